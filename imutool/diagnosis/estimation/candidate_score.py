"""Candidate effects: their score by the gain of one linear step."""

from __future__ import annotations

from bisect import insort
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from itertools import chain
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from imutool.array_types import Float, Float64, Int64
from imutool.diagnosis.estimation.gauss_newton import Fit, direction, fit
from imutool.diagnosis.estimation.jacobians import Chosen, ForwardPass, effect_jacobian, priors
from imutool.diagnosis.estimation.observability import WANDER, exclude_each_other, may_act, with_free
from imutool.diagnosis.estimation.significance import log_p_value
from imutool.diagnosis.estimation.trial.effect_forms import low_pass_with
from imutool.diagnosis.estimation.trial.filter_forms import lag_taken_back
from imutool.diagnosis.estimation.unnamed_effects import finer_curve
from imutool.diagnosis.estimation.whitening import WhitenedLog
from imutool.processes.forked import of_each
from imutool.sensor.effect import Effect, Stage, Theta

FILTERS = Stage.MOUNT, Stage.BANDWIDTH
UNSURE = 0.5  # of a score, by which derivatives given an earlier fit may be wrong
UNLIKELY = -3.0  # log p-value above which they need not be right
CLOCK = "clock_skew", "clock_jump"
KEPT = 2  # sets of derivatives: with an effect, and without it


class _Axis(NamedTuple):
    """White rows of one axis of a log, at the samples that are fitted alone, orthogonal to the bias."""

    fitted: Int64[np.ndarray, " n"]
    bias: Float64[np.ndarray, " n"]  # a constant behind the filter, of length 1
    where: Int64[np.ndarray, " q"]
    A: Float[np.ndarray, "q n"]
    r: Float[np.ndarray, " n"]

    def free(self, x: Float64[np.ndarray, "*k m"]) -> Float64[np.ndarray, "*k n"]:
        """Rows less their projection on the bias."""
        x = x.take(self.fitted, axis=-1)
        x -= (x @ self.bias)[..., None] * self.bias
        return x

    def short(self) -> _Axis:
        """The same in half of the memory."""
        return self._replace(A=self.A.astype(np.float32), r=self.r.astype(np.float32))


class _Linear(NamedTuple):
    """A candidate at a start, linear: by axis its parameters, their derivatives, and what the start adds, less the bias."""

    start: Theta
    rows: list[tuple[int, Int64[np.ndarray, " q"], Float[np.ndarray, "q _"], Float[np.ndarray, " _"] | None]]
    N: Float64[np.ndarray, "p p"]

    @property
    def acts(self) -> bool:
        """Whether the candidate changes a row; one that acts only next to others may not, given an earlier fit."""
        return any(bool(b.any()) or (x is not None and bool(x.any())) for _, _, b, x in self.rows)

    def short(self) -> _Linear:
        """The same in half of the memory, to guess scores given other fits."""
        half, rows = np.float32, self.rows
        return self._replace(rows=[(k, js, b.astype(half), x if x is None else x.astype(half)) for k, js, b, x in rows])


class CandidateScore:
    """Normal equations of a fit, to which the Schur complement of one more effect is added."""

    def __init__(self, logs: Sequence[WhitenedLog], base: Fit) -> None:
        self.logs, self.now = logs, base
        _, std = priors(base.chosen, base.settings)  # without it two curves of one axis, which share a constant, are singular
        self.N, self.g, self.total, self.axes = np.diag(1.0 / std**2), np.zeros(len(std)), 0.0, []
        for number, log in enumerate(logs):
            mask, residual = log.rows("fitted"), base.residuals[number]
            fitted = np.flatnonzero(mask)
            for k in range(log.pair.columns):
                where, A = base.jacobians.on_axis(number, k, np.ones(len(mask), bool))
                axis = _Axis(fitted, direction(log.constants[fitted, k]), where, A, residual[:, k])
                axis = axis._replace(A=axis.free(A), r=axis.free(residual[:, k]))
                self.axes.append(axis)
                self.N[where[:, None], where] += axis.A @ axis.A.T
                self.g[where] += axis.A @ axis.r
                self.total += float(axis.r @ axis.r)
        self.solved_g = np.linalg.solve(self.N, self.g)
        self.remaining = self.total - float(self.g @ self.solved_g)
        self.short = [axis.short() for axis in self.axes]

    def linear(self, effect: Effect, begun: Chosen) -> _Linear:
        """Derivatives of a candidate given the fit, and what it adds where it has begun."""
        start = begun[-1][1]
        rows, N = [], np.diag(1.0 / priors(((effect, start),), self.now.settings)[1] ** 2)
        for k, (log, forward) in enumerate(zip(self.logs, self.now.passes, strict=True)):
            with_it = forward if effect.linear else ForwardPass(log.pair, begun, forward)
            B, added = effect_jacobian(log.whiten, with_it, effect, onsets=False), with_it.added(forward)  # they are searched
            for column in range(log.pair.columns):
                axis, on = self.axes[log.pair.columns * k + column], B.on(column)
                if len(on) or column in added:
                    js, b = B.parameters[on], axis.free(B.rows[on])
                    N[js[:, None], js] += b @ b.T
                    more = axis.free(log.whiten.rows([added[column]], np.array([column]))[0]) if column in added else None
                    rows.append((log.pair.columns * k + column, js, b, more))
        return _Linear(start, rows, N)

    def gain(self, effect: Effect, linear: _Linear) -> float:
        """Gain in squares of one linear step; no positive parameter changes by more than a factor of e."""
        p = len(linear.start)
        N_ab, g_b, g_a, total = np.zeros((len(self.N), p)), np.zeros(p), self.g, self.total
        for k, js, b, added in linear.rows:
            axis, r = self.axes[k], self.axes[k].r
            if added is not None:
                r = r - added
                total += float(r @ r - axis.r @ axis.r)
                g_a = g_a - np.bincount(axis.where, axis.A @ added, len(g_a))
            if len(js):
                like = self.short[k] if b.dtype == np.float32 else axis
                N_ab[axis.where[:, None], js] += like.A @ b.T
                g_b[js] += b @ (like.r if added is None else r)
        solved_g = self.solved_g if g_a is self.g else np.linalg.solve(self.N, g_a)
        S, g = linear.N - N_ab.T @ np.linalg.solve(self.N, N_ab), g_b - N_ab.T @ solved_g
        try:
            step = np.linalg.solve(S, g)
        except np.linalg.LinAlgError:  # of a log against itself, float32 rows of 1e7 leave S singular
            step = np.linalg.lstsq(S, g)[0]
        far = float(np.abs(step[[parameter.positive for parameter in effect.parameters]]).max(initial=1.0))
        return float(self.remaining - total + g_a @ solved_g + (2.0 / far - 1.0 / far**2) * (g @ step))


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
    """Candidate effects with the starts of their fits, and their scores given a fit."""

    def __init__(self, logs: Sequence[WhitenedLog], effects: Sequence[Effect]) -> None:
        self.logs = logs
        self.starts: dict[str, list[Theta]] = {}
        self.log_choices: dict[str, float] = {}
        self.score: CandidateScore | None = None
        self.scores: dict[str, Scored] = {}
        self.linear: dict[frozenset[str], dict[str, list[_Linear]]] = {}  # by the filters that acted
        pair = logs[0].pair
        for effect in effects:
            if effect.key not in self.starts:
                starts = self.starts[effect.key] = pair.starts(effect)
                self.log_choices[effect.key] = float(np.log(max(1.0, pair.alternatives(effect) / len(starts))))

    def copy(self) -> Candidates:
        """Candidates with what is derived so far; neither sees what the other derives."""
        other = copy(self)
        other.scores, other.linear = dict(self.scores), {filters: dict(known) for filters, known in self.linear.items()}
        return other

    def count(self, effects: Sequence[Effect]) -> int:
        """Number of starts of some candidates: the hypotheses of the Bonferroni correction."""
        return sum(len(self.starts[effect.key]) for effect in effects)

    def log_p(self, effect: Effect, gain: float) -> float:
        """Log p-value of a gain by an effect.

        Starts that are the best of many choices make chance likelier.
        """
        return log_p_value(gain, len(effect.parameters)) + self.log_choices[effect.key]

    def ranked(self, base: Fit, candidates: Sequence[Effect], count: int | None = None) -> list[Scored]:
        """Candidates given a fit by their score, each from its best start: at least the `count` best of them.

        Derivatives change little from fit to fit with the same filters (a mount that rings, a low pass), so those of an earlier
        one tell which candidates need new ones: all whose score might be among the best if it were twice as good.
        """
        if self.score is None or self.score.now is not base:
            self.score, self.scores = CandidateScore(self.logs, base), {}
        derived = self._derived(base)
        allowed = [effect for effect in candidates if may_act(effect, base.keys)]
        allowed = [effect for effect in allowed if not any(exclude_each_other(effect, other) for other, _ in base.chosen)]
        known = {key for key, linear in derived.items() if all(each.acts for each in linear)} | self.scores.keys()
        self._derive(self.score, [effect for effect in allowed if effect.key not in known], derived)
        guesses = [(-np.inf if count is None else self._guess(self.score, effect, derived).log_p, effect) for effect in allowed]
        best, enough = list[Scored](), max(count or 0, 1)
        for guess, effect in sorted(guesses, key=lambda entry: entry[0]):
            if count is not None and len(best) >= enough and guess > min(UNSURE * best[enough - 1].log_p, UNLIKELY):
                break
            if effect.key not in self.scores:
                self._derive(self.score, [effect], derived)
            insort(best, self.scores[effect.key], key=attrgetter("log_p"))
        return best

    def jump_on_trend(self, base: Fit, best: Fit, named: Sequence[Effect], threshold: float) -> Fit:
        """The better of a fit with one more effect and a clock that runs fast and jumps.

        Each of the two alone is misplaced where the other acts.
        """
        clock = {effect.name: effect for effect in named if effect.name in CLOCK}
        first = best.chosen[-1][0].name
        if len(clock) < len(CLOCK) or first not in CLOCK or any(effect.name in (*CLOCK, WANDER) for effect, _ in base.chosen):
            return best
        skew, jump = (clock[name] for name in CLOCK)
        both = (skew, skew.null_value.astype(float)), (jump, self.starts[jump.key][-1])
        trial = fit(self.logs, (*base.chosen, *both), near=base)
        second = jump if first == skew.name else skew
        return trial if self.log_p(second, best.objective - trial.objective) < threshold else best

    def _derived(self, base: Fit) -> dict[str, list[_Linear]]:
        """Candidates derived given fits with the same filters; those of the last few such sets are kept."""
        filters = frozenset(effect.key for effect, _ in base.chosen if effect.stage in FILTERS and not effect.linear)
        derived = self.linear.pop(filters, {})
        while len(self.linear) >= KEPT:
            self.linear.pop(next(iter(self.linear)))
        self.linear[filters] = derived
        return derived

    def _derive(self, score: CandidateScore, effects: Sequence[Effect], derived: dict[str, list[_Linear]]) -> None:
        """Derive candidates given the fit, and score them; of the first stages, which take longest, each process gets half."""
        slowest = sorted(effects, key=lambda effect: effect.stage)
        order = [*slowest[::2], *slowest[1::2]]

        def scored(effect: Effect) -> tuple[float, Theta, float, list[_Linear]]:
            others = score.now.chosen
            begun = [((*others, (effect, start)), *lag_taken_back(others, effect, start)) for start in self.starts[effect.key]]
            linear = [score.linear(effect, each) for each in chain(*begun)]
            best = self._best(score, effect, linear)
            return best.log_p, best.start, best.gain, [each.short() for each in linear]

        for effect, (log_p, start, gain, short) in zip(order, of_each(scored, order), strict=True):
            derived[effect.key], self.scores[effect.key] = short, Scored(log_p, effect, start, gain)

    def _guess(self, score: CandidateScore, effect: Effect, derived: Mapping[str, Sequence[_Linear]]) -> Scored:
        """Score with derivatives given an earlier fit."""
        return self.scores[effect.key] if effect.key in self.scores else self._best(score, effect, derived[effect.key])

    def _best(self, score: CandidateScore, effect: Effect, linear: Sequence[_Linear]) -> Scored:
        gains = [(score.gain(effect, each), each.start) for each in linear]
        gain, start = max(gains, key=lambda pair: pair[0])
        return Scored(self.log_p(effect, gain), effect, start, gain)


class Portable(NamedTuple):
    """Description of a fit for another process, from which `restored` makes it again."""

    chosen: list[tuple[str, list[str], Theta]]
    numbers: dict[str, Any]
    unnamed: int  # effects without a name that the search had tried


def portable(search: Any, found: Fit) -> Portable:
    """Description of a fit and of the search that found it."""
    chosen = [(effect.key, [parameter.name for parameter in effect.parameters], theta) for effect, theta in found.chosen]
    numbers = {name: getattr(found, name) for name in ("bias", "objective", "residuals", "prior")}
    return Portable(chosen, numbers, len(search.unnamed))


def restored(described: Portable, like: Fit, effects: Sequence[Effect]) -> Fit:
    """Fit as another process described it; finer curves are made again."""
    by_key, chosen = {effect.key: effect for effect in effects}, list[tuple[Effect, Theta]]()
    for key, names, theta in described.chosen:
        whole = low_pass_with(by_key[key], names)
        free = [k for k, parameter in enumerate(whole.parameters) if parameter.name in names]
        effect = with_free(whole, free) if len(free) == len(names) else finer_curve(like.logs, whole)
        assert effect is not None, f"{key} was made from the same samples"
        chosen.append((effect, theta))
    passes = tuple(ForwardPass(log.pair, tuple(chosen)) for log in like.logs)
    return replace(like, chosen=tuple(chosen), passes=passes, **described.numbers)
