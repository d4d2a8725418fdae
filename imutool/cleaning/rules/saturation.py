"""Saturation: axes at the end of their range."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np

from imutool.array_types import Float64
from imutool.cleaning.finding import Finding, Intervals
from imutool.cleaning.rule import Rule, TopicSummary
from imutool.cleaning.rules.not_finite import AXES
from imutool.cleaning.samples import Samples
from imutool.units import ASCII_UNITS, SENSORS

SAMPLES = 5
PILE = 2.0
LEVELS = 10
FEW_SAMPLES, FAR, FINE_LEVELS = 3, 0.05, 64  # 64 levels: one step of the sensor is then at most 3 % of its range
RULE = (
    f"an axis is saturated at its own largest or smallest value where at least {SAMPLES} samples hold exactly "
    f"that value, more than {PILE:g} times as many as either of the next two values, among at least "
    f"{LEVELS} values, and it is not the median; {FEW_SAMPLES} samples are enough among at least {FINE_LEVELS} values, "
    f"where the next value is {100 * FAR:g} % nearer to zero"
)
KEPT = 3  # values at either end: the last one, and the two it is compared with


class Ends:
    """Extreme values of an axis and their counts, over samples that come in parts."""

    def __init__(self) -> None:
        self._few = np.zeros(0)  # distinct values, until there are enough of them
        self._ends = {-1: (np.zeros(0), np.zeros(0, np.int64)), 1: (np.zeros(0), np.zeros(0, np.int64))}
        self._samples = 0

    def see(self, values: Float64[np.ndarray, " n"]) -> None:
        """Add values; those that are not finite are skipped."""
        levels, counts = np.unique(values[np.isfinite(values)], return_counts=True)
        self._samples += int(counts.sum())
        if len(self._few) < FINE_LEVELS:
            self._few = np.union1d(self._few, levels)[:FINE_LEVELS]
        for side, (known, times) in self._ends.items():
            near = slice(None, KEPT) if side < 0 else slice(-KEPT, None)
            both, which = np.unique(np.concatenate([known, levels[near]]), return_inverse=True)
            total = np.bincount(which, np.concatenate([times, counts[near]])).astype(np.int64)
            self._ends[side] = both[near], total[near]

    def limit(self, side: int) -> float | None:
        """Saturation limit (`RULE`) at the low (-1) or high (1) end; None without saturation."""
        if len(self._few) < LEVELS:
            return None
        levels, counts = self._ends[side]
        end, near, before = (0, counts[1:], levels[1]) if side < 0 else (-1, counts[:-1], levels[-2])
        far = len(self._few) >= FINE_LEVELS and side * before < (1.0 - FAR) * side * levels[end]
        piled = counts[end] >= (FEW_SAMPLES if far else SAMPLES) and counts[end] > PILE * near.max()
        median = 2 * counts[end] > self._samples
        return float(levels[end]) if piled and not median else None

    def extreme(self, side: int) -> float:
        """Extreme value so far at an end."""
        levels = self._ends[side][0]
        return float(levels[0 if side < 0 else -1]) if len(levels) else np.nan


class Saturation(Rule):
    """Rule for saturated samples; it keeps them.

    The true value is at least this large, and a bias model cannot correct it.
    """

    place = 110

    def __init__(self) -> None:
        super().__init__()
        self._ends = [Ends() for _ in AXES]
        self._places: dict[tuple[int, int], tuple[float, Intervals]] = {}

    def see(self, samples: Samples) -> None:
        """Note the samples at the extreme value so far; a larger value clears them."""
        for axis, ends in enumerate(self._ends):
            values = samples.values[:, axis]
            ends.see(values)
            for side in (-1, 1):
                level = ends.extreme(side)
                known = self._places.get((axis, side))
                if known is None or known[0] != level:
                    known = self._places[axis, side] = level, Intervals()
                at = values == level
                known[1].add(samples.number[at], samples.stamp_ns[at])

    def findings(self, whole: TopicSummary) -> Iterator[Finding]:
        """Findings by axis and end."""
        for axis, side in product(range(6), (-1, 1)):
            limit = self._ends[axis].limit(side)
            if limit is not None:
                places = self._places[axis, side][1]
                limit *= float(whole.scale[axis])
                what = f"samples with {AXES[axis]} at the end of its range, {limit:.4g} {ASCII_UNITS[SENSORS[axis // 3]]}"
                values = {"axis": AXES[axis], "limit": limit}
                yield Finding("saturation", "warning", what, **places.where(), values=values, confidence=0.9)
