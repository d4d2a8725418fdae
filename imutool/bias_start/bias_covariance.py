"""How sure a bias is, sample by sample: the covariance of the rest bias, through the learned dynamics, and of the calibration.

For a start that holds for the whole log::

    dP/dt = F P + P F^T + Q,   F = d g / d beta at the prior,   Q = walk^2 a second,

g the drift that the model learned (zero for most) and Q how much a rest bias was seen to walk in the training logs; a start
that is followed brings the covariance of its filter. What the fit of the effects left open is added at each sample,
S S^T with S = T Sigma^1/2, T the derivative of the error with respect to the parameters.

Under a followed bias S counts as far as it differs from its mean so far. A part of an effect that stays the same is a rest
bias: neither the training logs nor the filter can tell the two apart. The fit says little of it, but their sum is known well,
and the filter's covariance is of the sum. To add S S^T whole would count it twice (on EuRoC, 2e-3 rad/s beside errors of
5e-4). The paper leaves all this to later work.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.linalg import expm

from imutool.bias.model import COLUMNS, BiasModel, Stream
from imutool.bias_start.bias_tracking import Along, Following
from imutool.bias_start.initial_bias import InitialBias
from imutool.units import Sensor

STEP_S = 1.0  # of the covariance's own dynamics, which take minutes

Covariances = Float64[np.ndarray, "n 6 6"]
Roots = Mapping[Sensor, Float64[np.ndarray, "n 3 p"]]


class Parts(NamedTuple):
    """Covariance of the rest bias at each sample, and the root of what the calibration adds
    (`imutool.bias.model.CovarianceModel`).
    """

    rest: Covariances
    calibration: Roots


class BiasCovariance:
    """The covariance of the bias at each sample, gyro (rad/s) then accel (m/s²), for samples as they arrive."""

    def __init__(self, model: BiasModel, start: InitialBias, stream: Stream) -> None:
        self._stream, self._calibration = stream, model.calibration_covariance()
        self._mean = _RunningMean() if isinstance(stream, Following | Along) else None
        self._P, self._t_s = np.diag(start.std**2), 0.0
        F = model.rest_dynamics()
        self._carried = expm(F * STEP_S)
        self._walk = np.diag(model.walk_std.detach().cpu().double().numpy() ** 2) * STEP_S

    def __call__(
        self, t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
    ) -> Covariances:
        """After the stream has been given the same samples."""
        P, calibration = self.parts(t_s, gyro, accel)
        for sensor, S in calibration.items():
            P[:, COLUMNS[sensor], COLUMNS[sensor]] += S @ S.transpose(0, 2, 1)
        return P

    def parts(
        self, t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
    ) -> Parts:
        """The same in its parts, for what is made of many samples."""
        P = self._of_rest(t_s)
        roots: Roots = {} if self._calibration is None or not len(t_s) else self._calibration(t_s, gyro, accel)
        return Parts(P, roots if self._mean is None or not roots else self._mean.off(roots))

    def _of_rest(self, t_s: Float64[np.ndarray, " n"]) -> Covariances:
        if isinstance(self._stream, Following):
            return self._stream.covariance.copy()
        if isinstance(self._stream, Along):
            out = np.zeros((len(t_s), 6, 6))
            out[:, range(6), range(6)] = self._stream.track.std_at(t_s) ** 2
            return out
        out = np.empty((len(t_s), 6, 6))
        first = 0
        while first < len(t_s):
            last = int(np.searchsorted(t_s, self._t_s + STEP_S))
            if last > first:
                out[first:last] = self._P
                first = last
            if first < len(t_s):
                self._P = self._carried @ self._P @ self._carried.T + self._walk
                self._t_s += STEP_S
        return out


class _RunningMean:
    """What roots have over their mean from the first sample to the present one; the blocks they arrive in change nothing."""

    def __init__(self) -> None:
        self._sum: dict[Sensor, Float64[np.ndarray, "3 p"]] = {}
        self._count = 0

    def off(self, roots: Roots) -> Roots:
        """The roots less their means."""
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
