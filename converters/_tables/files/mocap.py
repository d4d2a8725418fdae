"""Exports of motion captures: OptiTrack Motive, Vicon, Qualisys (text and .mat).

Each body becomes the columns `BODY/x [mm]`, ..., `BODY/qw`, ... next to one `time [s]`. Motive and Vicon write a quaternion
where they are asked to; Qualisys writes a matrix, column by column.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from imutool.array_types import Float64
from imutool.errors import DataError

from ..columns.rotations import of_matrices
from ..text.delimited import Columns

MOTIVE, VICON, QUALISYS = r"Format Version,", r"(Objects|Segments)[,;\s]*$", r"NO_OF_FRAMES\t"
LENGTHS = {"meters": "m", "centimeters": "cm", "millimeters": "mm"}
QUATERNION, PLACE = ("qx", "qy", "qz", "qw"), ("x", "y", "z")
FIX = "export the rotation as a quaternion"


def is_mocap(start: str) -> bool:
    """Whether a text is an export of a motion capture."""
    return re.match(rf"{MOTIVE}|{VICON}|{QUALISYS}", start.lstrip("\ufeff"), re.MULTILINE) is not None


def read_mocap(text: str, columns: Columns, path: Path) -> bool:
    """Add the bodies of an export; False for any other text.

    Raises:
        DataError: a matrix that does not rotate.
    """
    if not is_mocap(text):
        return False
    delimiter = "\t" if re.match(QUALISYS, text) else ","
    rows = [[field.strip() for field in row] for row in csv.reader(text.lstrip("\ufeff").splitlines(), delimiter=delimiter)]
    if delimiter == "\t":
        bodies = _qualisys(rows, columns, path)
    else:
        bodies = (_motive if re.match(MOTIVE, text.lstrip("\ufeff")) else _vicon)(rows, columns)
    _name_bodies(bodies, columns)
    return True


def read_mocap_mat(content: dict[str, Any], columns: Columns, path: Path) -> bool:
    """Add the rigid bodies of a .mat of Qualisys; False for any other content.

    A measurement is a structure with `FrameRate` and `RigidBodies`: positions in mm (bodies, 3, frames), matrices (bodies, 9,
    frames) column by column; of a single body without the first dimension.

    Raises:
        DataError: a matrix that does not rotate, or arrays that are no such measurement.
    """
    measured = [value for value in content.values() if isinstance(value, dict) and {"FrameRate", "RigidBodies"} <= value.keys()]
    body = measured[0]["RigidBodies"] if measured else {}
    if not (isinstance(body, dict) and {"Name", "Positions", "Rotations"} <= body.keys()):
        return False
    names = [str(name) for name in np.atleast_1d(body["Name"])]
    frames = np.atleast_1d(body["Positions"]).shape[-1]
    try:
        rate = float(measured[0]["FrameRate"])
        sizes = {"Positions": 3, "Rotations": 9}
        positions, rotations = (np.asarray(body[key], float).reshape(len(names), k, frames) for key, k in sizes.items())
    except (TypeError, ValueError) as error:
        raise DataError(f"its measurement of Qualisys cannot be read ({error})", where=path) from error
    if not 0.0 < rate < np.inf:
        raise DataError("its measurement of Qualisys has no frame rate", where=path, expected="FrameRate above 0 Hz")
    columns.add("time [s]", np.arange(frames) / rate, "s")
    columns.remarks.notes.append(f"a measurement of Qualisys at {rate:g} Hz, frames counted from 0 s, positions in mm")
    columns.is_mocap = True
    for name, position, rotation in reversed([*zip(names, positions, rotations, strict=True)]):
        q_wxyz = of_matrices(rotation.T.reshape(-1, 3, 3).transpose(0, 2, 1), path)
        _add_body(columns, name, position.T, q_wxyz[:, [1, 2, 3, 0]], "mm")
    _name_bodies(names, columns)
    return True


def _name_bodies(bodies: list[str], columns: Columns) -> None:
    if len(bodies) > 1:
        columns.remarks.notes.append(f"bodies in it: {', '.join(bodies)}; the first counts, and a map may name another")


def _motive(rows: list[list[str]], columns: Columns) -> list[str]:
    """Rigid bodies of OptiTrack Motive: the first row states units, and the rows above the numbers say what a column holds."""
    stated = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    head = next((n for n, row in enumerate(rows) if row[:1] == ["Frame"]), len(rows) - 1)
    labels = {row[1].lower(): row for row in rows[1:head] if len(row) > 1 and row[1]}
    kinds, names = labels.get("type", []), labels.get("name", [])
    table = _numbers(rows[head + 1 :], len(rows[head]))
    columns.add("time [s]", table[:, 1], "s")
    unit, rotation = LENGTHS.get(stated.get("Length Units", "").lower(), ""), stated.get("Rotation Type", "")
    columns.remarks.notes.append(f"an export of OptiTrack Motive in {stated.get('Length Units')}, rotations: {rotation}")
    places: dict[str, dict[str, int]] = {}
    for column, (axis, kind) in enumerate(zip(rows[head], rows[head - 1], strict=False)):
        if kinds[column : column + 1] in (["Rigid Body"], ["Bone"]) and kind in ("Rotation", "Position"):
            leaf = f"q{axis.lower()}" if kind == "Rotation" else axis.lower()
            places.setdefault(names[column], {})[leaf] = column
    return _add_bodies(columns, table, places, unit, rotation == "Quaternion")


def _vicon(rows: list[list[str]], columns: Columns) -> list[str]:
    """Objects or segments of Vicon: a rate, names, axes and units stand above the numbers, and the frames are counted."""
    head = next((n for n, row in enumerate(rows) if row[:1] == ["Frame"]), len(rows) - 1)
    end = next((n for n in range(head + 2, len(rows)) if not any(rows[n])), len(rows))  # trajectories of markers may follow
    rate, names, units = float(rows[1][0]), rows[head - 1], rows[head + 1]
    table = _numbers(rows[head + 2 : end], len(rows[head]))
    columns.add("time [s]", (table[:, 0] - table[0, 0]) / rate, "s")
    columns.remarks.notes.append(f"an export of Vicon at {rate:g} Hz, whose frames are counted from 0 s")
    places: dict[str, dict[str, int]] = {}
    body, unit = "", ""
    for column, axis in enumerate(rows[head]):
        body = names[column] if names[column : column + 1] != [""] and column < len(names) else body
        if match := re.fullmatch(r"([RT])([XYZW])", axis):
            leaf = f"q{match[2].lower()}" if match[1] == "R" else match[2].lower()
            places.setdefault(body, {})[leaf] = column
            unit = units[column] if match[1] == "T" else unit
    return _add_bodies(columns, table, places, unit, all("qw" in found for found in places.values()))


def _qualisys(rows: list[list[str]], columns: Columns, path: Path) -> list[str]:
    """Bodies of Qualisys (6D), in mm: the columns of a body begin with its name and X."""
    stated = {row[0]: row[1] for row in rows[:20] if len(row) > 1}
    head = next((n for n, row in enumerate(rows) if "Rot[0]" in row), len(rows) - 1)
    table, axes = _numbers(rows[head + 1 :], len(rows[head])), rows[head]
    rate = float(stated.get("FREQUENCY", "nan"))
    columns.add("time [s]", table[:, axes.index("Time")] if "Time" in axes else np.arange(len(table)) / rate, "s")
    columns.remarks.notes.append(f"an export of Qualisys at {rate:g} Hz, positions in mm")
    bodies: list[str] = []
    for first in [n for n, axis in reversed([*enumerate(axes)]) if axis == "X" or axis.endswith(" X")]:
        place = next((n for n in range(first, len(axes)) if axes[n] == "Rot[0]"), len(axes))
        if place + 9 > len(axes):
            continue
        bodies.append(axes[first].removesuffix("X").strip() or stated.get("BODY_NAMES", "body"))
        q_wxyz = of_matrices(table[:, place : place + 9].reshape(-1, 3, 3).transpose(0, 2, 1), path)
        _add_body(columns, bodies[-1], table[:, first : first + 3], q_wxyz[:, [1, 2, 3, 0]], "mm")
    return bodies[::-1]


def _add_bodies(
    columns: Columns, table: Float64[np.ndarray, "n k"], places: dict[str, dict[str, int]], unit: str, is_quaternion: bool
) -> list[str]:
    """Add the bodies that have all columns; angles of no certain convention are a loss."""
    if not is_quaternion:
        columns.remarks.losses.append(f"the rotations are angles of no certain convention, and no pose: {FIX}")
        return []
    whole = {body: found for body, found in places.items() if found.keys() >= {*PLACE, *QUATERNION}}
    for body, found in reversed(whole.items()):  # of several the columns of the last one are taken for the pose
        position, turn = (table[:, [found[leaf] for leaf in leaves]] for leaves in (PLACE, QUATERNION))
        _add_body(columns, body, position, turn, unit)
    return [*whole]


def _add_body(
    columns: Columns, body: str, position: Float64[np.ndarray, "n 3"], xyzw: Float64[np.ndarray, "n 4"], unit: str
) -> None:
    group = re.sub(r"\W+", "_", body.removeprefix("Global Angle ")).strip("_") or "body"
    for leaf, values in zip(PLACE, position.T, strict=True):
        columns.add(f"{group}/{leaf}{f' [{unit}]' if unit else ''}", values, unit)
    for leaf, values in zip(QUATERNION, xyzw.T, strict=True):
        columns.add(f"{group}/{leaf}", values)


def _numbers(rows: Sequence[list[str]], width: int) -> Float64[np.ndarray, "n k"]:
    """Rows of numbers of one width; an empty field is a body out of sight."""
    padded = [[*row[:width], *[""] * (width - len(row))] for row in rows if any(row)]
    return np.array([[_number(text) for text in row] for row in padded]).reshape(-1, width)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")
