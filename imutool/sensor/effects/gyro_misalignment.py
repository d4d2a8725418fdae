"""Misalignment of the gyro's axes: off-diagonal 3x3 on omega."""

from __future__ import annotations

from imutool.sensor.effect import Effect, Stage, Theta, each_pair, matrix
from imutool.sensor.linear_effect import LinearEffect, off_diagonal, per_pair
from imutool.sensor.readings import SensorSamples
from imutool.sensor.signals import GYRO
from imutool.units import Sensor

SENSORS: tuple[Sensor, ...] = ("gyro",)


def effect(sensor: Sensor) -> LinearEffect:
    """m (-): seen where two axes turn. A rotation common to gyro and accelerometer is a mount rotation."""
    pairs = per_pair("-", 0.05, diagonal=False)
    return LinearEffect("gyro_misalignment", sensor, "gyro += M omega, diag M = 0", pairs, GYRO, off_diagonal())


def _forward(read: SensorSamples, m: Theta) -> SensorSamples:
    return read.but(gyro=read.gyro + read.gyro @ matrix(m).T)


EFFECT = Effect(
    "gyro_misalignment",
    Stage.SENSOR,
    SENSORS,
    "gyro += M omega, diag M = 0",
    each_pair("-", 0.05, diagonal=False),
    "two axes turn",
    _forward,
)
