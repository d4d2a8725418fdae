"""Clock of a sensor under stamps that are late, in batches, wrap, or have wrong fractions.

A stamp is never earlier than its sample, so the sensor's own clock is a line under the stamps: the edge of their lower convex
hull above the middle of a window, which has the least sum of delays (Moon, Skelly and Towsley, Estimation and removal of clock
skew from network delay measurements, INFOCOM 1999; the hull: Zhang, Liu and Xia, INFOCOM 2002). Straight lines join the middles
of windows, so that a crystal may drift. Stamps take 8 bytes a sample.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from imutool.array_types import Bool, Float64, Int64
from imutool.recording import nanoseconds
from imutool.recording.sample_order import Ticked, spread_stamps, ticked

WINDOW = 256  # samples, several batches of any driver; a cheap sensor's rate wanders within seconds
GAP_NS = nanoseconds(0.5)  # no longer step says anything of the period
GAP_BATCHES = 1.7  # batches: samples are missing in a longer step, which ends a stretch, as one back does
SHORT, MANY_SHORT = 0.7, 0.05  # of the median step, and the share of such steps that only late stamps leave
SPAN = 16  # samples: over so many, stamps that jitter by a period show the period, and one of them is hardly late
AHEAD = 64  # samples, within which those that a program held back are all there
STAYS = 0.5  # of a period: by which the stamps behind a step are later at least, where a sample is lost and not late
WRAPS = {
    f"{bits} bit of {unit}": 2**bits * ns for bits in (16, 32) for unit, ns in (("ns", 1), ("us", 1000), ("ms", 1_000_000))
}
SECOND_NS = 1_000_000_000
FRACTIONS = {10: "10 ns", 100: "100 ns", 1000: "us", 10_000: "10 us", 100_000: "100 us", 1_000_000: "ms"}  # units of a fraction
FILLED = 0.9  # of a second: how far fractions reach in their own unit
MIN_SECONDS, MIN_HZ = 3, 4.0  # of a log whose fractions are judged
EVEN = 5.0  # times: most by which the step into the next second differs from the others
OTHER_RATE = 1.25  # of a window's rate, that of the next: no crystal drifts so far
SIDE = 4  # blocks, of a quarter of a window
ROUNDED_NS = 1000  # a microsecond, or what a float of seconds since 1970 keeps of it
BUNCHED = 0.3  # of the mean period: a shorter step is within a batch
BATCHED = 0.3  # share of such steps from which on stamps come in batches


class Stamps(NamedTuple):
    """Stamps of a topic without the wraps of its counter, and what was wrong with them.

    Attributes:
        fraction: unit in which the driver counted the nanoseconds of the stamps; empty where it is ns.
        batch: mean samples in a batch; 1 where they come one by one.
        unset: whether all are the same, as a driver leaves them that fills in none.
    """

    stamp_ns: Int64[np.ndarray, " n"]
    fraction: str
    wraps: Counter[str]
    batch: float
    unset: bool

    @property
    def faults(self) -> list[str]:
        """Faults, in words."""
        if self.unset:
            return [f"the stamps are not set: each is {self.stamp_ns[0]} ns"]
        words = [f"the stamps' fractions of a second are written in {self.fraction}, not in ns"] if self.fraction else []
        words += [
            f"the clock of the stamps wraps {count} times, as a counter of {name} does" for name, count in self.wraps.items()
        ]
        if self.batch > 1.0:
            words.append(batch_words(self.batch))
        return words


def read_stamps(stamp_ns: Int64[np.ndarray, " n"]) -> Stamps:
    """Stamps whose wraps are undone; a wrap is a step back by the range of a counter."""
    unit = _fraction_unit(stamp_ns)
    stamp_ns = stamp_ns + (unit - 1) * (stamp_ns % SECOND_NS)
    steps, wraps = np.diff(stamp_ns), Counter[str]()
    usual = int(np.median(steps)) if len(steps) else 0
    for row in np.flatnonzero(steps < -max(usual, 1)):
        for name, size in WRAPS.items():
            if size > 16 * usual > 0 and abs(int(steps[row]) + size - usual) <= max(8 * usual, size // 1000):
                wraps[name] += 1
                steps[row] += size
                break
    whole = np.concatenate([stamp_ns[:1], stamp_ns[:1] + np.cumsum(steps)]) if len(stamp_ns) else stamp_ns
    unset = len(steps) > 0 and not np.diff(stamp_ns).any()
    return Stamps(whole, FRACTIONS.get(unit, ""), wraps, batch_size(*bunched(steps)), unset)


def distinct(stamp_ns: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " m"]:
    """Stamps in order, each once; `np.unique` takes ten times as long and twice the memory."""
    ordered = np.sort(stamp_ns)
    first: Int64[np.ndarray, " m"] = ordered[np.diff(ordered, prepend=ordered[:1] - 1) != 0]
    return first


def bunched(steps_ns: Int64[np.ndarray, " n"]) -> tuple[int, int]:
    """Numbers of steps within a batch, and of all steps that say anything of the period.

    A step is short in comparison with those near it: a logger may go on at a tenth of its rate.
    """
    near = steps_ns[(steps_ns >= 0) & (steps_ns < GAP_NS)]
    parts = np.array_split(near, max(1, round(len(near) / WINDOW))) if len(near) else []
    return sum(int((part < BUNCHED * part.mean()).sum()) for part in parts), len(near)


def batch_size(within: int, steps: int) -> float:
    """Mean samples in a batch, from numbers of `bunched`; 1 where stamps come one by one."""
    share = within / steps if steps > WINDOW else 0.0
    return 1.0 / (1.0 - share) if BATCHED < share < 1.0 else 1.0


def batch_words(size: float) -> str:
    """Stamps in batches, in words."""
    return f"stamps come in batches of about {size:.1f} samples: the driver's, not the sensor's"


def usual_period(stamp_ns: Int64[np.ndarray, " n"]) -> float:
    """Usual period of a sensor (ns); 0 for fewer than two stamps.

    It is the median step, but for a clock in coarse ticks. Where many steps are short, stamps are late by a good part of a
    period: then the median over 16 samples counts. Lost samples make that too long, but leave no short steps.
    """
    if coarse := ticked(stamp_ns):
        return coarse.period_ns
    steps = np.diff(stamp_ns)
    median = float(np.median(steps)) if len(steps) else 0.0
    if len(steps) <= SPAN or (steps < SHORT * median).mean() < MANY_SHORT:
        return median
    return float(np.median(stamp_ns[SPAN:] - stamp_ns[:-SPAN])) / SPAN


def stay_late(stamp_ns: Int64[np.ndarray, " n"], period_ns: float, span: int = SPAN) -> Bool[np.ndarray, " m"]:
    """Steps behind which the stamps stay late, as behind a sample that is lost.

    Behind one that is late they do not. The earliest of `span` stamps on both sides are compared, against a line of the period.
    """
    line = (stamp_ns - stamp_ns[:1]).astype(np.float64) - period_ns * np.arange(len(stamp_ns))
    before, behind = line.copy(), line.copy()
    for back in (1 << n for n in range(span.bit_length() - 1)):  # minima of 2, 4, 8, ... samples
        before[back:] = np.minimum(before[back:], before[:-back])
        behind[:-back] = np.minimum(behind[:-back], behind[back:])
    late: Bool[np.ndarray, " m"] = behind[1:] - before[:-1] > STAYS * period_ns
    return late


def lost_samples(
    stamp_ns: Int64[np.ndarray, " n"], period_ns: float, steps: Bool[np.ndarray, " m"], coarse: Ticked | None
) -> Int64[np.ndarray, " m"]:
    """Number of samples lost in each of `steps` behind which the stamps stay late.

    Each is counted once. The earliest stamps on both sides show how many are lost. What is later than these is late, not lost.
    Steps that a clock in `coarse` ticks explains have lost none.
    """
    lost, last, span = np.zeros(len(steps), np.int64), -1, SPAN
    if coarse:
        period_ns, tick_ns, span = coarse
        steps = steps & (np.diff(stamp_ns) > period_ns)
        steps[-span:] &= np.diff(stamp_ns)[-span:] > period_ns + tick_ns  # where few stamps show it
    for row in np.flatnonzero(steps & stay_late(stamp_ns, period_ns, span)).tolist():
        first, behind = max(last + 1, row - span + 1), row + 1
        held_back = int((np.diff(stamp_ns[row : behind + AHEAD]) < BUNCHED * period_ns).sum()) > SPAN // 2
        near = stamp_ns[first : behind + (AHEAD if held_back else span)]  # over more samples a rate that wanders hides losses
        line = (near - near[0]) - period_ns * np.arange(len(near))
        late_ns = line[behind - first :].min() - line[: behind - first].min()
        lost[row] = max(0, round(float(late_ns) / period_ns))
        last = row if lost[row] else last
    return lost


def _fraction_unit(stamp_ns: Int64[np.ndarray, " n"]) -> int:
    """Unit of the stamps' fractions of a second in ns: not 1 where a driver wrote them in another unit.

    Such stamps crawl from the start of each second and leap into the next; in the right unit all steps are alike.
    """
    seconds, fraction = np.divmod(stamp_ns, SECOND_NS)
    into_next = np.diff(seconds) == 1
    if into_next.sum() < MIN_SECONDS or len(stamp_ns) < MIN_HZ * (seconds[-1] - seconds[0]):
        return 1
    largest, smallest = int(fraction.max()), int(fraction.min())
    unit = next((u for u in FRACTIONS if FILLED * SECOND_NS <= largest * u < SECOND_NS), 1)
    if unit == 1 or smallest * unit > (1.0 - FILLED) * SECOND_NS:
        return 1
    steps = np.diff(stamp_ns + (unit - 1) * fraction)
    usual, leap = float(np.median(steps)), float(np.median(steps[into_next]))
    return unit if usual > 0 and usual / EVEN <= leap <= usual * EVEN else 1


def unrounded(stamp_ns: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """Stamps of an even clock without their rounding; others as they are.

    Rounded to a microsecond, poses at 2 m/s err by it, and their second derivative has lines of it.
    """
    steps = np.diff(stamp_ns)
    period_ns = float(np.median(steps)) if len(steps) else 0.0
    if period_ns <= 0.0:
        return stamp_ns
    number, since = np.concatenate([[0.0], np.cumsum(np.rint(steps / period_ns))]), stamp_ns - stamp_ns[0]
    even = np.rint(np.polynomial.Polynomial.fit(number, since, 1)(number)).astype(np.int64)
    return stamp_ns[0] + even if np.abs(since - even).max() <= ROUNDED_NS else stamp_ns


def restamped(stamp_ns: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """Stamps on the line under them, by stretches without a gap.

    They increase, except where the clock was set back.
    """
    found = read_stamps(stamp_ns)
    whole, steps = found.stamp_ns, np.diff(found.stamp_ns)
    near = steps[(steps >= 0) & (steps < GAP_NS)]
    if not near.any():  # as in whole seconds
        starts = np.flatnonzero(np.diff(whole, prepend=whole[:1] - 1))
        return spread_stamps(whole, starts)[0] if len(starts) > 1 and (steps >= 0).all() else whole
    is_batched = found.batch > 1.0
    batch_ns = found.batch * float(near.mean()) if is_batched else usual_period(whole)
    back = np.flatnonzero(steps < -GAP_NS) + 1
    ends = np.flatnonzero(steps > GAP_BATCHES * batch_ns if is_batched else _lost(whole, batch_ns)) + 1
    out = whole.copy()
    for first, end in pairwise([0, *np.union1d(back, ends).tolist(), len(whole)]):
        for a, b in _at_one_rate(whole[first:end], found.batch):
            start, part = whole[first + a], slice(first + a, first + b)
            out[part] = start + np.rint(_line(whole[part] - start)).astype(np.int64)
    for first, end in pairwise([0, *back.tolist(), len(whole)]):
        number = np.arange(end - first)
        out[first:end] = np.maximum.accumulate(out[first:end] - number) + number
    return out


def _lost(stamp_ns: Int64[np.ndarray, " n"], period_ns: float) -> Bool[np.ndarray, " m"]:
    """Steps in which samples are lost: long ones, and others from which on the stamps stay late, but at the ends."""
    late, is_long = stay_late(stamp_ns, period_ns), np.diff(stamp_ns) > GAP_BATCHES * period_ns
    begins = late & ~np.concatenate([late[:1], late[:-1]])
    begins[:SPAN] = begins[-SPAN:] = False  # where few stamps show it
    return lost_samples(stamp_ns, period_ns, begins | (late & is_long), ticked(stamp_ns)) > 0


def _at_one_rate(stamp_ns: Int64[np.ndarray, " n"], batch: float) -> Iterator[tuple[int, int]]:
    """Parts of a stretch in which the rate is the same; the stamps near a change of the rate are in none.

    The usual rates of a window on both sides are compared: a stamp that is late for long only moves time between two blocks.
    """
    block, start = max(WINDOW // 4, round(8 * batch)), 0
    bounds = stamp_ns[::block].astype(np.float64)
    lasting = np.concatenate([np.full(SIDE, np.nan), np.diff(bounds), np.full(SIDE, np.nan)])
    usual = (
        np.nanmedian(np.lib.stride_tricks.sliding_window_view(lasting, SIDE)[1:-1], axis=1) if len(bounds) > 2 else bounds[:0]
    )
    ratio = np.abs(np.log(np.maximum(usual[SIDE:], 1.0) / np.maximum(usual[:-SIDE], 1.0)))
    for row in np.flatnonzero(ratio > np.log(OTHER_RATE)).tolist():
        if ratio[row] == ratio[max(row - SIDE, 0) : row + SIDE + 1].max():
            if row * block - start > 2:
                yield start, row * block
            start = (row + 2) * block
    if len(stamp_ns) - start > 2:
        yield start, len(stamp_ns)


def _line(delayed_ns: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Times on the line under the stamps of one stretch."""
    n = len(delayed_ns)
    count = max(1, round(n / WINDOW))
    number, stamp = np.arange(n, dtype=np.float64), delayed_ns.astype(np.float64)
    bounds = np.linspace(0, n, count + 1).astype(int)
    knots = [_under(number[a:b], stamp[a:b]) for a, b in pairwise(bounds)]
    x, y, slope = (np.array(column) for column in zip(*knots, strict=True))
    line: Float64[np.ndarray, " n"] = np.interp(number, x, y)
    before, after = number < x[0], number > x[-1]
    line[before] = y[0] + slope[0] * (number[before] - x[0])
    line[after] = y[-1] + slope[-1] * (number[after] - x[-1])
    return line


def _under(x: Float64[np.ndarray, " n"], y: Float64[np.ndarray, " n"]) -> tuple[float, float, float]:
    """Middle, and value and slope there, of the edge of the lower convex hull above the middle."""
    hull: list[int] = []
    for row in range(len(x)):
        while len(hull) > 1 and _turns_right(x, y, hull[-2], hull[-1], row):
            hull.pop()
        hull.append(row)
    middle = float(x.mean())
    right = max(1, int(np.searchsorted(x[hull], middle)))
    a, b = hull[right - 1], hull[right]
    slope = float((y[b] - y[a]) / (x[b] - x[a]))
    return middle, float(y[a] + slope * (middle - x[a])), slope


def _turns_right(x: Float64[np.ndarray, " n"], y: Float64[np.ndarray, " n"], a: int, b: int, c: int) -> bool:
    """Whether b lies on or above the line from a to c."""
    return bool((y[b] - y[a]) * (x[c] - x[a]) >= (y[c] - y[a]) * (x[b] - x[a]))
