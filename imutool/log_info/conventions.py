"""Conventions of an IMU in words: units, axes, the poses' world and clock."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator

import numpy as np

from imutool.cleaning import CleaningSettings
from imutool.cleaning.conventions import Conventions, Reading
from imutool.cleaning.rule import TopicSummary
from imutool.cleaning.rules.axes import Axes
from imutool.cleaning.rules.units import Units
from imutool.cleaning.samples import Motion, Samples
from imutool.cleaning.truth import Truth, truth_of
from imutool.cleaning.unit_evidence import accel_reading
from imutool.log_info.report import Convention
from imutool.recording import Imu, Recording

logger = logging.getLogger(__name__)

NO_POSES = "the log has no true poses"
NO_TURN = "the motion turns too little, or about one axis only"
NO_GRAVITY = "gravity does not turn clearly in the body: rest, planar motion, or a vehicle's own acceleration"


def convention_summary(imu: Imu, truth: Truth | None) -> TopicSummary:
    """Totals for the rules about conventions; nothing is converted."""
    motion = Motion()
    motion.see(Samples(np.arange(len(imu)), imu.t_ns, imu.t_ns, np.concatenate([imu.gyro, imu.accel], axis=1)))
    return TopicSummary(CleaningSettings(convert_units=False), len(imu), motion, truth)


def convention_warnings(whole: TopicSummary) -> list[str]:
    """Warnings about units, axes and frames; a note without a correction is none."""
    findings = [*Units().findings(whole), *Axes().findings(whole)]
    fix = "; imutool convert LOG OUT --fix corrects it"
    return [f.what + (fix if "fix" in f.values else "") for f in findings if f.severity != "note" or "fix" in f.values]


def warn_of_conventions(imu: Imu, truth: Truth | None, where: str) -> None:
    """Log the warnings about units, axes and frames for whoever uses the samples as they are."""
    for warning in convention_warnings(convention_summary(imu, truth)) if len(imu) else []:
        logger.warning("%s: %s", where, warning)


def warn_of_recordings(recordings: Iterable[Recording]) -> None:
    """Log those warnings for recordings in memory."""
    for recording in recordings:
        warn_of_conventions(recording.imu, truth_of(recording), f"{recording.name} {recording.imu_topic}")


def conventions(whole: TopicSummary) -> list[Convention]:
    """What the motion shows of each convention."""
    return [Convention(*entry) for entry in _entries(whole, whole.conventions)]


def _entries(whole: TopicSummary, found: Conventions) -> Iterator[tuple[str, bool, str]]:
    level, at_rest, unit = accel_reading(whole.motion)
    if level is not None:
        size = f"reads {level:.4g} {'when calm' if at_rest else 'in the median'}"
        yield "unit of accel", bool(unit), f"{unit}: it {size}" if unit else f"cannot be judged: it {size}"
    why = NO_GRAVITY if whole.truth is None else NO_TURN
    by_gravity = _gyro(found.relative, "gravity as accel reads it")
    yield "gyro against accel", *(by_gravity or (False, f"cannot be judged: {NO_GRAVITY}"))
    yield "gyro against poses", *(_gyro(found.gyro, found.topic) or _unknown(whole, why))
    if found.accel is not None:
        yield "accel against poses", True, f"{found.accel.names} by {_ratio(found.accel)}"
    else:
        yield "accel against poses", *_unknown(whole, "the motion is too slow to tell it from its negative")
    yield "world of poses", *((True, f"{found.up} is up") if found.up else _unknown(whole, why))
    if found.delay is not None:
        late = f"{1e3 * found.delay.seconds:+.1f} ms late, standard deviation {1e3 * found.delay.std_s:.1f} ms"
        yield "clock of poses", True, late
    else:
        yield "clock of poses", *_unknown(whole, why)


def _gyro(reading: Reading | None, against: str) -> tuple[bool, str] | None:
    if reading is None or not reading.sole:
        return None
    return True, f"{reading.names} in {reading.unit} by {against}, {_ratio(reading)}"


def _ratio(reading: Reading) -> str:
    return f"{reading.certain:.1f} standard errors ahead of the second best"


def _unknown(whole: TopicSummary, why: str) -> tuple[bool, str]:
    return False, f"cannot be judged: {NO_POSES if whole.truth is None else why}"
