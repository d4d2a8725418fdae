"""Folder of tables: of one sensor each, of IMUs and poses, or several recordings.

The tables become groups: `gyro` and `accel`, or `imu` and `ground_truth`, and those of other files by their names. Poses are
true by the name of their file, or where a motion capture wrote it; else they are the group `poses`. A table that holds a time
alone (`time.csv` of gnss-ins-sim) is the clock of those that have none and as many rows. A folder of .npy arrays, with a time
among them, is a table too if it has the name of a sensor (`gyro/t` and `gyro/value` of comma2k19).
"""

from __future__ import annotations

import logging
import re
from collections import Counter
from contextlib import suppress
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path

import numpy as np

from imutool.errors import DataError

from ... import Sequence
from ..._archive import refusing
from ..._dataflash_messages import TEXT_START
from ..._source import find_folders, head
from ...px4_csv import logs_in
from ...sensor_tables import is_phone
from ..columns.geodetic import add_local
from ..columns.map import POSES_GROUP, TRUTH_GROUP
from ..columns.times import rises, stated_rate
from ..files.formats import NO_NUMBERS, kind_of, load
from ..files.merged import join_positions
from ..files.npz import npy_shape, read_npy
from ..files.sensors import SENSORS, SPACED, name_columns, sensors_among
from ..text.blocks import text_of
from ..text.delimited import LOOKED_AT, Columns, is_text_table, read_csv
from ..text.header import MOSTLY
from ..text.names import TIME_WORDS, is_named_time, leaf_of, listed, name_and_unit, split_name
from ..text.packed import read_bytes, table_name
from .look import look, recorded_apart
from .roles import POSES, Names, role_folders, role_groups, shared_names, without_role

MAX_TABLES = 40  # of one recording
MAX_NAMED = 5  # of tables that are left out
DATA_FILE = "data.hdf5"  # of RoNIN
logger = logging.getLogger(__package__)  # whose records `_unpacking` renames
TEXTS = ".csv", ".txt", ".tsv", ".dat", ".log", ".tum", ".json", ".jsonl", ".ndjson"
ENDINGS = *TEXTS, ".mat", ".npz", ".npy", ".parquet", ".feather", ".arrow", ".h5", ".hdf5", ".xlsx", ".xls"


def sequences_below(source: Path) -> list[Sequence]:
    """Recordings of tables in a folder and in those below it."""
    found: dict[Path, list[Sequence]] = {}
    parts = set[Path]()

    def is_mine(folder: Path) -> bool:
        above = next((each for each in folder.parents if found.get(each)), folder)
        is_part = any(each in (folder, *folder.parents) for each in role_folders(above))
        parts.update([folder] if is_part else [])
        return bool(found.setdefault(folder, [] if is_part else _sequences_in(folder)))

    find_folders(source, is_mine, lambda folder: found[folder][0].path.is_dir())  # whose folders may be sensors of it
    sequences = [*chain(*found.values())]
    others = [folder for folder, own in found.items() if sequences and not own and folder not in parts]
    named = [each for each in others if re.fullmatch(rf"{POSES}|(.*_)?poses?", re.sub(SPACED, "_", each.name).lower())]
    if true := [f"{path.parent.name}/{path.name}" for each in named for path in _tables(each) or _arrays(each)]:
        lost = f"{source}: tables of true poses in a folder without an IMU are left out: {listed(true, MAX_NAMED)}"
        fix = "Put each next to the tables of its IMU, with ground_truth in its name"
        sequences[0] = replace(sequences[0], losses=(*sequences[0].losses, f"{lost}. {fix}"))
    return sequences


def _sequences_in(folder: Path) -> list[Sequence]:
    """Recordings of a folder: `data.hdf5`, or its tables together, in pairs or one by one.

    Together are tables of a gyroscope and an accelerometer, of several such pairs, or of one IMU and of poses: all of the
    folder, or those whose names differ in that alone (`walk_imu`, `walk_gt`; `imu/walk`, `gt/walk`). None are of a phone app
    or of PX4.
    """
    if kind_of(head(folder / DATA_FILE), folder / DATA_FILE) == "hdf5":
        return [Sequence(folder.name, folder / DATA_FILE)]
    found = {} if is_phone(folder) or logs_in(folder) else _recordings(folder)
    used = {path for tables in found.values() for path in tables}
    others = {
        path: kind_of(head(path), path) for path in (_stems(folder) if found else ()) if path.is_file() and path not in used
    }
    shown = (
        kind in ("csv", "") or (kind != "json" and (look(path).header or look(path).has_time)) for path, kind in others.items()
    )
    unread = {p.relative_to(folder).as_posix(): _is_of_motion(p) for p, is_table in zip(others, shown, strict=True) if is_table}
    motions, unknown = ([name for name, is_motion in unread.items() if is_motion == wanted] for wanted in (True, False))
    if unknown:  # settings in JSON are none, and damaged ones are told of
        logger.warning("%s: tables that show no IMU are left out: %s", folder, listed(unknown, MAX_NAMED))
    places = {name: (next(iter(tables)), "") if len(tables) == 1 else (folder, name) for name, tables in found.items()}
    sequences = [Sequence(folder.name if len(found) == 1 else name, *place) for name, place in places.items()]
    if motions:
        lost = f"{folder}: tables of poses or of an IMU that belong to no recording are left out: {listed(motions, MAX_NAMED)}"
        sequences[0] = replace(sequences[0], losses=(lost,))
    return sequences


def _is_of_motion(path: Path) -> bool:
    """Whether a table shows an IMU or poses, or is named as one of true poses."""
    seen = look(path)
    return seen.is_imu or seen.has_poses or re.fullmatch(POSES, re.sub(SPACED, "_", _stem(path)).lower()) is not None


def load_split(folder: Path, recording: str) -> Columns:
    """Columns of a recording's tables, each in the group of its sensor or of its file's name.

    Raises:
        DataError: the table of the gyroscope, of the accelerometer or of the IMU cannot be read.
    """
    tables, whole, clocks = _recordings(folder)[recording], Columns(), _clocks(folder)
    groups = role_groups(tables)
    for path, stem in tables.items():
        group = groups.get(path, stem)
        sensor = group.rpartition("/")[2] if path in groups and group.rpartition("/")[2] in SENSORS else ""
        try:
            part = _load(path)
        except DataError as error:
            if path in groups:
                raise
            if path.suffix.lower() != ".json" or not error.what.startswith(NO_NUMBERS):  # which is of settings
                whole.remarks.losses.append(f"{path.name} is left out: it {error.what}")
            continue
        _give_time(part, path, clocks)
        if path in groups:
            verb = "are" if group == POSES_GROUP else "is"
            part.remarks.notes.append(f"the {group.replace('_', ' ')} {verb} {path.name}")
        name_columns(part, sensor)
        if group == TRUTH_GROUP or (path not in groups and look(path).has_turns):  # a GNSS/INS
            add_local(part)
        whole.take(group, part, path.name)
    _count_rows(whole)
    join_positions(whole)
    return whole


def _tables(folder: Path) -> list[Path]:
    """Tables of a folder; narrow ones are a series of readings, or next to a clock, which is none of them."""
    files = _files(folder)
    clocks = [path for path in files if _is_clock(path)]
    narrow = {path for path in files if _is_narrow(path) and (clocks or _is_series(path))}
    tables = [path for path in files if path not in clocks and (kind_of(head(path), path) or path in narrow)]
    return [*tables, *_sensor_folders(folder)]


def _files(folder: Path) -> list[Path]:
    """Files with the ending of a table."""
    endings = {path: Path(table_name(path)).suffix.lower() for path in folder.iterdir()}
    return sorted(path for path, ending in endings.items() if ending in ENDINGS and (ending != ".log" or _is_table_log(path)))


def _is_table_log(path: Path) -> bool:
    """Whether a .log is a table: one with names, of an IMU or of poses; no DataFlash, no messages of a program."""
    if not path.is_file() or head(path).startswith(TEXT_START):
        return False
    seen = look(path)
    return any((seen.header, seen.is_imu, seen.may_be_imu, seen.has_poses))


def _sensor_folders(folder: Path) -> list[Path]:
    """Folders of arrays, those of a gyroscope and of an accelerometer among them; else none."""
    folders = sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    if {*sensors_among(path.name for path in folders).values()} != {*SENSORS}:
        return []
    return [path for path in folders if any(is_named_time(_stem(array)) for array in _arrays(path))]


def _arrays(folder: Path) -> list[Path]:
    """Arrays of a folder, by their first bytes; their times first."""
    found = [path for path in folder.iterdir() if kind_of(head(path), path) == "npy"]
    return sorted(found, key=lambda path: (not is_named_time(_stem(path)), path.name))


def _stems(folder: Path) -> dict[Path, str]:
    """Names of the tables of a folder, without endings, and of those below `imu/` and `vicon/` in it."""
    stems = {path: _stem(path) for path in _tables(folder)}
    for role in role_folders(folder):
        for each in (role, *sorted(below for pattern in ("*/", "*/*/") for below in role.glob(pattern))):
            stems |= {path: "_".join((*each.relative_to(role).parts, _stem(path))) for path in _tables(each)}
    return stems


def _recordings(folder: Path) -> dict[str, Names]:
    """Tables of each recording of a folder, by its name; the name is empty where all tables are one recording.

    The names of tables below `imu/` and `vicon/` begin with that of their folder.
    """
    stems = _stems(folder)
    roles = {path: f"{path.relative_to(folder).parts[0]}_" if path.parent != folder else "" for path in stems}
    names = {path: roles[path] + stem for path, stem in stems.items()}
    first = dict(islice(names.items(), MAX_TABLES))
    if groups := role_groups(names) or role_groups(first):
        parts = recorded_apart(groups, list(names))
        if len(parts) > 1:
            return {without_role(stems[min(part)]): {path: names[path] for path in sorted(part)} for part in parts}
        return {"": first}
    labels = stems
    for others in ({path: path.name for path in names}, names):  # imu.csv and imu.txt, imu/1.csv and vicon/1.csv
        count = Counter(labels.values())
        labels = {path: label if count[label] == 1 else others[path] for path, label in labels.items()}
    alike: dict[str, dict[Path, str]] = {}
    for path, shared in shared_names(stems, roles).items():
        alike.setdefault(shared, {})[path] = names[path]
    found: dict[str, Names] = {}
    of_imus = {look(path).header for path in names if look(path).is_imu} - {()}  # one that shows less is a recording, too
    for shared, paths in alike.items():
        groups = role_groups(paths)
        stem = stems[next((path for path in groups if groups[path] not in (TRUTH_GROUP, POSES_GROUP)), next(iter(paths)))]
        name = stem if shared.replace(" ", "").isdigit() and not stem.startswith(shared) else shared  # imuRaw1 and viconRot1
        own = {labels[path]: {path: names[path]} for path in paths if look(path).is_imu or look(path).header in of_imus}
        found |= {name: paths} if name and groups else own
    return found or {labels[path]: {path: names[path]} for path in names if look(path).may_be_imu}


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
    if not is_named_time(_stem(path)):
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


def _count_rows(whole: Columns) -> None:
    """Add the time of poses that state only their rate; with as many rows as another table they have its times."""
    for group in (TRUTH_GROUP, POSES_GROUP):
        own = [column for column in whole.values if column.startswith(f"{group}/")]
        lengths = {len(values) for column, values in whole.values.items() if column not in own}
        rate = stated_rate(whole, own[0]) if own and not any(is_named_time(leaf_of(column)) for column in own) else None
        if rate and (count := len(whole.values[own[0]])) not in lengths:
            whole.values[f"{group}/time"], whole.units[f"{group}/time"] = np.arange(count) / rate[1], "s"
            whole.remarks.notes.append(f"the poses have no time: rows are counted, at the {rate[0]!r} of {rate[1]:.6g} Hz")


def _give_time(part: Columns, path: Path, clocks: dict[str, tuple[np.ndarray, str]]) -> None:
    """Add the time of the clock with as many rows to a table without one; of several that whose name its own begins with."""
    length = len(next(iter(part.values.values()), ()))
    fits = [name for name, (values, _) in clocks.items() if len(values) == length]
    if any(map(is_named_time, part.values)) or not fits:
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
    read_csv(text_of(read_bytes(path)), part, path, minimum=3 if is_text_table(head(path), 3) else 1)
    if not part.values:
        raise DataError("holds no columns of numbers", where=path)
    return part


def _stem(path: Path) -> str:
    return Path(table_name(path)).stem
