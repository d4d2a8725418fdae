"""Duplicate messages: a stamp that one of the last messages has."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from imutool.cleaning.finding import Finding, Intervals
from imutool.cleaning.rule import Rule, TopicSummary
from imutool.cleaning.samples import Samples, joined

MEMORY = 1024  # messages: what a recorder sends again, it sends soon


class Duplicates(Rule):
    """Rule for duplicates: it keeps the first of equal stamps.

    A message sent again later is a duplicate too, not time that goes back. Another message with an earlier stamp is left to the
    rule for those.
    """

    place = 10

    def __init__(self) -> None:
        super().__init__()
        self._places, self._same = Intervals(), 0

    def __call__(self, stream: Iterable[Samples]) -> Iterator[Samples]:
        """Yield the samples without duplicates."""
        before: Samples | None = None
        for samples in stream:
            both = samples if before is None else joined([before, samples])
            seen = 0 if before is None else len(before.number)
            _, first, which = np.unique(both.stamp_ns, return_index=True, return_inverse=True)
            original = first[which]
            repeated = original[seen:] != np.arange(seen, len(both.number))
            if repeated.any():
                values = both.values.view(np.int64)
                same = (values[seen:] == values[original[seen:]]).all(axis=1)
                repeated &= same | (both.stamp_ns == np.maximum.accumulate(both.stamp_ns))[seen:]
                self._same += int((same & repeated).sum())
                self._places.add(samples.number[repeated], samples.stamp_ns[repeated])
                self.dropped.append(samples.number[repeated])
            kept = samples.where(~repeated)
            before = both.where(slice(max(0, len(both.number) - MEMORY), None))
            yield kept

    def findings(self, whole: TopicSummary) -> Iterator[Finding]:
        """Finding with the number of bitwise equal samples."""
        if self._places.count:
            what = "samples with a stamp that an earlier one has"
            values = {"identical": self._same}
            yield Finding("duplicates", "warning", what, **self._places.where(), values=values, action="dropped")
