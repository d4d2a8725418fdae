"""Samples for the rules: numbered columns in blocks, with context, and 0.1 s means."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np

from imutool.array_types import Bool, Float64, Int64
from imutool.errors import LogError
from imutool.file_location import Location
from imutool.mcap_io.codec import messages
from imutool.mcap_io.codec.decode import ImuBatch
from imutool.mcap_io.log import Log
from imutool.recording import nanoseconds
from imutool.recording.columns import quantile

BLOCK = 4096  # samples: what rules see at a time depends on the log alone, not on how its chunks were cut
STEP_NS = nanoseconds(0.1)
STEP_S = 0.1  # of `Motion`
RESTING = 0.1  # of the rate that a tenth of a log exceeds: the largest of rest
MAX_FRAMES = 4  # that a warning names
FIRST_MESSAGES = 1000  # that show whether sensors take turns
FEW_CHANGES, MAX_CHANGES = 10, 0.01  # of the frame, the second by messages: more are of sensors that take turns
MAX_COUNTED = 1000  # a hostile log names another frame in each message
MAX_RATES = 20_000  # samples of the gyro that are kept as they are: 480 kB

Numbers = Int64[np.ndarray, " n"]


class Samples(NamedTuple):
    """Consecutive messages that are still kept; `number` counts all messages from 0."""

    number: Numbers
    log_ns: Int64[np.ndarray, " n"]
    stamp_ns: Int64[np.ndarray, " n"]
    values: Float64[np.ndarray, "n 6"]  # gyro, accel, in the log's own units

    def where(self, index: slice | Bool[np.ndarray, " n"] | Int64[np.ndarray, " n"]) -> Samples:
        """Selected rows."""
        return Samples(*(column[index] for column in self))


def joined(parts: list[Samples]) -> Samples:
    """Concatenated samples."""
    return parts[0] if len(parts) == 1 else Samples(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def batches_by_topic(
    log: Log,
    topics: Collection[str],
    start_ns: int | None = None,
    end_ns: int | None = None,
    unreadable: Callable[[str, str], None] = lambda *_: None,
) -> Iterator[tuple[str, ImuBatch]]:
    """Messages of some IMUs as `raw_batches`: a chunk is unpacked once for all of them."""
    for topic, rows in messages.joined(log.rows(topics, start_ns, end_ns)):
        with log.named(topic):
            yield from ((topic, batch) for batch in log.topics[topic].decode_imu(rows, partial(unreadable, topic)))


class FrameCounts(Counter[str]):
    """Messages by the frame that they name, and how often it changes from one to the next."""

    changes = 0
    last: str | None = None

    def add(self, batch: ImuBatch) -> None:
        """Add the messages of a batch, which all name one frame."""
        frame = batch.frame_id.lstrip("/")
        self.changes += self.last not in (None, frame)
        self.last = frame
        if frame in self or len(self) < MAX_COUNTED:
            self[frame] += len(batch.stamp_ns)

    def words(self) -> list[str]:
        """Warning about an IMU whose messages name several frames; no name is no frame."""
        named = [f"{frame} ({count})" for frame, count in self.items() if frame]
        if len(named) < 2:
            return []
        some = ", ".join(named[:MAX_FRAMES]) + ", …" * (len(named) > MAX_FRAMES)
        return [f"the messages name {len(named)} frames: {some}; several sensors have no common bias"]

    def mixed(self) -> str:
        """Reason to distrust a topic on which sensors take turns; empty for one sensor."""
        named = sorted(frame for frame in self if frame)
        takes_turns = 2 <= len(named) <= MAX_FRAMES and self.changes > max(FEW_CHANGES, self.total() * MAX_CHANGES)
        return f"{len(named)} sensors take turns on the topic ({', '.join(named)})" if takes_turns else ""


def counted_frames(batches: Iterable[ImuBatch], frames: FrameCounts) -> Iterator[ImuBatch]:
    """The batches; their messages are counted by frame as they come."""
    for batch in batches:
        frames.add(batch)
        yield batch


def refuse_mixed(batches: Iterable[ImuBatch], topic: str, where: Location) -> None:
    """Refuse an IMU on whose topic sensors take turns, by its first messages.

    Raises:
        LogError: they do.
    """
    frames = FrameCounts()
    for _ in counted_frames(batches, frames):
        if frames.total() >= FIRST_MESSAGES:
            break
    if mixed := frames.mixed():
        fix = "Record each on a topic of its own, or set `force`"
        raise LogError(f"{topic}: {mixed}", where=where, expected="the messages of one sensor", fix=fix)


class BlockCutter:
    """Blocks of `BLOCK` messages, the last one shorter, whatever the batch sizes."""

    def __init__(self) -> None:
        self._parts: list[Samples] = []
        self._count, self._waiting = 0, 0

    def add(self, batch: ImuBatch) -> Iterator[Samples]:
        """Blocks that a batch completes."""
        number = np.arange(self._count, self._count + len(batch.stamp_ns))
        values = np.concatenate([batch.gyro, batch.accel], axis=1)
        self._parts.append(Samples(number, batch.log_time, batch.stamp_ns, values))
        self._count, self._waiting = self._count + len(number), self._waiting + len(number)
        if self._waiting >= BLOCK:
            whole, end = joined(self._parts), self._waiting // BLOCK * BLOCK
            self._parts, self._waiting = [whole.where(slice(end, None))], self._waiting - end
            yield from (whole.where(slice(first, first + BLOCK)) for first in range(0, end, BLOCK))

    def rest(self) -> Iterator[Samples]:
        """The last block, if there is one."""
        if self._waiting:
            yield joined(self._parts)


def blocks(batches: Iterable[ImuBatch]) -> Iterator[Samples]:
    """Blocks of one IMU, one after the other."""
    cutter = BlockCutter()
    for batch in batches:
        yield from cutter.add(batch)
    yield from cutter.rest()


def padded(stream: Iterable[Samples], margin: int) -> Iterator[tuple[Samples, slice]]:
    """Samples with up to `margin` neighbours on each side: rows, and the slice to judge."""
    waiting: list[Samples] = []
    before = 0
    for block in stream:
        waiting.append(block)
        count = sum(len(part.number) for part in waiting)
        if count - before > margin:
            whole = joined(waiting)
            yield whole, slice(before, count - margin)
            waiting = [whole.where(slice(max(0, count - 2 * margin), None))]
            before = min(margin, count - margin)
    if waiting:
        whole = joined(waiting)
        if before < len(whole.number):
            yield whole, slice(before, len(whole.number))


class Motion:
    """Means of the samples of each step of 0.1 s, and the first rates: 23 MB for ten hours."""

    def __init__(self) -> None:
        self.start_ns: int | None = None
        self.end_ns = 0
        self.samples = 0
        self._past_middle_ns = 0  # of all samples, each against the middle of its step
        self._steps: list[Int64[np.ndarray, " m"]] = []
        self._sums: list[Float64[np.ndarray, "m 7"]] = []
        self._open: tuple[int, Float64[np.ndarray, "7"]] | None = None
        self._rates: list[Float64[np.ndarray, "m 3"]] = []
        self._mean: tuple[Int64[np.ndarray, " m"], Float64[np.ndarray, "m 6"]] | None = None

    @property
    def middle_ns(self) -> int:
        """Start of the steps for what lies in their middle: the mean of a step's samples is up to half a period before that."""
        return (self.start_ns or 0) + self._past_middle_ns // max(self.samples, 1)

    def see(self, samples: Samples) -> None:
        """Add samples, with increasing stamps."""
        if not len(samples.number):
            return
        if self.start_ns is None:
            self.start_ns = self.end_ns = int(samples.stamp_ns[0])
        self.end_ns = int(samples.stamp_ns[-1])
        if self.samples < MAX_RATES:
            self._rates.append(samples.values[: MAX_RATES - self.samples, :3].copy())
        self.samples += len(samples.number)
        step, past_ns = np.divmod(samples.stamp_ns - self.start_ns, STEP_NS)
        self._past_middle_ns += int((past_ns - STEP_NS // 2).sum())
        rows = np.column_stack([np.ones(len(step)), samples.values])
        first = np.flatnonzero(np.diff(step, prepend=step[0] - 1))
        sums, steps = np.add.reduceat(rows, first, axis=0), step[first]
        if self._open is not None:
            if self._open[0] == steps[0]:
                sums[0] += self._open[1]
            else:
                self._steps.append(np.array([self._open[0]]))
                self._sums.append(self._open[1][None])
        self._open = int(steps[-1]), sums[-1].copy()
        self._steps.append(steps[:-1])
        self._sums.append(sums[:-1])

    @property
    def rates(self) -> Float64[np.ndarray, "m 3"]:
        """First samples of the gyro, as recorded."""
        return np.concatenate([np.zeros((0, 3)), *self._rates])

    def table(self) -> tuple[Int64[np.ndarray, " m"], Float64[np.ndarray, "m 6"]]:
        """Steps of 0.1 s since the first sample, and the mean gyro and accel in each.

        Steps without a sample are left out.

        Call it after the last sample; each call returns the same arrays.
        """
        if self._open is not None:
            self._steps.append(np.array([self._open[0]]))
            self._sums.append(self._open[1][None])
            self._open = None
        if self._mean is None:
            step = np.concatenate([np.zeros(0, np.int64), *self._steps])
            total = np.concatenate([np.zeros((0, 7)), *self._sums])
            self._steps, self._sums = [], []
            self._mean = step, total[:, 1:] / total[:, :1]
        return self._mean


def turns(rate: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Rows that turn: rest shows no axes, and a robot's arm may rest for most of a log."""
    size = np.linalg.norm(rate, axis=1)
    return np.asarray(size >= RESTING * (quantile(size, 0.9) if len(size) else 0.0))
