"""Spreadsheets (.xlsx, .xls): sheets as tables.

The library holds every cell between the first and the last of a sheet, 32 bytes each, also those without a value: a cell that
somebody left in the last row and column would be half a terabyte. So the cells of an .xlsx are counted before it is opened. An
.xls has at most 65 536 rows of 256.
"""

from __future__ import annotations

import datetime
import re
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from imutool.errors import DataError, required

from ..._archive import MAX_RATIO, RATIO_FREE, once_per_content, refusing
from ..._source import head
from ..text.delimited import Columns, is_text_table, read_csv
from .sensors import SENSORS, name_columns, pairs_among, sensors_among

MAX_CELLS = 1 << 25  # of a sheet: a gigabyte
LONGEST = 200  # letters of a cell that are kept
CHUNK, ZIP = 1 << 22, b"PK"
CELL = re.compile(rb"<(?:\w+:)?c\s[^<>]*?\br\s*=\s*[\"']([A-Za-z]{1,7})(\d{1,10})[\"']")
DETAILS = r"(?i)metadata\b.*"  # sheets in which phyphox describes the phone and the times of its buttons
Reader = Callable[[str, Columns, Path], None]


def load_sheets(path: Path, columns: Columns, read: Reader) -> None:
    """Add the columns of the only table in a spreadsheet, or those of each as a group.

    `read` adds the columns of a text.

    Raises:
        ConfigError: a library is missing; the extra is named.
        DataError: damaged, too large, or without a table.
    """
    texts = dict(_sheets(path))
    tables = {name: text for name, text in texts.items() if is_text_table(text.encode(), 2) and not re.fullmatch(DETAILS, name)}
    if unread := ", ".join(name for name, text in texts.items() if name not in tables and text):
        columns.remarks.notes.append(f"sheets without rows of numbers, or about the recording, are left out: {unread}")
    if len(tables) == 1:
        read(next(iter(tables.values())), columns, path)
        return
    groups = sensors_among(tables)
    groups = groups if {*groups.values()} == {*SENSORS} else pairs_among(tables)
    for name, text in tables.items():
        part, group = Columns(), groups.get(name, name)
        if is_text_table(text.encode()):
            read(text, part, path)
        else:  # a time and a number
            read_csv(text, part, path, minimum=2)
        name_columns(part, sensor if (sensor := group.rpartition("/")[2]) in SENSORS else "")
        columns.take(group, part, f"sheet {name}")


def _sheets(path: Path) -> Iterator[tuple[str, str]]:
    """Name of each sheet that is shown, and its rows as lines of text."""
    calamine = required("python_calamine", "tables", package="python-calamine", where=path, user="reading it")
    if head(path).startswith(ZIP):
        _check_members(path)
    try:
        with calamine.CalamineWorkbook.from_path(str(path)) as book:
            kind = calamine.SheetTypeEnum.WorkSheet, calamine.SheetVisibleEnum.Visible
            for name in [about.name for about in book.sheets_metadata if (about.typ, about.visible) == kind]:
                rows = book.get_sheet_by_name(name).iter_rows()
                yield name, "\n".join("\t".join(map(_text, row)) for row in rows)
    except calamine.CalamineError as error:
        raise DataError(
            f"cannot be read as a spreadsheet ({error})", where=path, fix="Save it anew, or as CSV (UTF-8)"
        ) from error


@once_per_content(64)  # sheets are looked at, then read
def _check_members(path: Path) -> None:
    with refusing(path), zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            with archive.open(member) as file:
                _check_cells(iter(partial(file.read, CHUNK), b""), path, member)


def _check_cells(chunks: Iterator[bytes], path: Path, member: zipfile.ZipInfo) -> None:
    """Refuse a sheet whose cells span more than `MAX_CELLS`, or that unpacks beyond all proportion.

    Raises:
        DataError: with the cell.
    """
    rows, width, rest, size = 1, 1, b"", 0
    for chunk in chunks:
        size += len(chunk)
        if size > MAX_RATIO * member.compress_size + RATIO_FREE:
            raise DataError(f"unpacks to more than {size} bytes", where=path, expected=f"at most {MAX_RATIO} to 1")
        text = rest + chunk
        for letters, digits in CELL.findall(text):
            row, column = int(digits), 0
            for letter in letters.upper():
                column = 26 * column + letter - ord("A") + 1
            rows, width = max(rows, row), max(width, column)
            if rows * width > MAX_CELLS:
                what = f"has a cell {letters.decode()}{row}, which makes {rows} rows of {width} columns"
                fix = "Delete the rows and columns behind the table, or save the sheet as CSV (UTF-8)"
                raise DataError(
                    what, where=f"{path}/{member.filename}", expected=f"at most {MAX_CELLS} cells in a sheet", fix=fix
                )
        rest = text[-256:]


def _text(value: Any) -> str:
    """A cell as a table of text has it: whole numbers without a point, dates and times as they are written."""
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, float):
        return str(int(value)) if value.is_integer() and abs(value) < 2**63 else repr(value)
    if isinstance(value, datetime.timedelta):
        return repr(value.total_seconds())
    return re.sub(r"[\s\"]+", " ", str(value))[:LONGEST]
