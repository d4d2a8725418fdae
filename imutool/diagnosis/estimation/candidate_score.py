"""One more effect beside those of a fit: what a single linear step of it would gain, without a fit for each candidate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from imutool.diagnosis.estimation.forward_cache import ForwardPass
from imutool.diagnosis.estimation.gauss_newton import Fit, WhitenedLog, direction, priors
from imutool.diagnosis.estimation.jacobians import effect_jacobian
from imutool.sensor.effect import Effect, Theta

RIDGE = 1e-9


class _Axis(NamedTuple):
    """White rows of one axis of a log that are fitted, zero elsewhere, without what the bias takes of them."""

    counts: Float64[np.ndarray, " m"]  # 1 for rows that are fitted
    bias: Float64[np.ndarray, " m"]  # a constant as it is behind the filter, of length 1
    where: Int64[np.ndarray, " q"]
    A: Float64[np.ndarray, "q m"]
    r: Float64[np.ndarray, " m"]

    def free(self, x: Float64[np.ndarray, "*k m"]) -> Float64[np.ndarray, "*k m"]:
        """What is left of some rows beside the bias."""
        x = x * self.counts
        return np.asarray(x - (x @ self.bias)[..., None] * self.bias)


class CandidateScore:
    """The normal equations of a fit, with a place left for one more effect."""

    def __init__(self, logs: Sequence[WhitenedLog], now: Fit) -> None:
        self.logs, self.now = logs, now
        q = sum(len(theta) for _, theta in now.chosen)
        self.N, self.g, self.total, self.axes = RIDGE * np.eye(q), np.zeros(q), 0.0, []
        for number, (log, course) in enumerate(zip(logs, now.courses, strict=True)):
            counts, residual = log.rows("fitted").astype(float), log.residual(course)
            everything = np.ones(len(counts), bool)
            for k in range(6):
                bias = log.constants[:, k] * counts
                where, A = now.slopes.on_axis(number, k, everything)
                one = _Axis(counts, direction(bias), where, A, residual[:, k])
                one = one._replace(A=one.free(A), r=one.free(residual[:, k]))
                self.axes.append(one)
                self.N[np.ix_(where, where)] += one.A @ one.A.T
                self.g[where] += one.A @ one.r
                self.total += float(one.r @ one.r)
        self.left = self.total - float(self.g @ np.linalg.solve(self.N, self.g))

    def gain(self, physics: Effect, start: Theta) -> float:
        """Squares that one linear step from a start takes off, no positive parameter changing by more than a factor of e."""
        chosen, p = (*self.now.chosen, (physics, start)), len(start)
        moves = np.array([not number.begins for number in physics.parameters])  # the others are gone through, not stepped
        N_bb, N_ab, g_b = np.zeros((p, p)), np.zeros((len(self.N), p)), np.zeros(p)
        g_a, total = self.g.copy(), self.total
        for k, (log, course) in enumerate(zip(self.logs, self.now.courses, strict=True)):
            with_it = course if physics.linear else ForwardPass(log.pair, chosen, course)
            B, added = effect_jacobian(log.whiten, with_it, physics), with_it.added(course)
            for axis, one in enumerate(self.axes[6 * k : 6 * k + 6]):
                js, r = np.flatnonzero(B.on[axis] & moves), one.r
                if axis in added:
                    r = r - one.free(log.whiten.rows(added[axis][None], np.array([axis]))[0])
                    total += float(r @ r - one.r @ one.r)
                    g_a[one.where] += one.A @ (r - one.r)
                if len(js):
                    b = one.free(B.white[axis, js])
                    N_bb[np.ix_(js, js)] += b @ b.T
                    N_ab[np.ix_(one.where, js)] += one.A @ b.T
                    g_b[js] += b @ r
        _, std = priors((chosen[-1],), (chosen[-1],))
        beside = np.linalg.solve(self.N, np.concatenate([N_ab, g_a[:, None]], axis=1))
        S, g = N_bb + np.diag(1.0 / std**2) - N_ab.T @ beside[:, :p], g_b - N_ab.T @ beside[:, p]
        step = np.linalg.solve(S, g)
        far = float(np.abs(step[[number.positive for number in physics.parameters]]).max(initial=1.0))
        return float(self.left - total + g_a @ beside[:, p] + (2.0 / far - 1.0 / far**2) * (g @ step))
