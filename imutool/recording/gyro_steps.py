"""Unit of a gyro by the steps in which it counts.

A digital gyro counts in steps that its data sheet states. Values that lie on such a grid, and on no finer one, show the unit.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from imutool.array_types import Float64

RATES_SI = {"rad/s": 1.0, "deg/s": np.pi / 180.0, "mdeg/s": np.pi / 180.0e3}
RANGES_DPS = 125.0, 250.0, 500.0, 1000.0, 2000.0, 4000.0  # over 2^15 counts: WitMotion, Bosch, and code for InvenSense
COUNTS_A_DPS = 131.0, 65.5, 32.8, 16.4, 14.375  # data sheets of InvenSense's MPU, ICM and ITG
ST_STEPS_DPS = 0.004375, 0.00875, 0.0175, 0.035, 0.07  # data sheets of ST's L3G and LSM
BNO055_STEPS = {"deg/s": 1 / 16, "rad/s": 1 / 900}  # its data sheet
WHOLE_DEG_S = 1.0, 0.5, 0.1, 0.01, 0.001  # decimals of degrees, as they look in radians
STEPS_DPS = *(full / 2**15 for full in RANGES_DPS), *(1 / counts for counts in COUNTS_A_DPS), *ST_STEPS_DPS
STEPS = [
    *((unit, step * np.deg2rad(1.0) / size) for unit, size in RATES_SI.items() for step in STEPS_DPS),
    *(("rad/s", np.deg2rad(step)) for step in WHOLE_DEG_S),
    *BNO055_STEPS.items(),
]
MAX_ROWS = 100_000  # of a long table, taken evenly
MAX_STEPS = 100.0  # from the median, within which a step that is stated to 0.1 % stays in phase
MIN_LENGTH = 0.85  # of the mean of the phases, where rounded decimals are a tenth of a step off
MIN_SUM = 25.0  # of Rayleigh's statistic on three axes: by chance it is larger 5 times in 10^9
MAX_OFF, MAX_UNCERTAIN = 0.005, 0.003  # share by which the grid's true step differs, and its standard deviation
MIN_NEXT = 0.1  # share of neighbours that are one step apart: else the true step is larger
ROUNDED = 1e-5  # of a step: rounding moves a value by less
MAX_COUNTS = 2.0**16  # of a register
MIN_WHOLE, WHOLE_OFF, WHOLE_ROWS = 200, 0.1, 10_000  # different counts of all values, what each may be off, rows that are taken
FIRST = 500  # values that are looked at before all others


def unit_by_steps(rates: Float64[np.ndarray, "n 3"]) -> tuple[str, float] | None:
    """Unit of a gyro whose values are steps of a common sensor, and the step; else None."""
    rates = rates[:: max(1, len(rates) // MAX_ROWS)]
    ordered = [np.sort(axis[np.isfinite(axis)]) for axis in rates.T]
    likely = _likely(ordered, np.array([step for _, step in STEPS]))
    found = [(unit, step) for (unit, step), worth in zip(STEPS, likely, strict=True) if worth and _counts_in(ordered, step)]
    some = rates[:: max(1, len(rates) // WHOLE_ROWS)]
    some = some[np.isfinite(some)]
    found = found or [(unit, step) for unit, step in STEPS if _are_whole(some, step)]
    return found[0] if len({unit for unit, _ in found}) == 1 else None


def _are_whole(values: Float64[np.ndarray, " n"], step: float) -> bool:
    """Whether all values are whole numbers of a step and of no multiple, as of a motion with few values near the median."""
    for some in (values[:FIRST], values):  # the first refute nearly every step
        counts = some / step
        whole = counts.round()
        if np.abs(counts - whole).max(initial=0.0) > WHOLE_OFF:
            return False
    whole.sort()  # np.unique imports numpy.ma
    whole = whole[np.diff(whole, prepend=-np.inf) > 0.0]
    enough = len(whole) >= MIN_WHOLE and np.abs(whole).max() < MAX_COUNTS
    return bool(enough and np.gcd.reduce(whole.astype(np.int64)) == 1)


def _likely(ordered: Sequence[Float64[np.ndarray, " _"]], steps: Float64[np.ndarray, " m"]) -> Iterator[bool]:
    """Whether enough neighbours may be one step apart, for each step: else `_counts_in`, which rounds, need not look."""
    away = [np.abs(axis - _middle(axis)) if len(axis) else axis for axis in ordered]
    reach, distance = (np.concatenate(x) for x in ([np.maximum(d[1:], d[:-1]) for d in away], [np.diff(x) for x in ordered]))
    nearest = np.argsort(reach)
    reach, distance = reach[nearest], distance[nearest]
    maximum, minimum = (np.searchsorted(reach, MAX_STEPS * steps * size) for size in (1.0 + ROUNDED, 1.0 - ROUNDED))
    for step, more, fewer in zip(steps.tolist(), maximum.tolist(), minimum.tolist(), strict=True):
        next_to = int(np.count_nonzero(np.abs(distance[:more] - step) < (0.5 + ROUNDED) * step))
        yield next_to >= MIN_NEXT * int(np.count_nonzero(distance[:fewer] > ROUNDED * step))


def _middle(ordered: Float64[np.ndarray, " n"]) -> float:
    return 0.5 * float(ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2])


def _counts_in(ordered: Sequence[Float64[np.ndarray, " _"]], step: float) -> bool:
    """Whether the values of three axes lie on grids of this step, each with an offset, by Rayleigh's test of their phases."""
    axes = [values for axis in ordered if len(values := _distinct(axis / step)) > 1]
    if not axes:
        return False
    steps = np.concatenate([values[1:] - values[:-1] for values in axes])
    if np.count_nonzero(steps[steps > 0.5].round() == 1) < MIN_NEXT * len(steps):  # first, as phases take longest
        return False
    sums = [np.exp(2j * np.pi * values).sum() for values in axes]
    total = sum(abs(each) ** 2 / len(values) for each, values in zip(sums, axes, strict=True))
    if total < MIN_SUM or sum(map(abs, sums)) < MIN_LENGTH * sum(map(len, axes)):
        return False
    turns = np.concatenate([np.angle(np.exp(2j * np.pi * v) / each) / (2 * np.pi) for each, v in zip(sums, axes, strict=True)])
    places = np.concatenate([values - values.mean() for values in axes])
    power = float((places**2).sum())
    off, uncertain = float((places * turns).sum()) / power, float(np.sqrt((turns**2).mean() / power))
    return abs(off) < MAX_OFF and uncertain < MAX_UNCERTAIN


def _distinct(ordered: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " m"]:
    """Different values near the median of ordered ones."""
    if not len(ordered):
        return ordered
    near = ordered[np.abs(ordered - _middle(ordered)) < MAX_STEPS].round(6)
    different = np.ones(len(near), bool)
    np.not_equal(near[1:], near[:-1], out=different[1:])
    return np.asarray(near[different])
