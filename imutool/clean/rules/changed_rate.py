"""Stretches in which the samples come at another rate than in most of the log."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from imutool.clean.finding import MAX_INTERVALS, Finding, runs
from imutool.clean.rules._base import Rule, Whole
from imutool.clean.samples import Samples

PART = 256  # samples whose median period is one row
CHANGE = 1.2  # times the usual period, or the usual period so many times this one
LEAST_PARTS = 3  # in a row
DISTRUST = 0.02  # of the samples: a model knows one rate


class ChangedRate(Rule):
    """Only said; a log with much of it is not to be trusted, since a bias model is made for one rate."""

    place = 90

    def __init__(self) -> None:
        super().__init__()
        self._rows: list[tuple[float, int, int, int]] = []
        self._waiting = np.zeros(0, np.int64)

    def see(self, samples: Samples) -> None:
        """One median a part."""
        stamp = np.concatenate([self._waiting, samples.stamp_ns])
        first = 0
        while len(stamp) - first > PART:
            self._row(stamp[first : first + PART + 1])
            first += PART
        self._waiting = stamp[first:]

    def _row(self, stamp: np.ndarray) -> None:
        self._rows.append((float(np.median(np.diff(stamp))), int(stamp[0]), int(stamp[-1]), len(stamp) - 1))

    def findings(self, whole: Whole) -> Iterator[Finding]:
        """One, with the rates."""
        if len(self._waiting) > PART // 4:
            self._row(self._waiting)
        if not self._rows:
            return
        table = np.array(self._rows)
        usual = float(np.median(np.repeat(table[:, 0], table[:, 3].astype(int) // (PART // 4))))
        other = (table[:, 0] > CHANGE * usual) | (table[:, 0] * CHANGE < usual)
        stretches = [(a, b) for a, b in runs(other) if b - a >= min(LEAST_PARTS, len(table))]
        if not stretches:
            return
        count = int(sum(table[a:b, 3].sum() for a, b in stretches))
        share = count / whole.motion.samples
        rates = [float(1e9 / np.median(table[a:b, 0])) for a, b in stretches]
        distrust = f"the rate changes, {100 * share:.0f} % of the samples have another" if share > DISTRUST else ""
        yield Finding(
            "changed_rate",
            "error" if distrust else "warning",
            "samples at another rate",
            count,
            tuple((self._rows[a][1], self._rows[b - 1][2]) for a, b in stretches[:MAX_INTERVALS]),
            max(0, len(stretches) - MAX_INTERVALS),
            {"usual_hz": 1e9 / usual, "rates_hz": rates[:MAX_INTERVALS], "share": share},
            sure=0.95,
            distrust=distrust,
        )
