"""Relative errors of a path that comes in blocks: ROE and RPE."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.geometry import quaternion
from imutool.inertial.scoring.path_blocks import AT_ONCE
from imutool.recording import Poses

PAIR_TOLERANCE = 0.1  # relative tolerance of a pair's distance: evo's default

Indices = Int64[np.ndarray, " m"]


class RelativeErrors:
    """Sums of the differences of motions over pairs of poses.

    It keeps poses until the true path has gone on by the longest distance.
    """

    def __init__(self, distances_m: Sequence[float]) -> None:
        self._distances_m = distances_m
        self._sums = np.zeros((len(distances_m), 3))  # pairs, metres, radians
        self._next = np.zeros(len(distances_m), np.int64)  # first kept pose whose pair is not known, by distance
        self._travelled, self._p, self._p_true = np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3))
        # With C = R_true R_est^T, R_true,i^T (dp_true - C_i dp_est) is the difference of motions, and C_i C_j^T that of their
        # rotations in another frame: length and angle are the same, for a fraction of the products.
        self._C = np.zeros((0, 4))

    @np.errstate(over="ignore", invalid="ignore")  # who asks for the figures checks them
    def add(self, estimate: Poses, truth: Poses) -> None:
        """Adds poses that count, on the same stamps."""
        if not len(truth):
            return
        before = self._p_true[-1:] if len(self._p_true) else truth.p_wb[:1]
        steps = quaternion.length(np.diff(np.concatenate([before, truth.p_wb]), axis=0))
        travelled = np.cumsum(np.concatenate([self._travelled[-1:], steps]))[-len(steps) :]
        q, q_true = quaternion.unit(estimate.q_wb_wxyz), quaternion.unit(truth.q_wb_wxyz)
        first = int(min(self._next, default=0))
        self._next -= first
        self._travelled = np.concatenate([self._travelled[first:], travelled])
        self._p = np.concatenate([self._p[first:], estimate.p_wb])
        self._p_true = np.concatenate([self._p_true[first:], truth.p_wb])
        self._C = np.concatenate([self._C[first:], quaternion.multiply(q_true, quaternion.inverse(q))])
        for k, distance_m in enumerate(self._distances_m):
            ended = int(np.searchsorted(self._travelled + distance_m, self._travelled[-1], side="right"))
            self._add_pairs(k, min(ended, len(self._travelled) - 1))

    @property
    def kept(self) -> int:
        """Number of poses in memory."""
        return len(self._travelled)

    def _add_pairs(self, k: int, end: int) -> None:
        """Adds the pairs of one distance that begin before a row."""
        for first in range(int(self._next[k]), end, AT_ONCE):
            rows = np.arange(first, min(first + AT_ONCE, end))
            i, j = pairs_by_distance(self._travelled, rows, self._distances_m[k])
            moved, moved_true = (p[j] - p[i] for p in (self._p, self._p_true))
            apart_m = quaternion.length(quaternion.rotate(self._C[i], moved) - moved_true).sum() if len(i) else 0.0
            turned = quaternion.angle_between(self._C[i], self._C[j]).sum() if len(i) else 0.0
            self._sums[k] += len(i), apart_m, turned
        self._next[k] = max(end, self._next[k])

    @np.errstate(over="ignore", invalid="ignore")
    def figures(self) -> dict[str, dict[str, float | None]]:
        """Means over all pairs, by distance; None where there is none."""
        roe: dict[str, float | None] = {}
        rpe: dict[str, float | None] = {}
        for k, distance_m in enumerate(self._distances_m):
            self._add_pairs(k, len(self._travelled) - 1)
            count, apart_m, turned = self._sums[k].tolist()
            key = f"{distance_m:g}"
            roe[key], rpe[key] = (float(np.degrees(turned / count)), apart_m / count) if count else (None, None)
        return {"roe_deg": roe, "rpe_m": rpe}


def pairs_by_distance(
    travelled: Float64[np.ndarray, " n"], i: Int64[np.ndarray, " _"], distance_m: float
) -> tuple[Indices, Indices]:
    """Pairs (i, j): the later point j at `distance_m` from point i along the path.

    `travelled` is the length of the path (m) to each point. The distance may differ by `PAIR_TOLERANCE` of it.

    The rule of evo's `--all_pairs`: of equally near points the first. Bisection applies because distance along a path only
    grows (evo searches every pair, minutes for 30 000 poses).
    """
    above = np.searchsorted(travelled, travelled[i] + distance_m, side="left")
    above = np.clip(above, i + 1, len(travelled) - 1)
    below = np.searchsorted(travelled, travelled[above - 1], side="left")  # first of the points that share that distance
    below = np.clip(below, i + 1, above)
    miss_above = np.abs(travelled[above] - travelled[i] - distance_m)
    miss_below = np.abs(travelled[below] - travelled[i] - distance_m)
    near = np.minimum(miss_below, miss_above) <= distance_m * PAIR_TOLERANCE
    return i[near], np.where(miss_below <= miss_above, below, above)[near]
