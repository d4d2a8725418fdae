"""Second-order low-pass on both sensors, H(s) = w_c² / (s² + 2 zeta w_c s + w_c²).

Most MEMS sensors have one (BMI160 data sheet, 2.4.3: "second order Butterworth"). It delays by 2 zeta / w_c, keeps the
amplitude of slow motion, which a first order does not, and delays fast motion more.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.effects.low_pass import OMEGA, RATE, SMOOTHING, Design, Filter, behind_gain, digital_starts, slowed
from imutool.sensor.samples import IdealMotion

BUTTERWORTH = 0.7  # damping, nearly
MIN_DAMPING = 0.2  # less rings, and passes no more of slow motion than of fast
START_HZ = (5.0, 12.0, 30.0, 80.0)


def _forward(motion: IdealMotion, theta: Theta) -> IdealMotion:
    """f_c (Hz), zeta, the rate of a digital filter, and that of exponential smoothing twice; it starts settled."""
    if math.isinf(theta[0]):
        return motion
    if np.isfinite(theta[2:]).any():
        return behind_gain(motion, _design(theta), lag=True)
    by = _second_order(2.0 * math.pi * float(theta[0]) / motion.rate_hz, float(theta[1]))
    gyro, accel, alpha = (slowed(motion, x, by) for x in (motion.gyro, motion.accel, motion.alpha))
    return replace(motion, gyro=gyro, accel=accel, alpha=alpha)


def _without_lag(motion: IdealMotion, theta: Theta) -> IdealMotion:
    return behind_gain(motion, _design(theta), lag=False)


def _design(theta: Theta) -> Design:
    rates = [*map(float, theta[2:]), math.inf, math.inf]
    return Design(float(theta[0]), float(theta[1]), rates[0], smoothing_hz=rates[1])


@lru_cache(maxsize=64)
def _second_order(a: float, zeta: float) -> Filter:
    """H for w_c of `a` rad a sample."""
    faster = zeta + cmath.sqrt(zeta**2 - 1.0)  # the poles' product is one, whose difference would cancel at a large damping
    pole, other = cmath.exp(-a / faster), cmath.exp(-a * faster)
    s = 1j * OMEGA
    return Filter.of(a**2 / (s**2 + 2.0 * zeta * a * s + a**2), np.array([1.0, -(pole + other).real, (pole * other).real]))


EFFECT = Effect(
    "second_order_low_pass",
    Stage.BANDWIDTH,
    ("gyro", "accel"),
    "d²gyro/dt² = w_c² (omega - gyro) - 2 zeta w_c dgyro/dt, w_c = 2 pi f_c, and likewise accel (at a rate: bilinear)",
    (
        Parameter("f_c", "Hz", 40.0, positive=True, null_value=math.inf),
        Parameter("zeta", "-", BUTTERWORTH, positive=True, null_value=BUTTERWORTH, minimum=MIN_DAMPING),
        RATE,
        SMOOTHING,
    ),
    "it moves at frequencies near f_c; a delay alone is a clock_offset",
    _forward,
    linear=False,
    starts=digital_starts(*([hz, BUTTERWORTH] for hz in START_HZ), order=[SMOOTHING.plausible]),
    lagless=_without_lag,
)
