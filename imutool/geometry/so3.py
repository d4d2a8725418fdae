"""Rotations (SO(3)) on tensors: exponential, logarithm, Jacobians, quaternions.

Float32 and float64.

Right convention throughout: `R_wb` takes body vectors to world and dR/dt = R_wb [omega_b]x, hence
d Exp(xi)/dt = Exp(xi) [J_r(xi) dxi/dt]x (Barfoot, State Estimation for Robotics, 2017, eq. 7.77a; Chirikjian 2012).

Every function of the angle is a function of s = |xi|², which is analytic: no square root is differentiated at zero, so
values and all derivatives are finite everywhere, also at xi = 0. Below `_BELOW` a Taylor series in s replaces
the closed form.

Reason for the threshold: the closed forms subtract nearly equal numbers. In the matrices the loss stays at one rounding (the
coefficient's error is multiplied by s), but their first derivative loses 1/angle and the second 1/angle² roundings; at an
angle of 0.5 that is 2 and 4. The series must reach this angle with a remainder under one rounding. The k-th term of the
slowest series falls as (s / 4 pi²)^k: 4 terms for float32 and 8 for float64, plus one because a derivative costs one. So the
number of terms depends on the dtype. The common threshold of 1e-4 or less is too small for float32: its derivatives are noise
at much larger angles. Both branches of every `torch.where` get arguments with finite results, so no NaN leaks from the branch
not taken.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from imutool.array_types import Float, Float64, Int

Vectors = Float[Tensor, "*batch 3"]
ROWS_AT_ONCE = 1 << 13  # whose steps stay in a core's cache
Rotations = Float[Tensor, "*batch 3 3"]
Quaternions = Float[Tensor, "*batch 4"]
Angles2 = Float[Tensor, "*batch"]


_BELOW, _ATAN_BELOW = 0.25, 1e-2  # of the squared angle a series is taken, and of r² one for atan(r) / r
_TERMS = {torch.float32: 5, torch.float64: 9}

# sin(x)/x, (1 - cos x)/x², (1 - sin(x)/x)/x² and 1/x² - cot(x/2)/(2x), each as a series in s = x².
_SINC = (
    1.0,
    -1 / 6,
    1 / 120,
    -1 / 5040,
    1 / 362880,
    -1 / 39916800,
    1 / 6227020800,
    -1 / 1307674368000,
    1 / 355687428096000,
    -1 / 121645100408832000,
)
_VERSINE = tuple(c / (2 * k + 2) for k, c in enumerate(_SINC))
_SINE_LEFT = tuple(-c for c in _SINC[1:])
_HALF_COT = (  # |B_2k+2| / (2k+2)!, Bernoulli numbers
    1 / 12,
    1 / 720,
    1 / 30240,
    1 / 1209600,
    1 / 47900160,
    691 / 1307674368000,
    1 / 74724249600,
    3617 / 10670622842880000,
    43867 / 5109094217170944000,
)
_ATAN = tuple((-1) ** k / (2 * k + 1) for k in range(9))


def hat(v: Vectors) -> Rotations:
    """Skew matrix [v]x with [v]x a = v x a."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*v.shape[:-1], 3, 3)


def exp(xi: Vectors) -> Rotations:
    """Rotation Exp(xi) = I + sin(a)/a [xi]x + (1 - cos a)/a² [xi]x², a = |xi| (Rodrigues)."""
    s = _squared(xi)
    return _quadratic(xi, _sinc(s), _versine(s))


def log(R: Rotations) -> Vectors:
    """Rotation vector of R, 0 <= |xi| <= pi, accurate to a few roundings over the whole range.

    Computed through the quaternion: its vector part is well conditioned where the trace is not (near pi), and vice versa. At
    exactly pi two opposite vectors are correct and one is returned; below pi the derivative is finite. R must be a rotation:
    an error off the manifold is projected, not reported.
    """
    q_wxyz = quaternion_wxyz_from_matrix(R)
    w, v = q_wxyz[..., :1], q_wxyz[..., 1:]
    return 2.0 * _atan2_over(_squared(v).unsqueeze(-1), w) * v


def by_vector(xi: Vectors, by_turn: Vectors) -> Vectors:
    """Gradient by xi of a function of Exp(xi), from that by a turn of the body: J_r(xi)^T of it.

    J_r(xi)^T = I + (1 - cos a)/a² [xi]x + (1 - sin(a)/a)/a² [xi]x², a = |xi|.
    """
    s, across = _squared(xi).unsqueeze(-1), torch.linalg.cross(xi, by_turn)
    gradient: Tensor = by_turn + _versine(s) * across + _sine_left(s) * torch.linalg.cross(xi, across)
    return gradient


def chart_rate(xi: Vectors, omega_b: Vectors) -> Vectors:
    """Chart rate dxi/dt = J_r^{-1}(xi) omega_b (paper, eq. 15), with one cross product.

    The inverse right Jacobian is J_r^{-1}(xi) = I + [xi]x / 2 + (1/a² - cot(a/2) / (2a)) [xi]x², a = |xi|, and
    [xi]x² w = xi (xi . w) - a² w. It is defined for a < 2 pi and grows as 2 pi / (2 pi - a) towards this limit;
    `ode.integrate` checks it.
    """
    s, along = _squared(xi).unsqueeze(-1), (xi * omega_b).sum(dim=-1, keepdim=True)
    half_turn: Tensor = 0.5 * torch.linalg.cross(xi, omega_b)
    return omega_b + half_turn + _half_cot(s) * (xi * along - s * omega_b)


def quaternion_wxyz_from_matrix(R: Rotations) -> Quaternions:
    """Unit quaternion of a rotation, with w >= 0.

    The shorter arc, and continuous up to half a turn.

    4 q q^T is linear in R; its row with the largest diagonal has length 2 or more, so it is normalised safely and smoothly
    (the idea of Shepperd 1978, without his square roots).
    """
    outer = _quaternion_outer(R)
    largest: Int[Tensor, "*batch"] = outer.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    row = outer.gather(-2, largest[..., None, None].expand(*largest.shape, 1, 4)).squeeze(-2)
    unit = row / torch.linalg.vector_norm(row, dim=-1, keepdim=True)
    return torch.where(unit[..., :1] < 0, -unit, unit)


def matrix_from_quaternion_wxyz(q_wxyz: Quaternions) -> Rotations:
    """Rotation of a quaternion of any length but zero."""
    q: Tensor = q_wxyz / torch.linalg.vector_norm(q_wxyz, dim=-1, keepdim=True)
    w, v = q[..., 0, None, None], q[..., 1:]
    skew = hat(v)
    return torch.eye(3, dtype=q.dtype, device=q.device) + 2.0 * w * skew + 2.0 * (skew @ skew)


def matrices_from_rows_wxyz(q_wxyz: Float64[np.ndarray, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Rotations of many quaternions, in blocks.

    The steps of all at once take four times the memory of the result.
    """
    R = torch.empty(len(q_wxyz), 3, 3, dtype=torch.float64)
    for first in range(0, len(q_wxyz), ROWS_AT_ONCE):
        rows = slice(first, first + ROWS_AT_ONCE)
        R[rows] = matrix_from_quaternion_wxyz(torch.from_numpy(q_wxyz[rows].copy()))
    return R


def _quadratic(xi: Vectors, linear: Angles2, square: Angles2) -> Rotations:
    """I + linear [xi]x + square [xi]x², with [xi]x² = xi xi^T - s I; by entries, at half the cost of matrices."""
    x, y, z = xi.unbind(-1)
    a, b, c = (linear.unsqueeze(-1) * xi).unbind(-1)
    u, v, w = (square.unsqueeze(-1) * xi).unbind(-1)
    xx, yy, zz, xy, xz, yz = u * x, v * y, w * z, u * y, u * z, v * z
    flat = [1.0 - yy - zz, xy - c, xz + b, xy + c, 1.0 - xx - zz, yz - a, xz - b, yz + a, 1.0 - xx - yy]
    return torch.stack(flat, dim=-1).reshape(*xi.shape[:-1], 3, 3)


def _squared(v: Float[Tensor, "*batch n"]) -> Angles2:
    return (v * v).sum(dim=-1)


def _terms(coefficients: tuple[float, ...], dtype: torch.dtype) -> tuple[float, ...]:
    """First coefficients of a series, as many as a type of numbers needs."""
    if dtype not in _TERMS:
        raise TypeError(f"rotations are computed in float32 or float64, not {dtype}")
    return coefficients[: _TERMS[dtype]]


def _horner(coefficients: tuple[float, ...], s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    value = torch.full_like(s, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        value = value * s + coefficient
    return value


def _analytic(s: Angles2, coefficients: tuple[float, ...], closed_form: Callable[[Angles2], Angles2]) -> Angles2:
    """Function of the angle: a series where it is small, else the closed form, which sees no small angle."""
    series, small = _terms(coefficients, s.dtype), s < _BELOW
    if bool(small.all()):
        return _horner(series, s)
    value = _horner(series, torch.where(small, s, torch.zeros_like(s)))
    return torch.where(small, value, closed_form(torch.where(small, torch.ones_like(s), s).sqrt()))


def _sinc(s: Angles2) -> Angles2:
    return _analytic(s, _SINC, lambda angle: angle.sin() / angle)


def _versine(s: Angles2) -> Angles2:
    return _analytic(s, _VERSINE, lambda angle: 0.5 * ((0.5 * angle).sin() / (0.5 * angle)).square())


def _sine_left(s: Angles2) -> Angles2:
    return _analytic(s, _SINE_LEFT, lambda angle: (1.0 - angle.sin() / angle) / angle.square())


def _half_cot(s: Angles2) -> Angles2:
    return _analytic(
        s, _HALF_COT, lambda angle: (1.0 - 0.5 * angle * (0.5 * angle).cos() / (0.5 * angle).sin()) / angle.square()
    )


def _atan2_over(n2: Float[Tensor, "*batch"], w: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """atan2(n, w) / n from n² and w >= 0; for small n / w as (1 / w) (1 - r²/3 + r⁴/5 - ...)."""
    small = n2 < _ATAN_BELOW * w.square()
    ones = torch.ones_like(n2)
    w_small = torch.where(small, w, ones)
    ratio2 = torch.where(small, n2, torch.zeros_like(n2)) / w_small.square()
    n = torch.where(small, ones, n2).sqrt()
    return torch.where(small, _horner(_terms(_ATAN, n2.dtype), ratio2) / w_small, torch.atan2(n, w) / n)


def _quaternion_outer(R: Rotations) -> Float[Tensor, "*batch 4 4"]:
    """4 q q^T, component order wxyz."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in R.unbind(-2))
    rows = [
        torch.stack([1 + xx + yy + zz, zy - yz, xz - zx, yx - xy], dim=-1),
        torch.stack([zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx], dim=-1),
        torch.stack([xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy], dim=-1),
        torch.stack([yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz], dim=-1),
    ]
    return torch.stack(rows, dim=-2)
