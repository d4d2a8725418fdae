"""Network of a bias model in torch, for training; `frozen` gives the model in numpy."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Literal, NamedTuple

import msgspec
import torch
from torch import Tensor, nn

from imutool import registry
from imutool.array_types import Float
from imutool.bias.model import STATISTICS, BiasModel
from imutool.config import Settings
from imutool.inertial.windows import end_attitude
from imutool.units import COLUMNS, SENSORS, Sensor


@dataclass(frozen=True)
class Segment:
    """Samples of a segment, `t` (s) from its first sample, and the rest bias at its start."""

    t: Float[Tensor, "batch n"]
    gyro: Float[Tensor, "batch n 3"]
    accel: Float[Tensor, "batch n 3"]
    rest: Float[Tensor, "batch 6"]

    def of(self, sensor: Sensor) -> tuple[Float[Tensor, "batch n 3"], Float[Tensor, "batch 3"]]:
        """Samples and rest bias of one sensor."""
        return (self.gyro if sensor == "gyro" else self.accel), self.rest[:, COLUMNS[sensor]]


class LastLayer(NamedTuple):
    """Weights in which a sensor's motion bias is linear, W u + out x, with u the samples."""

    W: Float[Tensor, "3 3"]
    out: Float[Tensor, "3 k"]
    inputs: Callable[[Segment], Float[Tensor, "batch n k"]]  # x, in the unit of the bias
    prior_root: Float[Tensor, "k k"]  # of the covariance of a row of `out` a priori, but for a factor


class BiasNetwork(nn.Module, ABC):
    """Bias network with the statistics of its sensor's training runs, for training.

    It computes in float64 (`imutool.training.fit`), unless `see` says otherwise. Names and shapes of its state are those of
    the model.
    """

    method: ClassVar[str]
    iterative: ClassVar[bool] = True  # false where the closed form is the whole solution
    objective: ClassVar[Literal["window_ends", "increments"]] = "window_ends"  # loss of the training (imutool.training)
    prefers: ClassVar[Mapping[str, Any]] = MappingProxyType({})  # TrainSettings that differ from the general defaults
    undecayed: ClassVar[tuple[str, ...]] = ()  # name prefixes of parameters without weight decay
    context: int = 0  # samples before a segment that its bias depends on; such a bias is rest + f(samples)
    forgets: bool = False  # the bias follows from all samples so far, whatever it was at the start
    prior_mean: Tensor
    prior_std: Tensor
    truth_std: Tensor
    rest_std: Tensor
    walk_std: Tensor
    noise_std: Tensor

    def __init__(self, config: Settings, rate_hz: float) -> None:
        super().__init__()
        self.config, self.rate_hz = config, rate_hz
        self.card: Mapping[str, Any] = {}
        for name in STATISTICS:
            self.register_buffer(name, torch.zeros(6))

    def take_temperature(self, channel: str, tensors: Mapping[str, Tensor]) -> None:
        """Take over the channel and the range of the temperature that a drift follows."""
        self.config = msgspec.structs.replace(self.config, temperature=channel)
        self.temperature = nn.Module()
        for name, value in tensors.items():
            self.temperature.register_buffer(name, value.to(self.prior_mean))

    def see(self, gyro: Float[Tensor, "n 3"], accel: Float[Tensor, "n 3"]) -> None:
        """Get ready for a training: the scales of the inputs from all its samples, the precision of what may be coarse."""

    def rest_at_work(self, sensor: Sensor, rest: Float[Tensor, "*logs 3"]) -> Float[Tensor, "*logs 3"]:
        """Rest biases for inference from those of training mode; equal for most models."""
        return rest

    @abstractmethod
    def motion_bias(self, sensor: Sensor, segment: Segment) -> Float[Tensor, "batch n 3"]:
        """Part of a sensor's bias that follows from the samples alone, whatever the rest bias. Differentiable."""

    def last_layer(self, sensor: Sensor) -> LastLayer | None:
        """Last layer of the motion bias, where it is solved for in closed form before the descent."""
        return None

    def rest_bias(self, sensor: Sensor, segment: Segment) -> Float[Tensor, "batch n 3"]:
        """Rest bias of one sensor at each sample: constant unless a model lets it drift. Differentiable."""
        u, rest = segment.of(sensor)
        return rest[:, None].expand_as(u)

    def sensor_bias(self, sensor: Sensor, segment: Segment) -> Float[Tensor, "batch n 3"]:
        """Bias of one sensor at each sample; row k depends on samples up to k. Differentiable.

        The sensors are separate because the training is: first the gyro, then the accelerometer with the trained gyro.
        """
        return self.rest_bias(sensor, segment) + self.motion_bias(sensor, segment)

    def forward(self, segment: Segment) -> Float[Tensor, "batch n 6"]:
        """Bias at each sample: gyro (rad/s), then accel (m/s²)."""
        return torch.cat([self.sensor_bias(sensor, segment) for sensor in SENSORS], dim=-1)

    def end_attitude(
        self, R_start: Float[Tensor, "batch 3 3"], segment: Segment, dt: Float[Tensor, "batch steps"]
    ) -> Float[Tensor, "batch 3 3"]:
        """Attitude (body to world) at the last sample, by integrating the debiased rate from `R_start`. Differentiable."""
        return end_attitude(R_start, segment.gyro - self.sensor_bias("gyro", segment), dt)

    @abstractmethod
    def begin_at(self, sensor: Sensor, W: Float[Tensor, "3 3"]) -> None:
        """Set the calibration matrix, solved in closed form, from which the training starts."""

    def take_covariance(self, sensor: Sensor, covariance: Float[Tensor, "9 9"]) -> None:
        """Take the covariance of that matrix, row by row: of use where the matrix is the whole model."""

    def frozen(self) -> BiasModel:
        """Model that infers with copies of the present weights, in numpy."""
        kind = registry.load("imutool.bias", self.method).Model
        tensors = {name: value.detach().cpu().double().numpy().copy() for name, value in self.state_dict().items()}
        model: BiasModel = kind(self.config, self.rate_hz, tensors)
        model.card = self.card
        return model
