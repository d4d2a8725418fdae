"""MCAP of any encoding: IMUs in protobuf or JSON become sensor_msgs/Imu, all else stays.

A message counts as an IMU if it holds an angular velocity and a linear acceleration of x, y, z each, by the schema in the log
(protobuf) or by its first message (JSON). The translated topic has the name of the source's; the original messages are on
TOPIC/as_recorded. Values are taken as rad/s and m/s².
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from imutool.errors import ConfigError, DataError
from imutool.recording.message_log import Message, MessageLog, MessageTopic, Remarks

from . import Sequence
from ._files import head, name

GENERAL = True
MAGIC = b"\x89MCAP0\r\n"
IMU = "sensor_msgs/msg/Imu"
GYRO = r"angular_?velocity|gyro(scope)?|ang_?vel|rotation_?rate|omega"
ACCEL = r"linear_?acceleration|accel(eration|erometer)?|acc"
STAMP = r"timestamp|stamp|time|sensor_?time"
PARTS = (("sec", "seconds", "secs"), ("nsec", "nanos", "nanosec", "nsecs"))
DEPTH = 4  # messages within messages that are searched
IMAGES = r"(sensor_msgs/(msg/)?|foxglove\.)(CompressedImage|Image|RawImage)"
Path3 = tuple[str, ...]
Decode = Callable[[bytes], Mapping[str, Any]]


@dataclass(frozen=True)
class _Fields:
    """Where a message holds rates, accelerations and its stamp."""

    gyro: Path3
    accel: Path3
    stamp: Path3 | None


def sequences(source: Path) -> list[Sequence]:
    """The source itself, if it is an MCAP log; logs in folders are not looked for."""
    return [Sequence(name(source), source)] if source.is_file() and head(source, len(MAGIC)) == MAGIC else []


def recognises(sequence: Sequence) -> bool:
    """Whether a sequence is an MCAP log: always, as only logs are listed."""
    return True


def read_sequence(sequence: Sequence, *, images: bool = True) -> MessageLog:
    """Message log of an MCAP log.

    Raises:
        ConfigError: a protobuf schema, and protobuf is not installed.
        DataError: the log is damaged.
    """
    remarks = Remarks()
    with _refusing(sequence.path), sequence.path.open("rb") as file:
        reader = _reader(file)
        summary = reader.get_summary()
        metadata = {record.name: dict(record.metadata) for record in reader.iter_metadata()}
        counts: dict[str, int] = {}
        if summary is not None and summary.statistics is not None:
            of_channel = summary.statistics.channel_message_counts
            for number, channel in summary.channels.items():
                schema = summary.schemas.get(channel.schema_id)
                if images or not re.fullmatch(IMAGES, schema.name if schema else ""):
                    counts[channel.topic] = counts.get(channel.topic, 0) + of_channel.get(number, 0)
    own = {**metadata.pop("imutool", {}), "format": "mcap_log", "sequence": sequence.name}
    return MessageLog(
        sequence.name,
        sequence.path.name,
        messages=partial(_messages, sequence.path, images, remarks),
        counts=counts,
        metadata={"imutool": own, **metadata},
        remarks=remarks,
    )


def read(source: Path) -> Iterator[MessageLog]:
    """Message log of the source."""
    return map(read_sequence, sequences(source))


class _refusing:  # noqa: N801  (a context manager)
    """Turn the errors of damaged logs into a DataError with the place."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        from mcap.exceptions import McapError

        if isinstance(error, McapError | struct.error | OSError | EOFError | UnicodeDecodeError):
            reason = str(error).partition("\n")[0] or type(error).__name__
            fix = "Save what is intact with imutool repair, and convert that"
            raise DataError(f"cannot be read as an MCAP log ({reason})", where=self._path, fix=fix) from error


def _reader(file: Any) -> Any:
    from mcap.reader import make_reader

    return make_reader(file, validate_crcs=True)


def _messages(path: Path, images: bool, remarks: Remarks) -> Iterator[Message]:
    """Messages in log-time order; of an IMU in another encoding, the translation and the original."""
    translations: dict[int, _Translation | None] = {}
    topics: dict[int, MessageTopic] = {}
    with _refusing(path), path.open("rb") as file:
        for schema, channel, message in _reader(file).iter_messages():
            if channel.id not in topics:
                topic = _topic(schema, channel)
                topics[channel.id] = topic
                found = translations[channel.id] = _translation(schema, channel, message.data, path)
                if found is not None:
                    topics[channel.id] = replace(topic, name=f"{channel.topic}/as_recorded")
                    remarks.notes.append(f"{channel.topic}: {channel.message_encoding} became {IMU}, taken as rad/s and m/s^2")
            topic, translation = topics[channel.id], translations[channel.id]
            if not images and re.fullmatch(IMAGES, topic.schema_name):
                continue
            if translation is not None and (payload := translation.cdr(message.data, message.log_time)) is not None:
                yield Message(translation.topic, message.log_time, message.publish_time, payload)
            yield Message(topic, message.log_time, message.publish_time, message.data)


def _topic(schema: Any, channel: Any) -> MessageTopic:
    metadata = tuple(sorted(channel.metadata.items()))
    if schema is None:
        return MessageTopic(channel.topic, "", "", b"", channel.message_encoding, metadata)
    return MessageTopic(channel.topic, schema.name, schema.encoding, bytes(schema.data), channel.message_encoding, metadata)


@dataclass
class _Translation:
    """Translation of one topic's messages into CDR."""

    topic: MessageTopic
    decode: Decode
    fields: _Fields

    def cdr(self, raw: bytes, log_time: int) -> bytes | None:
        """Bytes of the Imu message; None of a message that lacks a field."""
        try:
            content = self.decode(raw)
            gyro, accel = _vector(_at(content, self.fields.gyro)), _vector(_at(content, self.fields.accel))
            t_ns = log_time if self.fields.stamp is None else _stamp(_at(content, self.fields.stamp))
        except (KeyError, ValueError, TypeError):
            return None
        sec, nsec = divmod(t_ns, 10**9)
        start = struct.pack("<iII", sec, nsec, 5) + b"body\0"
        start += bytes(-len(start) % 8)
        unknown = (0.0,) * 9
        numbers = (0.0, 0.0, 0.0, 1.0, -1.0, *unknown[1:], *gyro, *unknown, *accel, *unknown)
        return b"\0\1\0\0" + start + struct.pack("<37d", *numbers)


def _translation(schema: Any, channel: Any, first: bytes, path: Path) -> _Translation | None:
    """Translation of a topic, if its messages are those of an IMU in JSON or protobuf."""
    if channel.message_encoding == "json":
        decode: Decode = json.loads
    elif channel.message_encoding == "protobuf" and schema is not None:
        decode = _protobuf(schema, path)
    else:
        return None
    try:
        content = decode(first)
    except (ValueError, TypeError):
        return None
    fields = _find(content)
    if fields is None:
        return None
    topic = MessageTopic(channel.topic, IMU, "ros2msg", b"", "cdr")
    return _Translation(topic, decode, fields)


def _protobuf(schema: Any, path: Path) -> Decode:
    """Decoder to nested dicts, by the descriptors in the schema."""
    try:
        from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
        from google.protobuf.message import DecodeError
    except ImportError as error:
        fix = "Install it with: pip install 'imutool[protobuf]'"
        raise ConfigError("reading protobuf messages needs protobuf", where=path, fix=fix) from error
    try:
        pool = descriptor_pool.DescriptorPool()
        for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
            pool.Add(file)
        kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
    except (DecodeError, KeyError, TypeError) as error:
        raise DataError(f"the schema of {schema.name} cannot be read ({error})", where=path) from error

    def decode(raw: bytes) -> Mapping[str, Any]:
        try:
            return _as_dict(kind.FromString(raw), DEPTH)
        except DecodeError as error:
            raise ValueError(str(error)) from error

    return decode


def _as_dict(message: Any, depth: int) -> dict[str, Any]:
    """Fields of a protobuf message, also those at their default; of repeated ones only numbers."""
    content: dict[str, Any] = {}
    for field in message.DESCRIPTOR.fields:
        value = getattr(message, field.name)
        if field.message_type is None:
            content[field.name] = value if isinstance(value, int | float | str | bytes) else list(value)
        elif depth and hasattr(value, "DESCRIPTOR"):
            content[field.name] = _as_dict(value, depth - 1)
    return content


def _find(content: Any) -> _Fields | None:
    """Fields of an IMU in the content of a message."""
    if not isinstance(content, Mapping):
        return None
    paths = list(_walk(content, (), DEPTH))
    gyro = _first(content, paths, GYRO, _vector)
    accel = _first(content, paths, ACCEL, _vector)
    if gyro is None or accel is None:
        return None
    return _Fields(gyro, accel, _first(content, paths, STAMP, _stamp))


def _walk(content: Mapping[str, Any], above: Path3, depth: int) -> Iterator[Path3]:
    for key, value in content.items():
        yield (*above, key)
        if depth and isinstance(value, Mapping):
            yield from _walk(value, (*above, key), depth - 1)


def _first(content: Mapping[str, Any], paths: list[Path3], pattern: str, parse: Callable[[Any], object]) -> Path3 | None:
    for path in paths:
        words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", path[-1]).lower()
        if re.fullmatch(pattern, words):
            try:
                parse(_at(content, path))
            except (KeyError, ValueError, TypeError):
                continue
            return path
    return None


def _at(content: Any, path: Path3) -> Any:
    for key in path:
        content = content[key]
    return content


def _vector(value: Any) -> tuple[float, float, float]:
    """Three numbers of an object with x, y, z, or of a list.

    Raises:
        ValueError, KeyError, TypeError: it is none.
    """
    parts = [value[axis] for axis in "xyz"] if isinstance(value, Mapping) else list(value)
    if len(parts) != 3 or any(isinstance(part, str | bool) for part in parts):
        raise ValueError("no vector")
    x, y, z = map(float, parts)
    return x, y, z


def _stamp(value: Any) -> int:
    """Nanoseconds of an object with seconds and nanoseconds.

    Raises:
        ValueError, TypeError: it is none.
    """
    if not isinstance(value, Mapping):
        raise TypeError("no stamp")
    sec, nsec = (next((int(value[key]) for key in keys if key in value), None) for keys in PARTS)
    if sec is None or nsec is None or not 0 <= sec < 2**31:
        raise ValueError("no stamp")
    return sec * 10**9 + nsec
