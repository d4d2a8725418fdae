"""Audit of a simulator: its IMU against its own poses, a data sheet and a recording.

log ─ kinematics ─> Kinematics ─ kinematic_fit ─> KinematicFit ─ motion_faults, noise_faults ─> AuditReport
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

from imutool.diagnosis.audit.bandwidth import max_filter_delays
from imutool.diagnosis.audit.faults import CERTAIN, FAULTS, FaultFound, found
from imutool.diagnosis.audit.motion import KinematicFit, Kinematics, kinematic_fit, kinematics, units
from imutool.diagnosis.audit.motion_faults import motion_faults, unexplained
from imutool.diagnosis.audit.noise import Expected, noise_faults
from imutool.diagnosis.audit.simulation import AT_BODY, Mount, read_simulation
from imutool.diagnosis.audit.spectral_lines import SpectralLine, by_differences, spectral_lines
from imutool.diagnosis.result import Estimate
from imutool.diagnosis.wording.quantity import grouped
from imutool.errors import DataError, ImutoolError
from imutool.file_location import Location
from imutool.log_info.convention_report import check_poses
from imutool.noise import datasheet
from imutool.recording import Recording
from imutool.report import Report
from imutool.units import AXES, SENSORS, Sensor

BY_RECORDING = ("body_centre", "clipping_absent", "digits_absent", "bandwidth_absent")
MIN_ARM_M = 0.02  # of the recording's sensor from its poses' point
TIMING = ("backward_difference", "step_delay", "early_stamps")
BY_POSITIONS = (
    *("coordinate_acceleration", "gravity_doubled", "gravity_sign", "gravity_only", "transport_term", "lever_arm"),
    "other_clock",
)
BY_NOISE = ("noise_absent", "noise_per_sample", "noise_density")


class AuditReport(Report, frozen=True, tag="imutool.audit/1"):
    """Report of `imutool audit`: faults of a simulator, and what these logs cannot show.

    Attributes:
        faults: each with its signal, numbers, equation and the report of a simulator that had it.
        tested: names of the faults that were looked for.
        not_tested: the others, with the reason.
        unexplained: shares of the sensors' motions (root mean square) that neither poses nor a fault explain, where large.
    """

    sim: str
    real: str | None
    faults: tuple[FaultFound, ...]
    tested: tuple[str, ...]
    not_tested: Mapping[str, str]
    unexplained: Mapping[str, float]


def audit(
    sim: Location,
    real: Location | None = None,
    *,
    noise: str | Path = "none",
    imu: str | None = None,
    truth: str | None = None,
) -> AuditReport:
    """Faults of a simulator's IMU, by its own poses, a data sheet's `noise` and a recording.

    `truth` is the topic of the poses, where there are several. They are moved to the sensor where /tf_static states its mount.

    Raises:
        ConfigError, LogError: a log or the data sheet cannot be read.
        DataError: the simulation has no poses that can be differentiated, or they are misread or in mm.
    """
    simulated, mount = read_simulation(sim, imu=imu, truth=truth)
    check_poses(simulated, world=False)  # of a wrong world the faults say it, and what to do
    recording, real_mount = (None, AT_BODY) if real is None else read_simulation(real, imu=imu, simulated=False)
    sheet = datasheet.read(noise)
    expected = _expected(recording, sheet)
    try:
        faults, unknown_lines, motion_left = _faults(simulated, recording, expected, (mount, real_mount))
    except DataError as error:
        raise error.at(sim) from error
    not_tested = dict(_not_tested(recording, sheet))
    varying = [each for each in SENSORS if any(reference.varies(each) for reference in expected) and not _states(sheet, each)]
    if varying and not any(fault.fault == "noise_density" for fault in faults):
        of = f"the noise of the recording's {' and '.join(varying)} varies, as vibration does"
        not_tested["noise_density"] = f"{of}: only a data sheet (`noise`) refutes a smaller one"
    if not simulated.truth.has_positions:
        not_tested |= dict.fromkeys(BY_POSITIONS, "the poses have no positions, which the accelerometer needs")
    if unknown_lines and not any(fault.fault == "step_lines" for fault in faults):
        at = " and ".join(f"{line.f_hz:.4g} Hz ({line.sensor})" for line in unknown_lines)
        not_tested["step_lines"] = (
            f"there are lines, at {at}, and the poses are too slow or too noisy to show whether the body moves so"
        )
    tested = tuple(name for name in FAULTS if name not in not_tested)
    return AuditReport(str(sim), None if real is None else str(real), tuple(faults), tested, not_tested, motion_left)


def simulator_faults(sim: Recording, real: Recording | None, sheet: datasheet.Noise) -> list[FaultFound]:
    """Faults of a simulation by its own poses, and against a recording and a data sheet.

    Raises:
        DataError: it has no poses that can be differentiated.
    """
    return _faults(sim, real, _expected(real, sheet), (AT_BODY, AT_BODY))[0]


def _expected(real: Recording | None, sheet: datasheet.Noise) -> list[Expected]:
    """Noise by a data sheet and by a recording."""
    by_sheet = [Expected.of_sheet(sheet)] if _has_noise(sheet) else []
    return by_sheet + ([] if real is None else [Expected.of_recording(real.imu)])


def _faults(
    sim: Recording, real: Recording | None, expected: list[Expected], mounts: tuple[Mount, Mount]
) -> tuple[list[FaultFound], list[SpectralLine], dict[str, float]]:
    """Faults, spectral lines whose cause the poses do not show, and large shares of the motion that nothing explains."""
    if not sim.truths:
        raise sim.no_truth("a simulation without poses", "a simulation with the poses of its body")
    sim, moved, by_motion = _in_si(sim)
    fit = kinematic_fit(moved)
    samples, rate_hz = np.concatenate([sim.imu.gyro, sim.imu.accel], axis=1), 1.0 / sim.imu.period_s
    by_motion += motion_faults(moved, fit, max_filter_delays(sim, fit))
    motion_left = unexplained(moved, fit, by_motion)
    if not sim.truth.has_positions:  # zeros stand for them: of the accelerometer they show nothing
        known = (f for f in by_motion if f.fault == "wrong_unit" or (f.signal != "accel" and f.fault not in BY_POSITIONS))
        by_motion = [msgspec.structs.replace(f, signal="gyro") if f.signal == "both" else f for f in known]
        motion_left.pop("accel", None)
    if motion_left:  # of what is no motion of the body no delay can be told
        by_motion = [fault for fault in by_motion if fault.fault not in TIMING or fault.signal not in (*motion_left, "both")]
    arm = np.array([fit.estimates[axis].value for axis in AXES])
    lines_found = spectral_lines(samples, fit.residual, rate_hz, *by_differences(sim.truth, arm))
    lines_found = [line for line in lines_found if sim.truth.has_positions or line.sensor == "gyro"]
    faults, unknown_lines = noise_faults(sim.imu, fit.residual, expected, lines_found)
    if any(fault.fault == "repeated_samples" for fault in faults):  # which are late by half of the physics step
        by_motion = [fault for fault in by_motion if fault.fault not in TIMING[:2]]
    faults = by_motion + faults
    if real is not None and real.truths:
        faults += _body_centre(fit, real, mounts)
    return faults, unknown_lines, motion_left


def _in_si(sim: Recording) -> tuple[Recording, Kinematics, list[FaultFound]]:
    """A simulation with its motion, in SI units, and the sensors that were in others."""
    moved = kinematics(sim)
    factor = units(moved)
    if set(factor.values()) == {1.0}:
        return sim, moved, []
    wrong = [found("wrong_unit", sensor, scale=Estimate(1.0 / by, 0.0, "-")) for sensor, by in factor.items() if by != 1.0]
    imu = replace(sim.imu, gyro=sim.imu.gyro * factor["gyro"], accel=sim.imu.accel * factor["accel"])
    moved = replace(moved, gyro=moved.gyro * factor["gyro"], accel=moved.accel * factor["accel"])
    return replace(sim, imu=imu), moved, wrong


def simulator_remarks(sim: Recording) -> list[str]:
    """Remarks on a simulation's errors by its own poses; none without usable poses."""
    try:
        faults = simulator_faults(sim, None, datasheet.read("none"))
    except ImutoolError:
        return []
    return [f"The simulation is wrong by itself: {fault.sentence} ({fault.fault}){_unless(fault)}" for fault in faults]


def lines(report: AuditReport) -> list[str]:
    """Text of a report: a sentence, then one line for each fault with its numbers and source."""
    count = len(report.faults)
    head = (
        "No fault of the simulator found." if not count else f"{count} fault{'s' if count > 1 else ''} of the simulator found:"
    )
    out = [head]
    for fault in report.faults:
        numbers = ", ".join(quantity.labelled for quantity in grouped(fault.parameters))
        out.append(f"{fault.fault}: {fault.sentence}{f' ({numbers})' if numbers else ''}.")
        out.append(f"    {fault.equation}; reported in {fault.source}")
        out += [f"    No fault if {fault.unless}."] if fault.unless else []
    for sensor, share in report.unexplained.items():
        differs = f"the motion that the {sensor} reads differs by {100.0 * share:.0f} % from that of the poses"
        out.append(f"Not explained: {differs}.")
    out += [f"Not tested: {', '.join(names)}: {why}." for why, names in _grouped(report.not_tested).items()]
    return out


def _unless(fault: FaultFound) -> str:
    return f", unless {fault.unless}" if fault.unless else ""


def _has_noise(sheet: datasheet.Noise) -> bool:
    """Whether a data sheet states any density; `none` states zeros."""
    return any(_states(sheet, sensor) for sensor in SENSORS)


def _states(sheet: datasheet.Noise, sensor: Sensor) -> bool:
    """Whether a data sheet states a sensor's density."""
    return bool((sheet.values(f"{sensor}_density") > 0.0).any())


def _grouped(not_tested: Mapping[str, str]) -> dict[str, list[str]]:
    out: dict[str, list[str]] = {}
    for name, why in not_tested.items():
        out.setdefault(why, []).append(name)
    return out


def _not_tested(real: Recording | None, sheet: datasheet.Noise) -> Iterator[tuple[str, str]]:
    if not _has_noise(sheet):
        yield "bias_never_walks", "it needs a data sheet (`noise`)"
    if real is None:
        yield from ((name, "they need a recording (`real`)") for name in BY_RECORDING)
    if real is None and not _has_noise(sheet):
        yield from ((name, "they need a data sheet (`noise`) or a recording (`real`)") for name in BY_NOISE)


def _body_centre(fit: KinematicFit, real: Recording, mounts: tuple[Mount, Mount]) -> list[FaultFound]:
    """A sensor at the body's centre, where the recording's sits off it."""
    try:
        moved: Kinematics = kinematics(real)
    except ImutoolError:
        return []
    own_arm, moved_arm = (
        {a: Estimate(estimates[a].value + stated, estimates[a].std, "m") for a, stated in zip(AXES, mount.arm, strict=True)}
        for estimates, mount in zip((fit.estimates, kinematic_fit(moved).estimates), mounts, strict=True)
    )
    clear = [abs(moved_arm[a].value - own_arm[a].value) > CERTAIN * np.hypot(moved_arm[a].std, own_arm[a].std) for a in AXES]
    sizes = [float(np.linalg.norm([arm[a].value for a in AXES])) for arm in (own_arm, moved_arm)]
    if not any(clear) or sizes[0] > 0.2 * sizes[1] or sizes[1] < MIN_ARM_M:
        return []
    return [found("body_centre", "accel", **moved_arm)]
