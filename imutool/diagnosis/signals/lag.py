"""Lag of a recording behind its simulation at first sight, by correlation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.signal import correlate, correlation_lags

from imutool.array_types import Float64
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.errors import DataError
from imutool.inertial.correlation import dependent_samples

Column = Float64[np.ndarray, "_"]


def lag_at_first_sight(
    t_real: Column,
    real: Float64[np.ndarray, "_ k"],
    t_sim: Column,
    sim: Float64[np.ndarray, "_ k"],
    names: Sequence[str],
    settings: DiagnoseSettings,
) -> tuple[float, float | None]:
    """Lag (s) of the recording at first sight, and the clock shift (s) if no epoch is shared.

    Raises:
        DataError: nowhere are the two alike.
    """
    own = settings.signal
    a, b = (
        np.stack([_smooth(t_s, column, own.align_hz) for column in values.T]) for t_s, values in ((t_real, real), (t_sim, sim))
    )
    if len(names) > 1:  # columns of one size each, so that none decides for all
        size = np.maximum(b.std(axis=1, keepdims=True), 1e-300)
        a, b = a / size, b / size
    total = np.sum([correlate(x, y, mode="full") for x, y in zip(a, b, strict=True)], axis=0)
    correlation = total / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-300)
    lags = correlation_lags(a.shape[1], b.shape[1]) / own.align_hz + float(t_real[0] - t_sim[0])
    shared = min(t_real[-1], t_sim[-1]) - max(t_real[0], t_sim[0])
    length = min(t_real[-1] - t_real[0], t_sim[-1] - t_sim[0])
    near, chance = np.abs(lags) <= settings.alignment.farthest_s, _chance(a, b)
    least = [float(np.clip(np.tanh(z * chance), own.least_correlation, own.most_demanded)) for z in own.alike_sigma]
    if shared > max(own.least_s, 0.5 * length) and near.any() and np.abs(correlation[near]).max() > least[0]:
        return float(lags[near][np.argmax(np.abs(correlation[near]))]), None
    best = int(np.argmax(correlation))
    if correlation[best] < least[1]:
        raise DataError(
            f"recording and simulation of {names[0]} are not alike (correlation {correlation[best]:.2f} at best; two unrelated"
            f" motions reach {least[1]:.2f})",
            where=names[0],
            expected="one motion",
            fix="Simulate what was recorded, or choose another field",
        )
    return 0.0, -float(lags[best])


def _chance(a: Float64[np.ndarray, "k n"], b: Float64[np.ndarray, "k m"]) -> float:
    """Deviation of the correlation of two independent signals with these spectra."""
    n = min(a.shape[1], b.shape[1])
    variances = [dependent_samples(x, y) / n for x, y in zip(a, b, strict=True)]
    return float(np.sqrt(np.mean(variances) / len(variances)))


def _smooth(t_s: Column, values: Column, rate_hz: float) -> Float64[np.ndarray, " _"]:
    """On an even clock, without its mean."""
    at = np.arange(t_s[0], t_s[-1], 1.0 / rate_hz)
    even = np.interp(at, t_s, values)
    return np.asarray(even - even.mean())
