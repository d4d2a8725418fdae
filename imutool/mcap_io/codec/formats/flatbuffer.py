"""FlatBuffers messages by the binary schema (.bfbs) in a log.

The library's Python package has no reflection and does not check offsets, so both are here. The schema is itself such a
message: its tables are those of reflection.fbs.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from imutool.mcap_io.codec.formats import DEPTH, LACKS, MAX_FIELDS, MAX_ROW, Path, fields_of, nested

# Base types of reflection.fbs with a fixed size, and the kinds that refer to others.
SCALARS = dict(zip(range(3, 13), "bBhHiIqQfd", strict=True))
BOOL, STRING, VECTOR, OBJECT, ARRAY = 2, 13, 14, 15, 17
LARGEST_STRUCT = 1 << 16  # bytes


@dataclass(frozen=True)
class Field:
    """Field of a table or struct: its slot in the vtable, or its byte in the struct."""

    name: str
    base: int
    element: int  # base type of a vector's or array's elements
    index: int  # of the object or enum
    length: int  # of an array
    slot: int
    default: float | int
    required: bool


@dataclass(frozen=True)
class Object:
    """Table or struct of a schema."""

    fields: Mapping[str, Field]
    is_struct: bool
    alignment: int
    size: int


class FlatBuffer:
    """Messages of one type, by its table in the schema."""

    def __init__(self, objects: Sequence[Object], root: Object) -> None:
        self._objects, self._root = objects, root

    @staticmethod
    def of(name: str, schema: bytes) -> FlatBuffer | None:
        """Type of that name in a binary schema, else the schema's root; None where the schema is damaged or has neither."""
        try:
            top = _Table(schema, _offset(schema, 0))
            objects = {part.text(0): _object(part) for part in top.tables(0)}
            root = top.follow(4)
            wanted = name if name in objects else _Table(schema, root).text(0) if root else ""
            made = list(objects.values())
            sound = all(_is_sound(field, len(made)) for kind in made for field in kind.fields.values())
            return FlatBuffer(made, objects[wanted]) if sound and all(kind.size <= LARGEST_STRUCT for kind in made) else None
        except (struct.error, ValueError, KeyError):
            return None

    def tree(self, depth: int) -> dict[str, Any]:
        """Tree of the fields, as `reflection` has it."""
        return self._tree(self._root, depth, [MAX_FIELDS])

    def _tree(self, kind: Object, depth: int, budget: list[int]) -> dict[str, Any]:
        fields: dict[str, Any] = {}
        for name, field in kind.fields.items():
            budget[0] -= 1
            if budget[0] < 0:
                break
            if field.base in SCALARS:
                fields[name] = "number" if field.index < 0 else ""  # else of an enum
            elif field.base == OBJECT:
                fields[name] = self._tree(self._objects[field.index], depth - 1, budget) if depth else ""
            elif field.base in (VECTOR, ARRAY) and field.element in SCALARS:
                fields[name] = "matrix" if "covariance" in name.lower() else "vector"
            else:
                fields[name] = "text" if field.base == STRING else ""
        return fields

    def parse(self, raw: bytes) -> Any:
        """Message with the place of its root table.

        Raises:
            ValueError: the bytes are no such message.
        """
        try:
            return raw, _offset(raw, 0)
        except struct.error as error:
            raise ValueError(str(error)) from error

    def at(self, message: Any, path: Sequence[str | int]) -> Any:
        """Value of a field; a number that a table leaves out has its default.

        Raises:
            KeyError: a field on the way is not set.
            ValueError: an offset points out of the message.
        """
        raw, place = message
        kind, names = self._root, [str(key) for key in path if isinstance(key, str)]
        try:
            for name in names[:-1]:
                field = kind.fields[name]
                place = self._place(raw, place, kind, field)
                kind = self._objects[field.index]
                place = place if kind.is_struct else _offset(raw, place)
            field = kind.fields[names[-1]]
            if field.base in SCALARS:
                inside = place + field.slot if kind.is_struct else _Table(raw, place).place(field.slot)
                return _scalar(raw, inside, SCALARS[field.base]) if inside else field.default
            place = self._place(raw, place, kind, field)
            if field.base == STRING:
                return _text(raw, place)
            form = SCALARS[field.element]
            first, count = (place, field.length) if field.base == ARRAY else _vector(raw, place)
            if int(path[-1]) >= count:
                raise IndexError(f"number {path[-1]} of {names[-1]}")
            return _scalar(raw, first + int(path[-1]) * struct.calcsize(form), form)
        except struct.error as error:
            raise ValueError(str(error)) from error

    def _place(self, raw: bytes, place: int, kind: Object, field: Field) -> int:
        inside = place + field.slot if kind.is_struct else _Table(raw, place).place(field.slot)
        if not inside:
            raise KeyError(field.name)
        return inside

    def numbers(self, message: Any) -> Iterator[Path]:
        """Paths of all numbers in a message, those of vectors up to its last."""
        for path, _, node in fields_of(self.tree(DEPTH)):
            if node == "number":
                yield path
            for number in range(MAX_ROW + 1) if node in ("vector", "matrix") else ():
                try:
                    self.at(message, (*path, number))
                except LACKS:
                    break
                yield *path, number

    def new(self, values: Sequence[tuple[Sequence[str | int], Any]]) -> bytes:
        """Bytes of a message with these fields; required ones are there, all others keep their default."""
        out = bytearray(4)
        struct.pack_into("<I", out, 0, self._write_table(out, self._root, nested(values)))
        return bytes(out)

    def _write_table(self, out: bytearray, kind: Object, tree: Mapping[str, Any]) -> int:
        """Append a table, behind its vtable and ahead of what it refers to; return its place."""
        fields = [f for f in kind.fields.values() if f.name in tree or (f.required and f.base in (STRING, VECTOR))]
        entries = [0] * ((max((field.slot for field in kind.fields.values()), default=2) - 2) // 2)
        _align(out, 2)
        vtable = len(out)
        out += bytes(4 + 2 * len(entries))
        _align(out, 8)
        table = len(out)
        out += struct.pack("<i", table - vtable)
        places: dict[str, int] = {}
        for field in sorted(fields, key=lambda field: -self._room(field)[0]):
            alignment, size = self._room(field)
            _align(out, alignment)
            places[field.name] = len(out)
            entries[(field.slot - 4) // 2] = len(out) - table
            out += bytes(size)
        struct.pack_into(f"<{2 + len(entries)}H", out, vtable, 4 + 2 * len(entries), len(out) - table, *entries)
        for field in fields:
            self._fill(out, places[field.name], field, tree.get(field.name))
        return table

    def _fill(self, out: bytearray, place: int, field: Field, value: Any) -> None:
        """Write a value at its place, or append it and write the way to it."""
        if field.base in SCALARS:
            struct.pack_into(f"<{SCALARS[field.base]}", out, place, value)
        elif field.base == ARRAY:
            struct.pack_into(f"<{len(value)}{SCALARS[field.element]}", out, place, *value)
        elif field.base == OBJECT and (kind := self._objects[field.index]).is_struct:
            for part in kind.fields.values():
                if part.name in (value or {}):
                    self._fill(out, place + part.slot, part, value[part.name])
        else:
            struct.pack_into("<I", out, place, self._append(out, field, value) - place)

    def _append(self, out: bytearray, field: Field, value: Any) -> int:
        """Append a string, a vector or a table; return its place."""
        if field.base == OBJECT:
            return self._write_table(out, self._objects[field.index], value or {})
        form = SCALARS.get(field.element, "I")
        if field.base == STRING:
            _align(out, 4)
            data = str(value or "").encode()
            count, data = len(data), data + b"\0"
        else:
            _align(out, 4)
            out += bytes(-(len(out) + 4) % struct.calcsize(f"<{form}"))
            count, data = len(value or ()), struct.pack(f"<{len(value or ())}{form}", *(value or ()))
        place = len(out)
        out += struct.pack("<I", count) + data
        return place

    def _room(self, field: Field) -> tuple[int, int]:
        """Alignment and size of a field in its table."""
        if field.base == OBJECT and (kind := self._objects[field.index]).is_struct:
            return kind.alignment, kind.size
        return (struct.calcsize(SCALARS.get(field.base, "I")),) * 2


def _object(table: _Table) -> Object:
    return Object(
        {field.name: field for field in map(_field, table.tables(1)) if field.base},
        bool(table.number(2, "B")),
        max(1, min(int(table.number(3, "i")), 16)),
        int(table.number(4, "i")),
    )


def _is_sound(field: Field, objects: int) -> bool:
    return field.slot >= 0 and (field.base != OBJECT or 0 <= field.index < objects) and field.slot <= LARGEST_STRUCT


def _field(table: _Table) -> Field:
    kind = _Table(table.raw, table.follow(1))
    base, element = (int(kind.number(slot, "b")) for slot in (0, 1))
    default = table.number(5, "d") if base in (11, 12) else table.number(4, "q")
    numbers = int(kind.number(2, "i", -1)), int(kind.number(3, "H")), int(table.number(3, "H"))
    known = base if base in (*SCALARS, BOOL, STRING, VECTOR, OBJECT, ARRAY) else 0
    return Field(table.text(0), known, element, *numbers, default, bool(table.number(7, "B")))


@dataclass(frozen=True)
class _Table:
    """Table in a message, its fields by their number in the schema."""

    raw: bytes
    at: int

    def place(self, slot: int) -> int:
        """Place of the field in a slot of the vtable; 0 of one that is not set."""
        vtable = self.at - int(_scalar(self.raw, self.at, "i"))
        inside = int(_scalar(self.raw, vtable + slot, "H")) if slot < int(_scalar(self.raw, vtable, "H")) else 0
        return self.at + inside if inside else 0

    def number(self, identity: int, form: str, default: float | int = 0) -> Any:
        place = self.place(4 + 2 * identity)
        return _scalar(self.raw, place, form) if place else default

    def follow(self, identity: int) -> int:
        place = self.place(4 + 2 * identity)
        return _offset(self.raw, place) if place else 0

    def text(self, identity: int) -> str:
        place = self.place(4 + 2 * identity)
        return _text(self.raw, place) if place else ""

    def tables(self, identity: int) -> Iterator[_Table]:
        """Tables of a vector."""
        if place := self.place(4 + 2 * identity):
            first, count = _vector(self.raw, place)
            if count > MAX_FIELDS:
                raise ValueError(f"a vector of {count} tables")
            for number in range(count):
                yield _Table(self.raw, _offset(self.raw, first + 4 * number))


def _scalar(raw: bytes, place: int, form: str) -> Any:
    if place < 0:  # which Python would count from the end
        raise ValueError(f"an offset to byte {place}")
    return struct.unpack_from(f"<{form}", raw, place)[0]


def _offset(raw: bytes, place: int) -> int:
    return place + int(_scalar(raw, place, "I"))


def _vector(raw: bytes, place: int) -> tuple[int, int]:
    """First element and number of elements of the vector that a field refers to."""
    start = _offset(raw, place)
    return start + 4, int(_scalar(raw, start, "I"))


def _text(raw: bytes, place: int) -> str:
    first, count = _vector(raw, place)
    return raw[first : first + count].decode()


def _align(out: bytearray, size: int) -> None:
    out += bytes(-len(out) % size)
