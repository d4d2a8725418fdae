"""Closed-form calibration: robust Gauss-Newton over windows between true poses.

Unknown are one matrix W of the sensor, the rest bias of each log, and the nuisances of each log: rotation, clock
and lever arm between its poses and the sensor, and the tilt of its world. The residual of a window is what integration misses
(`imutool.inertial.windows`), its derivative is exact, Huber's weights keep outliers of the truth from pulling, and everything
has a prior, measured against the residuals' own noise, so that what the motion does not show stays at zero.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from imutool.array_types import Float, Int
from imutool.bias.networks.network import BiasNetwork
from imutool.bias.networks.threads import of_each
from imutool.errors import DataError
from imutool.geometry import so3
from imutool.inertial.strapdown import GRAVITY_W
from imutool.inertial.windows import HUBER_MEDIANS, attitudes, huber_weight, rotation_residual, step_means, velocity_residual
from imutool.training.calibration.log_scatter import (
    ROTATION,
    integrated,
    shared_by_scatter,
    shown_by_logs,
    sums_by_log,
    widest,
)
from imutool.training.training_windows import Part, Pool, Windows
from imutool.units import COLUMNS, SENSORS, Sensor

W_PRIOR = 0.05  # plausible misalignment; a scale error of 0.1 is two of these
CORRELATED = 10.0  # errors of the truth last longer than a window: this many windows are taken to say the same once
ITERATIONS, REST_ITERATIONS = 6, 3  # the rest alone is nearly linear
MAX_SAMPLES = 120_000  # of one window length, so that hours of logs cost no more memory than minutes
END_SAMPLES = 3  # whose mean is the rate at an end of a window


@dataclass(frozen=True)
class Solution:
    """W, and the rest bias of each log (rad/s or m/s²) with its standard deviation."""

    W: Float[Tensor, "3 3"]
    covariance: Float[Tensor, "p p"]  # of W, row by row, as wide as the logs scatter; empty without a matrix
    rest: Float[Tensor, "logs 3"]
    std: Float[Tensor, "logs 3"]  # of `rest`


def carried_attitudes(model: BiasNetwork, windows: Windows) -> Float[Tensor, "batch n 3 3"]:
    """Attitudes under the accelerometer: the debiased gyro from each window's true start."""
    segment = windows.segment
    return attitudes(windows.R_start, segment.gyro - model.sensor_bias("gyro", segment), windows.dt)


def sensor_residual(
    model: BiasNetwork,
    sensor: Sensor,
    windows: Windows,
    W: Float[Tensor, "3 3"] | None = None,
    R_wb: Float[Tensor, "batch n 3 3"] | None = None,
    motion: Float[Tensor, "batch samples 3"] | None = None,
) -> tuple[Float[Tensor, "batch 3"], Float[Tensor, "batch n 3 3"]]:
    """Residual of each window's debiased samples, and its Jacobian by each sample.

    `W u` is taken off the sensor's samples on top of what the model takes off. `R_wb` are `carried_attitudes` and `motion` is
    the model's `motion_bias`, where they are known already.
    """
    segment = windows.segment
    u, _ = segment.of(sensor)
    motion = model.motion_bias(sensor, segment) if motion is None else motion
    true_u = u - model.rest_bias(sensor, segment) - motion
    if W is not None:
        true_u = true_u - u @ W.mT
    if sensor == "gyro":
        return rotation_residual(true_u, windows.dt, windows.R_start.mT @ windows.R_end)
    R_wb = carried_attitudes(model, windows) if R_wb is None else R_wb
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
    nuisances: bool = True,
) -> Solution:
    """Rest biases of all logs by Gauss-Newton; with `matrix` also W on top of the model's.

    Without `nuisances` a rest bias is the constant that fits best, which takes the nuisances of its log as far as it can.
    Windows of all lengths count together, each length against its own noise: short ones show the matrix, long ones the bias.

    Raises:
        DataError: a log has no window of that part that is free of gaps.
    """
    sets = [(first, n) for first, n in window_sets(pool, window_s, part, MAX_SAMPLES) if len(first)]
    rest, W, columns, known = rest.clone(), torch.zeros(3, 3).to(rest), COLUMNS[sensor], 9 if matrix else 0
    own_prior = widest(sensor, rest)[: None if nuisances else 3]  # of the rest bias, then of nuisances
    own, turns = torch.zeros(len(pool.names), len(own_prior)).to(rest), ROTATION[sensor] if nuisances else slice(0, 0)
    prior = torch.cat([torch.full((known,), W_PRIOR**-2.0).to(rest), own_prior.repeat(len(own))])
    fixed: dict[int, tuple[Tensor | None, Tensor]] = {}  # by window length: carried attitudes and the bias of motion stay

    def linearised(of_length: tuple[Int[Tensor, " k"], int]) -> _Linearised:
        first, n = of_length
        windows = pool.windows(first, n, rest[pool.log[first]])
        if n not in fixed:
            carried = carried_attitudes(model, windows) if sensor == "accel" else None
            fixed[n] = carried, model.motion_bias(sensor, windows.segment)
        e, A = sensor_residual(model, sensor, windows, W if matrix else None, *fixed[n])
        rates, forces = (u - b[:, None] for u, b in map(windows.segment.of, SENSORS))
        by_nuisance = nuisance_jacobian(sensor, windows, rates, forces)[..., : len(own_prior) - 3]
        e = e + (by_nuisance @ _apart(own, turns)[windows.log, 3:, None])[..., 0]
        u = step_means(windows.segment.of(sensor)[0]) if sensor == "gyro" else windows.segment.of(sensor)[0]
        by_own, weight = torch.cat([A.sum(1), by_nuisance], dim=2), _weight(e, windows.log, pool.minimum(sensor))
        return _Linearised(_by_matrix(A, u) if matrix else by_own[..., :0], by_own, e, weight, windows.log)

    def equations(of_length: tuple[Int[Tensor, " k"], int]) -> tuple[Float[Tensor, "u u"], Float[Tensor, " u"]]:
        by_matrix, by_own, e, weight, log = linearised(of_length)
        J = torch.cat([by_matrix, _by_log(by_own, log, len(own), turns)], dim=2)
        return torch.einsum("m,mij,mik->jk", weight, J, J), torch.einsum("m,mij,mi->j", weight, J, e)

    for _ in range(ITERATIONS if matrix else REST_ITERATIONS):
        own[:, :3] = rest[:, columns]
        H, g = torch.diag(prior), prior * torch.cat([W.flatten()[:known], own.flatten()])
        for by_H, by_g in of_each(equations, sets):
            H, g = H + by_H, g + by_g
        step = -torch.linalg.solve(H, g)
        if matrix:
            W = W + step[:9].reshape(3, 3)
        own = own + step[known:].reshape(own.shape)
        rest[:, columns] = own[:, :3]
    P = torch.linalg.inv(H)
    std = P.diagonal()[known:].reshape(own.shape)[:, :3].sqrt()
    W, covariance = _matrix_by_scatter(sensor, map(linearised, sets), W, _apart(own, turns)) if matrix else (W, P[:0, :0])
    return Solution(W, covariance, rest[:, columns].clone(), std)


class _Linearised(NamedTuple):
    """Windows of one length: derivatives by the matrix and by their log's own unknowns, residuals and weights."""

    by_matrix: Float[Tensor, "m 3 p"]
    by_own: Float[Tensor, "m 3 k"]
    e: Float[Tensor, "m 3"]
    weight: Float[Tensor, " m"]
    log: Int[Tensor, " m"]


def _apart(own: Float[Tensor, "logs o"], turns: slice) -> Float[Tensor, "logs o"]:
    """Unknowns of each log with rotations about their mean: what the rotations of all logs share is the matrix's."""
    out = own.clone()
    out[:, turns] -= own[:, turns].mean(0)
    return out


def _matrix_by_scatter(
    sensor: Sensor, sets: Iterable[_Linearised], W: Float[Tensor, "3 3"], own: Float[Tensor, "logs o"]
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "9 9"]]:
    """W and its covariance with errors as large as the logs scatter, with nuisances as wide as the logs show."""
    sums = [sums_by_log(torch.cat([s.by_matrix, s.by_own], dim=2), s.e, s.weight, s.log, len(own)) for s in sets]
    H, g = (torch.stack([parts[k] for parts in sums]).sum(0) for k in (0, 1))
    theta, prior = W.flatten(), torch.full((9,), W_PRIOR**-2.0).to(W)
    own_prior = shown_by_logs(sensor, H, g, theta, own, prior)
    theta, covariance = shared_by_scatter(integrated(H, g, own, own_prior, 9), theta, prior)
    return theta.reshape(3, 3), covariance


def nuisance_jacobian(
    sensor: Sensor, windows: Windows, gyro: Float[Tensor, "m n 3"], accel: Float[Tensor, "m n 3"]
) -> Float[Tensor, "m 3 k"]:
    """Derivative of a window's residual by its log's nuisances, in the order of `NUISANCE_STD`.

    The poses are those of a frame turned by phi against the sensor, late by tau: R' = R(t - tau) Exp(phi), and so is their
    velocity, of a point r away: v' = v + R [omega]x r. Only the ends of a window count, since nuisances cancel in between.
    `gyro` and `accel` are the samples without their rest bias.
    """
    R = windows.R_start.mT @ windows.R_end
    w_start, w_end = gyro[:, :END_SAMPLES].mean(1), gyro[:, -END_SAMPLES:].mean(1)
    if sensor == "gyro":
        by_clock = w_end - (R.mT @ w_start[..., None])[..., 0]
        return torch.cat([R.mT - torch.eye(3).to(R), by_clock[..., None]], dim=2)
    duration_s, g_w = windows.dt.sum(1), accel.new_tensor(GRAVITY_W)
    force = so3.hat(windows.v_end - windows.v_start - g_w * duration_s[:, None]) @ windows.R_start
    a_start, a_end = accel[:, :END_SAMPLES].mean(1), accel[:, -END_SAMPLES:].mean(1)
    change = windows.R_end @ a_end[..., None] - windows.R_start @ a_start[..., None]
    by_lever = windows.R_start @ so3.hat(w_start) - windows.R_end @ so3.hat(w_end)
    tilt = torch.eye(3).to(R)[None, :, :2] * duration_s[:, None, None]
    return torch.cat([tilt, -force, change + force @ w_start[..., None], by_lever], dim=2)


def end_samples(first: Int[Tensor, " m"], n: int) -> Int[Tensor, "m _"]:
    """The samples at both ends of windows of n steps that `nuisance_jacobian` reads."""
    k = torch.arange(min(END_SAMPLES, n + 1), device=first.device)
    return first[:, None] + torch.cat([k, n - k.flip(0)])


def window_sets(
    pool: Pool, window_s: Sequence[float], part: Part, max_samples: int, *, ends_only: bool = False
) -> list[tuple[Int[Tensor, " k"], int]]:
    """First samples of the windows of each length, and their steps; half overlapping.

    Where there are many, some are chosen evenly.

    Raises:
        DataError: a log has no window of that part that is free of gaps.
    """
    sets = []
    for n in map(pool.samples, window_s):
        first = pool.starts(n, part, hop=max(1, n // 2), ends_only=ends_only)
        sets.append((first[:: max(1, -(-len(first) * n // max_samples))], n))
    covered = torch.cat([pool.log[first] for first, _ in sets])
    missing = [name for i, name in enumerate(pool.names) if not bool((covered == i).any())]
    if missing:
        of = "" if part == "all" else f" in the {part.replace('_', '-')} part"
        raise DataError(
            f"no stretch of truth without a gap{of}",
            where=", ".join(missing),
            expected=f"{min(window_s):g} s of it in every log",
            fix="Leave the log out; or shorten gyro_window_s and accel_window_s, if you set them",
        )
    return sets


def _by_matrix(A: Float[Tensor, "m n 3 3"], u: Float[Tensor, "m n 3"]) -> Float[Tensor, "m 3 9"]:
    """d e / d W, row by row: taking W u off sample k adds A_k W u_k to the residual."""
    return torch.einsum("mkij,mkl->mijl", A, u).flatten(2)


def _by_log(J: Float[Tensor, "m 3 k"], log: Int[Tensor, " m"], logs: int, turns: slice) -> Float[Tensor, "m 3 all"]:
    """Derivative by the unknowns of every log: zero but for a window's own, and rotations about their mean."""
    out = J.new_zeros(len(J), 3, logs, J.shape[2])
    out[torch.arange(len(J), device=J.device), :, log] = J
    out[..., turns] -= out[..., turns].mean(2, keepdim=True)
    return out.flatten(2)


def _weight(e: Float[Tensor, "m 3"], log: Int[Tensor, " m"], minimum: Float[Tensor, " logs"]) -> Float[Tensor, " m"]:
    """Huber's weights, scaled so that a component of an ordinary window of its log has about unit noise, as the prior has."""
    size = e.norm(dim=1)
    delta = HUBER_MEDIANS * median_per_log(size, log, minimum)[log]
    weight: Tensor = huber_weight(size, delta) * 3 / delta**2 / CORRELATED
    return weight


def median_per_log(size: Float[Tensor, " m"], log: Int[Tensor, " m"], floor: Float[Tensor, " logs"]) -> Float[Tensor, " logs"]:
    """The median size of each log's windows, and not less than a least one.

    Truths differ in quality by a factor of eight between rooms of one data set.
    """
    medians = [size[log == i].median() if bool((log == i).any()) else size.median() for i in range(len(floor))]
    return torch.maximum(torch.stack(medians), floor.to(size))
