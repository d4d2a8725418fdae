"""Nonlinearity of the gyro in the rate: + k omega², per axis."""

from __future__ import annotations

from imutool.physics.effects._base import Effect, Sensor, diagonal, per_axis

SENSORS: tuple[Sensor, ...] = ("gyro",)


def effect(sensor: Sensor) -> Effect:
    """k (s/rad): seen in fast turns."""
    return Effect("gyro_quadratic", sensor, "gyro += k * omega^2", per_axis("s/rad", 0.02), lambda s: s.gyro**2, diagonal())
