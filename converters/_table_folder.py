"""Folder with a table for each sensor, or with one of an IMU beside one of poses.

The tables become groups: `gyro` and `accel`, or `imu` and `ground_truth`, and those of other files by their names. Poses are
true by the name of their file, or where a motion capture wrote it; else they are the group `poses`.
"""

from __future__ import annotations

import re
from pathlib import Path

from imutool.errors import DataError

from ._source import head
from ._table_files import kind_of, load
from ._table_groups import TRUE_GROUPS, has_poses
from ._table_mocap import is_mocap
from ._table_packed import table_name, text_head
from ._table_propose import propose
from ._table_sensors import SENSORS, name_columns, sensors_among
from ._table_text import Columns, read_csv, text_of
from .sensor_tables import is_phone

MOST_TABLES = 40
IMU = r"(.*[ _-])?(imu|inertial)\d*([ _-].*)?"  # in the name of a file, as of UZH-FPV's imu.txt; else its columns show it
POSES = rf"(.*[ _-])?({TRUE_GROUPS}|ground[ _-]truth)([ _-].*)?"  # groundtruth.txt, stamped_groundtruth_imu.txt
ENDINGS = ".csv", ".txt", ".tsv", ".dat", ".tum", ".mat", ".npz"
IMU_GROUP, TRUTH_GROUP, POSES_GROUP = "imu", "ground_truth", "poses"


def is_split(folder: Path) -> bool:
    """Whether the tables in a folder make one recording together.

    They are of a gyroscope and an accelerometer, of no phone app, or of one IMU and of poses.
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
        group = groups.get(path, _stem(path))
        sensor = group if group in SENSORS else ""
        try:
            part = load(path, kind_of(head(path), path))
        except DataError as error:
            if path in groups:
                raise
            whole.remarks.losses.append(f"{path.name} is left out: it {error.what}")
            continue
        if path in groups:
            verb = "are" if group == POSES_GROUP else "is"
            part.remarks.notes.append(f"the {group.replace('_', ' ')} {verb} {path.name}")
        name_columns(part, sensor)
        whole.take(group, part, path.name)
    return whole


def _tables(folder: Path) -> list[Path]:
    files = sorted(path for path in folder.iterdir() if Path(table_name(path)).suffix.lower() in ENDINGS)
    return [path for path in files[:MOST_TABLES] if kind_of(head(path), path)]


def _groups(tables: list[Path]) -> dict[Path, str]:
    """Groups of the tables that make a recording: gyro and accel, or one IMU and poses; none otherwise."""
    sensors = sensors_among(_stem(path) for path in tables)
    if {*sensors.values()} == {*SENSORS}:
        return {path: sensors[_stem(path)] for path in tables if _stem(path) in sensors}
    starts = {path: _start(path) for path in tables}
    captured = [path for path in tables if is_mocap(starts[path])]
    true = captured or [path for path in tables if re.fullmatch(POSES, _stem(path).lower())]
    columns = {path: _columns(path, starts[path]) for path in tables if path not in true}
    shown = [path for path, found in columns.items() if propose(found).entries.keys() >= {"gyro", "accel"}]
    imus = [path for path in columns if re.fullmatch(IMU, _stem(path).lower())] or shown
    poses = true or [path for path, found in columns.items() if path not in shown and has_poses(found)]
    both = len(imus) == len(poses) == 1 and imus != poses
    return {imus[0]: IMU_GROUP, poses[0]: TRUTH_GROUP if true else POSES_GROUP} if both else {}


def _stem(path: Path) -> str:
    return Path(table_name(path)).stem


def _start(path: Path) -> str:
    """First whole lines of a table of text; none of any other."""
    if kind_of(head(path), path) != "csv":
        return ""
    return text_of(text_head(path) or head(path)).rpartition("\n")[0]


def _columns(path: Path, start: str) -> Columns:
    """Columns that the first rows of a text have."""
    columns = Columns()
    if start:
        read_csv(start, columns, path)
        name_columns(columns, "")
    return columns
