"""Numbers of messages in other encodings than that of ROS 2: the same paths, times and values."""

from __future__ import annotations

import json
import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from imutool.diagnosis.signals.log_fields import GNSS, JOINTS, read_both
from imutool.errors import LogError
from imutool.file_location import to_location
from imutool.mcap_io.fields import numeric_fields, others, read_field
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read

START_NS, PERIOD_NS, COUNT = 1_700_000_000_123_456_789, 20_000_000, 50
KIND = "sensor_msgs/msg/JointState"
NAMES = ["hip", "knee"]
PATHS = [f"{word}[{k}]" for word in ("position", "velocity") for k in range(2)]
NUMBERS = np.random.default_rng(3).normal(size=(COUNT, 4))
POINT_IDL = b"""
================================================================================
IDL: robot/msg/Leg
#include "robot/msg/Point.idl"
module robot { module msg { struct Leg { string name; robot::msg::Point foot; double force; }; }; };
================================================================================
IDL: robot/msg/Point
module robot { module msg { struct Point { float x; float y; }; }; };
"""


def stamp(row: int) -> dict[str, int]:
    t_ns = START_NS + row * PERIOD_NS
    return {"sec": t_ns // 10**9, "nanosec": t_ns % 10**9}


def message(row: int) -> dict[str, Any]:
    """A JointState as JSON has it."""
    values = NUMBERS[row].tolist()
    return {
        "header": {"stamp": stamp(row), "frame_id": "a" * (row % 5)},
        "name": NAMES,
        "position": values[:2],
        "velocity": values[2:],
        "effort": [],
    }


def write(path: Path, schema: tuple[str, str, bytes], encoding: str, rows: list[bytes], topic: str = "/joints") -> Path:
    """Messages a millisecond behind their stamps."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel(topic, encoding, writer.register_schema(*schema))
        for row, data in enumerate(rows):
            t_ns = START_NS + row * PERIOD_NS + 1_000_000
            writer.add_message(channel, t_ns, data, t_ns)
        writer.finish()
    return path


def as_json(path: Path) -> Path:
    return write(path, (KIND, "jsonschema", b"{}"), "json", [json.dumps(message(row)).encode() for row in range(COUNT)])


def as_ros(path: Path, version: int) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    types, rows = store.types, []
    for row in range(COUNT):
        seq = {"seq": row} if version == 1 else {}
        time = types["builtin_interfaces/msg/Time"](**stamp(row))
        header = types["std_msgs/msg/Header"](stamp=time, frame_id="a" * (row % 5), **seq)
        values = NUMBERS[row]
        joints = types[KIND](header=header, name=NAMES, position=values[:2], velocity=values[2:], effort=np.zeros(0))
        rows.append(bytes((store.serialize_ros1 if version == 1 else store.serialize_cdr)(joints, KIND)))
    text = store.generate_msgdef(KIND, ros_version=version)[0].encode()
    schema, encoding = ("ros1msg", "ros1") if version == 1 else ("ros2msg", "cdr")
    return write(path, (KIND.replace("/msg/", "/") if version == 1 else KIND, schema, text), encoding, rows)


def described(
    name: str, fields: dict[str, str], nested: dict[str, dict[str, str]] | None = None
) -> descriptor_pb2.FileDescriptorProto:
    """A protobuf file with one message; a field is TYPE or TYPE[]."""
    file = descriptor_pb2.FileDescriptorProto(name="robot.proto", package="robot", syntax="proto3")
    file.enum_type.add(name="Mode").value.add(name="OFF", number=0)
    for kind, parts in {**(nested or {}), name: fields}.items():
        made = file.message_type.add(name=kind)
        for number, (field, of) in enumerate(parts.items(), 1):
            bare = of.removesuffix("[]")
            own = made.field.add(name=field, number=number, label=3 if of != bare else 1)
            if f"TYPE_{bare.upper()}" in descriptor_pb2.FieldDescriptorProto.Type.keys():  # noqa: SIM118
                own.type = descriptor_pb2.FieldDescriptorProto.Type.Value(f"TYPE_{bare.upper()}")
            else:
                own.type, own.type_name = (14 if bare == "Mode" else 11), f".robot.{bare}"
    return file


def protobuf(file: descriptor_pb2.FileDescriptorProto, name: str) -> tuple[Any, tuple[str, str, bytes]]:
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    made = message_factory.GetMessageClass(pool.FindMessageTypeByName(f"robot.{name}"))
    return made, (f"robot.{name}", "protobuf", descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString())


def as_protobuf(path: Path) -> Path:
    nested = {"Time": {"sec": "int64", "nanosec": "int64"}, "Header": {"stamp": "Time", "frame_id": "string"}}
    fields = {"header": "Header", "name": "string[]", "position": "double[]", "velocity": "double[]", "effort": "double[]"}
    made, schema = protobuf(described("Joints", fields, nested), "Joints")
    return write(path, schema, "protobuf", [made(**message(row)).SerializeToString() for row in range(COUNT)])


WRITERS = {"json": as_json, "ros1": lambda path: as_ros(path, 1), "ros2": lambda path: as_ros(path, 2), "protobuf": as_protobuf}


@pytest.mark.parametrize("encoding", WRITERS)
def test_numbers_and_stamps_are_those_of_ros_2(tmp_path: Path, encoding: str) -> None:
    path = WRITERS[encoding](tmp_path / "log.mcap")
    with Log(to_location(str(path))) as log:
        assert [p for p in numeric_fields(log, "/joints") if p != "header.seq"] == PATHS
    found = others(to_location(str(path)), "")
    assert [name for name in found if "seq" not in name] == [f"/joints.{p}" for p in PATHS]
    one = read_field(to_location(str(path)), "/joints.velocity[1]")
    assert np.array_equal(one.t_ns, START_NS + PERIOD_NS * np.arange(COUNT))
    assert np.array_equal(one.values, NUMBERS[:, 3])


@pytest.mark.parametrize("encoding", WRITERS)
def test_joints_are_paired_across_encodings_by_their_names(tmp_path: Path, encoding: str) -> None:
    mine, other = WRITERS[encoding](tmp_path / "real.mcap"), as_ros(tmp_path / "sim.mcap", 2)
    real, sim, topics = read_both(to_location(str(mine)), to_location(str(other)))
    assert real.schemas["/joints"] == sim.schemas["/joints"] == JOINTS
    assert real.joints["/joints"] == NAMES
    assert topics == {"/joints": "/joints"}


def test_a_number_is_no_truth_value_no_enumeration_and_no_text(tmp_path: Path) -> None:
    fields = {
        "on": "bool",
        "mode": "Mode",
        "text": "string",
        "raw": "bytes",
        "count": "uint32",
        "legs": "Leg[]",
        "bits": "bool[]",
    }
    made, schema = protobuf(described("State", fields, {"Leg": {"force": "float", "name": "string"}}), "State")
    rows = [
        made(on=True, text="a", count=row, legs=[{"force": 0.5 * row, "name": "b"}, {}]).SerializeToString() for row in range(9)
    ]
    path = write(tmp_path / "state.mcap", schema, "protobuf", rows, "/state")
    with Log(to_location(str(path))) as log:
        assert numeric_fields(log, "/state") == ["count", "legs[0].force", "legs[1].force"]
    assert np.array_equal(read_field(to_location(str(path)), "/state.legs[0].force").values, 0.5 * np.arange(9))
    rows = [
        json.dumps({"on": True, "t": "1", "no": None, "deep": [[row, 2.5]], "left-leg": {"a b": row}}).encode()
        for row in range(9)
    ]
    path = write(tmp_path / "state_json.mcap", ("", "", b""), "json", rows, "/state")
    with Log(to_location(str(path))) as log:
        assert numeric_fields(log, "/state") == ["deep[0][0]", "deep[0][1]", "left-leg.a b"]
    assert np.array_equal(read_field(to_location(str(path)), "/state.left-leg.a b").values, np.arange(9.0))


def test_long_lists_are_no_channels_and_hide_no_other_number(tmp_path: Path) -> None:
    rows = [json.dumps({"scan": [row / 7.0] * 70_000, "speed": row * 0.1}).encode() for row in range(4)]
    path = write(tmp_path / "scan.mcap", ("", "", b""), "json", rows, "/scan")
    with Log(to_location(str(path))) as log:
        assert numeric_fields(log, "/scan", long=False) == ["speed"]
        assert len(numeric_fields(log, "/scan")) == 65
    assert read_field(to_location(str(path)), "/scan.scan[69999]").values[-1] == 3 / 7.0


@pytest.mark.parametrize("encoding", ["json", "protobuf"])
def test_a_long_message_is_never_made_into_objects(tmp_path: Path, encoding: str) -> None:
    made, schema = protobuf(described("State", {"x": "double", "legs": "Leg[]"}, {"Leg": {"force": "float"}}), "State")
    long = {
        "json": b'{"x": [' + b"[]," * 3_000_000 + b"1]}",
        "protobuf": made(x=1.0).SerializeToString() + b"\x12\0" * 5_000_000,
    }
    path = write(tmp_path / "long.mcap", schema if encoding == "protobuf" else ("", "", b""), encoding, [long[encoding]], "/x")
    tracemalloc.start()
    with Log(to_location(str(path))) as log, pytest.raises(LogError, match="more than 8388608 bytes"):
        numeric_fields(log, "/x")
    assert tracemalloc.get_traced_memory()[1] < 12 * len(long[encoding])
    tracemalloc.stop()


def test_first_messages_are_held_one_at_a_time(tmp_path: Path) -> None:
    with (path := tmp_path / "many.mcap").open("wb") as file:
        writer = Writer(file, chunk_size=1)
        writer.start()
        for k in range(40):
            writer.add_message(writer.register_channel(f"/t{k}", "json" if k % 2 else "x", 0), k, b" " * 1_000_000, k)
        writer.finish()
    tracemalloc.start()
    assert not others(to_location(str(path)), "")
    with Log(to_location(str(path))) as log:
        assert len(log.topics) == 40
    assert tracemalloc.get_traced_memory()[1] < 10_000_000
    tracemalloc.stop()


def test_a_message_that_lacks_a_number_is_a_gap_and_a_damaged_one_an_error(tmp_path: Path) -> None:
    rows = [json.dumps({"x": None if row == 3 else row * 0.5} if row != 5 else {}).encode() for row in range(9)]
    path = to_location(str(write(tmp_path / "gap.mcap", ("", "", b""), "json", rows, "/x")))
    assert others(path, "", gaps=True)["/x.x"].left_out == 2
    with pytest.raises(LogError, match="there is no number x"):
        read_field(path, "/x.x")
    rows[6] = b'{"x": 0.'
    path = to_location(str(write(tmp_path / "cut.mcap", ("", "", b""), "json", rows, "/x")))
    with pytest.raises(LogError, match="not readable as json") as error:
        others(path, "", gaps=True)
    assert "cut.mcap /x" in str(error.value.where)
    assert all((error.value.expected, error.value.fix))


def test_times_of_foxglove_are_stamps_and_its_fixes_are_a_gnss(tmp_path: Path) -> None:
    rows = [
        json.dumps(
            {"timestamp": {"sec": 5, "nsec": 1000 + row}, "latitude": 47.0 + row, "longitude": 8.0, "altitude": 1.5}
        ).encode()
        for row in range(9)
    ]
    path = to_location(str(write(tmp_path / "fix.mcap", ("foxglove.LocationFix", "jsonschema", b"{}"), "json", rows, "/fix")))
    assert read_field(path, "/fix.latitude").t_ns.tolist() == [5_000_001_000 + row for row in range(9)]
    assert read_both(path, path)[0].schemas["/fix"] == GNSS


def test_a_definition_in_idl_is_read(tmp_path: Path) -> None:
    rows = []
    for row in range(9):
        text = b"leg\0" if row % 2 else b"other leg\0"
        body = len(text).to_bytes(4, "little") + text
        body += bytes(-len(body) % 4) + np.array([row, 2.0], "<f4").tobytes()
        rows.append(b"\0\1\0\0" + body + bytes(-len(body) % 8) + np.array([0.5 * row], "<f8").tobytes())
    path = to_location(str(write(tmp_path / "leg.mcap", ("robot/msg/Leg", "ros2idl", POINT_IDL), "cdr", rows, "/leg")))
    assert np.array_equal(read_field(path, "/leg.foot.x").values, np.arange(9.0))
    assert np.array_equal(read_field(path, "/leg.force").values, 0.5 * np.arange(9))


def test_numbers_of_an_imu_in_its_own_type_are_those_it_has(tmp_path: Path) -> None:
    made = [
        {"t_us": 1000 * row, "gyro": [row * 0.1, 0.0, 0.0], "accel": [0.0, 0.0, 9.81], "temp": 20.0 + row} for row in range(9)
    ]
    path = to_location(str(write(tmp_path / "imu.mcap", ("", "", b""), "json", [json.dumps(m).encode() for m in made], "/imu")))
    with Log(path) as log:
        assert log.imu_topics == ["/imu"]
    assert read_field(path, "/imu.temp").values.tolist() == [20.0 + row for row in range(9)]
    assert set(others(path, "")) == {"/imu.gyro[0]", "/imu.temp"}


def test_an_imu_of_its_own_type_in_ros_1_is_one(tmp_path: Path) -> None:
    text = b"Header header\nfloat32[3] gyro\nfloat32[3] accel\n" + b"=" * 80
    text += b"\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
    rows = [struct.pack("<4I3s6f", row, 7, row, 3, b"imu", row, 0, 0, 0, 0, 9.75) for row in range(9)]
    recording = read(to_location(str(write(tmp_path / "imu.mcap", ("driver/Imu", "ros1msg", text), "ros1", rows, "/imu"))))
    assert recording.imu.t_ns.tolist() == [7_000_000_000 + row for row in range(9)]
    assert np.array_equal(recording.imu.gyro[:, 0], np.arange(9.0))
    assert (recording.imu.accel == [0.0, 0.0, 9.75]).all()


def test_bodies_that_a_motion_capture_names_in_one_message_are_true_poses(tmp_path: Path) -> None:
    store, kind = get_typestore(Stores.ROS2_HUMBLE), "mocap4r2_msgs/msg/RigidBodies"
    body = "string rigid_body_name\ngeometry_msgs/Point[] markers\ngeometry_msgs/Pose pose\n"
    store.register(get_types_from_msg(body, "mocap4r2_msgs/msg/RigidBody"))
    store.register(get_types_from_msg("std_msgs/Header header\nmocap4r2_msgs/RigidBody[] rigidbodies\n", kind))
    types, rows = store.types, []
    point, quaternion = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/Quaternion"](0.5, -0.5, 0.5, 0.5)
    for row in range(9):
        named = [
            (name, [point(0, 0, 0)] * (row % 3), point(row, 2, k)) for k, name in enumerate(["drone", "wand"][: 1 + row % 2])
        ]
        bodies = [
            types["mocap4r2_msgs/msg/RigidBody"](name, markers, types["geometry_msgs/msg/Pose"](position, quaternion))
            for name, markers, position in named
        ]
        header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](**stamp(row)), "map")
        rows.append(bytes(store.serialize_cdr(types[kind](header, bodies), kind)))
    text = store.generate_msgdef(kind, ros_version=2)[0].encode()
    with Log(to_location(str(write(tmp_path / "mocap.mcap", (kind, "ros2msg", text), "cdr", rows, "/bodies")))) as log:
        assert (log.truth_topics, log.topics["/bodies"].own_schema) == (["/bodies"], kind)
        found = [batch for batch in log.pose_batches("/bodies") if batch.child_frame_id == "drone"]
    assert np.concatenate([batch.stamp_ns for batch in found]).tolist() == [START_NS + row * PERIOD_NS for row in range(9)]
    assert np.concatenate([batch.p_wb for batch in found]).tolist() == [[row, 2.0, 0.0] for row in range(9)]
    assert all((batch.q_wb_wxyz == [0.5, 0.5, -0.5, 0.5]).all() and batch.frame_id == "map" for batch in found)
