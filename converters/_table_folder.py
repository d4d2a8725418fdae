"""Folder with a table for each sensor, or with one of an IMU beside one of poses.

The tables become groups: `gyro` and `accel`, or `imu` and `ground_truth`, and those of other files by their names.
"""

from __future__ import annotations

import re
from pathlib import Path

from imutool.errors import DataError

from ._source import head
from ._table_files import kind_of, load
from ._table_groups import TRUE_GROUPS
from ._table_propose import propose
from ._table_sensors import SENSORS, name_columns, sensors_among
from ._table_text import Columns, read_csv, text_of
from .sensor_tables import is_phone

MOST_TABLES = 40
IMU = r"(.*[ _-])?(imu|inertial)\d*([ _-].*)?"  # in the name of a file, as of UZH-FPV's imu.txt; else its columns show it
POSES = rf"(.*[ _-])?({TRUE_GROUPS}|ground[ _-]truth)([ _-].*)?"  # groundtruth.txt, stamped_groundtruth_imu.txt
ENDINGS = ".csv", ".txt", ".tsv", ".dat", ".mat", ".npz"


def is_split(folder: Path) -> bool:
    """Whether the tables in a folder make one recording together.

    They are of a gyroscope and an accelerometer, of no phone app, or of one IMU and of true poses.
    """
    tables = _tables(folder)
    return bool(_groups(tables)) and not is_phone(folder)


def load_split(folder: Path) -> Columns:
    """Columns of all tables in a folder, each in the group of its sensor or of its file's name.

    Raises:
        DataError: the table of the gyroscope, of the accelerometer or of the IMU cannot be read.
    """
    tables, whole = _tables(folder), Columns()
    groups = _groups(tables)
    for path in tables:
        group = groups.get(path, path.stem)
        sensor = group if group in SENSORS else ""
        try:
            part = load(path, kind_of(head(path), path))
        except DataError as error:
            if path in groups:
                raise
            whole.remarks.losses.append(f"{path.name} is left out: it {error.what}")
            continue
        if path in groups:
            part.remarks.notes.append(f"the {group.replace('_', ' ')} is {path.name}")
        name_columns(part, sensor)
        whole.take(group, part, path.name)
    return whole


def _tables(folder: Path) -> list[Path]:
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in ENDINGS)
    return [path for path in files[:MOST_TABLES] if kind_of(head(path), path)]


def _groups(tables: list[Path]) -> dict[Path, str]:
    """Groups of the tables that make a recording: gyro and accel, or one IMU and true poses; none otherwise."""
    sensors = sensors_among(path.stem for path in tables)
    if {*sensors.values()} == {*SENSORS}:
        return {path: sensors[path.stem] for path in tables if path.stem in sensors}
    poses = [path for path in tables if re.fullmatch(POSES, path.stem.lower())]
    others = [path for path in tables if path not in poses] if len(poses) == 1 else []
    imus = [path for path in others if re.fullmatch(IMU, path.stem.lower())] or [path for path in others if _shows_imu(path)]
    return {imus[0]: "imu", poses[0]: "ground_truth"} if len(imus) == 1 else {}


def _shows_imu(table: Path) -> bool:
    """Whether the first rows of a text have columns of a gyroscope and of an accelerometer."""
    start = head(table)
    if kind_of(start, table) != "csv":
        return False
    columns = Columns()
    read_csv(text_of(start).rpartition("\n")[0], columns, table)
    return bool(propose(columns).entries.keys() >= {"gyro", "accel"})
