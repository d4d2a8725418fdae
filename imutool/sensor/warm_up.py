"""Warm-up as both sensors have it: + A (1 - exp(-t/tau)), t from the log's start."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from imutool.sensor.effect import Effect, Parameter, Stage, Theta, each_axis, misfit
from imutool.sensor.linear_effect import LinearEffect, full, per_axis
from imutool.sensor.readings import IdealMotion, SensorSamples
from imutool.sensor.signals import Signals
from imutool.units import Sensor

TAU_S = 60.0  # of the closed form, which is linear in A alone
START_TAU_S = (10.0, 30.0, 100.0)


def closed_form(sensor: Sensor, unit: str, plausible: float) -> LinearEffect:
    """A, with tau one minute."""
    equation = f"{sensor} += A (1 - exp(-t/tau))"
    return LinearEffect(f"{sensor}_bias_drift", sensor, equation, per_axis(unit, plausible), _warm, full(1))


def physics(sensor: Sensor, unit: str, plausible: float) -> Effect:
    """A, then tau (s), positive."""

    def forward(read: SensorSamples, theta: Theta) -> SensorSamples:
        added = _warming(read.stamp_s, float(theta[3]))[:, None] * theta[:3]
        return read.but(gyro=read.gyro + added) if sensor == "gyro" else read.but(accel=read.accel + added)

    def starts(felt: IdealMotion, samples: SensorSamples) -> list[Theta]:
        """For each tau the amplitudes that least squares gives beside a constant."""
        error, found = misfit(felt, samples)[0 if sensor == "gyro" else 1], []
        for tau_s in START_TAU_S:
            warm = _warming(samples.stamp_s, tau_s)
            columns = np.stack([warm, np.ones_like(warm)], axis=1)
            found.append(np.append(np.linalg.lstsq(columns, error, rcond=None)[0][0], tau_s))
        return found

    return Effect(
        f"{sensor}_bias_drift",
        Stage.SENSOR,
        (sensor,),
        f"{sensor} += A (1 - exp(-t/tau))",
        (*each_axis(unit, plausible), Parameter("tau", "s", 30.0, positive=True, null_value=30.0)),
        "the log is longer than tau",
        forward,
        linear=False,
        starts=starts,
    )


def _warm(signals: Signals) -> Float64[np.ndarray, "n 1"]:
    warm: Float64[np.ndarray, "n 1"] = -np.expm1(-signals.t_s[:, None] / TAU_S)
    return warm


def _warming(stamp_s: Float64[np.ndarray, " n"], tau_s: float) -> Float64[np.ndarray, " n"]:
    return np.asarray(-np.expm1(-stamp_s / tau_s))
