"""Normalised estimation error squared: whether errors are as large as their covariances say."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from scipy.special import gammaincinv

from imutool.errors import DataError, NumericsError


def consistency(
    errors: Float64[np.ndarray, "n k"], covariances: Float64[np.ndarray, "n k k"], confidence: float = 0.95
) -> dict[str, float | bool]:
    """Whether errors are as large as their claimed covariances say: the mean normalised estimation error squared.

    NEES_k = e_k^T P_k^{-1} e_k has mean `dimension` for honest covariances; n times the mean of n independent ones is
    chi-square with n k degrees of freedom (Bar-Shalom, Li, Kirubarajan 2001, section 5.4.2), which gives the two-sided
    bounds. Above the upper bound the covariances are too small (overconfident). Errors correlated in time make the
    bounds too narrow: pass one per correlation time.

    Raises:
        DataError: no errors, or a covariance that is not positive definite.
        NumericsError: an error or covariance is not finite.
    """
    samples, dimension = errors.shape
    if not samples or not dimension:
        raise DataError(f"errors are {list(errors.shape)}", expected="at least one row and column")
    if not (np.isfinite(errors).all() and np.isfinite(covariances).all()):
        raise NumericsError("errors or covariances are not finite", expected="finite numbers", fix="Look for divergence")
    try:
        whitening = np.linalg.cholesky(covariances)
    except np.linalg.LinAlgError as error:
        raise DataError("a covariance is not positive definite", expected="symmetric positive definite") from error
    nees = (np.linalg.solve(whitening, errors[..., None])[..., 0] ** 2).sum(axis=1)
    mean, freedom, tail = float(nees.mean()), samples * dimension, (1.0 - confidence) / 2.0
    lower, upper = (2.0 * float(gammaincinv(freedom / 2.0, q)) / samples for q in (tail, 1.0 - tail))
    return {
        "nees_mean": mean,
        "nees_lower": lower,
        "nees_upper": upper,
        "dimension": dimension,
        "samples": samples,
        "consistent": lower <= mean <= upper,
    }
