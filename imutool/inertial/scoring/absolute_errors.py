"""Absolute errors of a path that comes in blocks: AOE, APE, velocity RMSE."""

from __future__ import annotations

import numpy as np

from imutool.array_types import Float64
from imutool.geometry import quaternion
from imutool.inertial.scoring.alignment import Moments
from imutool.inertial.scoring.path_blocks import PathBlocks
from imutool.recording import TURNED, Poses


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
    q, q_true = quaternion.unit(estimate.q_wb_wxyz), quaternion.unit(truth.q_wb_wxyz)  # six decimals would count as an angle
    return np.asarray(np.degrees(quaternion.angle_between(q if turn is None else quaternion.multiply(turn, q), q_true)))


def _aligned_squares(
    estimate: Poses, truth: Poses, R: Float64[np.ndarray, "3 3"], shift: Float64[np.ndarray, "3"]
) -> tuple[float, float]:
    """Sums of the squared errors of orientation (deg) and position (m) after a rigid motion."""
    turned_deg = _turned_deg(estimate, truth, quaternion.of_matrix(R))
    return float(np.sum(turned_deg**2)), float(np.sum((estimate.p_wb @ R.T + shift - truth.p_wb) ** 2))
