"""Tables of other programs: their names of axes, their units, their times, and poses next to the IMU."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import scipy.io
from support.tables import write_csv

from imutool.converters import table
from imutool.converters._tables.columns.propose import propose
from imutool.converters._tables.files.formats import kind_of, load
from imutool.converters._tables.text.dates import calendar_times
from imutool.converters._tables.text.delimited import Columns
from imutool.converters._tables.text.names import name_and_unit
from imutool.errors import ConfigError, DataError

COUNT = 400
START_NS = 1_600_000_000_000_000_000
T_NS = START_NS + np.arange(COUNT) * 5_000_000
RNG = np.random.default_rng(11)
GYRO = RNG.normal(0.0, 0.1, (COUNT, 3))
ACCEL = RNG.normal(0.0, 0.02, (COUNT, 3)) + np.array([0.0, 0.0, 9.81])
P = RNG.normal(0.0, 1.0, (COUNT, 3))
Q_WXYZ = (raw := RNG.normal(0.0, 1.0, (COUNT, 4))) / np.linalg.norm(raw, axis=1, keepdims=True)
SIX = [*((f"gyr_{a}", "rad/s") for a in "xyz"), *((f"acc_{a}", "m/s^2") for a in "xyz")]
IMU_NAMES = [*(f"gyro_{a} [rad/s]" for a in "xyz"), *(f"accel_{a} [m/s^2]" for a in "xyz")]


@pytest.mark.parametrize(("counts", "step"), [("100 us", 50), ("us", 5_000)])
def test_the_counter_of_an_xsens_counts_tenths_of_milliseconds_or_microseconds(tmp_path, counts, step):
    names = ["PacketCounter", "SampleTimeFine", *(f"Acc_{a}" for a in "XYZ"), *(f"Gyr_{a} [rad/s]" for a in "XYZ")]
    columns = [np.arange(COUNT), 12_345 + step * np.arange(COUNT), *ACCEL.T, *GYRO.T]
    log = table.read_sequence(table.sequences(write_csv(tmp_path / "xsens.csv", names, columns))[0])
    assert np.array_equal(np.diff(log.imus["/imu0"].t_ns), np.full(COUNT - 1, 5_000_000))
    assert f"'SampleTimeFine' counts {counts}, as an Xsens sensor does" in log.remarks.notes


@pytest.mark.parametrize("time", ["TimeStartup", "Time since start in ns"])
def test_millidegrees_and_axes_behind_a_capital_are_known(tmp_path, time):
    names = [time, *(f"UncompAccel_{k}" for k in range(3)), *(f"UncompGyro_{k} [mdps]" for k in range(3))]
    columns = [T_NS - START_NS + 5_000_000_000, *ACCEL.T, *np.rad2deg(GYRO * 1e3).T]
    imu = table.read_sequence(table.sequences(write_csv(tmp_path / "vn.csv", names, columns))[0]).imus["/imu0"]
    np.testing.assert_allclose(imu.gyro, GYRO, rtol=1e-12)
    np.testing.assert_allclose(imu.accel, ACCEL, rtol=1e-12)


@pytest.mark.parametrize(
    ("compensated", "raw"),
    [
        (
            ("IMU::AngularRate::{} [rad/s]", "IMU::Accel::{} [m/s^2]"),
            ("IMU::UncompGyro::{} [rad/s]", "IMU::UncompAccel::{} [m/s^2]"),
        ),
        (("angularrate.{}", "accel.{}"), ("imu_rate.{}", "imu_accel.{}")),
        (("Gyro{}", "Acc{}"), ("UnCompGyro{}", "UnCompAcc{}")),
        (("gyro_comp_{} [rad/s]", "accel_comp_{}"), ("gyro_uncomp_{} [rad/s]", "accel_uncomp_{}")),
    ],
)
def test_uncompensated_columns_are_taken_and_compensated_ones_alone_are_named(tmp_path, compensated, raw):
    """A VectorNav has removed the biases that it knows; with both in a table `convert` asked, or took these."""

    def read(*names):
        columns = {name: (GYRO.T, ACCEL.T) if name in raw else (GYRO.T - 0.01, ACCEL.T - 0.1) for name in names}
        axes = {
            name.format("XYZ"[k]): sensor[k]
            for name, pair in columns.items()
            for sensor in [pair[_is_accel(name)]]
            for k in range(3)
        }
        path = write_csv(tmp_path / "vn.csv", ["TimeStartup", *axes], [T_NS - START_NS + 5_000_000_000, *axes.values()])
        (tmp_path / "map.toml").write_text('gyro_unit = "rad/s"\n')
        return table.read_sequence(table.sequences(path)[0], mapping=tmp_path / "map.toml")

    both, alone = read(*compensated, *raw), read(*compensated)
    np.testing.assert_allclose(both.imus["/imu0"].gyro, GYRO, rtol=1e-12)
    np.testing.assert_allclose(both.imus["/imu0"].accel, ACCEL, rtol=1e-12)
    said = [any("compensated: the filter in the sensor" in note for note in log.remarks.notes) for log in (both, alone)]
    assert said == [False, True]


def _is_accel(name):
    return "acc" in name.lower()


@pytest.mark.parametrize("stamp", ["set", "never set"])
def test_the_stamp_of_a_message_counts_before_the_time_of_its_arrival(tmp_path, stamp):
    late_ns = T_NS + RNG.integers(0, 3_000_000, COUNT)
    names = ["%time", "field.header.seq", "field.header.stamp"]
    names += [*(f"field.angular_velocity.{a}" for a in "xyz"), *(f"field.linear_acceleration.{a}" for a in "xyz")]
    columns = [late_ns, np.arange(COUNT), T_NS if stamp == "set" else 0 * T_NS, *GYRO.T, *ACCEL.T]
    imu = table.read_sequence(table.sequences(write_csv(tmp_path / "echo.csv", names, columns))[0]).imus["/imu0"]
    assert np.array_equal(imu.t_ns, T_NS if stamp == "set" else late_ns)


TWO_COLUMNS = [("sec", "nanosec"), ("header.stamp.secs", "header.stamp.nsecs"), ("stamp_Seconds", "stamp_Nanoseconds")]


@pytest.mark.parametrize("names", TWO_COLUMNS)
def test_a_stamp_in_two_columns_is_one_time(tmp_path, names):
    columns = [T_NS + 900_000_000, T_NS // 10**9, T_NS % 10**9, *GYRO.T, *ACCEL.T]
    path = write_csv(tmp_path / "two.csv", ["time", *names, *IMU_NAMES], columns)
    log = table.read_sequence(table.sequences(path)[0], mapping=None)
    expected = T_NS if names[0].startswith("header") else T_NS + 900_000_000  # else the first time counts
    assert np.array_equal(log.imus["/imu0"].t_ns, expected)
    bare = table.read_sequence(table.sequences(write_csv(path, [*names, *IMU_NAMES], columns[1:]))[0])
    assert np.array_equal(bare.imus["/imu0"].t_ns, T_NS)


def test_nanoseconds_without_their_second_are_no_time(tmp_path):
    path = write_csv(tmp_path / "half.csv", ["nanosec", *IMU_NAMES], [T_NS % 10**9, *GYRO.T, *ACCEL.T])
    with pytest.raises(ConfigError, match="no column that rises looks like a time"):
        table.read_sequence(table.sequences(path)[0])


POSES = {
    "ridi": ([*(f"pos_{a}" for a in "xyz"), *(f"ori_{a}" for a in "wxyz")], "estimate"),
    "motion capture": ([*(f"vicon_p{a}" for a in "xyz"), *(f"vicon_q{a}" for a in "wxyz")], "truth"),
    "behind": ([*(f"p_gt_{a}" for a in "xyz"), *(f"q_gt_{a}" for a in "wxyz")], "truth"),
    "at the end": ([*(f"p{a}_gt" for a in "xyz"), *(f"q{a}_gt" for a in "wxyz")], "truth"),
    "angles beside": ([*(f"p_{a}" for a in "xyz"), *(f"q_{a}" for a in "wxyz")], "estimate"),
}


@pytest.mark.parametrize("names", POSES)
def test_poses_on_the_time_of_the_imu_are_poses(tmp_path, names):
    columns, kind = POSES[names]
    angles = ["orientation_x", "orientation_y", "orientation_z"] if names == "angles beside" else []
    path = write_csv(
        tmp_path / "sim.csv",
        ["t_ns", *IMU_NAMES, *columns, *angles, "voltage"],
        [T_NS, *GYRO.T, *ACCEL.T, *P.T, *Q_WXYZ.T, *[P[:, 0]] * len(angles), P[:, 0]],
    )
    log = table.read_sequence(table.sequences(path)[0])
    ((topic, poses),) = log.poses.items()
    assert log.kinds == {topic: kind}
    assert np.array_equal(poses.p_wb, P)
    np.testing.assert_allclose(poses.q_wb_wxyz, Q_WXYZ, atol=1e-15)
    assert set(log.scalars) == {"/voltage", *(f"/{angle}" for angle in angles)}


def test_an_array_of_quaternions_is_poses_by_the_order_in_its_name(tmp_path):
    with h5py.File(tmp_path / "flight.h5", "w") as file:
        arrays = {"t_ns": T_NS, "gyro": GYRO, "accel": ACCEL, "pos": P, "quat_xyzw": Q_WXYZ[:, [1, 2, 3, 0]]}
        for name, values in arrays.items():
            file[name] = values
        file["gyro"].attrs["unit"], file["accel"].attrs["unit"] = "rad/s", "m/s^2"
    log = table.read_sequence(table.sequences(tmp_path / "flight.h5")[0])
    np.testing.assert_allclose(log.poses["/estimate/pose"].q_wb_wxyz, Q_WXYZ, atol=1e-15)
    assert np.array_equal(log.poses["/estimate/pose"].p_wb, P)


def test_an_orientation_alone_stays_numbers(tmp_path):
    path = write_csv(
        tmp_path / "ahrs.csv", ["t_ns", *IMU_NAMES, *(f"q{a}" for a in "wxyz")], [T_NS, *GYRO.T, *ACCEL.T, *Q_WXYZ.T]
    )
    log = table.read_sequence(table.sequences(path)[0])
    assert log.poses == {}
    assert set(log.scalars) == {f"/q{a}" for a in "wxyz"}


@pytest.mark.parametrize("time", [("Time (s)", ""), ("Time", "s")])
def test_axes_below_a_sensor_are_of_it_and_orientations_of_a_motion_capture_are_true(tmp_path, time):
    groups = [time[0], "Vicon Orientation", "", "", "", "IMU Acceleration", "", "", "IMU Gyroscope", "", "", "IMU Magnetometer"]
    axes = [time[1], *"WXYZ", *"XYZ", *"XYZ", *"XYZ"]
    missing = np.where(np.arange(COUNT)[:, None] < 7, 0.0, Q_WXYZ)  # the markers are hidden at first
    rows = np.column_stack([(T_NS - START_NS) * 1e-9, missing, ACCEL, GYRO, RNG.normal(size=(COUNT, 3))]).tolist()
    path, mapping = tmp_path / "wand.csv", tmp_path / "map.toml"
    path.write_text("\n".join(";".join(map(str, row)) for row in ([*groups, "", ""], axes, *rows)) + "\n")
    with pytest.raises(ConfigError) as refused:  # noise shows no unit of a gyro
        table.read_sequence(table.sequences(path)[0])
    proposed = str(refused.value.fix).partition("\n\n")[2]
    mapping.write_text(proposed.replace('gyro_unit = "?"', 'gyro_unit = "rad/s"'))
    log = table.read_sequence(table.sequences(path)[0], mapping=mapping)
    np.testing.assert_allclose(log.imus["/imu0"].gyro, GYRO)
    np.testing.assert_allclose(log.imus["/imu0"].accel, ACCEL)
    poses = log.poses["/ground_truth/pose"]
    np.testing.assert_allclose(poses.q_wb_wxyz, Q_WXYZ[7:], atol=1e-15)
    assert not poses.has_positions
    assert set(log.scalars) == {f"/IMU_Magnetometer_{a}" for a in "XYZ"}


def test_a_motion_capture_without_any_pose_is_no_truth(tmp_path):
    names = ["t_ns", *IMU_NAMES, *(f"vicon_orientation_{a}" for a in "wxyz")]
    path = write_csv(tmp_path / "rest.csv", names, [T_NS, *GYRO.T, *ACCEL.T, *np.zeros((4, COUNT))])
    log = table.read_sequence(table.sequences(path)[0])
    assert log.poses == {}
    assert f"/ground_truth/pose: {COUNT} samples without a pose are left out" in log.remarks.notes
    assert not any("zeros stand for them" in note for note in log.remarks.notes)


def test_a_few_quaternions_of_another_length_are_left_out_and_named(tmp_path):
    """Motion captures that were resampled across a change of the quaternion's sign have such."""
    names = ["t_ns", *IMU_NAMES, *(f"vicon_orientation_{a}" for a in "wxyz")]
    spoilt = np.where(np.isin(np.arange(COUNT), (17, 40))[:, None], 0.6 * Q_WXYZ, Q_WXYZ)
    log = table.read_sequence(table.sequences(write_csv(tmp_path / "wand.csv", names, [T_NS, *GYRO.T, *ACCEL.T, *spoilt.T]))[0])
    np.testing.assert_allclose(
        log.poses["/ground_truth/pose"].q_wb_wxyz, np.delete(Q_WXYZ, (17, 40), axis=0), rtol=0, atol=1e-15
    )
    assert any("2 quaternions whose length is not 1 are left out, the first in row 18" in note for note in log.remarks.notes)
    path = write_csv(tmp_path / "angles.csv", names, [T_NS, *GYRO.T, *ACCEL.T, *(0.6 * Q_WXYZ).T])
    with pytest.raises(DataError, match="expected norm 1"):  # columns of something else
        table.read_sequence(table.sequences(path)[0])


def test_single_fields_that_are_no_numbers_lose_no_column(tmp_path):
    names = ["t_ns", *IMU_NAMES, "pressure", "state"]
    rows = [
        [str(t), *map(repr, gyro), *map(repr, accel), "101.5", "idle"]
        for t, gyro, accel in zip(T_NS.tolist(), GYRO.tolist(), ACCEL.tolist(), strict=True)
    ]
    rows[200][1], rows[210][4], rows[220][7], rows[230][7] = "-8,00E-05", "ERR", "-", "1_0"
    (tmp_path / "log.csv").write_text("\n".join(";".join(row) for row in [names, *rows]) + "\n")
    log = table.read_sequence(table.sequences(tmp_path / "log.csv")[0])
    imu = log.imus["/imu0"]
    assert np.array_equal(imu.t_ns, np.delete(T_NS, 210))
    assert imu.gyro[200, 0] == -8e-5
    assert len(log.scalars["/pressure"].t_ns) == COUNT - 2
    assert "accel_x [m/s^2]: 1 fields, as 'ERR', are no numbers and count as missing" in log.remarks.notes
    assert "pressure: 2 fields, as '-', are no numbers and count as missing" in log.remarks.notes
    assert log.remarks.losses == []


def test_a_column_of_words_names_one_of_them(tmp_path):
    rows = [
        [t, *gyro, *accel, "7" if n < 100 else "off"] for n, (t, gyro, accel) in enumerate(zip(T_NS, GYRO, ACCEL, strict=True))
    ]
    text = "\n".join(",".join(map(str, row)) for row in [["t_ns", *IMU_NAMES, "mode"], *rows])
    (tmp_path / "log.csv").write_text(text + "\n")
    losses = table.read_sequence(table.sequences(tmp_path / "log.csv")[0]).remarks.losses
    assert losses == ["mode is left out: its fields, as 'off', are no numbers"]


NAMES_OF_AXES = [
    [*(f"{a} Gyro [x8005]" for a in "XYZ"), *(f"{a} Accel [x8004]" for a in "XYZ")],
    ["gyro_roll", "gyro_pitch", "gyro_yaw", *(f"accel_{a}" for a in "xyz")],
    ["rollrate", "pitchrate", "yawrate", *(f"acc_{a}" for a in "xyz")],
    [*(f"S1_Gyro_{a}_CAL" for a in "XYZ"), *(f"S1_Accel_LN_{a}_CAL" for a in "XYZ")],
    [*(f"imu.wb[{k}]" for k in range(3)), *(f"imu.fb[{k}]" for k in range(3))],
    [*(f"Gyro{a}" for a in "XYZ"), *(f"GForce{a}" for a in "XYZ")],
    [*(f"gyro_{a}" for a in "xyz"), *(f"accel_{a}" for a in "xyz"), "roll_rate", "pitch_rate", "yaw_rate"],
]


@pytest.mark.parametrize("names", NAMES_OF_AXES)
def test_axes_before_the_sensor_and_turns_about_them_are_known(names):
    values = [T_NS, *GYRO.T, *ACCEL.T, *GYRO.T]
    proposal = propose(Columns(dict(zip(["t", *names], values[: len(names) + 1], strict=True))))
    assert (proposal.entries["gyro"], proposal.entries["accel"]) == (names[:3], names[3:6])


def test_the_world_coordinates_of_a_point_are_no_rates():
    names = ["t", *(f"{a}_w" for a in "xyz"), *(f"acc_{a}" for a in "xyz")]
    assert "gyro" in propose(Columns(dict(zip(names, [T_NS, *P.T, *ACCEL.T], strict=True)))).open


HEADERS = {
    "part,left,right,left,right\naxis,acc_x,acc_x,gyr_x,gyr_x": [
        "part.axis",
        *(f"{s}.{n}_x" for n in ("acc", "gyr") for s in ("left", "right")),
    ],
    "time,left,,right,\n,acc_x,gyr_x,acc_x,gyr_x": ["time", "left.acc_x", "left.gyr_x", "right.acc_x", "right.gyr_x"],
    "time,left,right,top,low\nms,m/(s^2),m/(s^2),no_units,no_units": ["time", "left", "right", "top", "low"],
    "a,a,a,b,b\ntime,left,right,left,right\nCAL,CAL,CAL,CAL,CAL\nmSecs,deg/sec,m/(sec^2),deg/sec,no_units": [
        "a.time",
        "a.left",
        "a.right",
        "b.left",
        "b.right",
    ],
    "time,left,right,top,low, ": ["time", "left", "right", "top", "low"],
    "x,x,y,x,y": ["x", "x (2)", "y", "x (3)", "y (2)"],
    "INFO\nStart,1,2\n\nDATA\ntime,left,right,top,low": ["time", "left", "right", "top", "low"],
}


@pytest.mark.parametrize("end", ["", ","])
@pytest.mark.parametrize("header", HEADERS)
def test_no_column_is_lost_to_its_header(tmp_path, header, end):
    path = tmp_path / "log.csv"
    path.write_text(header + "\n" + "".join(f"{n},1,2,3,4{end}\n" for n in range(40)))
    columns = load(path, kind_of(path.read_bytes(), path))
    assert [values[5] for values in columns.values.values()] == [5, 1, 2, 3, 4]
    assert [*columns.values] == HEADERS[header]
    assert columns.units.get("left", "") == ("m/(s^2)" if "m/(s^2)" in header else "")
    assert columns.units.get("a.left", "") == ("deg/sec" if "CAL" in header else "")


CLOCKS = {
    "2026/3/4 15:04:05.25": 15.0 * 3600,
    "2026-03-04 15:04:05:250": 15.0 * 3600,
    "2026_03_04_15_04_05.250": 15.0 * 3600,
    "2026-3-4--15-04-05-250": 15.0 * 3600,
    "2026-03-04 15:04:05.25-0100": 16.0 * 3600,
    "2026-03-04 15:04:05.25-01": 16.0 * 3600,  # as PostgreSQL writes it
    "04-Mar-2026 15:04:05.250": 15.0 * 3600,  # as MATLAB writes it
    "3/4/2026 3:04:05.25 PM": 15.0 * 3600,
    "3/4/2026 12:04:05.25 am": 0.0,
    "23/4/2026 15:04:05.25": 50 * 86_400.0 + 15.0 * 3600,
}


@pytest.mark.parametrize("text", CLOCKS)
def test_dates_of_other_countries_count(text):
    (t_ns,), notes = calendar_times([text])
    assert t_ns == int(np.datetime64("2026-03-04T00:04:05.25", "ns").astype(int)) + CLOCKS[text] * 10**9
    assert ("its dates count as month/day/year" in notes) == (text.startswith("3/"))


def test_clocks_without_a_date_go_on_after_midnight_and_excels_after_the_hour():
    assert (calendar_times(["23:59:59.5", "00:00:00.5", "00:00:01"])[0] / 1e9).tolist() == [86399.5, 86400.5, 86401.0]
    assert (calendar_times(["59:59.5", "00:00.5"])[0] / 1e9).tolist() == [3599.5, 3600.5]
    assert (calendar_times(["23:59:59:500", "00:00:00:005"])[0] / 1e9).tolist() == [86399.5, 86400.005]
    assert calendar_times(["59:59:500"]) is None
    assert calendar_times(["12:30:00", "start"]) is None
    assert calendar_times(["9999-01-01 00:00:00"]) is None


def object_of_matlab(folder):
    """An element of a .mat file that holds an object, as a serial port, a timer or a figure."""
    scipy.io.savemat(folder / "one.mat", {"x": 1.0})
    texts = b"".join(np.array([1, 8], np.uint32).tobytes() + word.ljust(8, b"\0") for word in (b"port", b"MCOS", b"serial"))
    inside = np.array([6, 8, 17, 0], np.uint32).tobytes() + texts + (folder / "one.mat").read_bytes()[128:]
    return np.array([14, len(inside)], np.uint32).tobytes() + inside


def test_objects_of_matlab_are_refused_with_what_to_save(tmp_path):
    header = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
    (tmp_path / "log.mat").write_bytes(header + object_of_matlab(tmp_path))
    with pytest.raises(DataError, match="holds MATLAB objects"):
        table.read_sequence(table.sequences(tmp_path / "log.mat")[0])


def test_arrays_beside_an_object_of_matlab_are_read_and_the_object_is_named(tmp_path):
    """A workspace that was saved whole holds a serial port, a timer or a figure."""
    scipy.io.savemat(tmp_path / "log.mat", {"t_ns": T_NS, "SENSgyro": GYRO, "SENSacc": ACCEL})
    with (tmp_path / "log.mat").open("ab") as file:
        file.write(object_of_matlab(tmp_path))
    columns = load(tmp_path / "log.mat", "mat")
    np.testing.assert_array_equal(columns.values["SENSgyro[2]"], GYRO[:, 2])
    assert propose(columns).entries["accel"] == [f"SENSacc[{axis}]" for axis in range(3)]
    assert [loss.partition(".")[0] for loss in columns.remarks.losses] == ["its MATLAB objects are left out"]


def test_a_refusal_says_how_many_columns_it_does_not_list(tmp_path):
    names = np.array([f"s{number}" for number in range(65)], dtype=object)
    scipy.io.savemat(tmp_path / "log.mat", {"data": RNG.normal(0.0, 1.0, (COUNT, 65)), "labels": names})
    with pytest.raises(ConfigError, match=r"data/s0, .*, data/s39 and 25 more\. Give"):
        table.read_sequence(table.sequences(tmp_path / "log.mat")[0])


def test_a_matrix_with_as_many_columns_as_an_image_is_left_out_and_named(tmp_path):
    """It was left out without a word."""
    scipy.io.savemat(tmp_path / "log.mat", {"data": RNG.normal(0.0, 1.0, (COUNT, 65))})
    with pytest.raises(DataError, match="no columns of numbers; data is left out: it has 65 columns, as an image"):
        table.read_sequence(table.sequences(tmp_path / "log.mat")[0])


def test_an_object_of_matlab_hides_no_array_that_is_too_large(tmp_path, monkeypatch):
    scipy.io.savemat(tmp_path / "log.mat", {"zeros": np.zeros(10_000)}, do_compression=True)
    with (tmp_path / "log.mat").open("ab") as file:
        file.write(object_of_matlab(tmp_path))
    monkeypatch.setattr("imutool.converters._tables.files.mat.LIMIT", 50_000)
    with pytest.raises(DataError, match="unpacks to"):
        load(tmp_path / "log.mat", "mat")


def test_gravity_in_hundredths_is_asked_about_where_two_units_fit():
    names = ["t", *(f"gyro_{a}_dps" for a in "xyz"), *(f"acc_{a}" for a in "xyz")]
    for size, near in ((100.0, ["accel_unit"]), (1.0, [])):
        proposal = propose(Columns(dict(zip(names, [T_NS, *GYRO.T, *(size * ACCEL.T)], strict=True))))
        assert proposal.open == near


def test_times_before_the_start_are_moved(tmp_path):
    t_s = np.arange(COUNT) / 200.0 - 1.25  # before a launch
    log = table.read_sequence(
        table.sequences(write_csv(tmp_path / "log.csv", ["time [s]", *IMU_NAMES], [t_s, *GYRO.T, *ACCEL.T]))[0]
    )
    assert log.imus["/imu0"].t_ns[[0, -1]].tolist() == [750_000_000, 2_745_000_000]
    assert any("2 s later in the log" in note for note in log.remarks.notes)


def test_a_time_in_underscores_is_a_date_and_no_number(tmp_path):
    """Python's float reads 2026_03_04_15_04_59.5 as 20260304150459.5: over a minute that jumps by 41."""
    stamps = [f"2026_03_04_15_{4 + n // 60:02d}_{n % 60:02d}.5" for n in range(COUNT)]
    rows = [
        ",".join([stamp, *map(repr, row)]) for stamp, row in zip(stamps, np.column_stack([GYRO, ACCEL]).tolist(), strict=True)
    ]
    (tmp_path / "log.csv").write_text("\n".join([",".join(["UTC_Time", *IMU_NAMES]), *rows]) + "\n")
    imu = table.read_sequence(table.sequences(tmp_path / "log.csv")[0]).imus["/imu0"]
    assert np.array_equal(np.diff(imu.t_ns), np.full(COUNT - 1, 10**9))


@pytest.mark.parametrize("written_by", ["one clock", "groups with clocks", "a rate", "a rate and other lengths"])
def test_several_imus_of_one_table_are_several_imus_of_one_log(tmp_path, written_by):
    length = COUNT - 7 * (written_by == "a rate and other lengths")
    right = GYRO[::-1][:length], ACCEL[::-1][:length]
    if written_by == "one clock":
        names = ["t_ns", *(f"{of}_{s} [{u}]" for of in ("left", "right") for s, u in SIX)]
        path = write_csv(tmp_path / "gait.csv", names, [T_NS, *GYRO.T, *ACCEL.T, *right[0].T, *right[1].T])
    else:
        path = tmp_path / "gait.h5"
        with h5py.File(path, "w") as file:
            for of, (gyro, accel) in {"left": (GYRO, ACCEL), "right": right}.items():
                file[f"{of}/gyr"], file[f"{of}/acc"] = gyro, accel
                file[f"{of}/gyr"].attrs["unit"], file[f"{of}/acc"].attrs["unit"] = "rad/s", "m/s^2"
                if written_by == "groups with clocks":
                    file[f"{of}/time_ns"] = T_NS + 1_000_000 * (of == "right")
            file.attrs["fs"] = 200.0
    log = table.read_sequence(table.sequences(path)[0])
    assert {*log.imus} == {"/left/imu", "/right/imu"}
    np.testing.assert_allclose(log.imus["/left/imu"].gyro, GYRO)
    np.testing.assert_allclose(log.imus["/right/imu"].gyro, right[0])
    np.testing.assert_allclose(log.imus["/right/imu"].accel, right[1])
    late_ns = log.imus["/right/imu"].t_ns - log.imus["/left/imu"].t_ns[:length]
    assert np.array_equal(late_ns, np.full(length, 1_000_000 if written_by == "groups with clocks" else 0))
    assert log.scalars == {}
    stated = log.metadata["imutool/map/right/imu"]  # and nothing of what the map leaves open
    assert (stated["topic"], stated["gyro_unit"]) == ("/right/imu", "rad/s")
    assert all(stated.values())
    assert "[" not in stated["gyro"][0]
    assert not {"truth_file", "rotation_matrix", "gyro_scale"} & stated.keys()


@pytest.mark.parametrize("form", ["{s}{a}{n}", "{s}_{a}_{n}", "{s}{n}_{a}"])
def test_imus_that_are_numbered_are_several_imus_of_one_log(tmp_path, form):
    named = [
        form.format(s=s, a=a, n=n) + f" [{u}]" for n in (1, 2) for s, u in (("gyr", "rad/s"), ("acc", "m/s^2")) for a in "xyz"
    ]
    path = write_csv(tmp_path / "two.csv", ["t_ns", *named], [T_NS, *GYRO.T, *ACCEL.T, *GYRO[::-1].T, *ACCEL[::-1].T])
    imus = table.read_sequence(table.sequences(path)[0]).imus
    assert [*imus] == ["/imu1/imu", "/imu2/imu"]
    np.testing.assert_allclose(imus["/imu1/imu"].accel, ACCEL)
    np.testing.assert_allclose(imus["/imu2/imu"].gyro, GYRO[::-1])


def test_an_acceleration_without_a_number_does_not_stand_for_one_with_them(tmp_path):
    names = ["t_ns", *(f"accel_{a} [m/s^2]" for a in "xyz"), *(f"acc_{a} [m/s^2]" for a in "xyz"), *IMU_NAMES[:3]]
    path = write_csv(tmp_path / "phone.csv", names, [T_NS, *(np.nan * ACCEL).T, *ACCEL.T, *GYRO.T])
    np.testing.assert_allclose(table.read_sequence(table.sequences(path)[0]).imus["/imu0"].accel, ACCEL)


@pytest.mark.parametrize("without", ["lin_acc", "user_acceleration", "LinearAcceleration", "ac"])
def test_an_acceleration_without_gravity_does_not_stand_for_one_with_it(tmp_path, without):
    names = [
        "t_ns",
        *(f"{without}_{a} [m/s^2]" for a in "xyz"),
        *(f"{s}_{a} [{u}]" for s, u in (("acc", "m/s^2"), ("gyr", "rad/s")) for a in "xyz"),
    ]
    path = write_csv(tmp_path / "phone.csv", names, [T_NS, *(ACCEL - [0.0, 0.0, 9.81]).T, *ACCEL.T, *GYRO.T])
    log = table.read_sequence(table.sequences(path)[0])
    np.testing.assert_allclose(log.imus["/imu0"].accel, ACCEL)
    assert any("acc_x [m/s^2]/y/z is the one with gravity" in note for note in log.remarks.notes)


@pytest.mark.parametrize("unit", ["(rad/s)", ""])
def test_a_table_of_core_motion_has_a_stamp_for_each_sensor_and_reads_down_at_rest(tmp_path, unit):
    s, late_s = (T_NS - START_NS) / 1e9 + 98_765.0, 0.001
    names = [
        "loggingTime(txt)", "accelerometerTimestamp_sinceReboot(s)", *(f"accelerometerAcceleration{a}(G)" for a in "XYZ"),
        "gyroTimestamp_sinceReboot(s)", *(f"gyroRotation{a}{unit}" for a in "XYZ"),
        *(f"motionRotationRate{a}(rad/s)" for a in "XYZ"), *(f"motionUserAcceleration{a}(G)" for a in "XYZ"),
    ]  # fmt: skip
    user = ACCEL - [0.0, 0.0, 9.81]
    columns = [T_NS, s, *(-ACCEL / 9.80665).T, s + late_s, *GYRO.T, *(GYRO + 1.0).T, *(-user / 9.80665).T]
    log = table.read_sequence(table.sequences(write_csv(tmp_path / "sensorlog.csv", names, columns))[0])
    imu = log.imus["/imu0"]
    np.testing.assert_allclose(imu.gyro[0], GYRO[0])
    assert imu.t_ns[0] == 98_765_001_000_000
    np.testing.assert_allclose(np.median(imu.accel, axis=0), [0.0, 0.0, 9.81], atol=0.05)
    assert log.metadata["imutool/map"]["accel_time"] == "accelerometerTimestamp_sinceReboot(s)"


def test_one_map_holds_for_several_imus_whose_unit_is_open(tmp_path):
    names = ["t_ns", *(f"{of}_{s}" for of in ("left", "right") for s, _ in SIX)]
    path = write_csv(tmp_path / "gait.csv", names, [T_NS, *GYRO.T, *ACCEL.T, *(2.0 * GYRO).T, *ACCEL.T])
    with pytest.raises(ConfigError, match="state no unit of the gyro") as refused:
        table.read_sequence(table.sequences(path)[0])
    proposed = refused.value.fix.split("\n\n", 1)[1]
    assert "# it holds for /left/imu, /right/imu" in proposed
    (tmp_path / "map.toml").write_text(proposed.replace('gyro_unit = "?"', 'gyro_unit = "rad/s"'))
    log = table.read_sequence(table.sequences(path)[0], mapping=tmp_path / "map.toml")
    np.testing.assert_allclose(log.imus["/left/imu"].gyro, GYRO)
    np.testing.assert_allclose(log.imus["/right/imu"].gyro, 2.0 * GYRO)


@pytest.mark.parametrize(
    "stated",
    [
        {"gyro_unit": "deg/s"},
        {"gyro_unit": "deg/s", "accel_unit": "m/s^2", "time": "t_ns", "time_unit": "ns"},
        {"gyro_unit": "deg/s", "gyro": "wx,-wy,wz"},
        {"gyro_unit": "deg/s", "rate_hz": 200.0},
    ],
)
def test_a_map_states_what_is_open_and_the_table_shows_the_rest(tmp_path, stated):
    """As a user answers one question: `--map gyro_unit=deg/s`."""
    path = write_csv(tmp_path / "one.csv", ["t_ns", "wx", "wy", "wz", "ax", "ay", "az"], [T_NS, *GYRO.T, *ACCEL.T])
    with pytest.raises(ConfigError, match="state no unit of the gyro") as refused:
        table.read_sequence(table.sequences(path)[0])
    assert "what is open (gyro_unit=rad/s or deg/s or mdeg/s)" in refused.value.fix
    imu = table.read_sequence(table.sequences(path)[0], mapping=stated).imus["/imu0"]
    signs = [1.0, -1.0, 1.0] if "gyro" in stated else 1.0
    np.testing.assert_allclose(imu.gyro, np.deg2rad(GYRO) * signs, atol=1e-9)
    np.testing.assert_allclose(imu.accel, ACCEL, atol=1e-9)
    assert imu.t_ns[1] - imu.t_ns[0] == (5_000_000 if "rate_hz" in stated else T_NS[1] - T_NS[0])


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"gyro": "wx,wy,wq"}, "no column 'wq'"),
        ({"time": "t"}, "no column 't'"),
        ({"gyro": ["wx", "wy"]}, "gyro names 2 columns"),
        ({"gyro_unit": "rpm"}, "gyro_unit is 'rpm'"),
        ({"gyro_unit": ""}, "state no unit of the gyro"),
        ({"rate_hz": float("nan")}, "a positive rate_hz"),
        ({"rate_hz": 100.0, "counter": "n"}, "no column 'n'"),
        ({"gyro_scale": 0.01}, "gyro_scale without both units"),
        ({"accel_offset": 512.0, "gyro_unit": "rad/s"}, "accel_offset without both units"),
        ({"gyro_unti": "deg/s"}, "did you mean"),
    ],
)
def test_what_a_map_states_wrongly_is_said(tmp_path, wrong, said):
    path = write_csv(tmp_path / "one.csv", ["t_ns", "wx", "wy", "wz", "ax", "ay", "az"], [T_NS, *GYRO.T, *ACCEL.T])
    with pytest.raises(ConfigError, match=f"(?i){said}"):
        table.read_sequence(table.sequences(path)[0], mapping=wrong)


@pytest.mark.parametrize(
    ("gyro_unit", "accel_unit", "doubts"),
    [
        ("deg/s", "g", []),
        ("rad/s", "g", ["the gyro reaches"]),
        ("deg/s", "m/s^2", ["the median acceleration is 1 m/s"]),
        ("rad/s", "m/s^2", ["the median acceleration", "the gyro reaches"]),
    ],
)
def test_a_stated_unit_that_no_sensor_reaches_is_doubted(tmp_path, gyro_unit, accel_unit, doubts):
    turning = 90.0 * np.sin(np.arange(COUNT) / 20.0)[:, None] * [1.0, 0.5, 0.2]
    names = ["t_s", *(f"gyro_{a} [{gyro_unit}]" for a in "xyz"), *(f"acc_{a} [{accel_unit}]" for a in "xyz")]
    path = write_csv(tmp_path / "phone.csv", names, [np.arange(COUNT) / 100.0, *turning.T, *(ACCEL / 9.80665).T])
    notes = table.read_sequence(table.sequences(path)[0]).remarks.notes
    doubted = [note for note in notes if "is the unit right" in note]
    assert len(doubted) == len(doubts)
    assert all(expected in note for expected, note in zip(doubts, doubted, strict=True))


def test_axes_in_different_units_are_not_taken_for_one_unit(tmp_path):
    names = ["t_s", "gyro_x [rad/s]", "gyro_y [rad/s]", "gyro_z [deg/s]", *(f"acc_{a} [m/s^2]" for a in "xyz")]
    path = write_csv(tmp_path / "mixed.csv", names, [np.arange(COUNT) / 100.0, *GYRO.T, *ACCEL.T])
    with pytest.raises(ConfigError, match=r"gyro_z \[deg/s\] state different units"):
        table.read_sequence(table.sequences(path)[0])


def test_a_time_that_a_program_has_rounded_is_named(tmp_path):
    names = ["timestamp", *(f"gyro_{a} [rad/s]" for a in "xyz"), *(f"acc_{a} [m/s^2]" for a in "xyz")]
    path = write_csv(tmp_path / "excel.csv", names, [np.repeat([1.7e12, 1.70001e12], COUNT // 2), *GYRO.T, *ACCEL.T])
    with pytest.raises(ConfigError, match=f"'timestamp' is named as a time and does not rise: 2 different values in {COUNT}"):
        table.read_sequence(table.sequences(path)[0])


def test_what_ros_echoes_of_an_imu_is_one(tmp_path):
    nothing = [np.zeros(COUNT)] * 9
    columns = [
        T_NS // 10**9,
        T_NS % 10**9,
        *np.tile([0.0, 0.0, 0.0, 1.0], (COUNT, 1)).T,
        *nothing,
        *GYRO.T,
        *nothing,
        *ACCEL.T,
        *nothing,
    ]
    text = [
        ",".join([*map(repr, row[:2]), "imu_link", *map(repr, row[2:])])
        for row in zip(*(c.tolist() for c in columns), strict=True)
    ]
    (tmp_path / "echo.csv").write_text("\n".join(text) + "\n")
    imu = table.read_sequence(table.sequences(tmp_path / "echo.csv")[0]).imus["/imu0"]
    assert np.array_equal(imu.t_ns, T_NS)
    assert np.array_equal(imu.gyro, GYRO)
    assert np.array_equal(imu.accel, ACCEL)


@pytest.mark.parametrize("time", ["first", "last"])
@pytest.mark.parametrize("first", ["gyro", "accel"])
def test_a_time_and_six_axes_without_a_header_are_an_imu_by_its_gravity(tmp_path, first, time):
    """A board may print the time behind its readings."""
    sides = [GYRO, ACCEL] if first == "gyro" else [ACCEL, GYRO]
    axes = [*sides[0].T, *sides[1].T]
    path = write_csv(tmp_path / "raw.csv", [], [T_NS, *axes] if time == "first" else [*axes, T_NS])
    with pytest.raises(ConfigError, match="no unit of the gyro") as asked:  # which at rest nothing shows
        table.read_sequence(table.sequences(path)[0])
    assert 'accel = ["accel_x", "accel_y", "accel_z"]\naccel_unit = "m/s^2"' in str(asked.value)
    (tmp_path / "map.toml").write_text(str(asked.value.fix).partition("\n\n")[2].replace('"?"', '"rad/s"'))
    imu = table.read_sequence(table.sequences(path)[0], mapping=tmp_path / "map.toml").imus["/imu0"]
    assert np.array_equal(imu.t_ns, T_NS)
    assert np.array_equal(imu.gyro, GYRO)
    assert np.array_equal(imu.accel, ACCEL)


def test_readings_count_before_estimates_and_words_for_units_are_known(tmp_path):
    """A filter's acceleration has less of the motion, and perhaps the axes of the world."""
    names = ["timestamp_seconds", *(f"{kind}_acceleration_{a}_gs" for kind in ("raw", "est") for a in "xyz")]
    names += [f"{kind}_angular_rate_{a}_{unit}_per_s" for kind, unit in (("raw", "deg"), ("est", "rad")) for a in "xyz"]
    accel = np.random.default_rng(5).normal(0.0, 3.0, (400, 3))
    gyro = np.random.default_rng(6).normal(0.0, 30.0, (400, 3))
    t_s = np.arange(400) / 90.0
    estimated = np.tile([0.0, 0.01, 1.0], (400, 1)) + 0.01 * accel
    path = write_csv(tmp_path / "rocket.csv", names, [t_s, *accel.T, *estimated.T, *gyro.T, *np.deg2rad(gyro).T])
    imu = table.read_sequence(table.sequences(path)[0]).imus["/imu0"]
    np.testing.assert_allclose(imu.accel, 9.80665 * accel)
    np.testing.assert_allclose(imu.gyro, np.deg2rad(gyro))


@pytest.mark.parametrize("with_number", [False, True])
def test_rates_of_about_one_are_no_gravity_and_a_row_number_is_no_time(tmp_path, with_number):
    rng, count = np.random.default_rng(4), 2000
    t_s, gyro = 4908.0 + np.arange(count) / 500.0, rng.normal([0.5, 0.0, 0.0], 0.6, (count, 3))
    number = [np.arange(count)] if with_number else []
    rest = rng.normal([0.0, 0.0, 9.81], 0.3, (count, 3))
    for name, accel, found in (("calm", rest, True), ("race", 1.3 * rest, False)):
        columns = [*number, t_s, *gyro.T, *accel.T]
        path = write_csv(tmp_path / f"{name}.txt", [f"{value!r}" for value in range(len(columns))], columns, " ")
        path.write_text(path.read_text().partition("\n")[2])
        with pytest.raises(ConfigError) as refused:
            table.read_sequence(table.sequences(path)[0])
        assert ('gyro = ["gyro_x", "gyro_y", "gyro_z"]' in refused.value.fix) is found
        assert f'time = "{"time" if found else "column 2" if with_number else "column 1"}"' in refused.value.fix
        assert 'time_unit = "s"\n' in refused.value.fix


def test_a_row_of_devices_below_the_units_hides_no_names(tmp_path):
    """RaceChrono's CSV, of a phone in a car: the names, the units, and who measured."""
    names = ["timestamp", "lap_number", "speed", *(f"{a}_acc" for a in "xyz"), *(f"{a}_rate_of_rotation" for a in "xyz")]
    units = ["unix time", "", "m/s", "G", "G", "G", "deg/s", "deg/s", "deg/s"]
    devices = ["", "", "100: gps", *["200: acc"] * 3, *["300: gyro"] * 3]
    rng = np.random.default_rng(8)
    gyro, accel = rng.normal(0.0, 9.0, (200, 3)), rng.normal([0.0, 0.0, 1.0], 0.1, (200, 3))
    rows = [
        f"{1767150797 + n / 50:.2f},3,8.0,{','.join(map(repr, row))}" for n, row in enumerate(np.hstack([accel, gyro]).tolist())
    ]
    head = ["This file is created using RaceChrono Pro", "Format,3", "", *(",".join(row) for row in (names, units, devices))]
    (tmp_path / "lap.csv").write_text("\n".join([*head, *rows]) + "\n")
    imu = table.read_sequence(table.sequences(tmp_path / "lap.csv")[0]).imus["/imu0"]
    np.testing.assert_allclose(imu.gyro, np.deg2rad(gyro))
    np.testing.assert_allclose(imu.accel, 9.80665 * accel)
    assert imu.t_ns[0] == 1_767_150_797 * 10**9


@pytest.mark.parametrize("with_time", [False, True])
@pytest.mark.parametrize("accel_first", [False, True])
def test_an_array_of_six_columns_is_an_imu_where_one_half_shows_gravity(tmp_path, with_time, accel_first):
    """As in the files of learning challenges: imu (n, 6), ts, pos, quat."""
    halves = [ACCEL, GYRO] if accel_first else [GYRO, ACCEL]
    t_s = T_NS[:, None] * 1e-9
    arrays = {"imu": np.hstack([t_s, *halves])} if with_time else {"imu": np.hstack(halves), "ts": t_s[:, 0]}
    np.savez(tmp_path / "drone_0.npz", **arrays, vel=np.zeros((len(T_NS), 3)), platform=2)
    (sequence,) = table.sequences(tmp_path / "drone_0.npz")
    imu = table.read_sequence(sequence, mapping={"gyro_unit": "rad/s"}).imus["/imu0"]
    np.testing.assert_allclose(imu.gyro, GYRO)
    np.testing.assert_allclose(imu.accel, ACCEL)


def test_an_array_of_six_columns_beside_named_sensors_is_no_imu(tmp_path):
    six = np.hstack([ACCEL, GYRO])
    np.savez(tmp_path / "log.npz", features=six, gyro=2.0 * GYRO, acc=ACCEL, t=T_NS * 1e-9)
    (sequence,) = table.sequences(tmp_path / "log.npz")
    imu = table.read_sequence(sequence, mapping={"gyro_unit": "rad/s"}).imus["/imu0"]
    np.testing.assert_allclose(imu.gyro, 2.0 * GYRO)


def test_raw_counts_beside_calibrated_samples_are_no_imu(tmp_path):
    """APDM's older HDF5 files have both for each monitor, and names in the plural."""
    with h5py.File(tmp_path / "opal.h5", "w") as file:
        for monitor in ("SI-1", "SI-2"):
            group = file.create_group(monitor)
            group["Time"] = (1_700_000_000_000_000 + 10_000 * np.arange(200)).astype(np.uint64)
            for name, level, unit in (("Gyroscopes", 0.1, "rad/s"), ("Accelerometers", 9.81, "m/s^2")):
                values = group.create_dataset(f"Calibrated/{name}", data=np.tile([0.0, 0.0, level], (200, 1)))
                values.attrs["Units"] = np.bytes_(unit)
                group.create_dataset(f"Raw/{name}", data=np.tile([0, 0, round(1000 * level)], (200, 1)))
    (found,) = table.sequences(tmp_path / "opal.h5")
    log = table.read_sequence(found)
    assert [*log.imus] == ["/si_1_calibrated/imu", "/si_2_calibrated/imu"]
    assert {tuple(imu.gyro[0]) for imu in log.imus.values()} == {(0.0, 0.0, 0.1)}


@pytest.mark.parametrize(
    "above",
    [
        "# Units: ax/ay/az=g, gx/gy/gz=deg/s\n",
        "% a board\n% gx, gy, gz in deg/s; AX, AY, AZ in g\n",
        "// gx,gy,gz [dps]  ax,ay,az [g]\n",
    ],
)
def test_units_in_a_comment_above_the_header_count(tmp_path, above):
    names = ["time_ms", "ax", "ay", "az", "gx", "gy", "gz"]
    path = write_csv(tmp_path / "board.csv", names, [10 * np.arange(COUNT), *ACCEL.T, *GYRO.T], above=above)
    log = table.read_sequence(table.sequences(path)[0])
    np.testing.assert_allclose(log.imus["/imu0"].gyro, np.deg2rad(GYRO))
    np.testing.assert_allclose(log.imus["/imu0"].accel, 9.80665 * ACCEL)
    assert "gx, gy, gz in deg/s, by a comment above the table" in log.remarks.notes


def test_a_comment_that_names_no_column_or_no_unit_of_it_states_none(tmp_path):
    names = ["time_ms", "ax", "ay", "az", "gx", "gy", "gz"]
    above = "# gx: general, x in g mode (see wx,wy,wz=deg/s)\n# range: 2000 dps, rate in Hz\n"
    path = write_csv(tmp_path / "board.csv", names, [10 * np.arange(COUNT), *ACCEL.T, *GYRO.T], above=above)
    with pytest.raises(ConfigError, match="no unit of the gyro"):
        table.read_sequence(table.sequences(path)[0])


@pytest.mark.parametrize("gyro", ["Vitesse angulaire {} (rad/s)", "Šp‘¬“x{} (rad/s)", "{}_rotation (rad/s)"])
def test_units_show_the_sensors_whose_names_are_in_another_language(tmp_path, gyro):
    names = ["Temps (s)", *(gyro.format(axis) for axis in "XYZ"), *(f"Przyspieszenie {axis} (m/s²)" for axis in "XYZ")]
    log = table.read_sequence(table.sequences(write_csv(tmp_path / "log.csv", names, [T_NS * 1e-9, *GYRO.T, *ACCEL.T]))[0])
    np.testing.assert_allclose(log.imus["/imu0"].gyro, GYRO)
    np.testing.assert_allclose(log.imus["/imu0"].accel, ACCEL)


@pytest.mark.parametrize("columns", ["One", "No"])
def test_a_measurement_file_of_labview_is_a_table_in_its_units(tmp_path, columns):
    step_s = float(T_NS[1] - T_NS[0]) * 1e-9
    lines = [
        "LabVIEW Measurement\t",
        "Separator\tTab",
        "Decimal_Separator\t,",
        f"X_Columns\t{columns}",
        "***End_of_Header***\t",
    ]
    lines += ["Channels\t6\t\t\t\t\t\t", "\t".join(["Y_Unit_Label", *3 * ["deg/s"], *3 * ["m/s^2"]])]
    lines += ["\t".join(["Delta_X", *6 * [str(step_s).replace(".", ",")]]), "***End_of_Header***\t\t\t\t\t\t"]
    lines.append("\t".join(["X_Value", *(name.split()[0] for name in IMU_NAMES), "Comment"]))
    for t, gyro, accel in zip((np.arange(len(T_NS)) * step_s).tolist(), np.rad2deg(GYRO).tolist(), ACCEL.tolist(), strict=True):
        fields = [repr(t) if columns == "One" else "", *map(repr, gyro), *map(repr, accel)]
        lines.append("\t".join(fields).replace(".", ","))
    (tmp_path / "log.lvm").write_text("\n".join(lines) + "\n")
    log = table.read_sequence(table.sequences(tmp_path / "log.lvm")[0])
    np.testing.assert_allclose(log.imus["/imu0"].gyro, GYRO)
    np.testing.assert_allclose(log.imus["/imu0"].t_ns, np.arange(len(T_NS)) * step_s * 1e9, atol=1e3)


UNIT_FORMS = {
    "rad/s": ["(radians/sec)", "(rad·s⁻¹)", "_radians_per_second"],
    "deg/s": ["(°/sec)", "(º/s)", "_degrees_per_second", "[deg*s-1]"],
    "m/s^2": ["(m/sec^2)", "(m/s/s)", "(m·s⁻²)", "(meters per second squared)", "_meters_per_second_squared", "_m_per_sec2"],
    "cm/s^2": ["(Gal)"],
    "g": ["(g-force)"],
    "us": ["[μs]", "(micros)"],  # a Greek letter
    "": ["_degrees", "(radians)", "(m/s)"],
}


@pytest.mark.parametrize("unit", UNIT_FORMS)
def test_units_in_headers_have_many_forms(unit):
    assert {form: name_and_unit(f"value_x{form}", "")[1] for form in UNIT_FORMS[unit]} == dict.fromkeys(UNIT_FORMS[unit], unit)
