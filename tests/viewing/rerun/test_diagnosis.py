"""What the viewer is given of a diagnosis is read back from the file, entity by entity, to the last bit."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader
from support import diagnoses
from support.diagnoses import replace
from support.loaded import loaded
from support.saved_rrd import Entity, read

from imutool.diagnosis.wording.conclusion import headline
from imutool.errors import ConfigError
from imutool.viewing.rerun import diagnosis as view
from imutool.viewing.rerun.viewer import binary

SCALARS, STATE, TEXT = "Scalars:scalars", "StateChange:state", "TextLog:text"
AXES = [(signal, axis) for signal in ("gyro", "accel") for axis in "xyz"]


def layout(path: Path) -> str:
    reader = RrdReader(path)
    (store,) = reader.blueprints()
    return "\n".join(str(chunk.to_record_batch().to_pydict()) for chunk in reader.stream(store=store))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("diagnosis")
    for name in ("NOTHING", "BOTH", "THREE"):
        view.save(getattr(diagnoses, name), folder / f"{name}.rrd")
    return folder


@pytest.mark.parametrize("name", ["NOTHING", "BOTH", "THREE"])
def test_samples_and_what_is_left_read_back_bit_for_bit_with_their_nanoseconds(folder: Path, name: str) -> None:
    d = getattr(diagnoses, name)
    entities = read(folder / f"{name}.rrd")
    for trace in d.traces:
        root = str(rr.new_entity_path([trace.log]))
        for column, (signal, axis) in enumerate(AXES):
            real, before, after = (values[:, column] for values in (trace.real, trace.before, trace.after))
            samples, left = (entities[f"{root}/{signal}/{axis}/{kind}"] for kind in ("samples", "left"))
            np.testing.assert_array_equal(samples.numbers(SCALARS), np.stack([real, before, after], axis=1))
            np.testing.assert_array_equal(left.numbers(SCALARS), np.stack([real - before, real - after], axis=1))
            for entity in (samples, left):
                np.testing.assert_array_equal(entity.times(SCALARS, "elapsed"), np.rint(trace.t_s * 1e9).astype(np.int64))
            assert samples.static["SeriesLines:names"] == ["real", "before", "after"]
            assert left.static["SeriesLines:names"] == ["before", "after"]
            assert samples.static["SeriesLines:colors"][1:] == left.static["SeriesLines:colors"]


def test_the_file_holds_exactly_the_entities_it_should(folder: Path) -> None:
    plots = {f"/flight/{signal}/{axis}/{kind}" for signal, axis in AXES for kind in ("samples", "left")}
    where = {"/flight/where/unseen", "/flight/events", "/report", "/__properties"}
    assert set(read(folder / "NOTHING.rrd")) == plots | where
    located = {f"/flight/where/gyro/{axis}" for axis in "xyz"} | {f"/flight/where/accel/{axis}" for axis in "xy"}
    assert set(read(folder / "BOTH.rrd")) == plots | where | located


def states(entity: Entity) -> list[tuple[float, str]]:
    """Times in seconds, and what begins there."""
    told = [state[0] for state in entity.rows(STATE).to_pylist()]
    return list(zip((entity.times(STATE, "elapsed") * 1e-9).round(6).tolist(), told, strict=True))


def test_a_state_turns_where_a_located_stretch_begins_and_ends(folder: Path) -> None:
    entities = read(folder / "BOTH.rrd")
    wanted = [(0.0, "elsewhere"), (12.0, "here"), (48.5, "elsewhere"), (60.0, "here"), (89.0, "elsewhere")]
    assert states(entities["/flight/where/gyro/x"]) == wanted
    assert states(entities["/flight/where/accel/y"]) == wanted[:3]
    assert states(entities["/flight/where/unseen"]) == [(0.0, "elsewhere"), (30.0, "here"), (59.995, "elsewhere")]


def test_stretches_that_overlap_are_one(folder: Path) -> None:
    other = replace(diagnoses.FAST, intervals_s=((40.0, 50.0), (50.0, 55.0), (70.0, 71.0)), regime="high up")
    view.save(replace(diagnoses.ARM, located=(other, diagnoses.FAST)), folder / "overlap.rrd")
    entity = read(folder / "overlap.rrd")["/flight/where/accel/x"]
    wanted = [(0.0, "elsewhere"), (12.0, "here"), (55.0, "elsewhere"), (70.0, "here"), (71.0, "elsewhere")]
    assert states(entity) == wanted


def test_lines_show_the_extremes_of_what_falls_on_a_pixel(folder: Path) -> None:
    for kind in ("samples", "left"):
        policy = read(folder / "BOTH.rrd")[f"/flight/gyro/x/{kind}"].static["SeriesLines:aggregation_policy"]
        assert policy == [int(rr.components.AggregationPolicy.MinMax.value)]


def test_events_stand_where_stretches_begin_and_end(folder: Path) -> None:
    events = read(folder / "BOTH.rrd")["/flight/events"]
    told = list(zip(events.times(TEXT, "elapsed") * 1e-9, [t[0] for t in events.rows(TEXT).to_pylist()], strict=True))
    assert [t for t, _ in told] == sorted(t for t, _ in told)
    at = {(round(t, 1), text) for t, text in told}
    turning, fast = "gyro x, y, z, when turning", "accel x, y, angular rate above 0.4 rad/s"
    wanted = {
        (12.0, f"begins: {turning}"),
        (48.5, f"ends: {turning}"),
        (60.0, f"begins: {turning}"),
        (89.0, f"ends: {turning}"),
    }
    wanted |= {(12.0, f"begins: {fast}"), (48.5, f"ends: {fast}")}
    assert at == wanted | {(30.0, "unseen by any fit from here"), (60.0, "seen again from here")}


def test_located_time_goes_to_the_log_it_lies_in(folder: Path) -> None:
    entities = read(folder / "THREE.rrd")
    second = replace(diagnoses.FAST, intervals_s=((110.0, 120.0),))
    assert "/one/where/accel/x" in entities
    assert "/two/where/accel/x" not in entities
    view.save(replace(diagnoses.THREE, located=(second,)), folder / "second.rrd")
    entities = read(folder / "second.rrd")
    assert "/one/where/accel/x" not in entities
    assert "/two/where/accel/x" in entities


def test_the_report_says_the_conclusion_and_what_a_log_is_called_is_no_markup(folder: Path) -> None:
    (words,) = read(folder / "BOTH.rrd")["/report"].static["TextDocument:text"]
    assert headline(diagnoses.BOTH).replace("_", "\\_") in words
    assert diagnoses.BOTH.remarks[0] in words
    hostile = replace(diagnoses.BY_CURRENT, findings=(replace(diagnoses.DRIVEN, driver="[a](http://b) <i>"),), traces=())
    view.save(hostile, folder / "hostile.rrd")
    (words,) = read(folder / "hostile.rrd")["/report"].static["TextDocument:text"]
    assert r"\[a\](http://b) \<i\>" in words


def test_the_layout_has_a_tab_for_each_log_and_a_panel_for_each_axis(folder: Path) -> None:
    said = layout(folder / "THREE.rrd")
    for words in (
        "one", "two", "Residuals", "Samples", "Angular rate x (rad/s)", "Specific force z (m/s²)", "Where it differs",
        "Events", "Report", "elapsed",
    ):  # fmt: skip
        assert f"'{words}'" in said, words
    assert "'Residuals'" not in layout_of(replace(diagnoses.BOTH, traces=()), folder / "bare.rrd")


def layout_of(d: object, path: Path) -> str:
    view.save(d, path)  # type: ignore[arg-type]
    return layout(path)


def test_two_logs_of_one_name_stay_apart(folder: Path) -> None:
    first, second = diagnoses.traces("log", duration_s=12.0), diagnoses.traces("log", seed=2, duration_s=12.0)
    d = replace(diagnoses.NOTHING, real=("a", "b"), bias=np.zeros((2, 6)), traces=(first, second, replace(first, log="report")))
    assert view.names(d.traces) == ["log", "log (2)", "report (2)"]
    view.save(d, folder / "twice.rrd")
    entities = read(folder / "twice.rrd")
    np.testing.assert_array_equal(entities["/log/gyro/x/samples"].numbers(SCALARS)[:, 0], first.real[:, 0])
    np.testing.assert_array_equal(entities[r"/log\ \(2\)/gyro/x/samples"].numbers(SCALARS)[:, 0], second.real[:, 0])


@pytest.mark.parametrize("name", ["NOTHING", "BOTH", "THREE"])
def test_reruns_own_verifier_accepts_the_file(folder: Path, name: str) -> None:
    run = subprocess.run(
        [str(binary()), "rrd", "verify", str(folder / f"{name}.rrd")], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr


def test_an_existing_file_is_kept(tmp_path: Path) -> None:
    target = tmp_path / "view.rrd"
    target.write_bytes(b"mine")
    with pytest.raises(ConfigError, match="exists"):
        view.save(diagnoses.NOTHING, target)
    assert target.read_bytes() == b"mine"
    assert [path.name for path in tmp_path.iterdir()] == ["view.rrd"]


def test_an_interrupt_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(KeyboardInterrupt):
        view.save(diagnoses.NOTHING, tmp_path / "view.rrd")
    assert list(tmp_path.iterdir()) == []


def test_a_missing_rerun_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ConfigError, match=r"pip install 'imutool\[view\]'"):
        view.save(diagnoses.NOTHING, tmp_path / "view.rrd")
    assert list(tmp_path.iterdir()) == []


def test_importing_what_shows_a_diagnosis_costs_no_viewer_no_plotting_and_no_torch() -> None:
    shows = ("diagnosis.wording.conclusion", "viewing.html.diagnosis_page", "viewing.rerun.diagnosis")
    assert loaded(f"import {', '.join(f'imutool.{name}' for name in shows)}", {"torch", "rerun", "matplotlib"}) == []
