"""Units of a table's columns, and doubts about stated ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from imutool.array_types import Float64
from imutool.recording import GRAVITY_M_S2, Imu

from ._table_text import Columns

USUAL_TIME_NS = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
TIME_NS = {**USUAL_TIME_NS, "100us": 1e5}
GYRO_SI = {"rad/s": 1.0, "deg/s": np.pi / 180.0, "mdeg/s": np.pi / 180.0e3}
STANDARD_GRAVITY = 9.80665
ACCEL_SI = {"m/s^2": 1.0, "g": STANDARD_GRAVITY, "mg": STANDARD_GRAVITY / 1000.0, "cm/s^2": 0.01}
POSITION_SI = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
UNITS_OF: dict[str, dict[str, float]] = {
    "time_unit": TIME_NS,
    "gyro_unit": GYRO_SI,
    "accel_unit": ACCEL_SI,
    "truth_time_unit": TIME_NS,
    "position_unit": POSITION_SI,
}
GRAVITY_BAND = 0.15  # share by which the median acceleration may differ from gravity
# of the median length: a tenth of the lengths and the mean vector lie below both in 9 tables of user or linear acceleration,
# and above one of them in 70 tables of accelerometers on phones, boards and drones
MOST_TENTH, MOST_MEAN = 0.6, 0.6
MOST_OF_GRAVITY = 2.0  # factor between gravity and the median acceleration of a robot or a person that moves
FULL_SCALE_RAD_S = 35.0  # 2000 degrees a second, the widest range of common gyros
USUAL_SHARE = 0.99  # of the samples: single spikes show no unit


def gravity_units(columns: Columns, chosen: Sequence[str]) -> tuple[float, list[str]]:
    """Median length of the vectors, and the units in which it is gravity; none for motion alone."""
    level = _usual(np.linalg.norm([columns.values[c].astype(float) for c in chosen], axis=0), 0.5)
    return level, [] if is_motion_alone(columns, chosen) else [
        u for u, size in ACCEL_SI.items() if abs(level * size / STANDARD_GRAVITY - 1.0) < GRAVITY_BAND
    ]


def is_motion_alone(columns: Columns, chosen: Sequence[str]) -> bool:
    """Whether accelerations have no gravity: their lengths reach far down, and they cancel out."""
    values = np.stack([columns.values[c].astype(float) for c in chosen], axis=1)
    values = values[np.isfinite(values).all(axis=1)]
    lengths = np.linalg.norm(values, axis=1)
    level = _usual(lengths, 0.5)
    if not level > 0.0:
        return False
    return _usual(lengths, 0.1) < MOST_TENTH * level and float(np.linalg.norm(values.mean(axis=0))) < MOST_MEAN * level


def unit_doubts(imu: Imu, gyro_unit: str, accel_unit: str) -> list[str]:
    """Doubts about stated units: accelerations far from gravity, rates beyond the gyros' range."""
    if not len(imu):
        return []
    doubts = []
    level = _usual(np.linalg.norm(imu.accel, axis=1), 0.5)
    if np.isfinite(level) and not 1.0 / MOST_OF_GRAVITY < level / GRAVITY_M_S2 < MOST_OF_GRAVITY:
        doubts.append(
            f"the median acceleration is {level:.3g} m/s^2 with accel_unit {accel_unit!r}, and gravity is {GRAVITY_M_S2}:"
            " is the unit right, and are these the columns of the accelerometer?"
        )
    rate = _usual(np.abs(imu.gyro), USUAL_SHARE)
    if rate > FULL_SCALE_RAD_S:
        doubts.append(
            f"the gyro reaches {rate:.3g} rad/s with gyro_unit {gyro_unit!r}, and common gyros measure up to"
            f" {FULL_SCALE_RAD_S:g} rad/s: is the unit right?"
        )
    return doubts


def _usual(values: Float64[np.ndarray, "*n"], share: float) -> float:
    """Quantile of the finite values; nan without any."""
    finite = values[np.isfinite(values)]
    return float(np.quantile(finite, share)) if len(finite) else float("nan")
