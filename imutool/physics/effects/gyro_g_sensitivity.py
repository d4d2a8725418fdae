"""Sensitivity of the gyro to specific force: + G f."""

from __future__ import annotations

from imutool.physics.effects._base import Effect, Sensor, full, per_pair
from imutool.physics.signals import ACCEL

SENSORS: tuple[Sensor, ...] = ("gyro",)


def effect(sensor: Sensor) -> Effect:
    """G (rad/s per m/s²): seen where attitude or acceleration varies; collinear with the bias at rest."""
    pairs = per_pair("rad/s per m/s²", 1e-3)
    return Effect("gyro_g_sensitivity", sensor, "gyro += G f", pairs, ACCEL, full())
