"""Scale error of the gyro: omega (1 + s), per axis."""

from __future__ import annotations

from imutool.sensor.effect import Physics, Stage, Theta, each_axis
from imutool.sensor.linear_effect import Effect, Sensor, diagonal, per_axis
from imutool.sensor.readings import Read
from imutool.sensor.signals import GYRO

SENSORS: tuple[Sensor, ...] = ("gyro",)


def effect(sensor: Sensor) -> Effect:
    """s (-): seen where the axis turns."""
    return Effect("gyro_scale", sensor, "gyro += s * omega", per_axis("-", 0.1), GYRO, diagonal())


def _forward(read: Read, s: Theta) -> Read:
    return read.but(gyro=read.gyro * (1.0 + s))


PHYSICS = Physics(
    "gyro_scale",
    Stage.SENSOR,
    SENSORS,
    "gyro += s * omega",
    each_axis("-", 0.1),
    "the axis turns",
    _forward,
)
