"""A short made-up flight, read raw and by two made-up models."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from support.outlines import in_full, in_outline

from imutool.recording import Imu, Recording
from imutool.sensor.made_up_flight import ACCEL_BIAS, GYRO_BIAS, flight
from imutool.viewing.model.load_view import build
from imutool.viewing.model.run_data import Run, RunData


@pytest.fixture(scope="module", autouse=True)
def drawings() -> Iterator[None]:
    """Every drawing in full: these tests look at them."""
    with in_full():
        yield


@pytest.fixture
def words_alone() -> Iterator[None]:
    """Drawings in outline, for a test of what a page says."""
    with in_outline():
        yield


@pytest.fixture(scope="session")
def recording() -> Recording:
    return flight(3, duration_s=8.0)


def subtract(recording: Recording, name: str, gyro_bias: np.ndarray, accel_bias: np.ndarray) -> Run:
    imu = recording.imu
    return Run(name, Imu(imu.t_ns, imu.gyro - gyro_bias, imu.accel - accel_bias), gyro_bias, accel_bias)


@pytest.fixture(scope="session")
def runs(recording: Recording) -> list[Run]:
    gyro_bias, accel_bias = (recording.scalars[topic].values for topic in (GYRO_BIAS, ACCEL_BIAS))
    first = np.broadcast_to(gyro_bias[0], gyro_bias.shape), np.broadcast_to(accel_bias[0], accel_bias.shape)
    return [
        Run.raw(recording.imu),
        subtract(recording, "static", *(np.ascontiguousarray(bias) for bias in first)),
        subtract(recording, "my model/v1", gyro_bias, accel_bias),  # a name that no path may trip over
    ]


@pytest.fixture(scope="session")
def data(recording: Recording, runs: list[Run]) -> RunData:
    return build(recording, runs)
