"""Linear bias model: scale and misalignment, bias = rest + W u.

W is solved in closed form; a direction that the motion does not excite keeps the identity.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from imutool.array_types import Float64
from imutool.bias.model import BiasModel, Shapes, Stream, Vector6, matrices
from imutool.config import Settings
from imutool.units import SENSORS


class Config(Settings, frozen=True):
    """No settings; the training has its own."""


class Model(BiasModel):
    """Linear model gyro_hat = (I - W_g) gyro - rest_g, likewise for accel.

    The paper's linear method with A = I - W.

    Source: "Debiasing 6-DOF IMU via Hierarchical Learning of Continuous Bias Dynamics", sec. V-C (method "Linear");
    Rehder et al., ICRA 2016, eq. 5 and 10 for the calibration it stands for.
    """

    method: ClassVar[str] = "linear"

    def __init__(
        self, config: Settings | None = None, rate_hz: float = 0.0, tensors: Mapping[str, np.ndarray] | None = None
    ) -> None:
        super().__init__(config or Config(), rate_hz, tensors)

    @classmethod
    def shapes(cls, config: Settings) -> Shapes:
        """Shapes of the statistics and of W for each sensor."""
        return super().shapes(config) | matrices()

    def stretch(self, rest: Vector6, start_s: float = math.nan) -> Stream:
        """Bias rest + W u at every sample."""
        W_gyro, W_accel = (self.tensors[f"W.{sensor}"] for sensor in SENSORS)

        def affine(
            t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
        ) -> Float64[np.ndarray, "n 6"]:
            bias: Float64[np.ndarray, "n 6"] = rest + np.concatenate([gyro @ W_gyro.T, accel @ W_accel.T], axis=1)
            return bias

        return affine
