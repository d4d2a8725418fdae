"""Clock jumps: steps between the stamps and the recorder's log time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from imutool.cleaning.finding import MAX_INTERVALS, Finding
from imutool.cleaning.rule import Rule, TopicSummary
from imutool.cleaning.samples import Samples
from imutool.recording.columns import median

PART = 256  # samples whose median delay is one row
AROUND = 3  # rows on either side of a step, so that a burst that comes late is none
MIN_S = 0.02
SCATTERS = 8.0  # of the delay within rows
NOT_ITS_PERIOD = 0.5  # of a jump, by which the stamps' own step differs from what the rate says: then it is they that jump


class ClockJumps(Rule):
    """Rule for clock jumps; it only reports.

    Where stamps jump forward, `dt` jumps too: the bias starts anew, as after a gap.
    """

    place = 80

    def __init__(self) -> None:
        super().__init__()
        self._rows: list[tuple[float, float, int, int, int, int, int]] = []
        self._last: tuple[int, int, int] | None = None
        self._waiting: list[np.ndarray] = []

    def see(self, samples: Samples) -> None:
        """Record median delay, scatter and largest change of each part."""
        self._waiting.append(np.column_stack([samples.number, samples.stamp_ns, samples.log_ns]))
        rows = np.concatenate(self._waiting)
        first = 0
        while len(rows) - first >= PART:
            self._row(rows[first : first + PART])
            first += PART
        self._waiting = [rows[first:]]

    def _row(self, table: np.ndarray) -> None:
        delay = table[:, 2] - table[:, 1]
        if self._last is None:
            self._last = int(delay[0]), int(table[0, 1]), int(table[0, 0]) - 1
        usual = float(median(delay))
        changes = np.abs(np.diff(delay, prepend=self._last[0]))
        at = int(np.argmax(changes))
        before_ns, before = self._last[1:] if at == 0 else (int(table[at - 1, 1]), int(table[at - 1, 0]))
        expected = int(median(np.diff(table[:, 1]))) * (int(table[at, 0]) - before)  # what was dropped took its time too
        scatter = float(median(np.abs(delay - usual)))
        self._rows.append((usual, scatter, int(changes[at]), int(table[at, 0]), before_ns, int(table[at, 1]), expected))
        self._last = int(delay[-1]), int(table[-1, 1]), int(table[-1, 0])

    def findings(self, whole: TopicSummary) -> Iterator[Finding]:
        """Findings about the stamps' clock and the recorder's clock."""
        if self._waiting and len(self._waiting[0]) > PART // 4:
            self._row(self._waiting[0])
        by_clock: dict[str, list[tuple[int, float, int, int]]] = {"stamp": [], "log time": []}
        for row, size_s in self._steps():
            _, _, _, number, first, last, expected = row
            stamps_jump = abs((last - first) - expected) * 1e-9 > NOT_ITS_PERIOD * abs(size_s)
            by_clock["stamp" if stamps_jump else "log time"].append((number, size_s, first, last))
        whole.jumps = frozenset(number for number, *_ in by_clock["stamp"])
        for clock, jumps in by_clock.items():
            if jumps:
                what = f"jumps of the {clock} clock against the other"
                sizes = [size if clock == "log time" else -size for _, size, *_ in jumps[:MAX_INTERVALS]]
                yield Finding(
                    "clock_jumps",
                    "warning" if clock == "stamp" else "note",
                    what,
                    len(jumps),
                    tuple((first, last) for _, _, first, last in jumps[:MAX_INTERVALS]),
                    max(0, len(jumps) - MAX_INTERVALS),
                    {"clock": clock, "jumps_s": sizes},
                    confidence=0.9,
                )

    def _steps(self) -> Iterator[tuple[tuple[float, float, int, int, int, int, int], float]]:
        """Lasting steps of the delay: row of the largest change, and step size (s)."""
        if len(self._rows) < 2:
            return
        level = np.array([row[0] for row in self._rows])
        minimum = max(MIN_S * 1e9, SCATTERS * float(median(np.array([row[1] for row in self._rows]))))
        k = 0
        while k + 1 < len(level):
            before, after = median(level[max(0, k + 1 - AROUND) : k + 1]), median(level[k + 1 : k + 1 + AROUND])
            if abs(level[k + 1] - level[k]) > minimum and abs(after - before) > minimum:
                row = max(self._rows[k], self._rows[k + 1], key=lambda row: row[2])
                yield row, float(after - before) * 1e-9
                k += 1
            k += 1
