"""How far an estimate is from the truth over time: errors by axis, by angle and by direction, drift since a reset, windows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial.transform import Rotation

from imutool.recording import Poses, Times

Alignment = Literal["none", "origin", "yaw", "se3"]
ALIGNMENTS: tuple[Alignment, ...] = get_args(Alignment)

Vectors = Float64[np.ndarray, "n 3"]
Line = Float64[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class Errors:
    """How far an estimate is from the truth at its own stamps; a row is NaN where there is no truth to compare with."""

    t_ns: Times
    orientation_deg: Float64[np.ndarray, "n 3"]  # Log(R_true^T R_estimated), in the true body frame
    roll_pitch_yaw_deg: Float64[np.ndarray, "n 3"]  # of R_estimated R_true^T: about the world's x, y and z (yaw: heading)
    position_m: Float64[np.ndarray, "n 3"]  # estimated minus true, world

    @property
    def orientation_total_deg(self) -> Float64[np.ndarray, " n"]:
        """The angle of the orientation error, 0 to 180 degrees."""
        return _length(self.orientation_deg)

    @property
    def position_total_m(self) -> Float64[np.ndarray, " n"]:
        """The length of the position error."""
        return _length(self.position_m)

    @property
    def horizontal_m(self) -> Float64[np.ndarray, " n"]:
        """The length of the position error in the world's horizontal plane."""
        return _length(self.position_m[:, :2])

    @property
    def vertical_m(self) -> Float64[np.ndarray, " n"]:
        """The position error upwards, with its sign."""
        return self.position_m[:, 2]


@dataclass(frozen=True, eq=False)
class Drift:
    """How far integration has drifted since it was last set to the truth, every `reset_s`; NaN where there is no truth."""

    reset_s: float
    t_ns: Times
    since_s: Float64[np.ndarray, " n"]  # time since the reset
    orientation_deg: Float64[np.ndarray, " n"]
    velocity_m_s: Float64[np.ndarray, " n"]
    position_m: Float64[np.ndarray, " n"]


@dataclass(frozen=True)
class Window:
    """Root mean square errors at the ends of windows of one length that each start from the truth."""

    length_s: float
    count: int
    orientation_deg: float
    velocity_m_s: float
    position_m: float


def errors(estimate: Poses, truth: Poses, valid: Bool[np.ndarray, " n"]) -> Errors:
    """The error of an estimate against the truth at the same stamps, NaN where `valid` is false."""
    true, found = (Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True) for poses in (truth, estimate))
    hole = np.where(valid, 0.0, np.nan)[:, None]
    turned = np.rad2deg((true.inv() * found).as_rotvec())
    yaw_pitch_roll = (found * true.inv()).as_euler("ZYX", degrees=True)
    position = estimate.p_wb - truth.p_wb
    return Errors(estimate.t_ns, turned + hole, yaw_pitch_roll[:, ::-1] + hole, position + hole)


def _length(rows: Float64[np.ndarray, "n k"]) -> Line:
    length: Line = np.linalg.norm(rows, axis=1)
    return length
