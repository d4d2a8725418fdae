"""True poses at 10 Hz, and the angular rate and specific force that follow from them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.cleaning.samples import STEP_NS
from imutool.errors import LogError
from imutool.geometry import quaternion
from imutool.mcap_io.codec.schemas import TF
from imutool.mcap_io.codec.transforms import bodies, is_still
from imutool.mcap_io.log import Log
from imutool.recording import GRAVITY_M_S2, Poses, Recording, seconds
from imutool.units import AXES

FEWEST = 3  # poses that show an acceleration
ERRORS_LAST_S = 1.0  # errors of poses are alike for so long
SURE_REFLECTED = 5.0  # standard deviations; FETCH's gyro, with y reversed, has 3.7 to 10.8 in seven logs
LEVEL_RAD = 0.1  # deviation of the vertical in the body
ALONG, GRAVITY_BAND = np.cos(np.radians(20.0)), 0.25  # of a mean force that is gravity along an axis


class Turned(NamedTuple):
    """Rotation vector from the body of the poses to the gyro."""

    deg: Float64[np.ndarray, "3"]
    std_deg: Float64[np.ndarray, "3"]


class Truth(NamedTuple):
    """True poses at least 0.1 s apart, in order."""

    topic: str
    t_ns: Int64[np.ndarray, " n"]
    p_wb: Float64[np.ndarray, "n 3"]
    q_wb_wxyz: Float64[np.ndarray, "n 4"]
    kind: str = "truth"


def read_truth(
    log: Log,
    refused: Callable[[str, LogError], None] | None = None,
    topics: Sequence[str] | None = None,
    end_ns: int | None = None,
) -> Truth | None:
    """Poses of the first readable topic of the true ones, or of `topics`; None below three.

    They reach to `end_ns`. A transform of a topic is named as TOPIC/CHILD_FRAME; of several the first that turns counts.
    `refused` is called with each topic before it that cannot be read, and with the error.
    """
    for topic in log.truth_topics if topics is None else topics:
        found: dict[tuple[str, str], list[tuple[np.ndarray, ...]]] = {}
        named = topic if topic in log.topics else next(t.name for t in log.with_schema((TF,)) if topic.startswith(f"{t.name}/"))
        is_tree = log.topics[named].schema_name == TF
        try:
            for batch in log.pose_batches(named, end_ns=end_ns):
                parent, child = batch.frame_id.lstrip("/"), batch.child_frame_id.lstrip("/")
                if topic not in (named, f"{named}/{child}"):
                    continue
                parts = found.setdefault((parent, child) if is_tree else ("", topic), [])
                keep = _thinned(batch.stamp_ns, int(parts[-1][0][-1]) if parts else -(2**62))
                if len(keep):
                    parts.append((batch.stamp_ns[keep], batch.p_wb[keep], batch.q_wb_wxyz[keep]))
        except LogError as error:  # poses are a help here, not what is cleaned
            if refused is not None:
                refused(topic, error)
            continue
        each = [tuple(map(np.concatenate, zip(*found[pair], strict=True))) for pair in bodies(found) if found[pair]]
        for t_ns, p_wb, q_wb_wxyz in sorted(each, key=lambda body: is_still(body[2]))[:1]:  # not joints
            if len(t_ns) >= FEWEST:
                return Truth(topic, t_ns, p_wb, quaternion.unit(q_wb_wxyz), log.topics[named].pose_kind)
    return None


def of_poses(topic: str, poses: Poses, kind: str = "truth") -> Truth | None:
    """Poses in memory at 10 Hz; None with fewer than three."""
    keep = _thinned(poses.t_ns, -(2**62))
    if len(keep) < FEWEST:
        return None
    return Truth(topic, poses.t_ns[keep], poses.p_wb[keep], poses.q_wb_wxyz[keep], kind)


def truth_of(recording: Recording) -> Truth | None:
    """First poses of a recording at 10 Hz; None without any."""
    return next((of_poses(topic, poses, recording.kind_of(topic)) for topic, poses in recording.truths.items()), None)


def _thinned(stamp_ns: Int64[np.ndarray, " n"], last_ns: int) -> Int64[np.ndarray, " m"]:
    """First row of each 0.1 s after `last_ns`; rows that go back in time are left out."""
    step = stamp_ns // STEP_NS
    return np.flatnonzero(step > np.maximum.accumulate(np.concatenate([[last_ns // STEP_NS], step]))[:-1])


def turning(
    truth: Truth, spacing: int = 1
) -> tuple[Int64[np.ndarray, " m"], Int64[np.ndarray, " m"], Float64[np.ndarray, "m 3"]]:
    """Angular rate (rad/s, body) between poses `spacing` rows apart, with start and end (ns)."""
    q_wb_wxyz = quaternion.unit(truth.q_wb_wxyz)
    first, last = truth.t_ns[:-spacing], truth.t_ns[spacing:]
    dt = seconds(last, int(truth.t_ns[0])) - seconds(first, int(truth.t_ns[0]))
    turn = quaternion.log(quaternion.multiply(quaternion.inverse(q_wb_wxyz[:-spacing]), q_wb_wxyz[spacing:]))
    return first, last, turn / dt[:, None]


def axis_of_gravity(force_w: Float64[np.ndarray, "n 3"]) -> str | None:
    """Axis along which forces in the world are gravity in the mean, as `+z`; None for others."""
    mean = force_w.mean(axis=0)
    axis, size = int(np.argmax(np.abs(mean))), float(np.linalg.norm(mean))
    along = abs(mean[axis]) > ALONG * size and abs(size / GRAVITY_M_S2 - 1.0) < GRAVITY_BAND
    return f"{'+' if mean[axis] > 0.0 else '-'}{'xyz'[axis]}" if along else None


def stays_level(q_wb_wxyz: Float64[np.ndarray, "n 4"]) -> bool:
    """Whether a body turns about the vertical alone, but for less than a mount may be tilted."""
    vertical = quaternion.rotate(q_wb_wxyz, np.tile([0.0, 0.0, 1.0], (len(q_wb_wxyz), 1)))
    return bool(np.sqrt(vertical.var(axis=0).sum()) < LEVEL_RAD)


def best_rotation(gyro: Float64[np.ndarray, "n 3"], omega: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "3 3"]:
    """Rotation R of gyro = R omega that fits best (Kabsch)."""
    left, _, right = np.linalg.svd(gyro.T @ omega)
    return np.asarray(left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right)


def reversed_axes(gyro: Float64[np.ndarray, "n 3"], omega: Float64[np.ndarray, "n 3"]) -> str:
    """Axes of a left-handed gyro that read the opposite of true rates; empty without evidence.

    No turned body explains a reflection. The smallest singular value of the cross-covariance has to exceed `SURE_REFLECTED`
    standard deviations: a robot on a floor hardly turns about two of its axes.
    """
    left, size, right = np.linalg.svd(gyro.T @ omega)
    line = np.linalg.lstsq(gyro, omega, rcond=None)[0]
    residual = omega - gyro @ line
    std = np.sqrt(np.sum(((gyro @ left[:, 2]) * (residual @ right[2])) ** 2))
    if np.linalg.det(left @ right) > 0.0 or size[2] <= SURE_REFLECTED * std:
        return ""
    return "".join(axis for axis, gain in zip(AXES, np.diag(line), strict=True) if gain < 0.0)


def rotation_deg(
    turn: Float64[np.ndarray, "3 3"], gyro: Float64[np.ndarray, "n 3"], omega: Float64[np.ndarray, "n 3"], length_s: float
) -> Turned | None:
    """Rotation with its deviations: an error about an axis moves the rates about the others.

    Only rates that both share count: the poses of a robot on a floor turn about one axis, and say nothing of a turn about it.
    """
    shared = gyro.T @ (omega @ turn.T) * (length_s / ERRORS_LAST_S / len(gyro))  # symmetric, as R is the best
    seen = np.trace(shared) * np.eye(3) - (shared + shared.T) / 2.0
    minimum, _, maximum = np.linalg.eigvalsh(seen)
    if minimum <= 1e-9 * maximum:  # turns about one axis alone, as of wheels
        return None
    variance = ((gyro - omega @ turn.T) ** 2).sum(axis=1).mean() / 3.0
    std_deg = np.degrees(np.sqrt(variance * np.diag(np.linalg.inv(seen))))
    return Turned(np.degrees(quaternion.log(quaternion.of_matrix(turn))[0]), std_deg)


def force_in_world(truth: Truth) -> tuple[Int64[np.ndarray, " m"], Float64[np.ndarray, "m 4"], Float64[np.ndarray, "m 3"]]:
    """Time, orientation q_wb (wxyz) and acceleration (m/s², world) at inner poses.

    By second differences.
    """
    t_s = seconds(truth.t_ns, int(truth.t_ns[0]))
    v_w = np.diff(truth.p_wb, axis=0) / np.diff(t_s)[:, None]
    a_w = 2.0 * np.diff(v_w, axis=0) / (t_s[2:] - t_s[:-2])[:, None]
    return truth.t_ns[1:-1], quaternion.unit(truth.q_wb_wxyz[1:-1]), a_w
