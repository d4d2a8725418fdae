"""Repair the head of a damaged chunk, or find the definitions at its beginning.

The fields of a damaged head are known from the summary or from the packed data, and the CRC of the contents proves them.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable, Iterator

import lz4.frame
import zstandard
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema

from imutool.errors import LogError
from imutool.mcap_io.blocks import HEAD_BYTES
from imutool.mcap_io.codec import messages, records
from imutool.mcap_io.codec.records import CHUNK_HEAD, HEAD

FRAME_MAGICS = (b"\x28\xb5\x2f\xfd", b"\x04\x22\x4d\x18")  # of zstd and lz4
CHUNK_OPCODE = bytes([Opcode.CHUNK])
DEFINITIONS = {int(Opcode.SCHEMA): Schema, int(Opcode.CHANNEL): Channel}
MAX_SEARCHED = 1 << 20  # bytes in which packed data must begin
MAX_UNPACKED = 4 << 20  # bytes in which definitions are sought: they come first
STEP = 256


class UnreadableError(LogError):
    """The contents of a chunk are as its CRC says, and no records."""


def prove(
    raw: bytes, offset: int, known: ChunkIndex | None, max_chunk: int, is_boundary: Callable[[int], bool]
) -> tuple[messages.Messages, records.ChunkHead, bytes]:
    """Contents, head and repaired bytes of a chunk that its CRC proves.

    A chunk that states no CRC is taken where nothing contradicts it.
    `known` is the chunk's entry in an intact summary. `is_boundary` says whether a record can end at a byte.

    Raises:
        LogError: damaged.
    """
    try:
        return *_contents(raw, offset, known, max_chunk, is_boundary), raw
    except UnreadableError:
        raise
    except LogError:
        better = repair_head(raw, offset, known, max_chunk)
        if better is None:
            raise
        return *_contents(better, offset, None, max_chunk, is_boundary), better


def _contents(
    raw: bytes, offset: int, known: ChunkIndex | None, max_chunk: int, is_boundary: Callable[[int], bool]
) -> tuple[messages.Messages, records.ChunkHead]:
    if HEAD.unpack_from(raw) != (Opcode.CHUNK, len(raw) - HEAD.size):
        raise LogError(f"the head of the chunk at byte {offset} is damaged")
    head = records.ChunkHead.of(raw[:HEAD_BYTES], len(raw), offset)
    contents = records.unpack(raw, offset, max_chunk)
    try:
        found = messages.parse(contents, offset)
    except LogError as error:
        if head.crc:
            raise UnreadableError(error.what) from error
        raise  # `raise error from error` would be a cycle that keeps the contents: no collector runs in a scan
    if not head.crc and not is_consistent(raw, offset, known):
        raise LogError(f"the head of the chunk at byte {offset} is damaged, and it has no CRC")
    if not head.crc and not is_boundary(offset + len(raw)):
        raise LogError(f"the chunk at byte {offset} has no CRC, and no record follows it")
    return found, head


def repair_head(raw: bytes, offset: int, known: ChunkIndex | None, max_chunk: int) -> bytes | None:
    """The Chunk record with a head that its contents prove; None if intact or unprovable.

    `known` is the chunk's entry in an intact summary. The CRC itself must stand in the record as it was written.
    """
    if is_consistent(raw, offset, known) or len(raw) < HEAD.size + CHUNK_HEAD.size + 8:
        return None
    for candidate in _candidates(raw, known):
        try:
            head = records.ChunkHead.of(candidate[:HEAD_BYTES], len(candidate), offset)
            if head.crc:
                records.unpack(candidate, offset, max_chunk)
                if _is_one_frame(candidate[head.data_at :]):
                    return candidate
        except LogError:
            continue
    return None


def _is_one_frame(packed: bytes) -> bool:
    """Whether nothing follows a frame that unpacks; too long a chunk would hide those behind it."""
    if not packed.startswith(FRAME_MAGICS):
        return True
    is_zstd = packed.startswith(FRAME_MAGICS[0])
    frame = zstandard.ZstdDecompressor().decompressobj() if is_zstd else lz4.frame.LZ4FrameDecompressor()
    frame.decompress(packed)
    return not frame.unused_data


def is_consistent(raw: bytes, offset: int, known: ChunkIndex | None) -> bool:
    """Whether a chunk's head agrees with itself, with its data and with the summary's entry."""
    if len(raw) < HEAD.size or HEAD.unpack_from(raw) != (Opcode.CHUNK, len(raw) - HEAD.size):
        return False
    try:
        head = records.ChunkHead.of(raw[:HEAD_BYTES], len(raw), offset)
    except LogError:
        return False
    if known is not None:
        stated = (head.start_ns, head.end_ns, head.size, head.compression)
        return stated == (known.message_start_time, known.message_end_time, known.uncompressed_size, known.compression)
    return _size(raw[head.data_at :], head.compression, head.size) == head.size


def _size(packed: bytes, compression: str, stated: int) -> int:
    """Size of the contents from the packed bytes, or as the head states it."""
    if compression == "":
        return len(packed)
    with contextlib.suppress(zstandard.ZstdError):
        if compression == "zstd" and (size := zstandard.frame_content_size(packed)) >= 0:
            return int(size)
    return stated


def _candidates(raw: bytes, known: ChunkIndex | None) -> Iterator[bytes]:
    """The record with every head it may have had."""
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


def keeps_sound(head: records.ChunkHead, raw: bytes, found: messages.Messages) -> bool:
    """Whether a chunk that is copied as it is can be told to be sound.

    Its head must agree with its messages: the summary of the copy does. Its data must be one frame that ends where they do,
    since other readers refuse several, or one without an end.
    """
    if len(found.heads) and (head.start_ns, head.end_ns) != messages.span(found.times()):
        return False
    packed = raw[head.data_at :]
    if head.compression == "zstd":
        return zstandard.frame_content_size(packed) == head.size or _is_one_frame(packed)
    if head.compression == "":
        return True
    frame = lz4.frame.LZ4FrameDecompressor()
    try:
        frame.decompress(packed, max_length=max(head.size, 1))
        if not frame.eof:
            frame.decompress(b"", max_length=1)
    except (RuntimeError, EOFError):
        return False
    return bool(frame.eof) and not frame.unused_data


def find_definitions(raw: bytes) -> Iterator[tuple[int, bytes]]:
    """Finds Schema and Channel records at the start of a damaged chunk; nothing proves them.

    A writer may define its channels in its first chunk alone; without them no later chunk can be read.
    """
    starts = [raw.find(magic, 0, MAX_SEARCHED) for magic in FRAME_MAGICS] + (
        [_records_start(raw)] if raw[:1] == CHUNK_OPCODE else []
    )
    for start in sorted(start for start in starts if start >= 0):
        data, at = _unpack_start(raw[start:]), 0
        while len(data) - at >= HEAD.size:
            opcode, length = HEAD.unpack_from(data, at)
            whole = data[at : at + HEAD.size + length] if length <= len(data) - at - HEAD.size else b""
            if not whole or not opcode:  # no record: zeros that unpack to megabytes
                break
            if opcode in DEFINITIONS:
                with contextlib.suppress(LogError):
                    if records.build(records.parse(DEFINITIONS[opcode], whole[HEAD.size :], 0)) == whole:
                        yield opcode, whole[HEAD.size :]
            at += len(whole)


def _records_start(raw: bytes) -> int:
    """Start of the records of a chunk without compression; -1 for a chunk with one."""
    at = HEAD.size + CHUNK_HEAD.size
    return at + 8 if raw[at - 4 : at] == bytes(4) else -1


def _unpack_start(packed: bytes) -> bytes:
    """The contents before the damage, at most `MAX_UNPACKED` bytes."""
    if not packed.startswith(FRAME_MAGICS):
        return packed[:MAX_UNPACKED]
    data = bytearray()
    try:
        for piece in _unpack_steps(packed):
            data += piece
            if len(data) >= MAX_UNPACKED:
                break
    except (zstandard.ZstdError, RuntimeError, EOFError, ValueError):
        pass  # the contents before the damage are kept
    return bytes(data[:MAX_UNPACKED])


def _unpack_steps(packed: bytes) -> Iterator[bytes]:
    """Contents of a frame in pieces of at most `MAX_UNPACKED` bytes."""
    if packed.startswith(FRAME_MAGICS[0]):
        with zstandard.ZstdDecompressor().stream_reader(packed[:MAX_UNPACKED]) as stream:
            while piece := stream.read(STEP):
                yield piece
    else:
        frame = lz4.frame.LZ4FrameDecompressor()
        for at in range(0, min(len(packed), MAX_UNPACKED), STEP):
            yield frame.decompress(packed[at : at + STEP], max_length=MAX_UNPACKED)
