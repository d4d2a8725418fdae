"""Stuck values: repeated samples, an axis without changes, a gyro within one count.

A sensor with noise does not give six equal numbers twice; in 23 real recordings two samples in a row are the longest such
run. In a noise-free simulation at rest it does, so repeats are only dropped where the samples that do change show noise:
third differences then exceed second ones (by sqrt(20/6) for white noise), and in smooth motion they are far smaller.

A gyro that fails may alternate between two counts. It has noise elsewhere, reads other rates than usual on two axes or more (a
vehicle's long turn is about one), and stands still while the specific force changes: at rest that stands still, too.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from imutool.array_types import Bool, Float64, Int64
from imutool.cleaning.finding import Finding, Intervals
from imutool.cleaning.rule import Rule, TopicSummary
from imutool.cleaning.rules.not_finite import AXES
from imutool.cleaning.samples import STEP_NS, Motion, Samples, padded
from imutool.recording.columns import median, true_ranges

MIN = 10  # equal samples in a row
MAX_EQUAL = 3  # of six axes, apart from a run: a sensor that is slower than the other repeats three
AXIS_MIN, AXIS_MIN_S = 100, 1.0  # of one axis alone; the longest in real recordings is 17, or 0.17 s
HELD_SHARE = 0.3  # of neighbours that are equal: the topic is faster than its sensor
AXIS_DISTRUST = 0.1  # of the time
WITHIN = 1.5  # counts: the next one is two away
MOVES = 0.05  # of the usual specific force, by which its means of 0.1 s differ: 0.5 m/s²
STILL_GYRO = "samples whose gyro stands still within one count while the accelerometer moves"


class Stuck(Rule):
    """Rule for stuck values: it keeps the first of equal samples, and reports a stuck axis."""

    place = 40

    def __init__(self) -> None:
        super().__init__()
        self._places, self._quiet = Intervals(), Intervals()
        self._noisy = True
        self._equal, self._pairs = 0, 0
        self._axes = [_Axis() for _ in AXES]
        self._gyro = _StillGyro()

    def __call__(self, stream: Iterable[Samples]) -> Iterator[Samples]:
        """Yield the samples without repeats."""
        for around, core in padded(stream, AXIS_MIN):
            self._gyro.see(around, core)
            same, in_runs = _repeats(around.values)
            self._noisy = _noisy(around.values[~same], self._noisy)
            samples, repeated = around.where(core), in_runs[core]
            self._equal += int(same[core].sum())
            self._pairs += len(repeated)
            if repeated.any():
                places = self._places if self._noisy else self._quiet
                places.add(samples.number[repeated], samples.stamp_ns[repeated])
            if self._noisy:
                self.dropped.append(samples.number[repeated])
                samples = samples.where(~repeated)
            for axis, values in zip(self._axes, samples.values.T, strict=True):
                axis.see(values, samples)
            yield samples

    def findings(self, whole: TopicSummary) -> Iterator[Finding]:
        """Findings about repeats, a topic faster than its sensor, and stuck axes."""
        if self._places.count:
            what = f"samples that repeat the one before, in runs of {MIN} and more: the sensor was stuck"
            yield Finding("stuck", "warning", what, **self._places.where(), action="dropped", confidence=0.95)
        if self._quiet.count:
            what = "samples that repeat the one before, of a sensor without noise: simulated, or stuck"
            yield Finding("stuck", "note", what, **self._quiet.where(), confidence=0.5)
        if self._equal - self._places.count - self._quiet.count > HELD_SHARE * self._pairs:
            share = self._equal / self._pairs
            what = "samples equal to the one before: the topic is faster than its sensor"
            yield Finding("stuck", "warning", what, self._equal, values={"share": share}, confidence=0.9)
        yield from self._still_gyro(whole)
        total_s = (whole.motion.end_ns - (whole.motion.start_ns or 0)) * 1e-9
        for name, axis in zip(AXES, self._axes, strict=True):
            axis.close()
            if axis.places.count:
                share = min(axis.still_s / total_s, 1.0) if total_s > 0 else 0.0
                distrust = f"{name} stands still for {100 * share:.0f} % of the time" if share > AXIS_DISTRUST else ""
                what = f"samples with {name} unchanged for {AXIS_MIN_S:g} s and more"
                values = {"axis": name, "share": share}
                yield Finding(
                    "stuck", "error" if distrust else "warning", what, **axis.places.where(), values=values, distrust=distrust
                )

    def _still_gyro(self, whole: TopicSummary) -> Iterator[Finding]:
        places = Intervals()
        for run in self._gyro.failed(whole.motion):
            places.add_run(run.numbers, run.stamps_ns, run.numbers[1] - run.numbers[0] + 1)
            self.dropped.append(np.arange(run.numbers[0], run.numbers[1] + 1))
        if places.count:
            yield Finding("stuck", "warning", STILL_GYRO, **places.where(), action="dropped", confidence=0.9)


@dataclass
class _Run:
    """Run of a gyro within one count; `low` and `high` are its extremes."""

    numbers: tuple[int, int]
    stamps_ns: tuple[int, int]
    low: Float64[np.ndarray, "3"]
    high: Float64[np.ndarray, "3"]


class _StillGyro:
    """Runs of a gyro that stays within one count on all axes, across blocks."""

    def __init__(self) -> None:
        self._runs: list[_Run] = []
        self._count, self._goes_on = np.full(3, np.inf), False

    def see(self, around: Samples, core: slice) -> None:
        """Add the samples of the core, with their neighbours."""
        steps = np.abs(np.diff(around.values[:, :3], axis=0))
        self._count = np.minimum(self._count, np.where(steps > 0.0, steps, np.inf).min(axis=0, initial=np.inf))
        samples = around.where(core)
        still = self._still(around.values[:, :3], steps)[core]
        for first, end in true_ranges(still):
            numbers, stamps_ns = ((int(x[first]), int(x[end - 1])) for x in (samples.number, samples.stamp_ns))
            low, high = (extreme(samples.values[first:end, :3], axis=0) for extreme in (np.min, np.max))
            if first == 0 and self._goes_on:
                run = self._runs.pop()
                numbers, stamps_ns = (run.numbers[0], numbers[1]), (run.stamps_ns[0], stamps_ns[1])
                low, high = np.minimum(run.low, low), np.maximum(run.high, high)
            self._runs.append(_Run(numbers, stamps_ns, low, high))
        self._goes_on = bool(len(still) and still[-1])

    def _still(self, gyro: Float64[np.ndarray, "n 3"], steps: Float64[np.ndarray, "m 3"]) -> Bool[np.ndarray, " n"]:
        """Samples in `AXIS_MIN` within one count."""
        still = np.zeros(len(gyro), bool)
        for first, end in true_ranges(np.asarray((steps <= WITHIN * self._count).all(axis=1))):
            if end - first >= AXIS_MIN - 1:
                windows = sliding_window_view(gyro[first : end + 1], AXIS_MIN, axis=0)
                for k in np.flatnonzero((np.ptp(windows, axis=2) <= WITHIN * self._count).all(axis=1)):
                    still[first + k : first + k + AXIS_MIN] = True
        return still

    def failed(self, motion: Motion) -> Iterator[_Run]:
        """Runs in which the gyro failed."""
        if not self._runs or not all(_noisy(column[:, None], before=False) for column in motion.rates.T):
            return
        step, mean = motion.table()
        t_ns, usual = step * STEP_NS + (motion.start_ns or 0), np.median(mean, axis=0)
        for run in self._runs:
            inside = mean[(t_ns >= run.stamps_ns[0]) & (t_ns <= run.stamps_ns[1]), 3:]
            lasts = run.stamps_ns[1] - run.stamps_ns[0] >= AXIS_MIN_S * 1e9 and len(inside) > 1
            is_one = (run.high - run.low <= WITHIN * self._count).all()
            unusual = (np.abs((run.low + run.high) / 2.0 - usual[:3]) > WITHIN * self._count).sum() > 1
            if lasts and is_one and unusual and np.ptp(inside, axis=0).max() > MOVES * np.linalg.norm(usual[3:]):
                yield run


class _Axis:
    """Runs of one value on one axis, across blocks."""

    def __init__(self) -> None:
        self.places, self.still_s = Intervals(), 0.0
        self._value, self._numbers, self._stamps, self._count = np.nan, (0, 0), (0, 0), 0

    def see(self, values: Float64[np.ndarray, " n"], samples: Samples) -> None:
        if not len(values):
            return
        changes: Bool[np.ndarray, " n"] = np.diff(values, prepend=self._value) != 0
        starts = np.flatnonzero(changes)
        ends = np.concatenate([starts, [len(values)]])
        if ends[0]:  # goes on from the block before
            self._take(samples, 0, int(ends[0]), new=False)
        long = np.flatnonzero(np.diff(ends) >= AXIS_MIN)
        for start, end in [(int(starts[i]), int(ends[i + 1])) for i in long if i + 1 < len(starts)]:
            self._take(samples, start, end, new=True)
        if len(starts):
            self._take(samples, int(starts[-1]), len(values), new=True)
        self._value = float(values[-1])

    def _take(self, samples: Samples, start: int, end: int, *, new: bool) -> None:
        if new:
            self.close()
            self._numbers, self._stamps = (int(samples.number[start]), 0), (int(samples.stamp_ns[start]), 0)
        self._count += end - start
        self._numbers = self._numbers[0], int(samples.number[end - 1])
        self._stamps = self._stamps[0], int(samples.stamp_ns[end - 1])

    def close(self) -> None:
        """Close the current run."""
        lasted_s = (self._stamps[1] - self._stamps[0]) * 1e-9
        if self._count >= AXIS_MIN and lasted_s >= AXIS_MIN_S:
            self.places.add_run(self._numbers, self._stamps, self._count)
            self.still_s += lasted_s
        self._count = 0


def repeated(values: Float64[np.ndarray, "n 6"]) -> Bool[np.ndarray, " n"]:
    """Samples that repeat the one before, in runs of `MIN` and more, of a sensor with noise."""
    same, in_runs = _repeats(values)
    return in_runs & _noisy(values[~same], before=False)


def failed_gyro(t_ns: Int64[np.ndarray, " n"], values: Float64[np.ndarray, "n 6"]) -> Bool[np.ndarray, " n"]:
    """Samples whose gyro stands still within one count while the accelerometer moves."""
    samples = Samples(np.arange(len(t_ns)), t_ns, t_ns, values)
    gyro, motion, failed = _StillGyro(), Motion(), np.zeros(len(t_ns), bool)
    gyro.see(samples, slice(None))
    motion.see(samples)
    for run in gyro.failed(motion):
        failed[run.numbers[0] : run.numbers[1] + 1] = True
    return failed


def _repeats(values: Float64[np.ndarray, "n 6"]) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Samples that repeat the one before, and those of them in runs of `MIN` and more.

    A sensor at rest, whose digits are coarser than its noise, repeats itself as well: there axis after axis changes alone.
    """
    equal = np.concatenate([np.zeros((1, 6), bool), np.diff(values, axis=0) == 0])[: len(values)]
    same: Bool[np.ndarray, " n"] = np.asarray(equal.all(axis=1))
    in_runs = np.zeros(len(same), bool)
    for first, end in true_ranges(same):
        around = [equal[k].sum() for k in (first - 1, end) if 0 < k < len(same)]
        in_runs[first:end] = end - first >= MIN - 1 and not (around and max(around) > MAX_EQUAL)
    return same, in_runs


def _noisy(values: Float64[np.ndarray, "n k"], before: bool) -> bool:
    """Whether samples show noise; `before` for too few samples."""
    if len(values) < 4 * MIN:
        return before
    return any(median(np.abs(np.diff(column, n=3))) > median(np.abs(np.diff(column, n=2))) for column in values.T)
