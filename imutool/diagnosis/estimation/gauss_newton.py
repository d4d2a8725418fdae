"""Gauss-Newton fit of effects to whitened logs, with a bias for each log and axis.

Between the steps all times are searched at which an effect may set in. A Jacobian costs an evaluation for each parameter, a
step one: a Jacobian is kept as long as steps do what it predicts, and a fit may begin with that of another fit nearby.
Every parameter has a weak prior, a few times its plausible size: what the motion does not show stays at its null value
instead of becoming a large number, and its standard deviation says so. Positive parameters are fitted by their logarithm.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from imutool.array_types import Float64
from imutool.diagnosis.estimation.jacobians import (
    Chosen,
    ForwardPass,
    Jacobians,
    bound,
    bound_slopes,
    free_of,
    parameters_of,
    priors,
    step_of,
    with_value,
)
from imutool.diagnosis.estimation.whitening import WhitenedLog
from imutool.diagnosis.settings import FitSettings
from imutool.sensor.effect import Theta

ONSET_TAKES = 4.0  # times the limit: an onset moves after the first step, and regains most of some predicted losses
_objective = attrgetter("objective")


@dataclass(frozen=True, eq=False)
class Fit:
    """Fitted effects with parameters and biases, and the objective of the fit."""

    chosen: Chosen
    bias: Float64[np.ndarray, "logs k"]
    objective: float  # squares of white residuals and of the prior
    numbers: int  # of fitted white values
    logs: tuple[WhitenedLog, ...]
    part: str
    passes: tuple[ForwardPass, ...]
    residuals: tuple[Float64[np.ndarray, "_ k"], ...]  # white, bias included; each log has its own rows
    prior: Float64[np.ndarray, " p"]

    @property
    def settings(self) -> FitSettings:
        """Settings of the fit."""
        return self.logs[0].pair.settings.fit

    @property
    def keys(self) -> tuple[str, ...]:
        """The effects' keys."""
        return tuple(effect.key for effect, _ in self.chosen)

    @property
    def reduced_chi_square(self) -> float:
        """Squares left for each white value."""
        return self.objective / max(self.numbers, 1)

    @cached_property
    def jacobians(self) -> Jacobians:
        """Derivatives of the white samples, where the fit ended."""
        return Jacobians([log.whiten for log in self.logs], self.passes, self.chosen)

    @cached_property
    def information(self) -> Float64[np.ndarray, "p p"]:
        """Fisher information of the data alone, without the prior, biases marginalised."""
        p = len(self.prior)
        N, _ = _normal(_Problem(self.logs, self.chosen, self.part), self.jacobians, None, self.bias)
        out: Float64[np.ndarray, "p p"] = N[:p, :p] - N[:p, p:] @ np.linalg.solve(N[p:, p:], N[p:, :p])
        return out

    @cached_property
    def covariance(self) -> Float64[np.ndarray, "p p"]:
        """Covariance of the free parameters, biases marginalised; logarithms for positive ones."""
        return np.linalg.inv(self.information + np.diag(1.0 / self.prior**2)) if len(self.prior) else np.zeros((0, 0))

    def place(self, key: str) -> slice:
        """Slice of an effect's parameters among all."""
        k = self.keys.index(key)
        first = sum(len(theta) for _, theta in self.chosen[:k])
        return slice(first, first + len(self.chosen[k][1]))

    def stds(self) -> dict[str, Float64[np.ndarray, " p"]]:
        """Standard deviations by effect, in the parameters' units."""
        out = {}
        for effect, theta in self.chosen:
            slopes, own = bound_slopes(effect, theta), self.covariance[self.place(effect.key), self.place(effect.key)]
            std = np.sqrt(np.einsum("ij,jk,ik->i", slopes, own, slopes))
            out[effect.key] = std * (self.settings.between_samples if effect.jumps else 1.0)
        return out


def fit(
    logs: Sequence[WhitenedLog],
    begun: Chosen,
    part: str = "fitted",
    iterations: int | None = None,
    near: Fit | None = None,
    give_up_above: float = np.inf,
    hold_onsets: bool = False,
) -> Fit:
    """Fit effects together from where they begin, and a bias for each log.

    `near` is a fit of the same logs: its forward passes and the Jacobians of the effects that both share serve for the first
    step. A fit whose objective is not below `give_up_above` after a few steps goes no further, nor does one that only leaves
    effects out of `near` and whose first step predicts no less: the others hardly move.
    """
    problem = _Problem(logs, begun, part, hold_onsets)
    iterations = problem.settings.iterations if iterations is None else iterations
    base = _descended(problem, problem.state(begun, near), iterations, near, give_up_above)
    if iterations and any(effect.jumps for effect, _ in begun):
        base = _descended(problem, _polished(problem, base), iterations, None, np.inf)
    passes, residuals, numbers = tuple(base.passes), tuple(base.residuals), sum(log.count(part) for log in logs)
    return Fit(base.chosen, base.bias, base.objective, numbers, tuple(logs), part, passes, residuals, problem.std)


def without_effects(found: Fit, left_out: Collection[int], always: int) -> Chosen:
    """Effects of a fit without some; those that are always fitted take over what they can."""
    others = tuple(pair for k, pair in enumerate(found.chosen) if k not in left_out)
    return fit(found.logs, others, part=found.part, near=found).chosen if always else others


class _State(NamedTuple):
    """Parameters on the way of a fit, with residuals and the objective."""

    chosen: Chosen
    passes: list[ForwardPass]
    residuals: list[Float64[np.ndarray, "n k"]]
    bias: Float64[np.ndarray, "logs k"]
    objective: float


class _Problem:
    """Least squares of white residuals on some rows, with a prior about the start."""

    def __init__(self, logs: Sequence[WhitenedLog], begun: Chosen, part: str, hold_onsets: bool = False) -> None:
        self.logs, self.masks, self.hold_onsets = logs, [log.rows(part) for log in logs], hold_onsets
        self.constants = [np.stack([x[mask] for x in log.constants.T]) for log, mask in zip(logs, self.masks, strict=True)]
        self.settings = logs[0].pair.settings.fit
        self.mean, self.std = priors(begun, self.settings)

    def state(self, chosen: Chosen, like: _State | Fit | None) -> _State:
        """Residuals and objective of parameters; what equals a state like it is taken from there."""
        passes, residuals = list[ForwardPass](), list[Float64[np.ndarray, "n k"]]()
        for k, log in enumerate(self.logs):
            passes.append(ForwardPass(log.pair, chosen, None if like is None else like.passes[k]))
            known = None if like is None else (like.passes[k].blocks, like.residuals[k])
            residuals.append(log.residual(passes[k].blocks, known))
        total = float(np.vdot(off := (free_of(chosen) - self.mean) / self.std, off)) if len(self.mean) else 0.0
        bias = np.zeros((len(self.logs), self.logs[0].pair.columns))
        for k, (log, residual, mask) in enumerate(zip(self.logs, residuals, self.masks, strict=True)):
            for axis, (constant, prior) in enumerate(zip(self.constants[k], log.pair.bias_std, strict=True)):
                r = residual[:, axis][mask]
                bias[k, axis] = b = constant @ r / (constant @ constant + 1.0 / prior**2)
                r -= constant * b
                total += float(r @ r + (b / prior) ** 2)
        return _State(chosen, passes, residuals, bias, total)

    def step(self, jacobians: Jacobians, base: _State) -> tuple[Theta, float]:
        """Gauss-Newton step of free parameters, and the gain of the whole step; onsets stay."""
        N, g = _normal(self, jacobians, base.residuals, base.bias)
        x, parameters = free_of(base.chosen), parameters_of(base.chosen)
        N[: len(x), : len(x)] += np.diag(1.0 / self.std**2)
        g[: len(x)] -= (x - self.mean) / self.std**2
        begins = np.array([parameter.begins for parameter in parameters], bool)
        moves = np.concatenate([~begins, np.ones(len(g) - len(begins), bool)])
        delta = np.zeros(len(g))
        delta[moves] = np.linalg.solve(N[np.ix_(moves, moves)], g[moves])
        gain, delta = float(g @ delta), delta[: len(begins)]
        positive = np.array([parameter.positive for parameter in parameters])  # none changes by more than a factor of e
        return delta / max(1.0, float(np.abs(delta[positive]).max(initial=0.0))), gain

    def as_predicted(self, jacobians: Jacobians, before: _State, after: _State, step: Theta) -> bool:
        """Whether a step changed the residuals as the Jacobians predict, so that they are kept."""
        missed = length = 0.0
        for k, mask in enumerate(self.masks):
            for axis, constant in enumerate(self.constants[k]):
                predicted, bias = jacobians.along(k, axis, step, mask), direction(constant)
                off = (before.residuals[k][:, axis] - after.residuals[k][:, axis])[mask] - predicted
                missed += float(off @ off - (off @ bias) ** 2)
                length += float(predicted @ predicted - (predicted @ bias) ** 2)
        return missed <= self.settings.jacobian_error**2 * max(length, 1.0)


def _descended(problem: _Problem, base: _State, iterations: int, near: Fit | None, give_up_above: float) -> _State:
    """State after Gauss-Newton steps, each shortened until the objective falls."""
    settings, whiteners, steps = problem.settings, [log.whiten for log in problem.logs], 0
    kept = None if near is None or not len(problem.mean) or not iterations else near.jacobians
    hopeless = np.inf if near is None else _hopeless(base.chosen, near, give_up_above)
    while len(problem.mean) and steps < iterations:
        before = base.objective
        for moved in _onsets(problem, base) if steps else ():  # where it begins is best known until all else has moved once
            base = min(base, problem.state(moved, base), key=_objective)
        jacobians = Jacobians(whiteners, base.passes, base.chosen, kept)
        x, (whole, gain) = free_of(base.chosen), problem.step(jacobians, base)
        if not steps and before - gain >= hopeless:
            break
        tries = (
            (step, problem.state(_bound(base.chosen, x + step), base))
            for step in (whole * 0.5**k for k in range(settings.backtracks))
        )
        step, better = next((taken for taken in tries if taken[1].objective < base.objective), (x, base))
        if better is base:
            if jacobians.fresh:
                break
            kept = None
            continue
        predicted = problem.as_predicted(jacobians, base, better, step)
        base, steps = better, steps + 1
        converged = before - base.objective < settings.converged_squares and (jacobians.fresh or predicted)
        if converged or (steps == settings.patience_steps and base.objective >= give_up_above):
            break
        kept = jacobians if predicted else jacobians.linear()
    return base


def _hopeless(begun: Chosen, near: Fit, give_up_above: float) -> float:
    """Objective from which on a fit that only leaves effects out of `near` gives up, if its first step predicts so much."""
    known = {id(effect) for effect, _ in near.chosen}
    if any(effect.jumps or id(effect) not in known for effect, _ in begun):
        return np.inf
    takes = ONSET_TAKES if any(parameter.begins for parameter in parameters_of(begun)) else 1.0
    return near.objective + (give_up_above - near.objective) * takes


def _polished(problem: _Problem, base: _State) -> _State:
    """State after ever smaller steps of jumping effects: derivatives lead only from afar."""
    moving = [(effect.jumps, step_of(parameter)) for effect, _ in base.chosen for parameter in effect.parameters]
    for halved in range(problem.settings.polish_rounds):
        for j, (jumps, h) in enumerate(moving):
            for sign in (1.0, -1.0) if jumps else ():
                x = free_of(base.chosen)
                x[j] += sign * h * 2.0 ** (1 - halved)
                base = min(base, problem.state(_bound(base.chosen, x), base), key=_objective)
    return base


def _bound(chosen: Chosen, x: Theta) -> Chosen:
    """Effects with their parameters from free ones."""
    cuts = np.cumsum([len(theta) for _, theta in chosen])[:-1]
    return tuple((effect, bound(effect, part)) for (effect, _), part in zip(chosen, np.split(x, cuts), strict=True))


def direction(x: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Unit vector; zero stays zero, as a constant is on an axis without known samples."""
    return x / max(float(np.linalg.norm(x)), 1e-300)


def _onsets(problem: _Problem, base: _State) -> Iterator[Chosen]:
    """Onset times that minimise the cost: no effect before it, the effect after."""
    for k, (effect, _) in enumerate(() if problem.hold_onsets else base.chosen):
        for j, parameter in enumerate(effect.parameters):
            if not parameter.begins:
                continue
            at, excess = [], []
            each = zip(problem.logs, problem.masks, base.bias, base.passes, base.residuals, strict=True)
            for log, mask, bias, forward, residual in each:
                passes = (ForwardPass(log.pair, with_value(base.chosen, k, j, t), forward) for t in (np.inf, -np.inf))
                ends = (log.residual(end.blocks, (forward.blocks, residual)) - log.constants * bias for end in passes)
                never, always = ((end[mask] ** 2).sum(1) for end in ends)
                at.append(log.pair.stamp_s[:: log.whiten.every][mask])
                excess.append(never - always)
            order = np.argsort(np.concatenate(at), kind="stable")
            t_s, cost = np.concatenate(at)[order], np.cumsum(np.concatenate(excess)[order])
            best = int(np.argmin(cost[:-1]))
            yield with_value(base.chosen, k, j, float(t_s[best] + t_s[best + 1]) / 2.0)


def _normal(
    problem: _Problem,
    jacobians: Jacobians,
    residuals: Sequence[Float64[np.ndarray, "_ k"]] | None,
    bias: Float64[np.ndarray, "logs k"],
) -> tuple[Float64[np.ndarray, "q q"], Float64[np.ndarray, " q"]]:
    """Normal equations of free parameters and biases; no right-hand side without residuals."""
    p = sum(len(theta) for _, theta in jacobians.chosen)
    N, g = np.zeros((p + bias.size,) * 2), np.zeros(p + bias.size)
    for k, (log, mask) in enumerate(zip(problem.logs, problem.masks, strict=True)):
        for axis in range(log.pair.columns):
            where, A = jacobians.on_axis(k, axis, mask)
            constant, at = problem.constants[k][axis], p + log.pair.columns * k + axis
            N[where[:, None], where] += A @ A.T
            N[where, at] = N[at, where] = A @ constant
            N[at, at] = constant @ constant + 1.0 / log.pair.bias_std[axis] ** 2
            if residuals is not None:
                g[where] += A @ (residuals[k][:, axis][mask] - constant * bias[k, axis])
    return N, g
