"""Recover definitions of schemas and channels, and remap channel ids.

One file may hold several logs, mostly one: each is a section whose ids mean what its own records say, and callers see one
numbering for the whole file. A definition that a CRC covers (in a chunk, in a summary) replaces one that none covers. Where two
that are both covered disagree, they are of different logs.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
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
from imutool.mcap_io.recovery.chunk_repair import MAX_SEARCHED, find_definitions
from imutool.mcap_io.recovery.losses import LATEST_NS, Losses, reason
from imutool.mcap_io.storage.source import Source

MAX_AGREED = 1000  # definitions compared once: some writers repeat all of theirs in every chunk
DEFINITIONS = (Opcode.SCHEMA, Opcode.CHANNEL)


@dataclass
class Section:
    """One log in the file: from its first byte on, its own records define the ids."""

    start: int
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    proven: set[tuple[int, int]] = field(default_factory=set)  # opcode and id of definitions that a CRC covers
    ids: dict[int, int] = field(default_factory=dict)  # channel ids of the whole file by its own
    renamed: dict[str, str] = field(default_factory=dict)  # topics that carry another type elsewhere

    def known(self, opcode: int) -> dict[int, Any]:
        """Its schemas or its channels, by the opcode of their records."""
        return self.schemas if opcode == Opcode.SCHEMA else self.channels

    def readable(self) -> set[int]:
        """Channels that are defined together with their schema."""
        return {i for i, channel in self.channels.items() if not channel.schema_id or channel.schema_id in self.schemas}


class Sections:
    """Sections of a file, in its order."""

    def __init__(self) -> None:
        self.each = [Section(0)]

    def at(self, offset: int) -> Section:
        """The section of a byte."""
        return self.each[bisect_right([section.start for section in self.each], offset) - 1]

    def begin(self, start: int) -> bool:
        """Begins another section at a byte; false if one begins there already."""
        if self.at(start).start == start:
            return False
        self.each.insert(bisect_right([section.start for section in self.each], start), Section(start))
        return True

    def end(self, section: Section) -> int | None:
        """Where the next section begins, if there is one."""
        return next((other.start for other in self.each if other.start > section.start), None)

    def channels(self) -> set[int]:
        """Every channel id that is defined so far."""
        return {channel for section in self.each for channel in section.channels}

    def define(self, opcode: int, body: bytes, offset: int, *, proven: bool) -> str:
        """Adds a Schema or Channel record; returns a conflict that could be resolved, or "".

        Raises:
            LogError: damaged, or a CRC covers another definition of the same id as well.
        """
        section = self.at(offset)
        known, record = section.known(opcode), _parse(opcode, body, offset)
        before, key, conflict = known.get(record.id), (opcode, record.id), ""
        if before is not None and not same_definition(before, record):
            conflict = f"{records.name_of(opcode).lower()} {record.id} has two definitions, the second at byte {offset}"
            if proven and key in section.proven:
                raise LogError(conflict)
            conflict += f"; the {'second' if proven else 'first'} holds"
        if before is None or proven:
            known[record.id] = record
        if proven:
            section.proven.add(key)
        return conflict

    def contradicts(self, opcode: int, body: bytes, offset: int) -> bool:
        """Whether the section at `offset` has another definition under the same id.

        Raises:
            LogError: damaged.
        """
        record = _parse(opcode, body, offset)
        known = self.at(offset).known(opcode).get(record.id)
        return known is not None and not same_definition(known, record)

    def renumber(self) -> tuple[dict[int, Schema], dict[int, Channel]]:
        """Schemas and channels of the whole file; the first section keeps its ids."""
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        for section in self.each:
            first = section is self.each[0]
            placed = {
                local: _place(schemas, schema, _same_schema, reuse=not first)
                for local, schema in sorted(section.schemas.items())
            }
            for local in sorted(section.readable()):
                channel = section.channels[local]
                moved = replace(channel, schema_id=placed.get(channel.schema_id, 0))
                moved = replace(moved, topic=self._name(section, moved, schemas, channels))
                section.ids[local] = _place(channels, moved, _same_channel, reuse=not first)
        return schemas, channels

    def _name(self, section: Section, channel: Channel, schemas: dict[int, Schema], channels: dict[int, Channel]) -> str:
        """The topic's name in the whole file: one of another type gets another name."""
        taken = {other.topic: _type(other, schemas) for other in channels.values()}
        names = chain([channel.topic], (f"{channel.topic}_{number}" for number in count(2)))
        name = next(name for name in names if taken.get(name, _type(channel, schemas)) == _type(channel, schemas))
        if name != channel.topic:
            section.renamed[channel.topic] = name
        return str(name)

    def unproven_topics(self) -> list[str]:
        """Topics whose channel or schema no CRC covers."""
        topics = set()
        for section in self.each:
            for channel in (section.channels[local] for local in section.ids):
                keys = {(int(Opcode.CHANNEL), channel.id), (int(Opcode.SCHEMA), channel.schema_id)}
                if not keys - {(int(Opcode.SCHEMA), 0)} <= section.proven:
                    topics.add(channel.topic)
        return sorted(topics)


def same_definition(a: Any, b: Any) -> bool:
    """Whether two records of one id define the same messages."""
    if isinstance(a, Schema):
        return (a.name, a.data) == (b.name, b.data)
    return bool((a.topic, a.schema_id) == (b.topic, b.schema_id))


def _parse(opcode: int, body: bytes, offset: int) -> Any:
    return records.parse(Schema if opcode == Opcode.SCHEMA else Channel, body, offset)


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
    identity: int = record.id if record.id not in known else max(known) + 1
    known[identity] = replace(record, id=identity)
    return identity


def read_definitions(sections: Sections, losses: Losses, found: messages.Messages, block: MessageBlock) -> None:
    """Takes in a chunk's definitions; contradictions to proven ones begin another section."""
    found_definitions = [(opcode, found.data[first : first + length].tobytes()) for opcode, first, length in found.definitions]
    proven = block.offset not in losses.unchecked_in
    for second_try in (False, True):
        try:
            for opcode, body in found_definitions:
                conflict = sections.define(opcode, body, block.offset, proven=proven)
                if conflict:
                    losses.add_harmless(conflict)
            return
        except LogError as error:
            if second_try or not sections.begin(block.offset):
                losses.add_harmless(reason(error))
                return
            losses.add_harmless(f"another log begins at byte {block.offset}: the chunk there defines ids anew")


def search_damaged(
    sections: Sections, source: Source, blocks: Sequence[MessageBlock], damaged: Sequence[tuple[int, int]]
) -> None:
    """Looks for missing definitions in the damaged stretches (first byte, bytes) of a log."""
    for section in sections.each:
        stop = sections.end(section) or source.size + 1
        for offset, length in sorted(stretch for stretch in damaged if section.start <= stretch[0] < stop):
            used = {c for block in blocks if section.start <= block.offset < stop for c in block.counts or block.indexes}
            if used <= section.readable():
                break
            for opcode, body in find_definitions(source.at(offset, min(length, MAX_SEARCHED))):
                sections.define(opcode, body, offset, proven=False)


def renumber_counts(section: Section, counts: Mapping[int, int]) -> dict[int, int]:
    """Counts by the channel ids of the whole file, without undefined channels."""
    ids, total = section.ids, Counter[int]()
    for local, number in counts.items():
        if local in ids:
            total[ids[local]] += number
    return dict(total)


def check_definitions(sections: Sections, found: messages.Messages, block: MessageBlock, agreed: set[bytes]) -> None:
    """Refuses a CRC-proven chunk whose definitions show that another log wrote it.

    `agreed` collects the bodies of definitions that need not be compared again.

    Raises:
        LogError: the chunk is another log's, or a definition in it is damaged.
    """
    for opcode, first, length in found.definitions:
        body = found.data[first : first + length].tobytes()
        if body in agreed:
            continue
        if sections.contradicts(opcode, body, block.offset):
            raise LogError(f"the chunk at byte {block.offset} defines another {records.name_of(opcode)} under an id in use")
        if len(agreed) < MAX_AGREED:
            agreed.add(body)


def map_channels(section: Section, found: messages.Messages) -> tuple[Int64[np.ndarray, " n"], Bool[np.ndarray, " n"]] | None:
    """Channel ids in the whole file, -1 where undefined, and a mask of readable messages.

    None where the messages can stay as they are.
    """
    ids, heads = section.ids, found.heads
    local = np.unique(heads["channel"]).tolist()
    late = heads["log_time"] >= LATEST_NS
    if (
        not late.any()
        and all(ids.get(channel) == channel for channel in local)
        and not ((section.start or section.renamed) and found.definitions)
    ):
        return None
    table = np.full(1 << 16, -1, np.int64)
    table[list(ids)] = list(ids.values())
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
