"""Faults of a simulated IMU's timing, by the delays of its signals."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from imutool.diagnosis.audit.faults import CERTAIN, FaultFound, clear, found
from imutool.diagnosis.result import Estimate

MIN_DELAY = 0.05  # of a sample period: less is rounding
MIN_GYRO_DELAY = 0.3  # of a sample period: half of a finer step is that of a semi-implicit integrator
HALF = 0.6  # of a delay by one step: half of it, and errors
PART, WHOLE = 0.7, 0.8  # of a sample period: up to the one a delay is a part, from the other a whole step
NEAR = 0.15  # of a step, or of gravity, by which a number may differ from a whole one


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
