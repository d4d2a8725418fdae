"""A clock that runs fast or slow: samples taken at t (1 + eps)."""

from __future__ import annotations

import numpy as np

from imutool.sensor.effect import Effect, Parameter, Stage, Theta, starts_at
from imutool.sensor.samples import Times


def _forward(taken_s: Times, eps: Theta) -> Times:
    """t from the log's start; further in, the log's clock and that of the motion are eps t apart."""
    return np.asarray(taken_s + eps[0] * taken_s)


EFFECT = Effect(
    "clock_skew",
    Stage.CLOCK,
    ("gyro", "accel"),
    "samples are taken at t (1 + eps)",
    (Parameter("eps", "-", 1e-3),),
    "the log is long, and it moves",
    _forward,
    linear=False,
    starts=starts_at([0.0], [-1e-3], [1e-3]),
)
