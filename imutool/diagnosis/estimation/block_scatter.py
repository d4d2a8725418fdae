"""How sure a fit is by its own residuals: what blocks of time say of each number, and how far they are of one mind.

A fit's information holds where its white residuals are white. Beside poses they seldom are: the poses' errors come with the
motion and last. The sum of J^T r over a block of some seconds scatters by what is really there, and a covariance made of those
sums ("sandwich": Liang and Zeger, Biometrika 1986) is right whatever the residuals are within a block. So few blocks flatter
themselves, for the fit went through each; that is taken off (CR2: Bell and McCaffrey, Survey Methodology 2002). A gain in
squares is divided by the mean ratio of the two covariances (the design effect: Rao and Scott, JASA 1981) and becomes an F.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.linalg import solve_triangular
from scipy.stats import f as fisher

from imutool.diagnosis.estimation import gauss_newton as fits
from imutool.diagnosis.estimation.gauss_newton import Fit, WhitenedLog

BLOCK_S = 5.0
LEAST_BLOCKS = 6
BEFORE = 6.0  # blocks that all rows together are worth in saying how far noise is what it is said to be
HELD = 1e-6  # deviation of a number that is not asked
LEVERAGE = 0.95  # of one block on a number, above which its residuals say nothing of it
Matrix = Float64[np.ndarray, "p p"]


@dataclass(frozen=True, eq=False)
class Scatter:
    """Covariance of the fit's free parameters by the blocks (no less than by information), and of each effect its place in it.

    `inflation` is the ratio of the blocks' variance to the information's by effect, at least 1; `blocks` how many independent
    ones less one that rests on.
    """

    std: dict[str, Float64[np.ndarray, " _"]]
    inflation: dict[str, float]
    blocks: dict[str, float]

    def chance(self, name: str, gain: float, parameters: int) -> float:
        """The logarithm of the chance that what scatters like this gains so many squares by so many parameters."""
        f = max(gain, 0.0) / (parameters * self.inflation[name])
        return float(fisher.logsf(f, parameters, parameters * self.blocks[name]))


def scatter(logs: Sequence[WhitenedLog], found: Fit, part: str) -> Scatter:
    """What blocks of the rows that were fitted say of how sure the fit is."""
    blocks = [one for k, log in enumerate(logs) for one in _blocks(log, found, k, part)]
    _, prior_std = fits.priors(found.chosen, found.chosen)
    prior_std = np.where(_begins(found), HELD, prior_std)
    prior = np.diag(1.0 / prior_std**2)
    lower = np.linalg.cholesky(sum((H for H, _ in blocks), start=prior))
    middle = _seen_from(lower, prior)
    shares = []
    for H, score in blocks:
        share = _seen_from(lower, H)
        leverage, axes = np.linalg.eigh(share)
        turned = axes.T @ solve_triangular(lower, score, lower=True)
        even = axes @ (turned / np.sqrt(1.0 - np.clip(leverage, 0.0, LEVERAGE)))
        middle += np.outer(even, even)
        shares.append(share)
    outer = solve_triangular(lower, np.eye(len(lower)), lower=True)  # covariance by information: outer.T @ outer
    by_blocks, by_information = outer.T @ middle @ outer, outer.T @ outer
    return _by_effect(found, by_blocks, by_information, [outer.T @ one @ outer for one in shares])


def _begins(found: Fit) -> Bool[np.ndarray, " p"]:
    """Which numbers are times at which something sets in: nothing is smooth in them, so they are taken as they are."""
    return np.array([number.begins for physics, _ in found.chosen for number in physics.parameters], dtype=bool)


def _by_effect(found: Fit, by_blocks: Matrix, by_information: Matrix, shares: Sequence[Matrix]) -> Scatter:
    std, inflation, count, first = {}, {}, {}, 0
    usual = max(1.0, found.objective / max(found.numbers, 1))
    stated = found.stds()
    for physics, theta in found.chosen:
        part = slice(first, first + len(theta))
        first += len(theta)
        own, seen = by_information[part, part], by_blocks[part, part]
        each = np.array([np.diag(one)[part] for one in shares]) / np.diag(own)
        ratio, blocks = _moderated(np.diag(seen) / np.diag(own), _effective(each), usual)
        std[physics.key] = stated[physics.key] * np.sqrt(np.maximum(1.0, np.where(_begins(found)[part], 1.0, ratio)))
        mean = np.asarray(np.trace(np.linalg.solve(own, seen)) / len(theta))
        taken = np.array([np.trace(np.linalg.solve(own, one[part, part])) for one in shares])
        ratio, blocks = _moderated(mean, _effective(taken), usual)
        inflation[physics.key], count[physics.key] = max(1.0, float(ratio)), float(blocks)
    return Scatter(std, inflation, count)


def _effective(shares: Float64[np.ndarray, "b ..."]) -> Float64[np.ndarray, "..."]:
    """How many blocks of one size are worth as much as these, of which a few may hold most."""
    return np.asarray(shares.sum(axis=0) ** 2 / np.maximum((shares**2).sum(axis=0), 1e-300))


def _moderated(
    ratio: Float64[np.ndarray, "..."], blocks: Float64[np.ndarray, "..."], usual: float
) -> tuple[Float64[np.ndarray, "..."], Float64[np.ndarray, "..."]]:
    """A ratio of variances that few blocks know, drawn to that of all rows, and what both together rest on (Smyth 2004)."""
    own = np.maximum(blocks - 1.0, 0.0)
    return np.asarray((own * ratio + BEFORE * usual) / (own + BEFORE)), np.asarray(own + BEFORE)


def _seen_from(lower: Matrix, H: Matrix) -> Matrix:
    """H in coordinates in which all information together is one."""
    half = solve_triangular(lower, H, lower=True)
    out = np.asarray(solve_triangular(lower, half.T, lower=True))
    return np.asarray(0.5 * (out + out.T))


def _blocks(log: WhitenedLog, found: Fit, k: int, part: str) -> list[tuple[Matrix, Float64[np.ndarray, " p"]]]:
    """Each block's information on the effects, and the sum of its J^T r, a constant taken out of all the log."""
    rows, begins = log.rows(part), _begins(found)
    left = log.residual(found.courses[k])[rows] - log.constants[rows] * found.bias[k]
    J = np.zeros((6, len(begins), int(rows.sum())))
    for axis in range(6):
        where, J_axis = found.slopes.on_axis(k, axis, rows)
        one = log.constants[rows, axis]
        J[axis, where] = J_axis - np.outer(J_axis @ one, one) / max(float(one @ one), 1e-300)
    J[:, begins] = 0.0
    t_s = log.pair.stamp_s[:: log.whiten.every][rows]
    duration_s = float(t_s[-1] - t_s[0])
    block = np.floor((t_s - t_s[0]) / min(BLOCK_S, duration_s / LEAST_BLOCKS)).astype(int)
    out = []
    for which in np.unique(block):
        here = block == which
        flat = J[:, :, here].transpose(1, 0, 2).reshape(len(begins), -1)
        out.append((flat @ flat.T, flat @ left[here].T.reshape(-1)))
    return out
