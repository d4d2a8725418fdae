"""Gyroscope and accelerometer on topics of their own, joined to one IMU as they are read."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Set
from dataclasses import dataclass
from posixpath import commonpath
from typing import NamedTuple

import numpy as np

from imutool.array_types import Bool, Float64, Int64, Shaped, UInt8
from imutool.errors import ConfigError
from imutool.mcap_io.codec.encode import encode_imu
from imutool.mcap_io.codec.messages import Messages, Rows, columns
from imutool.mcap_io.codec.schemas import ACCELS, VECTOR3

SENSOR_WORDS = r"gyro(scope)?", r"accel(erometer)?"
JOIN_VECTORS = "; imutool debias and others read a gyro's and an accelerometer's vectors as one: --imu gyro=TOPIC,accel=TOPIC"
BY_NAMES = {"protobuf", "json", "msgpack", "flatbuffer"}  # encodings whose messages are an IMU by the names of their fields
READ, IDL = {"cdr", "ros1", *BY_NAMES}, {"ros2idl", "omgidl"}  # encodings; languages of definitions
Cut = Iterator[tuple[Shaped[np.ndarray, " n"], UInt8[np.ndarray, "n L"]]]  # heads and payloads of equal size


class Vectors(NamedTuple):
    """Samples of one sensor: stamps in ns, three numbers each, and their frame."""

    stamp_ns: Int64[np.ndarray, " n"]
    values: Float64[np.ndarray, "n 3"]
    frame_id: str


@dataclass(frozen=True)
class JoinedImu:
    """Messages of a gyroscope as those of an IMU, with the accelerations at their stamps."""

    cut_gyro: Callable[[Messages, Bool[np.ndarray, " n"]], Cut]
    rates: Callable[[Rows], Iterator[Vectors]]
    t_ns: Int64[np.ndarray, " n"]  # of the gyro's samples that have an acceleration
    accel: Float64[np.ndarray, "n 3"]

    def cut(self, found: Messages, mask: Bool[np.ndarray, " n"]) -> Cut:
        """Heads of the chosen messages that have an acceleration, and their samples as CDR."""
        for heads, payload in self.cut_gyro(found, mask):
            start = 0
            for stamp_ns, gyro, frame in self.rates(columns(heads, payload)):
                place = np.minimum(np.searchsorted(self.t_ns, stamp_ns), len(self.t_ns) - 1)
                known = self.t_ns[place] == stamp_ns
                if known.any():
                    rows = encode_imu(stamp_ns[known], gyro[known], self.accel[place][known], frame)
                    yield heads[start : start + len(known)][known], rows
                start += len(known)


def parse_parts(text: str) -> tuple[str, str] | None:
    """Topics of `gyro=/a,accel=/b`; None for any other name.

    Raises:
        ConfigError: it begins like that, and one of the two is missing.
    """
    if not re.match(r"\s*(gyro|accel)=", text):
        return None
    parts = dict(part.strip().partition("=")[::2] for part in text.split(","))
    if parts.keys() != {"gyro", "accel"} or not all(parts.values()):
        raise ConfigError(f"{text!r}", where="imu", expected="gyro=TOPIC,accel=TOPIC")
    return parts["gyro"], parts["accel"]


def whole_of(parts: tuple[str, str]) -> str:
    """Topic of the IMU that two topics make up: `imu` in the folder that they share."""
    return f"{commonpath(parts).rstrip('/')}/imu"


def pairs_by_name(topics: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Gyro and accelerometer topics whose names differ by the sensor alone, by their IMU.

    Several in one folder are told apart by what else is in their names: `/d/imu_0`, `/d/imu_1`.
    """
    gyro, accel = ({re.sub(rf"(?i)(?<=[/_]){word}(?=(_\w+)?(/|$))", "{}", t): t for t in topics} for word in SENSOR_WORDS)
    both = {pattern: (gyro[pattern], accel[pattern]) for pattern in gyro if "{}" in pattern and pattern in accel}
    wholes = {pattern: whole_of(parts) for pattern, parts in both.items()}
    if len({*wholes.values()}) < len(wholes):
        wholes = {pattern: pattern.replace("{}", "imu", 1) for pattern in both}
    return {whole: both[pattern] for pattern, whole in wholes.items() if whole not in topics}


def choice_of(topics: Iterable[str]) -> str:
    """Hint for several IMU topics: choose one, or join two that are one IMU."""
    joined = [f"gyro={gyro},accel={accel}" for gyro, accel in pairs_by_name(topics).values()]
    return f"Choose one with `imu`{''.join(f', or join two: {names}' for names in joined)}"


def no_imu_fix(topics: Iterable[tuple[str, str, str]]) -> str:
    """Hint for a log without an IMU, by its topics' types and both encodings; may be empty."""
    types, encodings, languages = zip(*topics, strict=True) if (topics := list(topics)) else ((), (), ())
    if types.count(VECTOR3) > 1 or {*ACCELS} & {*types}:
        return "`imu` gyro=TOPIC,accel=TOPIC joins the vectors of a gyroscope (rad/s) and of an accelerometer (m/s²)"
    if {"px4_msgs/msg/SensorGyro", "px4_msgs/msg/VehicleImu"} & {*types}:
        return "imutool convert makes an IMU of PX4's topics"
    return unread_fix({*encodings}, {*languages})


def unread_fix(encodings: Set[str], languages: Set[str]) -> str:
    """Hint at how messages of these encodings are searched for an IMU; may be empty."""
    if unread := sorted((encodings - READ) | (languages & IDL)):
        what = f"Messages in {' and '.join(unread)} are not searched for an IMU"
        return f"{what}: record them as messages of ROS, protobuf or JSON"
    if "protobuf" in encodings:
        try:
            import google.protobuf  # noqa: F401
        except ImportError:
            return "An IMU in protobuf is read with: pip install 'imutool[protobuf]'"
    if not (named := sorted(BY_NAMES & encodings)):
        return ""
    what = f"A message in {' or '.join(named)} is an IMU if its fields are named as an angular velocity and an acceleration"
    batches = "messages of several samples each are read from a file, one JSON message a line, and not from MCAP"
    return f"{what}; {batches}" if "json" in named else what
