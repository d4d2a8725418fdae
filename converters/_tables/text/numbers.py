"""Numbers in the fields of a table of text."""

from __future__ import annotations

import csv
import re
from array import array
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, overload

import numpy as np

COMMA_NUMBER = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
DECIMAL_COMMA = re.compile(r"[+-]?(0?,\d+|\d+,(\d\d?|\d{4,}))([eE][+-]?\d+)?")  # in quotes; of 1,234 it may mark thousands
GROUPED = re.compile(r"[+-]?(0|[1-9]\d{0,2}(\.\d{3})*)(,\d+)?")  # 1.234.567,8
WHOLE_NUMBER = re.compile(r"[+-]?\d{1,19}")
SAMPLED = 200  # rows that show which columns are whole numbers
EXACT = 2.0**15  # larger numbers that are not whole keep their texts: seconds since 1970 and days lose nanoseconds as float64
MAX_BACK = 0.25  # share of the steps of a time that go back
MAX_ODD = 0.1  # share of the fields of a column of numbers that are none: `-`, `ERR`, a garbled line


class Texts(Sequence[str]):
    """Texts of a column without line breaks; a list of them takes fifty bytes more for each."""

    def __init__(self) -> None:
        self._blocks: list[str] = []
        self._starts = [0]  # rows in which the blocks begin, and the end

    def add(self, texts: list[str]) -> None:
        """Take in the texts of further rows."""
        if texts:
            self._blocks.append("\n".join(texts))
            self._starts.append(self._starts[-1] + len(texts))

    def __len__(self) -> int:
        return self._starts[-1]

    def __iter__(self) -> Iterator[str]:
        return (text for block in self._blocks for text in block.split("\n"))

    @overload
    def __getitem__(self, row: int) -> str: ...
    @overload
    def __getitem__(self, row: slice) -> list[str]: ...
    def __getitem__(self, row: int | slice) -> str | list[str]:
        if isinstance(row, slice):
            return [*self][row]
        row = range(len(self))[row]
        block = bisect_right(self._starts, row) - 1
        return self._blocks[block].split("\n")[row - self._starts[block]]


def plain_columns(
    blocks: Callable[[], Iterable[list[str]]], delimiter: str | None
) -> tuple[list[np.ndarray | None], list[Sequence[str]]] | None:
    """Numbers and texts of columns of blocks of lines; None of lines of unequal widths.

    A field may have quotes, with no delimiter in them. A column is all of numbers, and has its texts only if it may be a time
    that float64 rounds, or is all of texts. NumPy takes a tenth of the time and memory of Python's fields. A block that cannot
    be read raises a ValueError.
    """
    looked, width, count, kinds = list[str](), 0, 0, dict[str, type]()
    parts: dict[str, array[Any]] = {}
    try:
        for lines in (_without_quotes(block, delimiter) for block in blocks()):
            if not width:
                looked, width = lines[:SAMPLED], _count(lines[0], delimiter) if lines else 0
            if not width or any(_count(line, delimiter) != width for line in lines):
                return None
            if not (kinds := kinds or _kinds([*looked, lines[-1]], delimiter)):
                return None
            used = [int(k) for k in kinds]
            read = np.loadtxt(lines, [*kinds.items()], comments=None, delimiter=delimiter, usecols=used, ndmin=1)
            for k in kinds:  # an array that grows, as two of the whole length would be in memory to join parts
                parts.setdefault(k, array(read[k].dtype.char)).frombytes(read[k].tobytes())
            count += len(read)
            del read
        if not kinds or _kinds([*looked, lines[-1]], delimiter) != kinds:
            return None
        read_as = ((k, kinds.get(str(k))) for k in range(width))
        values: list[np.ndarray | None] = [None if kind is None else np.frombuffer(parts[str(k)], kind) for k, kind in read_as]
        kept = [k for k, column in enumerate(values) if column is None or _is_rounded_time(column)]
        texts = [Texts() for _ in values]
        for lines in (_without_quotes(block, delimiter) for block in (blocks() if kept else ())):
            left = count - len(texts[kept[0]])  # the file may have grown
            rows = [line.split(delimiter, max(kept) + 1) for line in lines[:left]]
            for place in kept:
                texts[place].add([row[place].strip() for row in rows])
    except (ValueError, OverflowError):
        return None
    return (values, [*texts]) if all(len(texts[k]) == count for k in kept) else None


def _without_quotes(lines: list[str], delimiter: str | None) -> list[str]:
    """Lines without the quotes around fields.

    Raises:
        ValueError: a delimiter stands in quotes.
    """
    if not any('"' in line for line in lines):
        return lines
    if any(_count(part, delimiter) > 1 for line in lines for part in line.split('"')[1::2]):
        raise ValueError("a delimiter in quotes")
    return [line.replace('"', "") for line in lines]


def _kinds(lines: list[str], delimiter: str | None) -> dict[str, type]:
    """Types of the columns of numbers, by their places; none where the last field of each line is blank."""
    rows = [line.split(delimiter) for line in lines]
    fields = [[text.strip() for text in column] for column in zip(*rows, strict=True)]
    return {
        str(k): np.int64 if all(map(WHOLE_NUMBER.fullmatch, texts)) else np.float64
        for k, texts in enumerate(fields if any(row[-1] for row in rows) else [])
        if None not in map(_number, texts)
    }


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


def vectors(texts: Sequence[str]) -> np.ndarray | None:
    """Vectors of a column; None of other texts, or of several lengths."""
    if not vector(texts[0]):
        return None
    found = [vector(text) for text in texts]
    return np.array(found).astype(np.float64) if len({*map(len, found)}) == 1 else None


def decimal_points(texts: Sequence[str], mark: re.Pattern[str]) -> list[str]:
    """Fields with points for their decimal commas; none where no field has one."""
    has_one = "," in "".join(texts) and any("," in text and mark.fullmatch(text) for text in texts)
    return [text.replace(",", ".") for text in texts] if has_one else []


def has_comma_numbers(lines: list[str], delimiter: str | None) -> bool:
    """Whether a field of the first lines has a decimal comma, between other delimiters."""
    fields = (text for row in fields_of(lines[:SAMPLED], delimiter) for text in row)
    return delimiter != "," and any(map(COMMA_NUMBER.fullmatch, fields))


def without_thousands(lines: list[str], delimiter: str | None) -> tuple[list[str], list[int]]:
    """Rows without points that mark thousands, and the places of their columns."""
    if not has_comma_numbers(lines, delimiter):
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


def numbers(texts: Sequence[str]) -> tuple[np.ndarray, list[str]] | None:
    """Numbers of a column, nan for the few fields that are none, and these; None of texts."""
    if "_" not in "".join(texts):
        for kind in (int, float):
            try:
                return np.fromiter(map(kind, texts), np.int64 if kind is int else np.float64, len(texts)), []
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


def no_numbers(name: str, texts: Sequence[str]) -> str:
    """Sentence on a column of texts, which is left out."""
    wrong = next((text for text in texts if text and not is_number(text)), texts[0])
    return f"{name} is left out: its fields, as {wrong[:40]!r}, are no numbers"
