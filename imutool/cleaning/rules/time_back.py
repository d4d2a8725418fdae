"""Decreasing stamps, stamps far ahead of all later ones, and clocks that were reset.

A sample is *ahead* when most of the next samples come before it: then it is the one that is wrong, and without this a single
stamp of the year 2100 would cost the rest of the log. A sample is *late* when it does not come after all that were kept.

Late samples in a row, after which the stamps go on where the row ended, are motion on earlier times: the clock was set
back, and what is dropped is missing. Where the clock goes back by more than a second and stays there, or forward by more than a
day, an *epoch* ends. Of several epochs those are kept that together hold most samples in increasing time; that needs the whole
log, so such a log is read twice.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from imutool.array_types import Bool, Int64
from imutool.cleaning.finding import Finding, Intervals
from imutool.cleaning.rule import Rule, TopicSummary
from imutool.cleaning.samples import Samples, padded
from imutool.recording import nanoseconds
from imutool.recording.columns import median, true_ranges

AHEAD = 32  # samples asked whether one is ahead of them
SET_BACK_NS = nanoseconds(1.0)
LONGEST_PAUSE_NS = nanoseconds(86400.0)
MAX_EPOCHS = 1000
SET_BACK = 8  # late samples in a row, at least, of a clock that was set back


@dataclass
class Epoch:
    """Samples on one setting of the clock: their numbers `[first, end)`, stamps and count."""

    first: int
    end: int
    start_ns: int
    last_ns: int
    count: int


class NonMonotonic(Rule):
    """Leaves samples whose stamps strictly increase.

    Args:
        skip: ranges of message numbers `[first, end)` to be dropped whole; given in the second pass, where epochs are no more
            looked for.
    """

    place = 20

    def __init__(self, skip: Sequence[tuple[int, int]] | None = None) -> None:
        super().__init__()
        self._skip = skip
        self.epochs: list[Epoch] = []
        self._late, self._ahead, self._other = Intervals(), Intervals(), Intervals()
        self._furthest_s = 0.0
        self._run: tuple[int, int, int] | None = None  # of late samples up to the last one: count, how far back, last stamp
        self.set_back_ns: list[int] = []
        self._last: int | None = None
        self._late_ns: list[Int64[np.ndarray, " n"]] = []

    def __call__(self, stream: Iterable[Samples]) -> Iterator[Samples]:
        """The samples in order of time."""
        for around, core in padded(self._without_skipped(stream), AHEAD):
            ahead = _ahead(around.stamp_ns)
            place = around._replace(stamp_ns=_before(around.stamp_ns, ahead)).where(core)
            self._drop(self._ahead, place, ahead[core])
            samples = around.where(core).where(~ahead[core])
            late = self._judge(samples)
            self._drop(self._late, samples, late)
            self._late_ns.append(samples.stamp_ns[late])
            yield samples.where(~late)

    def _without_skipped(self, stream: Iterable[Samples]) -> Iterator[Samples]:
        for samples in stream:
            skipped = np.zeros(len(samples.number), bool)
            for first, end in self._skip or ():
                skipped |= (samples.number >= first) & (samples.number < end)
            self._drop(self._other, samples, skipped)
            yield samples.where(~skipped)

    def _drop(self, places: Intervals, samples: Samples, mask: Bool[np.ndarray, " n"]) -> None:
        if mask.any():
            places.add(samples.number[mask], samples.stamp_ns[mask])
            self.dropped.append(samples.number[mask])

    def _judge(self, samples: Samples) -> Bool[np.ndarray, " n"]:
        """Which samples are late; where the clock was set, a new epoch begins instead."""
        stamp, late = samples.stamp_ns, np.zeros(len(samples.stamp_ns), bool)
        first = 0
        while first < len(stamp):
            top = stamp[first] - 1 if self._last is None else self._last
            before = np.maximum.accumulate(np.concatenate([[top], stamp[first:]]))[:-1]
            end = first + self._epoch_ends(stamp[first:], before)
            behind = stamp[first:end] <= before[: end - first]
            late[first:end] = behind
            if behind.any():
                away = (before[: end - first] - stamp[first:end])[behind]
                self._furthest_s = max(self._furthest_s, float(away.max()) * 1e-9)
            self._note_set_backs(stamp[first:end], before[: end - first], behind)
            self._extend(samples, first, ~behind)
            if end < len(stamp):
                self.epochs.append(Epoch(int(samples.number[end]), 0, int(stamp[end]), int(stamp[end]), 0))
                self._last = int(stamp[end]) - 1
            first = end
        return late

    def _note_set_backs(
        self, stamp: Int64[np.ndarray, " n"], before: Int64[np.ndarray, " n"], behind: Bool[np.ndarray, " n"]
    ) -> None:
        """Notes late samples in a row after which the stamps go on from the last of them."""
        if not len(stamp) or not (behind.any() or self._run):
            return
        for first, end in true_ranges(behind) if behind[0] else [(0, 0), *true_ranges(behind)]:
            count, back_ns, last_ns = self._run if self._run and first == 0 else (0, 0, 0)
            if end > first:
                back_ns = back_ns or int(before[first] - stamp[first])
                count, last_ns = count + end - first, int(stamp[end - 1])
            self._run = (count, back_ns, last_ns) if end == len(stamp) else None
            if self._run is None and count >= SET_BACK and stamp[end] - last_ns < back_ns / 2:
                self.set_back_ns.append(back_ns)

    def _epoch_ends(self, stamp: Int64[np.ndarray, " n"], before: Int64[np.ndarray, " n"]) -> int:
        """The row with which another epoch begins; the number of rows where none does."""
        if self._skip is not None or len(self.epochs) >= MAX_EPOCHS:
            return len(stamp)
        back = stamp <= before - SET_BACK_NS
        for row in np.flatnonzero(back | (stamp - before > LONGEST_PAUSE_NS)):
            after = stamp[row : row + AHEAD]
            if not back[row] or (len(after) > 1 and median(after) <= before[row]):
                return int(row) if row or self.epochs else len(stamp)
        return len(stamp)

    def _extend(self, samples: Samples, first: int, kept: Bool[np.ndarray, " n"]) -> None:
        if not kept.any():
            return
        rows = np.flatnonzero(kept) + first
        if not self.epochs:
            start = int(samples.stamp_ns[rows[0]])
            self.epochs.append(Epoch(int(samples.number[rows[0]]), 0, start, start, 0))
        epoch = self.epochs[-1]
        epoch.end, epoch.last_ns = int(samples.number[rows[-1]]) + 1, int(samples.stamp_ns[rows[-1]])
        epoch.count += len(rows)
        self._last = epoch.last_ns

    def second_pass(self, messages: int) -> NonMonotonic | None:
        """The rule that skips the epochs left out; None where the clock was never set."""
        return NonMonotonic(left_out(self.epochs, messages)) if len(self.epochs) > 1 else None

    def findings(self, whole: TopicSummary) -> Iterator[Finding]:
        """Late samples, samples ahead, and epochs left out."""
        if self._late.count:
            whole.late_ns = np.sort(np.concatenate(self._late_ns))
            values: dict[str, float] = {"furthest_back_s": self._furthest_s}
            what = "samples whose stamp goes back"
            if self.set_back_ns:
                missing_s = sum(self.set_back_ns) * 1e-9
                values |= {"set_back": len(self.set_back_ns), "missing_s": missing_s}
                what += f"; the clock was set back, and {missing_s:.3g} s of motion are missing"
            yield Finding("time_back", "warning", what, **self._late.where(), values=values, action="dropped")
        if self._ahead.count:
            what = "samples with a stamp ahead of those that follow"
            yield Finding("time_back", "warning", what, **self._ahead.where(), action="dropped", confidence=0.9)
        if self._other.count:
            share = self._other.count / whole.messages
            what = "samples from before or after the clock was set, apart from the rest by more than a pause explains"
            many = share > whole.settings.max_invalid_share
            yield Finding(
                "time_back",
                "error",
                what,
                **self._other.where(),
                values={"share": share},
                action="dropped",
                confidence=0.8,
                distrust="its clock was set; imutool debias without --clean keeps each stretch" if many else "",
            )


def _ahead(stamp_ns: Int64[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Samples stamped at or after most of the next 32 samples (of two at least).

    Only where what follows them goes on after what came before them: else the clock was set back, and they are right.
    """
    n = len(stamp_ns)
    if n < 3 or (np.diff(stamp_ns) > 0).all():
        return np.zeros(n, bool)
    later = sliding_window_view(np.concatenate([stamp_ns, np.full(AHEAD, 2**63 - 1)]), AHEAD + 1)[:n, 1:]
    behind: Int64[np.ndarray, " n"] = (later <= stamp_ns[:, None]).sum(axis=1)
    following = np.minimum(AHEAD, n - 1 - np.arange(n))
    ahead: Bool[np.ndarray, " n"] = (behind >= 2) & (2 * behind > following)
    for first, end in true_ranges(ahead):
        if first and end < n and stamp_ns[end] <= stamp_ns[first - 1]:
            ahead[first:end] = False
    return ahead


def _before(stamp_ns: Int64[np.ndarray, " n"], ahead: Bool[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """Stamp of the last sample before each that is not ahead."""
    if not ahead.any() or ahead.all():
        return stamp_ns
    row = np.maximum.accumulate(np.where(ahead, 0, np.arange(len(ahead))))
    row[: int(np.argmin(ahead))] = int(np.argmin(ahead))
    return stamp_ns[row]


def left_out(epochs: Sequence[Epoch], messages: int) -> list[tuple[int, int]]:
    """The ranges of message numbers outside the epochs that together keep most samples.

    The longest path over epochs in file order: what follows must reach further in time, and not after more than a day; of
    one that overlaps with its predecessor the part after it counts.
    """
    best, before = np.zeros(len(epochs)), np.full(len(epochs), -1)
    for j, later in enumerate(epochs):
        best[j] = later.count
        for i, earlier in enumerate(epochs[:j]):
            if later.last_ns <= earlier.last_ns or later.start_ns - earlier.last_ns > LONGEST_PAUSE_NS:
                continue
            span = max(later.last_ns - later.start_ns, 1)
            after = (later.last_ns - max(later.start_ns, earlier.last_ns)) / span
            if best[i] + after * later.count > best[j]:
                best[j], before[j] = best[i] + after * later.count, i
    kept, at = [], int(np.argmax(best))
    while at >= 0:
        kept.append(epochs[at])
        at = int(before[at])
    edges = [0, *(edge for epoch in reversed(kept) for edge in (epoch.first, epoch.end)), messages]
    return [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > a]
