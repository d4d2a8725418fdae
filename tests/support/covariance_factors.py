"""Factors on a covariance, learned from other logs: one for all windows, or one for each by its motion."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.stats import chi2

from imutool.array_types import Float64

from .error_growth import Motion

SHARES = (0.68, 0.95, 0.997)
FEATURES = "constant", "rate", "force", "time"  # logarithms of rms rate, of rms change of the force, and of the time in the log
MIN_RATE, MIN_FORCE, SOON_S = 0.03, 0.1, 10.0  # rad/s, m/s², s: below these the logarithms hardly change
WEIGHT_STD, WINDOWS_A_LOG = 0.5, 10.0  # prior of the head's weights; independent windows for which a log counts
MAX_FACTOR, PRIOR_LOGS = 16.0, 3  # of a covariance; n logs of three axes show the factor's logarithm to sqrt(2 / 3n)
BISECTIONS = 40


class Judgement(NamedTuple):
    """Errors of a log's windows, and their covariance: the bias's part, and that of noise, poses and measurement."""

    error: Float64[np.ndarray, "m 3"]
    bias: Float64[np.ndarray, "m 3 3"]
    other: Float64[np.ndarray, "m 3 3"]
    features: Float64[np.ndarray, "m 4"]

    def squares(self, factor: float | Float64[np.ndarray, "m 1 1"] = 1.0) -> Float64[np.ndarray, " m"]:
        """Normalised squares of the errors, with a factor on the bias's part."""
        P = factor * self.bias + self.other
        return np.asarray(np.einsum("mi,mi->m", self.error, np.linalg.solve(P, self.error[..., None])[..., 0]))


def coverage(squares: Float64[np.ndarray, " m"]) -> str:
    """Shares of windows within the ellipsoids of `SHARES`."""
    return " / ".join(f"{100 * (squares <= chi2.ppf(share, 3)).mean():.0f}" for share in SHARES) + " %"


def with_factor(logs: list[Judgement]) -> str:
    """Coverage with each log's covariance times the factor that the other logs ask for."""
    logs = [log for log in logs if len(log.error)]
    if len(logs) < 2:
        return ""
    needed = [needed_factors(log) for log in logs]
    factors = [factor_of([n for n in needed if n is not own]) for own in needed]
    squares = np.concatenate([log.squares(factor) for log, factor in zip(logs, factors, strict=True)])
    return f" with a factor of {np.exp(np.mean(np.log(factors))):.2f}: {coverage(squares)}"


def features_of(motion: Motion, windows: list[slice]) -> Float64[np.ndarray, "m 4"]:
    """`FEATURES` of windows."""
    rows = []
    for window in windows:
        rate, force = motion.samples[window, :3], motion.samples[window, 3:]
        sizes = (rate**2).sum(axis=1).mean(), force.var(axis=0).sum()
        logarithms = [0.5 * np.log(size + minimum**2) for size, minimum in zip(sizes, (MIN_RATE, MIN_FORCE), strict=True)]
        rows.append([1.0, *logarithms, np.log(motion.t_s[window.start] + SOON_S) - np.log(SOON_S)])
    return np.reshape(rows, (-1, len(FEATURES)))


def with_head(logs: list[Judgement]) -> str:
    """Coverage with each log's covariance times the learned factors of its windows, learned from the other logs."""
    logs = [log for log in logs if len(log.error)]
    if len(logs) < 2:
        return ""
    factors = [np.exp(log.features @ head([other for other in logs if other is not log])) for log in logs]
    squares = np.concatenate([log.squares(factor[:, None, None]) for log, factor in zip(logs, factors, strict=True)])
    return f" with a head, factors of {np.exp(np.mean(np.log(np.concatenate(factors)))):.2f}: {coverage(squares)}"


def head(logs: list[Judgement]) -> Float64[np.ndarray, " f"]:
    """Weights of the features, by the likelihood of the logs' errors and a prior about zero."""

    def minus_log_posterior(weights: Float64[np.ndarray, " f"]) -> float:
        total = 0.5 * float((weights**2).sum()) / WEIGHT_STD**2
        for one in logs:
            P = np.exp(np.clip(one.features @ weights, -6.0, 6.0))[:, None, None] * one.bias + one.other
            squares = np.einsum("mi,mi->m", one.error, np.linalg.solve(P, one.error[..., None])[..., 0])
            total += 0.5 * WINDOWS_A_LOG * float((squares + np.linalg.slogdet(P)[1]).mean())
        return total

    return np.asarray(minimize(minus_log_posterior, np.zeros(len(FEATURES))).x)


def needed_factors(log: Judgement) -> Float64[np.ndarray, " m"]:
    """Factor on the bias's covariance that puts each window on its ellipsoid of `SHARES[0]`, by bisection of its logarithm."""
    low, high = np.full(len(log.error), -np.log(MAX_FACTOR)), np.full(len(log.error), np.log(MAX_FACTOR))
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        outside = log.squares(np.exp(middle)[:, None, None]) > chi2.ppf(SHARES[0], 3)
        low, high = np.where(outside, middle, low), np.where(outside, high, middle)
    return np.asarray(np.exp(0.5 * (low + high)))


def factor_of(needed: list[Float64[np.ndarray, " _"]]) -> float:
    """Conformal quantile of what the windows of n logs need, each log with the same weight.

    The share asked for is n + 1 to n larger, since the next log is none of these. The logarithm of the factor has a prior of
    about 0.5 around zero: that of n logs counts n / (n + `PRIOR_LOGS`).
    """
    weight = np.concatenate([np.full(len(of_log), 1.0 / len(of_log)) for of_log in needed]) / len(needed)
    ordered = np.argsort(values := np.concatenate(needed))
    level = min(SHARES[0] * (1.0 + 1.0 / len(needed)), 1.0)
    row = min(int(np.searchsorted(np.cumsum(weight[ordered]), level - 1e-9)), len(values) - 1)
    return float(values[ordered[row]] ** (len(needed) / (len(needed) + PRIOR_LOGS)))
