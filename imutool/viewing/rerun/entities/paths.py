"""Entities of paths, bodies, error vectors, worst moments and the colour scale of errors."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.recording import Poses, nanoseconds
from imutool.viewing.model.decimation import Rows, path_rows
from imutool.viewing.model.run_data import TRUTH, RunData, Trace, round_up_125, split_at_gaps
from imutool.viewing.model.trajectory_error import Errors, row_of_largest
from imutool.viewing.rerun import rr, sdk
from imutool.viewing.rerun.entities import styles
from imutool.viewing.rerun.entities.styles import INK, TRUTH_COLOR, WORST_COLOR, Color, color_of, heat_colors
from imutool.viewing.rerun.sdk import Scope

ROW_S = 1.0  # length of one row of a path: with a row per sample the viewer slows down
MAX_ROWS = 3_600  # of one path; a longer log has longer rows
Q_XYZW = [1, 2, 3, 0]  # columns of wxyz
LEGEND_STEPS, LEGEND_WIDTH, LEGEND_TICKS = 60, 100.0, 5
LEGEND_X, LEGEND_Y = (-50.0, 1.08 * LEGEND_WIDTH), (-3.0, 8.0)  # visible part of the drawing
LEGEND_TITLE = "debiased: orientation error"
ERROR_RADIUS = 0.8  # screen points
WORST_RADIUS, POLE_SHARE = 5.0, 0.2  # screen points; share of the scene, so that labels do not meet


@dataclass(frozen=True, eq=False)
class Pieces:
    """Straight pieces of a path between samples `first` and `last`, `counts` of them per row.

    A row has the stamp of its last sample: what the cursor shows has happened.
    """

    first: Int64[np.ndarray, " m"]
    last: Int64[np.ndarray, " m"]
    counts: Int64[np.ndarray, " k"]
    stamp_ns: Int64[np.ndarray, " k"]


def path_pieces(poses: Poses) -> Pieces:
    """Cut a path into straight pieces in rows of ROW_S, or in MAX_ROWS longer rows."""
    if len(poses) < 2:
        none = np.zeros(0, dtype=np.int64)
        return Pieces(none, none, none, none)
    lengths = [len(stretch) for stretch in split_at_gaps(poses)]
    of_stretch = np.repeat(np.arange(len(lengths)), lengths)
    ends = np.cumsum(lengths)
    rows = np.union1d(path_rows(poses.p_wb), np.concatenate([ends - lengths, ends - 1]))
    first, last = rows[:-1], rows[1:]
    unbroken = of_stretch[first] == of_stretch[last]
    first, last = first[unbroken], last[unbroken]
    since_ns = poses.t_ns[last] - poses.t_ns[0]
    row_ns = nanoseconds(max(ROW_S, (int(poses.t_ns[-1]) - int(poses.t_ns[0])) * 1e-9 / MAX_ROWS))
    starts = np.flatnonzero(np.diff((since_ns - 1) // row_ns, prepend=-1))  # of each row among the pieces
    counts = np.diff(np.append(starts, len(last)))
    return Pieces(first, last, counts, poses.t_ns[last[starts + counts - 1]])


def log_paths(data: RunData, to: rr.RecordingStream, scope: Scope, size: float) -> None:
    """Log world, paths and bodies of one log; `size` is the diagonal of the scene, m."""
    sdk.log_static(to, sdk.entity_path(scope, "world"), rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    if data.truth is not None and len(data.truth):
        _log_path(to, data, sdk.entity_path(scope, "world", "gt"), data.truth, None, "gt", TRUTH_COLOR)
        _log_body(
            to, data, sdk.entity_path(scope, "world", "gt"), data.truth, styles.body_style("gt", TRUTH, TRUTH_COLOR, size)
        )
    top = error_scale_top(data)
    for trace in data.traces:
        role = sdk.role(trace)
        entity, color = sdk.trace_path(data, trace, scope, "world", role), color_of(data, trace)
        error = None if trace.is_raw or top is None or trace.errors is None else trace.errors.orientation_total_deg
        _log_path(to, data, entity, trace.path, None if error is None or top is None else (error, top), role, color)
        _log_body(to, data, entity, trace.path, styles.body_style(role, sdk.label(data, trace), color, size))
        _log_worst(to, data, trace, entity, size)
        if not trace.is_raw and trace.errors is not None:
            _log_error_vectors(to, data, trace, trace.errors, sdk.trace_path(data, trace, scope, "world", "error_vec"))
    if top is not None:
        _log_legend(to, scope, top)


def error_scale_top(data: RunData) -> float | None:
    """Upper end of the path's colour scale, deg; None without truth or with several models.

    Of several models each path has a colour of its own; the plots show their errors.
    """
    if len(data.models()) != 1 or (errors := data.models()[0].errors) is None:
        return None
    known = errors.orientation_total_deg[np.isfinite(errors.orientation_total_deg)]
    return round_up_125(float(known.max())) if len(known) else None


def _log_path(
    to: rr.RecordingStream,
    data: RunData,
    entity: str,
    poses: Poses,
    by_error: tuple[Float64[np.ndarray, " n"], float] | None,
    role: str,
    color: Color,
) -> None:
    """Path in rows of pieces; `by_error` (errors, scale) colours each by its largest error."""
    cut = path_pieces(poses)
    if not len(cut.first):
        return
    strips = np.stack([poses.p_wb[cut.first], poses.p_wb[cut.last]], axis=1)
    colors = None
    if by_error is not None:
        error, top = by_error
        colors = heat_colors(_largest(error, cut), top)
    columns = rr.LineStrips3D.columns(strips=strips, colors=colors).partition(cut.counts)
    style = styles.path_style(role, None if colors is not None else color)
    sdk.log_columns(to, f"{entity}/path", style, sdk.data_times(data, cut.stamp_ns), columns)


def _largest(error: Float64[np.ndarray, " n"], cut: Pieces) -> Float64[np.ndarray, " m"]:
    """Largest error within each piece, NaN where none is known."""
    edges = np.stack([cut.first, cut.last + 1], axis=1).ravel()
    padded = np.append(error, np.nan)  # so that the last piece may end with the last sample
    largest: Float64[np.ndarray, " m"] = np.fmax.reduceat(padded, edges)[::2]
    return largest


def _log_body(to: rr.RecordingStream, data: RunData, entity: str, path: Poses, style: list[rr.AsComponents]) -> None:
    """Poses over time, and the style of the body."""
    rows = path_rows(path.p_wb)
    sdk.log_static(to, f"{entity}/body", *style)
    columns = rr.Transform3D.columns(translation=path.p_wb[rows], quaternion=path.q_wb_wxyz[rows][:, Q_XYZW])
    to.send_columns(f"{entity}/body", sdk.data_times(data, path.t_ns[rows]), columns, strict=True)


def error_rows(trace: Trace, errors: Errors) -> Rows:
    """Rows of a path at which its error vector is drawn."""
    rows = path_rows(trace.path.p_wb)
    known: Rows = rows[np.isfinite(errors.position_m[rows]).all(axis=1)]
    return known


def _log_error_vectors(to: rr.RecordingStream, data: RunData, trace: Trace, errors: Errors, entity: str) -> None:
    """Vectors from the true to the estimated position."""
    rows = error_rows(trace, errors)
    if not len(rows):
        return
    estimated = trace.path.p_wb[rows]
    strips = np.stack([estimated - errors.position_m[rows], estimated], axis=1)
    style = rr.LineStrips3D.from_fields(radii=rr.Radius.ui_points([ERROR_RADIUS]), colors=[WORST_COLOR])
    times = sdk.data_times(data, trace.path.t_ns[rows])
    sdk.log_columns(to, entity, style, times, rr.LineStrips3D.columns(strips=strips))


def _log_worst(to: rr.RecordingStream, data: RunData, trace: Trace, entity: str, size: float) -> None:
    """Pole on the true path (the model's may be far off) at a model's largest orientation error."""
    if trace.is_raw or trace.errors is None or data.truth is None:
        return
    errors = trace.errors
    row = row_of_largest(errors.orientation_total_deg)
    if row is None:
        return
    at_s = data.elapsed_s(errors.t_ns[row : row + 1])[0]
    rank = data.models().index(trace)
    prefix = f"{sdk.label(data, trace)} " if len(data.models()) > 1 else ""
    words = f"{prefix}worst: {errors.orientation_total_deg[row]:.2f}° at {at_s:.1f} s"
    foot = data.truth.p_wb[int(np.abs(data.truth.t_ns - errors.t_ns[row]).argmin())]
    top = foot + np.array([0.0, 0.0, POLE_SHARE * (1 + rank) * size])
    pole = rr.LineStrips3D([[foot, top]], colors=[WORST_COLOR], radii=rr.Radius.ui_points(1.0))
    radii = rr.Radius.ui_points([WORST_RADIUS, 0.0])
    dots = rr.Points3D([foot, top], labels=["", words], colors=[WORST_COLOR, INK], radii=radii, show_labels=True)
    sdk.log_static(to, f"{entity}/worst", pole, dots)


def _log_legend(to: rr.RecordingStream, scope: Scope, top: float) -> None:
    """Colour scale of a path, LEGEND_WIDTH wide; tick labels below, title on the left."""
    strips = [[[left, 0.0], [right, 0.0]] for left, right in pairwise(np.linspace(0.0, LEGEND_WIDTH, LEGEND_STEPS + 1))]
    shares = (np.arange(LEGEND_STEPS) + 0.5) / LEGEND_STEPS
    bar = rr.LineStrips2D(strips, colors=heat_colors(shares, 1.0), radii=rr.Radius.ui_points(6.0))
    sdk.log_static(to, sdk.entity_path(scope, "legend", "colors"), bar)
    ticks = np.linspace(0.0, 1.0, LEGEND_TICKS)
    words = [f"{share * top:g}°" for share in ticks] + [LEGEND_TITLE]
    places = [[share * LEGEND_WIDTH, 1.0] for share in ticks] + [[LEGEND_X[0] / 2.0, -2.5]]
    dots = rr.Points2D(places, labels=words, colors=[INK] * len(words), radii=rr.Radius.ui_points(0.0), show_labels=True)
    sdk.log_static(to, sdk.entity_path(scope, "legend", "ticks"), dots)
