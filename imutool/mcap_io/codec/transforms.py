"""Foxglove's `FrameTransform(s)` as TFMessage in CDR, and the bodies of a tree of frames."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np

from imutool.array_types import Bool
from imutool.mcap_io.codec.encode import encode_transforms
from imutool.mcap_io.codec.formats import LACKS, Format
from imutool.mcap_io.codec.joined_imu import Cut
from imutool.mcap_io.codec.messages import FIXED, MESSAGE, Messages
from imutool.mcap_io.codec.schemas import NS_PER_S, TF

TYPE = re.compile(r"(?:.*[./])?FrameTransform(s?)")
FRAMES = "parent_frame_id", "child_frame_id"
NUMBERS = *(("translation", axis) for axis in "xyz"), *(("rotation", axis) for axis in "wxyz")
WORLD = re.compile(r"(.*[/_])?(map|odom|world|earth)(_combined|_frame)?")
STAMPS = ("seconds", "nanos"), ("sec", "nsec")


def bodies(pairs: Collection[tuple[str, str]]) -> list[tuple[str, str]]:
    """Parents and children of a tree whose poses are those of a body in a world.

    Worlds are frames without a parent, and `map` and `odom` (REP 105): joints move in a body.
    """
    children = {child for _, child in pairs}
    in_worlds = [pair for pair in pairs if pair[0] not in children or WORLD.fullmatch(pair[0])]
    return [pair for pair in in_worlds if not WORLD.fullmatch(pair[1])] or in_worlds or [*pairs]


class Transform(NamedTuple):
    """Pose of a child frame in its parent: stamp in ns, position, and quaternion wxyz."""

    frames: tuple[str, str]
    stamp_ns: int
    values: list[float]


@dataclass(frozen=True)
class Transforms:
    """Messages of one or several transforms; one that lacks a field is left out."""

    format: Format
    several: bool
    schema_name: str = TF

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
                stamps = np.array([[each.stamp_ns for each in message] for message in messages], np.int64)
                values = np.array([[each.values for each in message] for message in messages], np.float64)
                yield heads[list(rows)], encode_transforms(stamps, values, frames)

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
