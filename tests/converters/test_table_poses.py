"""Poses next to an IMU's table: exports of motion captures, trajectories, and files that give none; and packed tables."""

from __future__ import annotations

import bz2
import gzip
import lzma
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from imutool.converters import table
from imutool.errors import ConfigError, DataError
from imutool.recording.message_log import MessageLog

COUNT = 1500
T_S = np.arange(COUNT) / 100.0
ANGLES = 0.6 * np.sin(T_S[:, None] * [0.9, 1.3, 0.7])
TURN = Rotation.from_euler("ZYX", ANGLES)
XYZW, MATRICES = TURN.as_quat(), TURN.as_matrix()
P_M = np.sin(T_S[:, None] * [0.5, 0.8, 1.1])
GYRO = np.vstack([(TURN[:-1].inv() * TURN[1:]).as_rotvec() * 100.0, np.zeros(3)])
ACCEL = TURN.inv().apply([0.0, 0.0, 9.80665])
EPOCH_S = 1_700_000_000
IMU_HEADER = "timestamp [ns],gyro_x (rad/s),gyro_y (rad/s),gyro_z (rad/s),acc_x (m/s^2),acc_y (m/s^2),acc_z (m/s^2)\n"


def rows(*columns: np.ndarray, mark: str = ",", end: str = "") -> str:
    return "".join(mark.join(f"{value:.9g}" for value in row) + end + "\n" for row in np.column_stack(columns).tolist())


def imu_text(epoch_s: int = 0) -> str:
    lines = rows(GYRO, ACCEL).splitlines()
    return IMU_HEADER + "".join(f"{epoch_s * 10**9 + n * 10_000_000},{line}\n" for n, line in enumerate(lines))


def motive(unit: str, size: float) -> str:
    """A rigid body and one of its markers; the body is out of sight in the third row."""
    stated = "Format Version,1.23,Take Name,Take 1,Take Notes,,Export Frame Rate,100.000000,Rotation Type,Quaternion"
    stated += f",Length Units,{unit}"
    names, axes = ",".join(["drone"] * 8), ",".join(["Rotation"] * 4 + ["Position"] * 3 + ["Mean Marker Error"])
    header = [
        f",Type,{names.replace('drone', 'Rigid Body')},Marker,Marker,Marker",
        f",Name,{names},m,m,m",
        f",ID,{names},m,m,m",
    ]
    header += [f",,{axes},Position,Position,Position", "Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,,X,Y,Z"]
    lines = rows(np.arange(COUNT), T_S, XYZW, size * P_M, 0.0 * T_S, size * P_M + 1.0).splitlines()
    lines[2] = "2,0.02" + "," * 11
    return "\n".join([stated + "\n", *header, *lines]) + "\n"


def vicon() -> str:
    header = "Objects\n100\n,,Global Angle drone:drone,,,,,,\nFrame,Sub Frame,RX,RY,RZ,RW,TX,TY,TZ\n,,,,,,mm,mm,mm\n"
    return header + rows(np.arange(1, COUNT + 1), 0 * T_S, XYZW, 1000.0 * P_M)


def qualisys() -> str:
    header = f"NO_OF_FRAMES\t{COUNT}\nFREQUENCY\t100\nDATA_INCLUDED\t6D\nBODY_NAMES\tdrone\n"
    header += "Frame\tTime\tdrone X\tY\tZ\tRoll\tPitch\tYaw\tResidual\t" + "\t".join(f"Rot[{n}]" for n in range(9)) + "\t\n"
    columns = np.arange(1, COUNT + 1), T_S, 1000.0 * P_M, 0.0 * P_M, 0 * T_S, MATRICES.transpose(0, 2, 1).reshape(-1, 9)
    return header + rows(*columns, mark="\t", end="\t")


EXPORTS = {
    "Take 2026-11-23 01.02.03 PM.csv": motive("Millimeters", 1000.0),
    "Take 1.csv": motive("Meters", 1.0),
    "objects.csv": vicon(),
    "6D.tsv": qualisys(),
}


def write_qualisys_mat(path: Path, bodies: int, **changed: Any) -> None:
    """A measurement as Qualisys saves it: a text of its own in the header, bodies in mm, matrices column by column."""
    turned = MATRICES.transpose(2, 1, 0).reshape(9, COUNT)
    turned[:, 2], place = np.nan, np.where(np.arange(COUNT) == 2, np.nan, 1000.0 * P_M.T)  # out of sight
    other = np.zeros((3, COUNT)), np.tile(np.eye(3).reshape(9, 1), COUNT)
    rigid = {
        "Bodies": float(bodies),
        "Name": np.array(["drone", "table"][:bodies], dtype=object),
        "Positions": np.stack([place, other[0]][:bodies]),
        "Rotations": np.stack([turned, other[1]][:bodies]),
    }
    measured = {"File": "walk.qtm", "Frames": float(COUNT), "FrameRate": 100.0, "RigidBodies": rigid}
    rigid |= {name: value for name, value in changed.items() if name in rigid}
    savemat(path, {path.stem: measured | {name: value for name, value in changed.items() if name in measured}})
    saved = path.read_bytes()
    path.write_bytes(b"QTM_ver 2.10, Level 5 MAT-file".ljust(124, b"\0") + saved[124:])


def read(folder: Path) -> MessageLog:
    return table.read_sequence(table.sequences(folder)[0])


@pytest.mark.parametrize("name", EXPORTS)
def test_an_export_of_a_motion_capture_beside_an_imu_is_its_truth_in_metres(tmp_path, name):
    (tmp_path / name).write_text(EXPORTS[name])
    (tmp_path / "phone.csv").write_text(imu_text())
    log = read(tmp_path)
    poses = log.poses["/ground_truth/pose"]
    seen = np.arange(COUNT) != 2 if "Take" in name else np.full(COUNT, True)
    np.testing.assert_allclose(poses.p_wb, P_M[seen], atol=1e-6)
    np.testing.assert_allclose(np.abs((poses.q_wb_wxyz * XYZW[seen][:, [3, 0, 1, 2]]).sum(axis=1)), 1.0, atol=1e-7)
    np.testing.assert_allclose(poses.t_ns, 1e9 * T_S[seen], atol=1.0)
    assert log.kinds == {"/ground_truth/pose": "truth"}
    assert log.remarks.losses == []


@pytest.mark.parametrize("bodies", [1, 2])
def test_a_measurement_of_qualisys_saved_for_matlab_is_the_truth_of_the_sensors_beside_it(tmp_path, bodies):
    write_qualisys_mat(tmp_path / "walk_7.mat", bodies)
    (tmp_path / "gyroscope.txt").write_text("time [s],x (rad/s),y (rad/s),z (rad/s)\n" + rows(T_S, GYRO))
    (tmp_path / "accelerometer.txt").write_text("time [s],x (m/s^2),y (m/s^2),z (m/s^2)\n" + rows(T_S, ACCEL))
    log = read(tmp_path)
    poses, seen = log.poses["/ground_truth/pose"], np.arange(COUNT) != 2
    np.testing.assert_allclose(poses.p_wb, P_M[seen], atol=1e-9)
    np.testing.assert_allclose(np.abs((poses.q_wb_wxyz * XYZW[seen][:, [3, 0, 1, 2]]).sum(axis=1)), 1.0, atol=1e-9)
    np.testing.assert_allclose(poses.t_ns, 1e9 * T_S[seen], atol=1.0)
    assert log.kinds == {"/ground_truth/pose": "truth"}
    assert log.remarks.losses == []
    assert any("bodies in it: drone, table" in note for note in log.remarks.notes) == (bodies > 1)


@pytest.mark.parametrize("rotation", ["angles of Vicon", "angles of Motive"])
def test_angles_of_no_certain_convention_are_no_poses_and_a_loss(tmp_path, rotation):
    without = vicon().replace("RX,RY,RZ,RW,", "RX,RY,RZ,,")
    text = without if "Vicon" in rotation else motive("Meters", 1.0).replace("Rotation Type,Quaternion", "Rotation Type,XYZ")
    (tmp_path / "mocap.csv").write_text(text)
    (tmp_path / "imu.csv").write_text(imu_text())
    log = read(tmp_path)
    assert log.poses == {}
    assert any("export the rotation as a quaternion" in loss for loss in log.remarks.losses)


def test_the_imu_keeps_its_own_clock_beside_a_truth_of_as_many_rows(tmp_path):
    (tmp_path / "imu.csv").write_text(imu_text(EPOCH_S))
    late = rows(P_M, XYZW, mark=" ").splitlines()
    (tmp_path / "gt.txt").write_text(
        "# timestamp tx ty tz qx qy qz qw\n"
        + "".join(f"{EPOCH_S + 3 + t:.6f} {line}\n" for t, line in zip(T_S, late, strict=True))
    )
    log = read(tmp_path)
    assert log.imus["/imu0"].t_ns[0] == EPOCH_S * 10**9
    assert log.poses["/ground_truth/pose"].t_ns[0] == (EPOCH_S + 3) * 10**9


def test_a_table_of_poses_is_taken_before_what_the_imus_table_estimates(tmp_path):
    own = np.column_stack([P_M + 5.0, XYZW])
    names, *lines = imu_text().splitlines()
    beside = [f"{line},{','.join(map(repr, row))}" for line, row in zip(lines, own.tolist(), strict=True)]
    (tmp_path / "imu.csv").write_text("\n".join([names + ",x,y,z,qx,qy,qz,qw", *beside]) + "\n")
    (tmp_path / "estPose.csv").write_text("time,px,py,pz,qx,qy,qz,qw\n" + rows(T_S[::2], P_M[::2], XYZW[::2]))
    (poses,) = read(tmp_path).poses.values()
    np.testing.assert_allclose(poses.p_wb, P_M[::2], atol=1e-6)


def test_a_truth_without_a_time_has_that_of_the_rate_that_it_states(tmp_path):
    columns = imu_text().splitlines()
    imu = "\n".join(line.split(",", 1)[1] for line in columns)
    rows = "\n".join(",".join(map(repr, row)) for row in np.column_stack([P_M, XYZW])[::2].tolist())
    (tmp_path / "imu.csv").write_text("# sampling frequency: 100\n" + imu + "\n")
    (tmp_path / "mocap.csv").write_text("# sampling frequency: 50\npx,py,pz,qx,qy,qz,qw\n" + rows + "\n")
    poses = read(tmp_path).poses["/ground_truth/pose"]
    np.testing.assert_allclose(poses.t_ns, 2e7 * np.arange(len(P_M[::2])))
    np.testing.assert_allclose(poses.p_wb, P_M[::2], atol=1e-6)


@pytest.mark.parametrize("rate_hz", [100.0, 50.0])  # at the first it has as many rows as the IMU
@pytest.mark.parametrize("size", [1.0, 1e3])  # s or ms
def test_a_truth_that_begins_at_zero_keeps_its_clock_beside_an_imu_of_this_century(tmp_path, rate_hz, size):
    (tmp_path / "imu.csv").write_text(imu_text(EPOCH_S))
    step = round(100.0 / rate_hz)
    true = rows(size * (T_S[::step] + 0.1), P_M[::step], XYZW[::step])
    (tmp_path / "gt.csv").write_text("time,px,py,pz,qx,qy,qz,qw\n" + true)
    log = read(tmp_path)
    assert log.imus["/imu0"].t_ns[0] == EPOCH_S * 10**9
    np.testing.assert_allclose(log.poses["/ground_truth/pose"].t_ns, 1e9 * (T_S[::step] + 0.1), atol=1e3)


@pytest.mark.parametrize("late_s", [0.0, 0.7])
def test_numbered_matrices_of_a_motion_about_one_axis_are_asked(tmp_path, late_s):
    """They turn as the gyro does row by row and column by column."""
    yaw = Rotation.from_euler("z", 3.0 * ANGLES[:, :1])
    gyro = np.vstack([(yaw[:-1].inv() * yaw[1:]).as_rotvec() * 100.0, np.zeros(3)])
    header = "Time,Position X,Position Y,Position Z," + ",".join(f"Rotation[{n}]" for n in range(9)) + "\n"
    tilted = Rotation.from_euler("x", 1.2) * yaw * Rotation.from_euler("y", 0.5)  # the body is turned against the gyro
    (tmp_path / "gt.csv").write_text(header + rows(T_S + late_s, P_M, tilted.as_matrix().reshape(-1, 9)))
    (tmp_path / "imu.csv").write_text(IMU_HEADER + rows(1e9 * T_S, gyro, 0.0 * gyro + [0.0, 0.0, 9.8]))
    log = read(tmp_path)
    assert log.poses == {}
    assert any("nor do their transposes; `rotation_matrix` of a map" in note for note in log.remarks.notes)


def sensor_tables(folder: Path, names: tuple[str, str], epoch_s: int = 0) -> None:
    """A table of the gyroscope and one of the accelerometer."""
    for name, unit, values in zip(names, ("rad/s", "m/s^2"), (GYRO, ACCEL), strict=True):
        lines = rows(values).splitlines()
        at_ns = (epoch_s * 10**9 + n * 10_000_000 for n in range(COUNT))
        text = "".join(f"{t},{line}\n" for t, line in zip(at_ns, lines, strict=True))
        (folder / f"{name}.csv").write_text(f"time_ns,x [{unit}],y [{unit}],z [{unit}]\n" + text)


@pytest.mark.parametrize("name", EXPORTS)
def test_an_export_of_a_motion_capture_beside_tables_of_a_sensor_each_is_their_truth(tmp_path, name):
    sensor_tables(tmp_path, ("gyroscope_3", "accelerometer_1"), EPOCH_S)
    (tmp_path / name).write_text(EXPORTS[name])
    log = read(tmp_path)
    assert log.kinds == {"/ground_truth/pose": "truth"}
    assert log.poses["/ground_truth/pose"].t_ns[-1] < 1e12  # on its own clock, for `--fix`
    np.testing.assert_allclose(log.imus["/imu0"].gyro, GYRO, rtol=1e-8)


def test_files_that_are_numbered_in_turn_are_the_imus_whose_names_they_share(tmp_path):
    sensor_tables(tmp_path, ("gyroscope_3", "accelerometer_1"), EPOCH_S)
    sensor_tables(tmp_path, ("second_gyroscope_21", "second_accelerometer_20"), EPOCH_S)
    sensor_tables(tmp_path, ("gyroscope_uncalibrated_4", "accelerometer_uncalibrated_2"), EPOCH_S)
    slow = np.arange(20) * 9_000 + 802_485_584  # ms since a boot: at a plausible rate they would be us
    (tmp_path / "location_8.csv").write_text("time,lat,lon,height\n" + "".join(f"{t},1.5,2.5,{t % 7}\n" for t in slow))
    (tmp_path / "sensors.csv").write_text("number,type,version,delay\n1,2,3,4\n2,3,4,5\n")
    log = read(tmp_path)
    assert {*log.imus} == {"/imu/imu", "/second/imu"}
    assert not [topic for topic in log.scalars if "location" in topic]
    assert any("without a time, are left out: " in loss and "location_8/lat" in loss for loss in log.remarks.losses)


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("rows_first", [True, False])
@pytest.mark.parametrize("late_s", [0.0, 0.7])
def test_nine_numbered_columns_are_matrices_in_the_order_in_which_they_turn(tmp_path, first, rows_first, late_s):
    nine = (MATRICES if rows_first else MATRICES.transpose(0, 2, 1)).reshape(-1, 9)
    header = "Time,Position X,Position Y,Position Z," + ",".join(f"Rotation[{n + first}]" for n in range(9)) + "\n"
    (tmp_path / "gt.csv").write_text(header + rows(T_S + late_s, P_M, nine))
    (tmp_path / "imu.csv").write_text(imu_text())
    poses = read(tmp_path).poses["/ground_truth/pose"]
    np.testing.assert_allclose(Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True).as_matrix(), MATRICES, atol=1e-6)
    np.testing.assert_allclose(poses.p_wb, P_M, atol=1e-8)


@pytest.mark.parametrize("rotation", ["R_wb", "C_nb", "q_wb", "q_wb_wxyz"])
def test_rotations_and_positions_may_name_their_frames(tmp_path, rotation):
    values = MATRICES if rotation[0] in "RC" else TURN.as_quat(scalar_first=rotation.endswith("wxyz"))
    np.savez(tmp_path / "run.npz", t=T_S, gyro=GYRO, accel=ACCEL, p_wb=P_M, **{rotation: values})
    log = read(tmp_path / "run.npz")
    poses = log.poses["/estimate/pose"]
    np.testing.assert_allclose(Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True).as_matrix(), MATRICES, atol=1e-6)
    np.testing.assert_allclose(poses.p_wb, P_M)
    np.testing.assert_allclose(log.imus["/imu0"].gyro, GYRO)


@pytest.mark.parametrize(
    ("names", "size"), [("x_{},y_{},z_{}", 1e3), ("pos_x_{},pos_y_{},pos_z_{}", 1.0), ("px_{},py_{},pz_{}", 1e2)]
)
def test_positions_state_their_unit_at_the_end_of_their_names(tmp_path, names, size):
    unit = {1.0: "m", 1e2: "cm", 1e3: "mm"}[size]
    (tmp_path / "imu.csv").write_text(imu_text())
    header = f"t_s,{names.format(*[unit] * 3)},qx,qy,qz,qw\n"
    (tmp_path / "groundtruth.csv").write_text(header + rows(T_S, size * P_M, XYZW))
    (sequence,) = table.sequences(tmp_path)
    poses = table.read_sequence(sequence).poses["/ground_truth/pose"]
    np.testing.assert_allclose(poses.p_wb, P_M, atol=1e-6)


@pytest.mark.parametrize("kind", ["positions,orientations", "translations,quats", "frame_positions,frame_quaternions"])
def test_arrays_of_poses_may_have_names_in_the_plural(tmp_path, kind):
    """As Python programs name them; those of comma2k19 are of a frame."""
    (tmp_path / "imu.csv").write_text(imu_text())
    arrays = dict(zip(["times", *kind.split(",")], (T_S[::5], P_M[::5], XYZW[::5]), strict=True))
    np.savez(tmp_path / "ground_truth.npz", **arrays)
    (sequence,) = table.sequences(tmp_path)
    poses = table.read_sequence(sequence).poses["/ground_truth/pose"]
    np.testing.assert_allclose(poses.p_wb, P_M[::5])
    np.testing.assert_allclose(poses.q_wb_wxyz[:, [1, 2, 3, 0]], XYZW[::5], atol=1e-12)


def test_a_map_that_names_rotations_alone_takes_the_time_beside_them(tmp_path):
    names = [f"u{n}" for n in range(4)]
    (tmp_path / "gt.csv").write_text("time,x,y,z," + ",".join(names) + "\n" + rows(T_S[::2], P_M[::2], XYZW[::2]))
    (tmp_path / "imu.csv").write_text(imu_text())
    (tmp_path / "uwb.csv").write_text("time,x,y,z\n" + rows(T_S[::5], P_M[::5]))
    (sequence,) = table.sequences(tmp_path)
    stated = {"quaternion_wxyz": [names[3], *names[:3]], "position": ["x", "y", "z"]}  # those of the truth
    poses = table.read_sequence(sequence, mapping=stated).poses["/ground_truth/pose"]
    np.testing.assert_allclose(poses.t_ns, 1e9 * T_S[::2], atol=1.0)
    np.testing.assert_allclose(poses.p_wb, P_M[::2], atol=1e-8)


def test_matrices_on_a_clock_of_their_own_say_so_and_keep_their_positions_where_a_map_names_them(tmp_path):
    names = [f"Rotation[{n}]" for n in range(9)]
    header = "Time,Position X [mm],Position Y [mm],Position Z [mm]," + ",".join(names)
    (tmp_path / "gt.csv").write_text(f"{header}\n" + rows(T_S, 1e3 * P_M, MATRICES.reshape(-1, 9)))
    (tmp_path / "imu.csv").write_text(imu_text(EPOCH_S))
    assert "nor do their transposes: their clocks share no time; `rotation_matrix`" in read(tmp_path).remarks.losses[0]
    stated = {"rotation_matrix": [f"ground_truth/{name}" for name in names]}
    poses = table.read_sequence(table.sequences(tmp_path)[0], mapping=stated).poses["/ground_truth/pose"]
    np.testing.assert_allclose(poses.p_wb, P_M, atol=1e-6)


def test_a_map_may_name_rotations_where_the_unit_of_the_gyro_is_open(tmp_path):
    bumpy = np.random.default_rng(1).normal(size=ACCEL.shape) * 3.0 + [0.0, 0.0, 9.8]  # gravity does not turn in it
    (tmp_path / "gt.csv").write_text("t,u0,u1,u2,u3\n" + rows(T_S, XYZW))
    path = tmp_path / "imu.csv"
    path.write_text("time,gx,gy,gz,ax,ay,az,u0,u1,u2,u3\n" + rows(T_S, np.rad2deg(GYRO), bumpy, XYZW))
    (sequence,) = table.sequences(path)
    log = table.read_sequence(sequence, mapping={"quaternion_wxyz": ["u3", "u0", "u1", "u2"]})
    np.testing.assert_allclose(log.imus["/imu0"].gyro, GYRO, atol=1e-8)
    with pytest.raises(ConfigError, match="no column 'u4'"):
        table.read_sequence(sequence, mapping={"quaternion_wxyz": ["u4", "u0", "u1", "u2"]})
    elsewhere = {"quaternion_wxyz": ["w", "x", "y", "z"], "truth_file": "gt.csv"}
    with pytest.raises(ConfigError, match="state no unit of the gyro"):
        table.read_sequence(sequence, mapping=elsewhere)


def test_the_biases_beside_a_true_state_are_no_imu(tmp_path):
    (tmp_path / "imu.csv").write_text(imu_text())
    names = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
    biases = [f"b_{sensor}_RS_S_{axis} [{unit}]" for sensor, unit in (("w", "rad s^-1"), ("a", "m s^-2")) for axis in "xyz"]
    state = rows(1e9 * T_S, P_M, XYZW[:, [3, 0, 1, 2]], 0.0 * GYRO, 0.0 * ACCEL)
    (tmp_path / "gt.csv").write_text(", ".join([names, *biases]) + "\n" + state)
    log = read(tmp_path)
    assert [*log.imus] == ["/imu0"]
    np.testing.assert_allclose(log.imus["/imu0"].accel, ACCEL, atol=1e-6)
    np.testing.assert_allclose(log.poses["/ground_truth/pose"].p_wb, P_M, atol=1e-6)


@pytest.mark.parametrize("name", ["poses.txt", "trajectory.tum"])
def test_a_trajectory_of_another_name_is_an_estimate(tmp_path, name):
    (tmp_path / "imu.csv").write_text(imu_text())
    (tmp_path / name).write_text(rows(T_S, P_M, XYZW, mark=" "))
    log = read(tmp_path)
    assert log.kinds == {"/estimate/pose": "estimate"}
    np.testing.assert_allclose(log.poses["/estimate/pose"].p_wb, P_M, atol=1e-6)


ROBOT = {
    "words": ("ABBposition", "ABBquaternion", ["_0", "_1", "_2"], ["_0", "_1", "_2", "_3"]),
    "letters": ("tool_", "tool_q", ["x", "y", "z"], ["w", "x", "y", "z"]),
}


def robot_table(
    path: Path, named: str, late_s: float = 0.0, count: int = COUNT, prefix: str = "", *, inverse: bool = False, mount: str = ""
) -> None:
    """Poses of a robot in the rows of an IMU, in columns of its name; so many seconds late.

    With `inverse` quaternions take the world to the body, and with `mount` the IMU is turned by 90 degrees about that axis.
    """
    place, turn, xyz, wxyz = ROBOT[named]
    header = [
        "time [s]",
        *(f"{sensor}_{axis} ({unit})" for sensor, unit in (("gyro", "rad/s"), ("acc", "m/s^2")) for axis in "xyz"),
    ]
    header += [prefix + place + axis for axis in xyz] + [prefix + turn + axis for axis in wxyz]
    at = np.clip(np.arange(count) - round(100 * late_s), 0, COUNT - 1)
    q_wxyz = XYZW[at][:, [3, 0, 1, 2]] * (np.array([1, -1, -1, -1]) if inverse else 1)
    R = Rotation.from_euler(mount or "z", 90.0 if mount else 0.0, degrees=True)
    sensors = (R.apply(column)[:count] for column in (GYRO, ACCEL))
    path.write_text(",".join(header) + "\n" + rows(T_S[:count], *sensors, P_M[at], q_wxyz))


@pytest.mark.parametrize("late_s", [0.0, 0.1, -0.2])
@pytest.mark.parametrize("named", ROBOT)
def test_columns_of_one_body_s_position_and_quaternion_are_its_poses(tmp_path, named, late_s):
    robot_table(tmp_path / "log.csv", named, late_s)
    (log,) = table.read(tmp_path / "log.csv")
    at = np.clip(np.arange(COUNT) - round(100 * late_s), 0, COUNT - 1)
    np.testing.assert_allclose(log.poses["/estimate/pose"].p_wb, P_M[at], atol=1e-6)
    assert [note for note in log.remarks.notes if "/ground_truth/pose" in note] == []
    alike = np.abs((log.poses["/estimate/pose"].q_wb_wxyz * XYZW[at][:, [3, 0, 1, 2]]).sum(axis=1))
    np.testing.assert_allclose(alike, 1.0, atol=1e-7)


@pytest.mark.parametrize("mount", ["", "x", "y", "z"])
@pytest.mark.parametrize("inverse", [False, True])
def test_quaternions_from_the_world_to_the_body_keep_the_world_of_their_positions(tmp_path, inverse, mount):
    """Their inverse turns as those in the other order do, but in other frames; gravity shows which it is."""
    robot_table(tmp_path / "log.csv", "words", inverse=inverse, mount=mount)
    (log,) = table.read(tmp_path / "log.csv")
    poses = log.poses["/estimate/pose"]
    np.testing.assert_allclose(np.abs((poses.q_wb_wxyz * XYZW[:, [3, 0, 1, 2]]).sum(axis=1)), 1.0, atol=1e-7)
    assert any("from the world to the body" in note for note in log.remarks.notes) == inverse
    assert not log.scalars  # the negative columns of the quaternion are poses, too


def test_a_setpoint_of_a_robot_is_no_pose(tmp_path):
    robot_table(tmp_path / "log.csv", "letters", prefix="desired_")
    (log,) = table.read(tmp_path / "log.csv")
    assert log.poses == {}


def test_poses_in_rows_whose_order_too_few_seconds_show_are_said(tmp_path):
    robot_table(tmp_path / "log.csv", "words", count=400)
    (log,) = table.read(tmp_path / "log.csv")
    assert log.poses == {}
    assert any("ABBquaternion" in note and "quaternion_wxyz" in note for note in log.remarks.notes)


def test_a_truth_that_gives_no_poses_is_a_loss(tmp_path):
    """KITTI's poses are twelve numbers a row, without a time."""
    (tmp_path / "imu.csv").write_text(imu_text())
    (tmp_path / "poses_gt.txt").write_text(rows(np.concatenate([MATRICES, P_M[:, :, None]], axis=2).reshape(-1, 12), mark=" "))
    log = read(tmp_path)
    assert log.poses == {}
    assert any("poses_gt.txt gives no poses" in loss for loss in log.remarks.losses)


def test_true_positions_without_orientations_are_named_as_such(tmp_path):
    """As an UWB or GNSS track gives them."""
    (tmp_path / "imu.csv").write_text(imu_text())
    track = "\n".join(f"{0.1 * n:.1f},{0.01 * n:.2f},0.5,1.0" for n in range(200))
    (tmp_path / "ground_truth.csv").write_text(f"time [s],x,y,z\n{track}\n")
    log = read(tmp_path)
    assert log.poses == {}
    assert any("it has positions without orientations" in loss for loss in log.remarks.losses)
    assert "/ground_truth_x" in log.scalars


@pytest.mark.parametrize(
    "changed",
    [{"FrameRate": 0.0}, {"FrameRate": np.nan}, {"FrameRate": "fast"}, {"Rotations": np.zeros((8, COUNT))}, {"Positions": 0.0}],
    ids=str,
)
def test_a_measurement_of_qualisys_that_contradicts_itself_is_refused(tmp_path, changed):
    write_qualisys_mat(tmp_path / "walk_7.mat", 1, **changed)
    with pytest.raises(DataError, match="its measurement of Qualisys"):
        table.load(tmp_path / "walk_7.mat", "mat")


def test_a_kind_of_poses_that_are_not_found_is_a_loss(tmp_path):
    path = tmp_path / "imu.csv"
    path.write_text(imu_text())
    log = table.read_sequence(table.sequences(path)[0], mapping={"pose_kind": "truth"})
    assert log.poses == {}
    assert any("imu.csv gives no poses" in loss and "quaternion_wxyz" in loss for loss in log.remarks.losses)
    assert not read(path).remarks.losses


def zipped(content: bytes, path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("inside.csv", content)


def in_frames(content: bytes, path: Path) -> None:
    path.write_bytes(zstandard.compress(content[:9_000]) + zstandard.compress(content[9_000:]))


PACKINGS: dict[str, Callable[[bytes, Path], object]] = {
    ".csv.gz": lambda content, path: path.write_bytes(gzip.compress(content)),
    ".csv.xz": lambda content, path: path.write_bytes(lzma.compress(content)),
    ".csv.bz2": lambda content, path: path.write_bytes(bz2.compress(content)),
    ".csv.zst": lambda content, path: path.write_bytes(zstandard.compress(content)),
    ".zip": zipped,
    ".zst": in_frames,
}


@pytest.mark.parametrize("ending", PACKINGS)
def test_a_packed_table_reads_as_the_table(convert, tmp_path, ending):
    path = tmp_path / f"walk{ending}"
    PACKINGS[ending](imu_text().encode(), path)
    before = path.read_bytes()
    (log,) = table.read(path)
    np.testing.assert_allclose(log.imus["/imu0"].gyro, GYRO, atol=1e-8)
    assert log.name == "walk"
    assert path.read_bytes() == before
    assert convert(path, tmp_path / "out.mcap").returncode == 0


@pytest.mark.parametrize("ending", [".csv.gz", ".csv.xz", ".csv.bz2", ".csv.zst"])
def test_a_packed_table_that_is_cut_or_too_large_is_refused_in_one_sentence(convert, tmp_path, ending):
    PACKINGS[ending](imu_text().encode(), tmp_path / f"cut{ending}")
    content = (tmp_path / f"cut{ending}").read_bytes()
    (tmp_path / f"cut{ending}").write_bytes(content[: len(content) // 2])
    done = convert(tmp_path / f"cut{ending}", tmp_path / "out.mcap")
    assert done.returncode == 4
    assert "cannot be" in done.stderr or "it is compressed with" in done.stderr
    PACKINGS[ending](b"t,ax,ay,az,gx,gy,gz\n" + b"1,2,3,4,5,6,7\n" * 10 + b"\n" * (1 << 25), tmp_path / f"bomb{ending}")
    with pytest.raises(DataError, match="unpacks to more than"):
        list(table.read(tmp_path / f"bomb{ending}"))


def test_a_folder_may_hold_packed_tables(tmp_path):
    (tmp_path / "imu.csv.gz").write_bytes(gzip.compress(imu_text().encode()))
    (tmp_path / "groundtruth.txt.gz").write_bytes(gzip.compress(rows(T_S, P_M, XYZW, mark=" ").encode()))
    np.testing.assert_allclose(read(tmp_path).poses["/ground_truth/pose"].p_wb, P_M, atol=1e-6)


def test_rates_of_a_reference_are_no_second_imu_and_no_recording(tmp_path):
    """As a GNSS/INS writes its motion, attitude and position to tables of their own."""
    (tmp_path / "imu.csv").write_text(imu_text())
    (tmp_path / "reference_motion.csv").write_text(imu_text())
    angles = ",".join(f"{name}_deg" for name in ("roll", "pitch", "yaw"))
    attitude = np.degrees(ANGLES[:, ::-1])
    (tmp_path / "reference_attitude.csv").write_text(f"t_s,{angles}\n" + rows(T_S, attitude))
    stated = {"roll_pitch_yaw": [f"reference_attitude/{name}" for name in angles.split(",")]}
    (sequence,) = table.sequences(tmp_path)
    log = table.read_sequence(sequence, mapping=stated)
    assert [*log.imus] == ["/imu0"]
    np.testing.assert_allclose(np.abs((log.poses["/ground_truth/pose"].q_wb_wxyz * XYZW[:, [3, 0, 1, 2]]).sum(axis=1)), 1.0)
    assert "/reference_motion_gyro_x_rad_s" in log.scalars


@pytest.mark.parametrize("name", ["ref.csv", "reference.csv", "robot_reference.csv"])
def test_poses_in_a_file_named_as_the_reference_are_true(tmp_path, name):
    (tmp_path / "imu.csv").write_text(imu_text())
    (tmp_path / name).write_text("time [s],px,py,pz,qx,qy,qz,qw\n" + rows(T_S, P_M, XYZW))
    assert read(tmp_path).kinds == {"/ground_truth/pose": "truth"}


@pytest.mark.parametrize("first", ["IMU", "truth"])
def test_true_poses_in_the_imus_table_may_have_a_time_of_their_own(tmp_path, first):
    imu, true = imu_text().splitlines(), ["truth_t [s],truth_px,truth_py,truth_pz,truth_qx,truth_qy,truth_qz,truth_qw"]
    true += rows(T_S + 0.023, P_M, XYZW).splitlines()
    pairs = zip(imu, true, strict=True) if first == "IMU" else zip(true, imu, strict=True)
    (tmp_path / "log.csv").write_text("\n".join(map(",".join, pairs)) + "\n")
    log = read(tmp_path)
    assert np.array_equal(log.imus["/imu0"].t_ns, 10_000_000 * np.arange(COUNT))
    np.testing.assert_allclose(log.poses["/ground_truth/pose"].t_ns, 1e9 * (T_S + 0.023), atol=1e3)


def test_poses_of_ros_in_tables_are_on_the_stamps_of_their_headers(tmp_path):
    """As bagpy and `rostopic echo -p` write them; the recorder's own time is 4 ms later."""
    times_ns = [1e9 * T_S + 4e6, 1e9 * T_S]
    for name, fields, values in (
        ("imu", ("angular_velocity.{}", "linear_acceleration.{}"), (GYRO, ACCEL)),
        ("vicon", ("pose.position.{}", "pose.orientation.{}"), (P_M, XYZW)),
    ):
        names = [f"field.{field.format(axis)}" for field in fields for axis in ("xyzw" if "orientation" in field else "xyz")]
        header = ",".join(["%time", "field.header.stamp", *names])
        (tmp_path / f"{name}.csv").write_text(f"{header}\n{rows(*times_ns, *values)}")
    log = read(tmp_path)
    np.testing.assert_allclose(log.imus["/imu0"].accel, ACCEL, atol=1e-6)
    poses = log.poses["/ground_truth/pose"]
    np.testing.assert_allclose(poses.t_ns, times_ns[1], atol=1.0)
    np.testing.assert_allclose(poses.p_wb, P_M, atol=1e-8)


@pytest.mark.parametrize(("other", "quaternion"), [("mag", "q"), ("gravity", "attitude.q")])
def test_other_vectors_beside_an_orientation_are_no_positions(tmp_path, other, quaternion):
    names = [f"{each}.{axis}" for each in ("gyro", "acc", other) for axis in "xyz"]
    header = ",".join(["time", *names, *(f"{quaternion}{axis}" for axis in "xyzw")])
    (tmp_path / "imu.csv").write_text(f"{header}\n{rows(T_S, GYRO, ACCEL, ACCEL / 9.80665, XYZW)}")
    log = read(tmp_path / "imu.csv")
    assert log.poses == {}
    assert f"/{other}_x" in log.scalars


@pytest.mark.parametrize(
    ("names", "kind"), [(("attitude", "position"), "estimate"), (("gt_orientation", "gt_position"), "truth")]
)
def test_orientations_and_positions_in_two_tables_are_poses_together(tmp_path, names, kind):
    (tmp_path / "imu.csv").write_text(imu_text())
    (tmp_path / f"{names[0]}.csv").write_text("time [s],qx,qy,qz,qw\n" + rows(T_S + 0.003, XYZW))
    gap = np.r_[np.arange(0, 700, 5), np.arange(800, COUNT, 5)]
    (tmp_path / f"{names[1]}.csv").write_text("time [s],x,y,z\n" + rows(T_S[gap], P_M[gap]))
    log = read(tmp_path)
    ((topic, poses),) = log.poses.items()
    assert log.kinds[topic] == kind
    t_s = 1e-9 * poses.t_ns
    assert len(t_s) == pytest.approx(COUNT - 105, abs=10)  # without the gap, across which nothing is interpolated
    assert ((t_s < 6.96) | (t_s > 7.99)).all()
    np.testing.assert_allclose(poses.p_wb, np.sin(t_s[:, None] * [0.5, 0.8, 1.1]), atol=1e-3)


@pytest.mark.parametrize("names", ["x_ned,y_ned,z_ned", "pos_ned_x,pos_ned_y,pos_ned_z", "pos_n,pos_e,pos_d"])
def test_positions_whose_names_say_ned_are_turned_to_a_world_with_z_up(tmp_path, names):
    (tmp_path / "imu.csv").write_text(imu_text())
    to_ned = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    poses = rows(T_S, to_ned.apply(P_M), (to_ned * TURN).as_quat())
    (tmp_path / "groundtruth.csv").write_text(f"time [s],{names},qx,qy,qz,qw\n{poses}")
    true = read(tmp_path).poses["/ground_truth/pose"]
    np.testing.assert_allclose(true.p_wb, P_M, atol=1e-8)
    np.testing.assert_allclose(Rotation.from_quat(true.q_wb_wxyz, scalar_first=True).as_matrix(), MATRICES, atol=1e-6)


@pytest.mark.parametrize("names", ["east,north,up", "easting,northing,altitude", "x,y,z"])
def test_a_heading_counts_from_the_first_axis_of_the_positions(tmp_path, names):
    """Of positions east, north and up from the second: else they and the rotations would be in two worlds."""
    (tmp_path / "imu.csv").write_text(imu_text())
    angles = np.degrees(TURN.as_euler("ZYX"))[:, ::-1]
    to_north = names != "x,y,z"
    heading = (90.0 * to_north - angles[:, 2:]) % 360.0
    (tmp_path / "gt.csv").write_text(f"time [s],{names},roll,pitch,heading\n{rows(T_S, P_M, angles[:, :2], heading)}")
    log = read(tmp_path)
    poses = log.poses["/ground_truth/pose"]
    world = Rotation.from_euler("z", -90.0 * to_north, degrees=True)
    np.testing.assert_allclose(poses.p_wb, world.apply(P_M), atol=1e-8)
    found = Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True).as_matrix()
    np.testing.assert_allclose(found, (world * TURN).as_matrix(), atol=1e-6)
    assert any("heading is taken as 0 along" in note for note in log.remarks.notes)


@pytest.mark.parametrize("named", ["b_{}_{}", "bias_{}_{}", "b_{}_RS_S_{}"])
def test_biases_of_an_estimate_are_no_imu(tmp_path: Path, named: str) -> None:
    """As OKVIS, VIO programs and EuRoC name them, next to positions `p_WS_W_x`."""
    (tmp_path / "imu.csv").write_text(imu_text())
    words = {"b_{}_{}": ("g", "a"), "bias_{}_{}": ("gyro", "acc"), "b_{}_RS_S_{}": ("w", "a")}[named]
    biases = [
        f"{named.format(word, axis)} {unit}" for word, unit in zip(words, ("[rad/s]", "[m/s^2]"), strict=True) for axis in "xyz"
    ]
    names = ["t [s]", *(f"p_WS_W_{a}" for a in "xyz"), *(f"q_WS_{a}" for a in "xyzw"), *(f"v_WS_W_{a}" for a in "xyz"), *biases]
    lines = rows(T_S, P_M, XYZW, 0.1 * P_M, *([0.01 + 0.0 * T_S] * 6))
    (tmp_path / "okvis.csv").write_text(",".join(names) + "\n" + lines)
    (found,) = table.sequences(tmp_path)
    log = table.read_sequence(found)
    assert ([*log.imus], [*log.poses]) == (["/imu0"], ["/estimate/pose"])
