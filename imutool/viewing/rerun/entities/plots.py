"""Plots over the whole log, on whatever timeline the viewer shows, and how high a plot of errors reaches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun.entities.palette import end_of_scale

if TYPE_CHECKING:
    import rerun.blueprint as rrb

LONGEST_TITLE = 90  # letters that fit over half of a window of 1280 pixels
READABLE = 10.0  # an error this many times smaller than the plot is high can still be read
SHOWN = 2.0  # times the models' largest error, and up to a number that can be read: how high a plot reaches that raw leaves


def plot(
    contents: Sequence[str],
    title: str,
    key: str = "",
    *,
    height: tuple[float, float] | None = None,
    legend: bool | None = None,
    overrides: Mapping[Any, Any] | None = None,
) -> rrb.TimeSeriesView:
    """A plot of these entities; the `key` says in its title what is what.

    A legend covers curves, wherever it is: unless it is asked for or refused, there is one where the title cannot say it.
    """
    import rerun.blueprint as rrb

    name = f"{title}: {key}" if key else title
    in_title = bool(key) and len(name) <= LONGEST_TITLE
    corner = rrb.PlotLegend(rrb.Corner2D.RightTop, visible=not in_title if legend is None else legend)
    axis_y = None if height is None else rrb.ScalarAxis(range=height)
    return rrb.TimeSeriesView(
        origin="/",
        contents=list(contents),
        name=name if in_title else title,
        axis_x=whole(),
        axis_y=axis_y,
        plot_legend=corner,
        overrides=overrides,
    )


def whole() -> rrb.TimeAxis:
    """All of whatever timeline is shown; by default Rerun shows a minute around the cursor."""
    import rerun as rr
    import rerun.blueprint as rrb

    end = rr.TimeRangeBoundary.infinite()
    return rrb.TimeAxis(link="Independent", view_range=rr.TimeRange(start=end, end=end))


def limit(data: RunData, values: Mapping[str, np.ndarray]) -> float | None:
    """How high a plot of errors, by run, reaches: a raw error that would make the models' flat lines leaves the plot.

    None where no run has errors, or none but zero.
    """
    tops = {name: float(np.nanmax(np.abs(found))) for name, found in values.items() if np.isfinite(found).any()}
    models = [tops[trace.name] for trace in data.models() if trace.name in tops]
    highest = max(tops.values(), default=0.0)
    cut = bool(models) and highest > READABLE * max(models) > 0.0
    reach = end_of_scale(SHOWN * max(models)) if cut else 1.05 * highest
    return reach if reach > 0.0 else None


def upwards(reach: float | None) -> tuple[float, float] | None:
    """The range of a plot of what has no sign."""
    return None if reach is None else (0.0, reach)


def both_ways(reach: float | None) -> tuple[float, float] | None:
    """The range of a plot of what has a sign."""
    return None if reach is None else (-reach, reach)
