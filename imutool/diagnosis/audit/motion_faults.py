"""Faults of a simulated IMU's motion and timing, and what of its motion nothing explains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from imutool.diagnosis.audit.axes import MIN_TURN, UNSEEN, is_signed, nearest_signed
from imutool.diagnosis.audit.faults import CERTAIN, FaultFound, clear, found
from imutool.diagnosis.audit.motion import KinematicFit, Kinematics, by_block, of_sum
from imutool.diagnosis.result import Estimate
from imutool.units import AXES, COLUMNS, SENSORS, Sensor

MIN_CLOCK = 0.05  # by which a clock is another: smoothing may take as much of a fast motion
MIN_OVER_NOISE = 3.0  # deviations of noise
MIN_ARM_M = 5e-3
MIN_DELAY = 0.05  # of a sample period: less is rounding
MIN_GYRO_DELAY = 0.3  # of a sample period: half of a finer step is that of a semi-implicit integrator
HALF = 0.6  # of a delay by one step: half of it, and errors
PART, WHOLE = 0.7, 0.8  # of a sample period: up to the one a delay is a part, from the other a whole step
NEAR = 0.15  # of a step, or of gravity, by which a number may differ from a whole one

GRAVITY = {0: "coordinate_acceleration", 2: "gravity_doubled", -1: "gravity_sign"}


def motion_faults(k: Kinematics, fit: KinematicFit, filters: tuple[float, float] = (0.0, 0.0)) -> list[FaultFound]:
    """Faults of gravity, frame, axes, transport term, point and timing.

    Delays (in sample periods) up to those of the sensors' own `filters` are no fault.
    """
    timing = timing_faults(fit.estimates, k.period_s, filters)
    return [*_frame_faults(k, fit), *_force_faults(fit), *_clock_faults(fit.estimates), *timing, *_arm_faults(fit.estimates)]


def unexplained(k: Kinematics, fit: KinematicFit, faults: Sequence[FaultFound]) -> dict[str, float]:
    """Large shares (of rms) of a sensor's motion that no pose, fault or noise explains."""
    scaled = {fault.fault for fault in faults} & {"other_clock", "gravity_only"}
    out: dict[str, float] = {}
    for sensor, samples, name in (("gyro", k.gyro, "scale"), ("accel", k.accel, "m")):
        part = COLUMNS[sensor]
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
    P, residual = fit.axes[SENSORS.index(sensor)], k.shown(fit.residual[:, COLUMNS[sensor]])
    x = (k.accel if sensor == "accel" else k.gyro - k.gyro.mean(axis=0)) @ P
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


# ── timing ──


def timing_faults(estimates: Mapping[str, Estimate], period_s: float, filters: tuple[float, float]) -> list[FaultFound]:
    """Faults of timing, by the delays of gyro, acceleration and attitude.

    Delays up to those of the sensors' own `filters` (sample periods) are no fault.

    A semi-implicit integrator makes all velocities late alike, by half of its step. So the acceleration counts from the gyro
    where the gyro is late by a part of a step, unless both are differences of explicit states. No difference and no integrator
    makes the attitude late: where it is, a step of the physics lies between reading and stamp, however short.
    """
    gyro, accel, attitude = (estimates[name] for name in ("tau_g", "tau_a", "tau_f"))
    gyro = _after_filter(gyro, filters[0] * period_s)
    if accel.value < attitude.value + CERTAIN * np.hypot(accel.std, attitude.std):  # a filter makes gravity late, too
        accel, attitude = (_after_filter(tau, filters[1] * period_s) for tau in (accel, attitude))
    steps = {"gyro": _delay(gyro, period_s, MIN_GYRO_DELAY), "accel": _delay(accel, period_s, MIN_DELAY)}
    together = abs(accel.value - attitude.value) < 3.0 * np.hypot(accel.std, attitude.std) + NEAR * period_s
    whole = together and steps["accel"] in ("step_delay", "early_stamps")
    if abs(attitude.value) >= MIN_DELAY * period_s and clear(attitude) and _is_late_alike(accel, attitude):
        whole = together = True
        name = "step_delay" if attitude.value > 0.0 else "early_stamps"
        late_alike = {"accel": accel, **({"gyro": gyro} if clear(gyro) else {})}
        steps |= {signal: name for signal, tau in late_alike.items() if _is_late_alike(tau, attitude)}
    after_gyro = Estimate(accel.value - gyro.value, float(np.hypot(accel.std, gyro.std)), "s")
    explained = abs(gyro.value) < PART * period_s and abs(after_gyro.value) < PART * period_s  # it makes no whole step
    if explained and (steps["gyro"] != steps["accel"] or not steps["accel"]) and not whole:
        accel, steps["accel"] = after_gyro, _delay(after_gyro, period_s, MIN_DELAY)
    late = {"gyro": gyro, "accel": accel}
    out = []
    for name in ("step_delay", "early_stamps"):
        signals = [signal for signal, kind in steps.items() if kind == name and (signal == "gyro" or together)]
        if signals:
            signal = "both" if len(signals) == 2 else signals[0]
            out.append(found(name, signal, delay=late[signals[0]]))
    if steps["accel"] == "step_delay" and not together:  # positions were differentiated twice: the attitude is in time
        steps["accel"] = "backward_difference"
    for signal, kind in steps.items():
        if kind == "backward_difference" and (signal == "gyro" or abs(attitude.value) < 0.5 * abs(accel.value)):
            tau = late[signal]
            out.append(found(kind, signal, delay=tau, step=Estimate(2.0 * tau.value, 2.0 * tau.std, "s")))
    return out


def _is_late_alike(tau: Estimate, attitude: Estimate) -> bool:
    """Whether a signal is late as its attitude certainly is, but for half a step of an integrator."""
    return abs(tau.value - attitude.value) < HALF * abs(attitude.value) + 3.0 * tau.std


def _delay(tau: Estimate, period_s: float, minimum: float) -> str:
    """Name of a delay: half a step or less, a whole step, a step early; empty for none or another."""
    steps = tau.value / period_s if clear(tau) else 0.0
    if abs(steps) > WHOLE:
        return "step_delay" if steps > 0.0 else "early_stamps"
    return "backward_difference" if minimum <= steps < PART else ""


def _after_filter(tau: Estimate, max_s: float) -> Estimate:
    """A delay that the sensor's own filter does not explain."""
    return Estimate(0.0, tau.std, tau.unit) if 0.0 < tau.value <= max_s else tau
