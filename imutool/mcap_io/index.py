"""Index of an intact log: its definitions, chunks and other records, in file order.

The data section is followed from its first byte to its end, so no record is overlooked. A chunk that the summary lists is not
read: one dictionary look-up per chunk. Logs without summary, message indexes or chunks only cost more reading.
"""

from __future__ import annotations

import struct
from collections import Counter

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Header, Schema, Statistics

from imutool.array_types import UInt64
from imutool.errors import LogError
from imutool.mcap_io.blocks import (
    HEAD_BYTES,
    Attachment,
    MessageBlock,
    RecordSpan,
    cut_short,
    message_offsets,
    read_entries,
    read_run,
    too_large,
)
from imutool.mcap_io.codec import messages, records
from imutool.mcap_io.codec.records import FOOTER_SIZE, HEAD, MAGIC, crc32
from imutool.mcap_io.storage.source import Source

SMALL = 4096  # bytes of a chunk in which messages are found sooner than in its message indexes
MAX_SUMMARY = 1 << 29  # bytes; that of a 100 GB log has some 20 million
CONVERT = "`imutool convert` makes one of other recordings"


class LogIndex:
    """Definitions, blocks of messages and other records of one log.

    Raises:
        LogError: empty, not an MCAP log, cut short, or damaged; the message says at which byte.
    """

    def __init__(self, source: Source, max_chunk: int = records.MAX_CHUNK) -> None:
        self.source, self.max_chunk = source, max_chunk
        self._read()

    def _read(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.items: list[MessageBlock | RecordSpan] = []
        self.statistics: Statistics | None = None
        self.footer = self._read_footer()
        self.data_end = self._scan_data_section(self._read_summary())
        self._find_definitions()

    @property
    def blocks(self) -> list[MessageBlock]:
        """Every block of messages, in file order."""
        return [item for item in self.items if isinstance(item, MessageBlock) and not item.lost]

    @property
    def header_bytes(self) -> bytes:
        """The bytes of the Header record."""
        return self.source.at(len(MAGIC), self.header_end - len(MAGIC))

    def lose(self, item: MessageBlock | RecordSpan, error: LogError) -> None:
        """Handles a part that cannot be read; in an intact log that is an error.

        Raises:
            LogError: `error`.
        """
        raise error

    @property
    def definitions_known(self) -> bool:
        """Whether no definition is missing: the statistics count as many as are known."""
        counted = self.statistics
        return counted is not None and (counted.channel_count, counted.schema_count) == (len(self.channels), len(self.schemas))

    def counts(self) -> dict[int, int]:
        """Messages per channel id."""
        return dict(self.statistics.channel_message_counts) if self.statistics else self.summed_counts()

    def summed_counts(self) -> dict[int, int]:
        """Messages per channel id, block by block."""
        total: Counter[int] = Counter()
        for block in self.blocks:
            total.update(self._counts_of(block))
        return dict(total)

    def unpack(self, block: MessageBlock) -> messages.Messages:
        """The messages of a block, CRC checked.

        Raises:
            LogError: the block is damaged.
        """
        return self.unpack_bytes(block, self.read(block))

    def read(self, block: MessageBlock) -> bytes:
        """The bytes of a block, as another log can hold them.

        Raises:
            LogError: too large for memory, or the disk does not give them.
        """
        if block.length > self.max_chunk:
            raise too_large("chunk", block.offset, block.length, self.max_chunk)
        return self.source.at(block.offset, block.length)

    def unpack_or_lose(self, block: MessageBlock) -> messages.Messages | None:
        """The messages of a block, or None where the block is damaged and `lose` allows it."""
        try:
            return self.unpack(block)
        except LogError as error:
            self.lose(block, error)
            return None

    def check(self) -> None:
        """Compares the CRC of every chunk and attachment.

        Raises:
            LogError: one is damaged.
        """
        for item in self.items:
            try:
                if isinstance(item, MessageBlock) and not item.lost:
                    self.unpack(item)
                elif isinstance(item, RecordSpan) and item.opcode == Opcode.ATTACHMENT:
                    Attachment.of(self.source, item.offset, item.length - HEAD.size).check_crc(self.source)
            except LogError as error:
                self.lose(item, error)

    def unpack_bytes(self, block: MessageBlock, raw: bytes) -> messages.Messages:
        """The messages of a block whose bytes are read already, CRC checked."""
        if block.compression is None:
            return messages.parse(raw, block.offset)
        data = records.unpack(raw, block.offset, self.max_chunk, block.head(raw))
        offsets = message_offsets(self.source, block, len(data)) if len(data) > SMALL else None
        found = (None if offsets is None else messages.parse_at(data, offsets)) or messages.parse(data, block.offset)
        block.trusted &= offsets is None or np.array_equal(offsets, found.offsets)  # an index may list some messages alone
        return found

    def entries(self, block: MessageBlock, channel: int) -> UInt64[np.ndarray, "n 2"]:
        """The message index of one channel of a block."""
        return read_entries(self.source, block, channel)

    # ── building the index ───────────────────────────────────────────────────────────────────────────────────────────

    def _read_footer(self) -> Footer:
        source = self.source
        if source.size == 0:
            raise LogError("the file is empty", expected="an MCAP log")
        start = source.at(0, min(len(MAGIC), source.size))
        if start != MAGIC[: len(start)]:
            raise LogError(f"this is not an MCAP log: it starts with {start!r}", expected=repr(MAGIC), fix=CONVERT)
        at = source.size - len(MAGIC) - FOOTER_SIZE
        if at < len(MAGIC) or source.at(source.size - len(MAGIC), len(MAGIC)) != MAGIC:
            raise cut_short(source)
        if source.head(at) != (Opcode.FOOTER, FOOTER_SIZE - HEAD.size):
            raise LogError(f"the footer at byte {at} is damaged", expected="a Footer record")
        footer: Footer = records.parse(Footer, source.at(at + HEAD.size, FOOTER_SIZE - HEAD.size), at)
        return footer

    def _read_summary(self) -> dict[int, ChunkIndex]:
        """Reads definitions and statistics; returns the chunk indexes by chunk offset."""
        start, end = self.footer.summary_start, self.source.size - len(MAGIC) - FOOTER_SIZE
        if start == 0:
            return {}
        if not len(MAGIC) <= start <= end:
            raise LogError(f"the footer says the summary begins at byte {start}", expected=f"at most {end}")
        if end - start > MAX_SUMMARY:
            raise LogError(f"the summary at byte {start} has {end - start} bytes", expected=f"at most {MAX_SUMMARY}")
        raw = self.source.at(start, end - start + FOOTER_SIZE - 4)
        if self.footer.summary_crc and crc32(raw) != self.footer.summary_crc:
            raise LogError(f"the summary at byte {start} is damaged: its CRC is {crc32(raw):08x}")
        position, stop, chunks = 0, end - start, {}
        while position < stop:
            opcode, length = HEAD.unpack_from(raw, position) if stop - position >= HEAD.size else (0, stop)
            body = raw[position + HEAD.size : position + HEAD.size + length]
            if length > stop - position - HEAD.size:
                raise LogError(f"the summary is damaged at byte {start + position}: a record crosses its end")
            if opcode == Opcode.CHUNK_INDEX:
                entry = records.parse_chunk_index(body, start + position)
                chunks[entry.chunk_start_offset] = entry
            elif opcode == Opcode.STATISTICS:
                self.statistics = records.parse(Statistics, body, start + position)
            else:
                self.define(opcode, body, start + position)
            position += HEAD.size + length
        return chunks

    def define(self, opcode: int, body: bytes, offset: int) -> None:
        """Takes in a Schema or Channel record; ignores other records.

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

    def _scan_data_section(self, chunks: dict[int, ChunkIndex]) -> int:
        """Follows the data section; returns where its DataEnd record begins."""
        source, position = self.source, len(MAGIC)
        limit = self.footer.summary_start or source.size - len(MAGIC) - FOOTER_SIZE
        opcode, length = source.head(position)
        if opcode != Opcode.HEADER or length > limit - position - HEAD.size:
            raise LogError(f"the record at byte {position} is {records.name_of(opcode)}", expected="a whole Header")
        self.header: Header = records.parse(Header, source.at(position + HEAD.size, length), position)
        self.header_end = position = position + HEAD.size + length
        while position < limit:
            if (known := chunks.get(position)) is not None:
                self.items.append(block := MessageBlock.of_summary(known, limit))
                position = block.end
                continue
            opcode, length = source.head(position) if limit - position >= HEAD.size else (0, limit)
            if length > limit - position - HEAD.size:
                raise LogError(
                    f"the {records.name_of(opcode)} record at byte {position} is damaged: it says it has {length} bytes",
                    expected=f"at most {max(0, limit - position - HEAD.size)}",
                )
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                if opcode == Opcode.FOOTER or position + HEAD.size + length != limit:
                    raise LogError(f"the data section ends at byte {position}, ahead of byte {limit} where the summary begins")
                return position
            position = self._add(opcode, position, length, limit)
        raise LogError(f"the data section does not end before byte {limit}", expected="a DataEnd record")

    def _add(self, opcode: int, position: int, length: int, limit: int) -> int:
        """Adds one record of the data section, or a run of messages; returns where the next begins."""
        whole = HEAD.size + length
        if opcode == Opcode.CHUNK:
            head = records.ChunkHead.of(self.source.at(position, min(HEAD_BYTES, whole)), whole, position)
            self.items.append(MessageBlock(position, whole, position + whole, head.start_ns, head.end_ns, head.compression))
        elif opcode == Opcode.MESSAGE:
            if whole > self.max_chunk:
                raise too_large("message", position, whole, self.max_chunk)
            block = read_run(self.source, position, whole, limit)
            self.items.append(block)
            return block.end
        elif opcode == Opcode.MESSAGE_INDEX and self.items and isinstance(self.items[-1], MessageBlock):
            self._add_message_index(self.items[-1], position, length)
        else:
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self.define(opcode, self.source.at(position + HEAD.size, length), position)
            self.items.append(RecordSpan(opcode, position, whole))
        return position + whole

    def _add_message_index(self, block: MessageBlock, position: int, length: int) -> None:
        if length < 6 or block.compression is None:
            raise LogError(f"the message index at byte {position} is damaged")
        channel, size = struct.unpack("<HI", self.source.at(position + HEAD.size, 6))
        block.end = position + HEAD.size + length
        if size:
            block.indexes[channel] = position

    def _find_definitions(self) -> None:
        """Finds the definitions that only stand inside chunks, unless the summary has them all."""
        chunks = [block for block in self.blocks if block.compression is not None]
        if not self.definitions_known:
            for block in chunks:
                if not block.indexes or not block.indexes.keys() <= self.channels.keys():
                    self._read_definitions(block)
            for block in chunks:
                if all(c.schema_id in self.schemas for c in self.channels.values() if c.schema_id):
                    break
                self._read_definitions(block)
        used = {c for block in self.blocks for c in (block.indexes or block.counts or {})}
        for block in chunks:  # a definition may also stand in a chunk that has no message of its channel
            if used <= self.channels.keys():
                break
            if block.counts is None:
                self._read_definitions(block)
        if missing := used - self.channels.keys():
            raise LogError(f"channel {min(missing)} has messages and no Channel record", expected="a definition")
        for channel in self.channels.values():
            if channel.schema_id and channel.schema_id not in self.schemas:
                raise LogError(f"{channel.topic} has schema {channel.schema_id}, which no record defines")

    def _read_definitions(self, block: MessageBlock) -> None:
        found = self.unpack(block)
        block.counts = dict(Counter(found.heads["channel"].tolist()))
        for opcode, first, length in found.definitions:
            self.define(opcode, found.data[first : first + length].tobytes(), block.offset)

    def _counts_of(self, block: MessageBlock) -> dict[int, int]:
        if block.counts is None and block.indexes:
            block.counts = {channel: len(self.entries(block, channel)) for channel in block.indexes}
        elif block.counts is None:
            self._read_definitions(block)
        assert block.counts is not None, "reading the definitions of a block counts its messages"
        return block.counts
