"""Samples of a log's IMU in blocks, in order of time, as often as they are needed.

The first pass finds whether the stamps increase and come one by one. Then only a block is in memory. Otherwise all stamps are,
with the order of the samples, and the samples that came too early.
"""

from __future__ import annotations

import tempfile
import weakref
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from typing import BinaryIO

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.cleaning import raw_batches
from imutool.cleaning.rules.gaps import missing
from imutool.cleaning.rules.not_finite import measured
from imutool.cleaning.rules.saturation import AxisLimits
from imutool.cleaning.samples import BLOCK, BlockCutter, FrameCounts, Samples, batches_by_topic, blocks, joined
from imutool.cleaning.stamp_line import Stamps, distinct, read_stamps, restamped, usual_period
from imutool.log_info.clock import IncreasingStamps, SensorStamps, sorted_stamps
from imutool.log_info.report import Interval
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.decode import ImuBatch
from imutool.mcap_io.log import Log
from imutool.recording import nanoseconds
from imutool.recording.columns import clock_jumps, median
from imutool.recording.sample_order import TICK_SPAN, ticked

APART_NS = nanoseconds(60.0)  # of stretches that are read by themselves
MAX_NAMED = 5  # unreadable messages
ROUNDING_NS = 1024  # of times as floats
READ_AT_ONCE = 8  # IMUs: a quarter of a megabyte of messages of each waits to be decoded
MARGIN = TICK_SPAN + 1  # stamps on both sides that show whether a step lost samples
NO_FAULTS = Stamps(np.zeros(0, np.int64), "", Counter(), 1.0, unset=False)
ROW_BYTES = 64  # of a sample: two times and six values; its message has some 350
MAX_KEPT_ROWS = 1 << 21  # 128 MiB, three hours at 200 Hz: a folder of temporary files may lie in memory
LAST_NS = 2**63 - 1


class ImuSamples:
    """Finite samples of an IMU in order of time, each stamp once.

    Attributes:
        counts: messages with a defect by its name; `missing` and `saturated` are complete after `counted`.
        recorded: messages, and their stamps, in order of time.
        sound: stamps of the samples.
        frames: messages by the frame that they name.
        stamps, jumps: faults of the stamps, and jumps of their clock.
        unreadable: what is wrong with the first messages that are none of an IMU.
        unsorted: whether the messages are one recording in another order than that of their log times.
    """

    def __init__(self, log: Log, topic: str, *, read: bool = True) -> None:
        """Reads the IMU once, unless `read_imus` does.

        Raises:
            LogError: no such IMU topic, another encoding, or damage.
        """
        self.log, self.topic = log, log.topic(topic, (schemas.IMU,)).name
        self._limits = AxisLimits(6)
        self._rank: Int64[np.ndarray, " n"] | None = None  # of each message among the samples, -1 of those that are none
        self._lag_ns = np.inf, -np.inf  # of the log times behind the stamps
        self.frames = FrameCounts()
        self.recorded: IncreasingStamps = SensorStamps()
        self.stamps, self.unsorted, self.sound = NO_FAULTS, False, IncreasingStamps()
        self.unreadable = list[str]()
        self._cutter, self._kept = BlockCutter(), KeptBlocks()
        if read:
            _read([self])

    def add(self, batch: ImuBatch) -> None:
        """Add the next messages."""
        self.frames.add(batch)
        for samples in self._cutter.add(batch):
            self._see(samples)

    def _see(self, samples: Samples) -> None:
        self._kept.add(samples)
        good = measured(samples.values)
        self._limits.see(samples.values[good], self.sound.count + np.arange(good.sum()))
        self.recorded.see(samples.stamp_ns)
        self.sound.see(samples.stamp_ns[good])
        lag_ns = samples.log_ns.astype(np.float64) - samples.stamp_ns
        self._lag_ns = min(self._lag_ns[0], lag_ns.min()), max(self._lag_ns[1], lag_ns.max())

    def name(self, unreadable: str) -> None:
        """Keep what is wrong with a message that is none of an IMU."""
        if len(self.unreadable) < MAX_NAMED:
            self.unreadable.append(unreadable)

    def finish(self) -> None:
        """Settle counts and order after the last message."""
        for samples in self._cutter.rest():
            self._see(samples)
        assert isinstance(self.recorded, SensorStamps), "stamps are sorted below at the earliest"
        self.jumps, self._period_ns = self.recorded.jumps, self.recorded.period_ns
        lost = self.recorded.count - self.sound.count
        self.counts = {"out_of_order": 0, "duplicated": 0, "missing": 0, "not_finite": lost, "saturated": 0}
        if not self.recorded.sound:
            self._hold_stamps()

    def __len__(self) -> int:
        return self.sound.count

    @property
    def period_s(self) -> float:
        """Median step between the samples."""
        return self.sound.steps.median() * 1e-9

    def _read(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Samples]:
        return self._kept.read(start_ns, end_ns) or blocks(raw_batches(self.log, self.topic, start_ns, end_ns))

    def _hold_stamps(self) -> None:
        """Reads all stamps into memory, and settles the order of the samples."""
        parts = [(samples.stamp_ns.copy(), samples.log_ns.copy(), measured(samples.values)) for samples in self._read()]
        t_ns, log_ns = (np.concatenate([np.zeros(0, np.int64), *(part[column] for part in parts)]) for column in (0, 1))
        rows = np.flatnonzero(np.concatenate([np.zeros(0, bool), *(good for *_, good in parts)]))
        self.stamps, self.jumps, self.recorded = read_stamps(t_ns), clock_jumps(t_ns), sorted_stamps(t_ns)
        self.counts["out_of_order"] = int((t_ns < np.maximum.accumulate(t_ns)).sum()) if len(t_ns) else 0
        self.unsorted = self.counts["out_of_order"] > 0 and _ordered_by(log_ns, t_ns)
        self.counts["duplicated"] = len(t_ns) - len(distinct(t_ns))
        line = distinct(restamped(t_ns) if self.stamps.batch > 1.0 or self.stamps.fraction else t_ns)
        self.counts["missing"] = int(missing(line, usual_period(line), ticked(line)).sum()) if len(line) > 1 else 0
        ordered, first = np.unique(t_ns[rows], return_index=True)
        self._rank = np.full(len(t_ns), -1)
        self._rank[rows[first]] = np.arange(len(first))
        self.sound = IncreasingStamps()
        self.sound.see(ordered)

    def __iter__(self) -> Iterator[Samples]:
        return self._in_order(self._read())

    def counted(self) -> Iterator[Samples]:
        """The samples; their defects are counted as they come."""
        stream = self._read()
        yield from self._in_order(self._reached(stream if self._rank is not None else self._lost(stream)))

    def _lost(self, stream: Iterable[Samples]) -> Iterator[Samples]:
        """Counts the samples that are missing between stamps that increase."""
        t_ns, judged, coarse = np.zeros(0, np.int64), 0, None
        for samples in stream:
            yield samples
            t_ns = np.concatenate([t_ns, samples.stamp_ns])
            end, coarse = max(judged, len(t_ns) - 1 - MARGIN), ticked(t_ns, coarse)
            if end > judged:
                self.counts["missing"] += int(missing(t_ns, self._period_ns, coarse)[judged:end].sum())
            t_ns, judged = t_ns[max(end - MARGIN, 0) :], min(end, MARGIN)
        if len(t_ns) > 1:
            self.counts["missing"] += int(missing(t_ns, self._period_ns, coarse)[judged:].sum())

    def _reached(self, stream: Iterable[Samples]) -> Iterator[Samples]:
        """Counts the samples that reach the limit of an axis."""
        finite = 0
        for samples in stream:
            yield samples
            values = samples.values[measured(samples.values)]
            self.counts["saturated"] += int(self._limits.reached(values, finite + np.arange(len(values))).sum())
            finite += len(values)

    def _in_order(self, stream: Iterable[Samples]) -> Iterator[Samples]:
        """Finite samples in order of time."""
        waiting, sent = list[Samples](), 0
        for samples in stream:
            if self._rank is None:
                good = measured(samples.values)
                yield samples if good.all() else samples.where(good)
                continue
            rank = self._rank[samples.number]
            whole = joined([*waiting, samples._replace(number=rank).where(rank >= 0)])
            whole = whole.where(np.argsort(whole.number))
            ready = int((whole.number == sent + np.arange(len(whole.number))).sum())
            yield whole.where(slice(ready))
            waiting, sent = [whole.where(slice(ready, None))], sent + ready

    def within(self, stretches: Sequence[Interval]) -> Iterator[tuple[int, Float64[np.ndarray, "n 6"]]]:
        """Parts of stretches of time that are in order and disjoint: number of the stretch, and samples."""
        first_ns, last_ns = np.array([(s.first_ns, s.last_ns) for s in stretches], np.int64).reshape(-1, 2).T
        cuts = (np.flatnonzero(first_ns[1:] - last_ns[:-1] > APART_NS) + 1).tolist()
        for a, b in pairwise([0, *(cuts if self._rank is None else []), len(stretches)]):
            start_ns, end_ns = (
                int(first_ns[a] + self._lag_ns[0]) - ROUNDING_NS,
                int(last_ns[b - 1] + self._lag_ns[1]) + ROUNDING_NS,
            )
            for samples in self._in_order(self._read(start_ns, end_ns) if self._rank is None else self._read()):
                of = a + np.searchsorted(first_ns[a:b], samples.stamp_ns, side="right") - 1
                of[(of < a) | (samples.stamp_ns > last_ns[of])] = -1
                for stretch in np.flatnonzero(np.bincount(of[of >= 0])).tolist():  # unlike `unique`, without masked arrays
                    yield stretch, samples.values[of == stretch]


def read_imus(log: Log, topics: Sequence[str]) -> Iterator[ImuSamples]:
    """Samples of some IMUs; each chunk is unpacked once for `READ_AT_ONCE` of them.

    Raises:
        LogError: as `ImuSamples`.
    """
    for first in range(0, len(topics), READ_AT_ONCE):
        yield from _read([ImuSamples(log, topic, read=False) for topic in topics[first : first + READ_AT_ONCE]])


def _read(imus: Sequence[ImuSamples]) -> Sequence[ImuSamples]:
    of = {imu.topic: imu for imu in imus}
    for topic, batch in batches_by_topic(imus[0].log, of, unreadable=lambda topic, what: of[topic].name(what)):
        of[topic].add(batch)
    for imu in imus:
        imu.finish()
    return imus


def _ordered_by(log_ns: Int64[np.ndarray, " n"], t_ns: Int64[np.ndarray, " n"]) -> bool:
    """Whether stamps in order of log time are those of one recording.

    A clock that was set back sets the log times back, too. In their order its samples would come between earlier ones, closer
    than the sensor measures, or with a jump before them.
    """
    steps, forward = np.diff(t_ns[np.argsort(log_ns, kind="stable")]), np.diff(t_ns)
    forward = forward[forward > 0]
    if not len(forward):
        return False
    short = median(forward) / 2.0
    closer = int((steps < short).sum()) > int((forward < short).sum())
    return int(steps.min()) >= 0 and not closer and not clock_jumps(np.sort(t_ns))


class KeptBlocks:
    """Blocks of samples in a file without a name.

    Of more than `MAX_KEPT_ROWS` samples, or where the system gives no file or no room, nothing is kept.
    """

    def __init__(self) -> None:
        self._file: BinaryIO | None = None
        self._rows = 0

    def add(self, samples: Samples) -> None:
        """Keep the next block; each but the last has `BLOCK` samples."""
        table = np.column_stack([samples.log_ns, samples.stamp_ns, samples.values.view(np.int64)])
        is_first, self._rows = not self._rows, self._rows + len(table)
        try:
            if is_first:
                self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115  closed with this object
                weakref.finalize(self, self._file.close)
            if self._file is not None and (self._rows > MAX_KEPT_ROWS or self._file.write(table.tobytes()) != table.nbytes):
                self._drop()
        except OSError:
            self._drop()

    def _drop(self) -> None:
        if self._file is not None:
            self._file.close()
        self._file = None

    def read(self, start_ns: int | None, end_ns: int | None) -> Iterator[Samples] | None:
        """The samples with log times from `start_ns` to `end_ns`, both included; None where they are not kept."""
        ends = 0 if start_ns is None else start_ns, LAST_NS if end_ns is None else end_ns
        return None if self._file is None else self._within(self._file, *ends)

    def _within(self, file: BinaryIO, start_ns: int, end_ns: int) -> Iterator[Samples]:
        for first in range(0, self._rows, BLOCK):
            file.seek(first * ROW_BYTES)
            table = np.frombuffer(file.read(min(BLOCK, self._rows - first) * ROW_BYTES), np.int64).reshape(-1, 8)
            log_ns, stamp_ns, values = table[:, 0].copy(), table[:, 1].copy(), table[:, 2:].copy().view(np.float64)
            samples = Samples(first + np.arange(len(table)), log_ns, stamp_ns, values)
            inside = (log_ns >= start_ns) & (log_ns <= end_ns)
            if inside.any():
                yield samples if inside.all() else samples.where(inside)
