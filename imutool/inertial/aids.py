"""Aids of an IMU in a log: stops, barometer, wheel odometry, and ground contact.

A barometer is a `FluidPressure`, or a number that is named as a pressure or an altitude. Wheel odometry is a pose topic of the
kind `odometry`, whose velocity is that of its poses in their own frame (`child_frame_id`), or a twist in the vehicle's frame.
The truth, an estimate and a command are never an aid. What wheels do not measure, sideways and upwards, the ground makes zero.

The mount R_vb (IMU to vehicle) follows from the log: the specific force of the odometry's motion, over half seconds, is that of
the IMU, turned (Wahba, SIAM Review 7, 1965).
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from imutool.array_types import Float64
from imutool.errors import ConfigError, DataError, LogError, did_you_mean
from imutool.geometry import quaternion
from imutool.inertial.metrics import align
from imutool.inertial.preintegration import hat
from imutool.inertial.strapdown import GRAVITY_W, with_velocity
from imutool.mcap_io.codec.schemas import MESSAGE_TWISTS, PRESSURE, TF
from imutool.mcap_io.fields import numbers, numeric_fields, split
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read_recordings
from imutool.mcap_io.topics import MESSAGE_POSES, Topic
from imutool.recording import Imu, Poses, Recording, Scalars, seconds
from imutool.recording.columns import ClockRun
from imutool.recording.message_log import named_kind

STOPS, BAROMETER, WHEELS, GROUND = KINDS = ("stops", "barometer", "odometry", "ground")
AUTO = "auto"
BLOCK_NS = 500_000_000  # over which the accelerations of odometry and IMU are compared
MOST_MOUNT_STD_RAD = 0.2  # of a mount that the motion shows
MOST_SLIP_M_S2 = 2.0  # difference in size of the two: above, wheels slip or their odometry was reset
LEAST_NOISE_M_S2 = 0.05  # of such a difference: what does not accelerate shows nothing, however exact it is
SAME_M, LEAST_PATH_M = 1e-3, 1.0  # odometry as near to the truth, over such a path, is the truth
PRESSURE_UNITS = {"Pa": (1.5e4, 1.2e5), "hPa": (150.0, 1200.0), "kPa": (15.0, 120.0)}
SEA_PA, EXPONENT, FACTOR_M = 101_325.0, 0.190263, 44_330.8  # of the standard atmosphere, ISO 2533
HEIGHT_NAME = re.compile(r"pressure|baro|altitude|altimeter")
NO_HEIGHT = re.compile(
    r"diff|dynamic|airspeed|temp|ti?y?re|estimat|innov|bias|gps|gnss|navsat|global|setpoint|home|_id\b|count|ratio"
)
COMMAND = re.compile(r"cmd|command|setpoint|target|desired")

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Odometry:
    """Poses of a vehicle with velocity; R_vb turns the IMU's vectors to the vehicle's frame."""

    poses: Poses
    R_vb: Float64[np.ndarray, "3 3"]
    std_rad: float


@dataclass(frozen=True)
class Aids:
    """Aids of one stretch of a log; `signals` states the topic, and a height's unit, by kind."""

    signals: dict[str, str]
    height: Scalars | None = None
    odometry: Odometry | None = None


def listed(signals: Mapping[str, str]) -> str:
    """Kinds of aids with what measures them, for a sentence."""
    return ", ".join(f"{kind} {signal}".strip() for kind, signal in signals.items())


def parse_aids(words: str) -> dict[str, str]:
    """Topic by kind, of words such as `stops,barometer=/baro`; empty: to be searched for.

    Raises:
        ConfigError: an unknown kind.
    """
    asked = dict[str, str]()
    for word in words.split(","):
        kind, _, topic = word.strip().partition("=")
        if kind not in (*KINDS, AUTO) or (topic and kind not in (BAROMETER, WHEELS)):
            fix = did_you_mean(kind, KINDS) or "Only barometer and odometry take a topic"
            raise ConfigError(f"aid {word!r}", where="aid", expected=f"auto, or some of {', '.join(KINDS)}", fix=fix)
        asked[kind] = topic
    return asked


def find_aids(log: Log, recording: Recording, asked: dict[str, str]) -> Aids:
    """Aids of a recording of a log, by kind and topic (`parse_aids`).

    With `auto` they are all that the log has, and one that cannot be used is left out with a warning.

    Raises:
        LogError: the log has no such aid; the message lists the topics that were looked at.
        DataError: it cannot be used: the truth itself, values of no pressure, a motion that does not show the mount.
    """
    wanted = dict.fromkeys((STOPS, BAROMETER, WHEELS), "") | asked if AUTO in asked else asked
    found = Aids({STOPS: ""} if STOPS in wanted else {})
    for kind, offered, read in ((BAROMETER, _barometers, _with_height), (WHEELS, _wheels, _with_odometry)):
        if kind not in wanted:
            continue
        names, looked_at = ([wanted[kind]], "") if wanted[kind] else offered(log, recording)
        if not names and kind in asked:
            raise LogError(
                f"no {kind} in this log; looked at {looked_at}", where=log.path, fix="Name a topic, or leave this aid out"
            )
        try:
            found = read(found, log, recording, names[0]) if names else found
        except (LogError, DataError) as error:
            if kind in asked:
                raise
            logger.warning("%s: the aid %s is left out: %s", recording.name, kind, error)
    if GROUND in wanted or found.odometry is not None:
        what = "vehicle frame of the odometry" if found.odometry else "x of the IMU is forward, levelled"
        found = replace(found, signals=found.signals | {GROUND: what})
    return found


def _with_height(found: Aids, log: Log, recording: Recording, signal: str) -> Aids:
    """With the height of a barometer."""
    if signal in log.topics and log.topics[signal].schema_name == PRESSURE:
        signal += ".fluid_pressure"
    topic, field = split(log, signal)
    t_ns, values = _of_stretch(recording.imu, *numbers(log, topic, (field,)))
    if len(t_ns) < 2:
        raise DataError(f"{signal} has {len(t_ns)} values while the IMU measures", where=recording.name, expected="two or more")
    height, unit = _height_m(values[:, 0], signal, "pressure" in f"{topic}.{field}".lower())
    return replace(found, signals=found.signals | {BAROMETER: f"{signal} ({unit})"}, height=Scalars(t_ns, height[:, None], "m"))


def _barometers(log: Log, recording: Recording) -> tuple[list[str], str]:
    """Pressures and barometric altitudes, FluidPressure first, then by their number of messages; and what was looked at."""
    ranked, looked_at = list[tuple[bool, int, bool, str]](), list[str]()
    for topic in log.topics.values():
        named = f"{topic.name} {topic.schema_name}".lower()
        if not topic.count or topic.is_derived or not HEIGHT_NAME.search(f"{named} {_definition(log, topic.name)}"):
            continue  # the first message of no other topic is looked at
        looked_at.append(f"{topic.name} ({topic.schema_name})")
        if NO_HEIGHT.search(named) or named_kind(topic.name, "") in ("truth", "estimate"):
            continue
        try:
            fields = numeric_fields(log, topic.name, long=False)
        except LogError:
            continue
        for field in ["fluid_pressure"] if topic.schema_name == PRESSURE else fields:
            text = named if field == "data" else field
            if HEIGHT_NAME.search(text) and not NO_HEIGHT.search(text):
                ranked.append((topic.schema_name != PRESSURE, -topic.count, "pressure" not in field, f"{topic.name}.{field}"))
    return [name for *_, name in sorted(ranked)], ", ".join(looked_at) or "types and names, of which none is of a pressure"


def _definition(log: Log, name: str) -> str:
    """Text of the schema of a topic, in small letters."""
    schemas = (log.index.schemas.get(channel.schema_id) for channel in log.index.channels.values() if channel.topic == name)
    return "".join(schema.data.decode("utf-8", "replace").lower() for schema in schemas if schema)


def _height_m(values: Float64[np.ndarray, " n"], signal: str, is_pressure: bool) -> tuple[Float64[np.ndarray, " n"], str]:
    """Height above the first value, and the unit of the values."""
    if not is_pressure:
        return values - values[0], "m"
    least, most = float(values.min()), float(values.max())
    for unit, (low, high) in PRESSURE_UNITS.items():
        if low <= least and most <= high:
            height = FACTOR_M * (1.0 - (values * (PRESSURE_UNITS["Pa"][0] / low) / SEA_PA) ** EXPONENT)
            return height - height[0], unit
    raise DataError(f"{signal} is from {least:g} to {most:g}", expected="the air's pressure in Pa, hPa or kPa")


def _of_stretch(
    imu: Imu, t_ns: np.ndarray, values: Float64[np.ndarray, "n k"]
) -> tuple[np.ndarray, Float64[np.ndarray, "m k"]]:
    """Finite rows while the IMU measures, on its setting of the clock, with stamps that increase."""
    run = ClockRun(slice(0, 0), int(imu.t_ns[0]), int(imu.t_ns[-1]), alone=False)
    rows = run.rows_of(t_ns)
    t_ns, values = t_ns[rows], values[rows]
    good = np.isfinite(values).all(axis=1) & (t_ns >= run.first_ns) & (t_ns <= run.last_ns)
    t_ns, values = t_ns[good], values[good]
    rises = np.diff(np.maximum.accumulate(t_ns), prepend=t_ns[:1] - 1) > 0
    return t_ns[rises], values[rises]


def _wheels(log: Log, recording: Recording) -> tuple[list[str], str]:
    """Topics of wheel odometry, and what was looked at."""
    pose_topics = log.pose_topics
    every = [t for t in log.topics.values() if t.schema_name in MESSAGE_TWISTS or t.name in pose_topics]
    kinds = {t.name: "truth" if _is_truth(t, recording) else _kind(t) for t in every if t.count}
    listed = ", ".join(f"{name} ({kind})" for name, kind in kinds.items())
    return [
        name for name, kind in kinds.items() if kind == WHEELS
    ], listed or "types, of which none is of poses or a TwistStamped"


def _with_odometry(found: Aids, log: Log, recording: Recording, name: str) -> Aids:
    """With the velocity of wheel odometry."""
    if name in recording.truths or (name in log.topics and _is_truth(log.topics[name], recording)):
        raise DataError(f"{name} is the truth, and no aid", where=recording.name, expected="a topic of wheel odometry")
    poses = _poses(log, name, recording)
    if recording.truths and _same_path(poses, recording.truth):
        raise DataError(f"{name} moves exactly as the truth, and is no aid", where=recording.name, expected="wheel odometry")
    return replace(found, signals=found.signals | {WHEELS: name}, odometry=_mounted(poses, recording.imu, name))


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
    t_ns, values = _of_stretch(imu, *numbers(log, name, paths))
    if len(t_ns) < 2:
        raise DataError(f"{name} has {len(t_ns)} twists while the IMU measures", expected="two or more")
    dt = np.diff(seconds(t_ns, int(t_ns[0])), prepend=0.0)
    yaw = np.cumsum(dt * values[:, 3])
    q = quaternion.exp(yaw[:, None] * np.array([0.0, 0.0, 1.0]))
    v = quaternion.rotate(q, values[:, :3])
    return Poses(t_ns, np.cumsum(dt[:, None] * v, axis=0), q, v)


def _same_path(poses: Poses, truth: Poses) -> bool:
    """Whether positions are those of the truth but for a rigid motion."""
    if len(truth) < 2:
        return False
    true, valid = truth.at(poses.t_ns)
    p, p_true = poses.p_wb[valid], true.p_wb[valid]
    motion = align(p, p_true) if len(p) > 2 else None
    if motion is None or float(quaternion.length(np.diff(p, axis=0)).sum()) < LEAST_PATH_M:
        return False
    R, shift = motion
    return float(np.sqrt(((p @ R.T + shift - p_true) ** 2).sum(axis=1).mean())) < SAME_M


def _mounted(poses: Poses, imu: Imu, name: str) -> Odometry:
    """Odometry with the mount that its motion shows.

    Raises:
        DataError: the motion does not show it, for it does not accelerate.
    """
    edges = np.arange(int(poses.t_ns[0]), int(poses.t_ns[-1]), BLOCK_NS)
    at, valid = poses.at(edges)
    middle, known = poses.at(edges[:-1] + BLOCK_NS // 2)
    first, last = np.searchsorted(imu.t_ns, edges[:-1]), np.searchsorted(imu.t_ns, edges[1:])
    full = (last - first) * imu.period_s * 1e9 > 0.9 * BLOCK_NS
    good = valid[1:] & valid[:-1] & known & full
    assert at.v_w is not None
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(imu.accel, axis=0)])
    f_b = (sums[last] - sums[first])[good] / (last - first)[good, None]
    f_w = np.diff(at.v_w, axis=0)[good] / (BLOCK_NS * 1e-9) - np.array(GRAVITY_W)
    f_v = quaternion.rotate(quaternion.inverse(middle.q_wb_wxyz[good]), f_w)
    alike = np.abs(quaternion.length(f_v) - quaternion.length(f_b)) < MOST_SLIP_M_S2
    f_v, f_b = f_v[alike], f_b[alike]
    if len(f_v) < 3:
        raise DataError(
            f"{name} and the IMU agree in fewer than three half seconds", expected="odometry while the IMU measures"
        )
    u, _, vt = np.linalg.svd(f_v.T @ f_b)
    R_vb = u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt
    variance = max(float(((f_v - f_b @ R_vb.T) ** 2).sum()) / (3 * len(f_v) - 3), LEAST_NOISE_M_S2**2)
    information = np.linalg.eigvalsh(-(hat(f_v) @ hat(f_v)).sum(axis=0)).min()
    std = float(np.sqrt(variance / max(information, np.finfo(float).tiny)))
    if std > MOST_MOUNT_STD_RAD:
        raise DataError(
            f"the motion does not show how the IMU is mounted in the frame of {name}",
            expected="a vehicle that brakes and starts again",
        )
    return Odometry(poses, R_vb, std)
