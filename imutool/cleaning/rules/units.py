"""Units other than m/s² and rad/s: g, mg, mm/s², ft/s², counts of 16 bits; degrees a second.

Gravity at rest settles the accelerometer's. The gyro's is settled by the rate of the poses, else by gravity: integrated, the
gyro must carry the specific force along; and else by the steps in which a common sensor counts.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from imutool.cleaning.finding import Finding, Severity
from imutool.cleaning.rule import Rule, TopicSummary
from imutool.cleaning.unit_evidence import FORCES, MOVING_TOLERANCE, RATES, accel_reading, rate_ratio
from imutool.recording import GRAVITY_M_S2
from imutool.recording.gyro_steps import unit_by_steps
from imutool.units import FULL_SCALE_RAD_S

FREE_OF_GRAVITY_M_S2 = 0.5
BAND = (0.45, 2.2)  # for the ratio of the measured to the true rate in a unit; 0.97 to 1.05 on real recordings
SURE_BAND = (0.9, 1.1)
BIASED = 0.15  # of gravity: so far off, a reading is a bias or a scale, which a model takes off


class Units(Rule):
    """Rule for units: it converts a settled unit, else reports it and distrusts the log."""

    place = 120

    def findings(self, whole: TopicSummary) -> Iterator[Finding]:
        """One for each sensor in another unit; `whole.scale` then converts."""
        yield from self._accel(whole)
        yield from self._gyro(whole)

    def _accel(self, whole: TopicSummary) -> Iterator[Finding]:
        level, at_rest, unit = accel_reading(whole.motion)
        if level is None:
            return
        values = {"reading": level, "at_rest": at_rest, "unit": unit or "unknown"}
        if unit == "m/s^2":
            return
        if unit and at_rest and whole.settings.convert_units:
            whole.scale[3:] = factor = FORCES[unit]
            what = f"accel is in {unit}, not m/s^2: it reads {level:.4g} when calm"
            values |= {"factor": factor, "fix": f"accel from {unit}"}
            yield Finding("units", "warning", what, 3, values=values, action="converted", confidence=0.98)
        elif unit:
            when = "when calm" if at_rest else "in motion, and no second is calm enough to be sure"
            what = f"accel looks like {unit}, not m/s^2: it reads {level:.4g} {when}"
            values |= {"fix": f"accel from {unit}"} if at_rest else {}
            yield Finding("units", "error", what, 3, values=values, confidence=0.7, distrust=f"accel may be in {unit}")
        elif level < FREE_OF_GRAVITY_M_S2:
            what = f"accel reads {level:.4g}: gravity was taken out, or it measures nothing"
            yield Finding("units", "error", what, 3, values=values, confidence=0.9, distrust="accel has no gravity in it")
        else:
            off = abs(level / GRAVITY_M_S2 - 1.0)
            distrust = f"the unit of accel is unknown: it reads {level:.4g}" if off > MOVING_TOLERANCE else ""
            values["unit"] = "unknown" if distrust else "m/s^2"
            what = f"accel reads {level:.4g} {'when calm' if at_rest else 'in the median'}, gravity is {GRAVITY_M_S2} m/s^2"
            severity: Severity = "error" if distrust else "warning" if off > BIASED else "note"
            yield Finding("units", severity, what, 3, values=values, confidence=0.8, distrust=distrust)

    def _gyro(self, whole: TopicSummary) -> Iterator[Finding]:
        unit, sure, how, ratio = _gyro_unit(whole)
        if unit == "rad/s":
            return
        values: dict[str, Any] = {"unit": unit, "ratio": ratio}
        if sure:
            values |= {"factor": RATES[unit], "fix": f"gyro from {unit}"}
        if sure and whole.settings.convert_units:
            whole.scale[:3] = RATES[unit]
            what = f"gyro is in {unit}, not rad/s: {how}"
            yield Finding("units", "warning", what, 3, values=values, action="converted", confidence=0.98)
        else:
            what = f"gyro looks like {unit}, not rad/s: {how}"
            yield Finding("units", "error", what, 3, values=values, confidence=0.7, distrust=f"gyro may be in {unit}")


def _gyro_unit(whole: TopicSummary) -> tuple[str, bool, str, float | None]:
    """Unit, whether it is sure, the evidence, and the ratio to the true rate."""
    ratio = None if whole.truth is None else rate_ratio(whole.motion, whole.truth)
    if ratio is not None:
        unit = min(RATES, key=lambda name: abs(np.log(max(ratio, 1e-12) * RATES[name])))
        share = ratio * RATES[unit]
        if BAND[0] <= share <= BAND[1]:
            return unit, SURE_BAND[0] <= share <= SURE_BAND[1], f"it is {ratio:.4g} times the true rate", ratio
    relative = whole.conventions.relative
    if relative is not None:
        return relative.unit, True, "in this unit it turns as gravity does in the accelerometer", ratio
    if (steps := unit_by_steps(whole.motion.rates)) is not None:
        return steps[0], True, f"it counts in steps of {steps[1]:.6g} {steps[0]}, as a common sensor does", ratio
    _, mean = whole.motion.table()
    fastest = float(np.abs(mean[:, :3]).max(initial=0.0))
    return ("deg/s" if fastest > FULL_SCALE_RAD_S else "rad/s"), False, f"it reaches {fastest:.4g}", ratio
