"""Errors of one log with one model, from every start that users have.

A log is integrated from its first true pose. Where its poses turn and the gyro does not, as over clipped samples, the path
turns with them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from imutool.array_types import Bool
from imutool.bias import static
from imutool.bias.model import BiasModel
from imutool.bias_start.bias_from_truth import TRUTH_S
from imutool.bias_start.correction import apply
from imutool.bias_start.model_choice import estimate_at_rest, find_initial_bias, smooth_in_memory
from imutool.errors import DataError, ModelError
from imutool.geometry import quaternion
from imutool.inertial import metrics
from imutool.inertial.strapdown import along_truth, drift
from imutool.recording import Imu, Poses, Recording, seconds

STARTS = ("auto", "smooth", "truth")
MAX_OF_LOG = 0.5  # that a start from the truth takes: scored on the same seconds, a constant would explain all of them
DRIFT_S = 5.0


@dataclass(frozen=True)
class Score:
    """Errors of a left-out log with one model and start."""

    log: str
    model: str
    start: str
    aoe_deg: float
    drift_m_s: float | None  # of the velocity, 5 s from the truth
    drift_deg: float | None = None  # of the attitude, 5 s from the truth


def scores_of(log: Recording, name: str, model: BiasModel | None, alone: Bool[np.ndarray, " n"]) -> list[Score]:
    """Scores with every start that a log has; without a model those of its own bias at rest."""
    return [score_of(log, name, start, imu, alone) for start in STARTS for imu in _corrected(log, model, start)]


def _corrected(log: Recording, model: BiasModel | None, start: str) -> list[Imu]:
    """Samples corrected by a model, or by the log's own rest bias; empty if the log has no start of this kind."""
    try:
        if model is None and start == "auto":
            static_model, initial = estimate_at_rest(log.imu, log.name)
            return [apply(static_model, initial, log.imu).imu]
        model = model or static.Model()
        if start == "smooth":
            return [apply(model, smooth_in_memory(model, log.imu, log.name), log.imu).imu]
        truth_s = min(TRUTH_S, MAX_OF_LOG * float(seconds(log.imu.t_ns[-1:], int(log.imu.t_ns[0]))[0]))
        initial = find_initial_bias(f"truth:{truth_s}" if start == "truth" else start, model, log)
        return [apply(model, initial, log.imu).imu]
    except (DataError, ModelError):
        return []


def score_of(log: Recording, model: str, start: str, imu: Imu, alone: Bool[np.ndarray, " n"]) -> Score:
    """Score of corrected samples; in the rows `alone` the poses turn and the gyro does not."""
    imu = turned_as_poses(imu, log.truth, alone[np.searchsorted(log.imu.t_ns, imu.t_ns)])
    path, truth, valid = along_truth(imu, log.truth, log.name)
    drifted = drift(path, truth, valid, DRIFT_S)
    drift_m_s, drift_rad = (
        float(np.sqrt(np.mean(x**2))) if len(x) else None for x in (drifted.velocity_m_s, drifted.orientation_rad)
    )
    drift_deg = None if drift_rad is None else float(np.degrees(drift_rad))
    aoe_deg = float(metrics.absolute(path, truth, valid)["aoe_deg"] or 0.0)
    return Score(log.name, model, start, aoe_deg, drift_m_s if truth.has_positions else None, drift_deg)


def turned_as_poses(imu: Imu, truth: Poses, rows: Bool[np.ndarray, " n"]) -> Imu:
    """Samples whose gyro turns as the poses do in some rows, by the rule of `dead_reckon`."""
    poses, dt = truth.at(imu.t_ns)[0], np.diff(seconds(imu.t_ns, int(imu.t_ns[0])))  # interpolated over gaps
    turns = quaternion.log(quaternion.multiply(quaternion.inverse(poses.q_wb_wxyz[:-1]), poses.q_wb_wxyz[1:]))
    return replace(imu, gyro=np.concatenate([np.where(rows[:-1, None], turns / dt[:, None], imu.gyro[:-1]), imu.gyro[-1:]]))
