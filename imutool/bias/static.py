"""Static bias model: a constant, the mean over time at rest."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import ClassVar

import numpy as np

from imutool.array_types import Float64, Rows6, Vectors
from imutool.bias.model import BiasModel, CovarianceModel, Stream, Vector6
from imutool.config import Settings
from imutool.units import Sensor

# Without training runs a measurement outweighs the prior: spreads of a consumer sensor (Bosch BMI160 data sheet: zero-rate
# offset 3 deg/s, zero-g offset 40 mg).
UNTRAINED: Mapping[str, np.ndarray] = {
    "prior_std": np.array([0.05] * 3 + [0.4] * 3, np.float32),  # single precision, as in a file
    "truth_std": np.array([2e-3] * 3 + [0.1] * 3, np.float32),
}

# Unknown scale of an axis and misalignment of two, relative: a third of the limit of a consumer sensor (InvenSense MPU-6050,
# PS-MPU-6000A revision 3.4: ±3 % at 25 °C).
CALIBRATION_STD = 0.01


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
