"""Messages of objects, lists, numbers and texts, in JSON or MessagePack."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from itertools import islice
from typing import Any

import msgspec
import numpy as np

from imutool.mcap_io.codec.formats import (
    DEEPEST,
    DEPTH,
    MATRIX,
    MAX_FIELDS,
    MAX_ROW,
    NUMBER,
    TEXT,
    TIME,
    VECTOR,
    Path,
    nested,
    refuse_long,
)
from imutool.mcap_io.codec.schemas import NS_PER_S

DATE_TIME = re.compile(r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d)(?:[.,](\d{1,9})\d*)?(Z|[+-]\d\d:?\d\d)?")
FRACTION_OF_S = re.compile(r":\d\d[.,]\d")
DIGITS = re.compile(r"[+-]?\d{1,20}")
FRACTION = re.compile(r"[+-]?(\d{1,20}(\.\d*)?|\.\d+)(e[+-]?\d{1,2})?", re.IGNORECASE)
IDENTITY = re.compile(r".*(frame|name|id)", re.IGNORECASE)  # fields whose text is no number, whatever it consists of


def number_in(text: str) -> int | float:
    """Number in a text; of a date and time (ISO 8601) ns since 1970.

    Without a zone it is in UTC. Protobuf writes times, and numbers of 64 bits, as text in JSON.

    Raises:
        ValueError: a text of another kind, or no date of the calendar.
    """
    if DIGITS.fullmatch(text):
        return int(text)
    if FRACTION.fullmatch(text):
        return float(text)
    if (found := DATE_TIME.fullmatch(text)) is None:
        raise ValueError("no number and no time")
    whole = datetime.fromisoformat(found[1] + (found[3] or "Z"))
    return int(whole.timestamp()) * NS_PER_S + int((found[2] or "").ljust(9, "0"))


def _kind(name: str, text: str) -> str:
    """Kind of a field by its text."""
    if IDENTITY.fullmatch(name):
        return TEXT
    try:
        number_in(text)
    except ValueError:
        return TEXT
    return TIME if DATE_TIME.fullmatch(text) else NUMBER


class Json:
    """Messages in JSON, perhaps with a JSON Schema."""

    def __init__(self, schema: bytes = b"") -> None:
        self._texts: dict[Path, str] = {}  # kinds of the numbers and times that are text
        try:
            self._schema = _from_json(schema or b"{}")
        except ValueError:
            self._schema = {}

    def comments(self, path: Path) -> Iterator[str]:
        """What the schema says of a field and of those around it, the nearest first."""
        nodes, found = self._with_referred([self._schema]), list[str]()
        for key in path:
            inner = (node.get("properties") for node in nodes)
            nodes = self._with_referred(properties.get(key) for properties in inner if isinstance(properties, dict))
            texts = (node.get(name) for name in ("unit", "units", "description", "title") for node in nodes)
            found.append(next((text for text in texts if isinstance(text, str) and text), ""))
        yield from reversed(found)

    def _with_referred(self, nodes: Iterable[Any]) -> list[dict[str, Any]]:
        """Schemas of a field, and those that they refer to or are made of."""
        found, waiting = list[dict[str, Any]](), [*nodes]
        while waiting and len(found) < MAX_ROW:
            if not isinstance(node := waiting.pop(0), dict):
                continue
            found.append(node)
            if isinstance(reference := node.get("$ref"), str) and reference.startswith("#/"):
                waiting.append(_inside(self._schema, reference[2:].split("/")))
            waiting += [part for name in ("allOf", "anyOf", "oneOf") if isinstance(node.get(name), list) for part in node[name]]
        return found

    def parse(self, raw: bytes) -> Any:
        """Value from its text.

        Raises:
            ValueError: it is no JSON, too long, or nests too deep.
        """
        return _from_json(raw)

    def at(self, message: Any, path: Path) -> Any:
        """Value of a field; of a text that is a number or a time, that.

        Raises:
            KeyError, IndexError, TypeError: the message lacks it.
            ValueError: it is a truth value.
        """
        for key in path:
            message = message[key]
        if isinstance(message, bool):
            raise ValueError("a truth value is no number")
        is_number = isinstance(message, str) and path and _kind(str(path[-1]), message) != TEXT
        return number_in(message) if is_number else message

    def new(self, values: Sequence[tuple[Path, Any]]) -> bytes:
        """Message with these fields; numbers and times are text where they are in the message of the tree."""
        return self._packed(nested([(path, self._written(tuple(path), value)) for path, value in values]))

    def _packed(self, message: dict[str, Any]) -> bytes:
        return json.dumps(message).encode()

    def _written(self, path: Path, value: Any) -> Any:
        kind = self._texts.get(path)
        return value if kind is None else str(value) if kind == NUMBER else f"{np.datetime64(value, 'ns')}Z"

    def tree(self, message: Any) -> Any:
        """Tree of the fields of one message."""
        return self._tree(message, ())

    def _tree(self, value: Any, path: Path) -> Any:
        if isinstance(value, str):
            kind = _kind(str(path[-1]), value) if path else TEXT
            if kind == TIME and not FRACTION_OF_S.search(value):  # which many samples share
                return TEXT
            if kind != TEXT:
                self._texts[path] = kind
            return kind
        if _is_number(value):
            return NUMBER
        if isinstance(value, list):
            return {3: VECTOR, 9: MATRIX}.get(len(value), "") if all(map(_is_number, value)) else ""
        if not isinstance(value, dict) or len(path) == DEPTH:
            return ""
        return {name: self._tree(part, (*path, name)) for name, part in value.items() if isinstance(name, str)}

    def numbers(self, message: Any) -> Iterator[Path]:
        """Paths of all numbers in a message."""
        yield from islice(_numbers(message, ()), MAX_FIELDS)


class MessagePack(Json):
    """Messages in MessagePack, perhaps with a JSON Schema."""

    def parse(self, raw: bytes) -> Any:
        """Value from its bytes.

        Raises:
            ValueError: they are no MessagePack, too many, or nest too deep.
        """
        refuse_long(raw)
        try:
            return msgspec.msgpack.decode(raw)
        except (msgspec.DecodeError, RecursionError) as error:
            raise ValueError(str(error) or "nests too deep") from error

    def _packed(self, message: dict[str, Any]) -> bytes:
        return msgspec.msgpack.encode(message)


def _from_json(raw: bytes) -> Any:
    refuse_long(raw)
    try:
        return json.loads(raw)
    except RecursionError as error:
        raise ValueError("nests too deep") from error


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _numbers(value: Any, path: Path) -> Iterator[Path]:
    if isinstance(value, dict | list) and len(path) < DEEPEST:
        for key, part in value.items() if isinstance(value, dict) else enumerate(value[: MAX_ROW + 1]):
            yield from _numbers(part, (*path, key))
    elif _is_number(value) and path:
        yield path


def _inside(node: Any, keys: Iterable[str]) -> Any:
    """Part of a JSON value by the names of objects in objects; None where it lacks one."""
    for key in keys:
        node = node.get(key) if isinstance(node, dict) else None
    return node


OF_OBJECTS = {"json": Json, "msgpack": MessagePack}  # encodings whose first messages describe them
