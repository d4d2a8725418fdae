"""A log with channels added to it: every record of the source passes through as the bytes it is.

One pass, one chunk in memory. A chunk is unpacked only to be checked and to have its IMU messages read; what is written
is the source's own bytes. Only what must change is made anew: the summary, and message indexes where the source has
none or wrong ones. Messages outside chunks keep their bytes too and are wrapped into chunks, because a reader that goes
by chunk indexes would otherwise not find them beside the new ones.
"""

from __future__ import annotations

import hashlib
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int64, UInt8, UInt16
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, ChunkIndex, DataEnd, Metadata, MetadataIndex

from imutool.errors import ConfigError, LogError
from imutool.mcap_io import records, schema
from imutool.mcap_io.log import DERIVED_KEY, ImuBatch, Log
from imutool.mcap_io.records import HEAD
from imutool.mcap_io.structure import Block, Span, Structure
from imutool.mcap_io.write import CHUNK_BYTES, Chunk, LogWriter
from imutool.place import Place, failures, opened, reason, same

COPY_BYTES = 1 << 20
DEFINITIONS = (Opcode.SCHEMA, Opcode.CHANNEL)


class NewTopic(NamedTuple):
    """A topic to be added, and its message."""

    name: str
    schema_name: str


class Made(NamedTuple):
    """Messages computed from a batch: times and sequence of the source messages that have one, a payload row for each."""

    batch: ImuBatch
    payloads: Sequence[UInt8[np.ndarray, "n L"]]


@runtime_checkable
class Derived(Protocol):
    """Channels computed from one IMU topic of the source, which is fed in file order."""

    @property
    def source_topic(self) -> str:
        """The IMU topic."""

    @property
    def topics(self) -> Sequence[NewTopic]:
        """The topics to be added."""

    def __call__(self, batch: ImuBatch) -> Made:
        """What to write for a batch: which of its messages stay, and one array of CDR payloads per new topic."""


@dataclass(frozen=True)
class RewriteReport:
    """What a rewritten log holds."""

    copied: int  # messages of the source
    added: Mapping[str, int]  # messages per new topic
    chunks: int
    source_bytes: int
    target_bytes: int


def rewrite(
    source: Place,
    target: Place,
    derived: Sequence[Derived],
    *,
    metadata: Mapping[str, Mapping[str, str]],
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> RewriteReport:
    """Writes `target`: all of `source`, the derived channels in chunks of their own, and the metadata records.

    A derived message has log time, publish time and sequence of the message it comes from. A metadata record of
    a name that the source has already stands beside it. The finished file is read back, every chunk
    checked and every message counted, before it takes its place. `progress` is told the bytes done and those there are,
    counting the source twice: once to copy, once to check.

    Raises:
        ConfigError: source or target cannot be opened, the target exists or is the source.
        LogError: the source is damaged, lacks a source topic, has a new topic already, or holds IMU messages that no
            recording could: NaN, or stamps that do not increase.
    """
    if same(source, target):
        raise ConfigError("the target is the source", where=target, fix="Choose another name")
    tell = progress or (lambda done, total: None)
    with Log(source) as log:
        _refuse_taken(log, derived)
        structure = log.structure
        start = len(records.MAGIC)
        header = structure.source.at(start, structure.header_end - start)
        with LogWriter(target, compression=_compression(structure), overwrite=overwrite, header=header) as out:
            copy = _Copy(log, out, derived)
            size = structure.source.size
            with log.named():
                copy.run(lambda done: tell(done, 2 * size))
            for name, values in metadata.items():
                out.metadata(name, values)
            out.finish()
            verify(out.target.temporary, out.contents.counts, lambda done, total: tell(size + size * done // total, 2 * size))
            tell(2 * size, 2 * size)
            added = {t.name: out.contents.counts[i] for s in copy.streams for t, i in zip(s.make.topics, s.ids, strict=True)}
            return RewriteReport(
                out.contents.counts.total() - sum(added.values()),
                added,
                len(out.contents.chunks),
                size,
                out.target.position,
            )


def sha256(path: Place) -> str:
    """The SHA-256 of a file, in hex, a block at a time.

    Raises:
        ConfigError: the file cannot be read.
    """
    try:
        with opened(path).file as file:
            return hashlib.file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]  # readinto: all that `opened` gives
    except failures(path) as error:
        raise ConfigError(f"cannot be read ({reason(error)})", where=path) from error


def verify(path: Place, counts: Mapping[int, int], progress: Callable[[int, int], None] | None = None) -> None:
    """Reads a whole log: the CRC of every chunk and of the data section, and the messages per channel id.

    Raises:
        LogError: something is not as it was written.
    """
    with Log(path) as log, log.named():
        structure, found, crc, position = log.structure, Counter[int](), 0, 0
        for item in structure.items:
            crc, position = _crc(structure, position, item.offset, crc), item.offset
            end = item.end if isinstance(item, Block) else item.offset + item.length
            if isinstance(item, Block):
                raw = structure.source.at(item.offset, item.length)
                crc, position = zlib.crc32(raw, crc), item.offset + item.length
                found.update(structure.unpacked(item, raw).heads["channel"].tolist())
            crc, position = _crc(structure, position, end, crc), end
            if progress:
                progress(position, structure.source.size)
        if found != Counter(counts):
            raise LogError(f"the copy has {found.total()} messages", expected=str(sum(counts.values())))
        _check_data_crc(structure, _crc(structure, position, structure.data_end, crc))


def _crc(structure: Structure, start: int, end: int, crc: int) -> int:
    for at in range(start, end, COPY_BYTES):
        crc = zlib.crc32(structure.source.at(at, min(COPY_BYTES, end - at)), crc)
    return crc


def _stated_crc(structure: Structure) -> int:
    """The CRC of the data section that the log states; 0 where it states none."""
    opcode, length = structure.source.head(structure.data_end)
    if opcode != Opcode.DATA_END:
        return 0
    body = structure.source.at(structure.data_end + HEAD.size, length)
    return int(records.parse(DataEnd, body, structure.data_end).data_section_crc)


def _check_data_crc(structure: Structure, crc: int) -> None:
    stated = _stated_crc(structure)
    if stated and stated != crc:
        raise LogError(f"the data section has CRC {crc:08x}", expected=f"{stated:08x}")


def _refuse_taken(log: Log, derived: Sequence[Derived]) -> None:
    for make in derived:
        log.topic(make.source_topic, (schema.IMU,))
        for new in make.topics:
            if new.name in log.topics:
                raise LogError(
                    f"{new.name} is in this log already",
                    where=log.path,
                    expected="a log without it",
                    fix="Choose another IMU with --imu, or start from the original log",
                )


def _compression(structure: Structure) -> str:
    """New chunks are packed as the source's first chunk is; a log without chunks gets them unpacked."""
    return next((b.compression for b in structure.blocks if b.compression is not None), "none")


@dataclass
class _Stream:
    """One `Derived`, the ids of its channels, and what waits to be written."""

    make: Derived
    sources: set[int]
    ids: list[int]
    data: list[bytes] = field(default_factory=list)
    channels: list[UInt16[np.ndarray, " n"]] = field(default_factory=list)
    times: list[Int64[np.ndarray, " n"]] = field(default_factory=list)
    offsets: list[Int64[np.ndarray, " n"]] = field(default_factory=list)
    size: int = 0

    def take(self, batch: ImuBatch) -> None:
        """Computes the new messages of a batch; those of one source message stand side by side."""
        batch, payloads = self.make(batch)
        assert len(payloads) == len(self.ids), f"{len(payloads)} arrays for {len(self.ids)} topics"
        parts = [
            records.message_rows(i, batch.log_time, batch.publish_time, batch.sequence, payload)
            for i, payload in zip(self.ids, payloads, strict=True)
        ]
        widths = [part.shape[1] for part in parts]
        count, stride = len(batch.log_time), sum(widths)
        begins = np.cumsum([0, *widths[:-1]])
        self.data.append(np.concatenate(parts, axis=1).tobytes())
        self.channels.append(np.tile(np.array(self.ids, np.uint16), count))
        self.times.append(np.repeat(batch.log_time, len(parts)))
        self.offsets.append((self.size + stride * np.arange(count)[:, None] + begins).reshape(-1))
        self.size += count * stride

    def flush(self, out: LogWriter) -> None:
        """Writes what waits as one chunk."""
        if self.size:
            times, offsets = np.concatenate(self.times), np.concatenate(self.offsets)
            out.chunk(Chunk(b"".join(self.data), np.concatenate(self.channels), times, offsets))
            for column in (self.data, self.channels, self.times, self.offsets):
                column.clear()
            self.size = 0


class _Copy:
    """The pass over the source."""

    def __init__(self, log: Log, out: LogWriter, derived: Sequence[Derived]) -> None:
        self.log, self.structure, self.out = log, log.structure, out
        out.contents.schemas.update(sorted(self.structure.schemas.items()))
        out.contents.channels.update(sorted(self.structure.channels.items()))
        self.streams = [
            _Stream(
                make,
                log.channel_ids(make.source_topic),
                [out.channel(t.name, t.schema_name, {DERIVED_KEY: make.source_topic}) for t in make.topics],
            )
            for make in derived
        ]

    def run(self, tell: Callable[[int], None]) -> None:
        """Copies item by item, and writes the new chunks between them.

        Raises:
            LogError: the source is damaged.
        """
        crc, position = 0, 0
        stated = _stated_crc(self.structure)
        for item in self.structure.items:
            self._item(item)
            end = item.end if isinstance(item, Block) else item.offset + item.length
            if stated:  # most writers leave it out, and reading everything once more would be for nothing
                crc = _crc(self.structure, position, end, crc)
            position = end
            for stream in self.streams:
                if stream.size >= CHUNK_BYTES:
                    stream.flush(self.out)
            tell(position)
        for stream in self.streams:
            stream.flush(self.out)
        if stated:
            _check_data_crc(self.structure, _crc(self.structure, position, self.structure.data_end, crc))

    def _item(self, item: Block | Span) -> None:
        if isinstance(item, Block):
            self._block(item)
        else:
            self._span(item)

    def _block(self, block: Block) -> None:
        raw = self.structure.source.at(block.offset, block.length)
        found = self.structure.unpacked(block, raw)
        for opcode, first, length in found.definitions:
            self._define(opcode, found.data[first : first + length].tobytes(), block.offset)
        self._feed(found)
        if block.compression is None:
            self.out.chunk(Chunk(raw, found.heads["channel"], found.times(), found.offsets), "none")
        else:
            self._chunk(block, raw, found)

    def _define(self, opcode: int, body: bytes, offset: int) -> None:
        """A definition inside a chunk, which the summary may have left out; one under a new channel's id is refused."""
        structure, contents = self.structure, self.out.contents
        schemas, channels = set(structure.schemas), set(structure.channels)
        structure.define(opcode, body, offset)
        new_schemas, new_channels = structure.schemas.keys() - schemas, structure.channels.keys() - channels
        if new_schemas & contents.schemas.keys() or new_channels & contents.channels.keys():
            raise LogError(f"the chunk at byte {offset} defines an id that the rest of the log does not mention")
        contents.schemas.update({i: structure.schemas[i] for i in new_schemas})
        contents.channels.update({i: structure.channels[i] for i in new_channels})

    def _feed(self, found: records.Messages) -> None:
        for stream in self.streams:
            mask = np.isin(found.heads["channel"], list(stream.sources))
            for rows in records.rows(found, mask):
                with self.log.named(stream.make.source_topic):
                    for batch in self.log.decode_imu(stream.make.source_topic, rows):
                        stream.take(batch)

    def _chunk(self, block: Block, raw: bytes, found: records.Messages) -> None:
        """The chunk's own bytes, then its own message indexes; these are built where they do not match the messages."""
        head, offset = records.ChunkHead.of(raw[:128], len(raw), block.offset), self.out.target.position
        self.out.target.write(raw)
        times, channels = found.times(), found.heads["channel"].copy()
        first, last = (int(times.min()), int(times.max())) if len(times) else (head.start_ns, head.end_ns)
        entry = ChunkIndex(
            chunk_length=len(raw),
            chunk_start_offset=offset,
            compression=head.compression,
            compressed_size=len(raw) - head.data_at,
            message_end_time=last,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=first,
            uncompressed_size=head.size,
        )
        if not self._indexes_match(block, found):
            self.out.index(entry, channels, times, found.offsets)
            return
        start = block.offset + block.length
        entry.message_index_offsets = {c: self.out.target.position + at - start for c, at in block.indexes.items()}
        entry.message_index_length = block.end - start
        self.out.target.write(self.structure.source.at(start, block.end - start))
        self.out.contents.chunks.append(entry)
        if len(times):
            self.out.contents.add(Counter(channels.tolist()), first, last)

    def _indexes_match(self, block: Block, found: records.Messages) -> bool:
        """Whether the source's message indexes list exactly the messages of the chunk."""
        if not block.indexes:
            return False
        tables = [
            np.column_stack([np.full(len(t), c, np.uint64), t])
            for c, t in ((c, self.structure.index(block, c)) for c in block.indexes)
        ]
        listed = np.concatenate(tables)
        actual = np.column_stack(
            [found.heads["channel"].astype(np.uint64), found.heads["log_time"], found.offsets.astype(np.uint64)]
        )
        return listed.shape == actual.shape and bool((listed[np.argsort(listed[:, 2])] == actual).all())

    def _span(self, span: Span) -> None:
        """Any other record, as it is; attachments and metadata are entered in the summary."""
        if span.opcode == Opcode.MESSAGE_INDEX:  # of no chunk: it can only mislead
            return
        at = self.out.target.position
        if span.opcode == Opcode.METADATA:
            body = self.structure.source.at(span.offset + HEAD.size, span.length - HEAD.size)
            name = records.parse(Metadata, body, span.offset).name
            self.out.contents.metadata.append(MetadataIndex(offset=at, length=span.length, name=name))
        elif span.opcode == Opcode.ATTACHMENT:
            self.out.contents.attachments.append(self._attachment(span, at))
        for start in range(span.offset, span.offset + span.length, COPY_BYTES):
            self.out.target.write(self.structure.source.at(start, min(COPY_BYTES, span.offset + span.length - start)))

    def _attachment(self, span: Span, offset: int) -> AttachmentIndex:
        """The index entry of an attachment, without reading its data."""
        at, end = span.offset + HEAD.size, span.offset + span.length

        def field(size: int) -> bytes:
            nonlocal at
            if size > end - at:
                raise LogError(f"the attachment at byte {span.offset} is damaged: its lengths contradict one another")
            at += size
            return self.structure.source.at(at - size, size)

        def text() -> str:
            return field(struct.unpack("<I", field(4))[0]).decode(errors="replace")

        log_time, create_time = struct.unpack("<QQ", field(16))
        name, media_type = text(), text()
        (size,) = struct.unpack("<Q", field(8))
        if size + 4 != end - at:
            raise LogError(f"the attachment at byte {span.offset} is damaged: its data have {size} bytes")
        return AttachmentIndex(
            offset=offset,
            length=span.length,
            log_time=log_time,
            create_time=create_time,
            data_size=size,
            name=name,
            media_type=media_type,
        )
