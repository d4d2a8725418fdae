"""The neural ODE's answer belongs to the equation, not to the step, the solver or the way its gradients are found."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import scipy.special
import torch
from torch import Tensor, nn

from imutool.bias.networks.network import BiasNetwork, Segment
from imutool.bias.networks.neural_ode import Curve, Drift, Network
from imutool.bias.networks.ode import HermitePath, integrate
from imutool.bias.neural_ode import DRIFT_FILTER_S, NEAR_ZERO, SLOW_S, Config
from imutool.bias.neural_stream import Curves, CurveWeights, erf
from imutool.geometry import so3
from imutool.inertial.windows import attitudes
from imutool.recording import seconds
from imutool.sensor.made_up_flight import flight
from imutool.units import COLUMNS, SENSORS, Sensor

RATE_HZ = 200.0
SECONDS = 12.0
# Euler holds its rate for a step and is late by half of it, so the path moves in proportion to the step. The drift sees the
# samples through a filter of half a second whatever the step; in flight, whose motion changes within a third of one, a quarter
# second is then good to a twentieth of the drift's own size, and the drift is there to take away a hundredth of a bias.
SHARE = 0.06  # between a step and its half; to no step at all it is twice as far
SAME_CURVE = 1e-13  # rad/s, m/s²: sums of 16 terms in another order
ORDER = 0.3  # design.md: measured order of convergence within 0.3 of theory
MIN = {"gyro": 5e-4, "accel": 5e-3}  # rad/s, m/s²: the drift over 12 s with these weights, else there is nothing to compare
MakeModel, MakeSegment = Callable[..., BiasNetwork], Callable[..., Segment]


def lively(build: MakeModel, **settings: object) -> Network:
    """A drift as strong as training may make it, and motion it answers to."""
    model = build("neural_ode", 3, **{"drift": ("gyro", "accel"), **settings})
    assert isinstance(model, Network)
    generator = torch.Generator().manual_seed(11)
    for drift in model.drift.values():
        assert isinstance(drift, Drift)
        drift.out.weight.copy_(0.5 * torch.randn(3, 9, generator=generator, dtype=torch.float64))
    return model


def rest_path(model: BiasNetwork, seen: Segment) -> dict[str, Tensor]:
    """beta(t) - beta(0), what the drift alone adds."""
    out = {}
    for sensor in ("gyro", "accel"):
        u, rest = seen.of(sensor)
        assert isinstance(model, Network)
        motion = model.curve[sensor](u, model._filtered(u, SLOW_S))
        out[sensor] = model.sensor_bias(sensor, seen) - motion - rest[:, None]
    return out


def largest(path: Tensor) -> float:
    return float(path.norm(dim=-1).max())


@pytest.fixture(scope="module")
def seen() -> Segment:
    """Two flights."""
    imus = [flight(seed, duration_s=SECONDS, still_s=0.0).imu for seed in (1, 2)]
    t = torch.from_numpy(seconds(imus[0].t_ns, int(imus[0].t_ns[0]))).expand(2, -1)
    gyro, accel = (torch.from_numpy(np.stack([getattr(imu, name) for imu in imus])) for name in ("gyro", "accel"))
    rest = torch.tensor([[0.01, 0.02, -0.01, 0.1, -0.1, 0.05], [0.0] * 6], dtype=torch.float64)
    return Segment(t.contiguous(), gyro, accel, rest)


@pytest.fixture(scope="module")
def reference(build: MakeModel, seen: Segment) -> dict[str, Tensor]:
    path = rest_path(lively(build), seen)
    for sensor, minimum in MIN.items():
        assert largest(path[sensor]) > minimum, sensor
    return path


def test_at_half_the_step_the_drift_is_the_same_and_what_is_left_halves(
    build: MakeModel, seen: Segment, reference: dict[str, Tensor]
) -> None:
    paths = [reference, *(rest_path(lively(build, drift_step_s=step_s), seen) for step_s in (0.125, 0.0625, 0.03125))]
    for sensor in MIN:
        apart = [a[sensor] - b[sensor] for a, b in pairwise(paths)]
        assert largest(apart[0]) < SHARE * largest(reference[sensor]), sensor
        left = [float(change.square().mean().sqrt()) for change in apart]  # the largest of 4800 is too noisy for an order
        order = np.log2(np.divide(left[:-1], left[1:]))
        assert np.abs(order - 1.0).max() < ORDER, sensor


def test_with_another_solver_the_drift_is_the_same(build: MakeModel, seen: Segment, reference: dict[str, Tensor]) -> None:
    """And rk4 and dopri5 agree closer: the path has a kink at every knot, on which rk4 stops and dopri5 does not."""
    rk4, dopri5 = (rest_path(lively(build, solver=solver), seen) for solver in ("rk4", "dopri5"))
    for sensor in MIN:
        size = largest(reference[sensor])
        assert largest(rk4[sensor] - reference[sensor]) < 2 * SHARE * size, sensor
        assert largest(dopri5[sensor] - reference[sensor]) < 2 * SHARE * size, sensor
        assert largest(rk4[sensor] - dopri5[sensor]) < 0.01 * size, sensor


def test_the_curve_needs_no_solver(build: MakeModel, seen: Segment) -> None:
    """Without drift, step and solver are nowhere in the answer."""
    answers = [build("neural_ode", 3, drift=(), solver=s, drift_step_s=h)(seen) for s, h in (("euler", 0.25), ("rk4", 1.0))]
    assert torch.equal(*answers)


def gradients(build: MakeModel, seen: Segment, sensor: Sensor, *, adjoint: bool, solver: str) -> dict[str, Tensor]:
    model = lively(build, adjoint=adjoint, solver=solver).requires_grad_(True)
    rest = seen.rest.clone().requires_grad_(True)
    bias = model.sensor_bias(sensor, Segment(seen.t, seen.gyro, seen.accel, rest))
    weight = torch.randn(bias.shape, generator=torch.Generator().manual_seed(5), dtype=bias.dtype)
    (bias * weight).sum().backward()
    named = {name: value.grad for name, value in model.named_parameters() if f".{sensor}." in name} | {"rest": rest.grad}
    return {name: value for name, value in named.items() if value is not None}


@pytest.mark.parametrize(
    ("solver", "sensor", "tolerance"), [("rk4", "gyro", 1e-3), ("rk4", "accel", 1e-3), ("dopri5", "gyro", 0.05)]
)
def test_the_adjoints_gradients_are_those_of_backpropagation(
    build: MakeModel, segment: MakeSegment, solver: str, sensor: Sensor, tolerance: float
) -> None:
    """As close as the solver is converged: the adjoint solves the continuous equation, backpropagation the discrete one.

    rk4 from knot to knot meets no kink and is within 1e-4; dopri5 steps over kinks, as in the test above.
    """
    seen = segment(22, 1, 101)
    plain, adjoint = (gradients(build, seen, sensor, adjoint=a, solver=solver) for a in (False, True))
    assert plain.keys() == adjoint.keys()
    assert sum(name.startswith("drift") for name in plain) == (12 if sensor == "gyro" else 14), "not every weight is reached"
    for name, value in plain.items():
        assert float(value.norm()) > 0, name
        assert float((adjoint[name] - value).norm()) <= tolerance * float(value.norm()), name


def weights_of(curve: Curve) -> CurveWeights:
    """What a model takes from its file."""
    W, *layers = (value.detach().numpy() for value in curve.parameters())
    first, second, last = (layers[0], layers[1]), (layers[2], layers[3]), layers[4]
    return CurveWeights(W, (first, second, last), curve.scale, NEAR_ZERO, curve.curve)


@pytest.mark.parametrize("scale", [0.05, 0.5, 5.0])
def test_the_curve_of_no_motion_is_exactly_zero(scale: float) -> None:
    torch.manual_seed(4)
    curve = Curve(64, 0.5, 0.02).double()
    with torch.no_grad():
        for value in curve.parameters():
            value.add_(scale * torch.randn(value.shape, dtype=value.dtype))
        still = torch.zeros(3, dtype=torch.float64)
        assert torch.equal(curve(still, still), still)
        at_work = Curves(weights_of(curve), weights_of(curve))
        for n in (1, 7, 63, 64, 65, 1000):  # a matrix product sums in another order: one rounding of N(0)
            zeros = torch.zeros(n, 3, dtype=torch.float64)
            left = max(curve(zeros, zeros).abs().max().item(), np.abs(at_work(np.zeros((n, 6)), np.zeros((n, 6)))).max())
            assert left <= curve.curve * 64 * 1e-16 * (1.0 + scale)
        alone = np.abs(at_work.one(np.zeros(6), np.zeros(6), 3.0)).max()
        assert alone <= curve.curve * 64 * 1e-16 * (1.0 + scale)


def test_the_error_function_is_scipys() -> None:
    x = np.concatenate([np.linspace(-9.0, 9.0, 200_001), 10.0 ** np.arange(-300.0, 1.0, 7.0)])
    assert np.abs(erf(x) - scipy.special.erf(x)).max() < 4e-16  # two units in the last place of 1
    assert erf(np.array([0.0, 6.0, 8.0, -8.0])).tolist() == [0.0, 1.0, 1.0, -1.0]


@pytest.mark.parametrize("bent", [True, False])
def test_the_curves_at_work_are_the_curves(bent: bool) -> None:
    """Of both sensors, in blocks of any size, and of one sample with a line of the rest bias on top."""
    torch.manual_seed(5)
    both = [Curve(16, scale, size).double() for scale, size in ((0.2, 0.02), (10.0, 0.2))]
    u, slow = 3.0 * torch.randn(2, 130, 6, dtype=torch.float64)
    with torch.no_grad():
        for curve in both:
            for value in curve.parameters():
                value.add_(0.3 * torch.randn(value.shape, dtype=value.dtype))
            curve.net[4].weight.mul_(float(bent))
        halves = (slice(0, 3), slice(3, 6))
        expected = torch.cat([c(u[:, half], slow[:, half]) for c, half in zip(both, halves, strict=True)], dim=1).numpy()
    at_work = Curves(weights_of(both[0]), weights_of(both[1]))
    rest, slope = np.arange(6.0), 0.1 * np.arange(6.0)
    for n in (1, 2, 63, 64, 65, 130):
        np.testing.assert_allclose(at_work(u[:n].numpy(), slow[:n].numpy()), expected[:n], rtol=0, atol=SAME_CURVE)
    at_work.add_line(rest, slope)
    for k in range(130):
        one = at_work.one(u[k].numpy(), slow[k].numpy(), 0.5 * k)
        np.testing.assert_allclose(one, expected[k] + rest + 0.5 * k * slope, rtol=0, atol=SAME_CURVE)


COARSE = 1e-6  # of the curve's size: some roundings of float32


def test_a_training_computes_the_curve_in_float32(build: MakeModel, seen: Segment) -> None:
    model = build("neural_ode", 3)
    assert isinstance(model, Network)
    model.see(seen.gyro[0], seen.accel[0])
    for sensor in SENSORS:
        coarse, curve = model.motion_bias(sensor, seen), model.curve.get_submodule(sensor)
        assert isinstance(curve, Curve)
        curve.precision = torch.float64
        exact = model.motion_bias(sensor, seen)
        assert coarse.dtype == torch.float64
        assert 0.0 < largest(coarse - exact) <= COARSE * largest(exact)
        assert not coarse.requires_grad, "the curve is solved for, not descended on"


def test_with_units_kept_of_many_the_seed_hardly_decides_which_curves_are_likely() -> None:
    u = torch.tensor([0.05, 0.05, 0.5]) * torch.randn(2_000, 3, generator=torch.Generator().manual_seed(0)).double()
    scatter = []
    for kept in (False, True):
        covariances = []
        for seed in (4, 5, 6):
            torch.manual_seed(seed)
            model = Network(Config(), RATE_HZ).double()
            if kept:
                model.see(u, u)
            curve = model.curve.get_submodule("gyro")
            assert isinstance(curve, Curve)
            root = curve.hidden(u[::10], u[::10]).double() @ curve.prior_root
            covariances.append(root @ root.mT)
        of_seeds = torch.stack(covariances)
        scatter.append(float(of_seeds.std(0).norm() / of_seeds.mean(0).norm()))
    assert scatter[1] < 0.6 * scatter[0], scatter


def test_units_of_a_sensor_that_does_not_move_are_kept_without_a_number_that_is_none() -> None:
    model = Network(Config(curve_width=8), RATE_HZ).double()
    model.see(torch.zeros(50, 3).double(), torch.zeros(50, 3).double())
    assert all(bool(value.isfinite().all()) for value in model.state_dict().values())


def test_an_untrained_model_adds_nothing(seen: Segment) -> None:
    """The networks begin at zero, so a descent begins at the closed form."""
    torch.manual_seed(0)
    with torch.no_grad():
        assert torch.equal(Network(Config(), RATE_HZ).double()(seen), seen.rest[:, None].expand(2, seen.t.shape[1], 6))


def test_taking_over_a_calibration_makes_it_the_linear_model(build: MakeModel, seen: Segment) -> None:
    W = torch.randn(3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    torch.manual_seed(0)
    model, linear = Network(Config(), RATE_HZ).double(), build("linear")
    for one in (model, linear):
        one.begin_at("gyro", 0.01 * W)
        one.begin_at("accel", 0.02 * W)
    with torch.no_grad():
        torch.testing.assert_close(model(seen), linear(seen), rtol=0, atol=1e-15)


def test_the_stream_goes_by_real_stamps(build: MakeModel, segment: MakeSegment) -> None:
    """A clock that jitters: the forward pass takes its mean step, the stream each step as it is.

    A step of the drift is then wrong by up to jitter / step of itself, and so is what it has added up to.
    """
    seen, jitter_s = segment(23, 1, 2001), 1e-3
    jitter = jitter_s * (torch.rand(1, 2001, generator=torch.Generator().manual_seed(2), dtype=torch.float64) - 0.5)
    t = seen.t + jitter - jitter[:, :1]
    model = lively(build)
    jittered = Segment(t, seen.gyro, seen.accel, seen.rest)
    streamed = model.frozen().stream(seen.rest[0].numpy())(t[0].numpy(), seen.gyro[0].numpy(), seen.accel[0].numpy())
    for sensor, columns in COLUMNS.items():
        apart = np.abs(streamed[:, columns] - model(jittered)[0, :, columns].numpy()).max()
        assert 0 < apart < 2 * jitter_s / model.config.drift_step_s * largest(rest_path(model, seen)[sensor]), sensor


def test_the_rest_dynamics_are_the_derivative_of_the_drift(build: MakeModel) -> None:
    model = lively(build).frozen()
    F, still, step = model.rest_dynamics(), np.zeros(3), 1e-6
    for sensor, columns in COLUMNS.items():
        ends = [
            [model.drift(sensor)(model.prior_mean[columns] + d, still, still) for d in s * step * np.eye(3)] for s in (1, -1)
        ]
        expected = (np.subtract(*ends) / (2.0 * step)).T
        assert np.abs(expected).max() > 1e-6
        np.testing.assert_allclose(F[columns, columns], expected, rtol=1e-5, atol=1e-9)


# ── the paper's joint equation ───────────────────────────────────────────────────────────────────────────────────────


class Joint(nn.Module):
    """dR/dt = R [gyro - b]x, db/dt = dC/dt + g(b - C(u, s), v, dv/dt): the paper's eq. 10 and 15 as they stand.

    dC/dt = (dC/du) du/dt + (dC/ds) ds/dt. The samples u and what the curve's filter makes of them, s, are causal Hermite paths;
    what the drift's filter makes of them, v, is another, through the grid's knots, whose time is the grid's index.
    """

    def __init__(self, model: Network, t: Tensor, gyro: Tensor) -> None:
        super().__init__()
        curve, drift = model.curve["gyro"], model.drift["gyro"]
        assert isinstance(curve, Curve)
        assert isinstance(drift, Drift)
        self.curve, self.drift, self.samples = curve, drift, HermitePath(t, gyro)
        self.slow = HermitePath(t, model._filtered(gyro[None], SLOW_S)[0])
        seen = model._filtered(gyro[None], DRIFT_FILTER_S)[0, :: model.stride]
        self.step_s = float(t[model.stride] - t[0])
        self.seen = HermitePath(torch.arange(len(seen)), seen)

    def forward(self, t: Tensor, R_wb: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        u, du = self.samples.value(t), self.samples.derivative(t)
        s, ds = self.slow.value(t), self.slow.derivative(t)
        motion, rise = torch.autograd.functional.jvp(self.curve, (u, s), (du, ds))  # rise = dC/dt
        index = t / self.step_s
        slow = self.drift((b - motion)[None], self.seen.value(index)[None], self.seen.derivative(index)[None] / self.step_s)
        return u - b, rise + slow[0]


def at_a_high_rate(n: int, **settings: object) -> tuple[Network, Tensor, Tensor]:
    """A model at 1 kHz, and the samples of a turning body."""
    torch.manual_seed(3)
    model = Network(Config(**settings), HIGH_RATE_HZ).double().requires_grad_(False).eval()  # type: ignore[arg-type]
    generator = torch.Generator().manual_seed(12)
    for value in model.parameters():
        value.add_(0.05 * torch.randn(value.shape, generator=generator, dtype=value.dtype))
    t = torch.arange(n, dtype=torch.float64) / HIGH_RATE_HZ
    gyro = torch.stack([torch.sin(4.0 * t), torch.cos(7.0 * t), 0.5 * torch.sin(2.0 * t + 1.0)], dim=1)
    return model, t, gyro


HIGH_RATE_HZ = 1000.0
TIGHT: dict[str, Any] = {
    "method": "dopri5",
    "rtol": 1e-9,
    "atol": 1e-12,
}  # the curve bends within a sample, where a rate is zero
# The fast path leaves out |d²omega/dt²| dt² / 12, and as much again for the axis that turns: 50 * 1e-6 / 6 per second.
FAST_PATH_RAD_S = 1e-5


def test_without_drift_the_joint_equation_and_the_fast_path_are_one(build: MakeModel) -> None:
    n = 61
    model, t, gyro = at_a_high_rate(n, drift_step_s=0.02, gyro_drift_rad_s2=1e-30)
    curve = model.curve["gyro"]
    assert isinstance(curve, Curve)
    R_0 = torch.eye(3, dtype=torch.float64)
    R_joint, b_joint = integrate(Joint(model, t, gyro), curve(gyro[0], gyro[0]), t, R_0, **TIGHT)
    bias = torch.from_numpy(model.frozen().stream(np.zeros(6))(t.numpy(), gyro.numpy(), np.zeros((n, 3)))[:, :3])
    torch.testing.assert_close(b_joint, bias, rtol=0, atol=1e-9)  # the total derivative of C integrates to C
    R_split = attitudes(R_0[None], (gyro - bias)[None], torch.diff(t)[None])[0]
    assert so3.log(R_joint.mT @ R_split).norm(dim=1).max() < FAST_PATH_RAD_S * float(t[-1])


def test_the_papers_joint_equation_and_the_split_form_are_one_flow(build: MakeModel) -> None:
    """dopri5 on (R, b) together, on the Hermite path of the samples, against the split form at the knots of its drift.

    With rk4 for the drift the two solve the same equation and agree to a thousandth of what the drift does; the stream's
    Euler rule is late by no more than two steps: it holds its rate for one, and du/dt is that of the one before.
    """
    n, rest = 121, np.array([0.02, -0.01, 0.03, 0.0, 0.0, 0.0])
    model, t, gyro = at_a_high_rate(n, drift_step_s=0.02, solver="rk4", gyro_drift_rad_s2=0.1)  # 0.12 s of it must be seen
    curve = model.curve["gyro"]
    assert isinstance(curve, Curve)
    R_0, beta_0 = torch.eye(3, dtype=torch.float64), torch.from_numpy(rest[:3])
    R_joint, b_joint = integrate(Joint(model, t, gyro), beta_0 + curve(gyro[0], gyro[0]), t, R_0, **TIGHT)

    segment = Segment(t[None], gyro[None], torch.zeros(1, n, 3, dtype=torch.float64), torch.from_numpy(rest)[None])
    split = model.sensor_bias("gyro", segment)[0]
    motion = curve(gyro, model._filtered(gyro[None], SLOW_S)[0])
    drifted = float((split - motion - beta_0).norm(dim=1).max())
    assert drifted > 1e-3, "the drift must be part of the comparison"
    knots = slice(None, -model.stride, model.stride)  # in its last step the split form does not know the next knot
    assert (b_joint - split)[knots].norm(dim=1).max() < 1e-3 * drifted

    streamed = torch.from_numpy(model.frozen().stream(rest)(t.numpy(), gyro.numpy(), np.zeros((n, 3)))[:, :3])
    apart = float((b_joint - streamed).norm(dim=1).max())
    fastest = float(torch.diff(split - motion, dim=0).norm(dim=1).max()) * HIGH_RATE_HZ
    assert apart < 2 * fastest * model.config.drift_step_s
    R_stream = attitudes(R_0[None], (gyro - streamed)[None], torch.diff(t)[None])[0]
    turned = so3.log(R_joint.mT @ R_stream).norm(dim=1).max()
    assert turned < (FAST_PATH_RAD_S + apart) * float(t[-1])
