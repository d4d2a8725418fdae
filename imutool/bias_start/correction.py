"""Correct IMU samples with a bias model: all in memory, or one at a time.

Causal: after the initial bias, the bias at a sample depends on that sample and earlier ones.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from imutool.bias.model import BiasModel, SampleStream, Stream, Vector6
from imutool.bias_start.bias_covariance import BiasEstimator
from imutool.bias_start.initial_bias import InitialBias, tracked_from_prior
from imutool.recording import Imu, seconds

BLOCK_SAMPLES = 1 << 14  # corrected at once: a covariance has 288 bytes


class DebiasedImu(NamedTuple):
    """Corrected samples and the subtracted bias: gyro (rad/s), then accel (m/s²)."""

    imu: Imu
    bias: Float64[np.ndarray, "n 6"]


def apply(model: BiasModel, start: InitialBias, imu: Imu) -> DebiasedImu:
    """Corrected samples and bias of a model."""
    bias = start.stream(model)(seconds(imu.t_ns, int(imu.t_ns[0])), imu.gyro, imu.accel)
    return DebiasedImu(Imu(imu.t_ns, imu.gyro - bias[:, :3], imu.accel - bias[:, 3:]), bias)


def apply_with_std(model: BiasModel, start: InitialBias, imu: Imu) -> tuple[DebiasedImu, Float64[np.ndarray, "n 6"]]:
    """Corrected samples as `apply`, and the standard deviation of the bias at each sample.

    Gyro (rad/s), then accel (m/s²); see `imutool.bias_start.bias_covariance`. Computed in blocks, as for a log.
    """
    estimator = BiasEstimator(model, start)
    t_s = seconds(imu.t_ns, int(imu.t_ns[0]))
    bias, std = np.empty((len(imu), 6)), np.empty((len(imu), 6))
    for first in range(0, len(imu), BLOCK_SAMPLES):
        rows = slice(first, first + BLOCK_SAMPLES)
        bias[rows], covariance = estimator(t_s[rows], imu.gyro[rows], imu.accel[rows])
        std[rows] = np.sqrt(covariance.diagonal(axis1=1, axis2=2))
    return DebiasedImu(Imu(imu.t_ns, imu.gyro - bias[:, :3], imu.accel - bias[:, 3:]), bias), std


class OnlineDebiaser:
    """Corrects IMU samples one at a time, for a live node.

    `start` is a rest bias, for instance `bias_at_rest.at_rest` over the first seconds, or `initial_bias.prior`. Without `start`
    it begins at the prior and tracks the rest bias, as `init="auto"` does.
    """

    def __init__(self, model: BiasModel, start: InitialBias | None = None) -> None:
        self._model, self._start, self._start_ns = model, start, -1

    def __call__(
        self, stamp_ns: int, gyro: Float64[np.ndarray, "3"], accel: Float64[np.ndarray, "3"]
    ) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"], Float64[np.ndarray, "6"]]:
        """Corrected angular rate (rad/s), specific force (m/s²), and the subtracted bias."""
        if self._start_ns < 0:
            self._start_ns = stamp_ns
            stream = (self._start or tracked_from_prior(self._model, stamp_ns)).stream(self._model)
            self._correct = stream.one if isinstance(stream, SampleStream) else _by_blocks(stream)
        u = np.concatenate((gyro, accel))
        bias = self._correct((stamp_ns - self._start_ns) * 1e-9, u)
        clean = u - bias
        return clean[:3], clean[3:], bias


def _by_blocks(stream: Stream) -> Callable[[float, Vector6], Vector6]:
    """Corrects one sample as a block, for a stream without a path for single samples."""

    def correct(t_s: float, u: Vector6) -> Vector6:
        bias: Vector6 = stream(np.array([t_s]), u[None, :3], u[None, 3:])[0]
        return bias

    return correct
