"""Samples taken at t + tau: + tau du/dt, to first order."""

from __future__ import annotations

import numpy as np

from imutool.physics.effects._base import Effect, Parameter, Sensor
from imutool.physics.signals import ACCEL_DOT, GYRO_DOT

SENSORS: tuple[Sensor, ...] = ("gyro", "accel")


def effect(sensor: Sensor) -> Effect:
    """tau (s): seen while it moves. Against poses, what is seen is the offset between the IMU's clock and theirs."""
    sees, name = (GYRO_DOT, "omega") if sensor == "gyro" else (ACCEL_DOT, "f")
    same = np.eye(3)[:, :, None]
    return Effect("clock_offset", sensor, f"{sensor} += tau d{name}/dt", (Parameter("tau", "s", 0.01),), sees, same)
