"""Pictures of paths from above and from the side, and a map of the error along the path."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from imutool.array_types import Bool, Float64
from imutool.recording import Poses
from imutool.units import AXES
from imutool.viewing.html.drawing import Panel, Picture, legend
from imutool.viewing.html.page import BEFORE, HELD, INK, LEVELS, MODELS
from imutool.viewing.html.report_wording import best_run, format_quantity, run_name
from imutool.viewing.model.decimation import path_rows
from imutool.viewing.model.run_data import RunData, Trace, gap_rows, split_at_gaps

HEIGHT_INCH = 4.3
MAX_POINTS = 1500  # of a path
FAR = 3.0  # extents of the truth; a path beyond leaves the picture
MARGIN = 0.06
ASPECT = 1.25  # width over height of a panel
DASHES: tuple[Any, ...] = ("-", (0, (7, 1.5, 1, 1.5)), (0, (1, 1)))  # of four models, of the next four, of the next
KILOMETRES_M = 5000.0  # extent from which axes are in kilometres
LONG_LABELS = 1e4  # coordinate from which labels, such as those of UTM, need the room of two
MIN_EXTENT_M = 0.5  # of a picture: a log at rest is not magnified to millimetres

Points = Float64[np.ndarray, "_ 3"]


def color_of(data: RunData, trace: Trace) -> str:
    """Colour of a run in every picture."""
    return BEFORE if trace.is_raw else MODELS[data.models().index(trace) % len(MODELS)]


def style_of(data: RunData, trace: Trace) -> dict[str, Any]:
    """Colour and dashes of a run's curves: no two runs of twelve share both."""
    rank = 0 if trace.is_raw else data.models().index(trace)
    return {"color": color_of(data, trace), "ls": DASHES[rank // len(MODELS) % len(DASHES)]}


def paths(data: RunData) -> Picture | None:
    """Truth and runs from above and from the side; None for a truth without positions.

    Paths that leave the picture are named.
    """
    if data.truth is not None and not data.truth.has_positions:
        return None
    shown, far = _near(data)
    views = [((0, 1), "From above", shown), ((_long_side(_box(data, shown)), 2), "From the side", shown)]
    if models := [trace for trace in far if not trace.is_raw]:
        side = _long_side(_box(data, models))
        views += [((0, 1), "Whole path, from above", models), ((side, 2), "Whole path, from the side", models)]
    panels = tuple(
        Panel(
            partial(_draw_paths, data=data, shown=traces, axes_of=axes_of, title=title), HEIGHT_INCH, f"Paths: {title.lower()}"
        )
        for axes_of, title, traces in views
    )
    start = "start" if data.truth is None else "true end"
    notes = ["Circle: start" if data.truth is None else "Circle: start; square: end of the truth"]
    for trace in far:
        out_of = "the first two pictures" if models and not trace.is_raw else "every picture" if models else "the picture"
        notes.append(f"{run_name(trace)} leaves {out_of} and ends {format_quantity(_end_m(trace), 'm')} from the {start}")
    return Picture("paths", "Paths", f"{'. '.join(notes)}.", panels)


def error_map(data: RunData) -> Picture | None:
    """Path of the best run, coloured by its position and orientation error; None without truth."""
    trace = best_run(data)
    if trace is None or trace.errors is None or data.truth is None or not data.truth.has_positions:
        return None
    fits = trace in _near(data)[0]
    rows = len(trace.path)
    starts = np.unique(np.linspace(0, rows - 1, min(rows, MAX_POINTS)).astype(int))
    points = trace.path.p_wb[starts] if fits else data.truth.at(trace.path.t_ns[starts])[0].p_wb
    whole = ~np.isin(np.arange(len(starts)), np.searchsorted(starts, gap_rows(trace.path.t_ns)) - 1)  # steps without a gap
    kinds = {"Position": (trace.errors.position_total_m, "m"), "Orientation": (trace.errors.orientation_total_deg, "°")}
    panels = []
    for kind, (error, unit) in kinds.items():
        title = f"{kind} error, at most {format_quantity(float(np.nanmax(error)), unit)}"
        maximum = np.fmax.reduceat(error, starts)  # of each step
        draw = partial(_draw_heat, points=points, whole=whole, error=maximum, title=title, unit=unit)
        panels.append(Panel(draw, HEIGHT_INCH, f"{kind} error of {trace.name} along the path from above, in colours"))
    whose = f"Path of {run_name(trace)}" if fits else "The true path"
    caption = f"{whose} from above, coloured by the error of {run_name(trace)}."
    return Picture("error-map", "Where the error grows", caption, tuple(panels))


def _draw_paths(figure: Any, *, data: RunData, shown: Sequence[Trace], axes_of: tuple[int, int], title: str) -> None:
    axes = figure.subplots()
    sides = list(axes_of)
    box = _box(data, shown)
    scale, unit = length_unit(_extent(box))
    lines = []
    for trace in data.traces:
        style = {"lw": 0.9 if trace.is_raw else 1.3, "label": trace.name, **style_of(data, trace)}
        lines += axes.plot(*(_broken(trace.path)[:, sides] * scale).T, **style)
    if data.truth is not None:
        true = axes.plot(*(_broken(data.truth)[:, sides] * scale).T, lw=1.1, color=INK, ls=(0, (4, 2)), label="truth")
        lines = [*true, *lines]
        axes.plot(*data.truth.p_wb[-1, sides] * scale, marker="s", ms=5, color=INK, ls="")
    start = (data.truth if data.truth is not None else data.traces[0].path).p_wb[0]
    axes.plot(*start[sides] * scale, marker="o", ms=5, color=INK, ls="")
    _equal(axes, box[:, sides] * scale, MIN_EXTENT_M * scale)
    axes.set(xlabel=f"{AXES[sides[0]]} ({unit})", ylabel=f"{AXES[sides[1]]} ({unit})")
    axes.set_title(title)
    legend(figure, lines)


def _draw_heat(
    figure: Any, *, points: Points, whole: Bool[np.ndarray, " _"], error: Float64[np.ndarray, " _"], title: str, unit: str
) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.ticker import MaxNLocator

    axes = figure.subplots()
    scale, unit = length_unit(float(np.nanmax(error))) if unit == "m" else (1.0, unit)
    error = error * scale
    top = float(np.nanmax(error))
    edges = np.asarray(MaxNLocator(len(LEVELS), min_n_ticks=3).tick_values(0.0, top if top > 0.0 else 1.0))
    edges = edges[edges >= 0.0][: len(LEVELS) + 1]
    level = np.clip(np.searchsorted(edges, error, side="right") - 1, 0, len(edges) - 2)
    axes.plot(*_pieces(points, whole), color=HELD, lw=0.6)  # where the truth is unknown
    colors = [LEVELS[round(k * (len(LEVELS) - 1) / max(len(edges) - 2, 1))] for k in range(len(edges) - 1)]
    for k, color in enumerate(colors):
        x, y = _pieces(points, (level == k) & np.isfinite(error) & whole)
        axes.plot(x, y, color=color, lw=2.2, label=f"{edges[k]:g} to {edges[k + 1]:g} {unit}", solid_capstyle="round")
    _equal(axes, points[:, :2], MIN_EXTENT_M)
    axes.set(xlabel="x (m)", ylabel="y (m)")
    axes.set_title(title)
    colored = ScalarMappable(BoundaryNorm(edges, len(colors)), ListedColormap(colors))
    bar = figure.colorbar(colored, ax=axes, shrink=0.8, pad=0.02)
    bar.set_label(f"error ({unit})")
    bar.outline.set_visible(False)
    bar.ax.grid(visible=False)


def _pieces(points: Points, selected: Any) -> tuple[Any, Any]:
    """Steps that begin where `selected` holds, as one line with holes."""
    starts = np.flatnonzero(selected[:-1])
    if not len(starts):
        return np.zeros(0), np.zeros(0)
    keep = np.unique(np.concatenate([starts, starts + 1]))
    out = points[keep].copy()
    out = np.insert(out, np.flatnonzero((np.diff(keep) > 1) | ~np.isin(keep[:-1], starts)) + 1, np.nan, axis=0)
    return out[:, 0], out[:, 1]


def _broken(poses: Poses) -> Points:
    """Path as one line with holes where poses are missing."""
    parts = split_at_gaps(poses)
    share = max(2, MAX_POINTS // max(len(parts), 1))
    hole = np.full((1, 3), np.nan)
    return np.concatenate([piece for part in parts for piece in (part.p_wb[path_rows(part.p_wb, share)], hole)][:-1])


def length_unit(extent_m: float) -> tuple[float, str]:
    """Factor and unit for an extent in metres."""
    return (1e-3, "km") if extent_m >= KILOMETRES_M else (1.0, "m")


def _equal(axes: Any, box: Float64[np.ndarray, "_ 2"], minimum: float) -> None:
    """Axis limits around a box with equal scales."""
    low, high = np.nanmin(box, axis=0), np.nanmax(box, axis=0)
    middle, half = (low + high) / 2.0, np.maximum((high - low) * (0.5 + MARGIN), minimum / 2.0)
    half = np.maximum(half, half[::-1] * [ASPECT, 1.0 / ASPECT])  # to the aspect of the panel
    axes.set_xlim(middle[0] - half[0], middle[0] + half[0])
    axes.set_ylim(middle[1] - half[1], middle[1] + half[1])
    axes.locator_params(nbins=7)
    if np.abs(middle[0]) >= LONG_LABELS:
        axes.locator_params("x", nbins=4)
    axes.set_aspect("equal", adjustable="box")


def _reference(data: RunData) -> Points:
    """Points that the picture must fit: the truth, else the path of the smallest extent."""
    if data.truth is not None:
        return data.truth.p_wb
    return min((trace.path.p_wb for trace in data.traces), key=_extent)


def _box(data: RunData, shown: Sequence[Trace]) -> Points:
    """Points to be seen when these runs are shown with the truth."""
    return np.concatenate([_reference(data), *(trace.path.p_wb for trace in shown)])


def _extent(points: Points) -> float:
    return float(np.max(np.ptp(points, axis=0)))


def _near(data: RunData) -> tuple[list[Trace], list[Trace]]:
    """Runs whose paths fit the picture, and runs that leave it."""
    points = _reference(data)
    centre, maximum = points.mean(axis=0), FAR * max(_extent(points), MIN_EXTENT_M)
    fits = [bool(np.abs(trace.path.p_wb - centre).max() <= maximum) for trace in data.traces]
    near = [trace for trace, fit in zip(data.traces, fits, strict=True) if fit]
    return near, [trace for trace, fit in zip(data.traces, fits, strict=True) if not fit]


def _end_m(trace: Trace) -> float:
    """Distance of a path's end from the truth, or from its own start without truth."""
    if trace.errors is not None:
        known = trace.errors.position_total_m[np.isfinite(trace.errors.position_total_m)]
        return float(known[-1])
    return float(np.linalg.norm(trace.path.p_wb[-1] - trace.path.p_wb[0]))


def _long_side(points: Points) -> int:
    """Horizontal axis of the largest extent."""
    return int(np.argmax(np.ptp(points[:, :2], axis=0)))
