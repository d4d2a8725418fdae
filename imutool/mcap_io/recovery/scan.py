"""Scan a damaged log from its first byte to its last, record by record.

Every chunk is unpacked where it is met, because only its CRC proves it. Where framing breaks, the search goes on to the next
valid record (`resync`); the bytes between are a gap. A record without a CRC never hides a chunk that a CRC proves: a chunk that
begins inside one shows that the record was cut off there.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from itertools import chain

from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Header

from imutool.errors import LogError
from imutool.mcap_io.blocks import HEAD_BYTES, RUN_BYTES, Attachment, MessageBlock, RecordSpan, too_large
from imutool.mcap_io.codec import messages, records
from imutool.mcap_io.codec.records import DATA_END_SIZE, HEAD, MAGIC
from imutool.mcap_io.recovery.chunk_repair import UnreadableError, prove
from imutool.mcap_io.recovery.losses import LATEST_NS, Losses, reason
from imutool.mcap_io.recovery.resync import LOG_START, MAX_CANDIDATES, RecordFrames
from imutool.mcap_io.recovery.scan_events import Definition, Gap, LogEnd, LogStart, ScanResult
from imutool.mcap_io.recovery.summary import DEFINITIONS, PRIVATE, SUMMARY, moved_summary
from imutool.mcap_io.storage.source import Source

MAX_STARTS = 8  # bytes at which a moved summary may begin, the last ones before its footer
MAX_ITEMS = 5_000_000  # a 100 GB log has some 100 000 chunks; a file of nothing but empty ones would fill the memory


class Scan(ScanResult):
    """One pass over the records of a file.

    `listed` are the entries of an intact summary, by the offset of their chunk; they help to put damaged heads right.

    Raises:
        LogError: more records than any recorder writes.
    """

    def __init__(self, source: Source, limit: int, listed: Mapping[int, ChunkIndex], losses: Losses, max_chunk: int) -> None:
        super().__init__()
        self.source, self.limit, self.listed, self.losses, self.max_chunk = source, limit, listed, losses, max_chunk
        self.has_summary = limit < source.size  # an intact one, which begins at the limit
        self.frames = RecordFrames(source, limit, max_chunk)
        self._ended = self._closed = False  # past the data section of a log, and past its footer
        self._open_gap: Gap | None = None  # messages behind it may lie inside a damaged chunk
        self._summary_starts: list[int] = []  # where one may begin
        self._defined_until = -1  # where the last definition outside chunks ended
        self._unproven = -1  # where the last record began, if no CRC proves it

    def run(self) -> None:
        """Scans from the first byte to the limit."""
        position = self._start()
        while position < self.limit:
            if len(self.items) + len(self.gaps) > MAX_ITEMS:
                raise LogError(f"the log has more than {MAX_ITEMS} records", expected="one that a recorder made")
            after = self._step(position)
            position = self._gap(position) if after is None else after
        self._close()

    def _close(self) -> None:
        """Says how the file ends."""
        limit = self.limit
        if self.has_summary and not self._ended:
            self.losses.add_harmless(f"the DataEnd record before byte {limit} is damaged; a new one can be made")
            if self.gaps and (self.gaps[-1].offset, self.gaps[-1].end) == (limit - DATA_END_SIZE, limit):
                self.events.remove(self.gaps.pop())  # no message was in it
        elif self._ended and not self._closed and not self.has_summary:
            self.losses.add_harmless("the log ends inside its summary; a new one can be made")
        elif not self._ended and not (self.gaps and self.gaps[-1].end == limit):
            why = "the log stops here without an end: the recorder did not finish it, or it was cut off"
            self.add_gap(Gap(limit, 0, why))

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
        frames, head = self.frames, self.frames.head(position)
        if head is None and frames.is_magic(position):
            self._log_boundary(position)
            return position + len(MAGIC)
        opcode, length = head or (0, 0)
        if opcode == Opcode.MESSAGE:
            return self._messages(position, length)
        if opcode == Opcode.CHUNK:
            return self._chunk(position, length)
        if head is None or not frames.is_valid(position, *head):
            return self._damaged(position)
        cut_off = opcode == Opcode.ATTACHMENT and not self._is_whole(position, length)
        if cut_off or (not self.has_summary and frames.holds_log(position, *head)):
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
                self.add_gap(Gap(position, 0, "a log stops here without an end, and another begins"))
            self.losses.add_harmless(f"another log begins at byte {position}")
            self.events.append(LogStart(position))
            self._ended, self._closed, self.last, self._open_gap = False, False, None, None
        self._unproven = -1

    # ── chunks ───────────────────────────────────────────────────────────────────────────────────────────────────────

    def _chunk(self, position: int, length: int) -> int | None:
        """Handles a Chunk record: proven, without CRC, or damaged."""
        end = position + HEAD.size + length
        why = f"the chunk at byte {position} is damaged: its lengths contradict one another"
        tried = set[int]()
        for stated in chain((length,), self._other_lengths(position)):
            if stated in tried or not 0 <= stated <= self.frames.limit - position - HEAD.size:
                continue
            tried.add(stated)
            try:
                return self._take_chunk(position, HEAD.size + stated)
            except UnreadableError as error:  # its contents are proven and make no sense; what lies in them is theirs
                return self._lose_chunk(position, HEAD.size + stated, reason(error))
            except LogError as error:
                why = reason(error) if stated == length else why
        if (proven := self.frames.find_proven(position + 1, min(end, self.limit))) >= 0:
            return self.add_gap(
                Gap(position, proven - position, f"{why}; another chunk begins inside it", *self._times(position))
            )
        return self._lose_chunk(position, end - position, why) if self.frames.is_boundary(end) else None

    def _lose_chunk(self, position: int, length: int, why: str) -> int:
        self.last = self._open_gap = gap = Gap(position, length, why, *self._times(position))
        return self.add_gap(gap)

    def _other_lengths(self, position: int) -> Iterator[int]:
        """Lengths that a Chunk record may have whose own length is damaged."""
        if (inner := self.frames.chunk_length(position)) is not None:
            yield inner
        if (entry := self.listed.get(position)) is not None:
            yield entry.chunk_length - HEAD.size

    def _take_chunk(self, position: int, whole: int) -> int:
        """Adds a chunk of `whole` bytes; returns where it ends.

        Raises:
            LogError: nothing proves it.
        """
        if whole > self.max_chunk:
            raise too_large("chunk", position, whole, self.max_chunk)
        found, head, raw = prove(
            self.source.at(position, whole), position, self.listed.get(position), self.max_chunk, self.frames.is_boundary
        )
        block = MessageBlock(position, whole, position + whole, 0, 0, head.compression, trusted=False)
        self.add_block(block, found, head)
        start = raw[:HEAD_BYTES]
        if head.crc and block.counts:
            start = start[: HEAD.size] + struct.pack("<QQ", block.start_ns, block.end_ns) + start[HEAD.size + 16 :]
        if start != self.source.at(position, min(whole, HEAD_BYTES)):
            self.repaired[position] = start
            self.losses.add_harmless(f"the head of the chunk at byte {position} was damaged, and is repaired")
        self.last, self._open_gap, self._unproven = block, None, -1 if head.crc else position
        return block.end

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
        self.note_follower(position, opcode)
        if opcode == Opcode.MESSAGE_INDEX:
            self._open_gap = None
            self.add_message_index(position, self.source.at(position + HEAD.size, length))
        elif opcode == Opcode.HEADER:
            if self.header is None:
                self.header = records.parse(Header, self.source.at(position + HEAD.size, length), position)
        elif opcode in DEFINITIONS:
            body = self.source.at(position + HEAD.size, length)
            self.events.append(Definition(position, opcode, body))
            if position != self._defined_until:  # another log's summary may follow a part of this one's
                self._summary_starts.append(position)
            self._defined_until = end
            self.used_channels |= {int.from_bytes(body[:2], "little")} if opcode == Opcode.CHANNEL else set()
            if not self._ended:
                self.items.append(RecordSpan(opcode, position, end - position))
        elif opcode == Opcode.FOOTER:
            start, found = moved_summary(self.source, self._summary_starts[-MAX_STARTS:], position)
            if found is not None and not self.has_summary:
                self.summaries.append(found)
                while found.chunks and isinstance(self.events[-1], Definition) and self.events[-1].offset >= start:
                    self.events.pop()  # it says itself whose definitions these are
            self._closed = self.frames.is_magic(end)
            self.events.append(LogEnd(closed=True))
        elif opcode == Opcode.DATA_END:
            self.data_ends.append(position)
            self.events.append(LogEnd(closed=False))
            self._ended, self.last, self._open_gap = True, None, None
            self._summary_starts.append(end)
        elif opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
            self.items.append(RecordSpan(opcode, position, end - position))
        return end

    def _damaged(self, position: int) -> int | None:
        """Handles an invalid or unknown record; returns its end, or None where that is unknown."""
        frames = self.frames
        if frames.limit - position < HEAD.size:
            return None
        opcode, length = self.source.head(position)
        for own in self._other_lengths(position):
            if 0 <= own <= frames.limit - position - HEAD.size:  # opcode or length of a chunk is damaged
                try:
                    return self._take_chunk(position, HEAD.size + own)
                except LogError:
                    continue
        end = position + HEAD.size + length
        if not (length <= frames.limit - position - HEAD.size and frames.is_boundary(end)):
            return None
        if frames.find_proven((self._unproven if self._unproven >= 0 else position) + 1, end) >= 0:
            return None
        if opcode >= PRIVATE:
            self.items.append(RecordSpan(opcode, position, HEAD.size + length))
        elif (opcode in SUMMARY and self._ended) or (opcode == Opcode.MESSAGE_INDEX and self.last is not None):
            name = records.name_of(opcode)
            self.losses.add_harmless(f"the {name} record at byte {position} is damaged; a new one can be made")
            if isinstance(self.last, MessageBlock) and self.last.end == position:
                self.last.end = end
        else:
            self.add_gap(Gap(position, HEAD.size + length, f"the {records.name_of(opcode)} record here is damaged"))
        self._unproven = position
        return end

    def _messages(self, position: int, length: int) -> int | None:
        """Adds messages outside chunks as one block; the last one only if its end is certain."""
        raw = self.source.at(position, min(max(RUN_BYTES, HEAD.size + length), self.frames.limit - position))
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
        self.add_block(block, found, None)
        self.last, self._unproven = self._open_gap, position + int(found.offsets[-1])
        if self._open_gap is not None:
            self.doubtful.append((block, self._open_gap))
        return position + end

    # ── gaps ─────────────────────────────────────────────────────────────────────────────────────────────────────────

    def _gap(self, position: int) -> int:
        """Goes on to the next valid record; the bytes between are lost."""
        frames = self.frames
        if self._unproven >= 0 and (proven := frames.find_proven(self._unproven + 1, position)) >= 0:
            self.cut_back(self._unproven, position)
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
        self.add_gap(gap)
        self.last = self._open_gap = gap
        return after
