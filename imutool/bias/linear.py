"""Linear bias model: scale and misalignment, bias = rest + W u.

W is solved in closed form; a direction that the motion does not excite keeps the identity.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor, nn

from imutool.bias.model import BiasModel, Segment, Stream, Vector6
from imutool.config import Settings
from imutool.units import SENSORS, Sensor


class Config(Settings, frozen=True):
    """No settings; the training has its own."""


class Model(BiasModel):
    """Linear model gyro_hat = (I - W_g) gyro - rest_g, likewise for accel.

    The paper's linear method with A = I - W.

    Source: "Debiasing 6-DOF IMU via Hierarchical Learning of Continuous Bias Dynamics", sec. V-C (method "Linear");
    Rehder et al., ICRA 2016, eq. 5 and 10 for the calibration it stands for.
    """

    method: ClassVar[str] = "linear"
    iterative: ClassVar[bool] = False

    def __init__(self, config: Settings | None = None, rate_hz: float = 0.0) -> None:
        super().__init__(config or Config(), rate_hz)
        self.W = nn.ParameterDict({sensor: nn.Parameter(torch.zeros(3, 3)) for sensor in SENSORS})

    def sensor_bias(self, sensor: Sensor, segment: Segment) -> Float[Tensor, "batch n 3"]:
        """Bias rest + W u at every sample."""
        u, rest = segment.of(sensor)
        W: Tensor = self.W[sensor]
        return rest[:, None] + u @ W.mT

    def begin_at(self, sensor: Sensor, W: Float[Tensor, "3 3"]) -> None:
        """Set the matrix W: the closed form is the whole model."""
        with torch.no_grad():
            self.W[sensor].copy_(W)

    def stream(self, rest: Vector6) -> Stream:
        """Bias rest + W u at every sample."""
        W_gyro, W_accel = (self.W[sensor].detach().cpu().double().numpy() for sensor in SENSORS)

        def affine(
            t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
        ) -> Float64[np.ndarray, "n 6"]:
            bias: Float64[np.ndarray, "n 6"] = rest + np.concatenate([gyro @ W_gyro.T, accel @ W_accel.T], axis=1)
            return bias

        return affine
