"""Second-order low-pass on both sensors, H(s) = w_c² / (s² + 2 zeta w_c s + w_c²).

Most MEMS sensors have one (BMI160 data sheet, 2.4.3: "second order Butterworth"). Beside its delay of 2 zeta / w_c it keeps the
amplitude of slow motion, which a first order does not, and delays fast motion more.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from imutool.sensor.effect import Effect, Parameter, Stage, Theta, starts_at
from imutool.sensor.effects.low_pass import OMEGA, Filter, slowed, without_lag
from imutool.sensor.samples import IdealMotion

BUTTERWORTH = 0.7  # damping, nearly
START_HZ = (5.0, 12.0, 30.0, 80.0)


def _forward(motion: IdealMotion, theta: Theta) -> IdealMotion:
    """f_c (Hz), zeta; the filter starts settled, and an infinite cut-off frequency lets everything pass."""
    if math.isinf(theta[0]):
        return motion
    by = _second_order(2.0 * math.pi * float(theta[0]) / motion.rate_hz, float(theta[1]))
    gyro, accel, alpha = (slowed(motion, x, by) for x in (motion.gyro, motion.accel, motion.alpha))
    return replace(motion, gyro=gyro, accel=accel, alpha=alpha)


@lru_cache(maxsize=64)
def _second_order(a: float, zeta: float) -> Filter:
    """H for w_c of `a` rad a sample."""
    root = cmath.sqrt(zeta**2 - 1.0)
    pole, other = cmath.exp(-a * (zeta - root)), cmath.exp(-a * (zeta + root))
    s = 1j * OMEGA
    return Filter.of(a**2 / (s**2 + 2.0 * zeta * a * s + a**2), np.array([1.0, -(pole + other).real, (pole * other).real]))


EFFECT = Effect(
    "second_order_low_pass",
    Stage.BANDWIDTH,
    ("gyro", "accel"),
    "d²gyro/dt² = w_c² (omega - gyro) - 2 zeta w_c dgyro/dt, w_c = 2 pi f_c, and likewise accel",
    (
        Parameter("f_c", "Hz", 40.0, positive=True, null_value=math.inf),
        Parameter("zeta", "-", BUTTERWORTH, positive=True, null_value=BUTTERWORTH),
    ),
    "it moves at frequencies near f_c; a delay alone is a clock_offset",
    _forward,
    linear=False,
    starts=starts_at(*([hz, BUTTERWORTH] for hz in START_HZ)),
    lagless=without_lag,
)
