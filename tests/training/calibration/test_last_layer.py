"""A planted curve comes back whatever was in its place; one that left-out logs do not want stays out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from imutool.bias.networks import linear, neural_ode
from imutool.bias.networks.network import Segment
from imutool.recording import Imu, Recording
from imutool.training.calibration.last_layer import solve_last_layer
from imutool.training.training_windows import Pool
from imutool.units import SENSORS, Sensor

Make = Callable[..., Recording]
RESTS = torch.tensor([[0.04, -0.02, 0.01, 0.1, -0.2, 0.05], [0.03, -0.03, 0.02, 0.15, -0.1, 0.0]]).double()
PLANTED = 0.3  # standard deviation of a weight
MISSED = 0.01  # share of the planted curve, less a constant: half is the prior's pull and the rule of integration
SLOW_S = 1.0  # of the filters' beginning, which the measured samples have otherwise


def shaped(seed: int, rate_hz: float) -> neural_ode.Network:
    """Network with a curve."""
    torch.manual_seed(seed)
    network = neural_ode.Network(rate_hz=rate_hz).double()
    for sensor in SENSORS:
        layer = network.last_layer(sensor)
        assert layer is not None
        assert layer.out.shape == (3, network.config.curve_width)
        layer.out.normal_(0.0, PLANTED)
        layer.W.normal_(0.0, 0.01)
    return network


def motion(network: neural_ode.Network, sensor: Sensor, recording: Recording) -> np.ndarray:
    """What the motion adds to a sensor's bias."""
    imu = recording.imu
    t = torch.from_numpy((imu.t_ns - imu.t_ns[0]) * 1e-9)
    whole = Segment(t[None], torch.tensor(imu.gyro)[None], torch.tensor(imu.accel)[None], torch.zeros(1, 6).double())
    with torch.no_grad():
        return network.motion_bias(sensor, whole)[0].numpy()


def planted(network: neural_ode.Network, recording: Recording, rest: torch.Tensor) -> Recording:
    """Samples u of which the network takes off all errors: u - rest - C(u) is true."""
    true = recording.imu
    made = Imu(true.t_ns, true.gyro + rest[:3].numpy(), true.accel + rest[3:].numpy())
    for _ in range(30):  # C is small: a fixed point
        gyro, accel = (motion(network, sensor, replace(recording, imu=made)) for sensor in SENSORS)
        made = Imu(true.t_ns, true.gyro + rest[:3].numpy() + gyro, true.accel + rest[3:].numpy() + accel)
    return replace(recording, imu=made)


@pytest.fixture(scope="module")
def sensor(perfect: Make) -> tuple[neural_ode.Network, list[Recording]]:
    flights = [perfect(seed, duration_s=60.0, still_s=2.0) for seed in (1, 2)]
    network = shaped(3, 1.0 / flights[0].imu.period_s)
    return network, [planted(network, flight, rest) for flight, rest in zip(flights, RESTS, strict=True)]


def test_a_planted_layer_comes_back_from_any_weights(sensor: tuple[neural_ode.Network, list[Recording]]) -> None:
    network, recordings = sensor
    pool, found = Pool.of(recordings), []
    for seed in (4, 5):
        learnt = neural_ode.Network(rate_hz=pool.rate_hz).double()
        learnt.load_state_dict(network.state_dict())
        torch.manual_seed(seed)
        for each in SENSORS:
            layer = learnt.last_layer(each)
            assert layer is not None
            layer.out.add_(torch.randn_like(layer.out))
            layer.W.add_(0.05 * torch.randn_like(layer.W))
            solve_last_layer(learnt, each, pool, RESTS)
        found.append(learnt)
    for each in SENSORS:
        for recording in recordings:
            curves = [motion(one, each, recording)[int(SLOW_S * pool.rate_hz) :] for one in (network, *found)]
            true, first, second = (curve - curve.mean(0) for curve in curves)
            assert np.std(first - true) < MISSED * np.std(true), each
            assert np.std(first - second) < 1e-6 * np.std(true), each


def test_a_curve_that_no_log_shows_stays_out(perfect: Make) -> None:
    pool = Pool.of([perfect(seed, duration_s=20.0, still_s=1.0) for seed in (1, 2)])
    for network in (linear.Network(rate_hz=pool.rate_hz).double(), neural_ode.Network(rate_hz=pool.rate_hz).double()):
        before = {name: value.clone() for name, value in network.state_dict().items()}
        solve_last_layer(network, "gyro", pool, torch.zeros_like(RESTS))
        assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())
