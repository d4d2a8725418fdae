"""What the message indexes behind a chunk say is in it: enough to enter a chunk in a summary without unpacking it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import UInt64
from mcap.opcode import Opcode

from imutool.errors import LogError
from imutool.mcap_io.codec import records
from imutool.mcap_io.codec.records import HEAD, MESSAGE, ChunkHead, Messages
from imutool.mcap_io.index import INDEX_HEAD, Block
from imutool.mcap_io.storage.source import Source

HEAD_BYTES = 128  # hold a Chunk record up to its packed data, whatever its compression is called


class Listing(NamedTuple):
    """The message indexes of one chunk: messages and entries (log time, offset) per channel id that has any."""

    counts: dict[int, int]
    entries: UInt64[np.ndarray, "n 2"]  # channel after channel, in order of `counts`
    start_ns: int
    end_ns: int

    def messages(self, data: bytes | memoryview, offset: int) -> tuple[Messages, bool]:
        """The messages in the unpacked bytes of the chunk, and whether these are the ones it lists.

        Raises:
            LogError: the records do not fill the bytes exactly; `offset` says where in the file they came from.
        """
        order = self.entries[:, 1].argsort(kind="stable")
        times, offsets = self.entries[order].view(np.int64).T
        found = records.listed(data, offsets) or records.messages(data, offset)
        if len(offsets) != len(found.offsets):
            return found, False
        channels = np.array([*self.counts], np.uint16).repeat([*self.counts.values()])[order]
        wrong = (found.heads["log_time"].view(np.int64) != times) | (found.heads["channel"] != channels)
        if found.offsets is not offsets:
            wrong |= found.offsets != offsets
        return found, not wrong.any()


def head(raw: bytes | memoryview, block: Block) -> ChunkHead:
    """The head of a chunk, from the first `HEAD_BYTES` of its bytes or more.

    Raises:
        LogError: there is no chunk where the block says, or its lengths contradict one another.
    """
    opcode, length = HEAD.unpack_from(raw)
    if opcode != Opcode.CHUNK or length != block.length - HEAD.size:
        raise LogError(f"the summary says a chunk lies at byte {block.offset}, which it does not")
    return ChunkHead.of(bytes(raw[:HEAD_BYTES]), block.length, block.offset)


def listing(raw: bytes | memoryview, block: Block, unpacked: int) -> Listing | None:
    """What the message indexes of a chunk of `unpacked` bytes say; None where there are none or they cannot be right.

    `raw` is all that lies between the chunk and the block's end. They are right when that is nothing but MessageIndex
    records, each channel's once and where the block says, and every entry lies within the chunk. Whether a message lies
    there, only the chunk itself can say.
    """
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
    return Listing(counts, entries, start_ns, end_ns)


def described(source: Source, block: Block) -> tuple[ChunkHead, Listing | None]:
    """Head and listing of a chunk, the rest of which is not read.

    Raises:
        LogError: there is no chunk where the block says, or its lengths contradict one another.
    """
    start = block.offset + block.length
    about = head(source.at(block.offset, min(block.length, HEAD_BYTES)), block)
    return about, listing(source.at(start, block.end - start), block, about.size)
