"""Poses beside an IMU: their turns against the mean rates of the gyroscope, and the time that they cover."""

from __future__ import annotations

import logging
from typing import NamedTuple

import numpy as np
from jaxtyping import Int64

from imutool.cleaning.truth import Truth, turning
from imutool.errors import LogError
from imutool.log_info.report import TruthInfo
from imutool.mcap_io.log import Log
from imutool.recording import GAP_FACTOR, MIN_GAP_S, Imu, nanoseconds, seconds

logger = logging.getLogger(__name__)

LEAST_TURNS = 20  # between poses
LEAST_RATE_RAD_S = 0.02  # rms of the gyro about its mean: less shows nothing


class Agreement(NamedTuple):
    """Rms (rad/s) of the gyro that the poses leave unexplained, and the share that they explain."""

    rms_rad_s: float
    explained: float


def agreement(poses: Truth, imu: Imu) -> Agreement | None:
    """Agreement of the turns of poses with the gyro; None where the two share too little motion.

    gyro = b + R omega, with the constant bias b and rotation R that fit best (Kabsch), over intervals of a tenth of a second.
    """
    if len(imu) < LEAST_TURNS or len(poses.t_ns) < LEAST_TURNS:
        return None
    start_ns, end_ns, rate = turning(poses)
    first, last = int(imu.t_ns[0]), int(imu.t_ns[-1])
    steps = (end_ns - start_ns).astype(float)
    inside = (start_ns >= first) & (end_ns <= last) & (steps < 4.0 * np.median(steps)) & np.isfinite(rate).all(axis=1)
    if inside.sum() < LEAST_TURNS:
        return None
    t = seconds(imu.t_ns, first)
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(np.diff(t)[:, None] * (imu.gyro[1:] + imu.gyro[:-1]) / 2.0, axis=0)])
    begin, end = seconds(start_ns[inside], first), seconds(end_ns[inside], first)
    mean = np.stack([(np.interp(end, t, c) - np.interp(begin, t, c)) / (end - begin) for c in turned.T], axis=1)
    gyro, omega = mean - mean.mean(axis=0), rate[inside] - rate[inside].mean(axis=0)
    motion = float(np.sqrt((gyro**2).sum(axis=1).mean()))
    if motion < LEAST_RATE_RAD_S:
        return None
    left, _, right = np.linalg.svd(gyro.T @ omega)
    turn = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
    rms = float(np.sqrt(((gyro - omega @ turn.T) ** 2).sum(axis=1).mean()))
    return Agreement(rms, max(0.0, 1.0 - (rms / motion) ** 2))


def transforms(log: Log, topic: str) -> list[tuple[str, Int64[np.ndarray, "..."]]]:
    """Children of the frames that have no parent, as TOPIC/CHILD_FRAME, with the stamps of their transforms."""
    found: dict[tuple[str, str], list[Int64[np.ndarray, "..."]]] = {}
    try:
        for batch in log.pose_batches(topic):
            found.setdefault((batch.frame_id.lstrip("/"), batch.child_frame_id.lstrip("/")), []).append(batch.stamp_ns)
    except LogError as error:
        logger.warning("%s %s: %s", log.path, topic, error.what)
    children = {child for _, child in found}
    return [(f"{topic}/{child}", np.concatenate(stamps)) for (parent, child), stamps in found.items() if parent not in children]


def coverage(topic: str, kind: str, truth_ns: Int64[np.ndarray, " n"], imu_ns: Int64[np.ndarray, " m"]) -> TruthInfo:
    """Truth coverage: share of the IMU's time between neighbouring true poses."""
    knots = np.unique(truth_ns)
    if len(knots) < 2 or not len(imu_ns):
        return TruthInfo(topic, len(truth_ns), kind)
    start, end = int(imu_ns.min()), int(imu_ns.max())
    steps = np.diff(knots)
    limit = max(GAP_FACTOR * float(np.median(steps)), nanoseconds(MIN_GAP_S))  # 4 median periods, 60 ms
    gap = (steps > limit) & (knots[1:] > start) & (knots[:-1] < end)
    after = np.searchsorted(knots, imu_ns, side="left")
    inside = (imu_ns >= knots[0]) & (imu_ns <= knots[-1])
    known = inside & (
        (steps <= limit)[np.clip(after - 1, 0, len(steps) - 1)] | (knots[np.clip(after, 0, len(steps))] == imu_ns)
    )
    return TruthInfo(
        topic,
        len(truth_ns),
        kind,
        coverage=float(known.mean()),
        gaps=int(gap.sum()),
        longest_gap_s=float(steps[gap].max()) * 1e-9 if gap.any() else 0.0,
        starts_after_s=float(knots[0] - start) * 1e-9,
        ends_before_s=float(end - knots[-1]) * 1e-9,
    )
