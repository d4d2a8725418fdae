"""Write a recording as a log, in chunks of one kind of data each.

An IMU read from a log whose images share its chunks costs the unpacking of every image; so IMU, poses, scalars and images
each have chunks of their own, about 1 MiB long, interleaved by the time they begin.
"""

from __future__ import annotations

import heapq
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

import imutool
from imutool.array_types import Int64, Shaped, UInt8
from imutool.errors import DataError, LogError
from imutool.file_location import Location
from imutool.mcap_io.codec import messages, schemas
from imutool.mcap_io.codec.encode import encode_float, encode_image, encode_imu, encode_pose, encode_transform, encode_vector3
from imutool.mcap_io.file_writer import Chunk, LogWriter
from imutool.mcap_io.storage.source import Source
from imutool.mcap_io.topics import KIND_KEY, UNIT_KEY, VELOCITY_KEY
from imutool.recording import Frames, Poses, Recording, Scalars
from imutool.recording.message_log import DOUBTFUL, Attachment, named_kind

CHUNK_BYTES = 1 << 20  # compression gains nothing beyond, memory grows tenfold by 32 MiB (mcap#1658)
RECORD = "imutool"  # name of our metadata record
SHADOWED_KEY = "shadowed"  # in that record: JSON of a recording's own entries under the keys we use
OWN_KEYS = ("writer", "name", "source", "imu_topic", SHADOWED_KEY)
WORLD, BODY = "world", "body"
PACKED_IMAGES = ("png", "jpeg", "jpg", "webp")  # compressing these again costs time and saves nothing


class Series(NamedTuple):
    """A topic with its columns; messages are encoded when their chunk is due."""

    channel: int
    t_ns: Int64[np.ndarray, " n"]
    columns: tuple[Shaped[np.ndarray, " n *k"], ...]
    encode: Callable[..., UInt8[np.ndarray, "n L"]]

    def records(self, part: slice) -> UInt8[np.ndarray, "n M"]:
        """Message records of some rows; their sequence is the row."""
        payload = self.encode(*(column[part] for column in self.columns))
        times = self.t_ns[part]
        sequence = np.arange(part.start, part.stop, dtype=np.uint32)
        return messages.message_rows(self.channel, times, times, sequence, payload)


def write(recording: Recording, path: Location, *, compression: str = "zstd", overwrite: bool = False) -> None:
    """Writes a recording as a log, which `read` gives back bit for bit.

    Log time, publish time and stamp are equal.

    Raises:
        ConfigError: the target exists (without `overwrite`) or cannot be written, or an unknown compression.
        DataError: two topics of one name, a unit or frames of another kind, or times ROS 2 cannot store (before 1970, or
            seconds beyond 32 bits).
    """
    _refuse_other_kinds(recording)
    with LogWriter(path, compression=compression, overwrite=overwrite) as log:
        _write_metadata(log, recording)
        groups = [_imu(log, recording), _poses(log, recording), scalar_series(log, recording.scalars, frame_id="")]
        streams: list[Iterator[tuple[Chunk, str | None]]] = [((chunk, None) for chunk in chunks(g)) for g in groups]
        streams += [_images(log, topic, frames) for topic, frames in recording.frames.items()]
        for chunk, packing in heapq.merge(*streams, key=lambda item: item[0].start_ns):
            log.chunk(chunk, packing)


def _refuse_other_kinds(recording: Recording) -> None:
    """Refuses units and formats that are no text, and images without a function that gives them (DataError)."""
    parts: list[tuple[str, object]] = [(f"unit of {topic}", numbers.unit) for topic, numbers in recording.scalars.items()]
    parts += [(f"format of {topic}", frames.format) for topic, frames in recording.frames.items()]
    wrong = [(part, value, "text") for part, value in parts if not isinstance(value, str)]
    wrong += [(f"`each` of {topic}", f.each, "a function") for topic, f in recording.frames.items() if not callable(f.each)]
    for part, value, expected in wrong:
        raise DataError(f"the {part} is of type {type(value).__name__}", where=recording.name, expected=expected)


def _write_metadata(log: LogWriter, recording: Recording) -> None:
    """Writes the record `imutool` first; the recording's own entries of that name stay apart."""
    given = recording.metadata.get(RECORD)
    shadowed = None if given is None else {k: v for k, v in given.items() if k in OWN_KEYS}
    own = {
        "writer": f"imutool {imutool.__version__}",
        "name": recording.name,
        "source": recording.source,
        "imu_topic": recording.imu_topic,
        SHADOWED_KEY: json.dumps(shadowed),
    }
    log.metadata(RECORD, own | {k: v for k, v in (given or {}).items() if k not in own})
    for name, values in recording.metadata.items():
        if name != RECORD:
            log.metadata(name, values)


def _imu(log: LogWriter, recording: Recording) -> list[Series]:
    imu = recording.imu
    channel = log.channel(recording.imu_topic, schemas.IMU)
    return [Series(channel, imu.t_ns, (imu.t_ns, imu.gyro, imu.accel), partial(encode_imu, frame_id=BODY))]


def _poses(log: LogWriter, recording: Recording) -> list[Series]:
    """Every truth as PoseStamped with its velocity, and the first also on /tf."""
    found, named = list[Series](), {topic: named_kind(topic, schemas.POSE) for topic in recording.truths}
    for which, (topic, poses) in enumerate(recording.truths.items()):
        t_ns, columns = poses.t_ns, (poses.t_ns, poses.p_wb, poses.q_wb_wxyz)
        kind, name = recording.kind_of(topic), named[topic]
        misread = kind != name and ("truth" in named.values() or not {kind, name}.isdisjoint(DOUBTFUL))  # or in another order
        channel = log.channel(topic, schemas.POSE, {KIND_KEY: kind} if misread else {})
        found.append(Series(channel, t_ns, columns, partial(encode_pose, frame_id=WORLD)))
        if which == 0:
            encode = partial(encode_transform, frame_id=WORLD, child_frame_id=BODY)
            found.append(Series(log.channel("/tf", schemas.TF), t_ns, columns, encode))
        found += velocity_series(log, topic, poses)
    return found


def velocity_series(log: LogWriter, topic: str, poses: Poses) -> list[Series]:
    """Velocities of poses, on a topic that names the poses' own."""
    if poses.v_w is None:
        return []
    channel = log.channel(f"{topic.removesuffix('/pose')}/velocity", schemas.VECTOR3, {VELOCITY_KEY: topic, UNIT_KEY: "m/s"})
    return [Series(channel, poses.t_ns, (poses.t_ns, poses.v_w), partial(encode_vector3, frame_id=WORLD))]


def scalar_series(log: LogWriter, scalars: Mapping[str, Scalars], frame_id: str) -> list[Series]:
    """Topics of one number or of a vector, with their units."""
    found: list[Series] = []
    for topic, numbers in scalars.items():
        t_ns, values, unit = numbers.t_ns, numbers.values, {UNIT_KEY: numbers.unit}
        if values.shape[1] == 1:
            found.append(Series(log.channel(topic, schemas.FLOAT, unit), t_ns, (values[:, 0],), encode_float))
        else:
            encode = partial(encode_vector3, frame_id=frame_id)
            found.append(Series(log.channel(topic, schemas.VECTOR3, unit), t_ns, (t_ns, values), encode))
    return found


def chunks(group: Sequence[Series]) -> Iterator[Chunk]:
    """Messages of some topics in log-time order, cut into chunks.

    Raises:
        DataError: a time before 1970, which a log cannot hold.
    """
    if not group:
        return
    times = np.concatenate([series.t_ns for series in group])
    if len(times) and times.min() < 0:
        raise DataError(f"a message has the time {times.min()} ns", expected="no time before 1970")
    which = np.repeat(np.arange(len(group), dtype=np.uint16), [len(series.t_ns) for series in group])
    order = np.argsort(times, kind="stable")
    times, which = times[order], which[order]
    del order
    widths = np.array([series.records(slice(0, 0)).shape[1] for series in group], np.int64)
    edges = np.zeros(len(times) + 1, np.int64)
    np.cumsum(widths[which], out=edges[1:])
    cuts = np.unique(np.searchsorted(edges[:-1], np.arange(CHUNK_BYTES, edges[-1], CHUNK_BYTES)))
    done = [0] * len(group)
    for first, last in pairwise([0, *cuts[cuts < len(times)].tolist(), len(times)] if len(times) else []):
        offsets = edges[first:last] - edges[first]
        data = np.empty(int(edges[last] - edges[first]), np.uint8)
        for index, series in enumerate(group):
            own_bytes = offsets[which[first:last] == index]
            if len(own_bytes):
                messages.scatter(data, own_bytes, series.records(slice(done[index], done[index] + len(own_bytes))))
                done[index] += len(own_bytes)
        channels = np.array([series.channel for series in group], np.uint16)[which[first:last]]
        yield Chunk(data.tobytes(), channels, times[first:last], offsets)


@dataclass
class MessageBuffer:
    """Messages that become one chunk."""

    packed: bool  # already: compressing them again costs time and saves nothing
    parts: list[bytes | memoryview] = field(default_factory=list)
    channels: list[int] = field(default_factory=list)
    times: list[int] = field(default_factory=list)
    offsets: list[int] = field(default_factory=list)
    size: int = 0

    def add(self, channel: int, sequence: int, log_time: int, publish_time: int, payload: bytes | memoryview) -> None:
        """Take in a message."""
        self.parts += messages.message_head(channel, sequence, log_time, publish_time, len(payload)), payload
        self.channels.append(channel)
        self.times.append(log_time)
        self.offsets.append(self.size)
        self.size += messages.MESSAGE.itemsize + len(payload)

    def pop(self) -> tuple[Chunk, str | None]:
        """Hand over the messages as a chunk with its compression."""
        channels, times = np.array(self.channels, np.uint16), np.array(self.times, np.int64)
        chunk = Chunk(b"".join(self.parts), channels, times, np.array(self.offsets, np.int64))
        for column in (self.parts, self.channels, self.times, self.offsets):
            column.clear()
        self.size = 0
        return chunk, "none" if self.packed else None


def _images(log: LogWriter, topic: str, frames: Frames) -> Iterator[tuple[Chunk, str | None]]:
    """The chunks of one camera; images are fetched when their chunk is due."""
    channel, buffer = log.channel(topic, schemas.IMAGE), MessageBuffer(frames.format.lower() in PACKED_IMAGES)
    return _image_chunks(channel, buffer, topic, frames)


def _image_chunks(channel: int, buffer: MessageBuffer, topic: str, frames: Frames) -> Iterator[tuple[Chunk, str | None]]:
    frame_id = topic.strip("/").split("/")[0]
    for sequence, (t_ns, image) in enumerate(frames.each()):
        if t_ns < 0:
            raise DataError(f"an image of {topic} has the time {t_ns} ns", expected="no time before 1970")
        buffer.add(channel, sequence, t_ns, t_ns, encode_image(t_ns, image, frame_id, frames.format))
        if buffer.size >= CHUNK_BYTES:
            yield buffer.pop()
    if buffer.parts:
        yield buffer.pop()


def about_imu(entries: Mapping[str, str], topic: str, own_topic: str | None = None) -> dict[str, str]:
    """Entries of the record `imutool` about one IMU; the sensor is that of `imu_topic`."""
    own = own_topic or entries.get("imu_topic") or topic
    named = topic == own or topic.startswith(f"{own}/")  # what is computed from an IMU lies below it
    return {key: value for key, value in entries.items() if named or key != "sensor"}


def own_and_user_metadata(
    records: Iterable[tuple[str, Mapping[str, str]]], topic: str
) -> tuple[Mapping[str, str], dict[str, dict[str, str]]]:
    """The writer's notes on a recording and its own metadata, from the records of a log.

    The writer's record is the first `imutool` that names what it shadows; later ones describe what was done to the log.
    """
    own: Mapping[str, str] = {}
    found: dict[str, dict[str, str]] = {}
    for name, values in records:
        entries = values
        if name == RECORD and SHADOWED_KEY in values and not own:
            own, shadowed = values, _shadowed(values[SHADOWED_KEY])
            entries = {k: v for k, v in values.items() if k not in OWN_KEYS} | dict(shadowed or {})
            if not entries and shadowed is None:
                continue
        found.setdefault(name, {}).update(entries)
    if RECORD in found:
        found[RECORD] = about_imu(found[RECORD], topic, own.get("imu_topic"))
    return own, found


def _shadowed(text: str) -> Mapping[str, str] | None:
    """A recording's own entries under our keys; None where it had no record `imutool`."""
    try:
        value = json.loads(text)
    except ValueError:
        value = None
    return value if isinstance(value, dict) and all(isinstance(v, str) for v in value.values()) else None


def copy_attachment(log: LogWriter, place: Attachment) -> str:
    """Copy an attachment of another log; of a damaged one, which is left out, what is wrong."""
    try:
        with (origin := Source(place.path)).file:
            log.attachment(origin, place.offset, place.length)
    except LogError as error:
        return f"{error.what}; it is left out"
    return ""
