"""Missing samples: steps between stamps that are longer than the sensor's period."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from imutool.array_types import Int64
from imutool.cleaning.finding import MAX_INTERVALS, Finding
from imutool.cleaning.rule import Rule, TopicSummary
from imutool.cleaning.samples import Samples
from imutool.cleaning.stamp_line import batch_size, batch_words, bunched, lost_samples, usual_period
from imutool.recording import nanoseconds
from imutool.recording.columns import MAX_GAP_S
from imutool.recording.sample_order import Ticked, ticked

MISSING = "samples missing"
MISSING_STEP = 1.5  # a step of this many median periods or more has lost samples
FEWEST_STEPS = 16  # for a median of their own
MAX = 100_000  # gaps held in memory; of a log with more, the rest is only counted
SERIOUS_SHARE, SERIOUS_S = 1e-3, 1.0
PAUSE_NS = nanoseconds(60.0)  # nobody recorded: nothing is missing


class Gap(NamedTuple):
    """Gap between neighbours: number of the second, both stamps, number of missing samples."""

    number: int
    first_ns: int
    last_ns: int
    missing: int


class Gaps(Rule):
    """Rule for missing samples between the remaining neighbours.

    Samples that another rule dropped are not missing.

    Nor are samples that came too late, nor anything where the clock of the stamps stepped or the rate is another.
    """

    place = 100

    def __init__(self) -> None:
        super().__init__()
        self.missing = 0
        self._last: tuple[int, int] | None = None
        self._period_ns = 0.0
        self._coarse: Ticked | None = None
        self._within, self._steps = 0, 0  # a batch of stamps, and in all
        self._rows: list[Gap] = []
        self._pauses: list[Gap] = []

    def see(self, samples: Samples) -> None:
        """Compare the steps within a block with their median."""
        if not len(samples.number):
            return
        number, stamp = samples.number, samples.stamp_ns
        if self._last is not None:
            number, stamp = np.append(self._last[0], number), np.append(self._last[1], stamp)
        self._last = int(number[-1]), int(stamp[-1])
        steps = np.diff(stamp)
        within, near = bunched(steps)
        self._within, self._steps = self._within + within, self._steps + near
        if len(steps) >= FEWEST_STEPS or (len(steps) and not self._period_ns):
            self._period_ns = usual_period(stamp)
        if not self._period_ns:
            return
        self._coarse = ticked(stamp, self._coarse)
        lost = missing(stamp, self._period_ns, self._coarse)
        lost = np.where(lost > 0, np.maximum(lost - (np.diff(number) - 1), 0), 0)
        for row in np.flatnonzero(steps > PAUSE_NS)[: MAX - len(self._pauses)]:
            self._pauses.append(Gap(int(number[row + 1]), int(stamp[row]), int(stamp[row + 1]), 0))
        self.missing += int(lost.sum())
        for row in np.flatnonzero(lost)[: MAX - len(self._rows)]:
            self._rows.append(Gap(int(number[row + 1]), int(stamp[row]), int(stamp[row + 1]), int(lost[row])))

    def findings(self, whole: TopicSummary) -> Iterator[Finding]:
        """Findings about missing samples, with the longest gaps, about pauses, and about stamps in batches."""
        pauses = [(row.first_ns, row.last_ns) for row in self._pauses if row.number not in whole.jumps]
        if pauses:
            what = f"pauses of more than {PAUSE_NS * 1e-9:g} s"
            left_out = max(0, len(pauses) - MAX_INTERVALS)
            yield Finding("gaps", "note", what, len(pauses), tuple(pauses[:MAX_INTERVALS]), left_out, confidence=0.9)
        if (size := batch_size(self._within, self._steps)) > 1.0:
            what = batch_words(size)
            distrust = f"{what}; imutool convert LOG OUT --restamp corrects it"
            yield Finding("gaps", "error", what, self._within, values={"batch": size}, distrust=distrust, confidence=0.9)
            return  # nothing shows how many samples are missing
        rows = [row for row in (self._left(row, whole) for row in self._rows) if row.missing]
        count = self.missing + sum(row.missing for row in rows) - sum(row.missing for row in self._rows)
        if not rows:
            return
        longest = sorted(rows, key=lambda row: row.first_ns - row.last_ns)[:MAX_INTERVALS]
        longest_s = (longest[0].last_ns - longest[0].first_ns) * 1e-9
        share = count / (count + whole.motion.samples)
        distrust = f"{100 * share:.0f} % of the samples are missing" if share > whole.settings.max_missing_share else ""
        serious = share > SERIOUS_SHARE or longest_s > SERIOUS_S
        yield Finding(
            "gaps",
            "error" if distrust else "warning" if serious else "note",
            MISSING,
            count,
            tuple(sorted((row.first_ns, row.last_ns) for row in longest)),
            len(rows) - len(longest),
            {"gaps": len(rows), "longest_s": longest_s, "share": share},
            distrust=distrust,
        )

    def _left(self, gap: Gap, whole: TopicSummary) -> Gap:
        """Gap without the samples that late stamps, clock jumps or another rate explain."""
        at_other_rate = any(first <= gap.first_ns and gap.last_ns <= last for first, last in whole.other_rate_ns)
        if gap.number in whole.jumps or at_other_rate:
            return gap._replace(missing=0)
        late = int(np.diff(np.searchsorted(whole.late_ns, [gap.first_ns + 1, gap.last_ns]))[0])
        return gap._replace(missing=max(gap.missing - late, 0))


def missing(stamp_ns: Int64[np.ndarray, " n"], period_ns: float, coarse: Ticked | None = None) -> Int64[np.ndarray, " m"]:
    """Number of samples that are lost in each step.

    0 for steps below 1.5 periods, for those that a clock in `coarse` ticks makes, for pauses, and where a stamp is late that
    those behind it make up for.
    """
    steps_ns = np.diff(stamp_ns)
    is_long = steps_ns > coarse.period_ns if coarse else steps_ns >= MISSING_STEP * period_ns
    return lost_samples(stamp_ns, period_ns, is_long & (steps_ns <= PAUSE_NS), coarse)


def pause_words(steps_ns: Int64[np.ndarray, " n"]) -> list[str]:
    """Pauses of the recorder among steps of stamps; a longer step is a jump of the clock."""
    pauses = steps_ns[(steps_ns > PAUSE_NS) & (steps_ns <= nanoseconds(MAX_GAP_S))]
    longest = f", the longest of {pauses.max() * 1e-9:.0f} s" if len(pauses) else ""
    return [f"pauses of more than {PAUSE_NS * 1e-9:g} s: {len(pauses)}{longest}"] if longest else []
