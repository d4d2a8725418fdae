"""The joint scheme: one ODE of attitude and bias on SO(3), the same bias at work, and a training that lowers the loss."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from imutool.bias import io
from imutool.bias.networks.joint_ode import JointField
from imutool.bias.networks.network import Segment
from imutool.bias.networks.neural_ode import Network
from imutool.bias.neural_ode import Config
from imutool.errors import ConfigError
from imutool.geometry import so3
from imutool.inertial.windows import end_attitude
from imutool.recording import seconds
from imutool.sensor.made_up_flight import flight

RATE_HZ = 200.0
STREAM = 1e-6  # rad/s and m/s²: of numpy against torch, as for every model
SAME_TURN = {"euler": 1e-2, "rk4": 1e-3}  # rad over half a second: Euler is late by half a step, 2.5 ms of a few rad/s
WEIGHTS = 0.3  # of the field's last layer: drifts of some 1e-4 rad/s²


def lively() -> Network:
    """A joint model whose field and calibration are not zero."""
    torch.manual_seed(0)
    model = Network(Config(scheme="joint"), RATE_HZ).double()
    field = model.drift["gyro"]
    assert isinstance(field, JointField)
    with torch.no_grad():
        field.W.copy_(0.02 * torch.randn(3, 3, dtype=torch.float64))
        field.get_parameter("drift.out.weight").copy_(WEIGHTS * torch.randn(3, 9, dtype=torch.float64))
    return model.requires_grad_(False).eval()


@pytest.fixture(scope="module")
def seen() -> Segment:
    """Half a second of two flights."""
    imus = [flight(seed, duration_s=2.0, still_s=0.0).imu.rows(slice(200, 301)) for seed in (1, 2)]
    t = torch.from_numpy(seconds(imus[0].t_ns, int(imus[0].t_ns[0]))).expand(2, -1).contiguous()
    gyro, accel = (torch.from_numpy(np.stack([getattr(imu, name) for imu in imus])) for name in ("gyro", "accel"))
    rest = torch.tensor([[0.01, 0.02, -0.01, 0.1, -0.1, 0.05], [0.0] * 6], dtype=torch.float64)
    return Segment(t, gyro, accel, rest)


def test_the_stream_equals_forward_in_blocks_and_one_by_one(seen: Segment) -> None:
    model = lively()
    expected = model(seen)[0].numpy()
    t, gyro, accel = (x[0].numpy() for x in (seen.t, seen.gyro, seen.accel))
    stream = model.frozen().stream(seen.rest[0].numpy())
    blocks = np.concatenate([stream(t[a:b], gyro[a:b], accel[a:b]) for a, b in ((0, 1), (1, 40), (40, 101))])
    np.testing.assert_allclose(blocks, expected, rtol=0, atol=STREAM)
    single = model.frozen().stream(seen.rest[0].numpy())
    each = [single.one(float(t[k]), np.concatenate([gyro[k], accel[k]])) for k in range(len(t))]
    np.testing.assert_allclose(each, expected, rtol=0, atol=STREAM)


@pytest.mark.parametrize("solver", ["euler", "rk4"])
def test_attitude_and_bias_are_integrated_together(seen: Segment, solver: str) -> None:
    model = lively()
    model.config = Config(scheme="joint", solver="euler" if solver == "euler" else "rk4")
    R_start = so3.exp(torch.tensor([[0.1, 0.2, 0.3], [1.0, -2.0, 0.5]], dtype=torch.float64))
    dt = torch.diff(seen.t, dim=1)
    R_end = model.end_attitude(R_start, seen, dt)
    apart = end_attitude(R_start, seen.gyro - model.sensor_bias("gyro", seen), dt)
    assert float(so3.log(R_end.mT @ apart).norm(dim=1).max()) < SAME_TURN[solver]


def test_the_default_scheme_stands_in_no_file() -> None:
    assert "scheme" not in io.plain(Config())
    assert io.plain(Config(scheme="joint"))["scheme"] == "joint"


def test_it_needs_a_drift_of_the_gyro() -> None:
    with pytest.raises(ConfigError, match="drift of the gyro"):
        Network(Config(scheme="joint", drift=()), RATE_HZ)
