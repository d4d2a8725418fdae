"""Check chunks with their message indexes, and keep what was read for the copy."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from imutool.array_types import Shaped, UInt8
from imutool.errors import LogError
from imutool.mcap_io.blocks import MessageBlock, MessageIndexes, parse_message_indexes
from imutool.mcap_io.codec import messages, records
from imutool.mcap_io.codec.records import ChunkHead
from imutool.mcap_io.storage.source import Source
from imutool.mcap_io.topics import Topic

NO_ENTRIES = np.zeros((0, 2), np.uint64)
SMALL = 4096  # bytes of a chunk, packed and unpacked, that is unpacked together with its neighbours
KEPT_BYTES = 10 << 20  # of messages: the two minutes of a 200 Hz IMU that the check of the fit reads, and all of a small log

Heads = Shaped[np.ndarray, " n"]  # of dtype messages.MESSAGE


class Part(NamedTuple):
    """Messages of one size, copied out of their chunk."""

    heads: Heads
    payload: UInt8[np.ndarray, "n L"]


class CheckedChunk(NamedTuple):
    """A chunk whose contents have the stated CRC, and whether its message indexes list them."""

    head: ChunkHead
    indexes: MessageIndexes | None  # those behind the chunk; None if missing or damaged
    right: bool
    found: messages.Messages


def check_chunk(everything: memoryview, block: MessageBlock, max_chunk: int) -> CheckedChunk:
    """Unpack a chunk and compare it with its CRC and its message indexes.

    `everything` is the chunk with the message indexes behind it.

    Raises:
        LogError: the chunk is damaged.
    """
    raw = everything[: block.length]
    head = block.head(raw)
    indexes = parse_message_indexes(everything[block.length :], block, head.size)
    data = records.unpack(raw, block.offset, max_chunk, head)
    if indexes is None:
        return CheckedChunk(head, None, False, messages.parse(data, block.offset))
    found, right = indexes.messages(data, block.offset)
    return CheckedChunk(head, indexes, right, found)


def neighbours(blocks: Iterable[MessageBlock]) -> Iterator[list[MessageBlock]]:
    """Small chunks that lie close together, and every other block alone."""
    near: list[MessageBlock] = []
    for block in blocks:
        if near and not (block.length <= SMALL >= near[0].length and block.end - near[0].offset <= messages.BATCH_BYTES):
            yield near
            near = []
        near.append(block)
    if near:
        yield near


def unpack_together(source: Source, blocks: Sequence[MessageBlock], max_chunk: int) -> messages.Messages | None:
    """The messages of small chunks at once, which costs numpy as much as those of one.

    None where they have to be unpacked one by one: damaged, without CRC, with definitions, or not as the summary says.
    """
    start, parts = blocks[0].offset, list[bytes | memoryview]()
    if not all(block.trusted and block.compression is not None for block in blocks):
        return None
    try:
        raw = memoryview(source.at(start, blocks[-1].end - start))
        for block in blocks:
            record = raw[block.offset - start : block.offset - start + block.length]
            head = block.head(record)
            if not head.crc or head.size > SMALL:
                return None
            parts.append(records.unpack(record, block.offset, max_chunk, head))
        found = messages.parse(b"".join(parts), start)
        found.times()
    except LogError:
        return None
    starts = np.cumsum([0, *map(len, parts[:-1])])
    return None if found.definitions or not np.isin(starts, found.offsets).all() else found


class KeptChunk(NamedTuple):
    """Head, message indexes and messages of some channels of a checked chunk."""

    head: ChunkHead
    indexes: MessageIndexes
    parts: Mapping[str, list[Part]]  # by topic
    defines: bool  # schemas or channels: whoever copies it has to read them


class KeptChunks:
    """Chunks that were read and checked before the copy, and then are only copied.

    A chunk is kept if it is intact and its message indexes are right. One that defines nothing is only copied: whoever does so
    must make sure that the file is still the same (`location.identity`).
    """

    def __init__(self, source: Source, topics: Mapping[str, tuple[Topic, set[int]]], max_chunk: int) -> None:
        self._source, self._topics, self._max_chunk = source, topics, max_chunk
        self._channels = set[int]().union(*(channels for _, channels in topics.values()))
        self._kept: dict[int, KeptChunk] = {}
        self._room = KEPT_BYTES

    def pop(self, block: MessageBlock, channels: set[int]) -> KeptChunk | None:
        """Hand over a chunk, if it was kept with the messages of these channels and defines nothing."""
        kept = self._kept.pop(block.offset, None) if channels == self._channels else None
        return None if kept is None or kept.defines else kept

    def rows(
        self, block: MessageBlock, wanted: Mapping[str, set[int]], first: int, last: int
    ) -> list[tuple[str, messages.Rows]] | None:
        """Messages of some topics by log time, as `Log.rows`; None if the chunk is not kept.

        Raises:
            LogError: the chunk is damaged.
        """
        if not wanted.keys() <= self._topics.keys() or (parts := self._read(block)) is None:
            return None
        found = []
        for topic in wanted:
            for heads, payload in parts[topic]:
                times = heads["log_time"].view(np.int64)
                mask = (times >= first) & (times <= last)
                if mask.any():
                    found.append((topic, messages.columns(heads[mask], payload[mask])))
        return found

    def _read(self, block: MessageBlock) -> Mapping[str, list[Part]] | None:
        """Messages in a chunk, which is kept; None if its indexes are wrong, or there is no room."""
        if (known := self._kept.get(block.offset)) is not None:
            return known.parts
        if block.compression is None or not block.indexes or block.end - block.offset > self._max_chunk or self._room <= 0:
            return None
        everything = memoryview(self._source.at(block.offset, block.end - block.offset))
        head, indexes, right, found = check_chunk(everything, block, self._max_chunk)
        if indexes is None or not right:
            return None
        parts = {name: list(parts_of(found, topic, channels)) for name, (topic, channels) in self._topics.items()}
        self._room -= sum(column.nbytes for of_topic in parts.values() for part in of_topic for column in part)
        self._kept[block.offset] = KeptChunk(head, indexes._replace(entries=NO_ENTRIES), parts, bool(found.definitions))
        return parts


def parts_of(found: messages.Messages, topic: Topic, channels: set[int]) -> Iterator[Part]:
    """Messages of a topic's channels, in stretches of one size."""
    for heads, payload in topic.cut(found, found.of_channels(channels)):
        yield Part(heads, payload)
