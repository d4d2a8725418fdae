"""Resonance of a soft mount: a spring and a damper, each axis to its own share."""

from __future__ import annotations

import cmath
import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from imutool.sensor.effect import Effect, Parameter, Stage, Theta, each_axis, starts_at
from imutool.sensor.effects.low_pass import OMEGA, Filter, slowed
from imutool.sensor.samples import IdealMotion

START_HZ = (4.0, 8.0, 15.0, 30.0, 50.0)
DAMPER = Parameter("damper", "-", 1.0, null_value=1.0)  # 1: between mass and base; 0: between the mass and what rests


def _forward(motion: IdealMotion, theta: Theta) -> IdealMotion:
    """f0 (Hz), zeta, share per axis, damper d: f + share (H f - f), H(s) = (2 d zeta w0 s + w0²) / (s² + 2 zeta w0 s + w0²).

    H is what a mass on a spring and a damper feels of its base's acceleration; it starts in the steady state. Without the
    base at its end the damper brakes the mass alone, as in a sensor of second order.
    """
    share, damper = theta[2:5], float(theta[5]) if len(theta) > 5 else DAMPER.null_value
    if not share.any():
        return motion
    by = _spring(2.0 * math.pi * float(theta[0]) / motion.rate_hz, float(theta[1]), damper)
    return replace(motion, accel=motion.accel + share * (slowed(motion, motion.accel, by) - motion.accel))


@lru_cache(maxsize=64)
def _spring(a: float, zeta: float, damper: float) -> Filter:
    """H for w0 of `a` rad a sample."""
    pole = cmath.exp(a * (-zeta + cmath.sqrt(zeta**2 - 1.0)))
    other = cmath.exp(a * (-zeta - cmath.sqrt(zeta**2 - 1.0)))
    s = 1j * OMEGA
    gain = (2.0 * damper * zeta * a * s + a**2) / (s**2 + 2.0 * zeta * a * s + a**2)
    return Filter.of(gain, np.array([1.0, -(pole + other).real, (pole * other).real]))


EFFECT = Effect(
    "mount_resonance",
    Stage.MOUNT,
    ("accel",),
    "accel += share * (H f - f), H = (2 damper zeta w0 s + w0^2) / (s^2 + 2 zeta w0 s + w0^2), w0 = 2 pi f0",
    (
        Parameter("f0", "Hz", 20.0, positive=True, null_value=20.0),
        Parameter("zeta", "-", 0.2, positive=True, null_value=0.2),
        *each_axis("-", 1.0, "share_"),
        DAMPER,
    ),
    "motion or shocks excite it",
    _forward,
    linear=False,
    starts=starts_at(*([hz, 0.1, 0.5, 0.5, 0.5, 1.0] for hz in START_HZ)),
)
