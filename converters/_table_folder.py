"""Folder with a table for each sensor, whose tables become the groups `gyro` and `accel`."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from imutool.errors import DataError

from ._source import head
from ._table_files import kind_of, load
from ._table_text import Columns
from ._table_times import rises
from .sensor_tables import is_phone

MOST_TABLES = 40
ENDINGS = ".csv", ".txt", ".tsv", ".dat", ".mat", ".npz"
SENSORS = {  # words in the names of files
    "gyro": r"gyr|gyros?|gyroscopes?|gyroskop|giroscopio|giroscopo",
    "accel": r"acce?|accels?|accelerometers?|accelerations?|acelerometro|accelerometre|beschleunigung(ssensor)?",
}
OTHERS = r"bias|biases|calib|calibration|linear|linea[lr]|user|gravity|noise|allan|stride|labels?"
VECTOR, POSE = ["time", "x", "y", "z"], ["time", *(f"position_{a}" for a in "xyz"), *(f"quaternion[{k}]" for k in range(4))]


def is_split(folder: Path) -> bool:
    """Whether a folder has a table of a gyroscope and one of an accelerometer, of no phone app."""
    return {*_roles(folder).values()} == {*SENSORS} and not is_phone(folder)


def load_split(folder: Path) -> Columns:
    """Columns of all tables in a folder, each in the group of its sensor or of its file's name.

    Raises:
        DataError: the table of the gyroscope or of the accelerometer cannot be read.
    """
    roles, whole = _roles(folder), Columns()
    for path in _tables(folder):
        try:
            part = load(path, kind_of(head(path), path))
        except DataError as error:
            if path in roles:
                raise
            whole.remarks.losses.append(f"{path.name} is left out: it {error.what}")
            continue
        group = roles.get(path, path.stem)
        _name_columns(part, path in roles)
        for name, values in part.values.items():
            column = f"{group}/{name}"
            whole.values[column], whole.units[column] = values, part.units.get(name, "")
            if name in part.texts:
                whole.texts[column] = part.texts[name]
        whole.remarks.notes.extend([f"the {group} is {path.name}"] if path in roles else [])
        whole.remarks.notes.extend(f"{path.name}: {note}" for note in part.remarks.notes)
        whole.remarks.losses.extend(f"{path.name}: {loss}" for loss in part.remarks.losses)
    return whole


def _tables(folder: Path) -> Iterator[Path]:
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in ENDINGS)
    return (path for path in files[:MOST_TABLES] if kind_of(head(path), path))


def _roles(folder: Path) -> dict[Path, str]:
    """Tables of a gyroscope and of an accelerometer by the words in their names; none of a sensor that has several."""
    found: dict[str, list[Path]] = {}
    for path in _tables(folder):
        words = [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", path.stem)]
        for sensor, pattern in SENSORS.items():
            named = any(re.fullmatch(pattern, word) for word in words)
            if named and not any(re.fullmatch(OTHERS, word) for word in words):
                found.setdefault(sensor, []).append(path)
    return {paths[0]: sensor for sensor, paths in found.items() if len(paths) == 1}


def _name_columns(table: Columns, is_sensor: bool) -> None:
    """Name the columns of a table without a header: a time, and a vector of a sensor or, of seven numbers, a pose."""
    numbers = [f"column {number}" for number in range(1, len(table.values) + 1)]
    if [*table.values] != numbers or not rises(table.values[numbers[0]]):
        return
    names = VECTOR if is_sensor else POSE if len(numbers) == len(POSE) else VECTOR[:1]
    new = {**dict(zip(numbers, numbers, strict=True)), **dict(zip(numbers, names, strict=False))}
    table.values = {new[name]: values for name, values in table.values.items()}
    table.texts = {new[name]: texts for name, texts in table.texts.items()}
