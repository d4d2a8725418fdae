"""ROS message types: ROS 1 definitions as ROS 2 definitions, ROS 1 messages as CDR.

A type that ROS 2 has with the same fields gets the definition of ROS 2, so that ROS 2 programs know it. Any other keeps the
definition of its bag, with names that ROS 2 allows: `wheel_speed` for `wheelSpeed`. Needs rosbags.
A bag of ROS 2 before Iron holds no definitions; those of a driver's own types are then in .msg files of its workspace.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any

import zstandard

from imutool.errors import DataError, required
from imutool.recording.message_log import MessageTopic

HEADER, TIME, DURATION = "std_msgs/msg/Header", "builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
RENAMED = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}
EMPTY_CDR = b"\0\1\0\0\0"  # ROS 2 gives a message without fields one byte
NAME = 2  # rosbags' kind of field: another message
FIELD = re.compile(r"(?!.*__)(?!.*_$)[a-z][a-z0-9_]*")
TYPE = re.compile(r"[A-Z][A-Za-z0-9]*")
CONSTANT_NAME = re.compile(r"[A-Z]([A-Z0-9_]?[A-Z0-9]+)*")
CONSTANT = re.compile(r"^[ \t]*[a-z0-9]+[ \t]+\w+[ \t]*=.*$", re.MULTILINE)  # a line of a definition
MSG_TYPE = re.compile(r"\w+/msg/\w+")
ZSTD, LARGEST = b"\x28\xb5\x2f\xfd", 1 << 30  # first bytes of what zstd made, and bytes of one message
WORKSPACES = "AMENT_PREFIX_PATH"  # what `source install/setup.bash` sets
ToCdr = Callable[["bytes | memoryview"], "bytes | memoryview"]


def need_rosbags(where: Path) -> None:
    """Check that rosbags is installed.

    Raises:
        ConfigError: it is not.
    """
    required("rosbags.typesys", "bags", where=where, user="reading ROS bags")


def ros2_name(kind: str) -> str:
    """Message type in ROS 2 spelling."""
    package, _, name = kind.partition("/")
    return f"{package}/msg/{name}" if "/" not in name else kind


def plain_cdr(payload: bytes | memoryview) -> bytes | memoryview:
    """A message in CDR, unpacked if rosbag2 compressed it alone, as metadata.yaml says.

    Raises:
        ValueError: it does not unpack.
    """
    if payload[:4] != ZSTD:  # CDR begins with a zero
        return payload
    try:
        if not 0 <= (size := zstandard.frame_content_size(payload)) <= LARGEST:
            raise ValueError(f"a compressed message says it has {size} bytes")
        return bytes(zstandard.ZstdDecompressor().decompress(payload))
    except zstandard.ZstdError as error:
        raise ValueError(f"a compressed message does not unpack: {error}") from error


@cache
def ros2_store() -> Any:
    """The message types of ROS 2 Jazzy."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


@lru_cache(maxsize=256)
def ros2_definition(kind: str) -> tuple[bytes, str] | None:
    """Text and REP-2011 hash of a type that ROS 2 has; None of any other."""
    store = ros2_store()
    if kind not in store.fielddefs:
        return None
    return store.generate_msgdef(kind, ros_version=2)[0].encode(), store.hash_rihs01(kind)


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
    if not MSG_TYPE.fullmatch(kind):  # a bag may state any text, also one that leads to another folder
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


class Ros1Types:
    """Message types of one ROS 1 bag, from the definitions in its connections."""

    def __init__(self) -> None:
        self._stores: list[Any] = []  # two publishers may define a type in two ways

    def topic(self, name: str, kind: str, definition: str) -> tuple[MessageTopic, ToCdr]:
        """Topic in CDR, and the translation of its messages.

        Raises:
            Exception: rosbags cannot parse the definition; what it raises is its own affair.
        """
        store = self._store_of(definition, ros2_name(kind))
        ros1_kind = _type_name(ros2_name(kind))
        kind = RENAMED.get(ros2_name(kind), ros1_kind)
        standard = ros2_store()
        fields = store.fielddefs[ros1_kind][1]
        if kind in standard.fielddefs and same_layout(store.fielddefs, ros1_kind, standard.fielddefs, kind):
            text, digest = ros2_definition(kind) or (b"", "")
        else:
            kind = ros1_kind
            text, digest = store.generate_msgdef(kind, ros_version=2)[0].encode(), store.hash_rihs01(kind)
        topic = MessageTopic(name, kind, "ros2msg", text, "cdr", (("topic_type_hash", digest),))
        return topic, partial(store.ros1_to_cdr, typename=ros1_kind) if fields else (lambda _: EMPTY_CDR)

    def _store_of(self, definition: str, kind: str) -> Any:
        from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

        known = ros2_store().fielddefs
        try:
            found = get_types_from_msg(definition, kind)
        except TypesysError:  # most often a constant: they are no part of a message
            found = get_types_from_msg(CONSTANT.sub("", definition), kind)
        parsed = {_type_name(name): _renamed(*parts) for name, parts in found.items()}
        parsed |= {name: known[name] for name in (HEADER, TIME, DURATION)}
        for store in self._stores:
            try:
                store.register(parsed)
            except TypesysError:
                continue
            return store
        store = get_typestore(Stores.EMPTY)
        store.register(parsed)
        self._stores.append(store)
        return store


def _type_name(kind: str) -> str:
    """Type name that ROS 2 allows: `my_robot/msg/WheelState` for `My_robot/msg/wheel_state`."""
    package, _, message = kind.rpartition("/msg/")
    if not TYPE.fullmatch(message):
        message = "".join(part[:1].upper() + part[1:] for part in message.split("_"))
    return f"{_field_name(package)}/msg/{message}"


def _field_name(name: str) -> str:
    """Field name that ROS 2 allows: `wheel_speed` for `wheelSpeed`."""
    if FIELD.fullmatch(name):
        return name
    snake = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()
    return re.sub(r"__+", "_", snake).strip("_") or "field"


def _renamed(constants: list[Any], fields: list[Any]) -> tuple[list[Any], list[Any]]:
    """Constants and fields of a type with names that ROS 2 allows; no two alike."""
    names: list[str] = []
    for name, _ in fields:
        new = _field_name(name)
        names.append(new if new not in names else f"{new}_{len(names)}")
    kept = [(name.upper(), *rest) for name, *rest in constants if CONSTANT_NAME.fullmatch(name.upper())]
    return kept, [(name, _renamed_field(field)) for name, (_, field) in zip(names, fields, strict=True)]


def _renamed_field(field: Any) -> Any:
    """Description of a field, its message type renamed."""
    if field[0] == NAME:
        return field[0], _type_name(field[1])
    if isinstance(field[1][0], tuple):
        return field[0], (_renamed_field(field[1][0]), field[1][1])
    return field


def ros1_topic(name: str, kind: str, definition: str) -> MessageTopic:
    """Topic that keeps the encoding of ROS 1."""
    return MessageTopic(name, kind.replace("/msg/", "/"), "ros1msg", definition.encode(), "ros1")


def same_layout(own: Mapping[str, Any], own_kind: str, standard: Mapping[str, Any], standard_kind: str) -> bool:
    """Whether two definitions lay out a message in the same bytes, and name its fields alike."""
    if own_kind == HEADER == standard_kind:
        return True
    if own_kind not in own or standard_kind not in standard:
        return False
    own_fields, their_fields = own[own_kind][1], standard[standard_kind][1]
    if [name for name, _ in own_fields] != [name for name, _ in their_fields]:
        return False
    return all(_same_field(own, a, standard, b) for (_, a), (_, b) in zip(own_fields, their_fields, strict=True))


def _same_field(own: Mapping[str, Any], own_field: Any, standard: Mapping[str, Any], standard_field: Any) -> bool:
    if own_field[0] != standard_field[0]:
        return False
    if own_field[0] == NAME:
        return same_layout(own, own_field[1], standard, standard_field[1])
    if isinstance(own_field[1][0], tuple):  # an array or a sequence: of what, and how many
        return bool(own_field[1][1] == standard_field[1][1]) and _same_field(
            own, own_field[1][0], standard, standard_field[1][0]
        )
    return bool(own_field == standard_field)
