"""Warm-up of the accelerometer: + A (1 - exp(-t/tau)), t from the log's start, tau one minute."""

from __future__ import annotations

from imutool.sensor import warm_up
from imutool.sensor.linear_effect import LinearEffect
from imutool.units import Sensor

SENSORS: tuple[Sensor, ...] = ("accel",)


def effect(sensor: Sensor) -> LinearEffect:
    """A (m/s²): seen where the log is longer than tau, and every log begins with a cold sensor."""
    return warm_up.closed_form(sensor, "m/s²", 0.1)


EFFECT = warm_up.physics("accel", "m/s²", 0.5)
