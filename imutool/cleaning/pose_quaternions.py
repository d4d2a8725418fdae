"""Quaternions of poses in another order, inverse, or of another world."""

from __future__ import annotations

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.cleaning.likelihood import CLEARLY, SURE, choose
from imutool.cleaning.truth import best_rotation
from imutool.geometry import quaternion
from imutool.recording import GRAVITY_M_S2
from imutool.recording.columns import median

MISREAD = {  # quaternions of poses: what is wrong with them, and the rows and signs that make w, x, y, z of them
    "have their w in the place of z": ((3, 0, 1, 2), (1, 1, 1, 1)),
    "have their w in the place of x": ((1, 2, 3, 0), (1, 1, 1, 1)),
    "are the inverse: they take vectors of the world to the body": ((0, 1, 2, 3), (1, -1, -1, -1)),
}
OTHER_WORLD = "are of a world whose z points the other way than that of the positions (one as in NED, one as in ENU)"


def read_right(what: str, q_wxyz: Float64[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 4"]:
    """Quaternions w, x, y, z of those that are misread in one of these ways."""
    if what == OTHER_WORLD:
        return np.asarray(quaternion.multiply(quaternion.NED_FROM_ENU, q_wxyz))
    rows, signs = MISREAD[what]
    return np.asarray(q_wxyz[:, rows] * signs)


def left_when_turned(gyro: Float64[np.ndarray, "n 3"], rate: Float64[np.ndarray, "n 3"]) -> float:
    """Median rate (rad/s) between gyro and poses, their body turned as fits best."""
    return float(median(np.linalg.norm(gyro - rate @ best_rotation(gyro, rate).T, axis=1)))


def is_other_world(
    f_b: Float64[np.ndarray, "n 3"],
    q_wb_wxyz: Float64[np.ndarray, "n 4"],
    a_w: Float64[np.ndarray, "n 3"],
    misfit: Float64[np.ndarray, "_ 3"],
    blocks: Int64[np.ndarray, " n"],
) -> bool:
    """Whether quaternions and positions are of two worlds, NED and ENU, by the specific force.

    The acceleration of the positions is that of f, turned by the quaternions, in the other world alone. `misfit` (m/s²) is the
    residual of the best reading of axes in one world.
    """
    if len(misfit) != len(f_b):
        return False
    f_w = quaternion.rotate(read_right(OTHER_WORLD, q_wb_wxyz), f_b)
    up = np.array([0.0, 0.0, GRAVITY_M_S2])
    choice = choose(np.stack([quaternion.length(x) for x in (misfit, a_w + up - f_w, a_w - up - f_w)]), blocks)
    if choice is None or choice.best == 0 or choice.certain < SURE:
        return False
    return bool(choice.misfit[choice.best] < CLEARLY * choice.misfit[0])
