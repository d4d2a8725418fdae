"""True latitude, longitude and height with angles: positions about the first, where gravity shows the world of the angles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imutool.converters import table
from imutool.recording.message_log import MessageLog

T_S = np.arange(6000) / 100.0
EVERY, SAME_AXES = slice(None, None, 10), np.eye(3)
A_M, F = 6_378_137.0, 1.0 / 298.257223563  # of WGS 84
LATITUDE, LONGITUDE, HEIGHT_M = np.radians(55.0), np.radians(179.9995), 120.0  # by the date line
ANGLES = np.stack([0.3 * np.sin(0.9 * T_S), 0.2 * np.sin(1.3 * T_S), 0.4 * np.sin(0.7 * T_S)], axis=1)  # roll, pitch, yaw
NED = np.stack([80.0 * np.sin(0.1 * T_S), 90.0 * np.sin(0.07 * T_S), 10.0 * np.sin(0.2 * T_S)], axis=1)


def ecef(latitude: np.ndarray, longitude: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Cartesian coordinates on the ellipsoid."""
    n = A_M / np.sqrt(1.0 - F * (2.0 - F) * np.sin(latitude) ** 2)
    along = (n + height) * np.cos(latitude)
    z = (n * (1.0 - F) ** 2 + height) * np.sin(latitude)
    return np.stack([along * np.cos(longitude), along * np.sin(longitude), z], axis=-1)


def rows(*values: np.ndarray) -> str:
    return "".join(",".join(map(repr, row)) + "\n" for row in np.column_stack(values).tolist())


STATED = "latitude [{0}],longitude [{0}],altitude [m]"


def recorded(
    folder: Path,
    unit: str,
    down: float,
    head: str = STATED,
    name: str = "groundtruth",
    *,
    axes: np.ndarray = SAME_AXES,
    tilt: float = 1.0,
    yaw: str = "yaw",
) -> MessageLog:
    """Log of an IMU next to angles of another table; `down` is 1 where the z axis of their world points down.

    `axes` has the IMU's axes in its rows, in those of the angles' body, and `tilt` is the share of roll and pitch.
    """
    angles = ANGLES * [tilt, tilt, 1.0]
    rotation = Rotation.from_euler("ZYX", angles[:, ::-1])
    turns = (rotation[:-1].inv() * rotation[1:]).as_rotvec() @ axes.T * 100.0
    force = rotation.inv().apply([0.0, 0.0, -9.81 * down]) @ axes.T
    latitude, longitude = LATITUDE + NED[:, 0] / 6.37e6, LONGITUDE + NED[:, 1] / (6.39e6 * np.cos(LATITUDE))
    folder.mkdir()
    imu = "time [s],gyro_x [rad/s],gyro_y [rad/s],gyro_z [rad/s],acc_x [m/s^2],acc_y [m/s^2],acc_z [m/s^2]\n"
    (folder / "imu.csv").write_text(imu + rows(T_S, np.concatenate([turns, turns[-1:]]), force))
    size = {"deg": 180.0 / np.pi, "rad": 1.0}[unit]
    wrapped = (longitude + np.pi) % (2.0 * np.pi) - np.pi
    truth = [T_S, latitude * size, wrapped * size, HEIGHT_M - NED[:, 2], *angles.T * 180.0 / np.pi]
    names = f"time [s],{head.format(unit)},roll [deg],pitch [deg],{yaw} [deg]\n"
    (folder / f"{name}.csv").write_text(names + rows(*(column[EVERY] for column in truth)))
    (sequence,) = table.sequences(folder)
    return table.read_sequence(sequence)


@pytest.mark.parametrize("name", ["groundtruth", "gnss_ins"])
@pytest.mark.parametrize(("unit", "head"), [("deg", STATED), ("rad", STATED), ("deg", "lat_{0},lon_{0},height_m")])
def test_latitude_longitude_and_height_are_positions_of_the_angles_beside_them(tmp_path, unit, head, name):
    (poses,) = recorded(tmp_path / "ship", unit, 1.0, head, name).poses.values()
    latitude, longitude = LATITUDE + NED[:, 0] / 6.37e6, LONGITUDE + NED[:, 1] / (6.39e6 * np.cos(LATITUDE))
    place = ecef(latitude, longitude, HEIGHT_M - NED[:, 2])[EVERY]
    sin, cos = np.sin([LATITUDE, LONGITUDE]), np.cos([LATITUDE, LONGITUDE])
    east, up = [-sin[1], cos[1], 0.0], [cos[0] * cos[1], cos[0] * sin[1], sin[0]]
    expected = (place - place[0]) @ np.stack([east, np.cross(up, east), up], axis=1)
    np.testing.assert_allclose(poses.p_wb, expected, atol=5e-3)  # the Earth bends by 1 mm in 100 m
    force = Rotation.from_quat(poses.q_wb_wxyz[:, [1, 2, 3, 0]]).apply(
        Rotation.from_euler("ZYX", ANGLES[EVERY, ::-1]).inv().apply([0.0, 0.0, -9.81])
    )
    np.testing.assert_allclose(force, np.tile([0.0, 0.0, 9.81], (len(force), 1)), atol=1e-9)


@pytest.mark.parametrize("tilt", [1.0, 0.1])  # of a drone and of a car
@pytest.mark.parametrize(
    ("axes", "yaw"), [([[1, 0, 0], [0, -1, 0], [0, 0, -1]], "hdg"), ([[0, 1, 0], [1, 0, 0], [0, 0, -1]], "Azi")]
)
def test_an_imu_with_other_axes_than_the_angles_from_north_leaves_them_their_positions(tmp_path, axes, yaw, tilt):
    """Forward, left, up, as in ROS, and right, forward, up, as NovAtel's; the angles are of forward, right, down."""
    log = recorded(tmp_path / "car", "deg", 1.0, axes=np.array(axes), tilt=tilt, yaw=yaw)
    enu = NED[EVERY][:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    np.testing.assert_allclose(log.poses["/ground_truth/pose"].p_wb, enu, atol=0.5)  # of the radii above
    assert any("are north, east and down" in note for note in log.remarks.notes)


def test_angles_in_another_world_keep_no_positions_of_this_one(tmp_path):
    log = recorded(tmp_path / "car", "deg", -1.0)
    assert not log.poses["/ground_truth/pose"].p_wb.any()
    assert any("the world of their rotations has +z up" in note for note in log.remarks.notes)
    assert "/ground_truth_latitude_deg" in log.scalars


def test_small_angles_without_a_unit_are_no_positions(tmp_path):
    log = recorded(tmp_path / "car", "rad", 1.0, "lat,lon,alt")
    assert not log.poses["/ground_truth/pose"].p_wb.any()
    assert any("lat and lon state neither deg nor rad" in note for note in log.remarks.notes)


def turned_imu(folder: Path) -> Rotation:
    """Rotations in a world with z up; the table of an IMU that reads them lies in the folder."""
    rotation = Rotation.from_euler("ZYX", ANGLES[:, ::-1])
    turns = (rotation[:-1].inv() * rotation[1:]).as_rotvec() * 100.0
    imu = "time [s],gyro_x [rad/s],gyro_y [rad/s],gyro_z [rad/s],acc_x [m/s^2],acc_y [m/s^2],acc_z [m/s^2]\n"
    force = rotation.inv().apply([0.0, 0.0, 9.81])
    (folder / "imu.csv").write_text(imu + rows(T_S, np.concatenate([turns, turns[-1:]]), force))
    return rotation


@pytest.mark.parametrize("head", ["latitude [deg],longitude [deg],altitude [m]", "easting,northing,height"])
def test_positions_on_the_earth_beside_quaternions_in_a_world_with_z_up_are_east_north_up(tmp_path, head):
    """As those of GNSS next to the orientation of an IMU that ROS has."""
    rotation = turned_imu(tmp_path)
    enu = NED[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    latitude, longitude = 0.9 + NED[:, 0] / 6.37e6, 0.2 + NED[:, 1] / (6.39e6 * np.cos(0.9))
    place = enu if "easting" in head else np.stack([np.degrees(latitude), np.degrees(longitude), enu[:, 2]], axis=1)
    (tmp_path / "groundtruth.csv").write_text(f"time [s],{head},qx,qy,qz,qw\n" + rows(T_S, place, rotation.as_quat()))
    poses = table.read_sequence(table.sequences(tmp_path)[0]).poses["/ground_truth/pose"]
    np.testing.assert_allclose(poses.p_wb, enu, atol=0.5)  # of the radii above
    np.testing.assert_allclose(Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True).as_quat(), rotation.as_quat(), atol=1e-6)


@pytest.mark.parametrize("world", ["ecef", "utm"])
def test_poses_about_the_centre_of_the_earth_become_east_north_up(tmp_path, world):
    """As comma2k19 has them. Northings of UTM are as large in Denmark, and stay."""
    rotation = turned_imu(tmp_path)
    enu = NED[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    earth = Rotation.from_euler("ZX", [LONGITUDE + np.pi / 2.0, np.pi / 2.0 - LATITUDE])  # from east, north, up
    place = ecef(LATITUDE, LONGITUDE, HEIGHT_M) + earth.apply(enu) if world == "ecef" else np.array([5e5, 6.36e6, 0.0]) + enu
    q_xyzw = (earth * rotation if world == "ecef" else rotation)[EVERY].as_quat()
    names = "time [s],x [m],y [m],z [m],qx,qy,qz,qw\n"
    (tmp_path / "groundtruth.csv").write_text(names + rows(T_S[EVERY], place[EVERY], q_xyzw))
    (sequence,) = table.sequences(tmp_path)
    log = table.read_sequence(sequence)
    poses = log.poses["/ground_truth/pose"]
    expected = enu - enu[0] if world == "ecef" else place
    np.testing.assert_allclose(poses.p_wb, expected[EVERY], atol=5e-3)  # up is that of the middle of the way
    level = Rotation.from_quat(poses.q_wb_wxyz[:, [1, 2, 3, 0]]).inv() * rotation[EVERY]
    assert level.magnitude().max() < 2e-5
    assert sum("centre of the Earth (ECEF)" in note for note in log.remarks.notes) == (world == "ecef")
