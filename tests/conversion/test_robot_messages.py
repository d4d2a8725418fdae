"""PX4's messages in a bag of ROS 2 become an IMU and poses in FLU and ENU, and paths become trajectories."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from imutool.api.logs import convert
from imutool.conversion.workers import ConvertReport
from imutool.errors import ConfigError, LogError
from imutool.log_info.inspection import inspect
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read

ARRAY = "float32[{}] {}\n"
PX4 = {
    "px4_msgs/msg/SensorCombined": "uint64 timestamp\nint32 RELATIVE_TIMESTAMP_INVALID = 2147483647\nfloat32[3] gyro_rad\n"
    "uint32 gyro_integral_dt\nint32 accelerometer_timestamp_relative\nfloat32[3] accelerometer_m_s2\nuint8 clipping\n",
    "px4_msgs/msg/VehicleImu": "uint64 timestamp\nuint64 timestamp_sample\nuint32 device\nfloat32[3] delta_angle\n"
    "float32[3] delta_velocity\nuint16 delta_angle_dt\nuint16 delta_velocity_dt\n",
    "px4_msgs/msg/SensorGyro": "uint64 timestamp\nuint64 timestamp_sample\nuint32 device_id\nfloat32 x\nfloat32 y\nfloat32 z\n"
    "float32 temperature\nuint32 error_count\nuint8[3] clip_counter\nuint8 samples\n",
    "px4_msgs/msg/VehicleOdometry": "uint64 timestamp\nuint64 timestamp_sample\nuint8 POSE_FRAME_NED = 1\nuint8 pose_frame\n"
    "float32[3] position\nfloat32[4] q\nfloat32[3] velocity\n",
}
PX4["px4_msgs/msg/SensorAccel"] = PX4["px4_msgs/msg/SensorGyro"]
STORE = get_typestore(Stores.ROS2_HUMBLE)
for name, text in PX4.items():
    STORE.register(get_types_from_msg(text, name))
TYPES = STORE.types
COUNT, START_NS, STEP_NS = 60, 1_700_000_000 * 10**9, 10_000_000
T_S = 0.01 * np.arange(COUNT)
R_ENU = Rotation.from_euler("ZYX", np.stack([0.3 + T_S, 0.2 * np.sin(5 * T_S), 0.1 * T_S], axis=1))
P_ENU = np.stack([T_S, 2 * T_S**2, 0.5 + T_S], axis=1)
GYRO, ACCEL = np.array([0.1, 0.2, -0.3]), np.array([0.5, -0.7, 9.8])  # FLU
FRD = np.array([1.0, -1.0, -1.0])
NED = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])


def f32(values: Any) -> np.ndarray:
    return np.asarray(values, np.float32)


def combined(n: int) -> Any:
    return TYPES["px4_msgs/msg/SensorCombined"](10_000 * (n + 500), f32(FRD * GYRO * (n + 1)), 9_000, 0, f32(FRD * ACCEL), 0)


def integrated(n: int) -> Any:
    delta = 0.01 * FRD
    us = 10_000 * (n + 500) + 5_000  # the end of what it integrates
    return TYPES["px4_msgs/msg/VehicleImu"](0, us, 7, f32(delta * GYRO * (n + 1)), f32(delta * ACCEL), 10_000, 10_000)


def single(kind: str, n: int, values: np.ndarray) -> Any:
    us = 10_000 * (n + 500)
    return TYPES[f"px4_msgs/msg/{kind}"](us + 90, us, 7, *f32(FRD * values), 41.0, 0, np.zeros(3, np.uint8), 8)


def odometry(n: int, frame: int = 1) -> Any:
    q_wxyz = (NED * R_ENU[n] * Rotation.from_matrix(np.diag(FRD))).as_quat(scalar_first=True)
    us = 10_000 * (n + 500)
    return TYPES["px4_msgs/msg/VehicleOdometry"](us + 90, us, frame, f32(NED.apply(P_ENU[n])), f32(q_wxyz), f32([0, 0, 0]))


def header(t_ns: int) -> Any:
    return TYPES["std_msgs/msg/Header"](TYPES["builtin_interfaces/msg/Time"](t_ns // 10**9, t_ns % 10**9), "map")


def path(poses: Iterable[int], now: int, stamp_of: int | None = None) -> Any:
    made = []
    for n in poses:
        point, turn = TYPES["geometry_msgs/msg/Point"](*P_ENU[n]), TYPES["geometry_msgs/msg/Quaternion"](*R_ENU[n].as_quat())
        t_ns = START_NS + STEP_NS * (n if stamp_of is None else stamp_of)
        made.append(TYPES["geometry_msgs/msg/PoseStamped"](header(t_ns), TYPES["geometry_msgs/msg/Pose"](point, turn)))
    return TYPES["nav_msgs/msg/Path"](header(START_NS + STEP_NS * now), made)


def written(log: Path, topics: dict[str, list[tuple[int, Any]]], *, defined: bool = True) -> Path:
    """A log of messages by topic, each at its step; with or without definitions."""
    with log.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        for topic, messages in topics.items():
            kind = messages[0][1].__msgtype__
            definition = STORE.generate_msgdef(kind, ros_version=2)[0] if defined else ""
            channel = writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", definition.encode()))
            for n, message in messages:
                t_ns = START_NS + n * STEP_NS
                writer.add_message(channel, t_ns, bytes(STORE.serialize_cdr(message, kind)), t_ns)
        writer.finish()
    return log


def converted(tmp_path: Path, topics: dict[str, list[tuple[int, Any]]]) -> tuple[Path, ConvertReport]:
    source = written(tmp_path / "bag.mcap", topics)
    return tmp_path / "out.mcap", convert(source, tmp_path / "out.mcap")


@pytest.mark.parametrize(("make", "version"), [(combined, ""), (integrated, "_v1")])  # of a message, since PX4 1.16
def test_px4s_imu_and_odometry_arrive_in_flu_and_enu(tmp_path, make, version):
    kind, poses = make(0).__msgtype__, f"/fmu/out/vehicle_odometry{version}"
    topics = {"/fmu/out/imu": [(n, make(n)) for n in range(COUNT)], poses: [(n, odometry(n)) for n in range(COUNT)]}
    out, report = converted(tmp_path, topics)
    recording = read(out, truth=f"{poses}/pose")
    np.testing.assert_allclose(recording.imu.gyro, GYRO * (np.arange(COUNT)[:, None] + 1), rtol=1e-6)
    np.testing.assert_allclose(recording.imu.accel, np.tile(ACCEL, (COUNT, 1)), rtol=1e-6)
    assert recording.imu.t_ns.tolist() == [10_000_000 * (n + 500) for n in range(COUNT)]
    np.testing.assert_allclose(recording.truth.p_wb, P_ENU, atol=1e-6)
    turns = Rotation.from_quat(recording.truth.q_wb_wxyz.copy(), scalar_first=True)
    assert (turns * R_ENU.inv()).magnitude().max() < 1e-6
    with Log(out) as log:
        assert log.topics[f"{poses}/pose"].pose_kind == "estimate"
        assert log.topics["/fmu/out/imu"].schema_name == kind  # PX4's own topic stays
    assert any("in FLU and ENU" in note for note in report.notes)


@pytest.mark.parametrize(("ending", "whole"), [("", "/fmu/out/imu"), ("_1", "/fmu/out/sensor_imu_1")])
def test_px4s_gyro_and_accelerometer_become_one_imu_at_the_log_times_of_the_gyro(tmp_path, ending, whole):
    topics = {
        f"/fmu/out/sensor_gyro{ending}": [(n, single("SensorGyro", n, GYRO * (n + 1))) for n in range(COUNT)],
        f"/fmu/out/sensor_accel{ending}": [(n, single("SensorAccel", n, ACCEL)) for n in range(COUNT)],
    }
    if ending:  # a second pair in the same folder
        topics |= {topic.replace("_1", "_0"): messages for topic, messages in topics.items()}
    source = written(tmp_path / "bag.mcap", topics)
    with Log(source) as log, pytest.raises(LogError, match="imutool convert makes an IMU of PX4's topics"):
        log.only_imu()
    report = convert(source, tmp_path / "out.mcap")
    recording = read(tmp_path / "out.mcap", imu=whole)
    np.testing.assert_allclose(recording.imu.gyro, GYRO * (np.arange(COUNT)[:, None] + 1), rtol=1e-6)
    np.testing.assert_allclose(recording.imu.accel, np.tile(ACCEL, (COUNT, 1)), rtol=1e-6)
    assert recording.imu.t_ns.tolist() == [10_000_000 * (n + 500) for n in range(COUNT)]
    with (tmp_path / "out.mcap").open("rb") as file:
        times = [message.log_time for _, _, message in make_reader(file).iter_messages(topics=[whole])]
    assert times == [START_NS + STEP_NS * n for n in range(COUNT)]
    assert any(note.endswith("in FLU") for note in report.notes)


def test_a_log_that_was_converted_before_gets_no_second_topic(tmp_path):
    topics = {"/fmu/out/imu": [(n, combined(n)) for n in range(COUNT)]}
    topics |= {"/odom": [(n, odometry(n)) for n in range(COUNT)], "/path": [(COUNT, path(range(COUNT), COUNT))]}
    out, _ = converted(tmp_path, topics)
    convert(out, tmp_path / "again.mcap")
    with Log(out) as first, Log(tmp_path / "again.mcap") as second:
        assert {t: d.count for t, d in first.topics.items()} == {t: d.count for t, d in second.topics.items()}


def test_of_messages_without_a_definition_no_empty_topics_are_made(tmp_path):
    """As in bags before Iron: what lacks is said where they are read, and nothing of them is lost."""
    topics = {"/fmu/out/sensor_combined": [(n, combined(n)) for n in range(COUNT)]}
    topics |= {"/fmu/out/sensor_gyro": [(n, single("SensorGyro", n, GYRO)) for n in range(COUNT)]}
    topics |= {"/fmu/out/vehicle_odometry": [(n, odometry(n)) for n in range(COUNT)]}
    report = convert(written(tmp_path / "bag.mcap", topics, defined=False), tmp_path / "out.mcap")
    with Log(tmp_path / "out.mcap") as log:
        assert {name: topic.count for name, topic in log.topics.items()} == dict.fromkeys(topics, COUNT)
    assert (report.losses, [note for note in report.notes if "is made of" in note]) == ([], [])


def test_the_kind_of_poses_in_an_mcap_log_is_the_users(tmp_path):
    """Of those that a topic holds, and of those that are made of PX4's and of paths; of a topic without poses it is refused."""
    topics = {"/odom": [(n, odometry(n)) for n in range(COUNT)], "/path": [(COUNT, path(range(COUNT), COUNT))]}
    source = written(tmp_path / "bag.mcap", topics | {"/fmu/out/imu": [(n, combined(n)) for n in range(COUNT)]})
    first = tmp_path / "first.mcap"
    convert(source, first, kinds=["/odom/pose=truth", "/path/pose=odometry"])
    convert(first, tmp_path / "second.mcap", kinds=["/path/pose=truth"])
    with Log(first) as one, Log(tmp_path / "second.mcap") as two:
        kinds = [[log.topics[f"/{name}/pose"].pose_kind for name in ("odom", "path")] for log in (one, two)]
    assert kinds == [["truth", "odometry"], ["truth", "truth"]]
    for topic in ("/fmu/out/imu", "/nothing", "/fmu/out/imu/pose"):
        with pytest.raises(ConfigError, match=f"'{topic}' holds no poses in bag"):
            convert(source, tmp_path / "third.mcap", kinds=[f"{topic}=truth"])
        assert not (tmp_path / "third.mcap").exists()


def test_info_names_what_convert_would_make(tmp_path):
    log = written(
        tmp_path / "bag.mcap",
        {"/path": [(9, path(range(9), 9))], "/fmu/out/vehicle_imu": [(n, integrated(n)) for n in range(9)]},
    )
    said = inspect(log).warnings
    assert "imutool convert LOG OUT makes poses of /path" in said
    assert "imutool convert LOG OUT makes an IMU of /fmu/out/vehicle_imu" in said
    convert(log, tmp_path / "out.mcap")
    assert not [warning for warning in inspect(tmp_path / "out.mcap").warnings if "imutool convert LOG OUT makes" in warning]


def test_beside_an_imu_of_ros_px4s_is_no_second_one(tmp_path):
    xyz, turn, none = TYPES["geometry_msgs/msg/Vector3"], TYPES["geometry_msgs/msg/Quaternion"](0, 0, 0, 1), np.zeros(9)
    ros = [
        (
            n,
            TYPES["sensor_msgs/msg/Imu"](
                header(START_NS + n * STEP_NS), turn, none, xyz(0, 0, 0.1), none, xyz(0, 0, 9.8), none
            ),
        )
        for n in range(COUNT)
    ]
    out, _ = converted(tmp_path, {"/imu/data": ros, "/fmu/out/imu": [(n, combined(n)) for n in range(COUNT)]})
    with Log(out) as log:
        assert log.imu_topics == ["/imu/data"]


def test_poses_in_a_frame_that_px4_does_not_know_are_a_loss(tmp_path):
    out, report = converted(tmp_path, {"/fmu/out/vehicle_odometry": [(n, odometry(n, n % 2)) for n in range(COUNT)]})
    with Log(out) as log:
        assert log.topics["/fmu/out/vehicle_odometry/pose"].count == COUNT // 2
    assert any(f"without a sample: {COUNT // 2}" in loss for loss in report.losses)


@pytest.mark.parametrize(
    "messages",
    [
        [(n, path(range(n + 1), n)) for n in (0, 1, 20, COUNT - 1)],
        [(n, path(range(max(0, n - 15), n + 1), n)) for n in range(5, COUNT, 9)] + [(COUNT - 1, path([COUNT - 1], COUNT - 1))],
        [(COUNT - 1, path(range(COUNT), COUNT - 1))],
    ],
    ids=["grows", "a window", "once"],
)
def test_paths_become_a_trajectory(tmp_path, messages):
    out, _ = converted(tmp_path, {"/slam/path": messages, "/ground_truth/path": messages})
    with Log(out) as log:
        assert {log.topics[f"{t}/path/pose"].pose_kind for t in ("/slam", "/ground_truth")} == {"estimate", "truth"}
        batches = list(log.pose_batches("/slam/path/pose"))
        assert {batch.frame_id for batch in batches} == {"map"}
        stamps, p = (np.concatenate([getattr(b, field) for b in batches]) for field in ("stamp_ns", "p_wb"))
        q = np.concatenate([batch.q_wb_wxyz for batch in batches])
    assert stamps.tolist() == [START_NS + STEP_NS * n for n in range(COUNT)]
    np.testing.assert_array_equal(p, P_ENU)
    np.testing.assert_allclose(np.abs((q * R_ENU.as_quat(scalar_first=True)).sum(axis=1)), 1.0, rtol=1e-12)


def test_a_later_path_replaces_what_the_one_before_estimated(tmp_path):
    moved = path(range(COUNT), COUNT)
    for n, stamped in enumerate(moved.poses):
        stamped.pose.position.x = 100.0 + n
    out, _ = converted(tmp_path, {"/slam/path": [(COUNT - 1, path(range(COUNT), COUNT)), (COUNT, moved)]})
    with Log(out) as log:
        p = np.concatenate([batch.p_wb for batch in log.pose_batches("/slam/path/pose")])
    assert p[:, 0].tolist() == [100.0 + n for n in range(COUNT)]


@pytest.mark.parametrize(
    "plan", [path(range(COUNT), 5, stamp_of=5), path(range(10, COUNT), 5), path(range(COUNT), 0, stamp_of=-170_000_000_000)]
)
def test_a_plan_is_no_trajectory(tmp_path, plan):
    """Its poses have one stamp, stamps of the future, or none."""
    out, _ = converted(tmp_path, {"/plan": [(5, plan)], "/odom": [(n, odometry(n)) for n in range(COUNT)]})
    with Log(out) as log:
        assert "/plan/pose" not in log.topics
