"""FlatBuffers by reflection, against a schema of flatc and messages of the flatbuffers package (fixtures/flatbuffer.json)."""

from __future__ import annotations

import contextlib
import json
from base64 import b64decode
from pathlib import Path

import numpy as np
import pytest

from imutool.mcap_io.codec.decode import decode_poses
from imutool.mcap_io.codec.encode import encode_imu
from imutool.mcap_io.codec.formats.flatbuffer import FlatBuffer
from imutool.mcap_io.codec.reflection import reflect

MADE = json.loads((Path(__file__).parents[2] / "fixtures" / "flatbuffer.json").read_text())
SCHEMA, POSE_SCHEMA = b64decode(MADE["bfbs"]), b64decode(MADE["pose_bfbs"])


def found(topic: str = "/imu", name: str = "acme.ImuSample", schema: bytes = SCHEMA):
    return reflect("flatbuffer", topic, name, schema, None)


def test_values_are_those_that_the_library_wrote():
    imu = found()
    for message in MADE["messages"]:
        sample = imu.sample(b64decode(message["bytes"]), log_time=7)
        assert sample.stamp_ns == message["stamp_ns"]
        assert sample.frame_id == "imu_link"
        assert sample.values == [*message["gyro"], *message["accel"]]


def test_the_root_of_the_schema_serves_a_channel_whose_type_has_another_name():
    assert found(name="ImuSample").vectors == found().vectors
    assert found(schema=POSE_SCHEMA) is None  # no IMU, and nothing says pose


def test_a_pose_is_found_by_its_type_and_its_position_beside_a_quaternion():
    pose = found("/vicon", "foxglove.PoseInFrame", POSE_SCHEMA)
    (columns,) = decode_poses(pose.encode([pose.sample(b64decode(MADE["pose"]), 7)]))
    assert columns.p_wb.tolist() == [[1.0, -2.0, 3.0]]
    assert columns.q_wb_wxyz.tolist() == [[0.5, 0.5, -0.5, 0.5]]
    assert (columns.stamp_ns.tolist(), columns.frame_id) == ([1_600_000_000_000_000_123], "world")


def test_a_new_message_is_read_back_and_lies_as_the_format_asks():
    imu, rng = found(), np.random.default_rng(5)
    gyro, accel, covariance = rng.normal(size=(3, 3)), rng.normal(size=(3, 3)), np.arange(9.0)
    stamps = np.array([5, 1_600_000_000_000_000_123, 2**31 * 10**9 - 1])
    made = imu.from_cdr(encode_imu(stamps, gyro, accel, "body", covariance, 2 * covariance))
    for n, raw in enumerate(made):
        sample = imu.sample(raw, 0)
        assert (sample.stamp_ns, sample.frame_id, sample.values) == (stamps[n], "body", [*gyro[n], *accel[n]])
        message = imu.format.parse(raw)
        assert [imu.format.at(message, ("angular_velocity_covariance", k)) for k in range(9)] == covariance.tolist()
        assert imu.format.at(message, ("mode",)) == 1  # the default of the schema
        assert imu.format.at(message, ("serial",)) == ""  # required, so it is there
        place = imu.format._place(raw, message[1], imu.format._root, imu.format._root.fields["angular_velocity"])
        assert place % 8 == 0  # doubles lie at multiples of their size


@pytest.mark.parametrize("size", range(0, 200, 3))
def test_bytes_that_are_no_message_are_a_value_error(size):
    whole = b64decode(MADE["messages"][0]["bytes"])
    rng, imu = np.random.default_rng(size), found()
    for raw in (whole[:size], rng.bytes(size), whole[:20] + rng.bytes(size)):
        try:
            imu.sample(raw, 7)
        except ValueError:
            continue  # anything else is a crash; noise may also be a message by chance


@pytest.mark.parametrize("seed", range(60))
def test_a_damaged_schema_is_no_imu_or_one_that_reads_without_a_crash(seed):
    rng = np.random.default_rng(seed)
    damaged = bytearray(SCHEMA)
    for at in rng.integers(0, len(damaged), 12):
        damaged[at] = rng.integers(256)
    imu = found(schema=bytes(damaged))
    assert FlatBuffer.of("acme.ImuSample", bytes(damaged[: seed * 20])) is None or seed * 20 >= 200
    if imu is not None:
        with contextlib.suppress(ValueError):
            imu.sample(b64decode(MADE["messages"][0]["bytes"]), 7)
