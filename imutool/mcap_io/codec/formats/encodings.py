"""Access to the fields of messages, by their encoding and schema."""

from __future__ import annotations

from typing import Any

from imutool.mcap_io.codec.formats import DEPTH
from imutool.mcap_io.codec.formats.flatbuffer import FlatBuffer
from imutool.mcap_io.codec.formats.objects import OF_OBJECTS, Json


def format_of(encoding: str, schema_name: str, schema: bytes) -> Any:
    """Access to messages of a schema; None of an unknown encoding or a damaged schema.

    Raises:
        ImportError: the schema is of protobuf, which is not installed.
    """
    if encoding in OF_OBJECTS:
        return OF_OBJECTS[encoding](schema)
    if encoding == "flatbuffer":
        return FlatBuffer.of(schema_name, schema)
    if encoding != "protobuf":
        return None
    from imutool.mcap_io.codec.formats.protobuf import Protobuf

    return Protobuf.of(schema_name, schema)


def tree_of(form: Any, first: bytes) -> Any:
    """Tree of the fields, by the schema or, of JSON and MessagePack, by the first message.

    Raises:
        ValueError: that is no message.
    """
    return form.tree(form.parse(first)) if isinstance(form, Json) else form.tree(DEPTH)
