"""Every view has something to show, everything logged has a view, and the words on the views are right."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rerun.blueprint as rrb
from support import saved_rrd

from imutool.recording import Recording
from imutool.viewing.model.load_view import build
from imutool.viewing.model.run_data import Run, RunData
from imutool.viewing.rerun import layout
from imutool.viewing.rerun.plots import error_axis_limit, plot

LONGEST = 90  # letters of a title at 1280 pixels: half the window is about 640 wide
NOT_SHOWN = {"/__properties", "/world"}  # a view has the second one as its origin

Make = Callable[[Recording, list[Run]], list[RunData]]


def certain(data: RunData) -> RunData:
    """With standard deviations."""
    traces = [
        trace if trace.is_raw else replace(trace, run=replace(trace.run, bias_std=np.full((len(trace.run.imu), 6), 1e-3)))
        for trace in data.traces
    ]
    return replace(data, traces=tuple(traces))


def bare(recording: Recording, runs: list[Run]) -> RunData:
    return build(replace(recording, truths={}, scalars={}), runs)


CASES: dict[str, Make] = {
    "one model": lambda recording, runs: [certain(build(recording, [runs[0], runs[2]]))],
    "two models": lambda recording, runs: [certain(build(recording, runs))],
    "raw alone": lambda recording, runs: [build(recording, runs[:1])],
    "a model without raw": lambda recording, runs: [build(recording, runs[2:])],
    "no truth": lambda recording, runs: [bare(recording, runs[:2])],
    "nothing known": lambda recording, runs: [replace(bare(recording, runs[:1]), events=())],
    "two logs": lambda recording, runs: [build(recording, runs[:2]), certain(replace(build(recording, runs), name="[a] b/c"))],
    "logs without truth": lambda recording, runs: [bare(recording, runs[:1]), bare(recording, runs)],
}


@pytest.fixture(params=CASES)
def logs(request: pytest.FixtureRequest, recording: Recording, runs: list[Run]) -> list[RunData]:
    return CASES[request.param](recording, runs)


def tabs(part: Any) -> list[str]:
    """The names of the tabs on the right of one log."""
    found: list[str] = saved_rrd.names(part.contents[1])
    return found


def test_every_view_shows_something_and_all_that_is_logged_is_shown(logs: list[RunData], tmp_path: Path) -> None:
    entities = saved_rrd.read(saved_rrd.written(logs, tmp_path / "a.rrd"))
    paths = [path for path in entities if entities[path].columns or entities[path].static]
    shown: set[str] = set()
    for view in saved_rrd.views(layout.blueprint(logs)):
        for name in saved_rrd.contents(view):
            held = saved_rrd.held(SimpleNamespace(contents=name, origin=view.origin), paths)
            assert held, f"{view.name}: {name}"
            shown |= held
        assert set(view.visualizer_overrides) <= set(saved_rrd.contents(view))
    assert {path for path in set(paths) - shown if not path.endswith("/world")} <= NOT_SHOWN


def test_titles_have_units_and_fit(logs: list[RunData]) -> None:
    for view in saved_rrd.views(layout.blueprint(logs)):
        assert view.name
        assert len(view.name) <= LONGEST
        if isinstance(view, rrb.TimeSeriesView):
            assert "(rad/s)" in view.name or "(m/s²)" in view.name or "(deg)" in view.name or "(m)" in view.name


def test_plots_show_the_whole_log_on_every_timeline_and_space_what_has_happened(logs: list[RunData]) -> None:
    for view in saved_rrd.views(layout.blueprint(logs)):
        if isinstance(view, rrb.TimeSeriesView):
            (told,) = view.properties["TimeAxis"].view_range.as_arrow_array().to_pylist()
            assert told["start"] == told["end"]  # infinite, both
        if isinstance(view, rrb.Spatial3DView):
            ranges = view.properties["VisibleTimeRanges"].ranges.as_arrow_array().to_pylist()
            assert [one["timeline"] for one in ranges] == list(saved_rrd.TIMELINES)


def test_the_tabs_are_those_that_have_content(recording: Recording, runs: list[Run]) -> None:
    def of(case: str) -> list[str]:
        return tabs(layout.blueprint(CASES[case](recording, runs)).root_container)

    everything = ["Signals", "Bias", "Spectrum", "Errors", "Events", "Report"]
    assert of("one model") == of("two models") == everything
    assert of("no truth") == [tab for tab in everything if tab != "Errors"]
    assert of("nothing known") == ["Signals", "Spectrum", "Report"]


def test_several_logs_are_compared_first_and_then_have_a_tab_each(recording: Recording, runs: list[Run]) -> None:
    two = CASES["two logs"](recording, runs)
    root = layout.blueprint(two).root_container
    assert saved_rrd.names(root) == ["Compare", "flight_3", "[a] b/c"]
    compared = saved_rrd.views(root.contents[0])
    assert [view.name for view in compared] == ["Orientation error (deg)", "Position error (m)", "Figures"]
    styles = list(compared[0].visualizer_overrides.values())
    named = [style.names.as_arrow_array().to_pylist()[0] for style in styles]
    assert named == [
        "flight_3: raw", "flight_3: debiased", "[a] b/c: raw", "[a] b/c: static", "[a] b/c: my model/v1",
    ]  # fmt: skip
    colors = [tuple(style.colors.as_arrow_array().to_pylist()) for style in styles]
    assert len(set(colors)) == len(colors)
    alone = layout.blueprint(CASES["logs without truth"](recording, runs)).root_container.contents[0]
    assert [view.name for view in saved_rrd.views(alone)] == ["Figures"]


def test_a_bias_is_plotted_by_axis_with_all_that_is_known_of_it(recording: Recording, runs: list[Run]) -> None:
    bias = layout.blueprint(CASES["one model"](recording, runs)).root_container.contents[1].contents[1]
    assert saved_rrd.names(bias) == ["Gyro bias (rad/s)", "Accel bias (m/s²)"]
    for (kind, unit), part in zip({"gyro": "rad/s", "accel": "m/s²"}.items(), bias.contents, strict=True):
        for axis, view in enumerate(saved_rrd.views(part)):
            assert view.name == f"{'xyz'[axis]} ({unit}): estimated bold, ±3σ thin, true broad and pale"
            visible = {
                path: style.visible_series.as_arrow_array().to_pylist() for path, style in view.visualizer_overrides.items()
            }
            only = [column == axis for column in range(3)]
            wanted = {"true": only, "estimated": only, "sigma": only * 2}
            assert visible == {f"/bias/{kind}/{name}": columns for name, columns in wanted.items()}


def test_colours_in_titles_are_those_of_the_curves(recording: Recording, runs: list[Run]) -> None:
    def titles(case: str) -> list[str]:
        return [view.name for view in saved_rrd.views(layout.blueprint(CASES[case](recording, runs)))]

    (orientation,) = [title for title in titles("one model") if title.startswith("Orientation error (deg), top")]
    assert re.fullmatch(r"Orientation error \(deg\), top [\d.]+: debiased blue, raw orange, worst pink", orientation)
    (position,) = [title for title in titles("two models") if title.startswith("Position error (m), top")]
    assert re.fullmatch(r"Position error \(m\), top [\d.]+: static blue, my model/v1 green, raw orange, worst pink", position)
    assert "Angular rate (rad/s): x red, y green, z blue; debiased bold, raw pale" in titles("one model")
    assert "Angular rate (rad/s): x red, y green, z blue" in titles("raw alone")
    assert "Angular rate (rad/s): x red, y green, z blue; static bold, my model/v1 paler" in titles("two models")


def test_only_where_a_title_cannot_say_what_is_what_a_legend_covers_curves() -> None:
    def legend(key: str) -> tuple[str, bool]:
        view = plot(["/a"], "Error (deg)", key)
        (visible,) = view.properties["PlotLegend"].visible.as_arrow_array().to_pylist()
        return str(view.name), visible

    assert legend("static blue") == ("Error (deg): static blue", False)
    assert legend("a model of a very long name " * 4) == ("Error (deg)", True)
    assert legend("") == ("Error (deg)", True)


def test_an_error_plot_keeps_the_models_readable_whatever_raw_does(data: RunData) -> None:
    errors = {"static": np.array([0.0, 2.0]), "my model/v1": np.array([np.nan, -1.0])}
    for raw, height in {6.0: 1.05 * 6.0, 19.9: 1.05 * 19.9, 20.1: 5.0, 2000.0: 5.0}.items():
        assert error_axis_limit(data, errors | {"raw": np.array([raw, np.nan])}) == pytest.approx(height)
    assert error_axis_limit(data, {"raw": np.array([np.nan])}) is None
    assert error_axis_limit(data, {"raw": np.zeros(3)}) is None
    assert error_axis_limit(data, {}) is None


def test_it_opens_with_whole_paths_on_elapsed_time(data: RunData) -> None:
    panel = layout.blueprint([data]).time_panel
    assert panel.timeline == "elapsed"
    assert panel.play_state == "following"  # at the end, so that all has happened
