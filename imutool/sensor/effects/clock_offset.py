"""Samples taken at t + tau: + tau du/dt, to first order."""

from __future__ import annotations

import numpy as np

from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.linear_effect import LinearEffect, LinearParameter
from imutool.sensor.readings import IdealMotion, SensorSamples, Times
from imutool.sensor.signals import ACCEL_DOT, GYRO_DOT
from imutool.units import Sensor

SENSORS: tuple[Sensor, ...] = ("gyro", "accel")


def effect(sensor: Sensor) -> LinearEffect:
    """tau (s): seen while it moves. Against poses, what is seen is the offset between the IMU's clock and theirs."""
    sees, name = (GYRO_DOT, "omega") if sensor == "gyro" else (ACCEL_DOT, "f")
    same = np.eye(3)[:, :, None]
    return LinearEffect("clock_offset", sensor, f"{sensor} += tau d{name}/dt", (LinearParameter("tau", "s", 0.01),), sees, same)


def _forward(taken_s: Times, tau_s: Theta) -> Times:
    return np.asarray(taken_s + tau_s[0])


def _starts(_felt: IdealMotion, _samples: SensorSamples) -> list[Theta]:
    """From no offset, and from beyond half a period of motion at a few hertz either way."""
    return [np.array([tau_s]) for tau_s in (0.0, -0.05, 0.05)]


EFFECT = Effect(
    "clock_offset",
    Stage.CLOCK,
    SENSORS,
    "samples are taken at t + tau",
    (Parameter("tau", "s", 0.05),),
    "it moves",
    _forward,
    linear=False,
    starts=_starts,
)
