"""Random walk of a bias in white noise: its likelihood from means of a residual.

Every gyro and accelerometer walks (rate random walk: IEEE 952, 1293). The walk is slow, and so is a drift, or what follows a
temperature: an effect that is weighed against white noise alone explains the walk.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from imutool.array_types import Float64, Int64

INDEPENDENT = 1e-3  # of the largest singular value, below which a derivative is a combination of others
Steps = Float64[np.ndarray, " w"]


class WalkLikelihood(NamedTuple):
    """Likelihood of sizes of a walk: squares left, logarithms of determinants.

    The determinants are those with all parameters, and with a constant alone. `fitted` are the squares of the residual as
    it was fitted, with the best constant, and `within` is the variance of its samples about the means of their blocks.
    """

    squares: Steps
    log_determinant: Steps
    beside_constant: Steps
    fitted: float
    within: float
    free: int

    def white(self) -> Steps:
        """Variance of the white noise for each size of the walk."""
        return np.asarray(self.squares / self.free)

    def of_any_noise(self) -> Steps:
        """Restricted log-likelihood with the best variance of the white noise."""
        return np.asarray(-0.5 * (self.free * np.log(self.white()) + self.log_determinant))

    def gain(self, variance: float) -> Steps:
        """Gain in log-likelihood over the residual as it was fitted, with a known variance of the white noise.

        It is restricted by the constant alone, which all fits have. Restricted by all parameters it does not compare fits of
        different ones: each would be worth the logarithm of what the walk adds to its variance.
        """
        return np.asarray(0.5 * ((self.fitted - self.squares) / variance - self.beside_constant))


def walk_likelihood(
    residual: Float64[np.ndarray, " n"],
    derivatives: Float64[np.ndarray, "q n"],
    block: Int64[np.ndarray, " n"],
    steps: Steps,
) -> WalkLikelihood | None:
    """Likelihood of walks by the variance of their steps from block to block.

    The variances are in units of a sample's white noise. `derivatives` are the residual's by what was fitted, a constant the
    first of them. The restricted likelihood is that of what no value of the parameters changes (Patterson and Thompson,
    Biometrika 1971): what they took up is no evidence against a walk. None where they leave too few blocks.
    """
    names, inverse, count = np.unique(block, return_inverse=True, return_counts=True)
    means = np.array([np.bincount(inverse, weights=row) for row in (residual, *derivatives)])
    means /= np.sqrt(count)  # as noisy as a sample
    power, vector = _modes(tuple((names - names[0]).tolist()), tuple(count.tolist()))
    y, fitted = means[0] @ vector, means[1:] @ vector
    _, singular, X = np.linalg.svd(fitted / np.maximum(np.linalg.norm(fitted, axis=1), 1e-300)[:, None], full_matrices=False)
    X = X[singular > INDEPENDENT * singular[0]]
    free = len(y) - len(X)
    if free <= len(X):
        return None
    constant = fitted[0] / max(float(np.linalg.norm(fitted[0])), 1e-300)
    squares, log_determinant, beside_constant = np.zeros((3, len(steps)))
    for k, variance in enumerate(1.0 + steps[:, None] * np.maximum(power, 0.0)):
        N, g = X / variance @ X.T, X / variance @ y
        squares[k] = y / variance @ y - g @ np.linalg.solve(N, g)
        log_determinant[k] = np.log(variance).sum() + np.linalg.slogdet(N)[1]
        beside_constant[k] = np.log(variance).sum() + np.log(max(float(constant / variance @ constant), 1e-300))
    within = float(residual @ residual - y @ y) / max(1, len(residual) - len(y))
    return WalkLikelihood(squares, log_determinant, beside_constant, float(y @ y - (y @ constant) ** 2), within, free)


@lru_cache(maxsize=8)
def _modes(since: tuple[int, ...], count: tuple[int, ...]) -> tuple[Float64[np.ndarray, " b"], Float64[np.ndarray, "b b"]]:
    """Eigenvalues and vectors of a walk's covariance in blocks of some samples; all axes and fits of a log share them."""
    root = np.sqrt(count)
    power, vector = np.linalg.eigh(np.minimum.outer(since, since) * np.outer(root, root))
    return power, vector


def without_walk(x: Float64[np.ndarray, " n"], steps: float) -> Float64[np.ndarray, " n"]:
    """White noise from white noise of variance 1 on a walk, whose steps have a variance.

    The sum is an ARIMA(0, 1, 1) process, (1 - B) x = (1 - theta B) e / sqrt(theta), theta + 1 / theta - 2 = steps (Box and
    Jenkins, Time Series Analysis, sec. 4.3.1). Before the first sample is zero: the walk begins at the constant bias.
    """
    if not steps:
        return x
    theta = 1.0 + 0.5 * steps - np.sqrt(steps + 0.25 * steps**2)
    return np.asarray(np.sqrt(theta) * lfilter([1.0, -1.0], [1.0, -theta], x))
