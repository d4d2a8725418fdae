"""What Rerun is given is read back from the file, entity by entity, to the last bit; and no display means no waiting."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from rerun.chunk import RrdReader

from imutool.recording import Poses, Recording
from imutool.view.rerun import scene
from imutool.view.rerun import viewer as view
from imutool.view.rerun.plots import limit
from imutool.view.rundata import Run, RunData, build, sparse

NO_WAIT_S = 2.0
SETTLED_S = 0.5
MODEL = "my model/v1"  # the fixture's awkward name, and how an entity path spells it
SPELT = r"my\ model\/v1"


@dataclass
class Entity:
    """All that a file says of one entity, temporal columns in the order of their rows."""

    static: dict[str, Any] = field(default_factory=dict)
    columns: dict[str, pa.Array] = field(default_factory=dict)

    def numbers(self, name: str) -> np.ndarray:
        """A column of fixed-size lists, one row per instant, in the precision it is stored in."""
        values = self.columns[name]
        flat = values
        while pa.types.is_list(flat.type) or pa.types.is_fixed_size_list(flat.type):
            flat = flat.flatten()
        return flat.to_numpy(zero_copy_only=False).reshape(len(values), -1)

    def times(self, name: str) -> np.ndarray:
        """Nanoseconds."""
        return self.columns[name].cast(pa.int64()).to_numpy()


def read(path: Path) -> dict[str, Entity]:
    reader = RrdReader(path)
    (store,) = reader.recordings()
    entities: dict[str, Entity] = {}
    for chunk in reader.stream(store=store):
        entity = entities.setdefault(chunk.entity_path, Entity())
        batch = chunk.to_record_batch()
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            if chunk.is_static:
                entity.static[name] = column.to_pylist()[0]
            else:
                before = entity.columns.get(name)
                entity.columns[name] = column if before is None else pa.concat_arrays([before, column])
    return entities


def layout(path: Path) -> str:
    """Everything the blueprint of a file says, as text."""
    reader = RrdReader(path)
    (store,) = reader.blueprints()
    return "\n".join(str(chunk.to_record_batch().to_pydict()) for chunk in reader.stream(store=store))


@pytest.fixture(scope="module")
def saved(data: RunData, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rerun") / "flight.rrd"
    view.show([data], save=path)
    return path


@pytest.fixture(scope="module")
def entities(saved: Path) -> dict[str, Entity]:
    return read(saved)


def expected_scalars(data: RunData) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Each plotted entity with its stamps and its exact values."""
    wanted: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for trace in data.traces:
        name, run, errors = trace.name.replace(MODEL, SPELT), trace.run, trace.errors
        assert errors is not None
        t_ns = run.imu.t_ns
        wanted[f"/imu/gyro/{name}"] = t_ns, run.imu.gyro
        wanted[f"/imu/accel/{name}"] = t_ns, run.imu.accel
        if not trace.is_raw:
            wanted[f"/bias/gyro/{name}"] = t_ns, run.gyro_bias
            wanted[f"/bias/accel/{name}"] = t_ns, run.accel_bias
        wanted[f"/error/orientation/{name}/axes"] = errors.t_ns, errors.orientation_deg
        wanted[f"/error/orientation/{name}/total"] = errors.t_ns, errors.orientation_total_deg[:, None]
        wanted[f"/error/position/{name}/axes"] = errors.t_ns, errors.position_m
        wanted[f"/error/position/{name}/total"] = errors.t_ns, errors.position_total_m[:, None]
    for kind, bias in data.true_bias.items():
        wanted[f"/bias/{kind}/true"] = bias.t_ns, bias.values
    return wanted


def expected_paths(data: RunData) -> dict[str, Poses]:
    assert data.truth is not None
    return {"truth": data.truth} | {trace.name.replace(MODEL, SPELT): trace.path for trace in data.traces}


def test_the_file_holds_exactly_the_entities_it_should(data: RunData, entities: dict[str, Entity]) -> None:
    bodies = {f"/world/{name}/{part}" for name in expected_paths(data) for part in ("path", "body")}
    wanted = set(expected_scalars(data)) | bodies | {"/world", "/report", "/__properties"}
    assert set(entities) == wanted


def test_every_curve_reads_back_bit_for_bit_with_its_nanoseconds(data: RunData, entities: dict[str, Entity]) -> None:
    for path, (t_ns, values) in expected_scalars(data).items():
        entity = entities[path]
        np.testing.assert_array_equal(entity.numbers("Scalars:scalars"), values, err_msg=path)
        np.testing.assert_array_equal(entity.times("ros2_timestamp"), t_ns, err_msg=path)
        np.testing.assert_array_equal(entity.times("elapsed"), t_ns - data.start_ns, err_msg=path)


def test_paths_and_bodies_read_back_in_the_single_precision_rerun_stores(data: RunData, entities: dict[str, Entity]) -> None:
    for name, poses in expected_paths(data).items():
        body = entities[f"/world/{name}/body"]
        np.testing.assert_array_equal(body.times("ros2_timestamp"), poses.t_ns)
        np.testing.assert_array_equal(body.times("elapsed"), poses.t_ns - data.start_ns)
        np.testing.assert_array_equal(body.numbers("Transform3D:translation"), poses.p_wb.astype(np.float32))
        q_xyzw = poses.q_wb_wxyz[:, [1, 2, 3, 0]].astype(np.float32)
        np.testing.assert_array_equal(body.numbers("Transform3D:quaternion"), q_xyzw)
        (strip,) = entities[f"/world/{name}/path"].static["LineStrips3D:strips"]
        np.testing.assert_array_equal(np.array(strip, dtype=np.float32), poses.p_wb.astype(np.float32))


def test_the_true_path_breaks_at_a_gap(recording: Recording, runs: list[Run], tmp_path: Path) -> None:
    t_ns = recording.truth.t_ns - recording.imu.t_ns[0]
    gappy = recording.truth.rows((t_ns < 4_000_000_000) | (t_ns > 5_000_000_000))
    data = build(replace(recording, truths={"/ground_truth/pose": gappy}), runs[:1])
    view.show([data], save=tmp_path / "gap.rrd")
    strips = read(tmp_path / "gap.rrd")["/world/truth/path"].static["LineStrips3D:strips"]
    assert data.truth is not None
    assert len(strips) == 2
    assert sum(map(len, strips)) == len(data.truth)


def test_a_long_path_is_thinned_in_3d_only(data: RunData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene, "MOST_IN_3D", 100)
    view.show([data], save=tmp_path / "long.rrd")
    entities = read(tmp_path / "long.rrd")
    rows = sparse(len(data.traces[0].path), 100)
    path = data.traces[0].path
    np.testing.assert_array_equal(entities["/world/raw/body"].times("ros2_timestamp"), path.t_ns[rows])
    (strip,) = entities["/world/raw/path"].static["LineStrips3D:strips"]
    assert len(strip) == len(rows) <= 101
    assert len(entities["/imu/gyro/raw"].times("elapsed")) == len(data.traces[0].run.imu)


def test_axes_are_red_green_blue_raw_thin_and_faint_the_model_bold(entities: dict[str, Entity]) -> None:
    def style(path: str) -> tuple[np.ndarray, list[float]]:
        static = entities[path].static
        packed = np.array(static["SeriesLines:colors"], dtype=np.uint32)
        return np.stack([packed >> 24, packed >> 16 & 255, packed >> 8 & 255], axis=1), static["SeriesLines:widths"]

    for kind in ("gyro", "accel"):
        raw, raw_widths = style(f"/imu/{kind}/raw")
        bold, bold_widths = style(f"/imu/{kind}/static")
        for colors in (raw, bold):
            assert colors.argmax(axis=1).tolist() == [0, 1, 2]
        assert max(raw_widths) < min(bold_widths)
        assert (np.ptp(raw, axis=1) < np.ptp(bold, axis=1)).all()  # nearer to grey
        names = entities[f"/imu/{kind}/static"].static["SeriesLines:names"]
        assert names == ["x static", "y static", "z static"]


def test_the_layout_shows_every_panel_over_the_whole_log_on_the_elapsed_timeline(saved: Path) -> None:
    text = layout(saved)
    for words in (
        "Paths", "Orientation error (deg)", "Position error (m)", "Angular rate (rad/s)", "Specific force (m/s²)",
        "Gyro bias (rad/s)", "Accel bias (m/s²)", "Signals", "Bias", "Report", "elapsed",
    ):  # fmt: skip
        assert f"'{words}'" in text, words


def test_an_error_plot_keeps_the_models_readable_whatever_raw_does(data: RunData) -> None:
    def top(factor: float, name: str) -> float:
        trace = next(t for t in data.traces if t.name == name)
        assert trace.errors is not None
        return factor * float(trace.errors.position_total_m.max())

    raw, worst = top(1.0, "raw"), max(top(1.0, "static"), top(1.0, MODEL))
    scales = {3.0: 3.0 * worst, 9.9: 9.9 * worst, 10.1: 5.0 * worst, 1000.0: 5.0 * worst}  # raw over worst: plot height
    for ratio, height in scales.items():
        first, *models = data.traces
        assert first.errors is not None
        grown = replace(first.errors, position_m=first.errors.position_m * (ratio * worst / raw))
        changed = replace(data, traces=(replace(first, errors=grown), *models))
        assert limit(changed, "position") == pytest.approx(1.05 * height)


def test_without_truth_and_model_there_is_no_empty_panel(recording: Recording, runs: list[Run], tmp_path: Path) -> None:
    view.show([build(replace(recording, truths={}, scalars={}), runs[:1])], save=tmp_path / "bare.rrd")
    text = layout(tmp_path / "bare.rrd")
    assert "'Paths'" in text
    assert "'Signals'" in text
    assert "error" not in text.replace("'error'", "").lower()
    assert "'Bias'" not in text
    entities = read(tmp_path / "bare.rrd")
    assert not [path for path in entities if path.startswith(("/error", "/bias", "/world/truth"))]
    assert "no truth" in entities["/report"].static["TextDocument:text"][0]


def test_the_report_holds_the_figures(data: RunData, entities: dict[str, Entity]) -> None:
    (text,) = entities["/report"].static["TextDocument:text"]
    assert data.notes[0] in text
    row = next(line for line in text.splitlines() if line.startswith("| aoe_deg"))
    shown = [float(cell) for cell in row.split("|")[2:-1]]
    assert shown == pytest.approx([trace.figures["aoe_deg"] for trace in data.traces], rel=1e-3)


def test_reruns_own_verifier_accepts_the_file(saved: Path) -> None:
    run = subprocess.run([str(view.binary()), "rrd", "verify", str(saved)], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
