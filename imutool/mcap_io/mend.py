"""A chunk whose head is damaged and whose contents are not: what the head said can be known from elsewhere, and a CRC proves it."""

from __future__ import annotations

import struct
from collections.abc import Iterator

import zstandard
from mcap.opcode import Opcode
from mcap.records import ChunkIndex

from imutool.errors import LogError
from imutool.mcap_io import records
from imutool.mcap_io.records import CHUNK_HEAD, HEAD


def mended(raw: bytes, offset: int, known: ChunkIndex | None) -> bytes | None:
    """The record with a head that its contents prove; None if its head is in order, or none can be proven.

    `known` is what a sound summary says of the chunk. The CRC itself must stand in the record as it was written.
    """
    if len(raw) < HEAD.size + CHUNK_HEAD.size + 8 or _in_order(raw, offset, known):
        return None
    for candidate in _candidates(raw, known):
        try:
            if records.ChunkHead.of(candidate[:128], len(candidate), offset).crc:
                records.unpack(candidate, offset)
                return candidate
        except LogError:
            continue
    return None


def _in_order(raw: bytes, offset: int, known: ChunkIndex | None) -> bool:
    """Whether the head agrees with itself, with its data and with what is known of it."""
    if HEAD.unpack_from(raw) != (Opcode.CHUNK, len(raw) - HEAD.size):
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
