"""A random walk of a bias: found next to white noise, not found in white noise, and taken out of it."""

from __future__ import annotations

import numpy as np
import pytest

from imutool.noise.bias_walk import walk_likelihood, without_walk

SAMPLES, EACH = 12_000, 50
CHI_SQUARE_STD = 4.0  # of eight parameters
STEPS = np.append(0.0, np.geomspace(1e-7, 1e-2, 14))  # of a sample, by its white noise


def residual(step: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(size=SAMPLES) + np.cumsum(np.sqrt(step) * rng.normal(size=SAMPLES))


def gains(x: np.ndarray, *fitted: np.ndarray) -> np.ndarray:
    """Log-likelihood of each step over none, after a constant and other columns were fitted."""
    A = np.stack([np.ones(SAMPLES), *fitted])
    left = x - np.linalg.lstsq(A.T, x)[0] @ A
    likely = walk_likelihood(left, A, np.arange(SAMPLES) // EACH, STEPS * EACH)
    assert likely is not None
    return likely.of_any_noise() - likely.of_any_noise()[0]


@pytest.mark.parametrize("step", [1e-5, 1e-4, 1e-3])
def test_a_walk_is_found_with_its_size(step: float) -> None:
    gained = gains(residual(step))
    assert gained.max() > 20.0
    assert 0.2 < STEPS[np.argmax(gained)] / step < 5.0


def test_white_noise_shows_no_walk() -> None:
    assert max(float(gains(residual(0.0, seed)).max()) for seed in range(10)) < 5.0


def test_the_variance_of_the_white_noise_is_known_and_the_first_block_has_any_number() -> None:
    x, one = residual(0.0), np.ones((1, SAMPLES))
    found, later = (walk_likelihood(2.0 * x, one, np.arange(SAMPLES) // EACH + first, STEPS * EACH) for first in (0, 777))
    assert found is not None
    assert later is not None
    assert found.white()[0] == pytest.approx(4.0, rel=0.3)  # of 240 blocks: three deviations
    assert found.within == pytest.approx(4.0, rel=0.1)
    for a, b in zip(found, later, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9)


def test_the_variance_within_short_blocks_is_that_of_their_samples() -> None:
    x = residual(0.0)
    found = walk_likelihood(x[:600], np.ones((1, 600)), np.arange(600) // 2, STEPS * 2)
    assert found is not None
    assert found.within == pytest.approx(1.0, rel=0.3)  # of 300 differences: three deviations


def test_a_walk_is_found_though_slow_effects_took_it_up() -> None:
    t = np.linspace(0.0, 1.0, SAMPLES)
    gained = gains(residual(1e-4), *(t**k for k in range(1, 6)))
    assert 0.2 < STEPS[np.argmax(gained)] / 1e-4 < 5.0


def test_slow_effects_gain_what_chance_gives_beside_a_walk() -> None:
    """The restricted likelihood gives each of them some squares more: a walk was taken for a curve of the time."""
    t, gained = np.linspace(0.0, 1.0, SAMPLES), []
    slow = np.stack([t**k for k in range(9)])
    for seed in range(20):
        x, left = residual(1e-3, seed), []
        for A in (slow[:1], slow):
            rest = x - np.linalg.lstsq(A.T, x)[0] @ A
            likely = walk_likelihood(rest, A, np.arange(SAMPLES) // EACH, STEPS * EACH)
            assert likely is not None
            left.append(float(rest @ rest) - 2.0 * float(likely.gain(1.0).max()))
        gained.append(left[0] - left[1])
    assert np.mean(gained) == pytest.approx(8.0, abs=2.0 * CHI_SQUARE_STD / len(gained) ** 0.5)


def test_what_a_fit_did_not_reach_counts_for_the_walk() -> None:
    A = np.stack([np.ones(SAMPLES), np.linspace(0.0, 1.0, SAMPLES)])
    likely = walk_likelihood(0.1 * A[1], A, np.arange(SAMPLES) // EACH, STEPS * EACH)
    assert likely is not None
    assert likely.gain(1.0)[0] == pytest.approx(0.5 * SAMPLES * 0.1**2 / 12.0, rel=1e-3)


def test_too_few_blocks_say_nothing_of_a_walk() -> None:
    assert walk_likelihood(np.ones(100), np.ones((1, 100)), np.arange(100) // 50, STEPS) is None


@pytest.mark.parametrize("step", [0.0, 1e-4, 1e-2, 1.0])
def test_noise_on_a_walk_becomes_white(step: float) -> None:
    white = without_walk(residual(step), step)[SAMPLES // 10 :]
    assert white.var() == pytest.approx(1.0, rel=0.06)
    assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 0.04
