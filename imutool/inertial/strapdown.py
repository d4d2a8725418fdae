"""Strapdown integration at the IMU's stamps, and velocity from true poses; numpy, no torch.

The rule is the paper's Euler step, each sample constant until the next::

    R_{k+1} = R_k Exp(gyro_k dt_k)
    v_{k+1} = v_k + (R_k accel_k + g_w) dt_k          dt_k = t_{k+1} - t_k
    p_{k+1} = p_k + v_k dt_k

so the last sample is not used, and row k of the trajectory depends on samples before k only.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from imutool.array_types import Bool, Float64, Int64, Vectors
from imutool.errors import DataError, NumericsError
from imutool.geometry import quaternion
from imutool.recording import GAP_FACTOR, GRAVITY_M_S2, MIN_GAP_S, Imu, Poses, Times, seconds
from imutool.recording.columns import median

GRAVITY_W = (0.0, 0.0, -GRAVITY_M_S2)
VELOCITY_WINDOW_S = 0.2
VELOCITY_ORDER = 3
COMPARED_S, MIN_SPEED_M_S, MAX_OFF = 1.0, 0.05, 0.5  # of velocities and positions: over a second, in motion, by the median
WINDOWS_AT_ONCE = 1 << 12  # whose arrays fit a core's cache
SAMPLES_PER_COEFFICIENT = 3  # a stretch shorter than the window gets a lower order, against noise

Indices = Int64[np.ndarray, " m"]
Column = Float64[np.ndarray, "m 1"]


class StartPose(NamedTuple):
    """Start of an integration: orientation (body to world), position (m), world velocity (m/s)."""

    q_wb_wxyz: Float64[np.ndarray, "4"]
    p_wb: Float64[np.ndarray, "3"]
    v_w: Float64[np.ndarray, "3"]

    @classmethod
    def of(cls, poses: Poses, row: int = 0) -> StartPose:
        """Start pose at one row of a trajectory.

        Raises:
            DataError: the trajectory has no velocity (`truth_velocity` derives one), or no such row.
        """
        if not -len(poses) <= row < len(poses):
            raise DataError(f"no row {row} among {len(poses)} poses", expected="a pose to start from")
        if poses.v_w is None:
            raise DataError("the poses carry no velocity", expected="v_w", fix="Derive it with strapdown.truth_velocity")
        return cls(poses.q_wb_wxyz[row], poses.p_wb[row], poses.v_w[row])


def dead_reckon(
    imu: Imu,
    start: tuple[Float64[np.ndarray, "4"], Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]],
    g_w: tuple[float, float, float] = GRAVITY_W,
) -> Poses:
    """Dead-reckoned trajectory at the IMU's stamps, from `start` (a `StartPose`) at the first.

    Rotations are a prefix product of quaternions in log depth, velocity and position cumulative sums; the rounding
    grows with the logarithm of the length. 30 000 samples take about 10 ms.

    Raises:
        DataError: no samples.
        NumericsError: the numbers overflow.
    """
    if not len(imu):
        raise DataError("the IMU has no samples", expected="at least one")
    q_0_wxyz, p_0, v_0 = (np.asarray(part, dtype=np.float64) for part in start)
    dt = np.diff(seconds(imu.t_ns, int(imu.t_ns[0])))[:, None]
    with np.errstate(over="ignore", invalid="ignore"):  # overflow is reported below with its row
        first_wxyz = quaternion.unit(q_0_wxyz[None])
        q_wb_wxyz = quaternion.running_product(np.concatenate([first_wxyz, quaternion.exp(imu.gyro[:-1] * dt)]))
        q_wb_wxyz /= quaternion.length(q_wb_wxyz)[:, None]  # in place, as below: few arrays as long as the log at once
        v_w = np.concatenate([v_0[None], quaternion.rotate(q_wb_wxyz[:-1], imu.accel[:-1])])
        np.multiply(np.add(v_w[1:], g_w, out=v_w[1:]), dt, out=v_w[1:])
        np.cumsum(v_w, axis=0, out=v_w)
        p_wb = np.cumsum(np.concatenate([p_0[None], v_w[:-1] * dt]), axis=0)
    if not all(np.isfinite(column).all() for column in (q_wb_wxyz, v_w, p_wb)):
        row = int(np.argmin(np.isfinite(np.concatenate([q_wb_wxyz, v_w, p_wb], axis=1)).all(axis=1)))
        raise NumericsError(
            f"integration overflows at {imu.t_ns[row]} ns",
            expected="rates and forces of a moving body",
            fix="Check gyro and accel just before that sample",
        )
    for column in (p_wb, q_wb_wxyz, v_w):  # so that the poses need no copy
        column.flags.writeable = False
    return Poses(imu.t_ns, p_wb, q_wb_wxyz, v_w)


def gaps_crossed(t_ns: Times, longer_s: float, start_ns: int) -> str:
    """Gaps of the IMU that an integration crosses, in words; times count from `start_ns`."""
    t = seconds(t_ns, start_ns)
    gaps = np.flatnonzero(np.diff(t) > longer_s)
    if not len(gaps):
        return ""
    found = f"gaps of the IMU: {len(gaps)}, {np.diff(t)[gaps].sum():.1f} s in all, the first at {t[gaps[0]]:.3f} s"
    return f"{found}; the integration keeps the last sample over a gap, and the scores include this"


def along_truth(imu: Imu, truth: Poses, where: str) -> tuple[Poses, Poses, Bool[np.ndarray, " n"]]:
    """Dead-reckoned trajectory, the truth on the same stamps, and the mask of valid rows.

    The stretch is from the first sample with truth to the last. The start is the truth there; its velocity is derived if it has
    none.

    Raises:
        DataError: fewer than two samples with truth.
        NumericsError: the numbers overflow.
    """
    rows, true, valid = stretch_with_truth(imu.t_ns, truth, where)
    return dead_reckon(imu.rows(rows), StartPose.of(true)), true, valid


def stretch_with_truth(t_ns: Times, truth: Poses, where: str) -> tuple[slice, Poses, Bool[np.ndarray, " m"]]:
    """Rows with truth, the truth with velocity there, and the mask of valid rows.

    The rows go from the first stamp with truth to the last.

    Raises:
        DataError: fewer than two stamps with truth.
    """
    true, valid = with_velocity(truth).at(t_ns)
    known = np.flatnonzero(valid)
    if len(known) < 2:
        raise DataError("IMU and true poses share fewer than two samples", where=where, expected="an overlap")
    rows = slice(int(known[0]), int(known[-1]) + 1)
    return rows, true.rows(rows), valid[rows]


class Drift(NamedTuple):
    """Drift of integrations from the truth: orientation (rad), velocity (m/s), position (m)."""

    orientation_rad: Float64[np.ndarray, " m"]
    velocity_m_s: Float64[np.ndarray, " m"]
    position_m: Float64[np.ndarray, " m"]


def window_drift(path: Poses, truth: Poses, first: Indices, last: Indices | slice) -> Drift:
    """Drift at rows `last` of integrations from the truth at rows `first`.

    `path` is the integration of the same samples from any start, on the stamps of `truth`. An integration from the truth at row
    s equals `path` rotated by C = R_true,s R_s^T from there on, so nothing is integrated again::

        R'_k = C R_k
        v'_k = v_true,s + C (v_k - v_s - g_w T) + g_w T                             T = t_k - t_s
        p'_k = p_true,s + v_true,s T + C (p_k - p_s - v_s T - g_w S) + g_w S        S = (T^2 - sum dt^2) / 2

    S is the double sum of dt by the Euler rule: the result equals `dead_reckon` over each window, to rounding.

    Raises:
        DataError: one of the two carries no velocity, or they are on different stamps.
    """
    if path.v_w is None or truth.v_w is None or not np.array_equal(path.t_ns, truth.t_ns):
        raise DataError("path and truth do not match", expected="poses with velocity on the same stamps")
    t = seconds(path.t_ns, int(path.t_ns[0]))
    squares = np.concatenate([[0.0], np.cumsum(np.diff(t) ** 2)])
    ends = np.arange(len(t))[last]
    T = t[ends] - t[first]
    S = 0.5 * (T**2 - (squares[ends] - squares[first]))
    out = np.empty((3, len(first)))
    for start in range(0, len(first), WINDOWS_AT_ONCE):
        part = slice(start, start + WINDOWS_AT_ONCE)
        out[:, part] = _drift_of(path, truth, first[part], ends[part], T[part, None], S[part, None])
    return Drift(*out)


def _drift_of(path: Poses, truth: Poses, first: Indices, last: Indices, T: Column, S: Column) -> Drift:
    """Drift of some windows, as `window_drift`."""
    g_T, g_S = np.array(GRAVITY_W) * T, np.array(GRAVITY_W) * S
    q_wxyz, q_true_wxyz = path.q_wb_wxyz, truth.q_wb_wxyz
    (p, v), (p_true, v_true) = ((poses.p_wb, np.asarray(poses.v_w)) for poses in (path, truth))
    q_c_wxyz = quaternion.multiply(q_true_wxyz[first], quaternion.inverse(q_wxyz[first]))
    faster = v_true[first] - v_true[last] + g_T + quaternion.rotate(q_c_wxyz, v[last] - v[first] - g_T)
    further = p_true[first] - p_true[last] + v_true[first] * T + g_S
    further += quaternion.rotate(q_c_wxyz, p[last] - p[first] - v[first] * T - g_S)
    turned = quaternion.angle_between(quaternion.multiply(q_c_wxyz, q_wxyz[last]), q_true_wxyz[last])
    return Drift(turned, quaternion.length(faster), quaternion.length(further))


def drift(path: Poses, truth: Poses, valid: Bool[np.ndarray, " n"], window_s: float) -> Drift:
    """Drift at the end of windows that start from the truth, of what `along_truth` gives.

    Raises:
        DataError: as `window_drift`.
    """
    return window_drift(path, truth, *drift_windows(path.t_ns, valid, window_s).T)


def drift_windows(t_ns: Times, valid: Bool[np.ndarray, " n"], window_s: float) -> Int64[np.ndarray, "m 2"]:
    """First and last rows of consecutive windows, with truth at both ends and no gap within."""
    t = seconds(t_ns, int(t_ns[0]))
    dt = np.diff(t)
    gaps = np.flatnonzero(dt > GAP_FACTOR * (median(dt) if len(dt) else 0.0))
    known = np.flatnonzero(valid)
    pairs = []
    first = 0
    while (next_known := np.searchsorted(known, first)) < len(known):
        first = int(known[next_known])
        last = int(np.searchsorted(t, t[first] + window_s))
        if last >= len(t):
            break
        if valid[last] and np.searchsorted(gaps, first) == np.searchsorted(gaps, last):
            pairs.append((first, last))
        first = last
    return np.array(pairs, np.int64).reshape(-1, 2)


def with_velocity(poses: Poses) -> Poses:
    """Trajectory with velocity: its own if it follows the positions, else `truth_velocity`."""
    return poses if poses.v_w is not None and velocity_follows(poses) else replace(poses, v_w=truth_velocity(poses))


def velocity_follows(poses: Poses) -> bool:
    """Whether the velocities of poses are those of their positions: of the world's axes, in m/s.

    By the median over a second; also true without velocities, or where the positions hardly move.
    """
    if poses.v_w is None or len(poses) < 2:
        return True
    t = seconds(poses.t_ns, int(poses.t_ns[0]))
    last = np.searchsorted(t, t + COMPARED_S)
    speed, off = np.empty((2, np.searchsorted(last, len(t))))
    for start in range(0, len(speed), WINDOWS_AT_ONCE):
        ends = last[start : min(start + WINDOWS_AT_ONCE, len(speed))] - start
        n, rows = len(ends), slice(start, start + int(ends[-1]) + 1)
        p, v, dt = poses.p_wb[rows], poses.v_w[rows], np.diff(t[rows])[:, None]
        path = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (v[1:] + v[:-1]) * dt, axis=0)])
        moved, stated = ((x[ends] - x[:n]) / (t[rows][ends] - t[rows][:n])[:, None] for x in (p, path))
        speed[start : start + n], off[start : start + n] = quaternion.length(moved), quaternion.length(moved - stated)
    return not len(speed) or bool(median(speed) < MIN_SPEED_M_S or median(off) < MAX_OFF * median(speed))


def truth_velocity(poses: Poses) -> Vectors:
    """World velocity (m/s) at every pose: Savitzky-Golay derivative of the positions.

    Around each pose, a polynomial of degree `VELOCITY_ORDER` in time is fitted to the poses of `VELOCITY_WINDOW_S` (an odd
    number m, by the median period, over the degree) by least squares on the true stamps; the velocity is its slope. On an even
    clock this is `scipy.signal.savgol_filter(p, m, 3, deriv=1, delta=period, mode="interp")`; jitter does no harm. Windows
    never cross a gap, as in `Poses.at`: four median periods, at least 80 ms. Near the ends of a stretch they stay inside, with
    the slope off their centre. A stretch shorter than the window lowers the order to keep three poses per coefficient, at
    least 1; a single pose between two gaps gets the slope between its neighbours.

    0.2 s and order 3 agree best with the accelerometer over a quarter second on TUM-VI (median 10 mm/s on room2 against
    15 for 0.1 s and order 5) and FETCH; on EuRoC, which has its own velocity, they are within 6-8 mm/s of that.

    Raises:
        DataError: fewer than two poses.
    """
    period_s = poses.period_s
    t = seconds(poses.t_ns, int(poses.t_ns[0]))
    window = max(2 * round(VELOCITY_WINDOW_S / period_s / 2) + 1, VELOCITY_ORDER + 1 + VELOCITY_ORDER % 2)
    breaks = np.flatnonzero(np.diff(t) > max(GAP_FACTOR * period_s, MIN_GAP_S)) + 1
    v_w = np.empty_like(poses.p_wb)
    for rows in np.split(np.arange(len(t)), breaks):
        first, after = int(rows[0]), int(rows[-1]) + 1
        if len(rows) == 1:
            around = slice(max(first - 1, 0), min(first + 2, len(t)))
            v_w[rows] = (poses.p_wb[around][-1] - poses.p_wb[around][0]) / (t[around][-1] - t[around][0])
        else:
            v_w[first:after] = _slopes(t[first:after], poses.p_wb[first:after], window, VELOCITY_ORDER)
    return v_w


def _slopes(t: Float64[np.ndarray, " n"], p: Vectors, window: int, order: int) -> Vectors:
    """Slopes of moving least-squares polynomials over one stretch without gaps."""
    n = len(t)
    if n < window:
        window, order = n, min(order, max(1, n // SAMPLES_PER_COEFFICIENT - 1))
    first = np.clip(np.arange(n) - window // 2, 0, n - window)
    out = np.empty_like(p)
    for start in range(0, n, WINDOWS_AT_ONCE):
        part = slice(start, start + WINDOWS_AT_ONCE)
        rows = first[part, None] + np.arange(window)
        out[part] = np.einsum("nm,nmk->nk", _slope_weights(t[rows], t[part], order), p[rows])
    return out


def _slope_weights(t: Float64[np.ndarray, "n m"], at: Float64[np.ndarray, " n"], order: int) -> Float64[np.ndarray, "n m"]:
    """Weights of the values of each window in the slope of its polynomial at a time.

    By the orthogonal polynomials of each window, P_k+1 = (u - a_k) P_k - b_k P_k-1 (Forsythe 1957), of all windows at once: a
    pseudoinverse of each takes many times as long.
    """
    n, window = t.shape
    span = t[:, -1] - t[:, 0]
    u = (t - at[:, None]) / span[:, None]  # relative to the pose: the slope is one coefficient
    P, at_pose, slope, squares = [np.ones_like(u)], [np.ones(n)], [np.zeros(n)], [np.full(n, float(window))]
    for k in range(order):
        a = np.einsum("nm,nm,nm->n", u, P[k], P[k]) / squares[k]
        b = squares[k] / squares[k - 1] if k else np.zeros(n)
        P.append((u - a[:, None]) * P[k] - b[:, None] * P[k - 1])
        slope.append(at_pose[k] - a * slope[k] - b * slope[k - 1])
        at_pose.append(-a * at_pose[k] - b * at_pose[k - 1])
        squares.append(np.einsum("nm,nm->n", P[-1], P[-1]))
    return np.asarray(sum(P[k] * (slope[k] / (squares[k] * span))[:, None] for k in range(1, order + 1)))
