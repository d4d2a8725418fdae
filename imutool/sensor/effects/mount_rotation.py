"""Rotation of the mount: the axes of both sensors against the body's."""

from __future__ import annotations

from dataclasses import replace

from scipy.spatial.transform import Rotation

from imutool.sensor.effect import Effect, Parameter, Stage, Theta, starts_at
from imutool.sensor.samples import IdealMotion


def _forward(motion: IdealMotion, phi: Theta) -> IdealMotion:
    """R_bi = Exp(phi) takes the sensor's vectors to the body; R_wb stays the body's attitude."""
    R_bi = Rotation.from_rotvec(phi).as_matrix()
    return replace(motion, gyro=motion.gyro @ R_bi, accel=motion.accel @ R_bi, alpha=motion.alpha @ R_bi)


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
