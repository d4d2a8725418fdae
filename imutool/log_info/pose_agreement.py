"""Turns between poses against the mean rates that the gyroscope measured."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from imutool.cleaning.truth import Truth, turning
from imutool.recording import Imu, seconds

LEAST_TURNS = 20  # between poses
LEAST_RATE_RAD_S = 0.02  # rms of the gyro about its mean: less shows nothing


class Agreement(NamedTuple):
    """Rms (rad/s) of the gyro that the poses leave unexplained, and the share that they explain."""

    rms_rad_s: float
    explained: float


def agreement(poses: Truth, imu: Imu) -> Agreement | None:
    """Agreement of the turns of poses with the gyro; None where the two share too little motion.

    gyro = b + R omega, with the constant bias b and rotation R that fit best (Kabsch), over intervals of a tenth of a second.
    """
    if len(imu) < LEAST_TURNS or len(poses.t_ns) < LEAST_TURNS:
        return None
    start_ns, end_ns, rate = turning(poses)
    first, last = int(imu.t_ns[0]), int(imu.t_ns[-1])
    steps = (end_ns - start_ns).astype(float)
    inside = (start_ns >= first) & (end_ns <= last) & (steps < 4.0 * np.median(steps)) & np.isfinite(rate).all(axis=1)
    if inside.sum() < LEAST_TURNS:
        return None
    t = seconds(imu.t_ns, first)
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(np.diff(t)[:, None] * (imu.gyro[1:] + imu.gyro[:-1]) / 2.0, axis=0)])
    begin, end = seconds(start_ns[inside], first), seconds(end_ns[inside], first)
    mean = np.stack([(np.interp(end, t, c) - np.interp(begin, t, c)) / (end - begin) for c in turned.T], axis=1)
    gyro, omega = mean - mean.mean(axis=0), rate[inside] - rate[inside].mean(axis=0)
    motion = float(np.sqrt((gyro**2).sum(axis=1).mean()))
    if motion < LEAST_RATE_RAD_S:
        return None
    left, _, right = np.linalg.svd(gyro.T @ omega)
    turn = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
    rms = float(np.sqrt(((gyro - omega @ turn.T) ** 2).sum(axis=1).mean()))
    return Agreement(rms, max(0.0, 1.0 - (rms / motion) ** 2))
