"""Mean angular rates between poses."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from imutool.recording import Poses


def rates_from_poses(poses: Poses) -> Float64[np.ndarray, "n 3"]:
    """Mean angular rate (rad/s, body frame) over each interval between consecutive poses: Log(R_k^T R_{k+1}) / dt.

    One row less than there are poses. A turn of more than pi between two poses is read as its shorter complement.
    """
    rotations = Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True)
    dt = np.diff(poses.t_ns).astype(np.float64) * 1e-9
    turned: Float64[np.ndarray, "n 3"] = (rotations[:-1].inv() * rotations[1:]).as_rotvec() / dt[:, None]
    return turned
