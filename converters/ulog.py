"""PX4 ULog (.ulg): IMUs in FLU, EKF poses as an estimate, simulated truth, every topic.

Frames: PX4 measures in FRD (x forward, y right, z down) and its world is NED. The IMU and pose topics are written in FLU (x
forward, y left, z up) and ENU, as ROS has them: y and z of the body change sign. The topics of PX4 keep its own frames, as
messages of the types px4_msgs. Stamps are PX4's own clock, in most logs the time since boot.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from functools import partial
from io import BufferedReader, FileIO, StringIO
from mmap import ACCESS_READ, mmap
from os import fstat
from pathlib import Path
from typing import Any

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.errors import DataError, required
from imutool.geometry import quaternion
from imutool.recording import Imu, Poses
from imutool.recording.joined_imu import joined
from imutool.recording.message_log import MessageLog, Remarks, Table
from imutool.recording.sample_order import in_order

from . import Sequence
from ._source import find_files, head
from ._ulog_texts import log_topic, logged

GENERAL = True
MAGIC, ENCRYPTED = b"ULog\x01\x12\x35", b"ULogEnc"
HEADER_BYTES = 16
READS_A_BYTE = 2  # at most: where it finds damage, pyulog reads head and content of a message at each byte
LEAST_IMU_HZ = 10.0  # slower logs of a sensor are samples for its temperature, not for its motion
FLU_FROM_FRD = np.array([1.0, -1.0, -1.0])
UP_FROM_DOWN = np.array([1.0, 1.0, -1.0])
Q_ENU_FROM_NED_WXYZ = np.array([[0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0]])
Q_FRD_FROM_FLU_WXYZ = np.array([[0.0, 1.0, 0.0, 0.0]])
LATEST_US = 2**31 * 1_000_000  # that the stamp of a ROS 2 message holds
NO_ACCEL = 0x7FFFFFFF  # accelerometer_timestamp_relative without an accelerometer
Columns = dict[str, np.ndarray]


def sequences(source: Path) -> list[Sequence]:
    """ULog files in the source, by their first bytes."""
    return find_files(source, (".ulg", ".ulge"), lambda start: start.startswith((MAGIC, ENCRYPTED)))


def recognises(sequence: Sequence) -> bool:
    """Whether a sequence is a ULog: always, as only ULogs are listed."""
    return True


def read_sequence(sequence: Sequence, *, images: bool = True) -> MessageLog:
    """Message log of a ULog.

    Raises:
        ConfigError: pyulog is not installed.
        DataError: the file is encrypted, damaged beyond reading, or holds no data.
    """
    ulog = _open(sequence.path)
    remarks = Remarks()
    topics: dict[str, Columns] = {}
    several = {data.name for data in ulog.data_list if data.multi_id > 0}
    for data in ulog.data_list:
        name = f"{data.name}/{data.multi_id}" if data.name in several else data.name
        if len(data.data.get("timestamp", ())):
            topics[name] = data.data
    if not topics:
        raise DataError("holds no data", where=sequence.path, expected="a log with messages")
    if ulog.file_corruption:
        remarks.losses.append("the file is damaged: some of its messages could not be read")
    elif _is_cut(sequence.path):
        remarks.losses.append("the file ends within a message: what came after is lost")
    if ulog.dropouts:
        lost_s = sum(dropout.duration for dropout in ulog.dropouts) * 1e-3
        remarks.notes.append(f"PX4's dropouts: {len(ulog.dropouts)}, {lost_s:.3f} s in all: the topics have gaps there")
    if unstamped := sum(int((columns["timestamp"] == 0).sum()) for columns in topics.values()):
        remarks.notes.append(f"messages that PX4 gave no stamp: {unstamped}; they are logged at the start of the log")
    poses = _all_poses(topics, remarks)
    texts = [(m.timestamp * 1000, m.log_level_str(), m.message) for m in ulog.logged_messages if m.timestamp < LATEST_US]
    if len(texts) < len(ulog.logged_messages):
        remarks.losses.append(f"texts with an impossible time: {len(ulog.logged_messages) - len(texts)}")
    return MessageLog(
        sequence.name,
        sequence.path.name,
        topics=(log_topic(),) if texts else (),
        messages=partial(logged, texts),
        imus=_imus(topics, remarks),
        poses=poses,
        tables={f"/{name}": _table(name, columns, 1000 * ulog.start_timestamp) for name, columns in topics.items()},
        kinds={topic: "truth" if topic.startswith("/ground_truth") else "estimate" for topic in poses},
        metadata=_metadata(sequence, ulog),
        remarks=remarks,
    )


def read(source: Path) -> Iterator[MessageLog]:
    """Message logs of all ULogs of the source, one after the other."""
    return map(read_sequence, sequences(source))


def _open(path: Path) -> Any:
    pyulog = required("pyulog", "ulog", where=path, user="reading ULogs")
    if head(path, len(ENCRYPTED)) == ENCRYPTED:
        raise DataError("is encrypted", where=path, fix="Decrypt it with PX4's Tools/decrypt_ulog.py first")
    printing = logging.getLogger("pyulog")
    printing.setLevel(logging.ERROR)
    try:
        # pyulog leaves a file that it refuses open, and prints where our reports go
        with _FiniteFile(FileIO(path)) as file, redirect_stdout(StringIO()):
            return pyulog.ULog(file, None, True)
    except Exception as error:  # pyulog raises TypeError, struct.error, KeyError, IndexError: whatever the bytes lead to
        raise DataError(f"cannot be read as a ULog ({error or type(error).__name__})", where=path) from error


class _FiniteFile(BufferedReader):
    """File that can be read a limited number of times: pyulog 1.3 reads one kind of damage for ever."""

    def __init__(self, raw: FileIO) -> None:
        super().__init__(raw)
        self._left = READS_A_BYTE * fstat(raw.fileno()).st_size + HEADER_BYTES

    def read(self, size: int | None = -1, /) -> bytes:
        """Some bytes, until there were more readings than a file of this size can need."""
        self._left -= 1
        if self._left < 0:
            raise EOFError("it begins again and again")
        return super().read(size)


def _is_cut(path: Path) -> bool:
    """Whether a sound ULog ends within a message, as after a loss of power; pyulog does not tell."""
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as raw:
        position = HEADER_BYTES
        while position + 3 <= len(raw):  # size of what follows (two bytes) and kind (one)
            position += 3 + raw[position] + 256 * raw[position + 1]
        return position != len(raw)


def _metadata(sequence: Sequence, ulog: Any) -> dict[str, dict[str, str]]:
    own = {"format": "ulog", "sequence": sequence.name, "frames": "IMU and poses: FLU body in ENU; px4_msgs topics: FRD in NED"}
    return {
        "imutool": own,
        "px4/info": {name: str(value) for name, value in ulog.msg_info_dict.items()},
        "px4/parameters": {name: str(value) for name, value in ulog.initial_parameters.items()},
        "px4/changed_parameters": {f"{t} us {name}": str(value) for t, name, value in ulog.changed_parameters},
        "px4/dropouts": {f"{dropout.timestamp} us": f"{dropout.duration} ms" for dropout in ulog.dropouts},
    }


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


def _imus(topics: dict[str, Columns], remarks: Remarks) -> dict[str, Imu]:
    """IMU of the estimator, and those of each sensor that is logged fast enough."""
    imus: dict[str, Imu] = {}
    if "sensor_combined" in topics:
        _put(imus, "/imu", partial(_combined, topics["sensor_combined"]), remarks)
    for name in sorted(topics):
        gyro_name, accel_name = re.fullmatch(r"sensor_gyro(?:_fifo)?(?:/(\d+))?", name), name.replace("gyro", "accel")
        if gyro_name is not None and accel_name in topics:
            topic = f"/imu/{'fifo' if 'fifo' in name else 'sensor'}{int(gyro_name[1] or 0)}"
            _put(imus, topic, partial(_pair, topics[name], topics[accel_name]), remarks)
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
    if len(gyro_ns) < 2 or (len(gyro_ns) - 1) * 1e9 < LEAST_IMU_HZ * float(gyro_ns[-1] - gyro_ns[0]):
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


def _all_poses(topics: dict[str, Columns], remarks: Remarks) -> dict[str, Poses]:
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
    q = in_order(_sample_ns(attitude), _vectors(attitude, "q[0] q[1] q[2] q[3]"), f"vehicle_attitude{ending}")
    remarks.notes.extend(q.notes)
    if not len(q.t_ns):
        return None
    t_ns, q_ned_frd = q.t_ns, quaternion.unit(q.values)
    p_wb, v_w = np.zeros((len(t_ns), 3)), None
    has_position = position is not None and {*"xyz"} <= position.keys()
    if position is not None and has_position:
        names = "y x z vy vx vz" if {"vx", "vy", "vz"} <= position.keys() else "y x z"
        moves = in_order(_sample_ns(position), _vectors(position, names), f"vehicle_local_position{ending}")
        if has_position := len(moves.t_ns) > 1:
            inside = (t_ns >= moves.t_ns[0]) & (t_ns <= moves.t_ns[-1])
            t_ns, q_ned_frd, start = t_ns[inside], q_ned_frd[inside], moves.t_ns[0]
            knots, t = (moves.t_ns - start).astype(float), (t_ns - start).astype(float)
            both = np.stack([np.interp(t, knots, column) for column in moves.values.T], axis=1)
            p_wb, v_w = both[:, :3] * UP_FROM_DOWN, both[:, 3:] * UP_FROM_DOWN if both.shape[1] > 3 else None
    if not has_position:
        remarks.notes.append(f"vehicle_attitude{ending} has no positions with it: those of its poses are zero")
    q_wb = quaternion.multiply(quaternion.multiply(Q_ENU_FROM_NED_WXYZ, q_ned_frd), Q_FRD_FROM_FLU_WXYZ)
    return Poses(t_ns, p_wb, quaternion.unit(q_wb), v_w)


def _table(name: str, columns: Columns, start_ns: int) -> Table:
    """Columns of a PX4 topic as a message; `q[0]`, `q[1]`, ... are one field."""
    groups: dict[str, list[str]] = {}
    for column in columns:
        groups.setdefault(re.sub(r"\[\d+\]$", "", column), []).append(column)
    fields, values = [], {}
    for group, members in groups.items():
        field = re.sub(r"[^a-z0-9]+", "_", group.lower()).strip("_") or "unnamed"
        while field in values:  # damage makes names alike
            field += "_"
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
