"""The report: what it says equals the figures, what it draws are the samples, what it lacks is left out, and it asks nobody."""

from __future__ import annotations

import re
import struct
import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import markup
from support.loaded import loaded

from imutool.bias_start.aided_path import residual_prior
from imutool.errors import ConfigError
from imutool.inertial.aids import Aids
from imutool.recording import Imu, Poses, Recording
from imutool.sensor.made_up_flight import flight
from imutool.viewing.html import drawing, report, report_errors, report_paths, report_signals, report_wording
from imutool.viewing.html.page import DARK, LEVELS, LIGHT, PAPER, is_imutool_page
from imutool.viewing.model import decimation
from imutool.viewing.model.events import Event
from imutool.viewing.model.load_view import build
from imutool.viewing.model.run_data import Run, RunData, Trace
from imutool.viewing.model.trajectory_error import RESET_S, Drift, Errors, Window

Page, svgs, curves = markup.Page, markup.svgs, markup.curves
APART = 2.0  # points between two curves that are seen as two
SECONDS, STILL_S = 20.0, 6.0  # of a flight, and of its rest before that
HOUR = 720_000  # samples at 200 Hz
MAX_BYTES, MAX_BYTES_OF_AN_HOUR = 1_500_000, 6_000_000
PIXEL = 0.05  # points; a drawing has two decimals
HOSTILE = '<img src=x onerror=alert(1)>"&\u202e../../x$y$'
CONTRAST = 3.0  # of lines and large letters against what is behind them (WCAG 1.4.11)
READABLE = 4.5  # of small letters


def subtract(recording: Recording, name: str, bias: np.ndarray, std: float | None = None) -> Run:
    """A model that takes off the same bias at all times."""
    imu, rows = recording.imu, np.tile(bias, (len(recording.imu), 1))
    gyro, accel = np.ascontiguousarray(rows[:, :3]), np.ascontiguousarray(rows[:, 3:])
    unsure = None if std is None else np.full((len(imu), 6), std)
    return Run(name, Imu(imu.t_ns, imu.gyro - gyro, imu.accel - accel), gyro, accel, unsure)


@pytest.fixture(scope="module")
def flown() -> Recording:
    return flight(3, duration_s=SECONDS, still_s=STILL_S)


@pytest.fixture(scope="module")
def seen(flown: Recording) -> RunData:
    """Raw and two models, one of which states how sure it is, with windows, drift and events as a log has them."""
    bias = np.concatenate([flown.scalars[f"/ground_truth/bias/{kind}"].values[0] for kind in ("gyro", "accel")])
    runs = [Run.raw(flown.imu), subtract(flown, "half", 0.5 * bias), subtract(flown, "in the log: whole", bias, std=0.01)]
    at = flown.imu.t_ns[1000]
    events = [Event("gap", int(at), int(at) + 10**8, "20 samples are missing"), Event("clock_jump", int(at), int(at), "back")]
    data = build(flown, runs, events=events)
    return replace(data, provenance={"file": "flight.mcap"})


@pytest.fixture(scope="module")
def page(seen: RunData) -> str:
    return report.page([seen])


@pytest.mark.usefixtures("words_alone")
def test_a_truth_of_orientations_alone_is_compared_in_orientation_alone(flown: Recording) -> None:
    turned = {topic: Poses(p.t_ns, np.zeros_like(p.p_wb), p.q_wb_wxyz) for topic, p in flown.truths.items()}
    data = build(replace(flown, truths=turned), [Run.raw(flown.imu), subtract(flown, "half", np.full(6, 1e-3))])
    written = report.page([data])
    assert "Orientation error" in written
    for words in ("Position error", "position error", "Position after", "Velocity after", "Position drift", 'id="log1-paths"'):
        assert words not in written


def panel(data: RunData, make: Callable[[RunData], drawing.Picture | None], which: int = 0) -> str:
    """One drawing of a picture that there is."""
    picture = make(data)
    assert picture is not None
    one = picture.panels[which]
    with mock.patch.dict(drawing.STYLE, {"path.simplify": False}):  # else matplotlib leaves out what no pixel would show
        return drawing.svg(one.draw, one.height_inch, "test", width_inch=drawing.HALF_INCH)


# ── what it says ──


def test_the_conclusion_comes_first_and_holds_the_figures_of_the_best_model(seen: RunData, page: str) -> None:
    whole = seen.traces[2].figures
    said = Page(page).text
    assert said.index("whole (in the log) cuts the orientation error") < said.index("Figures")
    assert f"from {report_wording.format_quantity(seen.traces[0].figures['aoe_deg'], '°')} to" in said
    less = report_wording.ratio_text(seen.traces[0].figures["aoe_deg"], whole["aoe_deg"])
    assert f"to {report_wording.format_quantity(whole['aoe_deg'], '°')} ({less})" in said
    errors = seen.traces[2].errors
    assert errors is not None
    row = int(np.nanargmax(errors.orientation_total_deg))
    worst = report_wording.format_quantity(float(errors.orientation_total_deg[row]), "°")
    at = report_wording.format_number(float(seen.elapsed_s(errors.t_ns)[row]))
    assert f"without alignment. The largest orientation error is {worst} at {at} s." in said


def test_samples_of_the_log_and_of_the_same_model_have_two_names_in_a_caption(seen: RunData) -> None:
    raw, _, logged = seen.traces
    far = [replace(trace, path=replace(trace.path, p_wb=trace.path.p_wb + 1e4)) for trace in (raw, logged)]
    far.append(replace(far[1], run=replace(logged.run, name="whole")))
    picture = report_paths.paths(replace(seen, traces=tuple(far)))
    assert picture is not None
    assert "whole (in the log) leaves" in picture.caption
    assert ". whole leaves" in picture.caption


def test_a_model_that_does_harm_is_not_praised(seen: RunData) -> None:
    raw, half, _ = seen.traces
    worse = replace(half, figures={**half.figures, "aoe_deg": 2.0 * raw.figures["aoe_deg"], "ape_m": raw.figures["ape_m"]})
    said = report_wording.comparison(worse, raw)
    assert said.startswith("half raises the orientation error from")
    assert "(2.0 times) and leaves the position error about as it was" in said
    seen = replace(seen, traces=(raw, worse))
    assert report_wording.summary_of_logs([seen]).startswith("In 0 of 1 logs")
    with drawing_only():
        compared = re.findall(r"<td class=word>(.*?)</td>.*?(best)?\" title", report.page([seen, replace(seen, name="other")]))
    assert [best for _, best in compared] == ["best", "", "best", ""]  # the smallest error, here of raw


def test_every_figure_is_in_the_table_to_the_last_digit_and_the_best_is_marked(seen: RunData, page: str) -> None:
    rows = {
        re.sub(r"<[^>]*>", "", row.split("</td>")[0]): re.findall(r'<td class="number( best)?" title="([^"]*)">', row)
        for row in re.findall(r"<tr>(.*?)</tr>", page, flags=re.DOTALL)
    }
    checked = 0
    for name, values in seen.table():
        if name in ("samples", "duration_s") or None in values:
            continue
        found = rows[report_wording.figure_label(name)]
        assert [float(value) for _, value in found] == values
        assert [bool(best) for best, _ in found] == [value == min(values) for value in values]
        checked += 1
    assert checked >= 5
    for trace_at, trace in enumerate(seen.traces):
        for window in trace.windows:
            found = rows[f"Orientation after {window.length_s:g} s (°)"]
            assert float(found[trace_at][1]) == window.orientation_deg
    assert any(trace.windows for trace in seen.traces)


def test_numbers_are_read_easily() -> None:
    told = {0.0: "0", 0.99996: "1.00", 1.234: "1.23", 43.21: "43.2", 0.0012345: "0.00123", 12345.6: "12,346", 3e-7: "3.0e-07"}
    assert {value: report_wording.format_number(value) for value in told} == told
    assert report_wording.format_number(None) == report_wording.format_number(float("nan")) == "–"
    assert report_wording.format_quantity(23_900.0, "m") == "23.9 km"
    assert report_wording.ratio_text(62.0, 2.0) == "31 times"


def drawing_only(*makes: object) -> object:
    """A page with some of its pictures: they are most of the time that one takes."""
    return mock.patch.object(report, "PICTURES", makes)


@pytest.mark.usefixtures("words_alone")
def test_several_logs_are_compared_first_and_each_has_its_part(seen: RunData) -> None:
    with drawing_only(report_paths.paths, report_errors.event_lanes):
        both = report.page([seen, replace(seen, name="other")])
    parsed = Page(both)
    assert parsed.text.startswith("2 logs 2 logs In 2 of 2 logs the best model has a smaller orientation error than raw")
    assert len(parsed.ids) == len(set(parsed.ids))
    assert {address.removeprefix("#") for address in parsed.addresses} <= set(parsed.ids)
    assert both.count("<details>") == 2
    assert len(svgs(both)) == 2 * (4 + 1)
    with pytest.raises(ConfigError, match="no log is given"):
        report.page([])


def test_events_have_lanes_and_rows_and_of_many_the_rest_is_counted(seen: RunData, page: str) -> None:
    assert {"gap: 1", "clock jump: 1", "worst error: 4"} <= set(curve_titles(page))
    assert "20 samples are missing" in Page(page).text
    many = [Event("stop", seen.start_ns + k * 10**8, seen.start_ns + k * 10**8, f"stop {k}") for k in range(90)]
    with drawing_only(report_errors.event_lanes):
        said = Page(report.page([replace(seen, events=(*seen.events, *many))])).text
    listed = len(re.findall(r"\bstop \d+\b", said))
    assert 0 < listed < 90
    assert f"{90 - listed} more are drawn above" in said


def test_of_many_events_the_longest_are_listed(seen: RunData) -> None:
    """The gap of a second of a log with many short ones was not in the table."""
    times = [(seen.start_ns + k * 10**8, 10**8 if k == 89 else 0) for k in range(90)]
    data = replace(seen, events=tuple(Event("gap", at, at + length, f"gap {k}") for k, (at, length) in enumerate(times)))
    assert "gap 89" in "".join(report_errors.event_table(data))


def test_an_angle_that_wraps_is_no_line_from_top_to_bottom() -> None:
    t = np.linspace(0.0, 100.0, 20_000)
    _, drawn = decimation.decimate_angle(t, np.mod(10.0 * t + 180.0, 360.0) - 180.0)
    assert np.nanmax(np.abs(np.diff(drawn))) < 10.0
    assert np.nanmin(drawn) < -179.0
    assert np.nanmax(drawn) > 179.0


def test_no_two_of_many_models_look_alike(seen: RunData) -> None:
    models = [replace(seen.traces[1], run=replace(seen.traces[1].run, name=f"model {k}")) for k in range(11)]
    data = replace(seen, traces=(seen.traces[0], *models))
    assert len({tuple(report_paths.style_of(data, trace).values()) for trace in data.traces}) == 12


def test_what_was_drawn_before_the_last_events_were_known_is_not_drawn_again(
    seen: RunData, page: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    names, svg = list[str](), report.svg
    drawn = report.drawings([replace(seen, events=seen.events[:1])])
    assert drawn
    monkeypatch.setattr(report, "svg", lambda draw, height, name, **how: names.append(name) or svg(draw, height, name, **how))
    assert re.sub("p-p[0-9a-f]{10}", "", report.page([seen], drawn)) == re.sub("p-p[0-9a-f]{10}", "", page)
    assert names == ["events-0"]


def curve_titles(content: str) -> list[str]:
    return re.findall(r'<g id="[^"]*curve-\d+"><title>([^<]*)</title>', content)


# ── what it draws ──


def test_every_run_has_its_curve_in_every_panel_it_belongs_to(seen: RunData, page: str) -> None:
    titles = curve_titles(page)
    names = [trace.name for trace in seen.traces]
    signed = {
        row: [of(trace).roll_pitch_yaw_deg[:, k] for trace in seen.traces] for k, row in enumerate(("roll", "pitch", "yaw"))
    }
    signed["vertical"] = [of(trace).vertical_m for trace in seen.traces]
    for row, errors in signed.items():
        tops = [np.nanmax(np.abs(error)) for error in errors]
        fits = [top <= report_errors.LINEAR_RATIO * min(tops) for top in tops]  # beyond, a run would be a stray sliver
        kind = "position" if row == "vertical" else "orientation"
        assert [titles.count(f"{name}: {kind} error, {row}") for name in names] == fits
    for name in names:
        assert titles.count(f"{name}: position error, horizontal") == 1
        if name != "raw":
            assert titles.count(f"{report_wording.run_name(seen.traces[names.index(name)])}: raw minus debiased, x") == 2
        # signals, their zoom, spectra and Allan deviations of two sensors, and the biases of a model
        assert titles.count(f"{name}, z") == 8 + 2 * (name != "raw")
    spectra = [svg for svg in svgs(page) if "spectrum" in svg]
    assert len(spectra) == 2
    for svg in spectra:  # the differences are constant: the spectrum of their rounding, below 1e-18, stretches no axis
        assert ">1e-" in svg
        assert not re.search(r">1e-[1-9]\d<", svg)
    assert titles.count("true, y") == 2
    assert titles.count("±3 σ, x") == 2
    assert titles.count("truth") == len([svg for svg in svgs(page) if "Paths:" in svg])


def test_a_wide_band_leaves_the_panel_that_its_curves_share(flown: Recording) -> None:
    bias = np.concatenate([flown.scalars[f"/ground_truth/bias/{kind}"].values[0] for kind in ("gyro", "accel")])
    for std, named in ((1.0, True), (0.004, False)):
        runs = [subtract(flown, "sure", bias, std=0.002), subtract(flown, "vague", 0.5 * bias, std=std)]
        drawn = panel(build(flown, [Run.raw(flown.imu), *runs]), report_signals.biases, 0)
        assert drawn.count("off scale: ±3 σ of vague, 6.00 wide") == 3 * named
        sure, vague = (curves(drawn)[name][:, 1].mean() for name in ("sure", "vague"))
        assert abs(sure - vague) > APART


def test_a_sample_near_the_largest_number_is_drawn(seen: RunData, flown: Recording) -> None:
    """Seeds n8-f and n8-g, numbers 166 and 296: the limits of the axis overflowed."""
    gyro = flown.imu.gyro.copy()
    gyro[50, 1] = 1.7e308
    run = Run.raw(Imu(flown.imu.t_ns, gyro, flown.imu.accel))
    assert "raw, y" in panel(replace(seen, traces=(replace(seen.traces[0], run=run),)), report_signals.signals)


def test_a_spectrum_whose_power_overflows_is_drawn(flown: Recording) -> None:
    imu = replace(flown.imu, accel=flown.imu.accel * [1.0, 1.0, 1e160])
    with np.errstate(all="ignore"):
        page = report.page([build(replace(flown, imu=imu, truths={}), [Run.raw(imu)])])
    assert len([svg for svg in svgs(page) if "spectrum" in svg]) == 2


@pytest.mark.parametrize("which", [0, 1], ids=["gyro", "accel"])
def test_signals_are_the_samples_of_all_runs_on_one_scale_one_below_the_other(seen: RunData, which: int) -> None:
    drawn = curves(panel(seen, report_signals.signals, which))
    t = seen.elapsed_s(seen.traces[0].run.imu.t_ns)
    for axis, suffix in enumerate(("", ", y", ", z")):
        values = [(one.name, (one.run.imu.gyro, one.run.imu.accel)[which][:, axis]) for one in seen.traces]
        extent = float(np.ptp(np.quantile(values[0][1], [0.01, 0.99])))
        steps = [k * step_of(drawn, values, suffix) for k in range(len(values))]
        assert steps[1] > extent
        lines = [(f"{name}{suffix}", y - step) for (name, y), step in zip(values, steps, strict=True)]
        same_scale([(drawn[name], *decimation.decimate_extremes(t, y)) for name, y in lines])


def step_of(drawn: dict[str, np.ndarray], values: list[tuple[str, np.ndarray]], suffix: str) -> float:
    """How much lower the second run is drawn than its samples, on the scale of the first."""
    (first, y), (second, other) = values[:2]
    t = np.arange(len(y), dtype=float)
    across = np.polyfit(decimation.decimate_extremes(t, y)[1], drawn[f"{first}{suffix}"][:, 1], 1)
    return float(
        np.median(decimation.decimate_extremes(t, other)[1] - (drawn[f"{second}{suffix}"][:, 1] - across[1]) / across[0])
    )


def same_scale(lines: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> None:
    """Each drawn line is its data by one and the same straight scale, found from the first; its corners are all there."""
    points, t, y = lines[0]
    across, up = np.polyfit(t, points[:, 0], 1), np.polyfit(y, points[:, 1], 1)
    for points, t, y in lines:
        assert len(points) == len(t)
        np.testing.assert_allclose(points[:, 0], np.polyval(across, t), atol=PIXEL)
        np.testing.assert_allclose(points[:, 1], np.polyval(up, y), atol=PIXEL)


def test_biases_are_what_was_taken_off_with_the_truth_on_the_same_scale(seen: RunData) -> None:
    drawn = curves(panel(seen, report_signals.biases))
    true = seen.true_bias["gyro"]
    lines = [(drawn["true, z"], *decimation.decimate_extremes(seen.elapsed_s(true.t_ns), true.values[:, 2]))]
    for trace in seen.models():
        t = seen.elapsed_s(trace.run.imu.t_ns)
        lines.append((drawn[f"{trace.name}, z"], *decimation.decimate_extremes(t, trace.run.gyro_bias[:, 2])))
    same_scale(lines)


def test_errors_are_on_one_scale_and_logarithmic_where_they_are_far_apart(seen: RunData) -> None:
    raw, half, _ = seen.traces
    assert raw.errors is not None
    assert half.errors is not None
    near = replace(seen, traces=(raw, half))
    drawn = curves(panel(near, report_errors.error_curves))
    t = seen.elapsed_s(raw.errors.t_ns)
    same_scale([(drawn[one.name], *decimation.decimate_extremes(t, of(one).orientation_total_deg)) for one in near.traces])
    tiny = replace(half, errors=scaled(half.errors, 1e-4))
    drawn = curves(panel(replace(seen, traces=(raw, tiny)), report_errors.error_curves))
    heights = drawn["raw"][200:, 1] - drawn["half"][200:, 1]  # upwards, numbers get smaller
    ratio = decimation.decimate_extremes(t, of(raw).orientation_total_deg / of(tiny).orientation_total_deg)
    assert heights.max() < 0.0
    assert np.log10(ratio[1][1:]).min() > 3.0


def test_errors_of_many_kilometres_are_in_kilometres_where_all_are(seen: RunData) -> None:
    raw, half, _ = seen.traces
    far, half_far = (replace(trace, errors=scaled(of(trace), 1e5)) for trace in (raw, half))
    for traces, unit in (((far, half_far), "km"), ((far, half), "m"), ((raw, half), "m")):
        picture = report_errors.error_curves(replace(seen, traces=traces))
        assert picture is not None
        figures, shown = list[Any](), picture.panels[1]
        drawing.svg(lambda figure: figures.append(figure) or shown.draw(figure), shown.height_inch, "x")  # noqa: B023
        rows = figures[0].axes
        assert [axes.get_ylabel() for axes in rows] == [f"{name} ({unit})" for name in ("total", "horizontal", "vertical")]
        largest = max(of(trace).position_total_m.max() for trace in traces) * (1e-3 if unit == "km" else 1.0)
        assert max(line.get_ydata().max() for line in rows[0].lines) == pytest.approx(largest)


def of(trace: Trace) -> Errors:
    assert trace.errors is not None
    return trace.errors


def scaled(errors: Errors, factor: float) -> Errors:
    return Errors(errors.t_ns, factor * errors.orientation_deg, factor * errors.roll_pitch_yaw_deg, factor * errors.position_m)


def test_an_aided_path_is_drawn_among_paths_and_errors_but_has_no_samples(seen: RunData) -> None:
    runs = [trace.run for trace in seen.traces[:2]]
    aided = runs[1].aided(Aids({"stops": ""}), residual_prior())
    data = replace(seen, traces=(*seen.traces[:2], replace(seen.traces[2], run=aided)))
    for make, drawn in ((report_paths.paths, True), (report_errors.error_curves, True), (report_signals.signals, False)):
        assert ("half aided" in panel(data, make)) == drawn
    assert "half aided" not in panel(data, report_signals.biases)
    assert report_wording.best_run(data) is data.traces[1]


def test_paths_have_equal_scales_and_one_that_leaves_is_said(seen: RunData) -> None:
    drawn = curves(panel(seen, report_paths.paths))
    assert seen.truth is not None
    true, points = seen.truth.p_wb, drawn["truth"]
    across, up = np.ptp(points[:, 0]) / np.ptp(true[:, 0]), np.ptp(points[:, 1]) / np.ptp(true[:, 1])
    assert across == pytest.approx(up, rel=0.01)
    raw, half, whole = seen.traces
    near = replace(whole, path=seen.truth)
    picture = report_paths.paths(replace(seen, traces=(raw, half, near)))
    assert "half leaves the first two pictures and ends" in picture.caption
    assert "raw leaves every picture and ends" in picture.caption
    assert "whole (in the log) leaves" not in picture.caption
    assert len(picture.panels) == 4
    assert len(report_paths.paths(replace(seen, traces=(raw, near))).panels) == 2


def test_the_path_is_coloured_by_its_error_and_the_largest_keeps_its_colour(seen: RunData) -> None:
    whole = seen.traces[2]
    error = np.zeros_like(of(whole).position_m)
    error[1234, 0] = 7.0  # one sample of four thousand
    peaked = replace(whole, errors=replace(of(whole), position_m=error))
    drawn = curves(panel(replace(seen, traces=(peaked,)), report_paths.error_map))
    assert set(drawn) == {f"{low} to {low + 1} m" for low in (0, 6)} | {f"{k} to {k + 1} m" for k in range(1, 6)} - empty(drawn)
    assert len(drawn["6 to 7 m"]) >= 2
    assert report_paths.error_map(replace(seen, truth=None)) is None


def test_labels_of_large_coordinates_do_not_touch(seen: RunData) -> None:
    """UTM: steps of 2.5 m have labels of eight characters."""
    assert seen.truth is not None

    def moved(path: Poses) -> Poses:
        return replace(path, p_wb=1.3 * path.p_wb + [691234.5, 5334567.8, 512.0])

    traces = tuple(replace(trace, path=moved(trace.path)) for trace in seen.traces)
    picture = report_paths.error_map(replace(seen, truth=moved(seen.truth), traces=traces))
    assert picture is not None
    figures, shown = list[Any](), picture.panels[0]
    drawing.svg(
        lambda figure: figures.append(figure) or shown.draw(figure), shown.height_inch, "x", width_inch=drawing.HALF_INCH
    )
    boxes = [label.get_window_extent() for label in figures[0].axes[0].get_xticklabels()]
    assert len(boxes) >= 2
    assert all(left.x1 < right.x0 for left, right in pairwise(boxes))


def test_gaps_of_the_samples_are_no_path_and_are_said(flown: Recording) -> None:
    number = np.arange(len(flown.imu))
    cut = replace(flown, imu=flown.imu.rows((number < 2000) | (number >= 2500)))  # at 200 Hz
    holed, whole = (build(one, [Run.raw(one.imu)]) for one in (cut, flown))
    assert any(note.startswith("Gaps of the IMU: 1, 2.5 s in all, the first at 9.995 s") for note in holed.notes)
    assert not any("Gaps of the IMU" in note for note in whole.notes)
    for data, parts in ((holed, 2), (whole, 1)):
        assert [path.count("M") for path in lines(panel(data, report_signals.signals))] == 3 * [parts]
        longest = max(step for path in lines(panel(data, report_paths.error_map)) for step in steps(path))
        assert longest < 10.0  # points; the 2.5 s would be a line of 70


def lines(svg: str) -> list[str]:
    """Paths of the curves that have a title."""
    return re.findall(r'<g id="[^"]*curve-\d+"><title>[^<]*</title>\s*<path d="([^"]*)"', svg)


def steps(path: str) -> list[float]:
    """Lengths of the drawn steps of a path."""
    parts = [np.array([pair.split() for pair in part.split("L")], dtype=float) for part in path.split("M")[1:]]
    return [float(length) for part in parts for length in np.linalg.norm(np.diff(part, axis=0), axis=1)]


def empty(drawn: dict[str, np.ndarray]) -> set[str]:
    """Levels that no step of the path is in have no corners, and no curve."""
    return {f"{k} to {k + 1} m" for k in range(7)} - set(drawn)


def test_a_long_log_shows_the_largest_drift_of_each_stretch(seen: RunData) -> None:
    rows, stretch = 10_000, 100
    since = np.arange(rows) % stretch * 0.1
    level = np.repeat(np.arange(rows // stretch, dtype=float), stretch)
    drift = Drift(10.0, seen.start_ns + np.arange(rows) * 10**8, since, level + since / 20.0, since, level)
    data = replace(seen, end_ns=int(drift.t_ns[-1]), traces=(replace(seen.traces[0], drift=drift),))
    picture = report_errors.drift_curves(data)
    assert picture is not None
    assert "Each stretch shows its largest" in picture.caption
    points = curves(panel(data, report_errors.drift_curves))["raw"]
    assert len(points) == rows // stretch
    steps = np.diff(points[:, 1])  # every stretch is as much above the one before
    np.testing.assert_allclose(steps, steps.mean(), atol=PIXEL)


def test_the_seconds_of_the_largest_error_are_shown_whole(seen: RunData) -> None:
    found = report_wording.worst_orientation_error(seen.traces[2], seen)
    assert found is not None
    points = curves(panel(seen, report_signals.zoom))["raw"]
    assert len(points) == pytest.approx(report_signals.ZOOM_S * 200.0, abs=3)


@given(st.floats(0.1, 10.0), st.integers(50, 2000))
def test_averaging_a_spectrum_keeps_a_level_and_its_order(level: float, count: int) -> None:
    frequency = np.arange(1.0, count + 1.0)
    at, power = decimation.average_log_bins(frequency, np.full((count, 3), level), 1.0)
    np.testing.assert_allclose(power, level, rtol=1e-12)
    assert (np.diff(at) > 0.0).all()
    assert at[0] == 1.0
    assert len(at) <= 1 + decimation.PER_DECADE * np.log10(count) + 1


# ── what is not there is left out ──


def titles(content: str) -> list[str]:
    return re.findall(r"<h3>([^<]*)</h3>", content)


@pytest.mark.usefixtures("words_alone")
def test_without_truth_there_are_no_errors_and_it_is_said(flown: Recording) -> None:
    data = build(replace(flown, truths={}, scalars={}), [Run.raw(flown.imu), subtract(flown, "model", np.full(6, 0.01))])
    content = report.page([data])
    assert titles(content) == ["Paths", "Signals", "Biases", "Spectra", "Allan deviation at rest", "Events", "Provenance"]
    said = Page(content).text
    assert "without truth, so its errors are unknown. model subtracts 0.992°/s from the angular rate" in said
    assert "truth" not in curve_titles(content)


def test_a_sensor_that_reads_zero_is_drawn(flown: Recording) -> None:
    zeros = np.zeros_like(flown.imu.gyro)
    dead = replace(flown, imu=Imu(flown.imu.t_ns, zeros, zeros))
    data = build(dead, [Run.raw(dead.imu)])
    assert not re.search(r"\bnan\b", Page(report.page([data])).text, re.IGNORECASE)
    assert report_signals.spectrum(data) is None  # its panels were empty
    assert report_signals.allan_deviation(data) is None


@pytest.mark.usefixtures("words_alone")
def test_a_bare_log_has_no_empty_section(flown: Recording) -> None:
    data = build(replace(flown, truths={}, scalars={}), [Run.raw(flown.imu)])
    (trace,) = data.traces
    content = report.page([replace(data, events=(), traces=(replace(trace, spectra={}),))])
    assert titles(content) == ["Paths", "Signals", "Allan deviation at rest", "Provenance"]
    moving = flown.imu.between(int(flown.imu.t_ns[1000]), int(flown.imu.t_ns[-1]))
    assert report_signals.allan_deviation(build(replace(flown, imu=moving), [Run.raw(moving)])) is None


def test_a_run_that_begins_later_is_at_rest_at_the_same_times(flown: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    late: Imu = flown.imu.rows(slice(200, None))
    data = build(replace(flown, truths={}, scalars={}), [Run.raw(flown.imu), replace(Run.raw(late), name="late")])
    curve, stretches = report_signals.allan.curve, []
    monkeypatch.setattr(report_signals.allan, "curve", lambda parts, step_s: stretches.append(parts) or curve(parts, step_s))
    assert report_signals.allan_deviation(data) is not None
    of_raw, _, of_late, _ = stretches
    np.testing.assert_array_equal(of_late[0], of_raw[0][200:])


def test_without_a_reset_the_drift_is_the_error_and_is_not_drawn_twice(flown: Recording) -> None:
    first_ns = int(flown.imu.t_ns[0])
    for seconds, drawn in ((RESET_S / 2.0, False), (1.5 * RESET_S, True)):
        short = flown.between(first_ns, first_ns + round(seconds * 1e9))
        data = build(short, [Run.raw(short.imu)])
        assert report_errors.error_curves(data) is not None
        assert (report_errors.drift_curves(data) is not None) == drawn


@pytest.mark.usefixtures("words_alone")
def test_truth_without_a_model_is_scored_alone(seen: RunData) -> None:
    with drawing_only(report_signals.biases, report_signals.zoom):
        raw = replace(seen.traces[0], figures={**seen.traces[0].figures, "duration_s": 12.5})  # a log may go on after its truth
        content = report.page([replace(seen, traces=(raw,))])
    assert titles(content) == ["Figures", "Drift from a true start", "Provenance"]
    assert re.search(r"raw has errors of .* over 12\.5 s", Page(content).text)
    assert 'class="number best"' not in content  # there is nothing to choose from


@pytest.mark.usefixtures("words_alone")
def test_without_allantools_the_page_says_what_is_left_out(seen: RunData, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report_signals, "find_spec", lambda name: None)
    with drawing_only(report_signals.allan_deviation):
        content = report.page([replace(seen, traces=seen.traces[:1])])
    assert "Allan deviation at rest" not in titles(content)
    assert "Without Allan deviations: allantools is not installed" in Page(content).text


# ── a page that can be sent to anybody ──


def test_no_request_leaves_it_and_it_runs_nothing(page: str) -> None:
    parsed = Page(page)
    assert parsed.addresses
    assert all(address.startswith("#") for address in parsed.addresses)
    assert "default-src 'none'" in page
    assert not parsed.tags & {"script", "link", "iframe", "img", "object"}
    assert parsed.handlers == []
    assert not re.search(r"@import|url\((?!#)", page)
    assert len(page.encode()) < MAX_BYTES


def test_names_from_anywhere_are_words_and_nothing_else(seen: RunData) -> None:
    hostile = replace(
        seen,
        name=HOSTILE,
        notes=(HOSTILE,),
        provenance={HOSTILE: HOSTILE},
        events=(Event("gap", seen.start_ns, seen.end_ns, HOSTILE),),
        traces=(seen.traces[0], replace(seen.traces[2], run=replace(seen.traces[2].run, name=HOSTILE))),
    )
    with drawing_only(report_paths.paths, report_signals.biases, report_errors.event_lanes):
        content = report.page([hostile, replace(hostile, name="_")])
    parsed = Page(content)
    assert not parsed.tags & {"img", "script"}
    assert parsed.handlers == []
    shown = HOSTILE.replace("\u202e", "\\u202e")
    assert parsed.text.count(shown) > 10
    assert "\u202e" not in content


def test_every_drawing_has_a_name_and_the_pages_own_colours(page: str) -> None:
    for svg in svgs(page):
        assert re.match(r'<svg role="img" aria-label="[^"]+"', svg.replace(' class="wide"', ""))
        assert not re.findall(r"#[0-9a-fA-F]{6}\b", svg)
        assert set(re.findall(r"var\(--(\w+)\)", svg)) <= LIGHT.keys()
    for name in LIGHT:
        assert page.count(f"--{name}: ") == 3, "light, dark and print"


def luminance(color: str) -> float:
    channels = np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)]) / 255.0
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("theme", [LIGHT, DARK, PAPER], ids=["light", "dark", "paper"])
def test_words_and_lines_stand_out_from_the_ground(theme: dict[str, str]) -> None:
    def contrast(name: str) -> float:
        low, high = sorted([luminance(theme[name]), luminance(theme["paper"])])
        return (high + 0.05) / (low + 0.05)

    assert all(contrast(name) >= READABLE for name in ("ink", "soft", "after"))
    assert all(contrast(name) >= CONTRAST for name in ("before", "second", "third", "fourth", "x", "y", "z"))
    assert len({theme[level.removeprefix("imutool:")] for level in LEVELS}) == len(LEVELS)


def test_an_hour_stays_small() -> None:
    rng = np.random.default_rng(1)
    t_ns = np.arange(HOUR) * 5_000_000
    imu = Imu(t_ns, rng.normal(size=(HOUR, 3)), rng.normal(size=(HOUR, 3)))
    walk = np.cumsum(rng.normal(size=(HOUR, 3)), axis=0)
    turned = np.tile([1.0, 0.0, 0.0, 0.0], (HOUR, 1))
    runs = [Run.raw(imu), Run("model", imu, walk, walk, np.abs(np.tile(walk, 2)))]
    path = Poses(t_ns, walk, turned)
    window = (Window(10.0, 360, 1.0, 1.0, 1.0),)
    figures = {"aoe_deg": 1.0, "ape_m": 1.0, "velocity_rmse_m_s": 1.0, "samples": HOUR, "duration_s": 3600.0}
    errors = Errors(t_ns, walk, walk, walk)
    traces = tuple(Trace(run, path, errors, windows=window, figures=figures) for run in runs)
    events = tuple(Event("gap", int(t), int(t) + 10**7, "gap") for t in t_ns[::1000])
    data = RunData("hour", 0, int(t_ns[-1]), path, {}, traces, (), events=events)
    assert len(report.page([data]).encode()) < MAX_BYTES_OF_AN_HOUR


# ── files ──


@pytest.mark.usefixtures("words_alone")
def test_a_page_is_written_whole_and_an_existing_file_is_kept(seen: RunData, tmp_path: Path) -> None:
    target = tmp_path / "report.html"
    report.check_target(target)
    assert list(tmp_path.iterdir()) == []
    with drawing_only(report_paths.paths):
        page = report.page([seen])
        report.write_page([seen], target)
    assert target.read_text(encoding="utf-8") == page
    assert is_imutool_page(target)
    for refused in (lambda: report.write_page([seen], target), lambda: report.check_target(target)):
        with pytest.raises(ConfigError, match="exists"):
            refused()
    assert target.read_text(encoding="utf-8") == page
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_pictures_are_sharp_and_named_after_the_log_wherever_its_name_leads(seen: RunData, tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "pictures"
    few = replace(
        seen,
        name="../.flight/1 <b>",
        truth=None,
        events=(),
        traces=(replace(seen.traces[0], errors=None, drift=None, spectra={}),),
    )
    made = report.write_pngs(few, folder)
    assert sorted(folder.iterdir()) == sorted(made)
    assert [path.name for path in made] == [f"_.flight_1__b_-{name}.png" for name in ("paths", "signals", "allan")]
    assert [path.name for path in tmp_path.iterdir()] == ["deep"]
    for path in made:
        png = path.read_bytes()
        assert png.startswith(b"\x89PNG")
        assert struct.unpack(">II", png[16:24])[0] == round(2 * drawing.HALF_INCH * drawing.DOTS_PER_INCH)
        assert painted(png, LIGHT["before"]) > 1000, path.name
    (folder / made[0].name).write_bytes(b"mine")
    with pytest.raises(ConfigError, match="exists"):
        report.write_pngs(few, folder)
    assert (folder / made[0].name).read_bytes() == b"mine"
    assert report.file_name("...") == "_"
    assert report.file_name("-rf") == "rf"


def painted(png: bytes, color: str) -> int:
    """How many pixels have a colour, or its half where it is drawn faintly."""
    import io

    from matplotlib.image import imread

    image = imread(io.BytesIO(png))[:, :, :3]
    wanted = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    return int((np.abs(image - wanted).max(axis=2) < 0.02).sum())


def test_our_colours_are_matplotlibs_only_while_we_draw(page: str) -> None:
    import matplotlib

    assert page
    assert not [name for name in matplotlib.colors.get_named_colors_mapping() if name.startswith("imutool")]
    assert matplotlib.rcParams["text.color"] == "black"


def test_a_missing_matplotlib_says_how_to_get_it(seen: RunData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    for make in (
        lambda: report.write_page([seen], tmp_path / "a.html"),
        lambda: report.write_pngs(seen, tmp_path),
        lambda: report.check_target(tmp_path / "a.html"),
    ):
        with pytest.raises(ConfigError, match=r"pip install 'imutool\[report\]'"):
            make()
    assert list(tmp_path.iterdir()) == []


def test_importing_the_views_costs_no_viewer_no_plotting_and_no_torch() -> None:
    code = "import imutool.viewing.model.run_data, imutool.viewing.rerun.viewer, imutool.viewing.html.report"
    assert loaded(code, {"torch", "rerun", "matplotlib"}) == []
