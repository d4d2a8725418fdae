"""Stereo camera on the body: EuRoC's, rectified, without distortion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

Points = Float64[np.ndarray, "n 3"]


@dataclass(frozen=True, eq=False)
class StereoRig:
    """Two equal pinhole cameras side by side; camera frame.

    x right, y down, z forward, origin in the left one.

    `R_bc`, `p_bc` take points of the left camera's frame to the body's (the IMU's); the right camera sits `baseline_m` along
    the left one's x.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    baseline_m: float
    R_bc: Float64[np.ndarray, "3 3"]
    p_bc: Float64[np.ndarray, "3"]
    name: str = ""

    def project(self, p_c: Points) -> Points:
        """Pixels (u left, u right, v) of points before the camera.

        u = cx + fx x / z, u right = u - fx baseline / z, v = cy + fy y / z. What lies behind (z <= 0) comes out as NaN.
        """
        z = np.where(p_c[:, 2] > 0.0, p_c[:, 2], np.nan)
        u_left = self.cx + self.fx * p_c[:, 0] / z
        return np.stack([u_left, u_left - self.fx * self.baseline_m / z, self.cy + self.fy * p_c[:, 1] / z], axis=1)

    def back_project(self, pixels: Points) -> Points:
        """Points in the camera frame that project to some pixels; the disparity must be positive."""
        z = self.fx * self.baseline_m / (pixels[:, 0] - pixels[:, 1])
        return np.stack([(pixels[:, 0] - self.cx) / self.fx * z, (pixels[:, 2] - self.cy) / self.fy * z, z], axis=1)

    def in_view(self, pixels: Points) -> Bool[np.ndarray, " n"]:
        """Whether a point falls inside both images; false for NaN."""
        with np.errstate(invalid="ignore"):
            columns = (pixels[:, :2] >= 0.0) & (pixels[:, :2] <= self.width - 1.0)
            return np.asarray(columns.all(axis=1) & (pixels[:, 2] >= 0.0) & (pixels[:, 2] <= self.height - 1.0))


def _fixed(rows: list[list[float]] | list[float]) -> np.ndarray:
    values = np.array(rows, dtype=np.float64)
    values.flags.writeable = False
    return values


# sensor.yaml of cam0 of the EuRoC data set (T_BS and intrinsics), Burri et al. 2016; the other camera 0.11 m to its right.
EUROC = StereoRig(
    fx=458.654,
    fy=457.296,
    cx=367.215,
    cy=248.375,
    width=752,
    height=480,
    baseline_m=0.11,
    R_bc=_fixed(
        [
            [0.0148655429818, -0.999880929698, 0.00414029679422],
            [0.999557249008, 0.0149672133247, 0.025715529948],
            [-0.0257744366974, 0.00375618835797, 0.999660727178],
        ]
    ),
    p_bc=_fixed([-0.0216401454975, -0.064676986768, 0.00981073058949]),
    name="EuRoC's cam0 as a rectified stereo pair, 0.11 m apart",
)
