"""Stamps that jitter while samples do not, told from a recording alone.

A sample taken late reads what the motion is by then: it is off the line through its neighbours by slope times delay. Samples
that were taken evenly lie on that line, whatever their stamps say. Poses are not asked: they know nothing of a millisecond.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from scipy.signal import savgol_filter
from scipy.stats import norm

from imutool.diagnosis.estimation.alignment import Pair
from imutool.diagnosis.estimation.timestamps import LEAST_JITTER_S, even
from imutool.diagnosis.result import Estimate, Finding, HeldOut

AROUND, DEGREE = 15, 3  # samples of a line, and what it may bend
EVENLY = 5.0  # standard deviations by which samples must be nearer to even than to their stamps
LEAST_ROWS = 100
TINY = 1e-300


def late_stamps(pairs: Sequence[Pair]) -> list[Finding]:
    """`timestamp_jitter` with its standard deviation (s), where stamps are uneven and samples are seen not to be."""
    off = [pair.stamp_s - even(pair.stamp_s)[0] for pair in pairs]
    if min(float(x.std()) for x in off) < LEAST_JITTER_S:
        return []
    followed, weight = 0.0, 0.0
    for pair, late in zip(pairs, off, strict=True):
        for column in pair.real.T:
            share, size = _followed(column, late, pair.period_s)
            followed, weight = followed + share * size, weight + size
    if weight <= 0.0:
        return []
    share, sigma = followed / weight, 1.0 / np.sqrt(weight)
    if share > 0.5 or 1.0 - share < EVENLY * sigma:
        return []
    every = np.concatenate(off)
    std = float(every.std())
    length = sum(float(pair.stamp_s[-1] - pair.stamp_s[0]) for pair in pairs)
    chance = float(norm.sf((1.0 - share) / sigma))
    told = {"std": Estimate(std, std / np.sqrt(2.0 * len(every)), "s")}
    nothing = HeldOut(0.0, 0.0, "-", round(length, 1))
    return [Finding("timestamp_jitter", "both", 0.0, chance, chance, told, "stamps jitter, samples do not", nothing)]


def _followed(column: Float64[np.ndarray, " n"], late_s: Float64[np.ndarray, " n"], period_s: float) -> tuple[float, float]:
    """How much of their stamps' lateness samples took part in, between 0 and 1, and one over the variance of that."""
    if len(column) < LEAST_ROWS:
        return 0.0, 0.0
    slope = savgol_filter(column, AROUND, DEGREE, deriv=1, delta=period_s)
    moved = slope * late_s
    moved = moved - savgol_filter(moved, AROUND, DEGREE)
    rest = column - savgol_filter(column, AROUND, DEGREE)
    size = float(moved @ moved)
    share = float(moved @ rest) / max(size, TINY)
    left = float(np.mean((rest - share * moved) ** 2))
    return share, size / max(left, TINY)
