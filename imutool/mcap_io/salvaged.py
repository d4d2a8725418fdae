"""The chart of a log that may be damaged: everything in it that can still be proven, and what cannot is told.

Believed is what a CRC covers: a summary, the contents of a chunk. The data section is followed record by record as in a whole log;
where framing breaks, the search goes on from byte to byte until a record convinces again (`resync`), or to the next chunk that the
summary knows. Message indexes are believed only as far as the summary vouches for them. Two logs in one file are two sections with
definitions of their own, and ids that collide are given anew.
"""

from __future__ import annotations

import struct
import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import UInt64
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Header, Schema, Statistics

from imutool.errors import LogError
from imutool.mcap_io import records
from imutool.mcap_io.attachment import Attached
from imutool.mcap_io.losses import Loss, Losses
from imutool.mcap_io.mend import MOST_SEARCHED, definitions, in_order, mended
from imutool.mcap_io.records import FIXED, FOOTER_SIZE, HEAD, MAGIC
from imutool.mcap_io.resync import LEAST, PRIVATE, SUMMARY, Frames
from imutool.mcap_io.source import Source
from imutool.mcap_io.structure import RUN_BYTES, Block, Span, Structure, known_block

MOST_ITEMS = 5_000_000  # a 100 GB log has some 100 000 chunks; a file of nothing but empty ones is made to fill the memory
ANOTHER = MAGIC + bytes([Opcode.HEADER])  # how a log begins
MOST_AGREED = 1000
MOST_SUMMARY = 1 << 28  # bytes; that of a 100 GB log has some 20 million
LATEST_NS = 2**63  # log times from here on (the year 2262) are of no clock


@dataclass
class Section:
    """One log in the file: from its first byte on, ids mean what its own records say."""

    start: int
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    vouched: set[tuple[int, int]] = field(default_factory=set)  # opcode and id of definitions that a CRC covers
    ids: dict[int, int] = field(default_factory=dict)  # its channels as the whole file's


@dataclass
class Gap:
    """A stretch in which no record could be made out."""

    offset: int
    length: int
    reason: str
    counts: Counter[int] = field(default_factory=Counter)  # by the channel ids of its section
    counted: bool = False  # from message indexes that survived behind it
    start_ns: int | None = None
    end_ns: int | None = None


class Salvaged(Structure):
    """As `Structure`, for a file that may be damaged; `losses` says what could not be used, and grows while chunks are read.

    Without a summary that a CRC vouches for, every chunk is unpacked at once, because only that proves it.

    Raises:
        LogError: there is nothing in the file that could be saved.
    """

    losses: Losses

    def __init__(self, source: Source) -> None:
        self.losses = Losses()
        self.sections = [Section(0)]
        self._trusted = False  # the summary: its CRC says it is as it was written
        self._index: dict[int, ChunkIndex] = {}
        self._last: Block | Gap | None = None  # what message indexes would belong to
        self._unframed: Gap | None = None  # messages from here on may be the contents of a damaged chunk
        self._gaps: list[Gap] = []
        self._doubtful: list[tuple[Block, Gap]] = []
        self._failed: list[tuple[Block, LogError]] = []
        self._lost_spans: set[int] = set()
        self._put_right: set[int] = set()
        self._agreed: set[bytes] = set()  # definitions in chunks that say nothing new
        self._data_end, self._data_ends = 0, 0
        self._ended = False
        self._header: Header | None = None
        super().__init__(source)

    # ── what callers use ─────────────────────────────────────────────────────────────────────────────────────────────

    @property
    def opening(self) -> bytes:
        """The bytes of the Header record, made anew where it is lost."""
        return records.build(self.header)

    def counts(self) -> dict[int, int]:
        """Messages per channel id, of what is not lost so far."""
        if self.statistics is not None and not self.losses:
            return dict(self.statistics.channel_message_counts)
        total: Counter[int] = Counter()
        for block in self.blocks:
            if block.counts is None and block.vouched and block.indexes:
                block.counts = _indexed(block)
            if block.counts is None and (found := self.found(block)) is not None:
                block.counts = dict(Counter(found.heads["channel"].tolist()))
            total.update(block.counts or {})
        return dict(total)

    def read(self, block: Block) -> bytes:
        """The bytes of a block, the head of a chunk put right where that is what is damaged.

        Raises:
            LogError: the disk does not give them.
        """
        raw = super().read(block)
        if block.compression is None:
            return raw
        better = mended(raw, block.offset, self._index.get(block.offset))
        if better is None:
            return raw
        self._put_right.add(block.offset)
        return better

    def unpacked(self, block: Block, raw: bytes) -> records.Messages:
        """The messages of a block that mean something: those of channels that are defined, at times that can be."""
        return self._fitted(block, self._opened(block, raw))

    def index(self, block: Block, channel: int) -> UInt64[np.ndarray, "n 2"]:
        """The entries of a message index; none where it is damaged, since the chunk itself says the same."""
        try:
            return super().index(block, channel)
        except LogError as error:
            self.losses.mend(error.what)
            return np.zeros((0, 2), np.uint64)

    def lose(self, item: Block | Span, error: LogError) -> None:
        """Leaves a part of the log out from now on, and remembers why."""
        if isinstance(item, Span):
            if item.offset not in self._lost_spans:
                self._lost_spans.add(item.offset)
                self.losses.add(Loss(item.offset, item.length, _reason(error), exact=True))
        elif not item.lost:
            item.lost = True
            self.losses.unchecked_in.pop(item.offset, None)
            counts, exact = self._known_of(item)
            times = (item.start_ns, item.end_ns) if item.start_ns <= item.end_ns < LATEST_NS else (None, None)
            self.losses.add(Loss(item.offset, item.length, _reason(error), self._by_topic(counts), exact, *times))

    def check(self) -> None:
        """Reads every chunk and attachment, so that `losses` is complete."""
        for block in self.blocks:
            self.found(block)
        for item in self.items:
            if isinstance(item, Span) and item.opcode == Opcode.ATTACHMENT and item.offset not in self._lost_spans:
                try:
                    Attached.of(self.source, item.offset, item.length - HEAD.size).check(self.source)
                except LogError as error:
                    self.lose(item, error)

    def define(self, opcode: int, body: bytes, offset: int, vouched: bool = True) -> None:
        """Takes in a Schema or Channel record of the section there; of two that disagree, the one that a CRC vouches for.

        Raises:
            LogError: damaged, or both are vouched for.
        """
        if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
            return
        section = self.sections[self._section(offset)]
        known: dict[int, Schema] | dict[int, Channel] = section.schemas if opcode == Opcode.SCHEMA else section.channels
        record = records.parse(Schema if opcode == Opcode.SCHEMA else Channel, body, offset)
        before, key = known.get(record.id), (opcode, record.id)
        if before is not None and not _same(before, record):
            said = f"{records.name_of(opcode).lower()} {record.id} has two definitions, the second at byte {offset}"
            if vouched and key in section.vouched:
                raise LogError(said)
            self.losses.mend(f"{said}; {'the second' if vouched else 'the first'} holds")
            if not vouched:
                return
        if vouched or before is None:
            known[record.id] = record
        if vouched:
            section.vouched.add(key)

    # ── how the chart comes about ────────────────────────────────────────────────────────────────────────────────────

    def _ends(self) -> Footer:
        source = self.source
        if source.size == 0:
            raise LogError("the file is empty", expected="an MCAP log")
        nothing = Footer(summary_start=0, summary_offset_start=0, summary_crc=0)
        at = source.size - len(MAGIC) - FOOTER_SIZE
        if at < len(MAGIC) or source.at(source.size - len(MAGIC), len(MAGIC)) != MAGIC:
            return nothing
        if source.head(at) != (Opcode.FOOTER, FOOTER_SIZE - HEAD.size):
            return nothing
        footer: Footer = records.parse(Footer, source.at(at + HEAD.size, FOOTER_SIZE - HEAD.size), at)
        return footer

    def _summary(self) -> dict[int, ChunkIndex]:
        if not self.footer.summary_crc:
            return {}  # nobody can say what it is worth; its records are met on the way, as others are
        try:
            self._index = super()._summary()
        except LogError as error:
            self.losses.mend(f"{_reason(error)}; a new summary can be made")
            self.sections, self.statistics = [Section(0)], None
            return {}
        self._trusted = self.footer.summary_start > 0
        return self._index

    def _chart(self, index: dict[int, ChunkIndex]) -> int:
        limit = self.footer.summary_start if self._trusted else self.source.size
        self._frames = Frames(self.source, limit)
        chunks = sorted(index)
        position = self._open()
        while position < limit:
            if len(self.items) + len(self._gaps) > MOST_ITEMS:
                raise LogError(
                    f"the log has more than {MOST_ITEMS} chunks and other records", expected="one that a recorder made"
                )
            if (block := self._vouched(position, limit)) is not None:
                self._take(block)
                position = block.end
                continue
            after = self._step(position)
            if after is None:
                following = bisect_right(chunks, position)
                after = self._gap(position, min(limit, chunks[following]) if following < len(chunks) else limit)
            position = after
        if self._trusted and not self._ended:
            self.losses.mend(f"the DataEnd record before byte {limit} is damaged; a new one can be made")
        elif not self._ended and not (self._gaps and self._gaps[-1].offset + self._gaps[-1].length == limit):
            self._gaps.append(
                Gap(limit, 0, "the log stops here without an end: the recorder did not finish it, or it was cut off")
            )
        return self._data_end if self._data_ends == 1 and len(self.sections) == 1 else self.source.size

    def _vouched(self, position: int, limit: int) -> Block | None:
        entry = self._index.get(position)
        if entry is None:
            return None
        try:
            return known_block(entry, limit)
        except LogError as error:
            self.losses.mend(_reason(error))
            return None

    def _open(self) -> int:
        """The magic and the Header; returns where records begin."""
        at = len(MAGIC)
        found = self._frames.head(at)
        sound = found is not None and found[0] == Opcode.HEADER and self._frames.agrees(at, *found)
        if not self._frames.magic(0):
            self.losses.mend("the file does not begin as an MCAP log does")
            if not sound:
                return 0
        return at

    def _take(self, chunk: Block) -> None:
        self.items.append(chunk)
        self._last, self._unframed = chunk, None

    def _step(self, position: int) -> int | None:
        """Takes in what begins at a position; returns where the next record begins, or None where none can be made out."""
        frames = self._frames
        if frames.magic(position):
            self._border(position)
            return position + len(MAGIC)
        head = frames.head(position)
        if head is not None and head[0] == Opcode.MESSAGE:
            return self._messages(position, head[1])
        if head is None or not frames.agrees(position, *head):
            return self._damaged(position)
        return None if self._swallows(position, *head) else self._record(position, *head)

    def _swallows(self, position: int, opcode: int, length: int) -> bool:
        """Whether a record was cut off, and what was written next lies where the rest of it should.

        Then another log begins inside it, or the end of a chunk leads nowhere; and its CRC does not prove it whole.
        """
        end = position + HEAD.size + length
        astray = opcode == Opcode.CHUNK and not self._frames.leads_on(end)
        if self._trusted or not (astray or self._frames.holds(position, end, ANOTHER)):
            return False
        try:
            if opcode == Opcode.CHUNK:
                records.unpack(self.source.at(position, end - position), position)
            elif opcode == Opcode.ATTACHMENT:
                return not Attached.of(self.source, position, length).check(self.source)
        except LogError:
            return True
        return opcode != Opcode.CHUNK

    def _border(self, position: int) -> None:
        """The magic inside the file: another log begins here, if a Header follows; else one has ended."""
        head = self._frames.head(position + len(MAGIC))
        if position and head is not None and head[0] == Opcode.HEADER:
            if not self._ended:
                self._gaps.append(Gap(position, 0, "a log stops here without an end, and another begins"))
            self.losses.mend(f"another log begins at byte {position}")
            self.sections.append(Section(position))
            self._ended, self._last, self._unframed = False, None, None

    def _record(self, position: int, opcode: int, length: int) -> int:
        """Takes in a record that agrees with itself; returns where it ends."""
        end, last = position + HEAD.size + length, self._last
        if opcode == Opcode.CHUNK:
            head = self._frames.chunk(position, length)
            assert head is not None, "a chunk that agrees has a head"
            self._take(Block(position, end - position, end, head.start_ns, head.end_ns, head.compression, vouched=False))
        elif opcode == Opcode.MESSAGE_INDEX:
            self._unframed = None
            if isinstance(last, Gap):
                self._count(last, position, length)
            elif isinstance(last, Block) and last.end == position:
                channel, size = struct.unpack("<HI", self.source.at(position + HEAD.size, 6))
                last.end = end
                if size:
                    last.indexes[channel] = position
        elif opcode == Opcode.HEADER:
            if self._header is None:
                self._header = records.parse(Header, self.source.at(position + HEAD.size, length), position)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self.define(opcode, self.source.at(position + HEAD.size, length), position, vouched=False)
            if not self._ended:
                self.items.append(Span(opcode, position, end - position))
        elif opcode == Opcode.FOOTER:
            self._moved_summary(position)
        elif opcode == Opcode.DATA_END:
            self._data_end, self._data_ends = position, self._data_ends + 1
            self._ended, self._last, self._unframed = True, None, None
        elif opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
            self.items.append(Span(opcode, position, end - position))
        elif opcode == Opcode.STATISTICS and not self._trusted and self.statistics is None:
            self._told: Statistics = records.parse(Statistics, self.source.at(position + HEAD.size, length), position)
        return end

    def _moved_summary(self, position: int) -> None:
        """A summary that is not where it says it is tells by how far, and so where its log began in the file."""
        footer = records.parse(Footer, self.source.at(position + HEAD.size, FOOTER_SIZE - HEAD.size), position)
        start, stop = self._data_end + HEAD.size + 4, position + FOOTER_SIZE - 4
        base = start - footer.summary_start
        if self._trusted or not self._ended or not footer.summary_crc or not footer.summary_start or base < 0:
            return
        if stop - start > MOST_SUMMARY:
            return
        raw = self.source.at(start, stop - start)
        if zlib.crc32(raw) != footer.summary_crc:
            return
        if all(section.start != base for section in self.sections):
            self.losses.mend(f"another log begins at byte {base}, as its summary says")
            self.sections.insert(self._section(base) + 1, Section(base))
        at = 0
        while len(raw) - at >= HEAD.size:
            opcode, length = HEAD.unpack_from(raw, at)
            try:
                self.define(opcode, raw[at + HEAD.size : at + HEAD.size + length], base)
            except LogError as error:
                self.losses.mend(_reason(error))
            at += HEAD.size + length

    def _count(self, gap: Gap, position: int, length: int) -> None:
        """A message index whose chunk is lost still tells what was in it."""
        body = self.source.at(position + HEAD.size, length)
        (channel,) = struct.unpack_from("<H", body)
        entries = np.frombuffer(body, "<u8", offset=6).reshape(-1, 2)
        if not gap.counted:
            gap.counts, gap.counted = Counter(), True
        gap.counts[channel] += len(entries)
        if len(entries) and entries[:, 0].max() < LATEST_NS:
            first, final = int(entries[:, 0].min()), int(entries[:, 0].max())
            gap.start_ns = first if gap.start_ns is None else min(first, gap.start_ns)
            gap.end_ns = final if gap.end_ns is None else max(final, gap.end_ns)

    def _damaged(self, position: int) -> int | None:
        """A record that does not agree with itself, or that nobody knows; None where not even its end is known."""
        frames = self._frames
        if self._frames.limit - position < HEAD.size:
            return None
        opcode, length = self.source.head(position)
        fits = length <= frames.limit - position - HEAD.size and frames.leads_on(position + HEAD.size + length)
        for own in (length if fits else None, frames.own_length(position)):  # a chunk whose opcode or length is what is damaged
            if own is not None and (opcode == Opcode.CHUNK or frames.chunk(position, own) is not None):
                end = position + HEAD.size + own
                if frames.leads_on(end):
                    start_ns, end_ns = struct.unpack("<QQ", self.source.at(position + HEAD.size, 16))
                    self._take(Block(position, end - position, end, start_ns, end_ns, "", vouched=False))
                    return end
        if not fits:
            return None
        whole = HEAD.size + length
        if opcode >= PRIVATE:
            self.items.append(Span(opcode, position, whole))
        elif (opcode in SUMMARY and self._ended) or (opcode == Opcode.MESSAGE_INDEX and self._last is not None):
            self.losses.mend(f"the {records.name_of(opcode)} record at byte {position} is damaged; a new one can be made")
            if isinstance(self._last, Block) and self._last.end == position:
                self._last.end += whole
        else:
            reason = f"the {records.name_of(opcode)} record here is damaged"
            self._gaps.append(Gap(position, whole, reason))
        return position + whole

    def _messages(self, position: int, length: int) -> int | None:
        """A run of messages outside chunks, as one block; its last one counts only if what follows shows where it ends."""
        limit = self._frames.limit
        raw = self.source.at(position, min(max(RUN_BYTES, HEAD.size + length), limit - position))
        offsets, _, end = records.scan(raw, bare=True)
        if not self._bounded(position + end, raw, offsets):
            end = int(offsets[-1])
        another = -1 if self._trusted else raw.find(ANOTHER, 0, end)
        if another >= 0:
            end = int(offsets[offsets <= another][-1])
        if not end:
            return None
        found = records.messages(raw[:end], position)
        times = found.heads["log_time"]
        block = Block(position, end, position + end, int(times.min()), int(times.max()), None, vouched=False)
        self.items.append(block)
        self._last = self._unframed
        if self._unframed is not None:
            self._doubtful.append((block, self._unframed))
        return position + end

    def _bounded(self, end: int, raw: bytes, offsets: np.ndarray) -> bool:
        """Whether the last message of a run ends at `end` indeed: a record follows, if perhaps a damaged one."""
        frames = self._frames
        if frames.leads_on(end):
            return True
        room = frames.limit - end
        if room >= HEAD.size:
            opcode, length = self.source.head(end)
            if opcode in LEAST and opcode != Opcode.MESSAGE and length < 1 << 48:
                return True  # a record of another kind, which goes on beyond the end of the file or is damaged
        if room < HEAD.size + 2:
            return self.source.at(end, 1)[0] == Opcode.MESSAGE or frames.limit < self.source.size or room <= 0
        heads = [raw[at : at + HEAD.size + 2] for at in offsets[-256:].tolist()]
        if heads[-1] in heads[:-1]:
            return True  # as long as one before it on its channel
        following = self.source.at(end, HEAD.size + 2)
        opcode, length = HEAD.unpack_from(following)
        if opcode == Opcode.MESSAGE and following[HEAD.size :] in {head[HEAD.size :] for head in heads}:
            return True
        return bool(length <= room - HEAD.size and length >= FIXED and frames.leads_on(end + HEAD.size + length))

    def _gap(self, position: int, limit: int) -> int:
        """Goes on to the next record that convinces; what lies between is lost."""
        frames = self._frames
        after = frames.next(position + 1, limit, self._channels())
        gap = Gap(position, after - position, self._what_broke(position))
        first = self.source.at(position, min(64, frames.limit - position))
        if len(first) >= HEAD.size + 16 and first[0] == Opcode.CHUNK:
            start_ns, end_ns = struct.unpack_from("<QQ", first, HEAD.size)
            if start_ns <= end_ns < LATEST_NS:
                gap.start_ns, gap.end_ns = start_ns, end_ns
        if self._ended and not any(
            frames.source.at(at, min(1 << 20, after - at)).strip(b"\0") for at in range(position, after, 1 << 20)
        ):
            self.losses.mend(f"{after - position} zero bytes follow the end of the log, at byte {position}")
            return after
        self._gaps.append(gap)
        self._last = self._unframed = gap
        return after

    def _what_broke(self, position: int) -> str:
        room = self._frames.limit - position - HEAD.size
        if room < 0:
            return "the log is cut short here, inside the head of a record"
        opcode, length = self.source.head(position)
        if opcode not in set(Opcode):
            return "no record begins here"
        name = records.name_of(opcode)
        if length > room:
            return f"the {name} record here says it has {length} bytes, and {room} are there"
        return f"the {name} record here is damaged"

    def _channels(self) -> set[int]:
        return {channel for section in self.sections for channel in section.channels}

    def _section(self, offset: int) -> int:
        return bisect_right([section.start for section in self.sections], offset) - 1

    # ── definitions, and what they make of the blocks ────────────────────────────────────────────────────────────────

    def _complete(self) -> None:
        told = self.statistics
        lacking = told is None or (told.channel_count, told.schema_count) != _sizes(self.sections[0])
        if any(item.compression is not None for item in self.blocks):
            self._give_up_doubtful()
        for block in self.blocks:
            if lacking or not block.vouched:
                self._learn(block)
        self._search_definitions()
        self._number()
        self._tell_unproven()
        for block in self.blocks:
            if block.counts is not None:
                self._settle(block, block.counts)
        for block, error in self._failed:
            self.lose(block, error)
        for gap in self._gaps:
            self._close(gap)
        self._gaps.clear()
        self._settle_header()

    def _give_up_doubtful(self) -> None:
        """In a log with chunks, messages found behind a gap are the insides of a damaged chunk, which nothing proves."""
        dropped = {id(block) for block, _ in self._doubtful}
        for block, gap in self._doubtful:
            gap.length = max(gap.length, block.offset + block.length - gap.offset)
            if not gap.counted:
                gap.counts.update(
                    records.messages(self.source.at(block.offset, block.length), block.offset).heads["channel"].tolist()
                )
        self.items = [item for item in self.items if id(item) not in dropped]

    def _learn(self, block: Block) -> None:
        """What a block holds, by unpacking it."""
        try:
            found = self._opened(block, self.read(block))
        except LogError as error:
            self._failed.append((block, error))
            return
        self._learn_definitions(found, block)
        good = found.heads[found.heads["log_time"] < LATEST_NS]
        block.counts = dict(Counter(found.heads["channel"].tolist()))
        if len(good):
            block.start_ns, block.end_ns = int(good["log_time"].min()), int(good["log_time"].max())

    def _learn_definitions(self, found: records.Messages, block: Block) -> None:
        """The definitions in a chunk; if they contradict what was known, what was known is another log's."""
        each = [(opcode, found.data[first : first + length].tobytes()) for opcode, first, length in found.definitions]
        proven = block.offset not in self.losses.unchecked_in
        try:
            for opcode, body in each:
                self.define(opcode, body, block.offset, vouched=proven)
        except LogError:
            place = self._section(block.offset) + 1
            self.losses.mend(f"another log begins at byte {block.offset}: the chunk there defines ids anew")
            self.sections.insert(place, Section(block.offset))
            for opcode, body in each:
                try:
                    self.define(opcode, body, block.offset, vouched=proven)
                except LogError as error:
                    self.losses.mend(_reason(error))

    def _search_definitions(self) -> None:
        """Where sound messages lack a definition, it is looked for in the damaged stretches of their log."""
        for place, section in enumerate(self.sections):
            stop = self.sections[place + 1].start if place + 1 < len(self.sections) else self.source.size
            stretches = [(block.offset, block.length) for block, _ in self._failed]
            stretches += [(gap.offset, gap.length) for gap in self._gaps]
            for offset, length in sorted(stretch for stretch in stretches if section.start <= stretch[0] < stop):
                if not self._lacking(section, stop):
                    break
                for opcode, body in definitions(self.source.at(offset, min(length, MOST_SEARCHED))):
                    self.define(opcode, body, offset, vouched=False)

    def _lacking(self, section: Section, stop: int) -> bool:
        """Whether messages of a section are of channels that are not defined, or whose schema is not."""
        used = {c for block in self.blocks if section.start <= block.offset < stop for c in block.counts or block.indexes}
        found = {i for i, c in section.channels.items() if not c.schema_id or c.schema_id in section.schemas}
        return not used <= found

    def _number(self) -> None:
        """Gives every section's schemas and channels an id in the whole: the first section keeps its own."""
        for section in self.sections:
            schemas = {}
            for local, schema in sorted(section.schemas.items()):
                schemas[local] = _place(
                    self.schemas, schema, lambda a, b: (a.name, a.encoding, a.data) == (b.name, b.encoding, b.data)
                )
            for local, channel in sorted(section.channels.items()):
                if channel.schema_id and channel.schema_id not in schemas:
                    continue  # without its schema nobody can read it
                placed = Channel(
                    channel.id, channel.topic, channel.message_encoding, channel.metadata, schemas.get(channel.schema_id, 0)
                )
                section.ids[local] = _place(
                    self.channels,
                    placed,
                    lambda a, b: (a.topic, a.schema_id, a.message_encoding) == (b.topic, b.schema_id, b.message_encoding),
                    reuse=section is not self.sections[0],
                )

    def _tell_unproven(self) -> None:
        """Names the topics that are called so, or are said to carry what they do, by bytes that may have changed."""
        topics = set()
        for section in self.sections:
            for local, identity in section.ids.items():
                channel = section.channels[local]
                keys = {(int(Opcode.CHANNEL), local), (int(Opcode.SCHEMA), channel.schema_id)}
                if not keys - {(int(Opcode.SCHEMA), 0)} <= section.vouched:
                    topics.add(self.channels[identity].topic)
        self.losses.unproven = sorted(topics)

    def _settle(self, block: Block, counts: dict[int, int]) -> None:
        """Counts by the ids of the whole, without the messages that mean nothing."""
        ids = self.sections[self._section(block.offset)].ids
        block.counts = {}
        for local, count in counts.items():
            if local in ids:
                block.counts[ids[local]] = block.counts.get(ids[local], 0) + count

    def _settle_header(self) -> None:
        if not self.items and self._header is None and not self.sections[0].channels:
            raise LogError("this is not an MCAP log: no record of one is in it", expected="an MCAP log")
        if self._header is None:
            encodings = {channel.message_encoding for channel in self.channels.values()}
            profile = {"cdr": "ros2", "ros1": "ros1"}.get(next(iter(encodings)), "") if len(encodings) == 1 else ""
            self._header = Header(profile=profile, library="")
            self.losses.mend(f"the Header is lost; the profile is {profile!r} by the messages' encoding")
        self.header = self._header
        self.header_end = len(MAGIC) + len(self.opening)
        if self.losses or self.losses.mended:
            self.statistics = self.statistics if self._trusted and not self.losses else None

    def _close(self, gap: Gap) -> None:
        ids = self.sections[self._section(gap.offset)].ids
        counts = Counter({ids.get(local, -1 - local): count for local, count in gap.counts.items()})
        self.losses.add(Loss(gap.offset, gap.length, gap.reason, self._by_topic(counts), gap.counted, gap.start_ns, gap.end_ns))

    def _by_topic(self, counts: dict[int, int]) -> dict[str, int]:
        found: Counter[str] = Counter()
        for channel, count in counts.items():
            known = self.channels.get(channel)
            found[known.topic if known else f"(channel {-1 - channel if channel < 0 else channel}, not defined)"] += count
        return dict(found)

    def _known_of(self, block: Block) -> tuple[dict[int, int], bool]:
        """Messages of a block that cannot be read, and whether that is certain."""
        if block.counts is not None:
            return block.counts, True
        ids = self.sections[self._section(block.offset)].ids
        counts = _indexed(block)
        return {ids.get(local, -1 - local): count for local, count in counts.items()}, bool(counts)

    def _opened(self, block: Block, raw: bytes) -> records.Messages:
        """Everything in a block, proven by its CRC where it has one."""
        if block.compression is None:
            found, crc = records.messages(raw, block.offset), 0
        else:
            found = records.messages(records.unpack(raw, block.offset), block.offset)
            crc = records.ChunkHead.of(raw[:128], len(raw), block.offset).crc
            if not crc and not in_order(raw, block.offset, self._index.get(block.offset)):
                raise LogError(f"the head of the chunk at byte {block.offset} is damaged, and it has no CRC to tell by")
        if not crc and len(found.heads):
            self.losses.unchecked_in[block.offset] = len(found.heads)
        if block.offset in self._put_right:
            self.losses.mend(f"the head of the chunk at byte {block.offset} was damaged, and is put right")
        return found

    def _refuse_others(self, section: Section, found: records.Messages, block: Block) -> None:
        """A chunk that a CRC proves, and that defines ids otherwise than the log it lies in, is another log's."""
        for opcode, first, length in found.definitions:
            body = found.data[first : first + length].tobytes()
            if body not in self._agreed:
                record = records.parse(Schema if opcode == Opcode.SCHEMA else Channel, body, block.offset)
                known = (section.schemas if opcode == Opcode.SCHEMA else section.channels).get(record.id)
                if known is not None and not _same(known, record):
                    raise LogError(f"the chunk at byte {block.offset} defines {records.name_of(opcode)} {record.id} otherwise")
                if len(self._agreed) < MOST_AGREED:
                    self._agreed.add(body)

    def _fitted(self, block: Block, found: records.Messages) -> records.Messages:
        """The same without what nobody defines and no clock shows, by the ids of the whole."""
        place = self._section(block.offset)
        self._refuse_others(self.sections[place], found, block)
        ids, heads = self.sections[place].ids, found.heads
        local = np.unique(heads["channel"]).tolist()
        late = heads["log_time"] >= LATEST_NS
        if not late.any() and all(ids.get(channel) == channel for channel in local) and not (place and found.definitions):
            return found
        table = np.full(1 << 16, -1, np.int64)
        table[list(ids)] = list(ids.values())
        channels = table[heads["channel"]]
        keep = ~late & (channels >= 0)
        if not block.edited:
            block.edited = True
            dropped = Counter(
                int(new) if new >= 0 else -1 - int(old)
                for new, old in zip(channels[~keep], heads["channel"][~keep], strict=True)
            )
            if dropped:
                why = "channels that no record defines" if (channels < 0).any() else "log times no clock shows"
                self.losses.add(
                    Loss(block.offset, block.length, f"messages in the chunk here have {why}", self._by_topic(dropped), True)
                )
        return _edited(found, keep, channels[keep])


def _edited(found: records.Messages, keep: np.ndarray, channels: np.ndarray) -> records.Messages:
    """Some of the messages, one behind the other, with other channel ids."""
    offsets, heads = found.offsets[keep], found.heads[keep].copy()
    sizes = heads["length"].astype(np.int64) + HEAD.size
    data = b"".join(found.data[a : a + n].tobytes() for a, n in zip(offsets.tolist(), sizes.tolist(), strict=True))
    view = np.frombuffer(data, np.uint8).copy()
    places = np.cumsum(sizes) - sizes
    heads["channel"] = channels
    for byte in range(2):
        view[places + HEAD.size + byte] = channels >> (8 * byte) & 0xFF
    return records.Messages(view, places, heads, [])


def _indexed(block: Block) -> dict[int, int]:
    """Messages per channel by where the message indexes lie: each has 15 bytes and 16 for every message."""
    if not block.indexes:
        return {}
    starts = sorted(block.indexes.items(), key=lambda item: item[1])
    ends = [offset for _, offset in starts[1:]] + [block.end]
    sizes = {channel: end - offset - 15 for (channel, offset), end in zip(starts, ends, strict=True)}
    return (
        {channel: size // 16 for channel, size in sizes.items()} if all(s >= 0 and s % 16 == 0 for s in sizes.values()) else {}
    )


def _place(known: dict[int, Any], record: Any, alike: Callable[[Any, Any], bool], *, reuse: bool = True) -> int:
    """The id under which a definition stands among those known: that of one alike, its own if it is free, or a new one."""
    if reuse:
        for identity, other in known.items():
            if alike(other, record):
                return identity
    identity = record.id if record.id not in known else max(known) + 1
    known[identity] = replace(record, id=identity)
    return identity


def _same(a: Schema | Channel, b: Schema | Channel) -> bool:
    if isinstance(a, Schema) and isinstance(b, Schema):
        return (a.name, a.data) == (b.name, b.data)
    return isinstance(a, Channel) and isinstance(b, Channel) and (a.topic, a.schema_id) == (b.topic, b.schema_id)


def _sizes(section: Section) -> tuple[int, int]:
    return len(section.channels), len(section.schemas)


def _reason(error: LogError) -> str:
    """What an error says, as one line of a list."""
    return error.what + (f", expected {error.expected}" if error.expected else "")
