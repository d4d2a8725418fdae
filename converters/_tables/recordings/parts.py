"""Recordings and sensors of one file, in groups, or by columns that tell them apart.

A table is several recordings where such a column (`trial`) meets a time that goes back, or no time, and where its
time begins anew without such a column. Sensors (`placement`) are IMUs of one recording where they have times in common.
Columns of one length are a table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from imutool.array_types import Int64
from imutool.errors import ConfigError, DataError

from ... import Sequence
from ..._source import head
from ..columns.times import is_counter
from ..columns.wraps import MIN_ROWS, begun_anew
from ..files.formats import kind_of, load, may_hold_several
from ..text.delimited import Columns
from ..text.names import group_of, is_named_time, is_of_recordings, is_of_sensors, leaf_of, tells_apart
from ..text.numbers import no_numbers
from .several import distinct, groups_apart, part_name, renamed

NOT_BACK, UP = 0.99, 0.5  # shares of the steps of a time that do not go back, and that go on
MAX_SAID = 5  # rows
MAX_BY_TURNS = 60  # recordings whose rows come by turns
FIX = (
    "Leave `rate_hz` out if a column is the time of each row; else give each recording a table of its own, or name the column"
    " that tells them apart `trial`"
)
Labels = dict[str, np.ndarray]
Rows = Int64[np.ndarray, " n"]
TableRows = dict[int, Rows]  # of a recording, in each table whose columns are of that length


def recordings_in(found: Sequence) -> list[Sequence]:
    """The file as one recording, or those that its groups or its columns tell apart."""
    try:
        several = found.path.is_file() and not found.inside and may_hold_several(found.path)
        parts = _recordings(found.path) if several else {}
    except (ConfigError, DataError):  # said when it is read
        return [found]
    return [Sequence(f"{found.name}_{name}", found.path, name, found.losses) for name in parts] if len(parts) > 1 else [found]


def load_table(path: Path, inside: str) -> Columns:
    """Columns of a table file, or of one of its recordings; several sensors are groups."""
    if not may_hold_several(path):
        return load(path, kind_of(head(path), path))
    parts = _recordings(path)
    if len(parts) == 1:
        _recordings_once.cache_clear()  # whose columns are handed on as they are
    columns = parts[inside]()
    for length, sensors in _labels(columns, is_of_sensors).items():
        if _share_time(columns, sensors):
            columns = _grouped(columns, length, sensors)
    return columns


def refuse_joined(columns: Columns, gyro: str, place: Path) -> None:
    """Refuse to count the rows of several recordings as those of one.

    Raises:
        ConfigError: a column tells recordings or sensors apart, or a time or a counter begins anew.
    """
    texts = {name: np.array(each) for name, each in columns.labels.items()}
    of_rows = {name: v for name, v in (columns.values | texts).items() if len(v) == len(columns.values[gyro])}
    for name, values in of_rows.items():
        leaf, what = leaf_of(name), ""
        if tells_apart(leaf):
            labels = _texts(values)
            what = f"{name!r} has {len(np.unique(labels))} values, as of several recordings" if labels is not None else ""
        elif (is_named_time(leaf) or is_counter(leaf)) and len(rows := begun_anew(values)):
            what = f"{name!r} begins anew in row {rows[0] + 1}, as of {len(rows) + 1} recordings"
        if what:
            raise ConfigError(f"{what}, and `rate_hz` would join them", where=place, expected="rows of one recording", fix=FIX)


def _recordings(path: Path) -> dict[str, Callable[[], Columns]]:
    """What gives the columns of each recording, by its name; of the only one without a name."""
    status = path.stat()
    return _recordings_once(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=1)  # the recordings of a file follow one another
def _recordings_once(path: Path, mtime_ns: int, size: int) -> dict[str, Callable[[], Columns]]:  # the key notices a change
    found: dict[str, Callable[[], Columns]] = {}
    for group, columns in groups_apart(load(path, kind_of(head(path), path))).items():
        for name, rows in _parts(columns).items():
            found[distinct("_".join(filter(None, (group, name))), found)] = partial(_with_rows, columns, rows, is_of_recordings)
    return found


def _texts(values: np.ndarray) -> np.ndarray | None:
    """Values as texts, if they are a few labels; else None."""
    if values.dtype.kind == "f":
        if not np.isfinite(values).all() or (values % 1.0 != 0.0).any():
            return None
        values = values.astype(np.int64)
    return values.astype(str) if 2 <= len(np.unique(values)) <= len(values) / MIN_ROWS else None


def _labels(columns: Columns, is_named: Callable[[str], bool]) -> dict[int, Labels]:
    """Columns of labels that are named so, by the length of their table."""
    every = columns.values | {name: np.array(texts) for name, texts in columns.labels.items()}
    found: dict[int, Labels] = {}
    for name, values in every.items():
        if is_named(leaf_of(name)) and (texts := _texts(values)) is not None:
            beside = found.setdefault(len(texts), {})
            if not any(np.array_equal(texts, other) for other in beside.values()):  # of the gyro, and of the accelerometer
                beside[name] = texts
    return found


def _clocks(columns: Columns, order: Rows, seams: Int64[np.ndarray, " k"]) -> list[np.ndarray]:
    """Times of a table, in the order of its parts; each goes on within a part."""
    of_rows = ((name, values) for name, values in columns.values.items() if len(values) == len(order))
    named = (values[order].astype(float) for name, values in of_rows if is_named_time(name))
    inside = np.delete(np.arange(len(order) - 1), seams - 1)
    steps = ((values, np.diff(values)[inside]) for values in named)
    return [
        values for values, each in steps if len(each) and min((each >= 0.0).mean() - NOT_BACK, (each > 0.0).mean() - UP) > 0.0
    ]


def _codes(labels: Labels) -> Rows:
    """Number of each row's combination of labels."""
    each = np.stack([np.unique(texts, return_inverse=True)[1] for texts in labels.values()])
    return np.unique(each, axis=1, return_inverse=True)[1].reshape(-1)


def _parts(columns: Columns) -> dict[str, TableRows]:
    """Rows of each recording of a file, by its name; without a name where it is one, whose rows stay as they are.

    The longest table with such a column says which there are; those of others that have one follow it.
    """
    recordings, sensors = _labels(columns, is_of_recordings), _labels(columns, is_of_sensors)
    every = {length: recordings.get(length, {}) | sensors.get(length, {}) for length in recordings.keys() | sensors.keys()}
    if not every and not (every := (recordings := _begun(columns))):
        return {"": {}}
    longest = max(every)
    parts = _apart(columns, longest, recordings.get(longest, {}))
    of_each = ({name: texts[rows] for name, texts in sensors.get(longest, {}).items()} for rows in parts.values())
    whole = [_with_rows(columns, {longest: rows}) for rows in parts.values()]
    if not all(_share_time(each, labels) for each, labels in zip(whole, of_each, strict=True) if labels):
        parts, recordings = _apart(columns, longest, every[longest], always=True), every
    if len(parts) == 1:
        return {"": {}}
    found = {name: {longest: rows} for name, rows in parts.items()}
    for length in recordings.keys() - {longest}:
        others = _apart(columns, length, recordings[length], always=True)
        for name, rows in found.items():
            rows[length] = others.get(name, np.zeros(0, np.int64))
    return found


def _begun(columns: Columns) -> dict[int, Labels]:
    """Number of each row's recording, where all times of a file begin anew in the same rows; none in any other file."""
    times = {name: values for name, values in columns.values.items() if is_named_time(leaf_of(name))}
    bounds = {(0, *begun_anew(values).tolist(), len(values)) for values in times.values()}
    if len(bounds) != 1:
        return {}
    (_, *rows, length), lengths = next(iter(bounds)), np.diff(next(iter(bounds)))
    if not rows or lengths.min() < MIN_ROWS:
        return {}
    note = f"{', '.join(map(repr, times))} begins anew in row {', '.join(str(row + 1) for row in rows[:MAX_SAID])}"
    columns.remarks.notes.append(f"{note}{', ...' if len(rows) > MAX_SAID else ''}: {len(lengths)} recordings")
    return {length: {"part": np.repeat(np.arange(1, len(lengths) + 1).astype(str), lengths)}}


def _apart(columns: Columns, length: int, labels: Labels, *, always: bool = False) -> dict[str, Rows]:
    """Rows of the recordings that labels of a table tell apart.

    All rows without labels, and unless `always` where a time goes on from each to the next.
    """
    if not labels:
        return {"": np.arange(length)}
    codes = _codes(labels)
    runs = np.concatenate([[0], np.cumsum(np.diff(codes) != 0)])
    in_blocks = runs[-1] + 1 <= len(runs) / MIN_ROWS
    if not in_blocks and codes.max() >= MAX_BY_TURNS:  # a counter
        return {"": np.arange(len(codes))}
    groups = runs if in_blocks else codes
    order = np.argsort(groups, kind="stable")
    seams = np.flatnonzero(np.diff(groups[order])) + 1
    clocks = _clocks(columns, order, seams)
    if not always and in_blocks and clocks and all((clock[seams] > clock[seams - 1]).all() for clock in clocks):
        return {"": order}
    found: dict[str, Rows] = {}
    for rows in np.split(order, seams):
        name = "_".join(part_name(leaf_of(column), str(texts[rows[0]])) for column, texts in labels.items())
        found[distinct(name, found)] = np.sort(rows)
    return found


def _share_time(columns: Columns, sensors: Labels) -> bool:
    """Whether all sensors of a table have times in common; one alone does."""
    codes = _codes(sensors)
    order = np.argsort(codes, kind="stable")
    seams = np.flatnonzero(np.diff(codes[order])) + 1
    spans = [[(each.min(), each.max()) for each in np.split(clock, seams)] for clock in _clocks(columns, order, seams)]
    return not len(seams) or any(max(start for start, _ in each) < min(end for _, end in each) for each in spans)


def _with_rows(columns: Columns, rows: TableRows, named: Callable[[str], bool] | None = None) -> Columns:
    """Columns with some rows of their tables; without any, as they are.

    Of columns that are `named` so the texts are in the recording's name.
    """
    if not rows:
        return columns
    used = [name for name in columns.labels if named is not None and named(leaf_of(name))]
    part = replace(columns, remarks=replace(columns.remarks))
    kept = {name: rows.get(len(values)) for name, values in (columns.values | columns.labels).items()}
    part.values = {n: each if kept[n] is None else each[kept[n]] for n, each in columns.values.items() if _is_left(kept[n])}
    part.texts = {n: _texts_in(each, kept[n]) for n, each in columns.texts.items() if n in part.values}
    part.labels = {n: _texts_in(e, kept[n]) for n, e in columns.labels.items() if n not in used and _is_left(kept[n])}
    part.remarks.notes, part.remarks.losses = [*columns.remarks.notes], [*columns.remarks.losses]
    _leave_out_losses(part, columns, used)
    return part


def _is_left(rows: Rows | None) -> bool:
    return rows is None or len(rows) > 0


def _texts_in(texts: Iterable[str], rows: Rows | None) -> list[str]:
    texts = [*texts]
    return texts if rows is None else [texts[row] for row in rows.tolist()]


def _leave_out_losses(part: Columns, columns: Columns, used: list[str]) -> None:
    """Take back that columns of texts are lost, which tell recordings or sensors apart."""
    texts = [no_numbers(n, columns.labels[name]) for name in used if name in columns.labels for n in (name, leaf_of(name))]
    part.remarks.losses[:] = [loss for loss in part.remarks.losses if not loss.endswith(tuple(texts))]


def _grouped(columns: Columns, length: int, sensors: Labels) -> Columns:
    """Columns with those of a table in a group of the name of each sensor."""
    codes, whole = _codes(sensors), replace(columns)
    _leave_out_losses(whole, columns, [*sensors])
    of_table = [name for name, values in (columns.values | columns.labels).items() if len(values) == length]
    for field in ("values", "units", "texts", "labels"):
        setattr(whole, field, {name: each for name, each in getattr(columns, field).items() if name not in of_table})
    around = {group_of(name) for name in of_table}
    names = {name: leaf_of(name) if len(around) == 1 else name for name in of_table if name not in sensors}
    for code in dict.fromkeys(codes.tolist()):
        rows = np.flatnonzero(codes == code)
        label = "_".join(str(texts[rows[0]]) for texts in sensors.values())
        whole.take(label, _with_rows(replace(renamed(columns, names), labels={}), {length: rows}), label)
    return whole
