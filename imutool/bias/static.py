"""Static bias model: a constant, the mean over time at rest."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from imutool.bias.model import BiasModel, Segment, Stream, Vector6
from imutool.config import Settings
from imutool.units import Sensor


class Config(Settings, frozen=True):
    """No settings."""


class Model(BiasModel):
    """Bias b(t) = rest, the turn-on bias.

    Titterton and Weston, Strapdown Inertial Navigation Technology, 2004, sec. 12.5.
    """

    method: ClassVar[str] = "static"
    iterative: ClassVar[bool] = False

    def __init__(self, config: Settings | None = None, rate_hz: float = 0.0) -> None:
        super().__init__(config or Config(), rate_hz)
        # Without training runs a measurement outweighs the prior: spreads of a consumer sensor (Bosch BMI160 data sheet:
        # zero-rate offset 3 deg/s, zero-g offset 40 mg).
        self.prior_std.copy_(torch.tensor([0.05] * 3 + [0.4] * 3))
        self.truth_std.copy_(torch.tensor([2e-3] * 3 + [0.1] * 3))

    def sensor_bias(self, sensor: Sensor, segment: Segment) -> Float[Tensor, "batch n 3"]:
        """Rest bias at every sample."""
        u, rest = segment.of(sensor)
        return rest[:, None].expand_as(u)

    def begin_at(self, sensor: Sensor, W: Float[Tensor, "3 3"]) -> None:
        """Ignore the calibration: this model has no matrix."""

    def stream(self, rest: Vector6) -> Stream:
        """Rest bias at every sample."""

        def constant(
            t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
        ) -> Float64[np.ndarray, "n 6"]:
            return np.broadcast_to(rest, (len(t_s), 6)).copy()

        return constant
