"""Tables of numbers as CDR messages with a type made from the columns."""

from __future__ import annotations

import numpy as np
from jaxtyping import Shaped, UInt8

from imutool.recording.message_log import MessageTopic, Table

ROS_NAMES = {"f4": "float32", "f8": "float64", "b1": "bool"} | {
    f"{sign}{size}": f"{name}{8 * size}" for sign, name in (("i", "int"), ("u", "uint")) for size in (1, 2, 4, 8)
}
ENCAPSULATION = 4  # bytes ahead of a CDR message; alignment counts from behind them


def table_topic(name: str, table: Table) -> MessageTopic:
    """Topic of a table, with the definition of its messages."""
    lines = []
    for column, (kind, shape) in _fields(table.columns.dtype).items():
        size = "".join(f"[{count}]" for count in shape)
        lines.append(f"{ROS_NAMES[kind.str[1:]]}{size} {column}\n")
    return MessageTopic(name, table.schema_name, "ros2msg", "".join(lines).encode(), "cdr")


def encode_table(columns: Shaped[np.ndarray, " n"]) -> UInt8[np.ndarray, "n L"]:
    """One message for each row; every field has a fixed size, so all rows lie alike."""
    fields = _fields(columns.dtype)
    offsets, position = [], ENCAPSULATION
    for kind, shape in fields.values():
        position += -(position - ENCAPSULATION) % kind.itemsize
        offsets.append(position)
        position += kind.itemsize * int(np.prod(shape, dtype=int))
    formats = [(kind.newbyteorder("<"), shape) for kind, shape in fields.values()]
    layout = np.dtype({"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": position})
    rows = np.zeros(len(columns), layout)
    for name in fields:
        rows[name] = columns[name]
    raw = rows.view(np.uint8).reshape(len(columns), position)
    raw[:, 1] = 1  # little endian
    return raw


def _fields(dtype: np.dtype[np.void]) -> dict[str, tuple[np.dtype[np.generic], tuple[int, ...]]]:
    """Type and shape of every column."""
    every = {}
    for name in dtype.names or ():
        field = dtype[name]
        every[name] = (field.subdtype[0], field.shape) if field.subdtype else (field, ())
    return every
