"""Header of a table of text: names of the columns, and their units."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path

from imutool.errors import DataError
from imutool.recording.message_log import Remarks

from .names import TIME_WORDS, UNITS, distinct_names, is_named_time, split_name, unit_named
from .numbers import fields_of, is_number

MAX_WORDS = 10  # in a refusal
MOSTLY = 0.8  # share of columns above which a text says nothing of a column
UNIT_TEXT = re.compile(r"[\[(]?(\W*|[a-zµ°]+([ /*^²\d-]+[a-z\d²-]*)*|-)[\])]?", re.IGNORECASE)
SENSOR_UNITS = "|".join(UNITS[unit] for unit in ("rad/s", "deg/s", "mdeg/s", "m/s^2", "cm/s^2", "ft/s^2", "mg", "g"))
COMMENTS = "#", "%", "//"
STATED_NUMBER = re.compile(  # above a table: `// Update Rate: 100.0Hz`
    r"\W*(?P<name>[a-z][\w ]{,40}?) *[:=,;\t] *(?P<value>\d{1,9}(\.\d{,15})?) *(?P<unit>k?hz|m?s)?\W*", re.IGNORECASE
)
OF_COLUMNS = re.compile(  # in a comment: `gx/gy/gz=deg/s`, `ax, ay, az in g`
    rf"(?P<names>[a-z]\w*(\s*[/,]\s*[a-z]\w*)*)\s*(=|:|\bin\b|[\[(])\s*(?P<unit>{SENSOR_UNITS})(?![\w/^²])"
)


def read_header(
    above: list[str],
    rows: list[str],
    delimiter: str | None,
    width: int,
    grouped: list[int],
    stated: dict[str, float],
    remarks: Remarks,
) -> tuple[list[str], dict[str, str]]:
    """Names of the columns and their units, by the lines above the rows and the first rows.

    What else they state goes into `stated` and `remarks`; in the columns at `grouped` points mark thousands.
    """
    several = (part for line in above if line.startswith(COMMENTS) for part in re.split(r", |: (?=.*=)| (?=\w+=\S)", line))
    matches = filter(None, map(STATED_NUMBER.fullmatch, [*above, *several]))
    stated |= {f"{match['name']} {match['unit'] or ''}".strip(): float(match["value"]) for match in matches}
    firsts = [row[0].strip().strip('"') for row in fields_of(rows, delimiter) if len(row) == width]
    names, units = header_of(above, delimiter, width, firsts)
    remarks.notes.extend([f"points mark thousands: {', '.join(names[k] for k in grouped)}"] if grouped else [])
    note_unused_header(above, delimiter, names, remarks)
    for unit, of in units_in_comments((line for line in above if line.startswith(COMMENTS)), names).items():
        units |= dict.fromkeys(of, unit)
        remarks.notes.append(f"{', '.join(of)} in {unit}, by a comment above the table")
    return names, units


def header_of(lines: list[str], delimiter: str | None, width: int, first: list[str]) -> tuple[list[str], dict[str, str]]:
    """Names of the columns, with the units of a row of their own below them.

    Without a header they are numbers. In a row of units texts repeat, and in the row of names above it none does. A row of
    names that repeat stands below a row of their groups. A first column without a name may have no field in the header, as in
    what R writes; `first` are its texts.
    """
    rows = [[text.strip().strip('"') for text in row] for row in fields_of([line.lstrip("#% ") for line in lines], delimiter)]
    while len(rows) > 1 and sum(map(is_number, rows[-1])) > sum(map(bool, rows[-1])) / 2:
        rows.pop()  # a row with too few numbers for one of the table
    if rows and len(rows[-1]) == width - 1 > 1 and _lacks_first(rows[-1], first):
        rows[-1] = ["", *rows[-1]]
    rows = [row[:width] for row in rows if len(row) >= width and not any(row[width:])]
    rows = [row for row in rows if any(map(unit_named, row)) or max(map(row.count, row)) <= max(MOSTLY * width, 1)]  # CAL, CAL
    if len(rows) > 2 and _are_units(rows[-2]) and len({*rows[-1]} - {""}) < len(rows[-1]) / 2:
        rows.pop()  # below the units RaceChrono writes the device of each column
    units: list[str] = []
    axes = bool(rows) and {"x", "y", "z"} <= {text.lower() for text in rows[-1]}
    if (len(rows) > 1 and not axes) and (
        sum(bool(UNIT_TEXT.fullmatch(text)) for text in rows[-1]) >= width - 1
        or sum(bool(unit_named(text)) for text in rows[-1]) >= width / 2
        or (_repeats(rows[-1]) and len({*rows[-2]} - {""}) >= width - 1)
    ):
        units = [re.sub(r"^[\[(](.*)[\])]$", r"\1", text) for text in rows.pop()]
    if not rows:
        return [f"column {number}" for number in range(1, width + 1)], {}
    names = rows[-1]
    if len(rows) > 1 and _repeats(names):
        joint, below = _below_groups(rows[-2], names, " " if axes else ".")
        names, units = (names, units) if _repeats(joint) else (joint, units or below)
    names = distinct_names(names)
    return names, dict(zip(names, units, strict=True)) if units else {}


def without_numbers_of_columns(lines: list[str], delimiter: str | None) -> list[str]:
    """Lines without a first one of 0, 1, 2, ..., which pandas writes above unnamed columns."""
    (row,) = fields_of(lines[:1], delimiter) or [[]]
    counted = [text.strip().strip('"') for text in (row if any(row[:1]) else row[1:])]  # above an index stands none
    return lines[1:] if len(counted) > 3 and counted == [*map(str, range(len(counted)))] else lines


def units_in_comments(lines: Iterable[str], names: list[str]) -> dict[str, list[str]]:
    """Columns by the unit that a comment states: `gx/gy/gz=deg/s`, `ax, ay, az in g`."""
    spelled, found = {name.lower(): name for name in names}, dict[str, list[str]]()
    for line in lines:
        for match in OF_COLUMNS.finditer(line.lower()):
            of = [spelled.get(name, "") for name in re.split(r"\s*[/,]\s*", match["names"])]
            if all(of):
                found.setdefault(unit_named(match["unit"]), []).extend(of)
    return found


def _lacks_first(names: list[str], first: list[str]) -> bool:
    """Whether a header lacks the name of the first column, which counts rows, or is the time where no name says so."""
    if not all(names) or any(map(is_number, names)) or not all(map(is_number, first)) or len(first) < 3:
        return False
    steps = {round(float(b) - float(a), 9) for a, b in pairwise(text.replace(",", ".") for text in first)}
    return steps == {1.0} if any(map(is_named_time, names)) else min(steps) > 0.0


def _are_units(texts: list[str]) -> bool:
    """Whether a row states units: what repeats in it is short, and some are known."""
    known = sum(bool(unit_named(text)) for text in texts)
    return known > len(texts) / 5 and all(UNIT_TEXT.fullmatch(text) for text in texts)


def _below_groups(groups: list[str], names: list[str], between: str) -> tuple[list[str], list[str]]:
    """Names of columns joined to those of their groups, and the units that stand below a group of one column.

    A group's name stands above the first of its columns, or above each.
    """
    group, joint, units = "", list[str](), list[str]()
    for above, text, following in zip(groups, names, [*groups[1:], "end"], strict=True):
        group = above or group
        units.append(text if above and following and unit_named(text) else "")
        joint.append(group if units[-1] else between.join(filter(None, (group, text))))
    return joint, units


def _repeats(texts: list[str]) -> bool:
    return len({*texts} - {""}) < len(texts) - texts.count("")


def note_unused_header(above: list[str], delimiter: str | None, names: list[str], remarks: Remarks) -> None:
    """Say of the line above the rows that it names no column, where it seems to."""
    fields = fields_of(above, delimiter)[-1] if above and delimiter is not None else []
    if names[:1] == ["column 1"] and 1 < len(fields) < len(names) and not any(map(is_number, fields)):
        note = f"the line above the rows has {len(fields)} fields and the rows {len(names)}: it names no column"
        is_header = any(re.fullmatch(TIME_WORDS, name) or unit for name, unit in map(split_name, fields))
        # else it may be a title
        (remarks.losses if is_header else remarks.notes).append(f"{note} ({', '.join(fields)[:200]})")


def refuse_other_header(fields: Sequence[Sequence[str]], path: Path) -> None:
    """Refuse rows below another header: their numbers are of other columns, or in other units.

    Such a header is a row of different words, or of units.

    Raises:
        DataError: a row is another header.
    """
    for row in range(len(fields[0]) if fields and all(fields) else 0):  # no texts are kept of columns of plain numbers
        if any(is_number(texts[row]) for texts in fields):
            continue
        words = [texts[row] for texts in fields]
        are_names = len({*words}) > len(words) / 2 and all(re.match(r"[^\W\d]", word) for word in words)
        if are_names or all(map(unit_named, words)):
            what = f"has another header below {row} rows: {', '.join(words[:MAX_WORDS])}"
            raise DataError(what, where=path, expected="one", fix="Give the rows below each header a table of their own")
