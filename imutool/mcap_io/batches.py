"""Batches of messages as a log gives them, and what is refused of them: numbers that are none, stamps that do not increase."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64, UInt32

from imutool.errors import LogError

LEAVE_OUT = "See what is wrong with imutool clean LOG, and leave it out with imutool debias --clean"


class ImuBatch(NamedTuple):
    """Consecutive messages of one IMU; times in ns, rad/s, m/s²."""

    log_time: Int64[np.ndarray, " n"]
    publish_time: Int64[np.ndarray, " n"]
    sequence: UInt32[np.ndarray, " n"]
    stamp_ns: Int64[np.ndarray, " n"]
    gyro: Float64[np.ndarray, "n 3"]
    accel: Float64[np.ndarray, "n 3"]
    frame_id: str


class PoseBatch(NamedTuple):
    """Consecutive poses of one frame in another; metres, quaternions as they stand in the log."""

    log_time: Int64[np.ndarray, " n"]
    publish_time: Int64[np.ndarray, " n"]
    sequence: UInt32[np.ndarray, " n"]
    stamp_ns: Int64[np.ndarray, " n"]
    p_wb: Float64[np.ndarray, "n 3"]
    q_wb_wxyz: Float64[np.ndarray, "n 4"]
    frame_id: str
    child_frame_id: str


class ScalarBatch(NamedTuple):
    """Consecutive messages of a numeric topic; `stamp_ns` is the log time where the message has no header."""

    log_time: Int64[np.ndarray, " n"]
    publish_time: Int64[np.ndarray, " n"]
    sequence: UInt32[np.ndarray, " n"]
    stamp_ns: Int64[np.ndarray, " n"]
    values: Float64[np.ndarray, "n k"]
    frame_id: str


def finite(sequence: UInt32[np.ndarray, " n"], **fields: Float64[np.ndarray, "n _"]) -> None:
    """Refuses NaN and infinity, naming the message."""
    for name, values in fields.items():
        good = np.isfinite(values).all(axis=1)
        if not good.all():
            row = int(np.argmin(good))
            raise LogError(
                f"message {sequence[row]} has {name} {values[row].tolist()}",
                expected="finite numbers",
                fix="Cut the log before or after it",
            )


@dataclass(slots=True)
class Clock:
    """Refuses stamps that repeat or go back, across batches."""

    count: int = 0
    last: int | None = None

    def check(self, stamp_ns: Int64[np.ndarray, " n"], sequence: UInt32[np.ndarray, " n"]) -> None:
        """Takes in the next stamps.

        Raises:
            LogError: one does not come after the one before it; the message names the message and both stamps.
        """
        if not len(stamp_ns):
            return
        before = np.concatenate([[stamp_ns[0] - 1 if self.last is None else self.last], stamp_ns[:-1]])
        bad = stamp_ns <= before
        if bad.any():
            row = int(np.argmax(bad))
            how = "repeats" if stamp_ns[row] == before[row] else "goes back"
            raise LogError(
                f"message {self.count + row} (sequence {sequence[row]}) has the stamp {stamp_ns[row]} ns, which {how}: "
                f"the message before has {before[row]} ns",
                expected="stamps that increase",
            )
        self.count, self.last = self.count + len(stamp_ns), int(stamp_ns[-1])

    def take(self, batch: ImuBatch) -> None:
        """Takes in the next samples of an IMU.

        Raises:
            LogError: NaN, infinity, or a stamp that does not come after the one before it.
        """
        try:
            finite(batch.sequence, angular_velocity=batch.gyro, linear_acceleration=batch.accel)
            self.check(batch.stamp_ns, batch.sequence)
        except LogError as error:
            raise LogError(error.what, expected=error.expected, fix=LEAVE_OUT) from error
