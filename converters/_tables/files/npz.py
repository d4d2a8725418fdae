"""Arrays of NumPy: .npz and .npy."""

from __future__ import annotations

import json
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from imutool.errors import DataError

from ..._source import head
from ..columns.headerless import name_headerless
from ..text.delimited import WIDEST, Columns
from .mat import check_size

OBJECTS = "allow_pickle"  # in what NumPy says of an array of objects


def load_npz(path: Path, columns: Columns) -> None:
    """Add the arrays of a .npz."""
    with zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            with archive.open(info) as member:  # the size that the array states, whatever the archive says
                shape = npy_shape(member) if info.filename.endswith(".npy") else ()
            check_size(path, max(info.file_size, 8 * int(np.prod(shape, dtype=float))))
        check_size(path, sum(info.file_size for info in archive.infolist()))
    with np.load(path, allow_pickle=False) as arrays:
        objects = [name for name in arrays.files if not _added(columns, name, arrays)]
        if objects and len(objects) == len(arrays.files):
            raise _of_objects(path)


def load_npy(path: Path, columns: Columns) -> None:
    """Add one array, whose columns are named by its type or a file beside it, or not at all."""
    array = read_npy(path)
    if array.dtype.names:
        _add(columns, "", array)
        return
    if array.ndim == 2 and array.shape[0] < array.shape[1]:
        array = array.T
    each = [*np.atleast_2d(array.T)[:WIDEST]] if array.ndim in (1, 2) else []
    names = _names_beside(path)
    named = len({*names}) == len(each)
    for number, column in enumerate(each):
        columns.add(names[number] if named else f"column {number + 1}", column)
    if not named:
        name_headerless(columns)


def _names_beside(path: Path) -> list[str]:
    """Names of columns in the description beside an array, as TLIO has it: `["ts_us(1)", "qxyzw_World_Device(4)", ...]`."""
    try:
        listed = json.loads(head(path.with_name(f"{path.stem}_description.json")))["columns_name(width)"]
        parts = [(name, int(width.rstrip(")"))) for name, width in (each.split("(") for each in listed)]
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return []
    axes = {name: "xyzw" if name.startswith("qxyzw") else "xyz" for name, _ in parts}
    spelled = {name: re.sub("^qxyzw", "quat", name.removesuffix("_World_Device")) for name, _ in parts}
    return [f"{spelled[name]}_{axis}" if width > 1 else spelled[name] for name, width in parts for axis in axes[name][:width]]


def _add(columns: Columns, name: str, array: np.ndarray) -> None:
    """Add an array; of structures each field is one, in the group of the structure."""
    for field in array.dtype.names or ():
        _add(columns, f"{name}/{field}".removeprefix("/"), array[field])
    if not array.dtype.names:
        columns.add(name, array)


def _added(columns: Columns, name: str, arrays: Any) -> bool:
    """Whether an array was added: one of Python's objects is none of numbers."""
    try:
        _add(columns, name, arrays[name])
    except ValueError as error:
        if OBJECTS not in str(error):
            raise
        return False
    return True


def _of_objects(path: Path) -> DataError:
    what = "holds objects of Python, which can run any program when they are read"
    fix = (
        "Load it where you trust its source, save its arrays with numpy.savez(OUT, gyro=..., acc=..., t=...), and convert that"
    )
    return DataError(what, where=path, fix=fix)


def read_npy(path: Path) -> np.ndarray:
    """Array of a .npy.

    Raises:
        DataError: larger than a table may be, or of Python's objects.
        ValueError: damaged.
    """
    with path.open("rb") as file:
        check_size(path, 8 * int(np.prod(npy_shape(file), dtype=float)))
    try:
        array: np.ndarray = np.load(path, allow_pickle=False)
    except ValueError as error:
        if OBJECTS in str(error):
            raise _of_objects(path) from error
        raise
    return array


def npy_shape(member: Any) -> tuple[int, ...]:
    """Shape of the array that an open .npy states."""
    version = np.lib.format.read_magic(member)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape: tuple[int, ...] = read(member)[0]
    return shape
