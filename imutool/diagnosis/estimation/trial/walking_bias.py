"""Walking bias: the random walk that a residual shows, and the squares it explains."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.special import softmax

from imutool.array_types import Bool, Float64, Int64
from imutool.diagnosis.estimation.gauss_newton import Fit, direction, fit
from imutool.diagnosis.estimation.jacobians import Jacobians, bound_slopes
from imutool.diagnosis.estimation.whitening import WhitenedImu, WhitenedLog, settled
from imutool.noise.bias_walk import WalkLikelihood, walk_likelihood

Axes = Float64[np.ndarray, " _"]
OnAxis = tuple[Int64[np.ndarray, " q"], Float64[np.ndarray, "q _"]]  # parameters that act on an axis, and their derivatives


def with_bias_walk(found: Fit) -> Fit:
    """Fit with the random walk of the biases that its residual shows; itself without one."""
    plain = [replace(log, whiten=replace(log.whiten, walk=None)) for log in found.logs]
    walks = [np.zeros(log.pair.columns) for log in plain]
    for k, (log, forward) in enumerate(zip(plain, found.passes, strict=True)):
        jacobians = Jacobians([log.whiten], [forward], found.chosen)
        for axes, steps, each in _walks(log, log.residual(forward.blocks), partial(jacobians.on_axis, 0)):
            likely = sum((likelihood.of_any_noise() for likelihood in each), start=np.zeros(len(steps)))
            best = _likeliest(likely)
            if 2.0 * (likely[best] - likely[0]) > log.pair.settings.search.clearly_better:
                walks[k][axes] = steps[best] * np.array([likelihood.white()[best] for likelihood in each])
    if not any(walk.any() for walk in walks) and all(log.whiten.walk is None for log in found.logs):
        return found
    logs = [replace(log, whiten=replace(log.whiten, walk=walk)) for log, walk in zip(plain, walks, strict=True)]
    return fit(logs, found.chosen, part=found.part, hold_onsets=True)


def std_of_unseen_walk(found: Fit) -> dict[str, Axes]:
    """Deviations that walks of the biases add which the noise does not have, by effect.

    A residual shows a slow walk too little to tell it from none, yet it moves what was fitted as if there were none. Its
    steps have the mean variance s of all that are looked for, each as likely as the residual says. They sum up, so that the
    estimate scatters by s C J^T W J C, with W_ij = min(i, j) the covariance of a walk of unit steps.
    """
    middle = np.zeros_like(found.covariance)
    for k, log in enumerate(found.logs):
        in_noise, rows = log.whiten.walk, log.rows(found.part)
        for axes, steps, each in _walks(log, found.residuals[k], partial(found.jacobians.on_axis, k)):
            likely = sum((likelihood.of_any_noise() for likelihood in each), start=np.zeros(len(steps)))
            if (in_noise is not None and in_noise[axes].any()) or int(np.argmax(likely)) == len(steps) - 1:
                continue
            weight = softmax(likely)
            for axis, likelihood in zip(axes.tolist(), each, strict=True):
                where, J = found.jacobians.on_axis(k, axis, rows)
                constant = direction(log.constants[rows, axis])
                moves = np.zeros((len(where), len(rows)))
                moves[:, rows] = J - np.outer(J @ constant, constant)
                moves = np.cumsum(moves[:, ::-1], axis=1)  # by a step at each row, which all later ones keep
                middle[where[:, None], where] += float(weight @ (steps * likelihood.white())) * moves @ moves.T
    moved = found.covariance @ middle @ found.covariance
    out = {}
    for effect, theta in found.chosen:
        slopes, own = bound_slopes(effect, theta), moved[found.place(effect.key), found.place(effect.key)]
        out[effect.key] = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", slopes, own, slopes), 0.0))
    return out


def squares_of_walk(found: Fit, like: Fit, *, of_any_speed: bool) -> float:
    """Squares that random walks of the biases explain of a fit's residual.

    They are twice the gain in log-likelihood, and what the fit itself did not reach; none of a sensor whose noise has its walk
    already. `like` is the fit whose derivatives serve, with the same effects and perhaps more. Against walks of any speed the
    noise is what the samples scatter within half a second: all that is left would count a fast walk as noise.
    """
    gained = 0.0
    kept = [j for key in found.keys for j in range(*like.place(key).indices(len(like.prior)))]
    for k, log in enumerate(found.logs):

        def on_axis(axis: int, rows: Bool[np.ndarray, " n"], k: int = k) -> OnAxis:
            where, J = like.jacobians.on_axis(k, axis, rows)
            return where[np.isin(where, kept)], J[np.isin(where, kept)]

        for axes, steps, each in _walks(log, found.residuals[k], on_axis, of_any_speed=of_any_speed):
            if log.whiten.walk is not None and log.whiten.walk[axes].any():
                continue
            noise = max([1.0, *([likelihood.within for likelihood in each] if of_any_speed else [like.reduced_chi_square])])
            likely = sum((likelihood.gain(noise) for likelihood in each), start=np.zeros(len(steps)))
            gained += 2.0 * noise * float(likely[int(np.argmax(likely)) if of_any_speed else _likeliest(likely)])
    return gained


def _likeliest(likely: Axes) -> int:
    """Index of the likeliest walk; none where that is the fastest, for what is faster is a motion's misfit."""
    best = int(np.argmax(likely))
    return best if best < len(likely) - 1 else 0


def _walks(
    log: WhitenedLog,
    residual: Float64[np.ndarray, "n k"],
    on_axis: Callable[[int, Bool[np.ndarray, " n"]], OnAxis],
    *,
    of_any_speed: bool = False,
) -> Iterator[tuple[Int64[np.ndarray, " a"], Float64[np.ndarray, " w"], list[WalkLikelihood]]]:
    """Axes of each sensor of an IMU, which walk alike, steps of a walk from row to row, and their likelihood by axis."""
    if not isinstance(log, WhitenedImu):
        return
    pair, own, every = log.pair, log.pair.settings.noise, log.whiten.every
    t_s, row_s = pair.stamp_s[::every] - pair.stamp_s[0], pair.period_s * every
    block_s = max(own.walk_mean_s, float(t_s[-1]) / own.walk_means)
    corners_hz = np.geomspace(min(own.walk_cycles / t_s[-1], own.walk_hz), own.walk_hz, own.walk_corners)
    if of_any_speed:
        corners_hz = np.append(corners_hz, np.geomspace(own.walk_hz, own.walk_fastest_hz, own.walk_fast_corners + 1)[1:])
    steps = np.append(0.0, (2.0 * np.pi * corners_hz * row_s) ** 2)  # at the corner both noises have one density
    known = pair.axes if pair.known is None else np.asarray(pair.known.all(axis=0))
    for part in pair.signals.values():
        found = dict[int, WalkLikelihood]()
        for axis in [k for k in range(*part.indices(len(known))) if known[k]]:
            rows = settled(pair.usable[::every, axis], log.whiten.order)
            derivatives = np.concatenate([log.constants[rows, axis][None], on_axis(axis, rows)[1]])
            block = (t_s[rows] / block_s).astype(int)
            likely = walk_likelihood(residual[rows, axis], derivatives, block, steps * block_s / row_s)
            found |= {} if likely is None else {axis: likely}
        yield np.array(list(found), np.int64), steps, list(found.values())
