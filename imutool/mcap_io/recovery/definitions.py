"""Decide which recording each block of a damaged file belongs to, and what its channel ids mean.

One file may hold parts of several logs: each is a recording whose ids mean what its own records say, and callers see one
numbering for the whole file. A block's recording follows from the definitions in the block, from a summary that lists it, from the
unbroken chain of records to its log's begin, and last from what its messages decode as. What stays open is on no topic.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, count
from typing import Any

import numpy as np
from jaxtyping import Bool, Int64
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from imutool.errors import LogError
from imutool.mcap_io.blocks import MessageBlock
from imutool.mcap_io.codec import messages, records
from imutool.mcap_io.codec.records import HEAD
from imutool.mcap_io.recovery.losses import LATEST_NS, Losses, reason
from imutool.mcap_io.recovery.resync import Gap
from imutool.mcap_io.recovery.scan import ChunkKey, Definition, Event, LogEnd, LogStart, ScannedBlock, Summary

MAX_ID = 2**16 - 1  # of a channel or a schema
Fits = Callable[[MessageBlock, int, "Recording"], bool]  # whether a block's messages of a channel decode by a recording's schema


@dataclass(eq=False)
class Recording:
    """One log in the file, whole or in part: its own records define the ids."""

    start: int
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    proven: set[tuple[int, int]] = field(default_factory=set)  # opcode and id of definitions that a CRC covers
    lists: set[ChunkKey] | None = None  # the chunks in its summary, which are all it has
    ended: bool = False  # its footer was met
    anonymous: bool = False  # no record in the file defines its ids
    ids: dict[int, int] = field(default_factory=dict)  # channel ids of the whole file by its own
    moved: bool = False  # its definitions cannot stay as they are in its chunks
    renamed: dict[str, str] = field(default_factory=dict)  # topics that carry another type elsewhere

    def known(self, opcode: int) -> dict[int, Any]:
        """Its schemas or its channels, by the opcode of their records."""
        return self.schemas if opcode == Opcode.SCHEMA else self.channels

    def readable(self) -> set[int]:
        """Channels that are defined together with their schema."""
        return {i for i, channel in self.channels.items() if not channel.schema_id or channel.schema_id in self.schemas}

    def meaning(self, channel: int) -> object:
        """What a channel id means here, to compare; None where it is not defined."""
        known = self.channels.get(channel)
        if known is None or (known.schema_id and known.schema_id not in self.schemas):
            return None
        schema = self.schemas.get(known.schema_id)
        return known.topic, known.message_encoding, (schema.name, schema.encoding, schema.data) if schema else None

    def agrees(self, definitions: Iterable[Any]) -> bool:
        """Whether none of these definitions contradicts its own."""
        for record in definitions:
            known = (self.schemas if isinstance(record, Schema) else self.channels).get(record.id)
            if known is not None and not same_definition(known, record):
                return False
        return True

    def define(self, record: Any, *, proven: bool) -> None:
        """Adds a definition; a proven one replaces one that is not."""
        opcode = int(Opcode.SCHEMA if isinstance(record, Schema) else Opcode.CHANNEL)
        if proven or (opcode, record.id) not in self.proven:
            self.known(opcode).setdefault(record.id, record)
            if proven:
                self.known(opcode)[record.id] = record
                self.proven.add((opcode, record.id))


class Recordings:
    """The recordings of a file, and which of them each block belongs to (`MessageBlock.recording`)."""

    def __init__(self, summaries: Sequence[Summary], losses: Losses, fits: Fits) -> None:
        self.losses, self.fits = losses, fits
        self.each: list[Recording] = []
        self.unproven: dict[int, dict[int, str]] = {}  # by a block's offset: its channels of which several topics are possible
        self._current: Recording | None = None
        self._behind_gap: list[ScannedBlock] = []  # blocks whose recording no chain proves
        self._verified: set[int] = set()  # channels whose messages behind the gap decode
        self._certain = False  # an unbroken chain of records leads from the definitions of the current one to here
        for summary in summaries:
            recording = Recording(summary.base)
            if summary.chunks:
                recording.lists = {(e.message_start_time, e.message_end_time, e.uncompressed_size) for e in summary.chunks}
            definitions = parsed(summary.definitions, summary.base, losses)
            twice = {key for key, number in Counter((type(d), d.id) for d in _different(definitions)).items() if number > 1}
            for record in definitions:
                if (type(record), record.id) not in twice:
                    recording.define(record, proven=True)
            for kind, number in sorted(twice, key=str):
                losses.add_harmless(f"a summary defines {kind.__name__.lower()} {number} twice; neither is used")
            self.each.append(recording)

    def of(self, block: MessageBlock) -> Recording:
        """The recording of a block."""
        return self.each[block.recording]

    def assign(self, events: Sequence[Event]) -> None:
        """Finds the recording of every block, in file order."""
        if not self.each:
            self.each.append(Recording(0))
        keys = {event.key for event in events if isinstance(event, ScannedBlock)}
        for recording in self.each:
            if recording.lists and not recording.lists & keys:  # one field of every entry is wrong; do the others agree?
                pairs = {pair for key in recording.lists for pair in _pairs(key)}
                recording.lists = {key for key in keys if not pairs.isdisjoint(_pairs(key))} or recording.lists
        for event in events:
            if isinstance(event, LogStart):
                self._begin(event.offset)
            elif isinstance(event, LogEnd):
                if self._current is not None:
                    self._current.ended = True
                self._certain = False
            elif isinstance(event, Gap):
                event.recording = self.each.index(self._now)
                self._certain, self._behind_gap, self._verified = False, [], set()
            elif isinstance(event, Definition):
                self._take_definition(event)
            else:
                self._assign(event)

    def _assign(self, found: ScannedBlock) -> None:
        recording = self._choose(found)
        listed = found.key in (recording.lists or ())
        known = {record.id for record in parsed(found.definitions, 0, self.losses) if isinstance(record, Channel)}
        found.evidence = 3 if known >= set(found.block.counts or {}) else 2 if listed else int(self._certain)
        found.block.recording = self.each.index(recording)
        self._current = recording
        self._certain = self._certain or found.evidence > 1 or bool(known)
        if not self._certain:
            self._verify(found, recording)

    def _verify(self, found: ScannedBlock, recording: Recording) -> None:
        """Checks behind a gap that messages decode; where not, all behind the gap is of a log that nothing defines."""
        self._behind_gap.append(found)
        ids = set(found.block.counts or {}) - self._verified
        self._verified |= ids
        if all(self.fits(found.block, i, recording) for i in ids & recording.readable()):
            return
        self.losses.add_harmless(f"behind byte {self._behind_gap[0].block.offset} messages do not fit the definitions before it")
        self._current = Recording(self._behind_gap[0].block.offset, anonymous=True)
        self.each.append(self._current)
        for other in self._behind_gap:
            other.block.recording = len(self.each) - 1
            self.unproven.pop(other.block.offset, None)

    @property
    def _now(self) -> Recording:
        return self._current or self.each[0]

    def _begin(self, start: int) -> None:
        """Begins the log whose Header stands at a byte."""
        self._current = next((recording for recording in self.each if recording.start == start), None)
        if self._current is None:
            self._current = Recording(start)
            self.each.append(self._current)
        self._certain = True

    def _take_definition(self, found: Definition) -> None:
        """Takes in a definition outside chunks; behind a gap one that contradicts begins another recording."""
        for record in parsed([(found.opcode, found.body)], found.offset, self.losses):
            if not self._now.agrees([record]):
                what = f"{type(record).__name__.lower()} {record.id} has two definitions, the second at byte {found.offset}"
                key = int(found.opcode), record.id
                self.losses.add_harmless(f"{what}; {'the one that a CRC covers' if key in self._now.proven else 'the first'} holds")
            else:
                self._now.define(record, proven=False)

    def _choose(self, found: ScannedBlock) -> Recording:
        """The recording of a block, which may be a new one."""
        own = parsed(found.definitions, found.block.offset, self.losses) if found.definitions else []
        rest = set(found.block.counts or {}) - {record.id for record in own if isinstance(record, Channel)}
        agreeing = [r for r in (self._now, *self.each) if r.agrees(own)]
        listed = [r for r in agreeing if r.lists and found.key in r.lists]
        if not agreeing:
            chosen = self._new(found.block.offset)
        elif own and not rest:
            chosen = (listed or agreeing)[0]
        else:
            chosen = self._among(found, rest, [r for r in listed if rest <= r.readable()] or agreeing)
        for record in own:
            chosen.define(record, proven=bool(found.crc))
        return chosen

    def _new(self, start: int) -> Recording:
        self.losses.add_harmless(f"another log begins at byte {start}: the chunk there defines ids anew")
        self.each.append(Recording(start))
        return self.each[-1]

    def _among(self, found: ScannedBlock, used: set[int], pool: Sequence[Recording]) -> Recording:
        """The recording of a block that does not define all of its ids itself."""
        pool = list({id(r): r for r in pool}.values())
        unlisted = [r for r in pool if r.lists is None or found.key in r.lists]
        if (self._certain or self._now.anonymous) and self._now in unlisted:
            return self._now
        for narrower in (
            [r for r in pool if used <= r.readable()],
            unlisted,
            [r for r in pool if not r.ended],
            [r for r in pool if r.start <= found.block.offset],
        ):
            pool = [r for r in pool if r in narrower] or pool
        open_ids = {i for i in used if len({r.meaning(i) for r in pool} - {None}) > 1}
        if not open_ids or (self._certain and self._now in pool):
            return self._now if self._now in pool else pool[0]
        fitting = [r for r in pool if all(self.fits(found.block, i, r) for i in open_ids)]
        pool = fitting or pool
        still = {i for i in open_ids if len({r.meaning(i) for r in pool} - {None}) > 1}
        if still:
            names = {i: {r.channels[i].topic for r in pool if i in r.channels} for i in still}
            self.unproven[found.block.offset] = {i: " or ".join(sorted(topics)) for i, topics in names.items()}
        return pool[0]

    # ── one numbering for the whole file ─────────────────────────────────────────────────────────────────────────────

    def renumber(self) -> tuple[dict[int, Schema], dict[int, Channel]]:
        """Schemas and channels of the whole file; the first recording keeps its ids.

        Raises:
            LogError: no id is left.
        """
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        for recording in self.each:
            first = recording is self.each[0]
            placed = {
                local: _place(schemas, schema, _same_schema, reuse=not first)
                for local, schema in sorted(recording.schemas.items())
            }
            for local in sorted(recording.readable()):
                channel = recording.channels[local]
                moved = replace(channel, schema_id=placed.get(channel.schema_id, 0))
                moved = replace(moved, topic=self._name(recording, moved, schemas, channels))
                recording.ids[local] = _place(channels, moved, _same_channel, reuse=not first)
            recording.moved = not first or bool(recording.renamed)
            for old, new in recording.renamed.items():
                self.losses.add_harmless(f"{old} carries messages of two types; those of the second are on {new}")
        return schemas, channels

    def _name(
        self, recording: Recording, channel: Channel, schemas: dict[int, Schema], channels: dict[int, Channel]
    ) -> str:
        """The topic's name in the whole file: one of another type gets another name."""
        taken = {other.topic: _type(other, schemas) for other in channels.values()}
        names = chain([channel.topic], (f"{channel.topic}_{number}" for number in count(2)))
        name = next(name for name in names if taken.get(name, _type(channel, schemas)) == _type(channel, schemas))
        if name != channel.topic:
            recording.renamed[channel.topic] = name
        return str(name)

    def unproven_topics(self) -> list[str]:
        """Topics whose channel or schema no CRC covers."""
        topics = set()
        for recording in self.each:
            for channel in (recording.channels[local] for local in recording.ids):
                keys = {(int(Opcode.CHANNEL), channel.id), (int(Opcode.SCHEMA), channel.schema_id)}
                if not keys - {(int(Opcode.SCHEMA), 0)} <= recording.proven:
                    topics.add(channel.topic)
        return sorted(topics)


def parsed(definitions: Iterable[tuple[int, bytes]], offset: int, losses: Losses) -> list[Any]:
    """Schema and Channel records; a damaged one is noted and left out."""
    found = []
    for opcode, body in definitions:
        try:
            found.append(records.parse(Schema if opcode == Opcode.SCHEMA else Channel, body, offset))
        except LogError as error:
            losses.add_harmless(reason(error))
    return found


def _pairs(key: ChunkKey) -> tuple[object, ...]:
    """Any two fields of a key, by which it is known again when one is wrong."""
    start_ns, end_ns, size = key
    return (0, start_ns, end_ns), (1, start_ns, size), (2, end_ns, size)


def _different(definitions: Iterable[Any]) -> Iterator[Any]:
    """Definitions without repetitions."""
    seen: list[Any] = []
    for record in definitions:
        if not any(type(other) is type(record) and other.id == record.id and same_definition(other, record) for other in seen):
            seen.append(record)
            yield record


def same_definition(a: Any, b: Any) -> bool:
    """Whether two records of one id define the same messages."""
    if isinstance(a, Schema):
        return (a.name, a.data) == (b.name, b.data)
    return bool((a.topic, a.schema_id) == (b.topic, b.schema_id))


def _type(channel: Channel, schemas: dict[int, Schema]) -> tuple[str, str]:
    schema = schemas.get(channel.schema_id)
    return (schema.name if schema else "", channel.message_encoding)


def _same_schema(a: Schema, b: Schema) -> bool:
    return bool((a.name, a.encoding, a.data) == (b.name, b.encoding, b.data))


def _same_channel(a: Channel, b: Channel) -> bool:
    return bool((a.topic, a.schema_id, a.message_encoding) == (b.topic, b.schema_id, b.message_encoding))


def _place(known: dict[int, Any], record: Any, same: Callable[[Any, Any], bool], *, reuse: bool) -> int:
    """Id of a definition: that of an equal one, its own if free, or a new one."""
    if reuse:
        for found, other in known.items():
            if same(other, record):
                return found
    identity: int = record.id if record.id not in known else free_id(known)
    known[identity] = replace(record, id=identity)
    return identity


def free_id(taken: Mapping[int, object]) -> int:
    """The largest id plus one, or the smallest free one.

    Raises:
        LogError: none is left.
    """
    largest = max(taken, default=0)
    found = largest + 1 if largest < MAX_ID else next((i for i in range(1, MAX_ID) if i not in taken), 0)
    if not found:
        raise LogError("the log has 65535 channels or schemas", expected="an id that is free")
    return found


def renumber_counts(recording: Recording, counts: Mapping[int, int]) -> dict[int, int]:
    """Counts by the channel ids of the whole file, without undefined channels."""
    ids, total = recording.ids, Counter[int]()
    for local, number in counts.items():
        if local in ids:
            total[ids[local]] += number
    return dict(total)


def map_channels(
    recording: Recording, refused: Mapping[int, object], found: messages.Messages
) -> tuple[Int64[np.ndarray, " n"], Bool[np.ndarray, " n"]] | None:
    """Channel ids in the whole file, -1 where undefined, and a mask of readable messages.

    None where the messages can stay as they are. `refused` are ids of which nobody knows what they mean.
    """
    ids, heads = recording.ids, found.heads
    local = np.unique(heads["channel"]).tolist()
    late = heads["log_time"] >= LATEST_NS
    unchanged = all(ids.get(channel) == channel and channel not in refused for channel in local)
    if not late.any() and unchanged and not (recording.moved and found.definitions):
        return None
    table = np.full(1 << 16, -1, np.int64)
    for own, number in ids.items():
        table[own] = -1 if own in refused else number
    channels = table[heads["channel"]]
    return channels, ~late & (channels >= 0)


def remap(found: messages.Messages, keep: Bool[np.ndarray, " n"], channels: Int64[np.ndarray, " k"]) -> messages.Messages:
    """The chosen messages, one behind the other, with other channel ids."""
    offsets, heads = found.offsets[keep], found.heads[keep].copy()
    sizes = heads["length"].astype(np.int64) + HEAD.size
    data = b"".join(found.data[a : a + n].tobytes() for a, n in zip(offsets.tolist(), sizes.tolist(), strict=True))
    view = np.frombuffer(data, np.uint8).copy()
    places = np.cumsum(sizes) - sizes
    heads["channel"] = channels
    for byte in range(2):
        view[places + HEAD.size + byte] = channels >> (8 * byte) & 0xFF
    return messages.Messages(view, places, heads, [])
