"""Spikes: one to three samples in a row far outside their neighbours.

A spike of w samples leaves by one step and comes back by another of the opposite sign, and both are many times larger than
every other step nearby. Real shocks ring: over the training recordings of EuRoC (motors), TUM-VI (hand-held) and FETCH
(wheels on a floor), the smaller of the two steps is at most 4.8 times the largest other step within ten samples (FETCH; 2.2
on EuRoC, 2.1 on TUM-VI), whatever its size. A steep start of a motion comes back too late, and two spikes within ten samples
of one another hide each other: then they stay.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from imutool.array_types import Bool, Float64
from imutool.cleaning.finding import Finding, Intervals
from imutool.cleaning.rule import Rule, TopicSummary
from imutool.cleaning.rules.not_finite import AXES
from imutool.cleaning.samples import Samples, padded
from imutool.recording.columns import quantile

NEARBY = 10  # samples on either side
LONGEST = 3  # samples
TIMES = 8.0  # the largest step nearby
ORDINARY = 0.75  # quantile of the steps


class Spikes(Rule):
    """Rule that drops spikes; a spike on one axis drops the whole sample."""

    place = 50

    def __init__(self) -> None:
        super().__init__()
        self._places, self._by_axis, self._largest = Intervals(), np.zeros(6, np.int64), np.zeros(6)

    def __call__(self, stream: Iterable[Samples]) -> Iterator[Samples]:
        """Yield the samples without spikes."""
        for around, core in padded(stream, NEARBY + LONGEST + 1):
            spike, size = spikes(around.values)
            spiked = spike[core]
            samples = around.where(core)
            bad = np.asarray(spiked.any(axis=1))
            if bad.any():
                self._by_axis += spiked.sum(axis=0)
                self._largest = np.maximum(self._largest, np.where(spiked, size[core], 0.0).max(axis=0))
                self._places.add(samples.number[bad], samples.stamp_ns[bad])
                self.dropped.append(samples.number[bad])
            yield samples.where(~bad)

    def findings(self, whole: TopicSummary) -> Iterator[Finding]:
        """Finding with count and largest step by axis."""
        if self._places.count:
            axes = [i for i in range(6) if self._by_axis[i]]
            values = {
                "axes": {AXES[i]: int(self._by_axis[i]) for i in axes},
                "largest_step": {AXES[i]: float(self._largest[i]) for i in axes},
            }
            what = f"samples that stand out by {TIMES:g} times the largest step near them"
            yield Finding("spikes", "warning", what, **self._places.where(), values=values, action="dropped", confidence=0.95)


def spikes(values: Float64[np.ndarray, "n k"]) -> tuple[Bool[np.ndarray, "n k"], Float64[np.ndarray, "n k"]]:
    """Spike mask by axis, and the smaller of the two steps of each spike (0 elsewhere).

    Where the samples nearby hardly change (at rest, at the end of the range), an ordinary step must not stand out: three
    quarters of the steps that are not zero, over the whole block, are the least that counts as a step nearby.
    """
    n = len(values)
    mask, size = np.zeros(values.shape, bool), np.zeros(values.shape)
    if n < NEARBY:
        return mask, size
    step = np.diff(values, axis=0)
    magnitude = np.abs(step)
    ordinary = np.array([quantile(column[column > 0], ORDINARY) if column.any() else 0.0 for column in magnitude.T])
    edge = np.zeros((NEARBY, values.shape[1]))
    largest = sliding_window_view(np.concatenate([edge, magnitude, edge]), NEARBY, axis=0).max(axis=-1)  # of steps k-10..k-1
    for width in range(1, LONGEST + 1):
        first = np.arange(1, n - width)  # the step into it is first - 1, the step out of it first + width - 1
        into, out = step[first - 1], -step[first + width - 1]
        peak = np.where(into * out > 0, np.minimum(np.abs(into), np.abs(out)), 0.0)
        other = np.maximum(np.maximum(largest[first - 1], largest[first + width + NEARBY]), ordinary)
        rows, axes = np.nonzero(peak > TIMES * other)
        for shift in range(width):
            mask[first[rows] + shift, axes] = True
            size[first[rows] + shift, axes] = np.maximum(size[first[rows] + shift, axes], peak[rows, axes])
    return mask, size
