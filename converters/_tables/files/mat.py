"""MATLAB's .mat files: structures, labels of columns, bodies of Qualisys; no objects."""

from __future__ import annotations

import re
import struct
import warnings
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from imutool.errors import DataError, required

from ..text.delimited import Columns
from .mocap import read_mocap_mat

LABELS = re.compile("head|label|col|field|channel", re.IGNORECASE)  # in the name of texts that name columns
LIMIT = 4 << 30  # bytes of numbers in one file
MAT_HEADER, MAT_COMPRESSED, MAT_STEP = 128, 15, 1 << 20  # bytes before the first element, type of a packed one, bytes at once


def load_mat(path: Path, columns: Columns) -> None:
    """Add the columns of a .mat file.

    Raises:
        DataError: damaged, too large, or of nothing but objects.
    """
    scipy_io = required("scipy.io", "tables", where=path, user="reading it")
    try:
        size = sum(8 * int(np.prod(shape, dtype=float)) for _, shape, _ in scipy_io.whosmat(path))
        has_objects = False
    except TypeError:  # scipy reads no header of an object
        size, has_objects = _unpacked_bytes(path), True
    check_size(path, size)
    try:
        with warnings.catch_warnings(action="ignore"):  # objects share a name
            content = scipy_io.loadmat(path, simplify_cells=True)
    except Exception as error:  # scipy raises whatever damaged bytes lead to
        if not has_objects:
            raise DataError(f"cannot be read as a .mat file ({error})", where=path) from error
        content = {}
    if read_mocap_mat(content, columns, path):
        return
    columns.has_structures = True
    for name, value, labels in _flat(content):
        if labels:
            for label, column in zip(labels, value.T, strict=True):
                columns.add(f"{name}/{label}", column)
        else:
            columns.add(name, value)
    if has_objects:
        fix = "Save arrays from MATLAB (of an object struct(...), of a table table2array), or a table with writetable as CSV"
        if not columns.values:
            raise DataError("holds MATLAB objects, as tables and timetables are", where=path, expected="arrays", fix=fix)
        columns.remarks.losses.append(f"its MATLAB objects are left out. {fix}")


def names_of_mat(path: Path) -> list[str]:
    """Names of the arrays of a .mat file; a structure or a cell array stands for two groups.

    Raises:
        DataError: damaged.
    """
    scipy_io = required("scipy.io", "tables", where=path, user="reading it")
    try:
        found = scipy_io.whosmat(path)
    except TypeError:  # scipy reads no header of an object
        return ["1.array", "2.array"]
    except Exception as error:  # scipy raises whatever damaged bytes lead to
        raise DataError(f"cannot be read as a .mat file ({error})", where=path) from error
    nested = [f"{number}.{name}" for name, _, kind in found if kind in ("struct", "cell") for number in (1, 2)]
    return [name for name, _, _ in found] + nested


def check_size(path: Path, size: int) -> None:
    """Refuse a file that unpacks to more bytes than fit.

    Raises:
        DataError: with the size.
    """
    if size > LIMIT:
        raise DataError(f"unpacks to {size} bytes", where=path, expected=f"at most {LIMIT}")


def _unpacked_bytes(path: Path) -> int:
    """Bytes of the elements of a .mat file, unpacked; no further than the limit."""
    with path.open("rb") as file:
        order = "<" if file.read(MAT_HEADER).endswith(b"IM") else ">"
        total = 0
        while len(tag := file.read(8)) == 8 and total <= LIMIT:
            kind, size = struct.unpack(f"{order}II", tag)
            if kind != MAT_COMPRESSED:
                total += size
                file.seek(size, 1)
                continue
            unpacker, packed = zlib.decompressobj(), file.read(size)
            while packed and total <= LIMIT:
                total += len(unpacker.decompress(packed, MAT_STEP))
                packed = unpacker.unconsumed_tail
    return total


def _flat(content: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any, list[str]]]:
    """Arrays of nested structures, with dotted names, and the labels of their columns.

    `data(2).gyro` and `gyro{2}` are numbered in front of the array: `data.2.gyro`, `2.gyro`.
    """
    for name, value in content.items():
        if name.startswith("__"):
            continue
        cells = value if isinstance(value, list) else _cells(value)
        if len(cells) > 1 and all(isinstance(cell, dict) and all(map(np.isscalar, cell.values())) for cell in cells):
            samples = {key: np.array([cell[key] for cell in cells]) for key in cells[0]}  # `IMU(k).Time` of each sample
            yield from _flat(samples, f"{prefix}{name}.")
            continue
        for number, cell in enumerate(cells, 1):
            if isinstance(cell, dict):
                yield from _flat(cell, f"{prefix}{name}.{number}.")
            elif isinstance(cell, np.ndarray):
                yield from _flat({name: cell}, f"{prefix}{number}.")
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        elif isinstance(value, np.ndarray | int | float) and not cells:
            yield f"{prefix}{name}", value, _labels(name, value, content)


def _cells(value: Any) -> list[Any]:
    """Arrays of a cell array; none of other values, or of texts."""
    cells = value.ravel().tolist() if isinstance(value, np.ndarray) and value.dtype.kind == "O" else []
    return cells if any(isinstance(cell, np.ndarray | dict) for cell in cells) else []


def _labels(name: str, value: Any, beside: dict[str, Any]) -> list[str]:
    """Texts that name the columns of a matrix.

    `NAME_label`, as Mission Planner writes it, or texts next to it that are as many, as MATLAB's `importdata` gives.
    """
    if np.ndim(value) != 2:
        return []
    own = f"{name}_label"
    named = [beside[own]] if own in beside else [texts for key, texts in beside.items() if LABELS.search(key)]
    return next((texts for texts in map(_texts, named) if len(texts) == value.shape[1] == len(set(texts))), [])


def _texts(value: Any) -> list[str]:
    texts = np.ravel(value).tolist() if isinstance(value, np.ndarray) and value.dtype.kind in "UO" else []
    return [text.strip() for text in texts] if all(isinstance(text, str) and text.strip() for text in texts) else []
