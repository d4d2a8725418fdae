"""MCAP of any encoding: IMUs and poses become those of ROS 2, all else stays.

The translated topic has the name of the source's; the original messages are on TOPIC/as_recorded. A folder with the numbered
parts of a ROS 2 bag (`NAME_0.mcap`, `NAME_1.mcap`, ...) and no metadata.yaml is one log: its recorder did not finish.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

from imutool.errors import DataError
from imutool.recording.message_log import Attachment, Message, MessageLog, MessageTopic, Remarks

from . import Sequence
from ._mcap_chunks import ATTACHMENT, MAGIC, Content, content, in_order, listed, records, summary_of, whole_size
from ._ros_types import plain_cdr
from ._source import find_files, find_folders, head, name, with_suffix

GENERAL = True
IMUS = r"sensor_msgs/msg/Imu|px4_msgs/msg/(Sensor|Vehicle).*"  # PX4 has parts of an IMU in messages of their own
METADATA = "metadata.yaml"  # of a ROS 2 bag, which its recorder writes last
PART = r"(.*)_(\d+)"  # name of a part of a ROS 2 bag
MAX_PAUSE_NS = 10 * 10**9  # between the parts of one recording, which a recorder splits as it goes
Define = Callable[[MessageTopic], MessageTopic]
IMAGES = r"(sensor_msgs/(msg/)?|foxglove\.)(CompressedImage|Image|RawImage)"


def sequences(source: Path) -> list[Sequence]:
    """The source itself, if it is an MCAP log; logs in folders that imutool did not write."""
    if source.is_dir():
        split = find_folders(source, lambda folder: bool(parts(Sequence(folder.name, folder))))
        taken = [sequence.path for sequence in split]
        alone = (log for log in _logs(source) if log.path.parent not in taken and not is_bag_folder(log.path.parent))
        return split + [log for log in alone if not _is_ours(log.path)]
    return [Sequence(name(source), source)] if source.is_file() and head(source, len(MAGIC)) == MAGIC else []


def own_logs(source: Path) -> list[Sequence]:
    """Logs of a folder that imutool wrote: its sources where nothing else is in it."""
    return [log for log in _logs(source) if _is_ours(log.path)]


def _logs(folder: Path) -> list[Sequence]:
    return find_files(folder, (".mcap",), lambda start: start.startswith(MAGIC))


def as_defined(topic: MessageTopic) -> MessageTopic:
    """The topic with the definition that the log has."""
    return topic


def read_sequence(sequence: Sequence, *, images: bool = True, define: Define = as_defined) -> MessageLog:
    """Message log of an MCAP log, or of the parts of one.

    `define` gives topics the definitions that it lacks.

    Raises:
        DataError: the log is damaged.
    """
    if sequence.path.is_dir():
        paths = parts(sequence)
        note = f"the bag has no {METADATA}; read in this order: {', '.join(path.name for path in paths)}"
        return read_parts(sequence, paths, Remarks([note]), images=images, define=define)
    with _refusing(sequence.path), sequence.path.open("rb") as file:
        summary = summary_of(_reader(file), file)
        found = Content(summary, file)
        of_channel = summary.statistics.channel_message_counts if summary.statistics is not None else {}
        counts: dict[str, int] = {}
        channels = [(summary.schemas.get(channel.schema_id), channel) for channel in summary.channels.values()]
        channels = [(s, channel) for s, channel in channels if images or not re.fullmatch(IMAGES, s.name if s else "")]
        for _, channel in channels if summary.statistics is not None else []:
            counts[channel.topic] = counts.get(channel.topic, 0) + of_channel.get(channel.id, 0)
        topics, silent = list[MessageTopic](), {topic for topic, count in counts.items() if not count}
        for schema, channel in channels:
            if _may_be_imu(schema, channel) or (channel.message_encoding == "cdr" and channel.topic in silent):
                topics.append(define(_topic(schema, channel)))
                silent.discard(channel.topic)
        left_out = f"topics without messages are left out: {', '.join(sorted(silent))}"
        remarks = Remarks([*found.notes, *[left_out][: len(silent)]], found.losses)
        own = {**found.metadata.pop("imutool", {}), "format": "mcap_log", "sequence": sequence.name}
    return MessageLog(
        sequence.name,
        sequence.path.name,
        topics=tuple(topics),
        messages=partial(_messages, sequence.path, images, define, remarks),
        counts=counts,
        metadata={"imutool": own, **found.metadata},
        attachments=tuple(Attachment(sequence.path, at, size) for at, size in found.attachments),
        remarks=remarks,
    )


def _may_be_imu(schema: Any, channel: Any) -> bool:
    """Whether messages are an IMU or a part of one: their topics are defined ahead of them, as two may be joined."""
    return schema is not None and channel.message_encoding == "cdr" and bool(re.fullmatch(IMUS, schema.name))


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


def parts(sequence: Sequence) -> list[Path]:
    """Parts of a ROS 2 bag without metadata.yaml, in order; none of other folders.

    A recorder numbers its parts from 0, and each begins where the one before it ends.
    """
    folder = sequence.path
    if is_bag_folder(folder):
        return []
    files = [path for path in with_suffix(folder, ".mcap") if path.is_file() and path.stat().st_size]
    named = {int(match[2]): (match[1], path) for path in files if (match := re.fullmatch(PART, path.stem))}
    found = [named[number][1] for number in sorted(named)]
    one_name = len(files) == len(named) and len({stem for stem, _ in named.values()}) == 1
    if not one_name or sorted(named) != [*range(len(named))] or any(head(p, len(MAGIC)) != MAGIC for p in found):
        return []
    spans = map(_span, found) if len(found) > 1 else ()
    gaps = (after[0] - before[1] for before, after in pairwise(spans) if before and after)
    return found if all(abs(gap) < MAX_PAUSE_NS for gap in gaps) else []


def is_bag_folder(folder: Path) -> bool:
    """Whether a folder is a ROS 2 bag; a recorder that died leaves no or empty metadata."""
    return b"rosbag2_bagfile_information" in head(folder / METADATA)


def _span(path: Path) -> tuple[int, int] | None:
    """First and last log time of a finished log; None of any other."""
    summary = _summary(path)
    statistics = None if summary is None else summary.statistics
    return (statistics.message_start_time, statistics.message_end_time) if statistics and statistics.message_count else None


def _is_ours(path: Path) -> bool:
    """Whether imutool wrote a log."""
    summary = _summary(path)
    return summary is not None and any(index.name.startswith("imutool") for index in summary.metadata_indexes)


def first_ns(path: Path) -> int:
    """First log time of a finished log; 0 of any other."""
    return (_span(path) or (0, 0))[0]


def is_finished(path: Path) -> bool:
    """Whether a file is an MCAP log that ends as its writer ends one."""
    if head(path, len(MAGIC)) != MAGIC:
        return False
    with path.open("rb") as file:
        file.seek(-len(MAGIC), 2)
        return file.read() == MAGIC


def _summary(path: Path) -> Any:
    """Summary of a finished log; None of any other."""
    try:
        with _refusing(path), path.open("rb") as file:
            return _reader(file).get_summary() if is_finished(path) else None
    except DataError:  # said again when the log is read
        return None


def read_parts(sequence: Sequence, paths: list[Path], remarks: Remarks, *, images: bool, define: Define) -> MessageLog:
    """Message log of the parts of a ROS 2 bag, one after the other.

    An unfinished one is read up to its end.
    """
    counts = Counter[str]()
    topics: dict[str, MessageTopic] = {}
    metadata: dict[str, dict[str, str]] = {}
    sources, attachments = [], list[Attachment]()
    for path in paths:
        if is_finished(path):
            part = read_sequence(Sequence(path.stem, path), images=images, define=define)
            remarks.notes += [note for note in part.remarks.notes if note not in remarks.notes]
            remarks.losses += part.remarks.losses
            counts.update(part.counts)
            for name, values in part.metadata.items():
                metadata.setdefault(name, {}).update(values)
            attachments += part.attachments
            found, messages = part.topics, partial(_messages, path, images, define, remarks)
        else:
            messages = partial(_unfinished, path, images)
            attachments += _unlisted(path)
            found = tuple(dict.fromkeys(message.topic for message in messages()))
            what = f"{path.name} was not finished: it is read up to its last whole chunk, at byte"
            remarks.losses.append(f"{what} {whole_size(path)} of {path.stat().st_size}")
        topics |= {topic.name: topic for topic in found if topic.message_encoding == "cdr"} | topics
        sources.append(messages)
    return MessageLog(
        sequence.name,
        sequence.path.name,
        topics=tuple(topics.values()),
        messages=lambda: chain.from_iterable(messages() for messages in sources),
        counts=counts,
        metadata=metadata | {"imutool": {"format": "mcap_log", "sequence": sequence.name}},
        attachments=tuple(attachments),
        remarks=remarks,
    )


def _unlisted(path: Path) -> Iterator[Attachment]:
    """Attachments of a log without an end."""
    from mcap.summary import Summary

    with _refusing(path), path.open("rb") as file:
        found = [*records(file, Summary(), whole_size(path))]
    yield from (Attachment(path, at, size) for opcode, at, size in found if opcode == ATTACHMENT)


def _unfinished(path: Path, images: bool) -> Iterator[Message]:
    """Messages of a log without an end, in log-time order within each chunk."""
    from mcap.records import Channel, Schema
    from mcap.records import Message as Record
    from mcap.summary import Summary

    schemas: dict[int, Any] = {}
    topics: dict[int, MessageTopic] = {}
    end = whole_size(path)
    with _refusing(path), path.open("rb") as file:
        for place in records(file, Summary(), end):
            for part in sorted(content(file, *place), key=lambda part: part.log_time if isinstance(part, Record) else -1):
                if isinstance(part, Schema):
                    schemas[part.id] = part
                elif isinstance(part, Channel):
                    topics[part.id] = _topic(schemas.get(part.schema_id), part)
                elif isinstance(part, Record) and (images or not re.fullmatch(IMAGES, topics[part.channel_id].schema_name)):
                    topic = topics[part.channel_id]
                    yield Message(topic, part.log_time, part.publish_time, _plain(topic, part.data))


def _reader(file: Any) -> Any:
    from mcap.reader import make_reader

    return make_reader(file, validate_crcs=True)


def _messages(path: Path, images: bool, define: Define = as_defined, remarks: Remarks | None = None) -> Iterator[Message]:
    """Messages in log-time order; what else chunks hold goes to the remarks."""
    topics: dict[int, MessageTopic] = {}
    others = Counter[int]()
    with _refusing(path), path.open("rb") as file:
        summary = summary_of(_reader(file), file)
        for log_time, _, _, number, publish_time, payload in in_order(summary, file, others):
            topic = topics.get(number)
            if topic is None:
                channel = summary.channels[number]
                schema = summary.schemas[channel.schema_id] if channel.schema_id else None
                topic = topics[number] = define(_topic(schema, channel))
            if images or not re.fullmatch(IMAGES, topic.schema_name):
                yield Message(topic, log_time, publish_time, _plain(topic, payload))
    loss = f"records in chunks that are none of MCAP's own are not carried over: {listed(others)}"
    if others and remarks is not None and loss not in remarks.losses:
        remarks.losses.append(loss)


def _plain(topic: MessageTopic, payload: bytes | memoryview) -> bytes | memoryview:
    return plain_cdr(payload) if topic.message_encoding == "cdr" else payload


def _topic(schema: Any, channel: Any) -> MessageTopic:
    metadata = tuple(sorted(channel.metadata.items()))
    if schema is None:
        return MessageTopic(channel.topic, "", "", b"", channel.message_encoding, metadata)
    return MessageTopic(channel.topic, schema.name, schema.encoding, bytes(schema.data), channel.message_encoding, metadata)
