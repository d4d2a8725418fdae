"""Score test of a candidate effect: the gain of one linear step beside a fit, without a fit for each candidate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from imutool.diagnosis.estimation.gauss_newton import Fit, direction, priors
from imutool.diagnosis.estimation.jacobians import ForwardPass, effect_jacobian
from imutool.diagnosis.estimation.whitening import WhitenedLog
from imutool.sensor.effect import Effect, Theta

RIDGE = 1e-9


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
        """Gain in squares of one linear step from a start, no positive parameter changing by more than a factor of e."""
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
        _, std = priors(chosen[-1:])
        beside = np.linalg.solve(self.N, np.concatenate([N_ab, g_a[:, None]], axis=1))
        S, g = N_bb + np.diag(1.0 / std**2) - N_ab.T @ beside[:, :p], g_b - N_ab.T @ beside[:, p]
        step = np.linalg.solve(S, g)
        far = float(np.abs(step[[parameter.positive for parameter in effect.parameters]]).max(initial=1.0))
        return float(self.left - total + g_a @ beside[:, p] + (2.0 / far - 1.0 / far**2) * (g @ step))
