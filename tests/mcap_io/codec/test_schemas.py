"""The codec against rosbags and mcap-ros2-support, both ways, in every encoding it reads."""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np
import pytest
from mcap_ros2._dynamic import generate_dynamic
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from imutool.errors import DataError, LogError
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.decode import decode_image, decode_imu, decode_poses, decode_scalars
from imutool.mcap_io.codec.encode import encode_float, encode_image, encode_imu, encode_pose, encode_transform, encode_vector3
from imutool.mcap_io.codec.ros2_definition import Walk, parse

STAMPS = np.array([0, 1, 999_999_999, 1_000_000_000, 1_403_638_128_245_096_960, 2**31 * 10**9 - 1])
COUNT = len(STAMPS)
FRAMES = ["", "b", "imu", "imu0", "base_link", "a frame with a long name and ünïcode"]

ROS2 = get_typestore(Stores.ROS2_HUMBLE)


def columns(width: int) -> np.ndarray:
    values = np.random.default_rng(width).normal(size=(COUNT, width))
    values[0] = -0.0
    values[1, :] = np.nextafter(0, 1)
    return values


def matrix(payloads: list[bytes]) -> np.ndarray:
    return np.array([list(payload) for payload in payloads], np.uint8)


def stamp_of(header: object) -> int:
    return header.stamp.sec * 10**9 + header.stamp.nanosec


@pytest.mark.parametrize("name", schemas.TYPE_HASHES)
def test_definitions_parse_to_the_types_ros_has(name: str) -> None:
    ours = get_types_from_msg(schemas.definition(name), name)
    for nested, fields in ours.items():
        assert fields == ROS2.fielddefs[nested]
    assert schemas.TYPE_HASHES[name] == ROS2.hash_rihs01(name)
    assert schemas.definition(name) == ROS2.generate_msgdef(name, ros_version=2)[0]


@pytest.mark.parametrize("frame_id", FRAMES)
def test_imu_bytes_are_those_of_rosbags_and_read_back_exactly(frame_id: str) -> None:
    gyro, accel, gyro_covariance, accel_covariance = columns(3), columns(3) + 1, columns(9), columns(9)[0]
    rows = encode_imu(STAMPS, gyro, accel, frame_id, gyro_covariance, accel_covariance)
    decoder = generate_dynamic(schemas.IMU, schemas.definition(schemas.IMU))[schemas.IMU]
    for i, row in enumerate(rows):
        theirs = ROS2.deserialize_cdr(row.tobytes(), schemas.IMU)
        assert bytes(ROS2.serialize_cdr(theirs, schemas.IMU)) == row.tobytes()
        message = decoder(row.tobytes())
        assert stamp_of(message.header) == STAMPS[i]
        assert message.header.frame_id == frame_id
        rate, force = message.angular_velocity, message.linear_acceleration
        assert np.array([rate.x, rate.y, rate.z]).tobytes() == gyro[i].tobytes()
        assert np.array([force.x, force.y, force.z]).tobytes() == accel[i].tobytes()
        assert np.array_equal(message.angular_velocity_covariance, gyro_covariance[i])
        assert np.array_equal(message.linear_acceleration_covariance, accel_covariance)
        assert (message.orientation.w, message.orientation_covariance[0]) == (1.0, -1.0)
    back = decode_imu(rows)
    assert back.frame_id == frame_id
    for ours, given in zip(back[:3], (STAMPS, gyro, accel), strict=True):
        assert ours.tobytes() == given.tobytes()


def test_imu_without_covariance_says_unknown() -> None:
    message = ROS2.deserialize_cdr(encode_imu(STAMPS, columns(3), columns(3), "b")[0].tobytes(), schemas.IMU)
    assert not message.angular_velocity_covariance.any()
    assert not message.linear_acceleration_covariance.any()


def second(order: str, *parts: object) -> np.ndarray:
    """Message in plain CDR 2: doubles lie at multiples of four bytes."""
    body = b""
    for part in parts:
        body += bytes(-len(body) % 4)
        if isinstance(part, str):
            body += struct.pack(order + "I", len(part) + 1) + part.encode() + b"\0"
        else:
            kind = np.dtype(order + ("f8" if isinstance(part, float) else "i4"))
            body += np.array(part, kind).tobytes()
    return matrix([bytes([0, 7 if order == "<" else 6, 0, 0]) + body])


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("frame_id", ["b", "imu", "abcdefg"])
def test_the_second_version_of_cdr_is_read(order: str, frame_id: str) -> None:
    imu = decode_imu(second(order, 7, 5, frame_id, *map(float, range(37))))
    assert (imu.stamp_ns[0], imu.frame_id) == (7_000_000_005, frame_id)
    assert (imu.gyro.tolist(), imu.accel.tolist()) == ([[13.0, 14.0, 15.0]], [[25.0, 26.0, 27.0]])
    tree = second(order, 99, 1, 7, 5, frame_id, "body", *map(float, range(7)))  # the list's bytes, then its count
    (pose,) = decode_poses(tree, schemas.TF)
    assert (pose.child_frame_id, pose.p_wb.tolist()) == ("body", [[0.0, 1.0, 2.0]])
    text = schemas.definition(schemas.TF).encode()
    leaves = [leaf.path for leaf in Walk(tree[0].tobytes(), parse(schemas.TF, text)).leaves()]
    assert leaves[-1] == "transforms[0].transform.rotation.w"


@pytest.mark.parametrize("name", ["sensor_msgs/Imu", "sensor_msgs::msg::dds_::Imu_", "sensor_msgs::msg::Imu", schemas.IMU])
def test_a_type_has_one_name_however_it_is_spelt(name: str) -> None:
    assert schemas.canonical(name) == schemas.IMU


@pytest.mark.parametrize("frame_id", FRAMES)
def test_pose_is_wxyz_in_memory_and_xyzw_in_the_message(frame_id: str) -> None:
    p_wb, q_wxyz = columns(3), columns(4)
    rows = encode_pose(STAMPS, p_wb, q_wxyz, frame_id)
    for i, row in enumerate(rows):
        message = ROS2.deserialize_cdr(row.tobytes(), schemas.POSE)
        q = message.pose.orientation
        assert [q.w, q.x, q.y, q.z] == q_wxyz[i].tolist()
        assert [message.pose.position.x, message.pose.position.y, message.pose.position.z] == p_wb[i].tolist()
        assert bytes(ROS2.serialize_cdr(message, schemas.POSE)) == row.tobytes()
    (back,) = decode_poses(rows)
    assert (back.frame_id, back.child_frame_id) == (frame_id, "")
    assert back.q_wb_wxyz.tobytes() == q_wxyz.tobytes()
    assert back.p_wb.tobytes() == p_wb.tobytes()
    assert np.array_equal(back.stamp_ns, STAMPS)


def test_transform_vector_float_and_image_are_those_of_rosbags() -> None:
    p_wb, q_wxyz = columns(3), columns(4)
    cases = {
        schemas.TF: encode_transform(STAMPS, p_wb, q_wxyz, "world", "body"),
        schemas.VECTOR3: encode_vector3(STAMPS, p_wb, "world"),
        schemas.FLOAT: encode_float(p_wb[:, 0]),
        schemas.IMAGE: [np.frombuffer(encode_image(int(s), b"\x89PNG...", "cam0", "png"), np.uint8) for s in STAMPS],
    }
    for name, rows in cases.items():
        for i, row in enumerate(rows):
            message = ROS2.deserialize_cdr(row.tobytes(), name)
            assert bytes(ROS2.serialize_cdr(message, name)) == row.tobytes()
            if name == schemas.TF:
                transform = message.transforms[0]
                q = transform.transform.rotation
                assert [q.w, q.x, q.y, q.z] == q_wxyz[i].tolist()
                assert (stamp_of(transform.header), transform.child_frame_id) == (STAMPS[i], "body")
            elif name == schemas.IMAGE:
                assert decode_image(row.tobytes()) == (STAMPS[i], "png", b"\x89PNG...")
                assert (bytes(message.data), message.format) == (b"\x89PNG...", "png")
    (back,) = decode_poses(cases[schemas.TF], schemas.TF)
    assert (back.frame_id, back.child_frame_id) == ("world", "body")
    assert back.q_wb_wxyz.tobytes() == q_wxyz.tobytes()
    assert decode_scalars(cases[schemas.VECTOR3], schemas.VECTOR3).values.tobytes() == p_wb.tobytes()
    floats = decode_scalars(cases[schemas.FLOAT], schemas.FLOAT)
    assert floats.stamp_ns is None
    assert floats.values[:, 0].tobytes() == p_wb[:, 0].tobytes()


@pytest.mark.parametrize("ros1", [False, True])
@pytest.mark.parametrize("frame_id", FRAMES)
def test_other_writers_messages_decode_exactly(make: Callable[..., bytes], frame_id: str, ros1: bool) -> None:
    encoding, frames = ("ros1", (frame_id, "bodies")) if ros1 else ("cdr", (frame_id, "bodies"))
    a, b, q = columns(3), columns(3) + 1, columns(4)
    imu = decode_imu(
        matrix([make(schemas.IMU, int(s), a[i], b[i], ros1=ros1, frames=frames) for i, s in enumerate(STAMPS)]), encoding
    )
    assert (imu.gyro.tobytes(), imu.accel.tobytes(), imu.frame_id) == (a.tobytes(), b.tobytes(), frame_id)
    assert np.array_equal(imu.stamp_ns, STAMPS)
    for kind in (schemas.POSE, schemas.POSE_COVARIANCE, schemas.ODOMETRY, schemas.TRANSFORM):
        rows = matrix([make(kind, int(s), a[i], q[i], ros1=ros1, frames=frames) for i, s in enumerate(STAMPS)])
        (pose,) = decode_poses(rows, kind, encoding)
        assert (pose.p_wb.tobytes(), pose.q_wb_wxyz.tobytes()) == (a.tobytes(), q.tobytes())
        assert pose.child_frame_id == ("" if kind in (schemas.POSE, schemas.POSE_COVARIANCE) else "bodies")
        assert np.array_equal(pose.stamp_ns, STAMPS)
    rows = matrix([make(schemas.VECTOR3, int(s), a[i], ros1=ros1, frames=frames) for i, s in enumerate(STAMPS)])
    assert decode_scalars(rows, schemas.VECTOR3, encoding).values.tobytes() == a.tobytes()
    rows = matrix([make(schemas.FLOAT, int(s), a[i, 0], ros1=ros1) for i, s in enumerate(STAMPS)])
    assert decode_scalars(rows, schemas.FLOAT, encoding).values[:, 0].tobytes() == a[:, 0].tobytes()


@pytest.mark.parametrize("ros1", [False, True])
@pytest.mark.parametrize("count", [0, 1, 3])
def test_any_number_of_transforms_decodes(make: Callable[..., bytes], count: int, ros1: bool) -> None:
    p, q, children = columns(3), columns(4), ["base", "camera_left", "x"][:count]
    rows = matrix(
        [
            make(schemas.TF, int(s), *[(p[i] + k, q[i], child) for k, child in enumerate(children)], ros1=ros1)
            for i, s in enumerate(STAMPS)
        ]
    )
    found = decode_poses(rows, schemas.TF, "ros1" if ros1 else "cdr")
    assert [pose.child_frame_id for pose in found] == children
    for k, pose in enumerate(found):
        assert np.array_equal(pose.p_wb, p + k)
        assert np.array_equal(pose.q_wb_wxyz, q)
        assert np.array_equal(pose.stamp_ns, STAMPS)


def test_big_endian_cdr_decodes(make: Callable[..., bytes]) -> None:
    a, b = columns(3), columns(3) + 1
    swapped = []
    for i, s in enumerate(STAMPS):
        message = ROS2.deserialize_cdr(make(schemas.IMU, int(s), a[i], b[i]), schemas.IMU)
        swapped.append(bytes(ROS2.serialize_cdr(message, schemas.IMU, little_endian=False)))
    back = decode_imu(matrix(swapped))
    assert (back.gyro.tobytes(), back.accel.tobytes(), back.frame_id) == (a.tobytes(), b.tobytes(), "a")
    assert np.array_equal(back.stamp_ns, STAMPS)


def test_frames_of_equal_length_are_told_apart_and_order_is_kept() -> None:
    names = ["a", "b", "b", "cc", "a", "a"]  # all pad to one size
    gyro = columns(3)
    each = [encode_imu(STAMPS[i : i + 1], gyro[i : i + 1], gyro[i : i + 1], n) for i, n in enumerate(names)]
    rows = np.concatenate(each)
    found = [(part, layout.texts[0]) for part, layout in schemas.runs(rows, schemas.IMU)]
    assert [name for _, name in found] == ["a", "b", "cc", "a"]
    pieces = [decode_imu(rows[part]) for part, _ in found]
    assert np.concatenate([piece.gyro for piece in pieces]).tobytes() == gyro.tobytes()
    with pytest.raises(LogError, match="4 different frames"):
        decode_imu(rows)


@pytest.mark.parametrize("cut", [0, 3, 8, 15, 20, 100, -1])
def test_a_payload_too_short_is_refused(cut: int) -> None:
    rows = encode_imu(STAMPS, columns(3), columns(3), "imu0")
    with pytest.raises(LogError, match="payload"):
        decode_imu(rows[:, :cut])


def test_a_text_length_beyond_the_payload_is_refused() -> None:
    rows = encode_imu(STAMPS, columns(3), columns(3), "imu0")
    rows[:, 12:16] = 255
    with pytest.raises(LogError, match="ends before byte"):
        decode_imu(rows)


def test_parameter_list_cdr_is_refused() -> None:
    rows = encode_imu(STAMPS, columns(3), columns(3), "imu0")
    rows[:, 1] = 3
    with pytest.raises(LogError, match="00 03"):
        decode_imu(rows)


@pytest.mark.parametrize("stamp_ns", [-(2**31) * 10**9 - 1, 2**31 * 10**9])
def test_stamps_beyond_32_bit_seconds_are_refused(stamp_ns: int) -> None:
    with pytest.raises(DataError, match="32 bits"):
        encode_vector3(np.array([stamp_ns]), np.zeros((1, 3)), "b")


def test_no_messages_encode_to_no_rows() -> None:
    rows = encode_imu(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), "imu0")
    assert rows.shape == (0, 4 + 24 + 37 * 8)
    assert list(schemas.runs(rows, schemas.IMU)) == []


def test_a_layout_fits_the_messages_that_lie_alike_alone() -> None:
    """`convert --fix` writes into a message where the last one of its topic had its fields."""
    stamp, vectors = np.zeros(1, np.int64), np.zeros((1, 3))
    first, other, longer = (encode_imu(stamp, vectors, vectors, frame)[0].tobytes() for frame in ("imu", "cam", "imu_link"))
    layout = schemas.layout_of(schemas.IMU, "cdr", message=first)
    assert [layout.fits(message) for message in (first, other, longer, first[:-1])] == [True, False, False, False]
