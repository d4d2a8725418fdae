"""Any number of any message, read by its path from logs that other writers made, bit for bit."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
from mcap_ros2.writer import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from imutool.diagnosis.signals.ideal_signal import SignalPair
from imutool.diagnosis.signals.signal_diagnosis import diagnose_signal
from imutool.errors import LogError
from imutool.mcap_io.codec import ros2_definition, schemas
from imutool.mcap_io.fields import numeric_fields, others, read_field
from imutool.mcap_io.log import Log
from imutool.mcap_io.repair import repair

START_NS = 1_700_000_000_123_456_789
PERIOD_NS = 20_000_000
COUNT = 300
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
ODOMETRY, JOINTS = "nav_msgs/msg/Odometry", "sensor_msgs/msg/JointState"
JOINT_NAMES = ["hip", "knee_left", "ankle"]


def header(stamp_ns: int, frame_id: str) -> dict[str, Any]:
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame_id}


def odometry(stamp_ns: int, twist: np.ndarray, frame_id: str = "odom") -> dict[str, Any]:
    x, y, z, *w = map(float, twist)
    return {
        "header": header(stamp_ns, frame_id),
        "child_frame_id": "base",
        "pose": {
            "pose": {"position": {"x": 1.0, "y": 2.0, "z": 3.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}},
            "covariance": [0.5] * 36,
        },
        "twist": {
            "twist": {"linear": {"x": x, "y": y, "z": z}, "angular": dict(zip("xyz", w, strict=True))},
            "covariance": [0.25] * 36,
        },
    }


def joints(stamp_ns: int, position: np.ndarray, effort: np.ndarray) -> dict[str, Any]:
    return {
        "header": header(stamp_ns, ""),
        "name": JOINT_NAMES[: len(position)],
        "position": [float(v) for v in position],
        "velocity": [],
        "effort": [float(v) for v in effort],
    }


def write(path: Path, messages: list[tuple[str, str, int, dict[str, Any]]], **options: Any) -> Path:
    """Messages (topic, type, log time, fields) as mcap-ros2-support serialises them."""
    with path.open("wb") as file:
        writer = Ros2Writer(file, **options)
        schemas = {}
        for topic, kind, log_time, message in messages:
            if kind not in schemas:
                schemas[kind] = writer.register_msgdef(kind, ROS2.generate_msgdef(kind, ros_version=2)[0])
            writer.write_message(topic, schemas[kind], message, log_time=log_time, publish_time=log_time)
        writer.finish()
    return path


@pytest.fixture
def robot(tmp_path: Path) -> tuple[Path, np.ndarray, np.ndarray, np.ndarray]:
    """A log with odometry (frame names of changing length) and joints, 5 ms apart, and what is in it."""
    rng = np.random.default_rng(1)
    twist, position, effort = rng.normal(size=(COUNT, 6)), rng.normal(size=(COUNT, 3)), rng.normal(size=(COUNT, 3))
    messages = []
    for i in range(COUNT):
        stamp = START_NS + i * PERIOD_NS
        frame = "odom" if i % 7 else "odometry"
        messages.append(("/odom", ODOMETRY, stamp + 3_000_000, odometry(stamp, twist[i], frame)))
        messages.append(("/joint_states", JOINTS, stamp + 9_000_000, joints(stamp + 5_000_000, position[i], effort[i])))
    return write(tmp_path / "robot.mcap", messages, chunk_size=20_000), twist, position, effort


def test_numbers_come_back_bit_for_bit_with_the_headers_stamps(
    robot: tuple[Path, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    path, twist, position, effort = robot
    signals = ["/odom.twist.twist.angular.z", "/joint_states.position[2]", "/joint_states.effort[0]"]
    found = {signal: read_field(path, signal) for signal in signals}
    stamps = START_NS + PERIOD_NS * np.arange(COUNT)
    assert np.array_equal(found["/odom.twist.twist.angular.z"].t_ns, stamps)
    assert np.array_equal(found["/odom.twist.twist.angular.z"].values, twist[:, 5])
    assert np.array_equal(found["/joint_states.position[2]"].t_ns, stamps + 5_000_000)
    assert np.array_equal(found["/joint_states.position[2]"].values, position[:, 2])
    assert np.array_equal(found["/joint_states.effort[0]"].values, effort[:, 0])


def test_element_of_a_fixed_array_and_of_an_array_of_messages(tmp_path: Path) -> None:
    transform = {"translation": {"x": 1.0, "y": 2.0, "z": 3.0}, "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    message = {
        "transforms": [
            {"header": header(START_NS, "a"), "child_frame_id": "bcd", "transform": transform},
            {
                "header": header(START_NS, "abcd"),
                "child_frame_id": "e",
                "transform": {**transform, "translation": {"x": 7.0, "y": 8.0, "z": 9.0}},
            },
        ]
    }
    rows = [("/tf", "tf2_msgs/msg/TFMessage", START_NS + i, message) for i in range(3)]
    rows += [("/odom", ODOMETRY, START_NS + i, odometry(START_NS + i, np.zeros(6))) for i in range(3)]
    path = write(tmp_path / "tf.mcap", rows)
    one = read_field(path, "/tf.transforms[1].transform.translation.y")
    assert one.values.tolist() == [8.0] * 3
    assert one.t_ns.tolist() == [START_NS + i for i in range(3)]  # no header of its own: the log's time
    assert read_field(path, "/odom.pose.covariance[35]").values.tolist() == [0.5] * 3


EVERY = (
    "bool a\nint8 b\nuint8 c\nint16 d\nuint16 e\nstring s\nint32 f\nuint32 g\n"
    "int64 h\nuint64 i\nfloat32 j\nfloat64 k\nbyte l\nchar m\n"
)


@settings(max_examples=40, deadline=None)
@given(
    st.tuples(
        st.booleans(),
        st.integers(-128, 127),
        st.integers(0, 255),
        st.integers(-(2**15), 2**15 - 1),
        st.integers(0, 2**16 - 1),
        st.text(max_size=9).filter(lambda s: "\0" not in s and all(not 0xD800 <= ord(c) < 0xE000 for c in s)),
        st.integers(-(2**31), 2**31 - 1),
        st.integers(0, 2**32 - 1),
        st.integers(-(2**53), 2**53),
        st.integers(0, 2**53),
        st.floats(width=32, allow_nan=False, allow_infinity=False),
        st.floats(allow_nan=False, allow_infinity=False),
        st.integers(0, 255),
        st.integers(0, 127),  # above, that library takes a char for signed; ROS 2 says uint8
    )
)
def test_every_kind_of_number_lies_where_the_other_library_writes_it(
    tmp_path_factory: pytest.TempPathFactory, row: Any
) -> None:
    names = "abcdesfghijklm"
    path = tmp_path_factory.mktemp("every") / "every.mcap"
    with path.open("wb") as file:
        writer = Ros2Writer(file)
        schema = writer.register_msgdef("ours/msg/Every", EVERY)
        writer.write_message("/every", schema, dict(zip(names, row, strict=True)), log_time=START_NS)
        writer.finish()
    numbers = [name for name in names if name != "s"]
    found = {f"/every.{name}": read_field(path, f"/every.{name}") for name in numbers}
    assert [found[f"/every.{name}"].values[0] for name in numbers] == [
        float(value) for name, value in zip(names, row, strict=True) if name != "s"
    ]


@pytest.mark.parametrize(
    ("signal", "says"),
    [
        ("/odom.twist.twist.linear.q", "twist.twist.linear.x"),
        ("/odom.twist.twist.linear", "twist.twist.linear.y"),
        ("/odom.child_frame_id", "pose.pose.position.x"),
        ("/joint_states.position[3]", "position[2]"),
        ("/joint_states.position", "position[0]"),
        ("/joint_states", "position[0]"),
        ("/imu.x", "/joint_states (sensor_msgs/msg/JointState)"),
        ("/odom.twist..x", "names and dots"),
        ("/joint_states.position[-1]", "names and dots"),
    ],
)
def test_a_wrong_name_is_refused_with_the_names_there_are(
    robot: tuple[Path, np.ndarray, np.ndarray, np.ndarray], signal: str, says: str
) -> None:
    with pytest.raises(LogError) as raised:
        read_field(robot[0], signal)
    assert says in str(raised.value)
    assert str(robot[0]) in str(raised.value)


def test_the_nearest_name_is_suggested(robot: tuple[Path, np.ndarray, np.ndarray, np.ndarray]) -> None:
    with pytest.raises(LogError, match=r"Did you mean /odom\.twist\.twist\.linear\.x\?"):
        read_field(robot[0], "/odom.twist.twist.liner.x")


def test_fields_are_listed_without_stamps(robot: tuple[Path, np.ndarray, np.ndarray, np.ndarray]) -> None:
    with Log(robot[0]) as log:
        assert numeric_fields(log, "/joint_states") == [f"{k}[{i}]" for k in ("position", "effort") for i in range(3)]
        assert [name for name in numeric_fields(log, "/odom") if "covariance" not in name][-1] == "twist.twist.angular.z"


def test_others_are_what_varies_but_the_signal_and_covariances(robot: tuple[Path, np.ndarray, np.ndarray, np.ndarray]) -> None:
    path, twist, *_ = robot
    found = others(path, "/odom.twist.twist.linear.x")
    expected = {f"/odom.twist.twist.{k}.{a}" for k in ("linear", "angular") for a in "xyz"} - {"/odom.twist.twist.linear.x"}
    expected |= {f"/joint_states.{k}[{i}]" for k in ("position", "effort") for i in range(3)}
    assert set(found) == expected
    assert np.array_equal(found["/odom.twist.twist.linear.y"].values, twist[:, 1])
    assert len(others(path, "/odom.twist.twist.linear.x", maximum=4)) == 4


def test_a_joint_that_goes_missing_is_refused_and_is_no_channel(tmp_path: Path) -> None:
    rows = [
        ("/j", JOINTS, START_NS + i, joints(START_NS + i, np.arange(3 if i < 5 else 2) + 0.1 * i, np.zeros(0)))
        for i in range(9)
    ]
    path = write(tmp_path / "missing.mcap", rows)
    assert len(read_field(path, "/j.position[1]")) == 9
    with pytest.raises(LogError, match=r"no number position\[2\]"):
        read_field(path, "/j.position[2]")
    assert set(others(path, "/j.position[0]")) == {"/j.position[1]"}


@pytest.mark.parametrize(("value", "stamp"), [(np.nan, 1), (np.inf, 1), (0.0, 0)])
def test_values_that_are_not_finite_and_stamps_that_stand_still_are_refused(tmp_path: Path, value: float, stamp: int) -> None:
    twist = np.zeros((9, 6))
    twist[4, 0] = value
    rows = [("/odom", ODOMETRY, START_NS + i, odometry(START_NS + i * stamp, twist[i])) for i in range(9)]
    path = write(tmp_path / "bad.mcap", rows)
    with pytest.raises(LogError, match="message 4" if stamp else "repeats"):
        read_field(path, "/odom.twist.twist.linear.x")


def test_stamps_that_were_never_set_give_way_to_the_logs_times(tmp_path: Path) -> None:
    rows = [("/odom", ODOMETRY, START_NS + i, odometry(0, np.zeros(6))) for i in range(9)]
    path = write(tmp_path / "unset.mcap", rows)
    assert read_field(path, "/odom.twist.twist.linear.x").t_ns.tolist() == [START_NS + i for i in range(9)]


HEADER = b"=" * 80 + b"\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"


def test_a_header_behind_the_numbers_gives_its_stamp(tmp_path: Path) -> None:
    payload = struct.pack("<IdiII", 0x100, 1.5, 20, 7, 1) + b"\0"
    path = raw(tmp_path / "late.mcap", b"float64 a\nstd_msgs/Header header\n" + HEADER, payload)
    found = read_field(path, "/a.a")
    assert (found.t_ns.tolist(), found.values.tolist()) == ([20 * 10**9 + 7], [1.5])


@pytest.mark.parametrize(
    ("second", "is_read"), [(b"float64 a # metres\n\nfloat64 b\n", True), (b"float64 b\nfloat64 a\n", False)]
)
def test_two_definitions_of_a_topics_messages_are_never_mistaken_for_one(tmp_path: Path, second: bytes, is_read: bool) -> None:
    with (tmp_path / "merged.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        for n, definition in enumerate((b"float64 a\nfloat64 b\n", second)):
            channel = writer.register_channel("/a", "cdr", writer.register_schema("a/msg/A", "ros2msg", definition))
            writer.add_message(channel, START_NS + n, struct.pack("<Idd", 0x100, 1.0, 2.0), START_NS + n)
        writer.finish()
    if is_read:
        assert read_field(tmp_path / "merged.mcap", "/a.a").values.tolist() == [1.0, 1.0]
        return
    with pytest.raises(LogError, match="two definitions of a/msg/A are on /a"):
        read_field(tmp_path / "merged.mcap", "/a.a")


@pytest.mark.parametrize("name", ["a/msg/RawImu", schemas.IMU])
def test_two_layouts_of_an_imu_s_messages_are_never_mistaken_for_one(tmp_path: Path, name: str) -> None:
    """The gyro of the first log was read as the accelerometer, and then no command read the rest of the log."""
    texts = [b"float64[3] gyro\nfloat64[3] accel\n", b"float64[3] accel\nfloat64[3] gyro\n"]
    if name == schemas.IMU:
        whole = schemas.definition(schemas.IMU)
        swapped = whole.replace(" angular_velocity", " @").replace(" linear_acceleration", " angular_velocity")
        texts = [swapped.replace(" @", " linear_acceleration").encode(), whole.encode()]
    with (tmp_path / "merged.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        for n, definition in enumerate(texts):
            channel = writer.register_channel("/imu", "cdr", writer.register_schema(name, "ros2msg", definition))
            writer.add_message(channel, START_NS + n, struct.pack("<I6d", 0x100, *range(6)), START_NS + n)
        writer.finish()
    with Log(tmp_path / "merged.mcap") as log, pytest.raises(LogError, match=r"carries .* \(two definitions\)"):
        log.topic("/imu", (schemas.IMU,))
    assert repair(tmp_path / "merged.mcap", tmp_path / "saved.mcap").messages == {"/imu": 2}


def raw(path: Path, definition: bytes, payload: bytes, *, name: str = "a/msg/A", language: str = "ros2msg") -> Path:
    """A log with one message of any definition and bytes."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start("ros2")
        schema = writer.register_schema(name, language, definition)
        channel = writer.register_channel("/a", "cdr", schema)
        writer.add_message(channel, START_NS, payload, START_NS)
        writer.finish()
    return path


CDR = b"\0\1\0\0"
LINE = b"\n" + b"=" * 80 + b"\nMSG: "
NESTED = (
    b"a/B0 b\nfloat64 x\n" + b"".join(LINE + b"a/B%d\na/B%d c\n" % (i, i + 1) for i in range(60)) + LINE + b"a/B60\nint8 z\n"
)
LEVEL = [b"".join(b"a/B%d f%d\n" % (i, j) for j in range(100)) + LINE + b"a/B%d\n" % i for i in range(20)]
WIDE = b"".join(LEVEL)  # 100^20 fields


@pytest.mark.parametrize(
    ("definition", "payload", "says"),
    [
        (b"a/A inner\nfloat64 x\n", CDR + bytes(64), "deep"),
        (b"a/B b\nfloat64 x\n" + LINE + b"a/B\na/A a\n", CDR + bytes(64), "deep"),
        (NESTED, CDR + bytes(64), "deep"),
        (WIDE + b"int8 z\n", CDR + bytes(64), "a count of|ends before"),
        (b"a/Missing m\nfloat64 x\n", CDR + bytes(64), "a/Missing is not defined"),
        (b"string s\nfloat64 x\n", CDR + b"\xff\xff\xff\x7f" + bytes(8), "ends before"),
        (b"string[] s\nfloat64 x\n", CDR + b"\xff\xff\xff\x7f" + bytes(8), "a count of 2147483647"),
        (b"float64[] s\nfloat64 x\n", CDR + b"\xff\xff\xff\xff" + bytes(8), "ends before"),
        (b"float64[999999999999999999] s\nfloat64 x\n", CDR + bytes(64), "ends before"),
        (b"string[100000] s\nfloat64 x\n", CDR + bytes(400_000), "texts and counts"),
        (b"wstring s\nfloat64 x\n", CDR + bytes(64), "wide string"),
        (b"float64 x\n", b"", "plain CDR"),
        (b"float64 x\n", b"\0\x09\0\0" + bytes(8), "plain CDR"),
        (b"float64 x\n", CDR + bytes(5), "ends before"),
        (b"what is? this\n", CDR + bytes(8), "has the line 'what is"),
        (b"\xff\xfe\0", CDR + bytes(8), "has the line"),
        (b"float64 x\n" * 200_000, CDR + bytes(8), "bytes"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_hostile_definitions_and_messages_are_refused_in_bounded_work(
    tmp_path: Path, definition: bytes, payload: bytes, says: str
) -> None:
    path = raw(tmp_path / "hostile.mcap", definition, payload)
    with pytest.raises(LogError, match=says):
        read_field(path, "/a.x")
    assert others(path, "/b.x") == {}


@settings(max_examples=150, deadline=None)
@given(st.binary(max_size=120), st.binary(max_size=60))
@example(b"=", b"")  # a separator with nothing after it
def test_random_definitions_and_payloads_raise_nothing_but_our_own(definition: bytes, payload: bytes) -> None:
    size = len(payload)
    with suppress(LogError):
        for leaf in ros2_definition.Walk(
            CDR + payload, ros2_definition.parse("a/msg/A", b"float64[] q\n" + definition)
        ).leaves():
            assert 4 <= leaf.offset <= leaf.offset + int(leaf.kind[1]) * (leaf.length or 0) <= 4 + size


def test_definitions_are_read_as_ros_writes_them() -> None:
    text = b"""
# a comment
int32 LIMIT=5     # a constant
string NAME = "a"
Header header
float64[<=3] few  # bounded
string<=10 short
int16 with_default 7
Inner[2] inner
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: a/Inner
float32 v
"""
    fields = ros2_definition.parse("a/msg/A", text)["a/A"]
    assert [tuple(field) for field in fields] == [
        ("header", "std_msgs/Header", None, "a comment"),
        ("few", "float64", 0, "bounded"),
        ("short", "string", None, "a comment"),
        ("with_default", "int16", None, "a comment"),
        ("inner", "a/Inner", 2, "a comment"),
    ]


@pytest.mark.parametrize(
    ("language", "message"),
    [("jsonschema", "ros2msg and cdr"), ("ros2idl", "IDL as ROS 2 records it"), ("", "ros2msg and cdr")],
)
def test_another_language_is_refused(tmp_path: Path, language: str, message: str) -> None:
    path = raw(tmp_path / "other.mcap", b"float64 x\n", CDR + bytes(8), language=language)
    with pytest.raises(LogError, match=message):
        read_field(path, "/a.x")


def test_big_endian_messages_are_read(tmp_path: Path) -> None:
    path = raw(
        tmp_path / "big.mcap", b"uint8 a\nfloat64 x\n", b"\0\0\0\0" + b"\7" + bytes(7) + np.array([2.5], ">f8").tobytes()
    )
    assert read_field(path, "/a.x").values.tolist() == [2.5]


def test_memory_is_bounded_by_a_chunk_not_by_the_log(tmp_path: Path) -> None:
    """Ten times the log, the same peak but for the columns that come back."""

    def peak(count: int) -> int:
        path = tmp_path / f"{count}.mcap"
        definition = b"float64 x\nuint8[4000] rest\n"
        with path.open("wb") as file:
            writer = Writer(file, chunk_size=200_000, compression=CompressionType.ZSTD)
            writer.start("ros2")
            schema = writer.register_schema("a/msg/A", "ros2msg", definition)
            channel = writer.register_channel("/a", "cdr", schema)
            for i in range(count):
                writer.add_message(channel, i, CDR + np.array([float(i)]).tobytes() + bytes(4000), i)
            writer.finish()
        tracemalloc.start()
        assert read_field(path, "/a.x").values[-1] == count - 1
        maximum = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return maximum

    peak(500)
    assert peak(10_000) < peak(500) + 10_000 * 400  # the log grows by 38 MB, what may be kept of it by 4


def test_signals_of_two_logs_are_diagnosed(tmp_path: Path, write_pair: Callable[[str, Path], Path]) -> None:
    """The whole way: an odometry twist with a gain, a joint that comes late, each against a simulation at another rate."""
    real, sim = (write_pair(which, tmp_path / f"{which}.mcap") for which in ("real", "sim"))
    for signal, effect, value in (("/odom.twist.twist.linear.x", "gain", 1.08), ("/joint_states.position[1]", "delay", 0.03)):
        pair = SignalPair.of_fields(read_field(real, signal), read_field(sim, signal), signal)
        d = diagnose_signal(pair, others(real, signal))
        (one,) = d.findings
        assert (one.effect, one.signal) == (effect, signal)
        estimate = one.parameters[effect]
        assert abs(estimate.value - value) < 4.0 * estimate.std


@pytest.fixture
def write_pair() -> Callable[[str, Path], Path]:
    rng = np.random.default_rng(5)
    f, p = rng.uniform(0.1, 1.5, (2, 12)), rng.uniform(0.0, 6.28, (2, 12))

    def signal(which: int, t: np.ndarray) -> np.ndarray:
        return np.cos(2.0 * np.pi * np.outer(t, f[which]) + p[which]).sum(1)

    def build(which: str, path: Path) -> Path:
        rate = 50.0 if which == "real" else 80.0
        t = np.arange(int(40.0 * rate)) / rate
        v, q = signal(0, t), signal(1, t - (0.03 if which == "real" else 0.0))
        if which == "real":
            v, q = 1.08 * v + 0.02 * rng.normal(size=len(t)), q + 0.02 * rng.normal(size=len(t))
        messages = []
        for i, at in enumerate(START_NS + np.round(t * 1e9).astype(np.int64)):
            messages.append(("/odom", ODOMETRY, int(at), odometry(int(at), np.array([v[i], 0, 0, 0, 0, 0.0]))))
            messages.append(("/joint_states", JOINTS, int(at), joints(int(at), np.array([0.0, q[i]]), np.zeros(0))))
        return write(path, messages)

    return build
