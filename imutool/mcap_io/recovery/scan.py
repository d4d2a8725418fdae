"""Scan a damaged log from its first byte to its last, record by record.

Where framing breaks, the search goes on to the next valid record (`resync`), or to the next chunk that the summary lists; the
bytes between are a gap. A chunk is unpacked only to tell a whole one from one that was cut off.
"""

from __future__ import annotations

import struct
from bisect import bisect_right
from collections.abc import Mapping

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Footer, Header

from imutool.errors import LogError
from imutool.mcap_io.blocks import RUN_BYTES, MessageBlock, RecordSpan
from imutool.mcap_io.codec import messages, records
from imutool.mcap_io.codec.records import FOOTER_SIZE, HEAD, MAGIC, crc32
from imutool.mcap_io.index import MAX_SUMMARY
from imutool.mcap_io.recovery.definitions import DEFINITIONS, Sections
from imutool.mcap_io.recovery.losses import LATEST_NS, Losses, reason
from imutool.mcap_io.recovery.resync import LOG_START, MAX_CANDIDATES, PRIVATE, SUMMARY, Gap, RecordFrames
from imutool.mcap_io.storage.source import Source

MAX_ITEMS = 5_000_000  # a 100 GB log has some 100 000 chunks; a file of nothing but empty ones would fill the memory


class Scan:
    """One pass over the records of a file.

    `chunks` are the entries of an intact summary, if there is one.

    Raises:
        LogError: more records than any recorder writes.
    """

    def __init__(
        self, source: Source, limit: int, chunks: Mapping[int, ChunkIndex], sections: Sections, losses: Losses
    ) -> None:
        self.source, self.limit, self.chunks, self.sections, self.losses = source, limit, chunks, sections, losses
        self.has_summary = limit < source.size  # an intact one, which begins at the limit
        self.frames = RecordFrames(source, limit)
        self.items: list[MessageBlock | RecordSpan] = []
        self.gaps: list[Gap] = []
        self.doubtful: list[tuple[MessageBlock, Gap]] = []  # messages that may be the contents of a damaged chunk
        self.header: Header | None = None
        self._data_ends: list[int] = []
        self._used_channels: set[int] = set()  # channels of messages, whose definition may be lost
        self._closed = False  # past a footer
        self._ended = False  # past the data section of a log
        self._last: MessageBlock | Gap | None = None  # what message indexes would belong to
        self._open_gap: Gap | None = None  # messages behind it may lie inside a damaged chunk

    def run(self) -> None:
        """Scans from the first byte to the limit."""
        limit, chunks = self.limit, sorted(self.chunks)
        position = self._start()
        while position < limit:
            if len(self.items) + len(self.gaps) > MAX_ITEMS:
                raise LogError(
                    f"the log has more than {MAX_ITEMS} chunks and other records", expected="one that a recorder made"
                )
            if (block := self._listed_block(position, limit)) is not None:
                self._add_block(block)
                position = block.end
                continue
            after = self._step(position)
            if after is None:
                following = bisect_right(chunks, position)
                after = self._gap(position, min(limit, chunks[following]) if following < len(chunks) else limit)
            position = after
        if self.has_summary and not self._ended:
            self.losses.add_harmless(f"the DataEnd record before byte {limit} is damaged; a new one can be made")
        elif self._ended and not self._closed and not self.has_summary:
            self.losses.add_harmless("the log ends inside its summary; a new one can be made")
        elif not self._ended and not (self.gaps and self.gaps[-1].offset + self.gaps[-1].length == limit):
            self.gaps.append(
                Gap(limit, 0, "the log stops here without an end: the recorder did not finish it, or it was cut off")
            )

    @property
    def data_end(self) -> int:
        """Offset of the DataEnd record; the file's end where it has none or several."""
        return self._data_ends[0] if len(self._data_ends) == 1 and len(self.sections.each) == 1 else self.source.size

    def _listed_block(self, position: int, limit: int) -> MessageBlock | None:
        entry = self.chunks.get(position)
        if entry is None:
            return None
        try:
            return MessageBlock.of_summary(entry, limit)
        except LogError as error:
            self.losses.add_harmless(reason(error))
            return None

    def _start(self) -> int:
        """Checks the magic and the Header; returns where records begin."""
        at = len(MAGIC)
        found = self.frames.head(at)
        sound = found is not None and found[0] == Opcode.HEADER and self.frames.is_valid(at, *found)
        if not self.frames.is_magic(0):
            self.losses.add_harmless("the file does not begin as an MCAP log does")
            if not sound:
                return 0
        return at

    def _add_block(self, chunk: MessageBlock) -> None:
        self.items.append(chunk)
        self._last, self._open_gap = chunk, None

    def _step(self, position: int) -> int | None:
        """Handles the record at a position; returns the next offset, None if the framing is broken."""
        frames = self.frames
        if frames.is_magic(position):
            self._log_boundary(position)
            return position + len(MAGIC)
        head = frames.head(position)
        if head is not None and head[0] == Opcode.MESSAGE:
            return self._messages(position, head[1])
        if head is None or not frames.is_valid(position, *head):
            return self._damaged(position)
        return None if not self.has_summary and self.frames.overlaps_next(position, *head) else self._record(position, *head)

    def _log_boundary(self, position: int) -> None:
        """Handles a magic inside the file: a log begins if a Header follows, else one has ended."""
        head = self.frames.head(position + len(MAGIC))
        if position and head is not None and head[0] == Opcode.HEADER:
            if not self._ended:
                self.gaps.append(Gap(position, 0, "a log stops here without an end, and another begins"))
            self.losses.add_harmless(f"another log begins at byte {position}")
            self.sections.begin(position)
            self._ended, self._closed, self._last, self._open_gap = False, False, None, None

    def _record(self, position: int, opcode: int, length: int) -> int:
        """Takes in a valid record; returns where it ends."""
        end = position + HEAD.size + length
        if opcode == Opcode.CHUNK:
            head = self.frames.chunk(position, length)
            assert head is not None, "a chunk that agrees has a head"
            self._add_block(
                MessageBlock(position, end - position, end, head.start_ns, head.end_ns, head.compression, trusted=False)
            )
        elif opcode == Opcode.MESSAGE_INDEX:
            self._message_index(position, length)
        elif opcode == Opcode.HEADER:
            if self.header is None:
                self.header = records.parse(Header, self.source.at(position + HEAD.size, length), position)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._define(opcode, self.source.at(position + HEAD.size, length), position, proven=False)
            if not self._ended:
                self.items.append(RecordSpan(opcode, position, end - position))
        elif opcode == Opcode.FOOTER:
            self._moved_summary(position)
            self._closed = self.frames.is_magic(end)
        elif opcode == Opcode.DATA_END:
            self._data_ends.append(position)
            self._ended, self._last, self._open_gap = True, None, None
        elif opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
            self.items.append(RecordSpan(opcode, position, end - position))
        return end

    def _moved_summary(self, position: int) -> None:
        """Finds the start of an inner log: the offset of its summary minus the stated one."""
        if not self._ended or not self._data_ends:
            return
        footer = records.parse(Footer, self.source.at(position + HEAD.size, FOOTER_SIZE - HEAD.size), position)
        start, stop = self._data_ends[-1] + HEAD.size + 4, position + FOOTER_SIZE - 4
        base = start - footer.summary_start
        if self.has_summary or not footer.summary_crc or not footer.summary_start or base < 0:
            return
        if stop - start > MAX_SUMMARY:
            return
        raw = self.source.at(start, stop - start)
        if crc32(raw) != footer.summary_crc:
            return
        if self.sections.begin(base):
            self.losses.add_harmless(f"another log begins at byte {base}, as its summary says")
        at = 0
        while len(raw) - at >= HEAD.size:
            opcode, length = HEAD.unpack_from(raw, at)
            self._define(opcode, raw[at + HEAD.size : at + HEAD.size + length], base, proven=True)
            at += HEAD.size + length

    def _define(self, opcode: int, body: bytes, offset: int, *, proven: bool) -> None:
        """Takes in a definition; one that contradicts a proven one is left out."""
        if opcode not in DEFINITIONS:
            return
        try:
            conflict = self.sections.define(opcode, body, offset, proven=proven)
        except LogError as error:
            conflict = reason(error)
        if conflict:
            self.losses.add_harmless(conflict)

    def _message_index(self, position: int, length: int) -> None:
        """Assigns a message index to the chunk before it, or counts a lost chunk's messages."""
        last, self._open_gap = self._last, None
        if isinstance(last, Gap):
            body = self.source.at(position + HEAD.size, length)
            last.count(int.from_bytes(body[:2], "little"), np.frombuffer(body, "<u8", offset=6).reshape(-1, 2))
        elif last is not None and last.end == position:
            channel, size = struct.unpack("<HI", self.source.at(position + HEAD.size, 6))
            last.end = position + HEAD.size + length
            if size:
                last.indexes[channel] = position

    def _damaged(self, position: int) -> int | None:
        """Handles an invalid or unknown record; returns its end, or None where that is unknown."""
        frames = self.frames
        if frames.limit - position < HEAD.size:
            return None
        opcode, length = self.source.head(position)
        fits = length <= frames.limit - position - HEAD.size and frames.is_boundary(position + HEAD.size + length)
        for own in (
            length if fits else None,
            frames.chunk_length(position),
        ):  # a chunk whose opcode or length is what is damaged
            if own is not None and (opcode == Opcode.CHUNK or frames.chunk(position, own) is not None):
                end = position + HEAD.size + own
                if frames.is_boundary(end):
                    start_ns, end_ns = struct.unpack("<QQ", self.source.at(position + HEAD.size, 16))
                    self._add_block(MessageBlock(position, end - position, end, start_ns, end_ns, "", trusted=False))
                    return end
        if not fits:
            return None
        whole = HEAD.size + length
        if opcode >= PRIVATE:
            self.items.append(RecordSpan(opcode, position, whole))
        elif (opcode in SUMMARY and self._ended) or (opcode == Opcode.MESSAGE_INDEX and self._last is not None):
            self.losses.add_harmless(
                f"the {records.name_of(opcode)} record at byte {position} is damaged; a new one can be made"
            )
            if isinstance(self._last, MessageBlock) and self._last.end == position:
                self._last.end += whole
        else:
            self.gaps.append(Gap(position, whole, f"the {records.name_of(opcode)} record here is damaged"))
        return position + whole

    def _messages(self, position: int, length: int) -> int | None:
        """Adds messages outside chunks as one block; the last one only if its end is certain."""
        limit = self.frames.limit
        raw = self.source.at(position, min(max(RUN_BYTES, HEAD.size + length), limit - position))
        offsets, _, end = messages.scan(raw, bare=True)
        if not self.frames.ends_run(position + end, raw, offsets, self.sections.channels() | self._used_channels):
            end = int(offsets[-1])
        next_log = -1 if self.has_summary else self.frames.find(position, position + end, LOG_START)
        if next_log >= 0:
            end = int(offsets[offsets <= next_log - position][-1])
        if not end:
            return None
        found = messages.parse(raw[:end], position)
        times = found.heads["log_time"]
        self._used_channels.update(np.unique(found.heads["channel"]).tolist())
        block = MessageBlock(position, end, position + end, int(times.min()), int(times.max()), None, trusted=False)
        self.items.append(block)
        self._last = self._open_gap
        if self._open_gap is not None:
            self.doubtful.append((block, self._open_gap))
        return position + end

    def _gap(self, position: int, limit: int) -> int:
        """Goes on to the next valid record; the bytes between are lost."""
        frames = self.frames
        after = frames.find_next(position + 1, limit, self.sections.channels() | self._used_channels)
        gap = Gap(position, after - position, frames.broken_framing(position))
        if frames.candidates > MAX_CANDIDATES:
            gap.reason += "; the search for what follows was given up after too many false starts"
        first = self.source.at(position, min(64, frames.limit - position))
        if len(first) >= HEAD.size + 16 and first[0] == Opcode.CHUNK:
            start_ns, end_ns = struct.unpack_from("<QQ", first, HEAD.size)
            if start_ns <= end_ns < LATEST_NS:
                gap.start_ns, gap.end_ns = start_ns, end_ns
        following = frames.head(after)
        if self._ended and not self._closed and (following is None or following[0] in SUMMARY | {Opcode.FOOTER, *DEFINITIONS}):
            self.losses.add_harmless(
                f"{after - position} bytes of the summary at byte {position} are damaged; a new one can be made"
            )
            return after
        if self._ended and frames.is_zero(position, after):
            self.losses.add_harmless(f"{after - position} zero bytes follow the end of the log, at byte {position}")
            return after
        self.gaps.append(gap)
        self._last = self._open_gap = gap
        return after
