"""Unit of positions, by the acceleration that the accelerometer measures.

Positions in another unit than metres accelerate a hundred or a thousand times too much. They are named only where metres
explain less than no motion at all would, and the other unit more than noise in metres ever could.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.cleaning.likelihood import SURE, choose
from imutool.recording.columns import median

Residuals = Callable[[float, int], Float64[np.ndarray, "..."]]

POSITIONS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}  # metres of one unit
RIVALS = 0.5, 1.0, 2.0  # of a unit: positions of no certain scale, as of one camera, fit another factor better
WIDTHS = 1, 2, 4  # rows over which the errors are averaged: noise of positions averages out sooner than the motion
LEAST_SHARE = 0.1  # of the squared misfit that a unit explains; noise times a factor k explains k of it at best, 0.01 in cm


def position_unit(residuals: Residuals, readings: int, blocks: Int64[np.ndarray, " n"]) -> str:
    """Unit of positions by the misfit of their acceleration.

    Metres where the motion shows no other.
    `residuals` gives the misfit (m/s²) of a reading of axes and gravity, for positions multiplied by a factor. A constant
    misfit is of the accelerometer's scale and bias, and counts for nothing.
    """
    for width in WIDTHS:
        averaged = partial(_averaged, residuals, width)
        if unit := _unit(averaged, readings, blocks[width - 1 : len(blocks) - width + 1]):
            return unit
    return "m"


def _averaged(residuals: Residuals, width: int, factor: float, row: int) -> Float64[np.ndarray, "m 3"]:
    """Triangular average of the misfits, as second differences over `width` rows average an acceleration."""
    triangle = np.convolve(np.full(width, 1.0 / width), np.full(width, 1.0 / width))
    return np.stack([np.convolve(column, triangle, mode="valid") for column in residuals(factor, row).T], axis=1)


def _unit(residuals: Residuals, readings: int, blocks: Int64[np.ndarray, " n"]) -> str:
    """Unit that errors show; empty where they show none."""
    still, metres = (_best(partial(residuals, factor), readings, blocks) for factor in (0.0, 1.0))
    if still is None or metres is None:
        return ""
    if median(metres) < median(still):
        return "m"
    found = {"": still, "m": metres}
    for unit in ("cm", "mm"):
        rivals = [_best(partial(residuals, POSITIONS[unit] * rival), readings, blocks) for rival in RIVALS]
        scales = choose(np.stack([row for row in rivals if row is not None]), blocks)
        if scales is not None and RIVALS[scales.best] == 1.0 and (row := rivals[scales.best]) is not None:
            found[unit] = row
    choice = choose(np.stack([*found.values()]), blocks)
    if choice is None or choice.certain < SURE:
        return ""
    of_still, left = choice.misfit[0] ** 2, choice.misfit[choice.best] ** 2
    return [*found][choice.best] if of_still - left > LEAST_SHARE * of_still else ""


def _best(
    residuals: Callable[[int], Float64[np.ndarray, "n 3"]], readings: int, blocks: Int64[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"] | None:
    """Errors of the best reading, about their median."""
    choice = choose(np.stack([np.linalg.norm(residuals(row), axis=1) for row in range(readings)]), blocks)
    if choice is None:
        return None
    best = residuals(choice.best)
    return np.asarray(np.linalg.norm(best - median(best), axis=1))
