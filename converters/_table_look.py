"""What a table of a folder shows by its first rows: an IMU, poses, a time."""

from __future__ import annotations

import logging
import re
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from imutool.errors import ConfigError, DataError

from ._source import head
from ._table_files import NO_NUMBERS, kind_of, load, read_text
from ._table_headerless import perhaps
from ._table_layouts import known_layout
from ._table_mocap import is_mocap
from ._table_packed import opener, text_head
from ._table_pose_names import has_poses
from ._table_propose import propose
from ._table_sensors import name_columns
from ._table_text import Columns, read_csv, text_of
from ._table_units import TIME_NS

MOST_LOOKED = 64 << 20  # bytes of a table that is no text
LAST_BYTES = 4096  # of a text, which hold its last row
LEAST_VECTOR = 3  # numbers in a row of a sensor
SINCE_1970_NS = 10**18  # in 2001; smaller times may count from any start
logger = logging.getLogger(__name__)


def _start(path: Path) -> str:
    """First whole lines of a table of text; none of any other."""
    if kind_of(head(path), path) != "csv":
        return ""
    return text_of(text_head(path)).rpartition("\n")[0]


class Seen(NamedTuple):
    """What the columns of a table show."""

    is_imu: bool
    may_be_imu: bool
    has_poses: bool
    is_mocap: bool
    has_time: bool
    header: tuple[str, ...] = ()  # names of all columns, if the table states them


def look(path: Path) -> Seen:
    """What the first rows of a text show, or a table of up to `MOST_LOOKED` bytes, once."""
    status = path.stat()
    return _looked(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=4096)
def _looked(path: Path, mtime_ns: int, size: int) -> Seen:  # the key notices a changed file
    columns, start, kind = Columns(), _start(path), kind_of(head(path), path)
    if start and is_mocap(start):
        read_csv(start, columns, path)
    elif start:
        read_text(start, columns, path)
    elif kind not in ("csv", "") and size <= MOST_LOOKED:
        try:
            columns = load(path, kind)
        except (DataError, ConfigError) as error:
            if not error.what.startswith(NO_NUMBERS):  # of a file of settings, say
                logger.warning("left out: %s", error)
    if not columns.values:
        return Seen(False, False, False, is_mocap(start), False)
    names = tuple(sorted(columns.values))
    name_columns(columns, "")
    entries = (known_layout(columns) or propose(columns)).entries
    is_imu, is_captured = entries.keys() >= {"gyro", "accel"}, is_mocap(start) or columns.is_mocap
    header = () if any(re.fullmatch(r"column \d+", name) for name in names) else names
    return Seen(is_imu, bool(start and perhaps(columns)), has_poses(columns), is_captured, "time" in entries, header)


def span_ns(path: Path) -> tuple[int, int] | None:
    """First and last time since 1970 of a table of text, by its first rows and its last."""
    status = path.stat()
    return _spanned(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=4096)
def _spanned(path: Path, mtime_ns: int, size: int) -> tuple[int, int] | None:
    with path.open("rb") as file:
        file.seek(max(0, size - LAST_BYTES))
        last = text_of(file.read()).rstrip().rpartition("\n")[2]
    columns, start = Columns(), text_of(head(path)).rpartition("\n")[0]
    if "\0" in start or opener(head(path)):
        return None
    read_csv(f"{start}\n{last}\n", columns, path, least=LEAST_VECTOR)
    entries = propose(columns).entries if columns.values else {}
    if "time" not in entries or entries.get("time_unit", "") not in TIME_NS:
        return None
    times_ns = columns.values[entries["time"]].astype(float)[[0, -1]] * TIME_NS[entries["time_unit"]]
    return (int(times_ns[0]), int(times_ns[1])) if times_ns.min() > SINCE_1970_NS else None
