"""Topics added to a log, computed from one of its IMUs batch by batch as the log is copied."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int64, UInt8, UInt16

from imutool.errors import LogError
from imutool.mcap_io.codec import messages, schemas
from imutool.mcap_io.log import Log
from imutool.mcap_io.passthrough.chunk_check import Part
from imutool.mcap_io.topics import ImuBatch
from imutool.mcap_io.writer import Chunk

BATCH_BYTES = 1 << 18  # of IMU messages are decoded at once: one chunk holds too few among its images for numpy to be quick


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


def check_new_topics(log: Log, derived: Sequence[DerivedTopics]) -> None:
    """Refuses a new topic that the log has already.

    Raises:
        LogError: it has, or lacks a source topic.
    """
    for topics in derived:
        log.topic(topics.source_topic, (schemas.IMU,))
        for new in topics.topics:
            if new.name in log.topics:
                raise LogError(
                    f"{new.name} is in this log already",
                    where=log.path,
                    expected="a log without it",
                    fix="Choose another IMU with `imu`, or start from the original log",
                )


@dataclass
class DerivedStream:
    """Queues of one `DerivedTopics`: source messages to decode, computed messages to write."""

    log: Log
    derived: DerivedTopics
    sources: set[int]
    ids: list[int]
    undecoded: list[Part] = field(default_factory=list)  # of the source, of equal size
    undecoded_bytes: int = 0
    data: list[UInt8[np.ndarray, "n M"]] = field(default_factory=list)
    channels: list[UInt16[np.ndarray, " n"]] = field(default_factory=list)
    times: list[Int64[np.ndarray, " n"]] = field(default_factory=list)
    offsets: list[Int64[np.ndarray, " n"]] = field(default_factory=list)
    size: int = 0

    def add(self, parts: Iterable[Part]) -> None:
        """Takes in messages of a source chunk, and decodes them once there are enough."""
        for every, payloads in parts:
            mine = np.logical_or.reduce([every["channel"] == channel for channel in self.sources])
            if not mine.any():
                continue
            part = Part(every, payloads) if mine.all() else Part(every[mine], payloads[mine])  # else another stream's too
            if self.undecoded and self.undecoded[-1].payload.shape[1] != part.payload.shape[1]:
                self.decode()
            self.undecoded.append(part)
            self.undecoded_bytes += part.payload.size
        if self.undecoded_bytes >= BATCH_BYTES:
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

    def pop_chunk(self) -> Chunk:
        """Hands over the computed messages as one chunk."""
        times, offsets = np.concatenate(self.times), np.concatenate(self.offsets)
        chunk = Chunk(b"".join(part.data for part in self.data), np.concatenate(self.channels), times, offsets)
        for column in (self.data, self.channels, self.times, self.offsets):
            column.clear()
        self.size = 0
        return chunk
