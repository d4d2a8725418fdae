"""Effects fitted to pairs, together, with a constant bias for each log, weighed by the noise.

Gauss-Newton on whitened residuals, and between its steps a look at all times at which an effect may set in. The derivatives
are differences of the effects' own forward models, so that an effect is one function and nothing else. Every parameter has a
weak prior, `PRIOR` times its plausible size: what the motion cannot show stays at nothing instead of becoming a large number,
and its standard deviation says so. Positive parameters are fitted by their logarithm.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from imutool.physics.effects._forward import Number, Physics, Stage, Theta, read, sensed
from imutool.physics.pair import Pair
from imutool.physics.readings import Read
from imutool.physics.whitening import Whitener, settled

PRIOR = 3.0
LOG_PRIOR = 1.5  # of a positive parameter about where its fit began, in powers of e
STEP, LOG_STEP = 1e-3, 1e-3
ITERATIONS = 6
BIAS_PRIOR = np.array([0.5] * 3 + [5.0] * 3)
BACKTRACKS = 4

Chosen = tuple[tuple[Physics, Theta], ...]


@dataclass(frozen=True, eq=False)
class Weighed:
    """A pair with the noise it is weighed by, and rows by what they are for."""

    pair: Pair
    whiten: Whitener

    def numbers(self, part: str) -> int:
        """White values of a part that tell anything."""
        rows, counts = self.rows(part), self.whiten.counts
        return int(6 * rows.sum() if counts is None else counts[rows].sum())

    def rows(self, part: str) -> Bool[np.ndarray, " n"]:
        """`fitted`, `held_out` or `all`, behind the filter's start."""
        pair, order, every = self.pair, self.whiten.order, self.whiten.every
        if part == "all":
            return np.asarray(settled(pair.fitted[::every], order) | settled(pair.held_out[::every], order))
        return settled((pair.fitted if part == "fitted" else pair.held_out)[::every], order)


@dataclass(frozen=True, eq=False)
class Fit:
    """Effects with their parameters, each log's bias, and how well they fit.

    `objective` is the sum of squares of white residuals and of the prior; `covariance` is of the parameters of all effects in
    order (logarithms for positive ones), biases taken out; `information` is the data's alone, without the prior; `numbers` are
    the white values that were weighed, in so many rows.
    """

    chosen: Chosen
    bias: Float64[np.ndarray, "logs 6"]
    objective: float
    covariance: Float64[np.ndarray, "p p"]
    information: Float64[np.ndarray, "p p"]
    rows: int
    numbers: int

    @property
    def names(self) -> tuple[str, ...]:
        """The effects."""
        return tuple(physics.name for physics, _ in self.chosen)

    def stds(self) -> dict[str, Float64[np.ndarray, " p"]]:
        """Standard deviations by effect, in the parameters' units."""
        out, first = {}, 0
        for physics, theta in self.chosen:
            std = np.sqrt(np.diag(self.covariance)[first : first + len(theta)])
            out[physics.name] = np.array(
                [s * t if n.positive else s for s, t, n in zip(std, theta, physics.parameters, strict=True)]
            )
            first += len(theta)
        return out


def expected(pair: Pair, chosen: Chosen) -> Float64[np.ndarray, "n 6"]:
    """What the sensor would read, without bias."""
    return _sensed(sampled(pair, chosen), chosen)


def sampled(pair: Pair, chosen: Chosen) -> Read:
    """What arrives at the sensor when its samples are taken."""
    return read(pair.felt, pair.stamp_s, [one for one in chosen if one[0].stage <= Stage.CLOCK])


def _sensed(taken: Read, chosen: Chosen) -> Float64[np.ndarray, "n 6"]:
    """What the sensor makes of it."""
    got = sensed(taken, [one for one in chosen if one[0].stage > Stage.CLOCK])
    return np.concatenate([got.gyro, got.accel], axis=1)


def free(physics: Physics, theta: Theta) -> Theta:
    """Parameters as they are fitted: logarithms of the positive ones."""
    return np.array([np.log(t) if n.positive else t for t, n in zip(theta, physics.parameters, strict=True)])


def bound(physics: Physics, x: Theta) -> Theta:
    """Back from there."""
    return np.array([np.exp(np.clip(v, -50, 50)) if n.positive else v for v, n in zip(x, physics.parameters, strict=True)])


def step_of(number: Number) -> float:
    """For differences."""
    if number.step is not None:
        return number.step
    return LOG_STEP if number.positive else STEP * number.plausible


def derivatives(
    pair: Pair, chosen: Chosen, of: Sequence[int], base: Float64[np.ndarray, "n 6"], taken: Read | None = None
) -> Float64[np.ndarray, "n 6 p"]:
    """d expected / d (free parameters) of some of the effects, by forward differences; `taken` is what is `sampled`."""
    columns = []
    for k in of:
        physics, theta = chosen[k]
        x = free(physics, theta)
        late = physics.stage > Stage.CLOCK
        if late and taken is None:
            taken = sampled(pair, chosen)
        for j, number in enumerate(physics.parameters):
            h = step_of(number)
            moved = x.copy()
            moved[j] += h
            others = (*chosen[:k], (physics, bound(physics, moved)), *chosen[k + 1 :])
            there = _sensed(taken, others) if late and taken is not None else expected(pair, others)
            columns.append((there - base) / h)
    return np.stack(columns, axis=2) if columns else np.zeros((*base.shape, 0))


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
    logs: Sequence[Weighed],
    begun: Chosen,
    part: str = "fitted",
    iterations: int = ITERATIONS,
) -> Fit:
    """The effects fitted together from where they begin, and a bias for each log."""
    mean, std = priors(begun, begun)
    p, N_data = len(mean), np.zeros((len(mean), len(mean)))
    masks = [log.rows(part) for log in logs]

    def tried(chosen: Chosen) -> _State:
        residuals = [_residual(log, chosen) for log in logs]
        return _State(chosen, residuals, *_biases(logs, residuals, masks, _penalty(chosen, mean, std)))

    now = tried(begun)
    for _ in range(iterations if p else 0):
        before = now.objective
        for moved in _set_in(logs, now, masks):
            now = min(now, tried(moved), key=_objective)
        N, g = _normal(logs, now.chosen, now.residuals, now.bias, masks)
        N_data = _without_biases(N, p)
        x = np.concatenate([free(physics, theta) for physics, theta in now.chosen])
        N[:p, :p] += np.diag(1.0 / std**2)
        g[:p] -= (x - mean) / std**2
        delta = _within(_solved(N, g, now.chosen), now.chosen)
        steps = (tried(_moved(now.chosen, x + delta * 0.5**back)) for back in range(BACKTRACKS))
        now = next((one for one in steps if one.objective < now.objective), now)
        if before - now.objective < 1e-2:
            break
    covariance = np.linalg.inv(N_data + np.diag(1.0 / std**2)) if len(mean) else np.zeros((0, 0))
    rows, numbers = int(sum(mask.sum() for mask in masks)), sum(log.numbers(part) for log in logs)
    return Fit(now.chosen, now.bias, now.objective, covariance, N_data, rows, numbers)


class _State(NamedTuple):
    """How far a fit has come."""

    chosen: Chosen
    residuals: list[Float64[np.ndarray, "n 6"]]
    bias: Float64[np.ndarray, "logs 6"]
    objective: float


def _objective(state: _State) -> float:
    return state.objective


def _solved(N: Float64[np.ndarray, "q q"], g: Float64[np.ndarray, " q"], chosen: Chosen) -> Float64[np.ndarray, " p"]:
    """The step of the parameters; times at which effects set in stay."""
    begins = np.array([number.begins for physics, _ in chosen for number in physics.parameters], bool)
    moves = np.concatenate([~begins, np.ones(len(g) - len(begins), bool)])
    delta = np.zeros(len(g))
    delta[moves] = np.linalg.solve(N[np.ix_(moves, moves)], g[moves])
    return delta[: len(begins)]


def _set_in(logs: Sequence[Weighed], now: _State, masks: Sequence[Bool[np.ndarray, " n"]]) -> Iterator[Chosen]:
    """With one effect setting in at its best time: before it squares left without the effect count, behind it those with it."""
    chosen = now.chosen
    for k, (physics, _) in enumerate(chosen):
        for j, number in enumerate(physics.parameters):
            if not number.begins:
                continue
            at, excess = [], []
            for log, mask, bias in zip(logs, masks, now.bias, strict=True):
                ends = (_residual(log, _but(chosen, k, j, t)) - constants(log) * bias for t in (np.inf, -np.inf))
                never, always = ((one[mask] ** 2).sum(1) for one in ends)
                stamp_s = log.pair.stamp_s
                at.append((stamp_s - stamp_s[0])[:: log.whiten.every][mask])
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


def _residual(log: Weighed, chosen: Chosen) -> Float64[np.ndarray, "n 6"]:
    return log.whiten(log.pair.real - expected(log.pair, chosen))


def constants(log: Weighed) -> Float64[np.ndarray, "n 6"]:
    """What a constant on each axis becomes behind the filter."""
    return log.whiten(np.ones_like(log.pair.real))


def _biases(
    logs: Sequence[Weighed],
    residuals: Sequence[Float64[np.ndarray, "n 6"]],
    masks: Sequence[Bool[np.ndarray, " n"]],
    penalty: float,
) -> tuple[Float64[np.ndarray, "logs 6"], float]:
    """The best constants for some residuals, and the objective with them."""
    b, total = np.zeros((len(logs), 6)), penalty
    for k, (log, residual, mask) in enumerate(zip(logs, residuals, masks, strict=True)):
        one, r = constants(log)[mask], residual[mask]
        b[k] = (one * r).sum(0) / ((one * one).sum(0) + 1.0 / BIAS_PRIOR**2)
        total += float(((r - one * b[k]) ** 2).sum() + ((b[k] / BIAS_PRIOR) ** 2).sum())
    return b, total


def _normal(
    logs: Sequence[Weighed],
    chosen: Chosen,
    residuals: Sequence[Float64[np.ndarray, "n 6"]],
    b: Float64[np.ndarray, "logs 6"],
    masks: Sequence[Bool[np.ndarray, " n"]],
) -> tuple[Float64[np.ndarray, "q q"], Float64[np.ndarray, " q"]]:
    """Normal equations of all free parameters, then each log's bias."""
    p = sum(len(theta) for _, theta in chosen)
    N, g = np.zeros((p + 6 * len(logs),) * 2), np.zeros(p + 6 * len(logs))
    for k, (log, residual, mask) in enumerate(zip(logs, residuals, masks, strict=True)):
        base = expected(log.pair, chosen)
        J = log.whiten(derivatives(log.pair, chosen, range(len(chosen)), base))[mask]
        one = constants(log)[mask]
        r = residual[mask] - one * b[k]
        flat = J.reshape(J.shape[0] * 6, p)
        here = slice(p + 6 * k, p + 6 * k + 6)
        N[:p, :p] += flat.T @ flat
        cross = np.einsum("nap,na->pa", J, one)
        N[:p, here] += cross
        N[here, :p] += cross.T
        N[here, here] += np.diag((one * one).sum(0) + 1.0 / BIAS_PRIOR**2)
        g[:p] += flat.T @ r.reshape(-1)
    return N, g


def _without_biases(N: Float64[np.ndarray, "q q"], p: int) -> Float64[np.ndarray, "p p"]:
    """The information on the parameters once biases are free as well."""
    out: Float64[np.ndarray, "p p"] = N[:p, :p] - N[:p, p:] @ np.linalg.solve(N[p:, p:], N[p:, :p])
    return out
