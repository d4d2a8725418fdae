"""ArduPilot DataFlash (.bin, .log): IMUs in FLU, EKF poses as an estimate, simulated truth.

The log describes its own messages (FMT), in binary or as text with a message a line; no library is needed. ArduPilot measures
in FRD and its world is NED: the IMU and pose topics are written in FLU and ENU, the other topics keep its own frames. Stamps
are the time since boot.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from imutool.errors import DataError
from imutool.geometry import quaternion
from imutool.geometry.quaternion import FLU_FROM_FRD
from imutool.recording import Imu, Poses, Scalars
from imutool.recording.joined_imu import joined
from imutool.recording.message_log import MessageLog, Remarks, Table
from imutool.recording.sample_order import in_order

from . import Sequence
from ._archive import refusing
from ._dataflash_messages import FMT, FMT_SIZE, HEAD, TEXT_START, Messages, read_messages, text_of
from ._source import find_files
from ._tables.columns.geodetic import plane

GENERAL = True
TEMPERATURES = "T", "Temp"  # of the sensor, in degrees Celsius; of older logs the second
IMU_FIELDS = "GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ"
POSE_FIELDS = "PE", "PN", "PD", "VE", "VN", "VD", "Roll", "Pitch", "Yaw"
US = 1000  # ns
TRUTH = "/ground_truth/pose"
SIMULATED_FIELDS = "Lat", "Lng", "Alt", "Q1", "Q2", "Q3", "Q4"  # in 1e-7 degrees and m; of the simulator SITL alone
EKF_TYPES = "XKF1", "NKF1", "EKF1"  # of EKF3, of EKF2, and of the EKF of logs before 2016


def sequences(source: Path) -> list[Sequence]:
    """DataFlash logs in the source, by their first bytes: the format of the formats."""
    starts = HEAD + bytes([FMT, FMT, FMT_SIZE]), TEXT_START
    return find_files(source, (".bin", ".log"), lambda start: start.startswith(starts))


def read_sequence(sequence: Sequence, *, images: bool = True) -> MessageLog:
    """Message log of a DataFlash log.

    Raises:
        DataError: it cannot be read, or holds no message.
    """
    remarks = Remarks()
    with refusing(sequence.path):
        raw = sequence.path.read_bytes()
    messages = read_messages(raw, remarks)
    if not messages:
        raise DataError("holds no messages with a time", where=sequence.path, expected="TimeUS or TimeMS in some of them")
    metadata = {"imutool": {"format": "dataflash", "sequence": sequence.name, "frames": "IMU and poses: FLU body in ENU"}}
    if "PARM" in messages and {"Name", "Value"} <= set(messages["PARM"].fields):
        metadata["ardupilot/parameters"] = {text_of(r["Name"]): str(float(r["Value"])) for r in messages["PARM"].rows}
    if "MSG" in messages and "Message" in messages["MSG"].fields:
        metadata["ardupilot/messages"] = _said(messages["MSG"])
    poses = _poses(messages, remarks) | _simulated_poses(messages, remarks)
    return MessageLog(
        sequence.name,
        sequence.path.name,
        imus=_imus(messages, remarks),
        poses=poses,
        scalars=_temperatures(messages),
        kinds={topic: "truth" if topic == TRUTH else "estimate" for topic in poses},
        tables={f"/{name}": _table(name, group) for name, group in messages.items()},
        metadata=metadata,
        remarks=remarks,
    )


def read(source: Path) -> Iterator[MessageLog]:
    """Message logs of all DataFlash logs of the source, one after the other."""
    return map(read_sequence, sequences(source))


def _said(messages: Messages) -> dict[str, str]:
    """Texts of the autopilot by their time; several of one time are numbered."""
    found: dict[str, str] = {}
    counts = Counter[str]()
    for t_ns, row in zip(messages.t_ns, messages.rows, strict=True):
        key = f"{t_ns // 1000} us"
        counts[key] += 1
        found[key if counts[key] == 1 else f"{key}, {counts[key]}"] = text_of(row["Message"])
    return found


def _instances(messages: dict[str, Messages], name: str) -> dict[int, Messages]:
    """Messages by sensor: IMU with its field `I`, or IMU, IMU2, IMU3 of older logs."""
    found: dict[int, Messages] = {}
    for key, group in messages.items():
        if (match := re.fullmatch(rf"{name}(\d?)", key)) is not None:
            if "I" in group.fields:
                found |= {int(number): group.where(group.rows["I"] == number) for number in np.unique(group.rows["I"])}
            else:
                found[int(match[1] or 1) - 1] = group
    return found


def _are_numbers(messages: Messages, fields: tuple[str, ...]) -> bool:
    return all(field in messages.fields and messages.rows.dtype[field].kind != "S" for field in fields)


def _imus(messages: dict[str, Messages], remarks: Remarks) -> dict[str, Imu]:
    imus = {}
    for number, group in sorted(_instances(messages, "IMU").items()):
        if not _are_numbers(group, IMU_FIELDS):
            remarks.losses.append(f"/imu{number} lacks numbers of {', '.join(IMU_FIELDS)}")
            continue
        values = np.stack([group.rows[f] for f in IMU_FIELDS], axis=1).astype(float)
        kept = in_order(group.t_ns, values, f"/imu{number}")
        remarks.notes.extend(kept.notes)
        imus[f"/imu{number}"] = Imu(kept.t_ns, kept.values[:, :3] * FLU_FROM_FRD, kept.values[:, 3:] * FLU_FROM_FRD)
    imus |= _raw_imus(messages, remarks)
    if not imus:
        remarks.losses.append("the log has no samples of an IMU")
    return imus


def _temperatures(messages: dict[str, Messages]) -> dict[str, Scalars]:
    """Temperature of each IMU; none of one that measures none and writes zeros."""
    found = {}
    for number, group in sorted(_instances(messages, "IMU").items()):
        field = next((name for name in TEMPERATURES if _are_numbers(group, (name,))), None)
        if field is not None and group.rows[field].any():
            kept = in_order(group.t_ns, group.rows[field].astype(float)[:, None], f"/imu{number}")
            found[f"/imu{number}/temperature"] = Scalars(kept.t_ns, kept.values, "degC")
    return found


def _raw_imus(messages: dict[str, Messages], remarks: Remarks) -> dict[str, Imu]:
    """IMUs of raw samples (GYR and ACC), which a log holds on request, at the times when they were taken."""
    imus = {}
    gyros, accels = (_instances(messages, name) for name in ("GYR", "ACC"))
    for number in sorted(gyros.keys() & accels.keys()):
        both = (gyros[number], ("SampleUS", *IMU_FIELDS[:3])), (accels[number], ("SampleUS", *IMU_FIELDS[3:]))
        if not all(_are_numbers(group, fields) for group, fields in both):
            continue
        columns = []
        for group, (clock, *axes) in both:
            values = np.stack([group.rows[axis] for axis in axes], axis=1).astype(float)
            columns += [group.rows[clock].astype(np.int64) * US, values * FLU_FROM_FRD]
        gyro_ns, rates, accel_ns, forces = columns
        topic = f"/imu{number}/raw"
        try:
            imus[topic], _, notes = joined(gyro_ns, rates, accel_ns, forces, topic)
        except DataError as error:
            remarks.losses.append(f"{topic} is left out: {error.what}")
        else:
            remarks.notes.extend(notes)
    return imus


def _poses(messages: dict[str, Messages], remarks: Remarks) -> dict[str, Poses]:
    """Poses of the first EKF core in ENU."""
    group = next((messages[name] for name in EKF_TYPES if name in messages), None)
    if group is None:
        return {}
    if not _are_numbers(group, POSE_FIELDS):
        remarks.losses.append(f"the EKF's message lacks numbers of {', '.join(POSE_FIELDS)}")
        return {}
    if "C" in group.fields:
        group = group.where(group.rows["C"] == group.rows["C"].min())
    rows = group.rows
    angles = [rows[f] * (0.01 if rows.dtype[f].kind in "iu" else 1.0) for f in POSE_FIELDS[6:]]  # as centidegrees
    values = np.stack([*(rows[f] for f in POSE_FIELDS[:6]), *angles], axis=1).astype(float)
    kept = in_order(group.t_ns, values, "/ekf/pose")
    remarks.notes.extend(kept.notes)
    q_wb_wxyz = quaternion.enu_from_ned(quaternion.of_roll_pitch_yaw(np.radians(kept.values[:, 6:])))
    up = np.array([1.0, 1.0, -1.0])
    return {"/ekf/pose": Poses(kept.t_ns, kept.values[:, :3] * up, quaternion.unit(q_wb_wxyz), kept.values[:, 3:6] * up)}


def _simulated_poses(messages: dict[str, Messages], remarks: Remarks) -> dict[str, Poses]:
    """True poses of a simulated flight in ENU, about the first."""
    if "SIM" not in messages or not _are_numbers(messages["SIM"], SIMULATED_FIELDS):
        return {}
    rows = messages["SIM"].rows
    values = np.stack([rows[f] for f in SIMULATED_FIELDS], axis=1).astype(float)
    values[~values[:, 3:].any(axis=1)] = np.nan  # no rotation
    kept = in_order(messages["SIM"].t_ns, values, TRUTH)
    remarks.notes.extend(kept.notes)
    if not len(kept.t_ns):
        return {}
    north, east, down = plane(kept.values[:, :3] * [*2 * [np.radians(1e-7)], 1.0]).T
    q_wb_wxyz = quaternion.enu_from_ned(quaternion.unit(kept.values[:, 3:]))
    return {TRUTH: Poses(kept.t_ns, np.stack([east, north, -down], axis=1), quaternion.unit(q_wb_wxyz))}


def _table(name: str, messages: Messages) -> Table:
    """Numbers of a message type; texts are left to the metadata."""
    rows = messages.rows
    names = [field for field in messages.fields if rows.dtype[field].kind != "S"]
    fields: list[tuple[str, np.dtype[Any]]] = []
    for field in names:
        new = _field(field)
        while new in dict(fields):  # a script may log both Roll and roll
            new = f"{new}_{len(fields)}"
        fields.append((new, np.dtype("<f4") if rows.dtype[field] == np.float16 else rows.dtype[field]))
    content = np.zeros(len(rows), np.dtype(fields))
    for field, (new, _) in zip(names, fields, strict=True):
        content[new] = rows[field]
    order = np.argsort(messages.t_ns, kind="stable")
    return Table(messages.t_ns[order], content[order], f"ardupilot/msg/{name.replace('_', '').capitalize()}")


def _field(label: str) -> str:
    """Field name that ROS 2 allows: `gyr_x` for `GyrX`."""
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", label)
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_") or "field"
