"""JSON documents: arrays of samples, of batches of samples, or of numbers.

`[{"t": 1, "acc": {"x": 0.1, ...}}, ...]`; `{"t": [1, 2], "ax": [0.1, 0.2]}`; `{"IMU6": [{"Timestamp": 1, "ArrayAcc": [...]}]}`.
Each array of objects becomes a table; an object with an array of samples in it becomes as many rows.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from itertools import takewhile
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from imutool.errors import DataError

from ..columns.headerless import name_headerless
from ..text.dates import calendar_times
from ..text.delimited import Columns, add_fields, read_csv
from ..text.numbers import numbers
from ..text.packed import read_bytes
from .sensors import name_columns, read_rows, sensors_among

START = re.compile(r'\s*(\{\s*"|\[\s*(\{\s*"|\[|-?\d+(\.\d+)?([eE][-+]?\d+)?\s*,))')
NEXT = re.compile(rb"\}\s*\{")  # an object behind another, without a comma
NOT_FINITE = re.compile(rb"[\[:,]\s*-?(NaN|Infinity)\b")
NO_JSON = msgspec.DecodeError, ValueError, RecursionError
MIN_ROWS = 5  # objects of an array that is a table
MAX_NUMBERS = 9  # or words, in an array that belongs to one sample, as a matrix does
MAX_DAMAGED = 0.1  # share of the lines that a logger cut off or garbled
MIN_SHARE = 0.05  # of the rows that have the same fields, if they are of a kind of their own
FAR = 2**1000  # beyond which an integer is no float64
SIGNAL = {"unit", "values"}  # of a signal, as A2D2 has the bus of a car
Row = dict[str, Any]


def is_json(start: str) -> bool:
    """Whether a text begins as a JSON document does."""
    return START.match(start) is not None


def load_json(path: Path, columns: Columns) -> None:
    """Add the columns of a JSON document, or of one JSON value a line.

    Raises:
        DataError: no JSON.
    """
    tables: dict[str, list[Row]] = {}
    for name, node in _nodes(_without_signals(_decoded(path, columns), columns), ""):
        if isinstance(node, list) and isinstance(node[0], dict):
            for kind, rows in _kinds(node).items():
                tables["/".join(filter(None, (name, kind)))] = rows
        elif isinstance(node, list) and isinstance(node[0], str) and (calendar_times(node) or numbers(node)):
            add_fields(columns, name, node, "")
        elif isinstance(node, list):
            columns.add(name, node if isinstance(node[0], str) else _numbers(node))
        else:
            columns.numbers[name] = float(_numbers([node])[0])
    name_headerless(columns)
    sensors = sensors_among(tables) if len(tables) > 1 else {}
    for name, rows in tables.items():
        part, text = Columns(), _text(rows)
        if not read_rows(text, part, path):
            read_csv(text, part, path, minimum=1)
        if len(tables) == 1:
            beside = name.removesuffix(name.rpartition(".")[2])  # as a rate next to the samples: `imu.frequency`, `imu.data`
            columns.numbers = {number.removeprefix(beside): value for number, value in columns.numbers.items()}
            columns.values, columns.units = part.values | columns.values, part.units | columns.units
            columns.texts, columns.labels = part.texts, part.labels | columns.labels
            columns.remarks.notes.extend(part.remarks.notes)
            columns.remarks.losses.extend(part.remarks.losses)
        else:
            group = sensors.get(name, name)
            name_columns(part, sensors.get(name, ""))
            columns.take(group, part, name)


def _without_signals(document: Any, columns: Columns) -> Any:
    """The document without signals that have times of their own; their columns are taken in.

    Such is `{"ax": {"unit": "g", "values": [[0, 0.1], ...]}}`. Signals of the same times are a group.
    """
    named = document.items() if isinstance(document, dict) else ()
    found = {name: node for name, node in named if _is_signal(node)}
    groups: dict[bytes, Columns] = {}
    for name, node in found.items():
        times, values = (_numbers([row[place] for row in node["values"]]) for place in (0, 1))
        group = groups.setdefault(times.tobytes(), Columns())
        group.add("time", times)
        group.add(name, values, node["unit"] or "")
    for group in groups.values():
        names = [*group.values][1:]
        words = zip(*(name.split("_") for name in names), strict=False)
        shared = "_".join(each[0] for each in takewhile(lambda each: len({*each}) == 1, words)) or "signals"
        columns.take(shared if shared not in columns.sources else f"{shared}{len(columns.sources)}", group, ", ".join(names))
    return {name: node for name, node in document.items() if name not in found} if found else document


def _is_signal(node: Any) -> bool:
    """Whether a node has a unit, and a time and a value in each row."""
    if not isinstance(node, dict) or node.keys() != SIGNAL or not isinstance(node["unit"], str | None):
        return False
    return _is_matrix(node["values"]) and len(node["values"][0]) == 2


def _decoded(path: Path, columns: Columns) -> Any:
    raw = read_bytes(path)
    try:
        return _value(raw)
    except NO_JSON as error:
        lines = [line.strip().rstrip(b",") for line in raw.splitlines() if line.strip()]
        values = []
        for line in lines:
            with suppress(*NO_JSON):
                values.append(_value(line))
        damaged = len(lines) - len(values)
        with suppress(*NO_JSON):
            if damaged:
                return _value(b"[" + NEXT.sub(b"},{", raw) + b"]")
        if len(values) < MIN_ROWS or damaged > MAX_DAMAGED * len(lines):
            what = f"begins as JSON and cannot be read ({error})"
            raise DataError(what, where=path, expected="one JSON document, or one JSON value a line") from error
        if damaged:
            columns.remarks.losses.append(f"{damaged} of {len(lines)} lines are no JSON and are left out")
        return values


def _value(raw: bytes) -> Any:
    """JSON value of a text, in which Python may have written NaN and Infinity.

    Raises:
        One of NO_JSON: it is none.
    """
    try:
        return msgspec.json.decode(raw)
    except msgspec.DecodeError:
        if not NOT_FINITE.search(raw):
            raise
        return json.loads(raw)


def _nodes(node: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Arrays and single numbers of a document, with dotted names; rows by their numbers, as of pandas, are an array."""
    if isinstance(node, dict) and len(node) >= MIN_ROWS and next(iter(node)) in ("0", "1"):
        first = int(next(iter(node)))
        node = [*node.values()] if [*node] == [str(n) for n in range(first, first + len(node))] else node
    if isinstance(node, dict):
        for key, child in node.items():
            inner = f"{name}.{key}" if name else str(key)
            if (names := _names_beside(node, child)) and _is_matrix(child):
                yield from ((f"{name}.{each}" if name else each, [row[n] for row in child]) for n, each in enumerate(names))
            else:
                yield from _nodes(child, inner)
    elif isinstance(node, bool) or node is None or isinstance(node, str):
        return
    elif isinstance(node, int | float):
        yield name or "value", node
    elif len(node) >= MIN_ROWS and all(isinstance(row, dict) for row in node):
        yield name, node
    elif _is_matrix(node):
        yield from ((f"{name}[{n}]" if name else f"column {n + 1}", [row[n] for row in node]) for n in range(len(node[0])))
    elif len(node) >= MIN_ROWS and (_are(node, int | float | None) or _are(node, str)):
        yield name or "values", node
    else:
        for number, child in enumerate(node):
            yield from _nodes(child, f"{name}.{number}" if name else str(number))


def _are(values: list[Any], kind: Any) -> bool:
    return all(isinstance(value, kind) for value in values)


def _numbers(values: list[Any]) -> np.ndarray:
    """Numbers as an array: nothing is NaN, and an integer that no array holds is infinite."""
    array = np.array([np.nan if value is None else value for value in values])
    return array if array.dtype != object else np.array([v if -FAR < v < FAR else np.inf for v in array], dtype=np.float64)


def _is_matrix(node: Any) -> bool:
    return (
        isinstance(node, list)
        and len(node) >= MIN_ROWS
        and all(isinstance(row, list) and len(row) == len(node[0]) > 1 for row in node)
        and all(isinstance(value, int | float | None) for row in node for value in row)
    )


def _names_beside(parent: Row, node: Any) -> list[str]:
    """Names of the columns of a matrix: a list next to it of as many words, or of as many objects with a name and units."""
    if not _is_matrix(node):
        return []
    for other in parent.values():
        if isinstance(other, list) and len(other) == len(node[0]):
            if all(isinstance(each, str) for each in other):
                return other
            if all(isinstance(each, dict) and isinstance(each.get("name"), str) for each in other):
                units = [each.get("units", each.get("unit", "")) for each in other]
                return [f"{each['name']} [{unit}]" if unit else each["name"] for each, unit in zip(other, units, strict=True)]
    return []


def _kinds(records: list[Row]) -> dict[str, list[Row]]:
    """Rows of the records, apart where many have fields that the others lack, under the name of such a field.

    A row without any of these fields is of the table `other`.
    """
    every = [row for record in records for row in _rows(record)]
    counts = Counter(frozenset(row) for row in every)
    large = [fields for fields, count in counts.items() if count > MIN_SHARE * len(every)]
    own = [fields.difference(*(other for other in large if other is not fields)) for fields in large]
    if len(large) < 2 or not all(own):
        return {"": every}
    tops = [re.split(r"[.\[]", min(fields))[0] for fields in own]
    names = tops if len({*tops}) == len(tops) else [min(fields) for fields in own]
    kinds: dict[str, list[Row]] = {}
    for row in every:
        fits = (name for name, fields in zip(names, own, strict=True) if fields & row.keys())
        kinds.setdefault(next(fits, "other"), []).append(row)
    return kinds


def _rows(record: Row) -> list[Row]:
    """A record as rows of flat names: one, or one for each sample of the arrays in it."""
    flat: Row = {}
    batches: dict[str, list[Any]] = {}
    _flatten(record, "", flat, batches)
    length = max(map(len, batches.values()), default=0)
    rows = []
    for number in range(length):
        row = dict(flat)
        for name, batch in batches.items():
            if number < len(batch):
                _flatten({name: batch[number]}, "", row, {})
        rows.append(row)
    return rows or [flat]


def _flatten(node: Row, name: str, flat: Row, batches: dict[str, list[Any]]) -> None:
    for key, value in node.items():
        inner = f"{name}.{key}" if name else key
        if isinstance(value, dict):
            _flatten(value, inner, flat, batches)
        elif not isinstance(value, list):
            flat[inner] = value
        elif len(value) <= MAX_NUMBERS and not any(isinstance(each, dict | list) for each in value):
            flat |= {f"{inner}[{n}]": each for n, each in enumerate(value)}
        else:
            batches[inner] = value


def _text(rows: list[Row]) -> str:
    """Rows as a table of text, with every field that one of them has."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    lines = ["\t".join(map(_field, names)), *("\t".join(_field(row.get(name)) for name in names) for row in rows)]
    return "\n".join(lines) + "\n"


def _field(value: Any) -> str:
    if value is None:
        return ""
    return re.sub(r"\s+", " ", value) if isinstance(value, str) else str(int(value) if isinstance(value, bool) else value)
