"""Misalignment of the accelerometer's axes: off-diagonal 3x3 on f."""

from __future__ import annotations

from imutool.physics.effects._base import Effect, Sensor, off_diagonal, per_pair
from imutool.physics.signals import ACCEL

SENSORS: tuple[Sensor, ...] = ("accel",)


def effect(sensor: Sensor) -> Effect:
    """m (-): seen where the attitude varies."""
    pairs = per_pair("-", 0.05, diagonal=False)
    return Effect("accel_misalignment", sensor, "accel += M f, diag M = 0", pairs, ACCEL, off_diagonal())
