"""Delay of true poses against a gyroscope, by windows that start from the truth."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.geometry import quaternion
from imutool.inertial.scoring.path_blocks import WindowPiece
from imutool.recording import Poses, seconds
from imutool.recording.columns import median

FEWEST_WINDOWS, MAX_MISSED = 10, 4.0  # that show a delay of the poses; of the median error of windows, that of one that counts
Vectors = Float64[np.ndarray, "m 3"]


def pose_delay(pieces: Iterable[WindowPiece]) -> tuple[float, float] | None:
    """Delay of the true poses (s) and its standard deviation, by windows; None for few of them.

    A path is the integration of debiased samples on the stamps of the truth, with a row beyond its windows at both ends. Where
    the poses are late by d, a window from one pose to another misses (w_last - w_first) d, with the angular rate w in the
    world, by first order. Windows of poses that jump do not count.
    """
    found = [_error_and_miss(*piece) for piece in pieces]
    if sum(len(error) for error, _ in found) < FEWEST_WINDOWS:
        return None
    error, miss = (np.concatenate(column) for column in zip(*found, strict=True))
    size = quaternion.length(error)
    kept = size <= MAX_MISSED * median(size)
    error, miss = error[kept], miss[kept]
    power = max(float((miss**2).sum()), np.finfo(np.float64).tiny)
    delay_s = float((miss * error).sum()) / power
    variance = float(((error - delay_s * miss) ** 2).sum()) / (3 * len(error) - 1)
    return delay_s, float(np.sqrt(variance / power))


def _error_and_miss(path: Poses, truth: Poses, windows: Int64[np.ndarray, "_ 2"]) -> tuple[Vectors, Vectors]:
    """Rotation error of each window, and what a delay of one second would make of it."""
    first, last = windows[(windows[:, 0] > 0) & (windows[:, 1] < len(path) - 1)].T
    turned = quaternion.multiply(quaternion.inverse(path.q_wb_wxyz[first]), path.q_wb_wxyz[last])
    error = quaternion.log(
        quaternion.multiply(quaternion.multiply(truth.q_wb_wxyz[first], turned), quaternion.inverse(truth.q_wb_wxyz[last]))
    )
    to_truth = quaternion.multiply(truth.q_wb_wxyz[first], quaternion.inverse(path.q_wb_wxyz[first]))
    t_s, rates = seconds(path.t_ns, int(path.t_ns[0])), []
    for row in (first, last):
        step = quaternion.multiply(path.q_wb_wxyz[row + 1], quaternion.inverse(path.q_wb_wxyz[row - 1]))
        rates.append(quaternion.log(step) / (t_s[row + 1] - t_s[row - 1])[:, None])
    return error, quaternion.rotate(to_truth, rates[1] - rates[0])
