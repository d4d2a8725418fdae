"""Read any number of any ROS 2 message by topic and path: `/joint_states.position[2]`.

Field offsets come from the definition in the log: one message is walked, and messages that share its counts are cut out in one
numpy pass. One chunk is in memory at a time.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import islice, pairwise

import numpy as np

from imutool.array_types import Float64, Int64, UInt8
from imutool.errors import LogError, did_you_mean
from imutool.location import Location
from imutool.mcap_io.codec import ros2_definition
from imutool.mcap_io.codec.messages import Rows
from imutool.mcap_io.codec.ros2_definition import Leaf
from imutool.mcap_io.log import Log
from imutool.mcap_io.topics import DERIVED_KEY, UNIT_KEY, StampCheck, Topic

LISTED = 60  # fields named in a message
MAX_ROW = 64  # numbers of an array that become channels
MAX_OTHERS, READ_FACTOR = 48, 4  # channels, and how many times as many fields are read to find varying ones
_PATH = re.compile(r"[A-Za-z]\w*(\[\d{1,9}\])?(\.[A-Za-z]\w*(\[\d{1,9}\])?)*")
_LAST = re.compile(r"(.*?)(?:\[(\d+)\])?")
_NO_CHANNEL = re.compile(r"(^|\.)(\w*stamp|covariance|\w+_covariance|variance)\b")


@dataclass(frozen=True, eq=False)
class Fields:
    """One number of a log over time, at the stamps of the headers or else at log times."""

    t_ns: Int64[np.ndarray, " n"]
    values: Float64[np.ndarray, " n"]
    unit: str = ""
    left_out: int = 0  # rows without a number, or with the stamp of the row before

    def __len__(self) -> int:
        return len(self.t_ns)


def read_field(path: Location, signal: str) -> Fields:
    """One signal of a log, named TOPIC.field.

    Raises:
        ConfigError: the file cannot be opened.
        LogError: no such topic or field (the message lists what there is), another encoding, an array that is shorter in some
            message, NaN or infinity, stamps that do not increase, damage.
    """
    with Log(path) as log:
        topic, inside = split(log, signal)
        reader = _read(log, topic, (inside,))
        with log.named(topic):
            return reader.whole(inside)


def numbers(log: Log, topic: str, paths: tuple[str, ...]) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, "n k"]]:
    """Stamps and numbers of some fields of a topic, unchecked."""
    reader = _read(log, topic, paths)
    return reader.t_ns(), np.concatenate([np.zeros((0, len(paths))), *reader.values])


def _read(log: Log, topic: str, paths: tuple[str, ...]) -> _Reader:
    """Reader of some fields of a topic, after its messages."""
    reader = _Reader(log, log.topics[topic], paths)
    for _, rows in log.rows([topic]):
        with log.named(topic):
            reader.take(rows)
    return reader


def split(log: Log, signal: str) -> tuple[str, str]:
    """Topic and path of TOPIC.field; of topics that both fit, the longer.

    Raises:
        LogError: no such topic, or no path behind it.
    """
    topics = [topic for topic in log.topics if signal.startswith(f"{topic}.")]
    if not topics:
        expected = "TOPIC.field" if signal in log.topics else log.listing()
        fields = f" It has {_listed(numeric_fields(log, signal))}" if signal in log.topics else ""
        what = f"{signal} names no field" if signal in log.topics else f"there is no topic that {signal} begins with"
        raise LogError(what, where=log.path, expected=expected, fix=fields.strip())
    topic = max(topics, key=len)
    inside = signal[len(topic) + 1 :]
    if not _PATH.fullmatch(inside):
        raise LogError(f"field {inside!r}", where=f"{log.path} {topic}", expected="names and dots: twist.linear.x")
    return topic, inside


def numeric_fields(log: Log, topic: str, *, long: bool = True) -> list[str]:
    """Paths of the numbers in a topic's first message, without stamps; `long` arrays if asked.

    Raises:
        LogError: no definition or another encoding than ros2msg and cdr.
    """
    definition = definition_of(log, log.topics[topic])
    for _, rows in log.rows([topic]):
        with log.named(topic):
            return list(_paths(ros2_definition.Walk(rows.payload[0].tobytes(), definition), long))
    return []


def others(
    path: Location, signal: str, most: int = MAX_OTHERS, skip: Collection[str] = (), *, gaps: bool = False
) -> dict[str, Fields]:
    """Every other varying number of a log by TOPIC.field: candidates to drive a signal.

    Left out are stamps, covariances, constants, long arrays (images), unreadable or computed topics, those in `skip`, all that
    vary behind the first `most`, and fields with NaN or stamps that do not increase; with `gaps`, only such rows of theirs.

    Raises:
        ConfigError, LogError: the log cannot be opened, or is damaged.
    """
    with Log(path) as log:
        readers, left = dict[str, _Reader](), READ_FACTOR * most
        for name, topic in log.topics.items():
            paths = [] if name in skip or DERIVED_KEY in topic.metadata else _offered(log, name)
            paths = [inside for inside in paths if f"{name}.{inside}" != signal and not _NO_CHANNEL.search(inside)][:left]
            if paths:
                readers[name], left = _Reader(log, topic, tuple(paths), strict=False), left - len(paths)
        for name, rows in log.rows(list(readers)):
            with log.named(name):
                readers[name].take(rows)
    offered = ((f"{name}.{inside}", reader.usable(inside, gaps)) for name, reader in readers.items() for inside in reader.paths)
    return dict(islice(((name, values) for name, values in offered if values is not None), most))


def _offered(log: Log, topic: str) -> list[str]:
    """Numeric fields of a topic, none where it has no readable definition."""
    try:
        return numeric_fields(log, topic, long=False)
    except LogError:
        return []


def definition_of(log: Log, topic: Topic) -> ros2_definition.Definition:
    """Definition of a topic's messages.

    Raises:
        LogError: it says nothing, or in another language.
    """
    where = f"{log.path} {topic.name}"
    if (topic.schema_encoding, topic.message_encoding) != ("ros2msg", "cdr"):
        raise LogError(
            f"{topic.name} is described as {topic.schema_encoding or 'nothing'!r} and encoded as {topic.message_encoding!r}",
            where=where,
            expected="ros2msg and cdr",
            fix="Record it with ROS 2's own MCAP plugin",
        )
    channel = next(c for c in log.index.channels.values() if c.topic == topic.name)
    with log.named(topic.name):
        return ros2_definition.parse(topic.schema_name, log.index.schemas[channel.schema_id].data)


def _paths(walk: ros2_definition.Walk, long: bool = True) -> Iterator[str]:
    for leaf in walk.leaves():
        if re.search(r"(^|\.)\w*stamp\.(sec|nanosec)$", leaf.path):
            continue
        if leaf.length is None:
            yield leaf.path
        elif long or leaf.length <= MAX_ROW:
            yield from (f"{leaf.path}[{k}]" for k in range(min(leaf.length, MAX_ROW)))


def _listed(names: Collection[str]) -> str:
    shown = list(names)[:LISTED]
    return ", ".join(shown) + (f" and {len(names) - LISTED} more" if len(names) > LISTED else "") if shown else "no number"


@dataclass(eq=False)
class _Reader:
    """Collects some fields of one topic; without `strict`, missing fields become NaN."""

    log: Log
    topic: Topic
    paths: tuple[str, ...]
    strict: bool = True
    log_times: list[Int64[np.ndarray, " n"]] = field(default_factory=list)
    stamps: list[Int64[np.ndarray, " n"]] = field(default_factory=list)  # of headers; zero without one
    values: list[Float64[np.ndarray, "n k"]] = field(default_factory=list)
    sequences: list[np.ndarray] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.definition = definition_of(self.log, self.topic)

    def take(self, rows: Rows) -> None:
        """Takes in the next messages, all of one size."""
        for part, places, order in self._runs(rows.payload):
            cut = rows.where(part)
            columns = np.full((len(cut.log_time), len(self.paths)), np.nan)
            for k, path in enumerate(self.paths):
                if path in places:
                    columns[:, k] = _column(cut.payload, places[path], order)
            self.log_times.append(cut.log_time)
            self.stamps.append(_stamps(cut, places, order))
            self.values.append(columns)
            self.sequences.append(cut.sequence)

    def _runs(self, payload: UInt8[np.ndarray, "n L"]) -> Iterator[tuple[slice, Mapping[str, Leaf], str]]:
        """Stretches of messages with the same field offsets, found by one walk each."""
        pending = [(0, len(payload))] if len(payload) else []
        while pending:
            first, last = pending.pop()
            walk = ros2_definition.Walk(payload[first].tobytes(), self.definition)
            places = self._places(walk)
            differ = np.zeros(last - first - 1, bool)
            for at, raw in walk.constants:
                column = payload[first:last, at : at + len(raw)]
                if (column != column[0]).any():
                    differ |= (column[1:] != column[:-1]).any(axis=1)
            edges = [first, *(np.flatnonzero(differ) + first + 1).tolist(), last]
            yield slice(first, edges[1]), places, walk.order
            pending += reversed(list(pairwise(edges[1:])))

    def _places(self, walk: ros2_definition.Walk) -> dict[str, Leaf]:
        """Offsets of the wanted fields and of the header's stamp; the walk ends at the last.

        Raises:
            LogError: no such number; the message lists the known ones.
        """
        asked: dict[str, list[tuple[str, int | None]]] = {}
        for path in self.paths:
            bare, index = _LAST.fullmatch(path).groups()  # type: ignore[union-attr]  # it matches any text
            asked.setdefault(bare, []).append((path, None if index is None else int(index)))
        found: dict[str, Leaf] = {}
        for leaf in walk.leaves():
            if leaf.path in ("header.stamp.sec", "header.stamp.nanosec"):
                found[f"stamp {leaf.path}"] = leaf
            for path, index in asked.get(leaf.path, ()):
                if (index is None) == (leaf.length is None) and (leaf.length is None or (index or 0) < leaf.length):
                    found[path] = leaf._replace(offset=leaf.offset + int(leaf.kind[1]) * (index or 0))
            if all(path in found for path in self.paths):
                break  # what comes behind need not lie alike
        missing = [path for path in self.paths if path not in found]
        if missing and self.strict:
            raise self._unknown(missing[0], walk)
        return found

    def _unknown(self, path: str, walk: ros2_definition.Walk) -> LogError:
        known = list(_paths(ros2_definition.Walk(walk.payload, self.definition)))
        return LogError(
            f"there is no number {path} in {self.topic.schema_name}",
            expected=_listed(known),
            fix=did_you_mean(path, known, f"{self.topic.name}.{{}}"),
        )

    def t_ns(self) -> Int64[np.ndarray, " n"]:
        """Header stamps; log times where there is no header or all stamps are zero."""
        stamp_ns, log_ns = (np.concatenate([np.zeros(0, np.int64), *parts]) for parts in (self.stamps, self.log_times))
        return stamp_ns if stamp_ns.any() else log_ns

    def whole(self, path: str) -> Fields:
        """A field over the whole log.

        Raises:
            LogError: no messages, NaN or infinity, stamps that do not increase.
        """
        if not self.log_times:
            raise LogError("there are no messages", expected="at least one")
        t_ns, sequence = self.t_ns(), np.concatenate(self.sequences)
        values = np.concatenate(self.values)[:, self.paths.index(path)]
        if not (finite := np.isfinite(values)).all():
            row = int(np.argmin(finite))
            raise LogError(
                f"message {row} (sequence {sequence[row]}) has {path} = {values[row]}",
                expected="finite numbers",
                fix="Choose another field, or cut the log before or after it",
            )
        StampCheck().check(t_ns, sequence)
        return Fields(t_ns, values, self.topic.metadata.get(UNIT_KEY, ""))

    def usable(self, path: str, gaps: bool = False) -> Fields | None:
        """A field over the whole log if it varies and can be a channel."""
        if not self.log_times:
            return None
        t_ns, values = self.t_ns(), np.concatenate(self.values)[:, self.paths.index(path)]
        sound = np.isfinite(values) & (np.diff(t_ns, prepend=t_ns[0] - 1) != 0)
        t_ns, values = t_ns[sound], values[sound]
        if not (gaps or (sound.all() and (np.diff(t_ns) > 0).all())) or len(values) < 2 or np.ptp(values) == 0.0:
            return None
        return Fields(t_ns, values, self.topic.metadata.get(UNIT_KEY, ""), int((~sound).sum()))


def _column(payload: UInt8[np.ndarray, "n L"], place: Leaf, order: str) -> np.ndarray:
    cut = np.ascontiguousarray(payload[:, place.offset : place.offset + int(place.kind[1])])
    return cut.view(order + place.kind)[:, 0]


def _stamps(rows: Rows, places: Mapping[str, Leaf], order: str) -> Int64[np.ndarray, " n"]:
    """Header stamps, zeros where there is no header."""
    keys = ("stamp header.stamp.sec", "stamp header.stamp.nanosec")
    if not all(key in places for key in keys):
        return np.zeros(len(rows.log_time), np.int64)
    sec, nanosec = (_column(rows.payload, places[key], order).astype(np.int64) for key in keys)
    return np.asarray(sec * 1_000_000_000 + nanosec)
