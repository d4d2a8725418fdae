"""Effects fitted to pairs, together, with a constant bias for each log, weighed by the noise.

Gauss-Newton on whitened residuals, and between its steps a look at all times at which an effect may set in. Derivatives cost as
many evaluations as there are parameters, and a step one: they stay as long as steps do what they say (`STRAIGHT`), and a fit
may begin with those of another nearby. Every parameter has a weak prior, `PRIOR` times its plausible size: what the motion
cannot show stays at nothing instead of becoming a large number, and its standard deviation says so. Positive parameters are
fitted by their logarithm.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from imutool.diagnosis.estimation.alignment import Pair
from imutool.diagnosis.estimation.forward_cache import Chosen, ForwardPass, bound, free
from imutool.diagnosis.estimation.jacobians import Jacobians
from imutool.diagnosis.estimation.whitening import Whitener, settled
from imutool.sensor.effect import Theta

PRIOR = 3.0
LOG_PRIOR = 1.5  # of a positive parameter about where its fit began, in powers of e
ITERATIONS = 8
BIAS_PRIOR = np.array([0.5] * 3 + [5.0] * 3)
BACKTRACKS = 4
SETTLED = 1e-2  # squares: less is no step any more
PATIENCE = 3  # steps, after which a fit has to be below what was hoped for
STRAIGHT = 0.05  # of a step's length in white samples: by how much it may miss what the derivatives say of it


@dataclass(frozen=True, eq=False)
class WhitenedLog:
    """A pair with the noise it is weighed by, and rows by what they are for."""

    pair: Pair
    whiten: Whitener

    def numbers(self, part: str) -> int:
        """White values of a part that tell anything."""
        rows, counts = self.rows(part), self.whiten.counts
        return int(6 * rows.sum() if counts is None else counts[rows].sum())

    def rows(self, part: str) -> Bool[np.ndarray, " n"]:
        """`fitted`, `held_out` or `all`, behind the filter's start."""
        fitted, held_out = self._rows
        return fitted | held_out if part == "all" else fitted if part == "fitted" else held_out

    @cached_property
    def _rows(self) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        every, order = self.whiten.every, self.whiten.order
        return settled(self.pair.fitted[::every], order), settled(self.pair.held_out[::every], order)

    @cached_property
    def constants(self) -> Float64[np.ndarray, "n 6"]:
        """What a constant on each axis becomes behind the filter."""
        return self.whiten(np.ones_like(self.pair.real))

    def residual(self, course: ForwardPass) -> Float64[np.ndarray, "n 6"]:
        """White residuals, with the bias."""
        return self.whiten(self.pair.real - course.expected)


@dataclass(frozen=True, eq=False)
class Fit:
    """Effects with their parameters, each log's bias, and how well they fit.

    `objective` is the sum of squares of white residuals and of the prior; `numbers` are the white values that were weighed, in
    so many rows.
    """

    chosen: Chosen
    bias: Float64[np.ndarray, "logs 6"]
    objective: float
    rows: int
    numbers: int
    logs: tuple[WhitenedLog, ...]
    part: str
    courses: tuple[ForwardPass, ...]
    prior: Float64[np.ndarray, " p"]

    @property
    def keys(self) -> tuple[str, ...]:
        """The effects' keys."""
        return tuple(physics.key for physics, _ in self.chosen)

    @cached_property
    def slopes(self) -> Jacobians:
        """Derivatives of the white samples, where the fit ended."""
        return Jacobians([log.whiten for log in self.logs], self.courses, self.chosen)

    @cached_property
    def information(self) -> Float64[np.ndarray, "p p"]:
        """The data's alone, without the prior, biases taken out."""
        p, masks = len(self.prior), [log.rows(self.part) for log in self.logs]
        nothing = [np.zeros((len(mask), 6)) for mask in masks]
        N, _ = _normal(self.logs, self.slopes, nothing, np.zeros((len(self.logs), 6)), masks)
        out: Float64[np.ndarray, "p p"] = N[:p, :p] - N[:p, p:] @ np.linalg.solve(N[p:, p:], N[p:, :p])
        return out

    @cached_property
    def covariance(self) -> Float64[np.ndarray, "p p"]:
        """Of the parameters of all effects in order (logarithms for positive ones), biases taken out."""
        return np.linalg.inv(self.information + np.diag(1.0 / self.prior**2)) if len(self.prior) else np.zeros((0, 0))

    def stds(self) -> dict[str, Float64[np.ndarray, " p"]]:
        """Standard deviations by effect, in the parameters' units."""
        out, first = {}, 0
        for physics, theta in self.chosen:
            std = np.sqrt(np.diag(self.covariance)[first : first + len(theta)])
            out[physics.key] = np.array(
                [s * t if n.positive else s for s, t, n in zip(std, theta, physics.parameters, strict=True)]
            )
            first += len(theta)
        return out


def expected(pair: Pair, chosen: Chosen) -> Float64[np.ndarray, "n 6"]:
    """What the sensor would read, without bias."""
    return ForwardPass(pair, chosen).expected


def priors(chosen: Chosen, begun: Chosen) -> tuple[Float64[np.ndarray, " p"], Float64[np.ndarray, " p"]]:
    """Mean and standard deviation of the free parameters."""
    mean, std = [], []
    for (physics, theta), (_, at) in zip(chosen, begun, strict=True):
        for number, x in zip(physics.parameters, free(physics, at), strict=True):
            mean.append(x if number.positive else 0.0)
            std.append(LOG_PRIOR if number.positive else PRIOR * number.plausible)
        assert len(theta) == len(physics.parameters)
    return np.array(mean), np.array(std)


def fit(
    logs: Sequence[WhitenedLog],
    begun: Chosen,
    part: str = "fitted",
    iterations: int = ITERATIONS,
    near: Fit | None = None,
    hopeful: float = np.inf,
) -> Fit:
    """The effects fitted together from where they begin, and a bias for each log.

    `near` is a fit of the same logs whose derivatives serve for the first step, as far as its effects are the same. A fit whose
    objective is not below `hopeful` after a few steps goes no further.
    """
    mean, std = priors(begun, begun)
    masks, whiteners = [log.rows(part) for log in logs], [log.whiten for log in logs]

    def tried(chosen: Chosen, like: _State | None) -> _State:
        courses = [ForwardPass(log.pair, chosen, None if like is None else like.courses[k]) for k, log in enumerate(logs)]
        residuals = [log.residual(course) for log, course in zip(logs, courses, strict=True)]
        return _State(chosen, courses, residuals, *_biases(logs, residuals, masks, _penalty(chosen, mean, std)))

    now, steps = tried(begun, None), 0
    known = None if near is None else near.slopes
    while len(mean) and steps < iterations:
        before = now.objective
        for moved in _set_in(logs, now, masks):
            now = min(now, tried(moved, now), key=_objective)
        slopes = Jacobians(whiteners, now.courses, now.chosen, known)
        sizes = (_step(logs, slopes, now, masks, mean, std) * 0.5**back for back in range(BACKTRACKS))
        x = np.concatenate([free(physics, theta) for physics, theta in now.chosen])
        tries = ((step, tried(_moved(now.chosen, x + step), now)) for step in sizes)
        step, better = next((one for one in tries if one[1].objective < now.objective), (x, now))
        if better is now:
            if slopes.fresh:
                break
            known = None
            continue
        straight = _straight(logs, slopes, now, better, step, masks)
        now, steps = better, steps + 1
        settled = before - now.objective < SETTLED and (slopes.fresh or straight)
        if settled or (steps == PATIENCE and now.objective >= hopeful):
            break
        known = slopes if straight else slopes.linear()
    rows, numbers = int(sum(mask.sum() for mask in masks)), sum(log.numbers(part) for log in logs)
    return Fit(now.chosen, now.bias, now.objective, rows, numbers, tuple(logs), part, tuple(now.courses), std)


class _State(NamedTuple):
    """How far a fit has come."""

    chosen: Chosen
    courses: list[ForwardPass]
    residuals: list[Float64[np.ndarray, "n 6"]]
    bias: Float64[np.ndarray, "logs 6"]
    objective: float


def _step(
    logs: Sequence[WhitenedLog],
    slopes: Jacobians,
    now: _State,
    masks: Sequence[Bool[np.ndarray, " n"]],
    mean: Float64[np.ndarray, " p"],
    std: Float64[np.ndarray, " p"],
) -> Theta:
    """Gauss and Newton's, of the free parameters."""
    N, g = _normal(logs, slopes, now.residuals, now.bias, masks)
    x = np.concatenate([free(physics, theta) for physics, theta in now.chosen])
    N[: len(x), : len(x)] += np.diag(1.0 / std**2)
    g[: len(x)] -= (x - mean) / std**2
    return _within(_solved(N, g, now.chosen), now.chosen)


def _straight(
    logs: Sequence[WhitenedLog],
    slopes: Jacobians,
    before: _State,
    after: _State,
    step: Theta,
    masks: Sequence[Bool[np.ndarray, " n"]],
) -> bool:
    """Whether a step went where the derivatives said: else they are to be taken anew."""
    missed = length = 0.0
    for k, (log, mask) in enumerate(zip(logs, masks, strict=True)):
        done, one = (before.residuals[k] - after.residuals[k])[mask], log.constants[mask]
        for axis in range(6):
            said, bias = slopes.along(k, axis, step, mask), direction(one[:, axis])
            off = done[:, axis] - said
            missed += float(off @ off - (off @ bias) ** 2)
            length += float(said @ said - (said @ bias) ** 2)
    return missed <= STRAIGHT**2 * max(length, 1.0)


def direction(x: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Of length one; nothing stays nothing, as a constant is on an axis that tells nothing."""
    return x / max(float(np.linalg.norm(x)), 1e-300)


def _objective(state: _State) -> float:
    return state.objective


def _solved(N: Float64[np.ndarray, "q q"], g: Float64[np.ndarray, " q"], chosen: Chosen) -> Float64[np.ndarray, " p"]:
    """The step of the parameters; times at which effects set in stay."""
    begins = np.array([number.begins for physics, _ in chosen for number in physics.parameters], bool)
    moves = np.concatenate([~begins, np.ones(len(g) - len(begins), bool)])
    delta = np.zeros(len(g))
    delta[moves] = np.linalg.solve(N[np.ix_(moves, moves)], g[moves])
    return delta[: len(begins)]


def _set_in(logs: Sequence[WhitenedLog], now: _State, masks: Sequence[Bool[np.ndarray, " n"]]) -> Iterator[Chosen]:
    """With one effect setting in at its best time: before it squares left without the effect count, behind it those with it."""
    chosen = now.chosen
    for k, (physics, _) in enumerate(chosen):
        for j, number in enumerate(physics.parameters):
            if not number.begins:
                continue
            at, excess = [], []
            for log, mask, bias, course in zip(logs, masks, now.bias, now.courses, strict=True):
                courses = (ForwardPass(log.pair, _but(chosen, k, j, t), course) for t in (np.inf, -np.inf))
                ends = (log.residual(one) - log.constants * bias for one in courses)
                never, always = ((one[mask] ** 2).sum(1) for one in ends)
                stamp_s = log.pair.stamp_s
                at.append(stamp_s[:: log.whiten.every][mask])
                excess.append(never - always)
            order = np.argsort(np.concatenate(at), kind="stable")
            t_s, cost = np.concatenate(at)[order], np.cumsum(np.concatenate(excess)[order])
            best = int(np.argmin(cost[:-1]))
            yield _but(chosen, k, j, float(t_s[best] + t_s[best + 1]) / 2.0)


def _but(chosen: Chosen, k: int, j: int, value: float) -> Chosen:
    """With another value of one parameter."""
    theta = chosen[k][1].copy()
    theta[j] = value
    return (*chosen[:k], (chosen[k][0], theta), *chosen[k + 1 :])


def _within(delta: Theta, chosen: Chosen) -> Theta:
    """A step in which no positive parameter changes by more than a factor of e."""
    positive = np.array([number.positive for physics, _ in chosen for number in physics.parameters])
    most = float(np.abs(delta[positive]).max(initial=0.0))
    return delta / max(1.0, most)


def _moved(chosen: Chosen, x: Theta) -> Chosen:
    out, first = [], 0
    for physics, theta in chosen:
        out.append((physics, bound(physics, x[first : first + len(theta)])))
        first += len(theta)
    return tuple(out)


def _penalty(chosen: Chosen, mean: Theta, std: Theta) -> float:
    if not len(mean):
        return 0.0
    x = np.concatenate([free(physics, theta) for physics, theta in chosen])
    return float((((x - mean) / std) ** 2).sum())


def _biases(
    logs: Sequence[WhitenedLog],
    residuals: Sequence[Float64[np.ndarray, "n 6"]],
    masks: Sequence[Bool[np.ndarray, " n"]],
    penalty: float,
) -> tuple[Float64[np.ndarray, "logs 6"], float]:
    """The best constants for some residuals, and the objective with them."""
    b, total = np.zeros((len(logs), 6)), penalty
    for k, (log, residual, mask) in enumerate(zip(logs, residuals, masks, strict=True)):
        one, r = log.constants[mask], residual[mask]
        b[k] = (one * r).sum(0) / ((one * one).sum(0) + 1.0 / BIAS_PRIOR**2)
        total += float(((r - one * b[k]) ** 2).sum() + ((b[k] / BIAS_PRIOR) ** 2).sum())
    return b, total


def _normal(
    logs: Sequence[WhitenedLog],
    slopes: Jacobians,
    residuals: Sequence[Float64[np.ndarray, "n 6"]],
    b: Float64[np.ndarray, "logs 6"],
    masks: Sequence[Bool[np.ndarray, " n"]],
) -> tuple[Float64[np.ndarray, "q q"], Float64[np.ndarray, " q"]]:
    """Normal equations of all free parameters, then each log's bias."""
    p = sum(len(theta) for _, theta in slopes.chosen)
    N, g = np.zeros((p + 6 * len(logs),) * 2), np.zeros(p + 6 * len(logs))
    for k, (log, residual, mask) in enumerate(zip(logs, residuals, masks, strict=True)):
        for axis in range(6):
            where, A = slopes.on_axis(k, axis, mask)
            one, bias = log.constants[mask, axis], p + 6 * k + axis
            N[np.ix_(where, where)] += A @ A.T
            N[where, bias] += A @ one
            N[bias, where] += A @ one
            N[bias, bias] += one @ one + 1.0 / BIAS_PRIOR[axis] ** 2
            g[where] += A @ (residual[mask, axis] - one * b[k, axis])
    return N, g
