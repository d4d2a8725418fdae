"""Write a message log as MCAP, its encoded messages as they come, its arrays by chunks.

Sensors, images and other topics have chunks of their own, so that a reader of the IMU unpacks no image.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

import imutool
from imutool.array_types import Shaped, UInt8
from imutool.conversion.restamping import SharedStamps
from imutool.conversion.robot_messages import Paths, Px4, pose_kind, px4_of, reflected_of, reflection_note
from imutool.conversion.sensor_pairs import SensorPairs
from imutool.conversion.user_labels import check_kinds
from imutool.errors import DataError
from imutool.file_location import Location
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.encode import encode_imu, encode_pose
from imutool.mcap_io.codec.reflection import Reflected
from imutool.mcap_io.codec.transforms import Transforms
from imutool.mcap_io.file_writer import Chunk, LogWriter
from imutool.mcap_io.topics import KIND_KEY, MESSAGE_POSES, PART_KEY, RECORDED_KEY
from imutool.mcap_io.write import (
    BODY,
    CHUNK_BYTES,
    RECORD,
    WORLD,
    MessageBuffer,
    Series,
    chunks,
    copy_attachment,
    scalar_series,
    velocity_series,
)
from imutool.recording import nanoseconds
from imutool.recording.columns import MAX_GAP_S, clock_jumps, jump_warnings
from imutool.recording.message_log import MessageLog, MessageTopic, Table, computed_kind, named_kind

BULKY = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/PointCloud2")
SENSORS = (schemas.IMU, schemas.VECTOR3, schemas.TF, schemas.FLOAT, *MESSAGE_POSES)
PACKED = ("sensor_msgs/msg/CompressedImage",)  # compressing these again costs time and saves nothing
ROS_NAMES = {"f4": "float32", "f8": "float64", "b1": "bool"} | {
    f"{sign}{size}": f"{name}{8 * size}" for sign, name in (("i", "int"), ("u", "uint")) for size in (1, 2, 4, 8)
}
LATEST_NS = 2**63 - 1  # of 64 bits with a sign, as numpy counts
MAX_JUMPS = 1000  # of the clock, that are counted
_Sampled = Reflected | Transforms | Px4  # what reads a sample from a message
ENCAPSULATION = 4  # bytes ahead of a CDR message; alignment counts from behind them
_encode_body = partial(encode_imu, frame_id=BODY)


def write_log(source: MessageLog, path: Location, *, compression: str = "zstd", overwrite: bool = False) -> None:
    """Write every topic of a message log.

    What the source counts differently goes to its remarks.

    Raises:
        ConfigError: the target exists (without `overwrite`) or cannot be written, or an unknown compression.
        DataError: the log holds no message, or a time that MCAP or ROS 2 cannot store.
    """
    with LogWriter(path, compression=compression, overwrite=overwrite) as log:
        _write_metadata(log, source)
        pairs = SensorPairs(source)
        stream = _Stream(log, source, pairs)
        groups = [_imus(log, source) + _poses(log, source) + scalar_series(log, source.scalars, BODY), _tables(log, source)]
        streams: list[Iterator[tuple[Chunk, str | None]]] = [((chunk, None) for chunk in chunks(g)) for g in groups]
        for chunk, packing in heapq.merge(*streams, stream.chunks(), key=lambda item: item[0].start_ns):
            log.chunk(chunk, packing)
        for topic, log_times, imu in pairs.joined(source.remarks):
            series = Series(log.channel(topic, schemas.IMU), log_times, (imu.t_ns, imu.gyro, imu.accel), _encode_body)
            for chunk in chunks([series]):
                log.chunk(chunk)
        source.remarks.losses.extend(filter(None, (copy_attachment(log, place) for place in source.attachments)))
        check_kinds(source, stream.channels, _write_trajectories(log, source, stream.paths))
        if not log.contents.counts.total():
            raise DataError("holds no messages", where=source.name, expected="a log with data")
        _compare(source, stream.counts)
        if source.remarks.notes or source.remarks.losses:
            lines = [*source.remarks.losses, *source.remarks.notes]
            log.metadata("imutool/remarks", {f"{number:03d}": line for number, line in enumerate(lines, start=1)})


def _write_trajectories(log: LogWriter, source: MessageLog, paths: Paths) -> list[str]:
    """Write the poses that paths left behind, but where a log that was converted before has them; their topics."""
    topics = []
    for topic, found in paths.trajectories():
        if (made := f"{topic}/pose") in source.counts:
            continue
        kind = {KIND_KEY: source.kinds.get(made, pose_kind(topic))}
        columns = (found.t_ns, found.numbers[:, :3], found.numbers[:, [6, 3, 4, 5]])
        encode = partial(encode_pose, frame_id=found.frame_id)
        for chunk in chunks([Series(log.channel(made, schemas.POSE, kind), found.t_ns, columns, encode)]):
            log.chunk(chunk)
        note = f"{made} is made of the messages on {topic}: {paths.messages[topic]}; a later one replaces what it has, too"
        source.remarks.notes.append(note)
        topics.append(made)
    return topics


class _Stream:
    """Encoded messages of a source, gathered into chunks; `channels` by topic."""

    def __init__(self, log: LogWriter, source: MessageLog, pairs: SensorPairs) -> None:
        self._log, self._source, self._pairs = log, source, pairs
        self.channels: dict[MessageTopic, int] = {}
        self._buffers: dict[int, MessageBuffer] = {}  # by channel
        self._shared = MessageBuffer(packed=False), MessageBuffer(packed=False)  # of sensors, and of all others that are small
        self._sequence = Counter[int]()
        self._reflected: dict[int, list[tuple[int, _Sampled]]] = {}  # channels of CDR, by the original's
        self._has_imu = any(schemas.canonical(topic.schema_name) == schemas.IMU for topic in source.topics)
        self._begun = set[int]()  # channels that have messages
        self._made_of = set[str]()  # topics of PX4 from which another is made
        self.paths = Paths()
        self._lacking = Counter[str]()  # messages without a sample, by topic
        self.counts = Counter[str]()
        for topic in source.topics:
            self._define(topic)

    def _define(self, topic: MessageTopic, first: bytes | memoryview | None = None) -> int:
        """Define a topic; an IMU or a pose in protobuf or the like becomes CDR under its name, its original gets another."""
        if first is not None and (found := reflected_of(topic, bytes(first), self._source)) is not None:
            cdr: list[tuple[int, _Sampled]] = [(self._define(_translated(topic, topic.name, found)), found)]
            if isinstance(found, Reflected) and found.pose is not None:
                cdr.append((self._define(_translated(topic, f"{topic.name}/pose", found.pose)), found.pose))
            recorded = (*topic.metadata, (RECORDED_KEY, topic.name))
            number = self.channels[topic] = self._define(replace(topic, name=f"{topic.name}/as_recorded", metadata=recorded))
            self._reflected[number] = cdr
            self._source.remarks.notes.append(reflection_note(topic, found))
            return number
        kind = self._source.kinds.get(topic.name)
        marked = topic if kind is None else replace(topic, metadata=(*topic.metadata, (KIND_KEY, kind)))
        if (whole := self._pairs.whole_of(topic.name)) is not None:
            marked = replace(marked, metadata=(*marked.metadata, (PART_KEY, whole)))
        number = self.channels[topic] = self._log.define(marked)
        name = schemas.canonical(topic.schema_name)
        if name in BULKY:
            self._buffers[number] = MessageBuffer(packed=name in PACKED)
        else:
            self._buffers[number] = self._shared[0 if name in SENSORS else 1]
        return number

    def chunks(self) -> Iterator[tuple[Chunk, str | None]]:
        """Chunks of about 1 MiB as they fill, and the rest at the end."""
        last, longest, jumps, stamps = None, nanoseconds(MAX_GAP_S), list[tuple[int, float]](), SharedStamps()
        before, jump = set[int](), (0, 0.0)
        for topic, log_time, publish_time, payload in self._source.messages():
            if (number := self.channels.get(topic)) is None:
                number = self._define(topic, payload)
            if not 0 <= log_time <= LATEST_NS:
                what, fix = f"a message of {topic.name} has the time {log_time} ns", "imutool repair leaves it out"
                raise DataError(what, expected="a time from 1970 to 2262", fix=fix)
            if last is not None and abs(log_time - last) > longest and len(jumps) < MAX_JUMPS:
                before, jump = set(self._begun), (log_time, (log_time - last) * 1e-9)
            if number in before:  # and no topic with a clock of its own
                jumps, before = [*jumps, jump], set()
            last = log_time
            self._pairs.take(topic, log_time, payload)
            stamps.take(topic, payload)
            self.paths.take(topic, payload)
            if number not in self._begun:
                self._begin(number, topic)
            if number in self._reflected:
                self._put_as_cdr(number, topic, log_time, publish_time, bytes(payload))
            buffer = self._put(number, log_time, publish_time, payload)
            if buffer.size >= CHUNK_BYTES:
                yield buffer.pop()
        for buffer in {id(b): b for b in (*self._shared, *self._buffers.values())}.values():
            if buffer.parts:
                yield buffer.pop()
        self._source.remarks.notes += [*jump_warnings(jumps), *stamps.notes()]
        for topic, number in self.channels.items():
            self.counts[topic.name] += self._sequence[number]
        for name, count in self._lacking.items():
            where = f"; see {name}/as_recorded" if name not in self._made_of else ""
            self._source.remarks.losses.append(f"messages of {name} without a sample: {count}{where}")

    def _begin(self, number: int, topic: MessageTopic) -> None:
        """Define the topic that is made of one of PX4's."""
        self._begun.add(number)
        found = px4_of(topic, has_imu=self._has_imu) if topic.message_encoding == "cdr" else None
        made = f"{topic.name}/{found.ending}" if found else ""
        if found is not None and made not in self._source.counts:  # which it is in a log that was converted before
            marks = ((KIND_KEY, self._source.kinds.get(made, pose_kind(topic.name))),) if found.ending == "pose" else ()
            channel = self._define(MessageTopic(made, found.schema_name, "ros2msg", b"", "cdr", marks))
            self._reflected[number] = [(channel, found)]
            self._made_of.add(topic.name)
            self._source.remarks.notes.append(f"{made} is made of {topic.name}, in FLU and ENU")

    def _put(self, number: int, log_time: int, publish_time: int, payload: bytes | memoryview) -> MessageBuffer:
        buffer = self._buffers[number]
        buffer.add(number, self._sequence[number], log_time, publish_time, payload)
        self._sequence[number] += 1
        return buffer

    def _put_as_cdr(self, number: int, topic: MessageTopic, log_time: int, publish_time: int, payload: bytes) -> None:
        """Put the sample in a message of a reflected IMU or pose, ahead of the message itself."""
        for channel, reflected in self._reflected[number]:
            try:
                sample = reflected.sample(payload, log_time)
            except ValueError:
                self._lacking[topic.name] += 1
                continue
            self._put(channel, log_time, publish_time, reflected.encode([sample]).tobytes())  # type: ignore[list-item]  # its own


def _translated(topic: MessageTopic, name: str, found: Reflected | Transforms) -> MessageTopic:
    """Topic of the IMU or the poses in another topic's messages."""
    kind = (named_kind if name == topic.name else computed_kind)(topic.name, topic.schema_name)
    marks = ((KIND_KEY, kind),) if found.schema_name != schemas.IMU else ()
    return MessageTopic(name, found.schema_name, "ros2msg", b"", "cdr", marks)


def _write_metadata(log: LogWriter, source: MessageLog) -> None:
    own = {"writer": f"imutool {imutool.__version__}", "source": source.source}
    entries = {name: dict(values) for name, values in source.metadata.items()}
    log.metadata(RECORD, own | entries.pop(RECORD, {}))
    for name, values in entries.items():
        log.metadata(name, values)


def _imus(log: LogWriter, source: MessageLog) -> list[Series]:
    """IMUs; jumps of their clocks go to the remarks."""
    for topic, imu in source.imus.items():
        source.remarks.notes += [f"{topic}: {warning}" for warning in jump_warnings(clock_jumps(imu.t_ns))]
    return [
        Series(log.channel(topic, schemas.IMU), imu.t_ns, (imu.t_ns, imu.gyro, imu.accel), _encode_body)
        for topic, imu in source.imus.items()
    ]


def _poses(log: LogWriter, source: MessageLog) -> list[Series]:
    """Poses with their kind, and their velocities."""
    series: list[Series] = []
    for topic, poses in source.poses.items():
        t_ns, kind = poses.t_ns, {KIND_KEY: source.kinds.get(topic, "unknown")}
        columns = (t_ns, poses.p_wb, poses.q_wb_wxyz)
        series.append(Series(log.channel(topic, schemas.POSE, kind), t_ns, columns, partial(encode_pose, frame_id=WORLD)))
        series += velocity_series(log, topic, poses)
    return series


def _tables(log: LogWriter, source: MessageLog) -> list[Series]:
    return [
        Series(log.define(_table_topic(topic, table)), table.t_ns, (table.columns,), _encode_table)
        for topic, table in source.tables.items()
    ]


def _table_topic(name: str, table: Table) -> MessageTopic:
    """Topic of a table, with the definition of its messages."""
    lines = []
    for column, (kind, shape) in _fields(table.columns.dtype).items():
        size = "".join(f"[{count}]" for count in shape)
        lines.append(f"{ROS_NAMES[kind.str[1:]]}{size} {column}\n")
    return MessageTopic(name, table.schema_name, "ros2msg", "".join(lines).encode(), "cdr")


def _encode_table(columns: Shaped[np.ndarray, " n"]) -> UInt8[np.ndarray, "n L"]:
    """One message for each row; every field has a fixed size, so all rows lie alike."""
    fields = _fields(columns.dtype)
    offsets, position = [], ENCAPSULATION
    for kind, shape in fields.values():
        position += -(position - ENCAPSULATION) % kind.itemsize
        offsets.append(position)
        position += kind.itemsize * int(np.prod(shape, dtype=int))
    position += 0 if fields else 1  # ROS 2 gives a message without fields one byte
    formats = [(kind.newbyteorder("<"), shape) for kind, shape in fields.values()]
    layout = np.dtype({"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": position})
    rows = np.zeros(len(columns), layout)
    for name in fields:
        rows[name] = columns[name]
    raw = rows.view(np.uint8).reshape(len(columns), position)
    raw[:, 1] = 1  # little endian
    return raw


def _fields(dtype: np.dtype[np.void]) -> dict[str, tuple[np.dtype[np.generic], tuple[int, ...]]]:
    """Type and shape of every column."""
    fields = ((name, dtype[name]) for name in dtype.names or ())
    return {name: (field.subdtype[0], field.shape) if field.subdtype else (field, ()) for name, field in fields}


def _compare(source: MessageLog, written: Counter[str]) -> None:
    """Note the topics of which the source counts more messages than were read."""
    kept = Counter({topic: count + written[f"{topic}/untranslated"] for topic, count in written.items()})
    fewer = [f"{topic} ({kept[topic]} of {count})" for topic, count in source.counts.items() if kept[topic] < count]
    if fewer:
        source.remarks.losses.append(f"fewer messages were read than the source counts: {', '.join(fewer)}")
