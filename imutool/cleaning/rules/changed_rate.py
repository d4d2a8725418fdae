"""Changed sample rate: stretches at another rate than most of the log."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.cleaning.finding import MAX_INTERVALS, Finding
from imutool.cleaning.rule import Rule, TopicSummary
from imutool.cleaning.samples import Samples
from imutool.recording.columns import median, true_ranges

PART = 64  # samples whose median period is one row
CHANGE = 1.2  # times the usual period, or the usual period so many times this one
MIN_PARTS = 4  # in a row
DISTRUST = 0.02  # of the samples: a model knows one rate


class ChangedRate(Rule):
    """Rule for a changed sample rate; it only reports.

    A bias model has one rate, so a large share at another rate makes the log untrusted.
    """

    place = 90

    def __init__(self) -> None:
        super().__init__()
        self._rows: list[Float64[np.ndarray, " m"]] = []  # median periods
        self._ends: list[Int64[np.ndarray, "m 2"]] = []
        self._waiting = np.zeros(0, np.int64)

    def see(self, samples: Samples) -> None:
        """Take one median period for each part."""
        stamp = np.concatenate([self._waiting, samples.stamp_ns])
        parts = max(len(stamp) - 1, 0) // PART
        if parts:
            self._rows.append(median(np.diff(stamp[: parts * PART + 1]).reshape(parts, PART), axis=1))
            edges = stamp[: parts * PART + 1 : PART]
            self._ends.append(np.column_stack([edges[:-1], edges[1:]]))
        self._waiting = stamp[parts * PART :]

    def findings(self, whole: TopicSummary) -> Iterator[Finding]:
        """Finding with the rates; its ends are known to within a part."""
        if not self._rows:
            return
        period, ends = np.concatenate(self._rows), np.concatenate(self._ends)
        usual = float(median(period))
        other = (period > CHANGE * usual) | (period * CHANGE < usual)
        stretches = [(a, b) for a, b in true_ranges(other) if b - a >= MIN_PARTS]
        if not stretches:
            return
        intervals = tuple((int(ends[a, 0]), int(ends[b - 1, 1])) for a, b in stretches)
        last = len(ends) - 1  # the change itself lies in a part before or after
        whole.other_rate_ns = [(int(ends[max(a - 1, 0), 0]), int(ends[min(b, last), 1])) for a, b in stretches]
        count = PART * sum(b - a for a, b in stretches)
        share = count / whole.motion.samples
        rates = [float(1e9 / median(period[a:b])) for a, b in stretches]
        distrust = f"the rate changes, {100 * share:.0f} % of the samples have another" if share > DISTRUST else ""
        yield Finding(
            "changed_rate",
            "error" if distrust else "warning",
            "samples at another rate",
            count,
            intervals[:MAX_INTERVALS],
            max(0, len(stretches) - MAX_INTERVALS),
            {"usual_hz": 1e9 / usual, "rates_hz": rates[:MAX_INTERVALS], "share": share},
            confidence=0.95,
            distrust=distrust,
        )
