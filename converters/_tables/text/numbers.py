"""Numbers in the fields of a table of text."""

from __future__ import annotations

import csv
import re

import numpy as np

COMMA_NUMBER = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
DECIMAL_COMMA = re.compile(r"[+-]?(0?,\d+|\d+,(\d\d?|\d{4,}))([eE][+-]?\d+)?")  # in quotes; of 1,234 it may mark thousands
GROUPED = re.compile(r"[+-]?(0|[1-9]\d{0,2}(\.\d{3})*)(,\d+)?")  # 1.234.567,8
WHOLE_NUMBER = re.compile(r"[+-]?\d{1,19}")
SAMPLED = 200  # rows that show which columns are whole numbers
EXACT = 2.0**15  # larger numbers that are not whole keep their texts: seconds since 1970 and days lose nanoseconds as float64
MAX_BACK = 0.25  # share of the steps of a time that go back
MAX_ODD = 0.1  # share of the fields of a column of numbers that are none: `-`, `ERR`, a garbled line


def plain_columns(lines: list[str], delimiter: str | None) -> tuple[list[np.ndarray | None], list[list[str]]] | None:
    """Numbers and texts of columns, of lines of equally many fields; None of other lines.

    A field may have quotes, with no delimiter in them. A column is all of numbers, and has its texts only if it may be a time
    that float64 rounds, or is all of texts. NumPy takes a tenth of the time and memory of Python's fields.
    """
    if any('"' in line for line in lines):
        if any(_count(part, delimiter) > 1 for line in lines for part in line.split('"')[1::2]):
            return None
        lines = [line.replace('"', "") for line in lines]
    looked = [line.split(delimiter) for line in [*lines[:SAMPLED], *lines[-1:]]]
    width = len(looked[0]) if looked else 0
    if not width or any(_count(line, delimiter) != width for line in lines) or not any(row[-1] for row in looked):
        return None
    fields = [[text.strip() for text in column] for column in zip(*looked, strict=True)]
    kinds = {
        str(k): np.int64 if all(map(WHOLE_NUMBER.fullmatch, texts)) else np.float64
        for k, texts in enumerate(fields)
        if None not in map(_number, texts)
    }
    if not kinds:
        return None
    try:
        used = [int(k) for k in kinds]
        rows = np.loadtxt(lines, [*kinds.items()], comments=None, delimiter=delimiter, usecols=used, ndmin=1)
    except (ValueError, OverflowError):
        return None
    values = [np.ascontiguousarray(rows[str(k)]) if str(k) in kinds else None for k in range(width)]
    texts: list[list[str]] = [[] for _ in values]
    kept = [k for k, column in enumerate(values) if column is None or _is_rounded_time(column)]
    for parts in (line.split(delimiter, max(kept) + 1) for line in lines if kept):
        for k in kept:
            texts[k].append(parts[k].strip())
    return values, texts


def _is_rounded_time(column: np.ndarray) -> bool:
    """Whether a column may be a time that float64 rounds; it seldom goes back."""
    is_large = column.dtype.kind == "f" and bool((np.abs(column) > EXACT).any())
    return is_large and bool((np.diff(column) < 0.0).sum() <= MAX_BACK * len(column))


def _count(line: str, delimiter: str | None) -> int:
    return len(line.split()) if delimiter is None else line.count(delimiter) + 1


def fields_of(lines: list[str], delimiter: str | None) -> list[list[str]]:
    """Fields of each line; in quotes the delimiter is text."""
    if delimiter is not None and any('"' in line for line in lines[:50]):
        return list(csv.reader(lines, delimiter=delimiter))
    return [line.split(delimiter) for line in lines]


def is_number(text: str) -> bool:
    """Whether a field is a number, perhaps with a decimal comma."""
    text = text.strip().strip('"')
    return _number(text) is not None or ("_" not in text and bool(COMMA_NUMBER.fullmatch(text)))


def vector(text: str) -> list[str]:
    """Numbers of a vector in a text, as NumPy prints it: `[ 0.1 -0.2  9.8]`; none of others."""
    match = re.fullmatch(r"\s*[\[(]([^\[\]()]*)[\])]\s*", text)
    fields = re.split(r"[\s,;]+", match[1].strip()) if match else []
    return fields if len(fields) > 1 and all(_number(field) is not None for field in fields) else []


def vectors(texts: list[str]) -> np.ndarray | None:
    """Vectors of a column; None of other texts, or of several lengths."""
    if not vector(texts[0]):
        return None
    found = [vector(text) for text in texts]
    return np.array(found).astype(np.float64) if len({*map(len, found)}) == 1 else None


def decimal_points(texts: list[str], mark: re.Pattern[str]) -> list[str]:
    """Fields with points for their decimal commas; none where no field has one."""
    has_one = "," in "".join(texts) and any("," in text and mark.fullmatch(text) for text in texts)
    return [text.replace(",", ".") for text in texts] if has_one else []


def without_thousands(lines: list[str], delimiter: str | None) -> tuple[list[str], list[int]]:
    """Rows without points that mark thousands, and the places of their columns."""
    if delimiter == "," or not any(
        COMMA_NUMBER.fullmatch(text) for row in fields_of(lines[:SAMPLED], delimiter) for text in row
    ):
        return lines, []
    rows = [[text.strip().strip('"') for text in row] for row in fields_of(lines, delimiter)]
    width = len(rows[0])
    columns = ([row[place] for row in rows if len(row) == width and row[place]] for place in range(width))
    grouped = [
        k for k, texts in enumerate(columns) if any("." in text for text in texts) and all(map(GROUPED.fullmatch, texts))
    ]
    for row in rows if grouped else ():
        for place in grouped if len(row) == width else ():
            row[place] = row[place].replace(".", "")
    return [(delimiter or " ").join(row) for row in rows] if grouped else lines, grouped


def numbers(texts: list[str]) -> tuple[np.ndarray, list[str]] | None:
    """Numbers of a column, nan for the few fields that are none, and these; None of texts."""
    if "_" not in "".join(texts):
        for kind in (int, float):
            try:
                return np.array(list(map(kind, texts)), np.int64 if kind is int else np.float64), []
            except (ValueError, OverflowError):
                pass
    found = [_number(text) for text in texts]
    odd = [text for text, number in zip(texts, found, strict=True) if number is None and text]
    if len(odd) > MAX_ODD * len(texts):
        return None
    return np.array([np.nan if number is None else number for number in found]), odd


def _number(text: str) -> float | None:
    """Number of a field; Python reads 2026_06_15 as one, nobody else does."""
    try:
        return None if "_" in text else float(text)
    except ValueError:
        return None


def no_numbers(name: str, texts: list[str]) -> str:
    """Sentence on a column of texts, which is left out."""
    wrong = next((text for text in texts if text and not is_number(text)), texts[0])
    return f"{name} is left out: its fields, as {wrong[:40]!r}, are no numbers"
