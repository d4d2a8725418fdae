"""Folder with a table for each sensor, whose tables become the groups `gyro` and `accel`."""

from __future__ import annotations

from pathlib import Path

from imutool.errors import DataError

from ._source import head
from ._table_files import kind_of, load
from ._table_sensors import SENSORS, name_columns, sensors_among
from ._table_text import Columns
from .sensor_tables import is_phone

MOST_TABLES = 40
ENDINGS = ".csv", ".txt", ".tsv", ".dat", ".mat", ".npz"


def is_split(folder: Path) -> bool:
    """Whether a folder has a table of a gyroscope and one of an accelerometer, of no phone app."""
    return {*_sensors(_tables(folder)).values()} == {*SENSORS} and not is_phone(folder)


def load_split(folder: Path) -> Columns:
    """Columns of all tables in a folder, each in the group of its sensor or of its file's name.

    Raises:
        DataError: the table of the gyroscope or of the accelerometer cannot be read.
    """
    tables, whole = _tables(folder), Columns()
    sensors = _sensors(tables)
    for path in tables:
        sensor = sensors.get(path, "")
        try:
            part = load(path, kind_of(head(path), path))
        except DataError as error:
            if sensor:
                raise
            whole.remarks.losses.append(f"{path.name} is left out: it {error.what}")
            continue
        if sensor:
            part.remarks.notes.append(f"the {sensor} is {path.name}")
        name_columns(part, sensor)
        whole.take(sensor or path.stem, part, path.name)
    return whole


def _tables(folder: Path) -> list[Path]:
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in ENDINGS)
    return [path for path in files[:MOST_TABLES] if kind_of(head(path), path)]


def _sensors(tables: list[Path]) -> dict[Path, str]:
    found = sensors_among(path.stem for path in tables)
    return {path: found[path.stem] for path in tables if path.stem in found}
