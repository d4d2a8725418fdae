"""Aids are found by type and name, in their own units, stamps and frames; the truth is never one of them."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import driven
from support.driven import LEVER_B, R_VB, STILL_S, Drive

from imutool.errors import ConfigError, DataError, LogError
from imutool.inertial.aids import Aids, parse_aids
from imutool.log_info.aid_search import find_aids
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read
from imutool.recording import Imu, Poses

HEIGHT = 5.0


@pytest.fixture(scope="module")
def drive() -> Drive:
    return driven.drive(duration_s=14.0)


def found(path: Path, words: str, truth: str | None = "/ground_truth/pose") -> Aids:
    with Log(path) as log:
        return find_aids(log, read(path, truth=truth), parse_aids(words))


def rising(t_ns: np.ndarray) -> np.ndarray:
    return HEIGHT * np.sin(1e-9 * (t_ns - t_ns[0]))


def test_words_are_aids_with_topics() -> None:
    assert parse_aids("stops, barometer=/baro.data") == {"stops": "", "barometer": "/baro.data"}
    only = "Only barometer and odometry take a topic"  # of a word that has one in vain, and of no other
    for wrong, fix in (("stop", "Did you mean stops?"), ("stops=/a", only), ("auto=/a", only), ("", ""), ("auto,gps", "")):
        with pytest.raises(ConfigError, match="expected auto, or some of stops, barometer, odometry, ground") as refused:
            parse_aids(wrong)
        assert refused.value.fix == fix


@pytest.mark.parametrize(("factor", "unit"), [(1.0, "Pa"), (0.01, "hPa"), (0.001, "kPa")])
def test_pressure_in_any_unit_is_a_height(drive: Drive, tmp_path: Path, factor: float, unit: str) -> None:
    t_ns = drive.vehicle.t_ns
    topic = driven.pressure(t_ns, rising(t_ns), factor)
    path = driven.write(tmp_path / "a.mcap", drive.imu, drive.truth, {"/air": topic}, late_ns=400_000_000)
    aids = found(path, "barometer")
    assert aids.signals == {"barometer": f"/air.fluid_pressure ({unit})"}
    assert aids.height is not None
    np.testing.assert_array_equal(aids.height.t_ns, t_ns[t_ns <= drive.imu.t_ns[-1]])  # stamps of the headers, not of arrival
    np.testing.assert_allclose(aids.height.values[:, 0], rising(aids.height.t_ns), rtol=0, atol=1e-6)


def test_a_number_named_as_an_altitude_is_metres_and_others_are_left_alone(drive: Drive, tmp_path: Path) -> None:
    t_ns = drive.imu.t_ns[::10]
    rows = [{"data": float(h)} for h in rising(t_ns)]
    other = ("std_msgs/msg/Float64", t_ns, rows)
    names = (
        "/diff_pressure",
        "/tyre_pressure",
        "/gps/altitude",
        "/ground_truth/altitude",
        "/baro/temperature",
        "/height_setpoint",
    )
    path = driven.write(tmp_path / "a.mcap", drive.imu, drive.truth, dict.fromkeys(names, other))
    with pytest.raises(LogError, match=r"no barometer in this log; looked at .*/diff_pressure"):
        found(path, "barometer")
    path = driven.write(tmp_path / "b.mcap", drive.imu, drive.truth, {**dict.fromkeys(names, other), "/altimeter": other})
    aids = found(path, "auto")
    assert aids.signals["barometer"] == "/altimeter.data (m)"
    assert aids.height is not None
    np.testing.assert_allclose(aids.height.values[:, 0], rising(aids.height.t_ns), atol=1e-9)
    with pytest.raises(DataError, match=r"/tyre_pressure\.data is from .*; expected the air's pressure"):
        found(path, "barometer=/tyre_pressure.data")


def test_values_that_are_none_are_left_out(drive: Drive, tmp_path: Path) -> None:
    t_ns = drive.vehicle.t_ns
    kind, _, rows = driven.pressure(t_ns, rising(t_ns))
    broken = [{**row, "fluid_pressure": np.nan} if k % 7 == 0 else row for k, row in enumerate(rows)]
    back = t_ns.copy()
    back[50] = back[40]
    path = driven.write(tmp_path / "a.mcap", drive.imu, drive.truth, {"/air": (kind, back, broken)})
    height = found(path, "barometer").height
    assert height is not None
    assert np.isfinite(height.values).all()
    assert (np.diff(height.t_ns) > 0).all()
    assert len(height) > 0.8 * len(t_ns)


@pytest.mark.parametrize("form", ["poses", "twist in odometry", "twist"])
def test_mount_and_velocity_come_from_poses_or_twist(drive: Drive, tmp_path: Path, form: str) -> None:
    still = replace(
        drive.vehicle, p_wb=np.zeros_like(drive.vehicle.p_wb), q_wb_wxyz=np.tile([1.0, 0, 0, 0], (len(drive.speed), 1))
    )
    both = np.column_stack([drive.speed, drive.turn])
    topic = {
        "poses": driven.odometry(drive.vehicle),
        "twist in odometry": driven.odometry(still, both),
        "twist": driven.wheels(drive, noise_m_s=0.0),
    }[form]
    path = driven.write(tmp_path / "a.mcap", drive.imu, drive.truth, {"/base": topic, "/cmd_vel": driven.wheels(drive, 0.5)})
    aids = found(path, "odometry")
    assert aids.signals == {"odometry": "/base", "ground": "vehicle frame of the odometry"}
    assert aids.odometry is not None
    poses = aids.odometry.poses
    assert poses.v_w is not None
    v_v = Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True).inv().apply(poses.v_w.copy())
    assert np.abs(v_v[:, 0] - drive.speed[: len(v_v)]).max() < 0.03  # poses are differentiated over a fifth of a second
    assert np.abs(v_v[:, 1:]).max() < 0.03
    turned = (Rotation.from_matrix(aids.odometry.R_vb) * R_VB.inv()).magnitude()
    assert turned < np.radians(5.0)
    assert turned < 4.0 * aids.odometry.std_rad + np.radians(2.0)  # lever arm and bias are not in the deviation


def test_odometry_that_is_reset_keeps_its_mount(drive: Drive, tmp_path: Path) -> None:
    """A jump of its poses by meters is half a second of hundreds of m/s²."""
    p = drive.vehicle.p_wb + np.where(np.arange(len(drive.vehicle))[:, None] > 350, [40.0, -25.0, 0.0], 0.0)
    path = driven.write(tmp_path / "a.mcap", drive.imu, drive.truth, {"/odom": driven.odometry(replace(drive.vehicle, p_wb=p))})
    odometry = found(path, "odometry").odometry
    assert odometry is not None
    assert (Rotation.from_matrix(odometry.R_vb) * R_VB.inv()).magnitude() < np.radians(5.0)


def test_the_truth_is_no_aid_by_any_name(drive: Drive, tmp_path: Path) -> None:
    rotated = Rotation.from_euler("z", 70.0, degrees=True)
    v = drive.truth
    turned = (rotated * Rotation.from_quat(v.q_wb_wxyz, scalar_first=True)).as_quat(scalar_first=True)
    moved = Poses(v.t_ns[::4], rotated.apply(v.p_wb[::4].copy()) + 3.0, turned[::4])
    topics = {"/odom": driven.odometry(moved), "/ekf/odom": driven.odometry(drive.vehicle), "/cmd_vel": driven.wheels(drive)}
    path = driven.write(tmp_path / "a.mcap", drive.imu, drive.truth, topics)
    with pytest.raises(DataError, match="/odom moves exactly as the truth, and is no aid"):
        found(path, "odometry")
    with pytest.raises(DataError, match="/ground_truth/pose is the truth, and no aid"):
        found(path, "odometry=/ground_truth/pose")
    assert found(path, "auto").signals == {"stops": ""}
    del topics["/odom"]
    path = driven.write(tmp_path / "b.mcap", drive.imu, drive.truth, topics)
    with pytest.raises(LogError, match="no odometry in this log; looked at") as error:
        found(path, "odometry")
    assert all(
        text in str(error.value) for text in ("/ground_truth/pose (truth)", "/ekf/odom (estimate)", "/cmd_vel (command)")
    )
    assert found(path, "odometry=/ekf/odom").odometry is not None
    with pytest.raises(DataError, match="/ekf/odom is the truth"):
        found(path, "odometry=/ekf/odom", truth="/ekf/odom")


def of_wheels(drive: Drive, speed: float = 1.0, turn: float = 1.0) -> driven.Topic:
    """Wheel odometry whose speed and turns are multiplied."""
    return driven.wheels(replace(drive, speed=speed * drive.speed, turn=turn * drive.turn))


@pytest.mark.parametrize(
    ("told", "changes"),
    [
        ("/wheels accelerates 3.* times as much as the IMU", {"speed": 3.6}),
        ("/wheels accelerates 9.*e.02 times as much as the IMU", {"speed": 1000.0}),
        ("/wheels turns left where the IMU turns right", {"turn": -1.0}),
        ("explain 0% of the gyro's motion", {"turn": 57.3}),
    ],
)
def test_wheels_in_another_unit_or_frame_are_refused(
    told: str, changes: dict[str, float], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Speeds in km/h made a path of 0.7 m one of 2.3 m on FETCH, without a word."""
    drive = driven.drive(duration_s=40.0)
    path = driven.write(tmp_path / "a.mcap", drive.imu, drive.truth, {"/wheels": of_wheels(drive, **changes)})
    with pytest.raises(DataError, match=told):
        found(path, "odometry")
    assert found(path, "auto").signals == {"stops": ""}
    assert "the aid odometry is left out: " in caplog.text


def test_wheels_that_accelerate_otherwise_are_refused(tmp_path: Path) -> None:
    """As velocities in the world's frame do; their own size had passed for evidence of the mount."""
    drive, other = (driven.drive(seed, duration_s=40.0) for seed in (0, 1))
    path = driven.write(tmp_path / "a.mcap", drive.imu, drive.truth, {"/wheels": of_wheels(replace(drive, speed=other.speed))})
    with pytest.raises(DataError, match="the motion does not show how the IMU is mounted in the frame of /wheels"):
        found(path, "odometry")


def test_wheels_whose_radius_is_wrong_still_aid(tmp_path: Path) -> None:
    drive = driven.drive(duration_s=40.0)
    for number, speed in enumerate((0.8, 1.2, -1.0)):  # or an IMU that looks backwards
        topics = {"/wheels": of_wheels(drive, speed=speed)}
        assert found(driven.write(tmp_path / f"{number}.mcap", drive.imu, drive.truth, topics), "odometry").odometry is not None


def test_wheels_that_are_late_get_the_clock_of_the_imu(tmp_path: Path) -> None:
    drive = driven.drive(duration_s=40.0)
    kind, t_ns, rows = driven.wheels(drive)
    both = []
    for number, late_ns in enumerate((0, 400_000_000)):
        path = driven.write(tmp_path / f"{number}.mcap", drive.imu, drive.truth, {"/wheels": (kind, t_ns + late_ns, rows)})
        both.append(found(path, "odometry"))
    right, late = both
    assert right.signals["odometry"] == "/wheels"
    assert re.fullmatch(r"/wheels \([34]\d\d ms late by the gyro, corrected\)", late.signals["odometry"])
    assert right.odometry is not None
    assert late.odometry is not None
    off_ns = int(late.odometry.poses.t_ns[50]) - int(right.odometry.poses.t_ns[50])
    assert abs(off_ns) < 30_000_000


def climbing(truth: Poses) -> Poses:
    """Poses whose height goes up and down by some metres."""
    rise = np.column_stack([np.zeros((len(truth), 2)), 3.0 * np.sin(1e-9 * (truth.t_ns - truth.t_ns[0]))])
    return replace(truth, p_wb=truth.p_wb + rise, v_w=None)


@pytest.mark.parametrize(
    ("told", "factor", "offset"),
    [
        ("falls where the true height rises", -1.0, 0.0),
        ("changes by 3.2. times", 3.28084, 0.0),
        ("is from 99997 to 100003", 1.0, 1e5),
    ],
)
def test_a_height_of_another_sign_or_unit_is_refused(told: str, factor: float, offset: float, tmp_path: Path) -> None:
    drive = driven.drive(duration_s=30.0)
    t_ns, truth = drive.imu.t_ns[::10], climbing(drive.truth)
    height = 3.0 * np.sin(1e-9 * (t_ns - truth.t_ns[0]))
    rows = [{"data": float(factor * h + offset)} for h in height]
    path = driven.write(tmp_path / "a.mcap", drive.imu, truth, {"/altimeter": ("std_msgs/msg/Float64", t_ns, rows)})
    with pytest.raises(DataError, match=told):
        found(path, "barometer")


def test_a_height_that_ends_stands_still_or_is_late_says_so(tmp_path: Path) -> None:
    drive = driven.drive(duration_s=30.0)
    t_ns, truth = drive.imu.t_ns[::10], climbing(drive.truth)
    noise = 0.05 * np.random.default_rng(0).normal(size=len(t_ns))

    def words(height: np.ndarray, stamps: np.ndarray) -> str:
        kind, _, rows = driven.pressure(stamps, height)
        return found(driven.write(tmp_path / "a.mcap", drive.imu, truth, {"/air": (kind, stamps, rows)}), "barometer").signals[
            "barometer"
        ]

    height = 3.0 * np.sin(1e-9 * (t_ns - truth.t_ns[0])) + noise
    half = len(t_ns) // 2
    assert words(height, t_ns) == "/air.fluid_pressure (Pa)"
    assert words(height[:half], t_ns[:half]) == "/air.fluid_pressure (Pa), 50% of the time"
    assert "unchanged for 15 s" in words(np.where(np.arange(len(t_ns)) < half, height, height[half]), t_ns)
    assert "2.0 s late by the true height" in words(height, t_ns + 2_000_000_000)


@pytest.mark.parametrize("exact", [False, True])
def test_a_motion_that_shows_no_mount_is_refused(
    drive: Drive, tmp_path: Path, caplog: pytest.LogCaptureFixture, exact: bool
) -> None:
    end_ns = int(drive.imu.t_ns[0] + STILL_S * 1e9)
    still: Imu = drive.imu.between(int(drive.imu.t_ns[0]), end_ns)
    if exact:  # of a simulator without noise
        still = replace(still, accel=np.tile(R_VB.inv().apply([0.0, 0.0, 9.81]), (len(still), 1)))
    truth, vehicle = (poses.between(int(drive.imu.t_ns[0]), end_ns) for poses in (drive.truth, drive.vehicle))
    twist = np.zeros((len(vehicle), 2))
    path = driven.write(tmp_path / "a.mcap", still, truth, {"/odom": driven.odometry(vehicle, twist)})
    with pytest.raises(DataError, match="the motion does not show how the IMU is mounted in the frame of /odom"):
        found(path, "odometry")
    assert "odometry" not in found(path, "auto").signals
    assert "the aid odometry is left out" in caplog.text


def test_the_lever_arm_is_where_it_was_put(drive: Drive) -> None:
    """The made-up vehicle itself: the IMU's true velocity, the lever arm and the mount give the speed of the wheels."""
    assert drive.truth.v_w is not None
    R = Rotation.from_quat(drive.truth.q_wb_wxyz, scalar_first=True)
    gyro = drive.imu.gyro - driven.BIAS[:3]
    v_v = R_VB.apply(R.inv().apply(drive.truth.v_w.copy()) + np.cross(gyro, LEVER_B))
    at, valid = drive.vehicle.at(drive.imu.t_ns)
    assert valid.all()
    speed = np.interp(drive.imu.t_ns - drive.imu.t_ns[0], at.t_ns[::2] - at.t_ns[0], drive.speed[: len(at.t_ns[::2])])
    assert np.abs(v_v[:, 0] - speed).max() < 0.03
