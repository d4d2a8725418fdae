"""Samples of a fast motion are read between them as the sampling theorem says; those of a slow one stay as they are."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

from imutool.inertial.resampling import AS_GOOD, refined

RATE_HZ, NOISE, COUNT = 200.0, np.array([0.01, 0.01]), 400
MAX = AS_GOOD * NOISE[0] / np.sqrt(COUNT)


def motion(t_s: np.ndarray, fast_hz: float) -> np.ndarray:
    """A burst in the middle, and a slow swing on a slope."""
    burst = np.exp(-(((t_s - 5.0) / 0.5) ** 2)) * np.sin(2.0 * np.pi * fast_hz * t_s)
    return np.stack([burst, np.sin(2.0 * np.pi * 1.5 * t_s) + t_s], axis=1)


@pytest.mark.parametrize("fast_hz", [60.0, 80.0])
def test_a_spline_through_refined_samples_is_the_motion(fast_hz: float) -> None:
    t_s, between_s = np.arange(2000) / RATE_HZ, np.arange(1000.3, 9000.0) / 1000.0
    x, truth = motion(t_s, fast_hz), motion(between_s, fast_hz)
    finer = refined(x, NOISE, COUNT)
    grid_s = np.linspace(t_s[0], t_s[-1], len(finer))
    off, plain = (make_interp_spline(at_s, y, k=3)(between_s) - truth for at_s, y in ((grid_s, finer), (t_s, x)))
    assert np.sqrt((off**2).mean(axis=0)).max() < MAX
    assert np.sqrt((plain[:, 0] ** 2).mean()) > MAX  # so that something was to be done
    every = (len(finer) - 1) // (len(x) - 1)
    assert finer[::every] == pytest.approx(x, abs=1e-9)


def test_samples_that_a_spline_follows_stay() -> None:
    x = motion(np.arange(2000) / RATE_HZ, 5.0)
    assert refined(x, NOISE, COUNT) is x
