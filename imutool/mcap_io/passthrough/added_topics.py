"""Topics added to a log, computed from one of its IMUs batch by batch as the log is copied."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from imutool.array_types import Int64, UInt8, UInt16
from imutool.errors import LogError
from imutool.mcap_io.codec import messages, schemas
from imutool.mcap_io.codec.decode import ImuBatch
from imutool.mcap_io.codec.encode import as_ros1
from imutool.mcap_io.codec.reflection import Reflected
from imutool.mcap_io.file_writer import Chunk, LogWriter
from imutool.mcap_io.log import Log
from imutool.mcap_io.passthrough.chunk_check import Part
from imutool.mcap_io.topics import DERIVED_KEY, REFLECTED, Topic
from imutool.recording.message_log import MessageTopic

Translate = Callable[[UInt8[np.ndarray, "..."]], UInt8[np.ndarray, "..."] | list[bytes]]  # from CDR


class NewTopic(NamedTuple):
    """A topic to be added, and its message."""

    name: str
    schema_name: str


class DerivedBatch(NamedTuple):
    """Messages computed from a batch, a payload row for each.

    `batch` holds the source messages that have one.
    """

    batch: ImuBatch
    payloads: Sequence[UInt8[np.ndarray, "n L"]]


@runtime_checkable
class DerivedTopics(Protocol):
    """Topics computed from one IMU topic of the source, in file order."""

    @property
    def source_topic(self) -> str:
        """The IMU topic."""

    @property
    def topics(self) -> Sequence[NewTopic]:
        """The topics to be added."""

    def __call__(self, batch: ImuBatch) -> DerivedBatch:
        """Messages for a batch: the source messages that stay, and CDR payloads per new topic."""


def check_new_topics(log: Log, added: Mapping[str, Sequence[NewTopic]]) -> None:
    """Refuses a new topic that the log has already; `added` has the new ones by source topic.

    Raises:
        LogError: it has, or lacks a source topic.
    """
    for source, topics in added.items():
        log.topic(source, (schemas.IMU,))
        for new in topics:
            if new.name in log.topics:
                raise LogError(
                    f"{new.name} is in this log already",
                    where=log.path,
                    expected="a log without it",
                    fix="Choose another IMU with `imu`, or start from the original log",
                )


def define(out: LogWriter, new: NewTopic, log: Log, source: Topic, *, own: bool) -> tuple[int, Translate | None]:
    """Define a new topic; return its channel id, and the translation of its messages out of CDR.

    With `own` an IMU has the type and encoding of its source, and the types of ROS have the encoding of ROS 1 where the source
    has it.
    """
    metadata = {DERIVED_KEY: source.name}
    if own and source.message_encoding == "ros1":
        text, name = schemas.ros1_definition(new.schema_name).encode(), new.schema_name.replace("/msg/", "/")
        topic = MessageTopic(new.name, name, "ros1msg", text, "ros1", tuple(metadata.items()))
        return out.define(topic), partial(as_ros1, schema_name=new.schema_name)
    if own and source.message_encoding in REFLECTED and new.schema_name == schemas.IMU:
        channel = next(channel for channel in log.index.channels.values() if channel.topic == source.name)
        schema = log.index.schemas.get(channel.schema_id)
        data = schema.data if schema else b""
        described = source.own_schema, source.schema_encoding, data, source.message_encoding, tuple(metadata.items())
        assert isinstance(source.reflected, Reflected), "an IMU in such an encoding was found by reflection"
        return out.define(MessageTopic(new.name, *described)), source.reflected.from_cdr
    return out.channel(new.name, new.schema_name, metadata), None


@dataclass
class DerivedStream:
    """Queues of one `DerivedTopics`: source messages to decode, computed messages to write."""

    log: Log
    derived: DerivedTopics
    sources: set[int]
    defined: Sequence[tuple[int, Translate | None]]  # channel ids, and translations out of CDR
    undecoded: list[Part] = field(default_factory=list)  # of the source, of equal size
    undecoded_bytes: int = 0
    data: list[UInt8[np.ndarray, "..."]] = field(default_factory=list)
    channels: list[UInt16[np.ndarray, " n"]] = field(default_factory=list)
    times: list[Int64[np.ndarray, " n"]] = field(default_factory=list)
    offsets: list[Int64[np.ndarray, " n"]] = field(default_factory=list)
    size: int = 0

    @property
    def ids(self) -> list[int]:
        """Channel ids of the new topics."""
        return [number for number, _ in self.defined]

    def add(self, parts: Iterable[Part]) -> None:
        """Takes in the IMU's messages of a source chunk, and decodes them once there are enough."""
        for part in parts:
            if self.undecoded and self.undecoded[-1].payload.shape[1] != part.payload.shape[1]:
                self.decode()
            self.undecoded.append(part)
            self.undecoded_bytes += part.payload.size
        if self.undecoded_bytes >= messages.BATCH_BYTES:
            self.decode()

    def decode(self) -> None:
        """Decodes the waiting messages and computes the new ones."""
        if self.undecoded:
            heads, payloads = zip(*self.undecoded, strict=True)
            rows = messages.columns(np.concatenate(heads), np.concatenate(payloads))
            self.undecoded.clear()
            self.undecoded_bytes = 0
            with self.log.named(self.derived.source_topic):
                for batch in self.log.topics[self.derived.source_topic].decode_imu(rows):
                    self._compute(batch)

    def _compute(self, batch: ImuBatch) -> None:
        """Computes the new messages of a batch, side by side for each source message."""
        batch, payloads = self.derived(batch)
        assert len(payloads) == len(self.ids), f"{len(payloads)} arrays for {len(self.ids)} topics"
        if any(translate for _, translate in self.defined) and len(batch.log_time):
            self._put_one_by_one(batch, [p if t is None else t(p) for (_, t), p in zip(self.defined, payloads, strict=True)])
            return
        widths = [messages.MESSAGE.itemsize + payload.shape[1] for payload in payloads]
        count, stride, ends = len(batch.log_time), sum(widths), np.cumsum(widths)
        data = np.empty((count, stride), np.uint8)
        for channel, payload, width, end in zip(self.ids, payloads, widths, ends.tolist(), strict=True):
            columns = data[:, end - width : end]
            messages.message_rows(channel, batch.log_time, batch.publish_time, batch.sequence, payload, columns)
        self.data.append(data)
        self.channels.append(np.tile(np.array(self.ids, np.uint16), count))
        self.times.append(np.repeat(batch.log_time, len(widths)))
        self.offsets.append((self.size + stride * np.arange(count)[:, None] + ends - widths).reshape(-1))
        self.size += count * stride

    def _put_one_by_one(self, batch: ImuBatch, payloads: Sequence[UInt8[np.ndarray, "..."] | list[bytes]]) -> None:
        """Put messages of differing sizes, side by side for each source message."""
        parts: list[bytes] = []
        sizes: list[int] = []
        times = batch.sequence.tolist(), batch.log_time.tolist(), batch.publish_time.view(np.uint64).tolist()
        for n, (sequence, log_ns, publish_ns) in enumerate(zip(*times, strict=True)):
            for channel, of_topic in zip(self.ids, payloads, strict=True):
                payload = bytes(of_topic[n])
                parts += messages.message_head(channel, sequence, log_ns, publish_ns, len(payload)), payload
                sizes.append(messages.MESSAGE.itemsize + len(payload))
        self.data.append(np.frombuffer(b"".join(parts), np.uint8))
        self.channels.append(np.tile(np.array(self.ids, np.uint16), len(batch.log_time)))
        self.times.append(np.repeat(batch.log_time, len(self.ids)))
        self.offsets.append(self.size + np.cumsum([0, *sizes[:-1]]))
        self.size += sum(sizes)

    def pop_chunk(self) -> Chunk:
        """Hands over the computed messages as one chunk."""
        times, offsets = np.concatenate(self.times), np.concatenate(self.offsets)
        chunk = Chunk(b"".join(part.data for part in self.data), np.concatenate(self.channels), times, offsets)
        for column in (self.data, self.channels, self.times, self.offsets):
            column.clear()
        self.size = 0
        return chunk
