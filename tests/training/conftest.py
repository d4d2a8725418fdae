"""Small flights, with or without errors, and one thread for small tensors."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
from support.small_tensors import one_thread  # noqa: F401  (a fixture)

from imutool.recording import Imu, Poses, Recording
from imutool.sensor.made_up_flight import FlightSettings as Flight
from imutool.sensor.made_up_flight import TriadSettings, flight, trajectory

PERFECT = TriadSettings(
    noise_density=0.0, walk_density=0.0, typical_bias=0.0, turn_on_bias=0.0, warm_up=0.0, scale=0.0, misalignment_rad=0.0
)


@pytest.fixture(scope="module")
def one_start() -> Iterator[None]:
    """Left-out logs are scored from one start of three: finding starts is most of a small training, and proved elsewhere."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("imutool.training.log_scores.STARTS", ("truth",))
        yield


@pytest.fixture(scope="module", autouse=True)
def short_hour() -> Iterator[None]:
    """A drift is looked at for five minutes: an hour is most of a small training, and test_fit.py has whole ones."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("imutool.training.held_out.HOUR_S", 300.0)
        yield


def _perfect(seed: int, **changes: Any) -> Recording:
    """Exact samples of an exact motion, and the exact truth at the samples' own stamps."""
    settings = msgspec.convert(
        msgspec.to_builtins(Flight(gyro=PERFECT, accel=PERFECT, truth_noise_m=0.0, truth_noise_rad=0.0)) | changes, Flight
    )
    made = flight(seed, settings)
    exact = trajectory(seed, settings).poses(made.imu.t_ns)
    return Recording(f"exact_{seed}", made.imu, {"/ground_truth/pose": exact})


def _planted(
    recording: Recording, W: dict[str, np.ndarray], rest: dict[str, np.ndarray], noise: float = 0.0, seed: int = 0
) -> Recording:
    """A sensor whose true value is (I - W) u - rest for what it measures, u: the linear model's own error."""
    rng = np.random.default_rng(seed)
    measured = {}
    for sensor in ("gyro", "accel"):
        true = getattr(recording.imu, sensor)
        u = np.linalg.solve(np.eye(3) - W[sensor], (true + rest[sensor]).T).T
        measured[sensor] = u + noise * rng.normal(size=u.shape)
    return Recording(recording.name, Imu(recording.imu.t_ns, measured["gyro"], measured["accel"]), recording.truths)


def _without_truth(recording: Recording, start_s: float, end_s: float) -> Recording:
    """A hole in the truth, in seconds from the first sample."""
    begin = int(recording.imu.t_ns[0])
    truth = recording.truth
    t_s = (truth.t_ns - begin) * 1e-9
    kept: Poses = truth.rows((t_s <= start_s) | (t_s >= end_s))
    return Recording(recording.name, recording.imu, {"/ground_truth/pose": kept})


@pytest.fixture(scope="session")
def perfect() -> Callable[..., Recording]:
    """`perfect(seed, **flight settings)`."""
    return _perfect


@pytest.fixture(scope="session")
def planted() -> Callable[..., Recording]:
    """`planted(recording, W, rest, noise=0.0)`."""
    return _planted


@pytest.fixture(scope="session")
def without_truth() -> Callable[..., Recording]:
    """`without_truth(recording, start_s, end_s)`."""
    return _without_truth
