"""The layout of a debiasing that is watched: the last seconds while it goes on, the whole of it when it is done."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from imutool.viewing.rerun.entities import clock
from imutool.viewing.rerun.entities import names as entities
from imutool.viewing.rerun.entities.names import Scope
from imutool.viewing.rerun.entities.palette import GROUND
from imutool.viewing.rerun.entities.plots import plot
from imutool.viewing.rerun.panels import BIAS_TITLES, TITLES

if TYPE_CHECKING:
    import rerun.blueprint as rrb

Box = tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]  # the lowest and the highest corner, metres

CORNER = np.array([-0.7, -0.7, 0.5])  # from where a whole path is looked at, in its diagonals
LAST_S = 20.0  # seen in the plots while it goes on


def blueprint(scopes: Mapping[str, Scope], boxes: Mapping[str, Box] | None = None) -> rrb.Blueprint:
    """Paths beside signals and biases, a tab for each IMU where there are several; the whole of them with their `boxes`."""
    import rerun.blueprint as rrb

    shown = [_of_one(topic, scope, None if boxes is None else boxes[topic]) for topic, scope in scopes.items()]
    return rrb.Blueprint(
        shown[0] if len(shown) == 1 else rrb.Tabs(*shown, active_tab=0),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=clock.ELAPSED, play_state="following"),
        auto_layout=False,
        auto_views=False,
    )


def _of_one(topic: str, scope: Scope, box: Box | None) -> rrb.Horizontal:
    import rerun as rr
    import rerun.blueprint as rrb

    begin, cursor = rr.TimeRangeBoundary.infinite(), rr.TimeRangeBoundary.cursor_relative()
    paths = rrb.Spatial3DView(
        origin=entities.path(scope, "world"),
        name="Paths",
        background=GROUND,
        eye_controls=_eye(scope, box),
        time_ranges=[rrb.VisibleTimeRange(timeline, start=begin, end=cursor) for timeline in clock.TIMELINES],
    )
    following = box is None
    signals = [_plot(scope, ("imu", kind), ("raw", "debiased"), title, following) for kind, title in TITLES.items()]
    biases = [_plot(scope, ("bias", kind), ("sigma", "estimated"), title, following) for kind, title in BIAS_TITLES.items()]
    return rrb.Horizontal(paths, rrb.Vertical(*signals, *biases), column_shares=[1, 1], name=topic)


def _eye(scope: Scope, box: Box | None) -> rrb.EyeControls3D:
    """A look at the whole debiased path; while it grows, at the body: without truth, integration leaves for kilometres."""
    import rerun.blueprint as rrb

    if box is None:
        return rrb.EyeControls3D(eye_up=(0.0, 0.0, 1.0), tracking_entity=entities.path(scope, "world", "debiased", "body"))
    low, high = box
    centre, size = (low + high) / 2.0, max(float(np.linalg.norm(high - low)), 1.0)
    return rrb.EyeControls3D(position=centre + size * CORNER, look_target=centre, eye_up=(0.0, 0.0, 1.0))


def _plot(scope: Scope, of: tuple[str, str], names: tuple[str, ...], title: str, following: bool) -> rrb.TimeSeriesView:
    import rerun as rr
    import rerun.blueprint as rrb

    contents = [entities.path(scope, *of, name) for name in names]
    if not following:
        return plot(contents, title, legend=False)
    begin, cursor = rr.TimeRangeBoundary.cursor_relative(seconds=-LAST_S), rr.TimeRangeBoundary.cursor_relative()
    return rrb.TimeSeriesView(
        origin="/",
        contents=contents,
        name=title,
        plot_legend=rrb.PlotLegend(visible=False),
        axis_x=rrb.TimeAxis(link="Independent", view_range=rr.TimeRange(start=begin, end=cursor)),
        time_ranges=[rrb.VisibleTimeRange(timeline, start=begin, end=cursor) for timeline in clock.TIMELINES],
    )
