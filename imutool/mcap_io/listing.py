"""What the message indexes behind a chunk say is in it: enough to enter a chunk in a summary without unpacking it."""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt64
from mcap.opcode import Opcode

from imutool.errors import LogError
from imutool.mcap_io.records import HEAD, MESSAGE, ChunkHead, Messages
from imutool.mcap_io.source import Source
from imutool.mcap_io.structure import Block

FIRST = struct.Struct("<BQHI")  # of a MessageIndex record: opcode, length, channel id and bytes of its entries
HEAD_BYTES = 128  # hold a Chunk record up to its packed data, whatever its compression is called


class Listing(NamedTuple):
    """The message indexes of one chunk: messages and entries (log time, offset) per channel id that has any."""

    counts: dict[int, int]
    entries: UInt64[np.ndarray, "n 2"]  # channel after channel, in order of `counts`

    @property
    def start_ns(self) -> int:
        """The earliest log time; 0 where there is no message."""
        return int(self.entries[:, 0].min()) if len(self.entries) else 0

    @property
    def end_ns(self) -> int:
        """The latest log time; 0 where there is no message."""
        return int(self.entries[:, 0].max()) if len(self.entries) else 0

    def lists(self, found: Messages) -> bool:
        """Whether it lists exactly these messages."""
        if len(self.entries) != len(found.offsets):
            return False
        order = np.argsort(self.entries[:, 1], kind="stable")
        channels = np.repeat(np.array([*self.counts], np.uint16), [*self.counts.values()])
        return bool(
            (self.entries[order, 1] == found.offsets.astype(np.uint64)).all()
            and (self.entries[order, 0] == found.heads["log_time"]).all()
            and (channels[order] == found.heads["channel"]).all()
        )


def head(source: Source, block: Block) -> ChunkHead:
    """The head of a chunk.

    Raises:
        LogError: there is no chunk where the block says, or its lengths contradict one another.
    """
    raw = source.at(block.offset, min(block.length, HEAD_BYTES))
    opcode, length = HEAD.unpack_from(raw)
    if opcode != Opcode.CHUNK or length != block.length - HEAD.size:
        raise LogError(f"the summary says a chunk lies at byte {block.offset}, which it does not")
    return ChunkHead.of(raw, block.length, block.offset)


def listing(source: Source, block: Block, unpacked: int) -> Listing | None:
    """What the message indexes of a chunk of `unpacked` bytes say; None where there are none or they cannot be right.

    They are right when nothing but MessageIndex records lies between the chunk and the block's end, each channel's once and
    where the block says, and every entry lies within the chunk. Whether a message lies there, only the chunk itself can say.
    """
    start = block.offset + block.length
    raw = source.at(start, block.end - start)
    counts: dict[int, int] = {}
    parts: list[bytes] = []
    seen: dict[int, int] = {}
    at = 0
    while len(raw) - at >= FIRST.size:
        opcode, length, channel, size = FIRST.unpack_from(raw, at)
        following = at + HEAD.size + length
        if opcode != Opcode.MESSAGE_INDEX or size % 16 or length != size + 6 or following > len(raw) or channel in seen:
            return None
        seen[channel] = start + at
        if size:
            counts[channel] = size // 16
            parts.append(raw[at + FIRST.size : following])
        at = following
    named = block.indexes
    if at != len(raw) or not seen.keys() >= named.keys() >= counts.keys() or any(seen[c] != named[c] for c in named):
        return None
    entries = np.frombuffer(b"".join(parts), "<u8").reshape(-1, 2)
    if not counts or int(entries[:, 1].max()) + MESSAGE.itemsize > unpacked or int(entries[:, 0].max()) >= 2**63:
        return None
    return Listing(counts, entries)
