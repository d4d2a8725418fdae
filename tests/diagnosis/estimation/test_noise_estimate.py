"""Noise against poses is what poses and sensor have, not what an effect does; a band ends where the poses' own errors begin."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_erosion
from scipy.signal import butter, sosfiltfilt
from support import planted

from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.model_selection import select_effects
from imutool.diagnosis.estimation.noise_estimate import known_band_hz, noise_std, whitened, whitened_stretches
from imutool.diagnosis.estimation.whitening import WhitenedImu
from imutool.diagnosis.reference.errors import SMOOTHED
from imutool.diagnosis.settings import BandSettings
from imutool.errors import DataError
from imutool.inertial.wiener import wiener_filter
from imutool.sensor import catalogue

FELT = planted.rich(duration_s=45.0)
BAND = BandSettings()
BAND_HZ = 6.0
NEAR = 1.35  # of the noise: three axes of a few hundred rows, and what a rich model spends
NEAR_A_JUMP = 2.0  # until a fit finds its time, the part of a second around it is misfit: left out altogether it is twenty
WITHOUT = planted.catalogue()


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


def beside_poses(effects: dict[str, list[float]] | None = None, added: np.ndarray | None = None) -> Pair:
    pair: Pair = planted.pair(FELT, effects, added=added)
    return replace(pair, band_hz=BAND_HZ)


def noise(log: WhitenedImu) -> np.ndarray:
    return np.asarray(noise_std(log.whiten))


@functools.cache
def quiet() -> np.ndarray:
    return noise(whitened(beside_poses(), WITHOUT))


def test_a_log_with_too_few_values_without_a_gap_is_refused() -> None:
    """A traceback once: a simulated flight of PX4 whose logger had dropped every third sample."""
    pair = beside_poses()
    gaps = np.arange(len(pair.real)) * pair.period_s % 0.4 < 0.2
    with pytest.raises(DataError, match=r"0 values every 0\.\d+ s are there without a gap; expected 12 or more"):
        whitened(replace(pair, known=np.repeat(~gaps[:, None], 6, axis=1)), WITHOUT)


def test_a_stretch_with_too_few_rows_is_left_out_beside_a_longer_one(caplog: pytest.LogCaptureFixture) -> None:
    pair = beside_poses()
    gaps = np.arange(len(pair.real)) * pair.period_s % 0.4 < 0.2
    poor = replace(pair, known=np.repeat(~gaps[:, None], 6, axis=1))
    (log,) = whitened_stretches([poor, pair], lambda _: WITHOUT)
    assert log.pair.known is None
    assert "are left out: " in caplog.text
    with pytest.raises(DataError, match="0 values every"):
        whitened_stretches([poor], lambda _: WITHOUT)


@pytest.mark.parametrize(
    "effects",
    [
        {"gyro_bias_drift": [0.02, -0.02, 0.02, 12.0]},
        {"gravity": [0.05, 0.05, -0.05]},
        {"clock_jump": [21.0, 0.02]},
        {"mount_rotation": [0.1, -0.1, 0.05]},
        {"lever_arm": [0.3, 0.1, -0.2]},
    ],
)
def test_an_effect_is_not_taken_for_noise(effects: dict[str, list[float]]) -> None:
    with_it = noise(whitened(beside_poses(effects), WITHOUT))
    near = NEAR_A_JUMP if "clock_jump" in effects else NEAR
    assert (with_it / quiet() < near).all(), with_it / quiet()


def test_rows_of_noise_have_the_size_that_is_told() -> None:
    log = whitened(beside_poses(), WITHOUT)
    pair = log.pair
    white = log.whiten(pair.real - planted.ideal(FELT) - planted.BIAS)[log.rows("all")]
    assert np.abs((white**2).mean(axis=0) - 1.0).max() < 0.25


def test_what_has_no_name_on_one_axis_makes_that_axis_little_noisier() -> None:
    odd = np.zeros((len(FELT.t_s), 6))
    odd[:, 2] = 0.5 * np.sign(np.sin(40.0 * FELT.gyro[:, 0]))
    with_it = noise(whitened(beside_poses(added=odd), WITHOUT))
    assert with_it[2] <= 1.01 * BAND.noisy_axis * np.median(with_it[:3])
    assert (with_it[[0, 1, 3, 4, 5]] / quiet()[[0, 1, 3, 4, 5]] < NEAR).all()


# ── the band ──


def errors(above_hz: float, size: float) -> np.ndarray:
    """Of what is expected of the accelerometer: noise faster than a frequency."""
    white = np.random.default_rng(5).normal(size=(len(FELT.t_s), 3))
    return size * np.asarray(sosfiltfilt(butter(4, [above_hz, 20.0], "band", fs=planted.RATE_HZ, output="sos"), white, axis=0))


def test_a_sensor_noisier_than_the_motion_leaves_the_band_as_it_is() -> None:
    pair = beside_poses(added=10.0 * planted.noise(len(FELT.t_s), 9))
    assert known_band_hz(pair.real, planted.ideal(FELT), planted.RATE_HZ, BAND_HZ, BAND) == BAND_HZ


def test_poses_that_err_faster_than_a_frequency_end_the_band_there() -> None:
    pair = beside_poses()
    wrong = planted.ideal(FELT)
    wrong[:, 3:] += errors(3.0, 5.0)
    ends_hz = known_band_hz(pair.real, wrong, planted.RATE_HZ, BAND_HZ, BAND)
    assert 1.25 <= ends_hz <= 3.0
    assert ends_hz < BAND_HZ


def test_a_quiet_axis_that_poses_do_not_know_ends_the_band_next_to_lively_ones() -> None:
    felt = replace(FELT, accel=FELT.accel * [6.0, 0.3, 6.0])
    wrong = planted.ideal(felt)
    wrong[:, 4] += errors(3.0, 0.5)[:, 1]
    ends_hz = known_band_hz(planted.ideal(felt), wrong, planted.RATE_HZ, BAND_HZ, BAND)
    assert 1.25 <= ends_hz <= 3.0


def follows_in_slow_motion(seed: int) -> Pair:
    """Hardly any slow motion; above 3 Hz the body shakes about a point 20 mm below, and positions know part of it, with noise.

    The sensor sits where its poses are.
    """
    felt = planted.rich(seed, duration_s=60.0)
    accel = felt.accel.mean(axis=0) + 0.1 * (felt.accel - felt.accel.mean(axis=0))
    shaken, moved, noise = (fast(k, len(felt.t_s)) for k in (1, 3, 2))
    alpha = 0.1 * np.gradient(shaken, 1.0 / planted.RATE_HZ, axis=0)
    felt = replace(felt, gyro=felt.gyro + 0.1 * shaken, alpha=felt.alpha + alpha, accel=accel + 0.4 * moved)
    lost = np.zeros((len(felt.t_s), 6))
    lost[:, 3:] = np.cross(alpha, [0.0, 0.0, 0.02])
    known = replace(felt, accel=felt.accel + 0.15 * noise)
    return replace(planted.pair(felt, added=lost), ideal=known, band_hz=12.0)


def fast(seed: int, count: int) -> np.ndarray:
    """Motion or noise between 3 and 12 Hz, of rms 1."""
    white = np.random.default_rng(seed).normal(size=(count, 3))
    band = sosfiltfilt(butter(4, [3.0, 12.0], "band", fs=planted.RATE_HZ, output="sos"), white, axis=0)
    return np.asarray(band / band.std())


@pytest.mark.parametrize("seed", [1, 2])
def test_what_fast_motion_the_positions_do_not_follow_is_no_lever_arm(seed: int) -> None:
    log = whitened(follows_in_slow_motion(seed), (*WITHOUT, SMOOTHED))
    assert select_effects([log], catalogue.diagnosed(["lever_arm"])).selected == ()
    assert log.pair.band_hz == pytest.approx(3.0)


def test_an_axis_that_poses_do_not_know_at_all_ends_no_band() -> None:
    wrong = planted.ideal(FELT)
    wrong[:, 4] += errors(0.3, 50.0)[:, 1]
    assert known_band_hz(beside_poses().real, wrong, planted.RATE_HZ, BAND_HZ, BAND) == BAND_HZ


def test_a_scale_beside_a_noisy_sensor_leaves_the_band_as_it_is() -> None:
    real = 0.8 * planted.ideal(FELT) + 5.0 * planted.noise(len(FELT.t_s), 9)
    assert known_band_hz(real, planted.ideal(FELT), planted.RATE_HZ, BAND_HZ, BAND) == BAND_HZ


def test_a_sensor_that_is_too_slow_leaves_the_band_as_it_is() -> None:
    pair = beside_poses({"low_pass": [6.0]})
    assert known_band_hz(pair.real, planted.ideal(FELT), planted.RATE_HZ, BAND_HZ, BAND) == BAND_HZ


def shaken_at_times(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A body that rests for ten seconds and shakes for ten, in two signals a quarter of a period apart; when it moves."""
    t, rng = planted.clock(120.0), np.random.default_rng(seed)
    moves = t // 10.0 % 2 == 1
    wave = 2.0 * np.pi * np.outer(t, rng.uniform(2.0, 12.0, 40)) + rng.uniform(0.0, 2.0 * np.pi, 40)
    return moves[:, None] * np.stack([np.cos(wave).sum(axis=1), np.sin(wave).sum(axis=1)], axis=1) / np.sqrt(20.0), moves


@pytest.mark.parametrize("seed", range(3))
def test_motion_is_not_shrunk_by_the_rests_between_and_rests_lose_their_noise(seed: int) -> None:
    x, moves = shaken_at_times(seed)
    noisy = x[:, :1] + np.random.default_rng([seed, 1]).normal(size=(len(x), 1))
    clean = wiener_filter(noisy, 100.0)
    assert (clean * x[:, :1])[moves].sum() / (clean**2)[moves].sum() == pytest.approx(1.0, abs=0.03)
    rests = binary_erosion(~moves, iterations=150)
    assert rms(clean[rests]) < 0.15


def test_a_signal_near_its_noise_is_known_by_another_that_stands_clear() -> None:
    x, moves = shaken_at_times(0)
    size, noise = np.array([100.0, 0.7]), np.random.default_rng(1).normal(size=x.shape)
    error = wiener_filter(x * size + noise, 100.0) - x * size
    alone = wiener_filter((x * size + noise)[:, 1:], 100.0) - (x * size)[:, 1:]
    assert rms(error[moves, 1]) < 0.5 * rms(alone[moves, 0])


def test_a_shock_is_no_noise_of_other_times() -> None:
    """Of a simulation without noise, in which a mean over time would find some."""
    x, _ = shaken_at_times(0)
    x[6000] += 1e3
    assert rms((wiener_filter(x, 100.0) - x)[:5000]) < 0.01 * rms(x[:5000])
