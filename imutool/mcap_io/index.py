"""What lies where in a log: its definitions, its chunks and everything between them, in file order.

The data section is always followed from its first byte to its end, so nothing in it can be overlooked; a chunk that the
summary knows is stepped over without being touched, so this costs one dictionary look-up per chunk. Logs without
summary, without message indexes or without chunks are charted the same way and only cost more reading.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Int64, UInt64
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Header, Schema, Statistics

from imutool.errors import LogError
from imutool.mcap_io.codec import chunk_index, records
from imutool.mcap_io.codec.attachment import Attached
from imutool.mcap_io.codec.crc import crc32
from imutool.mcap_io.codec.records import FOOTER_SIZE, HEAD, MAGIC
from imutool.mcap_io.losses import Losses
from imutool.mcap_io.storage.source import CUT_SHORT, Source

MOST_SUMMARY = 1 << 29  # bytes; that of a 100 GB log has some 20 million
INDEX_HEAD = struct.Struct("<BQHI")  # of a MessageIndex record: opcode, length, channel id and bytes of its entries
RUN_BYTES = 1 << 20  # messages outside chunks are taken in runs of about this size


class Span(NamedTuple):
    """A record between chunks, opcode and length included."""

    opcode: int
    offset: int
    length: int


@dataclass(slots=True)
class Block:
    """A stretch that holds messages: one Chunk record, or a run of messages outside chunks."""

    offset: int
    length: int
    end: int  # behind the message indexes that follow a chunk
    start_ns: int
    end_ns: int
    compression: str | None  # None: a run outside chunks
    indexes: dict[int, int] = field(default_factory=dict)  # channel id to the offset of its MessageIndex record
    counts: dict[int, int] | None = None  # messages per channel id, once known
    vouched: bool = True  # False: what is said of the block was found lying about, and only unpacking it proves it
    edited: bool = False  # its messages are not those of its bytes: some are left out, or have other channel ids
    lost: bool = False

    def holds(self, channels: set[int]) -> bool:
        """False when the block cannot hold a message of these channels."""
        known = (self.indexes if self.vouched else None) or self.counts
        return known is None or not channels.isdisjoint(known)


class LogIndex:
    """The chart of one log.

    Raises:
        LogError: empty, not an MCAP log, cut short, or damaged; the message says at which byte.
    """

    losses: Losses | None = None  # nothing is ever lost here: the first damage is an error

    def __init__(self, source: Source) -> None:
        self.source = source
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.items: list[Block | Span] = []
        self.statistics: Statistics | None = None
        self.footer = self._ends()
        index = self._summary()
        self.data_end = self._chart(index)
        self._complete()

    @property
    def blocks(self) -> list[Block]:
        """Everything that holds messages, in file order."""
        return [item for item in self.items if isinstance(item, Block) and not item.lost]

    @property
    def opening(self) -> bytes:
        """The bytes of the Header record."""
        return self.source.at(len(MAGIC), self.header_end - len(MAGIC))

    def lose(self, item: Block | Span, error: LogError) -> None:
        """Called where a part of the log cannot be used; here that is an error.

        Raises:
            LogError: `error`.
        """
        raise error

    @property
    def vouched(self) -> bool:
        """Whether the statistics say that all definitions are known, so that no chunk need be unpacked to find one."""
        told = self.statistics
        return told is not None and (told.channel_count, told.schema_count) == (len(self.channels), len(self.schemas))

    def counts(self) -> dict[int, int]:
        """Messages per channel id."""
        if self.statistics is not None:
            return dict(self.statistics.channel_message_counts)
        total: Counter[int] = Counter()
        for block in self.blocks:
            total.update(self._counts_of(block))
        return dict(total)

    def unpack(self, block: Block) -> records.Messages:
        """The messages of a block, CRC checked.

        Raises:
            LogError: the block is damaged.
        """
        return self.unpacked(block, self.read(block))

    def read(self, block: Block) -> bytes:
        """The bytes of a block, as they may stand in another log.

        Raises:
            LogError: more than anybody should hold in memory, or the disk does not give them.
        """
        if block.length > records.CHUNK_LIMIT:
            raise LogError(
                f"the chunk at byte {block.offset} has {block.length} bytes", expected=f"at most {records.CHUNK_LIMIT}"
            )
        return self.source.at(block.offset, block.length)

    def found(self, block: Block) -> records.Messages | None:
        """The messages of a block, or None if that block is lost now."""
        try:
            return self.unpack(block)
        except LogError as error:
            self.lose(block, error)
            return None

    def check(self) -> None:
        """Reads every chunk and attachment, and compares its CRC.

        Raises:
            LogError: one is damaged.
        """
        for item in self.items:
            try:
                if isinstance(item, Block):
                    if not item.lost:
                        self.unpack(item)
                elif item.opcode == Opcode.ATTACHMENT:
                    Attached.of(self.source, item.offset, item.length - HEAD.size).check(self.source)
            except LogError as error:
                self.lose(item, error)

    def prove(self) -> None:
        """Called before the log is written anew; a whole one is checked by who reads it."""

    def unpacked(self, block: Block, raw: bytes) -> records.Messages:
        """The same, for a caller that has read the block's bytes already."""
        if block.compression is None:
            return records.messages(raw, block.offset)
        opcode, length = HEAD.unpack_from(raw)
        if opcode != Opcode.CHUNK or length != block.length - HEAD.size:
            raise LogError(f"the summary says a chunk lies at byte {block.offset}, which it does not")
        data = records.unpack(raw, block.offset)
        offsets = self._listed(block, len(data))
        found = None if offsets is None else records.listed(data, offsets)
        return found or records.messages(data, block.offset)

    def _listed(self, block: Block, size: int) -> Int64[np.ndarray, " n"] | None:
        """Where the messages of a chunk of `size` bytes begin, by the message indexes behind it; None where they must be wrong.

        A hint: who uses it sees whether messages lie there.
        """
        raw = self.source.at(block.offset + block.length, block.end - block.offset - block.length)
        parts, at = [], 0
        while len(raw) - at >= INDEX_HEAD.size:
            opcode, length, _, size = INDEX_HEAD.unpack_from(raw, at)
            if opcode != Opcode.MESSAGE_INDEX or size % 16 or length != size + 6 or length > len(raw) - at - HEAD.size:
                return None
            parts.append(np.frombuffer(raw, "<u8", size // 8, at + INDEX_HEAD.size)[1::2])
            at += HEAD.size + length
        offsets = np.sort(np.concatenate([np.zeros(0, np.uint64), *parts]))
        return offsets.view(np.int64) if len(offsets) and offsets[-1] < size else None

    def index(self, block: Block, channel: int) -> UInt64[np.ndarray, "n 2"]:
        """The (log time, offset) entries of one channel in one block, from its MessageIndex record.

        Raises:
            LogError: no such record where the log says it is.
        """
        offset = block.indexes[channel]
        opcode, length = self.source.head(offset) if offset + HEAD.size <= block.end else (0, 0)
        if opcode != Opcode.MESSAGE_INDEX or length < 6 or length > block.end - offset - HEAD.size:
            raise LogError(f"the summary says a message index lies at byte {offset}, which it does not")
        body = self.source.at(offset + HEAD.size, length)
        identity, size = struct.unpack_from("<HI", body)
        if identity != channel or size != length - 6 or size % 16:
            raise LogError(f"the message index at byte {offset} is damaged")
        return np.frombuffer(body, "<u8", offset=6).reshape(-1, 2)

    # ── how the chart comes about ────────────────────────────────────────────────────────────────────────────────────

    def _ends(self) -> Footer:
        source = self.source
        if source.size == 0:
            raise LogError("the file is empty", expected="an MCAP log")
        start = source.at(0, min(len(MAGIC), source.size))
        if start != MAGIC[: len(start)]:
            raise LogError(f"this is not an MCAP log: it starts with {start!r}", expected=repr(MAGIC))
        at = source.size - len(MAGIC) - FOOTER_SIZE
        if at < len(MAGIC) or source.at(source.size - len(MAGIC), len(MAGIC)) != MAGIC:
            raise self._cut_short()
        opcode, length = source.head(at)
        if opcode != Opcode.FOOTER or length != FOOTER_SIZE - HEAD.size:
            raise LogError(f"the footer at byte {at} is damaged", expected="a Footer record")
        footer = records.parse(Footer, source.at(at + HEAD.size, length), at)
        assert isinstance(footer, Footer), "parse returns the class it is given"
        return footer

    def _cut_short(self) -> LogError:
        """Where a log without an end stops, found by following its records."""
        position, size = len(MAGIC), self.source.size
        inside = "inside its first record"
        while size - position >= HEAD.size:
            opcode, length = self.source.head(position)
            if length > size - position - HEAD.size:
                inside = f"inside the {records.name_of(opcode)} record that begins at byte {position}"
                break
            position += HEAD.size + length
            inside = f"after the {records.name_of(opcode)} record that ends at byte {position}"
        return LogError(f"the log is cut short at byte {size}, {inside}", expected="a log that ends", fix=CUT_SHORT)

    def _summary(self) -> dict[int, ChunkIndex]:
        """Definitions and statistics of the summary, and its chunk indexes by where their chunk begins."""
        start, end = self.footer.summary_start, self.source.size - len(MAGIC) - FOOTER_SIZE
        if start == 0:
            return {}
        if not len(MAGIC) <= start <= end:
            raise LogError(f"the footer says the summary begins at byte {start}", expected=f"at most {end}")
        if end - start > MOST_SUMMARY:
            raise LogError(f"the summary at byte {start} has {end - start} bytes", expected=f"at most {MOST_SUMMARY}")
        raw = self.source.at(start, end - start + FOOTER_SIZE - 4)
        if self.footer.summary_crc and crc32(raw) != self.footer.summary_crc:
            raise LogError(f"the summary at byte {start} is damaged: its CRC is {crc32(raw):08x}")
        position, stop, index = 0, end - start, {}
        while position < stop:
            opcode, length = HEAD.unpack_from(raw, position) if stop - position >= HEAD.size else (0, stop)
            body = raw[position + HEAD.size : position + HEAD.size + length]
            if length > stop - position - HEAD.size:
                raise LogError(f"the summary is damaged at byte {start + position}: a record crosses its end")
            if opcode == Opcode.CHUNK_INDEX:
                entry = chunk_index.parse(body, start + position)
                index[entry.chunk_start_offset] = entry
            elif opcode == Opcode.STATISTICS:
                self.statistics = records.parse(Statistics, body, start + position)
            else:
                self.define(opcode, body, start + position)
            position += HEAD.size + length
        return index

    def define(self, opcode: int, body: bytes, offset: int) -> None:
        """Takes in a Schema or Channel record; other records are left alone.

        Raises:
            LogError: damaged, or another definition under an id that is taken.
        """
        if opcode == Opcode.SCHEMA:
            schema = records.parse(Schema, body, offset)
            known = self.schemas.setdefault(schema.id, schema)
            if (known.name, known.data) != (schema.name, schema.data):
                raise LogError(f"schema {schema.id} is both {known.name} and, at byte {offset}, {schema.name}")
        elif opcode == Opcode.CHANNEL:
            channel = records.parse(Channel, body, offset)
            taken = self.channels.setdefault(channel.id, channel)
            if (taken.topic, taken.schema_id) != (channel.topic, channel.schema_id):
                raise LogError(f"channel {channel.id} is both {taken.topic} and, at byte {offset}, {channel.topic}")

    def _chart(self, index: dict[int, ChunkIndex]) -> int:
        """Follows the data section; returns where its DataEnd record begins."""
        source, position = self.source, len(MAGIC)
        limit = self.footer.summary_start or source.size - len(MAGIC) - FOOTER_SIZE
        opcode, length = source.head(position)
        if opcode != Opcode.HEADER or length > limit - position - HEAD.size:
            raise LogError(f"the record at byte {position} is {records.name_of(opcode)}", expected="a whole Header")
        self.header: Header = records.parse(Header, source.at(position + HEAD.size, length), position)
        position += HEAD.size + length
        self.header_end = position
        while position < limit:
            if (known := index.get(position)) is not None:
                block = known_block(known, limit)
                self.items.append(block)
                position = block.end
                continue
            opcode, length = source.head(position) if limit - position >= HEAD.size else (0, limit)
            if length > limit - position - HEAD.size:
                raise LogError(
                    f"the {records.name_of(opcode)} record at byte {position} is damaged: it says it has {length} bytes",
                    expected=f"at most {max(0, limit - position - HEAD.size)}",
                )
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                return position
            position = self._item(opcode, position, length, limit)
        raise LogError(f"the data section does not end before byte {limit}", expected="a DataEnd record")

    def _item(self, opcode: int, position: int, length: int, limit: int) -> int:
        """Takes in one record of the data section, or one run of messages; returns where the next begins."""
        whole = HEAD.size + length
        if opcode == Opcode.CHUNK:
            first = self.source.at(position, min(128, whole))
            head = records.ChunkHead.of(first, whole, position)
            self.items.append(
                Block(position, whole, position + whole, head.start_ns, head.end_ns, head.compression, counts=None)
            )
        elif opcode == Opcode.MESSAGE:
            return self._run(position, whole, limit)
        elif opcode == Opcode.MESSAGE_INDEX and self.items and isinstance(self.items[-1], Block):
            self._follow(self.items[-1], position, length)
        else:
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self.define(opcode, self.source.at(position + HEAD.size, length), position)
            self.items.append(Span(opcode, position, whole))
        return position + whole

    def _follow(self, block: Block, position: int, length: int) -> None:
        """A MessageIndex record behind its chunk."""
        if length < 6 or block.compression is None:
            raise LogError(f"the message index at byte {position} is damaged")
        channel, size = struct.unpack("<HI", self.source.at(position + HEAD.size, 6))
        block.end = position + HEAD.size + length
        if size:
            block.indexes[channel] = position

    def _run(self, position: int, first: int, limit: int) -> int:
        """A run of messages outside chunks, as one block."""
        raw = self.source.at(position, max(first, min(RUN_BYTES, limit - position)))
        _, _, end = records.scan(raw, bare=True)
        if not end:
            raise LogError(
                f"the message at byte {position} has {first - HEAD.size} bytes", expected=f"at least {records.FIXED}"
            )
        found = records.messages(raw[:end], position)
        times = found.times()
        counts = Counter(found.heads["channel"].tolist())
        self.items.append(Block(position, end, position + end, int(times.min()), int(times.max()), None, counts=dict(counts)))
        return position + end

    def _complete(self) -> None:
        """Finds the definitions that only stand inside chunks, when the summary does not vouch for having them all."""
        chunks = [block for block in self.blocks if block.compression is not None]
        if not self.vouched:
            for block in chunks:
                if not block.indexes or not block.indexes.keys() <= self.channels.keys():
                    self._learn(block)
            for block in chunks:
                if all(c.schema_id in self.schemas for c in self.channels.values() if c.schema_id):
                    break
                self._learn(block)
        used = {c for block in self.blocks for c in (block.indexes or block.counts or {})}
        for block in chunks:  # a definition may also stand in a chunk that has no message of its channel
            if used <= self.channels.keys():
                break
            if block.counts is None:
                self._learn(block)
        missing = used - self.channels.keys()
        if missing:
            raise LogError(f"channel {min(missing)} has messages and no Channel record", expected="a definition")
        for channel in self.channels.values():
            if channel.schema_id and channel.schema_id not in self.schemas:
                raise LogError(f"{channel.topic} has schema {channel.schema_id}, which no record defines")

    def _learn(self, block: Block) -> None:
        found = self.unpack(block)
        block.counts = dict(Counter(found.heads["channel"].tolist()))
        for opcode, first, length in found.definitions:
            self.define(opcode, found.data[first : first + length].tobytes(), block.offset)

    def _counts_of(self, block: Block) -> dict[int, int]:
        if block.counts is None:
            if block.indexes:
                block.counts = {channel: len(self.index(block, channel)) for channel in block.indexes}
            else:
                self._learn(block)
        assert block.counts is not None, "learning a block counts it"
        return block.counts


def known_block(entry: ChunkIndex, limit: int) -> Block:
    """A chunk as the summary describes it."""
    offset, length = entry.chunk_start_offset, entry.chunk_length
    end = offset + length + entry.message_index_length
    if length < HEAD.size + records.CHUNK_HEAD.size or end > limit:
        raise LogError(f"the summary says the chunk at byte {offset} ends at byte {end}", expected=f"at most {limit}")
    indexes = dict(entry.message_index_offsets) if entry.message_index_length else {}
    return Block(offset, length, end, entry.message_start_time, entry.message_end_time, entry.compression, indexes)
