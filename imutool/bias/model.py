"""Bias model: a causal map from measured samples and a rest bias to the bias at each sample.

The *rest bias* differs from run to run (the turn-on bias); the dynamics start from it. The part that the motion adds (scale,
misalignment, curvature) belongs to the sensor. Models add the two, `bias = rest + ...`: an error of the rest bias is the same
error at every sample, so `imutool.bias_start.initial_bias` can solve for it with any model.
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

COLUMNS = {"gyro": slice(0, 3), "accel": slice(3, 6)}  # of a vector of six

Vector6 = Float64[np.ndarray, "6"]  # gyro (rad/s) then accel (m/s²)
Covariances = Float64[np.ndarray, "n 6 6"]


@dataclass(frozen=True)
class Segment:
    """Samples of a segment.

    `t` in seconds from its first sample, and the rest bias at its start.
    """

    t: Float[Tensor, "batch n"]
    gyro: Float[Tensor, "batch n 3"]
    accel: Float[Tensor, "batch n 3"]
    rest: Float[Tensor, "batch 6"]

    def of(self, sensor: Sensor) -> tuple[Float[Tensor, "batch n 3"], Float[Tensor, "batch 3"]]:
        """Samples and rest bias of one sensor."""
        return (self.gyro if sensor == "gyro" else self.accel), self.rest[:, COLUMNS[sensor]]


@runtime_checkable
class Stream(Protocol):
    """Bias stream of a model.

    Samples arrive in blocks of any size, and the stream keeps its state between them.
    """

    def __call__(
        self, t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, "n 6"]:
        """Bias at each sample from this and earlier samples only; block borders change nothing."""


class BiasEstimate(NamedTuple):
    """Bias at each sample, gyro (rad/s) then accel (m/s²), and its covariance."""

    bias: Float64[np.ndarray, "n 6"]
    covariance: Covariances


@runtime_checkable
class RestBiasEstimator(Protocol):
    """Bias stream with the covariance of the rest bias, for blocks of any size."""

    def estimate(
        self, t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
    ) -> BiasEstimate:
        """Bias at each sample, and the covariance of its rest bias."""


@runtime_checkable
class SampleStream(Stream, Protocol):
    """Bias stream with a fast path for one sample.

    A block call spends half its time on slicing arrays.
    """

    def one(self, t_s: float, u: Vector6) -> Vector6:
        """Bias at one sample (gyro, then accel), as a block of this sample gives; the caller owns the array."""


@runtime_checkable
class CovarianceModel(Protocol):
    """Roots S of the covariance S S^T of the motion-dependent bias, by sensor.

    It takes a stream of samples.

    The columns of S belong to the same unknowns at every sample: the covariance root of a mean is the mean of S.
    """

    def __call__(
        self, t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
    ) -> Mapping[Sensor, Float64[np.ndarray, "n 3 p"]]:
        """Roots at each sample, from it and earlier ones; no entry for a sensor without covariance."""


class BiasModel(nn.Module, ABC):
    """Bias model with the statistics of its sensor's training runs, from which every run starts.

    It computes in float64 (`imutool.bias.io.load`, `imutool.training.fit`); files hold float32.

    Attributes:
        prior_mean, prior_std: rest bias over the training runs, and its spread from run to run.
        truth_std: spread of a rest bias estimated from `imutool.bias_start.bias_from_truth.TRUTH_S` seconds of truth.
        rest_std: spread of the bias at rest minus the bias in motion.
        walk_std: random walk of the rest bias per second^1/2.
        noise_std: white noise of a sample from the residuals, for the covariance of the debiased message.
    """

    method: ClassVar[str]
    iterative: ClassVar[bool] = True  # false where the closed form is the whole solution
    objective: ClassVar[Literal["window_ends", "increments"]] = "window_ends"  # loss of the training (imutool.training)
    prefers: ClassVar[Mapping[str, Any]] = MappingProxyType({})  # TrainSettings that differ from the general defaults
    undecayed: ClassVar[tuple[str, ...]] = ()  # name prefixes of parameters without weight decay
    longest_window_s: float = math.inf  # upper limit for the training
    context: int = 0  # samples before a segment that its bias depends on; such a bias is rest + f(samples)
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
        """Set the scales of the inputs from all training samples, before the first step."""

    def rest_at_work(self, sensor: Sensor, rest: Float[Tensor, "*logs 3"]) -> Float[Tensor, "*logs 3"]:
        """Rest biases for inference from those of training mode; equal for most models."""
        return rest

    @abstractmethod
    def sensor_bias(self, sensor: Sensor, segment: Segment) -> Float[Tensor, "batch n 3"]:
        """Bias of one sensor at each sample; row k depends on samples up to k. Differentiable.

        The sensors are separate because the training is: first the gyro, then the accelerometer with the trained gyro.
        """

    def forward(self, segment: Segment) -> Float[Tensor, "batch n 6"]:
        """Bias at each sample: gyro (rad/s), then accel (m/s²)."""
        return torch.cat([self.sensor_bias(sensor, segment) for sensor in SENSORS], dim=-1)

    def end_attitude(
        self, R_start: Float[Tensor, "batch 3 3"], segment: Segment, dt: Float[Tensor, "batch steps"]
    ) -> Float[Tensor, "batch 3 3"]:
        """Attitude (body to world) at the last sample, by integrating the debiased rate from `R_start`. Differentiable."""
        return end_attitude(R_start, segment.gyro - self.sensor_bias("gyro", segment), dt)

    def rest_dynamics(self) -> Float64[np.ndarray, "6 6"]:
        """Rest dynamics d(drift of the rest bias) / d(rest bias) per second; zero for most models."""
        return np.zeros((6, 6))

    def calibration_covariance(self) -> CovarianceModel | None:
        """Covariance of the motion-dependent part as a root for each sample; None if unknown."""
        return None

    @abstractmethod
    def begin_at(self, sensor: Sensor, W: Float[Tensor, "3 3"]) -> None:
        """Set the calibration matrix, solved in closed form, from which the training starts."""

    @abstractmethod
    def stream(self, rest: Vector6) -> Stream:
        """Bias stream in numpy from a rest bias, for long logs and live use; equals `forward` to 1e-6."""
