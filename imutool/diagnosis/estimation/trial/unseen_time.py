"""Unseen time: what the chosen effects gain on blocks that their fit has not seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import norm, wilcoxon
from scipy.stats import t as student

from imutool.array_types import Float64
from imutool.diagnosis.estimation.gauss_newton import Fit, fit, without_effects
from imutool.diagnosis.estimation.jacobians import Chosen, ForwardPass, sets_in
from imutool.diagnosis.estimation.whitening import WhitenedLog


def first_refuted(fitted: Fit, first: int) -> int:
    """Index of the first effect that unseen blocks refute; the number of effects if none is.

    Blocks that this fit has not seen, and those that a fit of the others has not. Against poses effects without a name have to
    stand together, too: two that cancel gain much together. What sets in once changes the constant, and all unseen
    blocks may lie behind it: the constant is that of the blocks that were fitted.
    """
    (other, hidden), exact = _fit_of_others(fitted), all(log.pair.exact for log in fitted.logs)
    misfit = max(1.0, fitted.reduced_chi_square)
    nameless = [k for k, (effect, _) in enumerate(fitted.chosen) if effect.kind != "catalogue" and not exact]

    def p_value(left_out: Sequence[int]) -> float:
        directions = ((fitted, other),) if hidden.intersection(left_out) else ((fitted, other), (other, fitted))
        both = [(f, without_effects(f, left_out, first), unseen.part) for f, unseen in directions]
        once = any(sets_in(fitted.chosen[k][0]).any() for k in left_out)
        blocks = np.concatenate([held_out_gains(f, others, part, f.part if once else part) for f, others, part in both])
        return min(held_out_p_value(blocks[:, 0]), prediction_p_value(blocks, misfit) if exact else 1.0)

    for k in range(first, len(fitted.chosen)):
        tested = [[k], nameless] if k in nameless and len(nameless) > 1 else [[k]]
        if max(map(p_value, tested)) > fitted.logs[0].pair.settings.search.held_out_p_value:
            return k
    return len(fitted.chosen)


def _fit_of_others(fitted: Fit) -> tuple[Fit, set[int]]:
    """Fit of the held-out blocks with the same onsets, and the effects, by index, that these blocks do not show.

    They lie on one side of an onset, where a step is a constant; its size there is that of the first fit.
    """
    other, hidden = fit(fitted.logs, fitted.chosen, part="held_out", near=fitted, hold_onsets=True), set[int]()
    for k, (effect, _) in enumerate(fitted.chosen):
        begins = sets_in(effect)
        if begins.any() and (other.stds()[effect.key] > effect.plausible)[~begins].all():
            hidden.add(k)
    chosen = tuple(fitted.chosen[k] if k in hidden else entry for k, entry in enumerate(other.chosen))
    return (fit(fitted.logs, chosen, part="held_out", iterations=0, near=other) if hidden else other), hidden


def held_out_p_value(gained: Float64[np.ndarray, " b"]) -> float:
    """p-value of the held-out improvement under H0, by Student's t or by robust ranks."""
    if len(gained) < 3 or not gained.std():
        return 1.0
    z = gained.mean() / (gained.std(ddof=1) / np.sqrt(len(gained)))
    ranks = float(wilcoxon(gained, alternative="greater").pvalue)  # also where one block asks a curve what it has never seen
    return min(float(student.sf(z, len(gained) - 1)), ranks)


def prediction_p_value(blocks: Float64[np.ndarray, "b 2"], misfit: float) -> float:
    """p-value of held-out noise following a prediction u under H0.

    Then 2 u.n - |u|² has mean -|u|² and variance 4 |u|² times `misfit`, the reduced chi-square of what has no explanation.
    """
    gain, size = blocks.sum(axis=0)
    return float(norm.sf((gain + size) / (2.0 * np.sqrt(misfit * size)))) if size > 0 else 1.0


def held_out_gains(fitted: Fit, others: Chosen, part: str, constant_of: str) -> Float64[np.ndarray, "b 2"]:
    """Squares that a fit gains over fewer effects, and those of its prediction, by block.

    The constant of the residual is that which is best for one part or the other.
    """
    out, block_s = [], fitted.logs[0].pair.settings.search.held_out_block_s
    for log, forward, residual in zip(fitted.logs, fitted.passes, fitted.residuals, strict=True):
        other = log.residual(ForwardPass(log.pair, others, forward).blocks, (forward.blocks, residual))
        with_, without = (_white(log, corrected, part, constant_of) for corrected in (residual, other))
        block = np.floor(log.pair.stamp_s[:: log.whiten.every][log.rows(part)] / block_s).astype(int)
        each = np.stack([(without**2).sum(1) - (with_**2).sum(1), ((without - with_) ** 2).sum(1)], axis=1)
        names, inverse = np.unique(block, return_inverse=True)
        out.append(np.stack([np.bincount(inverse, weights=column, minlength=len(names)) for column in each.T], axis=1))
    return np.concatenate(out)


def _white(log: WhitenedLog, residual: Float64[np.ndarray, "m k"], part: str, constant_of: str) -> Float64[np.ndarray, "n k"]:
    """White residuals of a part, with the constant that is best for one part or the other."""
    rows, fitted = log.rows(part), log.rows(constant_of)
    constant = log.constants[fitted]
    size = (constant * residual[fitted]).sum(0) / np.maximum((constant * constant).sum(0), 1e-300)
    return np.asarray(residual[rows] - log.constants[rows] * size)
