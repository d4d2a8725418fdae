"""Unit of positions, by the acceleration that the accelerometer measures.

Positions in another unit than metres accelerate a hundred or a thousand times too much. They are named only where metres
explain less than no motion at all would, and the other unit more than noise in metres ever could.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.cleaning.likelihood import SURE, choose
from imutool.recording.columns import median

POSITIONS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}  # metres of one unit
RIVALS = 0.5, 1.0, 2.0  # of a unit: positions of no certain scale, as of one camera, fit another factor better
WIDTHS = 1, 2, 4  # rows over which the errors are averaged: noise of positions averages out sooner than the motion
MIN_SHARE = 0.1  # of the squared misfit that a unit explains; noise times a factor k explains k of it at best, 0.01 in cm


class Misfits(NamedTuple):
    """Acceleration of the poses less that of the accelerometer, for each reading of its axes.

    Attributes:
        a_w: acceleration in the world, in the positions' unit (per s²).
        turned: specific force in the world (m/s²), by each reading of the axes.
        gravity: acceleration of a body at rest (m/s²), by each reading of the axis that is up. Reading `row` of the misfits
            is `divmod(row, len(gravity))`.
    """

    a_w: Float64[np.ndarray, "n 3"]
    turned: Float64[np.ndarray, "k n 3"]
    gravity: Float64[np.ndarray, "u 3"]

    def of(self, factor: float, row: int) -> Float64[np.ndarray, "n 3"]:
        """Misfits (m/s²) of a reading, for positions multiplied by a factor."""
        k, up = divmod(row, len(self.gravity))
        return np.asarray(factor * self.a_w + self.gravity[up] - self.turned[k])

    def sizes(self, factor: float) -> Float64[np.ndarray, "r n"]:
        """Lengths of the misfits of every reading."""
        moved = np.moveaxis(factor * self.a_w + self.gravity[:, None], -1, 0)  # norm(axis=2) takes three times as long
        squares = (sum((to - of) ** 2 for to, of in zip(moved, turned.T, strict=True)) for turned in self.turned)
        return np.asarray(np.sqrt(np.concatenate([*squares])))

    def averaged(self, width: int) -> Misfits:
        """Triangular averages, as second differences over `width` rows average an acceleration."""
        triangle = np.convolve(np.full(width, 1.0 / width), np.full(width, 1.0 / width))
        a_w, *turned = (
            np.stack([np.convolve(column, triangle, mode="valid") for column in rows.T], axis=1)
            for rows in (self.a_w, *self.turned)
        )
        return Misfits(a_w, np.stack(turned), self.gravity)


def position_unit(misfits: Misfits, blocks: Int64[np.ndarray, " n"]) -> str:
    """Unit of positions by the misfit of their acceleration.

    Metres where the motion shows no other.
    A constant misfit is of the accelerometer's scale and bias, and counts for nothing.
    """
    for width in WIDTHS:
        if unit := _unit(misfits.averaged(width), blocks[width - 1 : len(blocks) - width + 1]):
            return unit
    return "m"


def _unit(misfits: Misfits, blocks: Int64[np.ndarray, " n"]) -> str:
    """Unit that errors show; empty where they show none."""
    still, metres = (_best(misfits, factor, blocks) for factor in (0.0, 1.0))
    if still is None or metres is None:
        return ""
    if median(metres) < median(still):
        return "m"
    found = {"": still, "m": metres}
    for unit in ("cm", "mm"):
        rivals = [_best(misfits, POSITIONS[unit] * rival, blocks) for rival in RIVALS]
        scales = choose(np.stack([row for row in rivals if row is not None]), blocks)
        if scales is not None and RIVALS[scales.best] == 1.0 and (row := rivals[scales.best]) is not None:
            found[unit] = row
    choice = choose(np.stack([*found.values()]), blocks)
    if choice is None or choice.certain < SURE:
        return ""
    of_still, of_best = choice.misfit[0] ** 2, choice.misfit[choice.best] ** 2
    return [*found][choice.best] if of_still - of_best > MIN_SHARE * of_still else ""


def _best(misfits: Misfits, factor: float, blocks: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"] | None:
    """Errors of the best reading, about their median."""
    choice = choose(misfits.sizes(factor), blocks)
    if choice is None:
        return None
    best = misfits.of(factor, choice.best)
    return np.asarray(np.linalg.norm(best - median(best), axis=1))
