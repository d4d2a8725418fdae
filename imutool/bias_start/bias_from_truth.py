"""The constant in samples that true poses beside them show: by how much integration misses them, and how fast that grows."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from imutool.bias.model import Vector6
from imutool.geometry import so3
from imutool.inertial.strapdown import GRAVITY_W
from imutool.inertial.windows import HUBER_MEDIANS, attitudes, huber_weight, running_product, step_means

ITERATIONS = 4


def bias_from_truth(
    t_s: Float64[np.ndarray, " n"],
    samples: Float64[np.ndarray, "n 6"],
    R_wb: Float[Tensor, "n 3 3"],
    v_w: Float[Tensor, "n 3"],
    trusted: Bool[np.ndarray, " n"],
) -> Vector6:
    """The constant in samples that the truth beside them shows: the slope, in time, of what integration misses.

    Rotation and velocity are integrated from the first true pose; their misses e(t) = e_0 + (sum of A) b are fitted by all
    trusted poses with Huber's weights, e_0 being the first pose's own error. The attitude under
    the accelerometer is the true one (half a degree of drift would be a tenth of m/s²), carried through gaps by the gyro.
    """
    dt, seen = torch.from_numpy(np.diff(t_s))[None], torch.from_numpy(trusted)
    rate, force = torch.from_numpy(samples[:, :3])[None], torch.from_numpy(samples[:, 3:])[None]
    offset = torch.zeros(2, 3, dtype=torch.float64)
    for _ in range(ITERATIONS):
        running = running_product(so3.exp(step_means(rate - offset[0]) * dt[..., None]))[0]
        missed = (running @ so3.log(running.mT @ (R_wb[0].mT @ R_wb[1:]))[..., None])[..., 0]
        by_rate = torch.cumsum(running * dt[0, :, None, None], dim=0)
        offset[0] -= _slope(missed, by_rate, seen[1:])
    R_wb = _attitudes(t_s, rate - offset[0], R_wb, trusted)
    a_w = (R_wb @ force[0, ..., None])[..., 0] + torch.tensor(GRAVITY_W, dtype=torch.float64)
    risen = torch.cumsum(step_means(a_w[None])[0] * dt[0, :, None], dim=0)
    by_force = torch.cumsum(0.5 * (R_wb[:-1] + R_wb[1:]) * dt[0, :, None, None], dim=0)
    offset[1] = -_slope(v_w[1:] - v_w[0] - risen, by_force, seen[1:])
    return offset.flatten().numpy()


def _attitudes(
    t_s: Float64[np.ndarray, " n"], rate: Float[Tensor, "1 n 3"], R_wb: Float[Tensor, "n 3 3"], trusted: Bool[np.ndarray, " n"]
) -> Float[Tensor, "n 3 3"]:
    """The integrated attitude, turned by what it misses of the trusted poses, and in gaps by what lies between."""
    R_hat = attitudes(R_wb[:1], rate, torch.from_numpy(np.diff(t_s))[None])[0]
    missed = so3.log(R_hat.mT @ R_wb).numpy()
    filled = [np.interp(t_s, t_s[trusted], missed[trusted, axis]) for axis in range(3)]
    return torch.as_tensor(R_hat @ so3.exp(torch.from_numpy(np.stack(filled, axis=1))))


def _slope(missed: Float[Tensor, "n 3"], by: Float[Tensor, "n 3 3"], seen: Bool[Tensor, " n"]) -> Float[Tensor, "3"]:
    """b of missed = e_0 + by b, by least squares with Huber's weights."""
    y, X = missed[seen], torch.cat([by[seen], torch.eye(3, dtype=by.dtype).expand(int(seen.sum()), 3, 3)], dim=2)
    root = torch.ones(len(y), dtype=y.dtype)
    for _ in range(ITERATIONS):
        weighted = (X * root[:, None, None]).flatten(0, 1), (y * root[:, None]).reshape(-1, 1)
        found = torch.linalg.lstsq(*weighted).solution[:, 0]
        size = (y - X @ found).norm(dim=1)
        root = huber_weight(size, (HUBER_MEDIANS * size.median()).clamp_min(1e-9).expand(len(size))).sqrt()
    return torch.as_tensor(found[:3])
