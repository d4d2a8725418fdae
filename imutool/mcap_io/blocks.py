"""Blocks of messages, single records and attachments of a log, by where their bytes lie.

The message indexes behind a chunk list its messages: enough to enter the chunk in a summary without unpacking it.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, ChunkIndex, Metadata

from imutool.array_types import Int64, UInt64
from imutool.errors import LogError
from imutool.mcap_io.codec import messages, records
from imutool.mcap_io.codec.messages import MESSAGE, Messages
from imutool.mcap_io.codec.records import CHUNK_HEAD, HEAD, MAGIC, ChunkHead
from imutool.mcap_io.storage.source import CUT_SHORT, Source, crc_of

INDEX_HEAD = struct.Struct("<BQHI")  # of a MessageIndex record: opcode, length, channel id and bytes of its entries
CHUNK = int(Opcode.CHUNK)  # a plain number is compared ten times as fast
HEAD_BYTES = 128  # hold a Chunk record up to its packed data, whatever its compression is called
RUN_BYTES = 1 << 20  # messages outside chunks are read in runs of about this size
MAX_TEXT = 1 << 16  # bytes of an attachment's name or media type
SAVE = "imutool repair saves the rest of the log"


class RecordSpan(NamedTuple):
    """One record outside chunks, opcode and length included."""

    opcode: int
    offset: int
    length: int

    def metadata(self, source: Source) -> Metadata:
        """Content of a Metadata record (LogError: damaged)."""
        found: Metadata = records.parse(Metadata, source.at(self.offset + HEAD.size, self.length - HEAD.size), self.offset)
        return found


@dataclass(slots=True)
class MessageBlock:
    """One Chunk record, or a run of messages outside chunks."""

    offset: int
    length: int
    end: int  # behind the message indexes that follow a chunk
    start_ns: int
    end_ns: int  # 0 of a chunk whose writer never set it
    compression: str | None  # None: a run outside chunks
    indexes: dict[int, int] = field(default_factory=dict)  # channel id to the offset of its MessageIndex record
    counts: dict[int, int] | None = None  # messages per channel id, once known
    trusted: bool = True  # False: no summary lists the block, or its message indexes lack some; unpacking proves what is in it
    edited: bool = False  # some of its messages are left out or have other channel ids than in its bytes
    recording: int = 0  # of the logs in a damaged file, the one that wrote it
    lost: bool = False

    @staticmethod
    def of_summary(entry: ChunkIndex, limit: int) -> MessageBlock:
        """A chunk as the summary describes it; a LogError if it would cross the byte `limit`."""
        offset, length = entry.chunk_start_offset, entry.chunk_length
        end = offset + length + entry.message_index_length
        if length < HEAD.size + CHUNK_HEAD.size or end > limit:
            raise LogError(f"the summary says the chunk at byte {offset} ends at byte {end}", expected=f"at most {limit}")
        indexes = dict(entry.message_index_offsets) if entry.message_index_length else {}
        times = entry.message_start_time, entry.message_end_time
        return MessageBlock(offset, length, end, *times, entry.compression, indexes)

    def may_hold(self, channels: set[int]) -> bool:
        """False when the block cannot hold a message of these channels."""
        known = (self.indexes if self.trusted else None) or self.counts
        return known is None or not known.keys().isdisjoint(channels)  # looks up the fewer of the two

    def head(self, raw: bytes | memoryview) -> ChunkHead:
        """The chunk's head, from its first `HEAD_BYTES` bytes or more (LogError: no chunk, or lengths that contradict)."""
        if HEAD.unpack_from(raw) != (CHUNK, self.length - HEAD.size):
            raise LogError(f"the summary lists a chunk at byte {self.offset}, and none begins there")
        return ChunkHead.of(raw, self.length, self.offset)


class MessageIndexes(NamedTuple):
    """Message indexes of one chunk: counts and entries (log time, offset) per channel id."""

    counts: dict[int, int]
    entries: UInt64[np.ndarray, "n 2"]  # channel after channel, in order of `counts`
    start_ns: int
    end_ns: int

    def messages(self, data: bytes | memoryview, offset: int) -> tuple[Messages, bool]:
        """The messages in the unpacked bytes of the chunk, and whether these are the ones it lists.

        Raises:
            LogError: the records do not fill the bytes exactly; `offset` is that of the chunk in the file.
        """
        if len(self.entries) == 1:
            found, stated = messages.parse(data, offset), (*self.counts, *self.entries[0].tolist())
            heads = found.heads
            return found, len(heads) == 1 and (
                int(heads["channel"][0]),
                int(heads["log_time"][0]),
                int(found.offsets[0]),
            ) == stated
        order = self.entries[:, 1].argsort(kind="stable")
        times, offsets = self.entries[order].view(np.int64).T
        found = messages.parse_at(data, offsets) or messages.parse(data, offset)
        if len(offsets) != len(found.offsets):
            return found, False
        channels = np.array([*self.counts], np.uint16).repeat([*self.counts.values()])[order]
        wrong = (found.heads["log_time"].view(np.int64) != times) | (found.heads["channel"] != channels)
        if found.offsets is not offsets:
            wrong |= found.offsets != offsets
        return found, not wrong.any()


def parse_message_indexes(raw: bytes | memoryview, block: MessageBlock, unpacked: int) -> MessageIndexes | None:
    """Message indexes behind a chunk of `unpacked` bytes; None if missing or wrong.

    `raw` is all that lies between the chunk and the block's end. The indexes are right when that is nothing but MessageIndex
    records, each channel's once and where the block says, and every entry lies within the chunk. Whether a message lies
    there, only the chunk itself can say.
    """
    if len(raw) == messages.SINGLE_INDEX.size:
        opcode, length, channel, size, time_ns, at = messages.SINGLE_INDEX.unpack(raw)
        right = (
            (opcode, length, size) == (Opcode.MESSAGE_INDEX, 22, 16) and at + MESSAGE.itemsize <= unpacked and time_ns < 2**63
        )
        if right and block.indexes == {channel: block.offset + block.length}:
            return MessageIndexes({channel: 1}, np.frombuffer(raw, "<u8", 2, INDEX_HEAD.size).reshape(1, 2), time_ns, time_ns)
    counts: dict[int, int] = {}
    parts: list[bytes | memoryview] = []
    seen: dict[int, int] = {}
    at, start = 0, block.offset + block.length
    while len(raw) - at >= INDEX_HEAD.size:
        opcode, length, channel, size = INDEX_HEAD.unpack_from(raw, at)
        following = at + HEAD.size + length
        if opcode != Opcode.MESSAGE_INDEX or size % 16 or length != size + 6 or following > len(raw) or channel in seen:
            return None
        seen[channel] = start + at
        if size:
            counts[channel] = size // 16
            parts.append(raw[at + INDEX_HEAD.size : following])
        at = following
    named = block.indexes
    if at != len(raw) or not seen.keys() >= named.keys() >= counts.keys() or any(seen[c] != named[c] for c in named):
        return None
    entries = np.frombuffer(b"".join(parts), "<u8").reshape(-1, 2)
    if not counts:
        return None
    (start_ns, _), (end_ns, last) = entries.min(axis=0).tolist(), entries.max(axis=0).tolist()
    if last + MESSAGE.itemsize > unpacked or end_ns >= 2**63:
        return None
    return MessageIndexes(counts, entries, start_ns, end_ns)


def read_message_indexes(source: Source, block: MessageBlock) -> tuple[ChunkHead, MessageIndexes | None]:
    """Head and message indexes of a chunk, without reading its packed data.

    Raises:
        LogError: there is no chunk where the block says, or its lengths contradict one another.
    """
    head, start = block.head(source.at(block.offset, min(block.length, HEAD_BYTES))), block.offset + block.length
    return head, parse_message_indexes(source.at(start, block.end - start), block, head.size)


def message_offsets(source: Source, block: MessageBlock, unpacked: int) -> Int64[np.ndarray, " n"] | None:
    """Message offsets in a chunk of `unpacked` bytes from its message indexes; None if wrong.

    Only a hint: the caller checks that messages lie there.
    """
    raw = source.at(block.offset + block.length, block.end - block.offset - block.length)
    parts, at = [], 0
    while len(raw) - at >= INDEX_HEAD.size:
        opcode, length, _, size = INDEX_HEAD.unpack_from(raw, at)
        if opcode != Opcode.MESSAGE_INDEX or size % 16 or length != size + 6 or length > len(raw) - at - HEAD.size:
            return None
        parts.append(np.frombuffer(raw, "<u8", size // 8, at + INDEX_HEAD.size)[1::2])
        at += HEAD.size + length
    offsets = np.sort(np.concatenate([np.zeros(0, np.uint64), *parts]))
    return offsets.view(np.int64) if len(offsets) and offsets[-1] < unpacked else None


def read_entries(source: Source, block: MessageBlock, channel: int) -> UInt64[np.ndarray, "n 2"]:
    """The (log time, offset) entries of one channel in one block, from its MessageIndex record.

    Raises:
        LogError: no such record where the log says it is.
    """
    offset = block.indexes[channel]
    opcode, length = source.head(offset) if offset + HEAD.size <= block.end else (0, 0)
    if opcode != Opcode.MESSAGE_INDEX or length < 6 or length > block.end - offset - HEAD.size:
        raise LogError(f"the summary lists a message index at byte {offset}, and none begins there")
    body = source.at(offset + HEAD.size, length)
    identity, size = struct.unpack_from("<HI", body)
    if identity != channel or size != length - 6 or size % 16:
        raise LogError(f"the message index at byte {offset} is damaged")
    return np.frombuffer(body, "<u8", offset=6).reshape(-1, 2)


def read_run(source: Source, position: int, first: int, limit: int) -> MessageBlock:
    """A run of messages outside chunks as one block; `first` is the size of its first record.

    Raises:
        LogError: the first record cannot be a message.
    """
    raw = source.at(position, max(first, min(RUN_BYTES, limit - position)))
    _, _, end = messages.scan(raw, bare=True)
    if not end:
        raise LogError(f"the message at byte {position} has {first - HEAD.size} bytes", expected=f"at least {messages.FIXED}")
    found = messages.parse(raw[:end], position)
    times = found.times()
    counts = dict(Counter(found.heads["channel"].tolist()))
    return MessageBlock(position, end, position + end, int(times.min()), int(times.max()), None, counts=counts)


def too_large(what: str, offset: int, size: int, max_chunk: int) -> LogError:
    """Error about a record that is not to come into memory."""
    return LogError(f"the {what} at byte {offset} has {size} bytes", expected=f"at most {max_chunk} (`max_chunk`)")


def cut_short(source: Source) -> LogError:
    """Error that says where a log without an end stops, found by following its records."""
    position, opcode, inside = len(MAGIC), 0, False
    while source.size - position >= HEAD.size and not inside:
        opcode, length = source.head(position)
        inside = length > source.size - position - HEAD.size
        position += 0 if inside else HEAD.size + length
    name = records.name_of(opcode) if position > len(MAGIC) or inside else "first"
    where = f"{'inside' if inside or name == 'first' else 'after'} the {name} record at byte {position}"
    return LogError(f"the log is cut short at byte {source.size}, {where}", expected="a log that ends", fix=CUT_SHORT)


@dataclass(frozen=True, slots=True)
class Attachment:
    """The fields of one Attachment record but for its data, which may be larger than memory."""

    offset: int
    length: int  # of the whole record
    log_time: int
    create_time: int
    name: str
    media_type: str
    size: int

    @staticmethod
    def of(source: Source, offset: int, length: int) -> Attachment:
        """The fields of the record that begins at `offset` and has `length` bytes behind its head.

        Raises:
            LogError: its lengths contradict one another.
        """
        at, end = offset + HEAD.size, offset + HEAD.size + length

        def part(size: int) -> bytes:
            nonlocal at
            if size > min(end - at, MAX_TEXT):
                raise LogError(f"the attachment at byte {offset} is damaged: its lengths contradict one another", fix=SAVE)
            at += size
            return source.at(at - size, size)

        def text() -> str:
            return part(struct.unpack("<I", part(4))[0]).decode(errors="replace")

        log_time, create_time = struct.unpack("<QQ", part(16))
        name, media_type = text(), text()
        (size,) = struct.unpack("<Q", part(8))
        if size + 4 != end - at:
            raise LogError(f"the attachment at byte {offset} is damaged: its data have {size} bytes", fix=SAVE)
        return Attachment(offset, HEAD.size + length, log_time, create_time, name, media_type, size)

    def index_at(self, offset: int) -> AttachmentIndex:
        """The entry of a summary for this attachment at another place."""
        return AttachmentIndex(
            offset=offset,
            length=self.length,
            log_time=self.log_time,
            create_time=self.create_time,
            data_size=self.size,
            name=self.name,
            media_type=self.media_type,
        )

    def check_crc(self, source: Source) -> bool:
        """Compares the CRC of the attachment with the stated one; false if none is stated.

        Raises:
            LogError: another CRC.
        """
        start, end = self.offset + HEAD.size, self.offset + self.length - 4
        (stated,) = struct.unpack("<I", source.at(end, 4))
        if stated and (crc := crc_of(source, start, end)) != stated:
            what = f"the attachment at byte {self.offset} is damaged: its CRC is {crc:08x}"
            raise LogError(what, expected=f"{stated:08x}", fix=SAVE)
        return bool(stated)
