"""Initial bias from true poses.

The constant bias that explains the drift of the integrated samples.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from imutool.bias.model import BiasModel, Vector6
from imutool.bias_start.initial_bias import (
    LEAST_STD,
    TRACKED_BY,
    InitialBias,
    accuracy,
    bias_over,
    bias_prior,
    float64,
    prior,
    widened,
)
from imutool.errors import DataError
from imutool.geometry import so3
from imutool.inertial.strapdown import GRAVITY_W, with_velocity
from imutool.inertial.windows import HUBER_MEDIANS, attitudes, huber_weight, running_product, step_means
from imutool.recording import Recording, seconds

TRUTH_S = 15.0  # length of truth for a start: of 3, 5, 8, 10 and 15 s the best on training logs left out in turn
LEAST_TRUTH_S = 1.0
WORLD_TILT_STD = np.array([0.0] * 3 + [0.1] * 3)  # m/s²: half a degree, as of EuRoC's second Vicon room (docs/diagnosis.md)
ITERATIONS = 4


def from_truth(model: BiasModel, recording: Recording, truth_s: float = TRUTH_S) -> InitialBias:
    """Initial bias from up to `truth_s` seconds of true poses and the prior; gaps do no harm.

    It holds as long as those poses last; after them the rest bias is tracked. Tracking uses gravity, and the world of the
    truth may be tilted against gravity. The tilt is a bias of the accelerometer while true poses are used, and an error later.

    Raises:
        DataError: no truth, or less than a second.
    """
    both = recording.overlap()
    imu, truth = both.imu, both.truth
    poses, trusted = with_velocity(truth).at(imu.t_ns)
    t = seconds(imu.t_ns, int(imu.t_ns[0]))
    usable = np.flatnonzero(trusted)
    usable = usable[t[usable] <= t[usable[0]] + truth_s] if len(usable) else usable
    length_s = float(t[usable[-1]] - t[usable[0]]) if len(usable) else 0.0
    if length_s < LEAST_TRUTH_S:
        expected = f"at least {LEAST_TRUTH_S:g} s of it at the start"
        raise DataError(f"{length_s:.1f} s of truth", where=recording.name, expected=expected)
    rows = slice(int(usable[0]), int(usable[-1]) + 1)
    piece, poses = imu.rows(rows), poses.rows(rows)
    assert poses.v_w is not None
    start = prior(model, int(imu.t_ns[0]))
    residual = np.concatenate([piece.gyro, piece.accel], axis=1) - bias_over(model, piece, start.rest)
    R_wb = so3.matrix_from_quaternion_wxyz(torch.from_numpy(np.array(poses.q_wb_wxyz)))
    offset = bias_from_truth(t[rows], residual, R_wb, torch.from_numpy(np.array(poses.v_w)), trusted[rows])
    variance = float64(model.truth_std) ** 2 * (TRUTH_S / length_s) ** 2
    start = replace(start, std=widened(start.std, offset, variance + WORLD_TILT_STD**2))
    rest, std = _updated(start, offset, variance)
    how = f"truth over {length_s:.1f} s{', weighed against the training runs' if model.card else ''}, {accuracy(std)}"
    if not model.card:
        return InitialBias(rest, std, how)
    mean, spread = _updated(start, offset, variance + WORLD_TILT_STD**2)
    before = replace(bias_prior(model), mean=mean, std=np.maximum(spread, LEAST_STD))
    ends_s = seconds(piece.t_ns[-1:], int(recording.imu.t_ns[0]))[0]
    return InitialBias(rest, std, f"{how}, then {TRACKED_BY}", follows=before, hold_s=float(ends_s))


def _updated(start: InitialBias, offset: Vector6, variance: Vector6) -> tuple[Vector6, Vector6]:
    """Rest bias and standard deviation after measuring an offset of the start with a variance."""
    var = start.std**2
    gain = np.divide(var, var + variance, out=np.zeros(6), where=var > 0)  # a prior of zero variance stays
    return start.rest + gain * offset, np.sqrt(gain * variance)


def bias_from_truth(
    t_s: Float64[np.ndarray, " n"],
    samples: Float64[np.ndarray, "n 6"],
    R_wb: Float[Tensor, "n 3 3"],
    v_w: Float[Tensor, "n 3"],
    trusted: Bool[np.ndarray, " n"],
) -> Vector6:
    """Constant bias of samples with true poses: the slope in time of the integration error.

    Rotation and velocity are integrated from the first true pose; their errors e(t) = e_0 + (sum of A) b are fitted at all
    trusted poses with Huber's weights, e_0 being the error of the first pose itself. The accelerometer is rotated with the true
    attitude (half a degree of drift would be a tenth of m/s²), carried through gaps by the gyro.
    """
    dt, valid = torch.from_numpy(np.diff(t_s))[None], torch.from_numpy(trusted)
    rate, force = torch.from_numpy(samples[:, :3])[None], torch.from_numpy(samples[:, 3:])[None]
    offset = torch.zeros(2, 3, dtype=torch.float64)
    for _ in range(ITERATIONS):
        running = running_product(so3.exp(step_means(rate - offset[0]) * dt[..., None]))[0]
        error = (running @ so3.log(running.mT @ (R_wb[0].mT @ R_wb[1:]))[..., None])[..., 0]
        by_rate = torch.cumsum(running * dt[0, :, None, None], dim=0)
        offset[0] -= _slope(error, by_rate, valid[1:])
    R_wb = _attitudes(t_s, rate - offset[0], R_wb, trusted)
    a_w = (R_wb @ force[0, ..., None])[..., 0] + torch.tensor(GRAVITY_W, dtype=torch.float64)
    dv = torch.cumsum(step_means(a_w[None])[0] * dt[0, :, None], dim=0)
    by_force = torch.cumsum(0.5 * (R_wb[:-1] + R_wb[1:]) * dt[0, :, None, None], dim=0)
    offset[1] = -_slope(v_w[1:] - v_w[0] - dv, by_force, valid[1:])
    return offset.flatten().numpy()


def _attitudes(
    t_s: Float64[np.ndarray, " n"], rate: Float[Tensor, "1 n 3"], R_wb: Float[Tensor, "n 3 3"], trusted: Bool[np.ndarray, " n"]
) -> Float[Tensor, "n 3 3"]:
    """Integrated attitude, corrected by its error at trusted poses, interpolated in gaps."""
    R_hat = attitudes(R_wb[:1], rate, torch.from_numpy(np.diff(t_s))[None])[0]
    error = so3.log(R_hat.mT @ R_wb).numpy()
    filled = [np.interp(t_s, t_s[trusted], error[trusted, axis]) for axis in range(3)]
    return torch.as_tensor(R_hat @ so3.exp(torch.from_numpy(np.stack(filled, axis=1))))


def _slope(error: Float[Tensor, "n 3"], by: Float[Tensor, "n 3 3"], valid: Bool[Tensor, " n"]) -> Float[Tensor, "3"]:
    """b of error = e_0 + by b, by least squares with Huber's weights."""
    y, X = error[valid], torch.cat([by[valid], torch.eye(3, dtype=by.dtype).expand(int(valid.sum()), 3, 3)], dim=2)
    root = torch.ones(len(y), dtype=y.dtype)
    for _ in range(ITERATIONS):
        weighted = (X * root[:, None, None]).flatten(0, 1), (y * root[:, None]).reshape(-1, 1)
        solution = torch.linalg.lstsq(*weighted).solution[:, 0]
        size = (y - X @ solution).norm(dim=1)
        root = huber_weight(size, (HUBER_MEDIANS * size.median()).clamp_min(1e-9).expand(len(size))).sqrt()
    return torch.as_tensor(solution[:3])
