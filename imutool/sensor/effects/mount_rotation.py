"""Rotation of the mount: the axes of both sensors against the body's."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
from scipy.spatial.transform import Rotation

from imutool.array_types import Float64
from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.samples import IdealMotion, SensorSamples, Vectors

NOTHING_MOVES = 1e-9  # rad/s or m/s², below which a sensor says nothing
NEAR_RAD = 0.3  # up to which a fit that begins without a rotation finds it
MAX = 0.5  # of the squares, that may be left: between noise and noise every rotation leaves as much


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


def _starts(motion: IdealMotion, samples: SensorSamples) -> list[Theta]:
    """No rotation; also the nearest of both sensors (Kabsch, Acta Cryst. 1976), if it is large and takes most of the misfit."""
    read = motion.sample(samples.stamp_s, samples.stamp_s)
    pairs = [(read.gyro - read.gyro.mean(axis=0), samples.gyro - samples.gyro.mean(axis=0)), (read.accel, samples.accel)]
    body, sensor = (np.concatenate([pair[k] / max(pair[0].std(), NOTHING_MOVES) for pair in pairs]) for k in (0, 1))
    U, _, Vt = np.linalg.svd(body.T @ sensor)
    turned = Rotation.from_matrix(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)
    squares, before = (float(((body - vectors) ** 2).sum()) for vectors in (turned.apply(sensor), sensor))
    return [np.zeros(3), *([turned.as_rotvec()] if turned.magnitude() > NEAR_RAD and squares < MAX * before else [])]


EFFECT = Effect(
    "mount_rotation",
    Stage.MOUNT,
    ("gyro", "accel"),
    "gyro = R_bi^T omega, accel = R_bi^T f, R_bi = Exp(phi)",
    tuple(Parameter(f"phi_{axis}", "rad", 0.2) for axis in "xyz"),
    "two axes turn, or one turns and gravity tilts",
    _forward,
    linear=False,
    starts=_starts,
)
