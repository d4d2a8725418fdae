"""Pictures of errors over time, drift since each reset, and events."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.viewing.html.drawing import Panel, Picture, at_least_three_ticks, legend, plain_tick_labels
from imutool.viewing.html.page import AFTER, BEFORE, HELD, INK, MARK, text
from imutool.viewing.html.report_paths import length_unit, style_of
from imutool.viewing.html.report_wording import alignment_text, format_number, format_quantity
from imutool.viewing.model.decimation import DecimatedLine, decimate_angle, decimate_extremes
from imutool.viewing.model.events import KINDS, Event
from imutool.viewing.model.run_data import RunData, Trace
from imutool.viewing.model.trajectory_error import Drift

DECADES = 2.5  # shown below the largest error of the best run
LINEAR_RATIO = 8.0  # of the largest errors of two runs; above it a scale is logarithmic, or one run leaves the panel
MAX_RESETS = 60  # that stay distinguishable in a picture
HEIGHTS_INCH = {1: 2.6, 3: 5.6, 4: 5.6}  # by number of rows: panels side by side have one height

Line = Float64[np.ndarray, " _"]


def error_curves(data: RunData) -> Picture | None:
    """Orientation and position error, total and by direction; None without truth."""
    with_errors = [(trace, trace.errors) for trace in data.traces if trace.errors is not None]
    if not with_errors:
        return None
    scored, errors = [trace for trace, _ in with_errors], [found for _, found in with_errors]
    turned = {
        "total": [found.orientation_total_deg for found in errors],
        **{name: [found.roll_pitch_yaw_deg[:, k] for found in errors] for k, name in enumerate(("roll", "pitch", "yaw"))},
    }
    moved = {
        "total": [found.position_total_m for found in errors],
        "horizontal": [found.horizontal_m for found in errors],
        "vertical": [found.vertical_m for found in errors],
    }
    times = [data.elapsed_s(found.t_ns) for found in errors]
    panels: tuple[Panel, ...] = (_panel(data, scored, times, turned, "Orientation error", "°"),)
    if _positions_known(data):
        panels += (_panel(data, scored, times, moved, "Position error", "m"),)
    return Picture("errors", "Errors over time", f"Integrated from the true start, {alignment_text(data)}.", panels)


def drift_curves(data: RunData) -> Picture | None:
    """Orientation and position drift since the last reset to the truth; None without a reset."""
    with_drift = [(trace, trace.drift) for trace in data.traces if trace.drift is not None]
    if all(len(_resets(drift)) < 2 for _, drift in with_drift):  # the first is the true start, as of the errors
        return None
    scored, drifts = [trace for trace, _ in with_drift], [drift for _, drift in with_drift]
    caption = f"Set to the truth every {drifts[0].reset_s:g} s."
    curves = [(data.elapsed_s(drift.t_ns), drift.orientation_deg, drift.position_m) for drift in drifts]
    if any(len(_resets(drift)) > MAX_RESETS for drift in drifts):
        curves = [_largest(drift, *rows) for drift, rows in zip(drifts, curves, strict=True)]
        caption += " Each stretch shows its largest drift."
    times, turned, moved = (list(rows) for rows in zip(*curves, strict=True))
    panels: tuple[Panel, ...] = (_panel(data, scored, times, {"total": turned}, "Orientation drift", "°"),)
    if _positions_known(data):
        panels += (_panel(data, scored, times, {"total": moved}, "Position drift", "m"),)
    return Picture("drift", "Drift since the last reset", caption, panels)


def _positions_known(data: RunData) -> bool:
    return data.truth is None or data.truth.has_positions


def _resets(drift: Drift) -> Int64[np.ndarray, " k"]:
    """Rows at which integration starts again."""
    return np.flatnonzero(np.diff(drift.since_s, prepend=np.inf) <= 0.0)


def _largest(drift: Drift, t: Line, turned: Line, moved: Line) -> tuple[DecimatedLine, DecimatedLine, DecimatedLine]:
    """Largest drift between two resets, at the first of them."""
    starts = _resets(drift)
    return t[starts], np.fmax.reduceat(turned, starts), np.fmax.reduceat(moved, starts)


def _panel(
    data: RunData, scored: Sequence[Trace], times: Sequence[Line], rows: dict[str, list[Line]], title: str, unit: str
) -> Panel:
    draw = partial(_draw, data=data, scored=scored, times=times, rows=rows, title=title, unit=unit)
    return Panel(draw, HEIGHTS_INCH[len(rows)], f"{title} of {', '.join(trace.name for trace in scored)} over time")


def _draw(
    figure: Any,
    *,
    data: RunData,
    scored: Sequence[Trace],
    times: Sequence[Line],
    rows: dict[str, list[Line]],
    title: str,
    unit: str,
) -> None:
    panels = np.atleast_1d(figure.subplots(len(rows), 1, sharex=True))
    lines: list[Any] = []
    scale, scaled = length_unit(min(_largest_of_each(next(iter(rows.values()))), default=0.0)) if unit == "m" else (1.0, unit)
    for axes, (name, in_unit) in zip(panels, rows.items(), strict=True):
        values = [error * scale for error in in_unit]
        signed = name not in {"total", "horizontal"}
        log = not signed and _needs_log_scale(values)
        beyond: list[str] = []
        for trace, t, error in zip(scored, times, values, strict=True):
            if signed and axes is not panels[0] and _leaves(error, values):
                beyond.append(f"{trace.name} up to {format_quantity(float(np.nanmax(np.abs(error))) / scale, unit)}")
                continue
            shown = np.where(error > 0.0, error, np.nan) if log else error  # the start is exact: log(0)
            label = f"{trace.name}: {title.lower()}, {name}" if axes is not panels[0] else trace.name
            style = style_of(data, trace)
            curve = decimate_angle(t, shown) if signed and unit == "°" else decimate_extremes(t, shown)
            line = axes.plot(*curve, lw=0.9 if trace.is_raw else 1.3, label=label, **style)
            lines += line if axes is panels[0] else []
        _limits(axes, values, signed=signed, log=log)
        name_off_scale(axes, beyond)
        axes.set_ylabel(f"{name} ({scaled})" if len(rows) > 1 else f"{title.lower()} ({scaled})")
    panels[0].set_title(title)
    panels[-1].set(xlabel="time (s)", xlim=(0.0, data.duration_s))
    figure.align_ylabels(panels)
    legend(figure, lines)


def name_off_scale(axes: Any, beyond: Sequence[str]) -> None:
    """Name above a panel what leaves it."""
    if beyond:
        words = f"off scale: {', '.join(beyond)}"
        axes.set_title(words, loc="right", fontsize="small", fontweight="normal", color=INK, pad=2.0)


def _limits(axes: Any, values: Sequence[Line], *, signed: bool, log: bool) -> None:
    """Axis limits that keep the best and the worst run readable."""
    tops = _largest_of_each(values)
    if log:
        axes.set_yscale("log")
        plain_tick_labels(axes.yaxis)
        axes.set_ylim(min(tops) * 10.0**-DECADES, max(tops) * 2.0)
    elif signed:
        axes.axhline(0.0, color=INK, lw=0.6)
        maximum = max((top for top in tops if top <= LINEAR_RATIO * min(tops)), default=0.0)
        axes.set_ylim(-1.15 * maximum, 1.15 * maximum) if maximum > 0.0 else None
        at_least_three_ticks(axes)
    else:
        axes.set_ylim(0.0, 1.1 * max(tops, default=1.0) or 1.0)
        at_least_three_ticks(axes)


def _largest_of_each(values: Sequence[Line]) -> list[float]:
    """Largest size of each curve that has a number."""
    return [float(np.nanmax(np.abs(errors))) for errors in values if np.isfinite(errors).any()]


def _needs_log_scale(values: Sequence[Line]) -> bool:
    """Whether the largest errors differ too much for one linear scale."""
    tops = _largest_of_each(values)
    return len(tops) > 1 and min(tops) > 0.0 and max(tops) > LINEAR_RATIO * min(tops)


def _leaves(error: Line, values: Sequence[Line]) -> bool:
    """Whether a signed error is too large for the panel of the others, where it would be a stray sliver."""
    tops = _largest_of_each(values)
    return bool(np.isfinite(error).any()) and float(np.nanmax(np.abs(error))) > LINEAR_RATIO * min(tops) > 0.0


MAX_ROWS = 40
MIN_EVENT_SHARE = 0.002  # of the duration; a shorter event is a mark, so that one sample in an hour is visible
MOMENT_POINTS = 0.5
LANE_INCH, EDGES_INCH = 0.24, 0.75
EVENT_COLORS = {"stop": HELD, "finding": AFTER, "worst": BEFORE}


def event_lanes(data: RunData) -> Picture | None:
    """Lane for each kind of event; None without events."""
    kinds = [kind for kind in KINDS if any(event.kind == kind for event in data.events)]
    if not kinds:
        return None
    height = EDGES_INCH + LANE_INCH * len(kinds)
    panel = Panel(
        partial(_draw_lanes, data=data, kinds=kinds),
        height,
        f"Events over time: {', '.join(map(event_label, kinds))}",
        wide=True,
    )
    return Picture("events", "Events", "Bars are to scale; low marks are events too short for that.", (panel,))


def event_table(data: RunData) -> Iterator[str]:
    """Table of the longest events of each kind by time, with the number of the others."""
    shown = sorted(_longest(data.events), key=lambda event: event.start_ns)
    yield '<div class="scroll"><table><thead><tr><th>From (s)</th><th>For</th><th>What</th><th></th></tr></thead><tbody>'
    for event in shown:
        start_s, seconds = (event.start_ns - data.start_ns) * 1e-9, (event.end_ns - event.start_ns) * 1e-9
        length = f"{format_number(seconds)} s" if seconds > 0.0 else "a moment"
        yield (
            f"<tr><td class=number>{start_s:.3f}</td><td class=number>{length}</td>"
            f"<td class=entry>{event_label(event.kind)}</td><td>{text(event.text)}</td></tr>"
        )
    yield "</tbody></table></div>"
    if len(shown) < len(data.events):
        yield f'<p class="note">The longest of each kind; {len(data.events) - len(shown):,} more are drawn above.</p>'


def event_label(kind: str) -> str:
    """Kind of event as text."""
    return {"worst": "worst error"}.get(kind, kind.replace("_", " "))


def _longest(events: Sequence[Event]) -> list[Event]:
    """Longest events of every kind, the same number of each; of equal length the first."""
    kinds = {event.kind for event in events}
    share = max(1, MAX_ROWS // max(len(kinds), 1))
    by_length = sorted(events, key=lambda event: event.start_ns - event.end_ns)
    return [event for kind in kinds for event in [other for other in by_length if other.kind == kind][:share]]


def _draw_lanes(figure: Any, *, data: RunData, kinds: Sequence[str]) -> None:
    axes = figure.subplots()
    min_s = MIN_EVENT_SHARE * data.duration_s
    for lane, kind in enumerate(kinds):
        spans = [data.elapsed_s(np.array([e.start_ns, e.end_ns])) for e in data.events if e.kind == kind]
        color, label = EVENT_COLORS.get(kind, MARK), f"{event_label(kind)}: {len(spans)}"
        bars = [(first, last - first) for first, last in spans if last - first >= min_s]
        axes.broken_barh(bars, (-lane - 0.4, 0.8), color=color, lw=0, label=label)
        # a thin low mark: wide ones, many in a row, would look like one long event
        moments = [first for first, last in spans if last - first < min_s]
        axes.vlines(moments, -lane - 0.4, -lane + 0.1, color=color, lw=MOMENT_POINTS, label=label)
    axes.set_yticks([-lane for lane in range(len(kinds))], [event_label(kind) for kind in kinds])
    axes.tick_params(axis="y", length=0)
    axes.set(xlim=(0.0, data.duration_s), ylim=(-len(kinds) + 0.4, 0.6), xlabel="time (s)")
    axes.grid(visible=False, axis="y")
