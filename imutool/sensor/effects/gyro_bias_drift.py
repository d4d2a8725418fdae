"""Warm-up of the gyro: + A (1 - exp(-t/tau)), t from the log's start, tau one minute."""

from __future__ import annotations

from imutool.sensor import warm_up
from imutool.sensor.linear_effect import LinearEffect
from imutool.units import Sensor

SENSORS: tuple[Sensor, ...] = ("gyro",)


def effect(sensor: Sensor) -> LinearEffect:
    """A (rad/s): seen where the log is longer than tau, and every log begins with a cold sensor."""
    return warm_up.closed_form(sensor, "rad/s", 2e-3)


EFFECT = warm_up.physics("gyro", "rad/s", 0.02)
