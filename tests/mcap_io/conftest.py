"""Recordings to write, and logs that other writers made: the layouts and encodings a user's own logs come in."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from imutool.recording import Frames, Imu, Poses, Recording, Scalars

START_NS = 1_403_638_128_245_096_960  # in EuRoC's MH_04: its low digits are what float seconds would lose
COUNT = 4000  # more than one chunk of IMU messages
PERIOD_NS = 5_000_000
IMAGES = [(START_NS + 7 + 50_000_000 * i, bytes([i]) * (200_000 + i)) for i in range(12)]

LAYOUTS: dict[str, dict[str, Any]] = {
    "zstd": {"compression": CompressionType.ZSTD},
    "lz4": {"compression": CompressionType.LZ4},
    "plain": {"compression": CompressionType.NONE},
    "data-crc": {"compression": CompressionType.ZSTD, "enable_data_crcs": True},
    "no-message-index": {"index_types": IndexType.CHUNK | IndexType.ATTACHMENT | IndexType.METADATA},
    "no-index": {"index_types": IndexType.NONE},
    "no-definitions-in-summary": {"repeat_channels": False, "repeat_schemas": False},
    "no-schemas-in-summary": {"repeat_schemas": False},
    "no-statistics": {"use_statistics": False},
    "no-summary": {
        "index_types": IndexType.NONE,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_statistics": False,
        "use_summary_offsets": False,
    },
    "no-summary-but-message-index": {
        "index_types": IndexType.MESSAGE,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_statistics": False,
        "use_summary_offsets": False,
    },
    "unchunked": {"use_chunking": False},
    "unchunked-no-summary": {
        "use_chunking": False,
        "index_types": IndexType.NONE,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_statistics": False,
        "use_summary_offsets": False,
    },
}

ROS2 = get_typestore(Stores.ROS2_HUMBLE)
ROS1 = get_typestore(Stores.ROS1_NOETIC)
TRANSFORMS = "geometry_msgs/TransformStamped[] transforms\n"
ROS1.register(get_types_from_msg(TRANSFORMS, "tf2_msgs/msg/TFMessage"))  # noetic ships it apart from the common types


def unit(rng: np.random.Generator, count: int) -> np.ndarray:
    q = rng.normal(size=(count, 4))
    return q / np.linalg.norm(q, axis=1)[:, None]


@pytest.fixture(params=LAYOUTS)
def layout(request: pytest.FixtureRequest) -> str:
    """Every way another writer may lay out a log."""
    return str(request.param)


@pytest.fixture(scope="session")
def recording() -> Recording:
    """Everything a recording can hold, several chunks long."""
    rng = np.random.default_rng(7)
    t_ns = START_NS + PERIOD_NS * np.arange(COUNT)
    few = t_ns[::4] + 11
    truths = {
        "/ground_truth/pose": Poses(few, rng.normal(size=(len(few), 3)), unit(rng, len(few)), rng.normal(size=(len(few), 3))),
        "/ground_truth_recomputed/pose": Poses(t_ns[5::40], rng.normal(size=(100, 3)), unit(rng, 100)),
    }
    scalars = {
        "/imu0/temperature": Scalars(t_ns[::50], rng.normal(size=(80, 1)), "degC"),
        "/magnetometer": Scalars(t_ns[3::10], rng.normal(size=(400, 3)), "T"),
    }
    frames = {"/cam0/image_raw/compressed": Frames("png", len(IMAGES), lambda: iter(IMAGES))}
    metadata = {"sensor": {"gyro_noise": "1.7e-4", "name": "ADIS16448"}, "empty": {}}
    imu = Imu(t_ns, rng.normal(size=(COUNT, 3)), rng.normal(size=(COUNT, 3)))
    return Recording("MH_04", imu, truths, scalars, frames, metadata, source="MH_04.zip")


Message = tuple[str, str, int, int, int, bytes]  # topic, type, log time, publish time, sequence, payload


def header(store: Any, stamp_ns: int, frame_id: str) -> Any:
    time = store.types["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9)
    extra = {"seq": 0} if store is ROS1 else {}
    return store.types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id, **extra)


def vector(store: Any, values: np.ndarray, kind: str = "Vector3") -> Any:
    return store.types[f"geometry_msgs/msg/{kind}"](*map(float, values))


def quaternion(store: Any, wxyz: np.ndarray) -> Any:
    w, x, y, z = map(float, wxyz)
    return store.types["geometry_msgs/msg/Quaternion"](x, y, z, w)


@pytest.fixture(scope="session")
def make() -> Callable[..., bytes]:
    """The payload of one message as rosbags serialises it, in CDR or as ROS 1 does."""

    def build(kind: str, stamp_ns: int, *values: Any, ros1: bool = False, frames: tuple[str, str] = ("a", "b")) -> bytes:
        store = ROS1 if ros1 else ROS2
        types, head = store.types, header(store, stamp_ns, frames[0])
        if kind == "sensor_msgs/msg/Imu":
            gyro, accel = values
            covariance = np.arange(9.0)
            orientation = quaternion(store, np.array([1.0, 0, 0, 0]))
            fields = (head, orientation, covariance, vector(store, gyro), covariance, vector(store, accel), covariance)
            message = types[kind](*fields)
        elif kind == "geometry_msgs/msg/PoseStamped":
            pose = types["geometry_msgs/msg/Pose"](vector(store, values[0], "Point"), quaternion(store, values[1]))
            message = types[kind](head, pose)
        elif kind == "geometry_msgs/msg/PoseWithCovarianceStamped":
            pose = types["geometry_msgs/msg/Pose"](vector(store, values[0], "Point"), quaternion(store, values[1]))
            message = types[kind](head, types["geometry_msgs/msg/PoseWithCovariance"](pose, np.arange(36.0)))
        elif kind == "nav_msgs/msg/Odometry":
            pose = types["geometry_msgs/msg/Pose"](vector(store, values[0], "Point"), quaternion(store, values[1]))
            twist = types["geometry_msgs/msg/Twist"](vector(store, np.ones(3)), vector(store, np.ones(3)))
            with_pose = types["geometry_msgs/msg/PoseWithCovariance"](pose, np.arange(36.0))
            with_twist = types["geometry_msgs/msg/TwistWithCovariance"](twist, np.arange(36.0))
            message = types[kind](head, frames[1], with_pose, with_twist)
        elif kind in ("geometry_msgs/msg/TransformStamped", "tf2_msgs/msg/TFMessage"):
            each = []
            for p, q, child in values if kind.startswith("tf2") else [(*values, frames[1])]:
                transform = types["geometry_msgs/msg/Transform"](vector(store, p), quaternion(store, q))
                each.append(types["geometry_msgs/msg/TransformStamped"](head, child, transform))
            message = types[kind](each) if kind.startswith("tf2") else each[0]
        elif kind == "geometry_msgs/msg/Vector3Stamped":
            message = types[kind](head, vector(store, values[0]))
        elif kind == "std_msgs/msg/Float64":
            message = types[kind](float(values[0]))
        else:
            raise AssertionError(kind)
        return bytes(store.serialize_ros1(message, kind) if ros1 else store.serialize_cdr(message, kind))

    return build


@pytest.fixture
def foreign(tmp_path: Path) -> Callable[..., Path]:
    """A log that the `mcap` package wrote from given messages, in a given layout."""

    def build(
        messages: list[Message],
        layout: str = "zstd",
        *,
        ros1: bool = False,
        encoding: str = "",
        name: str = "foreign",
        chunk_size: int = 100_000,
        metadata: Mapping[str, dict[str, str]] | None = None,
        attachments: tuple[bytes, ...] = (),
        comment: str = "",
    ) -> Path:
        path = tmp_path / f"{name}.mcap"
        store = ROS1 if ros1 else ROS2
        with path.open("wb") as file:
            writer = Writer(file, chunk_size=chunk_size, **LAYOUTS[layout])
            writer.start("ros1" if ros1 else "ros2")
            channels: dict[str, int] = {}
            for number, (topic, kind, log_time, publish_time, sequence, payload) in enumerate(messages):
                if topic not in channels:
                    text, _ = store.generate_msgdef(kind, ros_version=1 if ros1 else 2)
                    name_ = kind.replace("/msg/", "/") if ros1 else kind
                    schema = writer.register_schema(name_, "ros1msg" if ros1 else "ros2msg", (comment + text).encode())
                    own = encoding or ("ros1" if ros1 else "cdr")
                    channels[topic] = writer.register_channel(topic, own, schema, {"frame": "x"})
                writer.add_message(channels[topic], log_time, payload, publish_time, sequence)
                if number == len(messages) // 2:
                    for data in attachments:
                        writer.add_attachment(5, 6, "notes.txt", "text/plain", data)
            for key, values in (metadata or {}).items():
                writer.add_metadata(key, values)
            writer.finish()
        return path

    return build


@pytest.fixture
def flight(make: Callable[..., bytes]) -> list[Message]:
    """An IMU and poses and another topic on clocks of their own, as a robot's recorder would mix them."""
    rng = np.random.default_rng(3)
    messages: list[Message] = []
    for i in range(900):
        stamp = START_NS + PERIOD_NS * i
        payload = make("sensor_msgs/msg/Imu", stamp, rng.normal(size=3), rng.normal(size=3), frames=("imu", ""))
        messages.append(("/imu/data", "sensor_msgs/msg/Imu", stamp + 1_000_000, stamp + 900_000, 40 + i, payload))
        if i % 9 == 0:
            pose = make("geometry_msgs/msg/PoseStamped", stamp, rng.normal(size=3), unit(rng, 1)[0], frames=("map", ""))
            messages.append(("/mocap", "geometry_msgs/msg/PoseStamped", stamp + 1_000_001, stamp, i, pose))
        if i % 5 == 0:
            value = make("std_msgs/msg/Float64", stamp, rng.normal())
            messages.append(("/height", "std_msgs/msg/Float64", stamp + 1_000_002, stamp, i, value))
    return messages
