"""One more effect beside those of a fit: what a single linear step of it would gain, without a fit for each candidate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from imutool.physics import fit as fits
from imutool.physics.effects._forward import Physics, Theta
from imutool.physics.fit import Fit, Weighed, derivatives, expected


class Panel:
    """The normal equations of a fit, with a place left for one more effect."""

    def __init__(self, logs: Sequence[Weighed], now: Fit) -> None:
        self.logs, self.now, self.masks = logs, now, [log.rows("fitted") for log in logs]
        self.bases = [expected(log.pair, now.chosen) for log in logs]
        self.sampled = [fits.sampled(log.pair, now.chosen) for log in logs]
        self.columns = []
        for k, (log, base, mask) in enumerate(zip(logs, self.bases, self.masks, strict=True)):
            J = log.whiten(derivatives(log.pair, now.chosen, range(len(now.chosen)), base))[mask]
            ones = np.zeros((*J.shape[:2], 6 * len(logs)))
            ones[:, range(6), range(6 * k, 6 * k + 6)] = fits.constants(log)[mask]
            self.columns.append(np.concatenate([J, ones], axis=2).reshape(-1, J.shape[2] + ones.shape[2]))
        self.N = sum(A.T @ A for A in self.columns) + 1e-9 * np.eye(self.columns[0].shape[1])
        self.white = [
            (log.whiten(log.pair.real - base)[mask] - fits.constants(log)[mask] * now.bias[k]).reshape(-1)
            for k, (log, base, mask) in enumerate(zip(logs, self.bases, self.masks, strict=True))
        ]
        self.left = self._left(self.white)

    def _left(self, white: Sequence[Float64[np.ndarray, " m"]]) -> float:
        g = sum(A.T @ r for A, r in zip(self.columns, white, strict=True))
        return float(sum(r @ r for r in white) - g @ np.linalg.solve(self.N, g))

    def gain(self, physics: Physics, start: Theta) -> float:
        """Squares that one linear step from a start takes off."""
        chosen = (*self.now.chosen, (physics, start))
        p, q, total = len(start), len(self.N), 0.0
        N_bb, N_ab, g_b, g_a = np.zeros((p, p)), np.zeros((q, p)), np.zeros(p), np.zeros(q)
        panel = zip(self.logs, self.bases, self.masks, self.columns, self.white, self.sampled, strict=True)
        for log, base, mask, A, white, sampled in panel:
            r, there = white, base if physics.linear else expected(log.pair, chosen)
            J = derivatives(log.pair, chosen, [len(chosen) - 1], there, sampled)
            B = log.whiten(J)[mask].reshape(-1, len(start))
            if not physics.linear:
                r = white - log.whiten(there - base)[mask].reshape(-1)
            N_bb, N_ab = N_bb + B.T @ B, N_ab + A.T @ B
            g_b, g_a, total = g_b + B.T @ r, g_a + A.T @ r, total + r @ r
        _, std = fits.priors((chosen[-1],), (chosen[-1],))
        S = N_bb + np.diag(1.0 / std**2) - N_ab.T @ np.linalg.solve(self.N, N_ab)
        g = g_b - N_ab.T @ np.linalg.solve(self.N, g_a)
        left = total - g_a @ np.linalg.solve(self.N, g_a) - g @ np.linalg.solve(S, g)
        return float(self.left - left)
