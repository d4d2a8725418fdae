"""Nonlinearity of the gyro in the rate: + k omega², per axis."""

from __future__ import annotations

from imutool.sensor.effect import Effect, Stage, Theta, each_axis
from imutool.sensor.linear_effect import LinearEffect, diagonal, per_axis
from imutool.sensor.readings import SensorSamples
from imutool.units import Sensor

SENSORS: tuple[Sensor, ...] = ("gyro",)


def effect(sensor: Sensor) -> LinearEffect:
    """k (s/rad): seen in fast turns."""
    return LinearEffect(
        "gyro_quadratic", sensor, "gyro += k * omega^2", per_axis("s/rad", 0.02), lambda s: s.gyro**2, diagonal()
    )


def _forward(read: SensorSamples, k: Theta) -> SensorSamples:
    return read.but(gyro=read.gyro * (1.0 + k * read.gyro))


EFFECT = Effect(
    "gyro_quadratic", Stage.SENSOR, SENSORS, "gyro += k * omega^2", each_axis("s/rad", 0.1), "it turns fast", _forward
)
