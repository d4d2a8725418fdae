"""Table files: text, JSON, Parquet, .npy, .npz, .mat, HDF5, .xlsx, by their first bytes."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from imutool.errors import DataError, required

from ..._archive import refusing
from ..._source import head
from ..columns.headerless import name_headerless
from ..columns.motion import add_gravity
from ..columns.times import fill_own_times, join_gps_weeks, read_clocks_and_days
from ..text.blocks import first_block, text_of
from ..text.delimited import FIRSTS, Columns, add_fields, is_text_table, read_csv, read_plain
from ..text.labelled import as_table
from ..text.names import group_of, is_named_time, leaf_of, tells_apart
from ..text.numbers import is_number
from ..text.packed import goes_back, read_bytes, text_head
from .echo import has_signals, long_table, of_echo, of_long
from .hdf5 import load_hdf5, names_of_hdf5
from .json_documents import is_json, load_json
from .layouts import state_units
from .mat import check_size, load_mat, names_of_mat
from .merged import join_calendar, join_milliseconds, join_stamps, settle_zones, sort_by_clock
from .mocap import is_mocap, read_mocap
from .npz import load_npy, load_npz
from .programs import GYROFLOW, of_labview, of_vectornav, scale_gyroflow, scale_stated, state_mip
from .sensors import names_sensors, read_rows
from .sheets import load_sheets

NO_NUMBERS = "holds no columns of numbers"
MAGIC = {  # the first bytes of a kind of file; behind 512 bytes of a user's own in HDF5
    "hdf5": b"\x89HDF\r\n\x1a\n",
    "parquet": b"PAR1",
    "feather": b"ARROW1\0\0",  # also Arrow's own
    "npy": b"\x93NUMPY",
    "sheets": b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1",  # of old Excel
}
MAT = (b"\x00\x01IM", b"\x01\x00MI")  # version 5 and the order of bytes, behind a text that is the writing program's own
MAT_AT = slice(124, 128)
ZIP = b"PK\x03\x04"
NUMBERS = r"u?int|float|double|halffloat|bool|timestamp|duration|time\d\d|dict"  # names of types of Arrow
VECTORS = r"(large_|fixed_size_)?list<\w+: (u?int|float|double|halffloat)"
SHEETS = {"xl/workbook.xml": "sheets", "xl/workbook.bin": "other sheets", "content.xml": "other sheets"}  # members of a zip


def kind_of(head: bytes, path: Path) -> str:
    """Kind of a table file by its first bytes; empty for any other file."""
    for kind, magic in MAGIC.items():
        if head.startswith(magic) or (kind == "hdf5" and head[512:].startswith(magic)):
            return kind
    if head[MAT_AT] in MAT:
        return "mat"
    if head.startswith(ZIP):
        names = _members(path) or ({*SHEETS} if path.suffix.lower() == ".xlsx" else set())  # cut off
        if sheets := next((kind for name, kind in SHEETS.items() if name in names), ""):
            return sheets
        if any(name.endswith(".npy") for name in names):
            return "npz"
    text = text_head(path)
    words = "" if b"\0" in text else text_of(text)
    if is_json(words):
        return "json"
    is_table = is_text_table(text) or (
        words and (as_table(words)[0] or is_mocap(words) or of_echo(words)[0] or of_long(words)[0])
    )
    return "csv" if is_table else ""


def load(path: Path, kind: str) -> Columns:
    """Columns of a table file.

    Raises:
        ConfigError: a library is missing; the extra is named.
        DataError: damaged, too large, or without numbers.
    """
    columns = Columns()
    with refusing(path):
        LOADERS[kind](path, columns)
    state_mip(columns)
    scale_stated(columns)
    join_stamps(columns)
    join_calendar(columns)
    join_milliseconds(columns)
    join_gps_weeks(columns)
    read_clocks_and_days(columns)
    settle_zones(columns)
    sort_by_clock(columns)
    fill_own_times(columns)
    state_units(columns)
    add_gravity(columns)
    if not columns.values:
        why = "".join(f"; {loss}" for loss in columns.remarks.losses[:1])
        raise DataError(f"{NO_NUMBERS}{why}", where=path, expected="a time, three rates and three accelerations")
    return columns


def may_hold_several(path: Path) -> bool:
    """Whether a file may hold several recordings or sensors, by names or a time that goes back.

    JSON and spreadsheets may: theirs are not known before all is read.
    """
    kind = kind_of(head(path), path)
    names = _names_of(path, kind)
    in_groups = kind in OF_GROUPS and len({*map(group_of, names)} | {""}) > 2
    if kind in ("json", "sheets") or in_groups or any(tells_apart(leaf_of(name)) for name in names):
        return True
    return goes_back(path) if kind == "csv" else kind == "parquet" and _times_fall(path, names)


def _times_fall(path: Path, names: list[str]) -> bool:
    """Whether a time of a Parquet file goes back."""
    times = [*filter(is_named_time, names)]
    fallen, others, last = set[str](), set[str](), dict[str, Any]()
    with refusing(path):
        file = _module("pyarrow.parquet", path).ParquetFile(path)
        for batch in file.iter_batches(columns=times) if times else ():  # a file of a few bytes may unpack to gigabytes
            for name, column in zip(batch.schema.names, batch.columns, strict=True):
                if not re.match(NUMBERS, str(column.type)) or column.null_count:
                    others.add(name)
                    continue
                kind = "int64" if re.match(r"time\d\d", str(column.type)) else column.type
                values = column.cast(kind).to_numpy(zero_copy_only=False)
                values = values.astype(np.int64 if values.dtype.kind == "M" else float)
                if (np.diff(values, prepend=last.get(name, values[:1])) < 0).any():
                    fallen.add(name)
                last[name] = values[-1:]
    return bool(fallen - others)


def _names_of(path: Path, kind: str) -> list[str]:
    """Names of the columns or arrays of a table; of text fields of further rows may be among them."""
    if kind == "csv":
        lines = text_of(text_head(path)).splitlines()[:FIRSTS]
        return [field.strip(' "#') for line in lines for field in re.split(r"[;,\t]", line) if not is_number(field)]
    with refusing(path), path.open("rb") as source:
        if kind == "parquet":
            return list(_module("pyarrow.parquet", path).ParquetFile(source).schema_arrow.names)
        if kind == "feather":
            return list(_module("pyarrow.ipc", path).open_file(source).schema.names)
        return OF_GROUPS[kind](path) if kind in OF_GROUPS else []


def _members(path: Path) -> set[str]:
    try:
        with zipfile.ZipFile(path) as archive:
            return set(archive.namelist())
    except (OSError, zipfile.BadZipFile):
        return set()


def _load_text(path: Path, columns: Columns) -> None:
    start = first_block(path)
    if start and not _is_of_program(start) and read_plain(path, start, columns):
        _finish(start, columns)
    else:
        read_text(text_of(read_bytes(path)), columns, path)


def _is_of_program(start: str) -> bool:
    """Whether the first lines of a text show the own format of a program, as of a motion capture or `ros2 topic echo`."""
    of_program = is_mocap(start) or of_labview(start) or of_vectornav(start, Columns()) or has_signals(start)
    return bool(of_program or of_echo(start)[0] or as_table(start)[0] or names_sensors(start))


def read_text(text: str, columns: Columns, path: Path) -> None:
    """Add the columns of a table of text, whatever program wrote it."""
    if read_mocap(text, columns, path):
        return
    (echoed, cut), (long, few) = of_echo(text), long_table(text, path)
    if table := echoed or long or of_labview(text) or of_vectornav(text, columns):
        read_csv(table, columns, path)
        columns.remarks.notes.extend(["a long table: its signals became columns"] if long else [])
        columns.remarks.losses.extend([f"{cut} messages without all fields of the first are left out"] if cut else [])
        columns.remarks.losses.extend([f"{few} times without a value of every signal are left out"] if few else [])
        return
    labelled, damaged, others = as_table(text)
    if labelled:
        read_csv(labelled, columns, path)
        columns.remarks.notes.append("its rows name their numbers")
        if others:
            columns.remarks.notes.append(f"{others} lines of other words are left out")
        if damaged:
            columns.remarks.losses.append(f"{damaged} lines with a part of these names are left out")
    elif not read_rows(text, columns, path):
        read_csv(text, columns, path)
        _finish(text, columns)


def _finish(text: str, columns: Columns) -> None:
    """Name and scale the columns of a plain table that begins with the text."""
    name_headerless(columns)
    if text.startswith(GYROFLOW):
        scale_gyroflow(columns)


def _load_parquet(path: Path, columns: Columns) -> None:
    file = _module("pyarrow.parquet", path).ParquetFile(path)
    names = _numbers_of(file.schema_arrow, columns)
    groups = [file.metadata.row_group(number) for number in range(file.metadata.num_row_groups)]
    each = (group.column(number) for group in groups for number in range(group.num_columns))
    check_size(path, 8 * sum(column.num_values for column in each if column.path_in_schema.partition(".")[0] in names))
    _add_arrow(file.read(columns=names), columns)  # a text of a few bytes may unpack to gigabytes


def _load_feather(path: Path, columns: Columns) -> None:
    with path.open("rb") as source:
        file, batches, size = _module("pyarrow.ipc", path).open_file(source), [], 0
        names = _numbers_of(file.schema, columns)
        for number in range(file.num_record_batches):
            batches.append(file.get_batch(number).select(names))
            size += batches[-1].nbytes
            check_size(path, size)
    if batches:
        _add_arrow(_module("pyarrow", path).Table.from_batches(batches), columns)


def _numbers_of(schema: Any, columns: Columns) -> list[str]:
    """Names of the fields that hold numbers or times, also in lists and structures; the others are losses."""
    numbers = [f.name for f in schema if re.match(rf"{NUMBERS}|{VECTORS}|struct", str(f.type))]
    texts = [f.name for f in schema if re.match(r"large_string|string", str(f.type))]
    words = [name for name in texts if tells_apart(name) or is_named_time(name)]
    others = [field for field in schema if field.name not in (*numbers, *words)]
    columns.remarks.losses.extend(f"{field.name} is left out: it is of type {field.type}, no number" for field in others)
    return numbers + words


def _add_arrow(table: Any, columns: Columns) -> None:
    while any(str(field.type).startswith("struct") for field in table.schema):
        table = table.flatten()  # `header.stamp.sec`
    for name in table.column_names:
        column = table.column(name)
        if "." in name and not re.match(rf"{NUMBERS}|{VECTORS}", str(column.type)):
            columns.remarks.losses.append(f"{name} is left out: it is of type {column.type}, no number")
            continue
        if re.match(VECTORS, str(column.type)):
            import pyarrow.compute

            lists = column.combine_chunks()
            lengths = np.unique(pyarrow.compute.list_value_length(lists).fill_null(0).to_numpy(zero_copy_only=False))
            if len(lengths) == 1 and lengths[0] > 0:
                columns.add(name, lists.flatten().to_numpy(zero_copy_only=False).reshape(-1, int(lengths[0])))
            else:
                columns.remarks.losses.append(f"{name} is left out: its lists differ in length, or are empty")
            continue
        if times := re.match(r"timestamp|duration|time\d\d", str(column.type)):
            kind = times[0].replace("time32", "time64")
            columns.add(f"{name} [ns]", column.cast(f"{kind}[ns]").cast("int64").to_numpy())
            columns.local_times.extend([] if getattr(column.type, "tz", None) else [f"{name} [ns]"])
        elif "string" in str(column.type):
            add_fields(columns, name, [str(text or "") for text in column.to_pylist()], "")
        else:
            columns.add(name, column.to_numpy())


def _refuse_sheets(path: Path, columns: Columns) -> None:
    fix = "Save it as .xlsx or CSV (UTF-8), and convert that"
    raise DataError("is a spreadsheet of another format", where=path, expected=".xlsx or .xls", fix=fix)


def _module(name: str, path: Path) -> Any:
    return required(name, "tables", where=path, user="reading it")


OF_GROUPS: dict[str, Callable[[Path], list[str]]] = {  # names of the arrays, with their groups
    "npz": lambda path: [name.removesuffix(".npy") for name in _members(path)],
    "mat": names_of_mat,
    "hdf5": names_of_hdf5,
}
LOADERS: dict[str, Callable[[Path, Columns], None]] = {
    "csv": _load_text,
    "json": load_json,
    "parquet": _load_parquet,
    "feather": _load_feather,
    "npz": load_npz,
    "npy": load_npy,
    "mat": load_mat,
    "hdf5": load_hdf5,
    "sheets": lambda path, columns: load_sheets(path, columns, read_text),
    "other sheets": _refuse_sheets,
}
