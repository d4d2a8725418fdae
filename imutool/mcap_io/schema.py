"""Message definitions, and whole columns of messages to and from their bytes in one numpy pass.

A message is walked once, field by field, to find where its numbers lie (a `Layout`); every further message with the same
texts lies the same way, so the columns are then cut out of a byte matrix, or written into one. Two encodings are known:
`cdr` as ROS 2 writes it (a 4-byte encapsulation, then fields aligned to their own size; both byte orders are read, little
endian is written) and `ros1` (no encapsulation, no alignment, a sequence number ahead of the stamp).

Quaternions are xyzw in messages and wxyz in memory. This file is where they change.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from imutool.errors import DataError, LogError

IMU = "sensor_msgs/msg/Imu"
POSE = "geometry_msgs/msg/PoseStamped"
VECTOR3 = "geometry_msgs/msg/Vector3Stamped"
TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
TF = "tf2_msgs/msg/TFMessage"
IMAGE = "sensor_msgs/msg/CompressedImage"
FLOAT = "std_msgs/msg/Float64"
ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORM = "geometry_msgs/msg/TransformStamped"

NS_PER_S = 1_000_000_000
NO_ORIENTATION = -1.0  # sensor_msgs/Imu: element 0 of a covariance of something that was not measured

_FIELDS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "std_msgs/Float64": "float64 data\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    "geometry_msgs/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose\n",
    "geometry_msgs/Vector3Stamped": "std_msgs/Header header\ngeometry_msgs/Vector3 vector\n",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance\n",
    "geometry_msgs/TwistWithCovarianceStamped": "std_msgs/Header header\ngeometry_msgs/TwistWithCovariance twist\n",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
    "geometry_msgs/TransformStamped": ("std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n"),
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "sensor_msgs/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data\n",
    "sensor_msgs/Imu": (
        "std_msgs/Header header\n"
        "geometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
        "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
        "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n"
    ),
}

# REP-2011 hashes of the definitions, as ROS 2 records them beside a channel; a test recomputes them with rosbags.
TYPE_HASHES = {
    IMU: "RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b",
    POSE: "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    VECTOR3: "RIHS01_d4829622288cbb443886e7ea94ea5671a3b1be6bab4ad04224432a65f7d7887a",
    TWIST: "RIHS01_77b67434531e6529b7a0091357b186b6ebdb17fd9ffd3e0c7ce9d3fb11a44563",
    TF: "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    IMAGE: "RIHS01_15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a",
    FLOAT: "RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a",
}


def definition(schema_name: str) -> str:
    """The `ros2msg` text of a message: its fields, then every nested message after a line of 80 `=`."""
    order: list[str] = []
    _collect(schema_name.replace("/msg/", "/"), order)
    return f"{'=' * 80}\nMSG: ".join([_FIELDS[order[0]], *(f"{name}\n{_FIELDS[name]}" for name in order[1:])])


def _collect(name: str, order: list[str]) -> None:
    """A message's name and those of all it is made of, depth first, each once."""
    order.append(name)
    for line in _FIELDS[name].splitlines():
        nested = line.split()[0].split("[")[0]
        if nested in _FIELDS and nested not in order:
            _collect(nested, order)


def canonical(schema_name: str) -> str:
    """The ROS 2 spelling of a schema's name: ROS 1 says `sensor_msgs/Imu`, ROS 2 `sensor_msgs/msg/Imu`."""
    package, slash, name = schema_name.partition("/")
    return f"{package}/msg/{name}" if slash and "/" not in name else schema_name


# What a message is made of, in order. "count" heads a sequence whose elements are the rest of the shape.
_SHAPES: dict[str, tuple[str | int, ...]] = {
    IMU: ("header", 37),
    POSE: ("header", 7),
    VECTOR3: ("header", 3),
    TWIST: ("header", 6 + 36),
    TF: ("count", "header", "text", 7),
    FLOAT: (1,),
    ODOMETRY: ("header", "text", 7 + 36 + 6 + 36),
    TRANSFORM: ("header", "text", 7),
    IMAGE: ("header", "text", "bytes"),
}
_ORIENTATION, _ORIENTATION_COVARIANCE = slice(0, 4), slice(4, 13)
_GYRO, _GYRO_COVARIANCE = slice(13, 16), slice(16, 25)
_ACCEL, _ACCEL_COVARIANCE = slice(25, 28), slice(28, 37)
_POSITION, _XYZW = slice(0, 3), slice(3, 7)
_WXYZ_FROM_XYZW = [3, 0, 1, 2]
_XYZW_FROM_WXYZ = [1, 2, 3, 0]


@dataclass(frozen=True, slots=True)
class Layout:
    """Where the fields of a message lie, and the bytes that make other messages lie the same way."""

    order: str  # "<" or ">"
    seconds: str  # "i4" in ROS 2, "u4" in ROS 1
    size: int
    stamps: tuple[int, ...]
    numbers: tuple[tuple[int, int], ...]  # (first byte, float64s)
    texts: tuple[str, ...]
    constants: tuple[tuple[int, bytes], ...]
    data: tuple[int, int] | None = None  # (first byte, bytes) of an image


class _Walk:
    """A position in a message, moving over one field at a time; texts and counts are read, or given."""

    def __init__(self, encoding: str, message: bytes | None, texts: Sequence[str] = ()) -> None:
        self.message, self.given, self.ros1 = message, list(texts), encoding == "ros1"
        self.order, self.start = "<", 0
        self.constants: list[tuple[int, bytes]] = []
        self.texts: list[str] = []
        if encoding == "cdr":
            self.start = 4
            head = b"\0\1\0\0" if message is None else message[:4]
            if head[:2] not in (b"\0\0", b"\0\1"):
                raise LogError(f"payload starts with {head.hex(' ')}", expected="plain CDR: 00 00 or 00 01")
            self.order = "<" if head[1] else ">"
            self.constants.append((0, head[:2]))
        elif encoding != "ros1":
            raise LogError(f"message encoding {encoding!r} is not known", expected="cdr or ros1")
        self.position = self.start

    def align(self, size: int) -> None:
        if not self.ros1:
            self.position += -(self.position - self.start) % size

    def skip(self, size: int) -> int:
        at, self.position = self.position, self.position + size
        if self.message is not None and self.position > len(self.message):
            raise LogError(f"payload of {len(self.message)} bytes ends before byte {self.position}")
        return at

    def word(self, value: int) -> int:
        """A uint32, which every message of the layout shares."""
        self.align(4)
        at = self.skip(4)
        raw = struct.pack("<I", value) if self.message is None else self.message[at : at + 4]
        self.constants.append((at, raw))
        return int(struct.unpack(self.order + "I", raw)[0])

    def text(self) -> None:
        nul = b"" if self.ros1 else b"\0"
        given = self.given.pop(0).encode() + nul if self.message is None else b""
        length = self.word(len(given))
        at = self.skip(length)
        raw = given if self.message is None else self.message[at : at + length]
        self.constants.append((at, raw))
        self.texts.append(raw.removesuffix(b"\0").decode(errors="replace"))


def _layout(
    schema_name: str, encoding: str, *, message: bytes | None = None, texts: Sequence[str] = (), data_size: int = 0
) -> Layout:
    """The layout of one message: of the given one, or of the one to be written with the given texts.

    Raises:
        LogError: the message is shorter than its fields, or its encoding is not known.
    """
    walk, shape, count = _Walk(encoding, message, texts), _SHAPES[schema_name], 1
    stamps: list[int] = []
    numbers: list[tuple[int, int]] = []
    data: tuple[int, int] | None = None
    if shape[0] == "count":
        shape, count = shape[1:], walk.word(1)
    for _ in range(count):
        for part in shape:
            if part == "header":
                walk.skip(4 if walk.ros1 else 0)  # the sequence number
                walk.align(4)
                stamps.append(walk.skip(8))
                walk.text()
            elif part == "text":
                walk.text()
            elif part == "bytes":
                length = walk.word(data_size)
                data = (walk.skip(length), length)
            else:
                walk.align(8)
                numbers.append((walk.skip(8 * int(part)), int(part)))
    kind = "u4" if walk.ros1 else "i4"
    constants = tuple(c for c in walk.constants if c[1])
    return Layout(walk.order, kind, walk.position, tuple(stamps), tuple(numbers), tuple(walk.texts), constants, data)


def runs(rows: UInt8[np.ndarray, "n L"], schema_name: str, encoding: str = "cdr") -> Iterator[tuple[slice, Layout]]:
    """Stretches of consecutive messages that share one layout; nearly always one, and checked in one pass.

    Raises:
        LogError: a message is shorter than its fields, or the encoding is not known.
    """
    pending = [(0, len(rows))] if len(rows) else []
    while pending:
        first, last = pending.pop()
        layout = _layout(schema_name, encoding, message=rows[first].tobytes())
        differ = np.zeros(last - first - 1, bool)
        for at, value in layout.constants:
            column = rows[first:last, at : at + len(value)]
            if (column != column[0]).any():
                differ |= (column[1:] != column[:-1]).any(axis=1)
        edges = [first, *(np.flatnonzero(differ) + first + 1).tolist(), last]
        yield slice(first, edges[1]), layout
        pending += reversed(list(pairwise(edges[1:])))


# ── reading ──────────────────────────────────────────────────────────────────────────────────────────────────────────


class ImuColumns(NamedTuple):
    """Consecutive Imu messages of one frame: stamps in ns, rad/s, m/s²."""

    stamp_ns: Int64[np.ndarray, " n"]
    gyro: Float64[np.ndarray, "n 3"]
    accel: Float64[np.ndarray, "n 3"]
    frame_id: str


class PoseColumns(NamedTuple):
    """Consecutive poses of one frame in another; `child_frame_id` is empty where the message names none."""

    stamp_ns: Int64[np.ndarray, " n"]
    p_wb: Float64[np.ndarray, "n 3"]
    q_wb_wxyz: Float64[np.ndarray, "n 4"]
    frame_id: str
    child_frame_id: str


class ScalarColumns(NamedTuple):
    """Consecutive numbers; `stamp_ns` is None for a message without a header, which the log's own time then carries."""

    stamp_ns: Int64[np.ndarray, " n"] | None
    values: Float64[np.ndarray, "n k"]
    frame_id: str


class TwistColumns(NamedTuple):
    """Consecutive TwistWithCovarianceStamped of one frame; `variance` is of angular then linear, in messages the other way."""

    stamp_ns: Int64[np.ndarray, " n"]
    angular: Float64[np.ndarray, "n 3"]
    linear: Float64[np.ndarray, "n 3"]
    variance: Float64[np.ndarray, "n 6"]
    frame_id: str


def _stamp(rows: UInt8[np.ndarray, "n L"], layout: Layout, which: int = 0) -> Int64[np.ndarray, " n"]:
    at = layout.stamps[which]
    seconds = rows[:, at : at + 4].view(layout.order + layout.seconds)[:, 0].astype(np.int64)
    return seconds * NS_PER_S + rows[:, at + 4 : at + 8].view(layout.order + "u4")[:, 0].astype(np.int64)


def _numbers(rows: UInt8[np.ndarray, "n L"], layout: Layout, columns: slice, which: int = 0) -> Float64[np.ndarray, "n k"]:
    at = layout.numbers[which][0] + 8 * columns.start
    cut = rows[:, at : at + 8 * (columns.stop - columns.start)]
    return cut.view(layout.order + "f8").astype(np.float64)


def _one_layout(rows: UInt8[np.ndarray, "n L"], schema_name: str, encoding: str) -> Layout:
    every = list(runs(rows, schema_name, encoding))
    if len(every) != 1:
        raise LogError(f"{len(every)} different frames in one batch", expected="one; split it with `runs`")
    return every[0][1]


def decode_imu(rows: UInt8[np.ndarray, "n L"], encoding: str = "cdr", layout: Layout | None = None) -> ImuColumns:
    """The columns of Imu messages that share one layout (`runs` splits those that do not).

    Raises:
        LogError: no rows, more than one layout, a payload too short, an unknown encoding.
    """
    layout = layout or _one_layout(rows, IMU, encoding)
    gyro, accel = _numbers(rows, layout, _GYRO), _numbers(rows, layout, _ACCEL)
    return ImuColumns(_stamp(rows, layout), gyro, accel, layout.texts[0])


def decode_poses(
    rows: UInt8[np.ndarray, "n L"], schema_name: str = POSE, encoding: str = "cdr", layout: Layout | None = None
) -> list[PoseColumns]:
    """The columns of PoseStamped, Odometry, TransformStamped or TFMessage: one entry per transform in a message.

    Raises:
        LogError: no rows, more than one layout, a payload too short, an unknown encoding.
    """
    layout = layout or _one_layout(rows, schema_name, encoding)
    named = 2 if "text" in _SHAPES[schema_name] else 1
    found = []
    for which in range(len(layout.stamps)):
        names = layout.texts[named * which : named * (which + 1)]
        q_wxyz = _numbers(rows, layout, _XYZW, which)[:, _WXYZ_FROM_XYZW]
        p_wb = _numbers(rows, layout, _POSITION, which)
        child = names[1] if named == 2 else ""
        found.append(PoseColumns(_stamp(rows, layout, which), p_wb, np.ascontiguousarray(q_wxyz), names[0], child))
    return found


def decode_scalars(
    rows: UInt8[np.ndarray, "n L"], schema_name: str, encoding: str = "cdr", layout: Layout | None = None
) -> ScalarColumns:
    """The columns of Float64 (one) or Vector3Stamped (three).

    Raises:
        LogError: no rows, more than one layout, a payload too short, an unknown encoding.
    """
    layout = layout or _one_layout(rows, schema_name, encoding)
    stamp_ns = _stamp(rows, layout) if layout.stamps else None
    frame_id = layout.texts[0] if layout.texts else ""
    return ScalarColumns(stamp_ns, _numbers(rows, layout, slice(0, layout.numbers[0][1])), frame_id)


def decode_twist(rows: UInt8[np.ndarray, "n L"], encoding: str = "cdr", layout: Layout | None = None) -> TwistColumns:
    """The columns of TwistWithCovarianceStamped.

    Raises:
        LogError: no rows, more than one layout, a payload too short, an unknown encoding.
    """
    layout = layout or _one_layout(rows, TWIST, encoding)
    numbers = _numbers(rows, layout, slice(0, 42))
    variance = numbers[:, 6:].reshape(-1, 6, 6).diagonal(axis1=1, axis2=2)
    return TwistColumns(_stamp(rows, layout), numbers[:, 3:6], numbers[:, :3], np.roll(variance, 3, axis=1), layout.texts[0])


def decode_image(message: bytes, encoding: str = "cdr") -> tuple[int, str, bytes]:
    """Stamp in ns, format and the encoded image of one CompressedImage message.

    Raises:
        LogError: the payload is too short, or its encoding is not known.
    """
    layout = _layout(IMAGE, encoding, message=message)
    assert layout.data is not None, "an image has bytes"
    row = np.frombuffer(message, np.uint8)[None, :]
    at, length = layout.data
    return int(_stamp(row, layout)[0]), layout.texts[1], message[at : at + length]


# ── writing ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def _blank(count: int, layout: Layout) -> UInt8[np.ndarray, "n L"]:
    """As many messages as asked for, with everything filled in that they share."""
    one = np.zeros(layout.size, np.uint8)
    for at, value in layout.constants:
        one[at : at + len(value)] = np.frombuffer(value, np.uint8)
    return np.repeat(one[None, :], count, axis=0)


def _put_stamp(rows: UInt8[np.ndarray, "n L"], layout: Layout, stamp_ns: Int64[np.ndarray, " n"]) -> None:
    if len(stamp_ns) and not -(2**31) <= stamp_ns.min() // NS_PER_S <= stamp_ns.max() // NS_PER_S < 2**31:
        raise DataError(
            f"stamps run from {stamp_ns.min()} to {stamp_ns.max()} ns",
            expected="seconds that fit 32 bits, as ROS 2 stores them",
        )
    at = layout.stamps[0]
    seconds = stamp_ns // NS_PER_S
    rows[:, at : at + 4].view("<i4")[:, 0] = seconds
    rows[:, at + 4 : at + 8].view("<u4")[:, 0] = stamp_ns - seconds * NS_PER_S


def _numbers_of(rows: UInt8[np.ndarray, "n L"], layout: Layout) -> Float64[np.ndarray, "n k"]:
    at, count = layout.numbers[0]
    return rows[:, at : at + 8 * count].view("<f8")


def encode_imu(
    stamp_ns: Int64[np.ndarray, " n"],
    gyro: Float64[np.ndarray, "n 3"],
    accel: Float64[np.ndarray, "n 3"],
    frame_id: str,
    gyro_covariance: Float64[np.ndarray, "9"] | Float64[np.ndarray, "n 9"] | None = None,
    accel_covariance: Float64[np.ndarray, "9"] | Float64[np.ndarray, "n 9"] | None = None,
) -> UInt8[np.ndarray, "n L"]:
    """One Imu message per row. Orientation is (0, 0, 0, 1) and marked as not measured; covariances, row-major, are one
    for all or one per row, and all zeros ("unknown", says the message's definition) where not given.

    Raises:
        DataError: a stamp beyond the 32-bit seconds of ROS 2.
    """
    layout = _layout(IMU, "cdr", texts=[frame_id])
    rows = _blank(len(stamp_ns), layout)
    _put_stamp(rows, layout, stamp_ns)
    numbers = _numbers_of(rows, layout)
    numbers[:, _ORIENTATION.stop - 1] = 1.0
    numbers[:, _ORIENTATION_COVARIANCE.start] = NO_ORIENTATION
    numbers[:, _GYRO], numbers[:, _ACCEL] = gyro, accel
    if gyro_covariance is not None:
        numbers[:, _GYRO_COVARIANCE] = gyro_covariance
    if accel_covariance is not None:
        numbers[:, _ACCEL_COVARIANCE] = accel_covariance
    return rows


def _encode_pose(
    layout: Layout,
    stamp_ns: Int64[np.ndarray, " n"],
    p_wb: Float64[np.ndarray, "n 3"],
    q_wb_wxyz: Float64[np.ndarray, "n 4"],
) -> UInt8[np.ndarray, "n L"]:
    rows = _blank(len(stamp_ns), layout)
    _put_stamp(rows, layout, stamp_ns)
    numbers = _numbers_of(rows, layout)
    numbers[:, _POSITION], numbers[:, _XYZW] = p_wb, q_wb_wxyz[:, _XYZW_FROM_WXYZ]
    return rows


def encode_pose(
    stamp_ns: Int64[np.ndarray, " n"],
    p_wb: Float64[np.ndarray, "n 3"],
    q_wb_wxyz: Float64[np.ndarray, "n 4"],
    frame_id: str,
) -> UInt8[np.ndarray, "n L"]:
    """One PoseStamped message per row.

    Raises:
        DataError: a stamp beyond the 32-bit seconds of ROS 2.
    """
    return _encode_pose(_layout(POSE, "cdr", texts=[frame_id]), stamp_ns, p_wb, q_wb_wxyz)


def encode_transform(
    stamp_ns: Int64[np.ndarray, " n"],
    p_wb: Float64[np.ndarray, "n 3"],
    q_wb_wxyz: Float64[np.ndarray, "n 4"],
    frame_id: str,
    child_frame_id: str,
) -> UInt8[np.ndarray, "n L"]:
    """One TFMessage per row, with one transform in it.

    Raises:
        DataError: a stamp beyond the 32-bit seconds of ROS 2.
    """
    return _encode_pose(_layout(TF, "cdr", texts=[frame_id, child_frame_id]), stamp_ns, p_wb, q_wb_wxyz)


def encode_vector3(
    stamp_ns: Int64[np.ndarray, " n"], vector: Float64[np.ndarray, "n 3"], frame_id: str
) -> UInt8[np.ndarray, "n L"]:
    """One Vector3Stamped message per row.

    Raises:
        DataError: a stamp beyond the 32-bit seconds of ROS 2.
    """
    layout = _layout(VECTOR3, "cdr", texts=[frame_id])
    rows = _blank(len(stamp_ns), layout)
    _put_stamp(rows, layout, stamp_ns)
    _numbers_of(rows, layout)[:] = vector
    return rows


def encode_twist(
    stamp_ns: Int64[np.ndarray, " n"],
    angular: Float64[np.ndarray, "n 3"],
    linear: Float64[np.ndarray, "n 3"],
    covariance: Float64[np.ndarray, "n 6 6"],
    frame_id: str,
) -> UInt8[np.ndarray, "n L"]:
    """One TwistWithCovarianceStamped message per row; `covariance` is of angular then linear, in messages the other way round.

    Raises:
        DataError: a stamp beyond the 32-bit seconds of ROS 2.
    """
    layout = _layout(TWIST, "cdr", texts=[frame_id])
    rows = _blank(len(stamp_ns), layout)
    _put_stamp(rows, layout, stamp_ns)
    numbers = _numbers_of(rows, layout)
    numbers[:, :3], numbers[:, 3:6] = linear, angular
    numbers[:, 6:] = np.roll(covariance, (3, 3), axis=(1, 2)).reshape(len(stamp_ns), 36)
    return rows


def encode_float(values: Float64[np.ndarray, " n"]) -> UInt8[np.ndarray, "n L"]:
    """One Float64 message per row; it has no stamp, so the log's own time carries it."""
    layout = _layout(FLOAT, "cdr")
    rows = _blank(len(values), layout)
    _numbers_of(rows, layout)[:, 0] = values
    return rows


def encode_image(stamp_ns: int, image: bytes, frame_id: str, image_format: str) -> bytes:
    """One CompressedImage message around the image's own bytes.

    Raises:
        DataError: a stamp beyond the 32-bit seconds of ROS 2.
    """
    layout = _layout(IMAGE, "cdr", texts=[frame_id, image_format], data_size=len(image))
    assert layout.data is not None, "an image has bytes"
    rows = np.zeros((1, layout.data[0]), np.uint8)
    for at, value in layout.constants:
        rows[0, at : at + len(value)] = np.frombuffer(value, np.uint8)
    _put_stamp(rows, layout, np.array([stamp_ns], np.int64))
    return rows.tobytes() + image


Encoder = Callable[[slice], UInt8[np.ndarray, "n L"]]
