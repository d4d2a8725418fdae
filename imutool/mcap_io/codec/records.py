"""The byte level of a log: records, chunks, and whole columns of messages in and out of them.

Small records go through the classes of the `mcap` package; what there are millions of (messages and their index entries)
goes through numpy. Format: https://mcap.dev/spec. Every length read from a file is held against the bytes there are.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from itertools import pairwise
from typing import Any, NamedTuple

import lz4.frame
import numpy as np
import zstandard
from jaxtyping import Bool, Int64, Shaped, UInt8, UInt16, UInt32, UInt64
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import McapRecord

from imutool.errors import ConfigError, LogError
from imutool.mcap_io.codec.crc import crc32

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")  # opcode and length, ahead of every record
CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, unpacked size, CRC, length of the compression's name
FOOTER_SIZE = HEAD.size + 20
COMPRESSIONS = {"none": "", "zstd": "zstd", "lz4": "lz4"}
ZSTD_LEVEL = 1  # 1.24 GB/s and 1.08x on the mixed log of the notes, where level 3 gave 0.29 GB/s and 1.24x
CHUNK_LIMIT = 2**31  # unpacked bytes; writers use 1 MiB, so a claim beyond this is damage, not data
RUN_AFTER = 8  # equal lengths in a row before a whole run is tested at once

MESSAGE = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
FIXED = MESSAGE.itemsize - HEAD.size  # the part of a message's length that is not payload


def build(record: McapRecord) -> bytes:
    """The bytes of one small record."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]  # mcap leaves it bare


def parse(kind: Any, body: bytes, offset: int) -> Any:
    """A small record of one of the classes of `mcap.records`, from its bytes behind opcode and length.

    Raises:
        LogError: the bytes make no such record; `offset` says where in the file it began.
    """
    try:
        return kind.read(ReadDataStream(BytesIO(body)))
    except (struct.error, EndOfFile, UnicodeDecodeError) as error:
        raise LogError(f"the {kind.__name__} record at byte {offset} is damaged ({error})") from error


def name_of(opcode: int) -> str:
    """What the format calls a record, for messages."""
    return Opcode(opcode).name.title().replace("_", "") if opcode in set(Opcode) else f"0x{opcode:02x}"


# ── reading ──────────────────────────────────────────────────────────────────────────────────────────────────────────


class Messages(NamedTuple):
    """The messages of one stretch of bytes, in file order, and the definitions among them."""

    data: UInt8[np.ndarray, " b"]
    offsets: Int64[np.ndarray, " n"]
    heads: Shaped[np.ndarray, " n"]  # of dtype MESSAGE
    definitions: list[tuple[int, int, int]]  # opcode, first byte and length of a Schema's or Channel's body

    def times(self) -> Int64[np.ndarray, " n"]:
        """Log times.

        Raises:
            LogError: one beyond 2^63 ns.
        """
        return signed(self.heads["log_time"])


class Rows(NamedTuple):
    """Consecutive messages of equal size, as columns; every array is a copy, so the chunk they came from is freed."""

    channel: UInt16[np.ndarray, " n"]
    log_time: Int64[np.ndarray, " n"]
    publish_time: Int64[np.ndarray, " n"]
    sequence: UInt32[np.ndarray, " n"]
    payload: UInt8[np.ndarray, "n L"]

    def where(self, mask: Bool[np.ndarray, " n"] | slice) -> Rows:
        """Some of the rows."""
        return Rows(*(column[mask] for column in self))


def signed(times: UInt64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """MCAP's uint64 nanoseconds as int64.

    Raises:
        LogError: a time beyond 2^63 ns (the year 2262), which only a damaged or wrapped clock writes.
    """
    if len(times) and times.max() >= 2**63:
        raise LogError(f"a message has the log time {times.max()} ns", expected="less than 2^63")
    return times.astype(np.int64)


def scan(data: bytes | memoryview, *, bare: bool = False) -> tuple[Int64[np.ndarray, " n"], list[tuple[int, int, int]], int]:
    """Where messages and definitions begin in a stretch of records, and the byte at which whole records end.

    A `bare` stretch lies outside chunks and also ends before the first record that is no message, or none that can be.
    Stretches of equally long messages, which topic-grouped chunks consist of, are recognised as a matrix; the framing is still
    followed record by record, only not in Python.
    """
    pieces: list[Int64[np.ndarray, " n"]] = []
    singles: list[int] = []
    definitions: list[tuple[int, int, int]] = []
    view = np.frombuffer(data, np.uint8)
    size, position, last, equal, wait = len(view), 0, -1, 0, RUN_AFTER
    unpack = HEAD.unpack_from
    while size - position >= HEAD.size:
        opcode, length = unpack(data, position)
        if length > size - position - HEAD.size:
            break
        if opcode == Opcode.MESSAGE:
            if length < FIXED:
                if bare:
                    break
                raise LogError(f"a message has {length} bytes", expected=f"at least {FIXED}")
            equal, last = (equal + 1, last) if length == last else (0, length)
            if equal >= wait:
                count = _run(view, position, HEAD.size + length)
                pieces += [np.array(singles, np.int64), position + np.arange(count) * (HEAD.size + length)]
                singles.clear()
                position += count * (HEAD.size + length)
                equal, wait = 0, (RUN_AFTER if count > RUN_AFTER else 2 * wait)
                continue
            singles.append(position)
        elif bare:
            break
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            definitions.append((opcode, position + HEAD.size, length))
        position += HEAD.size + length
    pieces.append(np.array(singles, np.int64))
    return np.concatenate(pieces), definitions, position


def _run(view: UInt8[np.ndarray, " b"], position: int, stride: int) -> int:
    """How many records in a row start with the same opcode and length as the one at `position`."""
    count = (len(view) - position) // stride
    heads = view[position : position + count * stride].reshape(count, stride)[:, : HEAD.size]
    same = (heads == heads[0]).all(axis=1)
    return count if same.all() else int(np.argmin(same))


def messages(data: bytes | memoryview, offset: int) -> Messages:
    """The messages in the unpacked bytes of a chunk, or in a run of records outside chunks.

    Raises:
        LogError: the records do not fill the bytes exactly; `offset` says where in the file they came from.
    """
    try:
        offsets, definitions, end = scan(data)
    except LogError as error:
        raise LogError(f"the chunk at byte {offset} is damaged: {error.what}", expected=error.expected) from error
    view = np.frombuffer(data, np.uint8)
    if end != len(view):
        raise LogError(f"the chunk at byte {offset} is damaged: a record crosses its end, at byte {end} of {len(view)}")
    return Messages(view, offsets, _matrix(view, offsets, MESSAGE.itemsize).view(MESSAGE)[:, 0], definitions)


def listed(data: bytes | memoryview, offsets: Int64[np.ndarray, " n"]) -> Messages | None:
    """The messages that begin at these offsets, in order; None unless they, and nothing else, fill the bytes from end to end.

    What `messages` finds by following the records one by one, for bytes of which an index is there: a tenth of the time
    where lengths alternate.
    """
    view, count = np.frombuffer(data, np.uint8), len(offsets)
    if not count or offsets[0] != 0 or offsets[-1] + MESSAGE.itemsize > len(view):
        return None
    sizes = np.empty(count, np.int64)
    np.subtract(offsets[1:], offsets[:-1], out=sizes[:-1])
    sizes[-1] = len(view) - offsets[-1]
    if sizes.min() < MESSAGE.itemsize:
        return None
    heads = _matrix(view, offsets, MESSAGE.itemsize).view(MESSAGE)[:, 0]
    wrong = (heads["opcode"] != Opcode.MESSAGE.value) | (heads["length"].view(np.int64) + HEAD.size != sizes)
    return None if wrong.any() else Messages(view, offsets, heads, [])


def _matrix(view: UInt8[np.ndarray, " b"], offsets: Int64[np.ndarray, " n"], width: int) -> UInt8[np.ndarray, "n w"]:
    """Copies of the `width` bytes at each offset; a view, where the spacing would allow one, made decoding slower."""
    if not len(offsets):
        return np.zeros((0, width), np.uint8)
    # a window on every byte; numpy's sliding_window_view makes the same, and takes longer than the copies out of one chunk
    windows = np.ndarray((len(view) - width + 1, width), np.uint8, view, strides=(1, 1))
    cut: UInt8[np.ndarray, "n w"] = windows[offsets]
    return cut


def rows(found: Messages, mask: Bool[np.ndarray, " n"]) -> Iterator[Rows]:
    """The chosen messages as columns, one entry per stretch of equal size; file order is kept."""
    for heads, payload in cut(found, mask):
        yield columns(heads, payload)


def cut(found: Messages, mask: Bool[np.ndarray, " n"]) -> Iterator[tuple[Shaped[np.ndarray, " n"], UInt8[np.ndarray, "n L"]]]:
    """Heads (of dtype MESSAGE) and payloads of the chosen messages, one pair per stretch of equal size, in file order."""
    heads, offsets = found.heads[mask], found.offsets[mask]
    edges = np.flatnonzero(heads["length"][1:] != heads["length"][:-1]) + 1
    for first, last in pairwise([0, *edges.tolist(), len(heads)] if len(heads) else []):
        size = int(heads["length"][first]) - FIXED
        yield heads[first:last], _matrix(found.data, offsets[first:last] + MESSAGE.itemsize, size)


def columns(heads: Shaped[np.ndarray, " n"], payload: UInt8[np.ndarray, "n L"]) -> Rows:
    """Messages of one size as columns.

    Raises:
        LogError: a time beyond 2^63 ns.
    """
    times = signed(heads["log_time"]), signed(heads["publish_time"])
    return Rows(heads["channel"].copy(), *times, heads["sequence"].copy(), payload)


@dataclass(frozen=True, slots=True)
class ChunkHead:
    """What a Chunk record says before its data."""

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    data_at: int  # first byte of the compressed data, counted from the record's first byte

    @staticmethod
    def of(record: bytes, length: int, offset: int) -> ChunkHead:
        """The head of a chunk, from the first bytes of the record; `length` is that of the whole record.

        Raises:
            LogError: lengths that contradict one another.
        """
        if len(record) < HEAD.size + CHUNK_HEAD.size:
            raise _contradicting(offset)
        start_ns, end_ns, size, crc, name = CHUNK_HEAD.unpack_from(record, HEAD.size)
        at = HEAD.size + CHUNK_HEAD.size
        if name > 64 or len(record) < at + name + 8:
            raise _contradicting(offset)
        compression = record[at : at + name].decode(errors="replace")
        (packed,) = struct.unpack_from("<Q", record, at + name)
        if packed != length - at - name - 8:
            raise _contradicting(offset)
        return ChunkHead(start_ns, end_ns, size, crc, compression, at + name + 8)


def _contradicting(offset: int) -> LogError:
    return LogError(f"the chunk at byte {offset} is damaged: its lengths contradict one another")


def unpack(record: bytes | memoryview, offset: int) -> bytes | memoryview:
    """The unpacked, CRC-checked bytes of a whole Chunk record: a view of it, where it is not compressed.

    Raises:
        LogError: unknown compression, data that do not unpack to the stated size, or a wrong CRC.
    """
    head = ChunkHead.of(bytes(record[:128]), len(record), offset)
    packed = memoryview(record)[head.data_at :]
    where = f"the chunk at byte {offset}"
    if head.size > CHUNK_LIMIT:
        raise LogError(f"{where} says it unpacks to {head.size} bytes", expected=f"at most {CHUNK_LIMIT}")
    if head.compression not in COMPRESSIONS.values():
        raise LogError(f"{where} is compressed with {head.compression!r}", expected="zstd, lz4 or none")
    try:
        data = _decompress(head.compression, packed, head.size)
    except (zstandard.ZstdError, RuntimeError, EOFError, ValueError) as error:
        raise LogError(f"{where} does not unpack ({error})") from error
    if len(data) != head.size:
        raise LogError(f"{where} unpacks to {len(data)} bytes", expected=str(head.size))
    if head.crc and crc32(data) != head.crc:
        raise LogError(
            f"{where} is damaged: its contents have CRC {crc32(data):08x}",
            expected=f"{head.crc:08x}",
            fix="Save the rest with `imutool repair`, or copy the log again from where it was recorded",
        )
    return data


_unpacker = zstandard.ZstdDecompressor()


def _decompress(compression: str, packed: memoryview, size: int) -> bytes | memoryview:
    """Never allocates more than `size`, whatever the packed bytes say about themselves."""
    if compression == "zstd":
        if size == 0:
            if _unpacker.stream_reader(packed).read(1):
                raise ValueError("the zstd frame holds something, the chunk nothing")
            return b""
        if zstandard.frame_content_size(packed) not in (-1, size):
            raise ValueError(f"the zstd frame says {zstandard.frame_content_size(packed)} bytes, the chunk {size}")
        return bytes(_unpacker.decompress(packed, max_output_size=size))
    if compression == "lz4":
        frame = lz4.frame.LZ4FrameDecompressor()
        data = bytes(frame.decompress(packed, max_length=size))
        if not frame.eof and frame.decompress(b"", max_length=1):
            raise ValueError(f"the lz4 frame goes on beyond the chunk's {size} bytes")
        return data
    return packed


# ── writing ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def message_rows(
    channel: int,
    log_time: Int64[np.ndarray, " n"],
    publish_time: Int64[np.ndarray, " n"],
    sequence: UInt32[np.ndarray, " n"],
    payload: UInt8[np.ndarray, "n L"],
    out: UInt8[np.ndarray, "n M"] | None = None,
) -> UInt8[np.ndarray, "n M"]:
    """One Message record per row: opcode, length, channel, sequence, the two times, and the payload; in `out`, if given."""
    count, size = payload.shape
    records = np.empty((count, MESSAGE.itemsize + size), np.uint8) if out is None else out
    heads = np.empty(count, MESSAGE)
    heads["opcode"], heads["length"], heads["channel"] = Opcode.MESSAGE, FIXED + size, channel
    heads["sequence"], heads["log_time"], heads["publish_time"] = sequence, log_time, publish_time
    records[:, : MESSAGE.itemsize] = heads.view(np.uint8).reshape(count, MESSAGE.itemsize)
    records[:, MESSAGE.itemsize :] = payload
    return records


def message_record(channel: int, sequence: int, time_ns: int, payload: bytes) -> bytes:
    """One Message record, for the few that are large; both its times are the same."""
    fixed = struct.pack("<HIQQ", channel, sequence, time_ns, time_ns)
    return HEAD.pack(Opcode.MESSAGE, FIXED + len(payload)) + fixed + payload


def scatter(data: UInt8[np.ndarray, " b"], offsets: Int64[np.ndarray, " n"], rows: UInt8[np.ndarray, "n M"]) -> None:
    """Puts each row at its own offset; the rows must not overlap there."""
    width = rows.shape[1]
    if len(data) == rows.size:
        data.reshape(rows.shape)[:] = rows
    else:
        np.lib.stride_tricks.sliding_window_view(data, width, writeable=True)[offsets] = rows


def message_index(channel: int, times: Int64[np.ndarray, " n"], offsets: Int64[np.ndarray, " n"]) -> bytes:
    """A MessageIndex record, its entries in order of log time (and of the file, where that is equal)."""
    entries = np.empty((len(times), 2), "<u8")
    order = np.argsort(times, kind="stable")
    entries[:, 0], entries[:, 1] = times[order], offsets[order]
    body = entries.tobytes()
    return HEAD.pack(Opcode.MESSAGE_INDEX, 6 + len(body)) + struct.pack("<HI", channel, len(body)) + body


def pack(compression: str) -> Callable[[bytes], bytes]:
    """The function that compresses a chunk, by the name a user gives it or the log does.

    Raises:
        ConfigError: no such compression.
    """
    name = COMPRESSIONS.get(compression, compression)
    if name == "zstd":
        compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL)
        return lambda data: bytes(compressor.compress(data))
    if name == "lz4":
        # blocks that know nothing of one another take 0.6 of the time, and of IMU messages no more room
        return lambda data: bytes(lz4.frame.compress(data, block_linked=False))
    if name == "":
        return lambda data: data
    raise ConfigError(f"{compression!r} is no compression", where="--compression", expected=", ".join(COMPRESSIONS))


def chunk_head(data: bytes, packed: bytes, compression: str, start_ns: int, end_ns: int) -> bytes:
    """The bytes of a Chunk record ahead of its packed data; the CRC is that of the unpacked."""
    name = compression.encode()
    body = CHUNK_HEAD.pack(start_ns, end_ns, len(data), crc32(data), len(name)) + name
    body += struct.pack("<Q", len(packed))
    return HEAD.pack(Opcode.CHUNK, len(body) + len(packed)) + body
