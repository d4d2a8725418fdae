"""Warm-up of the accelerometer: + A (1 - exp(-t/tau)), t from the log's start, tau one minute."""

from __future__ import annotations

from imutool.physics.effects import _warming
from imutool.physics.effects._base import Effect, Sensor

SENSORS: tuple[Sensor, ...] = ("accel",)


def effect(sensor: Sensor) -> Effect:
    """A (m/s²): seen where the log is longer than tau, and every log begins with a cold sensor."""
    return _warming.closed_form(sensor, "m/s²", 0.1)


PHYSICS = _warming.physics("accel", "m/s²", 0.5)
