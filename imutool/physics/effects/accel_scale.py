"""Scale error of the accelerometer: f (1 + s), per axis."""

from __future__ import annotations

from imutool.physics.effects._base import Effect, Sensor, diagonal, per_axis
from imutool.physics.signals import ACCEL

SENSORS: tuple[Sensor, ...] = ("accel",)


def effect(sensor: Sensor) -> Effect:
    """s (-): seen where the attitude varies; collinear with the bias otherwise."""
    return Effect("accel_scale", sensor, "accel += s * f", per_axis("-", 0.1), ACCEL, diagonal())
