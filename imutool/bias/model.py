"""What every bias model is: a causal map from measured samples and a rest bias to the bias at each sample.

The *rest bias* is what differs from run to run (the turn-on bias): the state the dynamics start from. What the motion adds
(scale, misalignment, curvature) belongs to the sensor. Models add the two, `bias = rest + ...`, so an error of the start is
the same error at every sample, which is what lets `imutool.bias_start.initial_bias` solve for it with any model.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor, nn

from imutool.config import Settings
from imutool.inertial.windows import end_attitude
from imutool.units import SENSORS, Sensor

COLUMNS = {"gyro": slice(0, 3), "accel": slice(3, 6)}  # of every vector of six

Vector6 = Float64[np.ndarray, "6"]  # gyro (rad/s) then accel (m/s²)
Covariances = Float64[np.ndarray, "n 6 6"]


@dataclass(frozen=True)
class Segment:
    """Samples a model is shown: `t` in seconds from the segment's first sample, and the bias it starts from."""

    t: Float[Tensor, "batch n"]
    gyro: Float[Tensor, "batch n 3"]
    accel: Float[Tensor, "batch n 3"]
    rest: Float[Tensor, "batch 6"]

    def of(self, sensor: Sensor) -> tuple[Float[Tensor, "batch n 3"], Float[Tensor, "batch 3"]]:
        """Samples and rest bias of one sensor."""
        return (self.gyro if sensor == "gyro" else self.accel), self.rest[:, COLUMNS[sensor]]


@runtime_checkable
class Stream(Protocol):
    """A model at work on samples as they arrive, in blocks of any size; it keeps what it must remember between them."""

    def __call__(
        self, t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, "n 6"]:
        """The bias at each sample, from this and earlier samples only; the blocks' borders change nothing."""


class BiasEstimate(NamedTuple):
    """A bias at each sample, gyro (rad/s) then accel (m/s²), and its covariance."""

    bias: Float64[np.ndarray, "n 6"]
    covariance: Covariances


@runtime_checkable
class RestBiasEstimator(Protocol):
    """A model at work with the covariance of its rest bias, for samples as they arrive in blocks of any size."""

    def estimate(
        self, t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
    ) -> BiasEstimate:
        """The bias at each sample, and the covariance of the rest bias in it."""


@runtime_checkable
class SampleStream(Stream, Protocol):
    """A stream with a shorter way for a single sample, for live use: half of such a call is cutting and joining arrays."""

    def one(self, t_s: float, u: Vector6) -> Vector6:
        """The bias at one sample (gyro, then accel): what a block of it alone would give. The array is the caller's."""


@runtime_checkable
class CovarianceModel(Protocol):
    """Roots S of the covariance S S^T of what the motion adds, for samples as they arrive, by sensor.

    The columns of S are the same unknowns at every sample: a mean over samples has the mean of S.
    """

    def __call__(
        self, t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
    ) -> Mapping[Sensor, Float64[np.ndarray, "n 3 p"]]:
        """One matrix a sample, from it and earlier ones; nothing for a sensor that nothing is known of."""


class BiasModel(nn.Module, ABC):
    """A bias model, with the statistics of its sensor's training runs that every start needs.

    At work in float64 (`imutool.bias.io.load`, `imutool.training.fit`); at rest, in a file, in float32.

    Attributes:
        prior_mean, prior_std: rest bias over the training runs, and its spread from run to run.
        truth_std: spread of a rest bias estimated from `imutool.bias_start.bias_from_truth.TRUTH_S` seconds of this data's own
            truth.
        rest_std: how far the bias at rest lies from that in motion.
        walk_std: how far a rest bias walks in a second^1/2.
        noise_std: white noise of a sample, as seen in the residuals, for the debiased message's covariance.
    """

    method: ClassVar[str]
    iterative: ClassVar[bool] = True  # false where the closed form leaves nothing to descend on
    objective: ClassVar[Literal["window_ends", "increments"]] = "window_ends"  # what the descent minimises (imutool.training)
    prefers: ClassVar[Mapping[str, Any]] = MappingProxyType({})  # TrainSettings that differ from the general defaults
    undecayed: ClassVar[tuple[str, ...]] = ()  # beginnings of the names of parameters that weight decay leaves alone
    longest_window_s: float = math.inf  # of the training: a longer one is cut to it
    context: int = 0  # samples from before a segment that the answer over it depends on; such a bias is rest + f(samples)
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
        for name in ("prior_mean", "prior_std", "truth_std", "rest_std", "walk_std", "noise_std"):
            self.register_buffer(name, torch.zeros(6))

    def see(self, gyro: Float[Tensor, "n 3"], accel: Float[Tensor, "n 3"]) -> None:
        """Shown every sample of the training part once, before the first step: the place to find the inputs' scales."""

    def rest_at_work(self, sensor: Sensor, rest: Float[Tensor, "*logs 3"]) -> Float[Tensor, "*logs 3"]:
        """Rest biases found beside the model in training mode, as they must be beside it at work: the same for most."""
        return rest

    @abstractmethod
    def sensor_bias(self, sensor: Sensor, segment: Segment) -> Float[Tensor, "batch n 3"]:
        """The bias of one sensor at each sample; row k depends on samples up to k. Differentiable.

        The two sensors are apart because training is: the gyro first, then the accelerometer on top of it.
        """

    def forward(self, segment: Segment) -> Float[Tensor, "batch n 6"]:
        """The bias at each sample: gyro (rad/s), then accel (m/s²)."""
        return torch.cat([self.sensor_bias(sensor, segment) for sensor in SENSORS], dim=-1)

    def end_attitude(
        self, R_start: Float[Tensor, "batch 3 3"], segment: Segment, dt: Float[Tensor, "batch steps"]
    ) -> Float[Tensor, "batch 3 3"]:
        """Attitude (body to world) at the last sample, by integrating the debiased rate from `R_start`. Differentiable."""
        return end_attitude(R_start, segment.gyro - self.sensor_bias("gyro", segment), dt)

    def rest_dynamics(self) -> Float64[np.ndarray, "6 6"]:
        """d(drift of the rest bias) / d(rest bias), a second: how an error of the start grows or dies. Zero for most."""
        return np.zeros((6, 6))

    def calibration_covariance(self) -> CovarianceModel | None:
        """What is left open of the motion-dependent part, for each sample as a root; none where it is not known."""
        return None

    @abstractmethod
    def begin_at(self, sensor: Sensor, W: Float[Tensor, "3 3"]) -> None:
        """Takes over a calibration solved in closed form, as the point the training starts from."""

    @abstractmethod
    def stream(self, rest: Vector6) -> Stream:
        """The same map in numpy, from a start on, for logs of any length and for live use; equals `forward` to 1e-6."""
