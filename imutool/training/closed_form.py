"""Closed-form calibration: robust Gauss-Newton over windows between true poses.

Unknown are one matrix W of the sensor and one rest bias a log. The residual of a window is what integration misses
(`imutool.inertial.windows`), its derivative is exact, Huber's weights keep outliers of the truth from pulling, and
everything has a
prior, measured against the residuals' own noise, so that what the motion does not show stays at zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from imutool.bias.model import COLUMNS
from imutool.bias.networks.network import BiasNetwork
from imutool.errors import DataError
from imutool.inertial.strapdown import GRAVITY_W
from imutool.inertial.windows import HUBER_MEDIANS, attitudes, huber_weight, rotation_residual, step_means, velocity_residual
from imutool.training.segments import Part, Pool, Windows
from imutool.units import Sensor

W_PRIOR = 0.05  # plausible misalignment; a scale error of 0.1 is two of these
REST_PRIOR = {"gyro": 0.1, "accel": 1.0}  # rad/s, m/s²: plausible turn-on biases
CORRELATED = 10.0  # errors of the truth last longer than a window: this many windows are taken to say the same once
LEAST_RESIDUAL = 1e-6  # rad or m/s: no truth is better, and perfect data must not outweigh the prior beyond float64's digits
ITERATIONS, REST_ITERATIONS = 6, 3  # the rest alone is nearly linear
MAX_SAMPLES = 120_000  # of one window length, so that hours of logs cost no more memory than minutes


@dataclass(frozen=True)
class Solution:
    """W and the rest bias of each log (rad/s or m/s²)."""

    W: Float[Tensor, "3 3"]
    rest: Float[Tensor, "logs 3"]


def sensor_residual(
    model: BiasNetwork, sensor: Sensor, windows: Windows, W: Float[Tensor, "3 3"] | None = None
) -> tuple[Float[Tensor, "batch 3"], Float[Tensor, "batch n 3 3"]]:
    """Residual of each window's debiased samples, and its Jacobian by each sample.

    `W u` is taken off the sensor's samples on top of what the model takes off. The attitude under the accelerometer starts at
    the true one and follows the debiased gyro.
    """
    segment = windows.segment
    u, _ = segment.of(sensor)
    true_u = u - model.sensor_bias(sensor, segment)
    if W is not None:
        true_u = true_u - u @ W.mT
    if sensor == "gyro":
        return rotation_residual(true_u, windows.dt, windows.R_start.mT @ windows.R_end)
    R_wb = attitudes(windows.R_start, segment.gyro - model.sensor_bias("gyro", segment), windows.dt)
    return velocity_residual(true_u, windows.dt, R_wb, windows.v_end - windows.v_start, u.new_tensor(GRAVITY_W))


@torch.no_grad()
def solve(
    model: BiasNetwork,
    sensor: Sensor,
    pool: Pool,
    rest: Float[Tensor, "logs 6"],
    window_s: Sequence[float],
    *,
    matrix: bool,
    part: Part = "train",
) -> Solution:
    """Rest biases of all logs by Gauss-Newton; with `matrix` also W on top of the model's.

    Windows of all lengths count together, each length against its own noise: short ones show the matrix, long ones the bias.

    Raises:
        DataError: a log has no window of that part that is free of gaps.
    """
    sets = [_some(pool.starts(n, part, hop=max(1, n // 2)), n) for n in map(pool.samples, window_s)]
    seen = torch.cat([pool.log[first] for first, _ in sets])
    missing = [name for i, name in enumerate(pool.names) if not bool((seen == i).any())]
    if missing:
        where = f"the {part.replace('_', '-')} part of {', '.join(missing)}"
        raise DataError(
            f"no stretch of {min(window_s):g} s of truth without a gap in {where}",
            expected="truth that covers at least one window",
            fix="Shorten the windows (settings gyro_window_s, accel_window_s), or leave the log out",
        )
    rest, W, columns, known = rest.clone(), torch.zeros(3, 3).to(rest), COLUMNS[sensor], 9 if matrix else 0
    for _ in range(ITERATIONS if matrix else REST_ITERATIONS):
        now = torch.cat([W.flatten()[:known], rest[:, columns].flatten()])
        prior = torch.full_like(now, REST_PRIOR[sensor] ** -2)
        prior[:known] = W_PRIOR**-2
        H, g = torch.diag(prior), prior * now
        for first, n in sets:
            if not len(first):
                continue
            windows = pool.windows(first, n, rest[pool.log[first]])
            e, A = sensor_residual(model, sensor, windows, W if matrix else None)
            J = _by_rest(A, windows.log, len(pool.names))
            if matrix:
                u, _ = windows.segment.of(sensor)
                J = torch.cat([_by_matrix(A, step_means(u) if sensor == "gyro" else u), J], dim=2)
            weight = _weight(e, windows.log, len(pool.names))
            H += torch.einsum("m,mij,mik->jk", weight, J, J)
            g += torch.einsum("m,mij,mi->j", weight, J, e)
        step = -torch.linalg.solve(H, g)
        if matrix:
            W = W + step[:9].reshape(3, 3)
        rest[:, columns] += step[known:].reshape(-1, 3)
    return Solution(W, rest[:, columns].clone())


def _some(first: Int[Tensor, " m"], n: int) -> tuple[Int[Tensor, " k"], int]:
    """At most `MAX_SAMPLES` of samples, evenly chosen."""
    return first[:: max(1, -(-len(first) * n // MAX_SAMPLES))], n


def _by_matrix(A: Float[Tensor, "m n 3 3"], u: Float[Tensor, "m n 3"]) -> Float[Tensor, "m 3 9"]:
    """d e / d W, row by row: taking W u off sample k adds A_k W u_k to the residual."""
    return torch.einsum("mkij,mkl->mijl", A, u).flatten(2)


def _by_rest(A: Float[Tensor, "m n 3 3"], log: Int[Tensor, " m"], logs: int) -> Float[Tensor, "m 3 k"]:
    """d e / d (rest of each log): taking a constant off all samples adds the sum of A_k times it."""
    J = A.new_zeros(len(A), 3, logs, 3)
    J[torch.arange(len(A), device=A.device), :, log] = A.sum(1)
    return J.flatten(2)


def _weight(e: Float[Tensor, "m 3"], log: Int[Tensor, " m"], logs: int) -> Float[Tensor, " m"]:
    """Huber's weights, scaled so that a component of an ordinary window of its log has about unit noise, as the prior has."""
    size = e.norm(dim=1)
    delta = HUBER_MEDIANS * median_per_log(size, log, logs)[log]
    weight: Tensor = huber_weight(size, delta) * 3 / delta**2 / CORRELATED
    return weight


def median_per_log(size: Float[Tensor, " m"], log: Int[Tensor, " m"], logs: int) -> Float[Tensor, " logs"]:
    """The median size of each log's windows.

    Truths differ in quality by a factor of eight between rooms of one data set.
    """
    medians = [size[log == i].median() if bool((log == i).any()) else size.median() for i in range(logs)]
    return torch.stack(medians).clamp_min(LEAST_RESIDUAL)
