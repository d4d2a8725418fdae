"""What can be had of a chunk that is damaged: its contents where only its head is, else the definitions it begins with.

What a damaged head said can be known from elsewhere, and the CRC proves it.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator

import lz4.frame
import zstandard
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema

from imutool.errors import LogError
from imutool.mcap_io.codec import records
from imutool.mcap_io.codec.records import CHUNK_HEAD, HEAD

FRAMES = (b"\x28\xb5\x2f\xfd", b"\x04\x22\x4d\x18")  # how what zstd and lz4 packed begins
CHUNK_OPCODE = bytes([Opcode.CHUNK])
DEFINITIONS = {int(Opcode.SCHEMA): Schema, int(Opcode.CHANNEL): Channel}
MOST_SEARCHED = 1 << 20
MOST_BEGUN = 4 << 20  # bytes to look for definitions in: they come first
STEP = 256


def mended(raw: bytes, offset: int, known: ChunkIndex | None) -> bytes | None:
    """The record with a head that its contents prove; None if its head is in order, or none can be proven.

    `known` is what a sound summary says of the chunk. The CRC itself must stand in the record as it was written.
    """
    if in_order(raw, offset, known) or len(raw) < HEAD.size + CHUNK_HEAD.size + 8:
        return None
    for candidate in _candidates(raw, known):
        try:
            if records.ChunkHead.of(candidate[:128], len(candidate), offset).crc:
                records.unpack(candidate, offset)
                return candidate
        except LogError:
            continue
    return None


def in_order(raw: bytes, offset: int, known: ChunkIndex | None) -> bool:
    """Whether the head agrees with itself, with its data and with what is known of it."""
    if len(raw) < HEAD.size or HEAD.unpack_from(raw) != (Opcode.CHUNK, len(raw) - HEAD.size):
        return False
    try:
        head = records.ChunkHead.of(raw[:128], len(raw), offset)
    except LogError:
        return False
    if known is not None:
        stated = (head.start_ns, head.end_ns, head.size, head.compression)
        return stated == (known.message_start_time, known.message_end_time, known.uncompressed_size, known.compression)
    return _size(raw[head.data_at :], head.compression, head.size) == head.size


def _size(packed: bytes, compression: str, stated: int) -> int:
    """The size of the contents as the packed bytes themselves tell it, or what the head states."""
    if compression == "":
        return len(packed)
    if compression == "zstd":
        try:
            size = zstandard.frame_content_size(packed)
        except zstandard.ZstdError:
            return stated
        return stated if size < 0 else int(size)
    return stated


def _candidates(raw: bytes, known: ChunkIndex | None) -> Iterator[bytes]:
    """The record under every head it may have had."""
    start_ns, end_ns, stated, crc, _ = CHUNK_HEAD.unpack_from(raw, HEAD.size)
    if known is not None:
        start_ns, end_ns = known.message_start_time, known.message_end_time
    for name in ("zstd", "lz4", "") if known is None else (known.compression,):
        at = HEAD.size + CHUNK_HEAD.size + len(name.encode()) + 8
        packed = raw[at:]
        sizes = {stated, _size(packed, name, stated)} if known is None else {known.uncompressed_size}
        for size in sorted(sizes):
            body = CHUNK_HEAD.pack(start_ns, end_ns, size, crc, len(name.encode())) + name.encode()
            yield HEAD.pack(Opcode.CHUNK, len(raw) - HEAD.size) + body + struct.pack("<Q", len(packed)) + packed


def definitions(raw: bytes) -> Iterator[tuple[int, bytes]]:
    """Schema and Channel records (opcode and body) in what can still be unpacked of a damaged stretch: nothing proves them.

    A writer may define its channels in its first chunk alone; without them every sound chunk behind it means nothing.
    """
    starts = [raw.find(magic, 0, MOST_SEARCHED) for magic in FRAMES] + ([_uncompressed(raw)] if raw[:1] == CHUNK_OPCODE else [])
    for start in sorted(start for start in starts if start >= 0):
        data, at = _begun(raw[start:]), 0
        while len(data) - at >= HEAD.size:
            opcode, length = HEAD.unpack_from(data, at)
            whole = data[at : at + HEAD.size + length] if length <= len(data) - at - HEAD.size else b""
            if not whole:
                break
            if opcode in DEFINITIONS:
                with contextlib.suppress(LogError):
                    if records.build(records.parse(DEFINITIONS[opcode], whole[HEAD.size :], 0)) == whole:
                        yield opcode, whole[HEAD.size :]
            at += len(whole)


def _uncompressed(raw: bytes) -> int:
    """Where the records of a chunk without compression begin."""
    at = HEAD.size + CHUNK_HEAD.size
    return at + 8 if raw[at - 4 : at] == bytes(4) else -1


def _begun(packed: bytes) -> bytes:
    """As much as unpacks before the damage, from a stretch that begins as its magic says; at most `MOST_BEGUN` bytes."""
    if not packed.startswith(FRAMES):
        return packed[:MOST_BEGUN]
    data = b""
    try:
        for piece in _unpacked(packed):
            data += piece
            if len(data) >= MOST_BEGUN:
                break
    except (zstandard.ZstdError, RuntimeError, EOFError, ValueError):
        pass  # what came before is what there is
    return data[:MOST_BEGUN]


def _unpacked(packed: bytes) -> Iterator[bytes]:
    """The contents of a frame, bit by bit; a piece may be as long as a bomb makes it, but no longer than `MOST_BEGUN`."""
    if packed.startswith(FRAMES[0]):
        with zstandard.ZstdDecompressor().stream_reader(packed[:MOST_BEGUN]) as stream:
            while piece := stream.read(STEP):
                yield piece
    else:
        frame = lz4.frame.LZ4FrameDecompressor()
        for at in range(0, min(len(packed), MOST_BEGUN), STEP):
            yield frame.decompress(packed[at : at + STEP], max_length=MOST_BEGUN)
