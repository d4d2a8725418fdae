"""Names for the columns of a table of text that has no header."""

from __future__ import annotations

import re

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
TIME_AND_IMU = 7


def name_headerless(columns: Columns) -> None:
    """Name the columns of an IMU: as ROS echoes it, or a time and six axes with gravity."""
    width = max((int(name[7:]) for name in columns.values if re.fullmatch(r"column \d{1,4}", name)), default=0)
    numbered = [f"column {number}" for number in range(1, width + 1)]
    if not width or not columns.values.keys() <= {*numbered}:
        return
    if width == len(ROS_IMU) and [*columns.values] == [*numbered[:2], *numbered[3:]]:
        new, why = ROS_IMU, "it has the columns of `ros2 topic echo --csv` of sensor_msgs/Imu"
    elif width == TIME_AND_IMU == len(columns.values) and rises(columns.values[numbered[0]]):
        halves = numbered[1:4], numbered[4:]
        shows = [bool(gravity_units(columns, half)[1]) for half in halves]
        if shows[0] == shows[1]:
            return
        sensors = ("accel", "gyro") if shows[0] else ("gyro", "accel")
        new = ["time", *(f"{sensor}_{axis}" for sensor in sensors for axis in "xyz")]
        why = f"it has no header: columns {'2 to 4' if shows[0] else '5 to 7'} show gravity and count as the accel"
    else:
        return
    name = dict(zip(numbered, new, strict=True))
    columns.values = {name[column]: values for column, values in columns.values.items()}
    columns.texts = {name[column]: texts for column, texts in columns.texts.items()}
    columns.units = {name[column]: unit for column, unit in columns.units.items()}
    columns.remarks.notes.append(why)
