"""Convolutional bias model: a matrix, and dilated causal convolutions over 2.5 s of samples.

Brossard, Bonnabel and Barrau correct a gyro by omega_hat = C omega + net(last samples of gyro and accel); here, as a bias::

    b_k = rest + (I - C) u_k - (N(x_{k-510..k}) - N(0))

with x all six measured channels in units of their spread in the training data. N is four convolutions of kernel 7 and
dilations 1, 4, 16, 64, each with batch norm, GELU and dropout, and a linear layer. The accelerometer has its own network
of the same form, on the same six channels. N(0) is the output for zero rate and zero force for all time. It is subtracted so
that a model without motion adds nothing to the rest bias; as a constant, it is part of the rest bias of every run.

Before the first sample of a log the input is that sample (replicate padding, as in the original). The network counts samples
and ignores their stamps: it does not see gaps, and a model belongs to one rate. Batch norm is folded into the convolutions.
The original is for the gyro only and has no rest bias per run. It starts C at the identity; here C starts from the closed
form, unless `start` says `identity`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal, NamedTuple

import msgspec
import numpy as np

from imutool.array_types import Float64, Rows6, Vectors
from imutool.bias.model import Array, BiasModel, Shapes, Stream, Vector6, matrices
from imutool.bias.neural_stream import gelu
from imutool.config import Settings
from imutool.errors import ConfigError
from imutool.units import COLUMNS, SENSORS, Sensor

Positive = Annotated[float, msgspec.Meta(ge=1e-9, le=1e9)]
Channels = Annotated[tuple[Annotated[int, msgspec.Meta(ge=1, le=512)], ...], msgspec.Meta(min_length=1, max_length=8)]
Dilations = Annotated[tuple[Annotated[int, msgspec.Meta(ge=1, le=1024)], ...], msgspec.Meta(min_length=1, max_length=8)]

EPSILON = 1e-5  # under the root of a variance
BLOCK = 2048  # samples that a stream convolves at once: bounds its memory


class Config(Settings, frozen=True):
    """Sizes and output units of the networks.

    One channel count and one dilation (samples) per layer.
    """

    channels: Channels = (16, 32, 64, 128)  # of each layer
    dilations: Dilations = (1, 4, 16, 64)  # of each layer, in samples
    kernel: Annotated[int, msgspec.Meta(ge=1, le=16)] = 7  # samples of a convolution
    dropout: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.1  # share of the outputs that a training step leaves out
    start: Literal["closed_form", "identity"] = "closed_form"  # of C; the original begins at the identity
    gyro_unit_rad_s: Positive = 0.02  # unit of the network's output for the gyro
    accel_unit_m_s2: Positive = 0.2  # the same for the accelerometer

    def unit(self, sensor: Sensor) -> float:
        """Unit of a network's output (rad/s or m/s²)."""
        return self.gyro_unit_rad_s if sensor == "gyro" else self.accel_unit_m_s2


class FoldedLayer(NamedTuple):
    """Layer with folded batch norm, for deviations from rest.

    y = GELU(weight * x + offset) - GELU(offset).
    """

    weight: Float64[np.ndarray, "after before kernel"]
    offset: Float64[np.ndarray, " after"]
    dilation: int


class Model(BiasModel):
    """Bias b = rest + (I - C) u - (N(x) - N(0)), for gyro and accel separately.

    Source: Brossard, Bonnabel and Barrau, "Denoising IMU Gyroscopes with Deep Learning for Open-Loop Attitude Estimation",
    RA-L 2020, arXiv:2002.10718, eq. 5 to 9 and fig. 2.
    """

    method: ClassVar[str] = "conv"
    config: Config
    counts_samples = True

    @classmethod
    def shapes(cls, config: Settings) -> Shapes:
        """Shapes of the statistics, of I - C and of the networks.

        Raises:
            ConfigError: not one channel count and one dilation per layer.
        """
        assert isinstance(config, Config)
        if len(config.channels) != len(config.dilations):
            raise ConfigError(
                f"{len(config.channels)} channels and {len(config.dilations)} dilations",
                where="model.channels",
                expected="one of each per layer",
            )
        shapes = super().shapes(config) | matrices()
        for sensor in SENSORS:
            net = f"net.{sensor}"
            shapes |= {f"{net}.out": (3, config.channels[-1]), f"{net}.centre": (6,), f"{net}.scale": (6,)}
            for k, (before, after) in enumerate(zip((6, *config.channels), config.channels, strict=False)):
                shapes[f"{net}.layers.{k}.weight"] = (after, before, config.kernel)
                shapes |= {f"{net}.layers.{k}.{name}": (after,) for name in ("gain", "shift", "mean", "var")}
        return shapes

    def folded(self, sensor: Sensor) -> list[FoldedLayer]:
        """Folded layers; the input of the first is u / scale, the deviation from zero motion."""
        net = f"net.{sensor}"
        x, layers = -self.tensors[f"{net}.centre"] / self.tensors[f"{net}.scale"], []
        for k, dilation in enumerate(self.config.dilations):
            weight, gain, shift, mean, var = (
                self.tensors[f"{net}.layers.{k}.{name}"] for name in ("weight", "gain", "shift", "mean", "var")
            )
            gain = gain / np.sqrt(var + EPSILON)
            weight = weight * gain[:, None, None]
            layers.append(FoldedLayer(weight, weight.sum(2) @ x + shift - mean * gain, dilation))
            x = gelu(layers[-1].offset)
        return layers

    def stretch(self, rest: Vector6, start_s: float = math.nan) -> Stream:
        """Bias stream; each layer keeps the inputs that its convolution reaches."""
        return _Stream(self, rest)


class _Stream:
    """Bias stream of both networks."""

    def __init__(self, model: Model, rest: Vector6) -> None:
        self.rest, tensors = rest.astype(np.float64), model.tensors
        self.W: Mapping[Sensor, Array] = {sensor: tensors[f"W.{sensor}"].T.copy() for sensor in SENSORS}
        self.scale = {sensor: tensors[f"net.{sensor}.scale"] for sensor in SENSORS}
        self.layers = {sensor: [_Convolution(layer) for layer in model.folded(sensor)] for sensor in SENSORS}
        self.out = {sensor: model.config.unit(sensor) * tensors[f"net.{sensor}.out"].T for sensor in SENSORS}

    def __call__(self, t_s: Float64[np.ndarray, " n"], gyro: Vectors, accel: Vectors) -> Rows6:
        u = np.concatenate([gyro, accel], axis=1)
        bias: Rows6 = np.empty_like(u)
        for start in range(0, len(u), BLOCK):
            rows = slice(start, start + BLOCK)
            for sensor in SENSORS:
                columns = COLUMNS[sensor]
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
        self.weight = folded.weight.transpose(2, 1, 0).reshape(self.kernel * channels, out).copy()
        self.offset, self.level = folded.offset, gelu(folded.offset)
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
        y: Array = gelu(taps.reshape(n, -1) @ self.weight + self.offset) - self.level
        return y
