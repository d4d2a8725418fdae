"""A log with channels added to it: every record of the source passes through as the bytes it is.

One pass, one chunk in memory. What no IMU message lies in is never looked into: its bytes go from file to file
(`target.Target.copy`), and its message indexes say what to enter in the summary. Only a chunk that holds messages of a source
IMU, or that its indexes do not describe, comes into memory to be unpacked, checked and read; what is written of it are the
very bytes that were checked. Only what must change is made anew: the summary, and message indexes where the source has
none or wrong ones. Messages outside chunks keep their bytes too and are wrapped into chunks, because a reader that goes
by chunk indexes would otherwise not find them beside the new ones.

A source that states the CRC of its data section gets it checked, and its copy states one, for which every byte passes
through memory (1.3 instead of 1.2 of the CPU time of `cp`, `pass` in `tests/bench/rewrite.py`); the copy of a source that
states none (most recorders' do not) states none.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, ChunkIndex, Metadata, MetadataIndex

from imutool.errors import ConfigError, LogError
from imutool.location import Location, identity, same
from imutool.mcap_io.added_topics import Derived, Stream
from imutool.mcap_io.codec import records
from imutool.mcap_io.codec import schemas as schema
from imutool.mcap_io.codec.records import HEAD, ChunkHead
from imutool.mcap_io.index import Block, LogIndex, Span
from imutool.mcap_io.listing import Listing, described, head, listing
from imutool.mcap_io.log import Log
from imutool.mcap_io.passthrough import Passage
from imutool.mcap_io.topics import DERIVED_KEY
from imutool.mcap_io.verify import Verified, check_data_crc, refuse_unknown, stated_crc, verify
from imutool.mcap_io.write import CHUNK_BYTES
from imutool.mcap_io.writer import Chunk, LogWriter

RUN_BYTES = 16 << 20  # verbatim bytes are copied in runs of about this size: between them progress is told


Values = Mapping[str, Mapping[str, str]]  # the entries of metadata records, by the records' names


@dataclass(frozen=True)
class RewriteReport:
    """What a rewritten log holds, and what of it was checked."""

    copied: int  # messages of the source
    added: Mapping[str, int]  # messages per new topic
    chunks: int
    source_bytes: int
    target_bytes: int
    verified: Verified


def rewrite(
    source: Location,
    target: Location | None,
    derived: Sequence[Derived],
    *,
    metadata: Values | Callable[[Verified], Values],
    overwrite: bool = False,
    check: str = "imu",
    progress: Callable[[int, int], None] | None = None,
) -> RewriteReport:
    """Writes `target`: all of `source`, the derived channels in chunks of their own, and the metadata records.

    A derived message has log time, publish time and sequence of the message it comes from. A metadata record of
    a name that the source has already stands beside it; `metadata` that is a function is asked when all else is written.

    The finished file is read back before it takes its place, and always its structure (`mcap_io.verify`). The contents of
    chunks with IMU messages are checked on the way through; with `check` "imu" those of the new chunks as well, with
    "all" every chunk, attachment and the CRC of the data section, from the finished file. With "none" nothing more.

    Without a target the log takes the place of the source, with its permissions, through the same temporary file; a
    symbolic link is followed and stays one, another name (hard link) of the file keeps the old log.

    `progress` is told the bytes done and those there are, counting the source twice: once to copy, once to check.

    Raises:
        ConfigError: source or target cannot be opened, the target exists or is the source, or an unknown `check`.
        LogError: the source is damaged, lacks a source topic, has a new topic already, changed meanwhile, or holds IMU
            messages that no model can take.
    """
    refuse_unknown(check)
    if target is not None and same(source, target):
        raise ConfigError("the target is the source", where=target, fix="Choose another name")
    place = (source.resolve() if isinstance(source, Path) else source) if target is None else target
    with Log(source) as log:
        _refuse_taken(log, derived)
        structure, before = log.structure, identity(source)
        start = len(records.MAGIC)
        header = structure.source.at(start, structure.header_end - start)
        crc = bool(stated_crc(structure))
        packing = _compression(structure)
        with LogWriter(place, compression=packing, overwrite=overwrite or target is None, header=header, data_crc=crc) as out:
            report = _Rewrite(log, out, derived, check, progress or (lambda done, total: None)).run(metadata)
            if target is None and isinstance(source, Path) and isinstance(out.target.temporary, Path):
                _take_permissions(out.target.temporary, source)
            if identity(source) != before:
                raise LogError("the log changed while it was copied", where=source, fix="Wait until its recorder is done")
            return report


def _take_permissions(path: Path, of: Path) -> None:
    """Gives a file the mode of another, and its owner where that is allowed."""
    there = of.stat()
    with suppress(PermissionError):
        os.chown(path, there.st_uid, there.st_gid)
    path.chmod(there.st_mode & 0o7777)


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


def _compression(structure: LogIndex) -> str:
    """New chunks are packed as the source's first chunk is; a log without chunks gets them unpacked."""
    return next((b.compression for b in structure.blocks if b.compression is not None), "none")


class _Rewrite:
    """The pass over the source, and the look back."""

    def __init__(
        self, log: Log, out: LogWriter, derived: Sequence[Derived], check: str, tell: Callable[[int, int], None]
    ) -> None:
        self.log, self.structure, self.source, self.out = log, log.structure, log.structure.source, out
        self.check, self.tell = check, tell
        out.contents.schemas.update(sorted(self.structure.schemas.items()))
        out.contents.channels.update(sorted(self.structure.channels.items()))
        self.streams = [
            Stream(
                log,
                make,
                log.channel_ids(make.source_topic),
                [out.channel(t.name, t.schema_name, {DERIVED_KEY: make.source_topic}) for t in make.topics],
            )
            for make in derived
        ]
        self.wanted = set().union(*(stream.sources for stream in self.streams)) if self.streams else set()
        self.passage = Passage(self.source, out.target)
        self.checked, self.made = 0, set[int]()  # chunks unpacked on the way; where new ones begin

    def run(self, metadata: Values | Callable[[Verified], Values]) -> RewriteReport:
        """Copies the log item by item with the new chunks between them, ends it, and looks back at it.

        Raises:
            LogError: the source is damaged, or the copy is.
        """
        size = self.source.size
        with self.log.named():
            self.passage.skip(self.structure.header_end)
            for item in self.structure.items:
                if isinstance(item, Block):
                    self._block(item)
                else:
                    self._span(item)
                for stream in self.streams:
                    if stream.size >= CHUNK_BYTES:
                        self._add(stream)
                if self.passage.upto - self.passage.copied >= RUN_BYTES:
                    self.passage.settle()
                self.tell(self.passage.copied, 2 * size)
            for stream in self.streams:
                stream.decode()
                self._add(stream)
            self.passage.settle()
            self.passage.skip(self.structure.data_end)
            if self.out.target.summing:
                check_data_crc(self.structure, self.passage.crc)
        contents = self.out.contents
        verified = self._verified()
        for name, values in (metadata(verified) if callable(metadata) else metadata).items():
            self.out.metadata(name, values)
        self.out.finish()
        self.structure.items.clear()  # what grows with a log is its chart, and the look back makes another
        verify(
            self.out.target.temporary,
            contents.counts,
            unpacked={"all": None, "imu": self.made, "none": ()}[self.check],
            progress=lambda done, total: self.tell(size + size * done // total, 2 * size),
        )
        self.tell(2 * size, 2 * size)
        added = {t.name: contents.counts[i] for s in self.streams for t, i in zip(s.make.topics, s.ids, strict=True)}
        copied = contents.counts.total() - sum(added.values())
        return RewriteReport(copied, added, len(contents.chunks), size, self.out.target.position, verified)

    def _verified(self) -> Verified:
        """What will have been checked when the log takes its place."""
        chunks = len(self.out.contents.chunks)
        checked = {"all": chunks, "imu": self.checked + len(self.made), "none": self.checked}[self.check]
        return Verified(self.check, checked, chunks)

    def _add(self, stream: Stream) -> None:
        """Writes what a stream holds as a chunk of its own."""
        if stream.size:
            self.passage.settle()
            self.made.add(self.out.target.position)
            self.out.chunk(stream.taken())

    def _block(self, block: Block) -> None:
        if block.compression is None:
            self._run(block)
            return
        if self.structure.vouched and block.indexes and self.wanted.isdisjoint(block.indexes):
            about, listed = described(self.source, block)
            if listed is not None:
                moved = self.passage.verbatim(block.end)
                self._enter(block, about, listed, moved)
                return
        self._unpacked(block)

    def _run(self, block: Block) -> None:
        """Messages outside chunks, which become a chunk."""
        raw = self.source.at(block.offset, block.length)
        found = self.structure.unpacked(block, raw)
        for stream in self.streams:
            stream.feed(found)
        self.passage.settle()
        self.checked += 1
        self.out.chunk(Chunk(raw, found.heads["channel"], found.times(), found.offsets), "none")
        self.passage.skip(block.end)

    def _unpacked(self, block: Block) -> None:
        """A chunk that is looked into; its own message indexes follow it if they list what is in it, else new ones."""
        everything = memoryview(self.source.at(block.offset, block.end - block.offset))
        raw, behind = everything[: block.length], everything[block.length :]
        try:
            about = head(raw, block)
            listed, data = listing(behind, block, about.size), records.unpack(raw, block.offset)
            found, right = listed.messages(data, block.offset) if listed else (records.messages(data, block.offset), False)
        except LogError as error:
            self.structure.lose(block, error)
            self.passage.settle()
            self.passage.skip(block.end)
            return
        for opcode, first, length in found.definitions:
            self._define(opcode, found.data[first : first + length].tobytes(), block.offset)
        for stream in self.streams:
            stream.feed(found)
        self.checked += 1
        if listed is not None and right:
            self._enter(block, about, listed, self.passage.put(everything) - block.offset)
        else:
            entry = self._entry(block, about, self.passage.put(raw))
            self.out.index(entry, found.heads["channel"].copy(), found.times(), found.offsets)
            self.passage.skip(block.end)

    def _enter(self, block: Block, about: ChunkHead, listed: Listing, moved: int) -> None:
        """Enters a chunk that has its own message indexes behind it in the summary."""
        entry = self._entry(block, about, block.offset + moved)
        entry.message_start_time, entry.message_end_time = listed.start_ns, listed.end_ns
        entry.message_index_offsets = {c: at + moved for c, at in block.indexes.items()}
        entry.message_index_length = block.end - block.offset - block.length
        self.out.contents.chunks.append(entry)
        self.out.contents.add(listed.counts, listed.start_ns, listed.end_ns)

    @staticmethod
    def _entry(block: Block, about: ChunkHead, at: int) -> ChunkIndex:
        """The index of a chunk at its new place, without its messages."""
        return ChunkIndex(
            chunk_length=block.length,
            chunk_start_offset=at,
            compression=about.compression,
            compressed_size=block.length - about.data_at,
            message_end_time=about.end_ns,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=about.start_ns,
            uncompressed_size=about.size,
        )

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

    def _span(self, span: Span) -> None:
        """Any other record, as it is; attachments and metadata are entered in the summary."""
        end = span.offset + span.length
        if span.opcode == Opcode.MESSAGE_INDEX:  # of no chunk: it can only mislead
            self.passage.settle()
            self.passage.skip(end)
            return
        at = span.offset + self.passage.verbatim(end)
        if span.opcode == Opcode.METADATA:
            body = self.source.at(span.offset + HEAD.size, span.length - HEAD.size)
            name = records.parse(Metadata, body, span.offset).name
            self.out.contents.metadata.append(MetadataIndex(offset=at, length=span.length, name=name))
        elif span.opcode == Opcode.ATTACHMENT:
            self.out.contents.attachments.append(self._attachment(span, at))

    def _attachment(self, span: Span, offset: int) -> AttachmentIndex:
        """The index entry of an attachment, without reading its data."""
        at, end = span.offset + HEAD.size, span.offset + span.length

        def field(size: int) -> bytes:
            nonlocal at
            if size > end - at:
                raise LogError(f"the attachment at byte {span.offset} is damaged: its lengths contradict one another")
            at += size
            return self.source.at(at - size, size)

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
