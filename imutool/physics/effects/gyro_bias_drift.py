"""Warm-up of the gyro: + A (1 - exp(-t/tau)), t from the log's start, tau one minute."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from imutool.physics.effects._base import Effect, Sensor, full, per_axis
from imutool.physics.signals import Signals

SENSORS: tuple[Sensor, ...] = ("gyro",)
TAU_S = 60.0


def effect(sensor: Sensor) -> Effect:
    """A (rad/s): seen where the log is longer than tau, and every log begins with a cold sensor."""
    equation = "gyro += A (1 - exp(-t/tau))"
    return Effect("gyro_bias_drift", sensor, equation, per_axis("rad/s", 2e-3), _warm, full(1))


def _warm(signals: Signals) -> Float64[np.ndarray, "n 1"]:
    warm: Float64[np.ndarray, "n 1"] = -np.expm1(-signals.t_s[:, None] / TAU_S)
    return warm
