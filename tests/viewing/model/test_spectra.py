"""Spectra are densities: white noise is as high as its density says, a line is where it is and holds its power."""

from __future__ import annotations

import numpy as np
import pytest

from imutool.recording import Imu
from imutool.viewing.model.run_data import MIN_SAMPLES, spectra

RATE_HZ, COUNT = 200.0, 40_000
SCATTER = 0.1  # of a mean over 800 frequencies of 49 half-overlapping windows: a hundredth, with margin


def sampled(gyro: np.ndarray) -> Imu:
    t_ns = np.arange(len(gyro), dtype=np.int64) * 5_000_000 + 1_700_000_000_000_000_000
    return Imu(t_ns, gyro, np.tile([0.0, 0.0, 9.81], (len(gyro), 1)))


def test_white_noise_has_its_density_at_all_frequencies() -> None:
    density = 1e-3  # rad/s/sqrt(Hz)
    noise = np.random.default_rng(1).normal(size=(COUNT, 3)) * density * np.sqrt(RATE_HZ / 2)
    found = spectra(sampled(noise))["gyro"]
    assert found.frequency_hz[0] == pytest.approx(0.125)
    assert found.frequency_hz[-1] == pytest.approx(RATE_HZ / 2)
    assert found.density.shape == (len(found.frequency_hz), 3)
    np.testing.assert_allclose(np.sqrt(found.density.mean(axis=0)), density, rtol=SCATTER)


def test_a_vibration_is_found_on_its_axis_with_its_power_and_a_constant_nowhere() -> None:
    t = np.arange(COUNT) / RATE_HZ
    gyro = np.zeros((COUNT, 3))
    gyro[:, 1] = 0.3 * np.sin(2 * np.pi * 37.0 * t) + 5.0
    found = spectra(sampled(gyro))
    line = found["gyro"]
    assert line.frequency_hz[line.density[:, 1].argmax()] == pytest.approx(37.0, abs=0.125)
    power = line.density[:, 1].sum() * np.diff(line.frequency_hz).mean()
    assert power == pytest.approx(0.3**2 / 2, rel=1e-3)
    assert line.density[:, [0, 2]].max() < 1e-20
    assert found["accel"].density.max() < 1e-20


def test_a_log_too_short_has_no_spectrum() -> None:
    assert not spectra(sampled(np.zeros((MIN_SAMPLES - 1, 3))))
    assert set(spectra(sampled(np.zeros((MIN_SAMPLES, 3))))) == {"gyro", "accel"}
