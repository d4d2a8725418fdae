"""Unit, frame and axes P in which a sensor reads its motion.

A frame is the body's, the world's, or that of the rates of Euler angles; axes are signed ones, or turned.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from imutool.array_types import Float64, Vectors

CLEARLY = 0.5  # of the squares of the ideal sensor, up to which another unit, frame or axes are chosen
ALIKE = 1.1  # times the least squares: hypotheses that explain as much, of which the simplest is taken
MIN_TURN = 0.05  # rad, from signed axes: less is a mount's misalignment
UNSEEN = 1e-4  # of the products of signal and parts: less tells no rotation, as that about the only axis of a planar motion;
# so rotations come out too small by up to this share
MIN_SEEN = 0.01  # of these products, of the axis that moves least, with a turned reflection
MAX_BIAS = 1.0  # m/s², of the accelerometer: gravity in the world frame is none

Parts = Float64[np.ndarray, "n 3 p"]
Matrix = Float64[np.ndarray, "3 3"]

AXES_ORDERS = product(permutations(range(3)), product((1.0, -1.0), repeat=3))
PERMUTATIONS = sorted(  # all 48 signed permutations, those that change fewest axes first
    (np.eye(3)[list(order)] * np.array(signs)[:, None] for order, signs in AXES_ORDERS),
    key=lambda P: float(np.abs(P - np.eye(3)).sum()),
)


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Parts of a motion in each frame, the right one first, of which a signal may be made."""

    frames: Mapping[str, Parts]
    free_bias: bool  # or at most `MAX_BIAS`
    turns: bool  # its axes may be turned, too

    def frame(self, y: Vectors) -> tuple[str, Matrix]:
        """Frame of a signal, and its axes P: the simplest that explains as much as any."""
        squares = self._squares(y, scaled=True)
        minimum = max(min(entry[0] for entry in squares), 1e-9 * float((y**2).sum()))  # an exact sensor leaves rounding
        if minimum > CLEARLY * squares[0][0]:
            return squares[0][2:]
        chosen = min((entry for entry in squares if entry[0] <= ALIKE * minimum), key=lambda entry: entry[1])
        frame, P = chosen[2:]
        return frame, nearest_signed(P) if is_signed(P) else P

    def unit(self, y: Vectors, other: float) -> float:
        """1, or another factor, if the signal times it is explained clearly better."""
        size = max(float((y**2).sum()), 1e-300)
        as_read, turned = (min(each[0] for each in self._squares(y * by)) / (size * by**2) for by in (1.0, other))
        return other if turned < CLEARLY * min(as_read, 1.0) else 1.0

    def _squares(self, y: Vectors, *, scaled: bool = False) -> list[tuple[float, int, str, Matrix]]:
        """What each frame and P leaves of a signal, with its rank: the ideal sensor is the first."""
        out: list[tuple[float, int, str, Matrix]] = []
        tried = [(frame, x, PERMUTATIONS) for frame, x in self.frames.items()]
        if self.turns:
            right, x = next(iter(self.frames.items()))
            tried.append((right, x, self._turned(y, x)))
        for frame, x, axes in tried:
            each = zip(axes, _minimum(y, x, axes, free_bias=self.free_bias, scaled=scaled), strict=True)
            out += [(squares, len(out) + rank, frame, P) for rank, (P, squares) in enumerate(each)]
        return out

    def _turned(self, y: Vectors, x: Parts) -> list[Matrix]:
        """Rotations, then reflections, of parts to a signal: Wahba's problem (SIAM Review 7, 1965)."""
        out = []
        for handed in (1.0, -1.0):
            for weight in _weights(x):
                of_y, of_x = (part - part.mean(axis=0) if self.free_bias else part for part in (y, x @ np.array(weight)))
                B = of_y.T @ of_x
                U, seen, Vt = np.linalg.svd(B + UNSEEN * np.linalg.norm(B) * np.diag([1.0, handed, 1.0]))
                if handed < 0.0 and seen[2] < MIN_SEEN * seen[0]:  # a planar motion shows no reflection
                    continue
                out.append(np.asarray(U @ np.diag([1.0, 1.0, handed * np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt))
        return out


def nearest_signed(P: Matrix) -> Matrix:
    """Signed axes from which others are turned least; the first of several."""
    return max(PERMUTATIONS, key=lambda signed: float(np.trace(P @ signed.T)))


def is_signed(P: Matrix) -> bool:
    """Whether axes are signed ones, up to a small angle."""
    return float(np.trace(P @ nearest_signed(P).T)) > 1.0 + 2.0 * math.cos(MIN_TURN)


def _weights(x: Parts) -> list[tuple[float, ...]]:
    """Weights of the parts: the rate; or acceleration, gravity (1, 0, 2, -1) and transport term."""
    if x.shape[2] == 1:
        return [(1.0,)]
    return [*((1.0, g, c) for g in (1.0, 0.0, 2.0, -1.0) for c in (0.0, 1.0)), (0.0, 1.0, 0.0)]


def _minimum(y: Vectors, x: Parts, axes: Sequence[Matrix], *, free_bias: bool, scaled: bool) -> list[float]:
    """Least squares of y P by its parts, for each P; the first part may be `scaled`."""
    weights = _weights(x)
    flat, n, s = x.reshape(-1, x.shape[2]), len(y), float((y**2).sum())
    G, both = flat.T @ flat, y.T @ x.reshape(n, -1)  # of y and x, whatever P
    mean_x, mean_y = x.mean(axis=0), y.mean(axis=0)
    out = []
    for P in axes:
        g, best = np.einsum("ji,jip->p", P, both.reshape(3, *x.shape[1:])), np.inf
        candidates = [np.array(weight) for weight in weights]
        if scaled:
            about, size = g - n * (mean_y @ P) @ mean_x, G - n * mean_x.T @ mean_x
            free = [max(float(about[0] - size[0, 1:] @ w[1:]) / max(float(size[0, 0]), 1e-300), 0.0) for w in candidates]
            candidates += [np.array([m, *w[1:]]) for m, w in zip(free, candidates, strict=True) if w[0]]
        for w in candidates:
            mean = mean_y @ P - mean_x @ w
            squares = 0.0 if free_bias else float(np.sum(np.maximum(np.abs(mean) - MAX_BIAS, 0.0) ** 2))
            best = min(best, s - 2.0 * float(w @ g) + float(w @ G @ w) - n * (float(mean @ mean) - squares))
        out.append(best)
    return out
