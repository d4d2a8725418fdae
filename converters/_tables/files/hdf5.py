"""HDF5: arrays, records of named fields, and the cells of MATLAB's .mat files from 7.3 on."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from imutool.errors import DataError, required

from ..columns.units import TIME_NS
from ..text.delimited import Columns
from ..text.names import unit_named
from .mat import check_size

MAX_CELLS = 10_000  # of a cell array
FILLS = "_FillValue", "missing_value"  # attributes that say what stands for a missing value
SINCE = re.compile(  # of the CF conventions, in UTC
    r"(?P<unit>[a-z]+) since (?P<day>\d{4}-\d\d?-\d\d?)([T ]+(?P<clock>\d\d?:\d\d?:\d\d?)(\.0*)?)? *(Z|UTC|[+-]?0?0(:?00)?)?",
    re.IGNORECASE,
)
DEEPEST = 8  # groups below a cell: one may lead to itself


def load_hdf5(path: Path, columns: Columns) -> None:
    """Add the columns of an HDF5 file.

    Raises:
        DataError: too large, or it holds nothing but MATLAB objects or links to other files.
    """
    h5py = required("h5py", "tables", where=path, user="reading it")
    elsewhere: list[str] = []
    objects: list[str] = []

    def look(name: str, link: Any) -> None:  # external links are never followed
        if isinstance(link, h5py.ExternalLink):
            elsewhere.append(name)

    def visit(name: str, node: Any) -> None:
        if name.startswith("#"):
            return
        if "MATLAB_object_decode" in node.attrs:
            objects.append(f"{name} is a MATLAB object ({_plain(node.attrs.get('MATLAB_class', 'unknown'))}), not an array")
        else:
            _add_node(columns, name, node, path)

    with h5py.File(path, "r") as file:
        visit("", file)
        file.visititems(visit)
        file.visititems_links(look)
    of_links = f"{', '.join(elsewhere)}: links to other files, which are not followed"
    for found, what, fix in (
        (elsewhere, of_links, "Copy the arrays into this file"),
        (objects, "; ".join(objects), "Save it from MATLAB as arrays, or with writetable as CSV"),
    ):
        if found and not columns.values:
            raise DataError(what, where=path, fix=fix)
        columns.remarks.losses.extend([f"{what}. {fix}"] if found else [])


def names_of_hdf5(path: Path) -> list[str]:
    """Names of the arrays of an HDF5 file; one of records or of cells stands for a group."""
    h5py = required("h5py", "tables", where=path, user="reading it")
    names: list[str] = []

    def visit(name: str, node: Any) -> None:
        if isinstance(node, h5py.Dataset) and not name.startswith("#"):
            own = node.dtype.names or ("1/", "2/") * (node.dtype == h5py.ref_dtype)
            names.extend([f"{name}/{field}" for field in own] or [name])

    with h5py.File(path, "r") as file:
        file.visititems(visit)
    return names


def _add_node(columns: Columns, name: str, node: Any, path: Path) -> None:
    """Add the numbers among the attributes of a group or an array, and the array."""
    for key, value in node.attrs.items():
        if np.ndim(value) == 0 and np.asarray(value).dtype.kind in "iuf":
            columns.add(f"{name}/{key}", value)
    if not hasattr(node, "dtype") or node.dtype.kind not in "iufbOSV":
        return
    if node.external or node.is_virtual:
        raise DataError(f"{name} lies in another file", where=path, fix="Copy it into this file")
    check_size(path, node.size * max(8, node.dtype.itemsize))
    if node.dtype.names:
        records = node[()]
        for field in node.dtype.names:
            columns.add(f"{name}/{field}", _texts_of(records[field]))
    elif node.dtype.kind == "O" and node.dtype.metadata and "ref" in node.dtype.metadata:
        _add_cells(columns, name, node, path)
    elif node.dtype.kind in "OS":
        columns.add(name, _texts_of(node[()]))
    elif _is_text(node):
        columns.add(name, np.array([_word(row) for row in node[()].T]))
    else:
        unit = next((value for key, value in node.attrs.items() if key.lower() in ("unit", "units")), "")
        values = _measured(node)
        since_1970_ns = _since_1970(values, _plain(unit))
        columns.add(name, *((values, _plain(unit)) if since_1970_ns is None else (since_1970_ns, "ns")))


def _measured(node: Any) -> Any:
    """Values of an array as NetCDF packs them: NaN for its fill values, the others scaled, then shifted."""
    values, attributes = node[()], {key: np.asarray(value).ravel() for key, value in node.attrs.items()}
    stated = {key: value[0] for key, value in attributes.items() if value.size == 1 and value.dtype.kind in "iuf"}
    lacking = [stated[key] for key in FILLS if key in stated]
    if lacking and (rows := np.isin(values, lacking)).any():
        values = np.where(rows, np.nan, values)
    scale = stated.get("scale_factor", stated.get("scale", 1.0) if node.dtype.kind in "iu" else 1.0)  # of counts
    if scale != 1.0 or "add_offset" in stated:
        values = values * float(scale) + float(stated.get("add_offset", 0.0))
    return values


def _since_1970(values: np.ndarray, unit: str) -> np.ndarray | None:
    """Nanoseconds since 1970 of times whose unit is that of NetCDF, `seconds since 2026-11-21 15:04:05`; None for others."""
    match = SINCE.fullmatch(unit.strip())
    size = TIME_NS.get(unit_named(match["unit"]), 0.0) if match else 0.0
    if match is None or not size or values.dtype.kind not in "iuf" or not np.isfinite(values).all():
        return None
    day, clock = ([int(part) for part in re.findall(r"\d+", match[each] or "0:0:0")] for each in ("day", "clock"))
    try:
        start = np.datetime64("{:04d}-{:02d}-{:02d}T{:02d}:{:02d}:{:02d}".format(*day, *clock), "ns")
    except (ValueError, OverflowError):
        return None
    steps = values * int(size) if values.dtype.kind in "iu" else np.rint(values * size)
    return np.asarray(steps.astype(np.int64) + start.astype(np.int64))


def _add_cells(columns: Columns, name: str, node: Any, path: Path) -> None:
    """Add the arrays and groups that a cell array, or a field of a structure's elements, leads to."""
    if node.size > MAX_CELLS:
        columns.remarks.losses.append(f"{name} is left out: it has {node.size} cells")
        return
    cells = [node.file[reference] for reference in node[()].ravel() if reference]
    if cells and all(map(_is_text, cells)):
        columns.add(name, np.array([_word(cell[()].T.ravel()) for cell in cells]))
        return
    group, _, leaf = name.rpartition("/")
    for number, cell in enumerate(cells, 1):
        own = f"{group}/{number}/{leaf}".lstrip("/")
        for below, part in _nodes(cell):
            _add_node(columns, f"{own}/{below}" if below else own, part, path)


def _nodes(node: Any, depth: int = 0) -> Iterator[tuple[str, Any]]:
    """An array, or the arrays of a group, with their names below it; links are not followed."""
    if hasattr(node, "dtype"):
        yield "", node
        return
    own = [name for name in node if type(node.get(name, getlink=True)).__name__ == "HardLink"]
    for name in own if depth < DEEPEST else ():
        for below, part in _nodes(node[name], depth + 1):
            yield f"{name}/{below}".rstrip("/"), part


def _is_text(node: Any) -> bool:
    return _plain(node.attrs.get("MATLAB_class", "")) == "char"


def _word(codes: np.ndarray) -> str:
    return "".join(map(chr, np.ravel(codes).tolist())).strip()


def _texts_of(values: np.ndarray) -> np.ndarray:
    """Bytes as texts; other values as they are."""
    if values.dtype.kind in "OS" and all(isinstance(each, bytes) for each in values.ravel()):
        return np.array([each.decode(errors="replace") for each in values.ravel()])
    return values


def _plain(attribute: Any) -> str:
    """Text of an attribute, which MATLAB writes as bytes and some programs as an array of one."""
    attribute = attribute.item() if isinstance(attribute, np.ndarray) and attribute.size == 1 else attribute
    return attribute.decode(errors="replace") if isinstance(attribute, bytes) else str(attribute)
