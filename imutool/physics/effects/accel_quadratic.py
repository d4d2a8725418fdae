"""Nonlinearity of the accelerometer: + k f², per axis; it rectifies vibration."""

from __future__ import annotations

from imutool.physics.effects._base import Effect, Sensor, diagonal, per_axis

SENSORS: tuple[Sensor, ...] = ("accel",)


def effect(sensor: Sensor) -> Effect:
    """k (s²/m): seen where the attitude varies."""
    return Effect("accel_quadratic", sensor, "accel += k * f^2", per_axis("s²/m", 6e-3), lambda s: s.accel**2, diagonal())
