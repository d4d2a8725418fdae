"""Candidate effects: their score by the gain of one linear step, and the selected ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from imutool.diagnosis.estimation.gauss_newton import Fit, direction, parameters_of, priors
from imutool.diagnosis.estimation.jacobians import ForwardPass, effect_jacobian
from imutool.diagnosis.estimation.significance import log_p_value
from imutool.diagnosis.estimation.whitening import WhitenedLog
from imutool.sensor.effect import Effect, Theta

RIDGE = 1e-9


@dataclass(frozen=True, eq=False)
class SelectedEffect:
    """Selected effect with its parameters and the cost of leaving it out.

    `p_value` is by chi-square over all rows, `gain` the squares that leaving it out adds there, `unidentified` its parameters
    that no motion showed, `similar` other effects that explain about as much in its place.
    """

    effect: Effect
    theta: Theta
    std: Theta
    unidentified: tuple[str, ...]
    p_value: float
    false_discovery_rate: float
    gain: float
    similar: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Selection:
    """Selected effects, strongest first; fits; number of trials, and of effects in every fit."""

    selected: tuple[SelectedEffect, ...]
    fitted: Fit
    whole: Fit
    tried: int
    always: int = 0


class _Axis(NamedTuple):
    """White rows of one axis of a log that are fitted, zero elsewhere, orthogonal to the bias."""

    counts: Float64[np.ndarray, " m"]  # 1 for rows that are fitted
    bias: Float64[np.ndarray, " m"]  # a constant behind the filter, of length 1
    where: Int64[np.ndarray, " q"]
    A: Float64[np.ndarray, "q m"]
    r: Float64[np.ndarray, " m"]

    def free(self, x: Float64[np.ndarray, "*k m"]) -> Float64[np.ndarray, "*k m"]:
        """Rows less their projection on the bias."""
        x = x * self.counts
        return np.asarray(x - (x @ self.bias)[..., None] * self.bias)


class CandidateScore:
    """Normal equations of a fit, to which the Schur complement of one more effect is added."""

    def __init__(self, logs: Sequence[WhitenedLog], now: Fit) -> None:
        self.logs, self.now = logs, now
        q = sum(len(theta) for _, theta in now.chosen)
        self.N, self.g, self.total, self.axes = RIDGE * np.eye(q), np.zeros(q), 0.0, []
        for number, (log, forward) in enumerate(zip(logs, now.passes, strict=True)):
            counts, residual = log.rows("fitted").astype(float), log.residual(forward.expected)
            everything = np.ones(len(counts), bool)
            for k in range(log.pair.columns):
                bias = log.constants[:, k] * counts
                where, A = now.jacobians.on_axis(number, k, everything)
                axis = _Axis(counts, direction(bias), where, A, residual[:, k])
                axis = axis._replace(A=axis.free(A), r=axis.free(residual[:, k]))
                self.axes.append(axis)
                self.N[np.ix_(where, where)] += axis.A @ axis.A.T
                self.g[where] += axis.A @ axis.r
                self.total += float(axis.r @ axis.r)
        self.left = self.total - float(self.g @ np.linalg.solve(self.N, self.g))

    def gain(self, effect: Effect, start: Theta) -> float:
        """Gain in squares of one linear step from a start.

        No positive parameter changes by more than a factor of e.
        """
        chosen, p = (*self.now.chosen, (effect, start)), len(start)
        moves = np.array([not parameter.begins for parameter in effect.parameters])  # onsets are searched, not stepped
        N_bb, N_ab, g_b = np.zeros((p, p)), np.zeros((len(self.N), p)), np.zeros(p)
        g_a, total = self.g.copy(), self.total
        for k, (log, forward) in enumerate(zip(self.logs, self.now.passes, strict=True)):
            with_it = forward if effect.linear else ForwardPass(log.pair, chosen, forward)
            B, added = effect_jacobian(log.whiten, with_it, effect), with_it.added(forward)
            for column in range(log.pair.columns):
                axis = self.axes[log.pair.columns * k + column]
                js, r = np.flatnonzero(B.on[column] & moves), axis.r
                if column in added:
                    r = r - axis.free(log.whiten.rows(added[column][None], np.array([column]))[0])
                    total += float(r @ r - axis.r @ axis.r)
                    g_a[axis.where] += axis.A @ (r - axis.r)
                if len(js):
                    b = axis.free(B.white[column, js])
                    N_bb[np.ix_(js, js)] += b @ b.T
                    N_ab[np.ix_(axis.where, js)] += axis.A @ b.T
                    g_b[js] += b @ r
        _, std = priors(chosen[-1:], self.now.settings)
        solved = np.linalg.solve(self.N, np.concatenate([N_ab, g_a[:, None]], axis=1))
        S, g = N_bb + np.diag(1.0 / std**2) - N_ab.T @ solved[:, :p], g_b - N_ab.T @ solved[:, p]
        step = np.linalg.solve(S, g)
        far = float(np.abs(step[[parameter.positive for parameter in effect.parameters]]).max(initial=1.0))
        return float(self.left - total + g_a @ solved[:, p] + (2.0 / far - 1.0 / far**2) * (g @ step))


def _exclude(a: Effect, b: Effect) -> bool:
    """Whether two effects never act together: variants of one catalogue effect on one sensor."""
    one_sensor = a.sensors == b.sensors or bool(set(a.sensors) & set(b.sensors))
    variants = a.kind == b.kind == "catalogue" and a.name == b.name and one_sensor
    return a.key == b.key or variants


class Scored(NamedTuple):
    """Candidate with the log p-value of its best start, and the gain in squares."""

    log_p: float
    effect: Effect
    start: Theta
    gain: float

    @property
    def aic_gain(self) -> float:
        """Gain less the expectation for as many parameters (Akaike)."""
        return self.gain - 2.0 * len(self.start)


class Candidates:
    """Candidate effects with the starts of their fits, and their scores beside a fit."""

    def __init__(self, logs: Sequence[WhitenedLog], effects: Sequence[Effect]) -> None:
        self.logs = logs
        self.starts: dict[str, list[Theta]] = {}
        self.log_choices: dict[str, float] = {}
        self.scores: dict[str, Scored] = {}
        self.scored_fit: Fit | None = None
        pair = logs[0].pair
        for effect in effects:
            if effect.key not in self.starts:
                starts = self.starts[effect.key] = pair.starts(effect)
                self.log_choices[effect.key] = float(np.log(max(1.0, pair.alternatives(effect) / len(starts))))

    def count(self, effects: Sequence[Effect]) -> int:
        """Number of starts of some candidates: the hypotheses of the Bonferroni correction."""
        return sum(len(self.starts[effect.key]) for effect in effects)

    def log_p(self, effect: Effect, gain: float) -> float:
        """Log p-value of a gain by an effect.

        Starts that are the best of many choices make chance likelier.
        """
        return log_p_value(gain, len(effect.parameters)) + self.log_choices[effect.key]

    def ranked(self, now: Fit, candidates: Sequence[Effect]) -> list[Scored]:
        """Candidates beside a fit by their score, each from its best start."""
        if self.scored_fit is not now:
            self.scored_fit, self.scores = now, {}
        allowed = [effect for effect in candidates if not any(_exclude(effect, other) for other, _ in now.chosen)]
        score = None
        for effect in allowed:
            if effect.key not in self.scores:
                score = score or CandidateScore(self.logs, now)
                gains = [(score.gain(effect, start), start) for start in self.starts[effect.key]]
                gain, start = max(gains, key=lambda pair: pair[0])
                self.scores[effect.key] = Scored(self.log_p(effect, gain), effect, start, gain)
        return sorted((self.scores[effect.key] for effect in allowed), key=lambda entry: entry.log_p)


def unnamed_count(found: Fit) -> int:
    """Number of effects that are not of the catalogue."""
    return sum(effect.kind != "catalogue" for effect, _ in found.chosen)


def bic(found: Fit, unnamed_penalty: float) -> float:
    """Bayesian information criterion (BIC): squares left and the cost of the parameters.

    An effect outside the catalogue costs more.
    """
    count = len(parameters_of(found.chosen))
    return found.objective + count * float(np.log(found.numbers)) + unnamed_penalty * unnamed_count(found)
