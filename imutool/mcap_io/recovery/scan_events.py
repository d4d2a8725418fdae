"""Results of scanning a damaged log, in file order: blocks, gaps, definitions, logs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Header

from imutool.array_types import UInt64
from imutool.mcap_io.blocks import MessageBlock, RecordSpan
from imutool.mcap_io.codec import messages, records
from imutool.mcap_io.codec.records import HEAD
from imutool.mcap_io.recovery.definitions import NO_HABITS, ChunkKey, Habits
from imutool.mcap_io.recovery.losses import LATEST_NS
from imutool.mcap_io.recovery.summary import Summary


@dataclass(slots=True)
class ScannedBlock:
    """A block of messages as the scan met it."""

    block: MessageBlock
    key: ChunkKey
    crc: int  # 0: nothing proves it
    definitions: list[tuple[int, bytes]]
    sizes: dict[int, tuple[int, int]]  # of the shortest and the longest message of a channel
    times: dict[int, tuple[int, int]]  # the first and the last log time of a channel
    evidence: int = 0  # for the recording it is assigned to, the more the better
    bare: bool = False  # another record follows at once where message indexes would stand
    habits: Habits = NO_HABITS  # of all blocks between two gaps
    brought: list[Any] = field(default_factory=list)  # definitions that its recording did not have before


class LogStart(NamedTuple):
    """Magic and Header of a log."""

    offset: int


class LogEnd(NamedTuple):
    """End of a log: its footer if it is closed, else the end of its data section."""

    closed: bool


class Definition(NamedTuple):
    """A Schema or Channel record outside chunks, which no CRC covers."""

    offset: int
    opcode: int
    body: bytes


@dataclass
class Gap:
    """A stretch without a valid record."""

    offset: int
    length: int
    reason: str
    start_ns: int | None = None
    end_ns: int | None = None
    counts: Counter[int] = field(default_factory=Counter)  # by the channel ids of its recording
    counted: bool = False  # from message indexes that survived behind it, or from the summary
    indexes: list[tuple[int, int, int, int]] = field(default_factory=list)  # channel, entries, first and last time of each
    recording: int = 0

    @property
    def end(self) -> int:
        """The first byte behind it."""
        return self.offset + self.length

    def count(self, channel: int, entries: UInt64[np.ndarray, "n 2"]) -> None:
        """Counts the messages of a lost chunk from the entries of a message index behind it."""
        if not self.counted:
            self.counts, self.counted = Counter(), True
        self.counts[channel] += len(entries)
        if len(entries) and entries[:, 0].max() < LATEST_NS:
            first, last = int(entries[:, 0].min()), int(entries[:, 0].max())
            self.indexes.append((channel, len(entries), first, last))
            self.start_ns = first if self.start_ns is None else min(first, self.start_ns)
            self.end_ns = last if self.end_ns is None else max(last, self.end_ns)


Event = LogStart | LogEnd | Definition | ScannedBlock | Gap  # what decides whose log a block is, in file order


def definition_runs(events: Sequence[Event]) -> dict[int, list[Definition]]:
    """Definitions outside chunks that follow one another, by the identity of the first."""
    runs = [[e for e in run if isinstance(e, Definition)] for kind, run in groupby(events, type) if kind is Definition]
    return {id(run[0]): run for run in runs}


def note_habits(events: Sequence[Event]) -> None:
    """Notes in every block the habits of the blocks around it, up to a gap or the end of a log."""
    found: list[ScannedBlock] = []
    for event in (*events, None):
        if isinstance(event, ScannedBlock):
            found.append(event)
        elif not isinstance(event, Definition):
            bare = any(each.bare for each in found)
            packing = {"no chunk" if each.block.compression is None else each.block.compression for each in found}
            indexed = any(each.block.indexes for each in found)
            habits = Habits(frozenset(packing - {""}), frozenset([True] * indexed + [False] * bare))
            for each in found:
                each.habits = habits
            found = []


class ScanResult:
    """Blocks, other records and gaps of a file as a scan meets them."""

    def __init__(self) -> None:
        self.items: list[MessageBlock | RecordSpan] = []
        self.events: list[Event] = []
        self.gaps: list[Gap] = []
        self.summaries: list[Summary] = []
        self.doubtful: list[tuple[MessageBlock, Gap]] = []  # messages that may be the contents of a damaged chunk
        self.repaired: dict[int, bytes] = {}  # heads of chunks that their contents prove to be damaged
        self.header: Header | None = None
        self.data_ends: list[int] = []
        self.used_channels: set[int] = set()
        self._latest: ScannedBlock | None = None
        self.last: MessageBlock | Gap | None = None  # what message indexes would belong to

    def add_block(self, block: MessageBlock, found: messages.Messages, head: records.ChunkHead | None) -> None:
        """Notes the counts, times and definitions of a block."""
        sizes, spans = {}, {}
        if len(found.heads) == 1:  # in a tenth of the time; some logs have nothing else
            _, length, channel, _, time_ns, _ = found.heads[0].item()
            block.counts, sizes = {channel: 1}, {channel: (length, length)}
            spans = {channel: (time_ns, time_ns)} if time_ns < LATEST_NS else {}
        else:
            block.counts = dict(Counter(found.heads["channel"].tolist()))
            for channel in block.counts:
                own = found.heads[found.heads["channel"] == channel]
                sizes[channel] = int(own["length"].min()), int(own["length"].max())
                possible = own["log_time"][own["log_time"] < LATEST_NS]
                if len(possible):
                    spans[channel] = int(possible.min()), int(possible.max())
        if spans:
            block.start_ns, block.end_ns = min(first for first, _ in spans.values()), max(last for _, last in spans.values())
        defined = [(opcode, found.data[first : first + length].tobytes()) for opcode, first, length in found.definitions]
        self.note_follower(block.offset, Opcode.CHUNK)
        self.items.append(block)
        size, crc = (head.size, head.crc) if head else (block.length, 0)
        self._latest = ScannedBlock(block, (block.start_ns, block.end_ns, size), crc, defined, sizes, spans)
        self.events.append(self._latest)
        self.used_channels.update(block.counts)

    def note_follower(self, position: int, opcode: int) -> None:
        """Notes whether another record than a message index begins where the last block ends."""
        found = self._latest
        if (
            opcode != Opcode.MESSAGE_INDEX
            and found
            and found.block.counts
            and not found.block.indexes
            and found.block.end == position
        ):
            found.bare = True

    def add_message_index(self, position: int, body: bytes) -> None:
        """Assigns a message index to the chunk before it, or counts a lost chunk's messages."""
        last = self.last
        channel, entries = int.from_bytes(body[:2], "little"), np.frombuffer(body, "<u8", offset=6).reshape(-1, 2)
        end = position + HEAD.size + len(body)
        if isinstance(last, MessageBlock) and last.end == position:
            counts = last.counts or {}
            if not len(entries) or (counts.get(channel) == len(entries) and channel not in last.indexes):
                last.end = end
                if len(entries):
                    last.indexes[channel] = position
                return
        if not len(entries):
            return
        if not isinstance(last, Gap):
            self.last = last = Gap(position, 0, "a chunk is gone from here: only its message indexes are left")
            self.add_gap(last)
        last.count(channel, entries)

    def cut_back(self, start: int, end: int) -> None:
        """Gives up the last record, which a proven chunk shows to be cut off."""
        if isinstance(self.events[-1], Definition) and self.events[-1].offset == start:
            self.events.pop()
        for block in reversed(self.items[-1:]):
            if isinstance(block, MessageBlock) and block.compression is None and block.offset + block.length == end:
                block.length, block.end = start - block.offset, start
            elif isinstance(block, MessageBlock) and block.end == end:
                block.end = start
                block.indexes = {channel: at for channel, at in block.indexes.items() if at < start}
            elif isinstance(block, RecordSpan) and block.offset == start:
                self.items.pop()

    def add_gap(self, gap: Gap) -> int:
        """Adds a gap; returns where it ends."""
        self.gaps.append(gap)
        self.events.append(gap)
        return gap.end
