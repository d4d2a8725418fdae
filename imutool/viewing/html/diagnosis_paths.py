"""Integrated paths of a diagnosis: unseen stretches from a true start, before and after.

The samples of a stretch are those of a perfect sensor plus the residual before or after the findings are modelled
(a constant bias is taken off either way). Their integral is `strapdown.dead_reckon`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from imutool.array_types import Float64
from imutool.diagnosis.result import Diagnosis, Traces
from imutool.inertial.strapdown import StartPose, dead_reckon
from imutool.recording import Imu, Poses
from imutool.viewing.html.diagnosis_figures import GAP_PERIODS, held_out_mask, rate_hz
from imutool.viewing.html.drawing import svg
from imutool.viewing.html.page import AFTER, BEFORE, INK

MIN_S, MAX_S = 2.0, 10.0  # of a stretch; a longer one is cut
GRID_S = 0.05  # of the drift's clock


class Stretch(NamedTuple):
    """True poses of one unseen stretch, and its integrated poses before and after the findings."""

    truth: Poses
    before: Poses
    after: Poses


def held_out_stretches(trace: Traces) -> Iterator[Stretch]:
    """Unseen stretches without gaps, at most ten seconds long; none without known positions."""
    if trace.truth is None or trace.ideal is None or not trace.truth.has_positions:
        return
    rows = np.flatnonzero(held_out_mask(trace) & np.isfinite(trace.ideal).all(axis=1))
    for piece in np.split(rows, np.flatnonzero(np.diff(trace.t_s[rows]) > GAP_PERIODS / rate_hz(trace)) + 1):
        count = max(1, int(np.ceil(len(piece) / (MAX_S * rate_hz(trace)))))
        for part in np.array_split(piece, count):
            if len(part) >= MIN_S * rate_hz(trace):
                yield _stretch(trace, slice(int(part[0]), int(part[-1]) + 1))


def paths(d: Diagnosis) -> str | None:
    """Unseen stretches of the first log from above, and drift from a true start over all logs.

    None where no stretch has poses, or nothing was found.
    """
    drawn = [list(held_out_stretches(trace)) for trace in d.traces]
    everything = [stretch for log in drawn for stretch in log]
    if not everything or not d.findings:
        return None

    def draw(figure: Any) -> None:
        above, turned, moved = figure.subplots(1, 3, width_ratios=[1.2, 1.0, 1.0])
        for stretch in drawn[0] or everything[:1]:
            for poses, color, width in ((stretch.truth, INK, 2.0), (stretch.before, BEFORE, 1.0), (stretch.after, AFTER, 1.0)):
                above.plot(*poses.p_wb[:, :2].T, color=color, lw=width, alpha=0.4 if color == INK else 1.0)
            above.plot(*stretch.truth.p_wb[0, :2], "o", color=INK, ms=2.5)
        above.set(xlabel="x (m)", ylabel="y (m)", title="Seen from above")
        above.set_aspect("equal", adjustable="datalim")
        for axes, name, column in ((turned, "orientation error (°)", 0), (moved, "position error (m)", 1)):
            for side, color in ((1, BEFORE), (2, AFTER)):
                t_s, rms = rms_drift(everything, side)
                axes.plot(t_s, rms[:, column], color=color, lw=1.3)
            axes.set(xlabel="time since the true start (s)", title=name.capitalize(), xlim=(0.0, None), ylim=(0.0, None))

    return svg(draw, 3.0, "paths")


def rms_drift(stretches: Sequence[Stretch], side: int) -> tuple[Float64[np.ndarray, " k"], Float64[np.ndarray, "k 2"]]:
    """Root mean square orientation (deg) and position error (m) by time since the start.

    `side` is 1 for before, 2 for after. As far as half of the stretches reach.
    """
    t_s = np.arange(0.0, float(np.median([stretch.truth.duration_s for stretch in stretches])) + 1e-9, GRID_S)
    squares = np.full((len(stretches), len(t_s), 2), np.nan)
    for k, stretch in enumerate(stretches):
        own_s = (stretch.truth.t_ns - stretch.truth.t_ns[0]) * 1e-9
        reach = t_s <= own_s[-1]
        for column, error in enumerate(_errors(stretch.truth, stretch[side])):
            squares[k, reach, column] = np.interp(t_s[reach], own_s, error) ** 2
    return t_s, np.sqrt(np.nanmean(squares, axis=0))


def _stretch(trace: Traces, rows: slice) -> Stretch:
    assert trace.truth is not None, "checked by the caller"
    assert trace.ideal is not None, "checked by the caller"
    truth: Poses = trace.truth.rows(rows)
    sides = []
    for expected in (trace.before, trace.after):
        read = trace.ideal[rows] + trace.real[rows] - expected[rows]
        imu = Imu(truth.t_ns, np.ascontiguousarray(read[:, :3]), np.ascontiguousarray(read[:, 3:]))
        sides.append(dead_reckon(imu, StartPose.of(truth)))
    return Stretch(truth, *sides)


def _errors(truth: Poses, path: Poses) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    turn, true = (Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True) for poses in (path, truth))
    angle: Float64[np.ndarray, " n"] = np.degrees((true.inv() * turn).magnitude())
    distance: Float64[np.ndarray, " n"] = np.linalg.norm(path.p_wb - truth.p_wb, axis=1)
    return angle, distance
