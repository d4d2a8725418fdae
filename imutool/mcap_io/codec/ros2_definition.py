"""Find every number in a ROS message from its definition, in one walk over its bytes.

Grammar and alignment are those of ROS 2 (docs.ros.org, "About internal ROS 2 interfaces"; CDR: each primitive is aligned to
its own size, in its version 2 to four bytes at most, from behind the encapsulation). ROS 1 has neither of the two.
A log's definitions are taken for hostile: how deep they nest is bounded, and every count is checked against the bytes left.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

from imutool.errors import LogError
from imutool.mcap_io.codec.formats import DEEPEST, MAX_FIELDS
from imutool.mcap_io.codec.schemas import IMU, PLAIN, ByteWalk, definition

NUMBERS = {
    **dict.fromkeys(("bool", "byte", "char", "uint8"), "u1"),
    **{f"{kind}{bits}": f"{kind[0]}{bits // 8}" for kind in ("int", "uint") for bits in (8, 16, 32, 64)},
    "float32": "f4",
    "float64": "f8",
}
FORMATS = {"u1": "B", "i1": "b", "u2": "H", "i2": "h", "u4": "I", "i4": "i", "u8": "Q", "i8": "q", "f4": "f", "f8": "d"}
TEXT = "string"
TIMES = {  # the types of the seconds; ROS 1 has no package for them
    "builtin_interfaces/Time": "int32",
    "builtin_interfaces/Duration": "int32",
    "time": "uint32",
    "duration": "int32",
}
PADDING = 4  # bytes to which some writers fill up a payload
MAX_TEXT = 1 << 20  # bytes of a definition
VECTORS = 3, 4  # numbers of a vector and of a quaternion, which are fields of their own
MAX_COUNTED = 4096  # counts and texts before a number in one message

_FIELD = re.compile(
    r"(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?P<array>\[(?P<bound><=)?(?P<count>\d*)\])?\s+(?P<name>[A-Za-z]\w*)(?P<rest>|\s.*|=.*)"
)
SEPARATOR = re.compile(r"^=+\s*$", re.MULTILINE)

Message = tuple[bytes, Mapping[str, tuple[int, str]]]  # bytes; first byte and format of each number by its path


class Field(NamedTuple):
    """One line of a definition; `length` is None for one value, 0 for a sequence.

    `comment` stands behind it, or else above it and the fields before it, without a blank line between them.
    """

    name: str
    kind: str
    length: int | None
    comment: str = ""


class Leaf(NamedTuple):
    """A number, or a row of `length` of them; `kind` is numpy's without byte order."""

    path: str
    offset: int
    kind: str
    length: int | None


Definition = Mapping[str, tuple[Field, ...]]


def parse(schema_name: str, text: bytes) -> Definition:
    """Fields of a message and of all nested messages, by `package/Name`.

    Raises:
        LogError: a line that is none of a definition, a message that is not defined, or one that contains itself.
    """
    if len(text) > MAX_TEXT:
        raise LogError(f"the definition of {schema_name} has {len(text)} bytes", expected=f"at most {MAX_TEXT}")
    root = _short(schema_name)
    known: dict[str, tuple[Field, ...]] = {
        name: (Field("sec", kind, None), Field("nanosec", "uint32", None)) for name, kind in TIMES.items()
    }
    for position, part in enumerate(SEPARATOR.split(text.decode(errors="replace"))):
        name, body = root, part
        if position:
            first, _, body = part.strip().partition("\n")
            name = _short(first.removeprefix("MSG:").strip())
        known[name] = tuple(_fields(name, body))
    _check(root, known, {}, 0)
    return {**known, "": (Field("", root, None),)}  # last: a separator with nothing after it defines "" too


def is_imu_of_ros(text: bytes) -> bool:
    """Whether an Imu's definition has the fields of ROS in order, as far as it can be read."""
    with suppress(LogError):
        own, ros = (parse(IMU, each) for each in (text, definition(IMU).encode()))
        vectors = "geometry_msgs/Vector3", "geometry_msgs/Quaternion"
        pairs = [([f[:3] for f in own.get(name, ())], [f[:3] for f in ros[name]]) for name in (_short(IMU), *vectors)]
        return all(own_fields in ([], standard_fields) for own_fields, standard_fields in pairs)
    return True


def refuse_two(topic: str, schema_name: str, definitions: Iterable[Definition]) -> None:
    """Refuse definitions that lay out one message differently, as in merged logs.

    Raises:
        LogError: they do.
    """
    layouts = [{name: [f._replace(comment="") for f in fields] for name, fields in each.items()} for each in definitions]
    if any(layout != layouts[0] for layout in layouts):
        what = f"two definitions of {schema_name} are on {topic}"
        raise LogError(what, expected="one", fix="Read the logs one by one that were merged to this one")


def _short(name: str) -> str:
    """`package/Name`, however it is spelt."""
    return name.replace("/msg/", "/")


def _fields(of: str, body: str) -> Iterator[Field]:
    above = ""
    for line in body.splitlines():
        bare, _, comment = (part.strip() for part in line.partition("#"))
        if not bare:
            above = comment
            continue
        found = _FIELD.fullmatch(bare)
        if found is None:
            raise LogError(f"the definition of {of} has the line {bare[:80]!r}", expected="TYPE name")
        if found["rest"].lstrip().startswith("="):
            continue  # a constant is in no message
        kind = found["type"]
        if kind not in NUMBERS and kind not in (TEXT, "wstring", *TIMES):
            kind = _short(kind) if "/" in kind else "std_msgs/Header" if kind == "Header" else f"{of.partition('/')[0]}/{kind}"
        count = None if found["array"] is None else 0 if found["bound"] else int((found["count"] or "0")[:12])
        yield Field(found["name"], kind, count, comment or above)


def _check(name: str, known: Definition, sound: dict[str, int], depth: int) -> int:
    """Depth to which a message nests; each message is checked once.

    Raises:
        LogError: one is not defined, or they nest too deep (which one that contains itself does).
    """
    if depth > DEEPEST:
        raise LogError(f"{name} nests more than {DEEPEST} messages deep", expected="a definition that ends")
    if name not in known:
        raise LogError(f"{name} is not defined in the log's schema", expected="every message that it is made of")
    if name not in sound:
        inner = [f.kind for f in known[name] if f.kind not in NUMBERS and f.kind not in (TEXT, "wstring")]
        sound[name] = 1 + max((_check(kind, known, sound, depth + 1) for kind in dict.fromkeys(inner)), default=0)
    if depth + sound[name] > DEEPEST + 1:
        raise LogError(f"{name} nests more than {DEEPEST} messages deep", expected="a definition that ends")
    return sound[name]


def decodes(payload: bytes, schema_name: str, text: bytes) -> bool:
    """Whether a CDR payload can be a message of this definition, whose fields fill it."""
    try:
        walk = Walk(payload, parse(schema_name, text))
        for _ in walk.leaves():
            pass
    except LogError:
        return False
    return 0 <= len(payload) - walk.position < PADDING


class Walk(ByteWalk):
    """A walk over one message, in order; `texts` are path, place and bytes of each text.

    Raises:
        LogError: not plain CDR, or the message ends before its fields do.
    """

    message: bytes

    def __init__(self, payload: bytes, definition: Definition, encoding: str = "cdr") -> None:
        super().__init__(encoding, payload)
        if not self.ros1 and len(payload) < self.start:
            raise LogError(f"payload starts with {payload.hex(' ')}", expected=PLAIN)
        self.definition = definition
        self.texts: list[tuple[str, int, bytes]] = []

    def leaves(self) -> Iterator[Leaf]:
        """Every number of the message, rows of numbers as one."""
        yield from self._message(self.definition[""][0].kind, "")

    def _message(self, kind: str, path: str) -> Iterator[Leaf]:
        fields = self.definition[kind]
        if not fields and not self.ros1:
            self.skip(1)  # what is empty is written as one byte
        for field in fields:
            yield from self._field(field, f"{path}.{field.name}" if path else field.name)

    def _field(self, field: Field, path: str) -> Iterator[Leaf]:
        count = field.length
        if count is not None and field.kind not in NUMBERS:
            self.delimiter()
        if count == 0:
            count = self.word()
        if field.kind in NUMBERS:
            kind = NUMBERS[field.kind]
            if count is None or count:
                self.align(int(kind[1]))
            at = self.skip(int(kind[1]) * (1 if count is None else count))
            yield Leaf(path, at, kind, count)
        elif field.kind == TEXT:
            for _ in range(self._bounded(1 if count is None else count)):
                at = self.skip(self.word())
                self.texts.append((path, at, self.message[at : self.position]))
        elif field.kind == "wstring":
            raise LogError(f"{path} is a wide string, whose size ROS 2 leaves open", fix="Choose a field before it")
        else:
            for k in range(self._bounded(1 if count is None else count)):
                yield from self._message(field.kind, path if count is None else f"{path}[{k}]")

    def _bounded(self, count: int) -> int:
        if count > len(self.message) - self.position:
            raise LogError(f"a count of {count} with {len(self.message) - self.position} bytes left in the message")
        return count

    def word(self, value: int = 0) -> int:
        """A count or a length; LogError where there are too many."""
        found = super().word(value)
        if len(self.constants) > MAX_COUNTED:
            raise LogError(f"more than {MAX_COUNTED} texts and counts in one message", fix="Choose a field before them")
        return found


class DescribedCdr:
    """Messages of one type. They are read only: new ones have a type of ROS."""

    def __init__(self, definition: Definition, encoding: str = "cdr") -> None:
        self._definition, self._encoding = definition, encoding
        self._size, self._constants = -1, list[tuple[int, bytes]]()
        self._places: dict[str, tuple[int, str]] = {}

    def tree(self, depth: int) -> dict[str, Any]:
        """Tree of the fields, as `reflection` has it."""
        return self._tree(self._definition[""][0].kind, depth, [MAX_FIELDS])

    def _tree(self, kind: str, depth: int, budget: list[int]) -> dict[str, Any]:
        fields: dict[str, Any] = {}
        for field in self._definition[kind]:
            budget[0] -= 1
            if budget[0] < 0:
                break
            if field.kind in NUMBERS:
                fields[field.name] = {None: "number", 3: "vector"}.get(field.length, "")
            elif field.kind in self._definition and field.length is None and depth:
                fields[field.name] = self._tree(field.kind, depth - 1, budget)
        return fields

    def comments(self, path: Sequence[str | int]) -> Iterator[str]:
        """Comments of a field and of those around it, the nearest first."""
        kind, found = self._definition[""][0].kind, list[str]()
        for key in (key for key in path if isinstance(key, str)):
            field = next(field for field in self._definition[kind] if field.name == key)
            kind = field.kind
            found.append(field.comment)
        yield from reversed(found)

    def parse(self, raw: bytes) -> Message:
        """Message with the places of its numbers.

        Raises:
            ValueError: the bytes are no such message.
        """
        if len(raw) != self._size or any(raw[at : at + len(value)] != value for at, value in self._constants):
            self._walk(raw)
        return raw, self._places

    def _walk(self, raw: bytes) -> None:
        self._size, places = -1, dict[str, tuple[int, str]]()
        try:
            walk = Walk(raw, self._definition, self._encoding)
            for leaf in walk.leaves():
                size, form = int(leaf.kind[1]), walk.order + FORMATS[leaf.kind]
                if leaf.length is None:
                    places[leaf.path] = leaf.offset, form
                for number in range(leaf.length if leaf.length in VECTORS else 0):
                    places[f"{leaf.path}[{number}]"] = leaf.offset + size * number, form
        except LogError as error:
            raise ValueError(error.what) from error
        self._places, self._size, self._constants = places, len(raw), walk.constants

    def at(self, message: Message, path: Sequence[str | int]) -> Any:
        """Value of a number."""
        offset, form = self.place(message, path)
        return struct.unpack_from(form, message[0], offset)[0]

    @staticmethod
    def place(message: Message, path: Sequence[str | int]) -> tuple[int, str]:
        """First byte of a number, and its format."""
        name = ".".join(str(key) for key in path if isinstance(key, str))
        return message[1][f"{name}[{path[-1]}]" if isinstance(path[-1], int) else name]

    def new(self, values: Sequence[tuple[Sequence[str | int], Any]]) -> bytes:
        """Refuse: fields that are not numbers have no default."""
        raise NotImplementedError
