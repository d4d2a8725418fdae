"""Clock of a topic, from stamps that come in blocks.

Up to `MAX_EXACT` steps are kept as they are. Of more only a histogram is, whose bins are 1/4096 of an octave wide: a median
then errs by less than 0.02 %, and means by nothing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping

import numpy as np

from imutool.array_types import Bool, Float64, Int64
from imutool.cleaning.rules.gaps import PAUSE_NS
from imutool.cleaning.samples import BLOCK
from imutool.cleaning.stamp_line import FRACTIONS, MANY_SHORT, SECOND_NS, SHORT, SPAN, bunched
from imutool.log_info.report import Clock
from imutool.recording.columns import clock_jumps, median
from imutool.recording.sample_order import ticked

UNUSUAL = 0.5  # share by which a period may differ from the median, to count for the rate
MAX_BATCHED = 0.2  # share of short steps up to which stamps surely come one by one
MAX_EXACT = 1 << 18  # steps: 2 MB, 22 minutes at 200 Hz
MAX_HELD = 1 << 22  # steps of topics that are read in one pass: 32 MB
MIN_HELD = 128  # steps, whose memory a topic takes that has none
OCTAVE_BITS = 12
FIRST, BINS = (1023 + 10) << OCTAVE_BITS, 30 << OCTAVE_BITS  # from 1 us to 18 minutes; beyond, all are in one bin
EDGES = (FIRST + np.arange(BINS) << (52 - OCTAVE_BITS)).view(np.float64)

StampsOf = Callable[[Collection[str]], Iterable[tuple[str, Int64[np.ndarray, "..."]]]]  # of some topics, in file order


class Steps:
    """Steps of stamps in order, each at least zero, from which medians and means follow."""

    def __init__(self) -> None:
        self._parts: list[Int64[np.ndarray, "..."]] = []
        self._held, self.count, self.largest = 0, 0, 0
        self._bins: Float64[np.ndarray, "3 b"] | None = None  # counts, and sums of steps from the edge and of their squares

    def see(self, steps_ns: Int64[np.ndarray, " n"]) -> None:
        """Add steps."""
        self._parts.append(steps_ns)
        self._held, self.count = self._held + len(steps_ns), self.count + len(steps_ns)
        self.largest = max(self.largest, int(steps_ns.max(initial=0)))
        if self._held > MAX_EXACT:
            self._fold()

    def _fold(self) -> None:
        if not self._held:
            return
        whole = np.concatenate(self._parts).astype(np.float64)
        place = np.clip((whole.view(np.int64) >> (52 - OCTAVE_BITS)) - FIRST, 0, BINS - 1)  # by exponent and first bits
        whole -= EDGES[place]  # squares of small numbers are exact
        more = np.stack([np.bincount(place, weights, BINS) for weights in (None, whole, whole**2)])
        self._bins = more if self._bins is None else self._bins + more
        self._parts, self._held = [], 0

    def _table(self) -> tuple[Float64[np.ndarray, " m"], Float64[np.ndarray, " m"], Float64[np.ndarray, " m"]]:
        """Increasing steps, how many there are of each, and the variance of those in a bin."""
        if self._bins is None:
            steps = np.sort(np.concatenate([np.zeros(0, np.int64), *self._parts])).astype(np.float64)
            return steps, np.ones(len(steps)), np.zeros(len(steps))
        self._fold()
        used = np.flatnonzero(self._bins[0])
        count, total, squares = self._bins[:, used]
        mean = total / count
        return EDGES[used] + mean, count, np.maximum(squares / count - mean**2, 0.0)

    def median(self) -> float:
        """Median step (ns); zero without steps."""
        if not self.count:
            return 0.0
        steps, count, _ = self._table()
        below, above = np.searchsorted(np.cumsum(count), [(self.count - 1) // 2, self.count // 2], side="right")
        return float(0.5 * (steps[below] + steps[above]))

    def share_below(self, limit_ns: float) -> float:
        """Share of the steps below a limit."""
        steps, count, _ = self._table()
        return float(count[steps < limit_ns].sum()) / self.count

    def clock(self, first_ns: int | None, last_ns: int | None) -> Clock:
        """Rate, jitter and largest gap of stamps that go from `first_ns` to `last_ns`."""
        if not self.count:
            return Clock(None, None, None, first_ns, last_ns)
        steps, count, variance = self._table()
        middle = self.median()

        def mean(values: Float64[np.ndarray, " m"], use: Bool[np.ndarray, " m"]) -> float:
            return float((count * values)[use].sum() / count[use].sum())

        usual = np.abs(steps - middle) <= UNUSUAL * middle  # the median itself is coarse where times are whole ms
        period = mean(steps, usual) if middle > 0 and usual.any() else middle  # none is near where two differ
        steady = steps <= PAUSE_NS  # that nobody recorded is no jitter
        away = steps - mean(steps, steady) if steady.any() else steps
        return Clock(
            rate_hz=1e9 / period if period > 0 else None,
            jitter_s=float(np.sqrt(mean(away**2 + variance, steady))) * 1e-9 if steady.any() else None,
            largest_gap_s=float(self.largest) * 1e-9,
            first_ns=first_ns,
            last_ns=last_ns,
        )


class IncreasingStamps:
    """Steps of stamps in blocks, with pauses and jumps of their clock.

    `increasing` is false from the first stamp on that repeats or goes back. Then the steps and jumps have no meaning.
    """

    def __init__(self) -> None:
        self.increasing, self.count = True, 0
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self.steps = Steps()
        self._ticked, self._blocks = list[float](), 0  # periods of blocks whose stamps are in coarse ticks, and all blocks
        self.long_ns = np.zeros(0, np.int64)
        self.jumps: list[tuple[int, float]] = []

    def see(self, stamp_ns: Int64[np.ndarray, " n"]) -> None:
        """Add the next stamps."""
        if not len(stamp_ns):
            return
        t_ns = stamp_ns if self.last_ns is None else np.append(self.last_ns, stamp_ns)
        steps = np.diff(t_ns)
        self.count += len(stamp_ns)
        self.first_ns = int(stamp_ns[0]) if self.first_ns is None else self.first_ns
        self.last_ns = int(stamp_ns[-1])
        self.increasing = self.increasing and int(steps.min(initial=1)) > 0
        if self.increasing:
            self.add(stamp_ns, steps)
            if int(steps.max(initial=0)) > PAUSE_NS:
                self.long_ns = np.append(self.long_ns, steps[steps > PAUSE_NS])
                self.jumps += clock_jumps(t_ns)

    def add(self, stamp_ns: Int64[np.ndarray, " n"], steps_ns: Int64[np.ndarray, " m"]) -> None:
        """Add stamps that increase, and the steps to them."""
        self.steps.see(steps_ns)
        self._ticked.extend([coarse.period_ns] if (coarse := ticked(stamp_ns)) else [])
        self._blocks += 1

    @property
    def ticked_ns(self) -> float:
        """Period of a sensor whose stamps are mostly in coarse ticks; else 0."""
        return float(median(np.array(self._ticked))) if 2 * len(self._ticked) > self._blocks else 0.0

    def clock(self) -> Clock:
        """Clock of the stamps."""
        clock = self.steps.clock(self.first_ns, self.last_ns)
        return clock._replace(rate_hz=1e9 / self.ticked_ns) if self.ticked_ns else clock


class SensorStamps(IncreasingStamps):
    """Stamps of a sensor, with what `stamp_line` asks of them."""

    def __init__(self) -> None:
        super().__init__()
        self._spans = Steps()  # over `SPAN` stamps
        self._tail = np.zeros(0, np.int64)
        self._within, self._near = 0, 0  # a batch, and in all
        self._fraction_ns = 0

    def add(self, stamp_ns: Int64[np.ndarray, " n"], steps_ns: Int64[np.ndarray, " m"]) -> None:
        """Add stamps that increase, and the steps to them."""
        super().add(stamp_ns, steps_ns)
        t_ns = np.concatenate([self._tail, stamp_ns])
        self._tail = t_ns[-SPAN:]
        self._spans.see(t_ns[SPAN:] - t_ns[:-SPAN])
        within, near = bunched(steps_ns)
        self._within, self._near = self._within + within, self._near + near
        self._fraction_ns = max(self._fraction_ns, int((stamp_ns % SECOND_NS).max()))

    @property
    def sound(self) -> bool:
        """Whether the stamps increase, one by one, in nanoseconds: `stamp_line` finds no fault."""
        in_ns = self._fraction_ns * min(FRACTIONS) >= SECOND_NS
        return self.increasing and in_ns and self._within <= MAX_BATCHED * self._near

    @property
    def period_ns(self) -> float:
        """Usual period, as `stamp_line.usual_period`."""
        usual = self.steps.median()
        if self.ticked_ns or self.steps.count <= SPAN or self.steps.share_below(SHORT * usual) < MANY_SHORT:
            return self.ticked_ns or usual
        return self._spans.median() / SPAN


def clocks(stamps_of: StampsOf, counts: Mapping[str, int]) -> Iterator[tuple[int, Clock]]:
    """Messages and clock of each topic, in as few passes over the log as memory allows.

    `counts` are the messages that are expected. Stamps that repeat or go back come into memory, and are sorted.
    """
    group, size = list[str](), 0
    for topic, count in counts.items():
        group.append(topic)
        size += min(count, MAX_EXACT) + MIN_HELD
        if size > MAX_HELD:
            yield from _clocks(stamps_of, group)
            group, size = [], 0
    yield from _clocks(stamps_of, group)


def _clocks(stamps_of: StampsOf, topics: list[str]) -> Iterator[tuple[int, Clock]]:
    seen = {topic: IncreasingStamps() for topic in topics}
    for topic, part in in_blocks(stamps_of(topics)):
        seen[topic].see(part)
    others = {topic: list[Int64[np.ndarray, "..."]]() for topic, stamps in seen.items() if not stamps.increasing}
    for topic, part in stamps_of(others) if others else ():
        others[topic].append(part)
    for topic, stamps in seen.items():
        in_order = sorted_stamps(np.concatenate(others.pop(topic))) if topic in others else stamps
        yield in_order.count, in_order.clock()


def sorted_stamps(stamp_ns: Int64[np.ndarray, " n"]) -> IncreasingStamps:
    """Stamps in order of time, some of which may be the same; only their clock is known."""
    seen, ordered = IncreasingStamps(), np.sort(stamp_ns)
    seen.count = len(ordered)
    seen.steps.see(np.diff(ordered))
    if len(ordered):
        seen.first_ns, seen.last_ns = int(ordered[0]), int(ordered[-1])
    return seen


def in_blocks(parts: Iterable[tuple[str, Int64[np.ndarray, "..."]]]) -> Iterator[tuple[str, Int64[np.ndarray, "..."]]]:
    """Stamps of each topic in blocks of at least `BLOCK`: a chunk may have one."""
    waiting, count = dict[str, list[Int64[np.ndarray, "..."]]](), Counter[str]()
    for topic, part in parts:
        waiting.setdefault(topic, []).append(part)
        count[topic] += len(part)
        if count[topic] >= BLOCK:
            yield topic, np.concatenate(waiting.pop(topic))
            count[topic] = 0
    yield from ((topic, np.concatenate(rest)) for topic, rest in waiting.items())
