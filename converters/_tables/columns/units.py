"""Units of a table's columns by gravity, and doubts about stated ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from imutool.array_types import Float64
from imutool.recording import GRAVITY_M_S2, Imu
from imutool.recording.gyro_steps import RATES_SI
from imutool.recording.joined_imu import unit_by_gravity

from ..text.delimited import Columns

USUAL_TIME_NS = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
TIME_NS = {**USUAL_TIME_NS, "100us": 1e5, "min": 60e9, "h": 3600e9, "day": 86400e9}  # the last four only where they are stated
GYRO_SI = RATES_SI
STANDARD_GRAVITY = 9.80665
ACCEL_SI = {"m/s^2": 1.0, "g": STANDARD_GRAVITY, "mg": STANDARD_GRAVITY / 1000.0, "cm/s^2": 0.01, "ft/s^2": 0.3048}
POSITION_SI = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
ANGLE_SI = {"deg": np.pi / 180.0, "rad": 1.0}
UNITS_OF: dict[str, dict[str, float]] = {
    "time_unit": TIME_NS,
    "gyro_unit": GYRO_SI,
    "accel_unit": ACCEL_SI,
    "truth_time_unit": TIME_NS,
    "position_unit": POSITION_SI,
    "roll_pitch_yaw_unit": ANGLE_SI,
}
GRAVITY_BAND = 0.15  # share by which the median acceleration may differ from gravity
# of the median length: a tenth of the lengths and the mean vector lie below both in 9 tables of user or linear acceleration,
# and above one of them in 70 tables of accelerometers on phones, boards and drones
MAX_TENTH, MAX_MEAN = 0.6, 0.6
MAX_OF_GRAVITY = 2.0  # factor between gravity and the median acceleration of a robot or a person that moves
MIN_HZ, MAX_HZ = 0.2, 50_000.0  # of samples; another unit of the time is a factor of 1000 away
FULL_SCALE_RAD_S = 35.0  # 2000 degrees a second, the widest range of common gyros
USUAL_SHARE = 0.99  # of the samples: single spikes show no unit
COUNTS_A_G = {2: 16384, 4: 8192, 8: 4096, 16: 2048}  # by the range in g, of 16 bits
RAW_BAND = 0.1  # share by which the median length of counts may differ from gravity's


def gravity_units(columns: Columns, chosen: Sequence[str], factor: float = 1.0) -> tuple[float, list[str]]:
    """Median length times a factor, and units in which it is gravity; none for motion alone."""
    level = factor * _usual(np.linalg.norm([columns.values[c] for c in chosen], axis=0), 0.5)
    return level, [] if is_motion_alone(columns, chosen) else [
        u for u, size in ACCEL_SI.items() if u != "ft/s^2" and abs(level * size / STANDARD_GRAVITY - 1.0) < GRAVITY_BAND
    ]


def is_motion_alone(columns: Columns, chosen: Sequence[str]) -> bool:
    """Whether accelerations have no gravity: their lengths reach far down, and they cancel out."""
    values = columns.side_by_side(chosen)
    if not (known := np.isfinite(values).all(axis=1)).all():
        values = values[known]
    lengths = np.linalg.norm(values, axis=1)
    level = _usual(lengths, 0.5)
    if not level > 0.0:
        return False
    return _usual(lengths, 0.1) < MAX_TENTH * level and float(np.linalg.norm(values.mean(axis=0))) < MAX_MEAN * level


def unit_doubts(imu: Imu, gyro_unit: str, accel_unit: str) -> list[str]:
    """Doubts about units: by the rate, gravity's size and turns, and the gyros' range."""
    if not len(imu):
        return []
    doubts, rate_hz = [], 1e9 / float(np.median(np.diff(imu.t_ns))) if len(imu) > 1 else MIN_HZ
    if not MIN_HZ <= rate_hz <= MAX_HZ:
        doubts.append(f"it has {rate_hz:.3g} samples a second, which no IMU has: is the unit of the time right?")
    level = _usual(np.linalg.norm(imu.accel, axis=1), 0.5)
    if np.isfinite(level) and not 1.0 / MAX_OF_GRAVITY < level / GRAVITY_M_S2 < MAX_OF_GRAVITY:
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
    turned = unit_by_gravity(imu.t_ns, imu.gyro / GYRO_SI[gyro_unit], imu.accel, GYRO_SI)
    if turned is not None and turned[0] != gyro_unit:
        doubts.append(
            f"gravity turns in the accelerometer as a gyro in {turned[0]} says (t = {turned[1]:.1f}), and gyro_unit is"
            f" {gyro_unit!r}: is the unit right?"
        )
    return doubts


def _usual(values: Float64[np.ndarray, "*n"], share: float) -> float:
    """Quantile of the finite values; nan without any."""
    finite = values[np.isfinite(values)]
    return float(np.quantile(finite, share, overwrite_input=True)) if len(finite) else float("nan")


def raw_counts(accel: Float64[np.ndarray, "n 3"]) -> tuple[int, int] | None:
    """Range (g) and counts a g that raw counts of an accelerometer fit; None for other values."""
    finite = accel[np.isfinite(accel).all(axis=1)]
    if not len(finite) or (finite != np.round(finite)).any():
        return None
    level = float(np.median(np.linalg.norm(finite, axis=1)))
    return next(((full, counts) for full, counts in COUNTS_A_G.items() if abs(level / counts - 1.0) < RAW_BAND), None)


def are_unsigned_counts(accel: Float64[np.ndarray, "n 3"]) -> bool:
    """Whether values are whole numbers above zero, as of a converter whose zero is no force."""
    finite = accel[np.isfinite(accel).all(axis=1)]
    return len(finite) > 0 and bool((finite == np.round(finite)).all() and (finite >= 0.0).all())
