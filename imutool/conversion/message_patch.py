"""Encoded messages patched in place: numbers and stamps, and an IMU's units and axes."""

from __future__ import annotations

import numpy as np

from imutool.array_types import Float64
from imutool.errors import DataError
from imutool.geometry import quaternion
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.encode import NO_ORIENTATION
from imutool.recording.message_log import MessageTopic

XYZW_FROM_WXYZ, WXYZ_FROM_XYZW = [1, 2, 3, 0], [3, 0, 1, 2]


class MessagePatch:
    """Payload whose numbers and stamps are written in place."""

    def __init__(self, topic: MessageTopic, payload: bytes) -> None:
        self.schema_name = schemas.canonical(topic.schema_name)
        self.layout = schemas.layout_of(self.schema_name, topic.message_encoding, message=payload)
        self.data = bytearray(payload)

    def numbers(self, which: int = 0) -> np.ndarray:
        """Numbers of one element: a view."""
        at, count = self.layout.numbers[which]
        return np.frombuffer(self.data, f"{self.layout.order}f8", count, at)

    def stamp_ns(self, which: int = 0) -> int:
        """Stamp of one element."""
        at, order = self.layout.stamps[which], self.layout.order
        seconds = np.frombuffer(self.data, f"{order}{self.layout.seconds}", 1, at)
        return int(seconds[0]) * schemas.NS_PER_S + int(np.frombuffer(self.data, f"{order}u4", 1, at + 4)[0])

    def move_stamp(self, by_ns: int, which: int = 0) -> None:
        """Shift a stamp."""
        at, order = self.layout.stamps[which], self.layout.order
        seconds = np.frombuffer(self.data, f"{order}{self.layout.seconds}", 1, at)
        nanos = np.frombuffer(self.data, f"{order}u4", 1, at + 4)
        moved_ns = self.stamp_ns(which) + by_ns
        if moved_ns < 0 and self.layout.seconds == "u4":
            what = f"a stamp of {moved_ns - by_ns} ns, moved by {by_ns} ns, lies before 0"
            raise DataError(what, expected="stamps that ROS 1 can store", fix="Cut the log there, or convert it to ROS 2 first")
        seconds[0], nanos[0] = divmod(moved_ns, schemas.NS_PER_S)


def corrected_imu(
    topic: MessageTopic, payload: bytes, gyro: Float64[np.ndarray, "3 3"], accel: Float64[np.ndarray, "3 3"]
) -> bytes:
    """Message of an IMU in right units and axes: both vectors, covariances, own orientation."""
    patch = MessagePatch(topic, payload)
    numbers = patch.numbers()
    for matrix, vector, covariance in (
        (gyro, schemas.GYRO, schemas.GYRO_COVARIANCE),
        (accel, schemas.ACCEL, schemas.ACCEL_COVARIANCE),
    ):
        numbers[vector] = matrix @ numbers[vector]
        if numbers[covariance][0] != -1.0:
            numbers[covariance] = (matrix @ numbers[covariance].reshape(3, 3) @ matrix.T).reshape(-1)
    if numbers[schemas.ORIENTATION_COVARIANCE][0] != NO_ORIENTATION:
        P, Q = (np.sign(matrix) * (matrix != 0) for matrix in (gyro, accel))
        if (P == Q).all() and np.linalg.det(P) > 0:
            q_wxyz = numbers[schemas.ORIENTATION][WXYZ_FROM_XYZW][None].astype(np.float64)
            numbers[schemas.ORIENTATION] = quaternion.multiply(q_wxyz, quaternion.of_matrix(P.T))[0][XYZW_FROM_WXYZ]
        else:
            numbers[schemas.ORIENTATION_COVARIANCE.start] = NO_ORIENTATION
    return bytes(patch.data)
