"""Rotations against answers computed independently in float64: matrix exponentials, quadrature, scipy."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import scipy.linalg
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from imutool.geometry import so3

DTYPES = [torch.float32, torch.float64]
ROUNDINGS = {  # a dozen operations on entries up to pi; in float64 the reference (expm, inv) is itself off by a dozen
    torch.float32: 8 * 2**-23,
    torch.float64: 32 * 2**-52,
}
GRAD_ROUNDINGS = 40 * 2**-23  # first derivatives lose 1 / angle more, at the threshold 2

THRESHOLD = 0.5  # square root of the switch in s
AXES = [(1.0, 0.0, 0.0), (0.6, -0.8, 0.0), (1 / 3, 2 / 3, -2 / 3), (-0.48, 0.6, 0.64)]
TO_PI = [
    *(0.0, 1e-30, 1e-12, 1e-8, 1e-7, 1e-5, 1e-4, 1e-3, 0.01, 0.0199, 0.02, 0.0201, 0.1, 0.19, 0.2, 0.201),
    *(THRESHOLD - 1e-4, THRESHOLD - 1e-9, THRESHOLD, THRESHOLD + 1e-9, THRESHOLD + 1e-4, 1.0, 1.5, 2.0, 2.5, 3.0),
    *(math.pi - 1e-2, math.pi - 1e-3, math.pi - 1e-4, math.pi - 1e-6, math.pi - 1e-9, math.pi),
]
TO_TWO_PI = [*TO_PI, math.pi + 1e-6, 4.0, 5.0, 6.0, 2 * math.pi - 0.1, 2 * math.pi - 0.01]


def right_jacobian_inverse(xi: Tensor) -> Tensor:
    """Its columns are the chart rates of unit body rates."""
    rates = torch.eye(3, dtype=xi.dtype).expand(*xi.shape[:-1], 3, 3).unbind(-2)
    return torch.stack([so3.chart_rate(xi, rate) for rate in rates], dim=-1)


FUNCTIONS = [so3.exp, right_jacobian_inverse]

small_vectors = arrays(np.float64, 3, elements=st.floats(-1.8, 1.8))  # |xi| < 3.12 < pi
any_quaternions = arrays(np.float64, 4, elements=st.floats(-1.0, 1.0)).filter(lambda q: np.linalg.norm(q) > 1e-3)


def sweep(angles: list[float], dtype: torch.dtype) -> tuple[Tensor, np.ndarray]:
    """Rotation vectors in the dtype, and the same numbers (as rounded) in float64 for the reference."""
    xi = torch.tensor([[angle * c for c in axis] for angle in angles for axis in AXES], dtype=torch.float64).to(dtype)
    return xi, xi.double().numpy()


def skew(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def right_jacobian_by_quadrature(xi: np.ndarray) -> np.ndarray:
    """Integral over [0, 1] of Exp(-u xi) du by Gauss-Legendre: 40 nodes are exact to a rounding for one turn."""
    nodes, weights = np.polynomial.legendre.leggauss(40)
    return np.einsum("n,nij->ij", weights / 2, Rotation.from_rotvec(-(nodes[:, None] + 1) / 2 * xi).as_matrix())


def reference(function: Callable[[Tensor], Tensor], xi: np.ndarray) -> np.ndarray:
    if function is so3.exp:
        return scipy.linalg.expm(skew(xi))
    return np.linalg.inv(right_jacobian_by_quadrature(xi))


@pytest.mark.parametrize("dtype", DTYPES)
def test_hat_is_the_cross_product(dtype: torch.dtype) -> None:
    a, b = torch.randn(2, 5, 4, 3, dtype=dtype, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close((so3.hat(a) @ b[..., None])[..., 0], torch.linalg.cross(a, b))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda f: f.__name__)
def test_matrices_equal_independent_ones_across_every_threshold(function: Callable, dtype: torch.dtype) -> None:
    inverse = function is right_jacobian_inverse
    xi, exact = sweep(TO_TWO_PI if inverse else TO_PI, dtype)
    got = function(xi)
    assert got.dtype == dtype
    for row, (matrix, v) in enumerate(zip(got.double().numpy(), exact, strict=True)):
        # Towards 2 pi the inverse is ill conditioned: what J_r, or the angle, is rounded by comes back times |J_r^{-1}|².
        half = np.linalg.norm(v) / 2
        edge = max(1.0, (half / math.sin(half)) ** 2) if inverse and half else 1.0
        error = np.abs(matrix - reference(function, v)).max()
        assert error <= ROUNDINGS[dtype] * edge, (row, np.linalg.norm(v), error)


@pytest.mark.parametrize("dtype", DTYPES)
def test_log_is_accurate_from_zero_to_pi(dtype: torch.dtype) -> None:
    _, exact = sweep(TO_PI, dtype)
    R = torch.from_numpy(Rotation.from_rotvec(exact).as_matrix()).to(dtype)
    got = so3.log(R).double().numpy()
    # The nearest of the two logarithms at pi. What R lost when it was rounded comes back in the vector, no more.
    error = np.minimum(
        np.abs(got - exact), np.abs(got - exact * (1 - 2 * np.pi / np.maximum(np.linalg.norm(exact, axis=1), 1e-9))[:, None])
    )
    assert error.max() <= ROUNDINGS[dtype], np.linalg.norm(exact, axis=1)[error.max(axis=1).argmax()]


@pytest.mark.parametrize("dtype", DTYPES)
def test_log_of_small_rotations_keeps_relative_accuracy(dtype: torch.dtype) -> None:
    xi, _ = sweep([1e-12, 1e-8, 1e-5, 1e-3], dtype)
    assert ((so3.log(so3.exp(xi)) - xi).norm(dim=-1) <= ROUNDINGS[dtype] * xi.norm(dim=-1)).all()


def test_log_near_pi_from_float64_rotations_just_inside_keeps_the_sign() -> None:
    for below in (1e-3, 1e-6, 1e-9, 1e-12):
        xi, exact = sweep([math.pi - below], torch.float64)
        assert np.abs(so3.log(so3.exp(xi)).numpy() - exact).max() <= ROUNDINGS[torch.float64]


@pytest.mark.parametrize("dtype", DTYPES)
def test_chart_rate_is_the_inverse_right_jacobian_times_the_rate(dtype: torch.dtype) -> None:
    xi, exact = sweep([*TO_PI, 4.0, 5.0], dtype)
    omega = torch.randn(xi.shape, dtype=dtype, generator=torch.Generator().manual_seed(2))
    inverses = np.stack([reference(right_jacobian_inverse, v) for v in exact])
    expected = np.einsum("nij,nj->ni", inverses, omega.double().numpy())
    error = np.abs(so3.chart_rate(xi, omega).double().numpy() - expected).max(axis=1)
    half = np.maximum(np.linalg.norm(exact, axis=1), 1e-9) / 2
    assert (error <= 8 * ROUNDINGS[dtype] * (half / np.sin(half)) ** 2).all()  # the reference is an inverse


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.02, 0.2, 0.4, 0.499, 0.6, 1.0, 2.0, 3.0, math.pi - 1e-3, math.pi - 1e-6])
def test_derivatives_agree_with_finite_differences(angle: float) -> None:
    xi = torch.tensor([[angle * c for c in axis] for axis in AXES], dtype=torch.float64, requires_grad=True)
    omega = torch.ones_like(xi)
    for function in FUNCTIONS:
        assert gradcheck(function, (xi,))
    assert gradcheck(lambda v: so3.chart_rate(v, omega), (xi,))
    assert gradcheck(lambda v: so3.quaternion_wxyz_from_matrix(so3.exp(v)), (xi,))
    if angle < math.pi - 1e-5:  # finite differences of 1e-6 would step over the cut at pi
        assert gradcheck(lambda v: so3.log(so3.exp(v)), (xi,))


def test_second_derivatives_agree_with_finite_differences_at_zero_and_either_side_of_the_threshold() -> None:
    for angle in (0.0, 0.49, 0.51, 2.0):
        xi = torch.tensor([[angle * c for c in axis] for axis in AXES[1:2]], dtype=torch.float64, requires_grad=True)
        for function in (so3.exp, right_jacobian_inverse, lambda v: so3.log(so3.exp(v))):
            assert gradgradcheck(function, (xi,))


def test_the_gradient_of_log_exp_is_the_identity_up_to_pi() -> None:
    for dtype, tolerance in (
        (torch.float32, 2e-5),
        (torch.float64, 1e-12),
    ):  # two Jacobians of norm up to pi/2 and their inverses
        for angle in (0.0, 1e-6, 0.3, 0.5, 2.0, 3.0, math.pi - 1e-3, math.pi - 1e-5):
            xi = torch.tensor([angle * c for c in AXES[2]], dtype=dtype)
            J = torch.autograd.functional.jacobian(lambda v: so3.log(so3.exp(v)), xi)
            assert (J - torch.eye(3, dtype=dtype)).abs().max() < tolerance, (dtype, angle)


@pytest.mark.parametrize("function", [*FUNCTIONS, lambda v: so3.log(so3.exp(v))])
def test_float32_gradients_equal_float64_ones_at_every_angle(function: Callable) -> None:
    angles = [a for a in TO_PI if a < 3.1]
    xi, _ = sweep(angles, torch.float32)

    def gradient(v: Tensor) -> Tensor:
        v = v.clone().requires_grad_(True)
        out = function(v)
        weights = torch.linspace(-1, 1, out[0].numel(), dtype=v.dtype).reshape(out[0].shape)
        return torch.autograd.grad((out * weights).sum(), v)[0]

    single, double = gradient(xi), gradient(xi.double())
    assert torch.isfinite(single).all()
    scale = 1.0 + double.abs().max()
    assert (single.double() - double).abs().max() <= GRAD_ROUNDINGS * scale


@pytest.mark.parametrize("dtype", DTYPES)
def test_gradients_at_exactly_zero_and_exactly_half_a_turn_are_finite(dtype: torch.dtype) -> None:
    eye, half = torch.eye(3, dtype=dtype), torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=dtype))
    for matrix in (eye, half):
        R = matrix.clone().requires_grad_(True)
        (gradient,) = torch.autograd.grad(so3.log(R).sum(), R)
        assert torch.isfinite(gradient).all()
    assert float(so3.log(half).norm()) == pytest.approx(math.pi, abs=1e-6)
    assert torch.equal(so3.log(eye), torch.zeros(3, dtype=dtype))


@given(small_vectors)
def test_log_undoes_exp(v: np.ndarray) -> None:
    xi = torch.from_numpy(v)
    assert (so3.log(so3.exp(xi)) - xi).abs().max() <= ROUNDINGS[torch.float64]


@given(any_quaternions)
def test_quaternions_and_matrices_are_one_another_s_inverse_and_agree_with_scipy(q: np.ndarray) -> None:
    unit = q / np.linalg.norm(q)
    R = so3.matrix_from_quaternion_wxyz(torch.from_numpy(q))
    assert np.abs(R.numpy() - Rotation.from_quat(q, scalar_first=True).as_matrix()).max() <= ROUNDINGS[torch.float64]
    assert (so3.matrices_from_rows_wxyz(np.stack([q, unit])) - R).abs().max() <= ROUNDINGS[torch.float64]
    back = so3.quaternion_wxyz_from_matrix(R).numpy()
    assert back[0] >= 0
    assert min(np.abs(back - unit).max(), np.abs(back + unit).max()) <= ROUNDINGS[torch.float64]


@given(small_vectors, small_vectors)
def test_the_right_jacobian_turns_a_change_of_the_vector_into_a_body_rotation(v: np.ndarray, d: np.ndarray) -> None:
    xi, step = torch.from_numpy(v), 1e-6 * torch.from_numpy(d)
    right = so3.exp(xi).T @ so3.exp(xi + step)
    left = so3.exp(xi + step) @ so3.exp(xi).T
    second_order = 1e-11  # |step|² times the curvature, of order one
    assert (so3.log(right) - torch.linalg.solve(right_jacobian_inverse(xi), step)).abs().max() < second_order
    assert (so3.log(left) - torch.linalg.solve(right_jacobian_inverse(-xi), step)).abs().max() < second_order


@pytest.mark.parametrize("batch", [(), (0,), (7,), (2, 1, 3)])
def test_any_batch_shape_passes_through(batch: tuple[int, ...]) -> None:
    xi = torch.randn(*batch, 3, generator=torch.Generator().manual_seed(3))
    R = so3.exp(xi)
    assert R.shape == (*batch, 3, 3)
    assert so3.log(R).shape == xi.shape
    assert so3.quaternion_wxyz_from_matrix(R).shape == (*batch, 4)
    for index in np.ndindex(batch):
        torch.testing.assert_close(R[index], so3.exp(xi[index]))


def test_half_precision_is_refused() -> None:
    with pytest.raises(TypeError, match="float32 or float64"):
        so3.exp(torch.zeros(3, dtype=torch.float16))
