"""Saturation: axes at the end of their range."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from itertools import product

import numpy as np

from imutool.array_types import Bool, Float64, Int64, Shaped
from imutool.cleaning.finding import Finding, Intervals
from imutool.cleaning.rule import Rule, TopicSummary
from imutool.cleaning.rules.not_finite import AXES
from imutool.cleaning.samples import BLOCK as PART
from imutool.cleaning.samples import Numbers, Samples
from imutool.recording.columns import median, quantile
from imutool.units import ASCII_UNITS, SENSORS

SAMPLES = 5
PILE = 2.0
LEVELS = 10
FEW_SAMPLES, FAR, FINE_LEVELS = 3, 0.05, 64  # 64 levels: one step of the sensor is then at most 3 % of its range
BAND, QUIET = 0.97, 0.75  # of the extreme value, and of the calmest steps: what is less is quieter than the sensor at rest
WIDER = 1.1  # times a flat end, that the other end of its range has at most: what rests at gravity is flat, too
MIN_FLAT, MOSTLY = 30, 0.6  # of noise, 0.39 are so quiet; EuRoC, TUM-VI, FETCH and BROAD have at most 0.52
BLOCK, FEW_BLOCKS, CALMEST = 50, 3, 0.05  # samples of a block, least blocks away from the extreme, quantile of their steps
RULE = (
    f"an axis is saturated at its own largest or smallest value where at least {SAMPLES} samples hold exactly "
    f"that value, more than {PILE:g} times as many as either of the next two values, among at least "
    f"{LEVELS} values, and it is not the median; {FEW_SAMPLES} samples are enough among at least {FINE_LEVELS} values, "
    f"where the next value is {100 * FAR:g} % nearer to zero; or where {MIN_FLAT} samples, and {MOSTLY:.0%} of those within "
    f"{1 - BAND:.0%} of it, change by less than {QUIET:.0%} of the axis' calmest steps, and no value of the other sign is "
    f"{WIDER - 1:.0%} larger: clipped before a calibration"
)
KEPT = 3  # values at either end: the last one, and the two it is compared with
MAX_NEAR = 1_000_000  # samples near an extreme value that are held: more, as of gravity at rest, are no plateau


class Ends:
    """Extreme values of an axis and their counts, over samples that come in parts."""

    def __init__(self) -> None:
        self._few = np.zeros(0)  # distinct values, until there are enough of them
        self._ends: dict[int, list[tuple[float, int]]] = {-1: [], 1: []}  # values and their counts, the extreme first
        self._samples = 0

    def see(self, values: Float64[np.ndarray, " n"]) -> None:
        """Add values; those that are not finite are skipped."""
        levels, counts = np.unique(values[np.isfinite(values)], return_counts=True)
        self._samples += int(counts.sum())
        if len(self._few) < FINE_LEVELS:
            # with counts `np.unique` does not import numpy.ma, which takes longer than a short log
            self._few = np.unique(np.concatenate([self._few, levels]), return_counts=True)[0][:FINE_LEVELS]
        for side, known in self._ends.items():
            near = slice(None, KEPT) if side < 0 else slice(-KEPT, None)
            total = dict(known)  # for so few values numpy takes ten times as long
            for level, count in zip(levels[near].tolist(), counts[near].tolist(), strict=True):
                total[level] = total.get(level, 0) + count
            self._ends[side] = sorted(total.items(), reverse=side > 0)[:KEPT]

    def limit(self, side: int) -> float | None:
        """Saturation limit (`RULE`) at the low (-1) or high (1) end; None without saturation."""
        if len(self._few) < LEVELS:
            return None
        (level, count), *others = self._ends[side]
        far = len(self._few) >= FINE_LEVELS and side * others[0][0] < (1.0 - FAR) * side * level
        piled = count >= (FEW_SAMPLES if far else SAMPLES) and count > PILE * max(times for _, times in others)
        median = 2 * count > self._samples
        return level if piled and not median else None

    def extreme(self, side: int) -> float:
        """Extreme value so far at an end."""
        return self._ends[side][0][0] if self._ends[side] else np.nan


NONE = np.zeros(0), np.zeros(0), np.zeros(0, np.int64), np.zeros(0, np.int64)


class _Near:
    """Samples above a value that grows: themselves, their steps, numbers and stamps."""

    def __init__(self) -> None:
        self._parts: list[tuple[Shaped[np.ndarray, " n"], ...]] = [NONE]
        self._held, self._maximum = 0, PART
        self._lost = 0.0  # largest of the samples that were too many

    def add(self, minimum: float, *columns: Shaped[np.ndarray, " n"]) -> None:
        """Add samples above `minimum`; too many are lost, until a larger value shows that they were not near the extreme."""
        if self._lost > minimum:
            self._lost = float(np.max(columns[0], initial=self._lost))
            return
        self._parts.append(columns)
        self._held += len(columns[0])
        if self._held > self._maximum:  # twice as many as were left last: each is moved a few times at most
            values = self.above(minimum)[0]
            self._held = len(values)
            self._maximum = 2 * self._held + PART
            if self._held > MAX_NEAR:
                self._parts, self._held, self._maximum, self._lost = [NONE], 0, PART, float(values.max())

    def above(self, minimum: float) -> tuple[Shaped[np.ndarray, " n"], ...]:
        """Samples above `minimum`; none where some of them are lost."""
        if self._lost > minimum:
            return NONE
        whole = [np.concatenate(column) for column in zip(*self._parts, strict=True)]
        kept = whole[0] > minimum
        self._parts = [tuple(column[kept] for column in whole)]
        return self._parts[0]


def _middles(steps: Float64[np.ndarray, "b n"]) -> Float64[np.ndarray, " b"]:
    """Median of each row; np.median imports numpy.ma."""
    half = steps.shape[1] // 2
    return np.asarray(np.sort(steps, axis=1)[:, half - 1 : half + 1].mean(axis=1))


class Plateau:
    """Samples near an end of an axis that change less than at rest.

    A sensor that is clipped before its calibration for temperature or scale has no value that repeats. Steps of noise differ
    from one to the next by sqrt(3) of their size; smooth motion without noise is calm wherever it turns back, and no plateau.
    """

    def __init__(self) -> None:
        self._last, self._samples = np.nan, 0
        self._blocks = [np.zeros((2, 0))]  # largest size, and median step of the noise
        self._extreme = {-1: 0.0, 1: 0.0}
        self._near = {-1: _Near(), 1: _Near()}

    def see(self, values: Float64[np.ndarray, " n"], number: Numbers, stamp_ns: Int64[np.ndarray, " n"]) -> None:
        """Add the next samples, in order."""
        finite = np.isfinite(values)
        signed = np.diff(np.where(finite, values, np.nan), prepend=self._last)
        step = np.nan_to_num(np.abs(signed), nan=np.inf)
        self._last, self._samples = values[-1] if len(values) else self._last, self._samples + len(values)
        whole = len(values) // BLOCK * BLOCK
        steps = signed[:whole].reshape(-1, BLOCK)
        calm = np.minimum(_middles(np.abs(steps)), _middles(np.abs(np.diff(steps, axis=1))) / np.sqrt(3.0))
        self._blocks.append(np.stack([np.abs(values[:whole]).reshape(-1, BLOCK).max(axis=1), calm]))
        for side, near in self._near.items():
            self._extreme[side] = float(np.max(side * values, where=finite, initial=self._extreme[side]))
            kept = side * values > (minimum := BAND * self._extreme[side])
            near.add(minimum, side * values[kept], step[kept], number[kept], stamp_ns[kept])

    def flat(self, side: int) -> tuple[float, Numbers, Int64[np.ndarray, " m"]] | None:
        """Limit at the low (-1) or high (1) end, numbers and stamps of the samples there; None without saturation."""
        value, step, number, stamp_ns = self._near[side].above(BAND * self._extreme[side])
        size, calm = np.concatenate(self._blocks, axis=1)
        calm = calm[(size < 0.5 * self._extreme[side]) & (calm > 0.0) & np.isfinite(calm)]
        wider = self._extreme[-side] > WIDER * self._extreme[side]
        if wider or len(calm) < FEW_BLOCKS or 2 * len(value) > self._samples:
            return None
        quiet = step < QUIET * quantile(calm, CALMEST)
        if quiet.sum() < max(MIN_FLAT, MOSTLY * len(value)):
            return None
        return side * float(median(value[quiet])), number[quiet], stamp_ns[quiet]


class AxisLimits:
    """Limits of axes, by `RULE`, from samples in blocks."""

    def __init__(self, axes: int) -> None:
        self._ends, self._plateaus = [Ends() for _ in range(axes)], [Plateau() for _ in range(axes)]

    def see(self, values: Float64[np.ndarray, "n k"], number: Numbers) -> None:
        """Add the next samples."""
        for column, ends, plateau in zip(values.T, self._ends, self._plateaus, strict=True):
            ends.see(column)
            plateau.see(column, number, number)

    @cached_property
    def _found(self) -> tuple[list[list[float]], Numbers]:
        """Limits of each axis, and numbers of the samples that are flat near one; known once all samples are."""
        levels: list[list[float]] = [[] for _ in self._ends]
        flat = [np.zeros(0, np.int64)]
        for side, (axis, ends) in product((-1, 1), enumerate(self._ends)):
            if (limit := ends.limit(side)) is not None:
                levels[axis].append(limit)
            elif (near := self._plateaus[axis].flat(side)) is not None:
                flat.append(near[1])
        return levels, np.concatenate(flat)

    def reached(self, values: Float64[np.ndarray, "n k"], number: Numbers) -> Bool[np.ndarray, " n"]:
        """Samples with an axis at its limit, once all samples were added."""
        levels, flat = self._found
        at = np.isin(number, flat)
        for column, limits in zip(values.T, levels, strict=True):
            for limit in limits:
                at |= column == limit
        return at


def at_limit(values: Float64[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Saturated samples of an axis, by `RULE`."""
    limits, number = AxisLimits(1), np.arange(len(values))
    for first in range(0, len(values), PART):
        limits.see(values[first : first + PART, None], number[first : first + PART])
    return limits.reached(values[:, None], number)


class Saturation(Rule):
    """Rule for saturated samples; it keeps them.

    The true value is at least this large, and a bias model cannot correct it.
    """

    place = 110

    def __init__(self) -> None:
        super().__init__()
        self._ends, self._plateaus = [Ends() for _ in AXES], [Plateau() for _ in AXES]
        self._places: dict[tuple[int, int], tuple[float, Intervals]] = {}

    def see(self, samples: Samples) -> None:
        """Note the samples at the extreme value so far; a larger value clears them."""
        for axis, ends in enumerate(self._ends):
            values = samples.values[:, axis]
            ends.see(values)
            self._plateaus[axis].see(values, samples.number, samples.stamp_ns)
            for side in (-1, 1):
                level = ends.extreme(side)
                known = self._places.get((axis, side))
                if known is None or known[0] != level:
                    known = self._places[axis, side] = level, Intervals()
                at = values == level
                known[1].add(samples.number[at], samples.stamp_ns[at])

    def findings(self, whole: TopicSummary) -> Iterator[Finding]:
        """Findings by axis and end."""
        for axis, side in product(range(6), (-1, 1)):
            limit = self._ends[axis].limit(side)
            if limit is not None:
                places = self._places[axis, side][1]
                limit *= float(whole.scale[axis])
                what = f"samples with {AXES[axis]} at the end of its range, {limit:.4g} {ASCII_UNITS[SENSORS[axis // 3]]}"
                values = {"axis": AXES[axis], "limit": limit}
                yield Finding("saturation", "warning", what, **places.where(), values=values, confidence=0.9)
            elif (flat := self._plateaus[axis].flat(side)) is not None:
                limit, places = flat[0] * float(whole.scale[axis]), Intervals()
                places.add(*flat[1:])
                end = f"the end of its range, {limit:.4g} {ASCII_UNITS[SENSORS[axis // 3]]}"
                what = f"samples with {AXES[axis]} flat near {end}: clipped before a calibration"
                values = {"axis": AXES[axis], "limit": limit}
                yield Finding("saturation", "warning", what, **places.where(), values=values, confidence=0.8)
