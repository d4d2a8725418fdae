"""Sizes that settle units: gravity as accel reads it, and the gyro's rate over the true one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from imutool.cleaning.samples import Motion
from imutool.cleaning.truth import Truth, turning
from imutool.recording import GRAVITY_M_S2, seconds
from imutool.recording.columns import median, quantile

DEGREES = 180.0 / np.pi
RATES: Mapping[str, float] = {  # rad/s of one unit
    "rad/s": 1.0,
    "deg/s": 1.0 / DEGREES,
    "mdeg/s": 1e-3 / DEGREES,
    **{f"counts of {full} deg/s in 16 bits": full / 32768.0 / DEGREES for full in (250, 500, 1000, 2000)},
}
FORCES: Mapping[str, float] = {  # m/s² of one unit
    "m/s^2": 1.0,
    "g": 9.80665,
    "mg": 9.80665e-3,
    "mm/s^2": 1e-3,
    "ft/s^2": 0.3048,
    **{f"counts of {full} g in 16 bits": full * 9.80665 / 32768.0 for full in (2, 4, 8, 16)},
}
REST_TOLERANCE = 0.05  # of gravity: 0.5 m/s² covers bias and scale of a poor sensor
MOVING_TOLERANCE = 0.4
UNIT_TOLERANCE = 0.1  # the other units are a factor of 1.2 apart and more

MIN_TURN_RAD_S, FEWEST_TURNS = 0.1, 10  # of the true rate, and times at which it turns so fast
POSES_APART_NS = 300_000_000
CALM_STEPS, CALM_SHARE = 10, 0.1  # windows of a second, and the calmest of them
CALM_SCATTER = 0.03  # of the reading
LARGEST_SCATTER = 1.0  # of the reading, in the median second: more is no gravity with motion, but noise about zero
STEADY_SPREAD = 0.15  # between the quartiles, of the median; 0.53 of noise about zero, 0.11 of a phone spun by hand
GRAVITY_SHARE = 0.5  # of the median reading, that the calmest seconds read at least where gravity is in it


class AccelReading(NamedTuple):
    """Gravity as accel reads it, whether at rest, and its unit; empty where none is sure."""

    level: float | None
    at_rest: bool
    unit: str


def accel_reading(motion: Motion) -> AccelReading:
    """Reading of gravity; no level without samples."""
    level, at_rest, is_noise = gravity_level(motion)
    if level is None or is_noise:
        return AccelReading(level, False, "")
    tolerance = REST_TOLERANCE if at_rest else MOVING_TOLERANCE
    if abs(level / GRAVITY_M_S2 - 1.0) <= tolerance:
        return AccelReading(level, at_rest, "m/s^2")
    ratios = {unit: level * factor / GRAVITY_M_S2 for unit, factor in FORCES.items() if unit != "m/s^2"}
    unit = min(ratios, key=lambda name: abs(np.log(max(ratios[name], 1e-12))))
    near = abs(ratios[unit] - 1.0) <= max(tolerance, UNIT_TOLERANCE)
    return AccelReading(level, at_rest, unit if near else "")


def gravity_level(motion: Motion) -> tuple[float | None, bool, bool]:
    """Gravity as accel reads it, whether at rest, and whether it may be noise; None if empty.

    Calm are the tenth of the seconds whose means over 0.1 s scatter least, if that is less than 3 % of what they read.
    Without any it is the median length, if that is steady: of a body that spins, gravity is gone from means of a second.
    Else it is the median of all, means of a second, in which vibration is gone; or what the calmest read, if that is less
    than half of it: then it is motion that the others read, and gravity was taken out.
    """
    step, mean = motion.table()
    if not len(step):
        return None, False, False
    count = len(step) // CALM_STEPS
    cut = mean[: count * CALM_STEPS, 3:].reshape(count, CALM_STEPS, 3)
    whole = np.diff(step[: count * CALM_STEPS].reshape(count, CALM_STEPS)[:, [0, -1]], axis=1)[:, 0] == CALM_STEPS - 1
    level = np.linalg.norm(cut.mean(axis=1), axis=1)
    scatter = np.sqrt(cut.var(axis=1).sum(axis=1)) / np.maximum(level, 1e-12)
    few = max(1, round(CALM_SHARE * count))
    calm = np.flatnonzero(whole)[np.argsort(scatter[whole])][:few]
    calm = calm[scatter[calm] < CALM_SCATTER]
    if len(calm):
        return float(quantile(level[calm], 0.5)), True, False
    length = np.linalg.norm(mean[:, 3:], axis=1)
    minimum, low, middle, high = (float(quantile(length, share)) for share in (0.05, 0.25, 0.5, 0.75))
    if not whole.any() or (high - low < STEADY_SPREAD * middle and minimum > GRAVITY_SHARE * middle):
        return middle, False, False
    median = float(quantile(level[whole], 0.5))
    calmest = float(quantile(level[np.flatnonzero(whole)[np.argsort((scatter * level)[whole])][:few]], 0.5))
    is_noise = float(quantile(scatter[whole], 0.5)) > LARGEST_SCATTER
    return (calmest if calmest < GRAVITY_SHARE * median else median), False, is_noise


def rate_ratio(motion: Motion, truth: Truth) -> float | None:
    """Ratio of measured to true rate while the truth turns; None if it hardly does.

    Both are lengths about their medians, which a bias does not change.
    """
    first, last, rate = turning(truth)
    step, mean = motion.table()
    if not len(step):
        return None
    t_s, steps_s = seconds(first, motion.start_ns or 0) + 0.5 * seconds(last - first, 0), 0.1 * step + 0.05
    true, measured = (np.linalg.norm(values - median(values), axis=1) for values in (rate, mean[:, :3]))
    turns = (true > MIN_TURN_RAD_S) & (last - first < POSES_APART_NS)
    turns &= (t_s >= steps_s[0]) & (t_s <= steps_s[-1])
    if turns.sum() < FEWEST_TURNS:
        return None
    return float(median(np.interp(t_s[turns], steps_s, measured)) / median(true[turns]))
