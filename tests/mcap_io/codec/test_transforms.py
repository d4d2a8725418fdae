"""Foxglove's transforms are poses of child frames, an estimate unless they are named."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from imutool.api.logs import convert
from imutool.cleaning.truth import read_truth
from imutool.log_info.inspection import inspect
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read

COUNT, STEP_NS, START_NS = 40, 10_000_000, 1_700_000_000_000_000_000
T_NS = START_NS + STEP_NS * np.arange(COUNT)


def transform(parent: str, child: str, t_ns: int, x: float) -> dict[str, object]:
    stamp = {"sec": t_ns // 10**9, "nsec": t_ns % 10**9}
    frames = {"parent_frame_id": parent, "child_frame_id": child}
    return {"timestamp": stamp, **frames, "translation": {"x": x, "y": 1, "z": 2}, "rotation": {"x": 0, "y": 0, "z": 0, "w": 1}}


def imu(n: int) -> dict[str, object]:
    return {"angular_velocity": {"x": 0.1, "y": 0.0, "z": 0.0}, "linear_acceleration": {"x": 0.0, "y": 0.0, "z": 9.81}}


Frames = tuple[tuple[str, str], ...]


def write(path: Path, several: bool, topic: str = "/tf", frames: Frames = (("world", "body"), ("body", "camera"))) -> Path:
    """Log of a body and of a camera on it, in one topic."""
    name = "foxglove.FrameTransforms" if several else "foxglove.FrameTransform"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels = [
            writer.register_channel(topic, "json", writer.register_schema(schema, "jsonschema", b"{}"))
            for topic, schema in (("/imu", "Imu"), (topic, name))
        ]
        for n, t in enumerate(T_NS.tolist()):
            each = [transform(*pair, t, float(n) if pair[1] == "body" else 0.5) for pair in frames]
            messages = [imu(n), *([{"transforms": each}] if several else each)]
            for channel, message in zip([channels[0]] + [channels[1]] * 2, messages, strict=False):
                writer.add_message(channel, t, json.dumps(message).encode(), t)
        writer.finish()
    return path


@pytest.mark.parametrize("several", [False, True])
def test_a_transform_is_a_pose_of_its_child_and_an_estimate_unless_it_is_named(tmp_path: Path, several: bool) -> None:
    path = write(tmp_path / "log.mcap", several)
    with Log(path) as log:
        assert (log.topics["/tf"].schema_name, log.topics["/tf"].pose_kind) == (schemas.TF, "estimate")
    assert not read(path).truths
    recording = read(path, truth="/tf/body")
    assert np.array_equal(recording.truth.t_ns, T_NS)
    assert recording.truth.p_wb.tolist() == [[float(n), 1.0, 2.0] for n in range(COUNT)]
    assert (recording.truth.q_wb_wxyz == [1.0, 0.0, 0.0, 0.0]).all()
    assert "/tf/body (estimate) is no truth" in recording.truth_caveat


def test_a_body_that_turns_comes_ahead_of_a_wall(tmp_path: Path) -> None:
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels = [
            writer.register_channel(topic, "json", writer.register_schema(schema, "jsonschema", b"{}"))
            for topic, schema in (("/imu", "Imu"), ("/mocap/tf", "foxglove.FrameTransforms"))
        ]
        for n, t in enumerate(T_NS.tolist()):
            turned = {"x": float(np.sin(n / 99)), "y": 0.0, "z": 0.0, "w": float(np.cos(n / 99))}
            each = [transform("map", "wall", t, 3.0), {**transform("map", "drone", t, float(n)), "rotation": turned}]
            for channel, message in zip(channels, (imu(n), {"transforms": each}), strict=True):
                writer.add_message(channel, t, json.dumps(message).encode(), t)
        writer.finish()
    assert list(read(tmp_path / "log.mcap").truths) == ["/mocap/tf/drone", "/mocap/tf/wall"]
    with Log(tmp_path / "log.mcap") as log:
        truth = read_truth(log)
    assert truth is not None
    assert truth.p_wb[1, 0] == 10.0


def test_convert_writes_transforms_of_ros_also_where_a_message_lists_none(tmp_path: Path) -> None:
    frames = [], [transform("map", "body", 5, 1.0)]
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        tf = writer.register_channel("/tf", "json", writer.register_schema("foxglove.FrameTransforms", "jsonschema", b"{}"))
        for each in frames:
            writer.add_message(tf, 7, json.dumps({"transforms": each}).encode(), 7)
        writer.finish()
    assert not convert(tmp_path / "log.mcap", tmp_path / "out.mcap").losses
    with Log(tmp_path / "out.mcap") as log:
        assert [log.topics[name].count for name in ("/tf", "/tf/as_recorded")] == [2, 2]
        assert [batch.p_wb.tolist() for batch in log.pose_batches("/tf")] == [[[1.0, 1.0, 2.0]]]


def test_info_names_the_bodies_that_are_seen_in_a_world(tmp_path: Path) -> None:
    (pose,) = inspect(write(tmp_path / "log.mcap", True)).truth
    assert (pose.topic, pose.poses, pose.kind) == ("/tf/body", COUNT, "estimate")


@pytest.mark.parametrize(
    "frames",
    [(("body", "wheel"), ("world", "body")), (("map", "odom"), ("odom", "body")), (("a/odom", "body"), ("body", "a/odom"))],
)
def test_joints_and_worlds_of_a_tree_are_no_bodies(tmp_path: Path, frames: Frames) -> None:
    path = write(tmp_path / "log.mcap", True, "/mocap/tf", frames)
    assert list(read(path).truths) == ["/mocap/tf/body"]
    assert [pose.topic for pose in inspect(path).truth] == ["/mocap/tf/body"]
    with Log(path) as log:
        truth = read_truth(log)
    assert truth is not None
    assert truth.p_wb[:, 0].tolist() == [0.0, 10.0, 20.0, 30.0]


MODELS = "string[] name\ngeometry_msgs/Pose[] pose\ngeometry_msgs/Twist[] twist\n"
LISTS = {"geometry_msgs/msg/PoseArray": ["1_of_2", "2_of_2"], "gazebo_msgs/msg/ModelStates": ["wall", "drone"]}


def list_of_poses(path: Path, topic: str, kind: str, bodies: int = 2) -> Path:
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(MODELS, "gazebo_msgs/msg/ModelStates"))
    kinds = store.types
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        text = store.generate_msgdef(kind, ros_version=2)[0].encode()
        imus = writer.register_channel("/imu", "json", writer.register_schema("Imu", "jsonschema", b"{}"))
        lists = writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", text))
        for n, t in enumerate(T_NS.tolist()):
            turned = kinds["geometry_msgs/msg/Quaternion"](np.sin(n / 99), 0.0, 0.0, np.cos(n / 99))
            places = [(3.0, kinds["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)), *[(float(n), turned)] * (bodies - 1)]
            poses = [kinds["geometry_msgs/msg/Pose"](kinds["geometry_msgs/msg/Point"](x, 1.0, 2.0), q) for x, q in places]
            stamp = kinds["builtin_interfaces/msg/Time"](t // 10**9, t % 10**9)
            head = kinds["std_msgs/msg/Header"](stamp, "map")
            fields = (head, poses) if kind.endswith("PoseArray") else (["wall", "drone"], poses, [])
            message = bytes(store.serialize_cdr(kinds[kind](*fields), kind))
            for channel, raw in ((imus, json.dumps(imu(n)).encode()), (lists, message)):
                writer.add_message(channel, t, raw, t)
        writer.finish()
    return path


@pytest.mark.parametrize("kind", LISTS)
def test_the_bodies_of_a_list_of_true_poses_are_told_apart(tmp_path: Path, kind: str) -> None:
    path = list_of_poses(tmp_path / "log.mcap", "/gt/poses", kind)
    truths = read(path).truths
    still, moving = (f"/gt/poses/{name}" for name in LISTS[kind])
    assert list(truths) == [moving, still]
    assert np.array_equal(truths[moving].t_ns, T_NS)
    assert truths[moving].p_wb.tolist() == [[float(n), 1.0, 2.0] for n in range(COUNT)]


def test_gazebo_states_are_true_by_their_type(tmp_path: Path) -> None:
    with Log(list_of_poses(tmp_path / "log.mcap", "/states", "gazebo_msgs/msg/ModelStates")) as log:
        assert log.truth_topics == ["/states"]


def test_an_array_of_poses_counts_if_it_is_named_true(tmp_path: Path) -> None:
    """Most are goals, detections or particles."""
    path = list_of_poses(tmp_path / "log.mcap", "/array", "geometry_msgs/msg/PoseArray")
    assert not read(path).truths
    convert(path, tmp_path / "true.mcap", kinds=["/array=truth"])
    assert list(read(tmp_path / "true.mcap").truths) == ["/array/2_of_2", "/array/1_of_2"]


def test_a_cloud_of_poses_holds_no_bodies(tmp_path: Path) -> None:
    path = list_of_poses(tmp_path / "log.mcap", "/gt/poses", "geometry_msgs/msg/PoseArray", bodies=100)
    assert not read(path).truths
