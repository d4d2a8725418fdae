"""Protobuf messages by the descriptors in a log's schema. Needs protobuf."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from graphlib import TopologicalSorter
from itertools import islice
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, duration_pb2, message_factory, timestamp_pb2
from google.protobuf.message import DecodeError

from imutool.mcap_io.codec.formats import DEEPEST, MAX_FIELDS, MAX_ROW, Path, refuse_long


@dataclass(frozen=True)
class Protobuf:
    """Messages of one type, made from its descriptor."""

    kind: Any

    @staticmethod
    def of(name: str, schema: bytes) -> Protobuf | None:
        """Type of that name in a FileDescriptorSet; None where the schema is damaged or lacks it.

        Its files may come in any order (writers in C++ put the first one ahead of what it imports), and lack times.
        """
        pool = descriptor_pool.DescriptorPool()
        try:
            refuse_long(schema)
            files = {known.DESCRIPTOR.name: known.DESCRIPTOR.serialized_pb for known in (timestamp_pb2, duration_pb2)}
            stated = descriptor_pb2.FileDescriptorSet.FromString(schema).file
            files |= {file.name: file.SerializeToString() for file in stated}
            for each in TopologicalSorter({file.name: file.dependency for file in stated}).static_order():
                pool.AddSerializedFile(files[each])
            return Protobuf(message_factory.GetMessageClass(pool.FindMessageTypeByName(name)))
        except (DecodeError, KeyError, TypeError, ValueError):
            return None

    def tree(self, depth: int) -> dict[str, Any]:
        """Tree of the fields, as `reflection` has it."""
        return _tree(self.kind.DESCRIPTOR, depth, [MAX_FIELDS])

    def parse(self, raw: bytes) -> Any:
        """Message from its bytes.

        Raises:
            ValueError: they are no such message, or too many.
        """
        refuse_long(raw)
        try:
            return self.kind.FromString(raw)
        except DecodeError as error:
            raise ValueError(str(error)) from error

    def at(self, message: Any, path: Sequence[str | int]) -> Any:
        """Value of a field.

        Raises:
            KeyError: a message on the way is not set.
        """
        for key in path[:-1]:
            if isinstance(key, int):
                message = message[key]
                continue
            field = message.DESCRIPTOR.fields_by_name[key]
            if field.message_type is not None and not field.is_repeated and not message.HasField(key):
                raise KeyError(key)
            message = getattr(message, key)
        return message[path[-1]] if isinstance(path[-1], int) else getattr(message, path[-1])

    def numbers(self, message: Any) -> Iterator[Path]:
        """Paths of all numbers in a message, without those of messages that are not set."""
        yield from islice(_numbers(message, ()), MAX_FIELDS)

    def new(self, values: Sequence[tuple[Sequence[str | int], Any]]) -> bytes:
        """Bytes of a message with these fields; all others keep their default."""
        message = self.kind()
        for path, value in values:
            inner = message
            for key in path[:-1]:
                inner = getattr(inner, str(key))
                if hasattr(inner, "SetInParent"):
                    inner.SetInParent()  # also where all in it is zero
            if isinstance(path[-1], int):
                inner.append(value)
            else:
                setattr(inner, path[-1], value)
        return bytes(message.SerializeToString())


def _tree(descriptor: Any, depth: int, budget: list[int]) -> dict[str, Any]:
    """Tree of a message's fields; `budget` counts down those that may still be searched."""
    fields: dict[str, Any] = {}
    for field in descriptor.fields:
        budget[0] -= 1
        if budget[0] < 0:
            break
        numeric = _is_number(field)
        if field.is_repeated:
            fields[field.name] = ("matrix" if "covariance" in field.name.lower() else "vector") if numeric else ""
        elif field.message_type is not None:
            fields[field.name] = _tree(field.message_type, depth - 1, budget) if depth else ""
        else:
            fields[field.name] = "number" if numeric else "text" if field.cpp_type == field.CPPTYPE_STRING else ""
    return fields


def _is_number(field: Any) -> bool:
    return field.cpp_type not in (field.CPPTYPE_STRING, field.CPPTYPE_MESSAGE, field.CPPTYPE_BOOL, field.CPPTYPE_ENUM)


def _numbers(message: Any, path: Path) -> Iterator[Path]:
    for field in message.DESCRIPTOR.fields if len(path) < DEEPEST else ():
        own = (*path, field.name)
        value = getattr(message, field.name)
        is_map = field.message_type is not None and field.message_type.GetOptions().map_entry
        if field.is_repeated and not is_map:
            for number, part in enumerate(value[: MAX_ROW + 1]):
                if field.message_type is not None:
                    yield from _numbers(part, (*own, number))
                elif _is_number(field):
                    yield *own, number
        elif field.message_type is not None and not is_map and message.HasField(field.name):
            yield from _numbers(value, own)
        elif _is_number(field):
            yield own
