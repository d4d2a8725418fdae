"""Debias a live stream one sample at a time, show it, and measure the delay of each sample."""

from __future__ import annotations

import logging
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import numpy as np

from imutool.bias.log_binding import started_at, without_drift
from imutool.bias.model import GAP_S, BiasModel
from imutool.bias_start import Fitness
from imutool.bias_start.bias_at_rest import auto
from imutool.bias_start.correction import OnlineDebiaser
from imutool.bias_start.earlier_load import after_load, with_earlier_load
from imutool.bias_start.initial_bias import model_samples
from imutool.bias_start.stretches import measured
from imutool.debiasing import DebiasedBlock
from imutool.errors import DataError
from imutool.mcap_io.codec.decode import ImuBatch
from imutool.recording.columns import clock_jumps, jump_warnings
from imutool.units import SENSORS
from imutool.viewing.stream import Delay, StreamStatistics
from imutool.viewing.stream.samples import MAX_NS, Malformed, Sample
from imutool.viewing.stream.sources import Samples, timely
from imutool.viewing.stream.stream_fit import STREAM, SWITCH_S, StreamFit, at_rate_of, imu_of

START_S = 2.0  # of the stream, from which the initial bias is taken
BATCH_S = 0.1  # shown together
MAX_WAITING = 2048  # batches, 3 minutes of a stream and some 100 MB at 1 kHz: of more that nobody draws, some are lost
MAX_FIRST = 1 << 16  # samples before the start, where the clock jumps again and again
MAX_DELAYS = 1 << 20  # of which percentiles are taken: 17 minutes at 1 kHz, then a random choice

logger = logging.getLogger("imutool")
Corrected = Callable[[Sample, np.ndarray, np.ndarray], None]
Show = Callable[[DebiasedBlock], None]


def run(
    source: Samples,
    model: BiasModel,
    malformed: Malformed,
    *,
    show: Show | None = None,
    each: Corrected | None = None,
    seconds: float | None = None,
    force: bool = False,
) -> StreamStatistics:
    """Debias a stream until it ends, `seconds` have passed, or Ctrl-C or SIGTERM comes.

    The initial bias is that of the stop in the first two seconds, else the model's prior (`bias_start.bias_at_rest.auto`); the
    samples until then are corrected late and are not counted in the delay.

    Raises:
        DataError: an untrained model and no rest at the start, or no samples.
        ModelError: a model that does not fit the first samples, without `force`, or was trained at another rate.
    """
    session = _Session(model, each, force)
    with _showing(show) as batches:
        try:
            for found in timely(source, seconds, malformed):
                session.add(found, batches)
        except (KeyboardInterrupt, SystemExit):  # Ctrl-C; `timeout` or a service: what came so far is kept
            pass
        session.end(batches)
    return session.statistics(malformed, batches.lost)


class _Session:
    """State of a stream."""

    def __init__(self, model: BiasModel, each: Corrected | None, force: bool) -> None:
        self._model, self._each, self._force = model, each, force
        self._fit: StreamFit | None = None
        self._fitness: Fitness | None = None
        self._online: OnlineDebiaser | None = None
        self._how, self._std = "", np.zeros(6)
        self._first: list[Sample] = []
        self._stretches = [0]  # of the first samples: where each begins; the clock jumps between them
        self._batch: list[tuple[Sample, np.ndarray]] = []
        self._delays: list[float] = []
        self._random = np.random.default_rng(0)
        self._begin_ns = self._last_ns = -1
        self._gap_ns = 0  # in which no sample came: the rate is that of the others
        self._ready_s = np.inf  # time of arrival from which on delays count: what came before waited for the start
        self._samples = self._gaps = self._out_of_order = self._not_measured = 0
        self._bias = np.zeros(6)

    def add(self, found: Sample, batches: _Batches) -> None:
        """Correct a sample, or keep it until the initial bias is known."""
        jumped = self._count(found)
        if self._online is not None:
            self._correct(found, batches)
            if found.arrival_s >= self._ready_s:
                self._add_delay(time.perf_counter() - found.arrival_s)
            return
        if jumped and self._first:
            self._stretches.append(len(self._first))
        self._first.append(found)
        seconds = abs(found.stamp_ns - self._first[self._stretches[-1]].stamp_ns) * 1e-9
        if seconds >= START_S or len(self._first) >= MAX_FIRST:
            self._start(batches)

    def _add_delay(self, delay_s: float) -> None:
        """Keep a delay; of very many a random choice (reservoir sampling)."""
        if len(self._delays) < MAX_DELAYS:
            self._delays.append(delay_s)
        elif (place := int(self._random.integers(self._samples))) < MAX_DELAYS:
            self._delays[place] = delay_s

    def end(self, batches: _Batches) -> None:
        """Correct what a short stream has left."""
        if self._online is None and self._first:
            self._start(batches)
        batches.put(self._block())
        self._fitness = None if self._fit is None else self._fit.end()

    def statistics(self, malformed: Malformed, lost: int) -> StreamStatistics:
        """Statistics so far.

        Raises:
            DataError: no samples.
        """
        if not self._samples:
            raise DataError(f"it sent no samples{malformed}", where=STREAM, expected='{"t_ns": …, "gyro": […], "accel": […]}')
        steps, steady_ns = self._samples - 1 - self._gaps, self._last_ns - self._begin_ns - self._gap_ns
        return StreamStatistics(
            samples=self._samples,
            seconds=(self._last_ns - self._begin_ns) * 1e-9,
            rate_hz=steps / (steady_ns * 1e-9) if steady_ns > 0 else 0.0,
            delay_ms=self._delay(),
            start=self._how,
            fit=self._fitness,
            gaps=self._gaps,
            out_of_order=self._out_of_order,
            not_measured=self._not_measured,
            malformed=malformed.count,
            not_shown=lost,
            gyro_bias=self._bias[:3].tolist(),
            accel_bias=self._bias[3:].tolist(),
        )

    def _delay(self) -> Delay | None:
        """Percentiles of the delays; None where the stream ended before the start."""
        if not self._delays:
            return None
        return Delay(*(np.percentile(self._delays, [50.0, 99.0, 100.0]) * 1e3).tolist())

    def _count(self, found: Sample) -> bool:
        """Count a sample, and say whether the clock has jumped to it."""
        step_ns = found.stamp_ns - self._last_ns
        usual = not self._samples or 0 < step_ns <= GAP_S * 1e9
        jumps = [] if usual else clock_jumps(np.array([self._last_ns, found.stamp_ns]))
        if not self._samples or jumps:
            self._begin_ns += found.stamp_ns - self._last_ns  # a jump takes no time
            self._gaps += len(jumps)
            for warning in jump_warnings(jumps):
                logger.warning("%s", warning)
        elif step_ns <= 0:
            self._out_of_order += 1
        elif step_ns > GAP_S * 1e9:
            self._gaps, self._gap_ns = self._gaps + 1, self._gap_ns + step_ns
        self._last_ns = max(self._last_ns, found.stamp_ns) if self._samples and not jumps else found.stamp_ns
        self._samples += 1
        return bool(jumps)

    def _start(self, batches: _Batches) -> None:
        """Take the initial bias from the first samples without a jump of the clock, and correct all.

        Raises:
            DataError: an untrained model, and no rest.
        """
        run = max(
            (slice(*ends) for ends in pairwise([*self._stretches, len(self._first)])), key=lambda run: run.stop - run.start
        )
        seen = imu_of(self._first[run])
        self._model = at_rate_of(seen, self._model, force=self._force)
        warm = sorted((found.stamp_ns, float(t)) for found in self._first[run] if (t := found.temperature) is not None)
        first_ns, last_ns = int(seen.t_ns[0]), int(seen.t_ns[-1])
        model = started_at(self._model, warm, first_ns, last_ns)
        model = with_earlier_load(model, [model_samples(model, seen)], first_ns)
        try:
            start = auto(model, without_drift(model, seen))
        except DataError as error:
            fix = f"Leave the sensor still for {START_S:g} s when the stream begins, or choose a trained model"
            span_s = 1e-9 * (last_ns - first_ns)
            ended = f"it ended after {len(seen)} sample{'s' * (len(seen) > 1)}, {span_s:.2g} s"
            raise DataError("it does not start at rest" if span_s > 0.9 * START_S else ended, where=STREAM, fix=fix) from error
        self._fit = StreamFit(model, start, seen, self._force)
        self._how, self._std = start.how, start.std
        self._online = OnlineDebiaser(after_load(self._model, model.load_before), start)
        for sample in self._first:
            self._correct(sample, batches)
        self._first = []
        self._ready_s = time.perf_counter()

    def _correct(self, found: Sample, batches: _Batches) -> None:
        assert self._online is not None
        u = np.array([found.gyro, found.accel])
        rate, force, bias = self._online(found.stamp_ns, u[0], u[1], found.temperature)
        self._bias = bias
        assert self._fit is not None
        self._fit.add(found)
        if self._each is not None:
            self._each(found, rate, force)
        self._batch.append((found, bias))
        if abs(found.stamp_ns - self._batch[0][0].stamp_ns) >= BATCH_S * 1e9:
            batches.put(self._block())

    def _block(self) -> list[tuple[Sample, np.ndarray, np.ndarray]]:
        """Measured samples of the batch with bias and deviation."""
        good = measured(*(np.array([getattr(found, name) for found, _ in self._batch]).reshape(-1, 3) for name in SENSORS))
        self._not_measured += int((~good).sum())
        block = [(found, bias, self._std) for (found, bias), kept in zip(self._batch, good.tolist(), strict=True) if kept]
        self._batch = []
        return block


class _Batches:
    """Queue of batches for the viewer's thread; batches that it has no time for are lost and counted."""

    def __init__(self) -> None:
        self._queue: queue.Queue[list[Any] | None] = queue.Queue(MAX_WAITING)
        self.lost = 0
        self.used = False

    def put(self, batch: list[Any]) -> None:
        """Hand a batch over without waiting."""
        try:
            if self.used and batch:
                self._queue.put_nowait(batch)
        except queue.Full:
            self.lost += len(batch)

    def finish(self) -> None:
        """Say that no more come."""
        self._queue.put(None)

    def __iter__(self) -> Iterator[list[Any]]:
        while (batch := self._queue.get()) is not None:
            yield batch


@contextmanager
def _showing(show: Show | None) -> Iterator[_Batches]:
    """Thread that shows batches, so that no sample waits for a viewer."""
    batches = _Batches()
    if show is None:
        yield batches
        return
    batches.used = True
    before = sys.getswitchinterval()
    thread = threading.Thread(target=_show_all, args=(batches, show), daemon=True)
    sys.setswitchinterval(SWITCH_S)
    thread.start()
    try:
        yield batches
    finally:
        batches.finish()
        thread.join()
        sys.setswitchinterval(before)


def _show_all(batches: Iterable[list[tuple[Sample, np.ndarray, np.ndarray]]], show: Show) -> None:
    """Show each batch; samples that are not newer than those before are left out."""
    last_ns, count = -MAX_NS - 1, 0
    for batch in batches:
        rows = []
        for row in batch:
            if row[0].stamp_ns > last_ns:
                rows.append(row)
                last_ns = row[0].stamp_ns
        if not rows:
            continue
        t_ns = np.array([found.stamp_ns for found, _, _ in rows], dtype=np.int64)
        gyro, accel = (np.array([getattr(found, name) for found, _, _ in rows]) for name in ("gyro", "accel"))
        sequence = np.arange(count, count + len(rows), dtype=np.uint32)
        count += len(rows)
        imu = ImuBatch(t_ns, t_ns, sequence, t_ns, gyro, accel, "imu")
        show(DebiasedBlock("/imu", imu, np.array([bias for _, bias, _ in rows]), np.array([std for _, _, std in rows])))
