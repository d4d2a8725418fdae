"""How far each run is from the truth: in total, by axis, by angle and by direction, since its last reset, at its worst."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from imutool.units import AXES
from imutool.viewing.model.run_data import RunData, Trace
from imutool.viewing.model.trajectory_error import Drift, Errors
from imutool.viewing.rerun.entities import names as entities
from imutool.viewing.rerun.entities import styles
from imutool.viewing.rerun.entities.names import Scope
from imutool.viewing.rerun.entities.palette import (
    BOLD_WIDTH,
    RAW_FADE,
    RAW_WIDTH,
    WORST_COLOR,
    Color,
    axis_colors,
    color_of,
    faded,
)
from imutool.viewing.rerun.entities.paths import worst
from imutool.viewing.rerun.entities.signals import rank, scalars

if TYPE_CHECKING:
    import rerun as rr

KINDS = ("orientation", "position")
UNITS = {"orientation": "deg", "position": "m"}
ANGLES = ("roll", "pitch", "yaw")
MARKER_SIZE = 6.0


def total(errors: Errors, kind: str) -> np.ndarray:
    """The size of the error of one kind, degrees or metres."""
    return errors.orientation_total_deg if kind == "orientation" else errors.position_total_m


def log(data: RunData, to: rr.RecordingStream, scope: Scope) -> None:
    """The errors of every run that has any."""
    for trace in data.traces:
        if trace.errors is not None:
            _log_errors(data, to, scope, trace, trace.errors)
        if trace.drift is not None:
            _log_drift(data, to, scope, trace, trace.drift)


def _log_errors(data: RunData, to: rr.RecordingStream, scope: Scope, trace: Trace, errors: Errors) -> None:
    role, name, color = entities.role(trace), entities.label(data, trace), color_of(data, trace)
    parts = {"orientation": errors.orientation_deg, "position": errors.position_m}
    for kind in KINDS:
        home = entities.of(data, trace, scope, "error", kind, role)
        whole = total(errors, kind)
        scalars(to, data, home, errors.t_ns, whole[:, None], styles.total(role, name, color))
        by_axis = _three(data, trace, AXES)
        scalars(to, data, f"{home}/axes", errors.t_ns, parts[kind], by_axis)
        if not trace.is_raw:
            _log_worst(data, to, home, errors, whole)
    home = entities.of(data, trace, scope, "error", "orientation", role)
    scalars(to, data, f"{home}/rpy", errors.t_ns, errors.roll_pitch_yaw_deg, _three(data, trace, ANGLES))
    home = entities.of(data, trace, scope, "error", "position", role)
    for direction, values, shade in (
        ("horizontal", errors.horizontal_m, color),
        ("vertical", errors.vertical_m, _other(color)),
    ):
        style = styles.total(role, f"{direction} {name}", shade)
        scalars(to, data, f"{home}/{direction}", errors.t_ns, values[:, None], style)


def _log_drift(data: RunData, to: rr.RecordingStream, scope: Scope, trace: Trace, drift: Drift) -> None:
    role, name = entities.role(trace), entities.label(data, trace)
    for kind, values in (("orientation", drift.orientation_deg), ("position", drift.position_m)):
        style = styles.total(role, name, color_of(data, trace))
        scalars(to, data, entities.of(data, trace, scope, "error", "drift", kind, role), drift.t_ns, values[:, None], style)


def _log_worst(data: RunData, to: rr.RecordingStream, home: str, errors: Errors, whole: np.ndarray) -> None:
    """One point in the plot of totals."""
    import rerun as rr

    row = worst(errors.t_ns, whole)
    if row is not None:
        style = rr.SeriesPoints(names=["worst"], colors=[WORST_COLOR], markers=["diamond"], marker_sizes=[MARKER_SIZE])
        scalars(to, data, f"{home}/worst", errors.t_ns[row : row + 1], whole[row : row + 1, None], style)


def _three(data: RunData, trace: Trace, names: tuple[str, ...]) -> rr.SeriesLines:
    """Curves about or along x, y and z: raw thin and faint, a model's bold."""
    label = entities.label(data, trace)
    faint = trace.is_raw and bool(data.models())
    colors = [faded(c, RAW_FADE) if faint else c for c in axis_colors(rank(data, trace))]
    return styles.curves([f"{name} {label}" for name in names], colors, RAW_WIDTH if faint else BOLD_WIDTH)


def _other(color: Color) -> Color:
    """A second shade of a run's colour."""
    return faded(color, RAW_FADE)
