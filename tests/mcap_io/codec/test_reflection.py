"""IMUs in messages of other types, and the units that their definitions state."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, timestamp_pb2
from mcap.writer import Writer

from imutool.api.logs import convert
from imutool.log_info.inspection import inspect
from imutool.mcap_io.codec.reflection import Reflected, reflect, reflect_cdr
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read

VALUES = 10.0, -20.0, 30.0, 0.1, -0.2, 1.0
RAW = b"\0\1\0\0" + struct.pack("<6d", *VALUES)
DEG, G = np.pi / 180, 9.80665


def reflected(text: str) -> Reflected:
    found = reflect_cdr("my_driver/msg/Imu", text.encode())
    assert found is not None
    return found


def fields(gyro: str, accel: str, above: str = "") -> str:
    return above + "".join([*(f"float64 gyro_{a}{gyro}\n" for a in "xyz"), *(f"float64 accel_{a}{accel}\n" for a in "xyz")])


@pytest.mark.parametrize(
    ("text", "gyro", "accel"),
    [
        (fields("  # deg/s", "  # g"), DEG, G),
        (fields(" # Degrees per second", " # acceleration in G's"), DEG, G),
        (fields(" # [mdps]", " # mg"), 1e-3 * DEG, 1e-3 * G),
        (fields(" # rate in rad/s", " # m/s^2"), 1.0, 1.0),
        (fields("", ""), 1.0, 1.0),
        (fields("", " # m/s**2", above="# angular rate (dps)\n"), DEG, 1.0),
        (fields("", "", above="# angular rate (dps)\n\n"), 1.0, 1.0),
        (fields(" # rad/s, not deg/s", " # x axis of the gyro"), 1.0, 1.0),
        ("float64[3] gyro  # deg/sec\nfloat64[3] accel  # (g)\n", DEG, G),
        ("float64[3] gyro_dps\nfloat64[3] acc_mg\n", DEG, 1e-3 * G),
        (
            "".join(
                f"float64 {name}\n" for name in ("gyroX_deg_s", "gyroY_deg_s", "gyroZ_deg_s", "accX_g", "accY_g", "accZ_g")
            ),
            DEG,
            G,
        ),
        ("float64[3] angular_velocity_rad_s  # as deg/s on the display\nfloat64[3] accel_mps2\n", 1.0, 1.0),
        ("".join(f"float64 {name}\n" for name in ("gx", "gy", "gz", "ax", "ay", "az")), 1.0, 1.0),
        ("Vec gyro # °/s\nVec accel\n" + "=" * 80 + "\nMSG: my_driver/Vec\nfloat64 x\nfloat64 y\nfloat64 z\n", DEG, 1.0),
    ],
)
def test_the_units_in_comments_count(text: str, gyro: float, accel: float) -> None:
    sizes = np.repeat([gyro, accel], 3)
    np.testing.assert_allclose(reflected(text).sample(RAW, 5).values, VALUES * sizes, rtol=1e-12)


def test_a_correction_is_written_in_the_unit_of_the_message() -> None:
    found = reflected(fields("  # deg/s", "  # g"))
    turned = found.with_vectors(RAW, np.stack([np.diag([1.0, -1.0, -1.0])] * 2))
    np.testing.assert_allclose(struct.unpack("<6d", turned[4:]), np.multiply(VALUES, [1, -1, -1, 1, -1, -1]), rtol=1e-12)


def test_parts_of_a_json_schema_state_units_where_a_field_refers_to_them() -> None:
    vector = {"type": "object", "title": "Vector"}
    parts = {
        "Rate": {"allOf": [vector, {"description": "deg/s"}]},
        "Force": {**vector, "unit": "g"},
        "Loop": {"$ref": "#/$defs/Loop"},
    }
    fields = {"gyro": {"$ref": "#/$defs/Rate"}, "accel": {"anyOf": [{"$ref": "#/$defs/Loop"}, {"$ref": "#/$defs/Force"}]}}
    raw = json.dumps({name: dict(zip("xyz", [1, 2, 3], strict=True)) for name in fields}).encode()
    found = reflect("json", "/imu", "Imu", json.dumps({"properties": fields, "$defs": parts}).encode(), raw)
    assert found is not None
    assert found.sizes == (DEG, G)


@pytest.mark.parametrize("part", [{"linear_acceleration": [7, 8, 9]}, {"left": {"accel": [7, 8, 9]}}, {"gyro": [7, 8, 9]}])
def test_gyro_and_accelerometer_are_those_beside_each_other(part: dict[str, object]) -> None:
    raw = json.dumps({**part, "imu": {"accel": [1, 2, 3], "gyro": [4, 5, 6]}}).encode()
    found = reflect("json", "/state", "", b"", raw)
    assert found is not None
    assert found.sample(raw, 0).values == [4, 5, 6, 1, 2, 3]


@pytest.mark.parametrize("key", ["description", "unit"])
def test_the_units_in_a_json_schema_count_both_ways(key: str) -> None:
    schema = {"properties": {"gyro": {"type": "object", key: "deg/s"}, "accel": {"type": "array", key: "g"}}}
    raw = json.dumps({"gyro": dict(zip("xyz", VALUES[:3], strict=True)), "accel": VALUES[3:], "t_ns": 5}).encode()
    found = reflect("json", "/imu", "Imu", json.dumps(schema).encode(), raw)
    assert found is not None
    sample = found.sample(raw, 0)
    np.testing.assert_allclose(sample.values, VALUES * np.repeat([DEG, G], 3), rtol=1e-12)
    again = json.loads(found.from_cdr(found.encode([sample]))[0])
    np.testing.assert_allclose([*again["gyro"].values(), *again["accel"]], VALUES, rtol=1e-12)


@pytest.mark.parametrize("order", ["as imported", "imported last", "not imported"])
def test_the_files_of_a_protobuf_schema_come_in_any_order(order: str) -> None:
    time = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(time)
    own = descriptor_pb2.FileDescriptorProto(name="imu.proto", package="my", syntax="proto3", dependency=[time.name])
    imu = own.message_type.add(name="Imu")
    imu.field.add(name="stamp", number=1, label=1, type=11, type_name=".google.protobuf.Timestamp")
    imu.field.add(name="gyro", number=2, label=3, type=1)
    imu.field.add(name="accel", number=3, label=3, type=1)
    files = {"as imported": [time, own], "imported last": [own, time], "not imported": [own]}[order]
    found = reflect("protobuf", "/imu", "my.Imu", descriptor_pb2.FileDescriptorSet(file=files).SerializeToString(), None)
    assert found is not None
    raw = b"\x0a\x04\x08\x07\x10\x05" + b"".join(bytes([tag, 24]) + struct.pack("<3d", 1, 2, 3) for tag in (0x12, 0x1A))
    assert found.sample(raw, 0) == (7_000_000_005, "", [1, 2, 3, 1, 2, 3])


RATE_HZ, START_NS = 100, 1_700_000_000_000_000_000
COUNTS = {  # a time without a unit, and how it counts the nanoseconds since some start
    "ns": lambda ns: START_NS + ns,
    "us": lambda ns: 5_000_000 + ns // 1000,
    "ms": lambda ns: (START_NS + ns) // 10**6,
    "s": lambda ns: 12.5 + ns * 1e-9,
}


def driver_log(
    path: Path, fields: Callable[[int], dict[str, object]], spread_ns: int = 4_000_000, topic: str = "/imu", count: int = 100
) -> Path:
    """JSON of an IMU whose messages come up to `spread_ns` late."""
    late = np.random.default_rng(1).integers(spread_ns, size=count).tolist()
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel(topic, "json", writer.register_schema("Imu", "jsonschema", b"{}"))
        for n in range(count):
            log_ns = START_NS + n * 10**9 // RATE_HZ + late[n]
            message = {**fields(n * 10**9 // RATE_HZ), "gyro": [0.1, 0.2, 0.01 * n], "accel": [0.0, 0.0, 9.81]}
            writer.add_message(channel, log_ns, json.dumps(message).encode(), log_ns)
        writer.finish()
    return path


def test_a_robot_counts_ticks_of_a_millisecond() -> None:
    """As Unitree's LowState does, which has no header."""
    found = reflected("float32[3] gyroscope\nfloat32[3] accelerometer\nuint32 tick\n")
    raw = [b"\0\1\0\0" + struct.pack("<6fI", *VALUES, 777 + 2 * n) for n in range(500)]
    settled = found.settled((START_NS + 2_000_000 * n + 1000 * (n % 7), message) for n, message in enumerate(raw))
    assert (settled.stamp_unit, settled.sample(raw[3], START_NS).stamp_ns) == ("ms", 783_000_000)
    assert struct.unpack("<6fI", settled.with_stamp(raw[3], 999_000_000)[4:])[-1] == 999


@pytest.mark.parametrize("is_filled", [True, False])
def test_samples_before_the_filter_in_the_sensor_are_taken_where_a_message_has_them(is_filled: bool) -> None:
    """VectorNav's CommonGroup gave those from which its filter had removed the bias, without a word."""
    vector = f"{'=' * 80}\nMSG: my_driver/V\nfloat64 x\nfloat64 y\nfloat64 z\n"
    found = reflected(f"V angularrate\nV accel\nV imu_accel\nV imu_rate\n{vector}")
    raw = b"\0\1\0\0" + struct.pack("<12d", *range(1, 7), *(is_filled * np.arange(7.0, 13.0)))
    settled = found.settled([(START_NS, raw)])
    assert list(settled.sample(raw, START_NS).values) == ([10, 11, 12, 7, 8, 9] if is_filled else [1, 2, 3, 4, 5, 6])
    assert settled.compensated.startswith("angularrate, accel are compensated") != is_filled


def test_a_position_in_a_driver_s_own_message_is_no_pose() -> None:
    """VectorNav's CommonGroup has latitude and longitude there."""
    vector = "float64 x\nfloat64 y\nfloat64 z\n"
    types = {"V": vector, "Q": f"{vector}float64 w\n"}
    parts = "".join(f"{'=' * 80}\nMSG: my_driver/{name}\n{text}" for name, text in types.items())
    assert reflected(f"V angularrate\nV accel\nV position\nQ quaternion\n{parts}").pose is None


@pytest.mark.parametrize("unit", COUNTS)
def test_the_log_times_show_the_unit_of_a_stamp(tmp_path: Path, unit: str) -> None:
    """Such logs had the jitter of the log times."""
    path = driver_log(tmp_path / "a.mcap", lambda ns: {"timestamp": COUNTS[unit](ns)})
    with Log(path) as log:
        found = log.topics["/imu"].reflected
    assert isinstance(found, Reflected)
    assert found.stamp_unit == unit
    (note,) = convert(path, tmp_path / "b.mcap").notes
    assert note.endswith(f"; timestamp is in {unit}, as the log times show")
    for log_path in (path, tmp_path / "b.mcap"):
        t_ns = read(log_path).imu.t_ns
        assert np.abs(np.diff(t_ns) - 10**9 // RATE_HZ).max() <= 1


def test_a_message_of_the_same_type_gets_its_stamp_in_its_unit() -> None:
    raw = json.dumps({"t": 1.5, "gyro": [1, 2, 3], "accel": [4, 5, 6]}).encode()
    found = reflect("json", "/imu", "Imu", b"", raw)
    assert isinstance(found, Reflected)
    later = (json.dumps({"t": 1.5 + 0.01 * n, "gyro": [1, 2, 3], "accel": [4, 5, 6]}).encode() for n in range(100))
    settled = found.settled((START_NS + n * 10**7, raw) for n, raw in enumerate(later))
    sample = settled.sample(raw, START_NS)
    assert sample.stamp_ns == 1_500_000_000
    assert json.loads(settled.from_cdr(settled.encode([sample]))[0])["t"] == 1.5


@pytest.mark.parametrize("parts", [("tv_sec", "tv_nsec"), ("tv_sec", "tv_usec"), ("sec", "usec")])
def test_a_stamp_in_the_parts_of_posix_is_read_and_written(parts: tuple[str, str]) -> None:
    """The samples had the log time."""
    raw = json.dumps({"stamp": dict(zip(parts, (7, 250), strict=True)), "gyro": [1, 2, 3], "accel": [4, 5, 6]}).encode()
    found = reflect("json", "/imu", "Imu", b"", raw)
    assert isinstance(found, Reflected)
    sample = found.sample(raw, START_NS)
    assert sample.stamp_ns == 7_000_000_000 + 250 * (1 if "nsec" in parts[1] else 1000)
    assert json.loads(found.from_cdr(found.encode([sample]))[0])["stamp"] == json.loads(raw)["stamp"]


@pytest.mark.parametrize(
    "fields",
    [
        lambda ns: {"timestamp": ns // 100},  # ticks of 100 ns
        lambda ns: {"time": ns // 10**9},  # whole seconds
        lambda ns: {"t": "later"},
        lambda ns: {"time": float("nan")},
        lambda ns: {"timestamp": 1_700_000_000.25},
        lambda ns: {"count": ns},
    ],
)
def test_a_number_that_counts_no_time_is_no_stamp(tmp_path: Path, fields: Callable[[int], dict[str, object]]) -> None:
    path = driver_log(tmp_path / "a.mcap", fields, spread_ns=1)
    (note,) = convert(path, tmp_path / "b.mcap").notes
    assert note.endswith("; at the log time, as the messages state no stamp with its unit")
    assert np.array_equal(read(path).imu.t_ns, START_NS + 10**7 * np.arange(100))


@pytest.mark.parametrize(("topic", "kind"), [("/ego", "estimate"), ("/ego/truth", "truth"), ("/odom", "odometry")])
def test_a_pose_in_the_messages_of_an_imu_has_a_topic_of_its_own(tmp_path: Path, topic: str, kind: str) -> None:
    """Its poses were left out without a word."""

    def state(ns: int) -> dict[str, object]:
        turn = {"x": 0.0, "y": 0.0, "z": 0.6, "w": 0.8}
        return {"time": ns * 1e-9, "position": {"x": ns * 1e-9, "y": 2.0, "z": 3.0}, "orientation": turn}

    path = driver_log(tmp_path / "a.mcap", state, topic=topic)
    convert(path, tmp_path / "b.mcap")
    for log_path in (path, tmp_path / "b.mcap"):
        with Log(log_path) as log:
            assert log.imu_topics == [topic]
            assert log.pose_topics == [f"{topic}/pose"]
            assert log.topics[f"{topic}/pose"].pose_kind == kind
        recording = read(log_path, truth=f"{topic}/pose")
        assert np.array_equal(recording.truth.t_ns, recording.imu.t_ns)
        np.testing.assert_allclose(recording.truth.p_wb[:, 0], 0.01 * np.arange(100), atol=1e-9)
        np.testing.assert_allclose(recording.truth.q_wb_wxyz[0], [0.8, 0.0, 0.0, 0.6])
    assert inspect(path).messages == 100
