"""CSV tables of ASL folders: exact integer stamps, float64 columns by header name."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from itertools import chain

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.errors import DataError

LARGEST_NS = 2**63 - 1
MAX_LINE = 65_536  # bytes; a field of megabytes would come back in an error message
BLOCK_ROWS = 50_000  # rows parsed at once: bounds the Python objects alive to a few hundred megabytes

# How data sets spell a quantity in their headers, less the unit in brackets: templates of one axis, then the axes.
SPELLINGS = {
    "gyro": (("w_rs_s_{}", "w{}", "angular_velocity_{}"), "xyz"),
    "accel": (("a_rs_s_{}", "a{}", "linear_acceleration_{}"), "xyz"),
    "p_wb": (("p_rs_r_{}", "p{}", "{}"), "xyz"),
    "q_wb_wxyz": (("q_rs_{}", "q{}"), "wxyz"),
    "v_w": (("v_rs_r_{}", "v{}"), "xyz"),
    "b_g": (("b_w_rs_s_{}", "bw{}"), "xyz"),
    "b_a": (("b_a_rs_s_{}", "ba{}"), "xyz"),
}
# What the columns after the stamp mean where a table has no header, as the data sets document it.
ORDERS = {
    "imu": ("gyro", "accel"),
    "truth": ("p_wb", "q_wb_wxyz", "v_w", "b_g", "b_a"),
}


@dataclass(frozen=True)
class Table:
    """Table: unchecked stamps (ns, file order), values by quantity, and line numbers."""

    where: str
    t_ns: Int64[np.ndarray, " n"]
    columns: dict[str, Float64[np.ndarray, "n _"]]
    lines: Int64[np.ndarray, " n"]

    def fault(self, row: int, what: str, expected: str) -> DataError:
        """Error at the line of a row."""
        return DataError(what, where=f"{self.where}:{self.lines[row]}", expected=expected)

    def require(self, *names: str) -> None:
        """Refuse a table that lacks a quantity, or has a value that is not finite.

        Raises:
            DataError: at the line and with the value.
        """
        for name in names:
            if name not in self.columns:
                raise DataError(f"has no columns for {name}", where=self.where, expected=_spelled(name))
            finite = np.isfinite(self.columns[name]).all(axis=1)
            if not finite.all():
                row = int(np.argmin(finite))
                raise self.fault(row, f"{name} is {self.columns[name][row].tolist()}", "finite numbers")

    def check_clock(self) -> None:
        """Refuse stamps that repeat or go back.

        Raises:
            DataError: at the line, with both stamps.
        """
        steps = np.diff(self.t_ns)
        if (steps <= 0).any():
            row = int(np.argmax(steps <= 0)) + 1
            raise self.fault(row, f"time goes from {self.t_ns[row - 1]} to {self.t_ns[row]} ns", "increasing stamps")


def parse(content: bytes, where: str, kind: str) -> Table:
    """Parse a table from bytes; `kind` (`imu`, `truth`) sets the columns without a header.

    Raises:
        DataError: empty, no row, a row with another number of columns or a field that is no number (with its line),
            a header that names a quantity in part, columns of unknown meaning.
    """
    lines = _lines(content, where)
    header, first = _header(lines)
    numbers = [n for n in range(first, len(lines)) if lines[n].strip()]
    if not numbers:
        raise DataError("is empty" if not content.strip() else "holds no rows", where=where, expected="rows of numbers")
    width = len(header) or lines[numbers[0]].count(b",") + 1
    if lines[numbers[0]].count(b",") == width:  # a comma ends each row, as some programs write them
        lines = [line.rstrip().removesuffix(b",") for line in lines]
    blocks = [
        _block([lines[n] for n in numbers[start : start + BLOCK_ROWS]], width, where, numbers[start : start + BLOCK_ROWS])
        for start in range(0, len(numbers), BLOCK_ROWS)
    ]
    t_ns = np.concatenate([stamps for stamps, _ in blocks])
    values = np.concatenate([block for _, block in blocks])
    places = _places(header, width, where, kind)
    columns = {name: np.ascontiguousarray(values[:, place]) for name, place in places.items()}
    return Table(where, t_ns, columns, np.array(numbers, np.int64) + 1)


def first_row(head: bytes) -> bytes:
    """First row in a table's first bytes (empty if there is none)."""
    lines = head.removeprefix(b"\xef\xbb\xbf").splitlines()
    return next((line for line in lines[_header(lines)[1] :] if line.strip()), b"")


def pairs(content: bytes, where: str) -> Iterator[tuple[int, str, int]]:
    """Parse a two-column table, such as a camera's image list: stamp (ns), text, line number.

    Raises:
        DataError: a row without a stamp or a text, with its line.
    """
    lines = _lines(content, where)
    _, first = _header(lines)
    for number in range(first, len(lines)):
        if not lines[number].strip():
            continue
        stamp, _, rest = lines[number].partition(b",")
        try:
            t_ns, text = _stamp(stamp), rest.split(b",")[0].strip().decode()
        except ValueError:
            t_ns, text = 0, ""
        if not text:
            raise DataError(f"row is {_shown(lines[number])}", where=f"{where}:{number + 1}", expected="stamp,filename")
        yield t_ns, text, number + 1


def _lines(content: bytes, where: str) -> list[bytes]:
    lines = content.removeprefix(b"\xef\xbb\xbf").splitlines()
    long = next((number for number, line in enumerate(lines, start=1) if len(line) > MAX_LINE), None)
    if long is not None:
        raise DataError(f"line is {len(lines[long - 1])} bytes long", where=f"{where}:{long}", expected="a table of text")
    return lines


def _header(lines: list[bytes]) -> tuple[list[str], int]:
    """Names in the last header line (lower case, without units), and number of header lines.

    A header starts with `#`; one without it is taken for a header only on the first line and when no field is a number.
    """
    names: list[str] = []
    for number, line in enumerate(lines):
        text = line.strip()
        plain = number == 0 and text and not any(_is_number(part) for part in text.split(b","))
        if text and not text.startswith(b"#") and not plain:
            return names, number
        if b"," in text:
            names = [_name(part) for part in text.lstrip(b"# ").decode("utf-8", "replace").split(",")]
    return names, len(lines)


def _name(text: str) -> str:
    return re.split(r"[\[(]", text, maxsplit=1)[0].strip().lower()


def _is_number(text: bytes) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _places(header: list[str], width: int, where: str, kind: str) -> dict[str, list[int]]:
    """Column indices by quantity, counted without the stamp.

    Raises:
        DataError: a name stands twice, a quantity is named in part, or nothing tells what the columns mean.
    """
    names = header[1:]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise DataError(f"header names {twice!r} twice", where=where)
    places: dict[str, list[int]] = {}
    for quantity in ORDERS[kind]:
        templates, axes = SPELLINGS[quantity]
        for template in templates:
            wanted = [template.format(axis) for axis in axes]
            present = [name for name in wanted if name in names]
            if len(present) == len(wanted):
                places[quantity] = [names.index(name) for name in wanted]
                break
            if present:
                missing = next(name for name in wanted if name not in names)
                raise DataError(f"header has {present[0]!r} but not {missing!r}", where=where, expected=", ".join(wanted))
    if places:
        return places
    start = 0
    for quantity in ORDERS[kind]:
        if start == width - 1:
            break
        axes = SPELLINGS[quantity][1]
        places[quantity] = list(range(start, start + len(axes)))
        start += len(axes)
    if start != width - 1:
        raise DataError(f"has {width} columns without known names", where=where, expected=_known_widths(kind))
    return places


def _known_widths(kind: str) -> str:
    widths, total = [], 1
    for quantity in ORDERS[kind]:
        total += len(SPELLINGS[quantity][1])
        widths.append(str(total))
    return f"a header, or the first {' or '.join(widths)} columns of: stamp, {', '.join(ORDERS[kind])}"


def _spelled(quantity: str) -> str:
    templates, axes = SPELLINGS[quantity]
    return " or ".join(", ".join(template.format(axis) for axis in axes) for template in templates)


def _block(
    rows: list[bytes], width: int, where: str, numbers: list[int]
) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, "n k"]]:
    """Stamps and values of some rows; after a fault, search the rows for the bad line."""
    fields = list(chain.from_iterable(row.split(b",") for row in rows))
    commas = width - 1
    if len(fields) == width * len(rows) and all(row.count(b",") == commas for row in rows):
        try:
            if any(b"_" in row for row in rows):  # Python reads 1_000 as a number, nobody else does
                raise ValueError
            stamps = _stamps(fields[::width])
            values = [np.array(list(map(float, fields[column::width]))) for column in range(1, width)]
            return stamps, np.stack(values, axis=1) if values else np.empty((len(rows), 0))
        except (ValueError, OverflowError):
            pass
    for row, number in zip(rows, numbers, strict=True):
        _check_row(row, width, f"{where}:{number + 1}")
    raise DataError("cannot be read", where=where, expected="rows of numbers")


def _check_row(row: bytes, width: int, where: str) -> None:
    """Reason why a row cannot be read, if there is one."""
    fields = row.split(b",")
    if len(fields) != width:
        raise DataError(f"row has {len(fields)} columns: {_shown(row)}", where=where, expected=f"{width} columns")
    try:
        _stamp(fields[0])
    except ValueError:
        raise DataError(f"stamp is {_shown(fields[0])}", where=where, expected="whole nanoseconds") from None
    for number, text in enumerate(fields[1:], start=2):
        if not _is_number(text) or b"_" in text:
            raise DataError(f"column {number} is {_shown(text)}", where=where, expected="a number")


def _shown(text: bytes) -> str:
    shown = text.decode("utf-8", "replace").strip()
    return repr(shown if len(shown) <= 80 else shown[:77] + "...")


def _stamps(texts: list[bytes]) -> Int64[np.ndarray, " n"]:
    try:
        stamps = np.array(list(map(int, texts)), dtype=np.int64)
    except ValueError:
        return np.array(list(map(_stamp, texts)), dtype=np.int64)
    if stamps.size and stamps.min() < 0:
        raise ValueError
    return stamps


def _stamp(text: bytes) -> int:
    """Exact integer nanoseconds of a decimal: `1.691117558834970368e+18` keeps 19 digits.

    Raises:
        ValueError: not a number, a fraction of a nanosecond, negative, or beyond 63 bits.
    """
    try:
        value = Decimal(text.decode("ascii").strip())
    except (InvalidOperation, UnicodeDecodeError):
        raise ValueError("not a number") from None
    if b"_" in text or not value.is_finite() or value.adjusted() > 18 or value < 0 or value != value.to_integral_value():
        raise ValueError("not whole nanoseconds")
    if (stamp := int(value)) > LARGEST_NS:
        raise ValueError("beyond 63 bits")
    return stamp
