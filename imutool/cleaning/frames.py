"""Signed permutations of axes, and how well each fits what gravity and true poses say."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np
from jaxtyping import Float64, Int64

WINDOW = 20  # steps of 0.1 s over which the gyro must carry gravity along
MOST_WINDOWS = 400  # evenly taken from a longer log
LEAST_WINDOWS = 8
LEAST_TURN_RAD = 0.3  # over a window; less says nothing of axes


def signed_permutations() -> Float64[np.ndarray, "48 3 3"]:
    """Signed permutations of three axes: 24 rotations and 24 reflections, the identity first."""
    found = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            P = np.zeros((3, 3))
            P[range(3), order] = signs
            found.append(P)
    return np.stack(found)


def axis_names(P: Float64[np.ndarray, "3 3"]) -> str:
    """Axis names of a signed permutation, as `+x +z -y`."""
    return " ".join(f"{'+' if row[np.argmax(np.abs(row))] > 0 else '-'}{'xyz'[int(np.argmax(np.abs(row)))]}" for row in P)


def tilt_misfit(
    step: Int64[np.ndarray, " m"], mean: Float64[np.ndarray, "m 6"], candidates: Float64[np.ndarray, "c 3 3"]
) -> Float64[np.ndarray, " c"] | None:
    """Gravity misfit (rad) of each candidate M: gyro rates M omega carry gravity for 2 s.

    In the frame of a window's start, the mean specific force of its first half and of its second are both gravity and what is
    left of the motion, whose velocity has bounds; the angle between them (rad), root median square over windows that turn.
    None where fewer than 8 windows turn by 0.3 rad.
    """
    gyro, accel = _windows(step, mean)
    if len(gyro) < LEAST_WINDOWS:
        return None
    return np.array([_misfit(gyro @ M.T, accel) for M in candidates])


def _windows(
    step: Int64[np.ndarray, " m"], mean: Float64[np.ndarray, "m 6"]
) -> tuple[Float64[np.ndarray, "w n 3"], Float64[np.ndarray, "w n 3"]]:
    """Angular rate and specific force in windows that turn and have no gap."""
    count = len(step) // WINDOW
    cut = mean[: count * WINDOW].reshape(count, WINDOW, 6)
    ends = step[: count * WINDOW].reshape(count, WINDOW)[:, [0, -1]]
    whole = ends[:, 1] - ends[:, 0] == WINDOW - 1
    rate = cut[..., :3] - np.median(mean[:, :3], axis=0) if len(mean) else cut[..., :3]
    turned = np.linalg.norm(rate, axis=2).sum(axis=1) * 0.1
    rows = np.flatnonzero(whole & (turned > LEAST_TURN_RAD))
    rows = rows[:: max(1, len(rows) // MOST_WINDOWS)]
    return rate[rows], cut[rows, :, 3:]


def _misfit(rate: Float64[np.ndarray, "w n 3"], accel: Float64[np.ndarray, "w n 3"]) -> float:
    from scipy.spatial.transform import Rotation

    R = Rotation.identity(len(rate))
    carried = np.empty_like(accel)
    for k in range(WINDOW):
        half = Rotation.from_rotvec(0.05 * rate[:, k])
        R = R * half
        carried[:, k] = R.apply(accel[:, k])
        R = R * half
    first, second = carried[:, : WINDOW // 2].mean(axis=1), carried[:, WINDOW // 2 :].mean(axis=1)
    size = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    cosine = np.einsum("ij,ij->i", first, second) / np.maximum(size, 1e-12)
    return float(np.sqrt(np.median(np.arccos(cosine.clip(-1.0, 1.0)) ** 2)))
