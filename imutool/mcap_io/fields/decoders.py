"""Numbers of messages by path, whatever the encoding: a decoder for each of two kinds.

`Described` messages (CDR, ROS 1) have a definition: one message is walked, and messages that share its counts are cut out in
one numpy pass. `Parsed` messages (JSON, MessagePack, protobuf, FlatBuffers) have no fixed place for a number, and
are parsed one by one.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from imutool.array_types import Float64, Int64, UInt8
from imutool.errors import LogError
from imutool.mcap_io.codec import ros2_definition, schemas
from imutool.mcap_io.codec.formats import LACKS, MAX_ROW, NumberFormat, Path, fields_of, stamps_of
from imutool.mcap_io.codec.formats.encodings import format_of, tree_of
from imutool.mcap_io.codec.ros2_definition import Definition, Leaf
from imutool.mcap_io.log import Log
from imutool.mcap_io.topics import REFLECTED, Topic

DESCRIBED = {("ros2msg", "cdr"), ("ros1msg", "ros1"), ("ros2idl", "cdr")}
_NO_IDL = re.compile(r"\A\s*IDL:.*$|^\s*#.*$", re.MULTILINE)  # the name of a part, and what it includes
_LAST = re.compile(r"(.*?)(?:\[(\d+)\])?")
_KEY = re.compile(r"\[(\d+)\]|([^.\[\]]+)")
_STAMP = re.compile(r"(^|\.)\w*stamp\.(sec|nanosec)$")
_HEADER = "header.stamp.sec", "header.stamp.nanosec"


class Columns(NamedTuple):
    """Numbers of consecutive messages, NaN where a message lacks one."""

    rows: slice
    stamps: Int64[np.ndarray, " n"]  # zero without one
    values: Float64[np.ndarray, "n k"]
    lacks: tuple[str, int] | None  # a path that a message lacks, and its row


@runtime_checkable
class Decoder(Protocol):
    """Numbers and texts of the messages of one topic."""

    def paths(self, raw: bytes, long: bool) -> list[str]:
        """Paths of the numbers in a message, without stamps; `long` arrays if asked."""

    def columns(self, payload: UInt8[np.ndarray, "n L"], paths: Sequence[str]) -> Iterator[Columns]:
        """Numbers of messages of equal size; LogError of one that is no such message."""

    def texts(self, payload: UInt8[np.ndarray, "n L"], path: str) -> Iterator[tuple[str, ...]]:
        """Every different list of texts in messages of equal size."""


def decoder_of(log: Log, topic: Topic) -> Decoder:
    """Decoder of a topic's messages.

    Raises:
        LogError: no schema, a damaged one, or one in another language.
    """
    if topic.reflected is not None:  # its messages come as those of ROS 2
        text = schemas.definition(topic.schema_name).encode()
        return Described(ros2_definition.parse(topic.schema_name, text), "cdr")
    channel = next(c for c in log.index.channels.values() if c.topic == topic.name)
    schema = log.index.schemas.get(channel.schema_id)
    name, data = topic.schema_name, schema.data if schema else b""
    where = f"{log.path} {topic.name}"
    if (topic.schema_encoding, topic.message_encoding) in DESCRIBED:
        parse = _parse_idl if topic.schema_encoding == "ros2idl" else ros2_definition.parse
        with log.named(topic.name):
            definition = parse(name, data)
            numbers = {channel.schema_id for channel in log.index.channels.values() if channel.topic == topic.name}
            texts = {log.index.schemas[number].data for number in numbers if number in log.index.schemas}
            ros2_definition.refuse_two(topic.name, name, [definition, *(parse(name, text) for text in texts)])
            return Described(definition, topic.message_encoding)
    if topic.message_encoding not in REFLECTED:
        raise LogError(
            f"{topic.name} is described as {topic.schema_encoding or 'nothing'!r} and encoded as {topic.message_encoding!r}",
            where=where,
            expected="ros2msg and cdr, ros1msg and ros1, protobuf, json, msgpack or flatbuffer",
            fix="Record it with ROS 2's own MCAP plugin",
        )
    try:
        form = format_of(topic.message_encoding, name, data)
    except ImportError as error:
        raise LogError(
            f"{topic.name} is in protobuf, which is not installed", where=where, fix="pip install 'imutool[protobuf]'"
        ) from error
    if form is None:
        raise LogError(f"the {topic.message_encoding} schema of {topic.name} is damaged or lacks {name}", where=where)
    return Parsed(form, topic.message_encoding)


def _parse_idl(schema_name: str, text: bytes) -> Definition:
    """Fields of a message and of nested ones from a `ros2idl` definition. Needs rosbags.

    Raises:
        LogError: rosbags is not installed or cannot read it, or as `parse`.
    """
    if len(text) > ros2_definition.MAX_TEXT:
        raise LogError(f"the definition of {schema_name} has {len(text)} bytes", expected=f"at most {ros2_definition.MAX_TEXT}")
    try:
        from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_typestore

        store = get_typestore(Stores.EMPTY)
        for part in ros2_definition.SEPARATOR.split(text.decode(errors="replace")):
            if bare := _NO_IDL.sub("", part).strip():
                store.register(get_types_from_idl(bare))
        msg, _ = store.generate_msgdef(schema_name, ros_version=2)
    except ImportError as error:
        raise LogError(
            "a ros2idl definition needs rosbags, which is not installed", fix="pip install 'imutool[bags]'"
        ) from error
    except (TypesysError, KeyError, ValueError) as error:
        raise LogError(f"the definition of {schema_name} is not readable", expected="IDL as ROS 2 records it") from error
    return ros2_definition.parse(schema_name, msg.encode())


class Described:
    """Messages of ROS: where their numbers lie follows from a definition."""

    def __init__(self, definition: Definition, encoding: str) -> None:
        self._walk: Callable[[bytes], ros2_definition.Walk] = lambda raw: ros2_definition.Walk(raw, definition, encoding)

    def paths(self, raw: bytes, long: bool) -> list[str]:
        """Paths of the numbers in a message."""
        leaves = [leaf for leaf in self._walk(raw).leaves() if not _STAMP.search(leaf.path)]
        found = list[str]()
        for leaf in leaves:
            if leaf.length is None:
                found.append(leaf.path)
            elif long or leaf.length <= MAX_ROW:
                found += [f"{leaf.path}[{k}]" for k in range(min(leaf.length, MAX_ROW))]
        return found

    def columns(self, payload: UInt8[np.ndarray, "n L"], paths: Sequence[str]) -> Iterator[Columns]:
        """Stretches of messages with the same field offsets, found by one walk each."""

        def look(raw: bytes) -> tuple[Sequence[tuple[int, bytes]], tuple[dict[str, Leaf], str]]:
            walk = self._walk(raw)
            return walk.constants, (_places(walk, paths), walk.order)

        for rows, (places, order) in schemas.stretches(payload, look):
            cut = payload[rows]
            values = np.full((len(cut), len(paths)), np.nan)
            for k, path in enumerate(paths):
                if path in places:
                    values[:, k] = _column(cut, places[path], order)
            lacks = next(((path, rows.start) for path in paths if path not in places), None)
            yield Columns(rows, _stamps(cut, places, order), values, lacks)

    def texts(self, payload: UInt8[np.ndarray, "n L"], path: str) -> Iterator[tuple[str, ...]]:
        """Every different list of texts."""
        while len(payload):
            walk = self._walk(payload[0].tobytes())
            for _ in walk.leaves():
                pass
            found = [(at, raw) for name, at, raw in walk.texts if name == path]
            yield tuple(raw.removesuffix(b"\0").decode(errors="replace") for _, raw in found)
            same = np.ones(len(payload), bool)
            for at, raw in found:
                same &= (payload[:, at : at + len(raw)] == np.frombuffer(raw, np.uint8)).all(axis=1)
            same[0] = True
            payload = payload[~same]


def _places(walk: ros2_definition.Walk, paths: Sequence[str]) -> dict[str, Leaf]:
    """Offsets of the wanted fields and of the header's stamp; the walk ends at the last."""
    asked: dict[str, list[tuple[str, int | None]]] = {}
    for path in paths:
        bare, index = _LAST.fullmatch(path).groups()  # type: ignore[union-attr]  # it matches any text
        asked.setdefault(bare, []).append((path, None if index is None else int(index)))
    found: dict[str, Leaf] = {}
    root = walk.definition[walk.definition[""][0].kind]
    stamps = len(_HEADER) if any((field.name, field.kind) == ("header", "std_msgs/Header") for field in root) else 0
    for leaf in walk.leaves():
        if leaf.path in _HEADER:
            stamps -= 1
            found[f"stamp {leaf.path}"] = leaf
        for path, index in asked.get(leaf.path, ()):
            if (index is None) == (leaf.length is None) and (leaf.length is None or (index or 0) < leaf.length):
                found[path] = leaf._replace(offset=leaf.offset + int(leaf.kind[1]) * (index or 0))
        if stamps <= 0 and all(path in found for path in paths):
            break  # what comes behind need not lie alike
    return found


def _column(payload: UInt8[np.ndarray, "n L"], place: Leaf, order: str) -> np.ndarray:
    cut = np.ascontiguousarray(payload[:, place.offset : place.offset + int(place.kind[1])])
    return cut.view(order + place.kind)[:, 0]


def _stamps(payload: UInt8[np.ndarray, "n L"], places: Mapping[str, Leaf], order: str) -> Int64[np.ndarray, " n"]:
    """Header stamps, zeros where there is no header."""
    keys = tuple(f"stamp {path}" for path in _HEADER)
    if not all(key in places for key in keys):
        return np.zeros(len(payload), np.int64)
    sec, nanosec = (_column(payload, places[key], order).astype(np.int64) for key in keys)
    return np.asarray(sec * 1_000_000_000 + nanosec)


class Parsed:
    """Messages that are parsed one by one."""

    def __init__(self, form: NumberFormat, encoding: str) -> None:
        self._form, self._encoding = form, encoding
        self._stamp: tuple[tuple[Path, int], ...] | None = None

    def paths(self, raw: bytes, long: bool) -> list[str]:
        """Paths of the numbers in a message, those of names that a path can hold."""
        clocks = {path for stamp in self._stamps(raw) for path, _ in stamp}
        found = [path for path in self._form.numbers(self._parse(raw)) if path not in clocks]
        lists = Counter(path[:-1] for path in found if isinstance(path[-1], int))
        kept = (p for p in found if not isinstance(p[-1], int) or (p[-1] < MAX_ROW if long else lists[p[:-1]] <= MAX_ROW))
        return [name for path in kept if _keys(name := _name(path)) == path]

    def columns(self, payload: UInt8[np.ndarray, "n L"], paths: Sequence[str]) -> Iterator[Columns]:
        """Numbers of all messages."""
        keys, at = [_keys(path) for path in paths], self._form.at
        values, stamps = np.full((len(payload), len(paths)), np.nan), np.zeros(len(payload), np.int64)
        lacks = None
        for row, raw in enumerate(payload):
            message = self._parse(raw.tobytes())
            if self._stamp is None:
                self._stamp = next(self._stamps(raw.tobytes()), ())
            for k, key in enumerate(keys):
                try:
                    values[row, k] = _number(at(message, key))
                except LACKS:
                    lacks = lacks or (paths[k], row)
            with suppress(*LACKS):
                stamps[row] = sum(int(at(message, path)) * size for path, size in self._stamp)
        yield Columns(slice(0, len(payload)), stamps, values, lacks)

    def texts(self, payload: UInt8[np.ndarray, "n L"], path: str) -> Iterator[tuple[str, ...]]:
        """Every different list of texts."""
        found = dict[tuple[str, ...], None]()
        for raw in payload:
            message = self._parse(raw.tobytes())
            try:
                found[tuple(str(text) for text in getattr(message, path, None) or message[path])] = None
            except LACKS:
                found[()] = None
        yield from found

    def _parse(self, raw: bytes) -> Any:
        try:
            return self._form.parse(raw)
        except ValueError as error:
            raise LogError(
                f"a message of {len(raw)} bytes is not readable as {self._encoding} ({error})",
                expected="whole messages",
                fix="Cut the log before or after it",
            ) from error

    def _stamps(self, raw: bytes) -> Iterator[tuple[tuple[Path, int], ...]]:
        try:
            tree = tree_of(self._form, raw)
        except ValueError:
            return
        yield from stamps_of(list(fields_of(tree))) if isinstance(tree, Mapping) else ()


def _number(value: Any) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise ValueError("no number")
    return float(value)


def _name(path: Path) -> str:
    return "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in path).removeprefix(".")


def _keys(path: str) -> Path:
    """Keys of a path; a name with a dot or a bracket has none that give it back."""
    return tuple(int(found[1]) if found[1] else found[2] for found in _KEY.finditer(path))
