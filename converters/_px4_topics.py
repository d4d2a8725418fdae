"""Topics of PX4 as columns: IMUs in FLU, poses in ENU, and every topic as messages.

PX4 measures in FRD (x forward, y right, z down) and its world is NED; y and z of the body change sign. Stamps are PX4's own
clock in microseconds.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.errors import DataError
from imutool.geometry import quaternion
from imutool.geometry.quaternion import FLU_FROM_FRD
from imutool.recording import Imu, Poses, interpolate
from imutool.recording.joined_imu import joined
from imutool.recording.message_log import MessageLog, Remarks, Table
from imutool.recording.sample_order import in_order

from . import Sequence

MIN_IMU_HZ = 10.0  # slower logs of a sensor are samples for its temperature, not for its motion
UP_FROM_DOWN = np.array([1.0, 1.0, -1.0])
NO_ACCEL = 0x7FFFFFFF  # accelerometer_timestamp_relative without an accelerometer
Columns = dict[str, np.ndarray]


def _field(columns: Columns, name: str) -> np.ndarray:
    """One field of a topic; damage and other versions of PX4 may leave it out."""
    if name not in columns:
        raise DataError(f"its topic has no field {name}")
    return columns[name]


def _ns(columns: Columns, name: str = "timestamp") -> Int64[np.ndarray, " n"]:
    return _field(columns, name).astype(np.int64) * 1000


def _sample_ns(columns: Columns) -> Int64[np.ndarray, " n"]:
    """Time of a sample where PX4 logs it, else of its message; 0 stands for a time that was not set, as in simulated truth."""
    message_ns = _ns(columns)
    sample_ns = _ns(columns, "timestamp_sample") if "timestamp_sample" in columns else message_ns
    return np.where(sample_ns > 0, sample_ns, message_ns)


def _vectors(columns: Columns, names: str) -> Float64[np.ndarray, "n k"]:
    return np.stack([_field(columns, name).astype(np.float64) for name in names.split()], axis=1)


def imus_of(topics: dict[str, Columns], remarks: Remarks) -> dict[str, Imu]:
    """IMU of the estimator, and those of each sensor that is logged fast enough."""
    imus: dict[str, Imu] = {}
    if "sensor_combined" in topics:
        _put(imus, "/imu", partial(_combined, topics["sensor_combined"]), remarks)
    sensors = {  # the number is in the name of a topic that has several
        (match[1], match[2] or "sensor", int(match[3] or 0)): columns
        for name, columns in topics.items()
        if (match := re.fullmatch(r"sensor_(gyro|accel)(?:_(fifo))?(?:/(\d+))?", name))
    }
    for kind, of, number in sorted(sensors):
        if kind == "gyro" and (accel := sensors.get(("accel", of, number))) is not None:
            _put(imus, f"/imu/{of}{number}", partial(_pair, sensors[kind, of, number], accel), remarks)
    if not imus:
        remarks.losses.append("the log has no IMU: neither sensor_combined, nor sensor_gyro and sensor_accel at 10 Hz or more")
    return imus


def _put(imus: dict[str, Imu], topic: str, found: Callable[[], tuple[Any, Any, Any, Any] | None], remarks: Remarks) -> None:
    try:
        if (columns := found()) is not None:
            imus[topic], _, notes = joined(*columns, name=topic)
            remarks.notes.extend(notes)
    except DataError as error:
        remarks.losses.append(f"{topic} is left out: {error.what}")


def _combined(columns: Columns) -> tuple[Any, Any, Any, Any]:
    """Stamps and values of gyro and accelerometer, as the estimator takes them."""
    gyro_ns, relative = _ns(columns), _field(columns, "accelerometer_timestamp_relative").astype(np.int64)
    known = relative != NO_ACCEL
    gyro, accel = (_vectors(columns, f"{n}[0] {n}[1] {n}[2]") * FLU_FROM_FRD for n in ("gyro_rad", "accelerometer_m_s2"))
    return gyro_ns, gyro, (gyro_ns + relative * 1000)[known], accel[known]


def _pair(gyro: Columns, accel: Columns) -> tuple[Any, Any, Any, Any] | None:
    """Stamps and values of both sensors; None if the gyro is logged too slowly."""
    gyro_ns, rates = _samples(gyro)
    if len(gyro_ns) < 2 or (len(gyro_ns) - 1) * 1e9 < MIN_IMU_HZ * float(gyro_ns[-1] - gyro_ns[0]):
        return None
    return (gyro_ns, rates, *_samples(accel))


def _samples(columns: Columns) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, "n 3"]]:
    """Stamps and values of a sensor in FLU; the samples of a FIFO are spread over its time."""
    if "samples" not in columns or "dt" not in columns:
        return _sample_ns(columns), _vectors(columns, "x y z") * FLU_FROM_FRD
    counts = columns["samples"].astype(np.int64)
    size = sum(1 for name in columns if re.fullmatch(r"x\[\d+\]", name))
    taken = np.arange(size)[None, :] < counts[:, None]
    back = (counts[:, None] - 1 - np.arange(size)[None, :]) * columns["dt"].astype(np.float64)[:, None] * 1000.0
    t_ns = _sample_ns(columns)[:, None] - np.rint(back).astype(np.int64)
    axes = [np.stack([_field(columns, f"{axis}[{n}]") for n in range(size)], axis=1) for axis in "xyz"]
    values = np.stack(axes, axis=2).astype(np.float64) * _field(columns, "scale").astype(np.float64)[:, None, None]
    return t_ns[taken], values[taken] * FLU_FROM_FRD


def poses_of(topics: dict[str, Columns], remarks: Remarks) -> dict[str, Poses]:
    """Poses of the simulated truth and of the estimator."""
    found: dict[str, Poses] = {}
    for topic, ending in (("/ground_truth/pose", "_groundtruth"), ("/ekf/pose", "")):
        try:
            poses = _poses(topics, ending, remarks)
        except DataError as error:
            remarks.losses.append(f"{topic} is left out: {error.what}")
        else:
            found |= {} if poses is None else {topic: poses}
    return found


def _poses(topics: dict[str, Columns], ending: str, remarks: Remarks) -> Poses | None:
    """Poses in ENU at the stamps of the attitude; position and velocity are interpolated between PX4's."""
    attitude, position = topics.get(f"vehicle_attitude{ending}"), topics.get(f"vehicle_local_position{ending}")
    if attitude is None:
        return None
    turns = _vectors(attitude, "q[0] q[1] q[2] q[3]")
    turns[~turns.any(axis=1)] = np.nan  # not set yet
    q = in_order(_sample_ns(attitude), turns, f"vehicle_attitude{ending}")
    remarks.notes.extend(q.notes)
    if not len(q.t_ns):
        return None
    t_ns, q_ned_frd_wxyz = q.t_ns, quaternion.unit(q.values)
    p_wb, v_w = np.zeros((len(t_ns), 3)), None
    has_position = position is not None and {*"xyz"} <= position.keys()
    if position is not None and has_position:
        names = "y x z vy vx vz" if {"vx", "vy", "vz"} <= position.keys() else "y x z"
        moves = in_order(_sample_ns(position), _vectors(position, names), f"vehicle_local_position{ending}")
        if has_position := len(moves.t_ns) > 1:
            inside = (t_ns >= moves.t_ns[0]) & (t_ns <= moves.t_ns[-1])
            t_ns, q_ned_frd_wxyz, start = t_ns[inside], q_ned_frd_wxyz[inside], moves.t_ns[0]
            both = interpolate((t_ns - start).astype(float), (moves.t_ns - start).astype(float), moves.values)
            p_wb, v_w = both[:, :3] * UP_FROM_DOWN, both[:, 3:] * UP_FROM_DOWN if both.shape[1] > 3 else None
    if not has_position:
        remarks.notes.append(f"vehicle_attitude{ending} has no positions with it: those of its poses are zero")
    return Poses(t_ns, p_wb, quaternion.unit(quaternion.enu_from_ned(q_ned_frd_wxyz)), v_w)


def log_of(
    sequence: Sequence, format: str, topics: dict[str, Columns], poses: dict[str, Poses], start_ns: int, remarks: Remarks
) -> MessageLog:
    """Message log of topics and their poses."""
    frames = "IMU and poses: FLU body in ENU; px4_msgs topics: FRD in NED"
    return MessageLog(
        sequence.name,
        sequence.path.name,
        imus=imus_of(topics, remarks),
        poses=poses,
        tables={f"/{name}": _table(name, columns, start_ns) for name, columns in topics.items()},
        kinds={topic: "truth" if topic.startswith("/ground_truth") else "estimate" for topic in poses},
        metadata={"imutool": {"format": format, "sequence": sequence.name, "frames": frames}},
        remarks=remarks,
    )


def _table(name: str, columns: Columns, start_ns: int) -> Table:
    """Columns of a PX4 topic as a message; `q[0]`, `q[1]`, ... are one field."""
    groups: dict[str, list[str]] = {}
    for column in columns:
        groups.setdefault(re.sub(r"\[\d+\]$", "", column), []).append(column)
    fields, values = [], dict[str, np.ndarray]()
    for group, members in groups.items():
        field = re.sub(r"[^a-z0-9]+", "_", group.lower()).strip("_") or "unnamed"
        while field in values:  # damage makes names alike
            field = f"{field}_{len(values)}"
        kind = np.result_type(*(columns[member].dtype for member in members))
        shape = (len(members),) if members != [group] else ()
        fields.append((field, kind, shape))
        values[field] = np.stack([columns[m] for m in members], axis=1) if shape else columns[group]
    rows = np.zeros(len(columns["timestamp"]), np.dtype(fields))
    for field, value in values.items():
        rows[field] = value
    t_ns = _ns(columns)
    t_ns[t_ns == 0] = start_ns  # never published: the stamp 0 is kept in the message
    order = np.argsort(t_ns, kind="stable")
    message = "".join(part.capitalize() for part in name.partition("/")[0].split("_"))
    return Table(t_ns[order], rows[order], f"px4_msgs/msg/{message}")
