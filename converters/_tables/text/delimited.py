"""Columns of numbers and tables of text: delimiters, headers, units.

A matrix of three columns `gyro` becomes the columns `gyro[0]`, `gyro[1]`, `gyro[2]`, whichever way it lies.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from imutool.array_types import Float64
from imutool.errors import DataError
from imutool.recording.message_log import Remarks

from .blocks import AROUND, MAX_LINE, rows_in_blocks, text_of
from .dates import NO_ZONE, calendar_times, damaged_times, join_dates
from .header import COMMENTS, read_header, refuse_other_header, without_numbers_of_columns
from .names import leaf_of, tells_apart
from .numbers import (
    COMMA_NUMBER,
    DECIMAL_COMMA,
    decimal_points,
    fields_of,
    has_comma_numbers,
    is_number,
    no_numbers,
    numbers,
    plain_columns,
    vector,
    vectors,
    without_thousands,
)
from .packed import UTF16

WIDEST = 64  # columns of a matrix; wider ones are images
TRANSPOSE = "Transpose it, if it holds a sample a column"
MIN_NUMBERS = 4  # in a row: a time and a vector
MIN_NAMED = 0.1  # share of the rows that have as many fields as the header, if it is theirs
LOOKED_AT = 200  # first lines, which show whether text is a table, and its words between the numbers
FIRSTS = 50  # rows that show what a column without a name counts


def matrix_columns(named: str | list[str]) -> list[str]:
    """Columns of an array of matrices, row by row; or nine columns as they are named."""
    return [f"{named}[{row}][{column}]" for row in range(3) for column in range(3)] if isinstance(named, str) else named


@dataclass
class Columns:
    """Columns by name, with units, single numbers, texts, remarks, and files by group."""

    values: dict[str, np.ndarray] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    numbers: dict[str, float] = field(default_factory=dict)
    texts: dict[str, Sequence[str]] = field(default_factory=dict)
    labels: dict[str, list[str]] = field(default_factory=dict)  # texts of columns that tell recordings or sensors apart
    remarks: Remarks = field(default_factory=Remarks)
    sources: dict[str, str] = field(default_factory=dict)
    local_times: list[str] = field(default_factory=list)  # columns of dates that name no zone
    has_structures: bool = False  # whose fields follow a dot, which in the name of a plain table's column makes no group
    is_mocap: bool = False  # the poses of a motion capture, whatever the file's name

    def add(self, name: str, array: Any, unit: str = "") -> None:
        """Take in an array of numbers of one, two or three dimensions."""
        array = np.asarray(array)
        if array.dtype.kind in "Mm":  # dates and times of NumPy, whatever their unit
            array, unit = array.astype(f"{array.dtype.kind}8[ns]").astype(np.int64), "ns"
        if array.dtype.kind in "UO" and array.ndim == 1 and len(array) > 1 and all(isinstance(each, str) for each in array):
            if tells_apart(leaf_of(name)):
                self.add_labels(name, array.tolist())
            return
        if array.dtype.kind not in "iufb" or array.ndim > 3 or not array.size:
            return
        array = array.astype(np.int64) if array.dtype.kind in "iu" and array.dtype.itemsize < 8 else array  # steps overflow
        if array.ndim == 3:
            array = np.moveaxis(array, 2, 0) if array.shape[:2] == (3, 3) else array
            if array.shape[1:] == (3, 3):
                for column, values in zip(matrix_columns(name), array.reshape(-1, 9).T, strict=True):
                    self.values[column], self.units[column] = values, unit
            return
        array = array.T if array.ndim == 2 and array.shape[0] < array.shape[1] else array
        if array.ndim == 2 and array.shape[1] > WIDEST:
            self.remarks.losses.append(f"{name} is left out: it has {array.shape[1]} columns, as an image")
        elif array.ndim == 2 and array.shape[1] > 1:
            for number in range(array.shape[1]):
                self.values[f"{name}[{number}]"], self.units[f"{name}[{number}]"] = array[:, number], unit
        elif array.size > 1:
            self.values[name], self.units[name] = array.reshape(-1), unit
        elif array.size == 1:
            self.numbers[name] = float(array.reshape(-1)[0])

    def add_labels(self, name: str, texts: Sequence[str]) -> None:
        """Take in the texts of a column, which are lost unless they tell recordings or sensors apart."""
        if tells_apart(leaf_of(name)):
            seen: dict[str, str] = {}
            self.labels[name] = [seen.setdefault(text, text) for text in texts]  # a few labels, each in memory once
        self.remarks.losses.append(no_numbers(name, texts))

    def unsigned(self, name: str) -> str:
        """The column that a name means: `ax` of `-ax`, which counts the other way."""
        return name if name in self.values else name.removeprefix("-")

    def side_by_side(self, names: Iterable[str]) -> Float64[np.ndarray, "n k"]:
        """Columns as one array; one named with a minus counts the other way."""
        columns = ((name in self.values, self.values[self.unsigned(name)].astype(float, copy=False)) for name in names)
        return np.stack([values if is_plain else -1.0 * values for is_plain, values in columns], axis=1)

    def take(self, group: str, other: Columns, label: str) -> None:
        """Take in the columns and remarks of another table as a group."""
        self.sources[group] = label
        for name, values in other.values.items():
            column = f"{group}/{name}"
            self.values[column], self.units[column] = values, other.units.get(name, "")
            if name in other.texts:
                self.texts[column] = other.texts[name]
        self.labels |= {f"{group}/{name}": texts for name, texts in other.labels.items()}
        self.numbers |= {f"{group}/{name}": value for name, value in other.numbers.items()}
        self.remarks.notes.extend(f"{label}: {note}" for note in other.remarks.notes)
        self.remarks.losses.extend(f"{label}: {loss}" for loss in other.remarks.losses)


def is_text_table(head: bytes, minimum: int = MIN_NUMBERS) -> bool:
    """Whether text has a row of at least so many numbers."""
    if b"\0" in head and not head.startswith(UTF16):
        return False
    text = text_of(head)
    lines = text.splitlines()
    rows = [line for line in (lines if text.endswith("\n") else lines[:-1] or lines) if line.strip()]  # the last may be cut
    delimiter = _delimiter(rows, minimum)
    return any(_is_row(row, delimiter, minimum) for row in rows[:LOOKED_AT])


def _delimiter(rows: list[str], minimum: int) -> str | None:
    """What separates most rows into equally many fields of which `minimum` are numbers; None for white space.

    Where each row may be one number with a decimal comma, a header of as many names shows two.
    """
    looked, marks = rows[:LOOKED_AT], (";", "\t", ",", "|", None)
    widths = {mark: Counter(len(row.split(mark)) for row in looked if _is_row(row, mark, minimum)) for mark in marks}
    best = max(marks, key=lambda mark: max(widths[mark].values(), default=0))  # of equals the first
    headers = {len(row.split(",")) for row in looked if not _is_row(row, ",", minimum)}
    return "," if [*widths[best]] == [1] and [*widths[","]] == [2] and 2 in headers else best


def _is_row(line: str, delimiter: str | None, minimum: int) -> bool:
    """Whether a line has `minimum` numbers."""
    fields = [] if line.startswith(COMMENTS) else line.split(delimiter)
    if any(mark in line for mark in "[(") and delimiter is not None:
        (fields,) = fields_of([line], delimiter)
        fields = [number for field in fields for number in vector(field) or [field]]
    return sum(map(is_number, fields)) >= minimum


def read_csv(text: str, columns: Columns, path: Path, minimum: int = MIN_NUMBERS) -> None:
    """Add the columns of a table of text with `minimum` numbers in a row.

    `path` is its address for messages.

    Raises:
        DataError: a line is too long for a table.
    """
    above, rows, delimiter = _cut(text, path, minimum)
    header = {line.strip(AROUND) for line in above}
    kept = [line for line in rows if line.strip(AROUND) not in header]
    if repeated := len(rows) - len(kept):  # as of files that were joined
        columns.remarks.notes.append(f"{repeated} lines that repeat the header are left out")
    body, grouped = without_thousands(kept, delimiter)
    values, fields, width = _columns_of(body, above, delimiter, columns)
    refuse_other_header(fields, path)
    named = read_header(above, kept[:FIRSTS], delimiter, width, grouped, columns.numbers, columns.remarks)
    _add_columns(columns, *named, values, fields, COMMA_NUMBER if delimiter != "," else DECIMAL_COMMA)


def read_plain(path: Path, start: str, columns: Columns) -> bool:
    """Add the columns of a file that begins with `start`, in blocks; False of odd rows.

    No row is odd if all are ASCII, and `plain_columns` reads them. Of the whole text `read_csv` makes the same columns.
    """
    above, rows, delimiter = _cut(start, path, MIN_NUMBERS)
    if len(rows) < LOOKED_AT or has_comma_numbers(rows, delimiter):
        return False
    header = {line.strip(AROUND) for line in above}
    plain = plain_columns(lambda: rows_in_blocks(path, rows, header), delimiter)
    if plain is None:
        return False
    named = read_header(above, rows[:FIRSTS], delimiter, len(plain[0]), [], columns.numbers, columns.remarks)
    _add_columns(columns, *named, *plain, COMMA_NUMBER if delimiter != "," else DECIMAL_COMMA)
    return True


def _cut(text: str, path: Path, minimum: int) -> tuple[list[str], list[str], str | None]:
    """Lines above the rows of a table, the rows, and their delimiter."""
    lines = [line for line in text.splitlines() if line.strip()]
    if any(len(line) > MAX_LINE for line in lines):
        raise DataError("has a line of more than 65 536 characters", where=path, expected="a sample a row", fix=TRANSPOSE)
    lines = without_numbers_of_columns(lines, delimiter := _delimiter(lines, minimum))
    first = next((n for n, line in enumerate(lines) if _is_row(line, delimiter, minimum)), len(lines))
    return lines[:first], lines[first:], delimiter


def _add_columns(
    columns: Columns,
    names: list[str],
    units: dict[str, str],
    values: list[np.ndarray | None],
    fields: list[Sequence[str]],
    comma: re.Pattern[str],
) -> None:
    """Add columns of numbers, and of texts what they hold; `comma` matches a number with a decimal comma."""
    commas, empty = list[str](), list[str]()
    if (joined := join_dates(names, fields)) is not None:
        del values[joined]
    for place, (named, read, texts) in enumerate(zip(names, values, fields, strict=True), 1):
        name = named or f"column {place}"
        if read is not None:
            columns.values[name], columns.units[name] = read, units.get(name, "")
            columns.texts |= {name: texts} if texts else {}
            continue
        if not any(texts):
            empty.append(named)
            continue
        if pointed := decimal_points(texts, comma):
            commas.append(name)
        add_fields(columns, name, pointed or texts, units.get(name, ""))
    if unread := ", ".join(filter(None, empty)):
        columns.remarks.notes.append(f"columns without a value are left out: {unread}")
    columns.remarks.notes.extend([f"decimal commas are read as points: {', '.join(commas)}"] if commas else [])


def _columns_of(
    lines: list[str], above: list[str], delimiter: str | None, columns: Columns
) -> tuple[list[np.ndarray | None], list[Sequence[str]], int]:
    """Numbers of columns that are read as such, texts of the others, and how many columns there are."""
    if (plain := plain_columns(lambda: [lines], delimiter)) is not None:
        return *plain, len(plain[0])
    rows = fields_of(lines, delimiter)
    ends = {len(row) for row in fields_of(above, delimiter) if row and row[-1].strip()}
    while rows and len(rows[0]) > 1 and len(rows[0]) not in ends and all(row[-1] == "" for row in rows):
        rows = [row[:-1] for row in rows]  # delimiters end each row, in the header perhaps none
    width = _width(rows, fields_of(above, delimiter))
    whole, others = ([row for row in rows if (len(row) == width) is fits] for fits in (True, False))
    words = sum(row[0].startswith(COMMENTS) or not any(map(is_number, row)) for row in others)
    if words:
        columns.remarks.notes.append(f"{words} lines of words between the rows are left out")
    if len(others) > words:
        columns.remarks.losses.append(f"{len(others) - words} rows do not have {width} fields and are left out")
    fields: list[Sequence[str]] = [[text.strip().strip('"') for text in column] for column in zip(*whole, strict=True)]
    return [None] * len(fields), fields, width


def add_fields(columns: Columns, name: str, texts: Sequence[str], unit: str) -> None:
    """Add a column of texts as numbers, vectors or times, or say what it is instead."""
    if (rows := vectors(texts)) is not None:
        columns.add(name, rows, unit)
    elif (found := numbers(texts)) is not None:
        columns.values[name], columns.texts[name], columns.units[name] = found[0], texts, unit
        if odd := found[1]:
            columns.remarks.notes.append(f"{name}: {len(odd)} fields, as {odd[0][:40]!r}, are no numbers and count as missing")
    elif (dated := calendar_times(texts)) is not None:
        columns.values[name], columns.units[name] = dated[0], "ns"
        columns.local_times.extend([name] if NO_ZONE in dated[1] else [])
        columns.remarks.notes.extend(f"{name}: {note}" for note in dated[1])
    elif len(set(texts)) == 1:
        columns.remarks.notes.append(f"{name} is {texts[0][:200]!r} in every row")
    elif damaged := damaged_times(texts):
        rows_left_out = {row for row, _ in damaged}
        usual = next(text for row, text in enumerate(texts, 1) if row not in rows_left_out)
        first = f"the first in row {damaged[0][0]}: {damaged[0][1][:40]!r}"
        columns.remarks.losses.append(
            f"{name} is left out: {len(damaged)} of its fields are no times as {usual!r} is ({first})"
        )
    else:
        columns.add_labels(name, texts)


def _width(rows: list[list[str]], above: list[list[str]]) -> int:
    """Number of fields of most rows, of those that the header has names for if there are any; of equals the larger.

    A row may be longer than its table: two that a board wrote at once, or a note.
    """
    counts = Counter(map(len, rows))
    named = {len(row) for row in above} & {width for width, count in counts.items() if count > MIN_NAMED * len(rows)}
    return max(named or counts, key=lambda width: (counts[width], width), default=0)
