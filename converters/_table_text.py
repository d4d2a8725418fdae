"""Columns of numbers and tables of text: delimiters, headers, units, calendar times.

A matrix of three columns `gyro` becomes the columns `gyro[0]`, `gyro[1]`, `gyro[2]`, whichever way it lies.
"""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from imutool.errors import DataError
from imutool.recording.message_log import Remarks

UTF16 = b"\xff\xfe", b"\xfe\xff"
WIDEST = 64  # columns of a matrix; wider ones are images
MAX_LINE = 65_536
LAST_S = 9_223_372_036  # in the year 2262, where nanoseconds in 64 bits end
LEAST_NUMBERS = 4  # in a row: a time and a vector
COMMENTS = "#", "%", "//"
DATE = re.compile(  # 2026-11-21T15:04:05.123Z, also with a blank and an offset; 21.11.2026 15:04:05,123
    r"(?:(\d{4})-(\d\d)-(\d\d)|(\d\d?)\.(\d\d?)\.(\d{4}))[T ]+(\d\d?:\d\d:\d\d)(?:[.,](\d{1,9})\d*)? ?(Z|UTC|[+-]\d\d:?\d\d)?"
)
UNIT_TEXT = re.compile(r"[\[(]?(\W*|[a-zµ°]+([ /*^²\d-]+[a-z\d²-]*)*|-)[\])]?", re.IGNORECASE)
SECONDS, NANOSECONDS = (
    re.compile(r"(.*?)(secs?|seconds?)", re.I),
    ("nsec", "nsecs", "nanosec", "nanosecs", "nanosecond", "nanoseconds"),
)
COMMA_NUMBER = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")


@dataclass
class Columns:
    """Columns by name, with units, rotation matrices, the texts of decimals, and remarks."""

    values: dict[str, np.ndarray] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    matrices: dict[str, np.ndarray] = field(default_factory=dict)
    texts: dict[str, list[str]] = field(default_factory=dict)
    remarks: Remarks = field(default_factory=Remarks)

    def add(self, name: str, array: Any, unit: str = "") -> None:
        """Take in an array of numbers of one, two or three dimensions."""
        array = np.asarray(array)
        if array.dtype.kind not in "iufb" or array.ndim > 3 or not array.size:
            return
        if array.ndim == 3:
            if array.shape[:2] == (3, 3):
                self.matrices[name] = np.moveaxis(array, 2, 0).astype(float)
            elif array.shape[1:] == (3, 3):
                self.matrices[name] = array.astype(float)
            return
        if array.ndim == 2 and array.shape[0] < array.shape[1]:
            array = array.T
        if array.ndim == 2 and array.shape[1] > 1:
            for number in range(array.shape[1] if array.shape[1] <= WIDEST else 0):
                self.values[f"{name}[{number}]"], self.units[f"{name}[{number}]"] = array[:, number], unit
        elif array.size > 1:
            self.values[name], self.units[name] = array.reshape(-1), unit

    def join_stamps(self) -> None:
        """Make one column of a stamp that has its seconds and its nanoseconds in two, as ROS' header.stamp has."""
        for seconds in [column for column in self.values if SECONDS.fullmatch(column)]:
            stem = SECONDS.fullmatch(seconds)[1]  # type: ignore[index]  # it matched
            nanoseconds = next((c for c in self.values if c.startswith(stem) and c[len(stem) :].lower() in NANOSECONDS), "")
            name, pair = f"{stem.rstrip('._/ ') or 'stamp'} [ns]", [self.values.get(c) for c in (seconds, nanoseconds)]
            if name in self.values or not all(part is not None and part.dtype.kind in "iu" for part in pair):
                continue
            sec, nsec = (np.asarray(part).astype(np.int64) for part in pair)
            if len(sec) == len(nsec) and 0 <= sec.min() <= sec.max() < LAST_S and 0 <= nsec.min() <= nsec.max() < 10**9:
                del self.values[seconds], self.values[nanoseconds]
                self.values[name], self.units[name] = sec * 10**9 + nsec, "ns"


def text_of(raw: bytes) -> str:
    """Text in UTF-8 or UTF-16, else in the code page of Western Windows, which Excel writes."""
    if raw.startswith(UTF16):
        return raw.decode("utf-16", "replace")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        cut = error.start >= len(raw) - 3  # inside a character
        return raw.decode("utf-8-sig", "ignore") if cut else raw.decode("cp1252", "replace")


def is_text_table(head: bytes) -> bool:
    """Whether text has a row of at least four numbers."""
    if b"\0" in head and not head.startswith(UTF16):
        return False
    lines = text_of(head).splitlines()
    rows = [line for line in lines[:-1] or lines if line.strip()]
    delimiter = _delimiter(rows)
    return any(sum(map(_is_number, row.split(delimiter))) >= LEAST_NUMBERS for row in rows[:50])


def _delimiter(rows: list[str], least: int = LEAST_NUMBERS) -> str | None:
    """What separates the fields, of which there are `least`; None for white space."""
    plain = [row for row in rows[:50] if not row.startswith(COMMENTS)]
    counts = {mark: min((row.count(mark) for row in plain[1:20]), default=0) for mark in (";", "\t", ",")}
    return next((mark for mark, count in counts.items() if count >= least - 1), None)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return bool(COMMA_NUMBER.fullmatch(text.strip()))
    return True


def read_csv(text: str, columns: Columns, path: Path, least: int = LEAST_NUMBERS) -> None:
    """Add the columns of a table of text with `least` numbers in a row.

    `path` is its address for messages.

    Raises:
        DataError: a line is too long for a table.
    """
    lines = [line for line in text.splitlines() if line.strip()]
    if any(len(line) > MAX_LINE for line in lines):
        raise DataError("has a line of more than 65 536 characters", where=path, expected="a table of text")
    delimiter = _delimiter(lines, least)
    first = next((n for n, line in enumerate(lines) if sum(map(_is_number, line.split(delimiter))) >= least), len(lines))
    rows = _fields(lines[first:], delimiter)
    width = max(map(len, rows), default=0)
    names, units = _header(lines[:first], delimiter, width)
    whole = [row for row in rows if len(row) == width]
    if len(whole) < len(rows):
        columns.remarks.losses.append(f"{len(rows) - len(whole)} rows do not have {width} fields and are left out")
    commas: list[str] = []
    for name, fields in zip(names, zip(*whole, strict=True), strict=True):
        texts = [text.strip().strip('"') for text in fields]
        if delimiter != "," and any(COMMA_NUMBER.fullmatch(text) for text in texts[:100]):
            texts[:] = [text.replace(",", ".") for text in texts]
            commas.append(name)
        if (values := _numbers(texts)) is not None:
            columns.values[name], columns.texts[name], columns.units[name] = values, texts, units.get(name, "")
        elif (t_ns := _dates(texts)) is not None:
            columns.values[name], columns.units[name] = t_ns, "ns"
            if not texts[0].endswith(("Z", "UTC")) and not re.search(r":\d\d[.,\d]*[+-]", texts[0]):
                columns.remarks.notes.append(f"{name}: its times name no zone and count as UTC")
        elif len(set(texts)) == 1:
            columns.remarks.notes.append(f"{name} is {texts[0][:200]!r} in every row")
        else:
            columns.remarks.losses.append(f"{name} is left out: its fields, as {texts[0][:40]!r}, are no numbers")
    if commas:
        columns.remarks.notes.append(f"decimal commas are read as points: {', '.join(commas)}")


def _header(lines: list[str], delimiter: str | None, width: int) -> tuple[list[str], dict[str, str]]:
    """Names of the columns, with the units of a row of their own below them; numbers where there is no header."""
    rows = [[text.strip().strip('"') for text in row] for row in _fields([line.lstrip("#% ") for line in lines], delimiter)]
    rows = [row for row in rows if len(row) == width]
    if len(rows) > 1 and sum(bool(UNIT_TEXT.fullmatch(text)) for text in rows[-1]) >= width - 1:
        names = _distinct(rows[-2])
        return names, dict(zip(names, (text.strip("[]()") for text in rows[-1]), strict=True))
    return (_distinct(rows[-1]) if rows else [f"column {number}" for number in range(1, width + 1)]), {}


def _dates(texts: list[str]) -> np.ndarray | None:
    """Calendar times in nanoseconds since 1970; None for other texts."""
    found = []
    for text in texts:
        if (match := DATE.fullmatch(text)) is None:
            return None
        year, month, day, day_first, month_second, year_last, clock, fraction, zone = match.groups()
        date = (year, month, day) if year else (year_last, month_second.zfill(2), day_first.zfill(2))
        try:
            seconds = int(np.datetime64(f"{'-'.join(date)}T{clock.zfill(8)}", "s").astype(np.int64))
        except ValueError:
            return None
        if zone and zone[0] in "+-":
            seconds -= int(f"{zone[0]}1") * (3600 * int(zone[1:3]) + 60 * int(zone[-2:]))
        found.append(seconds * 10**9 + int((fraction or "0").ljust(9, "0")))
    return np.array(found, np.int64)


def _fields(lines: list[str], delimiter: str | None) -> list[list[str]]:
    """Fields of each line; in quotes the delimiter is text."""
    if delimiter is not None and any('"' in line for line in lines[:50]):
        return list(csv.reader(lines, delimiter=delimiter))
    return [line.split(delimiter) for line in lines]


def _distinct(names: list[str]) -> list[str]:
    """Names of columns; one that repeats stands below the last that does not, as in a bag's messages written as a table.

    `angular_velocity,x,y,z,linear_acceleration,x,y,z` has `angular_velocity.x`, `linear_acceleration.x`, ....
    """
    above, distinct = "", []
    for text in names:
        if names.count(text) > 1:
            distinct.append(f"{above}.{text}" if above else text)
        else:
            above = text
            distinct.append(text)
    return distinct


def _numbers(texts: list[str]) -> np.ndarray | None:
    try:
        return np.array(list(map(int, texts)), np.int64)
    except (ValueError, OverflowError):
        pass
    try:
        return np.array([float(text) if text else np.nan for text in texts])
    except ValueError:
        return None
