"""Noise that is not white: what a recording of the same motion does not share goes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import butter, lfilter, sosfilt

from imutool.inertial.wiener import denoised, recorded_at, wiener_filter
from imutool.recording import Imu

RATE_HZ, DURATION_S, MOTION_HZ = 400.0, 60.0, 5.0


def motion(seed: int) -> np.ndarray:
    """Three signals of one motion."""
    t = np.arange(0.0, DURATION_S, 1.0 / RATE_HZ)
    rng = np.random.default_rng(seed)
    wave = 2.0 * np.pi * np.multiply.outer(t, rng.uniform(0.1, MOTION_HZ, (60, 3))) + rng.uniform(0.0, 2.0 * np.pi, (60, 3))
    return np.sin(wave).sum(axis=1) / np.sqrt(30.0)


def slow_noise(like: np.ndarray, cutoff_hz: float, seed: int) -> np.ndarray:
    """Noise behind a low-pass, far below the rate."""
    keep = np.exp(-2.0 * np.pi * cutoff_hz / RATE_HZ)
    white = 0.5 * np.random.default_rng([seed, 1]).normal(size=like.shape)
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], white, axis=0))


def faster(x: np.ndarray) -> float:
    """Size of what is twice as fast as the motion, away from the ends."""
    return float(
        np.sqrt((sosfilt(butter(6, 2.0 * MOTION_HZ, "high", fs=RATE_HZ, output="sos"), x, axis=0)[800:-800] ** 2).mean())
    )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("cutoff_hz", [20.0, 40.0])
def test_noise_behind_a_low_pass_goes_where_a_recording_does_not_share_it(seed: int, cutoff_hz: float) -> None:
    x = motion(seed)
    noise = slow_noise(x, cutoff_hz, seed)
    recorded = 0.95 * x + 0.1 * np.random.default_rng([seed, 2]).normal(size=x.shape)
    recorded[: round(RATE_HZ)] = np.nan  # the simulation begins before
    clean, alone = (denoised(x + noise, RATE_HZ, recorded=known)[0] for known in (recorded, None))
    assert faster(clean) < 0.1 * faster(noise) < 0.5 * faster(alone)
    inner = slice(800, -800)
    gain = (clean * x)[inner].sum(axis=0) / (clean**2)[inner].sum(axis=0)
    np.testing.assert_allclose(gain, 1.0, atol=0.02)


def test_nothing_is_taken_from_a_motion_that_has_no_noise() -> None:
    x = motion(0)
    recorded = x + 0.1 * np.random.default_rng(2).normal(size=x.shape)
    off = denoised(x, RATE_HZ, recorded=recorded)[0] - x
    assert np.sqrt((off**2).mean()) < 0.01 * np.sqrt((x**2).mean())


def test_a_recording_of_another_motion_says_nothing_of_the_noise() -> None:
    x, recorded = motion(0) + 0.1 * np.random.default_rng(3).normal(size=(24_000, 3)), motion(1)
    np.testing.assert_allclose(denoised(x, RATE_HZ, recorded=recorded)[0], wiener_filter(x, RATE_HZ), atol=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_the_noise_that_is_left_under_a_motion_is_told_with_its_density(seed: int) -> None:
    x, size = motion(seed), 0.2
    _, left = denoised(x + size * np.random.default_rng([seed, 1]).normal(size=x.shape), RATE_HZ)
    density = 2.0 * size**2 / RATE_HZ
    np.testing.assert_allclose(left.density[(left.f_hz > 1.0) & (left.f_hz < 4.0)].mean(axis=0), density, rtol=0.2)
    assert left.density[left.f_hz > 3.0 * MOTION_HZ].max() < 0.1 * density


@pytest.mark.parametrize("seed", range(20))
def test_white_noise_gets_no_colour_from_what_it_shares_by_chance(seed: int) -> None:
    x, recorded = np.random.default_rng(seed).normal(size=(2, 2_400, 6))
    assert np.array_equal(denoised(x, 100.0, recorded=recorded)[0], wiener_filter(x, 100.0))


@pytest.mark.parametrize("seed", range(3))
def test_beside_a_vibration_that_a_recording_lacks_a_motion_that_it_shares_is_kept(seed: int) -> None:
    """Interpolated between frequencies that are not shared, the noise was more than all of such a motion."""
    slow, rng = 0.02 * motion(seed), np.random.default_rng(seed)
    fast = sosfilt(butter(4, 20.0, "high", fs=RATE_HZ, output="sos"), rng.normal(size=slow.shape), axis=0)
    clean = denoised(slow + fast, RATE_HZ, recorded=slow + 1e-3 * rng.normal(size=slow.shape))[0]
    gains = (clean * slow).sum(axis=0) / (slow**2).sum(axis=0)
    np.testing.assert_array_less(0.8, gains)


@pytest.mark.parametrize("noise", [0.15, 0.2])
@pytest.mark.parametrize("seed", range(3))
def test_a_motion_stays_where_a_recording_averages_the_vibration_beside_it(seed: int, noise: float) -> None:
    """Where the average hides few frequencies the top of the spectrum was the noise, and a fifth of the motion went with it."""
    rng = np.random.default_rng(seed)
    x = 0.3 * motion(seed) + rng.normal(size=(24_000, 3))
    recorded = lfilter(np.ones(8) / 8.0, [1.0], x, axis=0) + noise * rng.normal(size=x.shape)
    slow = butter(4, MOTION_HZ, fs=RATE_HZ, output="sos")
    before, after = (sosfilt(slow, one, axis=0) for one in (x, denoised(x, RATE_HZ, recorded=recorded)[0]))
    np.testing.assert_array_less(0.95, (after * before).sum(axis=0) / (before**2).sum(axis=0))


def test_a_lag_does_not_hide_what_is_shared() -> None:
    """Of 50 ms, as of a slow filter: the phase turns with the frequency, and a mean over frequencies seemed to share less."""
    x, start_ns = np.tile(motion(5), 2) + np.random.default_rng(9).normal(size=(24_000, 6)), 1_700_000_000_000_000_000
    t_ns = start_ns + np.round(np.arange(len(x)) / RATE_HZ * 1e9).astype(np.int64)
    read, left = np.roll(x, 20, axis=0) + 0.1 * np.random.default_rng(10).normal(size=x.shape), []
    for gyro in (x[:, :3], None):
        recorded = recorded_at(Imu(t_ns, read[:, :3], read[:, 3:]), (t_ns - start_ns) * 1e-9, start_ns, gyro)
        noise = denoised(x, RATE_HZ, recorded=recorded)[1]
        left.append(noise.density[noise.f_hz < MOTION_HZ].mean())
    assert left[0] < 0.3 * left[1]


def test_a_fast_vibration_that_a_recording_shares_is_no_noise_that_is_left() -> None:
    x = motion(0) + np.random.default_rng(7).normal(size=(24_000, 3))
    recorded = x + 0.01 * np.random.default_rng(8).normal(size=x.shape)
    _, left = denoised(x, RATE_HZ, recorded=recorded)
    assert left.density.max() < 0.01 * 2.0 / RATE_HZ
    assert np.max(left.maximum) < 0.05
    noisy = x + 0.3 * np.random.default_rng(9).normal(size=x.shape)
    np.testing.assert_allclose(denoised(noisy, RATE_HZ, recorded=recorded)[1].maximum, 0.3, rtol=0.2)


def test_a_simulation_without_noise_has_none_left_where_a_recording_differs_by_its_motion() -> None:
    """A gain that drifts leaves a part of the motion, and a fast motion has second differences; both were taken for noise.

    So no misfit was larger than the noise, and every finding removed all of it.
    """
    x, rng = 30.0 * motion(0), np.random.default_rng(11)
    recorded = x * np.linspace(0.98, 1.02, len(x))[:, None] + 0.01 * rng.normal(size=x.shape)
    for simulated, recording in ((x, recorded), (x[::8], recorded[::8])):  # at the lower rate nearly all frequencies are shared
        clean, left = denoised(simulated, RATE_HZ, recorded=recording)
        assert np.sqrt(((clean - simulated) ** 2).mean()) < 1e-3
        assert left.density.max() * RATE_HZ / 2.0 < 1e-4
        assert np.max(left.maximum) < 0.01


def test_impacts_that_a_recording_shares_are_no_noise() -> None:
    """A sample of 40 in every second: the top of the spectrum is full of them, and they are motion."""
    x, rng = motion(0), np.random.default_rng(5)
    x[200::400] += 40.0 * rng.normal(size=x[200::400].shape)
    simulated, recorded = (x + 0.02 * rng.normal(size=x.shape) for _ in range(2))
    clean, alone = (denoised(simulated, RATE_HZ, recorded=known)[0] for known in (recorded, None))
    assert np.abs(clean - x).max() < 0.2 < np.abs(alone - x).max()


def test_nothing_is_taken_from_shocks_that_a_recording_shares() -> None:
    """Contacts of a legged robot, differentiated at every step: as white as a noise, and in both logs."""
    rng = np.random.default_rng(4)
    x = motion(0) + rng.normal(size=(24_000, 3)) * (rng.random((24_000, 1)) < 0.2)
    recorded = x + 0.01 * rng.normal(size=x.shape)
    off = denoised(x, RATE_HZ, recorded=recorded)[0] - x
    assert np.sqrt((off**2).mean()) < 1e-6


def test_a_clock_that_runs_fast_does_not_hide_what_is_shared() -> None:
    """Over a minute 200 ppm are 12 ms: a period of 80 Hz."""
    rate, start_ns = motion(5), 1_700_000_000_000_000_000
    t_s = np.arange(len(rate)) / RATE_HZ
    turns = 2.0 * np.pi * np.cumsum(80.0 + 5.0 * np.sin(2.0 * np.pi * 0.1 * t_s)) / RATE_HZ
    vibration = np.cos(turns[:, None] + [0.0, 1.0, 2.0])
    t_ns = start_ns + np.round(t_s * (1.0 + 2e-4) * 1e9).astype(np.int64)
    recorded = recorded_at(Imu(t_ns, rate, vibration), t_s, start_ns, rate)
    known = np.isfinite(recorded).all(axis=1)
    for k in (3, 4, 5):
        assert np.corrcoef(recorded[known, k], vibration[known, k - 3])[0, 1] > 0.9
    own_clock = recorded_at(Imu(t_ns, rate, vibration), t_s, start_ns)
    known = np.isfinite(own_clock).all(axis=1)
    assert abs(np.corrcoef(own_clock[known, 3], vibration[known, 0])[0, 1]) < 0.5
