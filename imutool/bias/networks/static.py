"""Static network: the rest bias, without weights."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from imutool.array_types import Float
from imutool.bias.networks.network import BiasNetwork, Segment
from imutool.bias.static import UNTRAINED, Config, Model
from imutool.config import Settings
from imutool.units import Sensor


class Network(BiasNetwork):
    """Network of `imutool.bias.static`."""

    method: ClassVar[str] = Model.method
    iterative: ClassVar[bool] = False

    def __init__(self, config: Settings | None = None, rate_hz: float = 0.0) -> None:
        super().__init__(config or Config(), rate_hz)
        for name, value in UNTRAINED.items():
            getattr(self, name).copy_(torch.from_numpy(value))

    def motion_bias(self, sensor: Sensor, segment: Segment) -> Float[Tensor, "batch n 3"]:
        """Zero."""
        return torch.zeros_like(segment.of(sensor)[0])

    def begin_at(self, sensor: Sensor, W: Float[Tensor, "3 3"]) -> None:
        """Ignore the calibration: this network has no matrix."""
