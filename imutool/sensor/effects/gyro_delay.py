"""Delay of the gyro against the accelerometer, from the filters of one chip.

What delays both is a `clock_offset`. Only a motion that both sensors see tells the two apart.
"""

from __future__ import annotations

from dataclasses import replace

from imutool.sensor.effect import Effect, Parameter, Stage, Theta, starts_at
from imutool.sensor.samples import IdealMotion


def _forward(motion: IdealMotion, tau_s: Theta) -> IdealMotion:
    return replace(motion, gyro=motion.sampler.at(motion.gyro, motion, motion.t_s - tau_s[0]))


EFFECT = Effect(
    "gyro_delay",
    Stage.BANDWIDTH,
    ("gyro",),
    "gyro(t) = omega(t - tau)",
    (Parameter("tau", "s", 0.005),),
    "it turns, and the accelerometer shows the clock",
    _forward,
    linear=False,
    starts=starts_at([0.0]),
)
