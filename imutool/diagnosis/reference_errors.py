"""A reference that is wrong for moments: what differs does so in a few short stretches, in rate and force, and nowhere else.

Poses that were lost and bridged give a simulation, or a truth, another motion there. No physics of a sensor comes for two
seconds and goes without a trace; so where all the rest is noise, the reference is to blame.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from scipy.stats import chi2

from imutool.diagnosis.estimation.jacobians import expected
from imutool.diagnosis.estimation.whitening import WhitenedImu
from imutool.diagnosis.result import Estimate, Finding, HeldOut, Located
from imutool.units import ASCII_UNITS, AXES, SENSORS

BLOCK_S = 0.25
STANDS_OUT = 1e-7  # chance of a block of noise
MOST_OF_TIME = 0.15
MOST_RUNS, LONGEST_S = 8, 4.0
QUIET = 1.1  # squares left a row outside
JOIN_S = 0.6


def wrong_for_moments(logs: Sequence[WhitenedImu]) -> tuple[list[Finding], list[Located]]:
    """`reference_error` with its length and moments, and where it is; nothing where the misfit is anything else."""
    if len(logs) != 1:
        return [], []
    (log,) = logs
    rows = log.rows("all")
    if not rows.any():
        return [], []
    t_s = log.pair.stamp_s[:: log.whiten.every][rows]
    white = log.whiten(log.pair.real - expected(log.pair, ()))[rows]
    one = log.constants[rows]
    white = white - np.median(white / np.where(one == 0, 1.0, one), axis=0) * one  # a mean would carry the moments' own misfit
    block = np.floor((t_s - t_s[0]) / BLOCK_S).astype(int)
    count = np.maximum(np.bincount(block), 1)
    power = np.stack([np.bincount(block, weights=(white[:, k : k + 3] ** 2).sum(axis=1)) for k in (0, 3)])
    loud = chi2.logsf(power, 3 * count) < np.log(STANDS_OUT)
    runs = _runs(loud.any(axis=0), float(t_s[0]))
    inside = (
        np.any([(t_s >= a - BLOCK_S) & (t_s <= b + BLOCK_S) for a, b in runs], axis=0) if runs else np.zeros(len(t_s), bool)
    )
    outside = white[~inside]
    at = t_s[0] + BLOCK_S * np.arange(len(count))
    both = all(loud[:, (at >= a - 1e-6) & (at < b)].any(axis=1).all() and b - a <= LONGEST_S for a, b in runs)
    if not runs or not both or len(runs) > MOST_RUNS or inside.mean() > MOST_OF_TIME or (outside**2).mean() > QUIET:
        return [], []
    length = float(np.mean([b - a for a, b in runs]))
    parameters = {"length": Estimate(length, BLOCK_S / np.sqrt(6.0 * len(runs)) + 0.1 * length, "s")}
    parameters |= {f"t_{k}": Estimate(a, BLOCK_S, "s") for k, (a, _) in enumerate(runs)}
    excess = (white[inside] ** 2).sum() - 6.0 * inside.sum()
    share = float(np.clip(excess / max(float((white**2).sum() - 6.0 * len(white)), 1e-300), 0.0, 1.0))
    left = log.pair.real - expected(log.pair, ())
    left = left - np.median(left, axis=0)
    unseen = log.pair.held_out
    t_all = log.pair.stamp_s
    away = unseen & ~np.any([(t_all >= a - BLOCK_S) & (t_all <= b + BLOCK_S) for a, b in runs], axis=0)
    before, after = (float(np.sqrt((left[mask, 3:] ** 2).mean())) for mask in (unseen, away))
    held = HeldOut(before, after, ASCII_UNITS["accel"], round(float(unseen.sum()) * log.pair.period_s, 1))
    finding = Finding(
        "reference_error", "both", share, STANDS_OUT, STANDS_OUT, parameters, "the reference is wrong there", held
    )
    return [finding], [_where(signal, white[:, 3 * k : 3 * k + 3], inside, runs, share) for k, signal in enumerate(SENSORS)]


def _where(
    signal: str, white: Float64[np.ndarray, "n 3"], inside: np.ndarray, runs: list[tuple[float, float]], share: float
) -> Located:
    power = (white[inside] ** 2).mean(axis=0)
    axes = tuple(axis for axis, value in zip(AXES, power, strict=True) if value > 1.3)
    return Located(signal, axes or AXES, tuple(runs), "no regime: the reference's own moments", share, STANDS_OUT)


def _runs(loud: np.ndarray, start_s: float) -> list[tuple[float, float]]:
    """Stretches of loud blocks (s), those close to one another joined."""
    edges = np.diff(np.concatenate([[0], loud.astype(int), [0]]))
    out: list[tuple[float, float]] = []
    for first, last in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True):
        begin, end = start_s + float(first) * BLOCK_S, start_s + float(last) * BLOCK_S
        if out and begin - out[-1][1] < JOIN_S:
            out[-1] = out[-1][0], end
        else:
            out.append((begin, end))
    return out
