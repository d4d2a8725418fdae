"""Preintegration: increments of attitude, velocity and position, with their bias Jacobians.

Numpy, no torch.

Forster, Carlone, Dellaert, Scaramuzza, "On-Manifold Preintegration", TRO 2017, eq. 33-36 and 44. Here a step uses the mean of
its two samples (reason: `imutool.inertial.windows`), and sums replace the recursions: a block of a hundred samples costs a few
dozen array operations.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from imutool.array_types import Float64

Vector3 = Float64[np.ndarray, "*filters 3"]
Matrix3 = Float64[np.ndarray, "*filters 3 3"]
Vectors = Float64[np.ndarray, "n *filters 3"]
EYE = np.eye(3)
HATS = np.cross(EYE[:, None], EYE[None]).swapaxes(1, 2).reshape(3, 9)  # hat(x), row by row, is x @ HATS: one product
CROSS = -HATS  # from all products of two vectors' axes to their cross product: eps_iab x_ab
SMALL_RAD2 = 1e-8  # below, two terms of the series are exact to 1e-17
MIN_RAD2 = 1e-300  # added to a square, so that sin(x) / x is 1 at zero


class Increment(NamedTuple):
    """Increment over a block, in the body frame at its start and without gravity.

    `by_bias` is the derivative of (rotation in rad in the body frame at the end, v, p) by a constant added to the bias.
    """

    duration_s: float
    R: Matrix3
    v: Vector3
    p: Vector3
    by_bias: Float64[np.ndarray, "*filters 9 6"]
    turned_rad: Float64[np.ndarray, "*filters"] | float  # length of the path, not of the chord


def hat(x: Float64[np.ndarray, "*batch 3"]) -> Float64[np.ndarray, "*batch 3 3"]:
    """Skew matrix of `x ×`."""
    return np.asarray(np.dot(x.reshape(-1, 3), HATS).reshape(*x.shape, 3))


def matvec(A: Float64[np.ndarray, "*batch k m"], x: Float64[np.ndarray, "*batch m"]) -> Float64[np.ndarray, "*batch k"]:
    """Product of each matrix and its vector."""
    product: Float64[np.ndarray, "*batch k"] = (A @ x[..., None])[..., 0]
    return product


def exp(xi: Float64[np.ndarray, "*batch 3"]) -> Float64[np.ndarray, "*batch 3 3"]:
    """Rotation by a rotation vector (Rodrigues).

    cos I + sin/angle hat(xi) + (1 - cos)/angle² xi xi^T.
    """
    return _rotation(xi, _length(xi))


def _length(xi: Float64[np.ndarray, "*batch 3"]) -> Float64[np.ndarray, "*batch"]:
    return np.asarray(np.sqrt(np.einsum("...i,...i->...", xi, xi) + MIN_RAD2))


def _rotation(xi: Float64[np.ndarray, "*batch 3"], angle: Float64[np.ndarray, "*batch"]) -> Float64[np.ndarray, "*batch 3 3"]:
    half = 0.5 * angle[..., None]
    sine = np.sin(half)
    sinc = sine / half
    R: Float64[np.ndarray, "*batch 3 3"] = (0.5 * sinc**2 * xi)[..., None] * xi[..., None, :]
    R += hat(sinc * np.cos(half) * xi)
    R.reshape(*xi.shape[:-1], 9)[..., ::4] += 1.0 - 2.0 * sine**2
    return R


def exp_and_jacobian(xi: Vector3) -> tuple[Matrix3, Matrix3]:
    """Rotation by a rotation vector, and its left Jacobian; in floats, which are faster."""
    both = np.array([_exp_and_jacobian(*x) for x in xi.reshape(-1, 3).tolist()]).reshape(*xi.shape[:-1], 2, 3, 3)
    return both[..., 0, :, :], both[..., 1, :, :]


def _exp_and_jacobian(x: float, y: float, z: float) -> tuple[float, ...]:
    """Entries of I + a [xi]x + b [xi]x² and I + b [xi]x + c [xi]x², row by row."""
    square = x * x + y * y + z * z
    if square < SMALL_RAD2:
        a, b, c = 1.0 - square / 6.0, 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    else:
        angle = math.sqrt(square)
        a, b = math.sin(angle) / angle, 2.0 * (math.sin(0.5 * angle) / angle) ** 2
        c = (1.0 - a) / square
    return _polynomial(x, y, z, a, b) + _polynomial(x, y, z, b, c)


def _polynomial(x: float, y: float, z: float, a: float, b: float) -> tuple[float, ...]:
    """Entries of I + a [xi]x + b [xi]x², row by row."""
    xx, yy, zz, xy, xz, yz = b * x * x, b * y * y, b * z * z, b * x * y, b * x * z, b * y * z
    x, y, z = a * x, a * y, a * z
    return 1.0 - yy - zz, xy - z, xz + y, xy + z, 1.0 - xx - zz, yz - x, xz - y, yz + x, 1.0 - xx - yy


def log(R: Matrix3) -> Vector3:
    """Rotation vector of a rotation."""
    from scipy.spatial.transform import Rotation

    xi: Vector3 = Rotation.from_matrix(R).as_rotvec()
    return xi


def integrate(t_s: Float64[np.ndarray, " n"], gyro: Vectors, accel: Vectors) -> Increment:
    """Increment from the first sample to the last; the samples are already minus their bias.

    Behind the samples there may be an axis of filters, which costs numpy little more than a single filter.
    """
    # numpy's functions that join and pad take as long as the sums: the arrays are filled in place
    n, dt = len(t_s), t_s[1:] - t_s[:-1]
    each = dt.reshape(-1, *(1 for _ in gyro.shape[1:]))
    step = (gyro[:-1] + gyro[1:]) * (0.5 * each)
    angle = _length(step)
    R, turned = np.empty((*gyro.shape, 3)), np.zeros((*gyro.shape, 3))  # R: body at each sample to body at the first
    R[0], R[1:] = EYE, _running_product(_rotation(step, angle))
    # a constant c added to the bias turns step k by -Jr c dt, transformed by the later steps
    right_jacobian = (EYE - 0.5 * hat(step)) * each[..., None]
    np.cumsum(R[1:] @ right_jacobian, axis=0, out=turned[1:])
    force = matvec(R, accel)

    halves, weights = np.empty((2, n - 1)), np.zeros((2, n))  # trapezoidal, to velocity and to position
    halves[0] = 0.5 * dt
    halves[1] = halves[0] * (t_s[-1] - 0.5 * (t_s[:-1] + t_s[1:]))
    weights[:, :-1] = halves
    weights[:, 1:] += halves
    filters = gyro.shape[1:-1]
    all_turned, all_R, force = (x.swapaxes(0, len(filters)) for x in (turned, R, force))  # the samples behind the filters
    moved = weights @ force
    by_bias = np.zeros((*filters, 9, 6))
    by_bias[..., :3, :3] = -R[-1].swapaxes(-1, -2) @ turned[-1]
    # force turned by -turned: its derivative is hat(force) turned, from the sums of force_a turned_bj
    weighted = (weights[:, None] * force.swapaxes(-1, -2)[..., None, :, :]).reshape(*filters, 6, n)
    sums = (weighted @ all_turned.reshape(*filters, n, 9)).reshape(*filters, 2, 9, 3)
    by_bias[..., 3:, :3] = (CROSS @ sums).reshape(*filters, 6, 3)
    by_bias[..., 3:, 3:] = -(weights @ all_R.reshape(*filters, n, 9)).reshape(*filters, 6, 3)
    return Increment(float(t_s[-1] - t_s[0]), R[-1], moved[..., 0, :], moved[..., 1, :], by_bias, angle.sum(axis=0))


def _running_product(R: Float64[np.ndarray, "n *filters 3 3"]) -> Float64[np.ndarray, "n *filters 3 3"]:
    """R_0, R_0 R_1, ...: within rows of about n^1/2 at once, then from row to row."""
    n = len(R)
    width = max(1, math.isqrt(n))
    rows = -(-n // width)
    product = np.empty((rows, width, *R.shape[1:]))
    whole = product.reshape(-1, *R.shape[1:])
    whole[:n], whole[n:] = R, EYE
    for k in range(1, width):
        product[:, k] = product[:, k - 1] @ product[:, k]
    for row in range(1, rows):
        product[row] = product[row - 1, -1] @ product[row]
    return whole[:n]
