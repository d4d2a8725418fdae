"""Bias covariance at each sample.

It is the covariance of the rest bias, propagated by the learned dynamics, plus that of the calibration.

For a rest bias that stays constant over the whole log::

    dP/dt = F P + P F^T + Q,   F = d g / d beta at the prior,   Q = walk^2 per second,

with g the learned drift (zero for most models) and Q the random walk of rest biases in the training logs. A tracked rest bias
has the covariance of its filter. The fit of the effects adds S S^T at each sample, with S = T Sigma^1/2 and T the derivative
of the error with respect to the parameters.

With a tracked bias, only the difference of S from its running mean counts. The constant part of an effect acts like a rest
bias: neither the training logs nor the filter can separate the two. The fit determines each poorly but their sum well, and the
filter's covariance is that of the sum. Adding the whole S S^T would count it twice (on EuRoC, 2e-3 rad/s with errors of 5e-4).
The paper leaves this to later work.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from imutool.array_types import Float64, Int64, Rows6, Vectors
from imutool.bias.model import BiasEstimate, BiasModel, Covariances
from imutool.bias_start.initial_bias import InitialBias, model_samples
from imutool.bias_start.stretches import measured_rows
from imutool.geometry import quaternion
from imutool.inertial.preintegration import hat
from imutool.recording import Imu, Poses, seconds
from imutool.units import COLUMNS, SENSORS, Sensor

PASSED_AT_ONCE = 1 << 12  # samples between windows: roots take some hundred bytes each
Roots = Mapping[Sensor, Float64[np.ndarray, "n 3 p"]]


class EstimateParts(NamedTuple):
    """Bias, covariance of its rest bias, and roots of the calibration covariance."""

    bias: Rows6
    rest: Covariances
    calibration: Roots


class BiasEstimator:
    """Bias with its covariance, gyro (rad/s) then accel (m/s²), for samples in blocks."""

    def __init__(self, model: BiasModel, start: InitialBias) -> None:
        self._rest, self._calibration = start.estimator(model), model.calibration_covariance()
        self._mean = _RunningMean() if start.tracked else None

    def __call__(self, t_s: Float64[np.ndarray, " n"], gyro: Vectors, accel: Vectors) -> BiasEstimate:
        """Bias and its covariance at each sample."""
        bias, P, calibration = self.parts(t_s, gyro, accel)
        for sensor, S in calibration.items():
            P[:, COLUMNS[sensor], COLUMNS[sensor]] += S @ S.transpose(0, 2, 1)
        return BiasEstimate(bias, P)

    def parts(self, t_s: Float64[np.ndarray, " n"], gyro: Vectors, accel: Vectors) -> EstimateParts:
        """Bias with the calibration's covariance as roots, for means over many samples."""
        bias, P = self._rest.estimate(t_s, gyro, accel)
        roots: Roots = {} if self._calibration is None or not len(t_s) else self._calibration(t_s, gyro, accel)
        return EstimateParts(bias, P, roots if self._mean is None else self._mean.subtract(roots))


class _RunningMean:
    """Mean of the roots from the first sample to the current one; block borders change nothing."""

    def __init__(self) -> None:
        self._sum: dict[Sensor, Float64[np.ndarray, "3 p"]] = {}
        self._count = 0

    def subtract(self, roots: Roots) -> Roots:
        """Roots minus their running means."""
        out: dict[Sensor, Float64[np.ndarray, "n 3 p"]] = {}
        n = 0
        for sensor, S in roots.items():
            total = np.cumsum(S, axis=0)
            total += self._sum.get(sensor, 0.0)
            n, self._sum[sensor] = len(S), total[-1].copy()
            total /= (self._count + np.arange(1, n + 1))[:, None, None]
            out[sensor] = np.subtract(S, total, out=total)
        self._count += n
        return out


class ExpectedDrift:
    """Drift covariance of windows by the bias, of pieces of a path that follow each other.

    `imu` has the samples as recorded, and the paths are integrations of the debiased ones. Errors of a window's start do not
    count, nor does the noise of the samples: vibration is no white noise, and the noise at rest is much less than the bias.
    """

    def __init__(self, model: BiasModel, start: InitialBias, imu: Imu) -> None:
        self._imu = measured_rows(imu)
        self._model, self._estimator, self._done = model, BiasEstimator(model, start), 0
        self._samples = model_samples(model, imu)

    def __call__(self, path: Poses, windows: Int64[np.ndarray, "m 2"]) -> Float64[np.ndarray, "m 6 6"]:
        """Covariance of attitude (rad), then velocity (m/s), at the end of each window."""
        t_ns, accel, log_drift = self._imu.t_ns, self._imu.accel, self._model.log_drift
        out = np.zeros((len(windows), 6, 6))
        for k, (first_ns, last_ns) in enumerate(path.t_ns[windows]):
            a, b = int(np.searchsorted(t_ns, first_ns)), int(np.searchsorted(t_ns, last_ns, side="right")) - 1
            if b <= a:  # nothing was measured
                continue
            for done in range(self._done, a, PASSED_AT_ONCE):
                self._parts(done, min(done + PASSED_AT_ONCE, a))
            _, rest, roots = self._parts(a, b)
            self._done = b
            if log_drift is not None:
                rest = rest + log_drift.covariance(t_ns[a:b])
            q_wb_wxyz = path.q_wb_wxyz[np.searchsorted(path.t_ns, t_ns[a : b + 1])]
            force_w = quaternion.rotate(q_wb_wxyz, accel[a : b + 1])
            by_bias = drift_by_bias(seconds(t_ns[a : b + 1], int(first_ns)), q_wb_wxyz, force_w)[:-1]
            constant, moving = by_bias.sum(axis=0), np.einsum("nij,njp->ip", by_bias, stacked(roots, b - a))
            out[k] = constant @ rest.mean(axis=0) @ constant.T + moving @ moving.T
        return out

    def _parts(self, first: int, end: int) -> EstimateParts:
        return self._estimator.parts(*(column[first:end] for column in self._samples))


def drift_by_bias(
    t_s: Float64[np.ndarray, " n"], q_wb_wxyz: Float64[np.ndarray, "n 4"], force_w: Vectors
) -> Float64[np.ndarray, "n 6 6"]:
    """Drift Jacobian: attitude and velocity at the end of a window by the bias of each sample.

    The errors are xi of the attitude, R_hat = Exp(xi) R, and delta v, both in the world frame; with the specific force f_w::

        d xi/dt = -R zeta_g        d delta_v/dt = -[f_w]x xi - R zeta_a

    for an error zeta of the bias (Barrau and Bonnabel, TAC 2017, as in `imutool.inertial.inertial_filter`).
    """
    dt = np.diff(t_s)[:, None]
    gained = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (force_w[1:] + force_w[:-1]) * dt, axis=0)])
    weight = 0.5 * (np.append(dt, 0.0) + np.insert(dt, 0, 0.0))
    out = np.zeros((len(t_s), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = -quaternion.matrix(q_wb_wxyz) * weight[:, None, None]
    out[:, 3:, :3] = -hat(gained[-1] - gained) @ out[:, :3, :3]
    return out


def stacked(roots: Roots, n: int) -> Float64[np.ndarray, "n 6 q"]:
    """Roots of both sensors, whose unknowns are independent."""
    parts = {sensor: roots.get(sensor, np.zeros((n, 3, 0))) for sensor in SENSORS}
    out = np.zeros((n, 6, sum(part.shape[2] for part in parts.values())))
    first = 0
    for sensor, part in parts.items():
        out[:, COLUMNS[sensor], first : first + part.shape[2]] = part
        first += part.shape[2]
    return out
