"""Names for the columns of a table without a header, by its values."""

from __future__ import annotations

import json
import re
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from imutool.recording.joined_imu import unit_by_gravity

from ..text.delimited import Columns
from .times import rises, units_of_time, usual_step
from .units import GYRO_SI, TIME_NS, gravity_units

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
CORE_MOTION = [  # of iOS, as OxIOD has it
    "time",
    *(f"attitude_{axis} [rad]" for axis in ("roll", "pitch", "yaw")),
    *(f"rotation_rate_{axis} [rad/s]" for axis in "xyz"),
    *(f"gravity_{axis} [g]" for axis in "xyz"),
    *(f"user_acceleration_{axis} [g]" for axis in "xyz"),
    *(f"magnetic_field_{axis}" for axis in "xyz"),
]
XSENS = [  # of MulRan, HeLiPR and the KAIST urban data, whose tools name them so
    "time",
    *(f"orientation.{axis}" for axis in "xyzw"),
    *(f"euler_{axis}" for axis in "xyz"),
    *(f"angular_velocity.{axis}" for axis in "xyz"),
    *(f"linear_acceleration.{axis}" for axis in "xyz"),
    *(f"magnetic_field.{axis}" for axis in "xyz"),
]
MIN_TENTH = 0.5  # of the median length, which 90 % of an accelerometer's readings exceed
DIRECTION = 1e-3  # by which rounding changes a direction, or its length of 1
WIDE, MAX_ROWS = 7, 20_000  # more columns than a time and an IMU; rows that are compared


class _Halves(NamedTuple):
    """Columns of a time, if there is one, and what the two triples behind it are of."""

    time: list[str]
    columns: list[str]
    sensors: tuple[str, str]


def perhaps(columns: Columns) -> list[str]:
    """Lines of a map for columns without names, of which the first look like an IMU."""
    groups: dict[str, list[str]] = {}
    for name in columns.values:
        if match := re.fullmatch(r"(.*/)?(column \d{1,4}|time)", name) or re.fullmatch(r"(.*)\[\d{1,4}\]", name):
            groups.setdefault(match[1] or "", []).append(name)
    for names in groups.values():  # a number of a frame, which does not rise in each row, is no time
        if (first := columns.values[names[0]]).dtype.kind in "iu" and not rises(first) and (np.diff(first) >= 0).all():
            del names[0]
    wide = [names for names in groups.values() if len(names) > WIDE]
    halves = next(filter(None, (_turning(columns, names) for names in wide)), None)
    halves = halves or next(filter(None, (_halves(columns, names) for names in groups.values())), None)
    if halves is None:
        return []
    triples = zip(halves.sensors, (halves.columns[:3], halves.columns[3:]), strict=True)
    return [f"perhaps {sensor} = {json.dumps(triple)}" for sensor, triple in triples]


def in_an_array(columns: Columns) -> dict[str, Any]:
    """Entries of an IMU in one array of six columns, behind a time or not."""
    arrays: dict[str, list[str]] = {}
    for name in columns.values:
        if match := re.fullmatch(r"(.*)\[\d\]", name):
            arrays.setdefault(match[1], []).append(name)
    found = [halves for names in arrays.values() if len(names) in (6, 7) and (halves := _halves(columns, names))]
    if len(found) != 1 or len(arrays[found[0].columns[0][:-3]]) != 6 + len(found[0].time):
        return {}
    (halves,) = found
    triples = dict(zip(halves.sensors, (halves.columns[:3], halves.columns[3:]), strict=True))
    return triples | ({"time": halves.time[0]} if halves.time else {})


def _halves(columns: Columns, names: list[str]) -> _Halves | None:
    """The first six columns that are no time; None where not exactly one half shows gravity.

    The time is the first column, or the seventh and last one: a board may print it behind its readings.
    """
    edges = [*names[:1], *(names[6:] if len(names) == 7 else [])]
    time = [name for name in edges if rises(columns.values[name])][:1]
    six = [name for name in names if name not in time][:6]
    shows = [_has_gravity(columns, half) for half in (six[:3], six[3:])] if len(six) == 6 else []
    if shows and time and not any(shows):  # increments of velocity, which a rate makes accelerations of
        rate_hz = 1.0 / float(np.nanmedian(np.diff(columns.values[time[0]].astype(float))))
        shows = [_has_gravity(columns, half, rate_hz) for half in (six[:3], six[3:])]
    return _Halves(time, six, ("accel", "gyro") if shows[0] else ("gyro", "accel")) if sum(shows) == 1 else None


def _turning(columns: Columns, names: list[str]) -> _Halves | None:
    """Three columns of a wide table in which gravity turns as a gyro in three others says; None of other tables.

    A direction has the same length in each row, and is none that a sensor measures.
    """
    t = columns.values[names[0]].astype(float)
    units = units_of_time(float(t[0]), usual_step(t)) if rises(columns.values[names[0]]) else []
    if len(units) != 1:
        return None
    values = {name: columns.values[name].astype(float)[:MAX_ROWS] for name in names[1:]}
    triples = [[*names[first : first + 3]] for first in range(1, len(names) - 2)]
    sizes = [np.linalg.norm([values[name] for name in three], axis=0) for three in triples]
    accels = [three for three, size in zip(triples, sizes, strict=True) if _has_gravity(columns, three) and np.ptp(size) > 1e-3]
    t_ns = np.rint((t - t[0]) * TIME_NS[units[0]]).astype(np.int64)[:MAX_ROWS]
    best, surest = None, 0.0
    for accel, gyro in product(accels, triples):
        if not {*accel} & {*gyro} and (np.diff(t_ns) > 0).all():
            rates, forces = (np.stack([values[name] for name in three], axis=1) for three in (gyro, accel))
            found = unit_by_gravity(t_ns, rates, forces, GYRO_SI)
            if found and found[1] > surest:
                best, surest = _Halves(names[:1], [*accel, *gyro], ("accel", "gyro")), found[1]
    return best


def _has_gravity(columns: Columns, triple: list[str], factor: float = 1.0) -> bool:
    """Whether three columns have the size of gravity, and seldom less, as rates of a fast flight about 1 rad/s have.

    A direction, as the row of a rotation, has not, and counts next to a fraction, as of satellites and a latitude.
    """
    if len({columns.values[name].dtype.kind for name in triple}) > 1:
        return False
    values = factor * np.stack([columns.values[name].astype(float) for name in triple])
    level, near = gravity_units(columns, triple, factor)
    near = near if factor == 1.0 else [unit for unit in near if unit == "m/s^2"]
    tenth = float(np.nanquantile(np.linalg.norm(values, axis=0), 0.1))
    return bool(near) and tenth > MIN_TENTH * level and not _is_direction(columns, triple)


def _is_direction(columns: Columns, triple: list[str]) -> bool:
    """Whether three columns have the length 1 in each row, as an accelerometer that measures g has not."""
    lengths = np.linalg.norm([columns.values[name].astype(float) for name in triple], axis=0)
    return bool(np.nanmax(np.abs(lengths - 1.0), initial=0.0) < DIRECTION)


def _is_core_motion(columns: Columns, numbered: list[str]) -> bool:
    """Whether unnamed columns are those of CoreMotion, whose gravity follows from its roll and pitch."""
    if len(numbered) != len(CORE_MOTION) or not rises(columns.values[numbered[0]]):
        return False
    roll, pitch, *gravity = columns.side_by_side([*numbered[1:3], *numbered[7:10]]).T
    expected = np.cos(pitch) * np.sin(roll), -np.sin(pitch), -np.cos(pitch) * np.cos(roll)
    return bool(np.nanmax(np.abs(np.stack(gravity) - expected)) < DIRECTION)


def _is_xsens(columns: Columns, numbered: list[str]) -> bool:
    """Whether unnamed columns are those of an Xsens sensor: its quaternion, and gravity where its accelerometer is alone."""
    if len(numbered) != len(XSENS) or not rises(columns.values[numbered[0]]):
        return False
    lengths = np.linalg.norm([columns.values[name].astype(float) for name in numbered[1:5]], axis=0)
    is_turn = bool(np.nanmax(np.abs(lengths - 1.0)) < DIRECTION)
    return is_turn and _has_gravity(columns, numbered[11:14]) and not _has_gravity(columns, numbered[8:11])


def _place_of_time(columns: Columns) -> int:
    """Place of the time in a table without a header: 1 behind a number of the row, else 0."""
    first, second = ([*columns.values.values()][:2] + [np.zeros(0)] * 2)[:2]
    return int(first.dtype.kind in "iu" and len(first) > 1 and bool((np.diff(first) == 1).all()) and rises(second))


def name_headerless(columns: Columns) -> None:
    """Name an IMU's columns: as ROS echoes it, or six axes with gravity, behind a time or not."""
    width = max((int(name[7:]) for name in columns.values if re.fullmatch(r"column \d{1,4}", name)), default=0)
    numbered = [f"column {number}" for number in range(1, width + 1)]
    if not width or not columns.values.keys() <= {*numbered}:
        return
    if (
        width > 7
        and rises(first := columns.values.get("column 1", np.zeros(0)))
        and np.array_equal(first, columns.values.get("column 2", first[:0]))
    ):  # the same time twice, as tools of MATLAB write it
        del columns.values["column 2"], numbered[1]
        columns.texts.pop("column 2", None)
        columns.remarks.notes.append("column 2 repeats column 1 and is left out")
    if width == len(ROS_IMU) and [*columns.values] == [*numbered[:2], *numbered[3:]]:
        new, why = ROS_IMU, "it has the columns of `ros2 topic echo --csv` of sensor_msgs/Imu"
    elif [*columns.values] == numbered and _is_core_motion(columns, numbered):
        new, why = CORE_MOTION, "it has no header: its columns are those of CoreMotion, as in OxIOD"
    elif [*columns.values] == numbered and _is_xsens(columns, numbered):
        new, why = XSENS, "it has no header: its columns are those of an Xsens sensor, as in MulRan"
    elif [*columns.values] == numbered and (halves := _halves(columns, numbered[_place_of_time(columns) :])):
        count = len(numbered) - len(halves.time) - 6
        if count != _place_of_time(columns):
            return
        axes = [f"{sensor}_{axis}" for sensor in halves.sensors for axis in "xyz"]
        named = dict(zip([*halves.time, *halves.columns], [*["time"] * len(halves.time), *axes], strict=True))
        new = [named.get(name, "count") for name in numbered]
        shown = halves.columns[:3] if halves.sensors[0] == "accel" else halves.columns[3:]
        begin, _, end = (name.removeprefix("column ") for name in shown)
        why = f"it has no header: columns {begin} to {end} show gravity and count as the accel"
    else:
        return
    name = dict(zip(numbered, new, strict=True))
    columns.values = {name[column]: values for column, values in columns.values.items()}
    columns.texts = {name[column]: texts for column, texts in columns.texts.items()}
    columns.units = {name[column]: unit for column, unit in columns.units.items() if column in name}
    columns.remarks.notes.append(why)
