"""Entities of errors (total, by axis, drift, worst moment) and of events (states and texts)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import zip_longest

import numpy as np

from imutool.viewing.model import events
from imutool.viewing.model.run_data import RunData, Trace
from imutool.viewing.model.trajectory_error import Drift, Errors, row_of_largest
from imutool.viewing.rerun import rr, sdk
from imutool.viewing.rerun.entities import styles
from imutool.viewing.rerun.entities.signals import log_axes, log_curves
from imutool.viewing.rerun.entities.styles import EVENT_COLOR, GREY, MODEL_COLORS, RAW_FADE, WORST_COLOR, Color, color_of
from imutool.viewing.rerun.sdk import Scope

KINDS = ("orientation", "position")
UNITS = {"orientation": "deg", "position": "m"}
ANGLES = ("roll", "pitch", "yaw")
MARKER_SIZE = 6.0
MIN_EVENT_SHARE = 0.003  # of the log: width of a moment in its lane, where it would else be invisible; its text is exact
EVENT_COLORS: dict[str, Color] = {"stop": GREY, "worst": WORST_COLOR, "finding": MODEL_COLORS[0]}  # the others are faults


def total_error(errors: Errors, kind: str) -> np.ndarray:
    """Total error of one kind, deg or m."""
    return errors.orientation_total_deg if kind == "orientation" else errors.position_total_m


def log_errors(data: RunData, to: rr.RecordingStream, scope: Scope) -> None:
    """Log the errors of every run: `error/{orientation,position}/…` and `error/drift/…`."""
    for trace in data.traces:
        if trace.errors is not None:
            _log_errors(data, to, scope, trace, trace.errors)
        if trace.drift is not None:
            _log_drift(data, to, scope, trace, trace.drift)


def _log_errors(data: RunData, to: rr.RecordingStream, scope: Scope, trace: Trace, errors: Errors) -> None:
    role, name, color = sdk.role(trace), sdk.label(data, trace), color_of(data, trace)
    orientation, position = (sdk.trace_path(data, trace, scope, "error", kind, role) for kind in KINDS)
    for kind, entity, by_axis in zip(KINDS, (orientation, position), (errors.orientation_deg, errors.position_m), strict=True):
        total = total_error(errors, kind)
        log_curves(to, data, entity, errors.t_ns, total[:, None], styles.total_error_curve(role, name, color))
        log_axes(to, data, trace, f"{entity}/axes", errors.t_ns, by_axis)
        if not trace.is_raw:
            _log_worst(data, to, entity, errors, total)
    log_axes(to, data, trace, f"{orientation}/rpy", errors.t_ns, errors.roll_pitch_yaw_deg, ANGLES)
    shades = {"horizontal": color, "vertical": styles.blend_to_grey(color, RAW_FADE)}
    for (direction, shade), values in zip(shades.items(), (errors.horizontal_m, errors.vertical_m), strict=True):
        style = styles.total_error_curve(role, f"{direction} {name}", shade)
        log_curves(to, data, f"{position}/{direction}", errors.t_ns, values[:, None], style)


def _log_drift(data: RunData, to: rr.RecordingStream, scope: Scope, trace: Trace, drift: Drift) -> None:
    role = sdk.role(trace)
    style = styles.total_error_curve(role, sdk.label(data, trace), color_of(data, trace))
    for kind, values in zip(KINDS, (drift.orientation_deg, drift.position_m), strict=True):
        log_curves(
            to, data, sdk.trace_path(data, trace, scope, "error", "drift", kind, role), drift.t_ns, values[:, None], style
        )


def _log_worst(data: RunData, to: rr.RecordingStream, entity: str, errors: Errors, total: np.ndarray) -> None:
    """One point at the largest total error."""
    row = row_of_largest(total)
    if row is not None:
        style = rr.SeriesPoints(names=["worst"], colors=[WORST_COLOR], markers=["diamond"], marker_sizes=[MARKER_SIZE])
        log_curves(to, data, f"{entity}/worst", errors.t_ns[row : row + 1], total[row : row + 1, None], style)


def event_kinds(data: RunData) -> list[str]:
    """Kinds of event in the log, in the order of `events.KINDS`."""
    present = {event.kind for event in data.events}
    return [kind for kind in events.KINDS if kind in present]


def log_events(data: RunData, to: rr.RecordingStream, scope: Scope) -> None:
    """Log `events/KIND`: states for the lane, and a text at the start of each event."""
    for kind in event_kinds(data):
        of_kind = sorted((event for event in data.events if event.kind == kind), key=lambda event: event.start_ns)
        entity = sdk.entity_path(scope, "events", kind)
        style = styles.state_style(kind.replace("_", " "), EVENT_COLORS.get(kind, EVENT_COLOR))
        times, states = styles.state_changes(_visible_intervals(of_kind, data), data.start_ns)
        at = sdk.data_times(data, np.array(times, dtype=np.int64))
        sdk.log_columns(to, entity, style, at, rr.StateChange.columns(state=states))
        level = "INFO" if kind == "stop" else "WARN"
        texts = rr.TextLog.columns(text=[event.text for event in of_kind], level=[level] * len(of_kind))
        stamps = np.array([event.start_ns for event in of_kind], dtype=np.int64)
        to.send_columns(entity, sdk.data_times(data, stamps), texts, strict=True)


def _visible_intervals(of_kind: Sequence[events.Event], data: RunData) -> list[tuple[int, int]]:
    """Intervals of sorted events, widened to a visible width; backwards where the log ends before.

    A widened interval ends half-way to the next event: many moments in a row are not one long event.
    """
    min_ns = round(MIN_EVENT_SHARE * (data.end_ns - data.start_ns))
    intervals = []
    for event, following in zip_longest(of_kind, of_kind[1:]):
        start_ns, end_ns = event.start_ns, event.end_ns
        if end_ns - start_ns < min_ns:
            start_ns = min(start_ns, data.end_ns - min_ns)
            half_way = data.end_ns if following is None else (event.end_ns + following.start_ns) // 2
            end_ns = max(event.end_ns, min(start_ns + min_ns, half_way))
        intervals.append((start_ns, end_ns))
    return intervals
