"""Read any number of any message by topic and path: `/joint_states.position[2]`.

Messages are those of ROS 2, of ROS 1, or in protobuf, JSON, MessagePack or FlatBuffers. One chunk is in memory at a time.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass, field
from itertools import islice
from types import MappingProxyType

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.errors import LogError, did_you_mean
from imutool.file_location import Location
from imutool.mcap_io.codec.decode import StampCheck
from imutool.mcap_io.codec.messages import Rows
from imutool.mcap_io.fields.decoders import decoder_of
from imutool.mcap_io.log import Log
from imutool.mcap_io.topics import UNIT_KEY, Topic, topics_of

__all__ = ["Fields", "PlainLog", "Reader", "decoder_of", "listed", "numbers", "numeric_fields", "others", "read_field", "split"]

LISTED = 60  # fields named in a message
MAX_OTHERS, READ_FACTOR = 48, 4  # channels, and how many times as many fields are read to find varying ones
_PATH = re.compile(r"[^.\[\]]+(\[\d{1,9}\])*(\.[^.\[\]]+(\[\d{1,9}\])*)*")
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


class PlainLog(Log):
    """Log whose messages all come as recorded, also IMUs and poses in types of their own."""

    def _read_topics(self) -> None:
        self.topics = MappingProxyType(topics_of(self.index))


@dataclass(eq=False)
class Reader:
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
        self.decoder = decoder_of(self.log, self.topic)

    def take(self, rows: Rows) -> None:
        """Takes in the next messages, all of one size."""
        for found in self.decoder.columns(rows.payload, self.paths):
            if found.lacks is not None and self.strict:
                path, row = found.lacks
                raise self._unknown(path, rows.payload[row].tobytes())
            self.log_times.append(rows.log_time[found.rows])
            self.stamps.append(found.stamps)
            self.values.append(found.values)
            self.sequences.append(rows.sequence[found.rows])

    def _unknown(self, path: str, raw: bytes) -> LogError:
        known = self.decoder.paths(raw, long=True)
        return LogError(
            f"there is no number {path} in {self.topic.schema_name or 'a message'}",
            expected=listed(known),
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


def read_field(path: Location, signal: str) -> Fields:
    """One signal of a log, named TOPIC.field.

    Raises:
        ConfigError: the file cannot be opened.
        LogError: no such topic or field (the message lists what there is), another encoding, an array that is shorter in some
            message, NaN or infinity, stamps that do not increase, damage.
    """
    with PlainLog(path) as log:
        topic, inside = split(log, signal)
        reader = _read(log, topic, (inside,))
        with log.named(topic):
            return reader.whole(inside)


def numbers(log: Log, topic: str, paths: tuple[str, ...]) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, "n k"]]:
    """Stamps and numbers of some fields of a topic, unchecked."""
    reader = _read(log, topic, paths)
    return reader.t_ns(), np.concatenate([np.zeros((0, len(paths))), *reader.values])


def _read(log: Log, topic: str, paths: tuple[str, ...]) -> Reader:
    """Reader of some fields of a topic, after its messages."""
    reader = Reader(log, log.topics[topic], paths)
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
        fields = f" It has {listed(numeric_fields(log, signal))}" if signal in log.topics else ""
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
        LogError: no schema, or another encoding.
    """
    message, decoder = dict(log.firsts([topic])).get(topic), decoder_of(log, log.topics[topic])
    with log.named(topic):
        return [] if message is None else decoder.paths(message, long)


def others(
    path: Location, signal: str, maximum: int = MAX_OTHERS, skip: Collection[str] = (), *, gaps: bool = False
) -> dict[str, Fields]:
    """Every other varying number of a log by TOPIC.field: candidates to drive a signal.

    Left out are stamps, covariances, constants, long arrays (images), unreadable or computed topics, those in `skip`, all that
    vary behind the first `maximum`, and fields with NaN or stamps that do not increase; with `gaps`, only such rows of theirs.

    Raises:
        ConfigError, LogError: the log cannot be opened, or is damaged.
    """
    with PlainLog(path) as log:
        readers, remaining = dict[str, Reader](), READ_FACTOR * maximum
        asked = {name: topic for name, topic in log.topics.items() if name not in skip and not topic.is_derived}
        offered_by = {name: _offered(log, name, message) for name, message in log.firsts(asked)}
        for name, topic in asked.items():
            paths = [p for p in offered_by.get(name, ()) if f"{name}.{p}" != signal and not _NO_CHANNEL.search(p)][:remaining]
            if paths:
                readers[name], remaining = Reader(log, topic, tuple(paths), strict=False), remaining - len(paths)
        for name, rows in log.rows(list(readers)):
            with log.named(name):
                readers[name].take(rows)
    offered = ((f"{name}.{inside}", reader.usable(inside, gaps)) for name, reader in readers.items() for inside in reader.paths)
    return dict(islice(((name, values) for name, values in offered if values is not None), maximum))


def _offered(log: Log, topic: str, message: bytes) -> list[str]:
    """Numeric fields of a topic, none where it has no readable definition."""
    try:  # not by `log.named`: from Python 3.12 on its error holds itself and the message until the next collection
        return decoder_of(log, log.topics[topic]).paths(message, long=False)
    except LogError:
        return []


def listed(names: Collection[str]) -> str:
    """Names for a message, the first `LISTED`."""
    shown = list(names)[:LISTED]
    return ", ".join(shown) + (f" and {len(names) - LISTED} more" if len(names) > LISTED else "") if shown else "no number"
