"""Closed-form calibration: robust Gauss-Newton over windows between true poses.

Unknown are one matrix W of the sensor, the rest bias of each log, and the nuisances of each log (`Nuisances`): rotation, clock
and lever arm between its poses and the sensor, and the tilt of its world. The residual of a window is what integration misses
(`imutool.inertial.windows`), its derivative is exact, Huber's weights keep outliers of the truth from pulling, and everything
has a prior, measured against the residuals' own noise, so that what the motion does not show stays at zero.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from imutool.array_types import Float, Int
from imutool.bias.model import COLUMNS
from imutool.bias.networks.network import BiasNetwork
from imutool.bias.networks.threads import of_each
from imutool.errors import DataError
from imutool.geometry import so3
from imutool.inertial.strapdown import GRAVITY_W
from imutool.inertial.windows import HUBER_MEDIANS, attitudes, huber_weight, rotation_residual, step_means, velocity_residual
from imutool.training.training_windows import Part, Pool, Windows
from imutool.units import SENSORS, Sensor

W_PRIOR = 0.05  # plausible misalignment; a scale error of 0.1 is two of these
REST_PRIOR = {"gyro": 0.1, "accel": 1.0}  # rad/s, m/s²: plausible turn-on biases
CORRELATED = 10.0  # errors of the truth last longer than a window: this many windows are taken to say the same once
ITERATIONS, REST_ITERATIONS = 6, 3  # the rest alone is nearly linear
MAX_SAMPLES = 120_000  # of one window length, so that hours of logs cost no more memory than minutes


NUISANCE_STD = {  # how far they differ from log to log, at most
    "gyro": (0.01,) * 3 + (5e-3,),  # rotation (rad), clock (s)
    "accel": (0.1,) * 2 + (0.01,) * 3 + (5e-3,) + (0.02,) * 3,  # tilt (m/s² of gravity), rotation, clock, lever arm (m)
}
ROTATION = {"gyro": slice(3, 6), "accel": slice(5, 8)}  # of a log's unknowns, of which the rest bias comes first
CLOCK, LEVER = {"gyro": slice(6, 7), "accel": slice(8, 9)}, {"gyro": slice(7, 7), "accel": slice(9, 12)}
NARROWER = np.geomspace(1.0, 20.0, 13)  # shares of these widths that logs may show, as divisors
END_SAMPLES = 3  # whose mean is the rate at an end of a window


@dataclass(frozen=True)
class Solution:
    """W, and the rest bias of each log (rad/s or m/s²) with its standard deviation.

    `covariance` is that of W, row by row, and empty without a matrix.
    """

    W: Float[Tensor, "3 3"]
    covariance: Float[Tensor, "p p"]
    rest: Float[Tensor, "logs 3"]
    std: Float[Tensor, "logs 3"]


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
    nuisance_prior = torch.tensor(NUISANCE_STD[sensor] if nuisances else ()).to(rest) ** -2.0
    own = torch.zeros(len(pool.names), 3 + len(nuisance_prior)).to(rest)  # rest bias, then nuisances
    turns = ROTATION[sensor] if nuisances else slice(0, 0)
    own_prior = torch.cat([torch.full((3,), REST_PRIOR[sensor] ** -2.0).to(rest), nuisance_prior]).repeat(len(own))
    prior = torch.cat([torch.full((known,), W_PRIOR**-2.0).to(rest), own_prior])
    fixed: dict[int, tuple[Tensor | None, Tensor]] = {}  # by window length: carried attitudes and the bias of motion stay

    def equations(of_length: tuple[Int[Tensor, " k"], int]) -> tuple[Float[Tensor, "u u"], Float[Tensor, " u"]]:
        first, n = of_length
        windows = pool.windows(first, n, rest[pool.log[first]])
        if n not in fixed:
            carried = carried_attitudes(model, windows) if sensor == "accel" else None
            fixed[n] = carried, model.motion_bias(sensor, windows.segment)
        e, A = sensor_residual(model, sensor, windows, W if matrix else None, *fixed[n])
        rates, forces = (u - b[:, None] for u, b in map(windows.segment.of, SENSORS))
        by_nuisance = nuisance_jacobian(sensor, windows, rates, forces)[..., : len(nuisance_prior)]
        apart = own.clone()
        apart[:, turns] -= own[:, turns].mean(0)  # what the rotations of all logs share is the matrix's
        e = e + (by_nuisance @ apart[windows.log, 3:, None])[..., 0]
        J = _by_log(torch.cat([A.sum(1), by_nuisance], dim=2), windows.log, len(own), turns)
        if matrix:
            u, _ = windows.segment.of(sensor)
            J = torch.cat([_by_matrix(A, step_means(u) if sensor == "gyro" else u), J], dim=2)
        weight = _weight(e, windows.log, pool.least(sensor))
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
    return Solution(W, P[:known, :known], rest[:, columns].clone(), P.diagonal()[known:].reshape(own.shape)[:, :3].sqrt())


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


def widest(sensor: Sensor, like: Tensor) -> Float[Tensor, " o"]:
    """One over the plausible variance of each of a log's own unknowns."""
    return torch.tensor([REST_PRIOR[sensor]] * 3 + list(NUISANCE_STD[sensor])).to(like) ** -2


def shown_by_logs(
    sensor: Sensor,
    H: Float[Tensor, "logs k k"],
    g: Float[Tensor, "logs k"],
    theta: Float[Tensor, " p"],
    own: Float[Tensor, "logs o"],
    prior: Float[Tensor, " p"],
) -> Float[Tensor, " o"]:
    """Prior of a log's own unknowns: as wide as the logs scatter beyond their deviations.

    The restricted likelihood of all logs decides between widths up to `NUISANCE_STD`: what logs share is the effects', and
    logs that agree keep one clock, one rotation and one lever arm. `H` and `g` are the losses of the logs about a point.
    """
    own_prior, p = widest(sensor, theta), len(prior)
    for _ in range(2):
        for part in (ROTATION[sensor], CLOCK[sensor], LEVER[sensor]):
            if part.start < part.stop:
                tried = own_prior.repeat(len(NARROWER), 1)
                tried[:, part] = torch.from_numpy(NARROWER[:, None] ** 2).to(tried) * widest(sensor, theta)[part]
                own_prior = tried[minus_log_likelihood(integrated(H, g, own, tried[:, None], p), theta, prior).argmin()]
    return own_prior


class Integrated(NamedTuple):
    """Losses of logs with each log's own unknowns integrated out."""

    S: Float[Tensor, "*batch logs p p"]
    v: Float[Tensor, "*batch logs p"]
    c: Float[Tensor, "*batch logs"]


def integrated(
    H: Float[Tensor, "*#batch k k"], g: Float[Tensor, "*#batch k"], own: Tensor, own_prior: Tensor, p: int
) -> Integrated:
    """Integrate out a log's own unknowns, which follow p parameters that the logs share."""
    A, b = H[..., p:, p:] + torch.diag_embed(own_prior), g[..., p:] + own_prior * own
    X, y = torch.linalg.solve(A, torch.cat([H[..., p:, :p].expand(*A.shape[:-1], p), b[..., None]], -1)).split((p, 1), -1)
    S, v = H[..., :p, :p] - H[..., :p, p:] @ X, g[..., :p] - (H[..., :p, p:] @ y)[..., 0]
    c = torch.logdet(A) - own_prior.log().sum(-1) + (own_prior * own.square()).sum(-1) - (b * y[..., 0]).sum(-1)
    return Integrated(S, v, c)


def minus_log_likelihood(logs: Integrated, theta: Float[Tensor, " p"], prior: Float[Tensor, " p"]) -> Float[Tensor, "*batch"]:
    """Twice the negative logarithm, but for a constant, with all unknowns integrated out."""
    S, v = torch.diag(prior) + logs.S.sum(-3), prior * theta + logs.v.sum(-2)
    L, failed = torch.linalg.cholesky_ex(S)  # one factor for both terms: a third of the time of logdet and solve
    whitened = torch.linalg.solve_triangular(L, v[..., None], upper=False)
    logdet = 2.0 * torch.diagonal(L, dim1=-2, dim2=-1).log().sum(-1)
    found = logs.c.sum(-1) + logdet - whitened.square().sum((-2, -1))
    return torch.where(failed == 0, found, math.inf)  # rounding alone makes S indefinite


def window_sets(
    pool: Pool, window_s: Sequence[float], part: Part, most_samples: int, *, ends_only: bool = False
) -> list[tuple[Int[Tensor, " k"], int]]:
    """Windows of each length, half overlapping, evenly chosen where there are many: first samples, and steps.

    Raises:
        DataError: a log has no window of that part that is free of gaps.
    """
    sets = []
    for n in map(pool.samples, window_s):
        first = pool.starts(n, part, hop=max(1, n // 2), ends_only=ends_only)
        sets.append((first[:: max(1, -(-len(first) * n // most_samples))], n))
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


def _weight(e: Float[Tensor, "m 3"], log: Int[Tensor, " m"], least: Float[Tensor, " logs"]) -> Float[Tensor, " m"]:
    """Huber's weights, scaled so that a component of an ordinary window of its log has about unit noise, as the prior has."""
    size = e.norm(dim=1)
    delta = HUBER_MEDIANS * median_per_log(size, log, least)[log]
    weight: Tensor = huber_weight(size, delta) * 3 / delta**2 / CORRELATED
    return weight


def median_per_log(size: Float[Tensor, " m"], log: Int[Tensor, " m"], least: Float[Tensor, " logs"]) -> Float[Tensor, " logs"]:
    """The median size of each log's windows, and not less than a least one.

    Truths differ in quality by a factor of eight between rooms of one data set.
    """
    medians = [size[log == i].median() if bool((log == i).any()) else size.median() for i in range(len(least))]
    return torch.maximum(torch.stack(medians), least.to(size))
