"""Numbers of a CDR message by the `ros2msg` definition in the log.

Messages of one layout are walked once.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any

from imutool.errors import LogError
from imutool.mcap_io.codec import ros2_definition
from imutool.mcap_io.codec.flatbuffer import MOST_FIELDS

FORMATS = {"u1": "B", "i1": "b", "u2": "H", "i2": "h", "u4": "I", "i4": "i", "u8": "Q", "i8": "q", "f4": "f", "f8": "d"}
Message = tuple[bytes, Mapping[str, tuple[int, str]]]  # bytes; first byte and format of each number by its path


class DescribedCdr:
    """Messages of one type. They are read only: new ones have a type of ROS."""

    def __init__(self, definition: ros2_definition.Definition) -> None:
        self._definition = definition
        self._size, self._constants = -1, list[tuple[int, bytes]]()
        self._places: dict[str, tuple[int, str]] = {}

    def tree(self, depth: int) -> dict[str, Any]:
        """Tree of the fields, as `reflection` has it."""
        return self._tree(self._definition[""][0].kind, depth, [MOST_FIELDS])

    def _tree(self, kind: str, depth: int, left: list[int]) -> dict[str, Any]:
        fields: dict[str, Any] = {}
        for field in self._definition[kind]:
            left[0] -= 1
            if left[0] < 0:
                break
            if field.kind in ros2_definition.NUMBERS:
                fields[field.name] = {None: "number", 3: "vector"}.get(field.length, "")
            elif field.kind in self._definition and field.length is None and depth:
                fields[field.name] = self._tree(field.kind, depth - 1, left)
        return fields

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
            walk = ros2_definition.Walk(raw, self._definition)
            for leaf in walk.leaves():
                size, form = int(leaf.kind[1]), walk.order + FORMATS[leaf.kind]
                if leaf.length is None:
                    places[leaf.path] = leaf.offset, form
                for number in range(3 if leaf.length == 3 else 0):
                    places[f"{leaf.path}[{number}]"] = leaf.offset + size * number, form
        except LogError as error:
            raise ValueError(error.what) from error
        self._places = places
        self._size, self._constants = len(raw), walk.constants

    def at(self, message: Message, path: Sequence[str | int]) -> Any:
        """Value of a number."""
        raw, places = message
        name = ".".join(str(key) for key in path if isinstance(key, str))
        offset, form = places[f"{name}[{path[-1]}]" if isinstance(path[-1], int) else name]
        return struct.unpack_from(form, raw, offset)[0]

    def new(self, values: Sequence[tuple[Sequence[str | int], Any]]) -> bytes:
        """Refuse: fields that are not numbers have no default."""
        raise NotImplementedError
