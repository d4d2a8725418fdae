"""Messages of any encoding as nested fields: access by path, and the stamp among them."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice, pairwise
from typing import Any, Protocol, runtime_checkable

from imutool.mcap_io.codec.schemas import NS_PER_S

STAMP = r"timestamp|stamp|time|sensor_?time"
CLOCK = r"((hw|hardware|device|sensor|sample|imu|host|header|capture|ts)_?)?(time|timestamp|stamp|t|ts)"
COUNTED = {rf"{CLOCK}_?ns(ec)?": 1, rf"{CLOCK}_?us(ec)?|utime": 1000}  # stamps of one number
SECONDS, NANOSECONDS = ("sec", "seconds", "secs"), ("nsec", "nanos", "nanosec", "nsecs", "nanoseconds")
DEPTH = 4  # messages within messages that are searched
MAX_ROW = 64  # numbers of a list that are fields of their own
DEEPEST, MAX_FIELDS = 24, 5000  # of a message's numbers: messages within messages, and fields; one can nest without end
MAX_BYTES = 1 << 23  # of a message or schema that becomes objects: JSON of 180 MB, 6 kB when packed, took 4.6 GB and a minute
NUMBER, VECTOR, MATRIX, TEXT = "number", "vector", "matrix", "text"
Path = tuple[str | int, ...]  # of a field; a number of a list has its place at the end
Tree = Mapping[str, Any]  # of fields: NUMBER, VECTOR, MATRIX, TEXT or a tree
LACKS = (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError)  # raised where a message lacks a field


@runtime_checkable
class Format(Protocol):
    """Encoding of messages, with access to their fields by path."""

    def parse(self, raw: bytes) -> Any:
        """Message from its bytes; ValueError where they are none."""

    def at(self, message: Any, path: Path) -> Any:
        """Value of a field; KeyError, IndexError or ValueError where the message lacks it."""

    def new(self, values: Sequence[tuple[Path, Any]]) -> bytes:
        """Bytes of a message with these fields; of numbers in a list the path ends with their place."""


@runtime_checkable
class NumberFormat(Format, Protocol):
    """Encoding of messages whose numbers can be listed."""

    def numbers(self, message: Any) -> Iterator[Path]:
        """Paths of numbers, no truth values and enumerations; of a list `MAX_ROW` and one more."""


def fields_of(tree: Tree, above: Path = ()) -> Iterator[tuple[Path, str, Any]]:
    """Path, name in lower case with underscores, and node of every field."""
    for name, node in tree.items():
        yield (*above, name), re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower(), node
        if isinstance(node, Mapping):
            yield from fields_of(node, (*above, name))


def stamps_of(fields: Iterable[tuple[Path, str, Any]]) -> Iterator[tuple[tuple[Path, int], ...]]:
    """Fields that make up each stamp of a known unit; the first counts."""
    for path, name, node in fields:
        if isinstance(node, Mapping) and re.fullmatch(STAMP, name):
            parts = [next((key for key in keys if node.get(key) == NUMBER), None) for keys in (SECONDS, NANOSECONDS)]
            if parts[0] is not None and parts[1] is not None:
                yield ((*path, parts[0]), NS_PER_S), ((*path, parts[1]), 1)
        for pattern, size in COUNTED.items():
            if node == NUMBER and re.fullmatch(pattern, name):
                yield ((path, size),)


def refuse_long(raw: bytes) -> None:
    """Refuse bytes whose objects would fill the memory.

    Raises:
        ValueError: more than `MAX_BYTES`.
    """
    if len(raw) > MAX_BYTES:
        raise ValueError(f"more than {MAX_BYTES} bytes")


def _tree(value: Any, depth: int) -> Any:
    """Tree of the fields of a JSON value."""
    if isinstance(value, bool) or value is None:
        return ""
    if isinstance(value, int | float):
        return NUMBER
    if isinstance(value, str):
        return TEXT
    if isinstance(value, list):
        numbers = all(isinstance(part, int | float) and not isinstance(part, bool) for part in value)
        return {3: VECTOR, 9: MATRIX}.get(len(value), "") if numbers else ""
    return {name: _tree(part, depth - 1) for name, part in value.items()} if depth else ""


class Json:
    """Messages in JSON, perhaps with a JSON Schema."""

    def __init__(self, schema: bytes = b"") -> None:
        try:
            self._schema = self.parse(schema or b"{}")
        except ValueError:
            self._schema = {}

    def comments(self, path: Path) -> Iterator[str]:
        """What the schema says of a field and of those around it, the nearest first."""
        node, found = self._schema, list[str]()
        for key in path:
            inner = node.get("properties") if isinstance(node, dict) else None
            node = inner.get(key) if isinstance(inner, dict) else None
            texts = [node.get(name, "") for name in ("unit", "units", "description", "title")] if isinstance(node, dict) else []
            found.append(next((text for text in texts if isinstance(text, str) and text), ""))
        yield from reversed(found)

    def parse(self, raw: bytes) -> Any:
        """Value from its text.

        Raises:
            ValueError: it is no JSON, too long, or nests too deep.
        """
        refuse_long(raw)
        try:
            return json.loads(raw)
        except RecursionError as error:
            raise ValueError("nests too deep") from error

    def at(self, message: Any, path: Path) -> Any:
        """Value of a field.

        Raises:
            KeyError, IndexError, TypeError: the message lacks it.
            ValueError: it is a truth value.
        """
        for key in path:
            message = message[key]
        if isinstance(message, bool):
            raise ValueError("a truth value is no number")
        return message

    def new(self, values: Sequence[tuple[Path, Any]]) -> bytes:
        """Text of a message with these fields."""
        return json.dumps(nested(values)).encode()

    def tree(self, message: Any) -> Any:
        """Tree of the fields of one message."""
        return _tree(message, DEPTH)

    def numbers(self, message: Any) -> Iterator[Path]:
        """Paths of all numbers in a message."""
        yield from islice(_numbers(message, ()), MAX_FIELDS)


def _numbers(value: Any, path: Path) -> Iterator[Path]:
    if isinstance(value, dict | list) and len(path) < DEEPEST:
        for key, part in value.items() if isinstance(value, dict) else enumerate(value[: MAX_ROW + 1]):
            yield from _numbers(part, (*path, key))
    elif isinstance(value, int | float) and not isinstance(value, bool) and path:
        yield path


def nested(values: Sequence[tuple[Sequence[str | int], Any]]) -> dict[str, Any]:
    """Fields by their paths as nested objects and lists."""
    tree: dict[str, Any] = {}
    for path, value in values:
        inner: Any = tree
        for key, following in pairwise(path):
            inner = inner.setdefault(key, [] if isinstance(following, int) else {})
        if isinstance(path[-1], int):
            inner.append(value)
        else:
            inner[path[-1]] = value
    return tree
