"""Unit, frame and axes P in which a sensor reads its motion.

A frame is the body's, the world's, or that of the rates of Euler angles; axes are signed ones, or turned.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from imutool.array_types import Float64

CLEARLY = 0.5  # of the squares of the ideal sensor, up to which another unit, frame or axes are chosen
ALIKE = 1.1  # times the least squares: hypotheses that explain as much, of which the simplest is taken
LEAST_TURN = 0.05  # rad, from signed axes: less is a mount's misalignment
MOST_BIAS = 1.0  # m/s², of the accelerometer: gravity in the world frame is none

Vectors = Float64[np.ndarray, "n 3"]
Parts = Float64[np.ndarray, "n 3 p"]
Matrix = Float64[np.ndarray, "3 3"]

AXES_ORDERS = product(permutations(range(3)), product((1.0, -1.0), repeat=3))
PERMUTATIONS = sorted(  # all 48 signed permutations, those that change fewest axes first
    (np.eye(3)[list(order)] * np.array(signs)[:, None] for order, signs in AXES_ORDERS),
    key=lambda P: float(np.abs(P - np.eye(3)).sum()),
)
RIGHT = np.array([1.0, 1.0, 0.0])  # of the parts in a right simulation


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Parts of a motion in each frame, the right one first, of which a signal may be made.

    Its bias is free, or at most `MOST_BIAS`. With `turns` its axes may be turned, too.
    """

    frames: Mapping[str, Parts]
    free_bias: bool
    turns: bool

    def frame(self, y: Vectors) -> tuple[str, Matrix]:
        """Frame of a signal, and its axes P: the simplest that explains as much as any."""
        squares = self._squares(y)
        least = max(min(entry[0] for entry in squares), 1e-9 * float((y**2).sum()))  # an exact sensor leaves rounding
        if least > CLEARLY * squares[0][0]:
            return squares[0][2:]
        chosen = min((entry for entry in squares if entry[0] <= ALIKE * least), key=lambda entry: entry[1])
        return chosen[2:]

    def unit(self, y: Vectors, other: float) -> float:
        """1, or another factor, if the signal times it is explained clearly better."""
        size = max(float((y**2).sum()), 1e-300)
        as_read, turned = (min(each[0] for each in self._squares(y * by)) / (size * by**2) for by in (1.0, other))
        return other if turned < CLEARLY * min(as_read, 1.0) else 1.0

    def _squares(self, y: Vectors) -> list[tuple[float, int, str, Matrix]]:
        """What each frame and P leaves of a signal, with its rank: the ideal sensor is the first."""
        out: list[tuple[float, int, str, Matrix]] = []
        for frame, x in self.frames.items():
            each = zip(PERMUTATIONS, _least(y, x, PERMUTATIONS, free_bias=self.free_bias), strict=True)
            out += [(left, len(out) + rank, frame, P) for rank, (P, left) in enumerate(each)]
        if not self.turns:
            return out
        frame, x = next(iter(self.frames.items()))
        P = self._turned(y, x @ RIGHT[: x.shape[2]])
        if not is_signed(P):
            out.append((_least(y, x, [P], free_bias=self.free_bias)[0], len(out), frame, P))
        return out

    def _turned(self, y: Vectors, x: Vectors) -> Matrix:
        """Rotation of a signal to what a right sensor reads: Wahba's problem (SIAM Review 7, 1965)."""
        y, x = (part - part.mean(axis=0) if self.free_bias else part for part in (y, x))
        U, _, Vt = np.linalg.svd(y.T @ x)
        return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt)


def is_signed(P: Matrix) -> bool:
    """Whether axes are signed ones, up to a small angle."""
    return max(float(np.trace(P @ signed.T)) for signed in PERMUTATIONS) > 1.0 + 2.0 * math.cos(LEAST_TURN)


def _least(y: Vectors, x: Parts, axes: Sequence[Matrix], *, free_bias: bool) -> list[float]:
    """Least squares of y P by its parts, for each P: the rate; or acceleration, gravity (0, 1, 2, -1) and transport term."""
    weights = (
        [(1.0,)] if x.shape[2] == 1 else [*((1.0, g, c) for g in (1.0, 0.0, 2.0, -1.0) for c in (0.0, 1.0)), (0.0, 1.0, 0.0)]
    )
    flat, n, s = x.reshape(-1, x.shape[2]), len(y), float((y**2).sum())
    G, both = flat.T @ flat, y.T @ x.reshape(n, -1)  # of y and x, whatever P
    mean_x, mean_y = x.mean(axis=0), y.mean(axis=0)
    out = []
    for P in axes:
        g, best = np.einsum("ji,jip->p", P, both.reshape(3, *x.shape[1:])), np.inf
        for weight in weights:
            w = np.array(weight)
            mean = mean_y @ P - mean_x @ w
            left = 0.0 if free_bias else float(np.sum(np.maximum(np.abs(mean) - MOST_BIAS, 0.0) ** 2))
            best = min(best, s - 2.0 * float(w @ g) + float(w @ G @ w) - n * (float(mean @ mean) - left))
        out.append(best)
    return out
