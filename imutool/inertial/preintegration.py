"""Preintegration: increments of attitude, velocity and position, with their bias Jacobians.

Numpy, no torch.

Forster, Carlone, Dellaert, Scaramuzza, "On-Manifold Preintegration", TRO 2017, eq. 33-36 and 44. Here a step uses the mean of
its two samples (reason: `imutool.inertial.windows`), and sums replace the recursions: a block of a hundred samples costs a few
dozen array operations.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

Vector3 = Float64[np.ndarray, "3"]
Matrix3 = Float64[np.ndarray, "3 3"]
Vectors = Float64[np.ndarray, "n 3"]
EYE = np.eye(3)
SMALL_RAD2 = 1e-8  # below, two terms of the series are exact to 1e-17


class Increment(NamedTuple):
    """Increment over a block, in the body frame at its start and without gravity.

    `by_bias` is the derivative of (rotation in rad in the body frame at the end, v, p) by a constant added to the bias.
    """

    duration_s: float
    R: Matrix3
    v: Vector3
    p: Vector3
    by_bias: Float64[np.ndarray, "9 6"]
    turned_rad: float  # length of the path, not of the chord


def hat(x: Float64[np.ndarray, "*batch 3"]) -> Float64[np.ndarray, "*batch 3 3"]:
    """Skew matrix of `x ×`."""
    out = np.zeros((*x.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -x[..., 2], x[..., 1], -x[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = x[..., 2], -x[..., 1], x[..., 0]
    return out


def exp(xi: Float64[np.ndarray, "*batch 3"]) -> Float64[np.ndarray, "*batch 3 3"]:
    """Rotation by a rotation vector (Rodrigues)."""
    square = (xi * xi).sum(-1)[..., None, None]
    small = square < SMALL_RAD2
    angle = np.sqrt(np.where(small, 1.0, square))
    first = np.where(small, 1.0 - square / 6.0, np.sin(angle) / angle)
    second = np.where(small, 0.5 - square / 24.0, 2.0 * (np.sin(0.5 * angle) / angle) ** 2)
    X = hat(xi)
    R: Float64[np.ndarray, "*batch 3 3"] = EYE + first * X + second * (X @ X)
    return R


def integrate(t_s: Float64[np.ndarray, " n"], gyro: Vectors, accel: Vectors) -> Increment:
    """Increment from the first sample to the last; the samples are already minus their bias."""
    # numpy's functions that join and pad take as long as the sums: the arrays are filled in place
    n, dt = len(t_s), t_s[1:] - t_s[:-1]
    step = 0.5 * (gyro[:-1] + gyro[1:]) * dt[:, None]
    R, turned = np.empty((n, 3, 3)), np.zeros((n, 3, 3))  # R: body at each sample to body at the first
    R[0], R[1:] = EYE, _running_product(exp(step))
    # a constant c added to the bias turns step k by -Jr c dt, transformed by the later steps
    right_jacobian = (EYE - 0.5 * hat(step)) * dt[:, None, None]
    np.cumsum(R[1:] @ right_jacobian, axis=0, out=turned[1:])
    R_by_bias = -R.swapaxes(-1, -2) @ turned
    force = (R @ accel[..., None])[..., 0]
    force_by_gyro_bias = -R @ hat(accel) @ R_by_bias

    weights = np.zeros((2, n))  # trapezoidal, to velocity and to position
    weights[0, :-1], weights[1, :-1] = dt, dt * (t_s[-1] - 0.5 * (t_s[:-1] + t_s[1:]))
    weights[:, 1:] += weights[:, :-1].copy()
    weights *= 0.5
    to_velocity, to_position = weights
    by_bias = np.zeros((9, 6))
    by_bias[:3, :3] = R_by_bias[-1]
    for rows, of_sample in ((slice(3, 6), to_velocity), (slice(6, 9), to_position)):
        by_bias[rows, :3] = np.einsum("n,nij->ij", of_sample, force_by_gyro_bias)
        by_bias[rows, 3:] = -np.einsum("n,nij->ij", of_sample, R)
    turned_rad = float(np.sqrt((step * step).sum(axis=1)).sum())
    return Increment(float(t_s[-1] - t_s[0]), R[-1], to_velocity @ force, to_position @ force, by_bias, turned_rad)


def _running_product(R: Float64[np.ndarray, "n 3 3"]) -> Float64[np.ndarray, "n 3 3"]:
    """R_0, R_0 R_1, ..., in log2(n) passes."""
    shift = 1
    while shift < len(R):
        before, R = R, np.empty_like(R)
        R[:shift] = before[:shift]
        np.matmul(before[:-shift], before[shift:], out=R[shift:])
        shift *= 2
    return R
