"""Derivatives of the white samples of a log by the parameters of the effects that it is fitted with."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from imutool.physics.course import Course
from imutool.physics.effects._forward import Physics
from imutool.physics.whitening import Whitener


class Slope(NamedTuple):
    """Of one effect, by axis and parameter; `on` says which of them are anything but zero."""

    white: Float64[np.ndarray, "6 p n"]
    on: Bool[np.ndarray, "6 p"]


Slopes = tuple[Slope, ...]


def slope(whiten: Whitener, course: Course, physics: Physics) -> Slope:
    """Of an effect on a course, or of a linear one that is not."""
    shape = 6, len(physics.parameters)
    white, on = np.zeros((*shape, len(range(0, len(course.pair.stamp_s), whiten.every)))), np.zeros(shape, bool)
    for axis, j, row in course.slope(physics):
        white[axis, j], on[axis, j] = whiten.one(row, axis), True
    return Slope(white, on)


def on_axis(
    slopes: Slopes, axis: int, mask: Bool[np.ndarray, " n"]
) -> tuple[Int64[np.ndarray, " q"], Float64[np.ndarray, "q m"]]:
    """Which parameters of all act on an axis, and their white derivatives there, on some rows."""
    where, rows, first = [], [], 0
    for one in slopes:
        js = np.flatnonzero(one.on[axis])
        where.append(first + js)
        rows += [one.white[axis, j][mask] for j in js]
        first += one.white.shape[1]
    at = np.concatenate([np.zeros(0, np.int64), *where])
    return at, np.stack(rows) if rows else np.zeros((0, int(mask.sum())))
