"""Control paths and charts against closed forms: constant rate, coning, causality, order of convergence, gradients."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline
from torch import Tensor, nn

from imutool.bias.networks.ode import HermitePath, integrate
from imutool.errors import DataError, NumericsError
from imutool.geometry import so3

F64 = torch.float64
EXACT = 1e-12  # hundreds of float64 steps
ORDER_TOLERANCE = 0.3  # design.md, Tests
GRADIENT_TOLERANCE = 2e-6  # of two solutions each converged to half of it
EYE = torch.eye(3, dtype=F64)


def knots(n: int = 12, k: int = 2, batch: tuple[int, ...] = (), seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    t = torch.cumsum(0.5 + torch.rand(n, dtype=F64, generator=generator), dim=0)
    return t, torch.randn(*batch, n, k, dtype=F64, generator=generator)


# --- paths -----------------------------------------------------------------------------------------------------------


def test_a_path_is_the_cubic_hermite_spline_with_backward_differences() -> None:
    t, u = knots()
    slopes = np.concatenate([np.zeros((1, 2)), np.diff(u.numpy(), axis=0) / np.diff(t.numpy())[:, None]])
    spline = CubicHermiteSpline(t.numpy(), u.numpy(), slopes)
    times = torch.linspace(float(t[0]), float(t[-1]), 501, dtype=F64)
    path = HermitePath(t, u)
    assert np.abs(path.value(times).numpy() - spline(times.numpy())).max() < EXACT
    assert np.abs(path.derivative(times).numpy() - spline(times.numpy(), 1)).max() < 10 * EXACT


def test_a_path_passes_through_its_knots_and_begins_level() -> None:
    t, u = knots(batch=(3, 2))
    path = HermitePath(t, u)
    assert (path.value(t) - u).abs().max() < EXACT
    assert (path.derivative(t)[..., 0, :] == 0).all()


def test_one_time_and_many_times_agree_for_any_batch() -> None:
    t, u = knots(batch=(3,))
    path, times = HermitePath(t, u), torch.tensor([0.0, 2.2, 5.0, 99.0], dtype=F64)
    for index, time in enumerate(times):
        assert path.value(time).shape == (3, 2)
        assert torch.equal(path.value(time), path.value(times)[:, index])
        assert torch.equal(path.derivative(time), path.derivative(times)[:, index])


@pytest.mark.parametrize("i", range(10))
def test_a_path_is_causal(i: int) -> None:
    """Changing sample i + 2 and later changes no value up to t_{i+1}; the slope at t_i knows samples up to i alone."""
    t, u = knots()
    later, next_one = u.clone(), u.clone()
    later[i + 2 :] += 100.0
    next_one[i + 1 :] += 100.0
    before = torch.linspace(float(t[0]), float(t[i + 1]), 201, dtype=F64)
    assert torch.equal(HermitePath(t, u).value(before), HermitePath(t, later).value(before))
    assert not torch.equal(HermitePath(t, u).value(t[i + 1] + 0.1), HermitePath(t, later).value(t[i + 1] + 0.1))
    assert torch.equal(HermitePath(t, u).derivative(t[i]), HermitePath(t, next_one).derivative(t[i]))


def test_a_path_goes_on_straight_past_its_last_knot_and_stays_before_its_first() -> None:
    t, u = knots()
    path = HermitePath(t, u)
    slope = (u[-1] - u[-2]) / (t[-1] - t[-2])
    assert (path.value(t[-1] + 0.7) - (u[-1] + 0.7 * slope)).abs().max() < EXACT
    assert (path.derivative(t[-1] + 0.7) - slope).abs().max() < EXACT
    assert (path.value(t[0] - 0.7) - u[0]).abs().max() < EXACT


def test_integer_knots_are_an_index_used_as_time() -> None:
    _, u = knots()
    path = HermitePath(torch.arange(12), u)
    assert torch.equal(
        path.value(torch.tensor(3.25)), HermitePath(torch.arange(12, dtype=F64), u).value(torch.tensor(3.25, dtype=F64))
    )


def test_gradients_flow_from_a_path_to_its_samples() -> None:
    t, u = knots(n=5)
    times = torch.linspace(float(t[0]), float(t[-1]) + 0.2, 7, dtype=F64)
    assert torch.autograd.gradcheck(lambda v: HermitePath(t, v).value(times), (u.requires_grad_(True),))


@given(st.integers(0, 2**31), st.floats(-2.0, 2.0), st.floats(-3.0, 3.0))
@settings(max_examples=30)
def test_a_straight_line_is_reproduced_from_the_second_knot_on(seed: int, slope: float, start: float) -> None:
    t, _ = knots(seed=seed)
    path = HermitePath(t, (start + slope * t)[:, None])
    times = torch.linspace(float(t[1]), float(t[-1]) + 1.0, 50, dtype=F64)
    assert (path.value(times)[:, 0] - (start + slope * times)).abs().max() < 1e-10


@pytest.mark.parametrize("times", [[0.0], [0.0, 1.0, 1.0], [0.0, 2.0, 1.0]])
def test_knots_that_do_not_increase_are_refused(times: list[float]) -> None:
    with pytest.raises(DataError, match="strictly increasing"):
        HermitePath(torch.tensor(times, dtype=F64), torch.zeros(len(times), 1, dtype=F64))


# --- rotations with a known answer -------------------------------------------------------------------------------------


class ConstantRate(nn.Module):
    """omega = A omega_0: a parameter to differentiate by; one state that integrates the first body axis in the world."""

    def __init__(self, rate: Tensor) -> None:
        super().__init__()
        self.rate, self.A = rate, nn.Parameter(torch.eye(3, dtype=rate.dtype))

    def forward(self, t: Tensor, R_wb: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        return (self.rate @ self.A.mT).expand(*state.shape[:-1], 3), R_wb[..., 0]


class Coning(nn.Module):
    """R = Exp(spin t z) Exp(tilt e), e = (cos, sin, 0)(wobble t): a spinning body whose axis is tilted towards e.

    Its body rate by hand, e' being e turned by a right angle: the spin seen from the tilted body is
    spin (cos(tilt) z + sin(tilt) e'), the tilting gives wobble (sin(tilt) e' - (1 - cos(tilt)) z).
    """

    spin, wobble = 0.7, 1.1

    def __init__(self, tilt: float = 0.8) -> None:
        super().__init__()
        self.tilt = nn.Parameter(torch.tensor(tilt, dtype=F64))

    def answer(self, t: Tensor) -> Tensor:
        zero = torch.zeros_like(t)
        axis = torch.stack([torch.cos(self.wobble * t), torch.sin(self.wobble * t), zero], dim=-1)
        return so3.exp(torch.stack([zero, zero, self.spin * t], dim=-1)) @ so3.exp(self.tilt * axis)

    def rate(self, t: Tensor) -> Tensor:
        across = (self.spin + self.wobble) * torch.sin(self.tilt)
        along = self.spin * torch.cos(self.tilt) - self.wobble * (1 - torch.cos(self.tilt)) + 0 * t
        return torch.stack([-across * torch.sin(self.wobble * t), across * torch.cos(self.wobble * t), along], dim=-1)

    def forward(self, t: Tensor, R_wb: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        return self.rate(t).expand(*state.shape[:-1], 3), -state + t


def constant_answer(rate: Tensor, t: Tensor) -> Tensor:
    return so3.exp(t[:, None] * rate)


def test_the_coning_rate_is_that_of_the_coning_rotation() -> None:
    field, t, h = Coning(), torch.linspace(0, 5, 7, dtype=F64), 1e-5
    with torch.no_grad():
        measured = so3.log(field.answer(t - h).mT @ field.answer(t + h)) / (2 * h)
        assert (measured - field.rate(t)).abs().max() < 1e-8  # h²


@pytest.mark.parametrize("method", ["euler", "rk4", "dopri5"])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 5e-4), (F64, EXACT)])
def test_a_constant_rate_over_many_turns_is_exact_for_every_method(method: str, dtype: torch.dtype, tolerance: float) -> None:
    """The chart turns a constant rate into a constant vector, which Euler integrates exactly; 3.2 turns, 6 charts.

    In float32 the outputs of dopri5 pass through its interpolant: a few roundings each, 100 times."""
    rate = torch.tensor([1.0, -2.0, 3.3], dtype=dtype)
    t = torch.linspace(0, 5, 101, dtype=F64)
    with torch.no_grad():
        R, _ = integrate(ConstantRate(rate), torch.zeros(3, dtype=dtype), t, torch.eye(3, dtype=dtype), method=method)
    assert R.dtype == dtype
    assert (R.double() - constant_answer(rate.double(), t)).abs().max() < tolerance


@pytest.mark.parametrize(("method", "order"), [("euler", 1), ("rk4", 4)])
def test_fixed_step_methods_converge_at_their_order_through_chart_changes(method: str, order: int) -> None:
    field, errors = Coning(), []
    for n in (40, 80):
        t = torch.linspace(0, 4, n + 1, dtype=F64)
        with torch.no_grad():
            R, state = integrate(field, torch.ones(1, dtype=F64), t, field.answer(t[:1])[0], method=method, max_angle=1.0)
            exact = t - 1 + 2 * torch.exp(-t)
            errors.append((float((R - field.answer(t)).abs().max()), float((state[:, 0] - exact).abs().max())))
    for rotation_or_state in zip(*errors, strict=True):
        measured = np.log2(np.array(rotation_or_state[:-1]) / np.array(rotation_or_state[1:]))
        assert abs(measured[-1] - order) < ORDER_TOLERANCE, (method, measured)


@pytest.mark.parametrize("tolerance", [1e-5, 1e-10])
def test_dopri5_meets_its_tolerance(tolerance: float) -> None:
    field, t = Coning(), torch.linspace(0, 5, 21, dtype=F64)
    with torch.no_grad():
        R, _ = integrate(
            field, torch.ones(1, dtype=F64), t, field.answer(t[:1])[0], method="dopri5", rtol=tolerance, atol=tolerance
        )
        assert (R - field.answer(t)).abs().max() < 10 * tolerance  # 20 intervals, each of which may use up the tolerance


def test_states_follow_the_rotation_they_depend_on() -> None:
    """The first body axis under a turn about z integrates to (sin, 1 - cos) / rate."""
    rate, t = torch.tensor([0.0, 0.0, 2.0], dtype=F64), torch.linspace(0, 4.5, 91, dtype=F64)
    with torch.no_grad():
        _, state = integrate(ConstantRate(rate), torch.zeros(3, dtype=F64), t, EYE, method="rk4")
    exact = torch.stack([torch.sin(2 * t) / 2, (1 - torch.cos(2 * t)) / 2, torch.zeros_like(t)], dim=1)
    assert (state - exact).abs().max() < 1e-6  # (2 * 0.05)^4 / 2880 a step, 90 steps


def test_elements_of_a_batch_change_charts_at_their_own_times_and_without_disturbing_each_other() -> None:
    rates = torch.tensor([[0.0, 0.0, 0.3], [0.0, 2.0, 0.0], [3.0, 0.0, 1.0], [-1.0, 1.0, 1.0]], dtype=F64)

    class Batch(nn.Module):
        def __init__(self, rate: Tensor) -> None:
            super().__init__()
            self.rate = rate

        def forward(self, t: Tensor, R_wb: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
            return self.rate * (1 + 0.3 * torch.sin(t)), R_wb[..., 0]

    t = torch.linspace(0, 6, 61, dtype=F64)
    with torch.no_grad():
        R, state = integrate(Batch(rates), torch.zeros(4, 3, dtype=F64), t, EYE.expand(4, 3, 3), method="rk4")
        turned = t + 0.3 * (1 - torch.cos(t))
        for element, rate in enumerate(rates):
            assert (R[:, element] - so3.exp(turned[:, None] * rate)).abs().max() < 1e-6
            alone_R, alone_state = integrate(Batch(rate), torch.zeros(3, dtype=F64), t, EYE, method="rk4")
            assert (alone_R - R[:, element]).abs().max() < EXACT
            assert (alone_state - state[:, element]).abs().max() < EXACT


def test_where_the_chart_changes_does_not_matter_to_a_converged_answer() -> None:
    field, t = Coning(), torch.linspace(0, 3, 76, dtype=F64)
    with torch.no_grad():
        often, _ = integrate(field, torch.ones(1, dtype=F64), t, EYE, method="rk4", max_angle=0.2)
        seldom, _ = integrate(field, torch.ones(1, dtype=F64), t, EYE, method="rk4", max_angle=5.0)
    assert (often - seldom).abs().max() < 1e-6  # (0.04 s x 1.5 rad/s)^4 / 120 a step, 75 steps


def test_float32_states_meet_float64_times_a_day_into_a_log() -> None:
    """Samples 5 ms apart at t = 86 400 s: in float32 seconds they would all be one time."""
    t = 86_400.0 + 0.005 * torch.arange(201, dtype=F64)
    u = torch.sin(3 * (t - t[0]))[:, None] * torch.tensor([1.0, 0.0, 0.0], dtype=F64)
    path = HermitePath(t, u.float())

    def field(t: Tensor, R_wb: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        assert t.dtype == F64
        return path.value(t), torch.zeros_like(state)

    R, _ = integrate(field, torch.zeros(0), t, torch.eye(3), method="rk4")
    angle = (1 - math.cos(3 * 1.0)) / 3
    assert abs(float(so3.log(R[-1])[0]) - angle) < 1e-4  # the spline lags its samples by O(dt²)


# --- gradients ---------------------------------------------------------------------------------------------------------


def gradients(
    field: nn.Module, method: str, *, n: int, adjoint: bool = False, max_angle: float = 1.5, span: float = 2.0
) -> list[Tensor]:
    """Of a scalar of everything that comes back, by the field's parameters, the start rotation and the start state."""
    generator = torch.Generator().manual_seed(7)
    t = torch.linspace(0, span, n + 1, dtype=F64)
    start = torch.tensor([0.1, 0.2, -0.3], dtype=F64, requires_grad=True)
    state0 = torch.ones(3, dtype=F64, requires_grad=True)
    R, state = integrate(
        field, state0, t, so3.exp(start), method=method, adjoint=adjoint, max_angle=max_angle, rtol=1e-10, atol=1e-10
    )
    at = slice(None, None, max(1, n // 4))
    R, state = R[at], state[at]
    weights = torch.randn(R.shape, dtype=F64, generator=generator), torch.randn(state.shape, dtype=F64, generator=generator)
    loss = (R * weights[0]).sum() + (state**2 * weights[1]).sum()
    return list(torch.autograd.grad(loss, [*field.parameters(), start, state0]))


def assert_close(got: list[Tensor], expected: list[Tensor], tolerance: float) -> None:
    for a, b in zip(got, expected, strict=True):
        assert (a - b).abs().max() <= tolerance * (1 + b.abs().max()), (a, b)


FIELDS = [lambda: ConstantRate(torch.tensor([0.5, -0.9, 0.8], dtype=F64)), Coning]


@pytest.mark.parametrize("make", FIELDS)
def test_a_chart_change_leaves_the_gradient_as_it_is(make: Callable[[], nn.Module]) -> None:
    """Up to 1.1 pi one chart is enough; the same with the chart changed at pi (the constant rate only) and at 0.5."""
    one_chart = gradients(make(), "rk4", n=39, max_angle=6.2, span=2.6)
    for max_angle in (math.pi, 0.5):
        assert_close(gradients(make(), "rk4", n=39, max_angle=max_angle, span=2.6), one_chart, GRADIENT_TOLERANCE)


@pytest.mark.parametrize("make", FIELDS)
@pytest.mark.parametrize(("method", "n"), [("rk4", 30), ("dopri5", 4)])
def test_the_adjoint_gives_the_gradient_of_backpropagation(make: Callable[[], nn.Module], method: str, n: int) -> None:
    expected = gradients(make(), method, n=n)
    assert_close(gradients(make(), method, n=n, adjoint=True), expected, GRADIENT_TOLERANCE)


def test_the_adjoint_of_euler_comes_closer_to_backpropagation_with_the_step() -> None:
    make, gaps = FIELDS[0], []
    for n in (20, 40):
        exact, adjoint = gradients(make(), "euler", n=n), gradients(make(), "euler", n=n, adjoint=True)
        gaps.append(max(float((a - b).abs().max()) for a, b in zip(adjoint, exact, strict=True)))
    assert abs(math.log2(gaps[0] / gaps[1]) - 1) < ORDER_TOLERANCE


def test_the_gradient_is_the_derivative() -> None:
    rate, t = torch.tensor([0.5, -0.9, 0.8], dtype=F64), torch.linspace(0, 2, 4, dtype=F64)

    def last(A: Tensor) -> Tensor:
        def field(t: Tensor, R_wb: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
            return A @ rate * (1 + t), R_wb[..., 1]

        R, state = integrate(field, torch.zeros(3, dtype=F64), t, EYE, method="rk4", max_angle=1.0)
        return torch.cat([R[-1].flatten(), state[-1]])

    assert torch.autograd.gradcheck(last, (EYE.clone().requires_grad_(True),))


def test_the_adjoint_reaches_tensors_it_is_told_of() -> None:
    t = torch.linspace(0, 2.5, 26, dtype=F64)
    results = []
    for adjoint in (False, True):
        u = torch.tensor([0.5, -0.9, 0.8], dtype=F64, requires_grad=True)

        def field(t: Tensor, R_wb: Tensor, state: Tensor, u: Tensor = u) -> tuple[Tensor, Tensor]:
            return u * (1 + t), R_wb[..., 0]

        R, state = integrate(field, torch.zeros(3, dtype=F64), t, EYE, method="rk4", adjoint=adjoint, parameters=[u])
        results.append(list(torch.autograd.grad(R[-1].sum() + state[-1].sum(), u)))
    assert_close(results[1], results[0], 1e-4)  # rk4 at a tenth of a second and up to 5 rad/s


# --- leaving the meaningful range ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["euler", "rk4", "dopri5"])
def test_a_full_turn_within_one_step_is_refused(method: str) -> None:
    rate, t = torch.tensor([0.0, 0.0, 100.0], dtype=F64), torch.linspace(0, 1, 11, dtype=F64)
    with pytest.raises(NumericsError, match="Reduce the step"):
        integrate(ConstantRate(rate), torch.zeros(3, dtype=F64), t, EYE, method=method)


@pytest.mark.parametrize("method", ["euler", "rk4", "dopri5"])
def test_a_state_that_blows_up_is_refused(method: str) -> None:
    def field(t: Tensor, R_wb: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        return torch.zeros(3, dtype=F64), state**2  # reaches infinity at t = 1

    with pytest.raises(NumericsError, match="Reduce the step"):
        integrate(field, torch.ones(1, dtype=F64), torch.linspace(0, 40, 401, dtype=F64), EYE, method=method)


def test_an_unfinished_stretch_past_a_chart_change_does_not_condemn_what_came_before() -> None:
    """A fixed-step stretch is solved past the change before it is cut there; what it did there must not count."""
    rate, t = torch.tensor([0.0, 0.0, 8.0], dtype=F64), torch.linspace(0, 6, 25, dtype=F64)  # 2 rad a step
    R, _ = integrate(ConstantRate(rate), torch.zeros(3, dtype=F64), t, EYE, method="euler")
    assert (R - constant_answer(rate, t)).abs().max() < EXACT
