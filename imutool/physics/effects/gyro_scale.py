"""Scale error of the gyro: omega (1 + s), per axis."""

from __future__ import annotations

from imutool.physics.effects._base import Effect, Sensor, diagonal, per_axis
from imutool.physics.signals import GYRO

SENSORS: tuple[Sensor, ...] = ("gyro",)


def effect(sensor: Sensor) -> Effect:
    """s (-): seen where the axis turns."""
    return Effect("gyro_scale", sensor, "gyro += s * omega", per_axis("-", 0.1), GYRO, diagonal())
