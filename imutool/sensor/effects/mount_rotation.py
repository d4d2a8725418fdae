"""Rotation of the mount: the axes of both sensors against the body's; it may slip."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial

import numpy as np

from imutool.array_types import Float64, Vectors
from imutool.sensor.effect import Effect, Parameter, Stage, Theta, residual
from imutool.sensor.effects.gyro_bias_step import best_row, followed, from_on, orthonormal
from imutool.sensor.samples import IdealMotion, SensorSamples

NOTHING_MOVES = 1e-9  # rad/s or m/s², below which a sensor says nothing
NEAR_RAD = 0.3  # up to which a fit that begins without a rotation finds it
NO_ERROR = 1e-12  # of the squares of a reading: an axis that is no measurement has none
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
    from scipy.spatial.transform import Rotation  # takes 0.1 s, which a model that is only loaded need not wait

    return np.asarray(Rotation.from_rotvec(phi).as_matrix())


def _starts(motion: IdealMotion, samples: SensorSamples) -> list[Theta]:
    """No rotation; also the nearest of both sensors (Kabsch, Acta Cryst. 1976), if it is large and takes most of the misfit."""
    from scipy.spatial.transform import Rotation

    read = motion.sample(samples.stamp_s, samples.stamp_s)
    pairs = [(read.gyro - read.gyro.mean(axis=0), samples.gyro - samples.gyro.mean(axis=0)), (read.accel, samples.accel)]
    body, sensor = (np.concatenate([pair[k] / max(pair[0].std(), NOTHING_MOVES) for pair in pairs]) for k in (0, 1))
    U, _, Vt = np.linalg.svd(body.T @ sensor)
    turned = Rotation.from_matrix(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)
    squares, before = (float(((body - vectors) ** 2).sum()) for vectors in (turned.apply(sensor), sensor))
    return [np.zeros(3), *([turned.as_rotvec()] if turned.magnitude() > NEAR_RAD and squares < MAX * before else [])]


def slipping(at: Parameter) -> Effect:
    """The rotation of a mount that slips at one time, which is its last parameter."""
    return replace(
        EFFECT,
        stage=Stage.SENSOR,  # between samples, a motion that turns at once has no spline
        equation=f"{EFFECT.equation} from {at.name} on",
        parameters=(*EFFECT.parameters, at),
        forward=_slipped,
        starts=_slips,
        alternatives=lambda samples: len(samples.stamp_s),
    )


def _slipped(samples: SensorSamples, theta: Theta) -> SensorSamples:
    R_bi, on = _rotation(*theta[:3].tolist()), np.asarray(samples.stamp_s >= theta[3])[:, None]
    return samples.with_readings(*(np.where(on, _turned(x, R_bi), x) for x in (samples.gyro, samples.accel)))


def _slips(motion: IdealMotion, samples: SensorSamples) -> list[Theta]:
    """The likeliest slip of a mount, by which v changes to v + v x phi."""
    t_s = samples.stamp_s
    ideal = motion.sample(t_s, t_s)
    basis = orthonormal(np.column_stack([np.ones(len(t_s)), followed(ideal)]))
    N, g = np.zeros((len(t_s) - 1, 3, 3)) + np.diag([p.plausible**-2 for p in EFFECT.parameters]), np.zeros((len(t_s) - 1, 3))
    for v, error in zip((ideal.gyro, ideal.accel), residual(motion, samples), strict=True):
        by_phi = np.stack([np.cross(v, axis) for axis in np.eye(3)], axis=2)
        rest = error - basis @ (basis.T @ error)
        for columns, own in zip(by_phi.transpose(1, 0, 2), rest.T, strict=True):
            square, size = float((own**2).mean()), float((v**2).mean())
            weight = 1.0 / square if square > NO_ERROR * size else 0.0
            shared = np.stack([from_on(basis * x[:, None]) for x in columns.T], axis=1)
            N += weight * (from_on(columns[:, :, None] * columns[:, None]) - shared @ shared.transpose(0, 2, 1))
            g += weight * from_on(columns * own[:, None])
    phi = np.linalg.solve(N, g[..., None])[..., 0]
    row = best_row(t_s, (phi * g).sum(axis=1))
    return [np.append(phi[row], (t_s[row] + t_s[row + 1]) / 2.0)]


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
