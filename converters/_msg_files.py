"""Definitions of message types from .msg files, beside a bag or in the sourced workspace.

A bag of ROS 2 before Iron holds no definitions, so that those of a driver's own types are only in its workspace.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from imutool.errors import DataError

from ._ros_types import ros2_store

TYPE = re.compile(r"\w+/msg/\w+")
WORKSPACES = "AMENT_PREFIX_PATH"  # what `source install/setup.bash` sets


def definition_from_files(kind: str, beside: Path) -> tuple[bytes, str]:
    """Definition of a type from .msg files; else nothing and the first type without one.

    Raises:
        DataError: a file is no definition that ROS 2 reads.
    """
    from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    found: dict[str, Any] = {}
    wanted = [kind]
    while wanted:
        name = wanted.pop()
        if name in found or name in ros2_store().fielddefs:
            continue
        path = next((path for path in _places(name, beside) if path.is_file()), None)
        if path is None:
            return b"", name
        try:
            found |= get_types_from_msg(path.read_text(), name)
        except (TypesysError, UnicodeDecodeError) as error:
            raise DataError(f"is no definition of {name} ({str(error).partition(chr(10))[0]})", where=path) from error
        wanted += [part for _, field in found[name][1] for part in _types_of(field)]
    store.register(found)
    text: str = store.generate_msgdef(kind, ros_version=2)[0]
    return text.encode(), ""


def _places(kind: str, beside: Path) -> Iterator[Path]:
    """Files that may define a type: `PACKAGE/msg/TYPE.msg` or `TYPE.msg` in the bag's folder, then in the workspaces."""
    if not TYPE.fullmatch(kind):  # a bag may state any text, also one that leads to another folder
        return
    package, _, name = kind.partition("/msg/")
    yield from (beside / package / "msg" / f"{name}.msg", beside / "msg" / f"{name}.msg", beside / f"{name}.msg")
    for prefix in filter(None, os.environ.get(WORKSPACES, "").split(os.pathsep)):
        yield Path(prefix) / "share" / package / "msg" / f"{name}.msg"


def _types_of(field: Any) -> list[str]:
    """Message types in the description of a field: itself, or that of its elements."""
    if isinstance(field[1], str):
        return [field[1]]
    return _types_of(field[1][0]) if isinstance(field[1][0], tuple) else []
