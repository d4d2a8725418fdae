"""Records, chunks and chunk indexes of an MCAP log to and from bytes.

The classes of the `mcap` package serve all but the ChunkIndex record: there is one for each chunk, and `mcap` takes 30 µs to
parse it and 20 µs to build it, a third of what copying a log of 1 MiB chunks costs; the functions here take a tenth.
Format: https://mcap.dev/spec. Every length read from a file is compared with the available bytes.
"""

from __future__ import annotations

import ctypes
import struct
import threading
from collections.abc import Callable, Mapping
from functools import cache
from io import BytesIO
from sys import intern
from typing import Any, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, McapRecord

from imutool.errors import ConfigError, LogError

try:  # on the log of `tests/bench/rewrite.py` zlib's CRC-32 costs a third of what `cp` does, that of isal a tenth
    from isal.isal_zlib import crc32 as _crc32
except ImportError:  # no wheel for this machine: the same numbers, later
    from zlib import crc32 as _crc32

crc32 = _crc32

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")  # opcode and length, ahead of every record
CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, unpacked size, CRC, length of the compression's name
USUAL_HEAD = struct.Struct("<BQQQQII4sQ")  # of a chunk record up to its data, where the compression's name has four letters
FOOTER_SIZE, DATA_END_SIZE = HEAD.size + 20, HEAD.size + 4
COMPRESSIONS = {"none": "", "zstd": "zstd", "lz4": "lz4"}
ZSTD_LEVEL = 1  # 1.24 GB/s and 1.08x on the mixed log of the notes, where level 3 gave 0.29 GB/s and 1.24x
PIECE, MAX_CHUNK = 16 << 20, 1 << 28  # bytes unpacked at once of lz4, and of a chunk; writers use 1 MiB, or a larger message


def build(record: McapRecord) -> bytes:
    """The bytes of one small record."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]  # mcap leaves it bare


def parse(kind: Any, body: bytes, offset: int) -> Any:
    """A record of a class of `mcap.records`, from its bytes behind opcode and length.

    Raises:
        LogError: the bytes make no such record; `offset` says where in the file it began.
    """
    try:
        return kind.read(ReadDataStream(BytesIO(body)))
    except (struct.error, EndOfFile, UnicodeDecodeError) as error:
        raise LogError(f"the {kind.__name__} record at byte {offset} is damaged ({error})") from error


def name_of(opcode: int) -> str:
    """The format's name of a record, for messages."""
    return Opcode(opcode).name.title().replace("_", "") if opcode in set(Opcode) else f"0x{opcode:02x}"


# ── reading ──────────────────────────────────────────────────────────────────────────────────────────────────────────


class ChunkHead(NamedTuple):
    """The fields of a Chunk record before its data."""

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    data_at: int  # first byte of the compressed data, counted from the record's first byte

    @staticmethod
    def of(record: bytes | memoryview, length: int, offset: int) -> ChunkHead:
        """Head of a chunk, from the first bytes of the record of `length` bytes.

        Raises:
            LogError: lengths that contradict one another.
        """
        if len(record) >= USUAL_HEAD.size:  # nearly always: a third of the time of the rest, for a log of a million chunks
            _, _, start_ns, end_ns, size, crc, name, packing, packed = USUAL_HEAD.unpack_from(record)
            if name == 4 and packing == b"zstd" and packed == length - USUAL_HEAD.size:
                return ChunkHead(start_ns, end_ns, size, crc, "zstd", USUAL_HEAD.size)
        if len(record) < HEAD.size + CHUNK_HEAD.size:
            raise _contradicting(offset)
        start_ns, end_ns, size, crc, name = CHUNK_HEAD.unpack_from(record, HEAD.size)
        at = HEAD.size + CHUNK_HEAD.size
        if name > 64 or len(record) < at + name + 8:
            raise _contradicting(offset)
        compression = bytes(record[at : at + name]).decode(errors="replace")
        (packed,) = struct.unpack_from("<Q", record, at + name)
        if packed != length - at - name - 8:
            raise _contradicting(offset)
        return ChunkHead(start_ns, end_ns, size, crc, compression, at + name + 8)

    def index_at(self, offset: int, length: int) -> ChunkIndex:
        """Summary entry for this chunk at a place, without its message indexes."""
        return ChunkIndex(
            chunk_length=length,
            chunk_start_offset=offset,
            compression=self.compression,
            compressed_size=length - self.data_at,
            message_end_time=self.end_ns,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=self.start_ns,
            uncompressed_size=self.size,
        )


def _contradicting(offset: int) -> LogError:
    return LogError(f"the chunk at byte {offset} is damaged: its lengths contradict one another")


def unpack(
    record: bytes | memoryview, offset: int, max_chunk: int = MAX_CHUNK, head: ChunkHead | None = None
) -> bytes | memoryview:
    """Unpack a Chunk record and check its CRC; a view where it is not compressed.

    `head` is that of the record, if it is known.

    Raises:
        LogError: unknown compression, data that do not unpack to the stated size, or a wrong CRC.
    """
    head = head or ChunkHead.of(record, len(record), offset)
    if head.size > max_chunk:
        raise LogError(
            f"the chunk at byte {offset} says it unpacks to {head.size} bytes", expected=f"at most {max_chunk} (`max_chunk`)"
        )
    if head.compression not in COMPRESSIONS.values():
        raise LogError(f"the chunk at byte {offset} is compressed with {head.compression!r}", expected="zstd, lz4 or none")
    try:
        data = _decompress(head.compression, memoryview(record)[head.data_at :], head.size)
    except (zstandard.ZstdError, RuntimeError, EOFError, ValueError) as error:
        raise LogError(f"the chunk at byte {offset} does not unpack ({error})") from error
    if len(data) != head.size:
        raise LogError(f"the chunk at byte {offset} unpacks to {len(data)} bytes", expected=str(head.size))
    if head.crc and crc32(data) != head.crc:
        raise LogError(
            f"the chunk at byte {offset} is damaged: its contents have CRC {crc32(data):08x}",
            expected=f"{head.crc:08x}",
            fix="Save the rest with `imutool repair`, or copy the log again from where it was recorded",
        )
    return data


class _Unpacker(threading.local):
    """Decompressor of each thread: with one for all, a sound chunk does not unpack while another thread unpacks."""

    def __init__(self) -> None:
        self.zstd = zstandard.ZstdDecompressor()


_unpacker = _Unpacker()


def _decompress(compression: str, packed: memoryview, size: int) -> bytes | memoryview:
    """Decompress one frame, or several in a row, and never allocate more than `size`, whatever the packed bytes say."""
    if compression == "zstd":
        if size and zstandard.frame_content_size(packed) in (-1, size):
            data: bytes = _unpacker.zstd.decompress(packed, max_output_size=size)
            if len(data) == size:
                return data
        data = _unpacker.zstd.stream_reader(packed, read_across_frames=True).read(size + 1)
        if len(data) > size:
            raise ValueError(f"the zstd frames go on beyond the chunk's {size} bytes")
        return data
    if compression == "lz4":
        context = lz4.frame.create_decompression_context()  # `LZ4FrameDecompressor` would copy the packed bytes first
        part, read, ended = lz4.frame.decompress_chunk(context, packed, max_length=min(size, PIECE))  # has it twice in memory
        out = bytearray(part) if size > PIECE else part
        while part and not ended and len(out) < size:
            part, count, ended = lz4.frame.decompress_chunk(context, packed[read:], max_length=min(PIECE, size - len(out)))
            out += part
            read += count
        if ended and read < len(packed) and len(out) < size:
            return bytes(lz4.frame.LZ4FrameFile(BytesIO(packed)).read(size + 1))
        if not ended and lz4.frame.decompress_chunk(context, packed[read:], max_length=1)[0]:
            raise ValueError(f"the lz4 frame goes on beyond the chunk's {size} bytes")
        return memoryview(out)
    return packed


# ── writing ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def pack(compression: str) -> Callable[[bytes], bytes]:
    """The function that compresses a chunk, by the compression's name.

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
    raise ConfigError(f"unknown compression {compression!r}", where="compression", expected=", ".join(COMPRESSIONS))


def chunk_head(data: bytes, packed: bytes, compression: str, start_ns: int, end_ns: int) -> bytes:
    """The bytes of a Chunk record before its packed data, with the CRC of the unpacked."""
    name = compression.encode()
    body = CHUNK_HEAD.pack(start_ns, end_ns, len(data), crc32(data), len(name)) + name
    body += struct.pack("<Q", len(packed))
    return HEAD.pack(Opcode.CHUNK, len(body) + len(packed)) + body


CHUNK_INDEX = int(Opcode.CHUNK_INDEX)
FIRST = struct.Struct("<QQQQI")  # start, end, offset and length of the chunk, bytes of its message index offsets
SECOND = struct.Struct("<QI")  # bytes of the message indexes, bytes of the compression's name
LAST = struct.Struct("<QQ")  # bytes of the messages packed, and unpacked
PAIR = struct.Struct("<HQ")  # channel id, and where its MessageIndex record begins
SINGLE_ENTRY = struct.Struct("<QQQQIHQQI4sQQ")  # all of it for one channel and a compression of four letters


def parse_chunk_index(body: bytes, offset: int) -> ChunkIndex:
    """A ChunkIndex from its bytes behind opcode and length.

    Raises:
        LogError: the bytes make no such record.
    """
    if len(body) == SINGLE_ENTRY.size:  # half the time for a log of small chunks
        start_ns, end_ns, at, length, size, channel, index_at, index_length, name, packing, *sizes = SINGLE_ENTRY.unpack(body)
        if (size, name, packing) == (PAIR.size, 4, b"zstd"):
            packed, unpacked = sizes
            return ChunkIndex(length, at, "zstd", packed, end_ns, index_length, {channel: index_at}, start_ns, unpacked)
    try:
        start_ns, end_ns, at, length, size = FIRST.unpack_from(body)
        if size % PAIR.size or FIRST.size + size > len(body):
            raise ValueError("the offsets of its message indexes cross its end")
        indexes = dict(PAIR.iter_unpack(memoryview(body)[FIRST.size : FIRST.size + size]))
        index_length, name = SECOND.unpack_from(body, FIRST.size + size)
        last = FIRST.size + size + SECOND.size + name
        packed, unpacked = LAST.unpack_from(body, last)
        compression = body[last - name : last].decode()
    except (struct.error, ValueError) as error:
        raise LogError(f"the ChunkIndex record at byte {offset} is damaged ({error})") from error
    return ChunkIndex(length, at, intern(compression), packed, end_ns, index_length, indexes, start_ns, unpacked)


def build_chunk_index(entry: ChunkIndex) -> bytes:
    """The bytes of a ChunkIndex record."""
    offsets: Mapping[int, int] = entry.message_index_offsets
    name = entry.compression.encode()
    size, times = PAIR.size * len(offsets), (entry.message_start_time, entry.message_end_time)
    first = FIRST.pack(*times, entry.chunk_start_offset, entry.chunk_length, size)
    pairs = b"".join([PAIR.pack(channel, at) for channel, at in offsets.items()])
    second = SECOND.pack(entry.message_index_length, len(name)) + name
    body = first + pairs + second + LAST.pack(entry.compressed_size, entry.uncompressed_size)
    return HEAD.pack(CHUNK_INDEX, len(body)) + body


class ChunkIndexes:
    """ChunkIndex records of a log being written, as bytes: 60, and 10 a channel, per chunk."""

    def __init__(self) -> None:
        self.raw, self._count = bytearray(), 0

    def append(self, entry: ChunkIndex) -> None:
        """Adds the next chunk's entry."""
        self.raw += build_chunk_index(entry)
        self._count += 1

    def __len__(self) -> int:
        return self._count


M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # malloc.h of glibc
LARGEST = 32 << 20  # the most to which glibc raises its threshold by itself, and twice that for trimming


@cache
def keep_buffers() -> bool:
    """Stops glibc from returning each chunk's buffers to the system, once per process.

    It sets the two thresholds that glibc would set itself had a block of 32 MiB been freed.

    Without this each buffer above 128 kB is mapped, faulted in page by page and unmapped again: on a log of 250 MB the
    IMU was read in 0.10 s instead of 0.31 s (zstd) and 0.52 s (lz4) of CPU time, with the same resident size. Returns
    whether the allocator took it; others than glibc do not, and keep what they do.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):
        return False
    return bool(mallopt(M_MMAP_THRESHOLD, LARGEST)) and bool(mallopt(M_TRIM_THRESHOLD, 2 * LARGEST))
