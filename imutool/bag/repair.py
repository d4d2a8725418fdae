"""Repair a ROS 1 bag: copy its intact chunks and rebuild its index."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from imutool.bag import records
from imutool.bag.records import FIRST_RECORD, MAGIC, U32, Chunk, Loss, Op
from imutool.bag.scan import Bag
from imutool.errors import ConfigError, LogError
from imutool.file_location import Location, same_location
from imutool.mcap_io.storage.source import Source
from imutool.mcap_io.storage.target import Target
from imutool.report import Progress, silent

NO_ATTACHMENTS = "a bag has no attachments"  # to keep damaged bytes in
PASSES = 3  # to plan, to write, to check


@dataclass(frozen=True)
class BagReport:
    """Contents of a repaired bag, and what is missing from it."""

    messages: Mapping[str, int]  # per topic
    chunks: int
    rebuilt: int  # of these, rebuilt because messages in them were lost
    was_indexed: bool
    lost: int  # stretches, of which the first are listed
    losses: Sequence[Loss]
    source_bytes: int
    target_bytes: int

    @property
    def whole(self) -> bool:
        """Whether everything in the source is in the target."""
        return self.lost == 0

    def plain(self) -> dict[str, Any]:
        """Losses as JSON values, as of `recovery.losses.Losses.plain`."""
        known = [loss.messages for loss in self.losses if loss.messages is not None]
        return {
            "whole": self.whole and self.was_indexed,
            "bytes": sum(loss.length for loss in self.losses),
            "messages": sum(known) if len(known) == self.lost else None,
            "topics": {},
            "stretches": [_stretch(loss) for loss in self.losses],
            "stretches_not_listed": self.lost - len(self.losses),
            "mended": [] if self.was_indexed else ["the bag had no index: it was rebuilt"],
            "unproven_messages": 0,
            "assumed_messages": 0,
            "unchecked_messages": 0,
            "unchecked_definitions": [],
        }


def _stretch(loss: Loss) -> dict[str, Any]:
    none: dict[str, Any] = {"topics": {}, "first_ns": None, "last_ns": None}
    return {"offset": loss.offset, "bytes": loss.length, "reason": loss.reason, "messages": loss.messages, **none}


class _Entry(NamedTuple):
    """A chunk of the target."""

    position: int
    first_ns: int
    last_ns: int
    counts: Mapping[int, int]


def is_bag(where: Location) -> bool:
    """Whether a file begins as ROS 1 bags do.

    Raises:
        ConfigError: it cannot be opened.
        LogError: it cannot be read.
    """
    source = Source(where, expected="an MCAP log or a ROS 1 bag")
    try:
        return source.at(0, min(len(MAGIC), source.size)) == MAGIC
    finally:
        source.file.close()


def repair_bag(source: Location, target: Location, *, overwrite: bool = False, progress: Progress = silent) -> BagReport:
    """Writes every readable message of `source` to `target`, byte for byte, with an index.

    A chunk of which nothing is lost keeps its bytes; any other is written unpacked with the messages found in it. The result
    is read back and compared before it takes its place. The format has no checks of its own: a flipped byte in the payload of
    an unpacked chunk cannot be noticed. `progress` gets the bytes done, of three times those of the source.

    Raises:
        ConfigError: source or target cannot be opened, the target exists or is the source.
        LogError: the source is not a ROS 1 bag or is encrypted, or nothing in it can be read.
    """
    if same_location(source, target):
        raise ConfigError("the target is the source", where=target, fix="Choose another name")
    with Bag(source, recover=True) as bag, Target(target, overwrite=overwrite) as out:
        size = bag.source.size
        index_pos, count = _plan(bag, lambda done: progress(done, PASSES * size))
        if not count and (bag.lost or bag.header is None):
            raise LogError("not one message can be read", where=source, expected="a bag with messages")
        used = sorted(bag.connections)
        out.write(MAGIC + records.bag_header(index_pos, len(used), count))
        with Bag(source, recover=True) as second:
            entries, crc, rebuilt = _write(second, out, lambda done: progress(size + done, PASSES * size))
            if (out.position, len(entries), sorted(second.connections)) != (index_pos, count, used):
                raise LogError("the bag changed while it was read", where=source)
            for number in used:
                out.write(second.connections[number].record)
        for entry in entries:
            out.write(records.chunk_info(*entry))
        out.flush()
        found = _read_back(out.temporary, lambda done: progress(2 * size + done * size // out.position, PASSES * size))
        if found != crc:
            raise LogError("what was written is not what was read", where=target)
        messages: Counter[str] = Counter()
        for entry in entries:
            messages.update({bag.connections[number].topic: n for number, n in entry.counts.items()})
        return BagReport(dict(messages), count, rebuilt, bag.indexed, bag.lost, tuple(bag.losses), size, out.position)


def _plan(bag: Bag, tell: Callable[[int], None]) -> tuple[int, int]:
    """Offset of the index, and number of chunks, in the target."""
    position, count = len(MAGIC) + FIRST_RECORD + 8, 0
    for chunk in bag.chunks():
        position += _length(chunk) + sum(len(raw) for raw in _indexes(chunk, _offsets(chunk)))
        count += 1
        tell(chunk.offset + chunk.length)
    return position, count


def _write(bag: Bag, out: Target, tell: Callable[[int], None]) -> tuple[list[_Entry], int, int]:
    """Writes the chunks; returns their entries, the CRC of their messages, and how many were rebuilt."""
    entries, crc, rebuilt = [], 0, 0
    for chunk in bag.chunks():
        counts = Counter(message.connection for message in chunk.messages)
        times = [message.time_ns for message in chunk.messages]
        entries.append(_Entry(out.position, min(times), max(times), dict(sorted(counts.items()))))
        if chunk.whole:
            out.write(bag.source.at(chunk.offset, chunk.length))
        else:
            rebuilt += 1
            data = b"".join(chunk.data[message.at : message.end] for message in chunk.messages)
            out.write(records.record(Op.CHUNK, {b"compression": b"none", b"size": U32.pack(len(data))}, data))
        for raw in _indexes(chunk, _offsets(chunk)):
            out.write(raw)
        crc = _crc(chunk, crc)
        tell(chunk.offset + chunk.length)
    return entries, crc, rebuilt


def _length(chunk: Chunk) -> int:
    """Bytes of the record that a chunk becomes."""
    if chunk.whole:
        return chunk.length
    size = sum(message.end - message.at for message in chunk.messages)
    return len(records.record(Op.CHUNK, {b"compression": b"none", b"size": U32.pack(size)}, b"")) + size


def _offsets(chunk: Chunk) -> list[int]:
    """Start of each message in the chunk's bytes as they are written."""
    if chunk.whole:
        return [message.at for message in chunk.messages]
    offsets, at = [], 0
    for message in chunk.messages:
        offsets.append(at)
        at += message.end - message.at
    return offsets


def _indexes(chunk: Chunk, offsets: Sequence[int]) -> list[bytes]:
    """The index records behind a chunk, one per connection."""
    entries: dict[int, list[tuple[int, int]]] = {}
    for message, offset in zip(chunk.messages, offsets, strict=True):
        entries.setdefault(message.connection, []).append((message.time_ns, offset))
    return [records.index(number, found) for number, found in sorted(entries.items())]


def _crc(chunk: Chunk, crc: int) -> int:
    for message in chunk.messages:
        crc = zlib.crc32(chunk.data[message.at : message.end], crc)
    return crc


def _read_back(path: Location, tell: Callable[[int], None]) -> int:
    """CRC of all messages in a bag that must be intact."""
    crc = 0
    with Bag(path) as bag:
        if not bag.indexed:
            raise LogError("what was written has no index", where=path)
        for chunk in bag.chunks():
            crc = _crc(chunk, crc)
            tell(chunk.offset + chunk.length)
    return crc
