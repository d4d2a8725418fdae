"""Definitions and byte layouts of the messages that imutool reads and writes.

A message is walked once, field by field, to find where its numbers lie (a `Layout`); every further message with the same
texts lies the same way, so whole columns are then cut out of a byte matrix (`decode`), or written into one (`encode`). Two
encodings are known: `cdr` as ROS 2 writes it (a 4-byte encapsulation, then fields aligned to their own size; both byte orders
and plain CDR 2 are read, little endian is written) and `ros1` (no encapsulation, no alignment, a sequence number ahead of the
stamp).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import pairwise
from typing import TypeVar

import numpy as np

from imutool.array_types import UInt8
from imutool.errors import LogError

IMU = "sensor_msgs/msg/Imu"
POSE = "geometry_msgs/msg/PoseStamped"
POSE_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
VECTOR3 = "geometry_msgs/msg/Vector3Stamped"
TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
TF = "tf2_msgs/msg/TFMessage"
IMAGE = "sensor_msgs/msg/CompressedImage"
FLOAT = "std_msgs/msg/Float64"
ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
PRESSURE = "sensor_msgs/msg/FluidPressure"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
ACCELS = "geometry_msgs/msg/AccelStamped", "geometry_msgs/msg/AccelWithCovarianceStamped"
MESSAGE_TWISTS = {TWIST_STAMPED: "twist", TWIST: "twist.twist", ODOMETRY: "twist.twist"}  # the twist's field

NS_PER_S = 1_000_000_000
PLAIN = "plain CDR: 00 00, 00 01, 00 06 or 00 07"
DDS_NAME = re.compile(r"(\w+)::msg::(?:dds_::)?(\w+?)_?")
Found = TypeVar("Found")  # what is known of a stretch of messages

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

# REP-2011 hashes of the definitions, as ROS 2 records them with a channel; a test recomputes them with rosbags.
TYPE_HASHES = {
    IMU: "RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b",
    POSE: "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    VECTOR3: "RIHS01_d4829622288cbb443886e7ea94ea5671a3b1be6bab4ad04224432a65f7d7887a",
    TWIST: "RIHS01_77b67434531e6529b7a0091357b186b6ebdb17fd9ffd3e0c7ce9d3fb11a44563",
    TF: "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    IMAGE: "RIHS01_15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a",
    FLOAT: "RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a",
}


@cache
def definition(schema_name: str) -> str:
    """The `ros2msg` text of a message and of its nested messages."""
    order: list[str] = []
    _collect(schema_name.replace("/msg/", "/"), order)
    return f"{'=' * 80}\nMSG: ".join([_FIELDS[order[0]], *(f"{name}\n{_FIELDS[name]}" for name in order[1:])])


def _collect(name: str, order: list[str]) -> None:
    """Adds a message's name and those of its nested messages, depth first, each once."""
    order.append(name)
    for line in _FIELDS[name].splitlines():
        nested = line.split()[0].split("[")[0]
        if nested in _FIELDS and nested not in order:
            _collect(nested, order)


def ros1_definition(schema_name: str) -> str:
    """The `ros1msg` text of a message and of its nested messages."""
    parts = definition(schema_name).split(separator := f"{'=' * 80}\nMSG: ")
    known = [part.replace("builtin_interfaces/Time stamp", "uint32 seq\ntime stamp") for part in parts]
    return separator.join(part for part in known if not part.startswith("builtin_interfaces/Time"))


@lru_cache(4096)
def canonical(schema_name: str) -> str:
    """ROS 2 spelling of a name: of `sensor_msgs/Imu` and `sensor_msgs::msg::dds_::Imu_`."""
    if dds := DDS_NAME.fullmatch(schema_name):
        return f"{dds[1]}/msg/{dds[2]}"
    package, slash, name = schema_name.partition("/")
    return f"{package}/msg/{name}" if slash and "/" not in name else schema_name


# What a message is made of, in order. "count" heads a sequence whose elements are the rest of the shape.
SHAPES: dict[str, tuple[str | int, ...]] = {
    IMU: ("header", 37),
    POSE: ("header", 7),
    POSE_COVARIANCE: ("header", 7 + 36),
    VECTOR3: ("header", 3),
    TWIST: ("header", 6 + 36),
    TF: ("count", "header", "text", 7),
    TWIST_STAMPED: ("header", 6),
    **dict(zip(ACCELS, (("header", 6), ("header", 6 + 36)), strict=True)),
    FLOAT: (1,),
    ODOMETRY: ("header", "text", 7 + 36 + 6 + 36),
    TRANSFORM: ("header", "text", 7),
    IMAGE: ("header", "text", "bytes"),
}
# Where a gyroscope's or an accelerometer's vector stands among the numbers of a message: angular behind linear.
VECTORS = {VECTOR3: slice(0, 3), TWIST_STAMPED: slice(3, 6), TWIST: slice(3, 6), **dict.fromkeys(ACCELS, slice(0, 3))}
# Where the fields stand among the numbers of an Imu, and those of a pose.
ORIENTATION, ORIENTATION_COVARIANCE = slice(0, 4), slice(4, 13)
GYRO, GYRO_COVARIANCE = slice(13, 16), slice(16, 25)
ACCEL, ACCEL_COVARIANCE = slice(25, 28), slice(28, 37)
POSITION, XYZW = slice(0, 3), slice(3, 7)
TWIST_OF_ODOMETRY, TWIST_COVARIANCE = slice(43, 49), slice(49, 85)


@dataclass(frozen=True, slots=True)
class Layout:
    """Byte offsets of a message's fields, and the bytes that messages of one layout share."""

    order: str  # "<" or ">"
    seconds: str  # "i4" in ROS 2, "u4" in ROS 1
    size: int
    stamps: tuple[int, ...]
    numbers: tuple[tuple[int, int], ...]  # (first byte, float64s)
    texts: tuple[str, ...]
    constants: tuple[tuple[int, bytes], ...]
    data: tuple[int, int] | None = None  # (first byte, bytes) of an image

    def fits(self, message: bytes) -> bool:
        """Whether a message has this layout."""
        return len(message) >= self.size and all(message.startswith(value, at) for at, value in self.constants)


class ByteWalk:
    """Position in a message that is read (or, without one, written), moving by one field.

    `constants` are the bytes that another message must share to have the same layout.

    Raises:
        LogError: not plain CDR, an unknown encoding, or a message that ends before its fields do.
    """

    def __init__(self, encoding: str, message: bytes | None) -> None:
        self.message, self.ros1 = message, encoding == "ros1"
        self.order, self.start, self.is_second = "<", 0, False
        self.constants: list[tuple[int, bytes]] = []
        if encoding == "cdr":
            self.start = 4
            head = b"\0\1\0\0" if message is None else message[:4]
            if head[:2] not in (b"\0\0", b"\0\1", b"\0\6", b"\0\7"):
                raise LogError(f"payload starts with {head.hex(' ')}", expected=PLAIN)
            self.order, self.is_second = "<" if head[1] & 1 else ">", head[1] > 1
            self.constants.append((0, head[:2]))
        elif encoding != "ros1":
            raise LogError(f"message encoding {encoding!r} is not known", expected="cdr or ros1")
        self.position = self.start

    def align(self, size: int) -> None:
        """Move to the next place of a field of this size."""
        if not self.ros1:
            self.position += -(self.position - self.start) % (min(size, 4) if self.is_second else size)

    def delimiter(self) -> None:
        """Move behind the size of a list of texts or messages, which CDR has in its version 2."""
        if self.is_second:
            self.align(4)
            self.skip(4)

    def skip(self, size: int) -> int:
        """Move behind a field; return its place."""
        at, self.position = self.position, self.position + size
        if self.message is not None and self.position > len(self.message):
            raise LogError(f"payload of {len(self.message)} bytes ends before byte {self.position}")
        return at

    def word(self, value: int = 0) -> int:
        """A uint32 that every message of the layout shares."""
        self.align(4)
        at = self.skip(4)
        raw = struct.pack("<I", value) if self.message is None else self.message[at : at + 4]
        self.constants.append((at, raw))
        return int(struct.unpack(self.order + "I", raw)[0])


class _Walk(ByteWalk):
    """Walk whose texts are read, or given."""

    def __init__(self, encoding: str, message: bytes | None, texts: Sequence[str]) -> None:
        super().__init__(encoding, message)
        self.given, self.texts = list(texts), list[str]()

    def text(self) -> None:
        nul = b"" if self.ros1 else b"\0"
        given = self.given.pop(0).encode() + nul if self.message is None else b""
        length = self.word(len(given))
        at = self.skip(length)
        raw = given if self.message is None else self.message[at : at + length]
        self.constants.append((at, raw))
        self.texts.append(raw.removesuffix(b"\0").decode(errors="replace"))


def layout_of(
    schema_name: str, encoding: str, *, message: bytes | None = None, texts: Sequence[str] = (), data_size: int = 0
) -> Layout:
    """Layout of the given message, or of one to be written with the given texts.

    Raises:
        LogError: the message is shorter than its fields, or its encoding is not known.
    """
    walk, shape, count = _Walk(encoding, message, texts), SHAPES[schema_name], 1
    stamps: list[int] = []
    numbers: list[tuple[int, int]] = []
    data: tuple[int, int] | None = None
    if shape[0] == "count":
        walk.delimiter()
        shape, count = shape[1:], walk.word(len(texts) // 2)
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
    """Stretches of consecutive messages that share one layout: nearly always one stretch.

    Raises:
        LogError: a message is shorter than its fields, or the encoding is not known.
    """

    def look(message: bytes) -> tuple[Sequence[tuple[int, bytes]], Layout]:
        layout = layout_of(schema_name, encoding, message=message)
        return layout.constants, layout

    return stretches(rows, look)


def stretches(
    rows: UInt8[np.ndarray, "n L"], look: Callable[[bytes], tuple[Sequence[tuple[int, bytes]], Found]]
) -> Iterator[tuple[slice, Found]]:
    """Stretches of messages that share what `look` finds in the first: constants, and more."""
    pending = [(0, len(rows))] if len(rows) else []
    while pending:
        first, last = pending.pop()
        constants, found = look(rows[first].tobytes())
        differ = np.zeros(last - first - 1, bool)
        for at, value in constants:
            column = rows[first:last, at : at + len(value)]
            if (column != column[0]).any():
                differ |= (column[1:] != column[:-1]).any(axis=1)
        edges = [first, *(np.flatnonzero(differ) + first + 1).tolist(), last]
        yield slice(first, edges[1]), found
        pending += reversed(list(pairwise(edges[1:])))
