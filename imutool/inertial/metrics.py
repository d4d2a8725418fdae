"""Error metrics of an estimated trajectory.

Plain dicts for JSON, with the unit in every key.

Definitions are the paper's (section "Evaluation Metric"), which are those of evo; a test compares with evo's command line.
Both trajectories have the same stamps, and a mask marks the rows with truth; other rows count nowhere. A figure that the
data do not determine is None (JSON null).

==================  ===================================================================================================
aoe_deg, ape_m      root mean square of the rotation angle and of the distance between estimate and truth, not aligned:
                    both start from the true pose, so all of the error is the estimate's (`evo_ape tum -r angle_deg`)
aoe_aligned_deg,    the same after the rigid motion of the estimate that brings its positions nearest to the true ones
ape_aligned_m       (Umeyama 1991, no scale; `evo_ape tum --align`)
velocity_rmse_m_s   root mean square of the velocity difference, not aligned
roe_deg, rpe_m      mean rotation angle and mean length of the difference of motions over stretches of 5, 10, 15 and
                    20 m of the true path (`evo_rpe tum -d D -u m --all_pairs --pairs_from_reference`)
==================  ===================================================================================================
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from imutool.array_types import Bool, Float64, Int64
from imutool.errors import DataError, NumericsError
from imutool.geometry import quaternion
from imutool.inertial.scoring.alignment import Moments
from imutool.inertial.scoring.path_blocks import AT_ONCE, PathBlock, PathBlocks
from imutool.recording import TURNED, Poses

DISTANCES_M = (5.0, 10.0, 15.0, 20.0)

Mask = Bool[np.ndarray, " n"]
Figures = dict[str, float | None]
PAIR_TOLERANCE = 0.1  # relative tolerance of a pair's distance: evo's default
Indices = Int64[np.ndarray, " m"]


def evaluate(estimate: Poses, truth: Poses, valid: Mask, distances_m: Sequence[float] = DISTANCES_M) -> dict[str, Any]:
    """Error metrics of the module's table, with `samples` (rows that count) and `duration_s`.

    The duration is from the first such row to the last.

    Raises:
        DataError: stamps differ, or no row is valid.
        NumericsError: a figure is not finite.
    """
    return evaluate_blocks(_blocks_of(estimate, truth, valid), distances_m)


def evaluate_blocks(blocks: PathBlocks, distances_m: Sequence[float] = DISTANCES_M) -> dict[str, Any]:
    """Error metrics as `evaluate`, of a path in blocks, which comes twice for the alignment."""
    sums, pairs = AbsoluteErrors(), RelativeErrors(distances_m)
    for estimate, truth in map(PathBlock.scored, blocks()):
        sums.add(estimate, truth)
        pairs.add(estimate, truth)
    figures = _finite(sums.figures(blocks))  # a path that diverged has no finite APE, whatever its relative errors
    duration_s = float(sums.last_ns - sums.first_ns) * 1e-9
    return {"samples": sums.count, "duration_s": duration_s, **figures, **pairs.figures()}


def absolute(estimate: Poses, truth: Poses, valid: Mask) -> Figures:
    """Absolute errors of orientation, position and velocity: AOE, APE, velocity RMSE.

    The aligned figures are None if positions (of either) do not span a plane, the velocity figure if a velocity is missing.
    Figures of position and velocity are None for a truth of orientations alone.

    Raises:
        DataError: stamps differ, or no row is valid.
        NumericsError: a figure is not finite.
    """
    return absolute_blocks(_blocks_of(estimate, truth, valid))


def absolute_blocks(blocks: PathBlocks) -> Figures:
    """Absolute errors as `absolute`, of a path in blocks."""
    sums = AbsoluteErrors()
    for estimate, truth in map(PathBlock.scored, blocks()):
        sums.add(estimate, truth)
    return _finite(sums.figures(blocks))


def _blocks_of(estimate: Poses, truth: Poses, valid: Mask) -> PathBlocks:
    """A path in memory in blocks, of the rows that count."""

    def blocks() -> Iterator[PathBlock]:
        path, true = PathBlock(estimate, truth, valid).scored()
        if not len(true):
            raise DataError("no stamp of the estimate has truth", expected="an overlap")
        for first in range(0, len(true), AT_ONCE):
            rows = slice(first, first + AT_ONCE)
            part = true.rows(rows)
            yield PathBlock(path.rows(rows), part, np.ones(len(part), bool))

    return blocks


def _finite(figures: Figures) -> Figures:
    """The figures; NumericsError of one that is not finite."""
    for name, value in figures.items():
        if value is not None and not np.isfinite(value):
            raise NumericsError(f"{name} is {value}", expected="a finite error", fix="The estimate diverged: check its inputs")
    return figures


class AbsoluteErrors:
    """Sums of squared errors over blocks, and the moments that align the positions."""

    def __init__(self) -> None:
        self.count, self.first_ns, self.last_ns = 0, 0, 0
        self._moments, self._has_velocity = Moments(), True
        self._squares = np.zeros(3)  # degrees, metres, m/s
        self._moves, self._lowest, self._highest = False, np.full(4, np.inf), np.full(4, -np.inf)  # of the truth

    def add(self, estimate: Poses, truth: Poses) -> None:
        """Adds poses that count, on the same stamps."""
        if not len(truth):
            return
        self.first_ns = self.first_ns if self.count else int(truth.t_ns[0])
        self.count, self.last_ns = self.count + len(truth), int(truth.t_ns[-1])
        self._moves = self._moves or bool(truth.p_wb.any() or (truth.v_w is not None and truth.v_w.any()))
        self._lowest = np.minimum(self._lowest, truth.q_wb_wxyz.min(axis=0))
        self._highest = np.maximum(self._highest, truth.q_wb_wxyz.max(axis=0))
        with np.errstate(over="ignore", invalid="ignore"):  # who asks for the figures checks them
            self._moments.add(estimate.p_wb, truth.p_wb)
            self._squares[0] += np.sum(_turned_deg(estimate, truth) ** 2)
            self._squares[1] += np.sum((estimate.p_wb - truth.p_wb) ** 2)
            if estimate.v_w is None or truth.v_w is None:
                self._has_velocity = False
            else:
                self._squares[2] += np.sum((estimate.v_w - truth.v_w) ** 2)

    def figures(self, blocks: PathBlocks) -> dict[str, float | None]:
        """Root mean squares; the same blocks come again, to be aligned.

        Raises:
            NumericsError: the positions overflow.
        """
        aligned: list[float | None] = [None, None]
        with np.errstate(over="ignore", invalid="ignore"):
            if (motion := self._moments.motion()) is not None:
                squares = np.zeros(2)
                for block in blocks():
                    squares += _aligned_squares(*block.scored(), *motion)
                aligned = np.sqrt(squares / self.count).tolist()
            aoe_deg, ape_m, velocity_m_s = np.sqrt(self._squares / self.count).tolist()
        known = self._moves or not (self._highest - self._lowest > TURNED).any()  # as `Poses.has_positions`
        return {
            "aoe_deg": aoe_deg,
            "aoe_aligned_deg": aligned[0],
            "ape_m": ape_m if known else None,
            "ape_aligned_m": aligned[1],
            "velocity_rmse_m_s": velocity_m_s if known and self._has_velocity else None,
        }


def _turned_deg(estimate: Poses, truth: Poses, turn: Float64[np.ndarray, "1 4"] | None = None) -> Float64[np.ndarray, " n"]:
    """Angles between the orientations of two paths, of which the first may be turned."""
    # of six decimals, the lengths would count as angles
    q_wxyz, q_true_wxyz = (quaternion.unit(poses.q_wb_wxyz) for poses in (estimate, truth))
    turned_wxyz = q_wxyz if turn is None else quaternion.multiply(turn, q_wxyz)
    return np.asarray(np.degrees(quaternion.angle_between(turned_wxyz, q_true_wxyz)))


def _aligned_squares(
    estimate: Poses, truth: Poses, R: Float64[np.ndarray, "3 3"], shift: Float64[np.ndarray, "3"]
) -> tuple[float, float]:
    """Sums of the squared errors of orientation (deg) and position (m) after a rigid motion."""
    turned_deg = _turned_deg(estimate, truth, quaternion.of_matrix(R))
    return float(np.sum(turned_deg**2)), float(np.sum((estimate.p_wb @ R.T + shift - truth.p_wb) ** 2))


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
        q_wxyz, q_true_wxyz = quaternion.unit(estimate.q_wb_wxyz), quaternion.unit(truth.q_wb_wxyz)
        first = int(min(self._next, default=0))
        self._next -= first
        self._travelled = np.concatenate([self._travelled[first:], travelled])
        self._p = np.concatenate([self._p[first:], estimate.p_wb])
        self._p_true = np.concatenate([self._p_true[first:], truth.p_wb])
        self._C = np.concatenate([self._C[first:], quaternion.multiply(q_true_wxyz, quaternion.inverse(q_wxyz))])
        for k, distance_m in enumerate(self._distances_m):
            ended = int(np.searchsorted(self._travelled + distance_m, self._travelled[-1], side="right"))
            self._add_pairs(k, min(ended, len(self._travelled) - 1))

    def _add_pairs(self, k: int, end: int) -> None:
        """Adds the pairs of one distance that begin before a row."""
        for first in range(int(self._next[k]), end, AT_ONCE):
            rows = np.arange(first, min(first + AT_ONCE, end))
            i, j = pairs_by_distance(self._travelled, rows, self._distances_m[k])
            moved, moved_true = (p[j] - p[i] for p in (self._p, self._p_true))
            apart_m = quaternion.length(quaternion.rotate(self._C[i], moved) - moved_true).sum() if len(i) else 0.0
            turned = quaternion.angle_between(self._C[i], self._C[j]).sum() if len(i) else 0.0
            self._sums[k] += len(i), apart_m, turned
        self._next[k] = end

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
    miss_above = np.abs(travelled[above] - travelled[i] - distance_m)
    miss_below = np.abs(travelled[below] - travelled[i] - distance_m)
    near = np.minimum(miss_below, miss_above) <= distance_m * PAIR_TOLERANCE
    return i[near], np.where(miss_below <= miss_above, below, above)[near]
