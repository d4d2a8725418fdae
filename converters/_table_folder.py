"""Folder of tables: of one sensor each, of IMUs and poses, or several recordings.

The tables become groups: `gyro` and `accel`, or `imu` and `ground_truth`, and those of other files by their names. Poses are
true by the name of their file, or where a motion capture wrote it; else they are the group `poses`. A table that holds a time
alone (`time.csv` of gnss-ins-sim) is the clock of those that have none and as many rows. A folder of .npy arrays, with a time
among them, is a table too if it has the name of a sensor (`gyro/t` and `gyro/value` of comma2k19).
"""

from __future__ import annotations

import re
from collections import Counter
from contextlib import suppress
from itertools import chain
from pathlib import Path

import numpy as np

from imutool.errors import DataError

from . import Sequence
from ._archive import refusing
from ._source import find_folders, head
from ._table_files import kind_of, load, npy_shape, read_npy
from ._table_geodetic import add_local
from ._table_groups import TRUE_GROUPS
from ._table_header import MOSTLY
from ._table_look import MOST_LARGER, look, recorded_apart
from ._table_map import IMU_GROUP, POSES_GROUP, TRUTH_GROUP
from ._table_names import TIME_WORDS, name_and_unit, split_name
from ._table_packed import read_bytes, table_name
from ._table_sensors import SENSORS, SPACED, WORD, name_columns, pairs_among, plain_among, sensors_among
from ._table_text import LOOKED_AT, Columns, is_text_table, read_csv, text_of
from ._table_times import rises
from .px4_csv import logs_in
from .sensor_tables import is_phone

MOST_TABLES = 40  # of one recording
DATA_FILE = "data.hdf5"  # of RoNIN
IMU = r"(.*[ _-])?(imu|inertial)\d*([ _-].*)?"  # in the name of a file, as of UZH-FPV's imu.txt; else its columns show it
IMUS = r"(imu|inertial)[ _-]?\w{1,20}"  # of several beside one file of poses: imu_1, imu_left
POSES = rf"(.*[ _-])?({TRUE_GROUPS}|ground[ _-]truth)([ _-].*)?"  # groundtruth.txt, stamped_groundtruth_imu.txt
REFERENCE = r"(.*[ _-])?ref(erence)?([ _-].*)?"  # of poses; of rates it is an ideal sensor
ROLES = "imu|inertial|ground|truth|poses?|raw|rots?|ref|reference"
ROLE = "|".join([ROLES, TRUE_GROUPS, *SENSORS.values()])  # a word in the name of a file
ENDINGS = (
    ".csv",
    ".txt",
    ".tsv",
    ".dat",
    ".tum",
    ".json",
    ".mat",
    ".npz",
    ".npy",
    ".parquet",
    ".feather",
    ".arrow",
    ".h5",
    ".hdf5",
    ".xlsx",
    ".xls",
)


def sequences_below(source: Path) -> list[Sequence]:
    """Recordings of tables in a folder and in those below it."""
    found: dict[Path, list[Sequence]] = {}

    def is_mine(folder: Path) -> bool:
        return bool(found.setdefault(folder, _sequences_in(folder)))

    find_folders(source, is_mine, lambda folder: found[folder][0].path.is_dir())  # whose folders may be sensors of it
    return [*chain(*found.values())]


def _sequences_in(folder: Path) -> list[Sequence]:
    """Recordings of a folder: `data.hdf5`, or its tables together, in pairs or one by one.

    Together are tables of a gyroscope and an accelerometer, of several such pairs, or of one IMU and of poses: all of the
    folder, or those whose names differ in that alone (`walk_imu`, `walk_gt`). None are of a phone app or of PX4.
    """
    if kind_of(head(folder / DATA_FILE), folder / DATA_FILE) == "hdf5":
        return [Sequence(folder.name, folder / DATA_FILE)]
    found = {} if is_phone(folder) or logs_in(folder) else _recordings(folder)
    places = {name: (tables[0], "") if len(tables) == 1 else (folder, name) for name, tables in found.items()}
    return [Sequence(folder.name if len(found) == 1 else name, *place) for name, place in places.items()]


def load_split(folder: Path, recording: str = "") -> Columns:
    """Columns of a recording's tables, each in the group of its sensor or of its file's name.

    Raises:
        DataError: the table of the gyroscope, of the accelerometer or of the IMU cannot be read.
    """
    tables, whole, clocks = _recordings(folder)[recording], Columns(), _clocks(folder)
    groups = _groups(tables)
    for path in tables:
        group = groups.get(path, _stem(path))
        sensor = group.rpartition("/")[2] if path in groups and group.rpartition("/")[2] in SENSORS else ""
        try:
            part = _load(path)
        except DataError as error:
            if path in groups:
                raise
            whole.remarks.losses.append(f"{path.name} is left out: it {error.what}")
            continue
        _give_time(part, path, clocks)
        if path in groups:
            verb = "are" if group == POSES_GROUP else "is"
            part.remarks.notes.append(f"the {group.replace('_', ' ')} {verb} {path.name}")
        name_columns(part, sensor)
        if group == TRUTH_GROUP:
            add_local(part)
        whole.take(group, part, path.name)
    return whole


def _tables(folder: Path) -> list[Path]:
    """Tables of a folder; narrow ones are a series of readings, or beside a clock, which is none of them."""
    files = _files(folder)
    clocks = [path for path in files if _is_clock(path)]
    narrow = {path for path in files if _is_narrow(path) and (clocks or _is_series(path))}
    tables = [path for path in files if path not in clocks and (kind_of(head(path), path) or path in narrow)]
    return [*tables, *_sensor_folders(folder)]


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if Path(table_name(path)).suffix.lower() in ENDINGS)


def _sensor_folders(folder: Path) -> list[Path]:
    """Folders of arrays, those of a gyroscope and of an accelerometer among them; else none."""
    folders = sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    if {*sensors_among(path.name for path in folders).values()} != {*SENSORS}:
        return []
    return [path for path in folders if any(_is_time(array) for array in _arrays(path))]


def _arrays(folder: Path) -> list[Path]:
    """Arrays of a folder, by their first bytes; their times first."""
    found = [path for path in folder.iterdir() if kind_of(head(path), path) == "npy"]
    return sorted(found, key=lambda path: (not _is_time(path), path.name))


def _is_time(path: Path) -> bool:
    return re.fullmatch(rf"(.*_)?{TIME_WORDS}", split_name(_stem(path))[0]) is not None


def _recordings(folder: Path) -> dict[str, list[Path]]:
    """Tables of each recording of a folder, by its name; the name is empty where all tables are one recording."""
    tables = _tables(folder)
    if groups := _groups(tables) or _groups(tables[:MOST_TABLES]):
        parts = recorded_apart(groups, tables)
        if len(parts) > 1:
            return {_without_role(_stem(min(part))): sorted(part) for part in parts}
        return {"": tables[:MOST_TABLES]}
    count = Counter(map(_stem, tables))
    stems = {path: _stem(path) if count[_stem(path)] == 1 else path.name for path in tables}  # imu.csv beside imu.txt
    alike: dict[str, list[Path]] = {}
    for path in tables:
        alike.setdefault(_without_role(_stem(path)), []).append(path)
    found: dict[str, list[Path]] = {}
    of_imus = {look(path).header for path in tables if look(path).is_imu} - {()}  # one that shows less is a recording, too
    for shared, paths in alike.items():
        first = _stem(paths[0])
        name = first if shared.isdigit() and not first.startswith(shared) else shared  # imuRaw1 beside viconRot1
        own = {stems[path]: [path] for path in paths if look(path).is_imu or look(path).header in of_imus}
        found |= {name: paths} if name and _groups(paths) else own
    return found or {stems[path]: [path] for path in tables if look(path).may_be_imu}


def _without_role(stem: str) -> str:
    """Name of a file without the words that say what its table holds."""
    parts = re.split(rf"({WORD}|\d+)", stem)
    return "".join(part for part in parts if not re.fullmatch(ROLE, part.lower())).strip("_- .")


def _is_narrow(path: Path) -> bool:
    """Whether a text has rows of numbers, too few for a time and a vector."""
    start = head(path)
    return not kind_of(start, path) and is_text_table(start, 1)


def _is_series(path: Path) -> bool:
    """Whether nearly every line of a narrow text has two numbers or more, as a time and a pressure."""
    lines = [line for line in text_of(head(path)).splitlines() if line.strip()][1:LOOKED_AT]  # below a header
    return bool(lines) and sum(is_text_table(line.encode(), 2) for line in lines) > MOSTLY * len(lines)


def _is_clock(path: Path) -> bool:
    """Whether a table is named as a time and holds nothing else."""
    if not _is_time(path):
        return False
    if kind_of(head(path), path) != "npy":
        return _is_narrow(path) and not is_text_table(head(path), 2)
    with path.open("rb") as file, suppress(ValueError):  # of a damaged header
        return len(npy_shape(file)) == 1
    return False


def _clocks(folder: Path) -> dict[str, tuple[np.ndarray, str]]:
    """Times of the tables that hold nothing else, with their units, by the name of the table without its word for time."""
    found = {}
    for path in filter(_is_clock, _files(folder)):
        (column, values), *_ = _load(path).values.items()
        if rises(values):
            name = re.sub(rf"_?{TIME_WORDS}$", "", split_name(_stem(path))[0])
            found[name] = values, name_and_unit(column, "")[1]
    return found


def _give_time(part: Columns, path: Path, clocks: dict[str, tuple[np.ndarray, str]]) -> None:
    """Add the time of the clock with as many rows to a table without one; of several that whose name its own begins with."""
    has_time = any(re.fullmatch(rf"(.*_)?{TIME_WORDS}", split_name(name)[0]) for name in part.values)
    length = len(next(iter(part.values.values()), ()))
    fits = [name for name, (values, _) in clocks.items() if len(values) == length]
    if has_time or not fits:
        return
    values, unit = clocks[max(fits, key=lambda name: len(name) if _stem(path).lower().startswith(name) else -1)]
    part.values = {"time": values, **part.values}
    part.units["time"] = unit


def _load(path: Path) -> Columns:
    """Columns of a table, also of a narrow one.

    Raises:
        DataError: damaged, or without numbers.
    """
    part = Columns()
    if path.is_dir():
        for array in _arrays(path):
            with refusing(array):
                part.add(_stem(array), read_npy(array))
        return part
    if not _is_narrow(path):
        return load(path, kind_of(head(path), path))
    read_csv(text_of(read_bytes(path)), part, path, least=3 if is_text_table(head(path), 3) else 1)
    if not part.values:
        raise DataError("holds no columns of numbers", where=path)
    return part


def _groups(tables: list[Path]) -> dict[Path, str]:
    """Groups of the tables that make a recording: gyro and accel of one or several IMUs, or IMUs and poses; else none."""
    sensors, seen = sensors_among(map(_stem, tables)), {path: look(path) for path in tables}
    several = pairs_among(map(_stem, tables)) or plain_among(map(_stem, tables))
    groups = sensors if {*sensors.values()} == {*SENSORS} else several
    of_sensors = {path: groups[_stem(path)] for path in tables if _stem(path) in groups}
    captured = [path for path in tables if seen[path].is_mocap]
    words = {path: re.sub(SPACED, "_", _stem(path)).lower() for path in tables}  # viconRot1
    true = captured or [path for path in tables if re.fullmatch(POSES, words[path])]
    true = true or [p for p in tables if re.fullmatch(REFERENCE, words[p]) and seen[p].has_poses and not seen[p].is_imu]
    if of_sensors:
        return of_sensors | {path: TRUTH_GROUP for path in true if len(true) == 1 and path not in of_sensors}
    shown = [path for path in tables if seen[path].is_imu and path not in true]
    imus = [path for path in tables if re.fullmatch(IMU, words[path]) and path not in true] or shown
    poses = true or [path for path in tables if seen[path].has_poses and path not in shown]
    if not poses and len(imus) == len(shown) == 1 and any(seen[path].has_time for path in tables if path not in shown):
        return {shown[0]: IMU_GROUP}
    if len(poses) != 1 or poses[0] in imus:
        return {}
    beside = {poses[0]: TRUTH_GROUP if true else POSES_GROUP}
    together = [path for path in shown if re.fullmatch(IMUS, _stem(path).lower())]
    if len(together) > 1 and _of_one_size(together):
        return {path: re.sub(r"[ -]", "_", _stem(path).lower()) for path in together} | beside
    return {imus[0]: IMU_GROUP} | beside if len(imus) == 1 else {}


def _of_one_size(paths: list[Path]) -> bool:
    """Whether files have about as many bytes, as those of IMUs that were recorded together have."""
    sizes = [path.stat().st_size for path in paths]
    return max(sizes) < MOST_LARGER * min(sizes)


def _stem(path: Path) -> str:
    return Path(table_name(path)).stem
