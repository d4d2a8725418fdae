"""IMU messages and poses of other types and encodings, found by reflection on their fields.

Fields come from protobuf descriptors, FlatBuffers schemas, `ros2msg` definitions, or the first message in JSON or MessagePack.
A message is that of an IMU if it holds an angular velocity and a linear acceleration of three numbers each, by the names of its
fields, in rad/s and m/s². It is a pose if its type or topic says so and it holds a position (m) and a quaternion.
A message that lacks them has NaN, so that `clean` can leave it out.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import groupby
from typing import NamedTuple

import numpy as np

from imutool.array_types import Bool, Float64, Shaped, UInt8
from imutool.errors import LogError
from imutool.mcap_io.codec import ros2_definition
from imutool.mcap_io.codec.decode import decode_imu
from imutool.mcap_io.codec.encode import encode_imu, encode_pose
from imutool.mcap_io.codec.formats import (
    ACCEL,
    DEPTH,
    GYRO,
    LACKS,
    MATRIX,
    STATED,
    TEXT,
    UNCOMPENSATED,
    UNITS_NS,
    Format,
    Path,
    Tree,
    beginning,
    counts_in,
    fields_of,
    imu_in,
    stamp_parts,
    stamps_of,
    unit_in,
    unit_in_name,
    unit_ns,
    vector_in,
)
from imutool.mcap_io.codec.formats.encodings import format_of, tree_of
from imutool.mcap_io.codec.messages import FIXED, MESSAGE, Messages
from imutool.mcap_io.codec.schemas import GYRO_COVARIANCE, IMU, POSE, runs
from imutool.mcap_io.codec.transforms import TYPE, Transforms

POSITION = r"position|pos|translation|p"
ORIENTATION = r"orientation|rotation|quaternion|quat|attitude|q"
POSE_TYPES = r"pose(?!s)|odom|truth|mocap|vicon|tracker"  # in the name of a type or topic: clouds and grids have poses too
FRAME = r"frame_?id|frame"
LOG_TIME, WITHOUT_STAMP = "log time", "as the messages state no stamp with its unit"
BY_LOG_TIMES = "as the log times show"
BY_SENSOR = "the filter in the sensor has removed the biases that it knows"


class Sample(NamedTuple):
    """Sample in a message: stamp in ns, frame, and its numbers."""

    stamp_ns: int
    frame_id: str
    values: Sequence[float]


@dataclass(frozen=True)
class Reflected:
    """Fields of an IMU or a pose in the messages of a topic; translates to and from CDR."""

    schema_name: str  # of the messages in CDR: an Imu or a PoseStamped
    format: Format
    vectors: tuple[Path, ...]  # of six numbers, rates, then accelerations; or of seven, position, then wxyz
    stamp: tuple[tuple[Path, int | float], ...]  # fields that add up to the stamp, with their nanoseconds; a float of floats
    frame: Path | None
    covariances: tuple[Path | None, ...] = ()
    other_stamps: tuple[Path, ...] = ()  # further times in the message, which do not count
    sizes: tuple[float, float] = (1.0, 1.0)  # of the rates and the accelerations of an IMU in SI, as the definition states
    units: str = ""  # that the definition states, in words
    counts: tuple[Path, ...] = ()  # times without a unit, in a message that states no stamp; the unit that log times show
    stamp_unit: str = ""
    pose: Reflected | None = None  # in the messages of an IMU
    uncompensated: tuple[Path, ...] = ()  # six others like `vectors`, for which they are taken where filled in

    @property
    def stamp_path(self) -> str:
        """Field of the stamp; of several the one that holds them."""
        return ".".join(map(str, self.stamp[0][0][: len(self.stamp[0][0]) - (len(self.stamp) > 1)]))

    @property
    def compensated(self) -> str:
        """Sentence on samples that the filter in the sensor has compensated; else empty."""
        names = ", ".join(dict.fromkeys(".".join(map(str, path[:-1] or path)) for path in self.vectors))
        return f"{names} are compensated: {BY_SENSOR}" if self.uncompensated else ""

    def settled(self, messages: Iterable[tuple[int, bytes]]) -> Reflected:
        """Fields that the first messages fill in, with the stamp whose unit their log times show where none is stated."""
        counts = () if self.stamp else self.counts
        first = beginning(messages) if counts or self.uncompensated else []
        with suppress(*LACKS):
            parsed = (self.format.parse(raw) for _, raw in first)
            if any(self.format.at(message, path) for message in parsed for path in self.uncompensated):
                return replace(self, vectors=self.uncompensated, uncompensated=()).settled(first)
        for path in counts[: len(first)]:
            with suppress(*LACKS):
                values = [self.format.at(self.format.parse(raw), path) for _, raw in first]
                if unit := unit_ns(values, [log_time for log_time, _ in first]):
                    stamp = ((path, float(unit) if any(isinstance(value, float) for value in values) else unit),)
                    pose = self.pose and replace(self.pose, stamp=stamp, stamp_unit=UNITS_NS[unit])
                    return replace(self, stamp=stamp, stamp_unit=UNITS_NS[unit], pose=pose)
        return self

    def sample(self, raw: bytes, log_time: int) -> Sample:
        """Sample in a message; at its log time where it has no stamp: 0 is one of a clock that runs.

        Raises:
            ValueError: the bytes are no such message, or it lacks a field.
        """
        try:
            message, at = self.format.parse(raw), self.format.at
            stamp_ns = round(sum(type(size)(at(message, path)) * size for path, size in self.stamp))
            frame = "" if self.frame is None else str(at(message, self.frame))
            values = [float(at(message, path)) for path in self.vectors]
            if self.sizes != (1.0, 1.0):
                values = [self.sizes[n // 3] * value for n, value in enumerate(values)]
            return Sample(stamp_ns or (0 if self.stamp_unit else log_time), frame, values)
        except (KeyError, IndexError, TypeError, AttributeError, OverflowError) as error:
            raise ValueError(f"the message lacks {error}") from error

    def with_stamp(self, raw: bytes, stamp_ns: int) -> bytes:
        """Message in CDR with another stamp, written in place; without one as it is.

        Raises:
            ValueError: the bytes are no such message.
        """
        return self._patched(raw, stamp_parts(stamp_ns, self.stamp))

    def with_vectors(self, raw: bytes, matrices: Float64[np.ndarray, "2 3 3"]) -> bytes:
        """Message of an IMU in CDR with both vectors multiplied, written in place.

        Raises:
            ValueError: the bytes are no such message.
        """
        values = np.array(self.sample(raw, 0).values).reshape(2, 3)
        recorded = (matrices @ values[:, :, None])[:, :, 0] / np.array(self.sizes)[:, None]
        return self._patched(raw, zip(self.vectors, recorded.ravel().tolist(), strict=True))

    def _patched(self, raw: bytes, fields: Iterable[tuple[Path, float]]) -> bytes:
        """Message in CDR with other numbers, written in place."""
        form, data = self.format, bytearray(raw)
        if not isinstance(form, ros2_definition.DescribedCdr):
            return raw
        message = form.parse(raw)
        for path, value in fields:
            offset, code = form.place(message, path)
            struct.pack_into(code, data, offset, value)
        return bytes(data)

    def encode(self, samples: Sequence[Sample]) -> UInt8[np.ndarray, "n L"]:
        """Samples of one frame as CDR."""
        values, stamps = np.array([sample.values for sample in samples]), np.array([s.stamp_ns for s in samples], np.int64)
        encode = encode_imu if self.schema_name == IMU else encode_pose
        return encode(stamps, values[:, :3], values[:, 3:], samples[0].frame_id)

    def cut(
        self, found: Messages, mask: Bool[np.ndarray, " n"]
    ) -> Iterator[tuple[Shaped[np.ndarray, " n"], UInt8[np.ndarray, "n L"]]]:
        """Heads of the chosen messages, and their samples as CDR, per stretch of one frame."""
        heads, offsets = found.heads[mask], found.offsets[mask]
        samples = []
        for offset, size, time in zip(offsets.tolist(), heads["length"].tolist(), heads["log_time"].tolist(), strict=True):
            first = offset + MESSAGE.itemsize
            try:
                samples.append(self.sample(found.data[first : first + size - FIXED].tobytes(), time))
            except ValueError:
                samples.append(Sample(time, "", [np.nan] * len(self.vectors)))
        start = 0
        for _, group in groupby(samples, key=lambda sample: sample.frame_id):
            part = list(group)
            yield heads[start : start + len(part)], self.encode(part)
            start += len(part)

    def from_cdr(self, rows: UInt8[np.ndarray, "n L"]) -> list[bytes]:
        """Messages of the topic's own type for Imu messages in CDR; fields that an Imu lacks stay unset."""
        messages: list[bytes] = []
        for part, layout in runs(rows, IMU):
            cut = rows[part]
            columns = decode_imu(cut, "cdr", layout)
            at = layout.numbers[0][0]
            covariances = [
                np.ascontiguousarray(cut[:, at + 8 * first : at + 8 * (first + 9)]).view("<f8")
                for first in (GYRO_COVARIANCE.start, GYRO_COVARIANCE.start + 12)
            ]
            for n, stamp_ns in enumerate(columns.stamp_ns.tolist()):
                gyro, accel = columns.gyro[n] / self.sizes[0], columns.accel[n] / self.sizes[1]
                values = [*gyro.tolist(), *accel.tolist()]
                fields = [*stamp_parts(stamp_ns, self.stamp), *zip(self.vectors, values, strict=True)]
                if self.frame is not None:
                    fields.append((self.frame, columns.frame_id))
                for path, matrix in zip(self.covariances, covariances, strict=True):
                    if path is not None:
                        fields += [((*path, k), value) for k, value in enumerate(matrix[n].tolist())]
                messages.append(self.format.new(fields))
        return messages


def reflect(encoding: str, topic: str, schema_name: str, schema: bytes, first: bytes | None) -> Reflected | Transforms | None:
    """Fields of an IMU, a pose or transforms in messages of a schema; None of others.

    JSON and MessagePack go by the `first` message, protobuf and FlatBuffers by the schema.

    Raises:
        ImportError: the schema is of protobuf, which is not installed.
    """
    form = format_of(encoding, schema_name, schema)
    if form is not None and (several := TYPE.fullmatch(schema_name)):
        return Transforms(form, bool(several[1]))
    try:
        tree = form and tree_of(form, first or b"")
    except ValueError:
        return None
    if form is None or not isinstance(tree, Mapping):
        return None
    if (imu := _found(tree, form)) is not None:
        return replace(_in_si(imu, form), pose=_pose(tree, form))
    return _pose(tree, form) if re.search(POSE_TYPES, f"{topic} {schema_name}".lower()) else None


def reflect_cdr(schema_name: str, schema: bytes, encoding: str = "cdr") -> Reflected | None:
    """Fields of an IMU in a definition of ROS; None of any other message."""
    try:
        form = ros2_definition.DescribedCdr(ros2_definition.parse(schema_name, schema), encoding)
    except LogError:
        return None
    found = _found(form.tree(DEPTH), form)
    return None if found is None else _in_si(found, form)  # without a pose: drivers put latitude and longitude there


def _in_si(found: Reflected, form: Format) -> Reflected:
    """Fields of an IMU with the sizes of the units that their names or the definition state."""
    comments = getattr(form, "comments", lambda _: ())
    paths = dict(zip(STATED, (found.vectors[0], found.vectors[3]), strict=True))
    stated = {sensor: unit_in_name(sensor, path) or unit_in(comments(path), STATED[sensor]) for sensor, path in paths.items()}
    names = ", ".join(f"{sensor} in {unit}" for sensor, (unit, _) in stated.items() if unit)
    return replace(found, sizes=(stated["gyro"][1], stated["accel"][1]), units=names)


def _found(tree: Tree, form: Format) -> Reflected | None:
    """Fields of an IMU in the tree of a message's fields."""
    fields = [*fields_of(tree)]
    raw = imu_in(fields, *UNCOMPENSATED)
    found = imu_in(fields, GYRO, ACCEL) or raw or imu_in(fields, "[gw]", "a", whole=False)  # ax, ay, az, gx, gy, gz
    if found is None:
        return None
    part, vectors = found
    frame = next((path for path, name, node in fields if node == TEXT and re.fullmatch(FRAME, name)), None)
    covariances = [
        next((path for path, name, node in part if node == MATRIX and re.fullmatch(rf"{pattern}_?covariance", name)), None)
        for pattern in (GYRO, ACCEL)
    ]
    stamp, *others = [*stamps_of(fields)] or [()]
    unused, counts = tuple(other[0][0] for other in others), () if stamp else counts_in(fields)
    uncompensated = raw[1] if raw and raw != found else ()
    return Reflected(IMU, form, vectors, stamp, frame, tuple(covariances), unused, counts=counts, uncompensated=uncompensated)


def _pose(tree: Tree, form: Format) -> Reflected | None:
    """First position with a quaternion next to it in the tree of a message's fields."""
    fields = [*fields_of(tree)]
    for path, name, node in fields:
        if not (isinstance(node, Mapping) and re.fullmatch(ORIENTATION, name)):
            continue
        position = vector_in([field for field in fields if field[0][:-1] == path[:-1]], POSITION)
        parts = next(([f"{q}{axis}" for axis in "wxyz"] for q in ("", "q") if {f"{q}{a}" for a in "wxyz"} <= node.keys()), None)
        if position is not None and parts is not None:
            frame = next((p for p, text, kind in fields if kind == TEXT and re.fullmatch(FRAME, text)), None)
            stamp = next(stamps_of(fields), ())
            vectors, counts = (*position, *((*path, part) for part in parts)), () if stamp else counts_in(fields)
            return Reflected(POSE, form, vectors, stamp, frame, counts=counts)
    return None
