"""Convolutional network: dilated causal convolutions (`imutool.bias.conv`).

Training computes in float32 (three times as fast; the weights stay float64) with the batch norm as it stands, inference in
float64 with the batch norm folded into the convolutions.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from imutool.array_types import Float
from imutool.bias.conv import EPSILON, Config, Model
from imutool.bias.networks.network import BiasNetwork, Segment
from imutool.config import Settings
from imutool.units import SENSORS, Sensor

MOMENTUM = 0.1  # of the running mean: batch norm's usual value
MIN_SCALE = (1e-2, 1e-2, 1e-2, 1e-1, 1e-1, 1e-1)  # rad/s, m/s²: limits the gain of a channel without motion


class FoldedLayer(NamedTuple):
    """Layer with folded batch norm, for deviations from rest.

    y = GELU(weight * x + offset) - GELU(offset).
    """

    weight: Float[Tensor, "after before kernel"]
    offset: Float[Tensor, " after"]
    dilation: int


class Layer(nn.Module):
    """Convolution, batch norm, GELU, dropout; only the batch norm has a constant."""

    def __init__(self, before: int, after: int, kernel: int, dilation: int, dropout: float) -> None:
        super().__init__()
        self.dilation, self.dropout, self.reach = dilation, dropout, (kernel - 1) * dilation
        self.weight = nn.Parameter(torch.empty(after, before, kernel))
        nn.init.normal_(self.weight, 0.0, (before * kernel) ** -0.5)
        self.gain, self.shift = nn.Parameter(torch.ones(after)), nn.Parameter(torch.zeros(after))
        self.mean: Tensor
        self.var: Tensor
        self.register_buffer("mean", torch.zeros(after))
        self.register_buffer("var", torch.ones(after))

    def forward(self, x: Float[Tensor, "batch before n"]) -> Float[Tensor, "batch after n"]:
        """Output of the unfolded layer, in the precision of its input."""
        y = functional.conv1d(causal(x, self.reach), self.weight.to(x), dilation=self.dilation)
        mean, var = self.mean.to(x), self.var.to(x)
        y = functional.batch_norm(y, mean, var, self.gain.to(x), self.shift.to(x), self.training, MOMENTUM, EPSILON)
        if self.training:  # batch_norm updated the two, which may be copies
            self.mean.copy_(mean)
            self.var.copy_(var)
        return functional.dropout(functional.gelu(y), self.dropout, self.training)

    def folded(self, x: Float[Tensor, " before"]) -> FoldedLayer:
        """Folded layer for deviations from the constant input `x`."""
        gain = self.gain * (self.var + EPSILON).rsqrt()
        weight = self.weight * gain[:, None, None]
        return FoldedLayer(weight, weight.sum(2) @ x + self.shift - self.mean * gain, self.dilation)


class Net(nn.Module):
    """Network N: six channels to a correction of three; zero before training."""

    def __init__(self, config: Config, unit: float) -> None:
        super().__init__()
        self.unit = unit
        sizes = zip((6, *config.channels), config.channels, config.dilations, strict=False)
        self.layers = nn.ModuleList(Layer(a, b, config.kernel, d, config.dropout) for a, b, d in sizes)
        self.out = nn.Parameter(torch.zeros(3, config.channels[-1]))  # no constant: the rest bias is one
        self.centre: Tensor
        self.scale: Tensor
        self.register_buffer("centre", torch.zeros(6))
        self.register_buffer("scale", torch.tensor([1.0, 1.0, 1.0, 10.0, 10.0, 10.0]))

    def forward(self, u: Float[Tensor, "batch n 6"]) -> Float[Tensor, "batch n 3"]:
        """N(x) in training, where the weights still change; N(x) - N(0) in inference."""
        return self._training_output(u) if self.training else self._inference_output(u)

    def _training_output(self, u: Float[Tensor, "batch n 6"]) -> Float[Tensor, "batch n 3"]:
        x = ((u - self.centre) / self.scale).mT.float()
        for layer in self.layers:
            x = layer(x)
        y: Tensor = (self.unit * (self.out.to(x) @ x)).mT.to(u)
        return y

    def _inference_output(self, u: Float[Tensor, "batch n 6"]) -> Float[Tensor, "batch n 3"]:
        x = (u / self.scale).mT
        for weight, offset, dilation in self.folded():
            y = functional.conv1d(causal(x, (weight.shape[2] - 1) * dilation), weight, offset, dilation=dilation)
            x = functional.gelu(y) - functional.gelu(offset)[:, None]
        return (self.unit * (self.out @ x)).mT

    def at_rest(self) -> Float[Tensor, "3"]:
        """N(0): output for zero rate and zero force for all time."""
        level: Tensor = self.unit * (self.out @ functional.gelu(self.folded()[-1].offset))
        return level

    def folded(self) -> list[FoldedLayer]:
        """Folded layers; the input of the first is u / scale, the deviation from zero motion."""
        x, layers = -self.centre / self.scale, []
        for layer in self.layers:
            assert isinstance(layer, Layer)
            layers.append(layer.folded(x))
            x = functional.gelu(layers[-1].offset)
        return layers


class Network(BiasNetwork):
    """Network of `imutool.bias.conv`."""

    method: ClassVar[str] = Model.method
    objective = "increments"
    prefers: ClassVar[Mapping[str, Any]] = MappingProxyType(
        {
            "steps": 500,
            "samples": 13_000,
            "gyro_rate": 1e-2,
            "accel_rate": 1e-2,
            "weight_decay": 0.1,
        }
    )
    undecayed: ClassVar[tuple[str, ...]] = ("W",)
    config: Config

    def __init__(self, config: Settings | None = None, rate_hz: float = 200.0) -> None:
        chosen = config or Config()
        assert isinstance(chosen, Config)
        Model.shapes(chosen)
        super().__init__(chosen, rate_hz)
        self.W = nn.ParameterDict({sensor: nn.Parameter(torch.zeros(3, 3)) for sensor in SENSORS})  # I - C
        self.net = nn.ModuleDict({sensor: Net(chosen, chosen.unit(sensor)) for sensor in SENSORS})
        self.context = (chosen.kernel - 1) * sum(chosen.dilations)

    def see(self, gyro: Float[Tensor, "n 3"], accel: Float[Tensor, "n 3"]) -> None:
        """Set origin and unit of each channel to its mean and standard deviation."""
        u = torch.cat([gyro, accel], dim=1)
        scale = torch.maximum(u.std(0), u.new_tensor(MIN_SCALE))
        for sensor in SENSORS:
            net = self._net(sensor)
            net.centre.copy_(u.mean(0))
            net.scale.copy_(scale)

    def rest_at_work(self, sensor: Sensor, rest: Float[Tensor, "*logs 3"]) -> Float[Tensor, "*logs 3"]:
        """Rest biases minus N(0), which only inference subtracts from the network."""
        return rest - self._net(sensor).at_rest().detach()

    def motion_bias(self, sensor: Sensor, segment: Segment) -> Float[Tensor, "batch n 3"]:
        """W u - N at each sample."""
        W: Tensor = self.W[sensor]
        correction: Tensor = self._net(sensor)(torch.cat([segment.gyro, segment.accel], dim=-1))
        return segment.of(sensor)[0] @ W.mT - correction

    def begin_at(self, sensor: Sensor, W: Float[Tensor, "3 3"]) -> None:
        """Set the matrix W; with `start="identity"` do nothing."""
        if self.config.start == "closed_form":
            with torch.no_grad():
                self.W[sensor].copy_(W)

    def _net(self, sensor: Sensor) -> Net:
        net = self.net[sensor]
        assert isinstance(net, Net)
        return net


def causal(x: Float[Tensor, "batch channels n"], reach: int) -> Float[Tensor, "batch channels m"]:
    """Pad on the left with the first sample; equals padding the input of the first layer.

    A constant input before the first sample gives a constant output of every layer.
    """
    return functional.pad(x, (reach, 0), mode="replicate") if reach else x
