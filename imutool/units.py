"""Names of sensors, axes and units, as tables, files and figures write them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Literal

Sensor = Literal["gyro", "accel"]
Three = tuple[float, float, float]  # one number an axis
SENSORS: tuple[Sensor, Sensor] = ("gyro", "accel")
COLUMNS: Mapping[str, slice] = {"gyro": slice(0, 3), "accel": slice(3, 6)}  # of six: a vector, or the columns of both sensors
AXES = ("x", "y", "z")
FULL_SCALE_RAD_S = 35.0  # 2000 degrees a second, the widest range of common MEMS gyros
MAX_RATE_RAD_S = 1e4  # no gyro measures more
NOUNS = {"gyro": "Angular rate", "accel": "Specific force"}
UNITS = {"gyro": "rad/s", "accel": "m/s²"}  # as people read them
ASCII_UNITS = {"gyro": "rad/s", "accel": "m/s^2"}  # as JSON and logs hold them


def with_superscripts(unit: str) -> str:
    """A unit as people read it: `m/s²` for `m/s^2`."""
    return unit.replace("^2", "²").replace("^3", "³")


def three(values: Iterable[float]) -> Three:
    """Three numbers, one an axis, as plain floats."""
    x, y, z = map(float, values)
    return x, y, z
