"""Coverage of an IMU's time by the poses of a log."""

from __future__ import annotations

import logging
from collections.abc import Iterable

import numpy as np

from imutool.array_types import Int64
from imutool.cleaning.stamp_line import distinct
from imutool.errors import LogError
from imutool.log_info.report import TruthInfo
from imutool.mcap_io.codec.transforms import bodies
from imutool.mcap_io.log import Log
from imutool.recording import GAP_FACTOR, MIN_GAP_S, nanoseconds

logger = logging.getLogger(__name__)


def transforms(log: Log, topic: str) -> list[tuple[str, Int64[np.ndarray, "..."]]]:
    """Frames that are bodies, as TOPIC/CHILD_FRAME, with their stamps."""
    found: dict[tuple[str, str], list[Int64[np.ndarray, "..."]]] = {}
    try:
        for batch in log.pose_batches(topic):
            found.setdefault((batch.frame_id.lstrip("/"), batch.child_frame_id.lstrip("/")), []).append(batch.stamp_ns)
    except LogError as error:
        logger.warning("%s %s: %s", log.path, topic, error.what)
    return [(f"{topic}/{pair[1]}", np.concatenate(found[pair])) for pair in bodies(found)]


def coverage(topic: str, kind: str, truth_ns: Int64[np.ndarray, " n"], imu_ns: Iterable[Int64[np.ndarray, "..."]]) -> TruthInfo:
    """Truth coverage: share of the IMU's time between neighbouring true poses.

    The IMU's stamps come in parts.
    """
    knots = distinct(truth_ns)
    if len(knots) < 2:
        return TruthInfo(topic, len(truth_ns), kind)
    steps = np.diff(knots)
    limit = max(GAP_FACTOR * float(np.median(steps)), nanoseconds(MIN_GAP_S))  # as `Poses.at`
    covered, count, start, end = 0, 0, 2**63 - 1, -(2**63)
    for part in imu_ns:
        after = np.searchsorted(knots, part, side="left")
        inside = (part >= knots[0]) & (part <= knots[-1])
        known = (steps <= limit)[np.clip(after - 1, 0, len(steps) - 1)] | (knots[np.clip(after, 0, len(steps))] == part)
        covered, count = covered + int((inside & known).sum()), count + len(part)
        start, end = int(part.min(initial=start)), int(part.max(initial=end))
    if not count:
        return TruthInfo(topic, len(truth_ns), kind)
    gap = (steps > limit) & (knots[1:] > start) & (knots[:-1] < end)
    return TruthInfo(
        topic,
        len(truth_ns),
        kind,
        coverage=covered / count,
        gaps=int(gap.sum()),
        longest_gap_s=float(steps[gap].max()) * 1e-9 if gap.any() else 0.0,
        starts_after_s=float(knots[0] - start) * 1e-9,
        ends_before_s=float(end - knots[-1]) * 1e-9,
    )
