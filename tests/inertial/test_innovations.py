"""The share of a correction that innovations ask for has the error that it states, also where they depend on each other."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import chi2, multivariate_t

from imutool.inertial.innovations import STUDENT, Innovations, share_of_correction

BLOCKS, DRAWS = 240, 400
# The mean of 400 draws has a standard error of a twentieth of a draw's, and their spread one of 1 / sqrt(800) = 3.5 %.
MEAN_SE, SPREAD = 4.0 / math.sqrt(DRAWS), 4.0 / math.sqrt(2.0 * DRAWS)
CORRELATED = 0.3  # Newey and West count lags up to six with falling weights: a little less than all of it


def covariances(rng: np.random.Generator) -> np.ndarray:
    root = rng.normal(size=(BLOCKS, 3, 3))
    return root @ root.transpose(0, 2, 1) + np.eye(3)


def drawn(share: float, dependence: float) -> tuple[np.ndarray, np.ndarray]:
    """Shares and stated deviations of draws where the innovations ask for a share; the noise is autoregressive."""
    rng = np.random.default_rng(5)
    S = covariances(rng)
    root = np.linalg.cholesky(S)
    d = (root @ rng.normal(size=(BLOCKS, 3, 1)))[..., 0] * 0.3
    d = np.cumsum(d - d.mean(axis=0), axis=0) / 10.0  # a tilt grows and fades slowly
    found = []
    for _ in range(DRAWS):
        white = rng.normal(size=(BLOCKS, 3, 1))
        noise = white.copy()
        for k in range(1, BLOCKS):
            noise[k] = dependence * noise[k - 1] + math.sqrt(1.0 - dependence**2) * white[k]
        e = share * d + 0.5 * (root @ noise)[..., 0]
        found.append(share_of_correction(Innovations(e, S), Innovations(e - d, S)))
    return np.array([each.value for each in found]), np.array([each.std for each in found])


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_the_share_is_unbiased_and_its_deviation_true(share: float) -> None:
    values, std = drawn(share, 0.0)
    assert abs(values.mean() - share) < MEAN_SE * values.std()
    assert np.sqrt((std**2).mean()) == pytest.approx(values.std(), rel=SPREAD + 0.05)


def test_dependent_innovations_tell_less() -> None:
    values, std = drawn(1.0, 0.6)
    alone = drawn(1.0, 0.0)[1]
    assert std.mean() > 1.5 * alone.mean()
    assert np.sqrt((std**2).mean()) == pytest.approx(values.std(), rel=CORRELATED)


def test_the_deviation_is_newey_and_wests() -> None:
    S, d = np.tile(np.eye(3), (2, 1, 1)), np.array([[1.0, 0.0, 0.0]] * 2)
    e = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    scores, weight = (0.5, -0.5), 1.0 - 1.0 / 7.0  # of a lag of one among six
    variance = scores[0] ** 2 + scores[1] ** 2 + 2.0 * weight * scores[0] * scores[1]
    assert share_of_correction(Innovations(e, S), Innovations(e - d, S))[:2] == pytest.approx((0.5, math.sqrt(variance) / 2.0))


def test_a_jolt_does_not_decide() -> None:
    rng = np.random.default_rng(6)
    S = np.tile(np.eye(3), (BLOCKS, 1, 1))
    d = 0.5 * rng.normal(size=(BLOCKS, 3))
    e = d + 0.5 * rng.normal(size=(BLOCKS, 3))
    quiet = share_of_correction(Innovations(e, S), Innovations(e - d, S))
    e[100] -= 1000.0 * d[100]
    assert share_of_correction(Innovations(e, S), Innovations(e - d, S)).value == pytest.approx(quiet.value, abs=0.2)


def test_what_a_correction_does_not_take_away_its_opposite_brings_back() -> None:
    """From corrected samples on, the share a is 1 - a: jolts count less if both have them, and no side's errors do alone."""
    rng = np.random.default_rng(8)
    S, d = covariances(rng), rng.standard_cauchy(size=(BLOCKS, 3))
    e = 0.3 * d + rng.standard_t(2.0, size=(BLOCKS, 3))
    without, corrected = Innovations(e, S), Innovations(e - d, S)
    there, back = share_of_correction(without, corrected), share_of_correction(corrected, without)
    assert back == pytest.approx((1.0 - there.value, there.std, there.filter_std))
    assert there.value == pytest.approx(0.3, abs=4.0 * there.std)


def test_nothing_to_compare_tells_nothing() -> None:
    S = np.tile(np.eye(3), (4, 1, 1))
    same, none = Innovations(np.ones((4, 3)), S), Innovations(np.zeros((0, 3)), np.zeros((0, 3, 3)))
    assert share_of_correction(same, same).std == share_of_correction(none, none).std == math.inf


def test_chi_square_and_likelihood_are_those_of_the_textbook() -> None:
    rng = np.random.default_rng(7)
    S = covariances(rng)
    e = (np.linalg.cholesky(S) @ rng.normal(size=(BLOCKS, 3, 1)))[..., 0]
    found = Innovations(e, S)
    assert (found.chi_square > chi2.ppf(0.95, 3)).mean() == pytest.approx(0.05, abs=4.0 * math.sqrt(0.05 * 0.95 / BLOCKS))
    true = [multivariate_t(shape=shape, df=STUDENT).logpdf(each) for each, shape in zip(e, S, strict=True)]
    np.testing.assert_allclose(np.diff(found.log_likelihood), np.diff(true), rtol=0.0, atol=1e-9)
