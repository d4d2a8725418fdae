"""Units and axes of the IMU; the poses' world, clock and coverage."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from imutool.cleaning.conventions import Conventions
from imutool.cleaning.likelihood import Reading
from imutool.cleaning.pose_delay import lateness
from imutool.cleaning.rule import TopicSummary
from imutool.cleaning.rules.axes import LATE_STDS, Axes
from imutool.cleaning.rules.saturation import Saturation
from imutool.cleaning.rules.stuck import Stuck
from imutool.cleaning.rules.units import Units
from imutool.cleaning.stamp_line import read_stamps
from imutool.cleaning.truth import Truth, truth_of
from imutool.cleaning.unit_evidence import accel_reading
from imutool.errors import DataError
from imutool.log_info.imu_motion import ImuMotion, blocks_of, motion_of, turns_at_stops
from imutool.log_info.pose_imu_rotation import (
    BY_HAND,
    CORRECTION,
    body_warnings,
    motion_warnings,
    reversed_warnings,
    sparse_warnings,
    unlike,
    velocities_judged,
)
from imutool.log_info.report import Convention, TruthInfo
from imutool.mcap_io.codec.decode import RESTAMP
from imutool.recording import GRAVITY_M_S2, Imu, Recording

logger = logging.getLogger(__name__)

FIX_BY_HAND = BY_HAND[0].upper() + BY_HAND[1:]
QUATERNIONS = "quaternions of poses"  # said only where they are misread
START_LATE_S = 0.015  # half of what is a warning; a start from poses 10 ms late is off by about its standard deviation
MIN_VERTICAL = 0.85  # of gravity along the z of the poses, in the mean: 32 degrees
NO_POSES = "the log has no true poses"
NO_TURN = (
    "no order of the axes fits clearly: little motion, turns about one axis only, a turned body, or poses of another motion"
)
NO_FORCE = (
    "no order of the axes fits clearly: slow motion, noisy positions or positions in another unit, or forces without gravity"
)
NO_DELAY = "the sizes of the turns show no single delay: few poses, or turns that hardly change"
NO_GRAVITY = "gravity does not turn clearly in the body: rest, planar motion, or a vehicle's own acceleration"


def defect_warnings(imu: Imu, whole: TopicSummary) -> list[str]:
    """Warning of axes that stand still or are clipped, of an IMU whose sensors both change."""
    stuck, saturation = Stuck(), Saturation()
    for _ in saturation(stuck(blocks_of(imu))):
        pass
    found = [f"{finding.count} {finding.what}" for rule in (stuck, saturation) for finding in rule.findings(whole)]
    return ["; ".join(found)] if found and not motion_of(imu).constant_sensors() else []


def convention_warnings(whole: TopicSummary) -> list[str]:
    """Warnings about units, axes and frames; a note without a correction is none.

    Corrections of the world and of the unit of positions stay in the totals.
    """
    findings = [*Units().findings(whole), *Axes().findings(whole)]
    return [
        f.what + (f"; {CORRECTION}" if "fix" in f.values else "") for f in findings if f.severity != "note" or "fix" in f.values
    ]


def contradictions(whole: TopicSummary) -> list[str]:
    """Sentences on axes that the motion contradicts, and on stops that the poses contradict."""
    return [*(finding.what for finding in Axes().findings(whole) if finding.severity == "error"), *turns_at_stops(whole)]


def _warnings(found: ImuMotion, whole: TopicSummary) -> list[str]:
    """Warnings about units, axes and frames of samples that are used uncorrected."""
    if not found.motion.samples:
        return []
    warnings, of_poses = [*found.constant_sensors(), *convention_warnings(whole)], _pose_warnings(found, whole)
    warnings += [warning for warning in of_poses if warnings and warning.endswith(BY_HAND)]
    return warnings or [*of_poses, *lean_warnings(found, whole)]


def _pose_warnings(found: ImuMotion, whole: TopicSummary) -> list[str]:
    """Warnings of poses that do not turn as the gyro does, or are too far apart to show it."""
    if whole.truth is None:
        return []
    sparse, compared = sparse_warnings(whole.truth), found.turns.get(whole.truth.topic)
    if compared is None or (turns := compared.agreement()) is None:
        return sparse
    topic, turned_deg = whole.truth.topic, [] if turns.turned is None else turns.turned.deg.tolist()
    seen = turns.explained, turns.rms_rad_s, turns.jumps, turns.largest_jump_deg
    body = body_warnings(topic, turned_deg, turns.explained, turns.as_recorded)
    return [*body, *reversed_warnings(topic, turns.reversed_axes), *motion_warnings(topic, *seen), *sparse]


def lean_warnings(found: ImuMotion, whole: TopicSummary) -> list[str]:
    """Warning of an IMU that lies otherwise than the body of the poses.

    It comes where no other warning names the cause. Turns about one axis, as of wheels, do not show how it lies; gravity does.
    """
    truth, vertical = whole.truth, whole.conventions.vertical_m_s2
    named = [warning for warning in _pose_warnings(found, whole) if not warning.endswith(BY_HAND)]
    if truth is None or vertical is None or vertical > MIN_VERTICAL * GRAVITY_M_S2 or named:
        return []
    causes = "the IMU lies otherwise than their body, their world is not z up, or gravity was subtracted"
    return [
        f"the accelerometer reads {vertical:.1f} m/s² along the z of the poses {truth.topic} in the mean, not gravity: {causes}"
    ]


def check_start_poses(recording: Recording) -> float:
    """Delay of the poses (s) for a start from them; zero where none is clear.

    Poses of another motion are refused, and what `convert --fix` corrects; jumps at times are no error.

    Raises:
        DataError: such poses.
    """
    truth = truth_of(recording)
    motion = motion_of(recording.imu, truth)
    found, whole = None if truth is None else motion.turns[truth.topic].agreement(), motion.summary(truth)
    for warning in _warnings(motion, whole):
        what, fix = _apart(warning, truth)
        if fix or (found is not None and unlike(found.explained, found.rms_rad_s)):
            expected, fix = "poses and samples of one motion for a start from the truth", fix or "See imutool info LOG"
            where = f"{recording.name} {recording.imu_topic}"
            raise DataError(what, where=where, expected=expected, fix=f"{fix}, or give another `init`")
    delay = whole.conventions.delay
    clear = delay is not None and delay.step is None and abs(delay.seconds) > max(START_LATE_S, LATE_STDS * delay.std_s)
    return delay.seconds if delay is not None and clear else 0.0


def check_poses(recording: Recording, *, world: bool = True, warn: bool = True) -> None:
    """Refuse poses whose quaternions, unit or, with `world`, vertical the IMU contradicts.

    Raises:
        DataError: such poses; their body and their clock may differ from the IMU's.
    """
    truth = truth_of(recording)
    motion = motion_of(recording.imu, truth)
    whole = motion.summary(truth)
    for finding in Axes().findings(whole):
        if "poses" in finding.values and (world or whole.quaternions or whole.position_unit != "m"):
            expected = "quaternions as w, x, y, z from body to world, z up, and metres"
            raise DataError(finding.what, where=recording.name, expected=expected, fix=_correction(finding.what, truth))
    for warning in _warnings(motion, whole) if warn else ():
        logger.warning("%s: %s", recording.name, warning)


def warn_of_conventions(imu: Imu, truth: Truth | None, where: str) -> TopicSummary:
    """Warn of units, axes, frames, and dead or clipped axes of uncorrected samples."""
    motion = motion_of(imu, truth)
    whole = motion.summary(truth)
    for warning in [*_warnings(motion, whole), *defect_warnings(imu, whole)]:
        logger.warning("%s: %s", where, warning.replace(CORRECTION, _correction(warning, truth)))
    return whole


def _correction(warning: str, truth: Truth | None) -> str:
    """The command that corrects what a warning names; poses that are no truth are judged only if they are called one."""
    if truth is None or truth.kind == "truth" or "poses" not in warning:
        return CORRECTION
    return CORRECTION.replace("--fix", f"--fix --kind {truth.topic}=truth")


def _apart(warning: str, truth: Truth | None) -> tuple[str, str]:
    """A warning without what to do, and that; empty where it says nothing to do."""
    for fix, text in ((CORRECTION, _correction(warning, truth)), (BY_HAND, FIX_BY_HAND)):
        if warning.endswith(fix):
            return warning.removesuffix(f"; {fix}"), text
    return warning, ""


def check_one_sensor(recordings: Sequence[Recording]) -> None:
    """Refuse logs that state different sensors.

    Raises:
        DataError: two of them state a sensor, and not the same one.
    """
    stated = {r.name: str(r.metadata.get("imutool", {}).get("sensor", "")) for r in recordings}
    if len({sensor for sensor in stated.values() if sensor}) > 1:
        listed = ", ".join(f"{name}: {sensor or 'not stated'}" for name, sensor in stated.items())
        what = f"the logs are of different sensors ({listed})"
        raise DataError(what, expected="logs of one sensor", fix="Take each sensor by itself")


def warn_of_recordings(recordings: Iterable[Recording]) -> list[TopicSummary]:
    """Log those warnings for recordings in memory."""
    return [warn_of_conventions(r.imu, truth_of(r), f"{r.name} {r.imu_topic}") for r in map(velocities_judged, recordings)]


@np.errstate(over="ignore", invalid="ignore")  # of one sample of 1e160, as a broken driver writes it
def check_conventions(recordings: Iterable[Recording]) -> None:
    """Refuse recordings whose stamps, units, axes or frames are wrong; log other warnings.

    Raises:
        DataError: as `check_motion`, and stamps that are not the sensor's.
    """
    for each in map(velocities_judged, recordings):
        where = f"{each.name} {each.imu_topic}"
        if faults := read_stamps(each.imu.t_ns).faults:
            raise DataError(faults[0], where=where, expected="the sensor's own times", fix=f"{RESTAMP} corrects it")
        check_motion(motion_of(each.imu, truth_of(each)), truth_of(each), where)


@np.errstate(over="ignore", invalid="ignore")
def check_motion(motion: ImuMotion, truth: Truth | None, where: str) -> None:
    """Check units, axes and frames of samples and poses that came in blocks.

    Raises:
        DataError: what `convert --fix` corrects, and a gyro that contradicts the true poses.
    """
    whole = motion.summary(truth)
    wrong = contradictions(whole)
    for warning in _warnings(motion, whole):
        what, fix = _apart(warning, truth)
        if fix or warning in wrong:
            raise DataError(what, where=where, expected="units, axes and poses that agree", fix=fix or FIX_BY_HAND)
        logger.warning("%s: %s", where, warning)


def check_units(whole: TopicSummary, where: str) -> None:
    """Refuse samples that are clearly in another unit (DataError)."""
    for finding in Units().findings(whole):
        if "fix" in finding.values:
            raise DataError(finding.what, where=where, expected="rad/s and m/s²", fix=CORRECTION)


def conventions(whole: TopicSummary) -> list[Convention]:
    """Lists what the motion shows of each convention."""
    return [Convention(*entry) for entry in _entries(whole, whole.conventions)]


def _entries(whole: TopicSummary, found: Conventions) -> Iterator[tuple[str, bool, str]]:
    level, at_rest, unit = accel_reading(whole.motion)
    if level is not None:
        size = f"reads {level:.4g} {'when calm' if at_rest else 'in the median'}"
        yield "unit of accel", bool(unit), f"{unit}: it {size}" if unit else f"cannot be judged: it {size}"
    if found.quaternions:
        yield QUATERNIONS, True, f"they {found.quaternions}; what follows is judged without that"
    turned = found.gyro is not None and found.gyro.sole
    by_gravity = _gyro(found.relative, "gravity as accel reads it")
    yield "gyro against accel", *(by_gravity or (False, f"cannot be judged: {NO_GRAVITY}"))
    yield "gyro against poses", *(_gyro(found.gyro, found.topic) or _unknown(whole, NO_TURN))
    if found.accel is not None:
        yield "accel against poses", True, f"{found.accel.names}, {_ratio(found.accel)}"
    else:
        yield "accel against poses", *_unknown(whole, NO_FORCE)
    yield "world of poses", *((True, f"{found.up} is up") if found.up else _unknown(whole, NO_FORCE if turned else NO_TURN))
    if found.unit != "m":
        yield "unit of positions", True, f"{found.unit}: so they accelerate as accel says"
    if found.delay is not None and found.delay.step is not None:
        before, after, _ = found.delay.step
        yield "clock of poses", True, f"steps: first {lateness(before)}, then {lateness(after)}"
    elif found.delay is not None:
        yield "clock of poses", True, f"{lateness(found.delay.seconds, 1)}, standard deviation {1e3 * found.delay.std_s:.1f} ms"
    else:
        yield "clock of poses", *_unknown(whole, NO_DELAY if turned else NO_TURN)


def _gyro(reading: Reading | None, against: str) -> tuple[bool, str] | None:
    if reading is None or not reading.sole:
        return None
    return True, f"{reading.names} in {reading.unit} by {against}, {_ratio(reading)}"


def _ratio(reading: Reading) -> str:
    return f"{reading.certain:.1f} standard errors better than the next order of axes"


def _unknown(whole: TopicSummary, why: str) -> tuple[bool, str]:
    return False, f"cannot be judged: {NO_POSES if whole.truth is None else why}"


def truth_warnings(truths: Sequence[TruthInfo]) -> list[str]:
    """Warnings about the true poses of a log with an IMU."""
    usable = [truth for truth in truths if truth.kind in ("truth", "unknown")]
    if not usable:
        others = ", ".join(f"{truth.topic} is of kind {truth.kind}" for truth in truths)
        return [f"no true poses: {others}; imutool evaluate LOG --truth TOPIC takes one of them" if others else "no true poses"]
    warnings = [f"{truth.topic}: shares no time with the IMU" for truth in usable if truth.coverage == 0.0]
    for truth in usable:
        explained, rms, jumps, largest = truth.gyro_explained, truth.gyro_rms_rad_s, truth.jumps, truth.largest_jump_deg
        as_recorded = truth.gyro_explained_as_recorded
        if isinstance(explained, float) and isinstance(as_recorded, float):
            warnings += body_warnings(truth.topic, truth.body_turned_deg or [], explained, as_recorded)
        warnings += reversed_warnings(truth.topic, truth.gyro_reversed_axes or "")
        if isinstance(explained, float) and isinstance(rms, float) and isinstance(jumps, int) and isinstance(largest, float):
            warnings += motion_warnings(truth.topic, explained, rms, jumps, largest)
    return warnings
