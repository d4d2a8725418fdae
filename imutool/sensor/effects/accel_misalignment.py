"""Misalignment of the accelerometer's axes: off-diagonal 3x3 on f."""

from __future__ import annotations

from imutool.sensor.effect import Effect, Stage, Theta, each_pair, matrix
from imutool.sensor.linear_effect import LinearEffect, off_diagonal, per_pair
from imutool.sensor.readings import SensorSamples
from imutool.sensor.signals import ACCEL
from imutool.units import Sensor

SENSORS: tuple[Sensor, ...] = ("accel",)


def effect(sensor: Sensor) -> LinearEffect:
    """m (-): seen where the attitude varies."""
    pairs = per_pair("-", 0.05, diagonal=False)
    return LinearEffect("accel_misalignment", sensor, "accel += M f, diag M = 0", pairs, ACCEL, off_diagonal())


def _forward(read: SensorSamples, m: Theta) -> SensorSamples:
    return read.but(accel=read.accel + read.accel @ matrix(m).T)


EFFECT = Effect(
    "accel_misalignment",
    Stage.SENSOR,
    SENSORS,
    "accel += M f, diag M = 0",
    each_pair("-", 0.05, diagonal=False),
    "the attitude varies",
    _forward,
)
