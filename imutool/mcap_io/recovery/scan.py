"""Scan a damaged log from its first byte to its last, record by record.

Every chunk is unpacked where it is met, because only its CRC proves it. Where framing breaks, the search goes on to the next
valid record (`resync`); the bytes between are a gap. A record without a CRC never hides a chunk that a CRC proves: a chunk that
begins inside one shows that the record was cut off there.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Footer, Header

from imutool.errors import LogError
from imutool.mcap_io.blocks import HEAD_BYTES, RUN_BYTES, Attachment, MessageBlock, RecordSpan
from imutool.mcap_io.codec import messages, records
from imutool.mcap_io.codec.records import FOOTER_SIZE, HEAD, MAGIC, crc32
from imutool.mcap_io.index import MAX_SUMMARY
from imutool.mcap_io.recovery.chunk_repair import is_consistent, repair_head
from imutool.mcap_io.recovery.losses import LATEST_NS, Losses, reason
from imutool.mcap_io.recovery.resync import LOG_START, MAX_CANDIDATES, PRIVATE, SUMMARY, Gap, RecordFrames
from imutool.mcap_io.storage.source import Source

MAX_ITEMS = 5_000_000  # a 100 GB log has some 100 000 chunks; a file of nothing but empty ones would fill the memory
DEFINITIONS = (Opcode.SCHEMA, Opcode.CHANNEL)

ChunkKey = tuple[int, int, int]  # start and end in ns, unpacked bytes: what a summary says of a chunk wherever it lies


class Summary(NamedTuple):
    """A summary that its CRC proves; `base` is the byte from which it counts."""

    base: int
    definitions: list[tuple[int, bytes]]
    chunks: list[ChunkIndex]


@dataclass(slots=True)
class ScannedBlock:
    """A block of messages as the scan met it."""

    block: MessageBlock
    key: ChunkKey
    crc: int  # 0: nothing proves it
    definitions: list[tuple[int, bytes]]
    evidence: int = 0  # for the recording it is assigned to, the more the better


class LogStart(NamedTuple):
    """Magic and Header of a log."""

    offset: int


class LogEnd(NamedTuple):
    """Footer and magic of a log."""

    offset: int


class Definition(NamedTuple):
    """A Schema or Channel record outside chunks, which no CRC covers."""

    offset: int
    opcode: int
    body: bytes


Event = LogStart | LogEnd | Definition | ScannedBlock | Gap  # what decides whose log a block is, in file order


class Scan:
    """One pass over the records of a file.

    `listed` are the entries of an intact summary, by the offset of their chunk; they help to put damaged heads right.

    Raises:
        LogError: more records than any recorder writes.
    """

    def __init__(self, source: Source, limit: int, listed: Mapping[int, ChunkIndex], losses: Losses, max_chunk: int) -> None:
        self.source, self.limit, self.listed, self.losses, self.max_chunk = source, limit, listed, losses, max_chunk
        self.has_summary = limit < source.size  # an intact one, which begins at the limit
        self.frames = RecordFrames(source, limit, max_chunk)
        self.items: list[MessageBlock | RecordSpan] = []
        self.events: list[Event] = []
        self.gaps: list[Gap] = []
        self.summaries: list[Summary] = []
        self.doubtful: list[tuple[MessageBlock, Gap]] = []  # messages that may be the contents of a damaged chunk
        self.repaired: dict[int, bytes] = {}  # heads of chunks that their contents prove to be damaged
        self.header: Header | None = None
        self.data_ends: list[int] = []
        self.used_channels: set[int] = set()
        self._closed = False  # past a footer
        self._ended = False  # past the data section of a log
        self._last: MessageBlock | Gap | None = None  # what message indexes would belong to
        self._open_gap: Gap | None = None  # messages behind it may lie inside a damaged chunk
        self._unproven = -1  # where the last record began, if no CRC proves it

    def run(self) -> None:
        """Scans from the first byte to the limit."""
        position = self._start()
        while position < self.limit:
            if len(self.items) + len(self.gaps) > MAX_ITEMS:
                raise LogError(
                    f"the log has more than {MAX_ITEMS} chunks and other records", expected="one that a recorder made"
                )
            after = self._step(position)
            position = self._gap(position) if after is None else after
        self._close()

    def _close(self) -> None:
        """Says how the file ends."""
        limit = self.limit
        if self.has_summary and not self._ended:
            self.losses.add_harmless(f"the DataEnd record before byte {limit} is damaged; a new one can be made")
        elif self._ended and not self._closed and not self.has_summary:
            self.losses.add_harmless("the log ends inside its summary; a new one can be made")
        elif not self._ended and not (self.gaps and self.gaps[-1].end == limit):
            why = "the log stops here without an end: the recorder did not finish it, or it was cut off"
            self._add_gap(Gap(limit, 0, why))

    def _start(self) -> int:
        """Checks the magic and the Header; returns where records begin."""
        at = len(MAGIC)
        self.events.append(LogStart(0))
        if not self.frames.is_magic(0):
            self.losses.add_harmless("the file does not begin as an MCAP log does")
            head = self.frames.head(at)
            if head is None or head[0] != Opcode.HEADER or not self.frames.is_valid(at, *head):
                return 0
        return at

    def _step(self, position: int) -> int | None:
        """Handles the record at a position; returns the next offset, None if the framing is broken."""
        frames = self.frames
        head = frames.head(position)
        if head is None and frames.is_magic(position):
            self._log_boundary(position)
            return position + len(MAGIC)
        if head is not None and head[0] == Opcode.MESSAGE:
            return self._messages(position, head[1])
        if head is not None and head[0] == Opcode.CHUNK:
            return self._chunk(position, head[1])
        if head is None or not frames.is_valid(position, *head):
            return self._damaged(position)
        if head[0] == Opcode.ATTACHMENT and not self._is_whole(position, head[1]):
            return None
        if not self.has_summary and frames.holds_log(position, *head):
            return None
        return self._record(position, *head)

    def _is_whole(self, position: int, length: int) -> bool:
        """Whether an attachment ends where it says: its CRC proves it, or a record follows."""
        if self.frames.is_boundary(position + HEAD.size + length):
            return True
        try:
            return Attachment.of(self.source, position, length).check_crc(self.source)
        except LogError:
            return False

    def _log_boundary(self, position: int) -> None:
        """Handles a magic inside the file: a log begins if a Header follows, else one has ended."""
        head = self.frames.head(position + len(MAGIC))
        if position and head is not None and head[0] == Opcode.HEADER:
            if not self._ended:
                self._add_gap(Gap(position, 0, "a log stops here without an end, and another begins"))
            self.losses.add_harmless(f"another log begins at byte {position}")
            self.events.append(LogStart(position))
            self._ended, self._closed, self._last, self._open_gap = False, False, None, None
        self._unproven = -1

    # ── chunks ───────────────────────────────────────────────────────────────────────────────────────────────────────

    def _chunk(self, position: int, length: int) -> int | None:
        """Handles a Chunk record: proven, without CRC, or damaged."""
        end = position + HEAD.size + length
        entry = self.listed.get(position)
        why = f"the chunk at byte {position} is damaged: its lengths contradict one another"
        for stated in dict.fromkeys((length, *self._other_lengths(position))):
            if not 0 <= stated <= self.frames.limit - position - HEAD.size:
                continue
            try:
                return self._take_chunk(position, HEAD.size + stated, entry)
            except LogError as error:
                why = reason(error) if stated == length else why
        if (proven := self.frames.find_proven(position + 1, min(end, self.limit))) >= 0:
            return self._add_gap(Gap(position, proven - position, f"{why}; another chunk begins inside it", *self._times(position)))
        if self.frames.is_boundary(end) and end <= self.limit:
            self._last = self._open_gap = gap = Gap(position, end - position, why, *self._times(position))
            self._add_gap(gap)
            return end
        return None

    def _other_lengths(self, position: int) -> Iterator[int]:
        """Lengths that a Chunk record may have whose own length is damaged."""
        if (inner := self.frames.chunk_length(position)) is not None:
            yield inner
        if (entry := self.listed.get(position)) is not None:
            yield entry.chunk_length - HEAD.size

    def _take_chunk(self, position: int, whole: int, entry: ChunkIndex | None) -> int:
        """Adds a chunk of `whole` bytes; returns where it ends.

        Raises:
            LogError: nothing proves it.
        """
        if whole > self.max_chunk:
            raise too_large(position, whole, self.max_chunk)
        raw = self.source.at(position, whole)
        try:
            found, head = self._proof(raw, position, entry)
        except LogError:
            better = repair_head(raw, position, entry, self.max_chunk)
            if better is None:
                raise
            found, head = self._proof(better, position, None)
            raw = better
        block = MessageBlock(position, whole, position + whole, 0, 0, head.compression, trusted=False)
        self._add_block(block, found, head)
        if head.crc and block.counts and (head.start_ns, head.end_ns) != (block.start_ns, block.end_ns):
            raw = raw[: HEAD.size] + struct.pack("<QQ", block.start_ns, block.end_ns) + raw[HEAD.size + 16 : HEAD_BYTES]
        if raw[:HEAD_BYTES] != self.source.at(position, min(whole, HEAD_BYTES)):
            self.repaired[position] = raw[:HEAD_BYTES]
            self.losses.add_harmless(f"the head of the chunk at byte {position} was damaged, and is repaired")
        self._last, self._open_gap, self._unproven = block, None, -1 if head.crc else position
        return block.end

    def _proof(self, raw: bytes, position: int, entry: ChunkIndex | None) -> tuple[messages.Messages, records.ChunkHead]:
        """Contents and head of a chunk that its CRC proves, or of one without CRC that nothing contradicts.

        Raises:
            LogError: damaged.
        """
        if HEAD.unpack_from(raw) != (Opcode.CHUNK, len(raw) - HEAD.size):
            raise LogError(f"the head of the chunk at byte {position} is damaged")
        head = records.ChunkHead.of(raw[:HEAD_BYTES], len(raw), position)
        found = messages.parse(records.unpack(raw, position, self.max_chunk), position)
        if not head.crc and not is_consistent(raw, position, entry):
            raise LogError(f"the head of the chunk at byte {position} is damaged, and it has no CRC to tell by")
        if not head.crc and not self.frames.is_boundary(position + len(raw)):
            raise LogError(f"the chunk at byte {position} has no CRC, and no record follows it")
        return found, head

    def _add_block(self, block: MessageBlock, found: messages.Messages, head: records.ChunkHead | None) -> None:
        """Notes the counts, times and definitions of a block."""
        times = found.heads["log_time"][found.heads["log_time"] < LATEST_NS]
        block.counts = dict(Counter(found.heads["channel"].tolist()))
        if len(times):
            block.start_ns, block.end_ns = int(times.min()), int(times.max())
        defined = [(opcode, found.data[first : first + length].tobytes()) for opcode, first, length in found.definitions]
        self.items.append(block)
        size, crc = (head.size, head.crc) if head else (block.length, 0)
        self.events.append(ScannedBlock(block, (block.start_ns, block.end_ns, size), crc, defined))
        self.used_channels.update(block.counts)

    def _times(self, position: int) -> tuple[int | None, int | None]:
        """Start and end that the head of a damaged chunk states, if they can be."""
        first = self.source.at(position, min(HEAD.size + 16, self.frames.limit - position))
        if len(first) == HEAD.size + 16 and first[0] == Opcode.CHUNK:
            start_ns, end_ns = struct.unpack_from("<QQ", first, HEAD.size)
            if 0 < start_ns <= end_ns < LATEST_NS:
                return start_ns, end_ns
        return None, None

    # ── other records ────────────────────────────────────────────────────────────────────────────────────────────────

    def _record(self, position: int, opcode: int, length: int) -> int:
        """Takes in a valid record; returns where it ends."""
        end = position + HEAD.size + length
        self._unproven = position
        if opcode == Opcode.MESSAGE_INDEX:
            self._message_index(position, length)
        elif opcode == Opcode.HEADER:
            if self.header is None:
                self.header = records.parse(Header, self.source.at(position + HEAD.size, length), position)
        elif opcode in DEFINITIONS:
            self.events.append(Definition(position, opcode, self.source.at(position + HEAD.size, length)))
            if not self._ended:
                self.items.append(RecordSpan(opcode, position, end - position))
        elif opcode == Opcode.FOOTER:
            self._moved_summary(position)
            self._closed = self.frames.is_magic(end)
            self.events.append(LogEnd(end))
        elif opcode == Opcode.DATA_END:
            self.data_ends.append(position)
            self._ended, self._last, self._open_gap = True, None, None
        elif opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
            self.items.append(RecordSpan(opcode, position, end - position))
        return end

    def _moved_summary(self, position: int) -> None:
        """Reads a summary that its CRC proves although it does not lie where the footer says."""
        if not self._ended or not self.data_ends:
            return
        footer = records.parse(Footer, self.source.at(position + HEAD.size, FOOTER_SIZE - HEAD.size), position)
        start, stop = self.data_ends[-1] + HEAD.size + 4, position + FOOTER_SIZE - 4
        if self.has_summary or not footer.summary_crc or not footer.summary_start or stop - start > MAX_SUMMARY:
            return
        raw = self.source.at(start, stop - start)
        if crc32(raw) == footer.summary_crc:
            summary = parse_summary(raw[: position - start], start - footer.summary_start)
            self.summaries += [] if summary is None else [summary]

    def _message_index(self, position: int, length: int) -> None:
        """Assigns a message index to the chunk before it, or counts the messages of a chunk that is gone."""
        last, self._open_gap = self._last, None
        body = self.source.at(position + HEAD.size, length)
        channel, entries = int.from_bytes(body[:2], "little"), np.frombuffer(body, "<u8", offset=6).reshape(-1, 2)
        end = position + HEAD.size + length
        if isinstance(last, MessageBlock) and last.end == position:
            counts = last.counts or {}
            if not len(entries) or (counts.get(channel) == len(entries) and channel not in last.indexes):
                last.end = end
                if len(entries):
                    last.indexes[channel] = position
                return
        if not len(entries):
            return
        if not isinstance(last, Gap):
            self._last = last = Gap(position, 0, "a chunk is gone from here: only its message indexes are left")
            self._add_gap(last)
        last.count(channel, entries)

    def _damaged(self, position: int) -> int | None:
        """Handles an invalid or unknown record; returns its end, or None where that is unknown."""
        frames = self.frames
        if frames.limit - position < HEAD.size:
            return None
        opcode, length = self.source.head(position)
        entry = self.listed.get(position)
        for own in self._other_lengths(position):
            if 0 <= own <= frames.limit - position - HEAD.size:  # opcode or length of a chunk is damaged
                try:
                    return self._take_chunk(position, HEAD.size + own, entry)
                except LogError:
                    continue
        end = position + HEAD.size + length
        if not (length <= frames.limit - position - HEAD.size and frames.is_boundary(end)):
            return None
        if frames.find_proven(position + 1, end) >= 0:
            return None
        if opcode >= PRIVATE:
            self.items.append(RecordSpan(opcode, position, HEAD.size + length))
        elif (opcode in SUMMARY and self._ended) or (opcode == Opcode.MESSAGE_INDEX and self._last is not None):
            name = records.name_of(opcode)
            self.losses.add_harmless(f"the {name} record at byte {position} is damaged; a new one can be made")
            if isinstance(self._last, MessageBlock) and self._last.end == position:
                self._last.end = end
        else:
            self._add_gap(Gap(position, HEAD.size + length, f"the {records.name_of(opcode)} record here is damaged"))
        self._unproven = position
        return end

    def _messages(self, position: int, length: int) -> int | None:
        """Adds messages outside chunks as one block; the last one only if its end is certain."""
        limit = self.frames.limit
        raw = self.source.at(position, min(max(RUN_BYTES, HEAD.size + length), limit - position))
        offsets, _, end = messages.scan(raw, bare=True)
        if not self.frames.ends_run(position + end, raw, offsets, self.used_channels):
            end = int(offsets[-1])
        next_log = -1 if self.has_summary else self.frames.find(position, position + end, LOG_START)
        if next_log >= 0:
            end = int(offsets[offsets <= next_log - position][-1])
        if not end:
            return None
        found = messages.parse(raw[:end], position)
        block = MessageBlock(position, end, position + end, 0, 0, None, trusted=False)
        self._add_block(block, found, None)
        self._last, self._unproven = self._open_gap, position + int(found.offsets[-1])
        if self._open_gap is not None:
            self.doubtful.append((block, self._open_gap))
        return position + end

    # ── gaps ─────────────────────────────────────────────────────────────────────────────────────────────────────────

    def _gap(self, position: int) -> int:
        """Goes on to the next valid record; the bytes between are lost."""
        frames = self.frames
        if self._unproven >= 0 and (proven := frames.find_proven(self._unproven + 1, position)) >= 0:
            self._cut_back(self._unproven, position)
            position, after = self._unproven, proven
        else:
            after = frames.find_next(position + 1, self.limit, self.used_channels)
        self._unproven = -1
        gap = Gap(position, after - position, frames.broken_framing(position), *self._times(position))
        if frames.candidates > MAX_CANDIDATES:
            gap.reason += "; the search for what follows was given up after too many false starts"
        following = frames.head(after)
        if self._ended and not self._closed and (following is None or following[0] in SUMMARY | {Opcode.FOOTER, *DEFINITIONS}):
            self.losses.add_harmless(f"{gap.length} bytes of the summary at byte {position} are damaged; a new one can be made")
            return after
        if self._ended and frames.is_zero(position, after):
            self.losses.add_harmless(f"{gap.length} zero bytes follow the end of the log, at byte {position}")
            return after
        self._add_gap(gap)
        self._last = self._open_gap = gap
        return after

    def _cut_back(self, start: int, end: int) -> None:
        """Gives up the last record, which a proven chunk shows to be cut off."""
        for block in reversed(self.items[-1:]):
            if isinstance(block, MessageBlock) and block.compression is None and block.offset + block.length == end:
                block.length, block.end = start - block.offset, start
            elif isinstance(block, MessageBlock) and block.end == end:
                block.end = start
                block.indexes = {channel: at for channel, at in block.indexes.items() if at < start}
            elif isinstance(block, RecordSpan) and block.offset == start:
                self.items.pop()

    def _add_gap(self, gap: Gap) -> int:
        """Adds a gap; returns where it ends."""
        self.gaps.append(gap)
        self.events.append(gap)
        return gap.end


def too_large(offset: int, size: int, max_chunk: int) -> LogError:
    """Error about a chunk that is not to come into memory."""
    return LogError(f"the chunk at byte {offset} has {size} bytes", expected=f"at most {max_chunk} (`max_chunk`)")


def parse_summary(raw: bytes, base: int) -> Summary | None:
    """Definitions and chunk indexes of a summary; None where other records are in it."""
    found = Summary(base, [], [])
    at = 0
    while len(raw) - at >= HEAD.size:
        opcode, length = HEAD.unpack_from(raw, at)
        body = raw[at + HEAD.size : at + HEAD.size + length]
        if opcode in DEFINITIONS:
            found.definitions.append((opcode, body))
        elif opcode == Opcode.CHUNK_INDEX:
            with suppress(LogError):
                found.chunks.append(records.parse_chunk_index(body, at))
        elif opcode not in SUMMARY and opcode < PRIVATE:
            return None
        at += HEAD.size + length
    return found if at == len(raw) else None
