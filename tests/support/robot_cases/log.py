"""Logs of robots for blind cases, as ROS 2 messages in MCAP."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from mcap.writer import CompressionType, Writer

START_NS = 1_700_000_000_000_000_000
Numbers = Float64[np.ndarray, "_ _"]
SEPARATOR = "=" * 80
HEADER = (
    f"{SEPARATOR}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    f"{SEPARATOR}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
VECTOR = f"{SEPARATOR}\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
POSE = (
    f"{SEPARATOR}\nMSG: geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
    f"{SEPARATOR}\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
    f"{SEPARATOR}\nMSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
)
ODOMETRY = (
    "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
    "geometry_msgs/TwistWithCovariance twist\n"
    f"{SEPARATOR}\nMSG: geometry_msgs/PoseWithCovariance\ngeometry_msgs/Pose pose\nfloat64[36] covariance\n"
    f"{SEPARATOR}\nMSG: geometry_msgs/TwistWithCovariance\ngeometry_msgs/Twist twist\nfloat64[36] covariance\n"
    f"{SEPARATOR}\nMSG: geometry_msgs/Twist\ngeometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n"
)
DEFINITIONS = {
    "sensor_msgs/msg/JointState": (
        f"std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n{HEADER}"
    ),
    "sensor_msgs/msg/MagneticField": (
        f"std_msgs/Header header\ngeometry_msgs/Vector3 magnetic_field\nfloat64[9] magnetic_field_covariance\n{VECTOR}{HEADER}"
    ),
    "sensor_msgs/msg/FluidPressure": f"std_msgs/Header header\nfloat64 fluid_pressure\nfloat64 variance\n{HEADER}",
    "sensor_msgs/msg/Temperature": f"std_msgs/Header header\nfloat64 temperature\nfloat64 variance\n{HEADER}",
    "sensor_msgs/msg/Range": (
        "uint8 ULTRASOUND=0\nuint8 INFRARED=1\nstd_msgs/Header header\nuint8 radiation_type\nfloat32 field_of_view\n"
        f"float32 min_range\nfloat32 max_range\nfloat32 range\n{HEADER}"
    ),
    "sensor_msgs/msg/NavSatFix": (
        "std_msgs/Header header\nsensor_msgs/NavSatStatus status\nfloat64 latitude\nfloat64 longitude\nfloat64 altitude\n"
        "float64[9] position_covariance\nuint8 position_covariance_type\n"
        f"{SEPARATOR}\nMSG: sensor_msgs/NavSatStatus\nint8 status\nuint16 service\n{HEADER}"
    ),
    "nav_msgs/msg/Odometry": f"{ODOMETRY}{POSE}{VECTOR}{HEADER}",
    "geometry_msgs/msg/PoseStamped": f"std_msgs/Header header\ngeometry_msgs/Pose pose\n{POSE}{HEADER}",
    "std_msgs/msg/Float64": "float64 data\n",
}


class _Cdr:
    """Little-endian CDR, each number aligned to its own size."""

    def __init__(self) -> None:
        self.data = bytearray(b"\0\1\0\0")

    def number(self, kind: str, *values: float | int) -> None:
        if values:
            self.data += b"\0" * (-(len(self.data) - 4) % struct.calcsize(kind)) + struct.pack(f"<{len(values)}{kind}", *values)

    def text(self, value: str) -> None:
        self.number("I", len(value) + 1)
        self.data += value.encode() + b"\0"

    def header(self, t_ns: int, frame: str = "") -> None:
        self.number("i", t_ns // 10**9)
        self.number("I", t_ns % 10**9)
        self.text(frame)


def _message(kind: str, t_ns: int, row: Sequence[float], names: Sequence[str]) -> bytes:
    out = _Cdr()
    if kind == "std_msgs/msg/Float64":
        out.number("d", *row)
        return bytes(out.data)
    out.header(t_ns)
    match kind.rpartition("/")[2]:
        case "JointState":
            n = len(names)
            out.number("I", n)
            for name in names:
                out.text(name)
            for part in (row[:n], row[n : 2 * n], row[2 * n :]):
                out.number("I", len(part))
                out.number("d", *part)
        case "Range":
            out.number("B", 0)
            out.number("f", 0.1, 0.02, 10.0, *row)
        case "NavSatFix":
            out.number("b", 0)
            out.number("H", 1)
            out.number("d", *row, *[0.0] * 9)
            out.number("B", 0)
        case "Odometry":
            out.text("base")
            out.number("d", *row[:7], *[0.0] * 36, *row[7:], *[0.0] * 36)
        case "MagneticField":
            out.number("d", *row, *[0.0] * 9)
        case "PoseStamped":
            out.number("d", *row)
        case _:
            out.number("d", *row, 0.0)
    return bytes(out.data)


def write(path: Path, topics: Mapping[str, tuple[str, Float64[np.ndarray, " _"], Numbers]], names: Sequence[str] = ()) -> None:
    """Write topics as (message, seconds, rows of numbers).

    Joints have positions, velocities and efforts in a row.
    """
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="imutool blind cases")
        messages = []
        for topic, (kind, t_s, rows) in topics.items():
            schema = writer.register_schema(kind, "ros2msg", DEFINITIONS[kind].encode())
            channel = writer.register_channel(topic, "cdr", schema)
            stamps = START_NS + np.round(np.asarray(t_s) * 1e9).astype(np.int64)
            messages += [
                (int(t), channel, _message(kind, int(t), row, names)) for t, row in zip(stamps, rows.tolist(), strict=True)
            ]
        for k, (t_ns, channel, data) in enumerate(sorted(messages, key=lambda entry: entry[0])):
            writer.add_message(channel, t_ns, data, t_ns, k)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap has no annotation for it
