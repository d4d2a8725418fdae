"""Static bias model: a constant, the mean over time at rest."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from imutool.array_types import Float64
from imutool.bias.model import BiasModel, Stream, Vector6
from imutool.config import Settings

# Without training runs a measurement outweighs the prior: spreads of a consumer sensor (Bosch BMI160 data sheet: zero-rate
# offset 3 deg/s, zero-g offset 40 mg).
UNTRAINED: Mapping[str, np.ndarray] = {
    "prior_std": np.array([0.05] * 3 + [0.4] * 3, np.float32),  # single precision, as in a file
    "truth_std": np.array([2e-3] * 3 + [0.1] * 3, np.float32),
}


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

        def constant(
            t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
        ) -> Float64[np.ndarray, "n 6"]:
            return np.broadcast_to(rest, (len(t_s), 6)).copy()

        return constant
