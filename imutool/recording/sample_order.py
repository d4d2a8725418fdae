"""Samples in the order of time; those of one stamp are spread at the sensor's rate.

A phone or a driver stamps on arrival, often in whole milliseconds, so that several samples have one stamp. The first of n
samples with a stamp T keeps it, and sample k goes to T + k s with s = (T' - T) / n, where T' is the next stamp. If the steps
are clearly more even then, all end at T instead, with s from the stamp before: such samples came late. Next to a gap s is
the median of the steps near it, so that a gap stays one. A first stamp that had begun before the recording has fewer samples:
they end at the next one. Any other sample that is alone with its stamp keeps it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from imutool.array_types import Bool, Float64, Int64
from imutool.recording.columns import clock_jumps, median, quantile

MAX_SET_BACK = 0.01  # share of samples that a clock which was set back may cost; of more they are several recordings
GAP_STEPS = 1.5  # median steps: a longer step holds a gap
NEAR = 64  # stamps whose median step counts: a logger may go on at another rate
CLEARLY = 0.9  # of the unevenness towards the next stamp: what is left at most where samples came late
MAX_TICKS, TICK_SPAN = 8, 256  # in a period of stamps that count in coarse ticks; samples, whose spans differ by a tick or two
MAX_ALIKE = 0.5  # share of the stamps with several samples from which on their number is that of a batch


@dataclass
class Cleaned:
    """Samples with finite values whose stamps increase; `rows` are their places as given."""

    t_ns: Int64[np.ndarray, " n"]
    values: Float64[np.ndarray, "n k"]
    rows: Int64[np.ndarray, " n"]
    notes: list[str] = field(default_factory=list)


def in_order(t_ns: Int64[np.ndarray, " n"], values: Float64[np.ndarray, "n k"], name: str, *, spread: bool = True) -> Cleaned:
    """Samples whose stamps increase; notes say how many were spread or left out, and why.

    Without `spread` only the first sample of a stamp is kept.
    """
    rows = np.flatnonzero(np.isfinite(values).all(axis=1))
    notes = _counted(len(t_ns) - len(rows), "that are not finite")
    begins = np.diff(t_ns[rows], prepend=t_ns[rows[:1]] - 1) != 0
    is_fresh = _is_fresh(t_ns[rows], begins)
    notes += _counted(int((~is_fresh).sum()), "whose stamp goes back")
    if back_s := [-step_s for _, step_s in clock_jumps(t_ns) if step_s < 0.0]:
        notes.append(f"the clock was set back by {sum(back_s):.6g} s: that much of the motion is missing there")
    rows, begins = rows[is_fresh], begins[is_fresh]
    stamps = placed = t_ns[rows]
    if spread and not begins.all() and begins.sum() > 1:
        placed, is_back = spread_stamps(stamps, np.flatnonzero(begins))
        is_repeated = _is_repeated(values[rows], np.flatnonzero(begins), keep_last=is_back)
        notes += _counted(int(is_repeated.sum()), "that repeat another one, stamp and values,")
        rows, stamps, placed = rows[~is_repeated], stamps[~is_repeated], placed[~is_repeated]
        notes += _spread_notes(placed - stamps, is_back)
    is_later = np.diff(placed, prepend=placed[:1] - 1) > 0
    notes += _counted(int((~is_later).sum()), "whose stamp repeats")
    rows = rows[is_later]
    return Cleaned(placed[is_later], values[rows], rows, [f"{name}: {note}" for note in notes])


def _counted(count: int, what: str) -> list[str]:
    return [f"{count} samples {what} are left out"] if count else []


def _is_fresh(t_ns: Int64[np.ndarray, " n"], begins: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Rows whose stamp is later than all before it, or that of the row before, of which the same holds."""
    before = np.concatenate([t_ns[:1] - 1, np.maximum.accumulate(t_ns)[:-1]])
    fresh: Bool[np.ndarray, " n"] = (t_ns > before)[np.flatnonzero(begins)][np.cumsum(begins) - 1]
    return fresh


def spread_stamps(t_ns: Int64[np.ndarray, " n"], starts: Int64[np.ndarray, " s"]) -> tuple[Int64[np.ndarray, " n"], bool]:
    """Stamps of which each is one sample's, and whether they were spread to the stamp before.

    The stamps are in order. `starts` are the rows in which the stamp changes, the first among them.
    """
    count = np.diff(starts, append=len(t_ns))
    steps = np.diff(t_ns[starts]).astype(np.float64)
    usual = steps / count[:-1]
    usual = np.concatenate([np.full(len(part), median(part)) for part in np.array_split(usual, -(-len(usual) // NEAR))])
    usual = np.append(usual, usual[-1])
    each, behind = np.repeat(count, count), np.arange(len(t_ns)) - np.repeat(starts, count)

    def placed(step: Float64[np.ndarray, " s"], place: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
        shared = np.where(step > GAP_STEPS * usual, usual, step)
        stamps: Int64[np.ndarray, " n"] = t_ns + np.rint(place * np.repeat(shared, count)).astype(np.int64)
        return stamps

    ahead = placed(np.append(steps, np.inf) / count, behind)
    lasting = float(usual[0] * count[0])
    if GAP_STEPS * lasting < steps[0] <= GAP_STEPS * median(steps):  # fewer samples, and no gap
        ahead[: count[0]] += int(steps[0] - lasting)
    back = placed(np.append(np.inf, steps) / count, behind - each + 1)
    moved = np.diff(ahead) != np.diff(back)
    of_row = np.repeat(usual, count)[1:][moved]
    uneven = [np.minimum(np.abs(np.diff(stamps)[moved] / of_row - 1.0), 1.0).sum() for stamps in (ahead, back)]
    is_back = bool(uneven[1] < CLEARLY * uneven[0] - 1.0)
    return (back if is_back else ahead), is_back


def _is_repeated(
    values: Float64[np.ndarray, "n k"], starts: Int64[np.ndarray, " s"], *, keep_last: bool
) -> Bool[np.ndarray, " n"]:
    """Rows whose values another row of their stamp has, but for one of them.

    A sensor at rest gives the same values, too. So where most stamps have equally many samples that differ, another stamp with
    as many has a batch like theirs.
    """
    count = np.diff(starts, append=len(values))
    stamp = np.repeat(np.arange(len(starts)), count)
    shared = np.flatnonzero(np.repeat(count > 1, count))[:: -1 if keep_last else 1]
    weighed = np.zeros(len(shared))  # equal rows have equal sums: to sort by one number takes a third of the time
    for place, column in enumerate(values.T):
        weighed += column[shared] * np.sqrt(place + 2.0)
    order = shared[np.lexsort((weighed, stamp[shared]))]
    equal = (np.diff(stamp[order]) == 0) & (np.diff(values[order], axis=0) == 0.0).all(axis=1)
    repeated = np.zeros(len(values), bool)
    repeated[order[1:][equal]] = True
    sizes = count[count > 1]
    repeats = np.add.reduceat(repeated, starts)
    usual = int(median(sizes))
    if ((sizes == usual) & (repeats[count > 1] == 0)).mean() > MAX_ALIKE:
        repeated[np.repeat(count == usual, count)] = False
    return repeated


def _spread_notes(moved_ns: Int64[np.ndarray, " n"], is_back: bool) -> list[str]:
    """Note on samples that have another stamp now."""
    if not moved_ns.any():
        return []
    way = "earlier than recorded, which makes the steps most even" if is_back else "later than recorded"
    note = f"{np.count_nonzero(moved_ns)} of {len(moved_ns)} samples share the stamp of another one: they are spread evenly"
    max_ms = np.abs(moved_ns).max() * 1e-6
    return [f"{note}, by up to {max_ms:.6g} ms {way}; imutool convert LOG OUT --restamp puts all on a line"]


def lost_to_set_back(t_ns: Int64[np.ndarray, " n"], name: str) -> list[str]:
    """Sentence on samples that have the times of others before them, where these are many."""
    lost = int((~_is_fresh(t_ns, np.diff(t_ns, prepend=t_ns[:1] - 1) != 0)).sum())
    if lost <= MAX_SET_BACK * len(t_ns):
        return []
    what = f"{name}: {lost} of {len(t_ns)} samples are left out, as their time goes back to that of samples before them"
    fix = "; if the table holds several recordings, give each a table of its own, or add a column `trial` that tells them apart"
    return [what + fix * any(step_s < 0.0 for _, step_s in clock_jumps(t_ns))]


class Ticked(NamedTuple):
    """Clock in ticks of a large part of a sensor's period (ns).

    `span` stamps show the line above them.
    """

    period_ns: float
    tick_ns: float
    span: int


def ticked(t_ns: Int64[np.ndarray, " n"], before: Ticked | None = None) -> Ticked | None:
    """Even clock behind stamps in coarse ticks; None of others.

    Its steps alternate, as 1, 1, 1 and 2 ms at 800 Hz. Samples that are lost by chance make no such clock: the shorter quarter
    of the spans of 256 samples differ by more ticks. Of stamps too few to show it, it is the clock `before` them.
    """
    if len(t_ns) < 2 * TICK_SPAN:
        return before
    steps_us = np.rint(np.diff(t_ns) / 1000.0).astype(np.int64)  # a float of seconds since 1970 keeps a microsecond
    tick_us = int(np.gcd.reduce(steps_us[:TICK_SPAN]))
    if tick_us <= 0 or (steps_us % tick_us).any() or median(steps_us) > MAX_TICKS * tick_us:
        return None
    spans_us = (t_ns[TICK_SPAN:] - t_ns[:-TICK_SPAN]) * 1e-3
    low, high = (float(quantile(spans_us, share)) for share in (0.05, 0.25))
    ticks = float(spans_us[spans_us < low + 1.5 * tick_us].mean()) / TICK_SPAN / tick_us
    fraction = abs(ticks - round(ticks))
    if high - low > 1.5 * tick_us or ticks < 1.0 or fraction * TICK_SPAN < 2.0:  # each step of whole ticks shows the period
        return None
    return Ticked(ticks * tick_us * 1e3, tick_us * 1e3, 1 << max(4, int(np.ceil(np.log2(2.0 / fraction)))))
