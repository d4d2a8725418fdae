"""Definitions of each recording in a damaged file, and one numbering for all of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, count
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from imutool.array_types import Bool, Int64
from imutool.errors import LogError
from imutool.mcap_io.blocks import MessageBlock
from imutool.mcap_io.codec import messages, records
from imutool.mcap_io.codec.records import HEAD
from imutool.mcap_io.codec.ros2_definition import decodes
from imutool.mcap_io.file_writer import free_id
from imutool.mcap_io.recovery.losses import LATEST_NS, Losses, reason

SCHEMA = int(Opcode.SCHEMA)
ChunkKey = tuple[int, int, int]  # start and end in ns, unpacked bytes: what a summary says of a chunk wherever it lies
CDR_HEADS = (b"\0\0", b"\0\1")  # other payloads are not what the channel says, and tell nothing
SAME_SCHEMA = attrgetter("name", "encoding", "data")  # of two equal ones
SAME_CHANNEL = attrgetter("topic", "schema_id", "message_encoding")
SAMPLES = 4  # messages of a channel that must decode by a definition


class Habits(NamedTuple):
    """Habits of a writer, the same in a whole log; empty where that is not known.

    `packing` are the compressions, or that there are no chunks; some writers leave small chunks as they are. `indexed` says
    whether message indexes follow the chunks.
    """

    packing: frozenset[str] = frozenset()
    indexed: frozenset[bool] = frozenset()

    def __or__(self, other: Habits) -> Habits:
        return Habits(self.packing | other.packing, self.indexed | other.indexed)

    def contradicts(self, other: Habits) -> bool:
        """Whether no writer has both."""
        return any(own and its and not own & its for own, its in zip(self, other, strict=True))


NO_HABITS = Habits()


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
    headless: bool = False  # its begin is lost, and may lie ahead of `start`
    gapped: bool = False  # a part of it is lost, perhaps with definitions
    ids: dict[int, int] = field(default_factory=dict)  # channel ids of the whole file by its own
    moved: bool = False  # its definitions cannot stay as they are in its chunks
    sizes: dict[int, tuple[int, int]] = field(default_factory=dict)  # the shortest and the longest message of a channel
    samples: dict[int, MessageBlock] = field(default_factory=dict)  # a block with messages of a channel
    habits: Habits = NO_HABITS  # of its writer
    renamed: dict[int, str] = field(default_factory=dict)  # topics of channels whose own carries another type

    def known(self, opcode: int) -> dict[int, Any]:
        """Its schemas or its channels, by the opcode of their records."""
        return self.schemas if opcode == Opcode.SCHEMA else self.channels

    def readable(self) -> set[int]:
        """Channels that are defined together with their schema."""
        return {i for i, channel in self.channels.items() if not channel.schema_id or channel.schema_id in self.schemas}

    def may_define(self, used: set[int]) -> bool:
        """Whether it defines all of these channels, or some and the rest may be lost."""
        readable = self.readable()
        return used <= readable or ((self.headless or self.gapped) and not used.isdisjoint(readable))

    def meaning(self, channel: int) -> object:
        """Meaning of a channel id here, to compare; None where it is not defined."""
        known = self.channels.get(channel)
        if known is None or (known.schema_id and known.schema_id not in self.schemas):
            return None
        schema = self.schemas.get(known.schema_id)
        return known.topic, known.message_encoding, (schema.name, schema.encoding, schema.data) if schema else None

    def agrees(self, definitions: Iterable[Any], *, proven: bool = False) -> bool:
        """Whether none of these definitions contradicts its own; a schema out of nowhere gives way to proven ones."""
        for record in definitions:
            known = (self.schemas if isinstance(record, Schema) else self.channels).get(record.id)
            if known is not None and not same_definition(known, record) and not (proven and self._gives_way(known)):
                return False
        return True

    def outweighed(self, definitions: Iterable[Any], rest: set[int]) -> bool:
        """Whether only definitions without a CRC contradict them, and ones with a CRC say what the rest of their chunk is."""
        compared = [record for record in definitions if (_opcode(record), record.id) in self.proven]
        return bool(rest) and self.agrees(compared) and {(int(Opcode.CHANNEL), i) for i in rest} <= self.proven

    def fits(self, channel: int, read: Callable[[], messages.Messages]) -> bool:
        """Whether messages of a channel decode by its definition here; True if unknown."""
        known = self.channels.get(channel)
        schema = self.schemas.get(known.schema_id) if known else None
        if known is None or schema is None or (schema.encoding, known.message_encoding) != ("ros2msg", "cdr"):
            return True
        found = read()
        chosen = np.flatnonzero(found.heads["channel"] == channel)[:SAMPLES].tolist()
        sizes = found.heads["length"].astype(np.int64) + HEAD.size
        payloads = [found.data[found.offsets[i] + messages.MESSAGE.itemsize : found.offsets[i] + sizes[i]] for i in chosen]
        plain = [raw for payload in payloads if (raw := payload.tobytes())[:2] in CDR_HEADS]
        return all(decodes(raw, schema.name, schema.data) for raw in plain)

    def _gives_way(self, known: Any) -> bool:
        """Whether it is a schema that no CRC covers and no channel uses: bytes of a damaged chunk may look like one."""
        used = {channel.schema_id for channel in self.channels.values()} | {i for opcode, i in self.proven if opcode == SCHEMA}
        return isinstance(known, Schema) and known.id not in used

    def define(self, record: Any, *, proven: bool) -> bool:
        """Adds a definition; a proven one replaces one that is not. Whether it is the first of its id."""
        opcode = _opcode(record)
        first = record.id not in self.known(opcode)
        if proven or (opcode, record.id) not in self.proven:
            self.known(opcode).setdefault(record.id, record)
            if proven:
                self.known(opcode)[record.id] = record
                self.proven.add((opcode, record.id))
        return first

    def take_back(self, definitions: Iterable[Any]) -> None:
        """Forgets definitions: the block that brought them is of another log."""
        for record in definitions:
            opcode = _opcode(record)
            self.known(opcode).pop(record.id, None)
            self.proven.discard((opcode, record.id))


def _opcode(definition: Any) -> int:
    return SCHEMA if isinstance(definition, Schema) else int(Opcode.CHANNEL)


def parsed(definitions: Iterable[tuple[int, bytes]], offset: int, losses: Losses) -> list[Any]:
    """Schema and Channel records; a damaged one is noted and left out."""
    found = []
    for opcode, body in definitions:
        try:
            found.append(records.parse(Schema if opcode == Opcode.SCHEMA else Channel, body, offset))
        except LogError as error:
            losses.add_harmless(reason(error))
    return found


def topics_of(channel: int, recordings: Iterable[Recording]) -> set[str]:
    """The topics that a channel id has in some recordings."""
    return {recording.channels[channel].topic for recording in recordings if recording.meaning(channel) is not None}


def same_definition(a: Any, b: Any) -> bool:
    """Whether two records of one id define the same messages."""
    if isinstance(a, Schema):
        return (a.name, a.data) == (b.name, b.data)
    return bool((a.topic, a.schema_id) == (b.topic, b.schema_id))


def key_pairs(key: ChunkKey) -> tuple[object, ...]:
    """Any two fields of a key, by which it is known again when one is wrong."""
    start_ns, end_ns, size = key
    return (0, start_ns, end_ns), (1, start_ns, size), (2, end_ns, size)


def different(definitions: Iterable[Any]) -> Iterator[Any]:
    """Definitions without repetitions."""
    seen: list[Any] = []
    for record in definitions:
        if not any(type(other) is type(record) and other.id == record.id and same_definition(other, record) for other in seen):
            seen.append(record)
            yield record


def renumber(
    recordings: Sequence[Recording], blocks: Iterable[MessageBlock], losses: Losses
) -> tuple[dict[int, Schema], dict[int, Channel]]:
    """Schemas and channels of the whole file; the first recording keeps its ids.

    Raises:
        LogError: no id is left.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    _name_topics(recordings, blocks)
    for recording in recordings:
        first = recording is recordings[0]
        placed = {
            local: _place(schemas, schema, SAME_SCHEMA, reuse=not first) for local, schema in sorted(recording.schemas.items())
        }
        for local in sorted(recording.readable()):
            channel = recording.channels[local]
            topic = recording.renamed.get(local, channel.topic)
            moved = replace(channel, topic=topic, schema_id=placed.get(channel.schema_id, 0))
            recording.ids[local] = _place(channels, moved, SAME_CHANNEL, reuse=not first)
        recording.moved = not first or bool(recording.renamed)
        for local, new in recording.renamed.items():
            losses.add_harmless(f"{recording.channels[local].topic} has two types; messages of the second are on {new}")
    return schemas, channels


def _name_topics(recordings: Sequence[Recording], blocks: Iterable[MessageBlock]) -> None:
    """Gives a channel another topic if its own carries another type; one without messages gives way."""
    carried = {(block.recording, channel) for block in blocks for channel in block.counts or ()}
    types: dict[str, tuple[str, str]] = {}
    every = [(number, local) for number, recording in enumerate(recordings) for local in sorted(recording.readable())]
    for number, local in sorted(every, key=lambda place: place not in carried):
        recording = recordings[number]
        channel = recording.channels[local]
        schema = recording.schemas.get(channel.schema_id)
        own = (schema.name if schema else "", channel.message_encoding)
        names = chain([channel.topic], (f"{channel.topic}_{suffix}" for suffix in count(2)))
        name = next(name for name in names if types.setdefault(name, own) == own)
        if name != channel.topic:
            recording.renamed[local] = name


def unproven_topics(recordings: Sequence[Recording]) -> list[str]:
    """Topics whose channel or schema no CRC covers."""
    topics = set()
    for recording in recordings:
        for channel in (recording.channels[local] for local in recording.ids):
            keys = {(int(Opcode.CHANNEL), channel.id), (int(Opcode.SCHEMA), channel.schema_id)}
            if not keys - {(int(Opcode.SCHEMA), 0)} <= recording.proven:
                topics.add(recording.renamed.get(channel.id, channel.topic))
    return sorted(topics)


def _place(known: dict[int, Any], record: Any, same: Callable[[Any], object], *, reuse: bool) -> int:
    """Id of a definition: that of an equal one, its own if free, or a new one."""
    if reuse:
        for found, other in known.items():
            if same(other) == same(record):
                return found
    identity: int = record.id if record.id not in known else free_id(known, "definition")
    known[identity] = replace(record, id=identity)
    return identity


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
