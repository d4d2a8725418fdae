"""Copy a log byte for byte and add topics to it, in one pass with one chunk in memory.

A chunk without IMU messages is copied from file to file (`target.Target.copy`), and its message indexes say what to enter in
the summary. A chunk that holds messages of a source IMU, or that its indexes do not describe, is unpacked and checked, once:
those that were checked before the copy began (`Log.keep`) are only copied. Only the summary is new, and message indexes where
the source has none or wrong ones. Messages outside chunks keep their bytes and are wrapped into chunks, because a reader that
goes by chunk indexes would otherwise not find them next to the new ones.

Where the source states the CRC of its data section, it is checked and the copy states one, for which every byte passes through
memory (1.3 instead of 1.2 of the CPU time of `cp`, `pass` in `tests/bench/rewrite.py`). Where the source states none, as most
recorders do, the copy states none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import MetadataIndex

from imutool.errors import ConfigError, LogError
from imutool.file_location import Location, identity, same_location
from imutool.mcap_io import Verified
from imutool.mcap_io.blocks import Attachment, MessageBlock, MessageIndexes, RecordSpan, read_message_indexes
from imutool.mcap_io.codec.messages import Messages
from imutool.mcap_io.codec.records import HEAD, ChunkHead
from imutool.mcap_io.file_writer import Chunk, LogWriter
from imutool.mcap_io.log import Log
from imutool.mcap_io.passthrough.added_topics import DerivedStream, DerivedTopics, check_new_topics, define
from imutool.mcap_io.passthrough.chunk_check import check_chunk, parts_of
from imutool.mcap_io.storage.target import PassThrough
from imutool.mcap_io.verify import check_data_crc, check_mode, stated_crc, verify
from imutool.mcap_io.write import CHUNK_BYTES
from imutool.processes.system import give
from imutool.report import Progress, silent

REPAIR = "imutool repair sets them right"
RUN_BYTES = 16 << 20  # of the source are copied at once; progress is reported between
Values = Mapping[str, Mapping[str, str]]  # the entries of metadata records, by the records' names


@dataclass(frozen=True)
class RewriteReport:
    """Messages, chunks and bytes of a rewritten log, and what of it was checked."""

    copied: int  # messages of the source
    added: Mapping[str, int]  # messages per new topic
    chunks: int
    unchecked: int  # messages of the source that no CRC covers
    source_bytes: int
    target_bytes: int
    verified: Verified


def rewrite(
    source: Location | Log,
    target: Location | None,
    derived: Sequence[DerivedTopics],
    *,
    metadata: Values | Callable[[Verified], Values],
    overwrite: bool = False,
    check: str = "imu",
    own_encoding: bool = False,
    progress: Progress = silent,
) -> RewriteReport:
    """Writes all of `source` to `target`, with derived topics and metadata records.

    Derived messages are in chunks of their own; with `own_encoding` in their source's encoding (`added_topics.define`).

    A derived message has log time, publish time and sequence of its source message. Where the source has a metadata record of
    the same name, both stand in the target; a function as `metadata` is called when all else is written.

    The finished file is read back before it takes its place; its structure is always checked (`mcap_io.verify`). Chunks with
    IMU messages are checked while they are copied. With `check` "imu" the new chunks are checked in the finished file, with
    "all" every chunk, attachment and the CRC of the data section, with "none" nothing more.

    Without a target the log takes the place of the source, with its permissions, through the same temporary file; a
    symbolic link is followed and stays one, another name (hard link) of the file keeps the old log.

    `progress` gets the bytes done and in total, which counts the source twice: once to copy, once to check. A source that is
    an open log stays open, with an empty index: what grows with a log is freed before the target is checked.

    Raises:
        ConfigError: source or target cannot be opened, the target exists or is the source, or an unknown `check`.
        LogError: the source is damaged, lacks a source topic, has a new topic already, changed meanwhile, or holds IMU
            messages that no model can take.
    """
    check_mode(check)
    path = source.path if isinstance(source, Log) else source
    if target is not None and same_location(path, target):
        raise ConfigError("the target is the source", where=target, fix="Choose another name")
    place = (path.resolve() if isinstance(path, Path) else path) if target is None else target
    with nullcontext(source) if isinstance(source, Log) else Log(source) as log:
        check_new_topics(log, {topics.source_topic: topics.topics for topics in derived})
        packing = next((block.compression for block in log.index.blocks if block.compression is not None), "none")
        crc, header, replace = bool(stated_crc(log.index)), log.index.header_bytes, overwrite or target is None
        with LogWriter(place, compression=packing, overwrite=replace, header=header, data_crc=crc) as out:
            report = _Rewrite(log, out, derived, check, own_encoding, progress).run(metadata)
            if target is None and isinstance(path, Path) and isinstance(out.target.temporary, Path):
                _copy_permissions(path, out.target.temporary)
            if identity(path) != log.index.source.identity:
                raise LogError("the log changed while it was copied", where=path, fix="Wait until its recorder is done")
            return report


def _copy_permissions(source: Path, target: Path) -> None:
    """Gives the target the mode of the source, and its owner where the system allows it."""
    status = source.stat()
    give(target, status)
    target.chmod(status.st_mode & 0o7777)


class _Rewrite:
    """One pass over the source, and the verification of the target."""

    def __init__(
        self,
        log: Log,
        out: LogWriter,
        derived: Sequence[DerivedTopics],
        check: str,
        own: bool,
        tell: Progress,
    ) -> None:
        self.log, self.index, self.source, self.out = log, log.index, log.index.source, out
        self.check, self.tell = check, tell
        out.contents.schemas.update(sorted(self.index.schemas.items()))
        out.contents.channels.update(sorted(self.index.channels.items()))
        self.streams = [self._stream(topics, own) for topics in derived]
        self.imu_channels = set().union(*(stream.sources for stream in self.streams)) if self.streams else set()
        self.passing = PassThrough(self.source, out.target)
        self.checked = self.unchecked = 0  # chunks unpacked before or while copying; messages that no CRC covers
        self.new_chunks = set[int]()  # their offsets

    def _stream(self, topics: DerivedTopics, own: bool) -> DerivedStream:
        source = self.log.topics[topics.source_topic]
        defined = [define(self.out, new, self.log, source, own=own) for new in topics.topics]
        return DerivedStream(self.log, topics, self.log.channel_ids(source.name), defined)

    def run(self, metadata: Values | Callable[[Verified], Values]) -> RewriteReport:
        """Copies the log item by item with the new chunks between them, ends it, and verifies it.

        Raises:
            LogError: the source is damaged, or the copy is.
        """
        size = self.source.size
        with self.log.named():
            self._copy_all(size)
        contents = self.out.contents
        verified = self._verified()
        for name, values in (metadata(verified) if callable(metadata) else metadata).items():
            self.out.metadata(name, values)
        self.out.finish()
        self.index.items.clear()  # it grows with the log, and the verification builds another
        verify(
            self.out.target.temporary,
            contents.counts,
            unpacked={"all": None, "imu": self.new_chunks, "none": ()}[self.check],
            max_chunk=self.index.max_chunk,
            progress=lambda done, total: self.tell(size + size * done // total, 2 * size),
        )
        self.tell(2 * size, 2 * size)
        added = {t.name: contents.counts[i] for s in self.streams for t, i in zip(s.derived.topics, s.ids, strict=True)}
        copied = contents.counts.total() - sum(added.values())
        unchecked = 0 if stated_crc(self.index) else self.unchecked  # else the CRC of the data section covers them
        return RewriteReport(copied, added, len(contents.chunks), unchecked, size, self.out.target.position, verified)

    def _copy_all(self, size: int) -> None:
        self.passing.skip(self.index.header_end)
        for item in self.index.items:
            if isinstance(item, MessageBlock):
                self._copy_block(item)
            else:
                self._copy_record(item)
            for stream in self.streams:
                if stream.size >= CHUNK_BYTES:
                    self._write_new_chunk(stream)
            if self.passing.pending >= RUN_BYTES:
                self.passing.flush()
            self.tell(self.passing.copied, 2 * size)
        for stream in self.streams:
            stream.decode()
            self._write_new_chunk(stream)
        self.passing.flush()
        self.passing.skip(self.index.data_end)
        if self.out.target.summing:
            check_data_crc(self.index, self.passing.crc)

    def _verified(self) -> Verified:
        chunks = len(self.out.contents.chunks)
        checked = {"all": chunks, "imu": self.checked + len(self.new_chunks), "none": self.checked}[self.check]
        return Verified(self.check, checked, chunks)

    def _write_new_chunk(self, stream: DerivedStream) -> None:
        if stream.size:
            self.passing.flush()
            self.new_chunks.add(self.out.target.position)
            self.out.chunk(stream.pop_chunk())

    def _copy_block(self, block: MessageBlock) -> None:
        if block.compression is None:
            self._wrap_run(block)
            return
        if kept := self.log.kept and self.log.kept.pop(block, self.imu_channels):
            for stream in self.streams:
                stream.add(kept.parts[stream.derived.source_topic])
            self.checked += 1
            self._list_chunk(block, kept.head, kept.indexes, self.passing.defer(block.end))
            return
        if self.index.definitions_known and block.indexes and self.imu_channels.isdisjoint(block.indexes):
            head, indexes = read_message_indexes(self.source, block)
            if indexes is not None and head[:2] == (indexes.start_ns, indexes.end_ns):
                self._list_chunk(block, head, indexes, self.passing.defer(block.end))
                return
        self._copy_unpacked(block)

    def _wrap_run(self, block: MessageBlock) -> None:
        """Writes messages outside chunks as a chunk."""
        raw = self.source.at(block.offset, block.length)
        found = self.index.unpack_bytes(block, raw)
        self._add(found)
        self.passing.flush()
        self.checked += 1
        self.unchecked += len(found.heads)
        self.out.chunk(Chunk(raw, found.heads["channel"], found.times(), found.offsets), "none")
        self.passing.skip(block.end)

    def _copy_unpacked(self, block: MessageBlock) -> None:
        """Copies a chunk that must be unpacked; wrong message indexes are replaced."""
        everything = memoryview(self.source.at(block.offset, block.end - block.offset))
        try:
            head, indexes, right, found = check_chunk(everything, block, self.index.max_chunk)
        except LogError as error:
            self.index.lose(block, error)
            self.passing.flush()
            self.passing.skip(block.end)
            return
        for opcode, first, length in found.definitions:
            self._define(opcode, found.data[first : first + length].tobytes(), block.offset)
        self._add(found)
        self.checked += 1
        if indexes is not None and right:
            self._list_chunk(block, head, indexes, self.passing.write(everything) - block.offset)
        else:
            self.unchecked += 0 if head.crc else len(found.heads)
            entry = head.index_at(self.passing.write(everything[: block.length]), block.length)
            self.out.write_indexes(entry, found.heads["channel"].copy(), found.times(), found.offsets)
            self.passing.skip(block.end)

    def _add(self, found: Messages) -> None:
        """Hands messages of the source IMUs to the topics computed from them."""
        for stream in self.streams:
            stream.add(parts_of(found, self.log.topics[stream.derived.source_topic], stream.sources))

    def _list_chunk(self, block: MessageBlock, head: ChunkHead, indexes: MessageIndexes, moved: int) -> None:
        """Enters a chunk with its own message indexes in the summary."""
        if head[:2] != (indexes.start_ns, indexes.end_ns):
            raise LogError(f"the times of the chunk at byte {block.offset} are not those of its messages", fix=REPAIR)
        self.unchecked += 0 if head.crc else sum(indexes.counts.values())
        entry = head.index_at(block.offset + moved, block.length)
        entry.message_start_time, entry.message_end_time = indexes.start_ns, indexes.end_ns
        entry.message_index_offsets = {c: at + moved for c, at in block.indexes.items()}
        entry.message_index_length = block.end - block.offset - block.length
        self.out.contents.chunks.append(entry)
        self.out.contents.add(indexes.counts, indexes.start_ns, indexes.end_ns)

    def _define(self, opcode: int, body: bytes, offset: int) -> None:
        """Adds a definition that only a chunk contains; refuses one under a new channel's id."""
        index, contents = self.index, self.out.contents
        known_schemas, known_channels = len(index.schemas), len(index.channels)
        index.define(opcode, body, offset)
        new_schemas = {i: index.schemas[i] for i in islice(reversed(index.schemas), len(index.schemas) - known_schemas)}
        new_channels = {i: index.channels[i] for i in islice(reversed(index.channels), len(index.channels) - known_channels)}
        if new_schemas.keys() & contents.schemas.keys() or new_channels.keys() & contents.channels.keys():
            raise LogError(f"the chunk at byte {offset} defines an id that the rest of the log does not mention")
        contents.schemas.update(new_schemas)
        contents.channels.update(new_channels)

    def _copy_record(self, span: RecordSpan) -> None:
        """Copies any other record; attachments and metadata are entered in the summary."""
        end = span.offset + span.length
        if span.opcode == Opcode.MESSAGE_INDEX:  # of no chunk: it can only mislead
            self.passing.flush()
            self.passing.skip(end)
            return
        at = span.offset + self.passing.defer(end)
        if span.opcode == Opcode.METADATA:
            name = span.metadata(self.source).name
            self.out.contents.metadata.append(MetadataIndex(offset=at, length=span.length, name=name))
        elif span.opcode == Opcode.ATTACHMENT:
            attachment = Attachment.of(self.source, span.offset, span.length - HEAD.size)
            self.out.contents.attachments.append(attachment.index_at(at))
