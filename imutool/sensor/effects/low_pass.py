"""Bandwidth of the sensor: a first-order low-pass on both, H(s) = w_c / (s + w_c)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.filters import OMEGA, filtered
from imutool.sensor.samples import IdealMotion, SensorSamples

START_HZ = (2.0, 5.0, 10.0, 20.0, 40.0, 80.0)


def _forward(motion: IdealMotion, cutoff_hz: Theta) -> IdealMotion:
    """As if what is felt first had always been felt; an infinite cut-off frequency lets everything pass."""
    if math.isinf(cutoff_hz[0]):
        return motion
    a = 2.0 * math.pi * float(cutoff_hz[0]) / motion.rate_hz  # rad a sample
    denominator = np.array([1.0, -math.exp(-a)])
    both = filtered(np.concatenate([motion.gyro, motion.accel, motion.alpha], axis=1), a / (1j * OMEGA + a), denominator)
    return replace(motion, gyro=both[:, :3], accel=both[:, 3:6], alpha=both[:, 6:])


def _starts(_motion: IdealMotion, _samples: SensorSamples) -> list[Theta]:
    return [np.array([hz]) for hz in START_HZ]


EFFECT = Effect(
    "low_pass",
    Stage.BANDWIDTH,
    ("gyro", "accel"),
    "d gyro/dt = 2 pi f_c (omega - gyro), and likewise accel",
    (Parameter("f_c", "Hz", 20.0, positive=True, null_value=math.inf),),
    "it moves at frequencies near f_c; a delay alone is a clock_offset",
    _forward,
    linear=False,
    starts=_starts,
)
