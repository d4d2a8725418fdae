"""The logs that lie in one file, mostly one: what their ids mean, and one numbering for all of them.

A definition that a CRC vouches for (in a chunk, in a summary) holds against one that stands in the open. Where two that are
both vouched for disagree, they are of different logs.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import chain, count
from typing import Any

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from imutool.errors import LogError
from imutool.mcap_io.codec import records

DEFINITIONS = (Opcode.SCHEMA, Opcode.CHANNEL)


@dataclass
class Section:
    """One log in the file: from its first byte on, ids mean what its own records say."""

    start: int
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    vouched: set[tuple[int, int]] = field(default_factory=set)  # opcode and id of definitions that a CRC covers
    ids: dict[int, int] = field(default_factory=dict)  # its channels as those of the whole file
    renamed: dict[str, str] = field(default_factory=dict)  # topics that carry another type elsewhere

    def known(self, opcode: int) -> dict[int, Any]:
        """Its schemas, or its channels."""
        return self.schemas if opcode == Opcode.SCHEMA else self.channels

    def readable(self) -> set[int]:
        """Channels whose messages mean something: they are defined, and so is their schema."""
        return {i for i, channel in self.channels.items() if not channel.schema_id or channel.schema_id in self.schemas}


class Sections:
    """All logs in a file, in its order."""

    def __init__(self) -> None:
        self.each = [Section(0)]

    def at(self, offset: int) -> Section:
        """The log that a byte belongs to."""
        return self.each[bisect_right([section.start for section in self.each], offset) - 1]

    def begin(self, start: int) -> bool:
        """Begins another log at a byte; false if one begins there already."""
        if self.at(start).start == start:
            return False
        self.each.insert(bisect_right([section.start for section in self.each], start), Section(start))
        return True

    def end(self, section: Section) -> int | None:
        """Where the next log begins, if there is one."""
        return next((other.start for other in self.each if other.start > section.start), None)

    def channels(self) -> set[int]:
        """Every channel id that is defined so far."""
        return {channel for section in self.each for channel in section.channels}

    def define(self, opcode: int, body: bytes, offset: int, *, vouched: bool) -> str:
        """Takes in a Schema or Channel record of the log at `offset`; returns what is wrong with it, if that matters not.

        Raises:
            LogError: damaged, or another definition of the same id is vouched for as well.
        """
        section = self.at(offset)
        known, record = section.known(opcode), _parsed(opcode, body, offset)
        before, key, said = known.get(record.id), (opcode, record.id), ""
        if before is not None and not alike(before, record):
            said = f"{records.name_of(opcode).lower()} {record.id} has two definitions, the second at byte {offset}"
            if vouched and key in section.vouched:
                raise LogError(said)
            said += f"; the {'second' if vouched else 'first'} holds"
        if before is None or vouched:
            known[record.id] = record
        if vouched:
            section.vouched.add(key)
        return said

    def contradicts(self, opcode: int, body: bytes, offset: int) -> bool:
        """Whether the log at `offset` has another definition under the same id.

        Raises:
            LogError: damaged.
        """
        record = _parsed(opcode, body, offset)
        known = self.at(offset).known(opcode).get(record.id)
        return known is not None and not alike(known, record)

    def number(self) -> tuple[dict[int, Schema], dict[int, Channel]]:
        """Schemas and channels of the whole: those of the first log under their own ids, others under theirs where free."""
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
        """What a topic is called in the whole: a topic carries one type, so one of another type needs another name."""
        taken = {other.topic: _type(other, schemas) for other in channels.values()}
        names = chain([channel.topic], (f"{channel.topic}_{number}" for number in count(2)))
        name = next(name for name in names if taken.get(name, _type(channel, schemas)) == _type(channel, schemas))
        if name != channel.topic:
            section.renamed[channel.topic] = name
        return str(name)

    def unproven(self) -> list[str]:
        """Topics that are called so, or are said to carry what they do, by bytes that no CRC covers."""
        topics = set()
        for section in self.each:
            for channel in (section.channels[local] for local in section.ids):
                keys = {(int(Opcode.CHANNEL), channel.id), (int(Opcode.SCHEMA), channel.schema_id)}
                if not keys - {(int(Opcode.SCHEMA), 0)} <= section.vouched:
                    topics.add(channel.topic)
        return sorted(topics)


def alike(a: Any, b: Any) -> bool:
    """Whether two records of one id define the same, as far as the messages are concerned."""
    if isinstance(a, Schema):
        return (a.name, a.data) == (b.name, b.data)
    return bool((a.topic, a.schema_id) == (b.topic, b.schema_id))


def _parsed(opcode: int, body: bytes, offset: int) -> Any:
    return records.parse(Schema if opcode == Opcode.SCHEMA else Channel, body, offset)


def _type(channel: Channel, schemas: dict[int, Schema]) -> tuple[str, str]:
    schema = schemas.get(channel.schema_id)
    return (schema.name if schema else "", channel.message_encoding)


def _same_schema(a: Schema, b: Schema) -> bool:
    return bool((a.name, a.encoding, a.data) == (b.name, b.encoding, b.data))


def _same_channel(a: Channel, b: Channel) -> bool:
    return bool((a.topic, a.schema_id, a.message_encoding) == (b.topic, b.schema_id, b.message_encoding))


def _place(known: dict[int, Any], record: Any, same: Callable[[Any, Any], bool], *, reuse: bool) -> int:
    """The id of a definition among those known: that of the same one, its own if it is free, or a new one."""
    if reuse:
        for found, other in known.items():
            if same(other, record):
                return found
    identity: int = record.id if record.id not in known else max(known) + 1
    known[identity] = replace(record, id=identity)
    return identity
