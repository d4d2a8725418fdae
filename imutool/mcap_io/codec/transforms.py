"""Foxglove's `FrameTransform(s)` as TFMessage in CDR, and the bodies of a tree of frames."""

from __future__ import annotations

import re
import struct
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import reduce
from itertools import count, groupby, takewhile
from operator import getitem
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Schema

from imutool.array_types import Bool, Float64, UInt8
from imutool.errors import LogError
from imutool.mcap_io.codec.encode import encode_transforms
from imutool.mcap_io.codec.formats import LACKS, MAX_ROW, Format, Path
from imutool.mcap_io.codec.joined_imu import Cut
from imutool.mcap_io.codec.messages import FIXED, MESSAGE, Messages
from imutool.mcap_io.codec.ros2_definition import FORMATS, TEXT, Definition, Walk, parse
from imutool.mcap_io.codec.schemas import NS_PER_S, TF
from imutool.recording.message_log import TRUE_TYPES

TYPE = re.compile(r"(?:.*[./])?FrameTransform(s?)")
FRAMES = "parent_frame_id", "child_frame_id"
NUMBERS = *(("translation", axis) for axis in "xyz"), *(("rotation", axis) for axis in "wxyz")
NAME, LISTED = re.compile(r"(.*_)?name"), "geometry_msgs/Pose"  # of a body
TYPES_OF_LISTS = re.compile(r"geometry_msgs/(msg/)?PoseArray$|gazebo_msgs/(msg/)?(Model|Link)States$")
WORLD = re.compile(r"(.*[/_])?(map|odom|world|earth)(_combined|_frame)?")
STILL = 0.02  # of a quaternion's numbers, 2 degrees
STAMPS = ("seconds", "nanos"), ("sec", "nsec")


def bodies(pairs: Collection[tuple[str, str]]) -> list[tuple[str, str]]:
    """Parents and children of a tree whose poses are those of a body in a world.

    Worlds are frames without a parent, and `map` and `odom` (REP 105): joints move in a body.
    """
    children = {child for _, child in pairs}
    in_worlds = [pair for pair in pairs if pair[0] not in children or WORLD.fullmatch(pair[0])]
    return [pair for pair in in_worlds if not WORLD.fullmatch(pair[1])] or in_worlds or [*pairs]


def is_still(q_wb_wxyz: Float64[np.ndarray, "n 4"]) -> bool:
    """Whether a body does not turn, as a wall or a wand that lies there."""
    return not len(q_wb_wxyz) or bool(np.ptp(q_wb_wxyz, axis=0).max() < STILL)


class ListedPoses:
    """Messages of ROS with a list of poses, read as transforms.

    Their names stand in the list, or in a list of their own; `2_of_3` is the second of three poses without names.
    """

    def __init__(self, definition: Definition, encoding: str, pose: str, name: str) -> None:
        self._definition, self._encoding, self._pose = definition, encoding, pose  # paths; of a name as a pattern
        self._name = re.compile(name)

    def parse(self, raw: bytes) -> dict[str, Any]:
        """Message as nested fields.

        Raises:
            ValueError: the bytes are no such message.
        """
        try:
            walk = Walk(raw, self._definition, self._encoding)
            numbers = {
                leaf.path: struct.unpack_from(walk.order + FORMATS[leaf.kind], raw, leaf.offset)[0] for leaf in walk.leaves()
            }
        except LogError as error:
            raise ValueError(error.what) from error
        texts = [(path, text.removesuffix(b"\0").decode(errors="replace")) for path, _, text in walk.texts]
        head: dict[str, Any] = {"parent_frame_id": dict(texts).get("header.frame_id", "")}
        if "header.stamp.sec" in numbers:
            head["timestamp"] = {"sec": numbers["header.stamp.sec"], "nsec": numbers["header.stamp.nanosec"]}
        at = [*takewhile(lambda path: f"{path}.position.x" in numbers, map(self._pose.format, count()))]
        names = [text for path, text in texts if self._name.fullmatch(path)]
        if len(names) != len(at):
            names = [f"{k}_of_{len(at)}" for k in range(1, len(at) + 1)] if len(at) <= MAX_ROW else []
        vectors = (("translation", "position", "xyz"), ("rotation", "orientation", "xyzw"))
        parts = ({to: {axis: numbers[f"{path}.{of}.{axis}"] for axis in axes} for to, of, axes in vectors} for path in at)
        return {"transforms": [{**head, "child_frame_id": name, **part} for name, part in zip(names, parts, strict=False)]}

    def at(self, message: Any, path: Path) -> Any:
        """Value of a field; KeyError where the message lacks it."""
        return reduce(getitem, path, message)


def listed_poses(schema: Schema | None, encoding: str, kind: str) -> Transforms | None:
    """Poses of several bodies in one message of true poses; None of any other type."""
    true = schema is not None and (kind == "truth" or re.search(TRUE_TYPES, schema.name))
    if schema is None or not true or schema.encoding not in ("ros1msg", "ros2msg"):
        return None
    with suppress(LogError):
        definition = parse(schema.name, schema.data)
        root = definition[definition[""][0].kind]
        for field in (field for field in root if field.length is not None):
            inner = definition.get(field.kind, ())
            name = next((part.name for part in inner if part.kind == TEXT and NAME.fullmatch(part.name)), None)
            pose = next((part.name for part in inner if (part.kind, part.length) == (LISTED, None)), None)
            if name and pose:
                at = f"{field.name}[{{}}].{pose}", rf"{field.name}\[\d+\]\.{name}"
                return Transforms(ListedPoses(definition, encoding, *at), several=True)
            if field.kind == LISTED and TYPES_OF_LISTS.search(schema.name):
                return Transforms(ListedPoses(definition, encoding, f"{field.name}[{{}}]", NAME.pattern), several=True)
    return None


class Transform(NamedTuple):
    """Pose of a child frame in its parent: stamp in ns, position, and quaternion wxyz."""

    frames: tuple[str, str]
    stamp_ns: int
    values: list[float]


@dataclass(frozen=True)
class Transforms:
    """Messages of one or several transforms; one that lacks a field is left out."""

    format: Format | ListedPoses
    several: bool
    schema_name: str = TF
    units: str = ""  # that the schema states
    stamp: bool = True  # or the log time in each that has none

    def sample(self, raw: bytes, log_time: int) -> list[Transform]:
        """Transforms of a message, which may list none.

        Raises:
            ValueError: they lack a field.
        """
        found = self._transforms(raw, log_time)
        with suppress(*LACKS):
            if found or (self.several and not len(self.format.at(self.format.parse(raw), ("transforms",)))):
                return found
        raise ValueError("no transform in the message")

    def encode(self, samples: Sequence[Sequence[Transform]]) -> UInt8[np.ndarray, "n L"]:
        """Messages of the same frames as CDR."""
        stamps = np.array([[each.stamp_ns for each in message] for message in samples], np.int64)
        values = np.array([[each.values for each in message] for message in samples], np.float64).reshape(*stamps.shape, 7)
        return encode_transforms(stamps, values, [each.frames for each in samples[0]])

    def cut(self, found: Messages, mask: Bool[np.ndarray, " n"]) -> Cut:
        """Heads of the chosen messages, and their transforms as CDR, per stretch of the same frames."""
        heads, offsets = found.heads[mask], found.offsets[mask]
        read = []
        for row, (offset, size, time) in enumerate(
            zip(offsets.tolist(), heads["length"].tolist(), heads["log_time"].tolist(), strict=True)
        ):
            first = offset + MESSAGE.itemsize
            read.append((row, self._transforms(found.data[first : first + size - FIXED].tobytes(), time)))
        for frames, group in groupby(read, key=lambda entry: [transform.frames for transform in entry[1]]):
            rows, messages = zip(*group, strict=True)
            if frames:
                yield heads[list(rows)], self.encode(messages)

    def _transforms(self, raw: bytes, log_time: int) -> list[Transform]:
        try:
            message = self.format.parse(raw)
            each = self.format.at(message, ("transforms",)) if self.several else [message]
        except LACKS:
            return []
        return [transform for part in each if (transform := self._transform(part, log_time)) is not None]

    def _transform(self, message: Any, log_time: int) -> Transform | None:
        at = self.format.at
        try:
            parent, child = (str(at(message, (name,))) for name in FRAMES)
            values = [float(at(message, path)) for path in NUMBERS]
        except LACKS:
            return None
        return Transform((parent, child), next(self._stamps(message), log_time), values)

    def _stamps(self, message: Any) -> Iterator[int]:
        for seconds, nanoseconds in STAMPS:
            try:
                parts = [int(self.format.at(message, ("timestamp", name))) for name in (seconds, nanoseconds)]
            except LACKS:
                continue
            yield parts[0] * NS_PER_S + parts[1]
        with suppress(*LACKS):
            yield int(self.format.at(message, ("timestamp",)))  # protobuf writes it in JSON as a date
