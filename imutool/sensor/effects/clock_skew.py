"""A clock that runs fast or slow: samples taken at t (1 + eps)."""

from __future__ import annotations

import numpy as np

from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.samples import IdealMotion, SensorSamples, Times


def _forward(taken_s: Times, eps: Theta) -> Times:
    """t from the log's start; further in, the log's clock and that of the motion are eps t apart."""
    return np.asarray(taken_s + eps[0] * taken_s)


def _starts(_motion: IdealMotion, _samples: SensorSamples) -> list[Theta]:
    return [np.array([eps]) for eps in (0.0, -1e-3, 1e-3)]


EFFECT = Effect(
    "clock_skew",
    Stage.CLOCK,
    ("gyro", "accel"),
    "samples are taken at t (1 + eps)",
    (Parameter("eps", "-", 1e-3),),
    "the log is long, and it moves",
    _forward,
    linear=False,
    starts=_starts,
)
