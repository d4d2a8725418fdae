"""`convert --fix`: a log in other units, axes and frames comes out as it was recorded, and says what was changed."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from imutool import registry
from imutool.api.logs import convert
from imutool.api.models import debias as debias_log
from imutool.bias.model_file import shipped_for
from imutool.cleaning.pose_quaternions import MISREAD, OTHER_WORLD
from imutool.conversion import correction_rounds
from imutool.conversion.corrections import RECORD, Corrections
from imutool.conversion.message_writer import write_log
from imutool.conversion.shared_corrections import fitted_to, shared
from imutool.converters import fetch
from imutool.errors import DataError, LogError
from imutool.evaluation import evaluate
from imutool.log_info.inspection import inspect
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read
from imutool.mcap_io.write import write
from imutool.recording import Imu, Poses, Recording
from imutool.recording.message_log import Message, MessageLog, MessageTopic
from imutool.sensor.made_up_flight import flight

P = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])

MakeMessages = Callable[[int, list[float], list[float]], list[bytes]]  # of a time, a position and a quaternion


@pytest.fixture(scope="module")
def made() -> Recording:
    return flight(3, duration_s=20.0, rate_hz=100.0, truth_rate_hz=50.0)


def in_ned(poses: Poses) -> Poses:
    q_wxyz = (Rotation.from_matrix(NED) * Rotation.from_quat(poses.q_wb_wxyz.copy(), scalar_first=True)).as_quat(
        scalar_first=True
    )
    return Poses(poses.t_ns, poses.p_wb @ NED.T, q_wxyz, None if poses.v_w is None else poses.v_w @ NED.T)


def assert_comes_back(log: Path, made: Recording) -> None:
    """The true poses are those that were made, and nothing is warned of."""
    fixed = read(log)
    turn, true = (Rotation.from_quat(q.copy(), scalar_first=True) for q in (fixed.truth.q_wb_wxyz, made.truth.q_wb_wxyz))
    assert (turn * true.inv()).magnitude().max() < 1e-7
    np.testing.assert_array_equal(fixed.truth.p_wb, made.truth.p_wb)
    assert inspect(log).warnings == []


@pytest.mark.parametrize("accel_axes", [P, -P], ids=["both turned", "accel negated too"])
def test_a_log_in_g_and_degrees_permuted_in_ned_comes_back(accel_axes: np.ndarray, made: Recording, tmp_path: Path) -> None:
    wrong = Imu(made.imu.t_ns, np.rad2deg(made.imu.gyro @ P.T), made.imu.accel @ accel_axes.T / 9.80665)
    write(replace(made, imu=wrong, truths={k: in_ned(v) for k, v in made.truths.items()}), tmp_path / "wrong.mcap")
    before = (tmp_path / "wrong.mcap").read_bytes()
    assert [w for w in inspect(tmp_path / "wrong.mcap").warnings if "--fix" in w]
    report = convert(tmp_path / "wrong.mcap", tmp_path / "right.mcap", fix=True)
    fixed = read(tmp_path / "right.mcap")
    alike = (accel_axes == P).all()  # then the sensor keeps its axes, and the body of the poses is turned to it
    np.testing.assert_allclose(fixed.imu.gyro @ (P if alike else np.eye(3)), made.imu.gyro, rtol=0, atol=1e-13)
    np.testing.assert_allclose(fixed.imu.accel @ (P if alike else np.eye(3)), made.imu.accel, rtol=0, atol=1e-12)
    np.testing.assert_allclose(fixed.truth.p_wb, made.truth.p_wb, rtol=0, atol=0)
    turn = Rotation.from_quat(fixed.truth.q_wb_wxyz.copy(), scalar_first=True)
    turn = turn * Rotation.from_matrix(P) if alike else turn
    true = Rotation.from_quat(made.truth.q_wb_wxyz.copy(), scalar_first=True)
    assert (turn * true.inv()).magnitude().max() < 1e-7
    assert inspect(tmp_path / "right.mcap").warnings == []
    with Log(tmp_path / "right.mcap") as log:
        assert set(log.metadata()[RECORD]) == {"/imu0", "/ground_truth/pose"}
    assert any("times 9.80665" in note for note in report.notes)
    assert (tmp_path / "wrong.mcap").read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["right.mcap", "wrong.mcap"]


@pytest.mark.parametrize("scale", [100.0, 1000.0])
def test_positions_in_other_units_come_back_in_metres(scale: float, made: Recording, tmp_path: Path) -> None:
    v_w = None if made.truth.v_w is None else scale * made.truth.v_w
    large = replace(made.truth, p_wb=scale * made.truth.p_wb, v_w=v_w)
    other = replace(made.truth, p_wb=made.truth.p_wb + np.array([0.5, 0.0, 0.0]), v_w=None)
    write(replace(made, truths={"/ground_truth/pose": large, "/ground_truth_leica/pose": other}), tmp_path / "large.mcap")
    (warning,) = inspect(tmp_path / "large.mcap").warnings
    assert f"are in {'mm' if scale > 100 else 'cm'} and not in m" in warning
    convert(tmp_path / "large.mcap", tmp_path / "right.mcap", fix=True)
    fixed = read(tmp_path / "right.mcap")
    np.testing.assert_allclose(fixed.truth.p_wb, made.truth.p_wb, rtol=1e-12)
    if made.truth.v_w is not None:
        np.testing.assert_allclose(fixed.truth.v_w, made.truth.v_w, rtol=1e-12)
    np.testing.assert_array_equal(fixed.truths["/ground_truth_leica/pose"].p_wb, other.p_wb)  # in the same frame, and in metres
    with Log(tmp_path / "right.mcap") as log:
        transforms = np.concatenate([batch.p_wb for batch in log.pose_batches("/tf")])
        assert "positions are now in m" in log.metadata()[RECORD]["/ground_truth/pose"]
    np.testing.assert_allclose(transforms, made.truth.p_wb, rtol=1e-12)
    assert inspect(tmp_path / "right.mcap").warnings == []


def test_a_turned_body_of_the_poses_comes_back_to_the_imu(made: Recording, tmp_path: Path) -> None:
    """Poses of another frame than the IMU's, as of a marker that was mounted askew, and the transform next to them."""
    turn = Rotation.from_rotvec([20.0, -30.0, 25.0], degrees=True)
    true = Rotation.from_quat(made.truth.q_wb_wxyz.copy(), scalar_first=True)
    askew = replace(made.truth, q_wb_wxyz=(true * turn).as_quat(scalar_first=True))
    write(replace(made, truths={"/ground_truth/pose": askew}), tmp_path / "askew.mcap")
    report = convert(tmp_path / "askew.mcap", tmp_path / "straight.mcap", fix=True)
    fixed = read(tmp_path / "straight.mcap")
    left = Rotation.from_quat(fixed.truth.q_wb_wxyz.copy(), scalar_first=True) * true.inv()
    assert np.degrees(left.magnitude()).max() < 1.0  # the sensor's own misalignment is of that size
    assert (fixed.truth.p_wb == made.truth.p_wb).all()
    assert any("the body is now that of the IMU" in note for note in report.notes)
    assert inspect(tmp_path / "straight.mcap").warnings == []
    with Log(tmp_path / "straight.mcap") as log:
        transforms = np.concatenate([batch.q_wb_wxyz for batch in log.pose_batches("/tf")])
    np.testing.assert_allclose(np.abs((transforms * fixed.truth.q_wb_wxyz).sum(axis=1)), 1.0, atol=1e-9)


def as_messages(made: Recording, kind: str, target: Path) -> Path:
    """Log of an IMU beside poses as messages that name their body, in ROS 2."""
    types = (store := get_typestore(Stores.ROS2_HUMBLE)).types
    vector, point = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Point"]

    def message(t_ns: int, p: list[float], q: list[float]) -> object:
        header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](*divmod(t_ns, 10**9)), "map")
        orientation = types["geometry_msgs/msg/Quaternion"](*q[1:], q[0])
        if kind == "geometry_msgs/msg/TransformStamped":
            return types[kind](header, "body", types["geometry_msgs/msg/Transform"](vector(*p), orientation))
        pose, twist = types["geometry_msgs/msg/Pose"](point(*p), orientation), types["geometry_msgs/msg/Twist"]
        known, of_twist = (types[f"geometry_msgs/msg/{name}WithCovariance"] for name in ("Pose", "Twist"))
        moving = twist(vector(1.0, 2.0, 3.0), vector(4.0, 5.0, 6.0))
        return types[kind](header, "body", known(pose, np.zeros(36)), of_twist(moving, np.diag(np.arange(1.0, 7.0)).ravel()))

    write(replace(made, truths={}), target)
    content = (module := registry.load("imutool.converters", "mcap_log")).read_sequence(next(iter(module.sequences(target))))
    topic = MessageTopic("/gt/body", kind, "ros2msg", store.generate_msgdef(kind, ros_version=2)[0].encode(), "cdr")
    rows = zip(made.truth.t_ns.tolist(), made.truth.p_wb.tolist(), made.truth.q_wb_wxyz.tolist(), strict=True)
    poses = [Message(topic, t, t, bytes(store.serialize_cdr(message(t, p, q), kind))) for t, p, q in rows]
    both = sorted([*content.messages(), *poses], key=lambda each: each.log_time)
    write_log(replace(content, messages=lambda: iter(both)), target, compression="none", overwrite=True)
    return target


@pytest.mark.parametrize("kind", ["nav_msgs/msg/Odometry", "geometry_msgs/msg/TransformStamped"])
def test_a_turned_body_of_poses_that_name_it_comes_back(kind: str, made: Recording, tmp_path: Path) -> None:
    """Without a tree of frames next to them: a Vicon bridge's topic, an INS's odometry, whose twist is in the body's axes."""
    turn, true = (
        Rotation.from_euler("z", 180.0, degrees=True),
        Rotation.from_quat(made.truth.q_wb_wxyz.copy(), scalar_first=True),
    )
    turned = replace(made.truth, q_wb_wxyz=(true * turn).as_quat(scalar_first=True))
    log = as_messages(replace(made, truths={"/ground_truth/pose": turned}), kind, tmp_path / "turned.mcap")
    convert(log, tmp_path / "straight.mcap", fix=True)
    fixed = Rotation.from_quat(read(tmp_path / "straight.mcap").truth.q_wb_wxyz.copy(), scalar_first=True)
    assert np.degrees((fixed * true.inv()).magnitude()).max() < 1e-5
    assert inspect(tmp_path / "straight.mcap").warnings == []
    if kind.endswith("Odometry"):
        with (tmp_path / "straight.mcap").open("rb") as file:
            (_, _, _, odometry), *_ = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages(
                ["/gt/body"]
            )
        velocity, rate = odometry.twist.twist.linear, odometry.twist.twist.angular
        np.testing.assert_allclose(
            [velocity.x, velocity.y, velocity.z, rate.x, rate.y, rate.z], [-1, -2, 3, -4, -5, 6], atol=1e-12
        )
        np.testing.assert_allclose(odometry.twist.covariance[::7], np.arange(1.0, 7.0), atol=1e-12)


def test_quaternions_in_ned_beside_positions_in_enu_come_back(made: Recording, tmp_path: Path) -> None:
    """Their positions were scored as if gravity pointed up."""
    wrong = replace(made.truth, q_wb_wxyz=in_ned(made.truth).q_wb_wxyz)
    write(replace(made, truths={"/ground_truth/pose": wrong}), tmp_path / "wrong.mcap")
    (warning,) = inspect(tmp_path / "wrong.mcap").warnings
    assert OTHER_WORLD in warning
    assert evaluate(tmp_path / "wrong.mcap")[0]["ape_m"] is None
    convert(tmp_path / "wrong.mcap", tmp_path / "right.mcap", fix=True)
    assert_comes_back(tmp_path / "right.mcap", made)


@pytest.mark.parametrize("what", MISREAD)
def test_misread_quaternions_come_back_and_what_they_hid_too(what: str, made: Recording, tmp_path: Path) -> None:
    """In NED, so that a second error shows only after the first."""
    rows, signs = MISREAD[what]
    poses = in_ned(made.truth)
    misread = np.empty_like(poses.q_wb_wxyz)
    misread[:, rows] = poses.q_wb_wxyz * signs
    write(replace(made, truths={"/ground_truth/pose": replace(poses, q_wb_wxyz=misread)}), tmp_path / "wrong.mcap")
    warnings = inspect(tmp_path / "wrong.mcap").warnings
    assert len(warnings) == 1  # and not that the poses turn unlike the gyro, which follows from it
    assert what in warnings[0]
    assert "--fix" in warnings[0]
    convert(tmp_path / "wrong.mcap", tmp_path / "right.mcap", fix=True)
    assert_comes_back(tmp_path / "right.mcap", made)
    q_wxyz = read(tmp_path / "right.mcap").truth.q_wb_wxyz
    with Log(tmp_path / "right.mcap") as log:
        assert what in log.metadata()[RECORD]["/ground_truth/pose"]
        transforms = np.concatenate([batch.q_wb_wxyz for batch in log.pose_batches("/tf")])
    np.testing.assert_allclose(np.abs((transforms * q_wxyz).sum(axis=1)), 1.0, atol=1e-9)


@pytest.mark.parametrize("late_s", [1.2, -1_600_000_000.0])
def test_late_poses_of_a_turned_body_in_another_world_are_corrected_at_once(tmp_path: Path, late_s: float) -> None:
    """As a motion capture gives them: a clock of its own, markers mounted askew, y up. Each error hides the next."""
    made = flight(3, duration_s=40.0, rate_hz=50.0, truth_rate_hz=25.0)
    turn = Rotation.from_rotvec([42.0, 20.0, 110.0], degrees=True)
    y_up = Rotation.from_euler("x", -90.0, degrees=True)
    true = Rotation.from_quat(made.truth.q_wb_wxyz.copy(), scalar_first=True)
    q_wxyz = (y_up * true * turn).as_quat(scalar_first=True)
    late = Poses(made.truth.t_ns + round(late_s * 1e9), made.truth.p_wb @ y_up.as_matrix().T, q_wxyz)
    write(replace(made, truths={"/vicon/pose": late}), tmp_path / "late.mcap")
    convert(tmp_path / "late.mcap", tmp_path / "right.mcap", fix=True)
    assert inspect(tmp_path / "right.mcap").warnings == []
    fixed = read(tmp_path / "right.mcap")
    assert np.abs(fixed.truth.t_ns - made.truth.t_ns).max() < 5_000_000
    with Log(tmp_path / "right.mcap") as log:
        said = log.metadata()[RECORD]["/vicon/pose"]
        times_ns = np.concatenate([part for topic in ("/imu0", "/vicon/pose") for part in log.stamps(topic)])
    assert np.ptp(times_ns) < 41e9  # log times have moved with the stamps
    assert all(
        part in said
        for part in (
            "earlier now" if late_s > 0 else "later now",
            "the body is now that of the IMU",
            "the world's x, y, z are now",
        )
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["late.mcap", "right.mcap"]


def test_short_logs_are_corrected_as_the_others_of_their_setup_and_a_right_one_stays(tmp_path: Path) -> None:
    """Seven seconds show no order of axes and no unit of positions; a log of another setup contradicts the others."""
    turn, y_up = Rotation.from_rotvec([3.0, -2.0, 94.0], degrees=True), Rotation.from_euler("x", -90.0, degrees=True)
    made = flight(3, duration_s=40.0, rate_hz=100.0, truth_rate_hz=50.0)
    start_ns = int(made.imu.t_ns[0])
    spans_s = {
        "long_1": (0.0, 40.0),
        "long_2": (5.0, 35.0),
        "short_1": (20.0, 27.0),
        "short_2": (30.0, 37.0),
        "right": (8.0, 40.0),
    }
    (tmp_path / "in").mkdir()
    for name, ends_s in spans_s.items():
        first_ns, last_ns = (start_ns + round(s * 1e9) for s in ends_s)
        poses = made.truth.between(first_ns, last_ns)
        if name != "right":
            q_wxyz = y_up * Rotation.from_quat(poses.q_wb_wxyz.copy(), scalar_first=True) * turn
            p_wb = 1000.0 * poses.p_wb @ y_up.as_matrix().T
            poses = Poses(poses.t_ns + 80_000_000, p_wb, q_wxyz.as_quat(scalar_first=True))
        part = replace(made, imu=made.imu.between(first_ns, last_ns), truths={"/vicon/pose": poses})
        write(part, tmp_path / "in" / f"{name}.mcap")
    alone = convert(tmp_path / "in" / "short_1.mcap", tmp_path / "alone.mcap", fix=True)
    assert not any("positions are now in m" in note for note in alone.notes)
    report = convert(tmp_path / "in", tmp_path / "out", fix=True, workers=1)
    assert [note.partition(":")[0] for note in report.notes if "as in the other logs" in note] == [
        "short_1.mcap",
        "short_2.mcap",
    ]
    assert "right.mcap: the motion shows nothing to correct" in report.notes
    for name in spans_s:
        fixed = read(tmp_path / "out" / f"{name}.mcap").truth
        true = made.truth.at(fixed.t_ns)[0]
        turns = [Rotation.from_quat(poses.q_wb_wxyz.copy(), scalar_first=True) for poses in (fixed, true)]
        assert np.degrees((turns[0] * turns[1].inv()).magnitude()).max() < 2.0, name
        np.testing.assert_allclose(fixed.p_wb, true.p_wb, atol=0.05, err_msg=name)


def test_an_axis_of_a_gyro_that_reads_the_opposite_is_reversed_also_where_a_log_is_too_short_to_show_it(
    data: Path, tmp_path: Path
) -> None:
    """FETCH's gyro is left-handed (y); the robot of 07_left_turn pitches and rolls too little to show it."""
    names = ("05_random", "06_right_turn", "07_left_turn")
    (tmp_path / "fetch").mkdir()
    for name in names:
        (tmp_path / "fetch" / name).symlink_to(data / "fetch" / name)
    report = convert(tmp_path / "fetch", tmp_path / "out", fix=True, workers=1)
    assert [note for note in report.notes if "left-handed" in note] == []
    for name in names:
        (recorded,) = fetch.read(data / "fetch" / name)
        fixed = read(tmp_path / "out" / f"{name}.mcap").imu
        np.testing.assert_array_equal(fixed.gyro, recorded.imu.gyro * (1.0, -1.0, 1.0), err_msg=name)
        np.testing.assert_array_equal(fixed.accel, recorded.imu.accel, err_msg=name)
        assert not any("opposite sign" in warning for warning in inspect(tmp_path / "out" / f"{name}.mcap").warnings)
        about = read(tmp_path / "out" / f"{name}.mcap").metadata["imutool"]
        assert about["sensor"] == "fetch, axes corrected"
        assert shipped_for({**about, "sensor": "fetch"})
        assert shipped_for(about) == ["fetch_axes_corrected-hybrid"], "the others are of the axes as recorded"


def test_a_log_whose_poses_have_another_delay_does_not_get_that_of_the_others(tmp_path: Path) -> None:
    """Seven seconds measure no delay, but they contradict one."""
    made = flight(3, duration_s=40.0, rate_hz=100.0, truth_rate_hz=50.0)
    start_ns = int(made.imu.t_ns[0])
    logs = {  # ends in s, delay in ms, and whether that is taken off
        "long_1": (0.0, 40.0, 80, True),
        "long_2": (5.0, 35.0, 80, True),
        "alike": (20.0, 27.0, 80, True),
        "none": (20.0, 27.0, 0, False),
        "late": (20.0, 27.0, 200, False),
        "early": (20.0, 27.0, -60, False),
        "right": (5.0, 35.0, 0, False),
    }
    (tmp_path / "in").mkdir()
    for name, (first_s, last_s, late_ms, _) in logs.items():
        ends_ns = [start_ns + round(s * 1e9) for s in (first_s, last_s)]
        poses = made.truth.between(*ends_ns)
        late = replace(poses, t_ns=poses.t_ns + late_ms * 1_000_000)
        write(replace(made, imu=made.imu.between(*ends_ns), truths={"/vicon/pose": late}), tmp_path / "in" / f"{name}.mcap")
    notes = convert(tmp_path / "in", tmp_path / "out", fix=True, workers=1).notes
    for name, (_, _, late_ms, is_corrected) in logs.items():
        before, after = (read(tmp_path / folder / f"{name}.mcap").truth.t_ns[0] for folder in ("in", "out"))
        if is_corrected:
            assert abs(before - after - late_ms * 1_000_000) < 5_000_000, name
        else:
            assert before == after, name
            said = f"{name}.mcap: /vicon/pose keeps its clock: in the other logs it is 8"
            assert any(note.startswith(said) and note.endswith("which its own motion contradicts") for note in notes), name


def test_a_small_delay_that_a_log_shows_is_not_replaced_by_a_larger_one_of_the_others(tmp_path: Path) -> None:
    """Two sessions of one setup: the clocks differ by less than two delays of one session may."""
    made = flight(3, duration_s=40.0, rate_hz=100.0, truth_rate_hz=50.0)
    (tmp_path / "in").mkdir()
    for name, late_ms in {"first": 27, "second": 27, "other": 6}.items():
        late = replace(made.truth, t_ns=made.truth.t_ns + late_ms * 1_000_000)
        write(replace(made, truths={"/vicon/pose": late}), tmp_path / "in" / f"{name}.mcap")
    convert(tmp_path / "in", tmp_path / "out", fix=True, workers=1)
    for name, left_ms in {"first": 0, "second": 0, "other": 6}.items():
        left_ns = read(tmp_path / "out" / f"{name}.mcap").truth.t_ns - made.truth.t_ns
        assert np.abs(left_ns - left_ms * 1_000_000).max() < 3_000_000, name


def test_what_logs_show_of_poses_by_an_imu_that_others_correct_is_not_shared() -> None:
    """An accelerometer in other axes than its gyro makes the world of the poses look turned, where the log shows no more."""
    turned, world = np.stack([P, np.eye(3)]), np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    right, misled = Corrections({"/imu0": turned}, pose_topic="/p"), Corrections(world=world, pose_topic="/p")
    common, lacking = shared({0: right, 1: right, 2: misled, 3: misled, 4: misled})
    np.testing.assert_array_equal(common.imus["/imu0"], turned)
    np.testing.assert_array_equal(common.world, np.eye(3))
    assert lacking == [2, 3, 4]


def test_logs_share_what_most_of_those_that_show_anything_agree_on() -> None:
    degrees, turned = np.stack([np.radians(1.0) * np.eye(3), np.eye(3)]), np.stack([P, P])
    shows, shows_other, shows_nothing = Corrections({"/imu0": degrees}), Corrections({"/imu0": turned}), Corrections()
    common, lacking = shared({0: shows, 1: shows, 2: shows_nothing, 3: shows_other})
    np.testing.assert_array_equal(common.imus["/imu0"], degrees)
    assert lacking == [2]  # and the last keeps what it shows itself
    for some in ([shows, shows_nothing], [shows, shows, shows_other, shows_other], [shows_nothing] * 3):
        common, lacking = shared(dict(enumerate(some)))
        assert (common.imus, lacking) == ({}, [])
    late = [Corrections(pose_topic="/p", late_ns=ms * 1_000_000) for ms in (-70, -80, -90, -700)]
    common, lacking = shared(dict(enumerate([*late, Corrections()])))
    assert (common.late_ns, lacking) == (-80_000_000, [4])  # of its own delay a log says most


def test_a_small_delay_does_not_turn_the_body(tmp_path: Path) -> None:
    """At 60 ms the poses still explain most of the gyro, by a rotation that is off by degrees."""
    made = flight(3, duration_s=40.0, rate_hz=50.0, truth_rate_hz=25.0)
    turn = Rotation.from_rotvec([20.0, -30.0, 25.0], degrees=True)
    true = Rotation.from_quat(made.truth.q_wb_wxyz.copy(), scalar_first=True)
    for name, late_ns in (("late", 60_000_000), ("punctual", 0)):
        poses = Poses(made.truth.t_ns + late_ns, made.truth.p_wb, (true * turn).as_quat(scalar_first=True))
        write(replace(made, truths={"/vicon/pose": poses}), tmp_path / f"{name}.mcap")
        convert(tmp_path / f"{name}.mcap", tmp_path / f"{name}_right.mcap", fix=True)
    late, punctual = (
        Rotation.from_quat(read(tmp_path / f"{name}_right.mcap").truth.q_wb_wxyz.copy(), scalar_first=True)
        for name in ("late", "punctual")
    )
    assert np.degrees((late * punctual.inv()).magnitude()).max() < 0.2


def test_point_clouds_are_written_once_and_not_in_every_round(
    made: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(replace(made, imu=replace(made.imu, gyro=made.imu.gyro @ P.T, accel=made.imu.accel @ P.T)), tmp_path / "turned.mcap")
    with (tmp_path / "turned.mcap").open("rb") as file, (tmp_path / "clouds.mcap").open("wb") as target:
        writer = Writer(target)
        writer.start("ros2")
        cloud = writer.register_schema("sensor_msgs/msg/PointCloud2", "ros2msg", b"uint8[] data")
        channels = {"/points": writer.register_channel("/points", "cdr", cloud)}
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.topic not in channels:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", kind, channel.metadata)
            writer.add_message(channels[channel.topic], message.log_time, message.data, message.publish_time)
        writer.add_message(channels["/points"], message.log_time, b"\0\1\0\0\0\0\0\0", message.log_time)
        writer.finish()
    written: list[set[str]] = []

    def noted(content: MessageLog, *args: object, **options: object) -> None:
        written.append({message.topic.name for message in content.messages()})
        write_log(content, *args, **options)

    monkeypatch.setattr(correction_rounds, "write_log", noted)
    convert(tmp_path / "clouds.mcap", tmp_path / "right.mcap", fix=True)
    assert ["/points" in topics for topics in written] == [False] * (len(written) - 1) + [True]
    assert len(written) > 1
    assert all("/imu0" in topics for topics in written)


def test_poses_of_another_frame_keep_their_clock(tmp_path: Path) -> None:
    """Odometry on the IMU's clock, in a frame of its own, next to a motion capture on another clock."""
    made = flight(3, duration_s=40.0, rate_hz=50.0, truth_rate_hz=25.0)
    late = replace(made.truth, t_ns=made.truth.t_ns + 3_600 * 10**9)
    write(replace(made, truths={"/mocap/pose": late, "/odom/pose": made.truth}), tmp_path / "both.mcap")
    corrections = Corrections(frame_id="world", late_ns=3_600 * 10**9, pose_topic="/mocap/pose", notes={"/mocap/pose": "late"})
    module = registry.load("imutool.converters", "mcap_log")
    content = module.read_sequence(next(iter(module.sequences(tmp_path / "both.mcap"))))

    def renamed(message: Message) -> Message:
        if message.topic.name != "/odom/pose":  # publishers may have no clock, or another one
            return message._replace(publish_time=[0, 5, 2**64 - 1][message.log_time % 3])
        return message._replace(payload=bytes(message.payload).replace(b"world", b"earth"))

    renamed_content = replace(content, messages=lambda: map(renamed, content.messages()))
    corrected = list(corrections.put_on(renamed_content).messages())
    times = {name: [m.log_time for m in corrected if m.topic.name == name] for name in ("/imu0", "/mocap/pose", "/odom/pose")}
    assert times["/odom/pose"] == made.truth.t_ns.tolist()
    assert times["/mocap/pose"] == made.truth.t_ns.tolist()
    assert {m.publish_time for m in corrected if m.topic.name == "/mocap/pose"} == {0, 2**64 - 1}
    assert [m.log_time for m in corrected] == sorted(m.log_time for m in corrected)


@pytest.mark.parametrize("late_s", [2**33, -(2**33)])
def test_a_stamp_that_no_field_holds_after_its_correction_is_named(late_s: int, made: Recording, tmp_path: Path) -> None:
    write(made, tmp_path / "log.mcap")
    module = registry.load("imutool.converters", "mcap_log")
    content = module.read_sequence(next(iter(module.sequences(tmp_path / "log.mcap"))))
    late = Corrections(frame_id="world", late_ns=late_s * 10**9, pose_topic="/ground_truth/pose")
    with pytest.raises(DataError, match="does not fit its field; expected stamps that ROS can store"):
        list(late.put_on(content).messages())


def test_a_right_log_stays_as_it_is(made: Recording, tmp_path: Path) -> None:
    write(made, tmp_path / "made.mcap")
    report = convert(tmp_path / "made.mcap", tmp_path / "same.mcap", fix=True)
    assert read(tmp_path / "same.mcap").imu == made.imu
    assert report.notes == ["same.mcap: the motion shows nothing to correct"]


@pytest.mark.parametrize(
    ("read_g", "kept"), [(1.0, []), (0.55, ["log.mcap: /imu0: accel reads 0.55 when calm, gravity is 9.81 m/s^2"])]
)
def test_a_log_at_rest_in_g_and_steps_of_a_register_comes_in_radians(
    read_g: float, kept: list[str], made: Recording, tmp_path: Path
) -> None:
    """What the motion does not settle is said too."""
    rng, shape = np.random.default_rng(7), made.imu.gyro.shape
    dps = np.round(np.round(rng.normal(30.0, 9.0, shape)) * 250 / 2**15, 6)
    forces = read_g * (np.array([0.0, 0.0, 1.0]) + rng.normal(0.0, 1e-4, shape))
    write(Recording("still", Imu(made.imu.t_ns, dps, forces)), tmp_path / "still.mcap")
    assert any("gyro looks like deg/s" in warning for warning in inspect(tmp_path / "still.mcap").warnings)
    report = convert(tmp_path / "still.mcap", tmp_path / "log.mcap", fix=True)
    fixed = read(tmp_path / "log.mcap").imu
    np.testing.assert_allclose(fixed.gyro, np.deg2rad(dps), rtol=1e-9)
    np.testing.assert_allclose(fixed.accel, forces * (1.0 if kept else 9.80665), rtol=1e-9)
    assert [note.removesuffix("; its unit stays") for note in report.notes[1:]] == kept


def test_a_log_in_g_without_a_calm_second_says_why_its_unit_stays(made: Recording, tmp_path: Path) -> None:
    """Accelerations without gravity read as much."""
    shaken = made.imu.accel + 4.0 * np.sin(np.arange(len(made.imu)) / 10.0)[:, None]
    write(Recording("shaken", replace(made.imu, accel=shaken / 9.80665)), tmp_path / "shaken.mcap")
    (note, *_) = convert(tmp_path / "shaken.mcap", tmp_path / "log.mcap", fix=True).notes
    assert "accel looks like g, not m/s^2" in note
    assert note.endswith("no second is calm enough to be sure; its unit stays")


def test_batched_stamps_are_put_on_the_sensors_line(made: Recording, tmp_path: Path) -> None:
    last = np.minimum(np.arange(len(made.imu)) // 4 * 4 + 3, len(made.imu) - 1)
    bunched = Imu(made.imu.t_ns[last] + 20_000 * (np.arange(len(made.imu)) % 4), made.imu.gyro, made.imu.accel)
    write(replace(made, imu=bunched), tmp_path / "bunched.mcap")
    (warning,) = inspect(tmp_path / "bunched.mcap").warnings
    assert "batches of about 4.0" in warning
    convert(tmp_path / "bunched.mcap", tmp_path / "even.mcap", restamp=True)
    even = read(tmp_path / "even.mcap").imu
    assert np.abs(even.t_ns - made.imu.t_ns).max() < 100_000
    assert (even.gyro == made.imu.gyro).all()
    assert inspect(tmp_path / "even.mcap").warnings == []


def with_times(source: Path, target: Path, times: Callable[[int, int], tuple[int, int]]) -> None:
    """Write a log again, with other header stamps and log times."""
    with source.open("rb") as file, target.open("wb") as out:
        reader, writer = make_reader(file), Writer(out)
        writer.start()
        ids: dict[str, int] = {}
        for schema, channel, message in reader.iter_messages():
            if channel.topic not in ids:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, number, channel.metadata)
            seconds, nanos = struct.unpack_from("<iI", message.data, 4)
            stamp_ns, log_time = times(seconds * 10**9 + nanos, message.log_time)
            data = bytearray(message.data)
            struct.pack_into("<iI", data, 4, *divmod(stamp_ns, 10**9))
            writer.add_message(ids[channel.topic], log_time, bytes(data), log_time)
        writer.finish()


def test_stamps_that_were_never_set_become_the_log_times(made: Recording, tmp_path: Path) -> None:
    write(made, tmp_path / "made.mcap")
    with_times(tmp_path / "made.mcap", tmp_path / "unset.mcap", lambda _, log_time: (0, log_time))
    assert any("the stamps are not set: each is 0 ns; imutool convert" in w for w in inspect(tmp_path / "unset.mcap").warnings)
    for run in (read, lambda path: debias_log(path, tmp_path / "debiased.mcap", model="static")):
        with pytest.raises(LogError, match="A stamp of 0 is not set: imutool convert LOG OUT --restamp"):
            run(tmp_path / "unset.mcap")
    convert(tmp_path / "unset.mcap", tmp_path / "set.mcap", restamp=True)
    found = read(tmp_path / "set.mcap")
    assert np.abs(found.imu.t_ns - made.imu.t_ns).max() <= 1
    assert (found.truth.t_ns == made.truth.t_ns).all()


@pytest.mark.parametrize("late_poses", [False, True], ids=["poses wrap too", "poses start after the wrap"])
def test_a_counter_that_wraps_runs_on_for_the_imu_and_the_poses_alike(
    made: Recording, tmp_path: Path, late_poses: bool
) -> None:
    """Header stamps of one 32 bit counter of microseconds; the log times are a computer's, a little late."""
    size_ns, wrap_ns = 2**32 * 1000, int(made.imu.t_ns[len(made.imu) // 3] // 1000 * 1000)
    truth = made.truth.between(wrap_ns + 1_000_000_000, int(made.imu.t_ns[-1])) if late_poses else made.truth
    write(replace(made, truths={"/ground_truth/pose": truth}), tmp_path / "made.mcap")
    rng = np.random.default_rng(2)

    def wrapped(stamp_ns: int, log_time: int) -> tuple[int, int]:
        return (stamp_ns - wrap_ns) // 1000 * 1000 % size_ns, log_time + int(rng.integers(0, 3_000_000))

    with_times(tmp_path / "made.mcap", tmp_path / "wrapped.mcap", wrapped)
    report = convert(tmp_path / "wrapped.mcap", tmp_path / "whole.mcap", restamp=True)
    whole = read(tmp_path / "whole.mcap")
    origin_ns = wrap_ns - size_ns  # when the counter was at 0
    assert np.abs(whole.imu.t_ns + origin_ns - made.imu.t_ns).max() <= 2000
    assert np.abs(whole.truth.t_ns + origin_ns - truth.t_ns).max() <= 1000
    assert sum("/ground_truth/pose" in note for note in report.notes) == 1


def own_type(made: Recording, target: Path, scale: float = 1.0) -> Path:
    """IMU in a type of a driver's own, whose fractions of a second are in units of 100 ns."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg("std_msgs/Header header\nsensor_msgs/Imu imu\nstring raw\n", "own_driver/msg/Reading"))
    kinds, none = store.types, np.zeros(9)
    text, _ = store.generate_msgdef("own_driver/msg/Reading", ros_version=2)
    with target.open("wb") as out:
        writer = Writer(out)
        writer.start()
        schema = writer.register_schema("own_driver/msg/Reading", "ros2msg", text.encode())
        channel = writer.register_channel("/imu", "cdr", schema)
        for t_ns, gyro, accel in zip(made.imu.t_ns.tolist(), made.imu.gyro, scale * made.imu.accel, strict=True):
            stamps = [
                kinds["builtin_interfaces/msg/Time"](t_ns // 10**9, t_ns % 10**9 // 100),
                kinds["builtin_interfaces/msg/Time"](0, 0),
            ]
            outer, inner = (kinds["std_msgs/msg/Header"](stamp, "imu") for stamp in stamps)
            turn = kinds["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
            rate, force = (kinds["geometry_msgs/msg/Vector3"](*vector.tolist()) for vector in (gyro, accel))
            imu = kinds["sensor_msgs/msg/Imu"](inner, turn, none, rate, none, force, none)
            message = kinds["own_driver/msg/Reading"](outer, imu, "$VNYMR")
            data = bytes(store.serialize_cdr(message, message.__msgtype__))
            writer.add_message(channel, t_ns + 3_000_000, data, t_ns + 3_000_000)
        writer.finish()
    return target


def test_an_imu_of_a_drivers_own_type_is_one_beside_what_was_made_of_it(made: Recording, tmp_path: Path) -> None:
    convert(own_type(made, tmp_path / "own.mcap"), tmp_path / "even.mcap", restamp=True)
    debias_log(tmp_path / "even.mcap", tmp_path / "debiased.mcap", model="static", init=(0.0,) * 6)
    with Log(tmp_path / "debiased.mcap") as log:
        assert (log.imu_topics, log.topics["/imu/debiased"].is_derived) == (["/imu"], True)
    np.testing.assert_array_equal(read(tmp_path / "debiased.mcap").imu.gyro, made.imu.gyro)


def test_stamps_in_messages_of_a_drivers_own_type_are_corrected(made: Recording, tmp_path: Path) -> None:
    log = own_type(made, tmp_path / "own.mcap")
    assert any("fractions of a second are written in 100 ns, not in ns" in warning for warning in inspect(log).warnings)
    report = convert(log, tmp_path / "even.mcap", restamp=True)
    assert any("fractions of a second are written in 100 ns" in note for note in report.notes)
    found = read(tmp_path / "even.mcap").imu
    assert np.abs(found.t_ns - made.imu.t_ns).max() <= 200
    assert (found.gyro == made.imu.gyro).all()
    assert not any("stamps" in warning for warning in inspect(tmp_path / "even.mcap").warnings)


def test_units_and_stamps_in_messages_of_a_drivers_own_type_are_corrected_at_once(made: Recording, tmp_path: Path) -> None:
    resting = replace(made, imu=Imu(made.imu.t_ns, 0.001 * made.imu.gyro, np.tile([0.0, 0.0, 9.80665], (len(made.imu), 1))))
    log = own_type(resting, tmp_path / "own.mcap", scale=1 / 9.80665)
    report = convert(log, tmp_path / "right.mcap", fix=True, restamp=True)
    assert any("accel times 9.80665" in note and "other fields of its messages stay" in note for note in report.notes)
    found = read(tmp_path / "right.mcap").imu
    np.testing.assert_allclose(found.accel, resting.imu.accel, rtol=1e-12)
    assert (found.gyro == resting.imu.gyro).all()
    assert np.abs(found.t_ns - made.imu.t_ns).max() <= 200


def test_poses_that_belong_before_the_zero_of_the_clock_are_left_out_and_counted(tmp_path: Path) -> None:
    """A recorder that counts from zero, and poses whose stamps are late."""
    made = flight(3, duration_s=50.0, rate_hz=100.0, truth_rate_hz=50.0)
    start_ns, late_ns = int(made.imu.t_ns[0]), 1_500_000_000
    t_ns = np.concatenate([[0, 20_000_000], made.truth.t_ns - start_ns + late_ns])
    rows = np.maximum(np.arange(len(t_ns)) - 2, 0)
    late = Poses(t_ns, made.truth.p_wb[rows], made.truth.q_wb_wxyz[rows])
    imu = replace(made.imu, t_ns=made.imu.t_ns - start_ns)
    write(replace(made, imu=imu, truths={"/ground_truth/pose": late}), tmp_path / "late.mcap")
    report = convert(tmp_path / "late.mcap", tmp_path / "right.mcap", fix=True)
    fixed = read(tmp_path / "right.mcap").truth
    assert fixed.t_ns[0] >= 0
    assert len(made.truth) - 2 <= len(fixed) <= len(made.truth)
    assert any("belong before the zero of the log's clock, and are left out" in note for note in report.notes)


def test_the_poses_follow_the_first_imu_and_another_mount_is_turned_to_it(made: Recording, tmp_path: Path) -> None:
    """Two IMUs and a body of the poses, each with axes of its own."""
    source, Q = tmp_path / "flight", np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    source.mkdir()
    header = "t [ns],gyro_x [rad/s],gyro_y [rad/s],gyro_z [rad/s],acc_x [m/s^2],acc_y [m/s^2],acc_z [m/s^2]\n"
    turn = Rotation.from_quat(made.truth.q_wb_wxyz.copy(), scalar_first=True) * Rotation.from_matrix(P)
    poses = np.column_stack([made.truth.t_ns * 1e-9, made.truth.p_wb, turn.as_quat(scalar_first=True)])
    for name, axes in (("imu_1", np.eye(3)), ("imu_2", Q)):
        samples = np.hstack([made.imu.gyro @ axes.T, made.imu.accel @ axes.T])
        lines = (f"{t}," + ",".join(map(repr, row)) for t, row in zip(made.imu.t_ns.tolist(), samples.tolist(), strict=True))
        (source / f"{name}.csv").write_text(header + "\n".join(lines) + "\n")
    text = "\n".join(",".join(map(repr, row)) for row in poses.tolist())
    (source / "gt.csv").write_text("t [s],x,y,z,qw,qx,qy,qz\n" + text + "\n")
    convert(source, tmp_path / "two.mcap")
    convert(tmp_path / "two.mcap", tmp_path / "right.mcap", fix=True)
    for topic in ("/imu_1/imu", "/imu_2/imu"):
        fixed = read(tmp_path / "right.mcap", imu=topic)
        np.testing.assert_allclose(fixed.imu.gyro, made.imu.gyro, atol=1e-12)
        np.testing.assert_allclose(fixed.imu.accel, made.imu.accel, atol=1e-12)
    left = Rotation.from_quat(fixed.truth.q_wb_wxyz.copy(), scalar_first=True) * (turn * Rotation.from_matrix(P.T)).inv()
    assert left.magnitude().max() < 1e-6
    assert inspect(tmp_path / "right.mcap").warnings == []


def test_a_drivers_json_that_is_turned_against_the_poses_keeps_its_axes(made: Recording, tmp_path: Path) -> None:
    write(made, tmp_path / "made.mcap")
    with (tmp_path / "made.mcap").open("rb") as file, (tmp_path / "json.mcap").open("wb") as out:
        writer = Writer(out)
        writer.start()
        imu = writer.register_channel("/imu", "json", writer.register_schema("Imu", "jsonschema", b'{"type": "object"}'))
        poses: dict[int, int] = {}
        for schema, channel, message in make_reader(file).iter_messages(topics=["/ground_truth/pose"]):
            if channel.id not in poses:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                poses[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, known, channel.metadata)
            writer.add_message(poses[channel.id], message.log_time, message.data, message.publish_time)
        for t_ns, gyro, accel in zip(made.imu.t_ns.tolist(), made.imu.gyro @ P.T, made.imu.accel @ P.T, strict=True):
            vectors = {"angular_velocity": gyro, "linear_acceleration": accel}
            content = {name: dict(zip("xyz", vector.tolist(), strict=True)) for name, vector in vectors.items()}
            stamp = {"sec": t_ns // 10**9, "nanosec": t_ns % 10**9}
            writer.add_message(imu, t_ns, json.dumps({"header": {"stamp": stamp}, **content}).encode(), t_ns)
        writer.finish()
    report = convert(tmp_path / "json.mcap", tmp_path / "right.mcap", fix=True)
    assert any("the body is now that of the IMU" in note for note in report.notes)
    right = read(tmp_path / "right.mcap")
    np.testing.assert_allclose(right.imu.gyro, made.imu.gyro @ P.T, atol=1e-12)
    turn, true = (Rotation.from_quat(q.copy(), scalar_first=True) for q in (right.truth.q_wb_wxyz, made.truth.q_wb_wxyz))
    assert (turn * (true * Rotation.from_matrix(P.T)).inv()).magnitude().max() < 1e-7
    assert inspect(tmp_path / "right.mcap").warnings == []


def in_mm(made: Recording, folder: Path, schema: tuple[str, str, bytes], encoding: str, message: MakeMessages) -> Path:
    """Log of an IMU beside poses in mm, in messages of another type."""
    write(replace(made, truths={}), folder / "imu.mcap")
    with (folder / "imu.mcap").open("rb") as file, (folder / "mm.mcap").open("wb") as out:
        writer = Writer(out)
        writer.start()
        poses = writer.register_channel("/mocap/tf", encoding, writer.register_schema(*schema))
        channels: dict[str, int] = {}
        for kind, channel, record in make_reader(file).iter_messages(topics=["/imu0"]):
            if not channels:
                known = writer.register_schema(kind.name, kind.encoding, kind.data)
                channels[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, known)
            writer.add_message(channels[channel.topic], record.log_time, record.data, record.publish_time)
        for t_ns, p, q in zip(made.truth.t_ns.tolist(), 1e3 * made.truth.p_wb, made.truth.q_wb_wxyz, strict=True):
            for raw in message(t_ns, p.tolist(), q.tolist()):
                writer.add_message(poses, t_ns, raw, t_ns)
        writer.finish()
    return folder / "mm.mcap"


def test_transforms_of_another_encoding_come_back_in_metres(made: Recording, tmp_path: Path) -> None:
    def message(_: int, p: list[float], q: list[float]) -> list[bytes]:
        place = {"translation": dict(zip("xyz", p, strict=True)), "rotation": dict(zip("wxyz", q, strict=True))}
        frames = ("map", "body"), ("body", "wheel")
        return [json.dumps({**place, "parent_frame_id": parent, "child_frame_id": child}).encode() for parent, child in frames]

    log = in_mm(made, tmp_path, ("foxglove.FrameTransform", "jsonschema", b"{}"), "json", message)
    convert(log, tmp_path / "fixed.mcap", fix=True)
    np.testing.assert_allclose(read(tmp_path / "fixed.mcap").truths["/mocap/tf/body"].p_wb, made.truth.p_wb, rtol=1e-12)
    assert inspect(tmp_path / "fixed.mcap").warnings == []


def test_named_bodies_keep_their_unit_and_the_note_says_so(made: Recording, tmp_path: Path) -> None:
    store, kind = get_typestore(Stores.ROS2_HUMBLE), "mocap_msgs/msg/Bodies"
    store.register(get_types_from_msg("string name\ngeometry_msgs/Pose pose\n", "mocap_msgs/msg/Body"))
    store.register(get_types_from_msg("mocap_msgs/Body[] bodies\n", kind))
    types = store.types

    def message(_: int, p: list[float], q: list[float]) -> list[bytes]:
        orientation = types["geometry_msgs/msg/Quaternion"](*q[1:], q[0])
        pose = types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](*p), orientation)
        return [bytes(store.serialize_cdr(types[kind]([types["mocap_msgs/msg/Body"]("drone", pose)]), kind))]

    text = store.generate_msgdef(kind, ros_version=2)[0].encode()
    report = convert(in_mm(made, tmp_path, (kind, "ros2msg", text), "cdr", message), tmp_path / "fixed.mcap", fix=True)
    assert [note for note in report.notes if "/mocap/tf" in note] == [
        f"fixed.mcap: /mocap/tf keeps its poses: only those of ROS are corrected, not {kind}"
    ]


def test_poses_of_which_the_other_logs_agree_on_nothing_get_no_note(tmp_path: Path) -> None:
    """All IMUs are read alike, and each motion capture had a clock of its own."""
    write(flight(3, duration_s=2.0), tmp_path / "log.mcap")
    flipped = np.stack([np.eye(3), -np.eye(3)])
    found = fitted_to(tmp_path / "log.mcap", Corrections({"/imu0": flipped}, pose_topic="/ground_truth/pose"))
    assert found is not None
    assert found.notes == {"/imu0": "units and axes are now as in the other logs"}
