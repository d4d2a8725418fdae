"""Logs written: definitions first, chunks of one kind of data each, and a summary that indexes everything.

An IMU read from a log whose images share its chunks costs the unpacking of every image; so IMU, poses, scalars and images
each have chunks of their own, about 1 MiB long, interleaved by the time they begin.
"""

from __future__ import annotations

import heapq
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from types import TracebackType
from typing import NamedTuple

import numpy as np
from jaxtyping import Int64, Shaped, UInt8, UInt16
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

import imutool
from imutool.errors import DataError
from imutool.mcap_io import records, schema
from imutool.mcap_io.chunk_index import ChunkIndexes
from imutool.mcap_io.read import OWN_KEYS, RECORD, SHADOWED_KEY, UNIT_KEY, VELOCITY_KEY
from imutool.mcap_io.records import FOOTER_SIZE, MAGIC
from imutool.mcap_io.target import Target
from imutool.place import Place
from imutool.recording import Frames, Recording

CHUNK_BYTES = 1 << 20  # compression gains nothing beyond, memory grows tenfold by 32 MiB (mcap#1658)
LARGEST_ID = 2**16 - 1  # of a channel or a schema
WORLD, BODY = "world", "body"
PACKED_IMAGES = ("png", "jpeg", "jpg", "webp")  # compressing these again costs time and saves nothing

_FOREVER = "{sec: 9223372036, nsec: 854775807}"
QOS = (
    "- history: keep_last\n  depth: 10\n  reliability: reliable\n  durability: volatile\n"
    f"  deadline: {_FOREVER}\n  lifespan: {_FOREVER}\n  liveliness: automatic\n"
    f"  liveliness_lease_duration: {_FOREVER}\n  avoid_ros_namespace_conventions: false\n"
)


class Chunk(NamedTuple):
    """Message records in log-time order, and what an index must know of each."""

    data: bytes
    channels: UInt16[np.ndarray, " n"]
    times: Int64[np.ndarray, " n"]
    offsets: Int64[np.ndarray, " n"]

    @property
    def start_ns(self) -> int:
        """The earliest log time."""
        return int(self.times.min())


@dataclass
class Contents:
    """What the summary of a log says, collected while its data section is written."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: ChunkIndexes = field(default_factory=ChunkIndexes)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    start_ns: int | None = None
    end_ns: int = 0

    def add(self, counts: Mapping[int, int], start_ns: int, end_ns: int) -> None:
        """Counts the messages of a chunk."""
        for channel, count in counts.items():  # `update` takes five times as long for the few there are
            self.counts[channel] += count
        self.start_ns = start_ns if self.start_ns is None else min(self.start_ns, start_ns)
        self.end_ns = max(self.end_ns, end_ns)

    def statistics(self) -> Statistics:
        """The Statistics record."""
        return Statistics(
            attachment_count=len(self.attachments),
            channel_count=len(self.channels),
            channel_message_counts=dict(sorted(self.counts.items())),
            chunk_count=len(self.chunks),
            message_count=self.counts.total(),
            message_end_time=self.end_ns,
            message_start_time=self.start_ns or 0,
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )

    def groups(self) -> Iterator[tuple[Opcode, bytes | bytearray]]:
        """The bytes of the summary section, its records grouped by opcode as the format demands."""
        yield Opcode.SCHEMA, _built(self.schemas.values())
        yield Opcode.CHANNEL, _built(self.channels.values())
        yield Opcode.STATISTICS, _built([self.statistics()])
        yield Opcode.CHUNK_INDEX, self.chunks.raw
        yield Opcode.ATTACHMENT_INDEX, _built(self.attachments)
        yield Opcode.METADATA_INDEX, _built(self.metadata)


def _built(group: Iterable[McapRecord]) -> bytes:
    return b"".join(records.build(record) for record in group)


class LogWriter:
    """A log being written, as a context manager: complete and in its place on leaving, or gone after any error.

    Without `data_crc` the log states no CRC of its data section, and bytes may pass into it that nobody has looked at.

    Raises:
        ConfigError: the target exists (without `overwrite`) or cannot be written, or an unknown compression.
    """

    def __init__(
        self,
        path: Place,
        *,
        compression: str = "zstd",
        overwrite: bool = False,
        header: bytes | None = None,
        data_crc: bool = True,
    ) -> None:
        self.compression = records.COMPRESSIONS.get(compression, compression)
        records.pack(compression)
        self.contents, self.finished = Contents(), False
        self.written: set[int] = set()  # schemas
        self.target = Target(path, overwrite=overwrite, summing=data_crc)
        try:
            own = records.build(Header(profile="ros2", library=f"imutool {imutool.__version__}"))
            self.target.write(MAGIC + (own if header is None else header))
        except BaseException:
            self.target.abandon()
            raise

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if kind is not None:
            self.target.abandon()
            return
        try:
            self.finish()
        except BaseException:
            self.target.abandon()
            raise
        self.target.commit()

    def channel(self, topic: str, schema_name: str, metadata: Mapping[str, str] | None = None) -> int:
        """Defines a topic (and its schema, once), and returns its channel id, the largest there is plus one.

        Raises:
            DataError: the topic is defined already, or no id is left.
        """
        if any(channel.topic == topic for channel in self.contents.channels.values()):
            raise DataError(f"two channels would be written to {topic}", expected="one topic each")
        described = {"offered_qos_profiles": QOS, "topic_type_hash": schema.TYPE_HASHES[schema_name]}
        record = Channel(
            id=_next(self.contents.channels, "channel"),
            topic=topic,
            message_encoding="cdr",
            metadata=described | dict(metadata or {}),
            schema_id=self._schema(schema_name),
        )
        self.contents.channels[record.id] = record
        self.target.write(records.build(record))
        return record.id

    def _schema(self, schema_name: str) -> int:
        """The id of a schema: that of one with the same definition (comments aside), or a new one."""
        text = schema.definition(schema_name)
        for known in self.contents.schemas.values():
            if known.name == schema_name and known.encoding == "ros2msg" and _bare(known.data) == _bare(text.encode()):
                self._write_schema(known)  # once more: so far it may stand in a later chunk only
                return int(known.id)
        record = Schema(id=_next(self.contents.schemas, "schema"), name=schema_name, encoding="ros2msg", data=text.encode())
        self.contents.schemas[record.id] = record
        self._write_schema(record)
        return record.id

    def _write_schema(self, record: Schema) -> None:
        if record.id not in self.written:
            self.written.add(record.id)
            self.target.write(records.build(record))

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Writes a metadata record."""
        raw = records.build(Metadata(name=name, metadata=dict(values)))
        self.contents.metadata.append(MetadataIndex(offset=self.target.position, length=len(raw), name=name))
        self.target.write(raw)

    def chunk(self, chunk: Chunk, compression: str | None = None) -> None:
        """Writes messages as one chunk, with their message indexes."""
        name = self.compression if compression is None else records.COMPRESSIONS.get(compression, compression)
        packed = records.pack(name)(chunk.data)
        start_ns, end_ns = chunk.start_ns, int(chunk.times.max())
        head = records.chunk_head(chunk.data, packed, name, start_ns, end_ns)
        offset = self.target.position
        self.target.write(head)
        self.target.write(packed)
        self.index(
            ChunkIndex(
                chunk_length=len(head) + len(packed),
                chunk_start_offset=offset,
                compression=name,
                compressed_size=len(packed),
                message_end_time=end_ns,
                message_index_length=0,
                message_index_offsets={},
                message_start_time=start_ns,
                uncompressed_size=len(chunk.data),
            ),
            chunk.channels,
            chunk.times,
            chunk.offsets,
        )

    def index(
        self,
        entry: ChunkIndex,
        channels: UInt16[np.ndarray, " n"],
        times: Int64[np.ndarray, " n"],
        offsets: Int64[np.ndarray, " n"],
    ) -> None:
        """Writes the message indexes of the chunk just written, and enters it in the summary."""
        first, counts = self.target.position, {}
        for channel in np.unique(channels).tolist():
            mask = channels == channel
            counts[channel] = int(mask.sum())
            entry.message_index_offsets[channel] = self.target.position
            self.target.write(records.message_index(channel, times[mask], offsets[mask]))
        entry.message_index_length = self.target.position - first
        self.contents.chunks.append(entry)
        if counts:
            self.contents.add(counts, int(times.min()), int(times.max()))

    def finish(self) -> None:
        """Ends the data section and writes the summary; the file is then complete under its temporary name."""
        if self.finished:
            return
        self.finished = True
        self.target.write(records.build(DataEnd(data_section_crc=self.target.crc)))
        start, offsets = self.target.position, b""
        self.target.summing, self.target.crc = True, 0  # from here on it is the summary's
        for opcode, raw in self.contents.groups():
            if raw:
                at = self.target.position
                offsets += records.build(SummaryOffset(group_opcode=opcode, group_start=at, group_length=len(raw)))
            self.target.write(raw)
        footer = Footer(summary_start=start, summary_offset_start=self.target.position, summary_crc=0)
        self.target.write(offsets)
        self.target.write(records.build(footer)[: FOOTER_SIZE - 4])
        footer.summary_crc = self.target.crc
        self.target.write(records.build(footer)[-4:] + MAGIC)
        self.target.flush()


def _next(taken: Mapping[int, object], what: str) -> int:
    """The largest id plus one, which keeps all ids there are."""
    largest = max(taken, default=0)
    if largest >= LARGEST_ID:
        raise DataError(f"a {what} has the id {largest}", expected=f"less than {LARGEST_ID}, so that one more has room")
    return largest + 1


def _bare(definition: bytes) -> list[bytes]:
    """A message definition without comments, blank lines and spacing."""
    lines = (b" ".join(line.partition(b"#")[0].split()) for line in definition.splitlines())
    return [line for line in lines if line]


# ── a Recording as a log ─────────────────────────────────────────────────────────────────────────────────────────────


class Series(NamedTuple):
    """A topic whose messages are made from slices of its columns when their chunk is due."""

    channel: int
    t_ns: Int64[np.ndarray, " n"]
    columns: tuple[Shaped[np.ndarray, " n *k"], ...]
    encode: Callable[..., UInt8[np.ndarray, "n L"]]

    def records(self, part: slice) -> UInt8[np.ndarray, "n M"]:
        """Message records of some rows; their sequence is the row."""
        payload = self.encode(*(column[part] for column in self.columns))
        times = self.t_ns[part]
        sequence = np.arange(part.start, part.stop, dtype=np.uint32)
        return records.message_rows(self.channel, times, times, sequence, payload)


def write(recording: Recording, path: Place, *, compression: str = "zstd", overwrite: bool = False) -> None:
    """Writes a recording as a log, which `read` gives back bit for bit. Log time, publish time and stamp are one.

    Raises:
        ConfigError: the target exists (without `overwrite`) or cannot be written, or an unknown compression.
        DataError: two topics of one name, or times ROS 2 cannot store (before 1970, or seconds beyond 32 bits).
    """
    with LogWriter(path, compression=compression, overwrite=overwrite) as log:
        _write_metadata(log, recording)
        groups = [_imu(log, recording), _poses(log, recording), _scalars(log, recording)]
        streams: list[Iterator[tuple[Chunk, str | None]]] = [((chunk, None) for chunk in chunks(g)) for g in groups]
        streams += [_images(log, topic, frames) for topic, frames in recording.frames.items()]
        for chunk, packing in heapq.merge(*streams, key=lambda item: item[0].start_ns):
            log.chunk(chunk, packing)


def _write_metadata(log: LogWriter, recording: Recording) -> None:
    """The record `imutool` first, with the recording's own entries of that name laid under it and kept apart."""
    given = recording.metadata.get(RECORD)
    shadowed = None if given is None else {k: v for k, v in given.items() if k in OWN_KEYS}
    own = {
        "writer": f"imutool {imutool.__version__}",
        "name": recording.name,
        "source": recording.source,
        "imu_topic": recording.imu_topic,
        SHADOWED_KEY: json.dumps(shadowed),
    }
    log.metadata(RECORD, own | {k: v for k, v in (given or {}).items() if k not in own})
    for name, values in recording.metadata.items():
        if name != RECORD:
            log.metadata(name, values)


def _imu(log: LogWriter, recording: Recording) -> list[Series]:
    imu = recording.imu
    channel = log.channel(recording.imu_topic, schema.IMU)
    return [Series(channel, imu.t_ns, (imu.t_ns, imu.gyro, imu.accel), partial(schema.encode_imu, frame_id=BODY))]


def _poses(log: LogWriter, recording: Recording) -> list[Series]:
    """Every truth as PoseStamped, its velocity beside it, and the first also on /tf for the 3D views."""
    found: list[Series] = []
    for which, (topic, poses) in enumerate(recording.truths.items()):
        t_ns, columns = poses.t_ns, (poses.t_ns, poses.p_wb, poses.q_wb_wxyz)
        channel = log.channel(topic, schema.POSE)
        found.append(Series(channel, t_ns, columns, partial(schema.encode_pose, frame_id=WORLD)))
        if which == 0:
            encode = partial(schema.encode_transform, frame_id=WORLD, child_frame_id=BODY)
            found.append(Series(log.channel("/tf", schema.TF), t_ns, columns, encode))
        if poses.v_w is not None:
            velocity = f"{topic.removesuffix('/pose')}/velocity"
            channel = log.channel(velocity, schema.VECTOR3, {VELOCITY_KEY: topic, UNIT_KEY: "m/s"})
            found.append(Series(channel, t_ns, (t_ns, poses.v_w), partial(schema.encode_vector3, frame_id=WORLD)))
    return found


def _scalars(log: LogWriter, recording: Recording) -> list[Series]:
    found: list[Series] = []
    for topic, scalars in recording.scalars.items():
        t_ns, values, unit = scalars.t_ns, scalars.values, {UNIT_KEY: scalars.unit}
        if values.shape[1] == 1:
            channel = log.channel(topic, schema.FLOAT, unit)
            found.append(Series(channel, t_ns, (values[:, 0],), schema.encode_float))
        else:
            channel = log.channel(topic, schema.VECTOR3, unit)
            found.append(Series(channel, t_ns, (t_ns, values), partial(schema.encode_vector3, frame_id="")))
    return found


def chunks(group: Sequence[Series]) -> Iterator[Chunk]:
    """The messages of some topics in log-time order, cut into chunks.

    Raises:
        DataError: a time before 1970, which a log cannot hold.
    """
    if not group:
        return
    times = np.concatenate([series.t_ns for series in group])
    if len(times) and times.min() < 0:
        raise DataError(f"a message has the time {times.min()} ns", expected="no time before 1970")
    which = np.repeat(np.arange(len(group)), [len(series.t_ns) for series in group])
    order = np.argsort(times, kind="stable")
    times, which = times[order], which[order]
    widths = np.array([series.records(slice(0, 0)).shape[1] for series in group], np.int64)
    ends = np.cumsum(widths[which])
    starts = ends - widths[which]
    cuts = np.flatnonzero(np.diff(starts // CHUNK_BYTES)) + 1
    done = [0] * len(group)
    for first, last in pairwise([0, *cuts.tolist(), len(times)] if len(times) else []):
        offsets = starts[first:last] - starts[first]
        data = np.empty(int(ends[last - 1] - starts[first]), np.uint8)
        for index, series in enumerate(group):
            mine = offsets[which[first:last] == index]
            if len(mine):
                rows = series.records(slice(done[index], done[index] + len(mine)))
                records.scatter(data, mine, rows)
                done[index] += len(mine)
        channels = np.array([series.channel for series in group], np.uint16)[which[first:last]]
        yield Chunk(data.tobytes(), channels, times[first:last], offsets)


def _images(log: LogWriter, topic: str, frames: Frames) -> Iterator[tuple[Chunk, str | None]]:
    """The chunks of one camera; its channel is defined at once, its images are fetched when their chunk is due."""
    channel = log.channel(topic, schema.IMAGE)
    packing = "none" if frames.format.lower() in PACKED_IMAGES else None
    return ((chunk, packing) for chunk in _image_chunks(channel, topic, frames))


def _image_chunks(channel: int, topic: str, frames: Frames) -> Iterator[Chunk]:
    frame_id = topic.strip("/").split("/")[0]
    parts: list[bytes] = []
    times: list[int] = []
    offsets: list[int] = []
    size = 0
    for sequence, (t_ns, image) in enumerate(frames.each()):
        if t_ns < 0:
            raise DataError(f"an image of {topic} has the time {t_ns} ns", expected="no time before 1970")
        payload = schema.encode_image(t_ns, image, frame_id, frames.format)
        parts.append(records.message_record(channel, sequence, t_ns, payload))
        times.append(t_ns)
        offsets.append(size)
        size += len(parts[-1])
        if size >= CHUNK_BYTES:
            yield _chunk_of(channel, parts, times, offsets)
            parts, times, offsets, size = [], [], [], 0
    if parts:
        yield _chunk_of(channel, parts, times, offsets)


def _chunk_of(channel: int, parts: list[bytes], times: list[int], offsets: list[int]) -> Chunk:
    channels = np.full(len(parts), channel, np.uint16)
    return Chunk(b"".join(parts), channels, np.array(times, np.int64), np.array(offsets, np.int64))
