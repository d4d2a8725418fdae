"""Noise of an IMU in motion: Allan deviation of its error over windows between true poses.

Over a window of length T, integration misses the truth by e = n_end - n_start - G b - noise (`imutool.inertial.windows`), n the
truth's own error and G = sum_k A_k how a constant b shows; y = -G^-1 e is the mean error of the rate (or specific force).
Differences of the y of neighbouring windows give an Allan deviation in which a white error of the truth falls as 1/T, the
sensor's white noise as T^-1/2, and a walking bias grows as T^1/2: the length of the window separates them. What neither a
model nor the truth explains (a delay, a wrong scale) is in it too, which is why the samples should be calibrated first.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from imutool.array_types import Bool, Float64, Int64
from imutool.errors import DataError
from imutool.geometry import so3
from imutool.inertial.stationary import GAP_PERIODS
from imutool.inertial.strapdown import GRAVITY_W, with_velocity
from imutool.inertial.windows import rotation_residual, velocity_residual
from imutool.noise.allan import Curve, freedom, library, sample_period_s
from imutool.processes.system import release_memory
from imutool.recording import Imu, Poses, seconds

MAD = 1.4826  # of a normal distribution: its standard deviation over its median size
MAD_EFFICIENCY = 0.37
OVERLAP = 2  # windows begin twice in their own length
MIN_WINDOWS = 9
MAX_WINDOWS = 3000  # of one length, in runs of neighbours: the median is good to 2 per cent with as many
RUN = 60
TURNED = 1.0 / 3.0  # of T, the least singular value of G: a window that turns all the way round shows no constant
MAX_SAMPLES = 50_000  # at once

Rows = Float64[np.ndarray, "n 3"]


def curves(imu: Imu, truth: Poses) -> tuple[Curve, Curve]:
    """Allan deviations of the errors of gyro (rad/s) and accelerometer (m/s²).

    Window lengths an octave apart.

    Outliers of the truth do no harm: the spread is the median's. Windows touch no gap in truth or samples. Lengths that fewer
    than 9 windows have are left out.

    Raises:
        DataError: the truth covers no window of the IMU's.
        ConfigError: allantools is not installed.
    """
    poses, trusted = with_velocity(truth).at(imu.t_ns)
    t = seconds(imu.t_ns, int(imu.t_ns[0]))
    period_s = sample_period_s(imu)
    start = max(1, round(sample_period_s(truth) / period_s))  # shorter windows would lie between two poses
    broken = np.cumsum((np.diff(t, prepend=t[0]) > GAP_PERIODS * period_s) | ~trusted)
    R_wb, v_w = so3.matrices_from_rows_wxyz(poses.q_wb_wxyz), poses.v_w
    assert v_w is not None
    del poses  # no array as long as the log stays when it is no longer needed
    release_memory()
    found: tuple[list[Rows], list[Rows]] = ([], [])
    lengths, worth = [], []
    n, tools = start, library()
    while 2 * n < len(imu):
        hop = max(1, n // OVERLAP)
        first = _starts(len(imu), n, hop, broken)
        gyro, accel = (_spread(partial(_error, imu, t, R_wb, v_w, n, sensor), first, n) for sensor in ("gyro", "accel"))
        if gyro is None or accel is None:
            break
        found[0].append(gyro)
        found[1].append(accel)
        lengths.append(n * period_s)
        whole = min(int(trusted.sum()), len(first) * hop)
        worth.append(max(1.0, MAD_EFFICIENCY * freedom(tools, whole, min(n, whole // 2))))
        n *= 2
    if not lengths:
        raise DataError(
            "the truth covers no stretch without gaps", expected=f"at least {MIN_WINDOWS} windows of {start * period_s:.3g} s"
        )
    tau_s, degrees = np.array(lengths), np.array(worth)
    return Curve(tau_s, np.array(found[0]), degrees), Curve(tau_s, np.array(found[1]), degrees)


def _starts(count: int, n: int, hop: int, broken: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " m"]:
    """First samples of windows of n steps that touch no gap; of more than enough, runs of neighbours all over the log."""
    first = np.arange(0, max(count - n, 0), hop)
    if len(first) > MAX_WINDOWS:
        begin = np.linspace(0, len(first) - RUN, MAX_WINDOWS // RUN).astype(int)
        first = first[np.unique((begin[:, None] + np.arange(RUN)).ravel())]
    kept: Int64[np.ndarray, " m"] = first[broken[first + n] == broken[first]]
    return kept


def _spread(
    error: Callable[..., tuple[Rows, Bool[np.ndarray, " m"]]], first: Int64[np.ndarray, " m"], n: int
) -> Float64[np.ndarray, "3"] | None:
    """Allan deviation of the error over windows of n steps; None where too few of them can show it."""
    if len(first) <= MIN_WINDOWS:  # too few pairs of neighbours, and the longest windows take the most memory
        return None
    at_once = max(1, MAX_SAMPLES // n)
    parts = [error(first[k : k + at_once]) for k in range(0, len(first), at_once)]
    y, shown = (np.concatenate(column) for column in zip(*parts, strict=True))
    first, y = first[shown], y[shown]
    after = np.searchsorted(first, first + n)  # the window that begins where this one ends
    pairs = np.flatnonzero((after < len(first)) & (first[np.minimum(after, len(first) - 1)] == first + n))
    if len(pairs) < MIN_WINDOWS:
        return None
    return np.asarray(MAD * np.median(np.abs(y[after[pairs]] - y[pairs]), axis=0) / np.sqrt(2.0))


def _error(
    imu: Imu, t: Float64[np.ndarray, " n"], R_wb: torch.Tensor, v_w: Rows, n: int, sensor: str, first: Int64[np.ndarray, " m"]
) -> tuple[Float64[np.ndarray, "m 3"], Bool[np.ndarray, " m"]]:
    """Mean error of the sensor over each window, in the body's axes, and whether the window can show it."""
    index = first[:, None] + np.arange(n + 1)
    dt = torch.from_numpy(np.diff(t[index], axis=1))
    begin, end = torch.from_numpy(index[:, 0]), torch.from_numpy(index[:, -1])
    if sensor == "gyro":
        e, A = rotation_residual(torch.from_numpy(imu.gyro[index]), dt, R_wb[begin].mT @ R_wb[end])
    else:
        dv = torch.from_numpy(v_w[index[:, -1]] - v_w[index[:, 0]])
        g_w = torch.tensor(GRAVITY_W, dtype=torch.float64)
        e, A = velocity_residual(torch.from_numpy(imu.accel[index]), dt, R_wb[torch.from_numpy(index)], dv, g_w)
    G = A.sum(1).numpy()
    size = np.linalg.svd(G, compute_uv=False)[:, -1]
    shown: Bool[np.ndarray, " m"] = size >= TURNED * dt.sum(1).numpy()
    G[~shown] = np.eye(3)
    return -np.linalg.solve(G, e.numpy()[..., None])[..., 0], shown
