"""What Rerun is given is read back from the file, entity by entity, to the last bit and the last nanosecond."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rerun as rr
from support import saved_rrd

from imutool.recording import Recording
from imutool.viewing.model.events import Event
from imutool.viewing.model.load_view import build
from imutool.viewing.model.run_data import LogTimes, Run, RunData, round_up_125
from imutool.viewing.model.trajectory_error import Drift, Errors, Window
from imutool.viewing.rerun import scene, sdk
from imutool.viewing.rerun.entities import paths, signals, styles
from imutool.viewing.rerun.viewer import binary

SCALARS = "Scalars:scalars"
SECOND = 1_000_000_000
LATE_NS = 7_000_003  # what a message waits before it is logged, in the fixture
HOSTILE = "<img src=x> | [a](http://b) *c* `d`\n# e"
SPELT = r"my\ model\/v1"  # how an entity path spells the fixture's awkward name

Curves = dict[str, tuple[np.ndarray, np.ndarray]]


def filled(data: RunData) -> RunData:
    """Every optional part filled in: certainty, log times other than stamps, events of all forms, provenance."""
    traces = []
    for trace in data.traces:
        spread = np.linspace(1e-4, 1e-3, 6 * len(trace.run.imu)).reshape(-1, 6)
        traces.append(trace if trace.is_raw else replace(trace, run=replace(trace.run, bias_std=spread)))
    start, stamps = data.start_ns, data.traces[0].run.imu.t_ns
    events = (
        Event("gap", start + SECOND, start + 2 * SECOND, "no samples for 1 s"),
        Event("gap", start + 3 * SECOND // 2, start + 3 * SECOND, "and none for 1.5 s"),
        Event("stop", start, start + SECOND // 2, "at rest"),
        Event("worst", start + 5 * SECOND, start + 5 * SECOND, HOSTILE),
        Event("saturation", data.end_ns, data.end_ns, "at the very end"),
    )
    logged = LogTimes(stamps, stamps + LATE_NS)
    return replace(data, traces=tuple(traces), events=events, logged=logged, provenance={"file": HOSTILE})


@pytest.fixture(scope="module")
def one(recording: Recording, runs: list[Run]) -> RunData:
    return filled(build(recording, [runs[0], runs[2]]))


@pytest.fixture(scope="module")
def saved(one: RunData, tmp_path_factory: pytest.TempPathFactory) -> Path:
    found: Path = saved_rrd.written([one], tmp_path_factory.mktemp("scene") / "one.rrd")
    return found


@pytest.fixture(scope="module")
def entities(saved: Path) -> SimpleNamespace:
    return SimpleNamespace(**{"all": saved_rrd.read(saved)})


def of_errors(home: str, part: str, errors: Errors) -> Curves:
    total, axes = {
        "orientation": (errors.orientation_total_deg, errors.orientation_deg),
        "position": (errors.position_total_m, errors.position_m),
    }[part]
    wanted = {home: (errors.t_ns, total[:, None]), f"{home}/axes": (errors.t_ns, axes)}
    if part == "orientation":
        return wanted | {f"{home}/rpy": (errors.t_ns, errors.roll_pitch_yaw_deg)}
    flat = {"horizontal": errors.horizontal_m, "vertical": errors.vertical_m}
    return wanted | {f"{home}/{name}": (errors.t_ns, values[:, None]) for name, values in flat.items()}


def of_drift(drift: Drift, world: str, role: str) -> Curves:
    return {
        f"{world}/error/drift/orientation/{role}": (drift.t_ns, drift.orientation_deg[:, None]),
        f"{world}/error/drift/position/{role}": (drift.t_ns, drift.position_m[:, None]),
    }


def expected(data: RunData, scope: str = "", scopes: dict[str, str] | None = None) -> Curves:
    """Each plotted entity with its stamps and its exact values; `scopes` names where a model's lie."""
    wanted: Curves = {}
    for trace in data.traces:
        home = scope if trace.is_raw or not scopes else scopes[trace.name]
        run, role = trace.run, "raw" if trace.is_raw else "debiased"
        t_ns = run.imu.t_ns
        wanted |= {f"{home}/imu/gyro/{role}": (t_ns, run.imu.gyro), f"{home}/imu/accel/{role}": (t_ns, run.imu.accel)}
        if trace.errors is not None:
            for part in ("orientation", "position"):
                wanted |= of_errors(f"{home}/error/{part}/{role}", part, trace.errors)
        if trace.drift is not None:
            wanted |= of_drift(trace.drift, home, role)
        for kind, bias, columns in (("gyro", run.gyro_bias, slice(0, 3)), ("accel", run.accel_bias, slice(3, 6))):
            if not trace.is_raw:
                wanted[f"{home}/bias/{kind}/estimated"] = t_ns, bias
            if run.bias_std is not None:
                std = run.bias_std[:, columns]
                wanted[f"{home}/bias/{kind}/sigma"] = t_ns, np.hstack([bias + 3.0 * std, bias - 3.0 * std])
    for kind, true in data.true_bias.items():
        wanted[f"{scope}/bias/{kind}/true"] = true.t_ns, true.values
    return wanted


def check(data: RunData, wanted: Curves, found: dict) -> None:
    """Every curve bit for bit, on all three timelines."""
    for path, (t_ns, values) in wanted.items():
        entity = found[path]
        np.testing.assert_array_equal(entity.numbers(SCALARS), values, err_msg=path)
        np.testing.assert_array_equal(entity.times(SCALARS, "elapsed"), t_ns - data.start_ns, err_msg=path)
        np.testing.assert_array_equal(entity.times(SCALARS, "ros2_timestamp"), t_ns, err_msg=path)
        np.testing.assert_array_equal(entity.times(SCALARS, "message_log_time"), data.log_ns(t_ns), err_msg=path)


# ── curves ──


def test_the_file_holds_exactly_the_entities_it_should(one: RunData, entities: SimpleNamespace) -> None:
    bodies = {f"/world/{role}/{part}" for role in ("gt", "raw", "debiased") for part in ("path", "body")}
    worst = {"/world/debiased/worst", "/error/orientation/debiased/worst", "/error/position/debiased/worst"}
    drawn = {f"/spectrum/{kind}/{part}" for kind in ("gyro", "accel") for part in ("raw", "debiased", "frame")}
    drawn |= {f"/spectrum/{kind}/frame/{part}" for kind in ("gyro", "accel") for part in ("hz", "density")}
    events = {f"/events/{kind}" for kind in ("gap", "stop", "worst", "saturation")}
    other = {"/world", "/world/error_vec", "/report", "/legend/colors", "/legend/ticks", "/__properties"}
    assert set(entities.all) == set(expected(one)) | bodies | worst | drawn | events | other


def test_every_curve_reads_back_bit_for_bit_with_its_nanoseconds(one: RunData, entities: SimpleNamespace) -> None:
    assert (one.log_ns(one.traces[0].run.imu.t_ns) != one.traces[0].run.imu.t_ns).all()
    check(one, expected(one), entities.all)


def test_nothing_is_on_any_other_timeline(entities: SimpleNamespace) -> None:
    found = {line for entity in entities.all.values() for stamps in entity.stamps.values() for line in stamps}
    assert found == set(saved_rrd.TIMELINES)


def test_curves_show_the_extremes_of_what_falls_on_a_pixel(one: RunData, entities: SimpleNamespace) -> None:
    policy = [int(rr.components.AggregationPolicy.MinMax.value)]
    for path in expected(one):
        assert entities.all[path].static["SeriesLines:aggregation_policy"] == policy, path


def test_axes_are_red_green_blue_raw_thin_and_faint_the_model_bold(entities: SimpleNamespace) -> None:
    def style(path: str) -> tuple[np.ndarray, list[float]]:
        static = entities.all[path].static
        packed = np.array(static["SeriesLines:colors"], dtype=np.uint32)
        return np.stack([packed >> 24, packed >> 16 & 255, packed >> 8 & 255], axis=1), static["SeriesLines:widths"]

    for kind in ("gyro", "accel"):
        raw, raw_widths = style(f"/imu/{kind}/raw")
        bold, bold_widths = style(f"/imu/{kind}/debiased")
        for colors in (raw, bold):
            assert colors.argmax(axis=1).tolist() == [0, 1, 2]
        assert max(raw_widths) < min(bold_widths)
        assert (np.ptp(raw, axis=1) < np.ptp(bold, axis=1)).all()  # nearer to grey
        assert entities.all[f"/imu/{kind}/debiased"].static["SeriesLines:names"] == ["x debiased", "y debiased", "z debiased"]


def test_the_worst_moment_is_marked_where_it_is(one: RunData, entities: SimpleNamespace) -> None:
    errors = one.models()[0].errors
    assert errors is not None
    for kind, total in (("orientation", errors.orientation_total_deg), ("position", errors.position_total_m)):
        row = int(np.nanargmax(total))
        mark = entities.all[f"/error/{kind}/debiased/worst"]
        assert mark.numbers(SCALARS).tolist() == [[total[row]]]
        assert mark.times(SCALARS, "ros2_timestamp").tolist() == [errors.t_ns[row]]
    row = int(np.nanargmax(errors.orientation_total_deg))
    static = entities.all["/world/debiased/worst"].static
    assert static["Points3D:labels"][1] == (
        f"worst: {errors.orientation_total_deg[row]:.2f}° at {(errors.t_ns[row] - one.start_ns) * 1e-9:.1f} s"
    )
    assert one.truth is not None
    foot = np.array(static["Points3D:positions"][0])
    np.testing.assert_array_equal(foot, one.truth.p_wb[np.abs(one.truth.t_ns - errors.t_ns[row]).argmin()].astype(np.float32))


@pytest.mark.parametrize(
    ("limit", "path", "maximum"),
    [("MAX_CURVE_ROWS", "/imu/accel/raw", 200), ("MAX_DERIVED_ROWS", "/error/position/raw/axes", 100)],
)
def test_a_very_long_curve_is_thinned_with_its_extremes_kept(
    one: RunData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, path: str, maximum: int
) -> None:
    monkeypatch.setattr(signals, limit, maximum)
    found = saved_rrd.read(saved_rrd.written([one], tmp_path / "thin.rrd"))
    t_ns, whole = expected(one)[path]
    values = found[path].numbers(SCALARS)
    assert len(values) <= maximum < len(whole)
    np.testing.assert_array_equal(values.min(axis=0), whole.min(axis=0))
    np.testing.assert_array_equal(values.max(axis=0), whole.max(axis=0))
    np.testing.assert_array_equal(values, whole[np.searchsorted(t_ns, found[path].times(SCALARS, "ros2_timestamp"))])
    (text,) = found["/report"].static["TextDocument:text"]
    assert ("Errors and biases are drawn with at most 100 rows" in text) == (limit == "MAX_DERIVED_ROWS")


# ── space ──


def strips(entity: SimpleNamespace) -> list[np.ndarray]:
    """The pieces of each row of a path."""
    return [np.array(row, dtype=np.float32) for row in entity.rows("LineStrips3D:strips").to_pylist()]


def test_a_path_grows_row_by_row_and_is_the_whole_path_at_the_end(one: RunData, entities: SimpleNamespace) -> None:
    assert one.truth is not None
    for role, poses in {"gt": one.truth, "raw": one.traces[0].path, "debiased": one.traces[1].path}.items():
        entity = entities.all[f"/world/{role}/path"]
        rows, stamps = strips(entity), entity.times("LineStrips3D:strips", "ros2_timestamp")
        pieces = np.concatenate(rows)
        p_wb = poses.p_wb.astype(np.float32)
        np.testing.assert_array_equal(pieces[:, 0], p_wb[:-1])
        np.testing.assert_array_equal(pieces[:, 1], p_wb[1:])
        ends = np.cumsum([len(row) for row in rows])
        np.testing.assert_array_equal(stamps, poses.t_ns[ends])  # what is shown at a time has happened by then
        assert (np.diff(stamps) <= 1.01 * SECOND).all()
        np.testing.assert_array_equal(entity.times("LineStrips3D:strips", "elapsed"), stamps - one.start_ns)
        np.testing.assert_array_equal(entity.times("LineStrips3D:strips", "message_log_time"), one.log_ns(stamps))


def test_bodies_read_back_in_the_single_precision_rerun_stores(one: RunData, entities: SimpleNamespace) -> None:
    assert one.truth is not None
    for role, poses in {"gt": one.truth, "raw": one.traces[0].path, "debiased": one.traces[1].path}.items():
        body, column = entities.all[f"/world/{role}/body"], "Transform3D:translation"
        np.testing.assert_array_equal(body.times(column, "ros2_timestamp"), poses.t_ns)
        np.testing.assert_array_equal(body.times(column, "elapsed"), poses.t_ns - one.start_ns)
        np.testing.assert_array_equal(body.times(column, "message_log_time"), one.log_ns(poses.t_ns))
        np.testing.assert_array_equal(body.numbers(column), poses.p_wb.astype(np.float32))
        q_xyzw = poses.q_wb_wxyz[:, [1, 2, 3, 0]].astype(np.float32)
        np.testing.assert_array_equal(body.numbers("Transform3D:quaternion"), q_xyzw)
        assert body.static["Points3D:labels"] == ["", {"gt": "truth"}.get(role, role)]


def test_the_debiased_path_has_the_colour_of_its_error_and_the_legend_its_scale(
    one: RunData, entities: SimpleNamespace
) -> None:
    errors = one.models()[0].errors
    assert errors is not None
    total = errors.orientation_total_deg
    top = round_up_125(total.max())
    assert total.max() <= top < 2.6 * total.max()
    packed = entities.all["/world/debiased/path"].rows("LineStrips3D:colors").flatten().to_numpy()
    found = np.stack([packed >> 24, packed >> 16 & 255, packed >> 8 & 255], axis=1)
    np.testing.assert_array_equal(found, styles.heat_colors(np.maximum(total[:-1], total[1:]), top))
    assert entities.all["/legend/ticks"].static["Points2D:labels"][0] == "0°"
    assert entities.all["/legend/ticks"].static["Points2D:labels"][4] == f"{top:g}°"


def test_an_error_vector_goes_from_the_true_place_to_the_estimated_one(one: RunData, entities: SimpleNamespace) -> None:
    path, errors = one.models()[0].path, one.models()[0].errors
    assert errors is not None
    entity = entities.all["/world/error_vec"]
    ends = np.concatenate(strips(entity))
    np.testing.assert_array_equal(ends[:, 1], path.p_wb.astype(np.float32))
    np.testing.assert_array_equal(ends[:, 0], (path.p_wb - errors.position_m).astype(np.float32))
    np.testing.assert_array_equal(entity.times("LineStrips3D:strips", "ros2_timestamp"), path.t_ns)


@pytest.mark.parametrize(("highest", "top"), [(0.3, 0.5), (1.0, 1.0), (1.1, 2.0), (5.0, 5.0), (130.0, 200.0), (0.0, 1.0)])
def test_a_scale_ends_with_a_number_that_can_be_read(highest: float, top: float) -> None:
    assert round_up_125(highest) == pytest.approx(top)


def test_heat_runs_from_its_first_colour_to_its_last_and_is_grey_where_nothing_is_known() -> None:
    colors = styles.heat_colors(np.array([0.0, 1.0, 2.0, 9.0, np.nan]), 2.0)
    np.testing.assert_array_equal(colors[[0, 1, 2, 3]], styles.HEAT[[0, 3, 6, 6]])
    assert tuple(colors[4]) == styles.GREY


def test_no_line_is_drawn_across_a_gap(recording: Recording, runs: list[Run], tmp_path: Path) -> None:
    t_ns = recording.truth.t_ns - recording.imu.t_ns[0]
    gappy = recording.truth.rows((t_ns < 4 * SECOND) | (t_ns > 5 * SECOND))
    data = build(replace(recording, truths={"/ground_truth/pose": gappy}), runs[:1])
    assert data.truth is not None
    found = saved_rrd.read(saved_rrd.written([data], tmp_path / "gap.rrd"))["/world/gt/path"]
    pieces = np.concatenate(strips(found))
    assert len(pieces) == len(data.truth) - 2
    edge = int(np.argmax(np.diff(data.truth.t_ns)))
    p_wb = data.truth.p_wb.astype(np.float32)
    assert not (pieces[:, 0] == p_wb[edge]).all(axis=1).any()
    assert (pieces[:, 1] == p_wb[edge]).all(axis=1).any()


def test_rows_of_a_very_long_path_are_bounded(one: RunData, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paths, "MAX_ROWS", 3)
    cut = paths.path_pieces(one.traces[0].path)
    assert len(cut.counts) == len(cut.stamp_ns) == 3
    assert cut.counts.sum() == len(cut.first) == len(one.traces[0].path) - 1


def test_a_path_of_one_pose_has_no_pieces(one: RunData) -> None:
    cut = paths.path_pieces(one.traces[0].path.rows(slice(0, 1)))
    assert len(cut.first) == len(cut.counts) == 0


# ── spectra and events ──


def test_a_spectrum_is_drawn_where_its_axes_say(one: RunData, entities: SimpleNamespace) -> None:
    for kind in ("gyro", "accel"):
        frame = signals.decade_frame(one, kind)
        drawn = entities.all[f"/spectrum/{kind}/debiased"].static["LineStrips2D:strips"]
        found = one.traces[1].spectra[kind]
        for points, column in zip(drawn, found.density.T, strict=True):
            x, y = np.array(points).T
            hz = 10.0 ** (x / signals.WIDTH * (frame.high_hz - frame.low_hz) + frame.low_hz)
            root = 10.0 ** ((1.0 - y / signals.HEIGHT) * (frame.high - frame.low) + frame.low)
            rows = np.abs(found.frequency_hz - hz[:, None]).argmin(axis=1)
            np.testing.assert_allclose(hz, found.frequency_hz[rows], rtol=1e-4)
            np.testing.assert_allclose(root, np.maximum(np.sqrt(column[rows]), 10.0**frame.low), rtol=1e-4)
            assert root.max() == pytest.approx(np.sqrt(column.max()), rel=1e-4)
        static = entities.all[f"/spectrum/{kind}/frame/hz"].static
        at_10_hz = static["Points2D:positions"][static["Points2D:labels"].index("10 Hz")]
        assert at_10_hz[0] == pytest.approx(frame.at(np.array([10.0]), np.array([1.0]))[0, 0], rel=1e-5)


def states(entity: SimpleNamespace) -> list[tuple[int, str]]:
    """Nanoseconds of elapsed time, and what begins there."""
    told = [state[0] for state in entity.rows("StateChange:state").to_pylist()]
    return list(zip(entity.times("StateChange:state", "elapsed").tolist(), told, strict=True))


def test_events_have_a_lane_for_each_kind_and_words_at_their_beginning(one: RunData, entities: SimpleNamespace) -> None:
    length = one.end_ns - one.start_ns
    seen = round(0.003 * length)
    assert states(entities.all["/events/gap"]) == [(0, "elsewhere"), (SECOND, "here"), (3 * SECOND, "elsewhere")]
    assert states(entities.all["/events/stop"]) == [(0, "here"), (SECOND // 2, "elsewhere")]
    moment = 5 * SECOND
    assert states(entities.all["/events/worst"]) == [(0, "elsewhere"), (moment, "here"), (moment + seen, "elsewhere")]
    assert states(entities.all["/events/saturation"])[1:] == [(length - seen, "here"), (length, "elsewhere")]
    for kind in ("gap", "stop", "worst", "saturation"):
        wanted = [event for event in one.events if event.kind == kind]
        lane = entities.all[f"/events/{kind}"]
        assert [text[0] for text in lane.rows("TextLog:text").to_pylist()] == [event.text for event in wanted]
        assert lane.times("TextLog:text", "ros2_timestamp").tolist() == [event.start_ns for event in wanted]
        assert lane.times("TextLog:text", "message_log_time").tolist() == [event.start_ns + LATE_NS for event in wanted]


# ── words ──


def test_the_report_holds_figures_windows_events_and_notes_and_no_markup_of_others(
    one: RunData, entities: SimpleNamespace
) -> None:
    (text,) = entities.all["/report"].static["TextDocument:text"]
    assert one.notes[0] in text
    row = next(line for line in text.splitlines() if line.startswith("| aoe_deg"))
    shown = [float(cell) for cell in row.split("|")[2:-1]]
    assert shown == pytest.approx([trace.figures["aoe_deg"] for trace in one.traces], rel=1e-3)
    (window, *_) = one.traces[1].windows
    assert isinstance(window, Window)
    assert f"| {window.length_s:g} s | my model/v1 | {window.count} |" in text
    assert "| 1.000 | 1.000 | gap | no samples for 1 s |" in text
    escaped = r"\<img src=x\> \| \[a\](http://b) \*c\* \`d\` \# e"
    assert text.count(escaped) == 2  # an event and the provenance
    assert HOSTILE not in text


# ── several models, several logs ──


def test_several_models_lie_under_their_names_and_raw_and_truth_beside_them(data: RunData, tmp_path: Path) -> None:
    found = saved_rrd.read(saved_rrd.written([data], tmp_path / "two.rrd"))
    scopes = {"static": "/run/static", "my model/v1": f"/run/{SPELT}"}
    wanted = expected(data, "", scopes)
    check(data, wanted, found)
    assert {path for path in found if SCALARS in found[path].columns} - set(wanted) == {
        f"{home}/error/{kind}/debiased/worst" for home in scopes.values() for kind in ("orientation", "position")
    }
    for path in ("/world/gt/path", "/world/raw/body", "/run/static/world/debiased/path", f"/run/{SPELT}/world/debiased/body"):
        assert path in found
    assert "/legend/colors" not in found  # each model's path has a colour of its own
    assert not {path for path in found if path.startswith("/world/debiased")}


def test_several_logs_lie_under_their_names_each_a_whole_tree(
    one: RunData, data: RunData, recording: Recording, runs: list[Run], tmp_path: Path
) -> None:
    bare = build(replace(recording, truths={}, scalars={}), runs[:1])
    found = saved_rrd.read(saved_rrd.written([one, data, replace(bare, name="a/b")], tmp_path / "logs.rrd"))
    second = r"/run/flight_3\ \(2\)"
    scopes = {"static": f"{second}/static", "my model/v1": f"{second}/{SPELT}"}
    for log, wanted in (
        (one, expected(one, "", {one.models()[0].name: "/run/flight_3"})),
        (data, expected(data, second, scopes)),
        (bare, expected(bare, r"/run/a\/b")),
    ):
        check(
            log, {path if path.startswith("/run") else f"/run/flight_3{path}": curve for path, curve in wanted.items()}, found
        )
    assert {path.split("/")[1] for path in found} == {"run", "compare", "__properties"}
    (text,) = found["/compare"].static["TextDocument:text"]
    aoe = text.splitlines()[2].split(" | ").index("aoe_deg")
    assert [line.split(" | ")[aoe] for line in text.splitlines()[4:]] == [
        f"{trace.figures['aoe_deg']:.4g}" if trace.figures else "" for log in (one, data, bare) for trace in log.traces
    ]


def test_a_name_is_shortened_by_the_words_that_all_models_begin_with(data: RunData) -> None:
    def labels(*models: str) -> list[str]:
        raw, *others = data.traces
        named = [replace(trace, run=replace(trace.run, name=name)) for trace, name in zip(others * 2, models, strict=False)]
        changed = replace(data, traces=(raw, *named))
        return [sdk.label(changed, trace) for trace in changed.traces]

    assert labels("euroc-adis16448-conv", "euroc-adis16448-linear") == ["raw", "conv", "linear"]
    assert labels("a-b", "a-bc") == ["raw", "b", "bc"]
    assert labels("static", "my model/v1") == ["raw", "static", "my model/v1"]
    assert labels("euroc-conv") == ["raw", "debiased"]


# ── what is not there ──


def test_the_command_that_opens_a_file_is_quoted_for_a_shell(recording: Recording, tmp_path: Path) -> None:
    data = build(recording, [Run.raw(recording.imu)])
    assert scene.save([data], tmp_path / "a b.rrd").said.endswith(f"rerun '{tmp_path / 'a b.rrd'}'")


def test_no_line_crosses_a_gap_of_the_samples(recording: Recording, tmp_path: Path) -> None:
    """Rerun drew a straight one over a second without samples; a row of NaN in its middle breaks it."""
    kept = ~np.isin(np.arange(len(recording.imu)), np.arange(400, 600))
    cut = replace(recording, imu=recording.imu.rows(kept), truths={}, scalars={})
    found = saved_rrd.read(saved_rrd.written([build(cut, [Run.raw(cut.imu)])], tmp_path / "gap.rrd"))
    values = found["/imu/gyro/raw"].numbers(SCALARS)
    assert np.isnan(values[400]).all()
    np.testing.assert_array_equal(np.delete(values, 400, axis=0), cut.imu.gyro)


def test_what_is_unknown_is_left_out(recording: Recording, runs: list[Run], tmp_path: Path) -> None:
    short = recording.between(int(recording.imu.t_ns[0]), int(recording.imu.t_ns[40]))  # too short for a spectrum
    data = replace(build(replace(short, truths={}, scalars={}), [Run.raw(short.imu)]), events=())
    found = saved_rrd.read(saved_rrd.written([data], tmp_path / "bare.rrd"))
    wanted = {"/imu/gyro/raw", "/imu/accel/raw", "/world", "/world/raw/path", "/world/raw/body", "/report", "/__properties"}
    assert set(found) == wanted
    assert "no truth" in found["/report"].static["TextDocument:text"][0]


@pytest.mark.parametrize("case", ["one", "data"])
def test_reruns_own_verifier_accepts_the_file(case: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    path = saved_rrd.written([request.getfixturevalue(case)], tmp_path / "verified.rrd")
    run = subprocess.run([str(binary()), "rrd", "verify", str(path)], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr


def test_the_docstring_of_the_scene_names_what_is_there(entities: SimpleNamespace) -> None:
    said = scene.log.__doc__ or ""
    for word in {path.split("/")[1] for path in entities.all} - {"__properties", "legend"}:
        assert f"`{word}" in said, word
