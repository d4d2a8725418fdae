"""Temperatures of a log: scalar topics and message fields of that name, on their own clocks.

A temperature changes over seconds. Of each half second only the first finite number is kept, so that memory does not depend on
the rate of the channel: sixteen bytes for each half second.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.errors import LogError
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.decode import decode_scalars
from imutool.mcap_io.codec.messages import Rows
from imutool.mcap_io.fields import Reader, numeric_fields
from imutool.mcap_io.log import Log
from imutool.mcap_io.topics import ENCODINGS, UNIT_KEY, Topic
from imutool.recording import Recording, Scalars

WORD = "temperature"
NAME = re.compile(r"temperature|(?<![a-z])temp(?![a-z])")
EVERY_NS = 500_000_000
CELSIUS = "degC"


def is_temperature(name: str) -> bool:
    """Whether a channel, TOPIC or TOPIC.field, is called a temperature."""
    return NAME.search(name.rpartition("/")[2].lower()) is not None


def thinned(t_ns: Int64[np.ndarray, " n"], values: Float64[np.ndarray, " n"], unit: str) -> Scalars:
    """First finite number of each half second; a stamp that goes back is left out."""
    good = np.isfinite(values) & (t_ns > np.maximum.accumulate(np.concatenate([t_ns[:1] - 1, t_ns[:-1]])))
    t_ns, values = t_ns[good], values[good]
    half_second = t_ns // EVERY_NS
    first = np.diff(half_second, prepend=half_second[:1] - 1) > 0
    return Scalars(t_ns[first], np.ascontiguousarray(values[first, None]), unit)


def temperatures(
    log: Log, skip: Collection[str] = (), start_ns: int | None = None, end_ns: int | None = None
) -> dict[str, Scalars]:
    """Temperatures of a log by channel: TOPIC of a Float64, TOPIC.field of other messages.

    Float64 topics are those called a temperature, fields those called `temperature`. Topics in `skip` are not read.
    `start_ns` and `end_ns` select by log time.

    Raises:
        LogError: the log is damaged.
    """
    found: dict[str, list[Scalars]] = {}
    readers: dict[str, Reader | None] = {}
    for name, topic in log.topics.items():
        if name not in skip and not topic.is_derived and topic.message_encoding in ENCODINGS:
            if topic.schema_name == schemas.FLOAT:
                if is_temperature(name):
                    readers[name] = None
            elif paths := _paths(log, topic):
                readers[name] = Reader(log, topic, tuple(paths), strict=False)
    for name, rows in log.rows(list(readers), start_ns, end_ns):
        with log.named(name):
            for channel, part in (
                _floats(log.topics[name], rows) if (reader := readers[name]) is None else _fields(reader, rows)
            ):
                found.setdefault(channel, []).append(part)
    return {channel: whole for channel, parts in found.items() if len(whole := _joined(parts))}


def with_temperatures(
    recordings: Sequence[Recording], log: Log, start_ns: int | None = None, end_ns: int | None = None
) -> list[Recording]:
    """Recordings of a log with the temperatures (`temperatures`) that are no scalar topic."""
    found = temperatures(log, set().union(*(recording.scalars for recording in recordings)), start_ns, end_ns)
    return [replace(recording, scalars={**recording.scalars, **found}) for recording in recordings] if found else [*recordings]


def _paths(log: Log, topic: Topic) -> list[str]:
    """Fields of a topic that are a temperature, by its definition."""
    channel = next((c for c in log.index.channels.values() if c.topic == topic.name), None)
    schema = None if channel is None else log.index.schemas.get(channel.schema_id)
    if schema is None or WORD.encode() not in schema.data:
        return []
    try:
        return [path for path in numeric_fields(log, topic.name, long=False) if path.rpartition(".")[2] == WORD]
    except LogError:  # another encoding than ROS 2's
        return []


def _floats(topic: Topic, rows: Rows) -> Iterator[tuple[str, Scalars]]:
    """Numbers of a scalar topic."""
    for part, layout in schemas.runs(rows.payload, topic.schema_name, topic.message_encoding):
        cut = rows.where(part)
        columns = decode_scalars(cut.payload, topic.schema_name, topic.message_encoding, layout)
        yield topic.name, thinned(cut.log_time, columns.values[:, 0], topic.metadata.get(UNIT_KEY, ""))


def _fields(reader: Reader, rows: Rows) -> Iterator[tuple[str, Scalars]]:
    """Numbers of the fields of a message, which ROS gives in °C."""
    reader.take(rows)
    t_ns, values = reader.t_ns(), np.concatenate(reader.values)
    for kept in (reader.log_times, reader.stamps, reader.values, reader.sequences):
        kept.clear()
    for path, column in zip(reader.paths, values.T, strict=True):
        yield f"{reader.topic.name}.{path}", thinned(t_ns, column, CELSIUS)


def _joined(parts: Sequence[Scalars]) -> Scalars:
    """Parts of one channel, thinned across their borders."""
    t_ns, values = (np.concatenate([getattr(part, name) for part in parts]) for name in ("t_ns", "values"))
    return thinned(t_ns, values[:, 0], parts[0].unit)
