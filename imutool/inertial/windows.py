"""What two true poses say of the samples between them: residuals over a window, and their derivative.

A window is n + 1 samples, the first and last at the two true poses. Samples are points of the signal, so the rate over a step
is the mean of its two ends. The paper's Euler rule, which holds each sample until the next, is late by half a step: against
the truth of EuRoC by 2.3 to 2.5 ms, where the mean is by less than 0.2 (`tests/bench/truth_delay.py`). Products over a window
are taken as a tree, so that a thousand samples cost ten batched multiplications and no Python loop.

Used with the measured samples to solve for a constant (`turn_on`), for a calibration (`train.closed_form`), and by the loss.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from imutool.geometry import so3

HUBER_MEDIANS = 1.5  # where a residual begins to count as an outlier, in medians of its kind

Samples = Float[Tensor, "batch n 3"]
Steps = Float[Tensor, "batch n-1"]


def step_means(u: Samples) -> Float[Tensor, "batch n-1 3"]:
    """The mean of each sample and the next: what a step from one to the other sees."""
    return 0.5 * (u[:, :-1] + u[:, 1:])


def running_product(increments: Float[Tensor, "batch n 3 3"]) -> Float[Tensor, "batch n 3 3"]:
    """Products `increments[0] @ ... @ increments[k]` for every k, in log2(n) passes (Hillis and Steele's scan)."""
    shift = 1
    while shift < increments.shape[1]:
        increments = torch.cat([increments[:, :shift], increments[:, :-shift] @ increments[:, shift:]], dim=1)
        shift *= 2
    return increments


def whole_product(increments: Float[Tensor, "batch n 3 3"]) -> Float[Tensor, "batch 3 3"]:
    """The product of all increments alone, at half the cost of the running one."""
    while increments.shape[1] > 1:
        odd = increments[:, increments.shape[1] // 2 * 2 :]
        pairs = increments[:, : increments.shape[1] // 2 * 2]
        increments = torch.cat([pairs[:, 0::2] @ pairs[:, 1::2], odd], dim=1)
    return increments[:, 0]


def attitudes(R_start: Float[Tensor, "batch 3 3"], gyro: Samples, dt: Steps) -> Float[Tensor, "batch n 3 3"]:
    """Attitude (body to world) at each sample, from `R_start` at the first."""
    later = R_start[:, None] @ running_product(so3.exp(step_means(gyro) * dt[..., None]))
    return torch.cat([R_start[:, None], later], dim=1)


def end_attitude(R_start: Float[Tensor, "batch 3 3"], gyro: Samples, dt: Steps) -> Float[Tensor, "batch 3 3"]:
    """Attitude at the last sample alone, at half the cost."""
    return R_start @ whole_product(so3.exp(step_means(gyro) * dt[..., None]))


def rotation_residual(
    gyro: Samples, dt: Steps, R_true: Float[Tensor, "batch 3 3"]
) -> tuple[Float[Tensor, "batch 3"], Float[Tensor, "batch n-1 3 3"]]:
    """How far the integrated window misses the true increment `R_start^T R_end`, and how the rate of each step moves it.

    Returns:
        e = Log(R_hat^T R_true) in rad, and A with e(gyro + d) = e - sum_k A_k d_k to first order in a small e, d_k the
        change of the rate over step k (`between`): it turns the step's end by d_k dt_k, seen through what comes after.
    """
    running = running_product(so3.exp(step_means(gyro) * dt[..., None]))
    R_hat = running[:, -1]
    A = (R_hat.mT[:, None] @ running) * dt[..., None, None]
    return so3.log(R_hat.mT @ R_true), A


def velocity_residual(
    accel: Samples, dt: Steps, R_wb: Float[Tensor, "batch n 3 3"], dv_true: Float[Tensor, "batch 3"], g_w: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "batch 3"], Float[Tensor, "batch n 3 3"]]:
    """How far the integrated specific force misses the true change of velocity (m/s), and how each sample moves it.

    Returns:
        e = dv_true - sum_k (R_k a_k + g) h_k, h the weights of the trapezoidal rule (s), and A_k = R_k h_k, so that
        e(accel + d) = e - sum_k A_k d_k exactly.
    """
    h = 0.5 * (torch.nn.functional.pad(dt, (0, 1)) + torch.nn.functional.pad(dt, (1, 0)))
    A = R_wb * h[..., None, None]
    return dv_true - (A @ accel[..., None]).sum(1)[..., 0] - g_w * dt.sum(1, keepdim=True), A


def huber_weight(size: Float[Tensor, " m"], delta: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
    """Weights of iteratively reweighted least squares for Huber's loss: 1 up to `delta`, then falling as 1/size."""
    return torch.where(size <= delta, torch.ones_like(size), delta / size.clamp_min(1e-300))


def huber(size: Float[Tensor, " m"], delta: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
    """Huber's loss of normalised sizes: (size/delta)²/2 up to `delta`, then linear, so that outliers pull no harder."""
    x = size / delta
    return torch.where(x <= 1, 0.5 * x * x, x - 0.5)
