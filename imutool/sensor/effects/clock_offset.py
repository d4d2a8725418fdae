"""Offset of the clock: samples are taken at t + tau, which adds tau du/dt to first order.

Against poses it is the offset between the IMU's clock and theirs.
"""

from __future__ import annotations

import numpy as np

from imutool.sensor.effect import Effect, Parameter, Stage, Theta, starts_at
from imutool.sensor.samples import Times


def _forward(taken_s: Times, tau_s: Theta) -> Times:
    return np.asarray(taken_s + tau_s[0])


EFFECT = Effect(
    "clock_offset",
    Stage.CLOCK,
    ("gyro", "accel"),
    "samples are taken at t + tau",
    (Parameter("tau", "s", 0.05),),
    "it moves",
    _forward,
    linear=False,
    starts=starts_at([0.0], [-0.05], [0.05]),  # beyond half a period of motion at a few hertz, either way
    trained=True,
)
