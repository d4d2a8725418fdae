"""IMUs and poses in messages of other types: by their fields, of PX4, and of paths.

PX4's messages (px4_msgs) are in FRD and NED, in microseconds. The topics made of them are in FLU and ENU, as those of a ULog.
A path (nav_msgs/Path) that grows as its robot moves is a trajectory: each new one replaces the poses from its first stamp on.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from imutool.array_types import Float64, Int64, UInt8
from imutool.errors import LogError, not_installed
from imutool.geometry import quaternion
from imutool.geometry.quaternion import FLU_FROM_FRD
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.encode import encode_imu, encode_pose
from imutool.mcap_io.codec.formats import MAX_PASSED_NS
from imutool.mcap_io.codec.reflection import BY_LOG_TIMES, LOG_TIME, WITHOUT_STAMP, Reflected, Sample, reflect
from imutool.mcap_io.codec.ros2_definition import DescribedCdr, parse
from imutool.mcap_io.codec.transforms import Transforms
from imutool.mcap_io.topics import RECORDED_KEY
from imutool.recording.message_log import MessageLog, MessageTopic, computed_kind

PACKAGE = "px4_msgs/msg/"
WHOLE_IMUS, SINGLE_SENSORS = ("SensorCombined", "VehicleImu"), ("SensorGyro", "SensorAccel")
PATH = "nav_msgs/msg/Path"
ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
US, BODY, WORLD = 1000, "base_link", "map"  # ns; frames of ROS
KNOWN_FRAMES = 1, 2  # of VehicleOdometry's poses: NED, and FRD with any heading
NUMBERS = 7  # of a pose: position, then xyzw


def reflected_of(topic: MessageTopic, first: bytes, source: MessageLog) -> Reflected | Transforms | None:
    """Fields of an IMU or of poses in a topic of another encoding; None of other topics.

    An original whose translation the log has is one of them.

    Raises:
        ConfigError: its messages are protobuf, which is not installed.
    """
    if RECORDED_KEY in dict(topic.metadata):
        return None
    try:
        found = reflect(topic.message_encoding, topic.name, topic.schema_name, topic.schema, first)
    except ImportError as error:
        raise not_installed("protobuf", "protobuf", where=topic.name, user="reading such messages") from error
    if not isinstance(found, Reflected):
        return found
    return found.settled(_first_messages(source, topic))


def _first_messages(source: MessageLog, topic: MessageTopic) -> Iterator[tuple[int, bytes]]:
    """Log times and contents of the first messages of a topic, as long as they may show a unit."""
    end_ns = None
    for other, log_time, _, raw in source.messages():
        if end_ns is not None and log_time > end_ns:
            return
        if other == topic:
            end_ns = log_time + MAX_PASSED_NS if end_ns is None else end_ns
            yield log_time, bytes(raw)


def reflection_note(topic: MessageTopic, found: Reflected | Transforms) -> str:
    """What a topic became, in which units, and by which clock if its messages state none."""
    si = "rad/s and m/s^2" if found.schema_name == schemas.IMU else "metres"
    units = f"{found.units}, as the schema states" if found.units else si
    note = f"{topic.name}: {topic.message_encoding} became {found.schema_name}, taken as {units}"
    if isinstance(found, Reflected) and found.pose is not None:
        note = f"{note}; its poses are on {topic.name}/pose"
    if isinstance(found, Reflected) and found.compensated:
        note = f"{note}; {found.compensated}"
    if isinstance(found, Reflected) and found.stamp_unit:
        return f"{note}; {found.stamp_path} is in {found.stamp_unit}, {BY_LOG_TIMES}"
    return note if found.stamp else f"{note}; at the {LOG_TIME}, {WITHOUT_STAMP}"


@dataclass(frozen=True)
class Px4:
    """IMU, poses or a single sensor in the messages of a topic of PX4."""

    schema_name: str  # of the messages that are made; none of a single sensor
    ending: str  # of the topic that is made
    format: DescribedCdr
    kind: str

    def sample(self, raw: bytes, log_time: int) -> Sample:
        """Sample in a message, in FLU and ENU.

        Raises:
            ValueError: the message holds no sample.
        """
        try:
            return self._read(raw)
        except KeyError as error:
            raise ValueError(f"the message lacks {error}") from error

    def _read(self, raw: bytes) -> Sample:
        message, at = self.format.parse(raw), self.format.at

        def number(name: str) -> int:
            return int(at(message, (name,)))

        def vector(name: str, count: int = 3) -> Float64[np.ndarray, " k"]:
            return np.array([at(message, (name, place)) for place in range(count)], np.float64)

        if self.kind in SINGLE_SENSORS:
            values = FLU_FROM_FRD * [float(at(message, (axis,))) for axis in "xyz"]
            return Sample((number("timestamp_sample") or number("timestamp")) * US, BODY, values.tolist())
        if self.kind == "VehicleOdometry":
            if number("pose_frame") not in KNOWN_FRAMES:
                raise ValueError("the frame of the pose is not known")
            values = np.concatenate([ENU_FROM_NED @ vector("position"), quaternion.enu_from_ned(vector("q", 4)[None])[0]])
            return Sample((number("timestamp_sample") or number("timestamp")) * US, WORLD, values.tolist())
        if self.kind == "VehicleImu":  # the middle of what it integrates
            spans = np.array([number("delta_angle_dt"), number("delta_velocity_dt")]) * US
            if not spans.all():
                raise ValueError("it integrates over no time")
            rates, forces = (
                vector(f"delta_{of}") / (span * 1e-9) for of, span in zip(("angle", "velocity"), spans, strict=True)
            )
            stamp_ns = number("timestamp_sample") * US - int(spans[0]) // 2
        else:
            rates, forces, stamp_ns = vector("gyro_rad"), vector("accelerometer_m_s2"), number("timestamp") * US
        return Sample(stamp_ns, BODY, [*(FLU_FROM_FRD * rates).tolist(), *(FLU_FROM_FRD * forces).tolist()])

    def encode(self, samples: Sequence[Sample]) -> UInt8[np.ndarray, "n L"]:
        """Samples of one frame as CDR."""
        values, stamps = np.array([sample.values for sample in samples]), np.array([s.stamp_ns for s in samples], np.int64)
        encode = encode_imu if self.schema_name == schemas.IMU else encode_pose
        return encode(stamps, values[:, :3], values[:, 3:], samples[0].frame_id)


def px4_of(topic: MessageTopic, *, has_imu: bool) -> Px4 | None:
    """IMU or poses that a topic of PX4 holds; None of any other.

    No IMU where the log has one of ROS.
    """
    name = schemas.canonical(topic.schema_name)
    kind = name.removeprefix(PACKAGE)
    is_pose = kind == "VehicleOdometry"
    if name == kind or kind not in (*WHOLE_IMUS, "VehicleOdometry") or (has_imu and not is_pose):
        return None
    return _px4(topic, kind, schemas.POSE if is_pose else schemas.IMU, "pose" if is_pose else "imu")


def px4_sensors(topics: Iterable[MessageTopic]) -> dict[str, Px4]:
    """Gyros and accelerometers of PX4 by topic; none where a topic holds both."""
    kinds = {topic: schemas.canonical(topic.schema_name).removeprefix(PACKAGE) for topic in topics}
    if {*WHOLE_IMUS} & {*kinds.values()}:
        return {}
    single = ((t, kind) for t, kind in kinds.items() if kind in SINGLE_SENSORS and t.message_encoding == "cdr")
    found = {topic.name: _px4(topic, kind, "", "") for topic, kind in single}
    return {name: form for name, form in found.items() if form is not None}


def _px4(topic: MessageTopic, kind: str, schema_name: str, ending: str) -> Px4 | None:
    """Access to the messages of a topic; None of a definition that is lacking, as in a bag before Iron, or cannot be read."""
    if not topic.schema:
        return None
    try:
        form = DescribedCdr(parse(schemas.canonical(topic.schema_name), topic.schema))
    except LogError:
        return None
    return Px4(schema_name, ending, form, kind)


def pose_kind(topic: str) -> str:
    """Kind of the poses of PX4 or of a path: by the topic's name, else an estimate."""
    return computed_kind(re.sub(r"/fmu/out/vehicle_odometry(_v\d+)?$", "", topic), "")  # which is the EKF's


class Trajectory(NamedTuple):
    """Poses of a path, in order."""

    t_ns: Int64[np.ndarray, " n"]
    numbers: Float64[np.ndarray, "n 7"]  # position, then xyzw
    frame_id: str


class Paths:
    """Trajectories that paths leave behind, by topic.

    A plan, whose poses have no past times of their own, leaves none.
    """

    def __init__(self) -> None:
        self._found: dict[str, Trajectory | None] = {}
        self.messages: dict[str, int] = defaultdict(int)

    def take(self, topic: MessageTopic, payload: bytes | memoryview) -> None:
        """Take in a message, if it is a path."""
        if schemas.canonical(topic.schema_name) != PATH or topic.message_encoding != "cdr":
            return
        before = self._found.get(topic.name, Trajectory(np.zeros(0, np.int64), np.zeros((0, NUMBERS)), ""))
        try:
            stamp_ns, path = _path(bytes(payload))
        except LogError:
            path, stamp_ns = None, 0
        if path is not None and not len(path.t_ns):
            return
        self.messages[topic.name] += 1
        rises = path is not None and path.t_ns[0] > 0 and bool((np.diff(path.t_ns) > 0).all())
        if before is None or path is None or not rises or (stamp_ns and path.t_ns[-1] > stamp_ns):
            self._found[topic.name] = None
            return
        kept = before.t_ns < path.t_ns[0]
        t_ns, numbers = np.concatenate([before.t_ns[kept], path.t_ns]), np.concatenate([before.numbers[kept], path.numbers])
        self._found[topic.name] = Trajectory(t_ns, numbers, path.frame_id)

    def trajectories(self) -> Iterator[tuple[str, Trajectory]]:
        """Topics with their trajectories of two poses at least."""
        for topic, found in self._found.items():
            if found is not None and len(found.t_ns) > 1:
                yield topic, found


def _path(payload: bytes) -> tuple[int, Trajectory]:
    """Stamp and poses of a path; rows of one length are read at once.

    Raises:
        LogError: the bytes are no path.
    """
    walk = _Walk("cdr", payload)
    stamp_ns, frame_id = walk.header()
    count = walk.word()
    if count > len(payload) // (8 * NUMBERS):
        raise LogError(f"a path of {count} poses in {len(payload)} bytes")
    stamps, numbers, frames = [], [], {frame_id}
    starts = []
    for done in range(count):
        starts.append(walk.position)
        stamp, frame = walk.header()
        walk.align(8)
        stamps.append(np.array([stamp], np.int64))
        numbers.append(np.frombuffer(payload, walk.order + "f8", NUMBERS, walk.skip(8 * NUMBERS))[None].astype(np.float64))
        frames.add(frame)
        if done == 1 and (rest := _rows(payload, starts[1], walk.position, count - 2, walk.order)) is not None:
            stamps.append(rest[0])
            numbers.append(rest[1])
            break
    if not count:
        return stamp_ns, Trajectory(np.zeros(0, np.int64), np.zeros((0, NUMBERS)), frame_id)
    return stamp_ns, Trajectory(np.concatenate(stamps), np.concatenate(numbers), frame)


class _Walk(schemas.ByteWalk):
    """Walk over stamps and frames."""

    def header(self) -> tuple[int, str]:
        """Stamp (ns) and frame."""
        assert self.message is not None
        self.align(4)
        at = self.skip(8)
        sec, nanosec = (int(np.frombuffer(self.message, self.order + kind, 1, at + k)[0]) for k, kind in ((0, "i4"), (4, "u4")))
        length = self.word()
        at = self.skip(length)
        return sec * schemas.NS_PER_S + nanosec, self.message[at : at + length].rstrip(b"\0").decode(errors="replace")


def _rows(
    payload: bytes, first: int, second: int, count: int, order: str
) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, "n 7"]] | None:
    """Poses behind the second, where all have its length and frame."""
    size = second - first
    if len(payload) < second + count * size:
        return None
    rows = np.frombuffer(payload, np.uint8, count * size, second).reshape(count, size)
    model = np.frombuffer(payload, np.uint8, size, first)
    text = slice(8, size - 8 * NUMBERS)
    if (rows[:, text] != model[text]).any():
        return None
    seconds, nanoseconds = (
        np.ascontiguousarray(rows[:, at : at + 4]).view(order + kind)[:, 0] for at, kind in ((0, "i4"), (4, "u4"))
    )
    numbers = np.ascontiguousarray(rows[:, size - 8 * NUMBERS :]).view(order + "f8").astype(np.float64)
    return seconds.astype(np.int64) * schemas.NS_PER_S + nanoseconds.astype(np.int64), numbers
