"""Readings of the axes of a sensor, and the choice among readings by Student's likelihood.

The ratio of likelihoods is tested over blocks of time, as neighbours are not independent (Vuong, Likelihood ratio tests for
model selection, Econometrica 57, 1989, eq. 5.6).
"""

from __future__ import annotations

from functools import cache
from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from imutool.array_types import Bool, Float64, Int64
from imutool.recording.columns import median

SURE = 3.0  # standard errors of the log likelihood ratio
CLEARLY = 0.5  # of the misfit of a zero reading, or of the log as it is, that of the best reading at most
STUDENT = 3.0  # degrees of freedom of the errors, so that a jolt does not decide
BLOCKS_S, FEWEST_BLOCKS = 1.0, 8


class Choice(NamedTuple):
    """Best of several rows of errors.

    `certain` is its lead over the second best in standard errors.
    """

    best: int
    certain: float
    misfit: Float64[np.ndarray, " c"]
    alike: Bool[np.ndarray, " c"]  # not told from the best


def choose(errors: Float64[np.ndarray, "c n"], blocks: Int64[np.ndarray, " n"]) -> Choice | None:
    """Best row of errors, by Student's likelihood; None for too little time.

    `certain` is the smallest ratio of the mean of the blocks' likelihood ratios to its standard error.
    """
    number, inverse = np.unique(blocks, return_inverse=True)
    if len(number) < FEWEST_BLOCKS:
        return None
    squares = errors**2
    misfit = np.sqrt(median(squares, axis=1))
    sigma = max(float(misfit.min()), 1e-9)
    likelihood = -0.5 * (STUDENT + 3.0) * np.log1p(squares / (STUDENT * sigma**2))
    sums = np.stack([np.bincount(inverse, row) for row in likelihood])
    best = int(np.argmax(sums.sum(axis=1)))
    ahead = sums[best] - sums
    error = ahead.std(axis=1, ddof=1) * np.sqrt(len(number))
    z = np.where(error > 0, ahead.sum(axis=1) / np.maximum(error, 1e-300), 0.0)
    return Choice(best, float(np.delete(z, best).min()), misfit, z < SURE)


class Reading(NamedTuple):
    """Signed permutation and unit of a sensor: true = factor * axes @ measured."""

    axes: Float64[np.ndarray, "3 3"]
    unit: str
    certain: float  # standard errors of the likelihood ratio against the second best
    misfit: float
    misfit_as_is: float
    sole: bool = True  # else the nearest to the log's axes of several that fit alike
    straight: bool = False  # whether the best rotation is a small one, although other axes fit, too

    @property
    def names(self) -> str:
        """Axis names, as `+x +z -y`."""
        return axis_names(self.axes)

    @property
    def wrong(self) -> bool:
        """Whether other axes than the log's fit, and clearly better."""
        return not self.as_is and self.misfit < CLEARLY * self.misfit_as_is

    @property
    def as_is(self) -> bool:
        """Whether the axes are those of the log."""
        return bool((self.axes == np.eye(3)).all())


@cache
def signed_permutations() -> Float64[np.ndarray, "48 3 3"]:
    """Signed permutations of three axes: 24 rotations and 24 reflections, the identity first.

    Read-only: all callers share it.
    """
    signed = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            P = np.zeros((3, 3))
            P[range(3), order] = signs
            signed.append(P)
    every = np.stack(signed)
    every.flags.writeable = False
    return every


def axis_names(P: Float64[np.ndarray, "3 3"]) -> str:
    """Axis names of a signed permutation, as `+x +z -y`."""
    return " ".join(f"{'+' if row[np.argmax(np.abs(row))] > 0 else '-'}{'xyz'[int(np.argmax(np.abs(row)))]}" for row in P)
