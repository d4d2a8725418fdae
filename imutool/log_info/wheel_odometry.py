"""Wheel odometry of a log: velocity in the vehicle's frame, and the mount of the IMU.

It is a pose topic of the kind `odometry`, whose velocity is that of its poses in their own frame (`child_frame_id`), or a twist
in the vehicle's frame. What wheels do not measure, sideways and upwards, the ground makes zero.

The mount R_vb (IMU to vehicle) follows from the log: the specific force of the odometry's motion, over half seconds, is that of
the IMU, turned (Wahba, SIAM Review 7, 1965).
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.cleaning.likelihood import CLEARLY
from imutool.cleaning.pose_delay import lateness, pose_delay
from imutool.cleaning.rules.axes import LATE_S, LATE_STDS
from imutool.cleaning.truth import of_poses
from imutool.errors import DataError
from imutool.geometry import quaternion
from imutool.inertial.aids import WHEELS, Aids, Odometry
from imutool.inertial.preintegration import hat
from imutool.inertial.scoring.alignment import align
from imutool.inertial.strapdown import GRAVITY_W, with_velocity
from imutool.log_info.imu_motion import motion_of
from imutool.log_info.pose_coverage import coverage
from imutool.log_info.pose_imu_rotation import agreement, motion_warnings, unlike
from imutool.mcap_io.codec.schemas import MESSAGE_TWISTS, TF
from imutool.mcap_io.fields import numbers
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read_recordings
from imutool.mcap_io.topics import MESSAGE_POSES, Topic
from imutool.recording import Imu, Poses, Recording, nanoseconds, seconds
from imutool.recording.columns import ClockRun, median, quantile
from imutool.recording.message_log import named_kind

BLOCK_NS = 500_000_000  # over which the accelerations of odometry and IMU are compared
MAX_MOUNT_STD_RAD = 0.2  # of a mount that the motion shows
MAX_SLIP_M_S2 = 2.0  # difference in size of the two: above, wheels slip or their odometry was reset
MIN_NOISE_M_S2 = 0.05  # of such a difference: what does not accelerate shows nothing, however exact it is
FEWEST, JUMPS = 4, 10.0  # half seconds; times the usual acceleration, above which odometry was reset
LEVEL = 0.98  # cosine of a vehicle's tilt
MAX_FACTOR = 1.5  # between the accelerations of odometry and IMU: more than a wheel's wrong radius
MAX_OF_TIME = 0.95  # that an aid covers; less is said
SAME_M, MIN_PATH_M = 1e-3, 1.0  # odometry as near to the truth, over such a path, is the truth
RIGHT = "odometry in m/s and rad/s, of the vehicle that carries the IMU"
NO_MOUNT = "the motion does not show how the IMU is mounted in the frame of {}"
COMMAND = re.compile(r"cmd|command|setpoint|target|desired")


def find_wheels(log: Log, recording: Recording) -> tuple[list[str], str]:
    """Topics of wheel odometry, and what was looked at."""
    pose_topics = log.pose_topics
    every = [t for t in log.topics.values() if t.schema_name in MESSAGE_TWISTS or t.name in pose_topics]
    kinds = {t.name: "truth" if _is_truth(t, recording) else _kind(t) for t in every if t.count}
    listed = ", ".join(f"{name} ({kind})" for name, kind in kinds.items())
    wheels = [name for name, kind in kinds.items() if kind == WHEELS]
    return wheels, listed or "types, of which none is of poses or a TwistStamped"


def with_odometry(found: Aids, log: Log, recording: Recording, name: str) -> Aids:
    """Adds the velocity of wheel odometry, on the clock of the IMU.

    Raises:
        DataError: the truth itself, another motion or unit than the IMU's, or a motion that does not show the mount.
    """
    if name in recording.truths or (name in log.topics and _is_truth(log.topics[name], recording)):
        raise DataError(f"{name} is the truth, and no aid", where=recording.name, expected="a topic of wheel odometry")
    poses = _poses(log, name, recording)
    if recording.truths and _same_path(poses, recording.truth):
        raise DataError(f"{name} moves exactly as the truth, and is no aid", where=recording.name, expected="wheel odometry")
    poses, delay_s = _on_clock(poses, recording.imu, name)
    late = f" ({lateness(delay_s)} by the gyro, corrected)" if delay_s else ""
    words = f"{name}{late}{cover(recording.imu, poses.t_ns)}"
    return replace(found, signals=found.signals | {WHEELS: words}, odometry=_mounted(poses, recording.imu, name))


def cover(imu: Imu, t_ns: Int64[np.ndarray, " n"]) -> str:
    """Words on an aid that measures for a part of the time alone."""
    share = coverage("", "", t_ns, [imu.t_ns]).coverage
    return f", {share:.0%} of the time" if isinstance(share, float) and share < MAX_OF_TIME else ""


def _on_clock(poses: Poses, imu: Imu, name: str) -> tuple[Poses, float]:
    """Odometry with the stamps that its turns have by the gyro, and the delay (s) that was taken from them.

    Raises:
        DataError: it turns otherwise than the gyro.
    """
    slow = of_poses(name, poses, WHEELS)
    if slow is None:
        return poses, 0.0
    delay = pose_delay(motion_of(imu).motion, slow)
    if delay is not None and delay.step is not None:
        before, after, _ = delay.step
        what = f"{name} is first {lateness(before)}, then {lateness(after)}, by the gyro"
        raise DataError(what, expected="one clock that never steps", fix="Cut the log where the clock steps")
    delay_s = delay.seconds if delay is not None and abs(delay.seconds) > max(LATE_S, LATE_STDS * delay.std_s) else 0.0
    late_ns = nanoseconds(delay_s)
    seen = agreement(slow._replace(t_ns=slow.t_ns - late_ns), imu)
    if seen is not None and unlike(seen.explained, seen.rms_rad_s):
        raise DataError(*motion_warnings(name, seen.explained, seen.rms_rad_s, 0, 0.0), expected=RIGHT)
    return replace(poses, t_ns=poses.t_ns - late_ns), delay_s


def _is_truth(topic: Topic, recording: Recording) -> bool:
    return topic.name in recording.truths or topic.pose_kind == "truth" or topic.is_derived


def _kind(topic: Topic) -> str:
    """Kind of a pose or twist topic; an unknown twist is odometry."""
    if topic.schema_name in MESSAGE_POSES or topic.schema_name not in MESSAGE_TWISTS:
        return topic.pose_kind
    if COMMAND.search(topic.name.lower()):
        return "command"
    kind = named_kind(topic.name, "")
    return WHEELS if kind == "unknown" else kind


def _poses(log: Log, name: str, recording: Recording) -> Poses:
    """Poses of odometry with their velocity, from its twist where it has no poses or they stay where they are."""
    schema = log.topics[name].schema_name if name in log.topics else TF
    if schema in MESSAGE_POSES or schema not in MESSAGE_TWISTS:
        (whole,) = read_recordings(log, imu=recording.imu_topic, truth=name, samples=recording.imu, derived=False)
        poses: Poses = whole.truths[name].between(int(recording.imu.t_ns[0]), int(recording.imu.t_ns[-1]))
        if len(poses) > 1 and np.ptp(poses.p_wb, axis=0).any():
            return with_velocity(poses)
        if schema not in MESSAGE_TWISTS:
            raise DataError(
                f"the {len(poses)} poses of {name} do not move", where=recording.name, expected="odometry that does"
            )
    return _dead_reckoned(log, name, recording.imu)


def _dead_reckoned(log: Log, name: str, imu: Imu) -> Poses:
    """Poses of a twist in the vehicle's frame, dead reckoned in the plane."""
    inside = MESSAGE_TWISTS[log.topics[name].schema_name]
    paths = tuple(f"{inside}.{part}" for part in ("linear.x", "linear.y", "linear.z", "angular.z"))
    t_ns, values = rows_of_stretch(imu, *numbers(log, name, paths))
    if len(t_ns) < 2:
        raise DataError(f"{name} has {len(t_ns)} twists while the IMU measures", expected="two or more")
    dt = np.diff(seconds(t_ns, int(t_ns[0])), prepend=0.0)
    q_wxyz = quaternion.exp(np.cumsum(dt * values[:, 3])[:, None] * np.array([0.0, 0.0, 1.0]))
    v = quaternion.rotate(q_wxyz, values[:, :3])
    return Poses(t_ns, np.cumsum(dt[:, None] * v, axis=0), q_wxyz, v)


def _same_path(poses: Poses, truth: Poses) -> bool:
    """Whether positions are those of the truth but for a rigid motion."""
    if len(truth) < 2:
        return False
    true, valid = truth.at(poses.t_ns)
    p, p_true = poses.p_wb[valid], true.p_wb[valid]
    motion = align(p, p_true) if len(p) > 2 else None
    if motion is None or float(quaternion.length(np.diff(p, axis=0)).sum()) < MIN_PATH_M:
        return False
    R, shift = motion
    return float(np.sqrt(((p @ R.T + shift - p_true) ** 2).sum(axis=1).mean())) < SAME_M


def rows_of_stretch(
    imu: Imu, t_ns: np.ndarray, values: Float64[np.ndarray, "n k"]
) -> tuple[np.ndarray, Float64[np.ndarray, "m k"]]:
    """Finite rows within the IMU's time, on its setting of the clock, with rising stamps."""
    run = ClockRun(slice(0, 0), int(imu.t_ns[0]), int(imu.t_ns[-1]), alone=False)
    rows = run.rows_of(t_ns)
    t_ns, values = t_ns[rows], values[rows]
    good = np.isfinite(values).all(axis=1) & (t_ns >= run.first_ns) & (t_ns <= run.last_ns)
    t_ns, values = t_ns[good], values[good]
    rises = np.diff(np.maximum.accumulate(t_ns), prepend=t_ns[:1] - 1) > 0
    return t_ns[rises], values[rises]


class _Blocks(NamedTuple):
    """Mean specific force and rate of the IMU in half seconds, and acceleration, rate and the vertical of the odometry."""

    f_b: Float64[np.ndarray, "n 3"]
    gyro_b: Float64[np.ndarray, "n 3"]
    a_v: Float64[np.ndarray, "n 3"]
    turn_v: Float64[np.ndarray, "n 3"]
    up_v: Float64[np.ndarray, "n 3"]


def _blocks(poses: Poses, imu: Imu) -> _Blocks:
    edges = np.arange(int(poses.t_ns[0]), int(poses.t_ns[-1]), BLOCK_NS)
    at, valid = poses.at(edges)
    middle, known = poses.at(edges[:-1] + BLOCK_NS // 2)
    first, last = np.searchsorted(imu.t_ns, edges[:-1]), np.searchsorted(imu.t_ns, edges[1:])
    good = valid[1:] & valid[:-1] & known & ((last - first) * imu.period_s * 1e9 > 0.9 * BLOCK_NS)
    assert at.v_w is not None
    sums = np.concatenate([np.zeros((1, 6)), np.cumsum(np.concatenate([imu.accel, imu.gyro], axis=1), axis=0)])
    means = (sums[last] - sums[first])[good] / (last - first)[good, None]
    seconds_ = BLOCK_NS * 1e-9
    to_v = quaternion.inverse(middle.q_wb_wxyz[good])
    turn = quaternion.log(quaternion.multiply(quaternion.inverse(at.q_wb_wxyz[:-1]), at.q_wb_wxyz[1:]))[good] / seconds_
    up_v = quaternion.rotate(to_v, np.tile([0.0, 0.0, 1.0], (len(to_v), 1)))
    return _Blocks(means[:, :3], means[:, 3:], quaternion.rotate(to_v, np.diff(at.v_w, axis=0)[good] / seconds_), turn, up_v)


def _check_motion(each: _Blocks, name: str) -> None:
    """Refuse odometry in the plane that turns or accelerates otherwise than the IMU.

    The specific force that is level, as complex numbers, is z a with the odometry's acceleration a. A regression gives the
    least |z| that fits, and the inverse one the largest, as both have errors.

    Raises:
        DataError: such odometry.
    """
    from scipy.spatial.transform import Rotation

    size = quaternion.length(each.a_v)
    use = size <= JUMPS * quantile(size, 0.9) if len(size) else np.zeros(0, bool)
    if use.sum() < FEWEST or median(each.up_v[use, 2]) < LEVEL:
        return
    level, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [each.f_b[use].mean(axis=0)])
    gyro, turn = level.apply(each.gyro_b[use])[:, 2], each.turn_v[use, 2]
    gyro, turn = gyro - gyro.mean(), turn - turn.mean()
    if (gyro * turn).sum() < -CLEARLY * np.sqrt((gyro**2).sum() * (turn**2).sum()):
        raise DataError(f"{name} turns left where the IMU turns right", expected=RIGHT, fix="Check the sign of its turns")
    force, a = level.apply(each.f_b[use]), each.a_v[use]
    z_b, z_v = (x[:, 0] + 1j * x[:, 1] - (x[:, 0] + 1j * x[:, 1]).mean() for x in (force, a))
    both, of_b, of_v = abs(np.vdot(z_v, z_b)), np.vdot(z_b, z_b).real, np.vdot(z_v, z_v).real
    share = both**2 / max(of_b * of_v, np.finfo(float).tiny)
    if 1.0 - share > 2.0 * use.sum() * share * MAX_MOUNT_STD_RAD**2:  # of the angle of z
        raise DataError(
            NO_MOUNT.format(name), expected="a vehicle that brakes and starts again, with velocities in its own frame"
        )
    if of_b / both < 1.0 / MAX_FACTOR or both / of_v > MAX_FACTOR:
        factor = np.sqrt(of_v / of_b)
        raise DataError(f"{name} accelerates {factor:.2g} times as much as the IMU", expected=RIGHT, fix="Check its unit")


def _mounted(poses: Poses, imu: Imu, name: str) -> Odometry:
    """Odometry with the mount that its motion shows.

    Raises:
        DataError: the motion does not show it, for it does not accelerate, or contradicts the IMU.
    """
    every = _blocks(poses, imu)
    _check_motion(every, name)
    f_v, f_b = every.a_v - GRAVITY_W[2] * every.up_v, every.f_b
    alike = np.abs(quaternion.length(f_v) - quaternion.length(f_b)) < MAX_SLIP_M_S2
    f_v, f_b = f_v[alike], f_b[alike]
    if len(f_v) < 3:
        raise DataError(
            f"{name} and the IMU agree in fewer than three half seconds", expected="odometry while the IMU measures"
        )
    u, _, vt = np.linalg.svd(f_v.T @ f_b)
    R_vb = u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt
    variance = max(float(((f_v - f_b @ R_vb.T) ** 2).sum()) / (3 * len(f_v) - 3), MIN_NOISE_M_S2**2)
    information = np.linalg.eigvalsh(-(hat(f_v) @ hat(f_v)).sum(axis=0)).min()
    std = float(np.sqrt(variance / max(information, np.finfo(float).tiny)))
    if std > MAX_MOUNT_STD_RAD:
        raise DataError(NO_MOUNT.format(name), expected="a vehicle that brakes and starts again")
    return Odometry(poses, R_vb, std)
