"""Where each way of reading the IMU says that the body went, from above and from the side, and how wrong it was where."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float64

from imutool.recording import Poses
from imutool.units import AXES
from imutool.viewing.html.drawing import Panel, Picture, legend
from imutool.viewing.html.page import BEFORE, HELD, INK, LEVELS, MODELS
from imutool.viewing.html.report_wording import best_run, format_quantity, run_name
from imutool.viewing.model.decimate import path_rows
from imutool.viewing.model.run_data import RunData, Trace, split_at_gaps

HEIGHT_INCH = 4.3
MOST_POINTS = 1500  # of a path
FAR = 3.0  # times the truth's extent, beyond which a path leaves the picture
MARGIN = 0.06
SHAPE = 1.25  # a panel is about so much wider than high
KILOMETRES_M = 5000.0  # from which on a picture counts in kilometres
LEAST_M = 0.5  # of a picture: a log at rest is not blown up to its millimetres

Points = Float64[np.ndarray, "_ 3"]


def color_of(data: RunData, trace: Trace) -> str:
    """The colour of a run in every picture."""
    return BEFORE if trace.is_raw else MODELS[data.models().index(trace) % len(MODELS)]


def paths(data: RunData) -> Picture:
    """Truth and all runs from above and from the side, in one scale; what leaves the picture is said."""
    shown, far = _near(data)
    views = [((0, 1), "From above", shown), ((_long_side(_box(data, shown)), 2), "From the side", shown)]
    if models := [trace for trace in far if not trace.is_raw]:
        side = _long_side(_box(data, models))
        views += [((0, 1), "All of it from above", models), ((side, 2), "All of it from the side", models)]
    panels = tuple(
        Panel(
            partial(_draw_paths, data=data, shown=traces, axes_of=axes_of, title=title), HEIGHT_INCH, f"Paths: {title.lower()}"
        )
        for axes_of, title, traces in views
    )
    start = "start" if data.truth is None else "true end"
    told = ["Circle: start" if data.truth is None else "Circle: start; square: end of the truth"]
    for trace in far:
        out_of = "the first two pictures" if models and not trace.is_raw else "every picture" if models else "the picture"
        told.append(f"{run_name(trace)} leaves {out_of} and ends {format_quantity(_end_m(data, trace), 'm')} from the {start}")
    return Picture("paths", "Paths", f"{'. '.join(told)}.", panels)


def error_map(data: RunData) -> Picture | None:
    """The best run's path coloured by its error in position and in orientation; nothing without truth."""
    trace = best_run(data)
    if trace is None or trace.errors is None or data.truth is None:
        return None
    fits = trace in _near(data)[0]
    points = trace.path.p_wb if fits else data.truth.at(trace.path.t_ns)[0].p_wb
    kinds = {"Position": (trace.errors.position_total_m, "m"), "Orientation": (trace.errors.orientation_total_deg, "°")}
    panels = []
    for kind, (error, unit) in kinds.items():
        title = f"{kind} error, at most {format_quantity(float(np.nanmax(error)), unit)}"
        draw = partial(_draw_heat, points=points, error=error, title=title, unit=unit)
        panels.append(Panel(draw, HEIGHT_INCH, f"{kind} error of {trace.name} along the path from above, in colours"))
    whose = f"Path of {run_name(trace)}" if fits else "The true path"
    caption = f"{whose} from above, coloured by the error that {run_name(trace)} has there."
    return Picture("error-map", "Where the error grows", caption, tuple(panels))


def _draw_paths(figure: Any, *, data: RunData, shown: Sequence[Trace], axes_of: tuple[int, int], title: str) -> None:
    axes = figure.subplots()
    sides = list(axes_of)
    box = _box(data, shown)
    scale, unit = _unit_of(_extent(box))
    lines = []
    for trace in data.traces:
        style = {"lw": 0.9 if trace.is_raw else 1.3, "color": color_of(data, trace), "label": trace.name}
        lines += axes.plot(*(_broken(trace.path)[:, sides] * scale).T, **style)
    if data.truth is not None:
        true = axes.plot(*(_broken(data.truth)[:, sides] * scale).T, lw=1.1, color=INK, ls=(0, (4, 2)), label="truth")
        lines = [*true, *lines]
        axes.plot(*data.truth.p_wb[-1, sides] * scale, marker="s", ms=5, color=INK, ls="")
    start = (data.truth if data.truth is not None else data.traces[0].path).p_wb[0]
    axes.plot(*start[sides] * scale, marker="o", ms=5, color=INK, ls="")
    _equal(axes, box[:, sides] * scale, LEAST_M * scale)
    axes.set(xlabel=f"{AXES[sides[0]]} ({unit})", ylabel=f"{AXES[sides[1]]} ({unit})")
    axes.set_title(title)
    legend(figure, lines)


def _draw_heat(figure: Any, *, points: Points, error: Float64[np.ndarray, " _"], title: str, unit: str) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.ticker import MaxNLocator

    axes = figure.subplots()
    starts = np.unique(np.linspace(0, len(points) - 1, min(len(points), MOST_POINTS)).astype(int))
    points, error = points[starts], np.fmax.reduceat(error, starts)  # the largest of each step
    scale, unit = _unit_of(float(np.nanmax(error))) if unit == "m" else (1.0, unit)
    error = error * scale
    top = float(np.nanmax(error))
    edges = np.asarray(MaxNLocator(len(LEVELS), min_n_ticks=3).tick_values(0.0, top if top > 0.0 else 1.0))
    edges = edges[edges >= 0.0][: len(LEVELS) + 1]
    level = np.clip(np.searchsorted(edges, error, side="right") - 1, 0, len(edges) - 2)
    axes.plot(points[:, 0], points[:, 1], color=HELD, lw=0.6)  # where there is no truth to compare with
    colors = [LEVELS[round(k * (len(LEVELS) - 1) / max(len(edges) - 2, 1))] for k in range(len(edges) - 1)]
    for k, color in enumerate(colors):
        here = (level == k) & np.isfinite(error)
        x, y = _pieces(points, here)
        axes.plot(x, y, color=color, lw=2.2, label=f"{edges[k]:g} to {edges[k + 1]:g} {unit}", solid_capstyle="round")
    _equal(axes, points[:, :2], LEAST_M)
    axes.set(xlabel="x (m)", ylabel="y (m)")
    axes.set_title(title)
    colored = ScalarMappable(BoundaryNorm(edges, len(colors)), ListedColormap(colors))
    bar = figure.colorbar(colored, ax=axes, shrink=0.8, pad=0.02)
    bar.set_label(f"error ({unit})")
    bar.outline.set_visible(False)
    bar.ax.grid(visible=False)


def _pieces(points: Points, here: Any) -> tuple[Any, Any]:
    """The steps that begin where `here` holds as one line with holes between."""
    starts = np.flatnonzero(here[:-1])
    if not len(starts):
        return np.zeros(0), np.zeros(0)
    keep = np.unique(np.concatenate([starts, starts + 1]))
    out = points[keep].copy()
    gaps = np.flatnonzero((np.diff(keep) > 1) | ~np.isin(keep[:-1], starts)) + 1
    out = np.insert(out, gaps, np.nan, axis=0)
    return out[:, 0], out[:, 1]


def _broken(poses: Poses) -> Points:
    """A path as one line that is broken where poses are missing."""
    parts = split_at_gaps(poses)
    share = max(2, MOST_POINTS // max(len(parts), 1))
    hole = np.full((1, 3), np.nan)
    rows = [piece for part in parts for piece in (part.p_wb[path_rows(part.p_wb, share)], hole)][:-1]
    return np.concatenate(rows)


def _unit_of(extent_m: float) -> tuple[float, str]:
    """What metres are multiplied by to be read easily, and what they are then."""
    return (1e-3, "km") if extent_m >= KILOMETRES_M else (1.0, "m")


def _equal(axes: Any, box: Float64[np.ndarray, "_ 2"], least: float) -> None:
    """Limits around what is to be seen, a metre as long upwards as across."""
    low, high = np.nanmin(box, axis=0), np.nanmax(box, axis=0)
    middle, half = (low + high) / 2.0, np.maximum((high - low) * (0.5 + MARGIN), least / 2.0)
    half = np.maximum(half, half[::-1] * [SHAPE, 1.0 / SHAPE])  # no wider or higher than the room that there is
    axes.set_xlim(middle[0] - half[0], middle[0] + half[0])
    axes.set_ylim(middle[1] - half[1], middle[1] + half[1])
    axes.locator_params(nbins=7)
    axes.set_aspect("equal", adjustable="box")


def _reference(data: RunData) -> Points:
    """What the picture is made to fit: the truth, else the path that keeps together best."""
    if data.truth is not None:
        return data.truth.p_wb
    return min((trace.path.p_wb for trace in data.traces), key=_extent)


def _box(data: RunData, shown: Sequence[Trace]) -> Points:
    """What is to be seen when these runs are shown beside the truth."""
    return np.concatenate([_reference(data), *(trace.path.p_wb for trace in shown)])


def _extent(points: Points) -> float:
    return float(np.max(np.ptp(points, axis=0)))


def _near(data: RunData) -> tuple[list[Trace], list[Trace]]:
    """Runs whose paths fit the picture, and those that leave it."""
    points = _reference(data)
    centre, most = points.mean(axis=0), FAR * max(_extent(points), LEAST_M)
    fits = [bool(np.abs(trace.path.p_wb - centre).max() <= most) for trace in data.traces]
    near = [trace for trace, fit in zip(data.traces, fits, strict=True) if fit]
    return near, [trace for trace, fit in zip(data.traces, fits, strict=True) if not fit]


def _end_m(data: RunData, trace: Trace) -> float:
    """How far a path ends from the truth, or without one from where it began."""
    if trace.errors is not None:
        known = trace.errors.position_total_m[np.isfinite(trace.errors.position_total_m)]
        return float(known[-1])
    return float(np.linalg.norm(trace.path.p_wb[-1] - trace.path.p_wb[0]))


def _long_side(points: Points) -> int:
    """The horizontal axis along which there is most to be seen from the side."""
    return int(np.argmax(np.ptp(points[:, :2], axis=0)))
