"""A penalised spline finds the noise, halves what it says it halves, and errs as it says it errs."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.random import default_rng

from imutool.sensor.smoothing import Samples

N, PERIOD_S = 4000, 0.01
T_S = PERIOD_S * np.arange(N)


def samples(y: np.ndarray, knot_s: float = 0.02) -> Samples:
    return Samples(T_S, y, np.ones(N), knot_s)


def wander(seed: int, size: float = 30.0, finer: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """Position and acceleration of a motion with white jerk, integrated finely by the trapezoidal rule."""
    step_s = PERIOD_S / finer
    a = np.cumsum(size * np.sqrt(step_s) * default_rng(seed).normal(size=N * finer))
    v = np.cumsum((a[1:] + a[:-1]) * 0.5 * step_s)
    p = np.cumsum((v[1:] + v[:-1]) * 0.5 * step_s)
    return p[::finer][: N - 1], a[2::finer][: N - 1]  # each integral begins half a step and ends half a step later


@pytest.mark.parametrize("cutoff_hz", [0.3, 3.0, 20.0])
def test_a_parabola_is_never_smoothed(cutoff_hz: float) -> None:
    y = np.stack([3.0 + 2.0 * T_S - 0.5 * T_S**2, T_S], axis=1)
    fit = samples(y).fit(cutoff_hz)
    np.testing.assert_allclose(fit.spline(T_S), y, atol=2e-3)  # 760 at the end, and a condition of 1e9 at the lowest
    np.testing.assert_allclose(fit.spline(T_S[50:-50], 2), [-1.0, 0.0] * np.ones((N - 100, 1)), atol=2e-3)


@pytest.mark.parametrize("cutoff_hz", [1.0, 4.0, 8.0])
def test_at_the_cut_off_a_motion_comes_out_at_half_its_size(cutoff_hz: float) -> None:
    y = np.sin(2.0 * np.pi * cutoff_hz * T_S)[:, None]
    fitted = samples(y).fit(cutoff_hz).spline(T_S)[500:-500]
    assert float(np.abs(fitted).max()) == pytest.approx(0.5, abs=0.02)  # samples twice as dense as knots are not quite even


@pytest.mark.parametrize("noise", [1e-3, 3e-2])
def test_the_noise_is_found(noise: float) -> None:
    p, _ = wander(1)
    y = p[:, None] + noise * default_rng(2).normal(size=(len(p), 1))
    fit = Samples(T_S[: len(p)], y, np.ones(len(p)), 0.02).fit()
    assert fit.noise == pytest.approx(noise, rel=0.06)  # 1 / sqrt(2 n) is 1 per cent; a little more smoothing than likeliest


@pytest.mark.parametrize("near_hz", [0.3, 5.0, 20.0])
def test_from_any_start_the_same_cut_off_is_likeliest(near_hz: float) -> None:
    p, _ = wander(1)
    y = p[:, None] + 1e-3 * default_rng(2).normal(size=(len(p), 1))
    of_all = Samples(T_S[: len(p)], y, np.ones(len(p)), 0.02)
    assert of_all.fit(near_hz=near_hz).cutoff_hz == of_all.fit().cutoff_hz


@pytest.mark.parametrize("derivative", [0, 2])
def test_it_errs_as_it_says(derivative: int) -> None:
    """On a motion with white jerk, for which the statement is exact."""
    p, a = wander(3, size=1.0)  # slow against the knots, within which a spline is smoother than that motion
    y = p[:, None] + 3e-3 * default_rng(4).normal(size=(len(p), 1))
    fit = Samples(T_S[: len(p)], y, np.ones(len(p)), 0.02).fit()
    error = (fit.spline(T_S[: len(p)], derivative)[:, 0] - (p if derivative == 0 else a))[200:-200]
    assert float(np.sqrt(np.mean(error**2))) / fit.std(derivative) == pytest.approx(1.0, abs=0.15)


def test_a_body_at_rest_without_noise_is_left_alone() -> None:
    fit = samples(np.full((N, 3), 7.0)).fit()
    np.testing.assert_allclose(fit.spline(T_S), 7.0, atol=1e-9)
    assert fit.noise < 1e-9


def test_a_weight_of_nought_is_a_sample_that_is_not_there() -> None:
    y = np.sin(T_S)[:, None]
    weights = np.ones(N)
    y[1000], weights[1000] = 1e6, 0.0
    fitted = Samples(T_S, y, weights, 0.02).fit(5.0).spline(T_S)
    assert abs(float(fitted[1000, 0]) - np.sin(10.0)) < 1e-6
