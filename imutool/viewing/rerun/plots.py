"""Plot views, axis limits, cameras and the blueprint frame of every layout."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from imutool.array_types import Float64
from imutool.viewing.model.run_data import RunData, round_up_125
from imutool.viewing.rerun import rr, rrb
from imutool.viewing.rerun.sdk import ELAPSED, TIMELINES

Box = tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]  # lowest and highest corner, m

MAX_TITLE_LENGTH = 90  # letters that fit over half of a window of 1280 pixels
READABLE_RATIO = 10.0  # an error is still readable when the plot is this many times higher
LIMIT_FACTOR = 2.0  # axis limit over the models' largest error, rounded up, where a larger raw error leaves the plot
CAMERA_OFFSET = np.array([-0.7, -0.7, 0.5])  # camera position from the centre of the scene, in scene diagonals


def frame(
    content: Any,
    play_state: Literal["following"] | None = "following",
    recordings: Literal["collapsed", "expanded"] = "collapsed",
) -> rrb.Blueprint:
    """Blueprint around views: `elapsed` as the timeline, side panels collapsed."""
    return rrb.Blueprint(
        content,
        rrb.BlueprintPanel(state=recordings),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=ELAPSED, play_state=play_state),
        auto_layout=False,
        auto_views=False,
    )


def plot(
    contents: Sequence[str],
    title: str,
    key: str = "",
    *,
    height: tuple[float, float] | None = None,
    legend: bool | None = None,
    overrides: Mapping[Any, Any] | None = None,
) -> rrb.TimeSeriesView:
    """Time series view of entities over the whole log; `key` explains the curves in the title.

    A legend always covers some curves. Unless `legend` decides, it appears only where the title is too short for the key.
    """
    name = f"{title}: {key}" if key else title
    in_title = bool(key) and len(name) <= MAX_TITLE_LENGTH
    return rrb.TimeSeriesView(
        origin="/",
        contents=list(contents),
        name=name if in_title else title,
        axis_x=whole_time_axis(),
        axis_y=None if height is None else rrb.ScalarAxis(range=height),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=not in_title if legend is None else legend),
        overrides=overrides,
    )


def whole_time_axis(span_s: tuple[float, float] | None = None) -> rrb.TimeAxis:
    """Time axis over the whole timeline or a span; Rerun's default shows one minute."""
    boundary = rr.TimeRangeBoundary
    ends = [boundary.infinite()] * 2 if span_s is None else [boundary.absolute(seconds=t_s) for t_s in span_s]
    return rrb.TimeAxis(link="Independent", view_range=rr.TimeRange(start=ends[0], end=ends[1]))


def visible_until_cursor(last_s: float | None = None) -> list[rrb.VisibleTimeRange]:
    """Visible time ranges up to the cursor: from the start, or only the last seconds."""
    boundary = rr.TimeRangeBoundary
    start = boundary.infinite() if last_s is None else boundary.cursor_relative(seconds=-last_s)
    return [rrb.VisibleTimeRange(timeline, start=start, end=boundary.cursor_relative()) for timeline in TIMELINES]


def camera_on(box: Box) -> rrb.EyeControls3D:
    """Camera that looks at a box from above one of its corners."""
    low, high = box
    centre = (low + high) / 2.0
    return rrb.EyeControls3D(position=centre + diagonal_m(box) * CAMERA_OFFSET, look_target=centre, eye_up=(0.0, 0.0, 1.0))


def diagonal_m(box: Box) -> float:
    """Diagonal of a box, at least 1 m."""
    return max(float(np.linalg.norm(box[1] - box[0])), 1.0)


def error_axis_limit(data: RunData, values: Mapping[str, np.ndarray]) -> float | None:
    """Upper limit of a plot of errors; a raw error that flattens the models' curves leaves it.

    None where no run has an error above zero.
    """
    tops = {name: float(np.nanmax(np.abs(error))) for name, error in values.items() if np.isfinite(error).any()}
    models = [tops[trace.name] for trace in data.models() if trace.name in tops]
    highest = max(tops.values(), default=0.0)
    cut = bool(models) and highest > READABLE_RATIO * max(models) > 0.0
    limit = round_up_125(LIMIT_FACTOR * max(models)) if cut else 1.05 * highest
    return limit if limit > 0.0 else None


def error_range(limit: float | None, *, signed: bool = False) -> tuple[float, float] | None:
    """Axis range of errors up to a limit."""
    return None if limit is None else (-limit if signed else 0.0, limit)
