"""Units other than m/s² and rad/s: g, mg, mm/s², ft/s², and degrees a second.

Gravity at rest settles the accelerometer's. The gyro's is settled by the true rate where there are poses, and else by gravity:
integrated over two seconds, the gyro must carry the specific force at their start to that at their end.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from imutool.cleaning.finding import Finding, Severity
from imutool.cleaning.rule import CleaningSettings, Rule, TopicSummary
from imutool.cleaning.rules.axes import tilt_misfit
from imutool.cleaning.samples import Motion, Samples
from imutool.cleaning.truth import Truth, turning
from imutool.recording import GRAVITY_M_S2, Imu, seconds

UNITS = {1.0: "g", 1000.0: "mg", GRAVITY_M_S2 * 1000.0: "mm/s^2", GRAVITY_M_S2 / 0.3048: "ft/s^2"}  # by reading at rest
FACTORS = {"g": 9.80665, "mg": 9.80665e-3, "mm/s^2": 1e-3, "ft/s^2": 0.3048}
REST_TOLERANCE = 0.05  # of gravity: 0.5 m/s² covers bias and scale of a poor sensor
MOVING_TOLERANCE = 0.4
UNIT_TOLERANCE = 0.1  # the units are a factor of 3.3 apart and more
FREE_OF_GRAVITY_M_S2 = 0.5

DEGREES = 180.0 / np.pi
DEGREES_BAND = (0.45, 2.2)  # of 180/pi, for the ratio of the measured to the true rate; 0.97 to 1.05 on real recordings
SURE_BAND = (0.9, 1.1)
MIN_TURN_RAD_S, FEWEST_TURNS = 0.1, 10  # of the true rate, and times at which it turns so fast
POSES_APART_NS = 300_000_000
FULL_SCALE_RAD_S = 35.0  # 2000 degrees a second, the widest range of common MEMS gyros
ASTRAY_RAD = 0.6  # what gravity misses by after two seconds of a rate 57 times too high; 0.19 at most on real recordings
CLEARLY = 0.5  # of the misfit as rad/s, that of deg/s at most
BIASED = 0.15  # of gravity: so far off, a reading is a bias or a scale, which a model takes off

CALM_STEPS, CALM_SHARE = 10, 0.1  # windows of a second, and the calmest of them
CALM_SCATTER = 0.03  # of the reading


class Units(Rule):
    """Rule for units: it converts a settled unit, else reports it and distrusts the log."""

    place = 120

    def findings(self, whole: TopicSummary) -> Iterator[Finding]:
        """One for each sensor in another unit; `whole.scale` then converts."""
        yield from self._accel(whole)
        yield from self._gyro(whole)

    def _accel(self, whole: TopicSummary) -> Iterator[Finding]:
        level, at_rest = gravity_level(whole.motion)
        if level is None:
            return
        tolerance = REST_TOLERANCE if at_rest else MOVING_TOLERANCE
        unit = accel_unit(level, tolerance)
        values = {"reading": level, "at_rest": at_rest, "unit": unit or "unknown"}
        if unit == "m/s^2":
            return
        if unit and at_rest and whole.settings.convert_units:
            whole.scale[3:] = factor = FACTORS[unit]
            what = f"accel is in {unit}, not m/s^2: it reads {level:.4g} when calm"
            yield Finding("units", "warning", what, 3, values=values | {"factor": factor}, action="converted", confidence=0.98)
        elif unit:
            what = f"accel looks like {unit}, not m/s^2: it reads {level:.4g}"
            yield Finding("units", "error", what, 3, values=values, confidence=0.7, distrust=f"accel may be in {unit}")
        elif level < FREE_OF_GRAVITY_M_S2:
            what = f"accel reads {level:.4g} in the median: gravity was taken out, or it measures nothing"
            yield Finding("units", "error", what, 3, values=values, confidence=0.9, distrust="accel has no gravity in it")
        else:
            off = abs(level / GRAVITY_M_S2 - 1.0)
            distrust = f"the unit of accel is unknown: it reads {level:.4g}" if off > MOVING_TOLERANCE else ""
            values["unit"] = "unknown" if distrust else "m/s^2"
            what = f"accel reads {level:.4g} {'when calm' if at_rest else 'in the median'}, gravity is {GRAVITY_M_S2} m/s^2"
            severity: Severity = "error" if distrust else "warning" if off > BIASED else "note"
            yield Finding("units", severity, what, 3, values=values, confidence=0.8, distrust=distrust)

    def _gyro(self, whole: TopicSummary) -> Iterator[Finding]:
        ratio = None if whole.truth is None else rate_ratio(whole.motion, whole.truth)
        share = None if ratio is None else ratio / DEGREES
        if share is not None and DEGREES_BAND[0] <= share <= DEGREES_BAND[1]:
            sure, how = SURE_BAND[0] <= share <= SURE_BAND[1], f"it is {ratio:.4g} times the true rate"
        elif share is not None and DEGREES_BAND[0] <= share * DEGREES <= DEGREES_BAND[1]:
            return
        else:
            step, mean = whole.motion.table()
            fastest = float(np.abs(mean[:, :3]).max(initial=0.0))
            fits = tilt_misfit(step, mean * whole.scale, np.stack([np.eye(3), np.eye(3) / DEGREES]))
            turns = fits is not None and bool(fits[1] < CLEARLY * fits[0]) and bool(fits[0] > ASTRAY_RAD)
            turns_as_rad_s = fits is not None and bool(fits[0] < CLEARLY * fits[1]) and bool(fits[0] < ASTRAY_RAD)
            if not turns and (fastest <= FULL_SCALE_RAD_S or turns_as_rad_s):
                return
            sure = turns and fastest > FULL_SCALE_RAD_S
            how = " and ".join(
                ["gravity turns as if it were"] * turns + [f"it reaches {fastest:.4g}"] * (fastest > FULL_SCALE_RAD_S)
            )
        values: dict[str, Any] = {"unit": "deg/s", "ratio": ratio}
        if sure and whole.settings.convert_units:
            whole.scale[:3] = 1.0 / DEGREES
            what = f"gyro is in deg/s, not rad/s: {how}"
            yield Finding(
                "units", "warning", what, 3, values=values | {"factor": 1.0 / DEGREES}, action="converted", confidence=0.98
            )
        else:
            what = f"gyro looks like deg/s, not rad/s: {how}"
            yield Finding("units", "error", what, 3, values=values, confidence=0.7, distrust="gyro may be in deg/s")


def unit_findings(imu: Imu, truth: Truth | None) -> list[Finding]:
    """Findings of the rule in samples that are in order; no unit is converted."""
    motion = Motion()
    motion.see(Samples(np.arange(len(imu)), imu.t_ns, imu.t_ns, np.concatenate([imu.gyro, imu.accel], axis=1)))
    whole = TopicSummary(CleaningSettings(convert_units=False), len(imu), motion, truth)
    return list(Units().findings(whole))


def accel_unit(level: float, tolerance: float) -> str:
    """The unit in which a reading of gravity is what it is; empty where none is."""
    if abs(level / GRAVITY_M_S2 - 1.0) <= tolerance:
        return "m/s^2"
    near = (unit for reading, unit in UNITS.items() if abs(level / reading - 1.0) <= max(tolerance, UNIT_TOLERANCE))
    return next(near, "")


def gravity_level(motion: Motion) -> tuple[float | None, bool]:
    """Gravity as the accel reads it, and whether at rest; None without samples.

    Calm are the tenth of the seconds whose means over 0.1 s scatter least, if that is less than 3 % of what they read.
    Without any it is the median of all, means of a second, in which vibration is gone.
    """
    step, mean = motion.table()
    if not len(step):
        return None, False
    count = len(step) // CALM_STEPS
    cut = mean[: count * CALM_STEPS, 3:].reshape(count, CALM_STEPS, 3)
    whole = np.diff(step[: count * CALM_STEPS].reshape(count, CALM_STEPS)[:, [0, -1]], axis=1)[:, 0] == CALM_STEPS - 1
    level = np.linalg.norm(cut.mean(axis=1), axis=1)
    scatter = np.sqrt(cut.var(axis=1).sum(axis=1)) / np.maximum(level, 1e-12)
    calm = np.flatnonzero(whole)[np.argsort(scatter[whole])][: max(1, round(CALM_SHARE * count))]
    calm = calm[scatter[calm] < CALM_SCATTER]
    if len(calm):
        return float(np.median(level[calm])), True
    return float(np.median(level[whole] if whole.any() else np.linalg.norm(mean[:, 3:], axis=1))), False


def rate_ratio(motion: Motion, truth: Truth) -> float | None:
    """Ratio of measured to true rate while the truth turns; None if it hardly does.

    Both are lengths about their medians, which a bias does not change.
    """
    first, last, rate = turning(truth)
    step, mean = motion.table()
    if not len(step):
        return None
    t_s, steps_s = seconds(first, motion.start_ns or 0) + 0.5 * seconds(last - first, 0), 0.1 * step + 0.05
    true, measured = (np.linalg.norm(values - np.median(values, axis=0), axis=1) for values in (rate, mean[:, :3]))
    turns = (true > MIN_TURN_RAD_S) & (last - first < POSES_APART_NS)
    turns &= (t_s >= steps_s[0]) & (t_s <= steps_s[-1])
    if turns.sum() < FEWEST_TURNS:
        return None
    return float(np.median(np.interp(t_s[turns], steps_s, measured)) / np.median(true[turns]))
