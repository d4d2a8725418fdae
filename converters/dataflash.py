"""ArduPilot DataFlash (.bin, .log): IMUs in FLU, EKF poses as an estimate, every message.

The log describes its own messages (FMT), in binary or as text with a message a line; no library is needed. ArduPilot measures
in FRD and its world is NED: the IMU and pose topics are written in FLU and ENU, the other topics keep its own frames. Stamps
are the time since boot.
"""

from __future__ import annotations

import re
import struct
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from imutool.errors import DataError
from imutool.geometry import quaternion
from imutool.recording import Imu, Poses
from imutool.recording.joined_imu import in_order
from imutool.recording.message_log import MessageLog, Remarks, Table

from . import Sequence
from ._archive import refusing
from ._source import find_files
from .ulog import FLU_FROM_FRD, Q_ENU_FROM_NED_WXYZ, Q_FRD_FROM_FLU_WXYZ

GENERAL = True
HEAD, FMT = b"\xa3\x95", 128
FMT_SIZE = 89
TYPES = {
    **{"b": "i1", "B": "u1", "M": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4", "q": "<i8", "Q": "<u8", "f": "<f4"},
    **{"d": "<f8", "L": "<i4", "c": "<i2", "C": "<u2", "e": "<i4", "E": "<u4", "n": "S4", "N": "S16", "Z": "S64"},
    "a": "(32,)<i2",
}
IMU_FIELDS = "GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ"
POSE_FIELDS = "PE", "PN", "PD", "VE", "VN", "VD", "Roll", "Pitch", "Yaw"
TEXT_START = b"FMT, 128, 89, FMT"
TEXT_TYPES = {**TYPES, "M": "S16"}  # a mode is written by its name
TEXT_SCALES = {**dict.fromkeys("cCeE", 100.0), "L": 1e7}  # of binary integers that text shows as decimals


class _Format(NamedTuple):
    """A message type: name, length with its head, field types as letters, and labels."""

    name: str
    size: int
    letters: str
    labels: list[str]

    @property
    def dtype(self) -> np.dtype[np.void]:
        """Layout of the payload."""
        return np.dtype([(label, TYPES[letter]) for label, letter in zip(self.labels, self.letters, strict=True)])


def sequences(source: Path) -> list[Sequence]:
    """DataFlash logs in the source, by their first bytes: the format of the formats."""
    starts = HEAD + bytes([FMT, FMT, FMT_SIZE]), TEXT_START
    return find_files(source, (".bin", ".log"), lambda start: start.startswith(starts))


def recognises(sequence: Sequence) -> bool:
    """Whether a sequence is a DataFlash log: always, as only these are listed."""
    return True


def read_sequence(sequence: Sequence, *, images: bool = True) -> MessageLog:
    """Message log of a DataFlash log.

    Raises:
        DataError: it cannot be read, or holds no message.
    """
    remarks = Remarks()
    with refusing(sequence.path):
        raw = sequence.path.read_bytes()
    columns = (_text_columns if raw.startswith(TEXT_START) else _columns)(raw, remarks)
    metadata = {"imutool": {"format": "dataflash", "sequence": sequence.name, "frames": "IMU and poses: FLU body in ENU"}}
    if "PARM" in columns and {"Name", "Value"} <= set(columns["PARM"].dtype.names or ()):
        metadata["ardupilot/parameters"] = {_text(r["Name"]): str(float(r["Value"])) for r in columns["PARM"]}
    if "MSG" in columns and {"TimeUS", "Message"} <= set(columns["MSG"].dtype.names or ()):
        metadata["ardupilot/messages"] = {f"{r['TimeUS']} us": _text(r["Message"]) for r in columns["MSG"]}
    timed = {name: c for name, c in columns.items() if "TimeUS" in (c.dtype.names or ())}
    if not timed:
        raise DataError("holds no messages with a time", where=sequence.path, expected="a log of ArduPilot")
    if untimed := sorted(columns.keys() - timed.keys() - {"PARM"}):
        remarks.losses.append(f"messages without a time are left out: {', '.join(untimed)}")
    poses = _poses(timed, remarks)
    return MessageLog(
        sequence.name,
        sequence.path.name,
        imus=_imus(timed, remarks),
        poses=poses,
        kinds=dict.fromkeys(poses, "estimate"),
        tables={f"/{name}": _table(name, rows) for name, rows in timed.items()},
        metadata=metadata,
        remarks=remarks,
    )


def read(source: Path) -> Iterator[MessageLog]:
    """Message logs of all DataFlash logs of the source, one after the other."""
    return map(read_sequence, sequences(source))


def _columns(raw: bytes, remarks: Remarks) -> dict[str, np.ndarray]:
    """Messages of every type as a structured array; bytes that are no message are counted."""
    formats: dict[int, _Format] = {FMT: _Format("FMT", FMT_SIZE, "", [])}
    offsets: dict[int, list[int]] = defaultdict(list)
    position = lost = 0
    while position + 3 <= len(raw):
        kind = formats.get(raw[position + 2]) if raw.startswith(HEAD, position) else None
        if kind is None or position + kind.size > len(raw):
            following = raw.find(HEAD, position + 1)
            end = len(raw) if following < 0 else following
            lost, position = lost + end - position, end
            continue
        if raw[position + 2] == FMT:
            _define(formats, raw[position + 3 : position + FMT_SIZE])
        else:
            offsets[raw[position + 2]].append(position)
        position += kind.size
    if lost:
        remarks.losses.append(f"{lost} bytes of the log are no message that it describes")
    data = np.frombuffer(raw, np.uint8)
    columns = {}
    for number, places in offsets.items():
        size = formats[number].size
        rows = data[np.array(places)[:, None] + np.arange(3, size)[None, :]]
        columns[formats[number].name] = np.ascontiguousarray(rows).view(formats[number].dtype)[:, 0]
    return columns


def _text_columns(raw: bytes, remarks: Remarks) -> dict[str, np.ndarray]:
    """Messages of a log in text, as those of the binary one; lines that are no message are counted."""
    formats: dict[str, _Format] = {}
    lines: dict[str, list[list[str]]] = defaultdict(list)
    lost = 0
    for line in raw.decode("latin-1").splitlines():
        name, _, content = line.partition(",")
        if name == "FMT" and content.count(",") >= 4:
            number, _, label, letters, labels = (part.strip() for part in content.split(",", 4))
            fields = [field.strip() for field in labels.split(",") if field.strip()]
            known = len(fields) == len(letters) == len(set(fields)) and set(letters) <= TYPES.keys() - {"a"}
            if known and number != str(FMT):
                formats[label] = _Format(label, 0, letters, fields)
        elif (form := formats.get(name)) is not None:
            values = [value.strip() for value in content.split(",", len(form.labels) - 1)]
            if len(values) == len(form.labels) and all(values):
                lines[name].append(values)
            else:
                lost += 1
        elif line.strip() and name != "FMT":
            lost += 1
    if lost:
        remarks.losses.append(f"{lost} lines of the log are no message that it describes")
    columns = {}
    for name, rows in lines.items():
        try:
            columns[name] = _from_text(formats[name], rows)
        except (ValueError, OverflowError) as error:
            remarks.losses.append(f"{len(rows)} messages {name} are left out: {error}")
    return columns


def _from_text(form: _Format, rows: list[list[str]]) -> np.ndarray:
    """Messages of a type as a structured array, in the units of the binary log."""
    found = np.zeros(len(rows), [(label, TEXT_TYPES[letter]) for label, letter in zip(form.labels, form.letters, strict=True)])
    for label, letter, texts in zip(form.labels, form.letters, zip(*rows, strict=True), strict=True):
        kind = found.dtype[label]
        if letter in TEXT_SCALES:
            scaled, held = np.rint(np.array(texts, float) * TEXT_SCALES[letter]), np.iinfo(kind)
            if not ((scaled >= held.min) & (scaled <= held.max)).all():
                raise ValueError(f"a {label} is beyond what the binary log holds")
            found[label] = scaled.astype(kind)
        elif kind.kind == "S":
            found[label] = [text.encode("latin-1") for text in texts]
        else:
            found[label] = np.array([int(text) for text in texts] if kind.kind in "iu" else texts, kind)
    return found


def _define(formats: dict[int, _Format], content: bytes) -> None:
    """Take in a FMT message; a type whose fields are not known is passed over."""
    number, size, name, letters, labels = struct.unpack("<BB4s16s64s", content)
    fields = [label for label in _text(labels).split(",") if label]
    form = _Format(_text(name), size, _text(letters), fields)
    known = len(fields) == len(form.letters) and set(form.letters) <= TYPES.keys() and len(set(fields)) == len(fields)
    if known and number != FMT and form.dtype.itemsize == size - 3:
        formats[number] = form


def _text(raw: bytes) -> str:
    return bytes(raw).partition(b"\0")[0].decode("ascii", "replace")


def _instances(columns: dict[str, np.ndarray], name: str) -> dict[int, np.ndarray]:
    """Rows by sensor: IMU with its field `I`, or IMU, IMU2, IMU3 of older logs."""
    found: dict[int, np.ndarray] = {}
    for key, rows in columns.items():
        if (match := re.fullmatch(rf"{name}(\d?)", key)) is not None:
            if "I" in (rows.dtype.names or ()):
                found |= {int(number): rows[rows["I"] == number] for number in np.unique(rows["I"])}
            else:
                found[int(match[1] or 1) - 1] = rows
    return found


def _are_numbers(rows: np.ndarray, fields: tuple[str, ...]) -> bool:
    return all(field in (rows.dtype.names or ()) and rows.dtype[field].kind != "S" for field in fields)


def _imus(columns: dict[str, np.ndarray], remarks: Remarks) -> dict[str, Imu]:
    imus = {}
    for number, rows in sorted(_instances(columns, "IMU").items()):
        if not _are_numbers(rows, IMU_FIELDS):
            remarks.losses.append(f"/imu{number} lacks numbers of {', '.join(IMU_FIELDS)}")
            continue
        values = np.stack([rows[f] for f in IMU_FIELDS], axis=1).astype(float)
        kept = in_order(rows["TimeUS"].astype(np.int64) * 1000, values, f"/imu{number}")
        remarks.notes.extend(kept.notes)
        imus[f"/imu{number}"] = Imu(kept.t_ns, kept.values[:, :3] * FLU_FROM_FRD, kept.values[:, 3:] * FLU_FROM_FRD)
    if not imus:
        remarks.losses.append("the log has no samples of an IMU")
    return imus


def _poses(columns: dict[str, np.ndarray], remarks: Remarks) -> dict[str, Poses]:
    """Poses of the first EKF core in ENU."""
    rows = next((columns[name] for name in ("XKF1", "NKF1") if name in columns), None)
    if rows is None:
        return {}
    if not _are_numbers(rows, POSE_FIELDS):
        remarks.losses.append(f"the EKF's message lacks numbers of {', '.join(POSE_FIELDS)}")
        return {}
    if "C" in (rows.dtype.names or ()):
        rows = rows[rows["C"] == rows["C"].min()]
    angles = [rows[f] * (0.01 if rows.dtype[f].kind in "iu" else 1.0) for f in POSE_FIELDS[6:]]  # as centidegrees
    values = np.stack([*(rows[f] for f in POSE_FIELDS[:6]), *angles], axis=1).astype(float)
    kept = in_order(rows["TimeUS"].astype(np.int64) * 1000, values, "/ekf/pose")
    remarks.notes.extend(kept.notes)
    roll, pitch, yaw = np.radians(kept.values[:, 6:]).T
    about_x, about_y, about_z = np.eye(3)[:, None, :] * np.stack([roll, pitch, yaw])[:, :, None]
    q_ned_frd = quaternion.multiply(
        quaternion.multiply(quaternion.exp(about_z), quaternion.exp(about_y)), quaternion.exp(about_x)
    )
    q_wb = quaternion.multiply(quaternion.multiply(Q_ENU_FROM_NED_WXYZ, q_ned_frd), Q_FRD_FROM_FLU_WXYZ)
    up = np.array([1.0, 1.0, -1.0])
    return {"/ekf/pose": Poses(kept.t_ns, kept.values[:, :3] * up, quaternion.unit(q_wb), kept.values[:, 3:6] * up)}


def _table(name: str, rows: np.ndarray) -> Table:
    """Numbers of a message type; texts are left to the metadata."""
    names = [field for field in rows.dtype.names or () if rows.dtype[field].kind != "S"]
    fields = [(_field(field), rows.dtype[field]) for field in names]
    content = np.zeros(len(rows), np.dtype(fields))
    for field, (new, _) in zip(names, fields, strict=True):
        content[new] = rows[field]
    t_ns = rows["TimeUS"].astype(np.int64) * 1000
    order = np.argsort(t_ns, kind="stable")
    return Table(t_ns[order], content[order], f"ardupilot/msg/{name.capitalize()}")


def _field(label: str) -> str:
    """Field name that ROS 2 allows: `gyr_x` for `GyrX`."""
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", label)
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_") or "field"
