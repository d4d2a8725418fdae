"""Roll, pitch and yaw in tables: the unit of the gyro by them, true angles next to IMUs, and what is no orientation."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pyarrow
import pytest
import scipy.io
from pyarrow import feather
from scipy.spatial.transform import Rotation
from support.tables import write_csv

from imutool.converters import table
from imutool.errors import ConfigError, DataError
from imutool.recording.message_log import MessageLog

COUNT = 3000
T_S = np.arange(COUNT) / 100.0
RNG = np.random.default_rng(5)


def motion(t_s: np.ndarray) -> Rotation:
    """Turns about all axes, by Rz(yaw) Ry(pitch) Rx(roll)."""
    return Rotation.from_euler("ZYX", np.stack([2.0 + np.sin(0.7 * t_s), 0.6 * np.sin(1.3 * t_s), 0.5 * np.sin(0.9 * t_s)], 1))


TURN = motion(T_S)
GYRO = (motion(T_S - 0.005).inv() * motion(T_S + 0.005)).as_rotvec() * 100.0
ACCEL = np.array([0.0, 0.0, 9.80665]) + RNG.normal(size=(COUNT, 3))  # of a flight without slip: gravity does not turn in it
RPY = TURN.as_euler("ZYX")[:, ::-1]
P_M = np.sin(T_S[:, None] * [0.5, 0.8, 1.1])
SENSOR = "time [s],Euler_X,Euler_Y,Euler_Z,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z\n"  # as Xsens' DOT writes it
TRUTH = "time,compass_heading(degrees),pitch(degrees),roll(degrees),North,East,Down\n"  # as of a drone's flight log


def rows(*columns: np.ndarray) -> str:
    return "".join(",".join(f"{value:.7g}" for value in row) + "\n" for row in np.column_stack(columns).tolist())


def sensor(angles: np.ndarray, gyro_size: float = np.rad2deg(1.0), header: str = SENSOR) -> str:
    return header + rows(T_S, angles, ACCEL, gyro_size * GYRO)


def truth(t_s: np.ndarray, late_s: float = 0.0, yaw: float = 1.0) -> str:
    roll, pitch, heading = np.rad2deg(motion(t_s).as_euler("ZYX")[:, ::-1]).round(1).T
    return TRUTH + rows(t_s + late_s, yaw * heading, pitch, roll, np.sin(t_s[:, None] * [0.5, 0.8, 1.1]))


def read(source: Path) -> MessageLog:
    (sequence,) = table.sequences(source)
    return table.read_sequence(sequence)


@pytest.mark.parametrize(("angle_size", "unit"), [(np.rad2deg(1.0), ""), (1.0, " [rad]")])
@pytest.mark.parametrize("gyro_size", [1.0, np.rad2deg(1.0)])
def test_the_angles_that_a_sensor_gives_beside_its_rates_show_their_unit(tmp_path, angle_size, unit, gyro_size):
    header = re.sub(r"(Euler_[XYZ])", rf"\1{unit}", SENSOR)
    (tmp_path / "dot.csv").write_text(sensor(angle_size * RPY, gyro_size, header))
    log = read(tmp_path / "dot.csv")
    np.testing.assert_allclose(log.imus["/imu0"].gyro, GYRO, atol=1e-5)
    assert log.poses == {}  # an orientation alone is the sensor's own


def test_a_sample_that_is_infinite_hides_the_unit_of_no_other(tmp_path):
    lines = sensor(np.rad2deg(RPY)).splitlines()
    lines[1000] = lines[1000].rpartition(",")[0] + ", -Infinity"
    (tmp_path / "dot.csv").write_text("\n".join(lines) + "\n")
    gyro = read(tmp_path / "dot.csv").imus["/imu0"].gyro
    np.testing.assert_allclose(gyro, np.delete(GYRO, 999, axis=0), atol=1e-5)


@pytest.mark.parametrize("names", ["Euler_X,Euler_Y,Euler_Z", "des_roll,des_pitch,des_yaw"])
def test_angles_of_another_motion_or_of_a_command_show_no_unit(tmp_path, names):
    header = SENSOR.replace("Euler_X,Euler_Y,Euler_Z", names)
    angles = RPY[::-1] if "Euler" in names else RPY
    (tmp_path / "dot.csv").write_text(sensor(np.rad2deg(angles), 20.0, header))
    with pytest.raises(ConfigError, match="state no unit of the gyro"):
        read(tmp_path / "dot.csv")


@pytest.mark.parametrize("late_s", [0.0, 0.4, -0.6])
@pytest.mark.parametrize("yaw", [1.0, -1.0])
def test_true_angles_beside_an_imu_are_poses_also_where_yaw_counts_the_other_way(tmp_path, late_s, yaw):
    (tmp_path / "imu.csv").write_text(sensor(np.rad2deg(RPY)))
    t_s = 1.0 + np.arange(280) / 10.0
    (tmp_path / "GT.csv").write_text(truth(t_s, late_s, yaw))
    log = read(tmp_path)
    poses = log.poses["/ground_truth/pose"]
    assert log.kinds == {"/ground_truth/pose": "truth"}
    to_enu = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    seen = to_enu.inv() * Rotation.from_quat(poses.q_wb_wxyz[:, [1, 2, 3, 0]])
    assert np.rad2deg((motion(t_s).inv() * seen).magnitude()).max() < 0.15  # by the rounded degrees
    north_east_down = np.sin(t_s[:, None] * [0.5, 0.8, 1.1])
    np.testing.assert_allclose(poses.p_wb, to_enu.apply(north_east_down), atol=1e-6)
    np.testing.assert_allclose(poses.t_ns, 1e9 * (t_s + late_s), atol=1e3)  # the clock is for `--fix`
    np.testing.assert_allclose(log.imus["/imu0"].gyro, GYRO, atol=1e-5)


def test_true_angles_of_another_motion_are_no_poses_and_the_reason_says_so(tmp_path):
    (tmp_path / "imu.csv").write_text(sensor(np.rad2deg(RPY)))
    (tmp_path / "GT.csv").write_text(truth(np.arange(300)[::-1] / 10.0).replace("\n", "\n", 1))
    text = truth(np.arange(300) / 10.0).splitlines()
    shuffled = [
        line.split(",")[0] + "," + ",".join(other.split(",")[1:]) for line, other in zip(text[1:], text[:0:-1], strict=True)
    ]
    (tmp_path / "GT.csv").write_text("\n".join([text[0], *shuffled]) + "\n")
    log = read(tmp_path)
    assert log.poses == {}
    assert any("do not turn as the gyro does, as Rz(yaw) Ry(pitch) Rx(roll)" in note for note in log.remarks.notes)
    assert any("GT.csv gives no poses" in loss and "do not turn as the gyro" in loss for loss in log.remarks.losses)


def test_a_map_names_roll_pitch_and_yaw_in_either_unit_and_sense(tmp_path):
    (tmp_path / "imu.csv").write_text(sensor(RPY * [1.0, 1.0, -1.0]))
    stated = [
        'time = "time [s]"',
        'time_unit = "s"',
        'gyro_unit = "deg/s"',
        'accel_unit = "m/s^2"',
        'roll_pitch_yaw_unit = "rad"',
    ]
    stated += ['gyro = ["Gyr_X", "Gyr_Y", "Gyr_Z"]', 'accel = ["Acc_X", "Acc_Y", "Acc_Z"]']
    mapping = tmp_path / "map.toml"
    mapping.write_text("\n".join([*stated, 'roll_pitch_yaw = ["Euler_X", "Euler_Y", "-Euler_Z"]']))
    (sequence,) = table.sequences(tmp_path / "imu.csv")
    poses = table.read_sequence(sequence, mapping=mapping).poses["/ground_truth/pose"]
    seen = Rotation.from_quat(poses.q_wb_wxyz[:, [1, 2, 3, 0]])
    assert (TURN.inv() * seen).magnitude().max() < 1e-6
    mapping.write_text("\n".join([*stated, 'roll_pitch_yaw = ["Euler_X", "Euler_Y"]']))
    with pytest.raises(ConfigError, match="roll_pitch_yaw names 2 columns"):
        table.read_sequence(sequence, mapping=mapping)


def test_several_imus_beside_one_truth_are_one_recording(tmp_path):
    for number in (1, 2):
        (tmp_path / f"IMU_{number}.csv").write_text(sensor(np.rad2deg(RPY) + number))
    turning = RNG.permutation(np.rad2deg(RPY))  # angles of no motion: the unit is that of the others
    (tmp_path / "IMU_avg.csv").write_text(sensor(turning))
    (tmp_path / "GT.csv").write_text(truth(np.arange(300) / 10.0, late_s=1.0))
    log = read(tmp_path)
    assert {*log.imus} == {"/imu_1/imu", "/imu_2/imu", "/imu_avg/imu"}
    assert [*log.poses] == ["/ground_truth/pose"]
    assert log.kinds == {"/ground_truth/pose": "truth"}
    for imu in log.imus.values():
        np.testing.assert_allclose(imu.gyro, GYRO, atol=1e-5)
    assert any("/imu_avg/imu: the other IMUs" in note for note in log.remarks.notes)


def test_imus_of_another_length_are_recordings_of_their_own(tmp_path):
    whole = sensor(np.rad2deg(RPY))
    (tmp_path / "IMU_1.csv").write_text(whole)
    (tmp_path / "IMU_2.csv").write_text("".join(whole.splitlines(keepends=True)[: COUNT // 2]))
    (tmp_path / "GT.csv").write_text(truth(np.arange(300) / 10.0))
    assert [sequence.name for sequence in table.sequences(tmp_path)] == ["IMU_1", "IMU_2"]


def test_a_log_that_mission_planner_wrote_for_matlab_names_its_columns_beside_them(tmp_path):
    imu, attitude = (
        ["LineNo", "TimeMS", "GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ"],
        ["LineNo", "TimeMS", "Roll", "Pitch", "Yaw"],
    )
    line, t_ms = np.arange(COUNT)[:, None], 1000.0 * T_S[:, None] + 13178.0
    content = {
        "IMU": np.hstack([line, t_ms, GYRO, ACCEL]),
        "ATT": np.hstack([line, t_ms, np.rad2deg(RPY)])[::4],
        **{f"{name}_label": np.array(labels, dtype=object)[:, None] for name, labels in (("IMU", imu), ("ATT", attitude))},
    }
    scipy.io.savemat(tmp_path / "flight.mat", content)
    log = read(tmp_path / "flight.mat")
    np.testing.assert_allclose(log.imus["/imu0"].gyro, GYRO)
    np.testing.assert_allclose(log.imus["/imu0"].accel, ACCEL)
    assert log.imus["/imu0"].t_ns[0] == 13_178_000_000
    assert log.kinds == {"/estimate/pose": "estimate"}
    seen = Rotation.from_quat(log.poses["/estimate/pose"].q_wb_wxyz[:, [1, 2, 3, 0]])
    assert (TURN[::4].inv() * seen).magnitude().max() < 1e-6


def test_the_structure_that_matlab_imports_a_table_to_has_names_of_columns_beside_them(tmp_path):
    heads = ["Time (ms)", *(f"gyr_{a} (rad/s)" for a in "xyz"), *(f"acc_{a} (m/s^2)" for a in "xyz")]
    cells = np.array(heads, dtype=object)[None]
    data = np.column_stack([1000.0 * T_S, GYRO, ACCEL])
    scipy.io.savemat(tmp_path / "walk.mat", {"A": {"data": data, "textdata": cells, "colheaders": cells}})
    log = read(tmp_path / "walk.mat")
    np.testing.assert_allclose(log.imus["/imu0"].gyro, GYRO)
    np.testing.assert_allclose(log.imus["/imu0"].accel, ACCEL)
    np.testing.assert_allclose(log.imus["/imu0"].t_ns * 1e-9, T_S, atol=1e-9)


@pytest.mark.parametrize("form", ["npy", "named npy", "text with the time twice"])
def test_an_array_or_text_without_names_has_an_imu_that_gravity_shows(tmp_path, form):
    source = tmp_path / ("imu.txt" if "text" in form else "imu.npy")
    accel = TURN.inv().apply([0.0, 0.0, 9.80665])
    table_of_all = np.column_stack([T_S, GYRO, accel])
    if form == "npy":
        np.save(source, table_of_all)
    elif form == "named npy":
        names = ["t", *(f"gyro_{a}" for a in "xyz"), *(f"acc_{a}" for a in "xyz")]
        np.save(source, np.rec.fromarrays(table_of_all.T, names=names))
    else:
        source.write_text(rows(1000.0 * T_S, 1000.0 * T_S, GYRO, accel).replace(",", " "))
    log = read(source)
    np.testing.assert_allclose(log.imus["/imu0"].gyro, GYRO, atol=1e-6)
    np.testing.assert_allclose(log.imus["/imu0"].accel, accel, atol=1e-5)
    np.testing.assert_allclose(log.imus["/imu0"].t_ns, 1e9 * T_S, atol=1e3)


def test_an_array_of_objects_is_refused_and_left_out_beside_numbers(tmp_path):
    info = np.array({"sensor": "bmi160"}, dtype=object)
    np.savez(tmp_path / "imu.npz", allow_pickle=True, t=T_S, gyro=GYRO, acc=TURN.inv().apply([0.0, 0.0, 9.81]), info=info)
    np.testing.assert_allclose(read(tmp_path / "imu.npz").imus["/imu0"].gyro, GYRO, atol=1e-12)
    np.save(tmp_path / "imu.npy", np.array([{"a": 1}, None], dtype=object), allow_pickle=True)
    with pytest.raises(DataError, match=r"objects of Python.*numpy.savez"):
        read(tmp_path / "imu.npy")


@pytest.mark.parametrize("ending", ["mat", "npz", "npy"])
def test_a_folder_of_tables_that_are_no_text_has_a_recording_for_each(tmp_path, ending):
    accel = TURN.inv().apply([0.0, 0.0, 9.80665])
    for name in ("walk_1", "walk_2"):
        path, arrays = tmp_path / f"{name}.{ending}", {"t": T_S, "gyr": GYRO, "acc": accel}
        if ending == "mat":
            scipy.io.savemat(path, arrays)
        elif ending == "npz":
            np.savez(path, **arrays)
        else:
            np.save(path, np.column_stack([T_S, GYRO, accel]))
    np.savez(tmp_path / "features.npz", weights=RNG.normal(size=(50, 20)))
    (tmp_path / "settings.json").write_text('{"rate": 100}')
    sequences = table.sequences(tmp_path)
    assert [sequence.name for sequence in sequences] == ["walk_1", "walk_2"]
    for sequence in sequences:
        np.testing.assert_allclose(table.read_sequence(sequence).imus["/imu0"].gyro, GYRO)


def test_a_matrix_that_a_sensor_gives_beside_its_rates_shows_their_unit(tmp_path):
    """As MT Manager of Xsens writes it, column by column; also transposed."""
    names = [f"Mat[{row}][{column}]" for column in (1, 2, 3) for row in (1, 2, 3)]
    header = (
        "// Sample rate: 100.0Hz\nPacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z," + ",".join(names) + "\n"
    )
    columns_first = TURN.as_matrix().transpose(0, 2, 1).reshape(-1, 9)
    for matrices in (columns_first, TURN.as_matrix().reshape(-1, 9)):
        (tmp_path / "MT.txt").write_text(header + rows(np.arange(COUNT), 100 * np.arange(COUNT), ACCEL, GYRO, matrices))
        imu = read(tmp_path / "MT.txt").imus["/imu0"]
        np.testing.assert_allclose(imu.gyro, GYRO, atol=1e-5)
        np.testing.assert_allclose(imu.t_ns, 1e9 * T_S, atol=1.0)


def test_angles_that_never_exceed_a_turn_are_in_the_unit_in_which_they_turn_as_the_gyro(tmp_path):
    header = "t,gx,gy,gz,ax,ay,az\n"
    (tmp_path / "imu.csv").write_text(header + rows(T_S, GYRO, ACCEL))
    (tmp_path / "vicon.csv").write_text("time,x,y,z,phi,theta,psi\n" + rows(T_S[::10], P_M[::10], RPY[::10]))
    log = read(tmp_path)
    np.testing.assert_allclose(log.imus["/imu0"].gyro, GYRO, atol=1e-6)
    seen = Rotation.from_quat(log.poses["/ground_truth/pose"].q_wb_wxyz[:, [1, 2, 3, 0]])
    assert (TURN[::10].inv() * seen).magnitude().max() < 1e-5


@pytest.mark.parametrize("t", [1.6e9 + np.arange(300), np.repeat(np.arange(100) * 0.01, 3)])
def test_slow_samples_and_three_of_a_stamp_are_no_increments(tmp_path, t):
    names = ["time", *(f"gyr_{a}" for a in "xyz"), *(f"acc_{a}" for a in "xyz")]
    whole = np.random.default_rng(2).integers(-1, 2, (6, 300))
    whole[5] += 9
    with pytest.raises(ConfigError) as refused:
        table.read_sequence(table.sequences(write_csv(tmp_path / "imu.csv", names, [t, *whole]))[0])
    assert "increments" not in str(refused.value)


def test_increments_of_velocity_and_angle_are_asked_about_with_their_rate(tmp_path):
    (tmp_path / "imr.txt").write_text(rows(300.0 + T_S, 0.01 * GYRO, 0.01 * ACCEL).replace(",", " "))
    with pytest.raises(ConfigError, match="times the 100 samples a second, the accel is gravity") as refused:
        read(tmp_path / "imr.txt")
    lines = (refused.value.fix or "").partition("\n\n")[2].splitlines()
    stated = {
        line.partition(" = ")[0].strip("# "): line.strip("# ") for line in lines if " = " in line and "poses:" not in line
    }
    stated |= {"gyro_unit": 'gyro_unit = "rad/s"', "accel_unit": 'accel_unit = "m/s^2"'}
    mapping = tmp_path / "map.toml"
    mapping.write_text("\n".join(stated[name] for name in stated if not name.startswith("raw")))
    (sequence,) = table.sequences(tmp_path / "imr.txt")
    imu = table.read_sequence(sequence, mapping=mapping).imus["/imu0"]
    np.testing.assert_allclose(imu.gyro, GYRO, atol=1e-5)
    np.testing.assert_allclose(imu.accel, ACCEL, atol=1e-4)


@pytest.mark.parametrize("form", ["feather", "microseconds beside seconds", "arrays beside a clock", "a date with dots"])
def test_further_forms_of_tables(tmp_path, form):
    accel = TURN.inv().apply([0.0, 0.0, 9.80665])
    t_ns = 1_600_000_000 * 10**9 + (1e9 * T_S).astype(np.int64)
    axes = [*(f"Accelerometer {a} (m/s/s)" for a in "XYZ"), *(f"Gyroscope {a} (rad/s)" for a in "XYZ")]
    values = np.hstack([accel, GYRO])
    if form == "feather":
        columns = {"timestamp": t_ns, **dict(zip(axes, values.T, strict=True)), "note": ["a"] * COUNT}
        feather.write_feather(pyarrow.table(columns), str(tmp_path / "walk.feather"))
    elif form == "microseconds beside seconds":
        stamps = np.column_stack([t_ns // 10**9, t_ns % 10**9 // 1000]).astype(object)
        lines = rows(values).splitlines()
        text = "".join(f"{s},{us},{line}\n" for (s, us), line in zip(stamps, lines, strict=True))
        (tmp_path / "RawSensors.csv").write_text(",".join(["Unix Time", "Microseconds", *axes]) + "\n" + text)
    elif form == "arrays beside a clock":
        for name, array in (("acc", accel), ("gyro", GYRO), ("imu_time", 1.6e9 + T_S)):
            np.save(tmp_path / f"{name}.npy", array)
    else:
        dates = np.datetime_as_string(t_ns.astype("datetime64[ns]"), unit="ms")
        text = "".join(f"{d.replace(':', '.')},{line}\n" for d, line in zip(dates, rows(values).splitlines(), strict=True))
        (tmp_path / "meta.csv").write_text(",".join(["time", *axes]) + "\n" + text)
    imu = read(tmp_path).imus["/imu0"]
    np.testing.assert_allclose(imu.gyro, GYRO, atol=1e-5)
    np.testing.assert_allclose(imu.accel, accel, atol=1e-4)
    np.testing.assert_allclose(imu.t_ns, t_ns, atol=500)


@pytest.mark.parametrize("mounted", [False, True])
@pytest.mark.parametrize("order", ["wxyz", "xyzw"])
def test_numbered_quaternions_of_a_motion_about_one_axis_are_poses_in_the_gyros_axes(tmp_path, order, mounted):
    """Another order is the inverse rotation, which turns about the same axis the other way: only the gyro's own axis tells."""
    yaw = Rotation.from_rotvec(np.sin(0.7 * T_S)[:, None] * [0.0, 0.0, 1.0])
    gyro = np.zeros((COUNT, 3))
    gyro[:, 1 if mounted else 2] = 0.7 * np.cos(0.7 * T_S)
    names = ",".join(f"mocap_orientation_{k}" for k in range(4))
    q = yaw.as_quat(scalar_first=order == "wxyz")
    (tmp_path / "log.csv").write_text(
        f"time [s],{names},acc_x,acc_y,acc_z,gyr_x,gyr_y,gyr_z\n" + rows(T_S, q, ACCEL, np.rad2deg(gyro))
    )
    log = read(tmp_path / "log.csv")
    (imu,), (poses,) = log.imus.values(), log.poses.values()
    assert np.abs(imu.gyro - gyro).max() < 1e-5, "the poses show that it counts degrees"
    either_way = any("and the other way, too: the motion has too few axes to tell" in n for n in log.remarks.notes)
    assert either_way == mounted
    right = np.abs((Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True) * yaw.inv()).as_rotvec()).max() < 1e-5
    assert right == (order == "wxyz" or not mounted)


@pytest.mark.parametrize("glitches", [False, True])
@pytest.mark.parametrize("form", ["mat", "npz"])
def test_an_array_of_matrices_is_poses_also_where_they_jump(tmp_path, form, glitches):
    """As MATLAB keeps them, 3 by 3 by n, or n by 3 by 3; a map may name the array, or its nine columns."""
    matrices = TURN.as_matrix()
    if glitches:  # of markers that change places, twice in three seconds: over 0.1 s most turns are theirs
        for k in range(100, COUNT, 150):
            matrices[k : k + 2] = matrices[k : k + 2] @ Rotation.from_euler("x", 12.0, degrees=True).as_matrix()
        matrices[:3] = np.nan
    arrays = {"ts": T_S, "gyr": GYRO, "acc": ACCEL}
    (tmp_path / "walk").mkdir()
    if form == "mat":
        scipy.io.savemat(tmp_path / "walk" / "imu.mat", arrays)
        scipy.io.savemat(tmp_path / "walk" / "vicon.mat", {"ts": T_S, "rots": np.moveaxis(matrices, 0, 2)})
    else:
        np.savez(tmp_path / "walk" / "imu.npz", **arrays)
        np.savez(tmp_path / "walk" / "vicon.npz", ts=T_S, rots=matrices)
    (sequence,) = table.sequences(tmp_path / "walk")
    for stated in ({}, {"rotation_matrix": "ground_truth/rots", "truth_time": "ground_truth/ts"}):
        log = table.read_sequence(sequence, mapping={"gyro_unit": "rad/s", "accel_unit": "m/s^2", **stated})
        (poses,) = log.poses.values()
        off = Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True) * motion((poses.t_ns - poses.t_ns[0]) * 1e-9).inv()
        assert np.median(off.magnitude()) < 0.05
    with pytest.raises(ConfigError, match=r"no column 'rotations\[0\]\[0\]'; expected one of .*ground_truth/rots\[0\]\[0\]"):
        table.read_sequence(sequence, mapping={"gyro_unit": "rad/s", "accel_unit": "m/s^2", "rotation_matrix": "rotations"})
