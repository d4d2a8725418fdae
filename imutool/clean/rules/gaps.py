"""Missing samples: steps between stamps that are longer than the sensor's period."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64, Int64

from imutool.clean.finding import MAX_INTERVALS, Finding
from imutool.clean.rules._base import Rule, Whole
from imutool.clean.samples import Samples

MISSING_STEP = 1.5  # a step of this many median periods or more has lost samples
FEWEST_STEPS = 16  # for a median of their own
SHORTEST_KEPT = 100_000  # gaps held in memory; a log with more is not worth their places


class Gaps(Rule):
    """Counts what is missing between neighbours that are left; what another rule dropped there is not missing."""

    place = 100

    def __init__(self) -> None:
        super().__init__()
        self.missing = 0
        self._last: tuple[int, int] | None = None
        self._period_ns = 0.0
        self._rows: list[tuple[int, int, int, int]] = []

    def see(self, samples: Samples) -> None:
        """Steps within a block are measured against the median of the block."""
        if not len(samples.number):
            return
        number, stamp = samples.number, samples.stamp_ns
        if self._last is not None:
            number, stamp = np.append(self._last[0], number), np.append(self._last[1], stamp)
        self._last = int(number[-1]), int(stamp[-1])
        steps = np.diff(stamp)
        if len(steps) >= FEWEST_STEPS or (len(steps) and not self._period_ns):
            self._period_ns = float(np.median(steps))
        if not self._period_ns:
            return
        lost = missing(steps, self._period_ns)
        lost = np.where(lost > 0, np.maximum(lost - (np.diff(number) - 1), 0), 0)
        self.missing += int(lost.sum())
        for row in np.flatnonzero(lost)[: SHORTEST_KEPT - len(self._rows)]:
            self._rows.append((int(number[row + 1]), int(stamp[row]), int(stamp[row + 1]), int(lost[row])))

    def findings(self, whole: Whole) -> Iterator[Finding]:
        """One; a step of the stamps' own clock, where nothing is missing, is `clock_jumps`' business."""
        rows = [row for row in self._rows if row[0] not in whole.jumps]
        self.missing -= sum(row[3] for row in self._rows if row[0] in whole.jumps)
        if not self.missing:
            return
        longest = sorted(rows, key=lambda row: row[1] - row[2])[:MAX_INTERVALS]
        share = self.missing / (self.missing + whole.motion.samples)
        limit = whole.rules.max_missing_share
        distrust = f"{100 * share:.0f} % of the samples are missing" if share > limit else ""
        yield Finding(
            "gaps",
            "error" if distrust else "warning" if share > 1e-3 or longest[0][2] - longest[0][1] > 1e9 else "note",
            "samples missing",
            self.missing,
            tuple(sorted((first, last) for _, first, last, _ in longest)),
            len(rows) - len(longest),
            {"gaps": len(rows), "longest_s": (longest[0][2] - longest[0][1]) * 1e-9, "share": share},
            distrust=distrust,
        )


def missing(steps_ns: Int64[np.ndarray, " n"], period_ns: float) -> Float64[np.ndarray, " n"]:
    """How many samples would fill each step; none where it is shorter than 1.5 periods."""
    periods = steps_ns / period_ns
    return np.where(periods >= MISSING_STEP, np.round(periods - 1.0), 0.0)
