"""Two signals at every lag: a short one is found in a long one, and chance is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from imutool.inertial.correlation import cross_correlation, dependent_samples

DRAWS, LENGTH, OVERLAP = 400, 1500, 1000
WITHIN = 0.15  # of a deviation from so many draws: its own is 4 %, and the autocorrelations are estimates
NOISE = 0.1  # of the size of a signal


def coloured(rng: np.random.Generator, n: int, pole: float) -> np.ndarray:
    """First-order autoregressive noise."""
    return np.asarray(lfilter([1.0], [1.0, -pole], rng.normal(size=n + 1000))[1000:])


@pytest.mark.parametrize("pole", [0.0, 0.9, 0.98])
def test_independent_signals_correlate_as_far_as_sigma_says(pole: float) -> None:
    rng = np.random.default_rng(1)
    at = LENGTH - OVERLAP  # one lag, drawn anew
    found = [cross_correlation(coloured(rng, LENGTH, pole), coloured(rng, LENGTH, pole), 2) for _ in range(DRAWS)]
    sigma = np.array([one.sigma[one.lag == at][0] for one in found])
    assert sigma.std() == pytest.approx(1.0, abs=WITHIN + 0.25 * (pole > 0.9))
    assert abs(sigma.mean()) < 3.0 * sigma.std() / np.sqrt(DRAWS)


def test_samples_that_count_as_one_are_those_of_the_theory() -> None:
    """Of two first-order signals, (1 + p q) / (1 - p q)."""
    rng = np.random.default_rng(2)
    a, b = coloured(rng, 200_000, 0.9), coloured(rng, 200_000, 0.5)
    assert dependent_samples(a - a.mean(), b - b.mean()) == pytest.approx((1.0 + 0.45) / (1.0 - 0.45), rel=0.1)


def test_lines_count_as_few_samples_whatever_their_frequencies() -> None:
    """Of two vibrations the sum of the theory swings about zero with the length, and a negative number is none of samples."""
    t = np.arange(LENGTH) / LENGTH
    for apart in np.arange(0.0, 6.0, 0.25):  # periods in the whole length
        a, b = np.sin(2 * np.pi * 75.0 * t), np.sin(2 * np.pi * (75.0 + apart) * t + 1.0)
        assert dependent_samples(a - a.mean(), b - b.mean()) > 0.05 * LENGTH


@pytest.mark.parametrize("start", [0, 700, 2200])
def test_a_short_signal_is_found_in_a_long_one(start: int) -> None:
    rng = np.random.default_rng(3)
    long = coloured(rng, 3000, 0.9) + np.linspace(0.0, 20.0, 3000)  # its mean is that of no piece
    short = long[start : start + 800] + NOISE * rng.normal(size=800)
    found = cross_correlation(short, long, 640)
    lag, value, sigma = found.best(np.full(len(found.lag), True))
    assert lag == start
    assert value > 1.0 - NOISE
    assert sigma > 10.0


def test_overlaps_that_are_short_or_constant_say_nothing() -> None:
    found = cross_correlation(np.arange(10.0), np.zeros(20), 5)
    assert not found.value.any()
    ramp = cross_correlation(np.arange(10.0), np.arange(10.0), 8)
    assert set(ramp.lag[ramp.value != 0.0]) <= {-2, -1, 0, 1, 2}
