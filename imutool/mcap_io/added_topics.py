"""What is added to a log: topics computed from one of its IMUs, batch by batch as the log is copied."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int64, Shaped, UInt8, UInt16

from imutool.mcap_io.batches import ImuBatch
from imutool.mcap_io.codec import records
from imutool.mcap_io.log import Log
from imutool.mcap_io.writer import Chunk

FEED_BYTES = 1 << 18  # of IMU messages make a batch: one chunk holds a few among its images, too few for numpy to be quick

Heads = Shaped[np.ndarray, " n"]  # of dtype records.MESSAGE
Payload = UInt8[np.ndarray, "n L"]


class NewTopic(NamedTuple):
    """A topic to be added, and its message."""

    name: str
    schema_name: str


class Made(NamedTuple):
    """Messages computed from a batch: times and sequence of the source messages that have one, a payload row for each."""

    batch: ImuBatch
    payloads: Sequence[UInt8[np.ndarray, "n L"]]


@runtime_checkable
class Derived(Protocol):
    """Channels computed from one IMU topic of the source, which is fed in file order."""

    @property
    def source_topic(self) -> str:
        """The IMU topic."""

    @property
    def topics(self) -> Sequence[NewTopic]:
        """The topics to be added."""

    def __call__(self, batch: ImuBatch) -> Made:
        """What to write for a batch: which of its messages stay, and one array of CDR payloads per new topic."""


@dataclass
class Stream:
    """One `Derived`, the ids of its channels, and what waits to be decoded, then to be written."""

    log: Log
    make: Derived
    sources: set[int]
    ids: list[int]
    waiting: list[tuple[Heads, Payload]] = field(default_factory=list)  # of the source, of equal size
    waits: int = 0  # bytes of them
    data: list[UInt8[np.ndarray, "n M"]] = field(default_factory=list)
    channels: list[UInt16[np.ndarray, " n"]] = field(default_factory=list)
    times: list[Int64[np.ndarray, " n"]] = field(default_factory=list)
    offsets: list[Int64[np.ndarray, " n"]] = field(default_factory=list)
    size: int = 0

    def feed(self, found: records.Messages) -> None:
        """Takes in its messages of a chunk of the source, and decodes them once there are enough."""
        of = found.heads["channel"]
        mask = np.logical_or.reduce([of == channel for channel in self.sources])
        for heads, payload in records.cut(found, mask):
            if self.waiting and self.waiting[-1][1].shape[1] != payload.shape[1]:
                self.decode()
            self.waiting.append((heads, payload))
            self.waits += payload.size
        if self.waits >= FEED_BYTES:
            self.decode()

    def decode(self) -> None:
        """Hands the messages that waited over."""
        if self.waiting:
            heads, payloads = zip(*self.waiting, strict=True)
            rows = records.columns(np.concatenate(heads), np.concatenate(payloads))
            self.waiting.clear()
            self.waits = 0
            with self.log.named(self.make.source_topic):
                for batch in self.log.decode_imu(self.make.source_topic, rows):
                    self.take(batch)

    def take(self, batch: ImuBatch) -> None:
        """Computes the new messages of a batch; those of one source message stand side by side."""
        batch, payloads = self.make(batch)
        assert len(payloads) == len(self.ids), f"{len(payloads)} arrays for {len(self.ids)} topics"
        widths = [records.MESSAGE.itemsize + payload.shape[1] for payload in payloads]
        count, stride, ends = len(batch.log_time), sum(widths), np.cumsum(widths)
        data = np.empty((count, stride), np.uint8)
        for channel, payload, width, end in zip(self.ids, payloads, widths, ends.tolist(), strict=True):
            here = data[:, end - width : end]
            records.message_rows(channel, batch.log_time, batch.publish_time, batch.sequence, payload, here)
        self.data.append(data)
        self.channels.append(np.tile(np.array(self.ids, np.uint16), count))
        self.times.append(np.repeat(batch.log_time, len(widths)))
        self.offsets.append((self.size + stride * np.arange(count)[:, None] + ends - widths).reshape(-1))
        self.size += count * stride

    def taken(self) -> Chunk:
        """What waits, as one chunk."""
        times, offsets = np.concatenate(self.times), np.concatenate(self.offsets)
        chunk = Chunk(b"".join(part.data for part in self.data), np.concatenate(self.channels), times, offsets)
        for column in (self.data, self.channels, self.times, self.offsets):
            column.clear()
        self.size = 0
        return chunk
