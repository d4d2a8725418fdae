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

from imutool.array_types import Float64
from imutool.bias.model import COLUMNS, BiasEstimate, BiasModel, Covariances
from imutool.bias.temperature_drift import with_drift, without_drift
from imutool.bias_start.initial_bias import InitialBias
from imutool.geometry.quaternion import unit
from imutool.inertial.error_growth import BiasCovariance, Grown, Motion, grown, pose_errors
from imutool.inertial.strapdown import with_velocity
from imutool.recording import Imu, Poses, seconds
from imutool.units import SENSORS, Sensor

Roots = Mapping[Sensor, Float64[np.ndarray, "n 3 p"]]


class EstimateParts(NamedTuple):
    """Bias, covariance of its rest bias, and roots of the calibration covariance.

    `bias.model.CovarianceModel`.
    """

    bias: Float64[np.ndarray, "n 6"]
    rest: Covariances
    calibration: Roots


class BiasEstimator:
    """Bias with its covariance, gyro (rad/s) then accel (m/s²).

    For samples as they arrive in blocks of any size.
    """

    def __init__(self, model: BiasModel, start: InitialBias) -> None:
        self._rest, self._calibration = start.estimator(model), model.calibration_covariance()
        self._mean = _RunningMean() if start.tracked else None

    def __call__(
        self, t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
    ) -> BiasEstimate:
        """Bias and its covariance at each sample."""
        bias, P, calibration = self.parts(t_s, gyro, accel)
        for sensor, S in calibration.items():
            P[:, COLUMNS[sensor], COLUMNS[sensor]] += S @ S.transpose(0, 2, 1)
        return BiasEstimate(bias, P)

    def parts(
        self, t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
    ) -> EstimateParts:
        """Bias with the calibration's covariance as roots, for means over many samples."""
        bias, P = self._rest.estimate(t_s, gyro, accel)
        roots: Roots = {} if self._calibration is None or not len(t_s) else self._calibration(t_s, gyro, accel)
        return EstimateParts(bias, P, roots if self._mean is None or not roots else self._mean.subtract(roots))


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
        self.motion = Motion(t_s, u - self.bias, unit(poses.q_wb_wxyz), poses.v_w, trusted)
        self.stated = BiasCovariance(rest, _stacked(self.roots, len(t_s)))
        self._noise = np.where(model.noise_std > 0, model.noise_std, start.noise)
        self._pose_std = pose_errors(self.motion, self._noise) if pose_std is None else pose_std

    def errors(self, window_s: float, from_s: float = 0.0) -> Grown:
        """Errors of integration over windows one after another, and their covariance; none where the poses are unknown."""
        windows = self.motion.windows(window_s, from_s) if np.isfinite(self._pose_std).all() else []
        return grown(self.motion, windows, self.stated, self._noise, self._pose_std)


def _stacked(roots: Roots, n: int) -> Float64[np.ndarray, "n 6 p"]:
    """Roots of both sensors, whose unknowns are independent."""
    parts = {sensor: roots.get(sensor, np.zeros((n, 3, 0))) for sensor in SENSORS}
    out = np.zeros((n, 6, sum(part.shape[2] for part in parts.values())))
    first = 0
    for sensor, part in parts.items():
        out[:, COLUMNS[sensor], first : first + part.shape[2]] = part
        first += part.shape[2]
    return out
