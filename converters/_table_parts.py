"""Recordings and sensors that columns of one table tell apart: `trial`, `placement`.

A table is several recordings where such a column is beside a time that goes back, or beside no time. Sensors are IMUs of one
recording where they have times in common.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np

from imutool.array_types import Int64
from imutool.errors import ConfigError, DataError

from . import Sequence
from ._source import head
from ._table_files import kind_of, load, names_of
from ._table_names import TIME_WORDS, is_of_recordings, is_of_sensors, split_name
from ._table_text import Columns, no_numbers
from ._table_times import LEAST_ROWS, begun_anew, is_counter

NOT_BACK, UP = 0.99, 0.5  # shares of the steps of a time that do not go back, and that go on
LONGEST_LABEL = 40  # characters, of a file's name
MOST_BY_TURNS = 60  # recordings whose rows come by turns
FIX = (
    "Leave `rate_hz` out if a column is the time of each row; else give each recording a table of its own, or name the column"
    " that tells them apart `trial`, in a table of text with a header"
)
Labels = dict[str, np.ndarray]
Rows = Int64[np.ndarray, " n"]


def recordings_in(found: Sequence) -> list[Sequence]:
    """The table as one recording, or those that its columns tell apart."""
    try:
        several = found.path.is_file() and not found.inside and _may_hold_several(found.path)
        parts = _parts(_loaded(found.path)) if several else {}
    except (ConfigError, DataError):  # said when it is read
        return [found]
    return [Sequence(f"{found.name}_{name}", found.path, name) for name in parts] if len(parts) > 1 else [found]


def load_table(path: Path, inside: str) -> Columns:
    """Columns of a table file, or of one of its recordings; several sensors are groups."""
    if not _may_hold_several(path):
        return load(path, kind_of(head(path), path), inside)
    whole = _loaded(path)
    columns = _with_rows(whole, _parts(whole)[inside], is_of_recordings) if inside else copy.deepcopy(whole)
    sensors = _labels(columns, is_of_sensors)
    return _grouped(columns, sensors) if sensors and _share_time(columns, sensors) else columns


def refuse_joined(columns: Columns, gyro: str, place: Path) -> None:
    """Refuse to count the rows of several recordings as those of one.

    Raises:
        ConfigError: a column tells recordings or sensors apart, or a time or a counter begins anew.
    """
    texts = {name: np.array(each) for name, each in columns.labels.items()}
    of_rows = {name: v for name, v in (columns.values | texts).items() if len(v) == len(columns.values[gyro])}
    for name, values in of_rows.items():
        leaf, what = name.rpartition("/")[2], ""
        if is_of_recordings(leaf) or is_of_sensors(leaf):
            labels = _texts(values)
            what = f"{name!r} has {len(np.unique(labels))} values, as of several recordings" if labels is not None else ""
        elif (_is_time(leaf) or is_counter(leaf)) and len(rows := begun_anew(values)):
            what = f"{name!r} begins anew in row {rows[0] + 1}, as of {len(rows) + 1} recordings"
        if what:
            raise ConfigError(f"{what}, and `rate_hz` would join them", where=place, expected="rows of one recording", fix=FIX)


def _may_hold_several(path: Path) -> bool:
    return any(is_of_recordings(name) or is_of_sensors(name) for name in names_of(path))


def _loaded(path: Path) -> Columns:
    status = path.stat()
    return _loaded_once(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=1)  # the recordings of a table follow one another
def _loaded_once(path: Path, mtime_ns: int, size: int) -> Columns:  # the key notices a changed file
    return load(path, kind_of(head(path), path))


def _texts(values: np.ndarray) -> np.ndarray | None:
    """Values as texts, if they are a few labels; else None."""
    if values.dtype.kind == "f":
        if not np.isfinite(values).all() or (values % 1.0 != 0.0).any():
            return None
        values = values.astype(np.int64)
    return values.astype(str) if 2 <= len(np.unique(values)) <= len(values) / LEAST_ROWS else None


def _labels(columns: Columns, is_named: Callable[[str], bool]) -> Labels:
    """Columns of labels that are named so, in a table whose columns are all of one length."""
    lengths = {len(values) for values in columns.values.values()}
    if len(lengths) != 1 or columns.sources:
        return {}
    every = columns.values | {name: np.array(texts) for name, texts in columns.labels.items()}
    texts = {name: _texts(values) for name, values in every.items() if is_named(name)}
    return {name: each for name, each in texts.items() if each is not None}


def _is_time(name: str) -> bool:
    return re.fullmatch(rf"(.*_)?{TIME_WORDS}", split_name(name)[0]) is not None


def _clocks(columns: Columns, order: Rows, seams: Int64[np.ndarray, " k"]) -> list[np.ndarray]:
    """Times of a table, in the order of its parts; each goes on within a part."""
    named = (values[order].astype(float) for name, values in columns.values.items() if _is_time(name))
    inside = np.delete(np.arange(len(order) - 1), seams - 1)
    steps = ((values, np.diff(values)[inside]) for values in named)
    return [
        values for values, each in steps if len(each) and min((each >= 0.0).mean() - NOT_BACK, (each > 0.0).mean() - UP) > 0.0
    ]


def _codes(labels: Labels) -> Rows:
    """Number of each row's combination of labels."""
    each = np.stack([np.unique(texts, return_inverse=True)[1] for texts in labels.values()])
    return np.unique(each, axis=1, return_inverse=True)[1].reshape(-1)


def _parts(columns: Columns) -> dict[str, Rows]:
    """Rows of each recording of a table, by name; all rows without a name where it is one."""
    recordings, sensors = _labels(columns, is_of_recordings), _labels(columns, is_of_sensors)
    parts = _apart(columns, recordings)
    of_each = ({name: texts[rows] for name, texts in sensors.items()} for rows in parts.values())
    together = (_share_time(_with_rows(columns, rows), each) for rows, each in zip(parts.values(), of_each, strict=True))
    return parts if not sensors or all(together) else _apart(columns, recordings | sensors, always=True)


def _apart(columns: Columns, labels: Labels, *, always: bool = False) -> dict[str, Rows]:
    """Rows of the recordings that labels tell apart; unless `always`, all rows where a time goes on from each to the next."""
    if not labels:
        return {"": np.arange(max(map(len, columns.values.values()), default=0))}
    codes = _codes(labels)
    runs = np.concatenate([[0], np.cumsum(np.diff(codes) != 0)])
    in_blocks = runs[-1] + 1 <= len(runs) / LEAST_ROWS
    if not in_blocks and codes.max() >= MOST_BY_TURNS:  # a counter
        return {"": np.arange(len(codes))}
    groups = runs if in_blocks else codes
    order = np.argsort(groups, kind="stable")
    seams = np.flatnonzero(np.diff(groups[order])) + 1
    clocks = _clocks(columns, order, seams)
    if not always and in_blocks and clocks and all((clock[seams] > clock[seams - 1]).all() for clock in clocks):
        return {"": order}
    found: dict[str, Rows] = {}
    for rows in np.split(order, seams):
        name = "_".join(_part_name(column, str(texts[rows[0]])) for column, texts in labels.items())
        again = sum(re.fullmatch(rf"{re.escape(name)}( \d+)?", other) is not None for other in found)
        found[f"{name} {again + 1}" if again else name] = np.sort(rows)
    return found


def _part_name(column: str, text: str) -> str:
    """Name of a recording by its label: `trial_3`, and `S01` for a label that is no number."""
    plain = re.sub(r"[^\w.+-]+", "_", text).strip("_.")[:LONGEST_LABEL] or "blank"
    return f"{split_name(column)[0] or 'part'}_{plain}" if plain.isdigit() else plain


def _share_time(columns: Columns, sensors: Labels) -> bool:
    """Whether all sensors of a table have times in common; one alone does."""
    codes = _codes(sensors)
    order = np.argsort(codes, kind="stable")
    seams = np.flatnonzero(np.diff(codes[order])) + 1
    spans = [[(each.min(), each.max()) for each in np.split(clock, seams)] for clock in _clocks(columns, order, seams)]
    return not len(seams) or any(max(start for start, _ in each) < min(end for _, end in each) for each in spans)


def _with_rows(columns: Columns, rows: Rows, named: Callable[[str], bool] | None = None) -> Columns:
    """Some rows of a table; of columns that are `named` so the texts are in the recording's name."""
    used = [name for name in columns.labels if named is not None and named(name)]
    part = Columns(units=dict(columns.units), numbers=dict(columns.numbers), sources=dict(columns.sources))
    part.values = {name: values[rows] for name, values in columns.values.items()}
    part.texts = {name: [texts[row] for row in rows.tolist()] for name, texts in columns.texts.items()}
    part.labels = {name: [texts[row] for row in rows.tolist()] for name, texts in columns.labels.items() if name not in used}
    part.remarks.notes, part.remarks.losses = [*columns.remarks.notes], [*columns.remarks.losses]
    _leave_out_losses(part, columns, used)
    return part


def _leave_out_losses(part: Columns, columns: Columns, used: list[str]) -> None:
    """Take back that columns of texts are lost, which tell recordings or sensors apart."""
    taken = {no_numbers(name, columns.labels[name]) for name in used if name in columns.labels}
    part.remarks.losses[:] = [loss for loss in part.remarks.losses if loss not in taken]


def _grouped(columns: Columns, sensors: Labels) -> Columns:
    """Columns of each sensor in a group of its name."""
    codes, whole = _codes(sensors), Columns(numbers=columns.numbers, remarks=columns.remarks)
    _leave_out_losses(whole, columns, [*sensors])
    for code in dict.fromkeys(codes.tolist()):
        rows = np.flatnonzero(codes == code)
        label = "_".join(str(texts[rows[0]]) for texts in sensors.values())
        part = _with_rows(columns, rows)
        part.values = {name: values for name, values in part.values.items() if name not in sensors}
        part.numbers, part.remarks = {}, type(columns.remarks)()
        whole.take(label, part, label)
    return whole
