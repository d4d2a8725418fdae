"""A damaged log written anew: what is sound as the bytes it is, every index rebuilt, and a record of what was lost.

A sound chunk is copied verbatim. Its message indexes are made from its messages, which its CRC proves, never copied.
Definitions stand in front of everything, so that the next damage costs less. Messages that no CRC covers go into chunks that
state none: being saved must not make them look proven.
"""

from __future__ import annotations

import json
import os
import secrets
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, ChunkIndex, Metadata, MetadataIndex

import imutool
from imutool.errors import ConfigError, ImutoolError, LogError
from imutool.location import Location, failures, same
from imutool.mcap_io.codec import records
from imutool.mcap_io.codec.attachment import Attached
from imutool.mcap_io.codec.records import CHUNK_HEAD, HEAD
from imutool.mcap_io.index import Block, LogIndex, Span
from imutool.mcap_io.log import Log
from imutool.mcap_io.losses import Loss, Losses
from imutool.mcap_io.storage.source import Source
from imutool.mcap_io.verify import verify
from imutool.mcap_io.writer import LogWriter

RECORD = "imutool_repair"  # name of the metadata record
DAMAGED = "imutool/damaged"  # attachments below this name hold damaged bytes as they were found
COPY_BYTES = 1 << 20
PART_BYTES = 16 << 20  # readers hold an attachment in memory as a whole
CRC_AT = HEAD.size + CHUNK_HEAD.size - 8  # in a Chunk record


@dataclass(frozen=True)
class RepairReport:
    """What a repaired log holds, and what is missing from it."""

    losses: Losses
    messages: Mapping[str, int]  # saved, by topic
    chunks: int
    kept: int  # damaged stretches that went along as attachments
    source_bytes: int
    target_bytes: int

    @property
    def whole(self) -> bool:
        """Whether there was nothing to repair."""
        return not self.losses and not self.losses.mended


def repair(
    source: Location,
    target: Location,
    *,
    damaged: str = "drop",
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> RepairReport:
    """Writes `target`: everything of `source` that is sound, in the order of the file, with all its indexes.

    With `damaged="keep"` the bytes of damaged stretches go along as attachments `imutool/damaged/OFFSET`, which no reader takes
    for messages. What was lost stands in the metadata record `imutool_repair`; a log that was whole gets none. The result is
    read back as a whole before it takes its place.

    Raises:
        ConfigError: source or target cannot be opened, the target exists or is the source, or an unknown `damaged`.
        LogError: no MCAP log, or nothing in it that can be saved.
    """
    if damaged not in ("drop", "keep"):
        raise ConfigError(f"{damaged!r} is nothing to do with damage", where="--damaged", expected="drop or keep")
    if same(source, target):
        raise ConfigError("the target is the source", where=target, fix="Choose another name")
    tell = progress or (lambda done, total: None)
    with Log(source, salvage=True) as log:
        structure, losses = log.structure, log.losses
        assert losses is not None, "with salvage there are losses, if perhaps none"
        size = structure.source.size
        compression = next((b.compression for b in structure.blocks if b.compression), "zstd")
        with LogWriter(target, compression=compression, overwrite=overwrite, header=structure.opening) as out:
            with log.named():
                structure.prove()
                saved = _Saved(structure, losses, out)
                for item in structure.items:
                    saved.take(item)
                    tell(item.offset, 2 * size)
                if losses and not out.contents.counts and not out.contents.attachments:
                    raise LogError(
                        f"nothing in it can be saved: {losses.entries[0].reason}", expected="at least one sound chunk"
                    )
                kept = [loss for loss in losses.entries if loss.length] if damaged == "keep" else []
                for loss in kept:
                    _keep(out, structure.source, loss)
            if losses or losses.mended:
                out.metadata(RECORD, _told(source, damaged, losses))
            out.finish()
            verify(
                out.target.temporary,
                out.contents.counts,
                progress=lambda done, total: tell(size + size * done // total, 2 * size),
            )
            tell(2 * size, 2 * size)
            messages: dict[str, int] = {}
            for channel, count in sorted(out.contents.counts.items()):
                topic = structure.channels[channel].topic
                messages[topic] = messages.get(topic, 0) + count
            return RepairReport(losses, messages, len(out.contents.chunks), len(kept), size, out.target.position)


def _told(source: Location, damaged: str, losses: Losses) -> dict[str, str]:
    """The metadata record."""
    found = losses.plain()
    unknown = {key: "unknown" if value is None else value for key, value in found.items() if key != "whole"}
    told = {key: value if isinstance(value, str) else json.dumps(value) for key, value in unknown.items()}
    return {"version": imutool.__version__, "source_file": source.name, "damaged": damaged, **told}


class _Saved:
    """The part of a log that goes on, item by item."""

    def __init__(self, structure: LogIndex, losses: Losses, out: LogWriter) -> None:
        self.structure, self.source, self.losses, self.out = structure, structure.source, losses, out
        out.contents.schemas.update(sorted(structure.schemas.items()))
        out.contents.channels.update(sorted(structure.channels.items()))
        for record in (*out.contents.schemas.values(), *out.contents.channels.values()):
            out.target.write(records.build(record))

    def take(self, item: Block | Span) -> None:
        """Copies one item, or has it counted as lost."""
        try:
            if isinstance(item, Span):
                self._span(item)
            elif not item.lost:
                self._block(item)
        except LogError as error:
            self.structure.lose(item, error)

    def _block(self, block: Block) -> None:
        raw = self.structure.read(block)
        found = self.structure.unpacked(block, raw)
        if block.compression is None or block.edited:
            if len(found.heads):
                self._anew(block, found)
            return
        head = records.ChunkHead.of(raw[:128], len(raw), block.offset)
        self._chunk(raw[: head.data_at], raw[head.data_at :], head, found)

    def _anew(self, block: Block, found: records.Messages) -> None:
        """Messages that cannot go on in the chunk they came from, or came from none."""
        data, times = found.data.tobytes(), found.times()
        compression = block.compression or ""
        if compression not in records.COMPRESSIONS.values():
            compression = "zstd"
        packed = records.pack(compression)(data)
        start = records.chunk_head(data, packed, compression, int(times.min()), int(times.max()))
        if block.offset in self.losses.unchecked_in:
            start = start[:CRC_AT] + bytes(4) + start[CRC_AT + 4 :]
        self._chunk(start, packed, records.ChunkHead.of(start, len(start) + len(packed), block.offset), found)

    def _chunk(self, start: bytes, packed: bytes, head: records.ChunkHead, found: records.Messages) -> None:
        times, offset = found.times(), self.out.target.position
        self.out.target.write(start)
        self.out.target.write(packed)
        entry = ChunkIndex(
            chunk_length=len(start) + len(packed),
            chunk_start_offset=offset,
            compression=head.compression,
            compressed_size=len(packed),
            message_end_time=int(times.max()) if len(times) else head.end_ns,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=int(times.min()) if len(times) else head.start_ns,
            uncompressed_size=head.size,
        )
        self.out.index(entry, found.heads["channel"].copy(), times, found.offsets)

    def _span(self, span: Span) -> None:
        """Anything else as it is; definitions stand in front already, and indexes are made anew."""
        at = self.out.target.position
        if span.opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE_INDEX):
            return
        if span.opcode == Opcode.METADATA:
            body = self.source.at(span.offset + HEAD.size, span.length - HEAD.size)
            name = records.parse(Metadata, body, span.offset).name
            self.out.contents.metadata.append(MetadataIndex(offset=at, length=span.length, name=name))
        elif span.opcode == Opcode.ATTACHMENT:
            attached = Attached.of(self.source, span.offset, span.length - HEAD.size)
            attached.check(self.source)
            self._enter(attached, at)
        for start in range(span.offset, span.offset + span.length, COPY_BYTES):
            self.out.target.write(self.source.at(start, min(COPY_BYTES, span.offset + span.length - start)))

    def _enter(self, attached: Attached, offset: int) -> None:
        self.out.contents.attachments.append(
            AttachmentIndex(
                offset=offset,
                length=attached.length,
                log_time=attached.log_time,
                create_time=attached.create_time,
                data_size=attached.size,
                name=attached.name,
                media_type=attached.media_type,
            )
        )


def _keep(out: LogWriter, source: Source, loss: Loss) -> None:
    """Damaged bytes as attachments, in parts that a reader can hold."""
    for start in range(loss.offset, loss.offset + loss.length, PART_BYTES):
        size = min(PART_BYTES, loss.offset + loss.length - start)
        name, media = f"{DAMAGED}/{start}".encode(), b"application/octet-stream"
        body = struct.pack("<QQI", loss.start_ns or 0, 0, len(name)) + name
        body += struct.pack("<I", len(media)) + media + struct.pack("<Q", size)
        at, crc = out.target.position, zlib.crc32(body)
        out.target.write(HEAD.pack(Opcode.ATTACHMENT, len(body) + size + 4) + body)
        for position in range(start, start + size, COPY_BYTES):
            part = source.at(position, min(COPY_BYTES, start + size - position))
            crc = zlib.crc32(part, crc)
            out.target.write(part)
        out.target.write(struct.pack("<I", crc))
        out.contents.attachments.append(
            AttachmentIndex(
                offset=at,
                length=out.target.position - at,
                log_time=loss.start_ns or 0,
                create_time=0,
                data_size=size,
                name=name.decode(),
                media_type=media.decode(),
            )
        )


@contextmanager
def repaired(source: Location, beside: Location) -> Iterator[tuple[Location, Losses] | None]:
    """A repaired copy of a damaged log in the folder of `beside`, for as long as it is needed; None if the log is whole.

    Raises:
        ConfigError: the copy cannot be written.
        LogError: nothing in the log can be saved.
    """
    with Log(source, salvage=True) as log:
        log.check()
        losses = log.losses
    assert losses is not None, "with salvage there are losses, if perhaps none"
    if not losses and not losses.mended:
        yield None
        return
    copy = beside.with_name(f".{source.name}.{os.getpid()}.{secrets.token_hex(4)}.partial")
    try:
        yield copy, repair(source, copy).losses
    except ImutoolError as error:  # the user never heard of the copy
        where = None if error.where is None else str(error.where).replace(str(copy), str(source))
        raise type(error)(error.what, where=where, expected=error.expected, fix=error.fix) from error
    finally:
        with suppress(failures(copy)):
            copy.unlink()
