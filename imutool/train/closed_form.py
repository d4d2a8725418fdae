"""A calibration without a single step of gradient descent: robust Gauss-Newton over windows between true poses.

Unknown are one matrix W of the sensor and one rest bias a log. The residual of a window is what integration misses
(`imutool.windows`), its derivative is exact, Huber's weights keep outliers of the truth from pulling, and everything has a
prior, measured against the residuals' own noise, so that what the motion does not show stays at zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from imutool.bias._base import COLUMNS, BiasModel, Sensor
from imutool.errors import DataError
from imutool.strapdown import GRAVITY_W
from imutool.train.segments import Pool, Windows
from imutool.windows import attitudes, between, huber_weight, rotation_residual, velocity_residual

W_PRIOR = 0.05  # plausible misalignment; a scale error of 0.1 is two of these
REST_PRIOR = {"gyro": 0.1, "accel": 1.0}  # rad/s, m/s²: plausible turn-on biases
CORRELATED = 10.0  # errors of the truth last longer than a window: this many windows are taken to say the same once
HUBER_MEDIANS = 1.5
ITERATIONS = 8
MAX_SAMPLES = 400_000  # of one window length, so that hours of logs cost no more memory than minutes


@dataclass(frozen=True)
class Solution:
    """W, the rest bias of each log, and the median residual of a window (rad, or m/s)."""

    W: Float[Tensor, "3 3"]
    rest: Float[Tensor, "logs 3"]
    residual: float


def sensor_residual(
    model: BiasModel, sensor: Sensor, windows: Windows, W: Float[Tensor, "3 3"] | None = None
) -> tuple[Float[Tensor, "batch 3"], Float[Tensor, "batch n 3 3"]]:
    """What the debiased samples of a window miss of the truth, and how each sample moves it (`imutool.windows`).

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
    model: BiasModel, sensor: Sensor, pool: Pool, rest: Float[Tensor, "logs 6"], window_s: Sequence[float], *, matrix: bool
) -> Solution:
    """The rest biases of all logs, and with `matrix` a calibration on top of the model's, by Gauss-Newton.

    Windows of all lengths count together, each length against its own noise: short ones show the matrix, long ones the bias.

    Raises:
        DataError: a log has no window of the training part that is free of gaps.
    """
    sets = [_some(pool.starts(n, "train", hop=max(1, n // 2)), n) for n in map(pool.samples, window_s)]
    seen = torch.cat([pool.log[first] for first, _ in sets])
    missing = [name for i, name in enumerate(pool.names) if not bool((seen == i).any())]
    if missing:
        raise DataError(
            f"no stretch of {min(window_s):g} s of truth without a gap in the training part of {', '.join(missing)}",
            expected="truth that covers at least one window",
            fix="Shorten the windows with --set, or leave the log out",
        )
    rest, W, columns, residual = rest.clone(), torch.zeros(3, 3).to(rest), COLUMNS[sensor], 0.0
    for _ in range(ITERATIONS):
        now = torch.cat([W.flatten(), rest[:, columns].flatten()])
        prior = torch.cat([torch.full_like(now[:9], W_PRIOR), torch.full_like(now[9:], REST_PRIOR[sensor])]) ** -2
        H, g = torch.diag(prior), prior * now
        for first, n in sets:
            if not len(first):
                continue
            windows = pool.windows(first, n, rest[pool.log[first]])
            e, A = sensor_residual(model, sensor, windows, W)
            u, _ = windows.segment.of(sensor)
            u = between(u) if sensor == "gyro" else u
            J = _derivative(A, u, windows.log, len(pool.names), matrix=matrix)
            weight, residual = _weight(e), float(e.norm(dim=1).median())
            H += torch.einsum("m,mij,mik->jk", weight, J, J)
            g += torch.einsum("m,mij,mi->j", weight, J, e)
        step = -torch.linalg.solve(H, g)
        W = W + step[:9].reshape(3, 3)
        rest[:, columns] += step[9:].reshape(-1, 3)
    return Solution(W, rest[:, columns].clone(), residual)


def _some(first: Int[Tensor, " m"], n: int) -> tuple[Int[Tensor, " k"], int]:
    """At most `MAX_SAMPLES` of samples, evenly chosen."""
    return first[:: max(1, -(-len(first) * n // MAX_SAMPLES))], n


def _derivative(
    A: Float[Tensor, "m n 3 3"], u: Float[Tensor, "m n 3"], log: Int[Tensor, " m"], logs: int, *, matrix: bool
) -> Float[Tensor, "m 3 k"]:
    """d e / d (W row by row, rest of each log): taking `d` off sample k adds A_k d to the residual."""
    of_W = torch.einsum("mkij,mkl->mijl", A, u).flatten(2)
    of_rest = A.new_zeros(len(A), 3, logs, 3)
    of_rest[torch.arange(len(A), device=A.device), :, log] = A.sum(1)
    return torch.cat([of_W if matrix else torch.zeros_like(of_W), of_rest.flatten(2)], dim=2)


def _weight(e: Float[Tensor, "m 3"]) -> Float[Tensor, " m"]:
    """Huber's weights, scaled so that a component of an ordinary window has about unit noise, as the prior has."""
    size = e.norm(dim=1)
    delta = HUBER_MEDIANS * size.median().clamp_min(1e-12)
    weight: Tensor = huber_weight(size, delta) * 3 / delta**2 / CORRELATED
    return weight
