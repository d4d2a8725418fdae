"""ROS 1 bags of any robot: every topic arrives as CDR with its definition, in log-time order."""

from __future__ import annotations

import dataclasses
import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from imutool.converters import ros1_bag
from imutool.converters._ros_types import Ros1Types
from imutool.mcap_io.read import read

STORE = get_typestore(Stores.ROS1_NOETIC)
STORE.register(
    get_types_from_msg(
        "Header header\nmy_robot/wheel_state[] wheels\nstring[2] names\ntime when\nint8 K\nint32 wheelSpeed\nuint8 LEFT=1\n"
        "================================================================================\n"
        "MSG: my_robot/wheel_state\nfloat32 speed\nuint8[] raw\n",
        "my_robot/msg/Wheels",
    )
)
TYPES = STORE.types
START_NS = 1_600_000_000_123_456_789
Decoded = dict[str, list[tuple[int, Any]]]


def header(t_ns: int) -> Any:
    time = TYPES["builtin_interfaces/msg/Time"](sec=t_ns // 10**9, nanosec=t_ns % 10**9)
    return TYPES["std_msgs/msg/Header"](seq=3, stamp=time, frame_id="imu_link")


def vector(*values: float) -> Any:
    return TYPES["geometry_msgs/msg/Vector3"](*values)


def imu(t_ns: int, n: int) -> Any:
    turn = TYPES["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    none = np.zeros(9)
    return TYPES["sensor_msgs/msg/Imu"](header(t_ns), turn, none, vector(0.1, n, 0.3), none, vector(n, 0.5, 9.8), none)


def wheels(t_ns: int, n: int) -> Any:
    wheel = TYPES["my_robot/msg/wheel_state"](speed=float(n), raw=np.arange(n % 5, dtype=np.uint8))
    time = TYPES["builtin_interfaces/msg/Time"](sec=n, nanosec=7)
    return TYPES["my_robot/msg/Wheels"](header(t_ns), [wheel] * (n % 3), ["left", "right"], time, n % 100, -n)


def image(t_ns: int, n: int) -> Any:
    return TYPES["sensor_msgs/msg/Image"](header(t_ns), 2, 3, "mono8", 0, 3, np.full(6, n % 256, np.uint8))


def empty(t_ns: int, n: int) -> Any:
    return TYPES["std_msgs/msg/Empty"]()


def odometry(t_ns: int, n: int) -> Any:
    point = TYPES["geometry_msgs/msg/Point"](float(n), 0.0, 0.0)
    pose = TYPES["geometry_msgs/msg/Pose"](point, TYPES["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0))
    twist = TYPES["geometry_msgs/msg/Twist"](vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0))
    return TYPES["nav_msgs/msg/Odometry"](
        header(t_ns),
        "base",
        TYPES["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36)),
        TYPES["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36)),
    )


TOPICS = {
    "/mavros/imu/data": imu,
    "/camera/imu": imu,
    "/wheels": wheels,
    "/camera/image_raw": image,
    "/husky/odom": odometry,
    "/tick": empty,
}


def write_bag(path: Path, *, compression: Writer.CompressionFormat | None = None, count: int = 100) -> Path:
    """A bag in small chunks; the camera's messages arrive half a second late."""
    writer = Writer(path)
    writer.chunk_threshold = 4096
    if compression is not None:
        writer.set_compression(compression)
    with writer as bag:
        connections = {
            topic: bag.add_connection(topic, make(0, 0).__msgtype__, typestore=STORE) for topic, make in TOPICS.items()
        }
        for n in range(count):
            t_ns = START_NS + n * 5_000_000
            for topic, make in TOPICS.items():
                message = make(t_ns, n)
                arrival = t_ns - 500_000_000 if topic.startswith("/camera") else t_ns
                bag.write(connections[topic], arrival, STORE.serialize_ros1(message, message.__msgtype__))
    return path


def test_a_definition_with_the_fields_of_ros_in_another_order_keeps_its_names() -> None:
    text = STORE.generate_msgdef("sensor_msgs/msg/Imu", ros_version=1)[0]
    other = {"angular_velocity": "linear_acceleration", "linear_acceleration": "angular_velocity"}
    text = re.sub("|".join(other), lambda found: other[found[0]], text)
    topic, _ = Ros1Types().topic("/imu", "sensor_msgs/Imu", text)
    assert topic.schema.index(b"linear_acceleration") < topic.schema.index(b"angular_velocity")


def values(message: Any) -> list[Any]:
    """The values of a decoded message in order; the sequence number, which ROS 2 lacks, is left out."""
    if dataclasses.is_dataclass(message):
        names = [field.name for field in dataclasses.fields(message) if field.name != "LEFT"]  # a constant
    else:
        names = list(getattr(message, "__slots__", ()))
    if names:
        return [value for name in names if name not in ("seq", "__msgtype__") for value in values(getattr(message, name))]
    if isinstance(message, list | tuple | np.ndarray | bytes | memoryview):
        return [value for part in message for value in values(part)]
    return [message]


def decoded(log: Path) -> Decoded:
    """Log times and values by topic, read with the mcap library in log-time order."""
    found: Decoded = {}
    with log.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, content in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, values(content)))
    return found


def as_rosbags_reads(bag: Path) -> Decoded:
    found: Decoded = {}
    with AnyReader([bag]) as reader:
        for connection, t_ns, raw in reader.messages():
            content = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append((t_ns, values(content)))
    return found


@pytest.mark.parametrize("compression", [None, Writer.CompressionFormat.LZ4, Writer.CompressionFormat.BZ2], ids=str)
def test_every_topic_arrives_with_the_values_that_rosbags_reads(convert, tmp_path, compression):
    bag, log = write_bag(tmp_path / "run.bag", compression=compression), tmp_path / "run.mcap"
    done = convert(bag, log, "--json", "-")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["losses"] == []
    ours, theirs = decoded(log), as_rosbags_reads(bag)
    theirs["/tick"] = [(t_ns, [0]) for t_ns, _ in theirs["/tick"]]  # ROS 2 gives an empty message one byte
    ours["/tick"] = [(t_ns, [0]) for t_ns, _ in ours["/tick"]]
    assert ours == theirs
    with AnyReader([log], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        by_topic = {c.topic: c for c in reader.connections}
        assert {t: c.msgcount for t, c in by_topic.items()} == dict.fromkeys(TOPICS, 100)
        last = list(reader.messages([by_topic["/wheels"]]))[-1]
        assert reader.deserialize(last[2], "my_robot/msg/Wheels").wheel_speed == -99


def test_a_bag_is_known_by_its_content_and_keeps_its_messages_in_time_order(convert, tmp_path):
    bag, log = write_bag(tmp_path / "run.bag"), tmp_path / "run.mcap"
    bag = bag.rename(tmp_path / "recording")
    assert convert(bag, log).returncode == 0
    assert [t for t, _ in decoded(log)["/camera/imu"]] == [START_NS - 500_000_000 + n * 5_000_000 for n in range(100)]


def test_the_order_holds_across_chunks(tmp_path):
    source = ros1_bag.read_sequence(ros1_bag.sequences(write_bag(tmp_path / "run.bag"))[0])
    times = [message.log_time for message in source.messages()]
    assert times == sorted(times)
    assert len(times) == 100 * len(TOPICS)


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_publishers_of_one_topic_share_it_where_one_of_them_latches(convert, tmp_path, ending):
    definition, md5 = STORE.generate_msgdef("sensor_msgs/msg/Imu")
    form = {"msgdef": definition.replace("\n", ending), "md5sum": md5}
    with Writer(tmp_path / "two.bag") as bag:
        two = [bag.add_connection("/imu", "sensor_msgs/msg/Imu", callerid=f"/{n}", latching=n, **form) for n in (0, 1)]
        for n in range(20):
            t_ns = START_NS + n * 10_000_000
            bag.write(two[n % 2], t_ns, STORE.serialize_ros1(imu(t_ns, n), "sensor_msgs/msg/Imu"))
    done = convert(tmp_path / "two.bag", tmp_path / "two.mcap")
    assert (done.returncode, done.stderr.strip()) == (0, "")
    assert {topic: len(rows) for topic, rows in decoded(tmp_path / "two.mcap").items()} == {"/imu": 20}


def test_no_images_leaves_out_images_alone(convert, tmp_path):
    assert convert(write_bag(tmp_path / "run.bag"), tmp_path / "run.mcap", "--no-images").returncode == 0
    assert set(decoded(tmp_path / "run.mcap")) == set(TOPICS) - {"/camera/image_raw"}


def test_a_definition_nobody_understands_keeps_its_encoding_and_is_named(convert, tmp_path):
    bag = write_bag(tmp_path / "run.bag")
    bag.write_bytes(bag.read_bytes().replace(b"float32 speed\n", b"flo%t32 speed\n"))
    done = convert(bag, tmp_path / "run.mcap")
    assert done.returncode == 0
    assert "/wheels keeps the encoding of ROS 1" in done.stderr
    with (tmp_path / "run.mcap").open("rb") as file:
        encodings = {c.topic: (c.message_encoding, s.encoding) for s, c, _ in make_reader(file).iter_messages()}
    assert encodings["/wheels"] == ("ros1", "ros1msg")
    assert encodings["/camera/imu"] == ("cdr", "ros2msg")


def test_a_message_that_contradicts_its_type_is_kept_as_it_is_and_counted(convert, tmp_path):
    with Writer(tmp_path / "run.bag") as bag:
        connection = bag.add_connection("/a", "sensor_msgs/msg/Imu", typestore=STORE)
        bag.write(connection, START_NS, STORE.serialize_ros1(imu(START_NS, 1), "sensor_msgs/msg/Imu"))
        bag.write(connection, START_NS + 1, b"no message")
    done = convert(tmp_path / "run.bag", tmp_path / "run.mcap")
    assert done.returncode == 3
    assert "1 messages of /a contradict their type" in done.stderr
    with (tmp_path / "run.mcap").open("rb") as file:
        kept = {c.topic: m.data for _, c, m in make_reader(file).iter_messages()}
    assert kept["/a/untranslated"] == b"no message"


def test_a_cut_bag_gives_what_it_holds_and_says_so(convert, tmp_path):
    bag = write_bag(tmp_path / "run.bag")
    bag.write_bytes(bag.read_bytes()[:60_000])
    done = convert(bag, tmp_path / "run.mcap")
    assert done.returncode == 3
    assert "the bag has no index" in done.stderr
    theirs = as_rosbags_reads(write_bag(tmp_path / "whole.bag"))
    ours = decoded(tmp_path / "run.mcap")
    assert 10 < len(ours["/camera/imu"]) < 100
    assert all(message in theirs["/camera/imu"] for message in ours["/camera/imu"])


def test_without_rosbags_the_extra_is_named(convert, tmp_path, monkeypatch):
    bag = write_bag(tmp_path / "run.bag", count=3)
    for name in [n for n in sys.modules if n.partition(".")[0] == "rosbags"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    done = convert(bag, tmp_path / "run.mcap")
    assert done.returncode == 3
    assert "pip install 'imutool[bags]'" in done.stderr


def test_a_foreign_robot_gets_no_sensor_unless_the_user_names_it(convert, tmp_path):
    bag = write_bag(tmp_path / "run.bag", count=3)
    for options, sensor in (((), None), (("--sensor", "xsens"), "xsens")):
        assert convert(bag, tmp_path / "run.mcap", "--overwrite", *options).returncode == 0
        with (tmp_path / "run.mcap").open("rb") as file:
            (record,) = [r for r in make_reader(file).iter_metadata() if r.name == "imutool"]
        assert record.metadata.get("sensor") == sensor
        assert "dataset" not in record.metadata
    assert not [topic for topic in decoded(tmp_path / "run.mcap") if "ground_truth" in topic]


def test_a_kind_goes_to_the_poses_it_names(convert, tmp_path):
    bag = write_bag(tmp_path / "run.bag", count=3)
    done = convert(bag, tmp_path / "run.mcap", "--kind", "/husky/odom=estimate")
    assert done.returncode == 0, done.stderr
    wrong = convert(bag, tmp_path / "x.mcap", "--kind", "/husky/odometry=truth")
    assert wrong.returncode == 3
    assert "expected /husky/odom" in wrong.stderr
    assert "--kind" in wrong.stderr


def write_split_bag(path: Path, gyro_topic: str, accel_topic: str) -> Path:
    """A gyro at 200 Hz and an accelerometer at 62.5 Hz, two milliseconds late, each in messages with zeros for the other."""
    with Writer(path) as bag:
        gyro, accel = (bag.add_connection(topic, "sensor_msgs/msg/Imu", typestore=STORE) for topic in (gyro_topic, accel_topic))
        samples = [(START_NS + n * 5_000_000, gyro, vector(0.1, 0.001 * n, 0.3), vector(0.0, 0.0, 0.0)) for n in range(400)]
        for n in range(125):
            t_ns = START_NS + 2_000_000 + n * 16_000_000
            samples.append((t_ns, accel, vector(0.0, 0.0, 0.0), vector((t_ns - START_NS) * 1e-9, 0.5, 9.8)))
        for t_ns, connection, rate, force in sorted(samples, key=lambda sample: sample[0]):
            message = imu(t_ns, 0)
            message.angular_velocity, message.linear_acceleration = rate, force
            bag.write(connection, t_ns, STORE.serialize_ros1(message, message.__msgtype__))
    return path


@pytest.mark.parametrize(
    ("topics", "options", "whole"),
    [
        (("/camera/gyro/sample", "/camera/accel/sample"), (), "/camera/imu"),
        (("/device_0/sensor_2/Gyro_0/imu/data", "/device_0/sensor_2/Accel_0/imu/data"), (), "/device_0/sensor_2/imu"),
        (("/a", "/b"), ("--imu", "gyro=/a,accel=/b"), "/imu"),
    ],
)
def test_a_gyro_and_an_accelerometer_of_their_own_become_one_imu(convert, tmp_path, topics, options, whole):
    done = convert(write_split_bag(tmp_path / "run.bag", *topics), tmp_path / "run.mcap", *options)
    assert done.returncode == 0, done.stderr
    assert "gyro at 200.0 Hz and accelerometer at 62.5 Hz became one IMU" in done.stderr
    recording = read(tmp_path / "run.mcap")  # the only IMU: the two sensors are its parts
    assert recording.imu_topic == whole
    t_s = (recording.imu.t_ns - START_NS) * 1e-9
    np.testing.assert_allclose(recording.imu.accel[:, 0], t_s, atol=1e-9)
    np.testing.assert_allclose(recording.imu.gyro[:, 1], 0.001 * t_s / 0.005, atol=1e-9)
    assert [len(decoded(tmp_path / "run.mcap")[topic]) for topic in topics] == [400, 125]
