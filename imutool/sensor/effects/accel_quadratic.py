"""Nonlinearity of the accelerometer: + k f², per axis; it rectifies vibration."""

from __future__ import annotations

from imutool.sensor.effect import Physics, Stage, Theta, each_axis
from imutool.sensor.linear_effect import Effect, Sensor, diagonal, per_axis
from imutool.sensor.readings import Read

SENSORS: tuple[Sensor, ...] = ("accel",)


def effect(sensor: Sensor) -> Effect:
    """k (s²/m): seen where the attitude varies."""
    return Effect("accel_quadratic", sensor, "accel += k * f^2", per_axis("s²/m", 6e-3), lambda s: s.accel**2, diagonal())


def _forward(read: Read, k: Theta) -> Read:
    return read.but(accel=read.accel * (1.0 + k * read.accel))


PHYSICS = Physics(
    "accel_quadratic",
    Stage.SENSOR,
    SENSORS,
    "accel += k * f^2",
    each_axis("s²/m", 6e-3),
    "the attitude varies; it rectifies vibration",
    _forward,
)
