"""Residuals of samples over windows between two true poses, and their derivatives.

A window is n + 1 samples, the first and last at the two true poses. Samples are points of the signal, so the rate over a step
is the mean of its two ends. The paper's Euler rule, which keeps each sample until the next, is late by half a step: 2.3 to
2.5 ms against the truth of EuRoC, where the mean is late by less than 0.2 ms (`tests/bench/truth_delay.py`). Products over a
window are a tree, so a thousand samples cost ten batched multiplications and no Python loop. Samples that many windows share
are integrated once (`Pieces`).

Users: the calibration (`training.closed_form`, `training.normal_equations`), the training loss, and the noise of a log.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import pad

from imutool.array_types import Float, Int
from imutool.geometry import so3
from imutool.units import Sensor

HUBER_MEDIANS = 1.5  # threshold of an outlier, in medians of the residuals

Samples = Float[Tensor, "batch n 3"]
Steps = Float[Tensor, "batch n-1"]


def step_means(u: Samples) -> Float[Tensor, "batch n-1 3"]:
    """Means of each sample and the next: the value over the step between them."""
    return 0.5 * (u[:, :-1] + u[:, 1:])


def running_product(increments: Float[Tensor, "batch n 3 3"]) -> Float[Tensor, "batch n 3 3"]:
    """Products `increments[0] @ ... @ increments[k]` for every k, two for each.

    Blelloch's scan, on arrays of each entry: they are multiplied in a seventh of the time of small matrices.
    """
    return _running(increments.permute(2, 3, 0, 1).contiguous()).permute(2, 3, 0, 1)


def _running(increments: Float[Tensor, "3 3 batch n"]) -> Float[Tensor, "3 3 batch n"]:
    if increments.shape[-1] < 2:
        return increments
    products = torch.empty_like(increments)
    products[..., 1::2] = odd = _running(_product(increments[..., :-1:2], increments[..., 1::2]))
    products[..., :1], later = increments[..., :1], increments[..., 2::2]
    products[..., 2::2] = _product(odd[..., : later.shape[-1]], later)
    return products


def _product(A: Float[Tensor, "3 3 batch n"], B: Float[Tensor, "3 3 batch n"]) -> Float[Tensor, "3 3 batch n"]:
    return torch.addcmul(torch.addcmul(A[:, 0:1] * B[0:1], A[:, 1:2], B[1:2]), A[:, 2:3], B[2:3])


def whole_turn(xi: Float[Tensor, "batch n 3"]) -> Float[Tensor, "batch 3 3"]:
    """Product of rotations Exp(xi[0]) ... Exp(xi[n-1]).

    It takes half the time of the running product. Its derivative needs vectors alone: dR = R [sum_k S_k^T J_r(xi_k) dxi_k]x,
    S_k the product of the rotations after k.
    """
    turn: Tensor = _WholeTurn.apply(xi)  # type: ignore[no-untyped-call]  # torch gives it no type
    return turn


class _WholeTurn(torch.autograd.Function):
    """`whole_turn`."""

    @staticmethod
    def forward(ctx: Any, xi: Tensor) -> Tensor:
        increments, ctx.later = so3.exp(xi), []
        while increments.shape[1] > 1:
            paired = increments.shape[1] // 2 * 2
            ctx.later.append(increments[:, 1:paired:2])
            increments = torch.cat([increments[:, :paired:2] @ ctx.later[-1], increments[:, paired:]], dim=1)
        ctx.save_for_backward(xi, increments)
        return increments[:, 0]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        xi, whole = ctx.saved_tensors
        slope = whole.mT @ grad[:, None]
        by_turn = (slope - slope.mT).flatten(2)[..., [7, 2, 3]]  # of the end; then of each increment, down the tree
        for later in reversed(ctx.later):
            by_pair, odd = by_turn[:, : later.shape[1]], by_turn[:, later.shape[1] :]
            both = torch.stack([(later @ by_pair[..., None])[..., 0], by_pair], dim=2).flatten(1, 2)
            by_turn = torch.cat([both, odd], dim=1)
        return so3.by_vector(xi, by_turn)


def turns_from_start(gyro: Samples, dt: Steps) -> Float[Tensor, "batch n 3 3"]:
    """Attitude at each sample, in the frame of the first."""
    later = running_product(so3.exp(step_means(gyro) * dt[..., None]))
    return torch.cat([torch.eye(3).to(later).expand(len(later), 1, 3, 3), later], dim=1)


def derivative_by_sample(sensor: Sensor, turns: Float[Tensor, "batch n 3 3"], dt: Steps) -> Float[Tensor, "batch n 3 3"]:
    """Derivative of the turn or the velocity by each sample, in the frame of the first.

    Half of each step belongs to either of its samples. A rate acts at the end of its step, a specific force at its sample.
    """
    if sensor == "accel":
        return 0.5 * (pad(dt, (0, 1)) + pad(dt, (1, 0)))[..., None, None] * turns
    by_step = 0.5 * dt[..., None, None] * turns[:, 1:]
    return pad(by_step, (0, 0, 0, 0, 1, 0)) + pad(by_step, (0, 0, 0, 0, 0, 1))


def attitudes(R_start: Float[Tensor, "batch 3 3"], gyro: Samples, dt: Steps) -> Float[Tensor, "batch n 3 3"]:
    """Attitude (body to world) at each sample, from `R_start` at the first."""
    return R_start[:, None] @ turns_from_start(gyro, dt)


def end_attitude(R_start: Float[Tensor, "batch 3 3"], gyro: Samples, dt: Steps) -> Float[Tensor, "batch 3 3"]:
    """Attitude at the last sample only, at half the cost."""
    return R_start @ whole_turn(step_means(gyro) * dt[..., None])


def rotation_residual(
    gyro: Samples, dt: Steps, R_true: Float[Tensor, "batch 3 3"]
) -> tuple[Float[Tensor, "batch 3"], Float[Tensor, "batch n-1 3 3"]]:
    """Rotation residual of the integrated window, and its derivative by the rate of each step.

    Returns:
        e = Log(R_hat^T R_true) in rad, and A with e(gyro + d) = e - sum_k A_k d_k to first order in a small e, d_k the
        change of the rate over step k (`between`): it turns the step's end by d_k dt_k, transformed by the later steps.
    """
    running = running_product(so3.exp(step_means(gyro) * dt[..., None]))
    R_hat = running[:, -1]
    A = (R_hat.mT[:, None] @ running) * dt[..., None, None]
    return so3.log(R_hat.mT @ R_true), A


def velocity_residual(
    accel: Samples, dt: Steps, R_wb: Float[Tensor, "batch n 3 3"], dv_true: Float[Tensor, "batch 3"], g_w: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "batch 3"], Float[Tensor, "batch n 3 3"]]:
    """Velocity residual of the integrated specific force (m/s), and its derivative.

    Returns:
        e = dv_true - sum_k (R_k a_k + g) h_k, h the weights of the trapezoidal rule (s), and A_k = R_k h_k, so that
        e(accel + d) = e - sum_k A_k d_k exactly.
    """
    A = derivative_by_sample("accel", R_wb, dt)
    return dv_true - (A @ accel[..., None]).sum(1)[..., 0] - g_w * dt.sum(1, keepdim=True), A


@dataclass(frozen=True)
class Pieces:
    """Pieces of logs between the ends of windows: each window is a row of whole pieces.

    Windows of several lengths overlap, and the samples that they share are integrated once. Let x_k be what piece k adds, G_k
    the turn before it, and C_k the sum of G_j x_j over all pieces j before it. A window from piece a to piece e turns by
    G_a^T G_e and adds G_a^T (C_e - C_a).
    """

    begin: Int[Tensor, " c"]
    steps: Int[Tensor, " c"]

    @classmethod
    def between(cls, windows: Sequence[tuple[Int[Tensor, " _"], int]], longest: int) -> Pieces:
        """Pieces of windows (first samples, steps), of at most `longest` steps; samples in no window are left out."""
        ends = torch.cat([first + k for first, n in windows for k in (0, n)])
        opens = torch.cat([torch.full_like(first, sign) for first, _ in windows for sign in (1, -1)])
        cuts, at = torch.unique(ends, return_inverse=True)
        covered = torch.zeros_like(cuts).index_add(0, at, opens).cumsum(0)[:-1] > 0
        begin, steps = cuts[:-1][covered], cuts.diff()[covered]
        parts = -(-steps // longest)
        of, before = torch.repeat_interleave(parts), torch.cumsum(parts, 0) - parts
        k = torch.arange(len(of), device=of.device) - before[of]
        start, end = (steps[of] * j // parts[of] for j in (k, k + 1))
        return cls(begin[of] + start, end - start)

    def row(self, first: Int[Tensor, " m"], n: int) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"]]:
        """First piece of each window of n steps, and the one after its last."""
        start, end = torch.searchsorted(self.begin, torch.stack([first, first + n]))
        return start, end

    def index(self) -> Int[Tensor, "c _"]:
        """Samples of each piece. A shorter piece repeats its last one: a step without duration adds nothing."""
        k = torch.arange(int(self.steps.max()) + 1, device=self.steps.device)
        return self.begin[:, None] + torch.minimum(k, self.steps[:, None])


@dataclass(frozen=True)
class Prefix:
    """Turn G and sum C before each of the `Pieces`, and after the last."""

    turn: Float[Tensor, "c 3 3"]
    total: Float[Tensor, "c 3 k"]

    @classmethod
    def of(cls, turns: Float[Tensor, "p 3 3"], adds: Float[Tensor, "p 3 k"]) -> Prefix:
        """From the turn of each piece, and from what it adds in the frame of its first sample."""
        turn = torch.cat([torch.eye(3).to(turns)[None], running_product(turns[None])[0]])
        return cls(turn, pad(torch.cumsum(turn[:-1] @ adds, 0), (0, 0, 0, 0, 1, 0)))

    def across(self, start: Int[Tensor, " m"], end: Int[Tensor, " m"]) -> tuple[Float[Tensor, "m 3 3"], Float[Tensor, "m 3 k"]]:
        """Turn of each window, and what it adds in the frame of its first sample."""
        back = self.turn[start].mT
        return back @ self.turn[end], back @ (self.total[end] - self.total[start])


def huber_weight(size: Float[Tensor, " m"], delta: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
    """Weights of iteratively reweighted least squares for Huber's loss.

    1 up to `delta`, then falling as 1/size.
    """
    return torch.where(size <= delta, torch.ones_like(size), delta / size.clamp_min(1e-300))


def huber(size: Float[Tensor, " m"], delta: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
    """Huber's loss of normalised sizes.

    (size/delta)²/2 up to `delta`, then linear, which limits outliers.
    """
    x = size / delta
    return torch.where(x <= 1, 0.5 * x * x, x - 0.5)
