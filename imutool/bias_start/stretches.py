"""Split samples into stretches at jumps of the clock, and leave out what is no measurement.

Filters cost by samples and their times stay small: a step of the stamps of more than `GAP_S`, or back by as much, begins a new
stretch, and counts as at most `MAX_GAP_S`.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from imutool.array_types import Bool, Float64, Int64, Vectors
from imutool.bias.model import GAP_S
from imutool.cleaning import rows
from imutool.cleaning.rules.saturation import at_limit
from imutool.cleaning.rules.stuck import STILL_GYRO, failed_gyro, repeated
from imutool.cleaning.samples import FrameCounts
from imutool.errors import ConfigError, DataError, LogError
from imutool.file_location import Location
from imutool.mcap_io.codec.decode import CLEAN_FIX, UNSET_FIX, ImuBatch
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read_recordings
from imutool.mcap_io.temperature import with_temperatures
from imutool.recording import GRAVITY_M_S2, Imu, Recording, nanoseconds, seconds
from imutool.recording.columns import MAX_GAP_S, jump_warnings, quantile
from imutool.units import MAX_RATE_RAD_S

MAX = np.array([MAX_RATE_RAD_S] * 3 + [1e6] * 3)  # rad/s and m/s²: no gyro or accelerometer measures more
MIN_FORCE_M_S2 = 1e-9  # on some axis: even in free fall a sensor's noise exceeds it
GRAVITY_RANGE = (0.4, 2.5)  # of the median specific force to gravity; a sensor in g has 0.1, a racing drone up to 2
MAX_STRETCHES = 1000  # that a report lists
AT_ONCE = 1 << 13  # samples
NOT_FINITE, OUT_OF_RANGE, ZERO_FORCE = "not_finite", "out_of_range", "zero_force"

logger = logging.getLogger(__name__)


class Stretch(NamedTuple):
    """Beginning of a stretch: its first stamp, and the step to it (negative: set back).

    On the filters' clock a step counts as at most `MAX_GAP_S`: beyond, the time says nothing about the bias.
    """

    start_ns: int
    step_s: float

    @property
    def jump(self) -> bool:
        """Whether the clock jumped, rather than paused."""
        return not 0.0 < self.step_s <= MAX_GAP_S


def unusual_gravity(accel: Vectors, bias: Float64[np.ndarray, "3"] | None = None) -> str:
    """Sentence on a specific force that is not gravity, by its median or its bias; else empty."""
    size, off = float(quantile(np.linalg.norm(accel, axis=1), 0.5)), 0.0 if bias is None else float(np.linalg.norm(bias))
    low, high = (share * GRAVITY_M_S2 for share in GRAVITY_RANGE)
    if not low <= size <= high:
        return f"the specific force has a median of {size:.3g} m/s², expected about {GRAVITY_M_S2:g}: check its unit"
    without = f"the accelerometer would have a bias of {off:.3g} m/s²: it does not measure gravity, or its unit is not m/s²"
    return without if off > GRAVITY_M_S2 - low else ""


def unmeasured(gyro: Vectors, accel: Vectors) -> Mapping[str, Bool[np.ndarray, " n"]]:
    """Samples that are no measurement: not finite, beyond any sensor, or without specific force."""
    u = np.concatenate([gyro, accel], axis=1)
    size = np.abs(u)
    not_finite = ~np.isfinite(u).all(axis=1)
    out_of_range = ~not_finite & (size > MAX).any(axis=1)
    zero = ~not_finite & ~out_of_range & (size[:, 3:].max(axis=1, initial=0.0) < MIN_FORCE_M_S2)
    return {NOT_FINITE: not_finite, OUT_OF_RANGE: out_of_range, ZERO_FORCE: zero}


def measured(gyro: Vectors, accel: Vectors) -> Bool[np.ndarray, " n"]:
    """Samples that are a measurement."""
    good = np.empty(len(gyro), bool)
    for first in range(0, len(gyro), AT_ONCE):
        rows = slice(first, first + AT_ONCE)
        good[rows] = ~np.logical_or.reduce(list(unmeasured(gyro[rows], accel[rows]).values()))
    return good


def measured_rows(imu: Imu) -> Imu:
    """Samples of an IMU that are a measurement; the IMU itself if all are."""
    good = measured(imu.gyro, imu.accel)
    return imu if good.all() else imu.rows(good)


def measured_imu(imu: Imu, where: str, *, free_fall: bool = False) -> Imu:
    """Samples of an IMU that are a measurement; a warning counts the others.

    Without specific force they are one in `free_fall` alone: a simulated sensor has no noise.

    Raises:
        DataError: fewer than two samples.
        ConfigError: fewer than two are left.
    """
    if len(imu) < 2:
        raise DataError(f"the IMU has {len(imu)} samples", where=where, expected="at least 2")
    if measured(imu.gyro, imu.accel).all():
        return imu
    reasons = {why: mask for why, mask in unmeasured(imu.gyro, imu.accel).items() if not (free_fall and why == ZERO_FORCE)}
    left_out = {reason: int(mask.sum()) for reason, mask in reasons.items() if mask.any()}
    if not left_out:
        return imu
    good = ~np.logical_or.reduce(list(reasons.values()))
    if good.sum() < 2:
        raise _nothing_measured(left_out, where)
    logger.warning("%s: samples that are no measurement are left out: %s", where, described(left_out))
    rows_left: Imu = imu.rows(good)
    return rows_left


def measured_recording(recording: Recording, *, free_fall: bool = False) -> Recording:
    """A recording without the IMU samples that are no measurement, or of a stuck sensor."""
    imu = measured_imu(recording.imu, recording.name, free_fall=free_fall)
    u = np.concatenate([imu.gyro, imu.accel], axis=1)
    repeats, failed = repeated(u), failed_gyro(imu.t_ns, u)
    for stuck, what in ((repeats, "samples that repeat the one before"), (failed & ~repeats, STILL_GYRO)):
        if stuck.any():
            text = f"{recording.name}: the sensor was stuck: %d {what} are left out, from %.3f s on"
            logger.warning(text, stuck.sum(), seconds(imu.t_ns[stuck][:1], int(imu.t_ns[0]))[0])
    return replace(recording, imu=imu.rows(~(repeats | failed)) if (repeats | failed).any() else imu)


def within_range(recording: Recording) -> Recording:
    """A recording without the samples whose gyro is saturated.

    A model would learn another scale from them. Those of the accelerometer stay, because the gyro's windows need them.
    """
    imu, text = recording.imu, "%s: %d of %d samples have the %s at the end of its range, %s"
    gyro, accel = (np.logical_or.reduce([at_limit(column) for column in x.T]) for x in (imu.gyro, imu.accel))
    if accel.any():
        logger.warning(text, recording.name, accel.sum(), len(imu), "accelerometer", "from which its model learns too little")
    if not gyro.any():
        return recording
    logger.warning(text, recording.name, gyro.sum(), len(imu), "gyro", "and are left out")
    return replace(recording, imu=imu.rows(~gyro))


def longest_stretch(recording: Recording) -> Recording:
    """Longest part of a recording on one setting of its clock."""
    longest = max(recording.between_jumps(), key=lambda part: len(part.imu))
    if longest is not recording:
        first_ns, last_ns = int(longest.imu.t_ns[0]), int(longest.imu.t_ns[-1])
        logger.warning("%s: only its longest stretch on one clock is used, from %d to %d ns", recording.name, first_ns, last_ns)
    return longest


def read_stretches(path: Location, *, imu: str | None = None, truth: str | None = None) -> list[Recording]:
    """Recordings of a log, one for each stretch between jumps of its clock.

    They are as `read` gives them, with scalars of one column and all temperatures, and the names NAME_1, NAME_2 and so on.

    Raises:
        ConfigError, LogError: as `read`.
    """
    with Log(path) as log:
        whole = with_temperatures(read_recordings(log, imu=imu, truth=truth, vectors=False), log)
    parts = [part for stretch in whole for part in stretch.between_jumps()]
    found = [part for part in parts if len(part.imu) > 1 and (any(map(len, part.truths.values())) or not part.truths)]
    if len(found) < len(parts) > 1:
        logger.warning("%s: %d stretches of its clock hold no poses, and are left out", path, len(parts) - len(found))
    named = [replace(part, name=f"{part.name}_{n}") for n, part in enumerate(found, 1)]
    return named if len(parts) > 1 and named else parts[:1]


class StretchClock:
    """Monotone time of samples, equal to their stamps up to the first jump."""

    def __init__(self) -> None:
        self.stretches: list[Stretch] = []
        self.count = 0
        self._last_ns: int | None = None
        self._removed_ns = 0

    def __call__(self, stamp_ns: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
        """Times (ns) of the next samples.

        Raises:
            LogError: a stamp that repeats, or goes back by less than `GAP_S`.
        """
        if not len(stamp_ns):
            return stamp_ns
        step = np.diff(stamp_ns, prepend=np.int64(stamp_ns[0] - 1 if self._last_ns is None else self._last_ns))
        gap_ns, max_ns = nanoseconds(GAP_S), nanoseconds(MAX_GAP_S)
        wrong = (step <= 0) & (step > -gap_ns)
        if wrong.any():
            row = int(np.argmax(wrong))
            how = "repeats" if step[row] == 0 else "goes back"
            raise LogError(
                f"message {self.count + row} has the stamp {stamp_ns[row]} ns, which {how}: "
                f"the message before has {stamp_ns[row] - step[row]} ns",
                expected="stamps that increase",
                fix=CLEAN_FIX if stamp_ns[row] else UNSET_FIX,
            )
        begins = np.flatnonzero((step > gap_ns) | (step < 0))
        self.stretches += [Stretch(int(stamp_ns[k]), float(step[k]) * 1e-9) for k in begins[:MAX_STRETCHES]]
        del self.stretches[MAX_STRETCHES:]
        self.count, self._last_ns = self.count + len(step), int(stamp_ns[-1])
        if not len(begins):  # as nearly always
            return np.asarray(stamp_ns - self._removed_ns)
        kept = np.where((step > max_ns) | (step < 0), max_ns, step)
        removed = self._removed_ns + np.cumsum(step - kept)
        self._removed_ns = int(removed[-1])
        return np.asarray(stamp_ns - removed)


@dataclass
class Sieve:
    """Samples of one IMU without those that are no measurement, with times of a `StretchClock`."""

    where: str = ""
    clock: StretchClock = field(default_factory=StretchClock)
    left_out: dict[str, int] = field(default_factory=dict)
    first_ns: int = 0  # stamp of the first sample that was left out
    frames: FrameCounts = field(default_factory=FrameCounts)

    def __call__(self, batch: ImuBatch) -> tuple[ImuBatch, Int64[np.ndarray, " n"]]:
        """Measured samples and their times (ns).

        Raises:
            LogError: a stamp that repeats, or goes back by less than `GAP_S`.
        """
        self.frames.add(batch)
        reasons = unmeasured(batch.gyro, batch.accel)
        bad = np.logical_or.reduce(list(reasons.values()))
        if bad.any():
            self.first_ns = self.first_ns if self.left_out else int(batch.stamp_ns[np.argmax(bad)])
            for reason, mask in reasons.items():
                if mask.any():
                    self.left_out[reason] = self.left_out.get(reason, 0) + int(mask.sum())
            batch = rows(batch, ~bad)
        return batch, self.clock(batch.stamp_ns)

    def refuse_nothing(self) -> None:
        """Refuse an IMU of which next to nothing is left.

        Raises:
            ConfigError: fewer than two measured samples, others were left out.
        """
        if self.left_out and self.clock.count < 2:
            raise _nothing_measured(self.left_out, self.where)

    def warnings(self) -> Iterator[str]:
        """Defects in words: samples that were left out, and jumps of the clock."""
        if self.left_out:
            total = sum(self.left_out.values())
            kinds = described(self.left_out)
            yield f"{total} samples are no measurement and left out ({kinds}), the first at {self.first_ns} ns"
        yield from self.frames.words()
        yield from jump_warnings([stretch for stretch in self.clock.stretches if stretch.jump])

    def record(self) -> dict[str, str]:
        """Entries of the log's metadata; none for a log without defects."""
        out = {"left_out": ", ".join(f"{reason}: {count}" for reason, count in self.left_out.items())} if self.left_out else {}
        if self.clock.stretches:
            out["stretches"] = ", ".join(f"{start_ns}: {step_s:.9g} s" for start_ns, step_s in self.clock.stretches)
        return out


def _nothing_measured(left_out: Mapping[str, int], where: str) -> ConfigError:
    return ConfigError(
        f"no sample is a measurement ({described(left_out)})",
        where=where,
        expected="finite samples with a specific force",
        fix="Look at the sensor with imutool info, or name another IMU in `imus`",
    )


WORDS = {
    NOT_FINITE: "not finite",
    OUT_OF_RANGE: "beyond any sensor",
    ZERO_FORCE: "without any specific force",
}


def described(left_out: Mapping[str, int]) -> str:
    """Left-out samples in words."""
    return ", ".join(f"{count} {WORDS[reason]}" for reason, count in left_out.items())
