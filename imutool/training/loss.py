"""The losses of both stages, robust and without a unit: what integration over a window misses of the truth.

The paper's are mean squares (eq. 16, 17). Here a window's error is divided by what is usual for windows of its length and log
and goes through Huber's function, so that an outlier of the motion capture pulls no harder than an ordinary window, and
windows of every length and every log count alike.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Float, Int
from torch import Tensor

from imutool.bias.model import BiasModel
from imutool.geometry import so3
from imutool.inertial.strapdown import GRAVITY_W
from imutool.inertial.windows import HUBER_MEDIANS, attitudes, between, end_attitude, huber
from imutool.training.segments import Windows
from imutool.units import Sensor


def orientation_error(model: BiasModel, windows: Windows) -> Float[Tensor, " batch"]:
    """|Log(R_hat^T R)| at the end of each window, in rad (paper, eq. 16, at the last sample)."""
    gyro = windows.segment.gyro - model.sensor_bias("gyro", windows.segment)
    R_hat = end_attitude(windows.R_start, gyro, windows.dt)
    return length(so3.log(R_hat.mT @ windows.R_end))


def motion_error(model: BiasModel, windows: Windows) -> Float[Tensor, " batch"]:
    """|v_hat - v| and |p_hat - p| / window together, at the end of each window, in m/s (paper, eq. 17, in one unit).

    The attitude follows the debiased gyro, whose weights this stage leaves alone.
    """
    segment, dt = windows.segment, windows.dt[..., None]
    with torch.no_grad():
        R_wb = attitudes(windows.R_start, segment.gyro - model.sensor_bias("gyro", segment), windows.dt)
    accel = segment.accel - model.sensor_bias("accel", segment)
    a_w = (R_wb @ accel[..., None])[..., 0] + accel.new_tensor(GRAVITY_W)
    rise = torch.cumsum(between(a_w) * dt, dim=1)
    velocity = windows.v_start + rise[:, -1] - windows.v_end
    risen = torch.cat([torch.zeros_like(rise[:, :1]), rise], dim=1)
    moved = (windows.v_start[:, None] + between(risen)) * dt
    position = (windows.p_start + moved.sum(1) - windows.p_end) / windows.dt.sum(1, keepdim=True)
    return length(torch.cat([velocity, position], dim=1))


def error(model: BiasModel, sensor: Sensor, windows: Windows) -> Float[Tensor, " batch"]:
    """The error that trains a sensor: orientation for the gyro (rad), motion for the accelerometer (m/s)."""
    return orientation_error(model, windows) if sensor == "gyro" else motion_error(model, windows)


class RobustLoss:
    """Huber's loss, its width 1.5 medians of the errors that windows of this length of this log had at the stage's start.

    Fixed during a stage, so that the loss can be followed; by log, because truths differ in quality by a factor of eight.
    """

    def __init__(self, medians: Mapping[int, Float[Tensor, " logs"]]) -> None:
        self.medians = medians

    def __call__(self, size: Float[Tensor, " batch"], log: Int[Tensor, " batch"], n: int) -> Float[Tensor, ""]:
        """Mean loss of windows of n steps."""
        return huber(size, HUBER_MEDIANS * self.medians[n][log]).mean()


def length(v: Float[Tensor, "*batch k"]) -> Float[Tensor, "*batch"]:
    """Euclidean length with a finite gradient at zero."""
    return (v.square().sum(dim=-1) + 1e-24).sqrt()
