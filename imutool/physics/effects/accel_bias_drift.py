"""Warm-up of the accelerometer: + A (1 - exp(-t/tau)), t from the log's start, tau one minute."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from imutool.physics.effects._base import Effect, Sensor, full, per_axis
from imutool.physics.signals import Signals

SENSORS: tuple[Sensor, ...] = ("accel",)
TAU_S = 60.0


def effect(sensor: Sensor) -> Effect:
    """A (m/s²): seen where the log is longer than tau, and every log begins with a cold sensor."""
    equation = "accel += A (1 - exp(-t/tau))"
    return Effect("accel_bias_drift", sensor, equation, per_axis("m/s²", 0.1), _warm, full(1))


def _warm(signals: Signals) -> Float64[np.ndarray, "n 1"]:
    warm: Float64[np.ndarray, "n 1"] = -np.expm1(-signals.t_s[:, None] / TAU_S)
    return warm
