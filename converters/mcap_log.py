"""MCAP of any encoding: IMUs and poses become those of ROS 2, all else stays.

The translated topic has the name of the source's; the original messages are on TOPIC/as_recorded.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

from imutool.errors import DataError
from imutool.recording.message_log import Message, MessageLog, MessageTopic

from . import Sequence
from ._source import head, name

GENERAL = True
MAGIC = b"\x89MCAP0\r\n"
CRC_AT = 33  # in a Chunk record: behind opcode, length, two times and the size
IMU = "sensor_msgs/msg/Imu", "cdr"  # defined ahead of the messages: a gyro's and an accelerometer's may be joined
IMAGES = r"(sensor_msgs/(msg/)?|foxglove\.)(CompressedImage|Image|RawImage)"


def sequences(source: Path) -> list[Sequence]:
    """The source itself, if it is an MCAP log; logs in folders are not looked for."""
    return [Sequence(name(source), source)] if source.is_file() and head(source, len(MAGIC)) == MAGIC else []


def recognises(sequence: Sequence) -> bool:
    """Whether a sequence is an MCAP log: always, as only logs are listed."""
    return True


def read_sequence(sequence: Sequence, *, images: bool = True) -> MessageLog:
    """Message log of an MCAP log.

    Raises:
        DataError: the log is damaged.
    """
    with _refusing(sequence.path), sequence.path.open("rb") as file:
        reader = _reader(file)
        summary = reader.get_summary()
        metadata = {record.name: dict(record.metadata) for record in reader.iter_metadata()}
        counts: dict[str, int] = {}
        topics: list[MessageTopic] = []
        if summary is not None and summary.statistics is not None:
            of_channel = summary.statistics.channel_message_counts
            for number, channel in summary.channels.items():
                schema = summary.schemas.get(channel.schema_id)
                if images or not re.fullmatch(IMAGES, schema.name if schema else ""):
                    if schema is not None and (schema.name, channel.message_encoding) == IMU:
                        topics.append(_topic(schema, channel))
                    counts[channel.topic] = counts.get(channel.topic, 0) + of_channel.get(number, 0)
        own = {**metadata.pop("imutool", {}), "format": "mcap_log", "sequence": sequence.name}
        unchecked = _without_crc(file, [] if summary is None else summary.chunk_indexes)
    log = MessageLog(
        sequence.name,
        sequence.path.name,
        topics=tuple(topics),
        messages=partial(_messages, sequence.path, images),
        counts=counts,
        metadata={"imutool": own, **metadata},
    )
    log.remarks.notes += [f"{unchecked} chunks state no CRC: their messages are not checked"] if unchecked else []
    return log


def _without_crc(file: BinaryIO, chunks: Iterable[Any]) -> int:
    """Number of chunks that state no CRC."""
    count = 0
    for chunk in chunks:
        file.seek(chunk.chunk_start_offset + CRC_AT)
        count += file.read(4) == bytes(4)
    return count


def read(source: Path) -> Iterator[MessageLog]:
    """Message log of the source."""
    return map(read_sequence, sequences(source))


@contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """Turn the errors of damaged logs into a DataError with the place."""
    try:
        yield
    except Exception as error:  # the reader raises whatever damaged bytes lead to: a wrong CRC is a ValueError
        reason = str(error).partition("\n")[0] or type(error).__name__
        fix = "Save what is intact with imutool repair, and convert that"
        raise DataError(f"cannot be read as an MCAP log ({reason})", where=path, fix=fix) from error


def _reader(file: Any) -> Any:
    from mcap.reader import make_reader

    return make_reader(file, validate_crcs=True)


def _messages(path: Path, images: bool) -> Iterator[Message]:
    """Messages in log-time order."""
    topics: dict[int, MessageTopic] = {}
    with _refusing(path), path.open("rb") as file:
        for schema, channel, message in _reader(file).iter_messages():
            topic = topics.get(channel.id)
            if topic is None:
                topic = topics[channel.id] = _topic(schema, channel)
            if images or not re.fullmatch(IMAGES, topic.schema_name):
                yield Message(topic, message.log_time, message.publish_time, message.data)


def _topic(schema: Any, channel: Any) -> MessageTopic:
    metadata = tuple(sorted(channel.metadata.items()))
    if schema is None:
        return MessageTopic(channel.topic, "", "", b"", channel.message_encoding, metadata)
    return MessageTopic(channel.topic, schema.name, schema.encoding, bytes(schema.data), channel.message_encoding, metadata)
