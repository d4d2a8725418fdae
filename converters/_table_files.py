"""Columns of numbers from table files: CSV, TSV, Parquet, .npz, MATLAB .mat and HDF5.

A matrix of three columns `gyro` becomes the columns `gyro[0]`, `gyro[1]`, `gyro[2]`, whichever way it lies.
"""

from __future__ import annotations

import csv
import re
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from imutool.errors import ConfigError, DataError
from imutool.recording.message_log import Remarks

from ._archive import refusing

LIMIT = 4 << 30  # bytes of numbers in one file
WIDEST = 64  # columns of a matrix; wider ones are images
MAX_LINE = 65_536
DELIMITERS = (",", ";", "\t")
HDF5, MAT5, PARQUET, ZIP = b"\x89HDF\r\n\x1a\n", b"MATLAB 5.0 MAT-file", b"PAR1", b"PK\x03\x04"
COMMA_NUMBER = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")


@dataclass
class Columns:
    """Columns by name, rotation matrices, the texts of decimals, and remarks."""

    values: dict[str, np.ndarray] = field(default_factory=dict)
    matrices: dict[str, np.ndarray] = field(default_factory=dict)
    texts: dict[str, list[str]] = field(default_factory=dict)
    remarks: Remarks = field(default_factory=Remarks)

    def add(self, name: str, array: Any) -> None:
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
                self.values[f"{name}[{number}]"] = array[:, number]
        elif array.size > 1:
            self.values[name] = array.reshape(-1)


def kind_of(head: bytes, path: Path) -> str:
    """Kind of a table file by its first bytes; empty for any other file."""
    if head.startswith(MAT5):
        return "mat"
    if head.startswith(HDF5) or head[512:].startswith(HDF5):
        return "hdf5"
    if head.startswith(PARQUET):
        return "parquet"
    if head.startswith(ZIP):
        return "npz" if _is_npz(path) else ""
    return "csv" if _is_text_table(head) else ""


def load(path: Path, kind: str) -> Columns:
    """Columns of a table file.

    Raises:
        ConfigError: a library is missing; the extra is named.
        DataError: damaged, too large, or without numbers.
    """
    columns = Columns()
    with refusing(path):
        LOADERS[kind](path, columns)
    if not columns.values:
        raise DataError("holds no columns of numbers", where=path, expected="a time, three rates and three accelerations")
    return columns


def _is_npz(path: Path) -> bool:
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith(".npy") for name in archive.namelist())
    except (OSError, zipfile.BadZipFile):
        return False


def _is_text_table(head: bytes) -> bool:
    """Whether text has a row of at least seven numbers, or four with a header that names them."""
    try:
        lines = head.decode("utf-8-sig", "strict" if len(head) < 4096 else "ignore").splitlines()
    except UnicodeDecodeError:
        return False
    rows = [line for line in lines[:-1] or lines if line.strip()]
    delimiter = _delimiter(rows)
    return any(sum(map(_is_number, row.split(delimiter))) >= 4 for row in rows[:20])


def _delimiter(rows: list[str]) -> str | None:
    """What separates the fields; None for white space."""
    counts = {mark: min((row.count(mark) for row in rows[1:20]), default=0) for mark in (";", "\t", ",")}
    return next((mark for mark, count in counts.items() if count >= 3), None)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return bool(COMMA_NUMBER.fullmatch(text.strip()))
    return True


def _load_csv(path: Path, columns: Columns) -> None:
    read_csv(path.read_text(encoding="utf-8-sig", errors="replace"), columns, path)


def read_csv(text: str, columns: Columns, path: Path) -> None:
    """Add the columns of a table of text; `path` is its address for messages.

    Raises:
        DataError: a line is too long for a table.
    """
    lines = [line for line in text.splitlines() if line.strip()]
    if any(len(line) > MAX_LINE for line in lines):
        raise DataError("has a line of more than 65 536 characters", where=path, expected="a table of text")
    delimiter = _delimiter(lines)
    first = next((n for n, line in enumerate(lines) if sum(map(_is_number, line.split(delimiter))) >= 4), len(lines))
    rows = _fields(lines[first:], delimiter)
    width = max(map(len, rows), default=0)
    names = _distinct([name.strip().strip('"') for name in lines[first - 1].lstrip("# ").split(delimiter)]) if first else []
    if len(names) != width:
        names = [f"column {number}" for number in range(1, width + 1)]
    whole = [row for row in rows if len(row) == width]
    if len(whole) < len(rows):
        columns.remarks.losses.append(f"{len(rows) - len(whole)} rows do not have {width} fields and are left out")
    for name, fields in zip(names, zip(*whole, strict=True), strict=True):
        texts = [text.strip().strip('"') for text in fields]
        if delimiter != "," and any(COMMA_NUMBER.fullmatch(text) for text in texts[:100]):
            texts[:] = [text.replace(",", ".") for text in texts]
            columns.remarks.notes.append(f"{name}: decimal commas are read as points")
        if (values := _numbers(texts)) is not None:
            columns.values[name], columns.texts[name] = values, texts


def _fields(lines: list[str], delimiter: str | None) -> list[list[str]]:
    """Fields of each line; in quotes the delimiter is text."""
    if delimiter is not None and any('"' in line for line in lines[:20]):
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


def _load_parquet(path: Path, columns: Columns) -> None:
    parquet = _module("pyarrow.parquet", path)
    file = parquet.ParquetFile(path)
    _check_size(path, file.metadata.num_rows * file.metadata.num_columns * 8)
    table = file.read()
    for name in table.column_names:
        column = table.column(name)
        if str(column.type).startswith("timestamp"):
            columns.add(f"{name} [ns]", column.cast("timestamp[ns]").cast("int64").to_numpy())
        else:
            columns.add(name, column.to_numpy())


def _load_npz(path: Path, columns: Columns) -> None:
    with zipfile.ZipFile(path) as archive:
        _check_size(path, sum(info.file_size for info in archive.infolist()))
    with np.load(path, allow_pickle=False) as arrays:
        for name in arrays.files:
            columns.add(name, arrays[name])


def _load_mat(path: Path, columns: Columns) -> None:
    scipy_io = _module("scipy.io", path)
    _check_size(path, sum(8 * int(np.prod(shape, dtype=float)) for _, shape, _ in scipy_io.whosmat(path)))
    try:
        content = scipy_io.loadmat(path, simplify_cells=True)
    except Exception as error:  # scipy raises whatever damaged bytes lead to
        raise DataError(f"cannot be read as a .mat file ({error})", where=path) from error
    for name, value in _flat(content):
        columns.add(name, value)


def _flat(content: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Arrays of nested structures, with dotted names."""
    for name, value in content.items():
        if not name.startswith("__"):
            if isinstance(value, dict):
                yield from _flat(value, f"{prefix}{name}.")
            elif isinstance(value, np.ndarray):
                yield f"{prefix}{name}", value


def _load_hdf5(path: Path, columns: Columns) -> None:
    h5py = _module("h5py", path)

    def visit(name: str, node: Any) -> None:  # external links are never followed
        if not isinstance(node, h5py.Dataset) or node.dtype.kind not in "iufb":
            return
        if node.external or node.is_virtual:
            raise DataError(f"{name} lies in another file", where=path, fix="Copy it into this file")
        _check_size(path, node.size * 8)
        columns.add(name, node[()])

    with h5py.File(path, "r") as file:
        file.visititems(visit)


def _check_size(path: Path, size: int) -> None:
    if size > LIMIT:
        raise DataError(f"unpacks to {size} bytes", where=path, expected=f"at most {LIMIT}")


def _module(name: str, path: Path) -> Any:
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise ConfigError(
            f"reading it needs {package}", where=path, fix="Install it with: pip install 'imutool[tables]'"
        ) from error


LOADERS: dict[str, Callable[[Path, Columns], None]] = {
    "csv": _load_csv,
    "parquet": _load_parquet,
    "npz": _load_npz,
    "mat": _load_mat,
    "hdf5": _load_hdf5,
}
