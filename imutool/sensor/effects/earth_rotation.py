"""The earth's own turning, as a gyro feels it that stands still on it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from imutool.array_types import Float64
from imutool.sensor.effect import Effect, Parameter, Stage, Theta, attitude_of, starts_at
from imutool.sensor.samples import IdealMotion

EARTH_RAD_S = 7.292115e-5  # WGS 84


def omega_w(latitude: float, heading: float) -> Float64[np.ndarray, "3"]:
    """Earth rate (rad/s) in the world, z up; `heading` is north's angle from x about z (rad)."""
    level = math.cos(latitude)
    return EARTH_RAD_S * np.array([level * math.cos(heading), level * math.sin(heading), math.sin(latitude)])


def _forward(motion: IdealMotion, theta: Theta) -> IdealMotion:
    """Latitude, heading (rad). An infinite latitude is none: the earth stands still."""
    latitude, heading = theta.tolist()
    if math.isinf(latitude):
        return motion
    turning = np.einsum("nji,j->in", attitude_of(motion, "earth_rotation"), omega_w(latitude, heading), order="C").T
    return replace(motion, gyro=motion.gyro + turning)


EFFECT = Effect(
    "earth_rotation",
    Stage.MOTION,
    ("gyro",),
    "gyro += R_wb^T omega_e",
    (Parameter("latitude", "rad", 0.8, null_value=math.inf), Parameter("heading", "rad", 2.0)),
    "the noise is that of a navigation-grade gyro, and the attitude varies",
    _forward,
    linear=False,
    starts=starts_at(*((latitude, heading) for latitude in (-0.8, 0.8) for heading in (-3.0, -1.0, 1.0, 3.0))),
    needs=("attitude",),
)
