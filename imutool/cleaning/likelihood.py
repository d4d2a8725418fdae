"""Choice among readings of the same data, by Student's likelihood.

The ratio of likelihoods is tested over blocks of time, as neighbours are not independent (Vuong, Likelihood ratio tests for
model selection, Econometrica 57, 1989, eq. 5.6).
"""

from __future__ import annotations

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
    misfit = np.sqrt(median(errors**2, axis=1))
    sigma = max(float(misfit.min()), 1e-9)
    likelihood = -0.5 * (STUDENT + 3.0) * np.log1p((errors / sigma) ** 2 / STUDENT)
    sums = np.stack([np.bincount(inverse, row) for row in likelihood])
    best = int(np.argmax(sums.sum(axis=1)))
    ahead = sums[best] - sums
    error = ahead.std(axis=1, ddof=1) * np.sqrt(len(number))
    z = np.where(error > 0, ahead.sum(axis=1) / np.maximum(error, 1e-300), 0.0)
    others = np.delete(z, best)
    return Choice(best, float(others.min()), misfit, z < SURE)
