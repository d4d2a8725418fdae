"""Linear network: bias = rest + W u, with W solved in closed form."""

from __future__ import annotations

from typing import ClassVar

import msgspec
import torch
from torch import Tensor, nn

from imutool.array_types import Float
from imutool.bias.linear import Config, Model
from imutool.bias.networks.network import BiasNetwork, Segment
from imutool.config import Settings
from imutool.units import SENSORS, Sensor


class Network(BiasNetwork):
    """Network of `imutool.bias.linear`."""

    method: ClassVar[str] = Model.method
    iterative: ClassVar[bool] = False
    config: Config

    def __init__(self, config: Settings | None = None, rate_hz: float = 0.0) -> None:
        chosen = config or Config()
        assert isinstance(chosen, Config)
        super().__init__(chosen, rate_hz)
        if chosen.covariance:
            self._make_covariances()
        self.W = nn.ParameterDict({sensor: nn.Parameter(torch.zeros(3, 3)) for sensor in SENSORS})

    def motion_bias(self, sensor: Sensor, segment: Segment) -> Float[Tensor, "batch n 3"]:
        """W u at every sample."""
        W: Tensor = self.W[sensor]
        return segment.of(sensor)[0] @ W.mT

    def begin_at(self, sensor: Sensor, W: Float[Tensor, "3 3"]) -> None:
        """Set the matrix W: the closed form is the whole model."""
        with torch.no_grad():
            self.W[sensor].copy_(W)

    def take_covariance(self, sensor: Sensor, covariance: Float[Tensor, "9 9"]) -> None:
        """Take the covariance of W, row by row."""
        if not self.config.covariance:
            self.config = msgspec.structs.replace(self.config, covariance=True)
            self._make_covariances()
        self.covariance.get_buffer(sensor).copy_(covariance)

    def _make_covariances(self) -> None:
        self.covariance = nn.Module()
        for sensor in SENSORS:
            self.covariance.register_buffer(sensor, self.prior_mean.new_zeros(9, 9))
