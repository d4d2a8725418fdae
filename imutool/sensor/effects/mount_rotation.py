"""Rotation of the mount: the axes of both sensors against the body's."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
from scipy.spatial.transform import Rotation

from imutool.array_types import Float64
from imutool.sensor.effect import Effect, Parameter, Stage, Theta, starts_at
from imutool.sensor.samples import IdealMotion, Vectors


def _forward(motion: IdealMotion, phi: Theta) -> IdealMotion:
    """R_bi = Exp(phi) takes the sensor's vectors to the body; R_wb stays the body's attitude."""
    R_bi = _rotation(*phi.tolist())
    turned = motion.sampler.behind.made
    gyro, accel, alpha = (turned(x, R_bi, partial(_turned, x, R_bi)) for x in (motion.gyro, motion.accel, motion.alpha))
    return replace(motion, gyro=gyro, accel=accel, alpha=alpha)


def _turned(x: Vectors, R_bi: Float64[np.ndarray, "3 3"]) -> Vectors:
    return np.asarray(R_bi.T @ x.T).T


@lru_cache(maxsize=64)
def _rotation(*phi: float) -> Float64[np.ndarray, "3 3"]:
    return np.asarray(Rotation.from_rotvec(phi).as_matrix())


EFFECT = Effect(
    "mount_rotation",
    Stage.MOUNT,
    ("gyro", "accel"),
    "gyro = R_bi^T omega, accel = R_bi^T f, R_bi = Exp(phi)",
    tuple(Parameter(f"phi_{axis}", "rad", 0.2) for axis in "xyz"),
    "two axes turn, or one turns and gravity tilts",
    _forward,
    linear=False,
    starts=starts_at([0.0, 0.0, 0.0]),
)
