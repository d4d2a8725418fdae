"""Errors of integration from the truth, and the covariance that they should have.

A window begins at a true pose. Its errors at the end are xi of the attitude, R_hat = Exp(xi) R, and delta v, both in the world
frame (m/s for the velocity). For an error zeta of the bias (measured minus zeta is what is integrated)::

    d xi/dt = -R zeta_g        d delta_v/dt = -[f_w]x xi - R zeta_a        f_w = R accel, the specific force in the world

(`imutool.bias_start.bias_covariance.drift_by_bias`). The covariance is the sum of four parts: bias, as a
constant and as roots S in time; white noise of the samples; the pose at the start; the pose at the end.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from imutool.array_types import Bool, Float64
from imutool.bias.log_binding import with_drift, without_drift
from imutool.bias.model import BiasModel
from imutool.bias_start.bias_covariance import BiasEstimator, drift_by_bias, stacked
from imutool.bias_start.initial_bias import InitialBias
from imutool.geometry import quaternion
from imutool.inertial.preintegration import EYE, hat
from imutool.inertial.strapdown import GRAVITY_W, with_velocity
from imutool.recording import Imu, Poses, seconds

Vector6 = Float64[np.ndarray, "6"]
MIN_TRUSTED = 0.5  # share of a window's samples with truth
LONGEST_STEP_S = 0.1  # between two samples of a window
LAG_S = 1.0  # of the differences that show the errors of the poses
FEWEST = 4  # differences, to say how good the poses are


class Motion(NamedTuple):
    """Debiased samples (rad/s, m/s²) and true poses at their times."""

    t_s: Float64[np.ndarray, " n"]
    samples: Float64[np.ndarray, "n 6"]
    q_wb_wxyz: Float64[np.ndarray, "n 4"]
    v_w: Float64[np.ndarray, "n 3"]
    trusted: Bool[np.ndarray, " n"]

    def window(self, from_s: float, length_s: float) -> slice | None:
        """Rows of a window from a time on; None where the truth is missing at an end, or for most of it."""
        first, last = (int(np.searchsorted(self.t_s, t)) for t in (from_s, from_s + length_s))
        rows = slice(first, last + 1)
        if last >= len(self.t_s) or not (self.trusted[first] and self.trusted[last]):
            return None
        whole = self.trusted[rows].mean() >= MIN_TRUSTED and np.diff(self.t_s[rows]).max() <= LONGEST_STEP_S
        return rows if whole else None

    def windows(self, length_s: float, from_s: float = 0.0) -> list[slice]:
        """Windows one after another."""
        starts = np.arange(max(from_s, float(self.t_s[np.argmax(self.trusted)])), self.t_s[-1], length_s)
        return [rows for start in starts if (rows := self.window(float(start), length_s)) is not None]


class BiasCovariance(NamedTuple):
    """Covariance of the bias at each sample: of a constant, and roots of what the motion adds."""

    rest: Float64[np.ndarray, "n 6 6"]
    roots: Float64[np.ndarray, "n 6 p"]


class Grown(NamedTuple):
    """Errors at the ends of windows, attitude (rad) then velocity (m/s), and their covariance.

    `bias` is the part of the covariance that the bias causes, `other` that of white noise and poses.
    """

    error: Float64[np.ndarray, "m 6"]
    bias: Float64[np.ndarray, "m 6 6"]
    other: Float64[np.ndarray, "m 6 6"]


def grown(motion: Motion, windows: list[slice], stated: BiasCovariance, noise: Vector6, pose_std: Vector6) -> Grown:
    """Errors at the ends of windows and their covariance.

    The lean of the truth's world is fitted to all of them together and taken off.
    """
    parts = [_integrated(motion, rows) for rows in windows]
    if not parts:
        return Grown(np.zeros((0, 6)), np.zeros((0, 6, 6)), np.zeros((0, 6, 6)))
    error, bias, other = np.stack([part.error for part in parts]), [], []
    for rows, part in zip(windows, parts, strict=True):
        A = part.by_bias.sum(axis=0)
        S = np.einsum("nij,njp->ip", part.by_bias, stated.roots[rows])
        bias.append(A @ stated.rest[rows].mean(axis=0) @ A.T + S @ S.T)
        shaken = part.by_bias * noise
        other.append(
            np.einsum("nij,nkj->ik", shaken, shaken) + (part.by_pose * pose_std**2) @ part.by_pose.T + np.diag(pose_std**2)
        )
    error[:, 3:] -= _by_lean(motion, windows, parts, error[:, 3:])
    return Grown(error, np.stack(bias), np.stack(other))


class _Integrated(NamedTuple):
    """Errors of one window, their derivatives by the bias of each sample and by the pose at the start."""

    error: Vector6
    by_bias: Float64[np.ndarray, "n 6 6"]
    by_pose: Float64[np.ndarray, "6 6"]


def _integrated(motion: Motion, rows: slice) -> _Integrated:
    t, u = motion.t_s[rows], motion.samples[rows]
    q, v = motion.q_wb_wxyz[rows], motion.v_w[rows]
    dt = np.diff(t)[:, None]
    steps = quaternion.exp(0.5 * (u[1:, :3] + u[:-1, :3]) * dt)
    q_hat = quaternion.multiply(q[:1], np.concatenate([[[1.0, 0.0, 0.0, 0.0]], quaternion.running_product(steps)]))
    force = quaternion.rotate(q_hat, u[:, 3:])
    gained = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (force[1:] + force[:-1]) * dt, axis=0)])
    v_hat = v[0] + gained[-1] + np.array(GRAVITY_W) * (t[-1] - t[0])
    xi = quaternion.log(quaternion.multiply(q_hat[-1:], quaternion.inverse(q[-1:])))[0]
    by_bias, by_pose = drift_by_bias(t, q_hat, force), np.eye(6)
    by_pose[3:, :3] = -hat(gained[-1])
    return _Integrated(np.concatenate([xi, v_hat - v[-1]]), by_bias, by_pose)


def _by_lean(
    motion: Motion, windows: list[slice], parts: list[_Integrated], velocity: Float64[np.ndarray, "m 3"]
) -> Float64[np.ndarray, "m 3"]:
    """Velocity that a horizontal acceleration of the world causes; a bias of the accelerometer is solved for with it."""
    length_s = np.array([motion.t_s[rows][-1] - motion.t_s[rows][0] for rows in windows])
    lean = length_s[:, None, None] * EYE[:, :2]
    if 3 * len(windows) < 2 * 5:  # too few to tell one from the other
        return np.zeros_like(velocity)
    X = np.concatenate([lean, np.stack([part.by_bias[:, 3:, 3:].sum(axis=0) for part in parts])], axis=2)
    solution = np.linalg.lstsq(X.reshape(-1, 5), velocity.ravel())[0]
    return np.asarray(lean @ solution[:2])


def pose_errors(motion: Motion, noise: Vector6) -> Vector6:
    """Standard deviation of the poses' own errors: attitude (rad), velocity (m/s).

    They are the same for all axes, and come from the difference of two neighbouring windows of `LAG_S`, in which a constant
    bias cancels: six variances of a pose, and twice the white noise of the samples. Errors that last for seconds do not show.
    NaN where a log is too short.
    """
    pairs = motion.windows(LAG_S)
    known = [_integrated(motion, rows) for rows in pairs]
    follows = [k for k in range(len(pairs) - 1) if pairs[k + 1].start == pairs[k].stop - 1]
    if len(follows) < FEWEST:
        return np.full(6, np.nan)
    change = np.stack([known[k + 1].error - known[k].error for k in follows])
    white = 2.0 * np.stack([((known[k].by_bias * noise) ** 2).sum(axis=(0, 2)) for k in follows]).mean(axis=0)
    square = (change**2).mean(axis=0) - white
    attitude = max(float(square[:3].mean()), 0.0) / 6.0
    # the attitude of each start leans its window's force: what that adds to the velocity is no error of the velocity
    leaned = 2.0 * attitude * float(np.mean([(known[k].by_pose[3:, :3] ** 2).sum(axis=1) for k in follows]))
    velocity = max(float(square[3:].mean()) - leaned, 0.0) / 6.0
    return np.repeat(np.sqrt([attitude, velocity]), 3)


class Judged:
    """Debiased samples of a log with their stated covariance, to be judged by true poses.

    `pose_std` is that of the poses (rad, m/s) if it is known; else the log shows it, and where it is too short it is NaN.
    """

    def __init__(
        self, model: BiasModel, start: InitialBias, imu: Imu, truth: Poses, pose_std: Float64[np.ndarray, "6"] | None = None
    ) -> None:
        t_s, u = seconds(imu.t_ns, int(imu.t_ns[0])), np.concatenate([imu.gyro, imu.accel], axis=1)
        steady = without_drift(model, imu)
        poses, trusted = with_velocity(truth).at(imu.t_ns)
        assert poses.v_w is not None
        self.bias, rest, self.roots = BiasEstimator(model, start).parts(t_s, steady.gyro, steady.accel)
        self.bias, rest = with_drift(model, imu.t_ns, self.bias, rest)
        self.motion = Motion(t_s, u - self.bias, quaternion.unit(poses.q_wb_wxyz), poses.v_w, trusted)
        self.stated = BiasCovariance(rest, stacked(self.roots, len(t_s)))
        self.noise = np.where(model.noise_std > 0, model.noise_std, start.noise)
        self._pose_std = pose_errors(self.motion, self.noise) if pose_std is None else pose_std

    def errors(self, window_s: float, from_s: float = 0.0) -> Grown:
        """Errors of integration over windows one after another, and their covariance; none where the poses are unknown."""
        windows = self.motion.windows(window_s, from_s) if np.isfinite(self._pose_std).all() else []
        return grown(self.motion, windows, self.stated, self.noise, self._pose_std)
