"""What is logged to Rerun of a log: entities and their columns, on timelines `elapsed` and `ros2_timestamp`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64, Int64

from imutool.recording import Poses, Times
from imutool.view.rerun.layout import size_m
from imutool.view.rerun.palette import (
    AXES,
    BOLD_WIDTH,
    RAW_FADE,
    RAW_WIDTH,
    TRUE_FADE,
    TRUTH_COLOR,
    XYZ,
    Color,
    axis_colors,
    color_of,
    faded,
)
from imutool.view.rerun.sdk import entity_path, need_sdk
from imutool.view.rundata import TRUTH, RunData, Trace, sparse, stretches

if TYPE_CHECKING:
    import rerun as rr

PATH_RADIUS = 1.0
MOST_IN_3D = 20_000  # poses of one path; plots are never thinned
Q_XYZW = [1, 2, 3, 0]  # columns of wxyz


def log(logs: Sequence[RunData], to: rr.RecordingStream, *, source: bool = True) -> None:
    """Everything of each log."""
    for data in logs:
        _log_one(data, to)


def _log_one(data: RunData, to: rr.RecordingStream) -> None:
    """Everything there is to see, into a Rerun recording: whole columns on timelines `elapsed` and `ros2_timestamp`.

    Entities: `/world/{truth,RUN}/{path,body}`, `/imu/{gyro,accel}/RUN`, `/bias/{gyro,accel}/{true,MODEL}`,
    `/error/{orientation,position}/RUN/{total,axes}` (degrees and metres) and `/report`.

    Raises:
        ConfigError: Rerun is not installed.
    """
    need_sdk()
    import rerun as rr

    to.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True, strict=True)
    to.log("report", rr.TextDocument(_report(data), media_type="text/markdown"), static=True, strict=True)
    size = size_m(data)
    if data.truth is not None:
        _log_path(to, data, TRUTH, data.truth, TRUTH_COLOR, size)
    for trace in data.traces:
        _log_path(to, data, trace.name, trace.path, color_of(data, trace), size)
        _log_signals(to, data, trace)
        if trace.errors is not None:
            _log_errors(to, data, trace)
    for kind, bias in data.true_bias.items():
        style = rr.SeriesLines(
            names=[f"{axis} true" for axis in AXES],
            colors=[faded(c, TRUE_FADE) for c in XYZ],
            widths=[2 * BOLD_WIDTH] * 3,
        )
        _log_scalars(to, f"bias/{kind}/true", data, bias.t_ns, bias.values, style)


def _log_path(to: rr.RecordingStream, data: RunData, name: str, path: Poses, color: Color, size: float) -> None:
    """The whole path as lines, and the body that moves along it with the cursor."""
    import rerun as rr

    strips = [piece.p_wb[sparse(len(piece), MOST_IN_3D)] for piece in stretches(path)]
    lines = rr.LineStrips3D(strips, colors=[color] * len(strips), radii=rr.Radius.ui_points(PATH_RADIUS))
    to.log(entity_path("world", name, "path"), lines, static=True, strict=True)
    poses = path.rows(_mask(len(path), sparse(len(path), MOST_IN_3D)))
    columns = rr.Transform3D.columns(translation=poses.p_wb, quaternion=poses.q_wb_wxyz[:, Q_XYZW])
    body = entity_path("world", name, "body")
    to.send_columns(body, _time(data, poses.t_ns), columns, strict=True)
    to.log(body, rr.TransformAxes3D(axis_length=0.12 * size), static=True, strict=True)
    to.log(body, rr.Points3D([[0, 0, 0]], colors=[color], radii=rr.Radius.ui_points(4), labels=[name]), static=True)


def _log_signals(to: rr.RecordingStream, data: RunData, trace: Trace) -> None:
    """What the run reads, raw thin and faint, a model's bold; and what a model subtracted."""
    import rerun as rr

    run = trace.run
    bold = rr.SeriesLines(
        names=[f"{axis} {trace.name}" for axis in AXES], colors=axis_colors(data, trace), widths=[BOLD_WIDTH] * 3
    )
    thin = rr.SeriesLines(
        names=[f"{axis} raw" for axis in AXES], colors=[faded(c, RAW_FADE) for c in XYZ], widths=[RAW_WIDTH] * 3
    )
    style = thin if trace.is_raw and data.models() else bold
    for kind, values in (("gyro", run.imu.gyro), ("accel", run.imu.accel)):
        _log_scalars(to, entity_path("imu", kind, trace.name), data, run.imu.t_ns, values, style)
    if not trace.is_raw:
        for kind, values in (("gyro", run.gyro_bias), ("accel", run.accel_bias)):
            _log_scalars(to, entity_path("bias", kind, trace.name), data, run.imu.t_ns, values, bold)


def _log_errors(to: rr.RecordingStream, data: RunData, trace: Trace) -> None:
    """Orientation and position error of a run, per axis and in total."""
    import rerun as rr

    errors = trace.errors
    assert errors is not None, "asked only where there is truth"
    width = RAW_WIDTH if trace.is_raw else BOLD_WIDTH
    total = rr.SeriesLines(names=[trace.name], colors=[color_of(data, trace)], widths=[width])
    axes = rr.SeriesLines(names=[f"{a} {trace.name}" for a in AXES], colors=axis_colors(data, trace), widths=[width] * 3)
    for kind, whole, parts in (
        ("orientation", errors.orientation_total_deg, errors.orientation_deg),
        ("position", errors.position_total_m, errors.position_m),
    ):
        _log_scalars(to, entity_path("error", kind, trace.name, "total"), data, errors.t_ns, whole[:, None], total)
        _log_scalars(to, entity_path("error", kind, trace.name, "axes"), data, errors.t_ns, parts, axes)


def _log_scalars(
    to: rr.RecordingStream,
    entity: str,
    data: RunData,
    t_ns: Times,
    values: Float64[np.ndarray, "n k"],
    style: rr.SeriesLines,
) -> None:
    """One curve per column; the style goes first, so that no curve is ever drawn in a colour of the viewer's choice."""
    import rerun as rr

    to.log(entity, style, static=True, strict=True)
    # strict: Rerun only warns of a length that does not match, and then the rows are missing.
    to.send_columns(entity, _time(data, t_ns), rr.Scalars.columns(scalars=values), strict=True)


def _time(data: RunData, t_ns: Times) -> list[rr.TimeColumn]:
    """Both clocks, exact to the nanosecond; `ros2_timestamp` is what Rerun's own MCAP reader calls header stamps."""
    import rerun as rr

    return [
        rr.TimeColumn("elapsed", duration=(t_ns - data.start_ns).astype("timedelta64[ns]")),
        rr.TimeColumn("ros2_timestamp", timestamp=t_ns.astype("datetime64[ns]")),
    ]


def _report(data: RunData) -> str:
    """The notes and the table of figures as Markdown."""
    lines = [f"# {data.name}", "", f"{data.duration_s:.1f} s.", "", *data.notes, ""]
    table = data.table()
    if table:
        names = [trace.name for trace in data.traces]
        lines += ["| figure | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
        for label, values in table:
            lines.append(f"| {label} | " + " | ".join("" if v is None else _number(v) for v in values) + " |")
    return "\n".join(lines)


def _number(value: float) -> str:
    """Four digits are enough to compare; no exponent for what has more."""
    return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.4g}"


def _mask(count: int, rows: Int64[np.ndarray, " m"]) -> np.ndarray:
    mask = np.zeros(count, dtype=bool)
    mask[rows] = True
    return mask
