"""Encode columns as ROS 2 messages, in one numpy pass for many messages.

Quaternions are wxyz in memory and xyzw in messages; here they change.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from imutool.array_types import Float64, Int64, UInt8
from imutool.errors import DataError
from imutool.mcap_io.codec.schemas import (
    ACCEL,
    ACCEL_COVARIANCE,
    FLOAT,
    GYRO,
    GYRO_COVARIANCE,
    IMAGE,
    IMU,
    NS_PER_S,
    ORIENTATION,
    ORIENTATION_COVARIANCE,
    POSE,
    POSITION,
    TF,
    TWIST,
    VECTOR3,
    XYZW,
    Layout,
    layout_of,
)

NO_ORIENTATION = -1.0  # sensor_msgs/Imu: element 0 of a covariance of something that was not measured
_XYZW_FROM_WXYZ = [1, 2, 3, 0]


@lru_cache  # a live stream is written message by message, in few frames
def _layout(kind: str, *texts: str) -> Layout:
    return layout_of(kind, "cdr", texts=texts)


def _blank(count: int, layout: Layout) -> UInt8[np.ndarray, "n L"]:
    """Messages with every byte filled in that they share."""
    message = np.zeros(layout.size, np.uint8)
    for at, value in layout.constants:
        message[at : at + len(value)] = np.frombuffer(value, np.uint8)
    return np.repeat(message[None, :], count, axis=0)


def _put_stamp(rows: UInt8[np.ndarray, "n L"], layout: Layout, stamp_ns: Int64[np.ndarray, " n"], which: int = 0) -> None:
    if len(stamp_ns) and not -(2**31) <= stamp_ns.min() // NS_PER_S <= stamp_ns.max() // NS_PER_S < 2**31:
        raise DataError(
            f"stamps run from {stamp_ns.min()} to {stamp_ns.max()} ns",
            expected="seconds that fit 32 bits, as ROS 2 stores them",
        )
    at = layout.stamps[which]
    seconds = stamp_ns // NS_PER_S
    rows[:, at : at + 4].view("<i4")[:, 0] = seconds
    rows[:, at + 4 : at + 8].view("<u4")[:, 0] = stamp_ns - seconds * NS_PER_S


def _numbers_of(rows: UInt8[np.ndarray, "n L"], layout: Layout, which: int = 0) -> Float64[np.ndarray, "n k"]:
    at, count = layout.numbers[which]
    return rows[:, at : at + 8 * count].view("<f8")


def _stamped(
    kind: str, stamp_ns: Int64[np.ndarray, " n"], frame_id: str
) -> tuple[UInt8[np.ndarray, "n L"], Float64[np.ndarray, "n k"]]:
    """Messages of one frame with their stamps, and their numbers as a view."""
    layout = _layout(kind, frame_id)
    rows = _blank(len(stamp_ns), layout)
    _put_stamp(rows, layout, stamp_ns)
    return rows, _numbers_of(rows, layout)


def encode_imu(
    stamp_ns: Int64[np.ndarray, " n"],
    gyro: Float64[np.ndarray, "n 3"],
    accel: Float64[np.ndarray, "n 3"],
    frame_id: str,
    gyro_covariance: Float64[np.ndarray, "9"] | Float64[np.ndarray, "n 9"] | None = None,
    accel_covariance: Float64[np.ndarray, "9"] | Float64[np.ndarray, "n 9"] | None = None,
) -> UInt8[np.ndarray, "n L"]:
    """One Imu message per row.

    Orientation is (0, 0, 0, 1) and marked as not measured; covariances, row-major, are one
    for all or one per row, and all zeros ("unknown" in the message's definition) where not given.

    Raises:
        DataError: a stamp beyond the 32-bit seconds of ROS 2.
    """
    rows, numbers = _stamped(IMU, stamp_ns, frame_id)
    numbers[:, ORIENTATION.stop - 1] = 1.0
    numbers[:, ORIENTATION_COVARIANCE.start] = NO_ORIENTATION
    numbers[:, GYRO], numbers[:, ACCEL] = gyro, accel
    if gyro_covariance is not None:
        numbers[:, GYRO_COVARIANCE] = gyro_covariance
    if accel_covariance is not None:
        numbers[:, ACCEL_COVARIANCE] = accel_covariance
    return rows


def encode_pose(
    stamp_ns: Int64[np.ndarray, " n"],
    p_wb: Float64[np.ndarray, "n 3"],
    q_wb_wxyz: Float64[np.ndarray, "n 4"],
    frame_id: str,
) -> UInt8[np.ndarray, "n L"]:
    """One PoseStamped message per row.

    Raises:
        DataError: a stamp beyond the 32-bit seconds of ROS 2.
    """
    rows, numbers = _stamped(POSE, stamp_ns, frame_id)
    numbers[:, POSITION], numbers[:, XYZW] = p_wb, q_wb_wxyz[:, _XYZW_FROM_WXYZ]
    return rows


def encode_transform(
    stamp_ns: Int64[np.ndarray, " n"],
    p_wb: Float64[np.ndarray, "n 3"],
    q_wb_wxyz: Float64[np.ndarray, "n 4"],
    frame_id: str,
    child_frame_id: str,
) -> UInt8[np.ndarray, "n L"]:
    """One TFMessage per row, with one transform in it.

    Raises:
        DataError: a stamp beyond the 32-bit seconds of ROS 2.
    """
    values = np.concatenate([p_wb, q_wb_wxyz], axis=1)
    return encode_transforms(stamp_ns[:, None], values[:, None], [(frame_id, child_frame_id)])


def encode_transforms(
    stamp_ns: Int64[np.ndarray, "n k"], values: Float64[np.ndarray, "n k 7"], frames: Sequence[tuple[str, str]]
) -> UInt8[np.ndarray, "n L"]:
    """One TFMessage per row with a transform for each parent and child.

    `values` are position and quaternion wxyz.

    Raises:
        DataError: a stamp beyond the 32-bit seconds of ROS 2.
    """
    layout = layout_of(TF, "cdr", texts=[name for pair in frames for name in pair])
    rows = _blank(len(stamp_ns), layout)
    for which in range(len(frames)):
        _put_stamp(rows, layout, stamp_ns[:, which], which)
        numbers = _numbers_of(rows, layout, which)
        numbers[:, POSITION], numbers[:, XYZW] = values[:, which, :3], values[:, which, 3:][:, _XYZW_FROM_WXYZ]
    return rows


def encode_vector3(
    stamp_ns: Int64[np.ndarray, " n"], vector: Float64[np.ndarray, "n 3"], frame_id: str
) -> UInt8[np.ndarray, "n L"]:
    """One Vector3Stamped message per row.

    Raises:
        DataError: a stamp beyond the 32-bit seconds of ROS 2.
    """
    rows, numbers = _stamped(VECTOR3, stamp_ns, frame_id)
    numbers[:] = vector
    return rows


def encode_twist(
    stamp_ns: Int64[np.ndarray, " n"],
    angular: Float64[np.ndarray, "n 3"],
    linear: Float64[np.ndarray, "n 3"],
    covariance: Float64[np.ndarray, "n 6 6"],
    frame_id: str,
) -> UInt8[np.ndarray, "n L"]:
    """One TwistWithCovarianceStamped message per row.

    `covariance` is of angular then linear; a message has them the other way round.

    Raises:
        DataError: a stamp beyond the 32-bit seconds of ROS 2.
    """
    rows, numbers = _stamped(TWIST, stamp_ns, frame_id)
    numbers[:, :3], numbers[:, 3:6] = linear, angular
    halves, swapped = numbers[:, 6:].reshape(-1, 2, 3, 2, 3), covariance.reshape(-1, 2, 3, 2, 3)
    for row, column in ((0, 0), (0, 1), (1, 0), (1, 1)):
        halves[:, row, :, column] = swapped[:, 1 - row, :, 1 - column]
    return rows


def as_ros1(rows: UInt8[np.ndarray, "n L"], schema_name: str) -> UInt8[np.ndarray, "n M"]:
    """CDR messages of one layout in the encoding of ROS 1, `seq` zero."""
    source = layout_of(schema_name, "cdr", message=rows[0].tobytes())
    target = layout_of(schema_name, "ros1", texts=list(source.texts))
    made = _blank(len(rows), target)
    for (ours, size), (source_place, _) in zip(_places(target), _places(source), strict=True):
        made[:, ours : ours + size] = rows[:, source_place : source_place + size]
    return made


def _places(layout: Layout) -> list[tuple[int, int]]:
    """First bytes and sizes of stamps and numbers."""
    return [*((at, 8) for at in layout.stamps), *((at, 8 * count) for at, count in layout.numbers)]


def encode_float(values: Float64[np.ndarray, " n"]) -> UInt8[np.ndarray, "n L"]:
    """One Float64 message per row, without a stamp: the log time carries it."""
    layout = _layout(FLOAT)
    rows = _blank(len(values), layout)
    _numbers_of(rows, layout)[:, 0] = values
    return rows


def encode_image(stamp_ns: int, image: bytes, frame_id: str, image_format: str) -> bytes:
    """One CompressedImage message around the image's own bytes.

    Raises:
        DataError: a stamp beyond the 32-bit seconds of ROS 2.
    """
    layout = layout_of(IMAGE, "cdr", texts=[frame_id, image_format], data_size=len(image))
    assert layout.data is not None, "an image has bytes"
    rows = np.zeros((1, layout.data[0]), np.uint8)
    for at, value in layout.constants:
        rows[0, at : at + len(value)] = np.frombuffer(value, np.uint8)
    _put_stamp(rows, layout, np.array([stamp_ns], np.int64))
    return rows.tobytes() + image
