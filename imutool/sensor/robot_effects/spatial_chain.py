"""Efforts of a chain of hinges across each other, linear in the moments of its links.

A point of link i at x is at the sum of R_j r_j over the links before, and R_i x. With E the columns of all R_i side by side,
efforts are those of d²E/dt² S and of gravity on A, where S (kg m²) and A (kg m) are the second and first moments of all
links, one symmetric matrix and one vector (principle of d'Alembert). The part of R_i along its own axis moves with link i - 1:
two columns a link are left. The directions of the axes alone are searched for: first at right angles or parallel, then near.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from imutool.array_types import Float64, Vectors
from imutool.recording import GRAVITY_M_S2
from imutool.sensor.robot_effects.signal_samples import State

DIRECTIONS = np.concatenate([np.eye(3), -np.eye(3)])  # of an axis where all angles are zero: most arms are built square
STARTS, SEED = 10, 0
EVALUATIONS = 30  # of a residual, with its derivatives, at most
MIN_MOMENT = 0.02  # of the tip against gravity, over the arm's size, that shows the links' lengths
Axes = Vectors
APART = 0.2  # of a direction that no place on the last link has
UNSURE = 1e-3  # square of the sine from which on a product of inertia hides a length
Cost = Callable[[Axes], float]


@dataclass(frozen=True, eq=False)
class SpatialChain:
    """Axes of the joints from base to tip where all angles are zero; the third direction is up."""

    axes: Axes

    @cached_property
    def bases(self) -> Float64[np.ndarray, "n 3 2"]:
        """Two directions of each link, at right angles to its axis."""
        return np.stack([np.linalg.svd(axis[None])[2][1:].T for axis in self.axes])

    @property
    def moments(self) -> int:
        """Number of coefficients: those of S, and those of A."""
        n = 2 * len(self.axes)
        return n * (n + 3) // 2

    def unpacked(self, theta: Float64[np.ndarray, " _"]) -> tuple[Float64[np.ndarray, "u u"], Float64[np.ndarray, " u"]]:
        """S and A from coefficients."""
        n = 2 * len(self.axes)
        S, (a, b) = np.zeros((n, n)), np.triu_indices(n)
        S[a, b] = S[b, a] = theta[: len(a)]
        return S, np.asarray(theta[len(a) : self.moments])

    def moved(self, state: State) -> Moved:
        """Directions of links and axes in the world, with their accelerations."""
        n, length = len(self.axes), len(state["q0"])
        R, speed, spin = np.broadcast_to(np.eye(3)[:, :, None], (3, 3, length)), np.zeros((3, length)), np.zeros((3, length))
        axes, E, bent = np.empty((n, 3, length)), np.empty((2 * n, 3, length)), np.empty((2 * n, 3, length))
        for k, (axis, basis) in enumerate(zip(self.axes, self.bases, strict=True)):
            q, dq, ddq = (state[f"{kind}{k}"] for kind in ("q", "dq", "ddq"))
            along = np.einsum("cdn,d->cn", R, axis)
            spin = spin + along * ddq + _cross(speed, along) * dq
            speed = speed + along * dq
            c, s, fixed = np.cos(q), np.sin(q), along * (1.0 - np.cos(q))
            R = c * R + s * _cross(along[:, None], R) + fixed[:, None] * axis[:, None]
            axes[k], e = along, np.einsum("cdn,dj->cjn", R, basis)
            turning = _cross(spin[:, None], e) + _cross(speed[:, None], _cross(speed[:, None], e))
            E[2 * k : 2 * k + 2], bent[2 * k : 2 * k + 2] = e.swapaxes(0, 1), turning.swapaxes(0, 1)
        return Moved(axes, E, bent)

    def efforts(self, moved: Moved, S: Float64[np.ndarray, "u u"], A: Float64[np.ndarray, " u"]) -> Float64[np.ndarray, "n k"]:
        """Efforts of all joints for some moments."""
        force = np.tensordot(S, moved.bent, axes=1)
        force[:, 2] += GRAVITY_M_S2 * A[:, None]
        turning = _cross(moved.E.swapaxes(0, 1), force.swapaxes(0, 1))
        links = turning[:, ::2] + turning[:, 1::2]
        beyond = np.cumsum(links[:, ::-1], axis=1)[:, ::-1]  # a joint carries all links behind it
        return np.asarray(np.einsum("kcn,ckn->nk", moved.axes, beyond))

    def columns(self, state: State) -> Float64[np.ndarray, "_ _ _"]:
        """Efforts for each coefficient: rows, joints, coefficients."""
        moved, n = self.moved(state), len(self.axes)
        a, b = np.triu_indices(2 * n)
        weights, length = np.where(a == b, 0.5, 1.0)[:, None], moved.E.shape[2]
        out = np.zeros((n, self.moments, length))  # samples last: what is gathered lies in one piece
        for k in range(n):
            arm, G = _cross(moved.axes[k][:, None], moved.E[2 * k :].swapaxes(0, 1)), np.zeros((2 * n, 2 * n, length))
            for own, bent in zip(arm, moved.bent.swapaxes(0, 1), strict=True):
                G[2 * k :] += own[:, None] * bent
            out[k, : len(a)] = weights * (G[a, b] + G[b, a])
            out[k, len(a) + 2 * k :] = GRAVITY_M_S2 * arm[2]
        return out.transpose(2, 0, 1)

    def of_link(self, x: Float64[np.ndarray, " 3"], link: int = -1) -> Float64[np.ndarray, " u"]:
        """A vector of a link, the last one, in the directions of all links."""
        out, orthogonal = np.zeros(2 * len(self.axes)), np.asarray(x, float)
        for k in reversed(range(len(self.axes))[: link + 1 or None]):
            out[2 * k : 2 * k + 2] = self.bases[k].T @ orthogonal
            orthogonal = self.axes[k] * float(self.axes[k] @ orthogonal)
        return out

    def origin(self, theta: Float64[np.ndarray, " _"]) -> tuple[Float64[np.ndarray, " u"], Float64[np.ndarray, "u m"]]:
        """Place of the last joint (m), in the directions of all links, and the directions in which nothing shows it.

        S between links i < j is r_i A_j. What link j weighs along its own axis moves with a link before: there S has a
        product of inertia too, and says little of a length.
        """
        S, A = self.unpacked(theta)
        n, size = len(self.axes), float(np.sqrt(np.abs(np.diag(S)).max()))
        S, A = S.reshape(n, 2, n, 2), A.reshape(n, 2)
        out, unknown = np.zeros((n, 2)), list[Float64[np.ndarray, " u"]]()
        for i in range(n - 1):
            N, shown, g = np.zeros((2, 2)), np.zeros((2, 2)), np.zeros(2)
            for j in range(i + 1, n):
                along = self.of_link(self.axes[j], j).reshape(n, 2)[i]
                squared = max(float(along @ along), 1e-300)
                P, weight = np.outer(along, along) / squared, 1.0 / (1.0 + squared / UNSURE)
                shown += float(A[j] @ A[j]) * (np.eye(2) - (weight < 0.5) * P)
                N += float(A[j] @ A[j]) * (np.eye(2) - (1.0 - weight) * P)
                g += (np.eye(2) - (1.0 - weight) * P) @ S[i, :, j] @ A[j]
            squares, directions = np.linalg.eigh(shown)
            known = np.sqrt(GRAVITY_M_S2 * np.maximum(squares, 0.0)) >= MIN_MOMENT**2 * size
            kept = directions[:, known]
            out[i] = kept @ np.linalg.solve(kept.T @ N @ kept, kept.T @ g)
            unknown += [np.kron(np.eye(n)[i], d) for d in directions[:, ~known].T]
        return out.ravel(), self._beyond_last_link(unknown)

    def _beyond_last_link(self, unknown: list[Float64[np.ndarray, " u"]]) -> Float64[np.ndarray, "u m"]:
        """Directions that no place on the last link has."""
        if not unknown:
            return np.zeros((2 * len(self.axes), 0))
        own = np.stack([self.of_link(axis) for axis in np.eye(3)], axis=1)
        U = np.stack(unknown, axis=1)
        left, sizes, _ = np.linalg.svd(U - own @ np.linalg.lstsq(own, U, rcond=None)[0], full_matrices=False)
        return np.asarray(left[:, sizes > APART])


@dataclass(frozen=True, eq=False)
class Moved:
    """World directions of the axes and of the links' two directions, and accelerations of those."""

    axes: Float64[np.ndarray, "k 3 n"]
    E: Float64[np.ndarray, "u 3 n"]
    bent: Float64[np.ndarray, "u 3 n"]


def searched(n: int, residual: Callable[[Axes], Float64[np.ndarray, " _"]], enough: float) -> Axes | None:
    """Axes whose residual is below enough (root mean square); None where none are found.

    Axes at right angles are turned one at a time from random ones. The best of them are then turned by small angles, and stay
    square where that explains no more than chance (BIC).
    """
    rng, found = np.random.default_rng(SEED), list[tuple[float, Axes]]()

    def cost(axes: Axes) -> float:
        return float((residual(axes) ** 2).mean())

    for _ in range(STARTS):
        axes, best = _descended(DIRECTIONS[rng.integers(0, len(DIRECTIONS), n)], cost)
        found.append((best, axes))
        if best < enough**2:
            break
    best, axes = min(found, key=lambda each: each[0])
    turned = _turned(axes, residual)
    rows = len(residual(axes))
    if rows * np.log(best / cost(turned)) > 2 * n * np.log(rows):
        best, axes = cost(turned), turned
    return axes if best < enough**2 else None


def _turned(axes: Axes, residual: Callable[[Axes], Float64[np.ndarray, " _"]]) -> Axes:
    """Axes of the least residual near others, turned about the vertical to be as near to those as they can."""
    n, bases = len(axes), SpatialChain(axes).bases

    def at(x: Float64[np.ndarray, " _"]) -> Axes:
        out = axes + np.einsum("kij,kj->ki", bases, x.reshape(n, 2))
        return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))

    def left(x: Float64[np.ndarray, " _"]) -> Float64[np.ndarray, " _"]:
        return residual(at(x))

    out = at(least_squares(left, np.zeros(2 * n), max_nfev=EVALUATIONS).x)
    (sx, sy), (ox, oy) = axes[:, :2].T, out[:, :2].T
    turn = np.arctan2((ox * sy - oy * sx).sum(), (ox * sx + oy * sy).sum())  # gravity does not show it
    return np.asarray(Rotation.from_euler("z", turn).apply(out))


def _descended(axes: Axes, cost: Cost) -> tuple[Axes, float]:
    best, turned = cost(axes), True
    while turned:
        turned = False
        for other in _neighbours(axes):
            if (moved_cost := cost(other)) < best:
                axes, best, turned = other, moved_cost, True
    return axes, best


def _neighbours(axes: Axes) -> Iterator[Axes]:
    for k in range(len(axes)):
        for direction in DIRECTIONS:
            if not np.array_equal(direction, axes[k]):
                out = axes.copy()
                out[k] = direction
                yield out


def _cross(a: Float64[np.ndarray, "..."], b: Float64[np.ndarray, "..."]) -> Float64[np.ndarray, "..."]:
    """Products along the first axis; each element is looked at where it lies, without a copy."""
    x = a[1] * b[2]
    out = np.empty((3, *x.shape))
    np.subtract(x, a[2] * b[1], out=out[0])
    np.subtract(a[2] * b[0], a[0] * b[2], out=out[1])
    np.subtract(a[0] * b[1], a[1] * b[0], out=out[2])
    return out
