"""Faults of a simulated IMU's motion, and what of its motion nothing explains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from imutool.diagnosis.audit.axes import MIN_TURN, UNSEEN, is_signed, nearest_signed
from imutool.diagnosis.audit.faults import FaultFound, clear, found
from imutool.diagnosis.audit.motion import KinematicFit, Kinematics, by_block, of_sum
from imutool.diagnosis.audit.timing import NEAR, timing_faults
from imutool.diagnosis.result import Estimate
from imutool.units import AXES, SENSORS, Sensor

MIN_CLOCK = 0.05  # by which a clock is another: smoothing may take as much of a fast motion
MIN_OVER_NOISE = 3.0  # deviations of noise
MIN_ARM_M = 5e-3
GRAVITY = {0: "coordinate_acceleration", 2: "gravity_doubled", -1: "gravity_sign"}


def motion_faults(k: Kinematics, fit: KinematicFit, filters: tuple[float, float] = (0.0, 0.0)) -> list[FaultFound]:
    """Faults of gravity, frame, axes, transport term, point and timing.

    Delays (in sample periods) up to those of the sensors' own `filters` are no fault.
    """
    timing = timing_faults(fit.estimates, k.period_s, filters)
    return [*_frame_faults(k, fit), *_force_faults(fit), *_clock_faults(fit.estimates), *timing, *_arm_faults(fit.estimates)]


def unexplained(k: Kinematics, fit: KinematicFit, faults: Sequence[FaultFound]) -> dict[str, float]:
    """Large shares of the sensors' motions that neither poses nor a fault nor noise explain.

    A share is one of the root mean square; medians are those between impacts.
    """
    scaled = {fault.fault for fault in faults} & {"other_clock", "gravity_only"}
    out: dict[str, float] = {}
    for sensor, samples, part, name in (("gyro", k.gyro, slice(0, 3), "scale"), ("accel", k.accel, slice(3, 6), "m")):
        residual = k.shown(fit.residual[:, part])
        size, moved, above = (
            float(np.median((x**2).sum(axis=1)))
            for x in (residual, k.shown(samples - samples.mean(axis=0)), fit.residual[:, part] - residual)
        )
        noise = above * k.band_hz / max(0.5 / k.period_s - k.band_hz, k.band_hz)
        share = float(np.sqrt(max(size - MIN_OVER_NOISE**2 * noise, 0.0) / max(moved, 1e-300)))
        scale = fit.estimates[name]
        off = abs(scale.value - 1.0) / max(abs(scale.value), 1.0) if clear(scale, 1.0) and not scaled else 0.0
        if max(share, off) > NEAR:
            out[sensor] = float(np.hypot(share, off))
    return out


def _clock_faults(estimates: Mapping[str, Estimate]) -> list[FaultFound]:
    s, m, k = (estimates[name] for name in ("scale", "m", "k"))
    whole = min(abs(k.value - times) for times in (1, *GRAVITY)) < MIN_CLOCK
    alike = abs(m.value - s.value**2) < NEAR * abs(s.value**2 - 1.0) and whole
    other = abs(s.value - 1.0) > MIN_CLOCK and clear(s, 1.0) and clear(m, 1.0)
    return [found("other_clock", "both", s=s)] if alike and other else []


def _arm_faults(estimates: Mapping[str, Estimate]) -> list[FaultFound]:
    arm = {axis: estimates[axis] for axis in AXES}
    far = np.linalg.norm([r.value for r in arm.values()]) > MIN_ARM_M
    return [found("lever_arm", "accel", **arm)] if far and any(clear(r) for r in arm.values()) else []


def _frame_faults(k: Kinematics, fit: KinematicFit) -> list[FaultFound]:
    flipped = any(np.linalg.det(P) < 0.0 for P in fit.axes)
    signed = [is_signed(P) for P in fit.axes]
    other = [np.linalg.det(P) < 0.0 or (s and not np.allclose(P, np.eye(3))) for P, s in zip(fit.axes, signed, strict=True)]
    flags = {
        "world_frame": [frame == "world" for frame in fit.frames],
        "euler_rates": [frame == "euler" for frame in fit.frames],
        "left_handed" if flipped else "permuted_axes": other,
    }
    out = [found(fault, signal) for fault, each in flags.items() for signal in _which(each)]
    turns = {sensor: _turn(k, fit, sensor) for sensor, s in zip(SENSORS, signed, strict=True) if not s}
    minimum = MIN_TURN / np.sqrt(3.0)  # about one of the axes
    certain = [s for s, turn in turns.items() if any(clear(angle) and abs(angle.value) > minimum for angle in turn.values())]
    return out + [found("turned_axes", sensor, **turns[sensor]) for sensor in certain]


def _turn(k: Kinematics, fit: KinematicFit, sensor: Sensor) -> dict[str, Estimate]:
    """Rotation of the body's axes, or of the nearest flipped ones, to the sensor's, with a deviation by blocks."""
    accel = int(sensor == "accel")
    P, residual = fit.axes[accel], k.shown(fit.residual[:, 3 * accel : 3 * accel + 3])
    x = (k.accel if accel else k.gyro - k.gyro.mean(axis=0)) @ P
    spread = np.linalg.pinv((x**2).sum() * np.eye(3) - x.T @ x)
    turn = Rotation.from_matrix(P if np.linalg.det(P) > 0.0 else P @ nearest_signed(P).T).as_rotvec()
    towards_none = UNSEEN * np.linalg.norm(x.T @ x) * np.abs(spread) @ np.abs(turn)
    std = np.hypot(of_sum(spread @ by_block(k, np.cross(x, residual)).T), towards_none)
    return {axis: Estimate(float(angle), float(s), "rad") for axis, angle, s in zip(AXES, turn, std, strict=True)}


def _force_faults(fit: KinematicFit) -> list[FaultFound]:
    m, k, c = (fit.estimates[name] for name in ("m", "k", "c"))
    out = []
    for whole, name in GRAVITY.items():
        if abs(k.value - whole) < NEAR and clear(k, 1.0):
            out.append(found(name, "accel", gravity=k))
    if abs(m.value) < NEAR and clear(m, 1.0) and abs(k.value - 1.0) < NEAR:
        out.append(found("gravity_only", "accel", acceleration=m))
    elif abs(c.value - 1.0) < 2.0 * NEAR and clear(c):
        out.append(found("transport_term", "accel", missing=c))
    return out


def _which(flags: Sequence[bool]) -> list[str]:
    """Signals that are marked: none, one, or both."""
    if all(flags):
        return ["both"]
    return [signal for signal, flag in zip(("gyro", "accel"), flags, strict=True) if flag]
