"""Corrections of a log: units, axes and stamps of IMUs, frames and clock of poses.

Messages are patched where they stand, so everything else of them stays: covariances turn with their vectors, and the poses in
the judged poses' frame turn with it. The record `imutool_corrections` says what was changed.
"""

from __future__ import annotations

import heapq
import struct
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import tee

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.cleaning.likelihood import axis_names
from imutool.cleaning.pose_quaternions import read_right
from imutool.cleaning.position_unit import POSITIONS
from imutool.conversion.restamping import SAME_CLOCK_NS
from imutool.errors import DataError
from imutool.geometry import quaternion
from imutool.log_info.pose_imu_rotation import Body
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.encode import NO_ORIENTATION
from imutool.mcap_io.codec.reflection import Reflected
from imutool.mcap_io.recovery.losses import LATEST_NS
from imutool.mcap_io.topics import ENCODINGS, MESSAGE_POSES, VELOCITY_KEY
from imutool.mcap_io.write import RECORD as OWN
from imutool.recording.message_log import Message, MessageLog, MessageTopic

RECORD = "imutool_corrections"
CONVENTIONS, STAMPS = "conventions", "stamps"  # what may be corrected
TURNED = ", axes corrected"  # behind the name of a sensor
XYZW_FROM_WXYZ, WXYZ_FROM_XYZW = [1, 2, 3, 0], [3, 0, 1, 2]
NOT_TURNED = Body(np.eye(3), frozenset())


@dataclass(frozen=True)
class Corrections:
    """Corrections that a log needs.

    Attributes:
        imus: by topic, the matrices that lead from its gyro and accel to right ones.
        world: rotation of the poses in the frame `frame_id`; `late_ns` is taken from their stamps.
        body: rotation from the body of the poses on `pose_topic` to the IMU.
        unit: of the positions on `pose_topic`, of their velocities, and of transforms of the frames `copies`.
        quaternions: what is wrong with those of `pose_topic` and `copies` (`pose_quaternions`).
        stamps: new stamps of messages of an IMU, of poses or vectors, in file order.
        reflected: topics among them whose messages have a type of their own.
        notes: what is corrected, by topic.
        kept: what stays wrong, and why.
    """

    imus: Mapping[str, Float64[np.ndarray, "2 3 3"]] = field(default_factory=dict)
    world: Float64[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    frame_id: str = ""
    late_ns: int = 0
    body: Body = NOT_TURNED
    pose_topic: str = ""
    unit: str = "m"
    quaternions: str = ""
    copies: frozenset[str] = frozenset()
    stamps: Mapping[str, Int64[np.ndarray, "..."]] = field(default_factory=dict)
    reflected: Mapping[str, Reflected] = field(default_factory=dict)
    notes: Mapping[str, str] = field(default_factory=dict)
    kept: Sequence[str] = ()

    @property
    def is_of_clock(self) -> bool:
        """Whether stamps alone are corrected."""
        same = (self.world == np.eye(3)).all() and (self.body.turn == np.eye(3)).all()
        return not self.imus and bool(same) and self.unit == "m" and not self.quaternions

    def __bool__(self) -> bool:
        """Whether there is anything to correct."""
        return bool(self.notes)

    def put_on(self, content: MessageLog) -> MessageLog:
        """Log with corrected messages, and the record of what was corrected."""
        content.remarks.notes.extend(f"{topic}: {note}" for topic, note in self.notes.items())
        earlier = content.metadata.get(RECORD, {})  # of another round, or of an earlier command
        record = {topic: "; ".join(filter(None, (earlier.get(topic), note))) for topic, note in self.notes.items()}
        metadata = {**content.metadata, RECORD: {**earlier, **record}}
        own, turned = content.metadata.get(OWN, {}), any((np.sign(axes) != np.eye(3)).any() for axes in self.imus.values())
        if turned and "sensor" in own and not own["sensor"].endswith(TURNED):  # a model of it as recorded does not fit any more
            metadata[OWN] = {**own, "sensor": own["sensor"] + TURNED}
        return replace(content, messages=lambda: self._after_zero(content), metadata=metadata)

    def _after_zero(self, content: MessageLog) -> Iterator[Message]:
        """Corrected messages; poses that belong before the zero of the log's clock have no time there."""
        before = 0
        for message in self._in_order(content):
            if message.log_time >= 0:
                yield message
            else:
                before += 1
        if before:
            note = f"{before} messages of poses belong before the zero of the log's clock, and are left out"
            content.remarks.notes.append(note)

    def _in_order(self, content: MessageLog) -> Iterator[Message]:
        """Corrected messages; where poses come from another clock, they are sorted in by the corrected one."""
        if abs(self.late_ns) < SAME_CLOCK_NS:
            return self._each(content.messages())
        others, moved = (self._where(content, is_moved) for is_moved in (False, True))
        return heapq.merge(others, moved, key=lambda message: message.log_time)

    def _where(self, content: MessageLog, is_moved: bool) -> Iterator[Message]:
        """Corrected messages whose log time has moved, or the others."""
        before, after = tee(message for message in content.messages() if _is_pose(message.topic) or not is_moved)
        return (new for old, new in zip(before, self._each(after), strict=True) if (new.log_time != old.log_time) is is_moved)

    def _each(self, messages: Iterator[Message]) -> Iterator[Message]:
        seen = Counter[str]()
        for message in messages:
            name, stamps = message.topic.name, self.stamps.get(message.topic.name)
            if stamps is None:
                yield self._corrected(message)
                continue
            stamp_ns, raw = int(stamps[seen[name]]), bytes(message.payload)
            seen[name] += 1
            if (reflected := self.reflected.get(name)) is not None:
                raw = reflected.with_stamp(raw, stamp_ns)
            else:
                patch = self._patch(message.topic, raw)
                patch.move_stamp(stamp_ns - patch.stamp_ns())
                raw = bytes(patch.data)
            yield self._corrected(message._replace(payload=raw))

    def _corrected(self, message: Message) -> Message:
        topic = message.topic
        if topic.message_encoding not in ENCODINGS:
            return message
        if topic.name in self.imus and topic.name in self.reflected:
            patched = self.reflected[topic.name].with_vectors(bytes(message.payload), self.imus[topic.name])
            return message._replace(payload=patched)
        if topic.name in self.imus:
            return message._replace(payload=_corrected_imu(self._patch(topic, message.payload), *self.imus[topic.name]))
        if not (self.pose_topic and _is_pose(topic)):
            return message
        patch = self._patch(topic, message.payload)
        before_ns = patch.stamp_ns()
        self._correct_poses(topic, patch)
        moved_ns = patch.stamp_ns() - before_ns
        if abs(moved_ns) > SAME_CLOCK_NS:
            published = message.publish_time + moved_ns if 0 < message.publish_time < LATEST_NS else message.publish_time
            message = message._replace(log_time=message.log_time + moved_ns, publish_time=max(published, 0))
        return message._replace(payload=bytes(patch.data))

    @cached_property
    def _layouts(self) -> dict[MessageTopic, schemas.Layout]:
        """Layout of each topic's last message, which nearly every next one shares."""
        return {}

    def _patch(self, topic: MessageTopic, payload: bytes | memoryview) -> _MessagePatch:
        schema_name, raw, layout = schemas.canonical(topic.schema_name), bytes(payload), self._layouts.get(topic)
        if layout is None or not layout.fits(raw):
            layout = self._layouts[topic] = schemas.layout_of(schema_name, topic.message_encoding, message=raw)
        return _MessagePatch(schema_name, layout, raw)

    @cached_property
    def _turns(self) -> tuple[Float64[np.ndarray, "4 4"], Float64[np.ndarray, "4 4"]]:
        """Rotations of the world, and from the IMU to the poses' body, as matrices by which a quaternion is multiplied."""
        turn, body = quaternion.of_matrix(self.world), quaternion.of_matrix(self.body.turn.T)
        return quaternion.multiply(turn, np.eye(4)).T, quaternion.multiply(np.eye(4), body).T

    def _correct_poses(self, topic: MessageTopic, patch: _MessagePatch) -> None:
        """Correct the poses or the velocity in the judged poses' frame."""
        named = 2 if "text" in schemas.SHAPES[patch.schema_name] else 1
        turn, body = self._turns
        for which in range(len(patch.layout.stamps)):
            if patch.layout.texts[named * which] != self.frame_id:
                continue
            numbers = patch.numbers(which)
            patch.move_stamp(-self.late_ns, which)
            if patch.schema_name == schemas.VECTOR3:
                factor = POSITIONS[self.unit] if dict(topic.metadata)[VELOCITY_KEY] == self.pose_topic else 1.0
                numbers[:] = factor * self.world @ numbers
                continue
            judged = topic.name == self.pose_topic or (named == 2 and patch.layout.texts[2 * which + 1] in self.copies)
            factor = POSITIONS[self.unit] if judged else 1.0
            numbers[schemas.POSITION] = factor * self.world @ numbers[schemas.POSITION]
            q_wxyz = numbers[schemas.XYZW][WXYZ_FROM_XYZW]
            if judged and self.quaternions:
                q_wxyz = read_right(self.quaternions, q_wxyz[None])[0]
            own = topic.name == self.pose_topic and patch.schema_name != schemas.TF  # a tree has bodies of its own
            if own or (named == 2 and patch.layout.texts[2 * which + 1] in self.body.frames):
                q_wxyz = body @ q_wxyz
                if patch.schema_name == schemas.ODOMETRY:
                    _turn_twist(numbers, self.body.turn)
            numbers[schemas.XYZW] = (turn @ q_wxyz)[XYZW_FROM_WXYZ]


class _MessagePatch:
    """Payload whose numbers and stamps are written in place."""

    def __init__(self, schema_name: str, layout: schemas.Layout, payload: bytes) -> None:
        self.schema_name, self.layout, self.data = schema_name, layout, bytearray(payload)
        self._stamp = struct.Struct(f"{layout.order}{'i' if layout.seconds == 'i4' else 'I'}I")

    def numbers(self, which: int = 0) -> np.ndarray:
        """Numbers of one element: a view."""
        at, count = self.layout.numbers[which]
        return np.frombuffer(self.data, f"{self.layout.order}f8", count, at)

    def stamp_ns(self, which: int = 0) -> int:
        """Stamp of one element."""
        seconds, nanos = self._stamp.unpack_from(self.data, self.layout.stamps[which])
        return int(seconds) * schemas.NS_PER_S + int(nanos)

    def move_stamp(self, by_ns: int, which: int = 0) -> None:
        """Shift a stamp."""
        moved_ns = self.stamp_ns(which) + by_ns
        seconds, nanos = divmod(moved_ns, schemas.NS_PER_S)
        try:
            self._stamp.pack_into(self.data, self.layout.stamps[which], seconds, nanos)
        except struct.error as error:
            what = f"a stamp of {moved_ns - by_ns} ns, moved by {by_ns} ns, does not fit its field"
            fix = "Cut the log there, or convert it to ROS 2 first" if moved_ns < 0 else "Cut the log there"
            raise DataError(what, expected="stamps that ROS can store", fix=fix) from error


def _turn_twist(numbers: np.ndarray, turn: Float64[np.ndarray, "3 3"]) -> None:
    """Turn the twist of an Odometry message, which is in the axes of its body."""
    both, twist, covariance = np.kron(np.eye(2), turn), schemas.TWIST_OF_ODOMETRY, schemas.TWIST_COVARIANCE
    numbers[twist] = both @ numbers[twist]
    numbers[covariance] = (both @ numbers[covariance].reshape(6, 6) @ both.T).reshape(-1)


def _corrected_imu(patch: _MessagePatch, gyro: Float64[np.ndarray, "3 3"], accel: Float64[np.ndarray, "3 3"]) -> bytes:
    """Message of an IMU in right units and axes: both vectors, covariances, own orientation."""
    numbers = patch.numbers()
    for matrix, vector, covariance in (
        (gyro, schemas.GYRO, schemas.GYRO_COVARIANCE),
        (accel, schemas.ACCEL, schemas.ACCEL_COVARIANCE),
    ):
        numbers[vector] = matrix @ numbers[vector]
        if numbers[covariance][0] != -1.0:
            numbers[covariance] = (matrix @ numbers[covariance].reshape(3, 3) @ matrix.T).reshape(-1)
    if numbers[schemas.ORIENTATION_COVARIANCE][0] != NO_ORIENTATION:
        P, Q = (np.sign(matrix) * (matrix != 0) for matrix in (gyro, accel))
        if (P == Q).all() and np.linalg.det(P) > 0:
            q_wxyz = numbers[schemas.ORIENTATION][WXYZ_FROM_XYZW][None].astype(np.float64)
            numbers[schemas.ORIENTATION] = quaternion.multiply(q_wxyz, quaternion.of_matrix(P.T))[0][XYZW_FROM_WXYZ]
        else:
            numbers[schemas.ORIENTATION_COVARIANCE.start] = NO_ORIENTATION
    return bytes(patch.data)


def pose_notes(world: Float64[np.ndarray, "3 3"], quaternions: str, unit: str, late_ns: int, turned: Body | None) -> list[str]:
    """Notes on what is corrected of poses."""
    parts = [f"the world's x, y, z are now {axis_names(world)} as recorded"] if (world != np.eye(3)).any() else []
    if quaternions:
        parts.append(f"quaternions now take vectors of the body to the world (as recorded, they {quaternions})")
    if unit != "m":
        parts.append(f"positions are now in m, and were in {unit}")
    if late_ns:
        parts.append(f"stamps are {abs(late_ns) * 1e-9:.6f} s {'earlier' if late_ns > 0 else 'later'} now")
    if turned is not None:
        deg = ", ".join(f"{angle:.4f}" for angle in np.degrees(quaternion.log(quaternion.of_matrix(turned.turn))[0]))
        parts.append(f"the body is now that of the IMU, turned by ({deg})° from that recorded")
    return parts


def _is_pose(topic: MessageTopic) -> bool:
    """Whether a topic holds poses, or their velocities."""
    name = schemas.canonical(topic.schema_name)
    return name in (*MESSAGE_POSES, schemas.TF) or (name == schemas.VECTOR3 and VELOCITY_KEY in dict(topic.metadata))
