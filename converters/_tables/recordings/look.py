"""What a table of a folder shows by its first rows: an IMU, poses, a time."""

from __future__ import annotations

import logging
import re
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

from imutool.errors import ConfigError, DataError

from ..._archive import once_per_content
from ..._source import head
from ..columns.headerless import perhaps
from ..columns.pose_names import has_poses, has_turns, pose_leaves
from ..columns.propose import propose
from ..columns.units import TIME_NS
from ..files.formats import NO_NUMBERS, kind_of, load, read_text
from ..files.layouts import known_layout
from ..files.mocap import is_mocap
from ..files.sensors import name_columns
from ..text.blocks import text_of
from ..text.delimited import MIN_NUMBERS, Columns, is_text_table, read_csv
from ..text.packed import opener, text_head

MAX_LOOKED = 64 << 20  # bytes of a table that is no text
LAST_BYTES = 4096  # of a text, which hold its last row
NARROW = 2  # numbers in a row of a time and a reading
MIN_VECTOR = 3  # numbers in a row of a sensor
MAX_LARGER = 1.2  # ratio of the sizes of files, or of the times, of IMUs that were recorded together
SINCE_1970_NS = 10**18  # in 2001; smaller times may count from any start
logger = logging.getLogger(__package__)  # whose records `_unpacking` renames


def _start(path: Path, kind: str) -> str:
    """First whole lines of a table of text, also of a narrow one; none of any other file."""
    if kind != "csv" and (kind or not is_text_table(text_head(path), NARROW)):
        return ""
    return text_of(text_head(path)).rpartition("\n")[0]


class Seen(NamedTuple):
    """What the columns of a table show."""

    is_imu: bool
    may_be_imu: bool
    has_poses: bool
    has_turns: bool
    is_mocap: bool
    has_time: bool
    header: tuple[str, ...] = ()  # names of all columns, if the table states them


@once_per_content(4096)
def look(path: Path) -> Seen:
    """What the first rows of a text show, or a table of up to `MAX_LOOKED` bytes."""
    columns, kind = Columns(), kind_of(head(path), path)
    start = _start(path, kind)
    if start and (is_mocap(start) or not kind):
        read_csv(start, columns, path, minimum=MIN_NUMBERS if kind else NARROW)
    elif start:
        read_text(start, columns, path)
    elif kind not in ("csv", "") and path.stat().st_size <= MAX_LOOKED:
        try:
            columns = load(path, kind)
        except (DataError, ConfigError) as error:
            if not error.what.startswith(NO_NUMBERS):  # of a file of settings, say
                logger.warning("left out: %s", error)
    if not columns.values:
        return Seen(False, False, False, False, is_mocap(start), False)
    names = tuple(sorted(columns.values))
    name_columns(columns, "")
    entries = (known_layout(columns) or propose(columns)).entries
    is_imu, is_captured = entries.keys() >= {"gyro", "accel"}, is_mocap(start) or columns.is_mocap
    header = () if any(re.fullmatch(r"column \d+", name) for name in names) else names
    turns = has_turns({leaf: column for column, (_, leaf) in pose_leaves(columns.values).items()})
    return Seen(is_imu, bool(perhaps(columns)), has_poses(columns), turns, is_captured, "time" in entries, header)


@once_per_content(4096)
def span_ns(path: Path) -> tuple[int, int] | None:
    """First and last time of a table of text, by its first rows and its last."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - LAST_BYTES))
        last = text_of(file.read()).rstrip().rpartition("\n")[2]
    columns, start = Columns(), text_of(head(path)).rpartition("\n")[0]
    if "\0" in start or opener(head(path)):
        return None
    read_csv(f"{start}\n{last}\n", columns, path, minimum=MIN_VECTOR)
    entries = propose(columns).entries if columns.values else {}
    if "time" not in entries or entries.get("time_unit", "") not in TIME_NS:
        return None
    times_ns = columns.values[entries["time"]].astype(float)[[0, -1]] * TIME_NS[entries["time_unit"]]
    return int(times_ns[0]), int(times_ns[1])


def recorded_apart(groups: dict[Path, str], tables: list[Path]) -> list[list[Path]]:
    """Tables of each of several recordings; none where those of several IMUs may be of one.

    Recordings differ in their time since 1970, or in how long they last. Further tables have the name of a pair in front.
    """
    pairs: dict[str, list[Path]] = {}
    for path, group in groups.items():
        pairs.setdefault(group.rpartition("/")[0], []).append(path)
    names = {key: _shared([path.name for path in pair]) for key, pair in pairs.items()}
    others = [path for path in tables if path not in groups]
    of = {path: [key for key, name in names.items() if name and path.name.startswith(name)] for path in others}
    spans = {path: span_ns(path) for path in groups if path.is_file()} if len(pairs) > 1 else {}
    known = {path: span for path, span in spans.items() if span}
    if not known or known.keys() != groups.keys() or any(len(keys) != 1 for keys in of.values()):
        return []
    whole = {key: [*pair, *(path for path, keys in of.items() if keys == [key])] for key, pair in pairs.items()}
    if min(start for start, _ in known.values()) < SINCE_1970_NS:
        lasting = [max(known[path][1] - known[path][0] for path in pair) for pair in pairs.values()]
        return [*whole.values()] if max(lasting) > MAX_LARGER * min(lasting) else []
    parts, end = list[list[Path]](), 0
    for key, pair in sorted(pairs.items(), key=lambda each: min(known[path] for path in each[1])):
        if min(known[path][0] for path in pair) > end:
            parts.append([])
        parts[-1] += whole[key]
        end = max(end, *(known[path][1] for path in pair))
    return parts


def _shared(names: list[str]) -> str:
    """Beginning that all names share."""
    return "".join(a for a, _ in takewhile(lambda pair: pair[0] == pair[1], zip(min(names), max(names), strict=False)))
