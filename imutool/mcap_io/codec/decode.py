"""Decode messages into columns of numbers and stamps, and check these.

Quaternions are xyzw in messages and wxyz in memory; here they change.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from imutool.array_types import Float64, Int64, UInt8, UInt32
from imutool.errors import LogError
from imutool.mcap_io.codec.messages import Rows
from imutool.mcap_io.codec.schemas import (
    ACCEL,
    GYRO,
    IMAGE,
    IMU,
    NS_PER_S,
    POSE,
    POSITION,
    SHAPES,
    TWIST,
    XYZW,
    Layout,
    layout_of,
    runs,
)

_WXYZ_FROM_XYZW = [3, 0, 1, 2]
LOST_NORM = 0.5  # of a quaternion; below, it is none
CUT, MAX_REPEATED = "Cut the log before or after it", 0.2  # share of stamps that repeat; more come in batches
CLEAN_FIX = "imutool info LOG and clean LOG show what is wrong; imutool debias --clean LOG OUT leaves it out on TOPIC/debiased"
RESTAMP = "imutool convert LOG OUT --restamp"
UNSET_FIX = f"A stamp of 0 is not set: {RESTAMP} takes the log times"


class ImuColumns(NamedTuple):
    """Consecutive Imu messages of one frame: stamps in ns, rad/s, m/s²."""

    stamp_ns: Int64[np.ndarray, " n"]
    gyro: Float64[np.ndarray, "n 3"]
    accel: Float64[np.ndarray, "n 3"]
    frame_id: str


class PoseColumns(NamedTuple):
    """Consecutive poses of one frame in another; `child_frame_id` may be empty."""

    stamp_ns: Int64[np.ndarray, " n"]
    p_wb: Float64[np.ndarray, "n 3"]
    q_wb_wxyz: Float64[np.ndarray, "n 4"]
    frame_id: str
    child_frame_id: str


class ScalarColumns(NamedTuple):
    """Consecutive numbers; `stamp_ns` is None for a message without a header."""

    stamp_ns: Int64[np.ndarray, " n"] | None
    values: Float64[np.ndarray, "n k"]
    frame_id: str


class TwistColumns(NamedTuple):
    """Consecutive TwistWithCovarianceStamped of one frame.

    `variance` is of angular then linear; a message has them the other way round.
    """

    stamp_ns: Int64[np.ndarray, " n"]
    angular: Float64[np.ndarray, "n 3"]
    linear: Float64[np.ndarray, "n 3"]
    variance: Float64[np.ndarray, "n 6"]
    frame_id: str


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

    def tracked(self) -> PoseBatch:
        """Poses that are one: tracking that lost the body writes NaN, or a quaternion of zero."""
        good = np.isfinite(self.p_wb).all(axis=1) & (np.linalg.norm(self.q_wb_wxyz, axis=1) > LOST_NORM)
        return self if good.all() else self._replace(**{name: getattr(self, name)[good] for name in self._fields[:6]})


class ScalarBatch(NamedTuple):
    """Consecutive messages of a numeric topic.

    `stamp_ns` is the log time where the message has no header.
    """

    log_time: Int64[np.ndarray, " n"]
    publish_time: Int64[np.ndarray, " n"]
    sequence: UInt32[np.ndarray, " n"]
    stamp_ns: Int64[np.ndarray, " n"]
    values: Float64[np.ndarray, "n k"]
    frame_id: str


def _stamp(rows: UInt8[np.ndarray, "n L"], layout: Layout, which: int = 0) -> Int64[np.ndarray, " n"]:
    at = layout.stamps[which]
    seconds = rows[:, at : at + 4].view(layout.order + layout.seconds)[:, 0].astype(np.int64)
    return seconds * NS_PER_S + rows[:, at + 4 : at + 8].view(layout.order + "u4")[:, 0].astype(np.int64)


def _numbers(rows: UInt8[np.ndarray, "n L"], layout: Layout, columns: slice, which: int = 0) -> Float64[np.ndarray, "n k"]:
    at = layout.numbers[which][0] + 8 * columns.start
    return rows[:, at : at + 8 * (columns.stop - columns.start)].view(layout.order + "f8").astype(np.float64)


def _one_layout(rows: UInt8[np.ndarray, "n L"], schema_name: str, encoding: str) -> Layout:
    every = list(runs(rows, schema_name, encoding))
    if len(every) != 1:
        raise LogError(f"{len(every)} different frames in one batch", expected="one; split it with `runs`")
    return every[0][1]


def decode_imu(rows: UInt8[np.ndarray, "n L"], encoding: str = "cdr", layout: Layout | None = None) -> ImuColumns:
    """Columns of Imu messages that share one layout (`schemas.runs` splits them by layout).

    Raises:
        LogError: no rows, more than one layout, a payload too short, an unknown encoding.
    """
    layout = layout or _one_layout(rows, IMU, encoding)
    gyro, accel = _numbers(rows, layout, GYRO), _numbers(rows, layout, ACCEL)
    return ImuColumns(_stamp(rows, layout), gyro, accel, layout.texts[0])


def decode_poses(
    rows: UInt8[np.ndarray, "n L"], schema_name: str = POSE, encoding: str = "cdr", layout: Layout | None = None
) -> list[PoseColumns]:
    """Columns of PoseStamped, Odometry, TransformStamped or TFMessage, per transform.

    Raises:
        LogError: no rows, more than one layout, a payload too short, an unknown encoding.
    """
    layout = layout or _one_layout(rows, schema_name, encoding)
    named = 2 if "text" in SHAPES[schema_name] else 1
    found = []
    for which in range(len(layout.stamps)):
        names = layout.texts[named * which : named * (which + 1)]
        q_wxyz = _numbers(rows, layout, XYZW, which)[:, _WXYZ_FROM_XYZW]
        p_wb = _numbers(rows, layout, POSITION, which)
        child = names[1] if named == 2 else ""
        found.append(PoseColumns(_stamp(rows, layout, which), p_wb, np.ascontiguousarray(q_wxyz), names[0], child))
    return found


def decode_scalars(
    rows: UInt8[np.ndarray, "n L"], schema_name: str, encoding: str = "cdr", layout: Layout | None = None
) -> ScalarColumns:
    """Columns of Float64 (one) or Vector3Stamped (three).

    Raises:
        LogError: no rows, more than one layout, a payload too short, an unknown encoding.
    """
    layout = layout or _one_layout(rows, schema_name, encoding)
    stamp_ns = _stamp(rows, layout) if layout.stamps else None
    frame_id = layout.texts[0] if layout.texts else ""
    return ScalarColumns(stamp_ns, _numbers(rows, layout, slice(0, layout.numbers[0][1])), frame_id)


def decode_twist(rows: UInt8[np.ndarray, "n L"], encoding: str = "cdr", layout: Layout | None = None) -> TwistColumns:
    """Columns of TwistWithCovarianceStamped.

    Raises:
        LogError: no rows, more than one layout, a payload too short, an unknown encoding.
    """
    layout = layout or _one_layout(rows, TWIST, encoding)
    linear, angular = _numbers(rows, layout, slice(0, 3)), _numbers(rows, layout, slice(3, 6))
    variance = _numbers(rows, layout, slice(6, 42))[:, ::7]  # the diagonal, of linear then angular
    return TwistColumns(_stamp(rows, layout), angular, linear, np.roll(variance, 3, axis=1), layout.texts[0])


def decode_image(message: bytes, encoding: str = "cdr") -> tuple[int, str, bytes]:
    """Stamp in ns, format and the encoded image of one CompressedImage message.

    Raises:
        LogError: the payload is too short, or its encoding is not known.
    """
    layout = layout_of(IMAGE, encoding, message=message)
    assert layout.data is not None, "an image has bytes"
    row = np.frombuffer(message, np.uint8)[None, :]
    at, length = layout.data
    return int(_stamp(row, layout)[0]), layout.texts[1], message[at : at + length]


def named(batch: Rows | ImuBatch, row: int) -> str:
    """A message by sequence and log time: many recorders leave the sequence at 0."""
    return f"message {batch.sequence[row]} (log time {batch.log_time[row] * 1e-9:.3f} s)"


def check_finite(batch: Rows | ImuBatch, fix: str = CUT, **fields: Float64[np.ndarray, "n _"]) -> None:
    """Refuses NaN and infinity, naming the message (LogError)."""
    for name, values in fields.items():
        if not (good := np.isfinite(values).all(axis=1)).all():
            row = int(np.argmin(good))
            raise LogError(f"{named(batch, row)} has {name} {values[row].tolist()}", expected="finite numbers", fix=fix)


@dataclass(slots=True)
class StampCheck:
    """Refuses stamps that repeat or go back, across batches."""

    count: int = 0
    last: int | None = None
    fix: str = ""  # what to do about it

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
            how, same = "repeats" if stamp_ns[row] == before[row] else "goes back", (stamp_ns == before).mean()
            fix = f"{RESTAMP} spreads samples that share a stamp" if self.fix and same > MAX_REPEATED else self.fix
            what = f"message {self.count + row} (sequence {sequence[row]}) has the stamp {stamp_ns[row]} ns, which {how}: "
            what = f"{what}the message before has {before[row]} ns"
            raise LogError(what, expected="stamps that increase", fix=fix if stamp_ns[row] else UNSET_FIX)
        self.count, self.last = self.count + len(stamp_ns), int(stamp_ns[-1])
