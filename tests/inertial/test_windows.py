"""Tree products equal sequential ones, and the residuals' derivatives are those of the residuals."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from imutool.geometry import so3
from imutool.inertial.windows import (
    Pieces,
    Prefix,
    attitudes,
    derivative_by_sample,
    end_attitude,
    huber,
    huber_weight,
    rotation_residual,
    running_product,
    step_means,
    turns_from_start,
    velocity_residual,
    whole_turn,
)

# A product of n rotations rounds n times in sequence; the tree rounds no more. 100 steps of one rounding each, and slack.
PRODUCT = {torch.float32: 1e-4, torch.float64: 1e-13}
# Central differences with a step of 1e-6 in float64: a truncation error of 1e-12 and a rounding error of 1e-16 / 1e-6.
STEP, DERIVATIVE = 1e-6, 1e-8
G_W = torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64)


def vectors(seed: int, batch: int, n: int) -> torch.Tensor:
    return torch.randn(batch, n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def rotations(seed: int, batch: int, n: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return so3.exp(vectors(seed, batch, n)).to(dtype)


def samples(seed: int, batch: int, n: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Samples of the size of fast flight, and steps that are not all alike."""
    generator = torch.Generator().manual_seed(seed)
    u = torch.randn(batch, n, 3, generator=generator, dtype=torch.float64)
    return u, 0.005 * (0.5 + torch.rand(batch, n - 1, generator=generator, dtype=torch.float64))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@given(seed=st.integers(0, 2**31), batch=st.integers(1, 3), n=st.integers(1, 70))
@settings(max_examples=30, deadline=None)
def test_running_and_whole_products_are_the_sequential_ones(dtype: torch.dtype, seed: int, batch: int, n: int) -> None:
    xi = vectors(seed, batch, n).to(dtype)
    increments = so3.exp(xi)
    expected, one_by_one = increments[:, 0], [increments[:, 0]]
    for k in range(1, n):
        expected = expected @ increments[:, k]
        one_by_one.append(expected)
    torch.testing.assert_close(running_product(increments), torch.stack(one_by_one, 1), rtol=0, atol=PRODUCT[dtype])
    torch.testing.assert_close(whole_turn(xi), expected, rtol=0, atol=PRODUCT[dtype])


@pytest.mark.parametrize("size", [1e-3, 0.1, 1.0])
@pytest.mark.parametrize("n", [1, 2, 7, 12])
def test_the_derivative_of_the_whole_turn_is_that_of_its_operations(n: int, size: float) -> None:
    xi = (size * vectors(11, 2, n)).requires_grad_()
    weight, one_by_one = rotations(12, 2, 1)[:, 0], so3.exp(xi).unbind(1)
    expected = one_by_one[0]
    for increment in one_by_one[1:]:
        expected = expected @ increment
    slopes = (torch.autograd.grad((weight * R).sum(), xi)[0] for R in (whole_turn(xi), expected))
    torch.testing.assert_close(*slopes, rtol=0, atol=PRODUCT[torch.float64])


def test_attitudes_start_at_the_start_and_end_at_the_end_attitude() -> None:
    gyro, dt = samples(1, 3, 41)
    R_start = rotations(2, 3, 1)[:, 0]
    R_wb = attitudes(R_start, gyro, dt)
    assert torch.equal(R_wb[:, 0], R_start)
    R = R_start
    for k in range(40):
        R = R @ so3.exp(0.5 * (gyro[:, k] + gyro[:, k + 1]) * dt[:, k, None])
        torch.testing.assert_close(R_wb[:, k + 1], R, rtol=0, atol=PRODUCT[torch.float64])
    torch.testing.assert_close(end_attitude(R_start, gyro, dt), R_wb[:, -1], rtol=0, atol=PRODUCT[torch.float64])


def test_a_steady_turn_ends_where_the_closed_form_says() -> None:
    rate = torch.tensor([0.3, -0.2, 0.9], dtype=torch.float64)
    dt = torch.full((1, 200), 0.01, dtype=torch.float64)
    R_end = end_attitude(torch.eye(3, dtype=torch.float64)[None], rate.expand(1, 201, 3), dt)
    torch.testing.assert_close(R_end[0], so3.exp(2.0 * rate), rtol=0, atol=PRODUCT[torch.float64])


def test_the_mean_of_two_samples_makes_the_rotation_second_order() -> None:
    """A rate that changes linearly about one axis turns by its mean exactly, where the held sample would be late."""
    t = torch.arange(101, dtype=torch.float64) * 0.01
    gyro = torch.zeros(1, 101, 3, dtype=torch.float64)
    gyro[0, :, 2] = t
    R_end = end_attitude(torch.eye(3, dtype=torch.float64)[None], gyro, torch.diff(t)[None])
    assert so3.log(R_end)[0, 2].item() == pytest.approx(0.5, abs=1e-12)


def test_the_rotation_residual_of_the_truth_is_zero_and_of_a_turned_truth_that_turn() -> None:
    gyro, dt = samples(3, 2, 33)
    R_true = end_attitude(torch.eye(3, dtype=torch.float64).expand(2, 3, 3), gyro, dt)
    e, _ = rotation_residual(gyro, dt, R_true)
    assert e.abs().max() < PRODUCT[torch.float64]
    turn = torch.tensor([[0.1, -0.2, 0.05], [0.0, 0.3, 0.0]], dtype=torch.float64)
    e, _ = rotation_residual(gyro, dt, R_true @ so3.exp(turn))
    torch.testing.assert_close(e, turn, rtol=0, atol=1e-12)


def test_the_rotation_residuals_derivative_is_that_of_finite_differences() -> None:
    gyro, dt = samples(4, 2, 9)
    R_true = end_attitude(torch.eye(3, dtype=torch.float64).expand(2, 3, 3), gyro, dt)  # e = 0: where A is exact
    _, A = rotation_residual(gyro, dt, R_true)
    assert A.shape == (2, 8, 3, 3)
    for k in range(9):
        for axis in range(3):
            moved = [gyro.clone(), gyro.clone()]
            moved[0][:, k, axis] += STEP
            moved[1][:, k, axis] -= STEP
            slope = (rotation_residual(moved[0], dt, R_true)[0] - rotation_residual(moved[1], dt, R_true)[0]) / (2 * STEP)
            # A turns the end of a step; a sample is half of the steps on either side of it. The rotation vector of a step is
            # not the turn of its end: J_r(gyro dt) - I is half of |gyro| dt, here at most 3 * 0.0075 / 2.
            sides = [A[:, j, :, axis] for j in (k - 1, k) if 0 <= j < 8]
            torch.testing.assert_close(slope, -0.5 * torch.stack(sides).sum(0), rtol=0.02, atol=2e-4)


def test_the_rotation_residuals_derivative_is_exact_where_the_steps_are_small() -> None:
    """The part left out is proportional to the angle of a step: ten times shorter steps, ten times less of it."""
    gyro, dt = samples(5, 1, 9)
    missed = []
    for shrink in (1.0, 0.1, 0.01):
        R_true = end_attitude(torch.eye(3, dtype=torch.float64)[None], gyro, dt * shrink)
        change = torch.randn(1, 9, 3, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
        ahead, behind = (rotation_residual(gyro + s * STEP * change, dt * shrink, R_true)[0] for s in (1, -1))
        _, A = rotation_residual(gyro, dt * shrink, R_true)
        linear = -(A @ step_means(change)[..., None]).sum(1)[..., 0]
        missed.append(float(((ahead - behind) / (2 * STEP) - linear).norm() / linear.norm()))
    assert missed[0] < 0.02
    assert missed[1] == pytest.approx(missed[0] / 10, rel=0.3)
    assert missed[2] == pytest.approx(missed[0] / 100, rel=0.3)


def test_the_velocity_residual_is_linear_with_exactly_its_derivative() -> None:
    accel, dt = samples(7, 2, 12)
    R_wb = rotations(8, 2, 12)
    dv = torch.tensor([[1.0, 2.0, 3.0], [-1.0, 0.0, 0.5]], dtype=torch.float64)
    e, A = velocity_residual(accel, dt, R_wb, dv, G_W)
    change = torch.randn(2, 12, 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    moved, _ = velocity_residual(accel + change, dt, R_wb, dv, G_W)
    torch.testing.assert_close(moved, e - (A @ change[..., None]).sum(1)[..., 0], rtol=0, atol=1e-13)
    for k, axis in ((0, 0), (5, 1), (11, 2)):  # ends weigh half a step
        ahead, behind = accel.clone(), accel.clone()
        ahead[:, k, axis] += STEP
        behind[:, k, axis] -= STEP
        up, down = (velocity_residual(u, dt, R_wb, dv, G_W)[0] for u in (ahead, behind))
        torch.testing.assert_close((up - down) / (2 * STEP), -A[:, k, :, axis], rtol=0, atol=DERIVATIVE)


def test_the_velocity_residual_of_free_fall_and_of_rest_is_zero() -> None:
    R_wb = torch.eye(3, dtype=torch.float64).expand(1, 21, 3, 3)
    dt = torch.full((1, 20), 0.05, dtype=torch.float64)
    nothing, up = torch.zeros(1, 21, 3, dtype=torch.float64), -G_W.expand(1, 21, 3)
    e, _ = velocity_residual(nothing, dt, R_wb, G_W[None], G_W)  # one second of falling
    assert e.abs().max() < 1e-13
    e, _ = velocity_residual(up, dt, R_wb, torch.zeros(1, 3, dtype=torch.float64), G_W)
    assert e.abs().max() < 1e-13


@given(st.floats(1e-6, 1e3), st.floats(1e-3, 1e3))
def test_huber_is_a_parabola_then_a_line_and_its_weight_is_its_slope(size: float, delta: float) -> None:
    x = torch.tensor([size], dtype=torch.float64, requires_grad=True)
    width = torch.tensor([delta], dtype=torch.float64)
    loss = huber(x, width)
    expected = 0.5 * (size / delta) ** 2 if size <= delta else size / delta - 0.5
    assert loss.item() == pytest.approx(expected, rel=1e-12)
    (slope,) = torch.autograd.grad(loss.sum(), x)
    # iteratively reweighted least squares: weight * size is the loss's slope, in units of delta²
    assert (huber_weight(x, width) * x / delta**2).item() == pytest.approx(slope.item(), rel=1e-12)


def test_huber_joins_smoothly_each_row_has_its_own_width_and_zero_is_harmless() -> None:
    x = torch.tensor([0.0, 1.0 - 1e-9, 1.0, 1.0 + 1e-9, 3.0], dtype=torch.float64, requires_grad=True)
    width = torch.tensor([1.0, 1.0, 1.0, 1.0, 3.0], dtype=torch.float64)
    loss = huber(x, width)
    (slope,) = torch.autograd.grad(loss.sum(), x)
    torch.testing.assert_close(loss[1:], torch.full((4,), 0.5, dtype=torch.float64), rtol=0, atol=2e-9)
    torch.testing.assert_close(slope * width, torch.tensor([0.0, 1, 1, 1, 1], dtype=torch.float64), rtol=0, atol=2e-9)
    assert torch.equal(huber_weight(torch.zeros(1), torch.zeros(1)), torch.ones(1))


@given(seed=st.integers(0, 2**31), longest=st.integers(1, 30), hops=st.tuples(st.integers(1, 9), st.integers(5, 40)))
@settings(max_examples=30, deadline=None)
def test_windows_from_shared_pieces_are_those_of_their_samples(seed: int, longest: int, hops: tuple[int, int]) -> None:
    """A hole that no window covers holds no number, and some windows overlap."""
    (gyro,), (dt,) = samples(seed, 1, 200)
    (accel,), _ = samples(seed + 1, 1, 200)
    t = torch.cat([torch.zeros(1).double(), dt.cumsum(0)])
    gyro[95:105] = torch.nan
    sets = [(torch.arange(95 - n)[::hop], n) for n, hop in zip((7, 40), hops, strict=True)] + [(torch.tensor([110, 120]), 60)]
    pieces = Pieces.between(sets, longest)
    index = pieces.index()
    steps = torch.diff(t[index], dim=1)
    turns = turns_from_start(gyro[index], steps)
    by_rate, by_force = (derivative_by_sample(sensor, turns, steps) for sensor in ("gyro", "accel"))
    added = torch.cat([by_rate.sum(1), (by_force @ accel[index][..., None]).sum(1)], dim=2)
    prefix = Prefix.of(turns[:, -1], added)
    assert index.shape[1] <= longest + 1
    assert not bool(torch.isin(torch.arange(95, 105), index).any())
    for first, n in sets:
        turn, total = prefix.across(*pieces.row(first, n))
        whole = first[:, None] + torch.arange(n + 1)
        R = attitudes(torch.eye(3).double().expand(len(first), 3, 3), gyro[whole], torch.diff(t[whole], dim=1))
        _, A = rotation_residual(gyro[whole], torch.diff(t[whole], dim=1), R[:, -1])
        e, _ = velocity_residual(accel[whole], torch.diff(t[whole], dim=1), R, torch.zeros(len(first), 3).double(), 0 * G_W)
        for found, expected in ((turn, R[:, -1]), (turn.mT @ total[..., :3], A.sum(1)), (-total[..., 3], e)):
            torch.testing.assert_close(found, expected, rtol=0, atol=100 * PRODUCT[torch.float64])
