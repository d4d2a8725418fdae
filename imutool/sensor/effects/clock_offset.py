"""Offset of the clock: samples are taken at t + tau, which adds tau du/dt to first order.

Against poses it is the offset between the IMU's clock and theirs.
"""

from __future__ import annotations

import numpy as np

from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.samples import IdealMotion, SensorSamples, Times


def _forward(taken_s: Times, tau_s: Theta) -> Times:
    return np.asarray(taken_s + tau_s[0])


def _starts(_motion: IdealMotion, _samples: SensorSamples) -> list[Theta]:
    """From no offset, and from beyond half a period of motion at a few hertz either way."""
    return [np.array([tau_s]) for tau_s in (0.0, -0.05, 0.05)]


EFFECT = Effect(
    "clock_offset",
    Stage.CLOCK,
    ("gyro", "accel"),
    "samples are taken at t + tau",
    (Parameter("tau", "s", 0.05),),
    "it moves",
    _forward,
    linear=False,
    starts=_starts,
    trained=True,
)
