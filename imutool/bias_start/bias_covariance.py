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
from imutool.bias_start.initial_bias import InitialBias
from imutool.units import Sensor

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
