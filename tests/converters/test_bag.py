"""ROS 1 bags, written with rosbags and read back exactly."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from imutool.converters import euroc, fetch, tum_vi
from imutool.errors import ConfigError, DataError

STORE = get_typestore(Stores.ROS1_NOETIC)
TYPES = STORE.types
Messages = list[tuple[str, int, Any]]
START_NS = 1403636579758560000
RNG = np.random.default_rng(7)
GYRO, ACCEL, POSITION = RNG.normal(size=(20, 3)), RNG.normal(size=(20, 3)), RNG.normal(size=(20, 3))
QUATERNION = np.array([0.48, 0.6, 0.0, 0.64])  # wxyz, exactly unit


def header(t_ns: int) -> Any:
    time = TYPES["builtin_interfaces/msg/Time"](sec=t_ns // 10**9, nanosec=t_ns % 10**9)
    return TYPES["std_msgs/msg/Header"](seq=0, stamp=time, frame_id="imu")


def xyz(kind: str, values: Iterable[float]) -> Any:
    x, y, z = map(float, values)
    return TYPES[f"geometry_msgs/msg/{kind}"](x=x, y=y, z=z)


def quaternion() -> Any:
    w, x, y, z = QUATERNION
    return TYPES["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)


def imu(n: int, t_ns: int) -> Any:
    unknown = np.zeros(9)
    rate, force = xyz("Vector3", GYRO[n]), xyz("Vector3", ACCEL[n])
    return TYPES["sensor_msgs/msg/Imu"](header(t_ns), quaternion(), unknown, rate, unknown, force, unknown)


def transform(n: int, t_ns: int) -> Any:
    inner = TYPES["geometry_msgs/msg/Transform"](translation=xyz("Vector3", POSITION[n]), rotation=quaternion())
    return TYPES["geometry_msgs/msg/TransformStamped"](header(t_ns), "body", inner)


def pose(n: int, t_ns: int) -> Any:
    inner = TYPES["geometry_msgs/msg/Pose"](position=xyz("Point", POSITION[n]), orientation=quaternion())
    return TYPES["geometry_msgs/msg/PoseStamped"](header(t_ns), inner)


def image(n: int, t_ns: int) -> Any:
    return TYPES["sensor_msgs/msg/CompressedImage"](header(t_ns), "png", np.arange(n + 1, dtype=np.uint8))


def raw_image(_: int, t_ns: int) -> Any:
    return TYPES["sensor_msgs/msg/Image"](header(t_ns), 1, 1, "mono8", 0, 1, np.zeros(1, np.uint8))


def point(n: int, t_ns: int) -> Any:
    return TYPES["geometry_msgs/msg/PointStamped"](header(t_ns), xyz("Point", POSITION[n]))


def write_bag(path: Path, **makers: Any) -> Path:
    """A bag of twenty messages on each topic (`__` for `/`), arriving 1 ms after their stamps."""
    with Writer(path) as bag:
        for name, make in makers.items():
            first = make(0, START_NS)
            connection = bag.add_connection("/" + name.replace("__", "/"), first.__msgtype__, typestore=STORE)
            for n in range(20):
                t_ns = START_NS + n * 5_000_000
                message = make(n, t_ns)
                bag.write(connection, t_ns + 1_000_000, STORE.serialize_ros1(message, first.__msgtype__))
    return path


BAGS = {
    "euroc": (euroc, "/imu0", {"imu0": imu, "vicon__firefly_sbx__firefly_sbx": transform}),
    "tum_vi": (tum_vi, "/imu0", {"imu0": imu, "vrpn_client__raw_transform": transform}),
    "fetch": (fetch, "/base/imu", {"base__imu": imu, "mocap__pose": pose}),
}


@pytest.mark.parametrize("dataset", BAGS)
def test_the_data_sets_own_topics_read_back_exactly(tmp_path, dataset):
    module, imu_topic, topics = BAGS[dataset]
    path = write_bag(tmp_path / "dataset-room9.bag", **topics)
    (recording,) = module.read(path)
    assert recording.name == ("room9" if dataset == "tum_vi" else "dataset-room9")
    assert recording.imu_topic == "/imu0"
    assert recording.imu.t_ns.tolist() == [START_NS + n * 5_000_000 for n in range(20)]
    assert np.array_equal(recording.imu.gyro, GYRO)
    assert np.array_equal(recording.imu.accel, ACCEL)
    assert np.array_equal(recording.truth.p_wb, POSITION)
    assert np.array_equal(recording.truth.q_wb_wxyz, np.tile(QUATERNION, (20, 1)))
    assert recording.metadata["imutool/topics"]["/imu0"] == imu_topic


@pytest.mark.parametrize("dataset", BAGS)
def test_each_bag_is_recognised_by_its_own_converter_alone(tmp_path, dataset):
    write_bag(tmp_path / "one.bag", **BAGS[dataset][2])
    recognising = [name for name, (module, *_) in BAGS.items() if module.recognises(module.sequences(tmp_path)[0])]
    assert recognising == [dataset]


def test_compressed_images_are_carried_and_raw_ones_and_positions_named_as_skipped(tmp_path):
    topics = {"imu0": imu, "cam0__image_raw__compressed": image, "cam1__image_raw": raw_image, "leica__position": point}
    (recording,) = euroc.read(write_bag(tmp_path / "one.bag", **topics))
    frames = recording.frames["/cam0/image_raw/compressed"]
    assert (frames.format, frames.count) == ("png", 20)
    assert list(frames.each()) == [(START_NS + n * 5_000_000, bytes(range(n + 1))) for n in range(20)]
    assert set(recording.metadata["imutool/skipped"]) == {"/cam1/image_raw", "/leica/position"}
    assert not recording.truths


def test_topics_that_the_data_set_does_not_have_are_losses(tmp_path, convert):
    """They were left out without a word: a second IMU, or the joints of a robot."""
    topics = {**BAGS["euroc"][2], "imu__spare": imu, "cam0__image_raw": raw_image}
    done = convert(write_bag(tmp_path / "one.bag", **topics), tmp_path / "out.mcap")
    assert done.returncode == 3
    assert "/imu/spare: is left out, as the data set has no such topic; --format ros1_bag keeps every topic" in done.stderr
    assert "note: out.mcap: /cam0/image_raw: raw images are not carried over" in done.stderr


def test_the_known_truth_comes_first_and_others_keep_their_names(tmp_path):
    topics = {"imu0": imu, "a__pose": pose, "vrpn_client__raw_transform": transform}
    (recording,) = tum_vi.read(write_bag(tmp_path / "one.bag", **topics))
    assert recording.metadata["imutool/topics"] == {
        "/imu0": "/imu0",
        "/ground_truth/pose": "/vrpn_client/raw_transform",
        "/ground_truth_a_pose/pose": "/a/pose",
    }


def test_a_bag_without_an_imu_or_with_two_unknown_ones_says_so(tmp_path):
    with pytest.raises(DataError, match=r"has 0 IMU topics \(none\)"):
        list(fetch.read(write_bag(tmp_path / "none.bag", mocap=pose)))
    with pytest.raises(DataError, match=r"has 2 IMU topics \(/a, /b\)"):
        list(fetch.read(write_bag(tmp_path / "two.bag", a=imu, b=imu)))


def test_a_defect_is_named_with_topic_and_message_number(tmp_path):
    path = write_bag(tmp_path / "one.bag", imu0=lambda n, t_ns: imu(n, START_NS if n == 7 else t_ns))
    with pytest.raises(DataError, match=r"one\.bag/imu0:8: time goes from"):
        list(euroc.read(path))


def found_messages(recording):
    return len(recording.imu), recording.metadata.get("imutool/losses", {}).get("bag", "")


def test_a_bag_that_is_cut_or_has_no_index_is_read_as_far_as_it_goes_and_says_so(tmp_path):
    path = write_bag(tmp_path / "one.bag", imu0=imu)
    raw = path.read_bytes()
    (whole,) = euroc.read(path)
    assert found_messages(whole) == (20, "")
    for size, count, said in ((len(raw) - 50, 20, "1 stretches of it lost"), (len(raw) // 2, 4, "2 stretches of it lost")):
        path.write_bytes(raw[:size])
        (recording,) = euroc.read(path)
        found, why = found_messages(recording)
        assert found == count
        assert why.startswith(f"the bag has no index; {count} messages were found chunk by chunk, {said}")
        assert np.array_equal(recording.imu.gyro, whole.imu.gyro[:count])
    path.write_bytes(raw.replace(raw[(at := raw.index(b"index_pos=")) : at + 18], b"index_pos=" + bytes(8)))
    (recording,) = euroc.read(path)
    assert found_messages(recording) == (20, "the bag has no index; 20 messages were found chunk by chunk, nothing of it lost")


@pytest.mark.parametrize("size", [0, 5, 13, 3000, 4200])
def test_a_bag_of_which_nothing_is_left_is_refused(tmp_path, size):
    path = write_bag(tmp_path / "one.bag", imu0=imu)
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(DataError, match=r"one\.bag: cannot be read as a ROS 1 bag"):
        list(euroc.read(path))


def test_a_bag_with_an_index_and_damage_is_refused_with_what_to_do(tmp_path):
    path = write_bag(tmp_path / "one.bag", imu0=imu)
    raw = path.read_bytes()
    path.write_bytes(raw[:7000] + bytes(500) + raw[7500:])
    with pytest.raises(DataError, match=r"one\.bag: cannot be read as a ROS 1 bag .* Save what is there with `imutool repair`"):
        list(euroc.read(path))


def test_without_rosbags_the_message_says_how_to_get_it(tmp_path, monkeypatch):
    path = write_bag(tmp_path / "one.bag", imu0=imu)
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(ConfigError, match=r"pip install 'imutool\[bags\]'"):
        list(euroc.read(path))
