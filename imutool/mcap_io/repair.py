"""Repair a damaged log: copy intact chunks, rebuild every index, record what was lost.

A log with all indexes and CRCs, which are right, is copied as it is. Of any other an intact chunk is copied; its indexes
are made from its messages, which its CRC proves, and never copied. Definitions stand in front of everything, so that the next
damage costs less. Messages that no CRC covers go into chunks that state none:
recovery must not make them look proven.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from mcap.opcode import Opcode
from mcap.records import MetadataIndex

import imutool
from imutool.errors import ConfigError, ImutoolError, LogError
from imutool.file_location import Location, identity, io_errors, same_location
from imutool.mcap_io.blocks import Attachment, MessageBlock, RecordSpan
from imutool.mcap_io.codec import messages, records
from imutool.mcap_io.codec.records import CHUNK_HEAD, HEAD, ChunkHead
from imutool.mcap_io.file_writer import LogWriter
from imutool.mcap_io.recovery import chunk_repair
from imutool.mcap_io.recovery.losses import Loss, Losses
from imutool.mcap_io.recovery.recovered_index import RecoveredIndex
from imutool.mcap_io.recovery.recovered_log import RecoveredLog
from imutool.mcap_io.storage.output_conflicts import refuse_existing
from imutool.mcap_io.storage.source import BLOCK_BYTES, Source, crc_of
from imutool.mcap_io.storage.target import Target, temporary
from imutool.mcap_io.verify import verify, verify_index
from imutool.processes.system import collector_paused
from imutool.report import Progress, silent

RECORD = "imutool_repair"  # name of the metadata record
DAMAGED = "imutool/damaged"  # attachments below this name hold damaged bytes as they were found
PART_BYTES = 16 << 20  # readers hold an attachment in memory as a whole
CRC_AT = HEAD.size + CHUNK_HEAD.size - 8  # in a Chunk record


@dataclass(frozen=True)
class RepairReport:
    """Contents of a repaired log, and what is missing from it."""

    losses: Losses
    messages: Mapping[str, int]  # saved, by topic
    chunks: int
    kept: int  # damaged stretches that went along as attachments
    source_bytes: int
    target_bytes: int

    @property
    def whole(self) -> bool:
        """Whether there was nothing to repair."""
        return self.losses.intact


def repair(
    source: Location,
    target: Location,
    *,
    damaged: str = "drop",
    overwrite: bool = False,
    max_chunk: int | None = None,
    progress: Progress = silent,
) -> RepairReport:
    """Writes the intact part of `source` to `target`, in order of log time, with all indexes.

    With `damaged="keep"` the bytes of damaged stretches become attachments `imutool/damaged/OFFSET`, which no reader takes
    for messages. The metadata record `imutool_repair` lists what was lost. A log with all indexes and CRCs, which are right, is
    copied byte for byte. The result is read back as a whole before it takes its place. A chunk of more than `max_chunk` bytes,
    packed or unpacked, is left out.

    Raises:
        ConfigError: source or target cannot be opened, the target exists or is the source, or an unknown `damaged`.
        LogError: no MCAP log, or nothing in it that can be saved.
    """
    if damaged not in ("drop", "keep"):
        raise ConfigError(f"unknown treatment of damaged bytes {damaged!r}", where="damaged", expected="drop or keep")
    if same_location(source, target):
        raise ConfigError("the target is the source", where=target, fix="Choose another name")
    with collector_paused(), RecoveredLog(source, max_chunk=max_chunk, reads_topics=False) as log:
        try:
            return _copy_intact(log, target, overwrite, progress) or _repair(log, target, damaged, overwrite, progress)
        except _ContradictionError:
            log.read_by_records()
            return _repair(log, target, damaged, overwrite, progress)


class _ContradictionError(Exception):
    """The contents of a log are not as its index says."""


def _copy_intact(log: RecoveredLog, target: Location, overwrite: bool, tell: Progress) -> RepairReport | None:
    """Copies a log whose indexes and CRCs are all there and right; None for any other.

    Frames of lz4 may lack their end mark, without which other readers refuse them: such a log is none.
    """
    index, source = log.index, log.index.source
    if index.by_records or any(block.compression == "lz4" for block in index.blocks):
        return None
    refuse_existing(target, overwrite=overwrite)
    try:
        verify_index(index, index.counts(), proven=True, progress=lambda done, total: tell(done, 2 * total))
    except LogError:
        return None
    with Target(target, overwrite=overwrite) as out:
        out.copy(source, 0, source.size)
        out.flush()
        written = Source(out.temporary)
        with written.file:
            same = crc_of(written, 0, source.size) == out.crc
        if not same or identity(log.path) != source.identity:
            raise LogError("the log changed while it was copied", where=log.path, fix="Wait until its recorder is done")
    tell(2 * source.size, 2 * source.size)
    return _report(log, index.counts(), len(index.blocks), 0, source.size)


def _report(log: RecoveredLog, counts: Mapping[int, int], chunks: int, kept: int, target_bytes: int) -> RepairReport:
    saved: dict[str, int] = {}
    for channel, count in sorted(counts.items()):
        topic = log.index.channels[channel].topic
        saved[topic] = saved.get(topic, 0) + count
    return RepairReport(log.losses, saved, chunks, kept, log.index.source.size, target_bytes)


def _repair(log: RecoveredLog, target: Location, damaged: str, overwrite: bool, tell: Progress) -> RepairReport:
    index, losses, size = log.index, log.losses, log.index.source.size
    compression = next((b.compression for b in index.blocks if b.compression), "zstd")
    with LogWriter(target, compression=compression, overwrite=overwrite, header=index.header_bytes) as out:
        with log.named():
            kept = _save(log, out, damaged, lambda done: tell(done, 2 * size))
        if not losses.intact:
            out.metadata(RECORD, _loss_record(log.path, damaged, losses))
        out.finish()
        verify(
            out.target.temporary,
            out.contents.counts,
            max_chunk=log.max_chunk,
            progress=lambda done, total: tell(size + size * done // total, 2 * size),
        )
        tell(2 * size, 2 * size)
        return _report(log, out.contents.counts, len(out.contents.chunks), kept, out.target.position)


def _loss_record(source: Location, damaged: str, losses: Losses) -> dict[str, str]:
    """The metadata record of what was lost."""
    values = {key: "unknown" if value is None else value for key, value in losses.plain().items() if key != "whole"}
    texts = {key: value if isinstance(value, str) else json.dumps(value) for key, value in values.items()}
    return {"version": imutool.__version__, "source_file": source.name, "damaged": damaged, **texts}


def _save(log: RecoveredLog, out: LogWriter, damaged: str, tell: Callable[[int], None]) -> int:
    """Copies everything intact; returns how many damaged stretches were kept.

    Raises:
        LogError: nothing is intact.
    """
    log.check_data_crc()
    if log.losses and not log.index.by_records:
        raise _ContradictionError
    if log.index.by_records:
        log.index.check()
    saver = _Saver(log.index, out)
    for item in log.index.items:
        saver.copy(item)
        tell(item.offset)
    losses = log.losses
    if losses and not out.contents.counts and not out.contents.attachments:
        raise LogError(f"nothing in it can be saved: {losses.entries[0].reason}", expected="at least one sound chunk")
    kept = [loss for loss in losses.entries if loss.length] if damaged == "keep" else []
    for loss in kept:
        _attach_damaged(out, log.index.source, loss)
    return len(kept)


class _Saver:
    """Copies the intact parts of a log, item by item."""

    def __init__(self, index: RecoveredIndex, out: LogWriter) -> None:
        self.index, self.source, self.out = index, index.source, out
        out.contents.schemas.update(sorted(index.schemas.items()))
        out.contents.channels.update(sorted(index.channels.items()))
        for record in (*out.contents.schemas.values(), *out.contents.channels.values()):
            out.target.write(records.build(record))

    def copy(self, item: MessageBlock | RecordSpan) -> None:
        """Copies one item, or lists it as lost."""
        try:
            if isinstance(item, RecordSpan):
                self._copy_record(item)
            elif not item.lost:
                self._copy_block(item)
        except LogError as error:
            if not self.index.by_records:
                raise _ContradictionError from error
            self.index.lose(item, error)

    def _copy_block(self, block: MessageBlock) -> None:
        raw = self.index.read(block)
        found = self.index.unpack_bytes(block, raw)
        head = None if block.compression is None else ChunkHead.of(raw, len(raw), block.offset)
        if head is None or block.edited or not chunk_repair.keeps_sound(head, raw, found):
            if len(found.heads):
                self._new_chunk(block, found)
            return
        self._write_chunk([raw], head, found)

    def _new_chunk(self, block: MessageBlock, found: messages.Messages) -> None:
        """Packs messages that cannot stay in their chunk, or lie outside chunks."""
        data, times = found.data.tobytes(), found.times()
        compression = block.compression or ""
        if compression not in records.COMPRESSIONS.values():
            compression = "zstd"
        packed = records.pack(compression)(data)
        start = records.chunk_head(data, packed, compression, int(times.min()), int(times.max()))
        if block.offset in self.index.losses.unchecked_in:
            start = start[:CRC_AT] + bytes(4) + start[CRC_AT + 4 :]
        self._write_chunk([start, packed], ChunkHead.of(start, len(start) + len(packed), block.offset), found)

    def _write_chunk(self, parts: list[bytes], head: ChunkHead, found: messages.Messages) -> None:
        times, at = found.times(), self.out.target.position
        for part in parts:
            self.out.target.write(part)
        entry = head.index_at(at, self.out.target.position - at)
        if len(times):
            entry.message_start_time, entry.message_end_time = messages.span(times)
        self.out.write_indexes(entry, found.heads["channel"], times, found.offsets)

    def _copy_record(self, span: RecordSpan) -> None:
        """Copies any other record; definitions stand in front already, and indexes are rebuilt."""
        at = self.out.target.position
        if span.opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE_INDEX):
            return
        if span.opcode == Opcode.METADATA:
            name = span.metadata(self.source).name
            self.out.contents.metadata.append(MetadataIndex(offset=at, length=span.length, name=name))
        elif span.opcode == Opcode.ATTACHMENT:
            self.out.attachment(self.source, span.offset, span.length)
            return
        self.out.target.copy(self.source, span.offset, span.offset + span.length)


def _attach_damaged(out: LogWriter, source: Source, loss: Loss) -> None:
    """Writes damaged bytes as attachments, in parts that a reader can hold."""
    for start in range(loss.offset, loss.offset + loss.length, PART_BYTES):
        size = min(PART_BYTES, loss.offset + loss.length - start)
        name, media = f"{DAMAGED}/{start}", "application/octet-stream"
        texts = b"".join(struct.pack("<I", len(text)) + text.encode() for text in (name, media))
        body = struct.pack("<QQ", loss.start_ns or 0, 0) + texts + struct.pack("<Q", size)
        at, crc, length = out.target.position, zlib.crc32(body), len(body) + size + 4
        out.target.write(HEAD.pack(Opcode.ATTACHMENT, length) + body)
        for position in range(start, start + size, BLOCK_BYTES):
            part = source.at(position, min(BLOCK_BYTES, start + size - position))
            crc = zlib.crc32(part, crc)
            out.target.write(part)
        out.target.write(struct.pack("<I", crc))
        attachment = Attachment(at, HEAD.size + length, loss.start_ns or 0, 0, name, media, size)
        out.contents.attachments.append(attachment.index_at(at))


@contextmanager
def repaired(source: Location, beside: Location, max_chunk: int | None) -> Iterator[tuple[Location, Losses] | None]:
    """Temporary repaired copy of a damaged log next to another file; None if the log is intact.

    Raises:
        ConfigError: the copy cannot be written.
        LogError: nothing in the log can be saved.
    """
    with RecoveredLog(source, max_chunk=max_chunk) as log:
        log.check()
        intact = log.losses.intact
    if intact:
        yield None
        return
    copy = temporary(beside)
    try:
        yield copy, repair(source, copy, max_chunk=max_chunk).losses
    except ImutoolError as error:  # the user does not know the copy
        where = None if error.where is None else str(error.where).replace(str(copy), str(source))
        raise error.replaced(where=where) from error
    finally:
        with suppress(io_errors(copy)):
            copy.unlink()
