"""The paper's scheme: one ODE of attitude and bias on SO(3), the same whichever way it is solved, and the same at work."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
import torch
from torch import Tensor

from imutool.bias import model_file
from imutool.bias.networks import ode as chart
from imutool.bias.networks.network import Segment
from imutool.bias.networks.neural_ode import PAPER_WEIGHTS, Network
from imutool.bias.networks.paper_ode import BiasOde
from imutool.bias.networks.perceptron import Drift
from imutool.bias.neural_ode import Config
from imutool.geometry import so3
from imutool.recording import seconds
from imutool.sensor.made_up_flight import flight

RATE_HZ = 200.0
STREAM = 1e-6  # rad/s and m/s²: of numpy against torch, as for every model
WEIGHTS = 0.1
LATE = 1e-2  # rad: Euler is late by half a step, 2.5 ms of a few rad/s
SENSORS: tuple[Literal["gyro", "accel"], ...] = ("gyro", "accel")


def lively() -> Network:
    """Model of the paper's scheme, with fields of some size."""
    torch.manual_seed(0)
    model = Network(Config(scheme="paper"), RATE_HZ).double().requires_grad_(False).eval()
    for value in model.parameters():
        value.mul_(WEIGHTS / PAPER_WEIGHTS)
    return model


@pytest.fixture(scope="module")
def seen() -> Segment:
    """Half a second of two flights."""
    imus = [flight(seed, duration_s=2.0, still_s=0.0).imu.rows(slice(200, 301)) for seed in (1, 2)]
    t = torch.from_numpy(seconds(imus[0].t_ns, int(imus[0].t_ns[0]))).expand(2, -1).contiguous()
    gyro, accel = (torch.from_numpy(np.stack([getattr(imu, name) for imu in imus])) for name in ("gyro", "accel"))
    rest = torch.tensor([[0.01, 0.02, -0.01, 0.1, -0.1, 0.05], [0.0] * 6], dtype=torch.float64)
    return Segment(t, gyro, accel, rest)


@pytest.fixture(scope="module")
def turned() -> Tensor:
    return so3.exp(torch.tensor([[0.1, 0.2, 0.3], [1.0, -2.0, 0.5]], dtype=torch.float64))


class Together(torch.nn.Module):
    """Equation 10 for attitude and bias, as it stands."""

    def __init__(self, drift: Drift, solved: BiasOde) -> None:
        super().__init__()
        self.drift, self.solved = drift, solved

    def forward(self, index: Tensor, R_wb: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
        u, du = self.solved.controls(index)
        return self.solved.step_s * (u - bias), self.solved.step_s * self.drift(bias, u, du)


def test_the_stream_equals_forward_in_blocks_and_one_by_one(seen: Segment) -> None:
    model = lively()
    expected = model(seen)[0].numpy()
    assert np.ptp(expected, axis=0).min() > 1e-3  # every column moves
    t, gyro, accel = (x[0].numpy() for x in (seen.t, seen.gyro, seen.accel))
    stream = model.frozen().stream(seen.rest[0].numpy())
    blocks = np.concatenate([stream(t[a:b], gyro[a:b], accel[a:b]) for a, b in ((0, 1), (1, 40), (40, 101))])
    np.testing.assert_allclose(blocks, expected, rtol=0, atol=STREAM)
    single = model.frozen().stream(seen.rest[0].numpy())
    each = [single.one(float(t[k]), np.concatenate([gyro[k], accel[k]])) for k in range(len(t))]
    np.testing.assert_allclose(each, expected, rtol=0, atol=STREAM)


def test_where_samples_are_missing_it_steps_on(seen: Segment) -> None:
    """A step of half a second at once would leave the field's valid steps, and the bias with it."""
    model = lively().frozen()
    for name in ("out.weight", "out.bias"):
        model.tensors[f"drift.gyro.{name}"] = 20.0 * model.tensors[f"drift.gyro.{name}"]
    t, gyro, accel = (x[0].numpy() for x in (seen.t, seen.gyro, seen.accel))
    whole = model.stream(np.zeros(6))(t, gyro, accel)
    kept = np.r_[0:5, 100]
    holed = model.stream(np.zeros(6))(t[kept], gyro[kept], accel[kept])
    assert np.abs(holed[-1]).max() < 2 * np.abs(whole).max()


def test_eulers_fast_steps_are_those_of_the_joint_equation(seen: Segment, turned: Tensor) -> None:
    model = lively().requires_grad_(True)
    drift = model.get_submodule("drift.gyro")
    assert isinstance(drift, Drift)
    fast = model.paper_ode("gyro", seen.t, seen.gyro)
    start = seen.rest[:, :3]
    rotations, biases = chart.integrate(Together(drift, fast), start, fast.grid, turned)
    found = fast.attitudes(start, turned, "euler", adjoint=False)
    torch.testing.assert_close(found, rotations, rtol=0, atol=1e-12)
    torch.testing.assert_close(fast.bias(start, "euler", adjoint=False), biases.transpose(0, 1), rtol=0, atol=1e-12)
    weights = list(drift.parameters())
    for one, other in zip(*(torch.autograd.grad(R[-1, :, 0].sum(), weights) for R in (found, rotations)), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("adjoint", [False, True])
def test_rk4_follows_the_flow_that_euler_is_late_for(seen: Segment, turned: Tensor, adjoint: bool) -> None:
    rows = slice(0, 13)
    solved = lively().paper_ode("gyro", seen.t[:, rows], seen.gyro[:, rows])
    start = seen.rest[:, :3]
    late = solved.attitudes(start, turned, "euler", adjoint=False)[-1]
    near = solved.attitudes(start, turned, "rk4", adjoint=adjoint)[-1]
    flow = solved.attitudes(start, turned, "dopri5", adjoint=False)[-1]
    off = [float(so3.log(R.mT @ flow).norm(dim=1).max()) for R in (near, late)]
    assert off[0] < 0.1 * off[1]
    assert off[1] < LATE


def test_the_sample_before_gives_the_first_slope(seen: Segment) -> None:
    """A window inside a log moves as the log does."""
    model = lively()
    for sensor in SENSORS:
        u, rest = seen.of(sensor)
        whole = model.paper_ode(sensor, seen.t, u).bias(rest, "euler", adjoint=False)
        inside = model.paper_ode(sensor, seen.t[:, 40:], u[:, 40:], u[:, 39]).bias(whole[:, 40], "euler", adjoint=False)
        torch.testing.assert_close(inside, whole[:, 40:], rtol=0, atol=1e-12)


def test_the_default_scheme_stands_in_no_file() -> None:
    assert "scheme" not in model_file.plain(Config())
    assert model_file.plain(Config(scheme="paper"))["scheme"] == "paper"


def test_its_file_holds_two_fields_and_no_curve() -> None:
    shapes = lively().frozen().shapes(Config(scheme="paper"))
    assert not [name for name in shapes if name.startswith("curve")]
    assert {name.split(".")[1] for name in shapes if name.startswith("drift")} == set(SENSORS)
