"""Warm-up of the gyro: + A (1 - exp(-t/tau)), t from the log's start, tau one minute."""

from __future__ import annotations

from imutool.physics.effects import _warming
from imutool.physics.effects._base import Effect, Sensor

SENSORS: tuple[Sensor, ...] = ("gyro",)


def effect(sensor: Sensor) -> Effect:
    """A (rad/s): seen where the log is longer than tau, and every log begins with a cold sensor."""
    return _warming.closed_form(sensor, "rad/s", 2e-3)


PHYSICS = _warming.physics("gyro", "rad/s", 0.02)
