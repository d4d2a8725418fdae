"""Covariance of a linear model: that of its matrix."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from support.switchings_on import Switchings, log

from imutool.bias import linear
from imutool.bias.networks.linear import Network
from imutool.bias.networks.static import Network as StaticNetwork
from imutool.training.calibration import closed_form
from imutool.training.training_windows import Pool
from imutool.units import COLUMNS, SENSORS, Sensor

SETS, LOGS = 8, 4  # sets of logs
MIN = 0.4  # the size stated before the scatter counts, too, and is too large for poses with independent errors
KIND = Switchings(rest_s=2.0, duration_s=20.0, rate_hz=50.0, mount_rad=0.0, clock_s=0.0, scale=0.01)


def test_the_bias_is_as_uncertain_as_the_matrix() -> None:
    """Covariance of W u is (u kron I)^T C (u kron I); older files have no covariance."""
    rng = np.random.default_rng(0)
    root = {sensor: rng.normal(size=(9, 9)) * 1e-3 for sensor in SENSORS}
    tensors = {f"covariance.{sensor}": R @ R.T for sensor, R in root.items()}
    root_at = linear.Model(linear.Config(covariance=True), 100.0, tensors).calibration_covariance()
    assert root_at is not None
    u = rng.normal(size=(5, 6))
    found = root_at(np.arange(5.0), u[:, :3], u[:, 3:])
    for sensor, R in root.items():
        for row, S in zip(u[:, COLUMNS[sensor]], found[sensor], strict=True):
            J = np.kron(np.eye(3), row)
            np.testing.assert_allclose(S @ S.T, J @ R @ R.T @ J.T, rtol=1e-9, atol=1e-15)
    assert linear.Model().calibration_covariance() is None


def test_a_network_keeps_the_covariance_for_its_file() -> None:
    network = Network().double()
    network.take_covariance("accel", torch.eye(9, dtype=torch.float64))
    model = network.frozen()
    assert model.config == linear.Config(covariance=True)
    assert {name: value.shape for name, value in model.tensors.items()} == dict(linear.Model.shapes(model.config))
    np.testing.assert_array_equal(model.tensors["covariance.accel"], np.eye(9))
    np.testing.assert_array_equal(model.tensors["covariance.gyro"], np.zeros((9, 9)))
    Network(model.config).double().load_state_dict(network.state_dict())


@pytest.mark.parametrize("sensor", SENSORS)
def test_matrices_of_different_logs_differ_as_their_covariance_says(sensor: Sensor) -> None:
    solutions = []
    for first in range(0, LOGS * SETS, LOGS):
        pool = Pool.of([log(seed, 0, KIND) for seed in range(first, first + LOGS)])
        rest = pool.t.new_zeros(LOGS, 6)
        solutions.append(closed_form.solve(StaticNetwork().double(), sensor, pool, rest, (1.0, 4.0), matrix=True, part="all"))
    W = torch.stack([solution.W.flatten() for solution in solutions])
    squares = [float(d @ torch.linalg.solve(s.covariance, d)) / 9 for d, s in zip(W - W.mean(0), solutions, strict=True)]
    assert MIN < np.mean(squares) * SETS / (SETS - 1) < 1.0
