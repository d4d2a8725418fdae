"""Names for the columns of a table of text that has no header."""

from __future__ import annotations

import json
import re
from typing import NamedTuple

from ._table_text import Columns
from ._table_times import rises
from ._table_units import gravity_units

SQUARE = [f"[{number}]" for number in range(9)]
ROS_IMU = [  # `ros2 topic echo --csv` of sensor_msgs/Imu
    *("header.stamp.sec", "header.stamp.nanosec", "header.frame_id"),
    *(f"orientation.{axis}" for axis in "xyzw"),
    *(f"orientation_covariance{place}" for place in SQUARE),
    *(f"angular_velocity.{axis}" for axis in "xyz"),
    *(f"angular_velocity_covariance{place}" for place in SQUARE),
    *(f"linear_acceleration.{axis}" for axis in "xyz"),
    *(f"linear_acceleration_covariance{place}" for place in SQUARE),
]


class _Halves(NamedTuple):
    """Columns of a time, if there is one, and what the two triples behind it are of."""

    time: list[str]
    columns: list[str]
    sensors: tuple[str, str]


def perhaps(columns: Columns) -> list[str]:
    """Lines of a map for more columns without a header, of which the first look like an IMU."""
    halves = _halves(columns, [name for name in columns.values if re.fullmatch(r"column \d{1,4}", name)])
    if halves is None:
        return []
    triples = zip(halves.sensors, (halves.columns[:3], halves.columns[3:]), strict=True)
    return [f"perhaps {sensor} = {json.dumps(triple)}" for sensor, triple in triples]


def _halves(columns: Columns, names: list[str]) -> _Halves | None:
    """The first six columns that are no time; None where not exactly one half shows gravity."""
    time = names[:1] if names and rises(columns.values[names[0]]) else []
    six = names[len(time) : len(time) + 6]
    shows = [bool(gravity_units(columns, half)[1]) for half in (six[:3], six[3:])] if len(six) == 6 else []
    return _Halves(time, six, ("accel", "gyro") if shows[0] else ("gyro", "accel")) if sum(shows) == 1 else None


def name_headerless(columns: Columns) -> None:
    """Name an IMU's columns: as ROS echoes it, or six axes with gravity, behind a time or not."""
    width = max((int(name[7:]) for name in columns.values if re.fullmatch(r"column \d{1,4}", name)), default=0)
    numbered = [f"column {number}" for number in range(1, width + 1)]
    if not width or not columns.values.keys() <= {*numbered}:
        return
    if width == len(ROS_IMU) and [*columns.values] == [*numbered[:2], *numbered[3:]]:
        new, why = ROS_IMU, "it has the columns of `ros2 topic echo --csv` of sensor_msgs/Imu"
    elif [*columns.values] == numbered and (halves := _halves(columns, numbered)) and width == len(halves.time) + 6:
        new = ["time"] * len(halves.time) + [f"{sensor}_{axis}" for sensor in halves.sensors for axis in "xyz"]
        place = width - 5 if halves.sensors[0] == "accel" else width - 2
        why = f"it has no header: columns {place} to {place + 2} show gravity and count as the accel"
    else:
        return
    name = dict(zip(numbered, new, strict=True))
    columns.values = {name[column]: values for column, values in columns.values.items()}
    columns.texts = {name[column]: texts for column, texts in columns.texts.items()}
    columns.units = {name[column]: unit for column, unit in columns.units.items()}
    columns.remarks.notes.append(why)
