"""Recording of a ROS 1 bag; topics are found by type, the data sets' names first.

The stamps are those of the message headers. Raw images (`sensor_msgs/Image`) and positions without orientation
(`PointStamped`) are not carried over; the metadata record `imutool/skipped` names them. A bag that its recorder did not
finish, or that is cut, has no index: what can be read of it is converted, and `imutool/losses` says so, and which topics the
data set does not have.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from imutool.bag.scan import Bag
from imutool.errors import ConfigError, DataError, LogError, required
from imutool.recording import Frames, Imu, Poses, Recording, Scalars

from . import Sequence, _asl
from ._archive import once_per_content
from ._asl_table import Table
from ._ros_types import ros2_name
from ._source import is_bag

IMU = "sensor_msgs/msg/Imu"
POSES = ("geometry_msgs/msg/TransformStamped", "geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Odometry")
IMAGE = "sensor_msgs/msg/CompressedImage"
SKIPPED = {
    "sensor_msgs/msg/Image": "raw images are not carried over, only CompressedImage",
    "geometry_msgs/msg/PointStamped": "a position without orientation is no pose",
}
NOT_OF_DATASET = "is left out, as the data set has no such topic; `format=ros1_bag` keeps every topic"


def topics(path: Path) -> dict[str, str]:
    """Message types by topic, in ROS 2 spelling.

    Raises:
        DataError: the bag cannot be read.
    """
    return _known(path)[0]


def _known(path: Path) -> tuple[dict[str, str], str]:
    """Message types by topic, and the bag's defect or "".

    A bag without an index is scanned completely.
    """
    try:
        return _known_once(path)
    except OSError as error:
        raise DataError(f"cannot be read ({error.strerror})", where=path) from error


@once_per_content(64)  # three converters ask about the same bag
def _known_once(path: Path) -> tuple[dict[str, str], str]:
    with _open(path) as bag:
        wrong = ""
        if not bag.indexed:
            count = sum(len(chunk.messages) for chunk in bag.chunks())
            if not count:
                raise DataError("cannot be read as a ROS 1 bag (no index, and not one message)", where=path)
            lost = f"{bag.lost} stretches of it lost, the first: {bag.losses[0].reason}" if bag.lost else "nothing of it lost"
            wrong = f"the bag has no index; {count} messages were found chunk by chunk, {lost}"
        return {c.topic: ros2_name(c.kind) for _, c in sorted(bag.connections.items())}, wrong


def recording_of(
    sequence: Sequence, dataset: str, sensor: str, known: bool, truths: dict[str, str], of_bag: tuple[str, ...], images: bool
) -> Recording:
    """Recording of a sequence: of a bag with the truths `of_bag`, else of an ASL folder."""
    if is_bag(sequence.path):
        return recording(sequence, dataset=dataset, sensor=sensor, known=known, truths=of_bag, images=images)
    return _asl.recording(sequence, dataset=dataset, sensor=sensor, known=known, truths=truths, images=images)


def recording(
    sequence: Sequence, *, dataset: str, sensor: str, known: bool, truths: tuple[str, ...], images: bool
) -> Recording:
    """Recording of a bag; the first topic of `truths` is the truth, then alphabetically.

    Of a bag that is not `known` to be of the data set, only the topics in `truths` are truth.

    Raises:
        ConfigError: rosbags is not installed.
        DataError: no IMU, several without a known name, or a defect in the data, with topic and message number.
    """
    kinds, wrong = _known(sequence.path)
    imu_topic = _imu_topic(sequence.path, [topic for topic, kind in kinds.items() if kind == IMU])
    wanted = (t for t, kind in kinds.items() if kind in POSES and (known or t in truths))
    pose_topics = sorted(wanted, key=lambda t: (t not in truths, t))
    skipped = {topic: SKIPPED[kind] for topic, kind in kinds.items() if kind in SKIPPED}
    named = {_asl.IMU_TOPIC: imu_topic}
    taken = {imu_topic, *pose_topics, *skipped}
    losses = {"bag": wrong} if wrong else {}
    losses |= {topic: NOT_OF_DATASET for topic, kind in kinds.items() if topic not in taken and kind != IMAGE}
    repairs: dict[str, str] = {}
    poses: dict[str, Poses] = {}
    scalars: dict[str, Scalars] = {}
    tables = {topic: table for topic in pose_topics if (table := _poses(sequence.path, topic)) is not None}
    for number, (topic, table) in enumerate(tables.items()):
        target = "/ground_truth/pose" if number == 0 else f"/ground_truth_{topic.strip('/').replace('/', '_')}/pose"
        named[target] = topic
        if repeated := _asl.add_truth(table, target, poses, scalars):
            repairs[target] = _asl.REPEATED.format(repeated)
    metadata = {
        "imutool": _asl.identity(dataset, sequence, sensor, known),
        "imutool/topics": named,
        **({"imutool/repairs": repairs} if repairs else {}),
        **({"imutool/skipped": skipped} if skipped else {}),
        **({"imutool/losses": losses} if losses else {}),
    }
    frames = {topic: _frames(sequence.path, topic) for topic, kind in kinds.items() if images and kind == IMAGE}
    return Recording(
        sequence.name,
        _imu(sequence.path, imu_topic),
        poses,
        scalars,
        {topic: found for topic, found in frames.items() if found.count},
        metadata,
        _asl.IMU_TOPIC,
        sequence.path.name,
    )


def _imu_topic(path: Path, candidates: list[str]) -> str:
    if _asl.IMU_TOPIC in candidates:
        return _asl.IMU_TOPIC
    if len(candidates) != 1:
        raise DataError(
            f"has {len(candidates)} IMU topics ({', '.join(candidates) or 'none'})",
            where=path,
            expected="one, or /imu0",
            fix="`format=ros1_bag` reads any bag" if candidates else "",
        )
    return candidates[0]


def _imu(path: Path, topic: str) -> Imu:
    rows = [
        (t_ns, [w.x, w.y, w.z, a.x, a.y, a.z])
        for t_ns, message in _messages(path, topic)
        for w, a in [(message.angular_velocity, message.linear_acceleration)]
    ]
    table = _table(path, topic, rows, {"gyro": slice(0, 3), "accel": slice(3, 6)})
    if table is None:
        raise DataError("holds no messages", where=f"{path}{topic}", expected="an IMU's samples")
    return _asl.imu(table)


def _poses(path: Path, topic: str) -> Table | None:
    rows = []
    for t_ns, message in _messages(path, topic):
        if hasattr(message, "transform"):
            p, q = message.transform.translation, message.transform.rotation
        else:
            pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
            p, q = pose.position, pose.orientation
        rows.append((t_ns, [p.x, p.y, p.z, q.w, q.x, q.y, q.z]))
    return _table(path, topic, rows, {"p_wb": slice(0, 3), "q_wb_wxyz": slice(3, 7)})


def _table(path: Path, topic: str, rows: list[tuple[int, list[float]]], columns: dict[str, slice]) -> Table | None:
    """Table of rows whose "lines" are message numbers; empty without rows."""
    if not rows:
        return None
    values = np.array([value for _, value in rows], np.float64)
    return Table(
        f"{path}{topic}",
        np.array([t_ns for t_ns, _ in rows], np.int64),
        {name: np.ascontiguousarray(values[:, place]) for name, place in columns.items()},
        np.arange(1, len(rows) + 1, dtype=np.int64),
    )


def _frames(path: Path, topic: str) -> Frames:
    first, count = None, 0
    for _, raw in _payloads(path, topic):
        first, count = raw if first is None else first, count + 1
    image = None if first is None else _decoder(path)(first, IMAGE)
    # "jpeg", "png", or as image_transport writes it: "bgr8; jpeg compressed bgr8"
    known = (name for name in ("png", "jpeg") if image is not None and name in image.format.replace("jpg", "jpeg"))
    return Frames(next(known, image.format if image else ""), count, partial(_each, path, topic))


def _each(path: Path, topic: str) -> Iterator[tuple[int, bytes]]:
    for t_ns, message in _messages(path, topic):
        yield t_ns, message.data.tobytes()


def _messages(path: Path, topic: str) -> Iterator[tuple[int, Any]]:
    """Header stamps (ns) and messages, in the order of the file."""
    decode = _decoder(path)
    for kind, raw in _payloads(path, topic):
        message = decode(raw, kind)
        yield message.header.stamp.sec * 10**9 + message.header.stamp.nanosec, message


def _payloads(path: Path, topic: str) -> Iterator[tuple[str, bytes]]:
    """Types and bytes of every message of a topic."""
    with _open(path) as bag:
        for chunk in bag.chunks():
            for message in chunk.messages:
                of = bag.connections[message.connection]
                if of.topic == topic:
                    yield ros2_name(of.kind), chunk.data[message.data_at : message.end]


def _decoder(path: Path) -> Callable[[bytes, str], Any]:
    """Decoder from type and bytes to a message.

    Raises:
        ConfigError: rosbags is not installed.
    """
    typesys = required("rosbags.typesys", "bags", where=path, user="reading ROS 1 bags")
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)

    def decode(raw: bytes, kind: str) -> Any:
        try:
            return store.deserialize_ros1(raw, kind)
        except Exception as error:  # struct, assertions and its own: a message that is none shows in many ways
            raise DataError(f"holds a message that is no {kind} ({error})", where=path) from error

    return decode


@contextmanager
def _open(path: Path) -> Iterator[Bag]:
    """Open a bag; with an index it must be intact, without one the readable part is taken."""
    try:
        with Bag(path) as bag:
            bag.recover = not bag.indexed
            yield bag
    except (ConfigError, LogError) as error:
        raise DataError(f"cannot be read as a ROS 1 bag ({error.what})", where=path, fix=error.fix) from error
