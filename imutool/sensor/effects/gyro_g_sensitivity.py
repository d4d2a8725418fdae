"""Sensitivity of the gyro to specific force: + G f."""

from __future__ import annotations

from imutool.sensor.effect import Effect, Stage, Theta, each_pair
from imutool.sensor.linear_effect import LinearEffect, full, per_pair
from imutool.sensor.readings import SensorSamples
from imutool.sensor.signals import ACCEL
from imutool.units import Sensor

SENSORS: tuple[Sensor, ...] = ("gyro",)


def effect(sensor: Sensor) -> LinearEffect:
    """G (rad/s per m/s²): seen where attitude or acceleration varies; collinear with the bias at rest."""
    pairs = per_pair("rad/s per m/s²", 1e-3)
    return LinearEffect("gyro_g_sensitivity", sensor, "gyro += G f", pairs, ACCEL, full())


def _forward(read: SensorSamples, g: Theta) -> SensorSamples:
    return read.but(gyro=read.gyro + read.accel @ g.reshape(3, 3).T)


EFFECT = Effect(
    "gyro_g_sensitivity",
    Stage.SENSOR,
    SENSORS,
    "gyro += G f",
    each_pair("rad/s per m/s²", 3e-3),
    "attitude or acceleration varies; collinear with the bias at rest",
    _forward,
)
