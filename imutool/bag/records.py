"""Records of a ROS 1 bag (format 2.0) to and from bytes.

Format: http://wiki.ros.org/Bags/Format/2.0. Every length read is compared with the available bytes. The format has
no checksums, but bz2 and some lz4 chunks do.
"""

from __future__ import annotations

import bz2
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import lz4.frame

from imutool.errors import LogError

MAGIC = b"#ROSBAG V2.0\n"
FIRST_RECORD = 4096  # header and padding of the bag header record, so that it can be filled in at the end
HEAD_LIMIT = 4096  # of a record's fields: a topic is the longest, and a definition's text is not among them
CHUNK_LIMIT = 256 << 20  # bytes, packed and unpacked; rosbag's own are 768 KiB or one message
DEFINITION_LIMIT = 4 << 20  # bytes of a message's definition; the longest common one has 10 000
KIND = re.compile(r"\w+(/\w+)*", re.ASCII)
U32 = struct.Struct("<I")


class Op(IntEnum):
    """Kinds of records."""

    MESSAGE = 2
    BAG = 3
    INDEX = 4
    CHUNK = 5
    INFO = 6
    CONNECTION = 7


NEEDED: Mapping[int, Mapping[bytes, int]] = {  # fields with their sizes
    Op.MESSAGE: {b"conn": 4, b"time": 8},
    Op.BAG: {b"index_pos": 8, b"conn_count": 4, b"chunk_count": 4},
    Op.INDEX: {b"conn": 4, b"count": 4},
    Op.CHUNK: {b"size": 4},
    Op.INFO: {b"chunk_pos": 8, b"count": 4},
    Op.CONNECTION: {b"conn": 4},
}
# what writers put ahead of the field `op`: nothing, or some of the fields with their lengths
AHEAD = {Op.CHUNK: (0, 13, 19, 20, 32, 33), Op.MESSAGE: (0, 13, 17, 30)}


class Head(NamedTuple):
    """A record without its data, which begin at `data_at` and may be cut off."""

    op: int
    fields: Mapping[bytes, bytes]
    at: int
    data_at: int
    size: int

    @property
    def end(self) -> int:
        """The byte behind the record."""
        return self.data_at + self.size

    def number(self, name: bytes) -> int:
        """A field that is an unsigned number."""
        return int.from_bytes(self.fields[name], "little")

    @property
    def time_ns(self) -> int:
        """The time of a message record."""
        seconds, nanoseconds = struct.unpack("<II", self.fields[b"time"])
        return int(seconds) * 10**9 + int(nanoseconds)


class Connection(NamedTuple):
    """Who published what: a topic, its type in ROS 1 spelling, and the whole record."""

    number: int
    topic: str
    kind: str
    record: bytes


@dataclass(frozen=True)
class Loss:
    """A byte range of a bag that could not be read, and how many messages were in it."""

    offset: int
    length: int
    reason: str
    messages: int | None = None


class Message(NamedTuple):
    """Place of one message in the bytes of its chunk."""

    connection: int
    time_ns: int
    at: int
    data_at: int
    end: int


class ChunkInfo(NamedTuple):
    """Offset of a chunk, its first time, and how many messages of each connection it holds."""

    offset: int
    first_ns: int
    counts: Mapping[int, int]


class Chunk(NamedTuple):
    """One chunk's bytes, unpacked, and its messages; `whole` when nothing in it was lost."""

    offset: int
    length: int
    data: bytes
    messages: list[Message]
    whole: bool


def fields(data: bytes, at: int, end: int) -> dict[bytes, bytes] | None:
    """Named values that fill a byte range exactly, or None."""
    found: dict[bytes, bytes] = {}
    while at < end:
        if end - at < 4:
            return None
        (size,) = U32.unpack_from(data, at)
        first, at = at + 4, at + 4 + size
        if at > end:
            return None
        name, equals, value = data[first:at].partition(b"=")
        if not (equals and name.isascii()):
            return None
        found[name] = value
    return found


def head(data: bytes, at: int) -> Head | None:
    """Head of the record at a byte; None if cut off or of no known kind."""
    if len(data) - at < 8:
        return None
    (size,) = U32.unpack_from(data, at)
    if size > HEAD_LIMIT or size > len(data) - at - 8:
        return None
    found = fields(data, at + 4, at + 4 + size)
    if found is None or len(op := found.get(b"op", b"")) != 1:
        return None
    if (needed := NEEDED.get(op[0])) is None or (op[0] == Op.CHUNK and b"compression" not in found):
        return None
    for name, length in needed.items():  # a generator takes twice as long, of each message
        if len(found.get(name, b"")) != length:
            return None
    (length,) = U32.unpack_from(data, at + 4 + size)
    return Head(op[0], found, at, at + 8 + size, length)


def next_head(data: bytes, op: Op, start: int) -> Head | None:
    """Next record of a kind at or behind a byte, by the bytes that each head contains."""
    sign = b"\4\0\0\0op=" + bytes([op])
    at = data.find(sign, start)
    while at >= 0:
        for ahead in AHEAD[op]:
            if at - 4 - ahead >= start and (found := head(data, at - 4 - ahead)) is not None and found.op == op:
                return found
        at = data.find(sign, at + 1)
    return None


def connection(found: Head, data: bytes, record: bytes) -> Connection:
    """Parses a connection record.

    Raises:
        LogError: it lacks what every reader asks of it, or holds something else.
    """
    inner = fields(data, 0, len(data))
    if inner is None or not inner.keys() >= {b"type", b"md5sum", b"message_definition"}:
        raise LogError("a connection record is damaged", expected="type, md5sum and message_definition")
    try:
        topic = found.fields.get(b"topic", b"").decode()
        kind, _, _ = (inner[name].decode() for name in (b"type", b"md5sum", b"message_definition"))
        inner.get(b"callerid", b"").decode()
    except UnicodeDecodeError as error:
        raise LogError(f"a connection record is damaged ({error})", expected="text in UTF-8") from error
    if not (topic.isprintable() and topic and KIND.fullmatch(kind) and inner.get(b"latching", b"") in (b"", b"0", b"1")):
        raise LogError(f"a connection record is damaged: topic {topic!r} of type {kind!r}")
    return Connection(found.number(b"conn"), topic, kind, record)


def chunk_info_of(found: Head, data: bytes) -> ChunkInfo:
    """Start time of a chunk and its messages by connection, as the bag's index states them."""
    start = found.fields.get(b"start_time", bytes(8))
    first_ns = int.from_bytes(start[:4], "little") * 10**9 + int.from_bytes(start[4:8], "little")
    return ChunkInfo(found.number(b"chunk_pos"), first_ns, dict(struct.iter_unpack("<II", data[: len(data) // 8 * 8])))


def unpack(compression: str, packed: bytes, size: int, *, cut: bool) -> bytes:
    """Contents of a chunk, at most as long as stated; of a cut one the bytes it has.

    Raises:
        LogError: an unknown compression, damaged, or of another size than it says.
    """
    if compression == "none":
        return packed
    if compression not in ("bz2", "lz4"):
        raise LogError(f"it is packed with {compression!r}", expected="bz2, lz4 or none")
    if size > CHUNK_LIMIT:
        raise LogError(f"it says it unpacks to {size} bytes", expected=f"at most {CHUNK_LIMIT}")
    unpacker = bz2.BZ2Decompressor() if compression == "bz2" else lz4.frame.LZ4FrameDecompressor()
    parts: list[bytes] = []
    remaining, data = size + 1, packed  # a byte more than stated, to notice a longer one
    try:
        while remaining and not unpacker.eof and (data or not unpacker.needs_input):
            parts.append(unpacker.decompress(data, max_length=remaining))
            remaining, data = remaining - len(parts[-1]), b""
    except (OSError, ValueError, EOFError, RuntimeError) as error:
        raise LogError(f"it does not unpack ({error})") from error
    if cut:
        return b"".join(parts)[:size]
    if remaining != 1 or not unpacker.eof:
        raise LogError(f"it does not unpack to the {size} bytes it says it has")
    return b"".join(parts)


# ── writing ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def record(op: Op, named: Mapping[bytes, bytes], data: bytes) -> bytes:
    """The bytes of a record; its fields in order of their names, as rosbag writes them."""
    every = sorted({**named, b"op": bytes([op])}.items())
    inner = b"".join(U32.pack(len(name) + 1 + len(value)) + name + b"=" + value for name, value in every)
    return U32.pack(len(inner)) + inner + U32.pack(len(data)) + data


def stamp(time_ns: int) -> bytes:
    """A time as the format stores it."""
    return struct.pack("<II", *divmod(time_ns, 10**9))


def bag_header(index_pos: int, connections: int, chunks: int) -> bytes:
    """The first record, padded to its fixed size."""
    named = {b"index_pos": struct.pack("<Q", index_pos), b"conn_count": U32.pack(connections), b"chunk_count": U32.pack(chunks)}
    empty = len(record(Op.BAG, named, b"")) - 8
    return record(Op.BAG, named, b" " * (FIRST_RECORD - empty))


def index(number: int, entries: Sequence[tuple[int, int]]) -> bytes:
    """Index record: times (ns) and offsets of one connection's messages in a chunk."""
    data = b"".join(stamp(time_ns) + U32.pack(offset) for time_ns, offset in sorted(entries))
    return record(Op.INDEX, {b"ver": U32.pack(1), b"conn": U32.pack(number), b"count": U32.pack(len(entries))}, data)


def chunk_info(position: int, first_ns: int, last_ns: int, counts: Mapping[int, int]) -> bytes:
    """Chunk info record for the end of a bag."""
    named = {
        b"ver": U32.pack(1),
        b"chunk_pos": struct.pack("<Q", position),
        b"start_time": stamp(first_ns),
        b"end_time": stamp(last_ns),
        b"count": U32.pack(len(counts)),
    }
    return record(Op.INFO, named, b"".join(U32.pack(number) + U32.pack(count) for number, count in counts.items()))
