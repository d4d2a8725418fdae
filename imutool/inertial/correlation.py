"""Cross-correlation of signals at every lag, its chance, and whiteness of a residual."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.signal import correlate, correlation_lags, periodogram

from imutool.array_types import Bool, Float64, Int64

MIN_ALIKE = 0.25  # of the size of two autocorrelations, that their product sums to: it scatters where both are lines
NEARLY_ONE = 1.0 - 1e-9  # correlation whose Fisher transform is finite
DEGREES = 3.0  # of freedom that Fisher's z loses
Column = Float64[np.ndarray, " _"]


class Correlation(NamedTuple):
    """Correlation of b[i + lag] with a[i], by lag.

    `sigma` is Fisher's z over its standard deviation for independent signals with these spectra.
    """

    lag: Int64[np.ndarray, " l"]
    value: Float64[np.ndarray, " l"]
    sigma: Float64[np.ndarray, " l"]

    def best(self, allowed: Bool[np.ndarray, " l"]) -> tuple[int, float, float]:
        """Lag, correlation and sigma at the allowed lag that chance explains worst."""
        at = int(np.argmax(np.where(allowed, self.sigma, -np.inf)))
        return int(self.lag[at]), float(self.value[at]), float(self.sigma[at])


def cross_correlation(a: Column, b: Column, minimum: int) -> Correlation:
    """Correlation over the samples that both have at a lag; 0 if fewer than `minimum`.

    Each overlap has its own mean and size, so that a short signal is found in a long one.
    """
    a, b = a - a.mean(), b - b.mean()
    lags = correlation_lags(len(b), len(a))
    first, last = np.maximum(0, -lags), np.minimum(len(a), len(b) - lags)
    count = last - first
    (sum_a, squares_a), (sum_b, squares_b) = (
        (_over(x, low, high), _over(x * x, low, high)) for x, low, high in ((a, first, last), (b, first + lags, last + lags))
    )
    product = correlate(b, a, mode="full") - sum_a * sum_b / count
    power_a, power_b = squares_a - sum_a**2 / count, squares_b - sum_b**2 / count
    size = np.sqrt(np.maximum(power_a, 0.0) * np.maximum(power_b, 0.0))
    shown = (count >= minimum) & (size > 1e-9 * np.sqrt(float(a @ a) * float(b @ b)))
    value = np.where(shown, product / np.where(shown, size, 1.0), 0.0).clip(-NEARLY_ONE, NEARLY_ONE)
    independent = np.maximum(count / dependent_samples(a, b) - DEGREES, 0.0)
    return Correlation(lags, value, np.arctanh(value) * np.sqrt(independent))


def dependent_samples(a: Column, b: Column) -> float:
    """Samples that count as one in the correlation of two signals of mean zero.

    1 + 2 sum_k rho_a(k) rho_b(k), Bartlett, JRSS Suppl. 8 (1946), 27.
    """
    n = min(len(a), len(b)) // 2
    rho_a, rho_b = (correlate(v, v, mode="full")[v.size :][:n] / max(float(v @ v), 1e-300) for v in (a, b))
    alike = max(float((rho_a * rho_b).sum()), MIN_ALIKE * float(np.linalg.norm(rho_a) * np.linalg.norm(rho_b)))
    return 1.0 + 2.0 * alike


def _over(x: Column, first: Int64[np.ndarray, " l"], last: Int64[np.ndarray, " l"]) -> Float64[np.ndarray, " l"]:
    """Sums of x from first to last."""
    total = np.concatenate([[0.0], np.cumsum(x)])
    return np.asarray(total[last] - total[first])


def time_ahead_s(x: Float64[np.ndarray, "n ..."], y: Float64[np.ndarray, "n ..."], t_s: Float64[np.ndarray, " n"]) -> float:
    """Time (s) by which columns y come before columns x that are alike."""
    slope = np.gradient(x, t_s, axis=0) / y.std(axis=0)
    return float(((y - x) / y.std(axis=0) * slope).sum() / max(float((slope**2).sum()), 1e-300))


def is_white(
    residual: Float64[np.ndarray, "n k"],
    noise: Float64[np.ndarray, " k"],
    minimum: Float64[np.ndarray, " k"],
    bands: int,
    factor: float,
    chance: float,
) -> bool:
    """Whether a residual is white, has no line, and is only noise at low frequencies.

    It is white if no band is louder than `factor` times the quietest of `bands` bands. A misfit of a motion is loud at low
    frequencies, or near Nyquist, where poses lose impacts. Less than `minimum` is no misfit.
    """
    f, power = periodogram(residual, fs=2.0, axis=0)  # white noise has its variance at each frequency
    parts, minimum = np.stack([part.mean(axis=0) for part in np.array_split(power[1:], bands)]), minimum**2
    fast = power[f > 1.0 / bands]
    line = len(fast) * np.exp(-fast.max(axis=0) / np.maximum(fast.mean(axis=0), minimum))
    alike = (parts < factor**2 * np.maximum(parts.min(axis=0), minimum)).all()
    return bool(alike and (parts[0] < factor**2 * np.maximum(noise**2, minimum)).all() and line.min() > chance)
