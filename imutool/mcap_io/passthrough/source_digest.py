"""Digests of logs: SHA-256 of all bytes, or of what states the contents of a large log."""

from __future__ import annotations

import hashlib
from types import TracebackType

from imutool.file_location import Location
from imutool.mcap_io.blocks import HEAD_BYTES
from imutool.mcap_io.codec.records import MAGIC
from imutool.mcap_io.index import LogIndex
from imutool.mcap_io.storage.source import BLOCK_BYTES, Digest

# SHA-256 takes longer than `cp` (1.6 and 2 GB/s on the machine of docs/performance.md), and needs every byte of a chunk that
# the kernel copies otherwise
LARGEST_HASHED = 64 << 20


class SourceDigest:
    """Digest of a source for its copy's metadata; a context manager, as a thread may compute it.

    `source_sha256` is that of the file. A log above `LARGEST_HASHED` bytes has `source_digest`: SHA-256 of the header, the head
    of every chunk with the CRC of its contents, and all bytes from the end of the data section on. Two logs that differ in a
    chunk's contents, order or length then have different ones, if the recorder wrote CRCs.
    """

    def __init__(self, index: LogIndex, source: Location) -> None:
        self._index, self._size = index, index.source.size
        self._whole = Digest(source) if self._size <= LARGEST_HASHED else None
        self._stated = None if self._whole is not None else _stated(index)

    def result(self) -> dict[str, str]:
        """Name of the entry, and the digest in hex.

        Raises:
            LogError: the file has become shorter, or the disk does not give it.
        """
        if self._whole is not None:
            return {"source_sha256": self._whole.result()}
        return {"source_digest": self._stated or ""}

    def __enter__(self) -> SourceDigest:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._whole is not None:
            self._whole.__exit__(kind, error, trace)


def digest_with_crcs(index: LogIndex) -> str:
    """SHA-256 of a log's bytes without the contents of chunks, for which their CRCs stand.

    A chunk without CRC counts with its contents. If this digest and every CRC are right, every byte is as it was.
    """
    source, whole, done = index.source, hashlib.sha256(), 0
    parts = []  # from `done` to the contents of the next chunk, and their end
    for block in index.blocks:
        if block.compression is not None:
            head = block.head(source.at(block.offset, min(block.length, HEAD_BYTES)))
            if head.crc:
                parts.append((block.offset + head.data_at, block.offset + block.length))
    for start, end in [*parts, (source.size, source.size)]:
        for at in range(done, start, BLOCK_BYTES):
            whole.update(source.at(at, min(BLOCK_BYTES, start - at)))
        done = end
    return whole.hexdigest()


def _stated(index: LogIndex) -> str:
    """Digest of everything that says what is in the log."""
    source, whole = index.source, hashlib.sha256(MAGIC + index.header_bytes)
    for block in index.blocks:
        raw = source.at(block.offset, block.length if block.compression is None else min(block.length, HEAD_BYTES))
        whole.update(raw if block.compression is None else raw[: block.head(raw).data_at])
    whole.update(source.at(index.data_end, source.size - index.data_end))
    return whole.hexdigest()
