"""ROS 1 bag of any robot: every topic as CDR under its own name, in log-time order.

Message types come from the definitions in the bag. A topic whose definition cannot be translated keeps the encoding of
ROS 1; so does a single message that contradicts its definition, on TOPIC/untranslated. A bag without an index (its recorder
was killed, or it is cut) is read chunk by chunk.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from imutool.bag import records
from imutool.bag.scan import Bag
from imutool.errors import DataError, LogError
from imutool.recording.message_log import Message, MessageLog, MessageTopic, Remarks

from . import Sequence
from ._ros_types import IMAGES, Ros1Types, ToCdr, need_rosbags, ros1_topic, ros2_name
from ._source import find_files

GENERAL = True
SUFFIXES = (".bag", ".active")
BUFFER_BYTES = 64 << 20  # of messages wait for earlier ones in later chunks


class _Route(NamedTuple):
    """Where the messages of a connection go; without a translation they keep their bytes."""

    topic: MessageTopic
    to_cdr: ToCdr | None
    definition: str
    kind: str


def sequences(source: Path) -> list[Sequence]:
    """Bags in the source, by their first bytes."""
    return find_files(source, SUFFIXES, lambda head: head.startswith(records.MAGIC))


def read_sequence(sequence: Sequence, *, images: bool = True) -> MessageLog:
    """Message log of a bag.

    Raises:
        ConfigError: rosbags is not installed.
        DataError: the bag cannot be read, or holds no messages.
    """
    need_rosbags(sequence.path)
    remarks, types = Remarks(), Ros1Types()
    with _open(sequence.path) as bag:
        if not bag.indexed:  # its definitions lie among the messages
            count = sum(len(chunk.messages) for chunk in bag.chunks())
            if not count:
                raise DataError("cannot be read as a ROS 1 bag (no index, and not one message)", where=sequence.path)
            remarks.losses.append(_without_index(bag, count))
        routes = _routes(bag, types, remarks, images)
        counts = Counter[str]()
        for info in bag.infos:
            for number, count in info.counts.items():
                if number in routes:
                    counts[routes[number].topic.name] += count
    return MessageLog(
        sequence.name,
        sequence.path.name,
        topics=tuple(dict.fromkeys(route.topic for route in routes.values())),
        messages=partial(_messages, sequence.path, routes, remarks),
        counts=dict(counts),
        metadata={"imutool": {"format": "ros1_bag", "sequence": sequence.name}},
        remarks=remarks,
    )


def read(source: Path) -> Iterator[MessageLog]:
    """Message logs of all bags of the source, one after the other."""
    return map(read_sequence, sequences(source))


def _without_index(bag: Bag, count: int) -> str:
    lost = f"{bag.lost} stretches are lost, the first: {bag.losses[0].reason}" if bag.lost else "nothing was lost"
    return f"the bag has no index: {count} messages were read chunk by chunk, {lost}"


def _routes(bag: Bag, types: Ros1Types, remarks: Remarks, images: bool) -> dict[int, _Route]:
    """Topic and translation of every connection; a topic of two types gets a name for each."""
    routes: dict[int, _Route] = {}
    by_name: dict[str, MessageTopic] = {}
    for number, connection in sorted(bag.connections.items()):
        if not images and ros2_name(connection.kind) in IMAGES:
            continue
        definition = _definition(connection.record)
        try:
            topic, to_cdr = types.topic(connection.topic, connection.kind, definition)
        except Exception as error:  # noqa: BLE001  (a grammar error of rosbags shows in many ways)
            topic, to_cdr = ros1_topic(connection.topic, connection.kind, definition), None
            reason = str(error).partition("\n")[0]
            remarks.notes.append(
                f"{connection.topic} keeps the encoding of ROS 1: its {connection.kind} is not understood ({reason})"
            )
        if _inner(connection.record).get(b"latching") == b"1":
            topic = replace(topic, metadata=(*topic.metadata, ("latching", "1")))
        known = by_name.setdefault(topic.name, topic)
        if replace(known, metadata=()) == replace(topic, metadata=()):
            topic = known  # of several publishers, of which one may latch
        else:
            other = f"{topic.name}/{connection.kind.replace('/', '_')}_{number}"
            remarks.notes.append(f"{topic.name} carries two message types; {connection.kind} is on {other}")
            topic = replace(topic, name=other)
            by_name[other] = topic
        routes[number] = _Route(topic, to_cdr, definition, connection.kind)
    return routes


def _definition(record: bytes) -> str:
    """Text of the message definition in a connection record."""
    return _inner(record)[b"message_definition"].decode().replace("\r\n", "\n")  # of a publisher on Windows


def _inner(record: bytes) -> dict[bytes, bytes]:
    """Fields in the data of a connection record."""
    head = records.head(record, 0)
    assert head is not None  # or the scan had refused it
    return records.fields(record, head.data_at, len(record)) or {}


def _messages(path: Path, routes: dict[int, _Route], remarks: Remarks) -> Iterator[Message]:
    """Messages in log-time order, translated."""
    untranslated = Counter[str]()
    with _open(path) as bag:
        for time_ns, number, raw in _in_order(bag):
            route = routes.get(number)
            if route is None:
                continue
            if route.to_cdr is None:
                yield Message(route.topic, time_ns, time_ns, raw)
                continue
            try:
                payload = route.to_cdr(raw)
            except Exception:  # noqa: BLE001  (struct, assertions, index errors: a message that contradicts its type)
                untranslated[route.topic.name] += 1
                kept = ros1_topic(f"{route.topic.name}/untranslated", route.kind, route.definition)
                yield Message(kept, time_ns, time_ns, raw)
                continue
            yield Message(route.topic, time_ns, time_ns, payload)
        if bag.indexed and bag.lost:
            remarks.losses.append(f"{bag.lost} stretches of the bag are lost, the first: {bag.losses[0].reason}")
    for topic, count in untranslated.items():
        remarks.losses.append(
            f"{count} messages of {topic} contradict their type; they are on {topic}/untranslated as recorded"
        )


def _in_order(bag: Bag) -> Iterator[tuple[int, int, memoryview]]:
    """Times, connections and bytes in time order; of a bag without index, ordered within the buffer.

    A message waits until no later chunk can hold an earlier one.
    """
    starts = {info.offset: info.first_ns for info in bag.infos}
    earliest, bound = {}, 2**63
    for offset in sorted(starts, reverse=True):  # the earliest time in any chunk behind this one
        earliest[offset] = bound
        bound = min(bound, starts[offset])
    waiting: list[tuple[int, int, int, memoryview]] = []
    size = order = 0
    for chunk in bag.chunks():
        data = memoryview(chunk.data)
        for message in chunk.messages:
            raw = data[message.data_at : message.end]
            heapq.heappush(waiting, (message.time_ns, order, message.connection, raw))
            order, size = order + 1, size + len(raw)
        until = earliest.get(chunk.offset, -1)
        while waiting and (waiting[0][0] < until or size > BUFFER_BYTES):
            time_ns, _, number, raw = heapq.heappop(waiting)
            size -= len(raw)
            yield time_ns, number, raw
    while waiting:
        time_ns, _, number, raw = heapq.heappop(waiting)
        yield time_ns, number, raw


@contextmanager
def _open(path: Path) -> Iterator[Bag]:
    """Open a bag; damage is counted and left out."""
    try:
        with Bag(path, recover=True) as bag:
            yield bag
    except LogError as error:
        raise DataError(f"cannot be read as a ROS 1 bag ({error.what})", where=path, fix=error.fix) from error
