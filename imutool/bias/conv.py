"""Convolutional bias model: a matrix, and dilated causal convolutions over 2.5 s of samples.

Brossard, Bonnabel and Barrau correct a gyro by omega_hat = C omega + net(last samples of gyro and accel); here, as a bias::

    b_k = rest + (I - C) u_k - (N(x_{k-510..k}) - N(0))

with x all six measured channels in units of their spread in the training data. N is four convolutions of kernel 7 and
dilations 1, 4, 16, 64, each with batch norm, GELU and dropout, and a linear layer. The accelerometer has its own network
of the same form, on the same six channels. N(0) is the output for zero rate and zero force for all time. It is subtracted so
that a model without motion adds nothing to the rest bias; as a constant, it is part of the rest bias of every run.

Before the first sample of a segment or log the input is that sample (replicate padding, as in the original). The network
counts samples and ignores their stamps: it does not see gaps, and a model belongs to one rate.

Training computes in float32 (three times as fast; the weights stay float64), inference in float64 with the batch norm folded
into the convolutions. The original is for the gyro only and has no rest bias per run. It starts C at the identity; here C
starts from the closed form, unless `start` says `identity`.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor, nn
from torch.nn import functional

from imutool.bias.model import COLUMNS, BiasModel, Segment, Stream, Vector6
from imutool.config import Settings
from imutool.errors import ConfigError
from imutool.units import SENSORS, Sensor

Positive = Annotated[float, msgspec.Meta(gt=0)]
Channels = Annotated[tuple[Annotated[int, msgspec.Meta(ge=1, le=512)], ...], msgspec.Meta(min_length=1, max_length=8)]
Dilations = Annotated[tuple[Annotated[int, msgspec.Meta(ge=1, le=1024)], ...], msgspec.Meta(min_length=1, max_length=8)]
Array = Float64[np.ndarray, "..."]

EPSILON = 1e-5  # under the root of a variance; with the momentum of the running mean, batch norm's usual values
MOMENTUM = 0.1
LEAST_SCALE = (1e-2, 1e-2, 1e-2, 1e-1, 1e-1, 1e-1)  # rad/s, m/s²: limits the gain of a channel without motion
BLOCK = 2048  # samples that a stream convolves at once: bounds its memory


class Config(Settings, frozen=True):
    """Sizes and output units of the networks.

    One channel count and one dilation (samples) per layer.
    """

    channels: Channels = (16, 32, 64, 128)
    dilations: Dilations = (1, 4, 16, 64)
    kernel: Annotated[int, msgspec.Meta(ge=1, le=16)] = 7
    dropout: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.1
    start: Literal["closed_form", "identity"] = "closed_form"  # of C
    gyro_unit_rad_s: Positive = 0.02
    accel_unit_m_s2: Positive = 0.2


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
            reach = (weight.shape[2] - 1) * dilation
            y = functional.conv1d(causal(x, reach), weight, offset, dilation=dilation)
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


class Model(BiasModel):
    """Bias b = rest + (I - C) u - (N(x) - N(0)), for gyro and accel separately.

    Source: Brossard, Bonnabel and Barrau, "Denoising IMU Gyroscopes with Deep Learning for Open-Loop Attitude Estimation",
    RA-L 2020, arXiv:2002.10718, eq. 5 to 9 and fig. 2.
    """

    method: ClassVar[str] = "conv"
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
        if len(chosen.channels) != len(chosen.dilations):
            raise ConfigError(
                f"{len(chosen.channels)} channels and {len(chosen.dilations)} dilations",
                where="model.channels",
                expected="one of each per layer",
            )
        super().__init__(chosen, rate_hz)
        self.W = nn.ParameterDict({sensor: nn.Parameter(torch.zeros(3, 3)) for sensor in SENSORS})  # I - C
        self.net = nn.ModuleDict({"gyro": Net(chosen, chosen.gyro_unit_rad_s), "accel": Net(chosen, chosen.accel_unit_m_s2)})
        self.context = (chosen.kernel - 1) * sum(chosen.dilations)

    def see(self, gyro: Float[Tensor, "n 3"], accel: Float[Tensor, "n 3"]) -> None:
        """Set origin and unit of each channel to its mean and standard deviation."""
        u = torch.cat([gyro, accel], dim=1)
        scale = torch.maximum(u.std(0), u.new_tensor(LEAST_SCALE))
        for sensor in SENSORS:
            net = self._net(sensor)
            net.centre.copy_(u.mean(0))
            net.scale.copy_(scale)

    def rest_at_work(self, sensor: Sensor, rest: Float[Tensor, "*logs 3"]) -> Float[Tensor, "*logs 3"]:
        """Rest biases minus N(0), which only inference subtracts from the network."""
        return rest - self._net(sensor).at_rest().detach()

    def sensor_bias(self, sensor: Sensor, segment: Segment) -> Float[Tensor, "batch n 3"]:
        """Bias rest + W u - N at each sample."""
        u, rest = segment.of(sensor)
        W: Tensor = self.W[sensor]
        correction: Tensor = self._net(sensor)(torch.cat([segment.gyro, segment.accel], dim=-1))
        return rest[:, None] + u @ W.mT - correction

    def begin_at(self, sensor: Sensor, W: Float[Tensor, "3 3"]) -> None:
        """Set the matrix W; with `start="identity"` do nothing."""
        if self.config.start == "closed_form":
            with torch.no_grad():
                self.W[sensor].copy_(W)

    def stream(self, rest: Vector6) -> Stream:
        """Bias stream in numpy; each layer keeps the inputs that its convolution reaches."""
        return _Stream(self, rest)

    def _net(self, sensor: Sensor) -> Net:
        net = self.net[sensor]
        assert isinstance(net, Net)
        return net


def causal(x: Float[Tensor, "batch channels n"], reach: int) -> Float[Tensor, "batch channels m"]:
    """Pad on the left with the first sample; equals padding the input of the first layer.

    A constant input before the first sample gives a constant output of every layer.
    """
    return functional.pad(x, (reach, 0), mode="replicate") if reach else x


class _Stream:
    """Bias stream of both networks."""

    def __init__(self, model: Model, rest: Vector6) -> None:
        self.rest = rest.astype(np.float64)
        nets = {sensor: model._net(sensor) for sensor in SENSORS}
        self.W: dict[Sensor, Array] = {sensor: _array(model.W[sensor]).T.copy() for sensor in SENSORS}
        self.scale = {sensor: _array(net.scale) for sensor, net in nets.items()}
        self.layers = {sensor: [_Convolution(folded) for folded in net.folded()] for sensor, net in nets.items()}
        self.out: dict[Sensor, Array] = {sensor: net.unit * _array(net.out).T for sensor, net in nets.items()}

    def __call__(
        self, t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, "n 6"]:
        u = np.concatenate([gyro, accel], axis=1)
        bias: Float64[np.ndarray, "n 6"] = np.empty_like(u)
        for start in range(0, len(u), BLOCK):
            rows = slice(start, start + BLOCK)
            for sensor, columns in zip(SENSORS, COLUMNS.values(), strict=True):
                x: Array = u[rows] / self.scale[sensor]
                for layer in self.layers[sensor]:
                    x = layer(x)
                bias[rows, columns] = self.rest[columns] + u[rows, columns] @ self.W[sensor] - x @ self.out[sensor]
        return bias


class _Convolution:
    """Causal convolution of one layer on a stream.

    One buffer holds past and present inputs, so the taps of a sample are rows at equal distances. The past moves to the front
    only when the buffer is full: a single sample costs no copy.
    """

    def __init__(self, folded: FoldedLayer) -> None:
        out, channels, self.kernel = folded.weight.shape
        self.dilation, self.reach = folded.dilation, (self.kernel - 1) * folded.dilation
        self.weight = _array(folded.weight).transpose(2, 1, 0).reshape(self.kernel * channels, out).copy()
        self.offset, self.level = _array(folded.offset), _array(functional.gelu(folded.offset))
        self.buffer, self.end = np.empty((self.reach + BLOCK, channels)), -1  # -1: no sample yet

    def __call__(self, x: Array) -> Array:
        n = len(x)
        if self.end < 0:
            self.buffer[: self.reach], self.end = x[0], self.reach
        if self.end + n > len(self.buffer):
            self.buffer[: self.reach] = self.buffer[self.end - self.reach : self.end].copy()
            self.end = self.reach
        first = self.end - self.reach
        self.end += n
        self.buffer[self.end - n : self.end] = x
        row, column = self.buffer.strides
        taps = np.lib.stride_tricks.as_strided(
            self.buffer[first:], (n, self.kernel, x.shape[1]), (row, self.dilation * row, column), writeable=False
        )
        y: Array = _gelu(taps.reshape(n, -1) @ self.weight + self.offset) - self.level
        return y


def _gelu(x: Array) -> Array:
    from scipy.special import erf

    y: Array = 0.5 * x * (1.0 + erf(x * np.sqrt(0.5)))
    return y


def _array(tensor: Tensor) -> Array:
    out: Array = tensor.detach().cpu().double().numpy()
    return out
