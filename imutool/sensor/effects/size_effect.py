"""Size of the accelerometer: each of its axes has a lever arm of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from imutool.inertial.kinematics import lever_acceleration
from imutool.sensor.effect import Effect, Stage, Theta, each_pair
from imutool.sensor.samples import IdealMotion


def _forward(motion: IdealMotion, r_b: Theta) -> IdealMotion:
    added = lever_acceleration(motion.gyro.T, motion.alpha.T, r_b.reshape(3, 3))
    return replace(motion, accel=motion.accel + np.stack(added).T)


EFFECT = Effect(
    "size_effect",
    Stage.MOTION,
    ("accel",),
    "accel_i += (alpha x r_i + omega x (omega x r_i))_i",
    each_pair("m", 0.02),
    "it turns fast; what the three arms share is a lever arm",
    _forward,
)
