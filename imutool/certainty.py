"""How sure a bias is, sample by sample: the covariance of the rest bias, through the learned dynamics, and of the calibration.

For a start that holds for the whole log::

    dP/dt = F P + P F^T + Q,   F = d g / d beta at the prior,   Q = walk^2 a second,

g the drift that the model learned (zero for most) and Q how much a rest bias was seen to walk in the training logs; a start
that is followed brings the covariance of its filter. What the fit of the effects left open is added at each sample,
T Sigma T^T with T the derivative of the error with respect to the parameters. The paper leaves this to later work.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from scipy.linalg import expm

from imutool.bias._base import BiasModel, Stream
from imutool.rest_track import Along, Following
from imutool.turn_on import TurnOn

STEP_S = 1.0  # of the covariance's own dynamics, which take minutes

Covariances = Float64[np.ndarray, "n 6 6"]


class Certainty:
    """The covariance of the bias at each sample, gyro (rad/s) then accel (m/s²), for samples as they arrive."""

    def __init__(self, model: BiasModel, start: TurnOn, stream: Stream) -> None:
        self._stream, self._calibration = stream, model.calibration_covariance()
        self._P, self._t_s = np.diag(start.std**2), 0.0
        F = model.rest_dynamics()
        self._carried = expm(F * STEP_S)
        self._walk = np.diag(model.walk_std.detach().cpu().double().numpy() ** 2) * STEP_S

    def __call__(
        self, t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
    ) -> Covariances:
        """After the stream has been given the same samples."""
        P = self._of_rest(t_s)
        return P if self._calibration is None or not len(t_s) else P + self._calibration(t_s, gyro, accel)

    def _of_rest(self, t_s: Float64[np.ndarray, " n"]) -> Covariances:
        if isinstance(self._stream, Following):
            return self._stream.covariance
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
