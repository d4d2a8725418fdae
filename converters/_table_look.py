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
from ._table_packed import text_head
from ._table_pose_names import has_poses
from ._table_propose import propose
from ._table_sensors import name_columns
from ._table_text import Columns, read_csv, text_of

MOST_LOOKED = 64 << 20  # bytes of a table that is no text
logger = logging.getLogger(__name__)


def _start(path: Path) -> str:
    """First whole lines of a table of text; none of any other."""
    if kind_of(head(path), path) != "csv":
        return ""
    return text_of(text_head(path) or head(path)).rpartition("\n")[0]


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
    is_imu = entries.keys() >= {"gyro", "accel"}
    header = () if any(re.fullmatch(r"column \d+", name) for name in names) else names
    return Seen(is_imu, bool(start and perhaps(columns)), has_poses(columns), is_mocap(start), "time" in entries, header)
