"""Warm-up of the gyro: + A (1 - exp(-t/tau)), t from the log's start, tau one minute."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from imutool.physics.effects._base import Effect, Sensor, full, per_axis
from imutool.physics.effects._forward import Number, Physics, Stage, Theta, each_axis, misfit
from imutool.physics.readings import Felt, Read
from imutool.physics.signals import Signals

SENSORS: tuple[Sensor, ...] = ("gyro",)
TAU_S = 60.0
START_TAU_S = (10.0, 30.0, 100.0)


def effect(sensor: Sensor) -> Effect:
    """A (rad/s): seen where the log is longer than tau, and every log begins with a cold sensor."""
    equation = "gyro += A (1 - exp(-t/tau))"
    return Effect("gyro_bias_drift", sensor, equation, per_axis("rad/s", 2e-3), _warm, full(1))


def _warm(signals: Signals) -> Float64[np.ndarray, "n 1"]:
    warm: Float64[np.ndarray, "n 1"] = -np.expm1(-signals.t_s[:, None] / TAU_S)
    return warm


def _warming(stamp_s: Float64[np.ndarray, " n"], tau_s: float) -> Float64[np.ndarray, " n"]:
    return np.asarray(-np.expm1((stamp_s[0] - stamp_s) / tau_s))


def _forward(read: Read, theta: Theta) -> Read:
    """A, then tau (s), positive; t from the first sample."""
    return read.but(gyro=read.gyro + _warming(read.stamp_s, float(theta[3]))[:, None] * theta[:3])


def _starts(felt: Felt, samples: Read) -> list[Theta]:
    """For each tau the amplitudes that least squares gives beside a constant."""
    error, starts = misfit(felt, samples)[0], []
    for tau_s in START_TAU_S:
        warm = _warming(samples.stamp_s, tau_s)
        columns = np.stack([warm, np.ones_like(warm)], axis=1)
        starts.append(np.append(np.linalg.lstsq(columns, error, rcond=None)[0][0], tau_s))
    return starts


PHYSICS = Physics(
    "gyro_bias_drift",
    Stage.SENSOR,
    SENSORS,
    "gyro += A (1 - exp(-t/tau))",
    (*each_axis("rad/s", 0.02), Number("tau", "s", 30.0, positive=True, nothing=30.0)),
    "the log is longer than tau",
    _forward,
    linear=False,
    starts=_starts,
)
