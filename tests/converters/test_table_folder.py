"""Folders with a table a sensor, and what the proposed map holds: followed to the letter, it leads to the recording."""

from __future__ import annotations

import json
import re
from itertools import accumulate
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from scipy.spatial.transform import Rotation
from support.flight_logs import write_dataflash
from support.tables import write_csv

from imutool.api.logs import convert
from imutool.converters import sensor_tables, table
from imutool.errors import ConfigError, DataError
from imutool.mcap_io.read import read

COUNT = 400
T_S = 1_600_000_000.0 + np.arange(COUNT) / 100.0
RNG = np.random.default_rng(12)
GYRO = RNG.normal(0.0, 0.1, (COUNT, 3))
TURN = np.linspace(0.0, 1.0, COUNT)
ACCEL = 9.80665 * np.stack([np.sin(TURN), 0.0 * TURN, np.cos(TURN)], axis=1)  # changes evenly: between two samples it is known
LATE_S = 0.002


def rows(t_s: np.ndarray, *values: np.ndarray, mark: str = ",") -> str:
    return "".join(
        mark.join([f"{t:.6f}", *map(repr, row)]) + "\n" for t, row in zip(t_s, np.column_stack(values).tolist(), strict=True)
    )


FOLDERS = {
    "without headers": ("Gyro.txt", rows(T_S, GYRO), "Accel.txt", rows(T_S + LATE_S, ACCEL)),
    "of another language": (
        "giroscopio_1.csv",
        "timestamp,x,y,z\n" + rows(T_S, GYRO),
        "acelerometro_1.csv",
        "timestamp,x,y,z\n" + rows(T_S + LATE_S, ACCEL),
    ),
    "with names of their own": (
        "RawGyro.csv",
        "t;gyro_x;gyro_y;gyro_z\n" + rows(T_S, GYRO, mark=";"),
        "raw-acc.csv",
        "t;acc_x;acc_y;acc_z\n" + rows(T_S + LATE_S, ACCEL, mark=";"),
    ),
}


def answered(error: ConfigError, path: Path, **answers: str) -> Path:
    """The proposed map with answers to what it asks."""
    text = str(error.fix).partition("\n\n")[2]
    for name, answer in answers.items():
        text = re.sub(rf'^{name} = "\?".*$', f'{name} = "{answer}"', text, flags=re.MULTILINE)
    path.write_text(text)
    return path


@pytest.mark.parametrize("header", ["# timestamp tx ty tz qx qy qz qw\n", ""])
@pytest.mark.parametrize(
    "names", [("imu.txt", "groundtruth.txt"), ("run_imu0.txt", "stamped_groundtruth_imu.txt"), ("phone.txt", "mocap.txt")]
)
def test_a_folder_with_an_imu_beside_true_poses_is_one_recording(tmp_path, names, header):
    source = tmp_path / "flight"
    source.mkdir()
    t_s = np.arange(10 * COUNT) / 100.0
    pitch, zero = Rotation.from_rotvec(np.outer(3.0 * np.sin(2.0 * t_s), [0.0, 1.0, 0.0])), 0.0 * t_s
    rotation = Rotation.from_rotvec(np.outer(2.0 * np.sin(1.1 * t_s), [1.0, 0.0, 0.0])) * pitch
    gyro = pitch.inv().apply(np.stack([2.2 * np.cos(1.1 * t_s), zero, zero], axis=1)) + np.outer(
        6.0 * np.cos(2.0 * t_s), [0, 1, 0]
    )
    accel = rotation.inv().apply([0.0, 0.0, 9.81])
    position = RNG.normal(size=(len(t_s), 3))
    (source / names[0]).write_text(
        "# timestamp ang_vel_x ang_vel_y ang_vel_z lin_acc_x lin_acc_y lin_acc_z\n" + rows(T_S[0] + t_s, gyro, accel, mark=" ")
    )
    (source / names[1]).write_text(header + rows(T_S[0] + t_s, position, rotation.as_quat(), mark=" "))
    (source / "left_images.txt").write_text("# id timestamp image_name\n0 1600000000.0 img/image_0_0.png\n")
    (sequence,) = table.sequences(tmp_path)
    log = table.read_sequence(sequence)
    np.testing.assert_allclose(log.imus["/imu0"].accel, accel)
    poses = log.poses["/ground_truth/pose"]
    np.testing.assert_allclose(poses.p_wb, position)
    assert (rotation.inv() * Rotation.from_quat(poses.q_wb_wxyz[:, [1, 2, 3, 0]])).magnitude().max() < 1e-6


def test_a_folder_with_tables_of_several_recordings_has_them_all(tmp_path):
    header = "time [s],gyro_x [rad/s],gyro_y [rad/s],gyro_z [rad/s],acc_x [m/s^2],acc_y [m/s^2],acc_z [m/s^2]\n"
    still = np.zeros((COUNT, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (COUNT, 1))
    pose = "time [s],x [m],y [m],z [m],qw,qx,qy,qz\n" + rows(T_S, *still)
    folders = ("walks", "pairs", "one", "walks/more")
    for name in folders:
        (tmp_path / name).mkdir()
    for number in range(45):
        (tmp_path / "walks" / f"walk_{number:02}.csv").write_text(header + rows(T_S + 1000.0 * number, GYRO, ACCEL))
    (tmp_path / "walks" / "people.csv").write_text("walk,height,age,weight\n1,1.8,30,70\n2,1.7,31,60\n")
    for number in range(2):
        (tmp_path / "pairs" / f"{number}_imu.csv").write_text(header + rows(T_S + 1000.0 * number, GYRO + number, ACCEL))
        (tmp_path / "pairs" / f"{number}_mocap.csv").write_text(pose)
    (tmp_path / "one" / "imu.csv").write_text(header + rows(T_S, GYRO, ACCEL))
    assert [s.name for s in table.sequences(tmp_path / "walks")] == [f"walk_{number:02}" for number in range(45)]
    assert [s.name for s in table.sequences(tmp_path / "one")] == ["one"]
    pairs = table.sequences(tmp_path / "pairs")
    logs = [table.read_sequence(sequence) for sequence in pairs]
    assert [(log.name, [*log.poses]) for log in logs] == [(str(number), ["/ground_truth/pose"]) for number in range(2)]
    np.testing.assert_allclose([log.imus["/imu0"].gyro for log in logs], [GYRO, GYRO + 1])
    assert len(table.sequences(tmp_path)) == 45 + 2 + 1


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_folder_with_a_table_a_sensor_is_one_recording(tmp_path, folder):
    gyro_name, gyro, accel_name, accel = FOLDERS[folder]
    source = tmp_path / "walk"
    source.mkdir()
    (source / gyro_name).write_text(gyro)
    (source / accel_name).write_text(accel)
    (source / "gyro_bias.csv").write_text("x,y,z,w\n1,2,3,4\n")
    (source / "notes.txt").write_text("a walk\n")
    assert sensor_tables.sequences(source) == []
    (sequence,) = table.sequences(tmp_path)
    with pytest.raises(ConfigError) as refused:
        table.read_sequence(sequence)
    assert 'accel_time = "accel/' in refused.value.fix
    log = table.read_sequence(sequence, mapping=answered(refused.value, tmp_path / "map.toml", gyro_unit="rad/s"))
    imu = log.imus["/imu0"]
    assert np.array_equal(imu.t_ns, np.rint(T_S[1:] * 1e6).astype(np.int64) * 1000)
    assert np.array_equal(imu.gyro, GYRO[1:])
    late = np.stack([np.interp(T_S[1:], T_S + LATE_S, column) for column in ACCEL.T], axis=1)
    np.testing.assert_allclose(imu.accel, late, atol=1e-6)  # float seconds at an epoch
    assert f"{gyro_name}: the gyro is {gyro_name}" in log.remarks.notes


def simulated(folder: Path, runs: int) -> np.ndarray:
    """Folder as gnss-ins-sim writes it: a time in a table of its own, tables without; the true accelerations."""
    folder.mkdir()
    t_s = 0.01 * np.arange(COUNT)
    turn = np.stack([0 * t_s, 0 * t_s, np.sin(t_s)], axis=1)
    tables = {"time": (["time (sec)"], t_s), "ref_gyro": ([f"ref_gyro_{a} (deg/s)" for a in "xyz"], turn)}
    tables |= {"gps_time": (["gps_time (sec)"], t_s[::10]), "gps-0": (["lat (deg)", "lon (deg)", "alt (m)"], turn[::10])}
    for run in range(runs):
        tables[f"gyro-{run}"] = [f"gyro_{a} (deg/s)" for a in "xyz"], np.rad2deg(GYRO) + run
        tables[f"accel-{run}"] = [f"accel_{a} (m/s^2)" for a in "xyz"], -ACCEL
    for name, (names, values) in tables.items():
        np.savetxt(folder / f"{name}.csv", values, header=",".join(names), delimiter=",", comments="")
    return -ACCEL


@pytest.mark.parametrize(("runs", "topics"), [(1, ["/imu0"]), (2, ["/imu0/imu", "/imu1/imu"])])
def test_a_folder_of_gnss_ins_sim_has_its_times_in_a_table_of_their_own(tmp_path, runs, topics):
    accel = simulated(tmp_path / "run", runs)
    (sequence,) = table.sequences(tmp_path)
    log = table.read_sequence(sequence)
    assert [*log.imus] == topics
    for run, imu in enumerate(log.imus.values()):
        np.testing.assert_allclose(imu.gyro, GYRO + np.deg2rad(run), rtol=1e-12)
        np.testing.assert_array_equal(imu.accel, accel)
        assert imu.t_ns.tolist() == [10_000_000 * n for n in range(COUNT)]
    assert np.diff(log.scalars["/gps_0_lat_deg"].t_ns).tolist() == [100_000_000] * (COUNT // 10 - 1)
    assert not log.remarks.losses


def test_of_a_table_of_one_sensor_x_y_and_z_are_the_axes(tmp_path):
    """PX4's sensor_gyro has three counters next to them."""
    names = ["timestamp", "timestamp_sample", *(f"clip_counter[{k}]" for k in range(3)), *"xyz"]
    t_us, zero = 1e6 * T_S, np.zeros((COUNT, 3))
    for sensor, values in (("gyro", GYRO), ("accel", ACCEL)):
        columns = np.column_stack([t_us, t_us - 100, zero, values])
        np.savetxt(tmp_path / f"my_{sensor}_0.csv", columns, header=",".join(names), delimiter=",", comments="")
    (sequence,) = table.sequences(tmp_path)
    with pytest.raises(ConfigError) as refused:
        table.read_sequence(sequence)
    log = table.read_sequence(sequence, mapping=answered(refused.value, tmp_path / "map.toml", gyro_unit="rad/s"))
    np.testing.assert_array_equal(log.imus["/imu0"].gyro, GYRO)


def test_of_several_sensors_the_map_names_the_first_and_the_refusal_all(tmp_path):
    groups = "left_acc", "left_gyr", "coarse_acc", "right_gyr"  # which of them belong together is not said
    names = [f"{group}_{a}" for group in groups for a in "xyz"]
    (tmp_path / "log.csv").write_text(",".join(["time", *names]) + "\n" + rows(T_S, ACCEL, GYRO, 2 * ACCEL, 2 * GYRO))
    (sequence,) = table.sequences(tmp_path / "log.csv")
    with pytest.raises(ConfigError, match="left_gyr_x/y/z, right_gyr_x/y/z") as refused:
        table.read_sequence(sequence)
    log = table.read_sequence(sequence, mapping=answered(refused.value, tmp_path / "map.toml", gyro_unit="rad/s"))
    assert np.array_equal(log.imus["/imu0"].gyro, GYRO)
    assert np.array_equal(log.imus["/imu0"].accel, ACCEL)


def test_the_proposed_map_keeps_the_poses_and_the_refusal_names_what_cannot_be_read(tmp_path):
    q_wxyz = np.stack([np.cos(TURN), 0 * TURN, np.sin(TURN), 0 * TURN], axis=1)
    names = [
        "time",
        *(f"gyr_{a}" for a in "xyz"),
        *(f"acc_{a}" for a in "xyz"),
        *(f"p_{a}" for a in "xyz"),
        *(f"q_{a}" for a in "wxyz"),
    ]
    text = ",".join([*names, "state"]) + "\n" + rows(T_S, GYRO, ACCEL, ACCEL, q_wxyz)
    text = text.replace("\n", ",boost\n").replace("state,boost", "state").replace("boost", "coast", 5)
    (tmp_path / "log.csv").write_text(text)
    (sequence,) = table.sequences(tmp_path / "log.csv")
    with pytest.raises(ConfigError, match="state is left out") as refused:
        table.read_sequence(sequence)
    log = table.read_sequence(sequence, mapping=answered(refused.value, tmp_path / "map.toml", gyro_unit="rad/s"))
    (poses,) = log.poses.values()
    np.testing.assert_allclose(np.abs(poses.q_wb_wxyz), np.abs(q_wxyz), atol=1e-12)
    assert set(log.kinds.values()) == {"estimate"}  # nothing says that they are truth


def test_motion_without_gravity_is_asked_about(tmp_path):
    names = ["time", *(f"gyro_{a} [rad/s]" for a in "xyz"), *(f"motionUserAcceleration{a}(G)" for a in "XYZ")]
    for accel in (0.01 * ACCEL / 9.8, 0.3 * ACCEL / 9.8):
        (tmp_path / "log.csv").write_text(",".join(names) + "\n" + rows(T_S, GYRO, accel))
        with pytest.raises(ConfigError, match="gravity was taken out"):
            table.read_sequence(table.sequences(tmp_path / "log.csv")[0])


@pytest.mark.parametrize("has_gravity", [True, False])
def test_a_body_that_turns_over_and_over_has_gravity_in_its_accelerations(tmp_path, has_gravity):
    t_s = 0.01 * np.arange(6000)
    rates = np.stack([3.0 + 2.5 * np.sin(0.7 * t_s), 2.0 * np.cos(0.5 * t_s), 1.5 * np.sin(0.3 * t_s)], axis=1)
    turns = list(accumulate(Rotation.from_rotvec(0.01 * rates), lambda turned, step: turned * step))
    forces = np.stack([4.0 * np.sin(t_s), 4.0 * np.cos(1.3 * t_s), 9.0 * np.sin(1.7 * t_s) + 9.8 * has_gravity], axis=1)
    accel = Rotation.concatenate(turns).inv().apply(forces) / 9.80665
    names = ["time_s", *(f"gyro_{a} (deg/s)" for a in "xyz"), *(f"acc_{a} (g)" for a in "xyz")]
    (tmp_path / "log.csv").write_text(",".join(names) + "\n" + rows(t_s, np.rad2deg(rates), accel))
    (sequence,) = table.sequences(tmp_path / "log.csv")
    if has_gravity:
        np.testing.assert_allclose(table.read_sequence(sequence).imus["/imu0"].accel, 9.80665 * accel, rtol=1e-12)
    else:
        with pytest.raises(ConfigError, match="gravity was taken out, or the body turned upside down and back"):
            table.read_sequence(sequence)


def test_a_packets_number_is_no_clock_and_counts_samples_whatever_its_step(tmp_path):
    names = ["Packet number", *(f"gyro_{a} [rad/s]" for a in "xyz"), *(f"acc_{a} [m/s^2]" for a in "xyz")]
    packets = 2 * np.arange(COUNT) + 4 * (np.arange(COUNT) > 99)  # of two sensors; two packets of this are missing
    body = "".join(
        f"{n}," + row.partition(",")[2] for n, row in zip(packets, rows(T_S, GYRO, ACCEL).splitlines(True), strict=True)
    )
    (tmp_path / "log.csv").write_text(",".join(names) + "\n" + body)
    (sequence,) = table.sequences(tmp_path / "log.csv")
    with pytest.raises(ConfigError, match="'Packet number' counts the samples") as refused:
        table.read_sequence(sequence)
    mapping = tmp_path / "map.toml"
    mapping.write_text(re.sub("rate_hz = .*", "rate_hz = 100.0", refused.value.fix.partition("\n\n")[2]))
    steps = np.diff(table.read_sequence(sequence, mapping=mapping).imus["/imu0"].t_ns)
    assert np.array_equal(steps, np.where(np.arange(COUNT - 1) == 99, 30_000_000, 10_000_000))


def test_a_rounded_time_is_a_time_and_an_open_unit_beside_a_counter_no_error(tmp_path):
    names = [*(f"gyro_{a} [rad/s]" for a in "xyz"), *(f"acc_{a} [m/s^2]" for a in "xyz")]
    t_s = np.floor(np.arange(COUNT) / 1.2) / 100.0  # every sixth stands twice
    (tmp_path / "log.csv").write_text(",".join(["time", *names]) + "\n" + rows(t_s, GYRO, ACCEL))
    imu = table.read_sequence(table.sequences(tmp_path / "log.csv")[0]).imus["/imu0"]
    assert len(imu) == COUNT
    assert np.abs(imu.t_ns * 1e-9 - t_s).max() < 0.0051
    text = ",".join(["n", *names]).replace("gyro_x [rad/s]", "gyro_x") + "\n" + rows(np.arange(COUNT), GYRO, ACCEL)
    (tmp_path / "log.csv").write_text(
        text.replace(".000000,", ",").replace("gyro_y [rad/s]", "gyro_y").replace("gyro_z [rad/s]", "gyro_z")
    )
    with pytest.raises(ConfigError, match="rate_hz"):
        table.read_sequence(table.sequences(tmp_path / "log.csv")[0])


def test_poses_whose_clock_was_set_back_keep_their_own_times(tmp_path):
    """As many poses as samples do not make the IMU's times theirs."""
    names = ["t_ns", *(f"gyro_{a} [rad/s]" for a in "xyz"), *(f"acc_{a} [m/s^2]" for a in "xyz")]
    t_ns = np.arange(COUNT) * 10_000_000
    turns = np.tile([0.0, 0.0, 0.0, 1.0], (COUNT, 1))
    (tmp_path / "imu.csv").write_text(",".join(names) + "\n" + rows(t_ns, GYRO, ACCEL))
    later = t_ns + np.where(np.arange(COUNT) < 0.7 * COUNT, 4_000_000_000, 1_000_000)
    (tmp_path / "headpose.csv").write_text("t_ns,px,py,pz,qx,qy,qz,qw\n" + rows(later, np.zeros((COUNT, 3)), turns))
    (poses,) = table.read_sequence(table.sequences(tmp_path)[0]).poses.values()
    assert poses.t_ns[0] == 4_000_000_000


def test_a_file_with_arrays_of_different_lengths_beside_tables_is_left_out(tmp_path):
    from scipy.io import savemat

    names = ["t_s", *(f"gyro_{axis} [rad/s]" for axis in "xyz"), *(f"acc_{axis} [m/s^2]" for axis in "xyz")]
    (tmp_path / "imu.csv").write_text(",".join(names) + "\n" + rows(T_S, GYRO, ACCEL))
    savemat(tmp_path / "gps.mat", {f"channel{n}": np.arange(10.0 + n) for n in range(8)})
    (sequence,) = table.sequences(tmp_path)
    np.testing.assert_allclose(table.read_sequence(sequence).imus["/imu0"].gyro, GYRO)


@pytest.mark.parametrize("suffix", ["", ".npy"])
def test_a_folder_of_arrays_for_each_sensor_is_a_table_for_each(tmp_path, suffix):
    """Arrays are known by their first bytes: comma2k19 has them in files without a suffix, and its poses apart."""
    turn = GYRO + TURN[:, None]  # so that gravity shows the unit
    arrays = {
        "gyro": {"t": T_S, "value": np.asfortranarray(turn)},
        "gyro_bias": {"t": T_S, "value": 0.0 * turn},
        "accelerometer": {"t": T_S, "value": ACCEL},
        "magnetometer": {"t": T_S[::10], "value": turn[::10]},
        "../global_pose": {"frame_times": T_S[::10], "frame_positions": ACCEL[::10]},
    }
    for sensor, files in arrays.items():
        (folder := tmp_path / "drive" / "IMU" / sensor).mkdir(parents=True)
        for name, values in files.items():
            with (folder / f"{name}{suffix}").open("wb") as file:
                np.save(file, values)
    (tmp_path / "drive" / "IMU" / "gyro" / "notes").write_text("no array")
    (sequence,) = table.sequences(tmp_path)
    assert sequence.name == "IMU"
    log = table.read_sequence(sequence, mapping={"gyro_unit": "rad/s"})
    np.testing.assert_array_equal(log.imus["/imu0"].gyro, turn)
    np.testing.assert_array_equal(log.imus["/imu0"].accel, ACCEL)
    assert len(log.scalars["/magnetometer_value_2"].t_ns) == COUNT // 10
    assert {topic.split("_")[0] for topic in log.scalars} == {"/magnetometer", "/gyro"}
    (loss,) = log.remarks.losses
    assert f"global_pose/frame_positions{suffix}. Put each next to the tables of its IMU" in loss
    (tmp_path / "drive" / "IMU" / "gyro" / f"value{suffix}").write_bytes(b"\x93NUMPY\x01\x00")
    with pytest.raises(DataError, match=rf"gyro/value{suffix}: cannot be read"):
        table.read_sequence(sequence)


def test_a_damaged_table_in_a_folder_is_told_and_a_file_of_settings_is_not(tmp_path, caplog):
    names = ["t_s", *(f"gyro_{axis} [rad/s]" for axis in "xyz"), *(f"acc_{axis} [m/s^2]" for axis in "xyz")]
    (tmp_path / "walk.csv").write_text(",".join(names) + "\n" + rows(T_S, GYRO, ACCEL))
    np.savez(tmp_path / "run.npz", gyro=GYRO, accel=ACCEL)
    raw = (tmp_path / "run.npz").read_bytes()
    (tmp_path / "run.npz").write_bytes(raw[:300] + bytes(50) + raw[350:])
    (tmp_path / "settings.json").write_text('{"rate": 100, "name": "walk"}')
    (sequence,) = table.sequences(tmp_path)
    assert sequence.path.name == "walk.csv"
    (told,) = caplog.messages
    assert re.match(r"left out: .*run\.npz: cannot be read", told)


@pytest.mark.parametrize("imu", ["one table", "a table each", "beside poses"])
def test_further_tables_of_a_recording_arrive_also_where_they_are_narrow(tmp_path, imu):
    names = [f"gyro_{a} [rad/s]" for a in "xyz"], [f"acc_{a} [m/s^2]" for a in "xyz"]
    if imu == "a table each":
        for file, columns, values in zip(("Gyro", "Accel"), names, (GYRO, ACCEL), strict=True):
            (tmp_path / f"{file}.csv").write_text(",".join(["time [s]", *columns]) + "\n" + rows(T_S, values))
    else:
        (tmp_path / "log.csv").write_text(",".join(["time [s]", *names[0], *names[1]]) + "\n" + rows(T_S, GYRO, ACCEL))
    if imu == "beside poses":
        quaternions = np.tile([1.0, 0.0, 0.0, 0.0], (COUNT, 1))
        (tmp_path / "gt.csv").write_text("time [s],x [m],y [m],z [m],qw,qx,qy,qz\n" + rows(T_S, 0.0 * GYRO, quaternions))
    (tmp_path / "Barometer.csv").write_text("time [s],pressure\n" + rows(T_S[::5], T_S[::5] + 1013.0))
    (tmp_path / "Depth.csv").write_text("time [s],depth,temperature,voltage\n" + rows(T_S, T_S, T_S, T_S))
    (tmp_path / "README.txt").write_text("Sensor 1\n2 walks\nof 3 4 people\n")
    (sequence,) = table.sequences(tmp_path)
    log = table.read_sequence(sequence)
    np.testing.assert_allclose(log.imus["/imu0"].gyro, GYRO)
    np.testing.assert_allclose(log.scalars["/Barometer_pressure"].values[:, 0], T_S[::5] + 1013.0, rtol=1e-6)
    assert len(log.scalars["/Depth_depth"].t_ns) == COUNT
    assert [*log.poses] == (["/ground_truth/pose"] if imu == "beside poses" else [])
    assert log.remarks.losses == []


def test_files_of_one_name_and_folders_below_a_table_are_recordings_of_their_own(tmp_path):
    header = "time,gyro_x [rad/s],gyro_y [rad/s],gyro_z [rad/s],acc_x [m/s2],acc_y [m/s2],acc_z [m/s2]\n"
    (tmp_path / "older").mkdir()
    for number, name in enumerate(("imu.csv", "imu.txt", "older/imu.csv")):
        (tmp_path / name).write_text(header + rows(T_S + 1000.0 * number, GYRO + number, ACCEL))
    logs = [table.read_sequence(sequence) for sequence in table.sequences(tmp_path)]
    assert [log.name for log in logs] == ["imu.csv", "imu.txt", "older"]
    np.testing.assert_allclose([log.imus["/imu0"].gyro for log in logs], [GYRO, GYRO + 1, GYRO + 2])


def test_of_several_accelerometers_the_one_with_no_further_word_is_asked_about(tmp_path):
    (tmp_path / "gyroscope.csv").write_text("t [s],x (in radians/s),y (in radians/s),z (in radians/s)\n" + rows(T_S, GYRO))
    for name in ("accelerometer.csv", "new_accelerometer.csv"):
        (tmp_path / name).write_text("t [s],x (in G's),y (in G's),z (in G's)\n" + rows(T_S, ACCEL / 9.80665))
    (sequence,) = table.sequences(tmp_path)
    with pytest.raises(ConfigError) as refused:
        table.read_sequence(sequence)
    assert 'accel = ["accel/x", "accel/y", "accel/z"]  # please confirm: these columns?' in str(refused.value.fix)
    (tmp_path / "new_accelerometer.csv").unlink()
    (sequence,) = table.sequences(tmp_path)
    np.testing.assert_allclose(table.read_sequence(sequence).imus["/imu0"].accel, ACCEL, rtol=1e-9)


def test_tables_with_a_clock_of_a_name_of_their_own_keep_it(tmp_path):
    """Columns next to `imuTimestamp` and `utcTimestamp(nanos)` of another length were left out, as if they had no time."""
    named = "imuTimestamp,utcTimestamp(nanos)," + "{0}_x[{1}],{0}_y[{1}],{0}_z[{1}]\n"
    utc_ns, boot_ms = np.round(1e9 * T_S).astype(np.int64), np.arange(COUNT) * 10
    for name, title, unit, values in (("accelerometer", "acc", "m/s^2", ACCEL), ("gyroscope", "ang_vel", "rad/s", GYRO)):
        lines = (f"{a},{b},{','.join(map(repr, row))}" for a, b, row in zip(boot_ms, utc_ns, values.tolist(), strict=True))
        (tmp_path / f"{name}.csv").write_text(named.format(title, unit) + "\n".join(lines) + "\n")
    lines = (f"{a},{b},{a},{a},{a}" for a, b in zip(boot_ms[::3], utc_ns[::3], strict=True))
    (tmp_path / "magnetic_field.csv").write_text(named.format("mfield", "uT") + "\n".join(lines) + "\n")
    (tmp_path / "air.csv").write_text("timestamp_global[ns],pressure[mbar]\n" + "".join(f"{t},{t % 7}\n" for t in utc_ns[::5]))
    (sequence,) = table.sequences(tmp_path)
    log = table.read_sequence(sequence)
    for name, step in (("mfield_x", 3), ("pressure", 5)):
        (found,) = (scalars for topic, scalars in log.scalars.items() if name in topic)
        assert np.array_equal(found.t_ns, utc_ns[::step])
    assert log.remarks.losses == []


def test_what_one_file_shows_it_shows_in_a_folder(tmp_path):
    lines = zip(T_S.tolist(), GYRO.tolist(), (ACCEL / 9.80665).tolist(), strict=True)
    named = "".join(
        f"acc {t:.3f} {a[0]} {a[1]} {a[2]}\ngyro {t:.3f} {g[0]} {g[1]} {g[2]}\n" for t, g, a in ((t, *gs) for t, *gs in lines)
    )
    folders = {
        "rows that name their sensor": ("walk_1.txt", named),
        "sentences of VectorNav": (
            "vn.txt",
            "".join(f"$VNYMR,1,2,3,.1,.2,.3,{a[0]},{a[1]},{a[2]},.1,.2,{g[2]}*66\n" for a, g in zip(ACCEL, GYRO, strict=True)),
        ),
        "more columns without a header": ("log.txt", rows(T_S, GYRO, ACCEL, np.full((COUNT, 1), 31.5))),
    }
    for folder, (name, text) in folders.items():
        (tmp_path / folder).mkdir()
        (tmp_path / folder / name).write_text(text)
    assert [sequence.path.name for sequence in table.sequences(tmp_path)] == ["log.txt", "walk_1.txt", "vn.txt"]
    with pytest.raises(ConfigError) as refused:
        table.read_sequence(table.sequences(tmp_path)[0])
    assert '# perhaps accel = ["column 5", "column 6", "column 7"]' in str(refused.value.fix)


def test_a_table_that_shows_less_is_what_the_others_of_its_columns_are(tmp_path):
    """Six columns `imu`: of a rest no unit of the gyro is seen, and of a run not even which half is gravity's."""
    t_s = np.arange(2000) / 100.0

    def lively(phase: float) -> np.ndarray:
        pitch = Rotation.from_rotvec(np.outer(1.2 * np.sin(1.3 * t_s + phase), [0.0, 1.0, 0.0]))
        turn = Rotation.from_rotvec(np.outer(1.5 * np.sin(0.7 * t_s), [1.0, 0.0, 0.0])) * pitch
        gyro = (turn[:-1].inv() * turn[1:]).as_rotvec() * 100.0
        exact = np.hstack([turn.inv().apply([0.0, 0.0, 9.81]), np.vstack([gyro, gyro[-1:]])])
        return exact + RNG.normal(0.0, 0.01, (2000, 6))

    still = np.array([0.0, 0.0, 9.81, 0.0, 0.0, 0.0]) + RNG.normal(0.0, 0.01, (2000, 6))
    run = lively(2.0) + np.hstack([RNG.normal(0.0, 7.0, (2000, 3)), RNG.normal(0.0, 4.0, (2000, 3))])
    logs = {"a": lively(0.0), "b": lively(1.0), "rest": still, "run": run}
    for name, imu in logs.items():
        scipy.io.savemat(tmp_path / f"{name}.mat", {"ts": t_s, "imu": imu, "flag": np.ones(2000)})
    scipy.io.savemat(tmp_path / "notes.mat", {"index": np.arange(30), "step": np.ones((30, 2))})
    with pytest.raises(ConfigError, match="no unit of the gyro"):
        convert(tmp_path / "rest.mat", tmp_path / "rest.mcap")
    weightless = RNG.normal(0.0, 2.0, (2000, 6))  # without gravity the units of the others are in doubt
    scipy.io.savemat(tmp_path / "weightless.mat", {"ts": t_s, "imu": weightless, "flag": np.ones(2000)})
    report = convert(tmp_path, tmp_path / "out", workers=1)
    assert [failure.name for failure in report.failures] == ["weightless"]
    assert len(report.written) == 4
    said = "its columns and units are taken for those of the other tables, which show them"
    assert [note.partition(":")[0] for note in report.notes if note.endswith(said)] == ["rest.mcap", "run.mcap"]
    for name, imu in logs.items():
        read_back = read(tmp_path / "out" / f"{name}.mcap").imu
        np.testing.assert_array_equal(read_back.accel, imu[:, :3])
        np.testing.assert_array_equal(read_back.gyro, imu[:, 3:])


def test_a_time_that_was_set_back_is_no_axis_of_its_sensor(tmp_path):
    """Without a header the first column that does not rise was the x axis."""
    times = np.concatenate([T_S[:300], T_S[300:] - 2.5])
    (tmp_path / "gyro.csv").write_text(rows(times, GYRO))
    (tmp_path / "acc.csv").write_text(rows(times, ACCEL))
    (sequence,) = table.sequences(tmp_path)
    imu = table.read_sequence(sequence, mapping={"gyro_unit": "rad/s"}).imus["/imu0"]
    np.testing.assert_allclose(imu.accel[:300], ACCEL[:300])


@pytest.mark.parametrize("later_s", [0.0, 1000.0])
def test_pairs_of_tables_from_other_times_are_recordings_of_their_own(tmp_path, later_s):
    """Of one time they are IMUs of one recording: a left foot and a right one."""
    for name, late in (("walk_1_20210713", 0.0), ("walk_2_20210716", later_s)):
        (tmp_path / f"{name}_GYR.csv").write_text("time [s],x [rad/s],y [rad/s],z [rad/s]\n" + rows(T_S + late, GYRO))
        (tmp_path / f"{name}_ACC.csv").write_text("time [s],x [m/s^2],y [m/s^2],z [m/s^2]\n" + rows(T_S + late, ACCEL))
    logs = [table.read_sequence(sequence) for sequence in table.sequences(tmp_path)]
    assert [len(log.imus) for log in logs] == ([1, 1] if later_s else [2])
    assert all(len(imu) == COUNT for log in logs for imu in log.imus.values())


def test_sensors_of_two_files_share_the_time_since_1970_and_not_the_one_since_their_first_rows(tmp_path):
    """As MetaWear writes them, whose gyro begins before its accelerometer."""
    for name, unit, late, values in (("GYR", "rad/s", 0.0, GYRO), ("ACC", "m/s^2", 0.035, ACCEL)):
        t_ms = np.rint(1e3 * (T_S + late)).astype(int)
        head = f"epoc (ms),timestamp (-0400),elapsed (s),x-axis ({unit}),y-axis ({unit}),z-axis ({unit})\n"
        lines = [
            f"{t},2020-09-13T08.26.{(t // 1000) % 60:02d}.{t % 1000:03d},{(t - t_ms[0]) / 1e3:.3f}," + ",".join(map(repr, row))
            for t, row in zip(t_ms.tolist(), values.tolist(), strict=True)
        ]
        (tmp_path / f"walk_{name}.csv").write_text(head + "\n".join(lines) + "\n")
    imu = table.read_sequence(table.sequences(tmp_path)[0]).imus["/imu0"]
    assert imu.t_ns[0] == 1_600_000_000_040_000_000
    np.testing.assert_allclose(
        imu.accel,
        9.80665 * np.stack([np.sin(turn := np.interp(imu.t_ns * 1e-9, T_S + 0.035, TURN)), 0.0 * turn, np.cos(turn)], axis=1),
        atol=1e-3,
    )


def test_pairs_that_last_differently_are_recordings_of_their_own(tmp_path):
    """As Sensor Kinetics names them, with a time from 0; they were IMUs of one log."""
    t_s = np.arange(2 * COUNT) / 100.0
    values = {"gyrm": np.tile(GYRO, (2, 1)), "accm": np.tile(ACCEL, (2, 1)), "magm": np.tile(ACCEL, (2, 1))}
    for name, count in (("walk_f_1", COUNT), ("walk_f_2", 2 * COUNT)):
        for sensor, each in values.items():
            text = "time,X_value,Y_value,Z_value\n" + rows(t_s[:count], each[:count])
            (tmp_path / f"{name}_{sensor}.csv").write_text(text)
    found = table.sequences(tmp_path)
    assert [sequence.name for sequence in found] == ["walk_f_1", "walk_f_2"]
    logs = [table.read_sequence(sequence, mapping={"gyro_unit": "rad/s"}) for sequence in found]
    assert [len(log.imus["/imu0"]) for log in logs] == [COUNT, 2 * COUNT]
    assert "/walk_f_1_magm_X_value" in logs[0].scalars
    for sensor, each in values.items():
        (tmp_path / f"walk_f_1_{sensor}.csv").write_text("time,X_value,Y_value,Z_value\n" + rows(t_s, each))
    (together,) = table.sequences(tmp_path)
    assert len(table.read_sequence(together, mapping={"gyro_unit": "rad/s"}).imus) == 2


def test_a_gyro_and_an_accelerometer_of_other_times_are_not_paired_row_by_row(tmp_path):
    for name, first_ms, values in (("Gyroscope", 156_496, GYRO), ("Acceleration", 63_156, ACCEL)):
        text = "".join(f"{first_ms + 5 * n},{x},{y},{z}\n" for n, (x, y, z) in enumerate(values.tolist()))
        (tmp_path / f"{name}.csv").write_text(f"Time stamp,x,y,z\n{text}")
    (sequence,) = table.sequences(tmp_path)
    with pytest.raises(DataError, match="gyro and accelerometer share no time"):
        table.read_sequence(sequence, mapping={"time_unit": "ms", "gyro_unit": "rad/s"})


def test_axes_in_one_word_are_no_phone_s_and_an_accelerometer_of_its_own_hides_no_imus(tmp_path):
    pair, rocket = tmp_path / "pair", tmp_path / "rocket"
    pair.mkdir(), rocket.mkdir()
    (pair / "Gyroscope.csv").write_text("Time (s),GyroX,GyroY,GyroZ\n" + rows(T_S, GYRO))
    (pair / "Accelerometer.csv").write_text("Time (s),AccelX,AccelY,AccelZ\n" + rows(T_S, ACCEL))
    values = np.column_stack([GYRO, ACCEL]).tolist()
    lines = (f"{t:.3f},IMU{k}," + ",".join(map(repr, row)) for t, row in zip(T_S, values, strict=True) for k in (0, 1))
    (rocket / "imu_flight.csv").write_text("ts [s],id,Gx,Gy,Gz,Ax,Ay,Az\n" + "\n".join(lines) + "\n")
    (rocket / "high_g.csv").write_text("ts [s],acc_x,acc_y,acc_z\n" + rows(T_S, ACCEL))
    for folder, count in ((pair, 1), (rocket, 2)):
        (sequence,) = table.sequences(folder)
        imus = table.read_sequence(sequence, mapping={"gyro_unit": "rad/s"}).imus
        assert len(imus) == count
        for imu in imus.values():
            np.testing.assert_allclose(imu.gyro, GYRO, rtol=1e-12)


def test_a_narrow_table_beside_an_imu_keeps_its_readings(tmp_path):
    t_s, vectors = np.arange(300) / 100.0, np.random.default_rng(5).normal([0, 0, 0, 0, 0, 9.81], 0.1, (300, 6))
    names = ["t [s]", *(f"g{a} [rad/s]" for a in "xyz"), *(f"a{a} [m/s^2]" for a in "xyz")]
    write_csv(tmp_path / "imu.csv", names, [t_s, *vectors.T])
    write_csv(tmp_path / "baro.csv", ["t [s]", "pressure"], [t_s[::10], 1e5 + t_s[::10]])
    (sequence,) = table.sequences(tmp_path)
    log = table.read_sequence(sequence)
    assert [*log.imus] == ["/imu0"]
    assert len(log.scalars["/baro_pressure"].t_ns) == 30


def test_tables_of_a_folder_that_show_no_imu_are_named(tmp_path, caplog):
    """As those of a device whose columns have no known names, next to one that is read."""
    names = ["t [s]", *(f"g{a} [rad/s]" for a in "xyz"), *(f"a{a} [m/s^2]" for a in "xyz")]
    for name in ("walk", "run"):
        write_csv(tmp_path / f"{name}.csv", names, [T_S, *GYRO.T, *ACCEL.T])
    write_csv(tmp_path / "other.csv", ["p", "q", "r", "s"], [RNG.normal(0.0, 1.0, COUNT) for _ in range(4)])
    (tmp_path / "settings.json").write_text('{"gain": [1, 2, 3], "rate": 5}')
    assert [sequence.name for sequence in table.sequences(tmp_path)] == ["run", "walk"]
    (told,) = [line.getMessage() for line in caplog.records]
    assert told == f"{tmp_path}: tables that show no IMU are left out: other.csv"


def test_tables_of_a_folder_of_imus_that_show_none_are_named(tmp_path, caplog):
    """Next to markers of a motion capture they were left out without a word."""
    for folder in ("imu", "vicon"):
        (tmp_path / folder).mkdir()
    names = ["t [s]", *(f"g{a} [rad/s]" for a in "xyz"), *(f"a{a} [m/s^2]" for a in "xyz")]
    write_csv(tmp_path / "imu" / "walk.csv", names, [T_S, *GYRO.T, *ACCEL.T])
    for path in ("imu/steps.csv", "vicon/markers.csv"):
        write_csv(tmp_path / path, ["A1", "A2", "A3", "B1"], [RNG.normal(0.0, 1.0, COUNT) for _ in range(4)])
    assert len(table.sequences(tmp_path)) == 1
    told = [line.getMessage() for line in caplog.records]
    assert told == [f"{tmp_path}: tables that show no IMU are left out: imu/steps.csv, vicon/markers.csv"]


def test_what_lies_beside_an_imu_and_is_not_read_is_named(tmp_path, caplog):
    """An array without names that has a time, as of TLIO, and true poses in a folder of their own, as of ADVIO."""
    names = ["t [s]", *(f"g{a} [rad/s]" for a in "xyz"), *(f"a{a} [m/s^2]" for a in "xyz")]
    for folder in ("phone", "ground-truth"):
        (tmp_path / folder).mkdir()
    write_csv(tmp_path / "phone" / "imu_samples_0.csv", names, [T_S, *GYRO.T, *ACCEL.T])
    np.save(tmp_path / "phone" / "imu0_resampled.npy", np.column_stack([T_S, *(5.0 + RNG.normal(0.0, 1.0, (8, COUNT)))]))
    write_csv(
        tmp_path / "ground-truth" / "pose.csv", [f"{value}.5" for value in range(8)], [T_S, *RNG.normal(0, 1, (7, COUNT))]
    )
    (sequence,) = table.sequences(tmp_path)
    assert "tables that show no IMU are left out: imu0_resampled.npy" in "\n".join(r.getMessage() for r in caplog.records)
    (loss,) = table.read_sequence(sequence).remarks.losses
    assert "true poses in a folder without an IMU are left out: ground-truth/pose.csv" in loss


@pytest.mark.parametrize("name", ["walk2_gt.csv", "walk2_gt.txt"])
def test_poses_whose_recording_lies_in_no_table_are_a_loss(tmp_path, name):
    """They were named in a line of the logger, and the exit code was 0."""
    names = ["t [s]", *(f"g{a} [rad/s]" for a in "xyz"), *(f"a{a} [m/s^2]" for a in "xyz")]
    for recording in ("walk1", "walk3"):
        write_csv(tmp_path / f"{recording}_imu.csv", names, [T_S, *GYRO.T, *ACCEL.T])
    poses = [T_S, *RNG.normal(0.0, 1.0, (3, COUNT)), *np.tile([[0.0], [0.0], [0.0], [1.0]], COUNT)]
    for path in ("walk1_gt.csv", name):
        write_csv(tmp_path / path, ["t", "x", "y", "z", "qx", "qy", "qz", "qw"], poses)
    if name.endswith(".txt"):  # a trajectory without a header
        text = (tmp_path / name).read_text().replace(",", " ")
        (tmp_path / name).write_text(text.partition("\n")[2])
    first, second = table.sequences(tmp_path)
    (loss,) = table.read_sequence(first).remarks.losses
    assert loss == f"{tmp_path}: tables of poses or of an IMU that belong to no recording are left out: {name}"
    assert not table.read_sequence(second).remarks.losses


def test_an_array_that_a_description_names_has_the_poses_of_the_imu_beside_it(tmp_path):
    """As of TLIO, whose array has the IMU in the axes of the world: no sensor's."""
    names = ["#timestamp [ns]", *(f"w_RS_S_{a} [rad s^-1]" for a in "xyz"), *(f"a_RS_S_{a} [m s^-2]" for a in "xyz")]
    write_csv(tmp_path / "imu_samples_0.csv", names, [np.rint(1e9 * T_S).astype(np.int64), *GYRO.T, *ACCEL.T])
    q_xyzw, p = np.tile([0.1, -0.1, 0.7, 0.7], (COUNT, 1)), RNG.normal(0.0, 1.0, (COUNT, 3))
    np.save(tmp_path / "imu0_resampled.npy", np.column_stack([1e6 * T_S, GYRO, ACCEL, q_xyzw, p, 0.0 * p]))
    listed = ["ts_us(1)", "gyr_compensated_rotated_in_World(3)", "acc_compensated_rotated_in_World(3)"]
    listed += ["qxyzw_World_Device(4)", "pos_World_Device(3)", "vel_World(3)"]
    (tmp_path / "imu0_resampled_description.json").write_text(json.dumps({"columns_name(width)": listed}))
    log = table.read_sequence(table.sequences(tmp_path)[0])
    np.testing.assert_array_equal(log.imus["/imu0"].gyro, GYRO)
    ((topic, poses),) = log.poses.items()
    assert (log.kinds[topic], len(poses.t_ns), log.remarks.losses) == ("estimate", COUNT, [])
    np.testing.assert_allclose(poses.q_wb_wxyz[0], [0.7, 0.1, -0.1, 0.7], atol=1e-9)
    np.testing.assert_allclose(poses.p_wb, p)


def test_a_folder_of_matrices_asks_for_a_map_and_takes_it(tmp_path):
    """A script of a test bench saves all that it reads in one array, without names."""
    angles = RNG.normal(0.0, 0.4, (COUNT, 3))
    for name in ("slow", "fast"):
        scipy.io.savemat(tmp_path / f"{name}.mat", {"data": np.column_stack([T_S, angles, ACCEL, GYRO, 0.0 * TURN])})
    found = table.sequences(tmp_path)
    assert [sequence.name for sequence in found] == ["fast", "slow"]
    with pytest.raises(ConfigError, match="no columns look like the gyro"):
        table.read_sequence(found[0])
    named = {"time": "data[0]", "time_unit": "s", "gyro_unit": "rad/s", "accel_unit": "m/s^2"}
    given = named | {sensor: [f"data[{first + axis}]" for axis in range(3)] for sensor, first in (("accel", 4), ("gyro", 7))}
    imu = table.read_sequence(found[0], mapping=given).imus["/imu0"]
    np.testing.assert_array_equal(imu.gyro, GYRO)
    np.testing.assert_array_equal(imu.accel, ACCEL)


def test_a_table_that_joins_two_others_is_no_imu_of_its_own(tmp_path):
    t_ms = 10.0 * np.arange(COUNT)
    gyro, accel = GYRO, ACCEL + RNG.normal(0.0, 0.1, (COUNT, 3))
    for name, values in (("gyro", gyro), ("acc", accel)):
        write_csv(tmp_path / f"{name}.csv", ["time_ms", "x", "y", "z"], [t_ms, *values.T])
    names = ["Time", *(f"{sensor}_{axis}" for sensor in ("Gyro", "Acc") for axis in "xyz")]
    write_csv(tmp_path / "final.csv", names, [np.arange(COUNT), *np.round(np.hstack([gyro, accel]), 12).T])
    (sequence,) = table.sequences(tmp_path)
    log = table.read_sequence(sequence, mapping={"gyro_unit": "rad/s"})
    assert [*log.imus] == ["/imu0"]
    assert any("/final/imu is left out: it holds the samples of /imu0" in note for note in log.remarks.notes)


def test_tables_in_log_files_and_those_of_programs_that_are_none(tmp_path):
    table_text = "time_s,gx_rad_s,gy_rad_s,gz_rad_s,ax_m_s2,ay_m_s2,az_m_s2\n" + rows(T_S, GYRO, ACCEL)
    for name in ("walk1.log", "walk2.log"):
        (tmp_path / name).write_text(table_text)
    assert [each.name for each in table.sequences(tmp_path)] == ["walk1", "walk2"]
    (tmp_path / "walk1.log").rename(tmp_path / "imu.csv")
    write_dataflash(tmp_path / "walk2.log", text=True)
    said = (f"2026-11-30 12:00:{n % 60:02}.5 INFO node: value {n / 10} of {n}\n" for n in range(COUNT))
    (tmp_path / "debug.log").write_text("".join(said))
    (found,) = table.sequences(tmp_path)
    assert found.path == tmp_path / "imu.csv"


def test_a_sequence_of_mulran_is_an_imu_beside_its_poses(tmp_path):
    """Neither table has a header: time, quaternion, angles, rates, forces, magnetic field; time, and a matrix row by row."""
    t_ns = 1_564_718_964 * 10**9 + np.arange(8 * COUNT) * 10**7
    t_s = (t_ns - t_ns[0]) / 1e9
    rotation = Rotation.from_rotvec(np.outer(0.4 * np.sin(1.1 * t_s), [1.0, 0.0, 0.0]))
    gyro, accel = np.outer(0.44 * np.cos(1.1 * t_s), [1.0, 0.0, 0.0]), rotation.inv().apply([0.0, 0.0, 9.81])
    position = np.array([354e3, 4025e3, 20.0]) + RNG.normal(size=(len(t_s), 3))
    field = np.tile([0.2, 0.1, 0.4], (len(t_s), 1))
    xsens = np.concatenate([rotation.as_quat(), rotation.as_euler("xyz"), gyro, accel, field], axis=1)
    rigid = np.concatenate([rotation.as_matrix(), position[:, :, None]], axis=2).reshape(-1, 12)
    for name, table_of in (("xsens_imu.csv", xsens), ("global_pose.csv", rigid)):
        lines = (f"{t},{','.join(map(repr, row))}\n" for t, row in zip(t_ns.tolist(), table_of.tolist(), strict=True))
        (tmp_path / name).write_text("".join(lines))
    (sequence,) = table.sequences(tmp_path)
    log = table.read_sequence(sequence)
    assert np.array_equal(log.imus["/imu0"].t_ns, t_ns)
    np.testing.assert_allclose(log.imus["/imu0"].gyro, gyro)
    np.testing.assert_allclose(log.imus["/imu0"].accel, accel)
    poses = log.poses["/estimate/pose"]
    assert np.array_equal(poses.t_ns, t_ns)
    np.testing.assert_allclose(poses.p_wb, position)
    assert (rotation.inv() * Rotation.from_quat(poses.q_wb_wxyz[:, [1, 2, 3, 0]])).magnitude().max() < 1e-6


@pytest.mark.parametrize(("folder", "doubts"), [("iphone", 1), ("pixel", 0)])
def test_the_sign_of_an_accelerometer_is_doubted_where_a_path_names_a_phone_of_apple(tmp_path, folder, doubts):
    """ADVIO has the readings of an iPhone as they are: -1 g along the axis that points up."""
    (tmp_path / folder).mkdir()
    for name, values in (("gyro", GYRO), ("accelerometer", ACCEL / -9.81)):
        (tmp_path / folder / f"{name}.csv").write_text(rows(T_S, values))
    given = {"gyro_unit": "rad/s"}
    log = table.read_sequence(table.sequences(tmp_path)[0], mapping=given)
    assert sum("reads -1 g along the axis that points up" in doubt for doubt in log.remarks.doubts) == doubts
    turned = [f"-accel/{axis}" for axis in "xyz"]
    again = table.read_sequence(table.sequences(tmp_path)[0], mapping=given | {"accel": turned})
    assert not again.remarks.doubts
    np.testing.assert_allclose(again.imus["/imu0"].accel, -log.imus["/imu0"].accel)
