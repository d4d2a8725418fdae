"""Fitness of a model for a live stream: of its first samples, later, and at its end."""

from __future__ import annotations

import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from imutool.bias.log_binding import at_rate
from imutool.bias.model import BiasModel
from imutool.bias_start import Fitness
from imutool.bias_start.fitness import CHECKED_S, judge
from imutool.bias_start.initial_bias import InitialBias, model_samples
from imutool.bias_start.stretches import measured
from imutool.errors import DataError
from imutool.log_info.convention_report import warn_of_conventions
from imutool.recording import Imu
from imutool.viewing.stream.samples import Sample

STREAM = "the stream"  # in messages
JUDGED_S = (10.0, 30.0, CHECKED_S)  # after which the samples are judged while the stream goes on
SWITCH_S = 0.0005  # that another thread may keep the interpreter: Python's own 5 ms are the whole delay allowed


def imu_of(samples: Sequence[Sample]) -> Imu:
    """Measured samples in the order of their stamps; of those with one stamp the last."""
    ordered = sorted({sample.stamp_ns: sample for sample in samples}.values())
    t_ns = np.array([sample.stamp_ns for sample in ordered], dtype=np.int64)
    gyro, accel = (np.array([getattr(sample, name) for sample in ordered]).reshape(-1, 3) for name in ("gyro", "accel"))
    good = measured(gyro, accel)
    return Imu(t_ns[good], gyro[good], accel[good])


def at_rate_of(imu: Imu, model: BiasModel, *, force: bool) -> BiasModel:
    """Model at the rate of the first samples.

    Raises:
        DataError: none is a measurement, or stamps that are not in nanoseconds.
        ModelError: as `at_rate`.
    """
    if not len(imu):
        expected = "finite samples with a specific force"
        raise DataError("none of the first samples is a measurement", where=STREAM, expected=expected)
    if len(imu) < 2:
        return model
    imu.check_rate(STREAM)
    return at_rate(model, 1.0 / imu.period_s, STREAM, imu.t_ns, force=force)


@dataclass
class StreamFit:
    """Keeps the first `CHECKED_S` seconds of a stream, and judges the model by them."""

    model: BiasModel
    start: InitialBias
    first: Imu
    force: bool = False
    found: Fitness | None = None
    _kept: list[Sample] = field(default_factory=list)
    _thread: threading.Thread | None = None
    _judged: int = 0  # of `JUDGED_S`

    def __post_init__(self) -> None:
        """Judge the first samples.

        Raises:
            ModelError: the model is unfit, and `force` is not given.
        """
        self._judge(self.first, force=self.force)

    def add(self, sample: Sample) -> None:
        """Keep a sample; at some times a thread judges all of them."""
        seconds = (sample.stamp_ns - int(self.first.t_ns[0])) * 1e-9
        if 0.0 <= seconds < CHECKED_S:
            self._kept.append(sample)
        if self._judged < len(JUDGED_S) and seconds >= JUDGED_S[self._judged]:
            self._judged += 1
            if self._thread is None or not self._thread.is_alive():
                self._thread = threading.Thread(target=self._judge_kept, args=(list(self._kept),), daemon=True)
                self._thread.start()

    def end(self) -> Fitness | None:
        """Fitness by all samples that were kept."""
        if self._thread is not None:
            self._thread.join()
        self._judge_kept(self._kept)
        return self.found

    def _judge_kept(self, samples: Sequence[Sample]) -> None:
        before = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_S)
        try:
            if len(imu := imu_of(samples)) >= len(self.first):
                self._judge(imu, force=True)
        finally:
            sys.setswitchinterval(before)

    def _judge(self, imu: Imu, *, force: bool) -> None:
        """Judge some samples; only a model that becomes unfit is said at once, as a doubt may be for want of samples."""
        known, self.found = self.found, judge(self.model, self.start, [model_samples(self.model, imu)], {})
        if self.found.verdict == "unfit" and (known is None or known.verdict != "unfit"):
            warn_of_conventions(imu, None, STREAM)
            self.found.report(str(self.model.card.get("name", self.model.method)), STREAM, force=force)
