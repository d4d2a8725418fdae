"""Static bias model: a constant, the mean over time at rest."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import ClassVar

import numpy as np

from imutool.array_types import Float64, Rows6, Vectors
from imutool.bias.model import GAP_S, BiasEstimate, BiasModel, CovarianceModel, Covariances, Stream, Vector6
from imutool.config import Settings
from imutool.units import Sensor

# Without training logs a measurement outweighs the prior: spreads of a consumer sensor (Bosch BMI160 data sheet: zero-rate
# offset 3 deg/s, zero-g offset 40 mg).
UNTRAINED: Mapping[str, np.ndarray] = {
    "prior_std": np.array([0.05] * 3 + [0.4] * 3, np.float32),  # single precision, as in a file
    "truth_std": np.array([2e-3] * 3 + [0.1] * 3, np.float32),
}

# Unknown scale of an axis and misalignment of two, relative: a third of the limit of a consumer sensor (InvenSense MPU-6050,
# PS-MPU-6000A revision 3.4: ±3 % at 25 °C).
CALIBRATION_STD = 0.01
STEP_S = 1.0  # of the covariance of a constant rest bias, whose dynamics take minutes


class Config(Settings, frozen=True):
    """No settings."""


class Model(BiasModel):
    """Bias b(t) = rest, the turn-on bias.

    Titterton and Weston, Strapdown Inertial Navigation Technology, 2004, sec. 12.5.
    """

    method: ClassVar[str] = "static"

    def __init__(
        self, config: Settings | None = None, rate_hz: float = 0.0, tensors: Mapping[str, np.ndarray] | None = None
    ) -> None:
        super().__init__(config or Config(), rate_hz, UNTRAINED if tensors is None else tensors)

    def stretch(self, rest: Vector6, start_s: float = math.nan) -> Stream:
        """Rest bias at every sample."""
        return partial(_constant, rest)

    def calibration_covariance(self) -> CovarianceModel | None:
        """Covariance of an unknown scale and misalignment, which the model does not correct.

        At rest they act on gravity, and the bias measured there contains that: the accelerometer counts from its first sample.
        """
        spread = CALIBRATION_STD * np.eye(3)
        first: list[Float64[np.ndarray, "3"]] = []

        def root_at(
            t_s: Float64[np.ndarray, " n"], gyro: Vectors, accel: Vectors
        ) -> Mapping[Sensor, Float64[np.ndarray, "n 3 p"]]:
            if not first:
                first.append(accel[0].copy())
            samples: dict[Sensor, Vectors] = {"gyro": gyro, "accel": accel - first[0]}
            return {sensor: np.einsum("ip,nj->nipj", spread, u).reshape(len(u), 3, 9) for sensor, u in samples.items()}

        return root_at


def _constant(rest: Vector6, t_s: Float64[np.ndarray, " n"], gyro: Vectors, accel: Vectors) -> Rows6:
    """The rest bias in each row; a function of the module, so that a stream can be pickled."""
    return np.broadcast_to(rest, (len(t_s), 6)).copy()


class ConstantBiasStream:
    """Constant rest bias; its covariance grows by random walk and the model's drift."""

    def __init__(self, model: BiasModel, rest: Vector6, std: Vector6) -> None:
        self._stream = model.stream(rest)
        self._P, self._t_s, self._before_s = np.diag(std**2), 0.0, 0.0
        self._maximum = np.maximum(std, model.prior_std) ** 2
        self._transition = _transition(model.rest_dynamics() * STEP_S)
        self._walk = np.diag(model.walk_std**2) * STEP_S

    def estimate(self, t_s: Float64[np.ndarray, " n"], gyro: Vectors, accel: Vectors) -> BiasEstimate:
        """Bias at each sample, and the covariance of the rest bias in steps of `STEP_S`."""
        covariance = np.empty((len(t_s), 6, 6))
        ends = [*np.flatnonzero(np.diff(t_s, prepend=self._before_s) > GAP_S).tolist(), len(t_s)]
        first = self._within(t_s, 0, ends[0], covariance)
        for end in ends[1:]:
            self._after_gap(float(t_s[first]))
            first = self._within(t_s, first, end, covariance)
        self._before_s = float(t_s[-1]) if len(t_s) else self._before_s
        return BiasEstimate(self._stream(t_s, gyro, accel), covariance)

    def _within(self, t_s: Float64[np.ndarray, " n"], first: int, end: int, covariance: Covariances) -> int:
        """Covariances from row `first` to `end`, which no gap interrupts."""
        while first < end:
            last = min(end, int(np.searchsorted(t_s, self._t_s + STEP_S)))
            if last > first:
                covariance[first:last] = self._P
                first = last
            if first < end:
                self._P = self._transition @ self._P @ self._transition.T + self._walk
                self._t_s += STEP_S
        return end

    def _after_gap(self, t_s: float) -> None:
        """Add the random walk of whole steps up to a time, no more than the variance of a run's bias; nothing drifts."""
        steps = max(0.0, (t_s - self._t_s) // STEP_S)
        variance = np.diag(self._P)
        self._P = self._P + np.diag(np.minimum(steps * np.diag(self._walk), np.maximum(self._maximum - variance, 0.0)))
        self._t_s += steps * STEP_S


def _transition(F: Float64[np.ndarray, "6 6"]) -> Float64[np.ndarray, "6 6"]:
    """Matrix exponential."""
    if not F.any():
        return np.eye(6)
    from scipy.linalg import expm

    return np.asarray(expm(F))
