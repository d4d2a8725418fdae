"""Scale error of the gyro: omega (1 + s), per axis."""

from __future__ import annotations

from imutool.sensor.effect import Effect, Stage, Theta, each_axis
from imutool.sensor.linear_effect import LinearEffect, diagonal, per_axis
from imutool.sensor.readings import SensorSamples
from imutool.sensor.signals import GYRO
from imutool.units import Sensor

SENSORS: tuple[Sensor, ...] = ("gyro",)


def effect(sensor: Sensor) -> LinearEffect:
    """s (-): seen where the axis turns."""
    return LinearEffect("gyro_scale", sensor, "gyro += s * omega", per_axis("-", 0.1), GYRO, diagonal())


def _forward(read: SensorSamples, s: Theta) -> SensorSamples:
    return read.but(gyro=read.gyro * (1.0 + s))


EFFECT = Effect(
    "gyro_scale",
    Stage.SENSOR,
    SENSORS,
    "gyro += s * omega",
    each_axis("-", 0.1),
    "the axis turns",
    _forward,
)
