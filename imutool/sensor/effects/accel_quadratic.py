"""Nonlinearity of the accelerometer: + k f², per axis; it rectifies vibration."""

from __future__ import annotations

from imutool.sensor.effect import Effect, Stage, Theta, each_axis
from imutool.sensor.linear_effect import LinearEffect, diagonal, per_axis
from imutool.sensor.readings import SensorSamples
from imutool.units import Sensor

SENSORS: tuple[Sensor, ...] = ("accel",)


def effect(sensor: Sensor) -> LinearEffect:
    """k (s²/m): seen where the attitude varies."""
    return LinearEffect("accel_quadratic", sensor, "accel += k * f^2", per_axis("s²/m", 6e-3), lambda s: s.accel**2, diagonal())


def _forward(read: SensorSamples, k: Theta) -> SensorSamples:
    return read.but(accel=read.accel * (1.0 + k * read.accel))


EFFECT = Effect(
    "accel_quadratic",
    Stage.SENSOR,
    SENSORS,
    "accel += k * f^2",
    each_axis("s²/m", 6e-3),
    "the attitude varies; it rectifies vibration",
    _forward,
)
