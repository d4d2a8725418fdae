"""Scale error of the accelerometer: f (1 + s), per axis."""

from __future__ import annotations

from imutool.sensor.effect import Effect, Stage, Theta, each_axis
from imutool.sensor.linear_effect import LinearEffect, diagonal, per_axis
from imutool.sensor.readings import SensorSamples
from imutool.sensor.signals import ACCEL
from imutool.units import Sensor

SENSORS: tuple[Sensor, ...] = ("accel",)


def effect(sensor: Sensor) -> LinearEffect:
    """s (-): seen where the attitude varies; collinear with the bias otherwise."""
    return LinearEffect("accel_scale", sensor, "accel += s * f", per_axis("-", 0.1), ACCEL, diagonal())


def _forward(read: SensorSamples, s: Theta) -> SensorSamples:
    return read.but(accel=read.accel * (1.0 + s))


EFFECT = Effect(
    "accel_scale",
    Stage.SENSOR,
    SENSORS,
    "accel += s * f",
    each_axis("-", 0.05),
    "the attitude varies",
    _forward,
)
