"""Write a log: definitions first, then chunks, and a summary that indexes everything."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import NamedTuple

import numpy as np
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
from imutool.array_types import Int64, UInt16
from imutool.errors import DataError
from imutool.file_location import Location
from imutool.mcap_io.blocks import Attachment
from imutool.mcap_io.codec import messages, records
from imutool.mcap_io.codec import schemas as schema
from imutool.mcap_io.codec.records import FOOTER_SIZE, HEAD, MAGIC
from imutool.mcap_io.storage.source import Source
from imutool.mcap_io.storage.target import Target
from imutool.recording.message_log import MessageTopic

LARGEST_ID = 2**16 - 1  # of a channel or a schema

_FOREVER = "{sec: 9223372036, nsec: 854775807}"
QOS = (
    "- history: keep_last\n  depth: 10\n  reliability: reliable\n  durability: volatile\n"
    f"  deadline: {_FOREVER}\n  lifespan: {_FOREVER}\n  liveliness: automatic\n"
    f"  liveliness_lease_duration: {_FOREVER}\n  avoid_ros_namespace_conventions: false\n"
)


class Chunk(NamedTuple):
    """Message records in log-time order, with the columns of their index."""

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
    """Contents of a summary, collected while the data section is written."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: records.ChunkIndexes = field(default_factory=records.ChunkIndexes)
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
        """Bytes of the summary section, its records grouped by opcode."""
        yield Opcode.SCHEMA, _built(self.schemas.values())
        yield Opcode.CHANNEL, _built(self.channels.values())
        yield Opcode.STATISTICS, _built([self.statistics()])
        yield Opcode.CHUNK_INDEX, self.chunks.raw
        yield Opcode.ATTACHMENT_INDEX, _built(self.attachments)
        yield Opcode.METADATA_INDEX, _built(self.metadata)


def _built(group: Iterable[McapRecord]) -> bytes:
    return b"".join(records.build(record) for record in group)


class LogWriter:
    """A log being written, as a context manager: complete on leaving, or gone after an error.

    Without `data_crc` the log states no CRC of its data section, and bytes may pass into it that nobody has looked at.

    Raises:
        ConfigError: the target exists (without `overwrite`) or cannot be written, or an unknown compression.
    """

    def __init__(
        self,
        path: Location,
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
        """Defines a topic and its schema; returns its channel id, the largest plus one.

        Raises:
            DataError: the topic is defined already, or no id is left.
        """
        if any(channel.topic == topic for channel in self.contents.channels.values()):
            raise DataError(f"two channels would be written to {topic}", expected="one topic each")
        described = {"offered_qos_profiles": QOS, "topic_type_hash": schema.TYPE_HASHES[schema_name]}
        return self._channel(topic, "cdr", described | dict(metadata or {}), self._schema(schema_name))

    def define(self, topic: MessageTopic) -> int:
        """Defines a topic with the schema and encoding of its source; returns its channel id.

        Raises:
            DataError: no id is left.
        """
        return self._channel(topic.name, topic.message_encoding, _described(topic), self._schema_of(topic))

    def _channel(self, topic: str, encoding: str, metadata: dict[str, str], schema_id: int) -> int:
        number = free_id(self.contents.channels, "channel")
        record = Channel(id=number, topic=topic, message_encoding=encoding, metadata=metadata, schema_id=schema_id)
        self.contents.channels[number] = record
        self.target.write(records.build(record))
        return number

    def _schema_of(self, topic: MessageTopic) -> int:
        """Id of a topic's schema; 0 where the source has none. A type known here may come without its definition."""
        if not topic.schema_name:
            return 0
        if topic.schema_name in schema.TYPE_HASHES and not topic.schema:
            return self._schema(topic.schema_name)
        for known in self.contents.schemas.values():
            if (known.name, known.encoding, known.data) == (topic.schema_name, topic.schema_encoding, topic.schema):
                return int(known.id)
        return self._new_schema(topic.schema_name, topic.schema_encoding, topic.schema)

    def _schema(self, schema_name: str) -> int:
        """Id of a schema with the same definition (comments aside), or of a new one."""
        text = schema.definition(schema_name).encode()
        for known in self.contents.schemas.values():
            if known.name == schema_name and known.encoding == "ros2msg" and _bare(known.data) == _bare(text):
                self._write_schema(known)  # once more: so far it may stand in a later chunk only
                return int(known.id)
        return self._new_schema(schema_name, "ros2msg", text)

    def _new_schema(self, name: str, encoding: str, data: bytes) -> int:
        record = Schema(id=free_id(self.contents.schemas, "schema"), name=name, encoding=encoding, data=data)
        self.contents.schemas[record.id] = record
        self._write_schema(record)
        return record.id

    def _write_schema(self, record: Schema) -> None:
        if record.id not in self.written:
            self.written.add(record.id)
            self.target.write(records.build(record))

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Writes a metadata record; bytes of a file name that are no UTF-8 are written as escapes."""
        texts = {key: value.encode("utf-8", "backslashreplace").decode() for key, value in values.items()}
        raw = records.build(Metadata(name=name, metadata=texts))
        self.contents.metadata.append(MetadataIndex(offset=self.target.position, length=len(raw), name=name))
        self.target.write(raw)

    def attachment(self, source: Source, offset: int, length: int) -> None:
        """Copies an attachment's record from another log; LogError of a damaged one."""
        found = Attachment.of(source, offset, length - HEAD.size)
        found.check_crc(source)
        self.contents.attachments.append(found.index_at(self.target.position))
        self.target.copy(source, offset, offset + length)

    def chunk(self, chunk: Chunk, compression: str | None = None) -> None:
        """Writes messages as one chunk, with their message indexes."""
        name = self.compression if compression is None else records.COMPRESSIONS.get(compression, compression)
        packed = records.pack(name)(chunk.data)
        start_ns, end_ns = chunk.start_ns, int(chunk.times.max())
        head = records.chunk_head(chunk.data, packed, name, start_ns, end_ns)
        offset = self.target.position
        self.target.write(head + packed)
        entry = records.ChunkHead.of(head, len(head) + len(packed), offset).index_at(offset, len(head) + len(packed))
        self.write_indexes(entry, chunk.channels, chunk.times, chunk.offsets)

    def write_indexes(
        self,
        entry: ChunkIndex,
        channels: UInt16[np.ndarray, " n"],
        times: Int64[np.ndarray, " n"],
        offsets: Int64[np.ndarray, " n"],
    ) -> None:
        """Writes the message indexes of the chunk just written, and enters it in the summary."""
        first, counts = self.target.position, dict[int, int]()
        for channel in (ids := np.flatnonzero(np.bincount(channels)).tolist() if len(channels) > 1 else channels.tolist()):
            of_channel = channels == channel if len(ids) > 1 else slice(None)
            index = messages.message_index(channel, times[of_channel], offsets[of_channel])
            counts[channel] = (len(index) - messages.SINGLE_INDEX.size) // 16 + 1
            entry.message_index_offsets[channel] = self.target.position
            self.target.write(index)
        entry.message_index_length = self.target.position - first
        self.contents.chunks.append(entry)
        if counts:
            self.contents.add(counts, *messages.span(times))

    def finish(self) -> None:
        """Ends the data section and writes the summary under the temporary name."""
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


def _described(topic: MessageTopic) -> dict[str, str]:
    """Channel metadata of a topic, with the quality of service that ROS 2 asks for."""
    metadata = dict(topic.metadata)
    qos = QOS.replace("volatile", "transient_local") if metadata.get("latching") == "1" else QOS
    return {"offered_qos_profiles": qos} | metadata if topic.message_encoding == "cdr" else metadata


def free_id(taken: Mapping[int, object], what: str) -> int:
    """The largest id of a channel or schema plus one, or else the smallest free one."""
    if (largest := max(taken, default=0)) < LARGEST_ID:
        return largest + 1
    if free := next((i for i in range(1, LARGEST_ID) if i not in taken), 0):
        return free
    raise DataError(f"the log has {len(taken)} {what}s", expected="an id that is free")


def _bare(definition: bytes) -> list[bytes]:
    """A message definition without comments, blank lines and spacing."""
    return [line for text in definition.splitlines() if (line := b" ".join(text.partition(b"#")[0].split()))]
