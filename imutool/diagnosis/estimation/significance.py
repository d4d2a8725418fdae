"""What speaks for an effect: the chance of its gain, and what it brings on blocks of time that a fit has not seen."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from scipy.special import gammaincc, gammainccinv, gammaln
from scipy.stats import norm, wilcoxon
from scipy.stats import t as student

from imutool.diagnosis.estimation.forward_cache import Chosen
from imutool.diagnosis.estimation.gauss_newton import Fit, WhitenedLog, expected

BLOCK_S = 2.0
FAR_OUT = 300.0  # half the gain, above which the tail itself is less than a number can hold


def log_p_value(gain: float, parameters: int) -> float:
    """The logarithm of the chance that noise alone gains as much by so many parameters (far out, the tail's leading term)."""
    half, k = 0.5 * max(gain, 0.0), 0.5 * parameters
    return float(np.log(gammaincc(k, half))) if half < FAR_OUT else float((k - 1.0) * np.log(half) - half - gammaln(k))


def gain_for(log_chance: float, parameters: int) -> float:
    """The squares that so many parameters gain with such a chance."""
    return float(2.0 * gammainccinv(0.5 * parameters, np.exp(max(log_chance, -FAR_OUT))))


def held_out_p_value(gained: Float64[np.ndarray, " b"]) -> float:
    """The chance of blocks gaining so much when they gain nothing: by Student's test, or by ranks where a few gain most."""
    if len(gained) < 3 or not gained.std():
        return 1.0
    z = gained.mean() / (gained.std(ddof=1) / np.sqrt(len(gained)))
    ranks = float(wilcoxon(gained, alternative="greater").pvalue)  # also where one block asks a curve what it has never seen
    return min(float(student.sf(z, len(gained) - 1)), ranks)


def prediction_p_value(blocks: Float64[np.ndarray, "b 2"]) -> float:
    """The chance of unseen noise following what is predicted so well: 2 u.n - |u|² has mean -|u|² and variance 4 |u|²."""
    gain, size = blocks.sum(axis=0)
    return float(norm.sf((gain + size) / (2.0 * np.sqrt(size)))) if size > 0 else 1.0


def held_out_gains(log: WhitenedLog, fitted: Fit, k: int, part: str) -> Float64[np.ndarray, "b 2"]:
    """Squares by which each block of a part that was not fitted is better with an effect, and those of what it adds."""
    chosen = fitted.chosen
    with_, without = (_white(log, one, part) for one in (chosen, (*chosen[:k], *chosen[k + 1 :])))
    rows = log.rows(part)
    block = np.floor(log.pair.stamp_s[:: log.whiten.every][rows] / BLOCK_S).astype(int)
    each = np.stack([(without**2).sum(1) - (with_**2).sum(1), ((without - with_) ** 2).sum(1)], axis=1)
    names, inverse = np.unique(block, return_inverse=True)
    return np.stack([np.bincount(inverse, weights=column, minlength=len(names)) for column in each.T], axis=1)


def _white(log: WhitenedLog, chosen: Chosen, part: str) -> Float64[np.ndarray, "n 6"]:
    """White residuals of a part, with the best constant for that part."""
    rows = log.rows(part)
    residual = log.whiten(log.pair.real - expected(log.pair, chosen))[rows]
    one = log.constants[rows]
    return np.asarray(residual - one * ((one * residual).sum(0) / np.maximum((one * one).sum(0), 1e-300)))
