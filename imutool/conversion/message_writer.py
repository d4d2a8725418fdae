"""Write a message log as MCAP, its encoded messages as they come, its arrays by chunks.

Sensors, images and other topics have chunks of their own, so that a reader of the IMU unpacks no image.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np

import imutool
from imutool.conversion.sensor_pairs import SensorPairs
from imutool.conversion.table_messages import encode_table, table_topic
from imutool.errors import DataError
from imutool.location import Location
from imutool.mcap_io.codec import messages, schemas
from imutool.mcap_io.codec.encode import encode_float, encode_imu, encode_pose, encode_vector3
from imutool.mcap_io.read import RECORD, UNIT_KEY, VELOCITY_KEY
from imutool.mcap_io.topics import KIND_KEY, MESSAGE_POSES, PART_KEY
from imutool.mcap_io.write import BODY, CHUNK_BYTES, WORLD, Series, chunks
from imutool.mcap_io.writer import Chunk, LogWriter
from imutool.recording.message_log import MessageLog, MessageTopic

BULKY = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/PointCloud2")
SENSORS = (schemas.IMU, schemas.VECTOR3, schemas.TF, schemas.FLOAT, *MESSAGE_POSES)
PACKED = ("sensor_msgs/msg/CompressedImage",)  # compressing these again costs time and saves nothing


_encode_body = partial(encode_imu, frame_id=BODY)


class Written(NamedTuple):
    """Messages written, by topic."""

    counts: dict[str, int]


@dataclass
class _Buffer:
    """Messages that become one chunk."""

    packed: bool
    parts: list[bytes | memoryview] = field(default_factory=list)
    channels: list[int] = field(default_factory=list)
    times: list[int] = field(default_factory=list)
    offsets: list[int] = field(default_factory=list)
    size: int = 0

    def pop(self) -> tuple[Chunk, str | None]:
        """Hand over the messages as a chunk with its compression."""
        channels, times = np.array(self.channels, np.uint16), np.array(self.times, np.int64)
        chunk = Chunk(b"".join(self.parts), channels, times, np.array(self.offsets, np.int64))
        for column in (self.parts, self.channels, self.times, self.offsets):
            column.clear()
        self.size = 0
        return chunk, "none" if self.packed else None


def write_log(source: MessageLog, path: Location, *, compression: str = "zstd", overwrite: bool = False) -> Written:
    """Write every topic of a message log; return the messages written by topic.

    What the source counts differently goes to its remarks.

    Raises:
        ConfigError: the target exists (without `overwrite`) or cannot be written, or an unknown compression.
        DataError: the log holds no message, or a time that MCAP or ROS 2 cannot store.
    """
    with LogWriter(path, compression=compression, overwrite=overwrite) as log:
        _write_metadata(log, source)
        pairs = SensorPairs(source)
        stream = _Stream(log, source, pairs)
        groups = [_imus(log, source) + _poses(log, source) + _scalars(log, source), _tables(log, source)]
        streams: list[Iterator[tuple[Chunk, str | None]]] = [((chunk, None) for chunk in chunks(g)) for g in groups]
        for chunk, packing in heapq.merge(*streams, stream.chunks(), key=lambda item: item[0].start_ns):
            log.chunk(chunk, packing)
        for topic, imu in pairs.joined(source.remarks):
            series = Series(log.channel(topic, schemas.IMU), imu.t_ns, (imu.t_ns, imu.gyro, imu.accel), _encode_body)
            for chunk in chunks([series]):
                log.chunk(chunk)
        counts = _counts(log)
        if not sum(counts.values()):
            raise DataError("holds no messages", where=source.name, expected="a log with data")
        _compare(source, stream.counts)
        if source.remarks.notes or source.remarks.losses:
            lines = [*source.remarks.losses, *source.remarks.notes]
            log.metadata("imutool/remarks", {f"{number:03d}": line for number, line in enumerate(lines, start=1)})
    return Written(counts)


class _Stream:
    """Encoded messages of a source, gathered into chunks."""

    def __init__(self, log: LogWriter, source: MessageLog, pairs: SensorPairs) -> None:
        self._log, self._source, self._pairs = log, source, pairs
        self._channels: dict[MessageTopic, int] = {}
        self._buffers: dict[int, _Buffer] = {}  # by channel
        self._shared = _Buffer(packed=False), _Buffer(packed=False)  # of sensors, and of all others that are small
        self._sequence = Counter[int]()
        self.counts = Counter[str]()
        for topic in source.topics:
            self._define(topic)

    def _define(self, topic: MessageTopic) -> int:
        kind = self._source.kinds.get(topic.name)
        marked = topic if kind is None else replace(topic, metadata=(*topic.metadata, (KIND_KEY, kind)))
        if (whole := self._pairs.whole_of(topic.name)) is not None:
            marked = replace(marked, metadata=(*marked.metadata, (PART_KEY, whole)))
        number = self._channels[topic] = self._log.define(marked)
        name = schemas.canonical(topic.schema_name)
        if name in BULKY:
            self._buffers[number] = _Buffer(packed=name in PACKED)
        else:
            self._buffers[number] = self._shared[0 if name in SENSORS else 1]
        return number

    def chunks(self) -> Iterator[tuple[Chunk, str | None]]:
        """Chunks of about 1 MiB as they fill, and the rest at the end."""
        for topic, log_time, publish_time, payload in self._source.messages():
            if (number := self._channels.get(topic)) is None:
                number = self._define(topic)
            if log_time < 0:
                raise DataError(f"a message of {topic.name} has the time {log_time} ns", expected="no time before 1970")
            self._pairs.take(topic, payload)
            buffer = self._buffers[number]
            sequence = self._sequence[number]
            self._sequence[number] = sequence + 1
            buffer.parts += messages.message_head(number, sequence, log_time, publish_time, len(payload)), payload
            buffer.channels.append(number)
            buffer.times.append(log_time)
            buffer.offsets.append(buffer.size)
            buffer.size += messages.MESSAGE.itemsize + len(payload)
            if buffer.size >= CHUNK_BYTES:
                yield buffer.pop()
        for buffer in {id(b): b for b in (*self._shared, *self._buffers.values())}.values():
            if buffer.parts:
                yield buffer.pop()
        for topic, number in self._channels.items():
            self.counts[topic.name] += self._sequence[number]


def _write_metadata(log: LogWriter, source: MessageLog) -> None:
    own = {"writer": f"imutool {imutool.__version__}", "source": source.source}
    entries = {name: dict(values) for name, values in source.metadata.items()}
    log.metadata(RECORD, own | entries.pop(RECORD, {}))
    for name, values in entries.items():
        log.metadata(name, values)


def _imus(log: LogWriter, source: MessageLog) -> list[Series]:
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
        if poses.v_w is not None:
            velocity = {VELOCITY_KEY: topic, UNIT_KEY: "m/s"}
            channel = log.channel(f"{topic.removesuffix('/pose')}/velocity", schemas.VECTOR3, velocity)
            series.append(Series(channel, t_ns, (t_ns, poses.v_w), partial(encode_vector3, frame_id=WORLD)))
    return series


def _scalars(log: LogWriter, source: MessageLog) -> list[Series]:
    series: list[Series] = []
    for topic, scalars in source.scalars.items():
        t_ns, values, unit = scalars.t_ns, scalars.values, {UNIT_KEY: scalars.unit}
        if values.shape[1] == 1:
            series.append(Series(log.channel(topic, schemas.FLOAT, unit), t_ns, (values[:, 0],), encode_float))
        else:
            channel = log.channel(topic, schemas.VECTOR3, unit)
            series.append(Series(channel, t_ns, (t_ns, values), partial(encode_vector3, frame_id=BODY)))
    return series


def _tables(log: LogWriter, source: MessageLog) -> list[Series]:
    return [
        Series(log.define(table_topic(topic, table)), table.t_ns, (table.columns,), encode_table)
        for topic, table in source.tables.items()
    ]


def _counts(log: LogWriter) -> dict[str, int]:
    counts: Counter[str] = Counter()
    for number, channel in log.contents.channels.items():
        counts[channel.topic] += log.contents.counts[number]
    return dict(counts)


def _compare(source: MessageLog, written: Counter[str]) -> None:
    """Note the topics of which the source counts more messages than were read."""
    kept = Counter({topic: count + written[f"{topic}/untranslated"] for topic, count in written.items()})
    fewer = [f"{topic} ({kept[topic]} of {count})" for topic, count in source.counts.items() if kept[topic] < count]
    if fewer:
        source.remarks.losses.append(f"fewer messages were read than the source counts: {', '.join(fewer)}")
