"""The colour of a noise: drawn again it has the spectrum of the recorded one, and follows the motion as that did."""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Float64
from scipy.signal import lfilter, welch

from imutool.config import build
from imutool.noise.colour import Colour, measured

RATE_HZ, SECONDS, SLOW, WHITE = 200.0, 300, 0.95, 0.02  # pole of the noise, and the steady white noise under it


PERIOD_S = 20.0  # of the motion's size


def _made(rng: np.random.Generator) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, "n 6"], Float64[np.ndarray, "n 6"]]:
    """Time, a motion whose size swells and ebbs tenfold, and slow noise that does so with it."""
    n = int(RATE_HZ * SECONDS)
    t_s = np.arange(n) / RATE_HZ
    size = 10.0 ** (0.5 * np.sin(2.0 * np.pi * t_s / PERIOD_S) - 0.5)[:, None]
    motion = size * np.sin(2.0 * np.pi * 0.7 * t_s[:, None] + np.arange(6))
    slow = lfilter([np.sqrt(1.0 - SLOW**2)], [1.0, -SLOW], rng.normal(size=(n, 6)), axis=0)
    return t_s, motion, size * slow + WHITE * rng.normal(size=(n, 6))


def test_noise_drawn_along_another_motion_has_the_spectrum_and_follows_the_motion() -> None:
    t_s, motion, noise = _made(np.random.default_rng(0))
    std = noise.std(axis=0)
    colour = measured([(t_s, motion + noise, motion)], std, RATE_HZ)
    assert colour is not None
    assert build(Colour, msgspec.to_builtins(colour)) == colour
    other_t_s, other_motion, other = _made(np.random.default_rng(1))
    drawn = colour.drawn(other_t_s, other_motion, np.random.default_rng(2)) * std
    np.testing.assert_allclose(drawn.std(axis=0), other.std(axis=0), rtol=0.15)
    phase = np.sin(2.0 * np.pi * other_t_s / PERIOD_S)
    for rows in (phase < -0.8, phase > 0.8):  # where it hardly moves, and where it moves most
        for k in (0, 5):
            (_, planted), (_, made) = (welch(x[rows, k], RATE_HZ, nperseg=128) for x in (other, drawn))
            np.testing.assert_allclose(np.log(made[2:]), np.log(planted[2:]), atol=0.7)


def test_noise_of_the_expected_signal_itself_is_not_drawn_once_more() -> None:
    """A smoothed motion that errs is nearly as strong as the recorded one; noise on top of it would be too much."""
    rng = np.random.default_rng(3)
    t_s, motion, _ = _made(rng)
    error = 0.5 * rng.normal(size=motion.shape)
    recorded = motion + 0.1 * rng.normal(size=motion.shape)
    left = recorded - motion - error
    std = left.std(axis=0)
    colour = measured([(t_s, recorded, motion + error)], std, RATE_HZ)
    assert colour is not None
    drawn = colour.drawn(t_s, motion + error, rng) * std
    assert np.all(drawn.std(axis=0) < 0.3 * std)


def test_the_range_of_each_sensor_is_that_of_its_own_noise() -> None:
    t_s, motion, swelling = _made(np.random.default_rng(5))
    noise = np.hstack([np.random.default_rng(6).normal(size=(len(t_s), 3)), swelling[:, 3:]])
    colour = measured([(t_s, motion + noise, motion)], noise.std(axis=0), RATE_HZ)
    assert colour is not None
    (low, high), (accel_low, accel_high) = colour.gyro_range, colour.accel_range
    assert 0.9 < low < 1.0 < high < 1.1  # white noise
    assert accel_low < 0.5
    assert accel_high > 1.5


def test_a_recording_of_seconds_has_no_colour_and_a_colour_belongs_to_its_rate() -> None:
    t_s, motion, noise = _made(np.random.default_rng(0))
    few = slice(0, int(8.0 * RATE_HZ))
    assert measured([(t_s[few], motion[few] + noise[few], motion[few])], noise.std(axis=0), RATE_HZ) is None
    colour = measured([(t_s, motion + noise, motion)], noise.std(axis=0), RATE_HZ)
    assert colour is not None
    assert colour.holds_at(200.5)
    assert not colour.holds_at(100.0)


def test_noise_of_which_the_expected_signal_has_a_part_is_drawn_without_that_part() -> None:
    rng = np.random.default_rng(4)
    t_s, motion, _ = _made(rng)
    recorded, expected = (motion + std * rng.normal(size=motion.shape) for std in (0.5, 0.3))
    std = (recorded - expected).std(axis=0)
    colour = measured([(t_s, recorded, expected)], std, RATE_HZ)
    assert colour is not None
    drawn = colour.drawn(t_s, expected, rng) * std
    np.testing.assert_allclose(drawn.std(axis=0), np.sqrt(0.5**2 - 0.3**2), rtol=0.1)
