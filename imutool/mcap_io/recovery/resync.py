"""Find the next valid record after corrupt bytes.

A record is valid when the lengths inside it agree (a chunk's data with the chunk, an index's entries with the index, the texts
of a definition with the definition). A message has no such lengths: the records that follow it must be valid.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from imutool.array_types import Int64
from imutool.errors import LogError
from imutool.mcap_io.blocks import Attachment
from imutool.mcap_io.codec import messages, records
from imutool.mcap_io.codec.messages import FIXED
from imutool.mcap_io.codec.records import CHUNK_HEAD, HEAD, MAGIC
from imutool.mcap_io.recovery.summary import PRIVATE
from imutool.mcap_io.storage.source import Source

WINDOW = 1 << 20
MAX_SMALL = 1 << 24  # bytes of a record that is parsed whole: a definition, metadata, an entry of the summary
MAX_CANDIDATES = 1 << 17  # parsed in one file; more occur only in a file made to be searched forever
MIN_PROOF_BYTES = 1 << 30  # that may be unpacked while chunks are sought in damaged bytes
CHAIN = 3  # records in a row that prove a message after a gap
LOG_START = MAGIC + bytes([Opcode.HEADER])

SMALL: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.FOOTER: Footer,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.STATISTICS: Statistics,
    Opcode.METADATA: Metadata,
    Opcode.METADATA_INDEX: MetadataIndex,
    Opcode.SUMMARY_OFFSET: SummaryOffset,
    Opcode.DATA_END: DataEnd,
}
IN_MEMORY = {Opcode.MESSAGE, Opcode.MESSAGE_INDEX}  # as a whole
# The shortest body of each
MIN_LENGTH = {
    Opcode.HEADER: 8,
    Opcode.FOOTER: 20,
    Opcode.SCHEMA: 14,
    Opcode.CHANNEL: 16,
    Opcode.MESSAGE: FIXED,
    Opcode.CHUNK: CHUNK_HEAD.size + 8,
    Opcode.MESSAGE_INDEX: 6,
    Opcode.CHUNK_INDEX: 56,
    Opcode.ATTACHMENT: 36,
    Opcode.ATTACHMENT_INDEX: 40,
    Opcode.STATISTICS: 46,
    Opcode.METADATA: 8,
    Opcode.METADATA_INDEX: 20,
    Opcode.SUMMARY_OFFSET: 17,
    Opcode.DATA_END: 4,
}
_MIN_LENGTH = np.full(256, 2**63, np.uint64)
_MIN_LENGTH[[int(o) for o in MIN_LENGTH]] = list(MIN_LENGTH.values())
_KNOWN = _MIN_LENGTH < 2**63
_CANDIDATE = np.dtype([("opcode", "u1"), ("length", "<u8")])


class RecordFrames:
    """Checks of record framing in one file, up to a byte.

    Raises (everywhere):
        LogError: the disk does not give the bytes.
    """

    def __init__(self, source: Source, limit: int, max_chunk: int) -> None:
        self.source, self.limit, self.max_chunk, self.candidates = source, limit, max_chunk, 0
        self._proof_bytes = max(MIN_PROOF_BYTES, 4 * source.size)  # left to be unpacked in vain

    def head(self, position: int) -> tuple[int, int] | None:
        """Opcode and length of a record that fits into the file, or None."""
        if not 0 <= position <= self.limit - HEAD.size:
            return None
        opcode, length = self.source.head(position)
        if length > self.limit - position - HEAD.size or (opcode < PRIVATE and length < int(_MIN_LENGTH[opcode])):
            return None
        if opcode in IN_MEMORY and length > self.max_chunk:
            return None
        return opcode, length

    def is_magic(self, position: int) -> bool:
        """Whether the magic of a log stands there."""
        return position + len(MAGIC) <= self.limit and self.source.at(position, len(MAGIC)) == MAGIC

    def find(self, start: int, end: int, needle: bytes) -> int:
        """First offset of `needle` that begins in a stretch, or -1."""
        over = len(needle) - 1
        for at in range(start, end, WINDOW):
            raw = self.source.at(at, min(WINDOW + over, end + over - at, self.limit - at))
            if (found := raw.find(needle)) >= 0:
                return at + found
        return -1

    def is_zero(self, start: int, end: int) -> bool:
        """Whether all bytes of a stretch are zero."""
        return not any(self.source.at(at, min(WINDOW, end - at)).strip(b"\0") for at in range(start, end, WINDOW))

    def is_boundary(self, position: int) -> bool:
        """Whether a record can end here: the file ends, or another record or a log begins."""
        return position == self.limit or self.is_magic(position) or self.head(position) is not None

    def is_valid(self, position: int, opcode: int, length: int) -> bool:
        """Whether the lengths inside a record agree with its own; always False for a message."""
        if opcode == Opcode.CHUNK:
            return self.chunk(position, length) is not None
        if opcode == Opcode.MESSAGE_INDEX:
            (size,) = struct.unpack("<I", self.source.at(position + HEAD.size + 2, 4))
            return bool(size == length - 6 and size % 16 == 0)
        try:
            if opcode == Opcode.ATTACHMENT:
                return Attachment.of(self.source, position, length).length == HEAD.size + length
            kind = SMALL.get(opcode)
            if kind is None or length > MAX_SMALL:
                return False
            raw = self.source.at(position, HEAD.size + length)
            return records.build(records.parse(kind, raw[HEAD.size :], position)) == raw
        except LogError:
            return False

    def chunk(self, position: int, length: int) -> records.ChunkHead | None:
        """The head of a chunk whose record has this length, or None; its compression must be known."""
        whole = HEAD.size + length
        if whole > self.limit - position:
            return None
        try:
            head = records.ChunkHead.of(self.source.at(position, min(128, whole)), whole, position)
        except LogError:
            return None
        return head if head.compression in records.COMPRESSIONS.values() else None

    def chunk_length(self, position: int) -> int | None:
        """Length of a Chunk record from the fields inside it, where its own length field is damaged."""
        first = self.source.at(position, min(128, self.limit - position))
        if len(first) < HEAD.size + CHUNK_HEAD.size:
            return None
        name = CHUNK_HEAD.unpack_from(first, HEAD.size)[4]
        at = HEAD.size + CHUNK_HEAD.size + name
        if name > 4 or first[at - name : at].decode(errors="replace") not in records.COMPRESSIONS.values():
            return None
        if len(first) < at + 8:
            return None
        (packed,) = struct.unpack_from("<Q", first, at)
        length = at - HEAD.size + 8 + packed
        return int(length) if packed and length <= self.limit - position - HEAD.size else None

    def find_next(self, start: int, limit: int, channels: set[int]) -> int:
        """Offset of the next valid record or log from `start` on; `limit` if there is none."""
        for at in range(start, limit, WINDOW):
            for offset in self._candidates(self.source.at(at, min(WINDOW + len(MAGIC), self.limit - at)), at):
                position = at + offset
                if position >= limit or self.candidates > MAX_CANDIDATES:
                    return limit
                self.candidates += 1
                if self.is_magic(position) or self._is_plausible(position, channels):
                    return position
        return limit

    def _candidates(self, raw: bytes, at: int, *, chunks_only: bool = False) -> list[int]:
        """Offsets of possible records and magics, or of chunks alone, in `WINDOW` bytes."""
        view = np.frombuffer(raw, np.uint8)
        found: list[int] = []
        if len(view) >= HEAD.size:
            count = len(view) - HEAD.size + 1
            small = (view[8:] == 0) & (view[7 : 7 + count] == 0) & (view[6 : 6 + count] == 0)
            small &= (view[:count] == Opcode.CHUNK.value) if chunks_only else _KNOWN[view[:count]]
            offsets = np.flatnonzero(small[:WINDOW])
            heads = np.lib.stride_tricks.sliding_window_view(view, HEAD.size)[offsets].view(_CANDIDATE)[:, 0]
            room = self.limit - at - HEAD.size - offsets
            fits = (heads["length"] >= _MIN_LENGTH[heads["opcode"]]) & (heads["length"].astype(np.int64) <= room)
            found = offsets[fits].tolist()
        magic = -1 if chunks_only else raw.find(MAGIC)
        while 0 <= magic < WINDOW:
            found.append(magic)
            magic = raw.find(MAGIC, magic + 1)
        return sorted(found)

    def _is_plausible(self, position: int, channels: set[int]) -> bool:
        found = self.head(position)
        if found is None:
            return False
        opcode, length = found
        end = position + HEAD.size + length
        if opcode != Opcode.MESSAGE:
            return self.is_valid(position, opcode, length) and (opcode == Opcode.CHUNK or self.is_boundary(end))
        for _ in range(CHAIN):
            if channels and int.from_bytes(self.source.at(position + HEAD.size, 2), "little") not in channels:
                return False
            position += HEAD.size + length
            found = self.head(position)
            if found is None:
                return position == self.limit
            opcode, length = found
            if opcode != Opcode.MESSAGE:
                return self.is_valid(position, opcode, length)
        return True

    def holds_log(self, position: int, opcode: int, length: int) -> bool:
        """Whether another log begins inside a record, which was cut off; an attachment may hold one."""
        if self.find(position, position + HEAD.size + length, LOG_START) < 0:
            return False
        try:
            return opcode != Opcode.ATTACHMENT or not Attachment.of(self.source, position, length).check_crc(self.source)
        except LogError:
            return True

    def find_proven(self, start: int, end: int) -> int:
        """Offset of the first chunk in a stretch that its CRC proves, or -1."""
        for at in range(start, end, WINDOW):
            raw = self.source.at(at, min(WINDOW + len(MAGIC), self.limit - at))
            for offset in self._candidates(raw, at, chunks_only=True):
                if at + offset >= end or self._proof_bytes < 0:
                    return -1
                if self.proves(at + offset):
                    return at + offset
        return -1

    def proves(self, position: int) -> bool:
        """Whether a chunk begins there that its CRC proves."""
        opcode, length = self.source.head(position)
        head = self.chunk(position, length) if opcode == Opcode.CHUNK and HEAD.size + length <= self.max_chunk else None
        if head is None or not head.crc or head.size > self.max_chunk:
            return False
        self._proof_bytes -= head.size + length
        try:
            messages.parse(records.unpack(self.source.at(position, HEAD.size + length), position, self.max_chunk), position)
        except LogError:
            return False
        return True

    def ends_run(self, end: int, raw: bytes, offsets: Int64[np.ndarray, " n"], channels: set[int]) -> bool:
        """Whether the last message of a run ends at `end`: a record follows, perhaps a damaged one."""
        if self.is_boundary(end):
            return True
        room = self.limit - end
        if room >= HEAD.size:
            opcode, length = self.source.head(end)
            if opcode in MIN_LENGTH and opcode != Opcode.MESSAGE and length < 1 << 48:
                return True  # a record of another kind, which goes on beyond the end of the file or is damaged
        if room < HEAD.size + 2:
            return self.source.at(end, 1)[0] in MIN_LENGTH
        heads = [raw[at : at + HEAD.size + 2] for at in offsets[-256:].tolist()]
        if heads[-1] in heads[:-1]:
            return True  # as long as one before it on its channel
        following = self.source.at(end, HEAD.size + 2)
        opcode, length = HEAD.unpack_from(following)
        known = channels | {int.from_bytes(head[HEAD.size :], "little") for head in heads}
        if opcode == Opcode.MESSAGE and int.from_bytes(following[HEAD.size :], "little") in known:
            return True
        return bool(length <= room - HEAD.size and length >= FIXED and self.is_boundary(end + HEAD.size + length))

    def broken_framing(self, position: int) -> str:
        """Describes what is wrong with the record at a position."""
        room = self.limit - position - HEAD.size
        if room < 0:
            return "the log is cut short here, inside the head of a record"
        opcode, length = self.source.head(position)
        if opcode not in set(Opcode):
            return "no record begins here"
        name = records.name_of(opcode)
        if length > room:
            return f"the {name} record here says it has {length} bytes, and {room} are there"
        return f"the {name} record here is damaged"
