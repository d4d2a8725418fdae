"""Noise of any colour is made white and of unit variance; a slow misfit is not taken for noise; a band is cut out cleanly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, lfilter, sosfilt

from imutool.diagnosis.estimation.whitening import Band, Whitener, burg, level, settled, whitener
from imutool.diagnosis.settings import NoiseSettings
from imutool.inertial.wiener import NoiseLeft

N, RATE_HZ, STD = 12_000, 100.0, 0.01
SIGMAS = 4.5  # of a sample autocorrelation, one over the root of the count; some 60 are looked at
VARIANCE = 0.06  # four and a half standard deviations of the variance of 12 000 samples
LEVEL = 0.10  # a spectrum's median over so few segments is known no better
COLOURED = np.array([1.0, -1.6, 0.8])  # a resonance at 7.4 Hz


def white(seed: int, count: int = N) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 6))


def autocorrelation(x: np.ndarray, lags: int) -> np.ndarray:
    return np.stack([(x[k:] * x[:-k]).sum(axis=0) / (x * x).sum(axis=0) for k in range(1, lags + 1)])


@pytest.mark.parametrize("seed", range(3))
def test_autoregressive_noise_becomes_white_and_of_unit_variance(seed: int) -> None:
    x = STD * lfilter([1.0], COLOURED, white(seed), axis=0)
    everything = np.ones(N, bool)
    w = whitener(x, everything, 6)
    out = w(x)[settled(everything, 6)]
    assert np.abs(autocorrelation(out, 10)).max() < SIGMAS / np.sqrt(N)
    assert np.abs((out**2).mean(axis=0) - 1.0).max() < VARIANCE
    assert np.abs(autocorrelation(x, 1)).min() > 0.5  # it was not white before


def test_each_axis_has_a_size_of_its_own() -> None:
    sizes = np.array([1e-4, 1e-3, 1e-2, 0.1, 1.0, 10.0])
    w = whitener(sizes * white(0), np.ones(N, bool), 2)
    np.testing.assert_allclose(w.std, sizes, rtol=VARIANCE)


def test_burg_finds_the_autoregression() -> None:
    x = lfilter([1.0], COLOURED, white(1)[:, 0])
    np.testing.assert_allclose(burg(x, np.ones(N, bool), 2), COLOURED, atol=SIGMAS / np.sqrt(N))


def test_what_does_not_count_does_not_matter() -> None:
    x = lfilter([1.0], COLOURED, white(2)[:, 0])
    usable = np.ones(N, bool)
    usable[3000:3500] = usable[9000] = False
    spoiled = np.where(usable, x, 1e6)
    np.testing.assert_allclose(burg(spoiled, usable, 4), burg(x, usable, 4), atol=1e-12)


def test_a_row_is_settled_when_all_that_it_looks_back_on_counts() -> None:
    usable = np.array([0, 1, 1, 1, 0, 1, 1, 1, 1], bool)
    assert settled(usable, 2).tolist() == [False, False, False, True, False, False, False, True, True]
    assert settled(usable, 0).tolist() == usable.tolist()


def test_a_few_spikes_are_not_the_noise() -> None:
    x = STD * white(3)
    x[[1000, 7000]] = 1e2 * STD  # of which the plain size becomes 1.6 times as large
    w = whitener(x, np.ones(N, bool), 0)
    np.testing.assert_allclose(w.std, STD, rtol=VARIANCE)


def test_it_is_linear_and_acts_on_each_column_alike() -> None:
    x = white(4, 500)
    w = whitener(lfilter([1.0], COLOURED, x, axis=0), np.ones(500, bool), 3)
    stack = np.stack([x, 2.0 * x, np.zeros_like(x)], axis=2)
    out = w(stack)
    np.testing.assert_allclose(out[:, :, 0], w(x), atol=1e-12)
    np.testing.assert_allclose(out[:, :, 1], 2.0 * w(x), atol=1e-12)
    assert not out[:, :, 2].any()


@pytest.mark.parametrize("banded", [False, True])
def test_rows_are_filtered_as_the_books_filters_do(banded: bool) -> None:
    x, axes = white(11, 701)[:, :4].T.copy(), np.array([5, 0, 0, 2])
    band = Band.below(8.0, 200.0) if banded else None
    w = Whitener(np.random.default_rng(12).normal(size=(6, 8)), np.arange(1.0, 7.0), band)
    for row, axis, got in zip(x, axes, w.rows(x, axes), strict=True):
        slow = row
        if band is not None:
            half = len(band.taps) // 2
            slow = np.convolve(row, band.taps)[half : half + len(row)][:: band.every]
        np.testing.assert_allclose(got, lfilter(w.filters[axis], [w.std[axis]], slow), atol=1e-12)


# ── against an exact simulation ──


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("count", [2000, N])
def test_level_of_white_noise_is_its_size(seed: int, count: int) -> None:
    w = level(STD * white(seed, count), np.ones(count, bool), RATE_HZ, NoiseSettings())
    np.testing.assert_allclose(w(STD * white(seed, count))[6:].std(axis=0), 1.0, atol=LEVEL)


@pytest.mark.parametrize("rows_in_one_run", [520, 780, 1040])
def test_level_of_white_noise_is_its_size_where_one_to_three_segments_count(rows_in_one_run: int) -> None:
    """A recording at 50 Hz has few segments between its held-out blocks, and a median over few is skewed."""
    usable = np.arange(4096) < rows_in_one_run
    power = [level(white(seed, 4096), usable, 50.0, NoiseSettings()).std ** 2 for seed in range(20)]
    assert abs(float(np.mean(power)) - 1.0) < LEVEL


@pytest.mark.parametrize("seed", range(3))
def test_level_counts_what_is_left_of_a_simulations_noise_where_a_motion_hides_it(seed: int) -> None:
    """Noise of twice the size below a tenth of the rate, as of a simulation that moves up to there."""
    slow = sosfilt(butter(4, 0.1 * RATE_HZ, fs=RATE_HZ, output="sos"), 2.0 * STD * white(seed + 10), axis=0)
    edge_hz = np.array([0.0, 0.1, 0.1 + 1e-6, 0.5]) * RATE_HZ
    left = NoiseLeft(edge_hz, np.outer([1.0, 1.0, 0.0, 0.0], 2.0 * (2.0 * STD) ** 2 / RATE_HZ * np.ones(6)))
    x, settings = STD * white(seed) + slow, NoiseSettings(motion_hz=0.15 * RATE_HZ, reference_hz=0.4 * RATE_HZ)
    means = [level(x, np.ones(N, bool), RATE_HZ, settings, known)(x)[20:].std(axis=0) for known in (left, None)]
    assert np.abs(means[0] - 1.0).max() < 0.1 < np.abs(means[1] - 1.0).min()


def test_level_does_not_take_a_slow_misfit_for_noise() -> None:
    t = np.arange(N) / RATE_HZ
    misfit = np.repeat((0.1 * np.sin(2.0 * np.pi * 0.4 * t) + 0.05 * np.sin(2.0 * np.pi * 3.0 * t))[:, None], 6, axis=1)
    x = STD * white(5) + misfit
    w = level(x, np.ones(N, bool), RATE_HZ, NoiseSettings())
    kept = w(misfit)[100:].std(axis=0) / (misfit.std() / STD)
    assert (np.abs(kept - 1.0) < 2 * LEVEL).all()
    learned = whitener(x, np.ones(N, bool), 6)
    assert (learned(misfit)[100:].std(axis=0) < 0.7 * misfit.std() / STD).all()  # what would be lost by learning it


def test_level_does_not_take_a_line_for_noise() -> None:
    t = np.arange(N) / RATE_HZ
    line = np.repeat((0.05 * np.sin(2.0 * np.pi * 23.0 * t))[:, None], 6, axis=1)
    w = level(STD * white(6) + line, np.ones(N, bool), RATE_HZ, NoiseSettings())
    assert (w(line)[100:].std(axis=0) > 0.7 * line.std() / STD).all()


def test_level_knows_the_colour_above_the_motion() -> None:
    x = STD * lfilter([1.0, 0.9], [1.0], white(7), axis=0)  # less and less towards Nyquist
    w = level(x, np.ones(N, bool), RATE_HZ, NoiseSettings())
    spectrum = np.abs(np.fft.rfft(w(x)[100:], axis=0)) ** 2 / (N - 100)
    f_hz = np.fft.rfftfreq(N - 100, 1.0 / RATE_HZ)
    high = (f_hz > 18.0) & (f_hz < 40.0)
    assert np.abs(spectrum[high].mean(axis=0) - 1.0).max() < 0.25


def test_level_is_the_same_with_a_third_of_the_rows_left_out() -> None:
    x = STD * white(8)
    usable = (np.arange(N) // 600) % 3 != 2
    w = level(np.where(usable[:, None], x, 0.0), usable, RATE_HZ, NoiseSettings())
    np.testing.assert_allclose(w(x)[6:].std(axis=0), 1.0, atol=LEVEL)


# ── a band ──


@pytest.mark.parametrize("rate_hz", [100.0, 200.0])
def test_a_band_passes_what_is_slower_and_blocks_what_is_faster(rate_hz: float) -> None:
    band = Band.below(8.0, rate_hz)
    t = np.arange(int(20.0 * rate_hz)) / rate_hz
    for f_hz, minimum, maximum in ((0.5, 0.99, 1.01), (3.0, 0.99, 1.01), (20.0, 0.0, 0.01), (35.0, 0.0, 0.01)):
        x = np.repeat(np.sin(2.0 * np.pi * f_hz * t)[:, None], 6, axis=1)
        inner = slice(len(x[:: band.every]) // 10, -len(x[:: band.every]) // 10)
        ratio = float(band(x)[inner].std() / np.sqrt(0.5))
        assert minimum <= ratio <= maximum, f"{f_hz} Hz: {ratio:.4f}"


def test_a_band_does_not_delay() -> None:
    band = Band.below(8.0, 200.0)
    t = np.arange(4000) / 200.0
    x = np.repeat(np.sin(2.0 * np.pi * 2.0 * t)[:, None], 6, axis=1)
    inner = slice(100, -100)
    np.testing.assert_allclose(band(x)[inner], x[:: band.every][inner], atol=0.01)


def test_a_band_keeps_every_so_many_th_sample_and_no_fewer_than_its_edge_needs() -> None:
    band = Band.below(8.0, 200.0)
    x = white(9, 4001)
    assert band.every > 1
    assert 200.0 / band.every >= 2.0 * 8.0
    assert len(band(x)) == len(x[:: band.every])
    assert band(np.zeros((4001, 6, 0))).shape == (len(x[:: band.every]), 6, 0)


def test_white_noise_behind_a_band_becomes_white_again() -> None:
    band = Band.below(10.0, 200.0)
    x, everything = STD * white(10, 40_000), np.ones(40_000, bool)
    w = replace(whitener(band(x), everything[:: band.every], 12), band=band)
    out = w(x)[200:-200]
    assert w.every == band.every
    assert len(w(x)) == len(x[:: band.every])
    assert np.abs((out**2).mean(axis=0) - 1.0).max() < 0.1
    # nearly: twelve coefficients cannot undo the stop band of a filter that has a hundred
    assert np.abs(autocorrelation(out, 12)).max() < 0.25
    plain = band(x)[200:-200]
    assert np.abs(autocorrelation(plain, 1)).min() > 0.25  # the rows just hold the band, so that little is left to undo


def test_columns_of_zeros_stay_zeros() -> None:
    w = Whitener(np.ones((6, 1)), np.full(6, STD))
    assert not w(np.zeros((100, 6))).any()
