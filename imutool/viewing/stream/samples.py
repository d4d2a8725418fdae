"""Samples of a live stream, and how a message holds one, in JSON or CDR."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import msgspec
import numpy as np

from imutool.errors import LogError
from imutool.mcap_io.codec.decode import decode_imu

CDR = b"\0\1\0\0"  # how a little-endian message begins; no JSON does
MAX_NS = 1 << 62  # of a stamp, 146 years: the step between any two fits into int64

Vector = tuple[float, float, float]


class Sample(NamedTuple):
    """Sample of an IMU: stamp (ns), rad/s, m/s², arrival (s of `time.perf_counter`), perhaps °C."""

    stamp_ns: int
    gyro: Vector
    accel: Vector
    arrival_s: float
    temperature: float | None = None


class _Vector(msgspec.Struct):
    x: float
    y: float
    z: float

    def plain(self) -> Vector:
        return self.x, self.y, self.z


class _Stamp(msgspec.Struct):
    """Time of ROS 2 or of ROS 1."""

    sec: int | None = None
    nanosec: int | None = None
    secs: int | None = None
    nsecs: int | None = None

    def stamp_ns(self) -> int | None:
        """Nanoseconds; None without a time."""
        whole, rest = (self.sec, self.nanosec) if self.sec is not None else (self.secs, self.nsecs)
        return None if whole is None else whole * 1_000_000_000 + (rest or 0)


class _Header(msgspec.Struct):
    stamp: _Stamp


class _Message(msgspec.Struct):
    """Sample in imutool's JSON, or a sensor_msgs/Imu, perhaps in the envelope of a rosbridge."""

    t_ns: int | None = None
    t_s: float | None = None
    gyro: Vector | None = None
    accel: Vector | None = None
    temperature: float | None = None
    header: _Header | None = None
    angular_velocity: _Vector | None = None
    linear_acceleration: _Vector | None = None
    msg: _Message | None = None

    def stamp_ns(self) -> int | None:
        """Nanoseconds; None without a time."""
        if self.t_ns is not None or self.t_s is not None:
            return self.t_ns if self.t_ns is not None else round(1e9 * (self.t_s or 0.0))
        return None if self.header is None else self.header.stamp.stamp_ns()

    def values(self) -> tuple[Vector | None, Vector | None]:
        """Angular rate and specific force; None where there is none."""
        rate, force = (None if v is None else v.plain() for v in (self.angular_velocity, self.linear_acceleration))
        return self.gyro or rate, self.accel or force


DECODER = msgspec.json.Decoder(_Message)


def sample(text: bytes | str, arrival_s: float) -> Sample:
    """Sample from JSON with t_ns or t_s, gyro, accel, or from a sensor_msgs/Imu in JSON.

    Raises:
        ValueError: it is none.
    """
    message = DECODER.decode(text)
    message = message.msg or message
    stamp_ns, (gyro, accel) = message.stamp_ns(), message.values()
    if gyro is None or accel is None:
        raise ValueError("neither gyro and accel nor a sensor_msgs/Imu")
    if stamp_ns is None:
        raise ValueError("no time: t_ns, t_s or header.stamp")
    if abs(stamp_ns) > MAX_NS:
        raise ValueError("a time more than 146 years from 1970")
    return Sample(stamp_ns, gyro, accel, arrival_s, message.temperature)


@dataclass
class Malformed:
    """Count of messages that hold no sample, with the first reason."""

    count: int = 0
    first: str = ""

    def __str__(self) -> str:
        """The count and the first reason, to follow a sentence; empty without such a message."""
        return f"; the first of {self.count} messages: {self.first}" if self.count else ""

    def add(self, text: bytes | str, error: Exception) -> None:
        """Count a message."""
        self.count += 1
        if not self.first:
            self.first = f"{error}: {text[:100]!r}"


def decoded(text: bytes | str, arrival_s: float, malformed: Malformed) -> Iterator[Sample | None]:
    """The sample of a message; None if it holds none, so that time is looked at."""
    try:
        if isinstance(text, bytes) and text.startswith(CDR):
            imu = decode_imu(np.frombuffer(text, np.uint8)[None])
            yield Sample(int(imu.stamp_ns[0]), tuple(imu.gyro[0].tolist()), tuple(imu.accel[0].tolist()), arrival_s)
        else:
            yield sample(text, arrival_s) if text.strip() else None
    except (msgspec.DecodeError, UnicodeDecodeError, ValueError, OverflowError, RecursionError, LogError) as error:
        malformed.add(text, error)
        yield None
