"""Tables as boards, phones and students write them: no units, slow clocks, raw counts, names of their own."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from scipy.spatial.transform import Rotation
from support.tables import write_csv

from imutool.converters import table
from imutool.converters._tables.columns.units import raw_counts
from imutool.converters._tables.text.labelled import as_table
from imutool.converters._tables.text.names import split_name
from imutool.errors import ConfigError, DataError
from imutool.recording.gyro_steps import unit_by_steps

COUNT = 300
RNG = np.random.default_rng(23)
T_S = np.arange(COUNT) * 0.01
COUNTS = np.round(RNG.normal(0.0, 12.0, (COUNT, 3)))  # of a gyro at rest
ACCEL_G = np.round(RNG.normal(0.0, 0.01, (COUNT, 3)) + np.array([0.1, -0.2, 0.97]), 4)
NAMES = ["t", *(f"a{a}" for a in "xyz"), *(f"g{a}" for a in "xyz")]


def read(path: Path):
    return table.read_sequence(table.sequences(path)[0])


@pytest.mark.parametrize(
    ("unit", "step", "places"),
    [
        ("deg/s", 2000 / 2**15, 2),
        ("deg/s", 1 / 131, 4),
        ("deg/s", 0.07, 2),
        ("rad/s", np.deg2rad(500 / 2**15), 12),
        ("rad/s", 1 / 900, 6),
        ("mdeg/s", 8.75, 2),
    ],
)
def test_the_steps_of_a_register_show_the_unit_of_the_gyro(tmp_path, unit, step, places):
    gyro = np.round(COUNTS * step + 0.3 * step, places)
    log = read(write_csv(tmp_path / "imu.csv", NAMES, [T_S, *ACCEL_G.T, *gyro.T]))
    size = {"deg/s": np.pi / 180, "mdeg/s": np.pi / 180e3, "rad/s": 1.0}[unit]
    np.testing.assert_allclose(log.imus["/imu0"].gyro, gyro * size, rtol=1e-9)
    assert any(f" {unit}, as a common sensor does" in note for note in log.remarks.notes)


@pytest.mark.parametrize(
    ("unit", "step", "digits"), [("deg/s", 1 / 131, 15), ("deg/s", 0.07, 6), ("rad/s", np.deg2rad(1 / 16.4), 7)]
)
def test_the_steps_of_a_gesture_show_the_unit_too(unit, step, digits):
    counts = np.round(np.random.default_rng(4).normal(0.0, 4000.0, (300, 3)))
    rates = np.vectorize(lambda value: float(f"{value:.{digits}g}"))(counts * step)
    assert unit_by_steps(rates) == (unit, pytest.approx(step))
    assert unit_by_steps(counts) is unit_by_steps(3.0 * rates) is unit_by_steps(rates + 0.3 * step) is None


@pytest.mark.parametrize("grid", [1.0, 0.1, 0.125, 0.06, 0.03, 0.01, 0.0012, 0.0011, 0.001, 1 / 128, 1e-6, 9.80665 / 16384])
@pytest.mark.parametrize("spread", [1.5, 5.0, 60.0])
def test_other_steps_show_no_unit(grid, spread):
    counts = np.round(np.random.default_rng(4).normal(0.0, spread, (2000, 3)))
    assert unit_by_steps(counts * grid) is None
    assert unit_by_steps(np.full((50, 3), np.nan)) is None
    assert unit_by_steps(np.random.default_rng(4).normal(0.0, spread, (2000, 3)) * grid) is None


def test_a_stated_unit_against_the_steps_is_asked(tmp_path):
    names = ["time", *(f"angular_velocity_{a}" for a in "xyz"), *(f"linear_acceleration_{a}" for a in "xyz")]
    path = write_csv(tmp_path / "ros.csv", names, [T_S, *(COUNTS / 16).T, *(9.8 * ACCEL_G).T])
    with pytest.raises(ConfigError, match=r"say rad/s, and the gyro counts in steps of 0.0625 deg/s") as caught:
        read(path)
    assert 'gyro_unit = "rad/s"  # please confirm: rad/s or deg/s or mdeg/s?' in str(caught.value)


@pytest.mark.parametrize(("start", "step_s", "unit"), [(1.7e9, 0.4, "s"), (1.7e12, 0.4, "ms"), (1.7e18, 0.3, "ns")])
def test_a_time_since_1970_may_be_slow(tmp_path, start, step_s, unit):
    size = {"s": 1.0, "ms": 1e-3, "ns": 1e-9}[unit]
    t = start + np.arange(COUNT) * round(step_s / size, 9)
    log = read(write_csv(tmp_path / "imu.csv", NAMES, [t, *ACCEL_G.T, *(COUNTS * 0.07).round(2).T]))
    assert np.allclose(np.diff(log.imus["/imu0"].t_ns) * 1e-9, step_s, atol=1e-4)


def test_whole_seconds_since_1970_that_may_be_milliseconds_since_a_boot_are_asked(tmp_path):
    """A phone that runs for two weeks counts as many ms as seconds have passed until 2010."""
    t = 1_279_035_037 + 2 * np.arange(COUNT)
    with pytest.raises(ConfigError, match="states no unit, and a step of 2 fits s and ms"):
        read(write_csv(tmp_path / "imu.csv", ["timestamp", *NAMES[1:]], [t, *ACCEL_G.T, *(COUNTS * 0.07).round(2).T]))


def test_a_last_column_that_has_a_name_and_no_values_keeps_the_header(tmp_path):
    gyro = (COUNTS * 0.07).round(2)
    rows = [",".join(map(repr, row)) + ",,,," for row in np.hstack([T_S[:, None], ACCEL_G, gyro]).tolist()]
    (tmp_path / "sparse.csv").write_text("\n".join([",".join([*NAMES, "bias", "scale"]), "0" + "," * 10, *rows]) + "\n")
    np.testing.assert_allclose(read(tmp_path / "sparse.csv").imus["/imu0"].gyro, np.deg2rad(gyro), rtol=1e-9)


@pytest.mark.parametrize("step", [1, 0.5])
def test_a_step_of_a_second_or_of_a_millisecond_is_asked(tmp_path, step):
    path = write_csv(tmp_path / "imu.csv", ["timestamp", *NAMES[1:]], [np.arange(COUNT) * step, *ACCEL_G.T, *(COUNTS * 0.07).T])
    with pytest.raises(ConfigError, match=r"a step of .* fits s and ms"):
        read(path)


def test_several_rows_with_one_stamp_are_spread_over_it(tmp_path):
    t = 1.7e9 + np.arange(COUNT) // 10 * 0.1
    log = read(write_csv(tmp_path / "imu.csv", NAMES, [t, *ACCEL_G.T, *(COUNTS * 0.07).T]))
    assert np.allclose(np.diff(log.imus["/imu0"].t_ns), 10_000_000, atol=200)  # of stamps with float64's digits
    assert any("share the stamp of another one" in note for note in log.remarks.notes)


def test_rows_in_whole_seconds_keep_their_rate_though_the_first_and_the_last_second_are_cut(tmp_path):
    t_s = 1.7e9 + 0.85 + np.arange(COUNT) / 19.4
    log = read(write_csv(tmp_path / "imu.csv", NAMES, [np.floor(t_s), *ACCEL_G.T, *(COUNTS * 0.07).T]))
    t_ns = log.imus["/imu0"].t_ns
    assert len(t_ns) == COUNT
    assert np.abs((t_ns - t_ns[0]) * 1e-9 - (t_s - t_s[0])).max() < 2 / 19.4  # two rows
    assert np.diff(t_ns).max() < 2e9 / 19.4  # no gap


def test_a_clock_counts_before_the_unit_in_its_name(tmp_path):
    rows = [f"15:04:{n // 100:02d}.{n % 100:02d}0\t{x}\t{y}\t{z}\t1\t2\t3" for n, (x, y, z) in enumerate(ACCEL_G)]
    names = ["Time(s)", *(f"a{a}(g)" for a in "xyz"), *(f"w{a}(deg/s)" for a in "xyz")]
    (tmp_path / "wit.txt").write_text("\n".join(["StartTime: 2026-11-21 15:04:00.000\t\t", "\t".join(names), *rows]) + "\n")
    imu = read(tmp_path / "wit.txt").imus["/imu0"]
    assert np.array_equal(np.diff(imu.t_ns), np.full(COUNT - 1, 10_000_000))


@pytest.mark.parametrize(
    ("gyro", "accel"),
    [
        ([f"Gyro{a}_deg_per_s" for a in "XYZ"], [f"Accel{a}_m_per_s2" for a in "XYZ"]),
        ([f"EKF Raw {a} Gyro (deg/s)" for a in "XYZ"], [f"EKF Raw {a} Accel" for a in "XYZ"]),
        ([f"角速度{a}(°/s)" for a in "XYZ"], [f"加速度{a}(m/s²)" for a in "XYZ"]),
        ([f"giroscopio_{a}_dps" for a in "xyz"], [f"aceleracion_{a}" for a in "xyz"]),
        ([f"w_{a} [deg/s]" for a in "xyz"], [f"f_{a}" for a in "xyz"]),
        ([f"gyr_left_wrist_{a}_dps" for a in "xyz"], [f"acc_left_wrist_{a}" for a in "xyz"]),
        ([f"Gyro{a}_chest (deg/s)" for a in "XYZ"], [f"Accel{a}_chest" for a in "XYZ"]),
        ([f"Foot Gyroscope {a} [deg/s]" for a in "XYZ"], [f"Foot Accel Sensor {a} [m/s^2]" for a in "XYZ"]),  # Noraxon
        (["p [deg/s]", "q [deg/s]", "r [deg/s]"], [f"accl{k}" for k in range(3)]),
        ([f"flight.{a} [deg/s]" for a in "pqr"], [f"flight.f_{a}" for a in "xyz"]),  # of a structure, or of a folder's table
        ([f"gyro_deg_s[{k}]" for k in range(3)], [f"accelerometer_m_s2[{k}]" for k in range(3)]),
        ([f"Gyroscope {a} (deg/sec)" for a in "XYZ"], [f"Accelerometer {a} (m/s/s)" for a in "XYZ"]),
        ([f"gyro{a} (deg.s^-1)" for a in "XYZ"], [f"accel{a} (m.s^-2)" for a in "XYZ"]),  # SBG
        ([f"{a}Rate (deg/s)" for a in "xyz"], [f"{a}Accel (m/s2)" for a in "xyz"]),  # Aceinna
        ([f"gyro_raw_{a} [deg/s]" for a in "xyz"], [f"acc_raw_{a}" for a in "xyz"]),
        ([f"ang_vel_uncal_{a}[deg/s]" for a in "xyz"], [f"acc_uncal_{a}[m/s^2]" for a in "xyz"]),
        ([f"gyro {a} (in degrees/s)" for a in "xyz"], [f"acc {a} (in m/s^2)" for a in "xyz"]),
        ([f"gyro {a} [degrees per second]" for a in "xyz"], [f"accel_{a}" for a in "xyz"]),
        ([f"ang_vel_{a} [deg/s]" for a in "xyz"], [f"acc_b_{a}" for a in "xyz"]),
        ([f"G{a}_IMU (deg/s)" for a in "xyz"], [f"A{a}_IMU" for a in "xyz"]),
        ([f"w.{a} (deg/s)" for a in "xyz"], [f"f.{a}" for a in "xyz"]),  # of structures
        ([f"gyroADC[{k}] (deg/s)" for k in range(3)], [f"accSmooth[{k}] (m/s/s)" for k in range(3)]),  # blackbox_decode
    ],
)
def test_names_of_other_programs(tmp_path, gyro, accel):
    path = write_csv(tmp_path / "imu.csv", ["time_s", *gyro, *accel], [T_S, *COUNTS.T, *(9.80665 * ACCEL_G).T])
    (imu,) = read(path).imus.values()
    np.testing.assert_allclose(imu.gyro, np.deg2rad(COUNTS), rtol=1e-12)
    np.testing.assert_allclose(imu.accel, 9.80665 * ACCEL_G, rtol=1e-12)


def test_a_bias_in_the_axes_of_the_body_is_no_acceleration(tmp_path):
    names = ["time_s", *(f"gyro_{a} [deg/s]" for a in "xyz"), *(f"acc_b_{a}" for a in "xyz")]
    bias = np.tile([0.01, -0.02, 0.03], (COUNT, 1))
    path = write_csv(tmp_path / "imu.csv", names, [T_S, *COUNTS.T, *bias.T])
    with pytest.raises(ConfigError):
        read(path)
    path = write_csv(tmp_path / "both.csv", [*names, "acc_x", "acc_y", "acc_z"], [T_S, *COUNTS.T, *bias.T, *ACCEL_G.T])
    np.testing.assert_allclose(read(path).imus["/imu0"].accel, 9.80665 * ACCEL_G, rtol=1e-12)


def test_a_table_of_ulog2csv_is_in_the_units_of_px4(tmp_path):
    names = [
        "timestamp",
        *(f"gyro_rad[{k}]" for k in range(3)),
        "gyro_integral_dt",
        *(f"accelerometer_m_s2[{k}]" for k in range(3)),
    ]
    columns = [1e6 * T_S, *(0.01 * COUNTS).T, 0 * T_S + 10_000, *(9.80665 * ACCEL_G).T]
    imu = read(write_csv(tmp_path / "run_sensor_combined_0.csv", names, columns)).imus["/imu0"]
    np.testing.assert_allclose(imu.gyro, 0.01 * COUNTS, rtol=1e-12)


def test_matrices_as_matlab_writes_them_in_a_table(tmp_path):
    """`acc_1` to `acc_3`: their rate stands in a comment, and the orientation next to them shows the gyro's unit."""
    t_s = np.arange(2000) * 0.01
    turned = Rotation.from_rotvec(np.stack([0.4 * np.sin(2 * t_s), 0.5 * np.sin(3 * t_s), 0.3 * np.cos(2 * t_s)], axis=1))
    gyro = np.vstack([(turned[:-1].inv() * turned[1:]).as_rotvec() * 100.0, np.zeros((1, 3))])
    accel, wxyz = turned.inv().apply([0.0, 0.0, 9.81]), turned.as_quat()[:, [3, 0, 1, 2]]
    names = [*(f"ori_{n}" for n in "1234"), *(f"acc_{n}" for n in "123"), *(f"gyr_{n}" for n in "123")]
    path = write_csv(tmp_path / "imu.csv", names, [*wxyz.T, *accel.T, *np.rad2deg(gyro).T])
    path.write_text(f"// fs=100 nSamples=2000\n{path.read_text()}")
    imu = read(path).imus["/imu0"]
    np.testing.assert_allclose(imu.gyro, gyro, atol=1e-9)
    assert imu.period_s == pytest.approx(0.01)
    four = write_csv(tmp_path / "four.csv", ["t", *(f"acc_{n}" for n in "1234"), *(f"gyr_{n}" for n in "1234")], [T_S] * 9)
    with pytest.raises(ConfigError, match="no columns look like the gyro"):
        read(four)


@pytest.mark.parametrize("form", ["timestamp,sensor,axis,value", "Series;Time;Value"])
def test_a_long_table_has_its_signals_as_columns(tmp_path, form):
    """One value is missing, and with it a sample."""
    values = np.round(np.hstack([RNG.normal(0.0, 0.1, (COUNT, 3)), 9.80665 * ACCEL_G]), 6)
    lines = [
        f"{t:.2f},{sensor},{axis},{value}" if "," in form else f"{sensor}{axis};{t:.2f};{value}"
        for t, row in zip(T_S.tolist(), values.tolist(), strict=True)
        for (sensor, axis), value in zip([(s, a) for s in ("gyro", "accel") for a in "xyz"], row, strict=True)
    ]
    del lines[6 * 50 + 4]
    (tmp_path / "long.csv").write_text("\n".join([form, *lines]) + "\n")
    (sequence,) = table.sequences(tmp_path / "long.csv")
    log = table.read_sequence(sequence, mapping={"gyro_unit": "rad/s", "accel_unit": "m/s^2", "time_unit": "s"})
    np.testing.assert_array_equal(log.imus["/imu0"].gyro, np.delete(values[:, :3], 50, axis=0))
    assert log.remarks.losses == ["1 times without a value of every signal are left out"]
    (tmp_path / "twice.csv").write_text("\n".join([form, *lines, *lines[:6]]) + "\n")
    with pytest.raises(DataError, match=r"long table whose signals .* have two at one\. Pivot it"):
        read(tmp_path / "twice.csv")


def test_a_gyro_in_degrees_is_asked_for_its_time(tmp_path):
    """`gyr_x_deg` may be the rate or its sum."""
    names = ["time_s", *(f"acc_{a}_mps2" for a in "xyz"), *(f"gyr_{a}_deg" for a in "xyz")]
    path = write_csv(tmp_path / "imu.csv", names, [T_S, *(9.80665 * ACCEL_G).T, *RNG.normal(0.0, 1.0, (3, COUNT))])
    with pytest.raises(ConfigError, match=r'gyro = \["gyr_x_deg", "gyr_y_deg", "gyr_z_deg"\]\ngyro_unit = "\?"'):
        read(path)


@pytest.mark.parametrize("sentence", ["VNIMU", "VNYMR", "VNQMR"])
def test_sentences_of_a_vectornav_lack_a_time_alone(tmp_path, sentence):
    ahead = {"VNIMU": "", "VNYMR": "10.0,20.0,30.0,", "VNQMR": "0.0,0.0,0.0,1.0,"}[sentence] + "+1.1,-0.2,+0.3,"
    behind = ",+20.7,+084.3" if sentence == "VNIMU" else ""
    lines = [
        f"${sentence},{ahead}{','.join(f'{v:+.4f}' for v in (*accel, *gyro))}{behind}*66"
        for gyro, accel in zip(0.01 * COUNTS, 9.80665 * ACCEL_G, strict=True)
    ]
    (tmp_path / "vn.txt").write_text("\n".join(["$VNRRG,01,VN-100*58", *lines][sentence == "VNIMU" :]) + "\n")
    (tmp_path / "map.toml").write_text(
        'rate_hz = 100.0\ngyro_unit = "rad/s"\naccel_unit = "m/s^2"\n'
        'gyro = ["gyro_x [rad/s]", "gyro_y [rad/s]", "gyro_z [rad/s]"]\n'
        'accel = ["accel_x [m/s^2]", "accel_y [m/s^2]", "accel_z [m/s^2]"]\n'
    )
    with pytest.raises(ConfigError) as refused:
        read(tmp_path / "vn.txt")
    assert 'gyro_unit = "rad/s"' in str(refused.value.fix)
    log = table.read_sequence(table.sequences(tmp_path / "vn.txt")[0], mapping=tmp_path / "map.toml")
    assert any("compensated" in note for note in log.remarks.notes) == (sentence != "VNIMU")
    imu = log.imus["/imu0"]
    np.testing.assert_allclose(imu.gyro, 0.01 * COUNTS, atol=1e-4)
    np.testing.assert_allclose(imu.accel, 9.80665 * ACCEL_G, atol=1e-4)


def test_the_fields_of_a_microstrain_sensor_have_the_units_of_its_protocol(tmp_path):
    """In g at rest the acceleration shows its unit, but a gyro in rad/s shows none."""
    names = ["GPS Week", "GPS TOW", *(f"{a} Accel [x8004]" for a in "XYZ"), *(f"{a} Gyro [x8005]" for a in "XYZ")]
    gyro = RNG.normal(0.0, 0.1, (COUNT, 3))
    above = "FILE_INFO\nListSeparator=comma\n\nDEVICE_INFO\nModelName,3DM-GX3-35\n\nDATA_START\n"
    columns = [np.full(COUNT, 1969), 137_649.0 + T_S, *ACCEL_G.T, *gyro.T]
    imu = read(write_csv(tmp_path / "log.csv", names, columns, above=above)).imus["/imu0"]
    np.testing.assert_array_equal(imu.gyro, gyro)
    np.testing.assert_allclose(imu.accel, 9.80665 * ACCEL_G)


@pytest.mark.parametrize(
    "named",
    [
        "rotationRate{}|gravity{}|acceleration{}",
        "rotationRate.{}|gravity.{}|userAcceleration.{}",
        "rotation_rate_{}(radians/s)|gravity_{}(G)|user_acc_{}(G)",
        "",
    ],
)
def test_gravity_beside_an_acceleration_of_coremotion_is_added_to_it(tmp_path, named):
    """As Sensor Logger writes the motion of an Apple watch, and OxIOD that of a phone, without a header."""
    t_s, rng = np.arange(1000) * 0.01, np.random.default_rng(4)
    angles = np.stack([2.0 * t_s, 0.8 * np.sin(1.3 * t_s), 1.1 * t_s], axis=1)  # turns over and over
    gravity = -Rotation.from_euler("xyz", angles).inv().apply([0.0, 0.0, 1.0])
    motion, gyro = rng.normal(0.0, 0.9, (2, 1000, 3))
    parts = {form: v for form, v in zip(named.split("|"), (gyro, gravity, motion), strict=False) if form}
    columns = {
        f.format(a): each for f, v in parts.items() for a, each in zip("XYZ" if "." not in f else "xyz", v.T, strict=True)
    }
    path = write_csv(tmp_path / "WristMotion.csv", ["t [s]", *columns], [t_s, *columns.values()])
    if not named:
        attitude = np.arctan2(gravity[:, 0], -gravity[:, 2]), -np.arcsin(gravity[:, 1]), t_s
        rows = np.column_stack([t_s, *attitude, gyro, gravity, motion, 40.0 * gravity])
        path.write_text("\n".join(",".join(map(repr, row)) for row in rows.tolist()) + "\n")
    log = table.read_sequence(table.sequences(path)[0], mapping={"gyro_unit": "rad/s"})
    np.testing.assert_allclose(log.imus["/imu0"].accel, -9.80665 * (gravity + motion), rtol=1e-9)
    np.testing.assert_array_equal(log.imus["/imu0"].gyro, gyro)


def test_short_integers_of_matlab_are_numbers_as_all_are(tmp_path):
    """A counter in 16 bits named as a time ended in a traceback."""
    counts = np.round(16384 * ACCEL_G).astype(np.int16)
    names = [f"accel{axis}Data" for axis in "XYZ"], [f"gyro{axis}Data" for axis in "XYZ"]
    columns = dict(zip(names[0] + names[1], [*counts.T, *COUNTS.astype(np.int16).T], strict=True))
    scipy.io.savemat(tmp_path / "run.mat", columns | {"timeData": np.arange(1, COUNT + 1, dtype=np.uint16)})
    scales = {"accel_unit": "g", "accel_scale": 1 / 16384, "gyro_unit": "deg/s", "rate_hz": 100.0}
    imu = table.read_sequence(table.sequences(tmp_path / "run.mat")[0], mapping=scales).imus["/imu0"]
    np.testing.assert_allclose(imu.accel, 9.80665 * counts / 16384, rtol=1e-12)
    np.testing.assert_allclose(imu.gyro, np.deg2rad(COUNTS), rtol=1e-12)


def test_the_scales_of_a_log_of_gyroflow_are_applied(tmp_path):
    stated = (
        "GYROFLOW IMU LOG\nversion,1.3\nid,logger\norientation,YxZ\ntscale,0.001\ngscale,0.00122173047\nascale,0.00048828125\n"
    )
    accel = np.round(ACCEL_G / 0.00048828125)
    rows = np.column_stack([1000.0 * T_S, COUNTS, accel]).astype(int).tolist()
    text = stated + "t,gx,gy,gz,ax,ay,az\n" + "".join(",".join(map(str, row)) + "\n" for row in rows)
    (tmp_path / "run.gcsv").write_text(text)
    imu = read(tmp_path / "run.gcsv").imus["/imu0"]
    np.testing.assert_allclose(imu.gyro, 0.00122173047 * COUNTS, rtol=1e-12)
    np.testing.assert_allclose(imu.accel, 9.80665 * 0.00048828125 * accel, rtol=1e-12)
    np.testing.assert_allclose(imu.t_ns, 1e9 * T_S, atol=1.0)


@pytest.mark.parametrize(("named", "written", "doubted"), [("dps", "rad", True), ("rads", "rad", False), ("dps", "deg", False)])
def test_a_stated_unit_against_the_way_gravity_turns_is_doubted(tmp_path, named, written, doubted):
    t_s = np.arange(6000) * 0.01
    turn = Rotation.from_euler("xyz", 0.8 * np.sin(t_s[:, None] * [0.9, 1.3, 0.7]))
    gyro = np.vstack([(turn[:-1].inv() * turn[1:]).as_rotvec() * 100.0, np.zeros(3)])
    gyro = gyro + 0.002 * np.random.default_rng(3).normal(size=gyro.shape)
    accel = turn.inv().apply([0.0, 0.0, 1.0])
    names = ["t", *(f"gyro_{a}_{named}" for a in "xyz"), *(f"accel_{a}_g" for a in "xyz")]
    values = gyro if written == "rad" else np.degrees(gyro)
    notes = read(write_csv(tmp_path / "imu.csv", names, [t_s, *values.T, *accel.T])).remarks.notes
    assert any("gravity turns" in note and "is the unit right?" in note for note in notes) == doubted


@pytest.mark.parametrize("written", ["rad", "deg"])
def test_a_name_that_only_ros_has_in_rad_is_asked_where_gravity_turns_otherwise(tmp_path, written):
    t_s = np.arange(3000) * 0.01
    turn = Rotation.from_euler("xyz", 0.8 * np.sin(t_s[:, None] * [0.9, 1.3, 0.7]))
    gyro = np.vstack([(turn[:-1].inv() * turn[1:]).as_rotvec() * 100.0, np.zeros(3)])
    gyro = gyro + 0.002 * np.random.default_rng(3).normal(size=gyro.shape)
    names = ["t", *(f"Angular Velocity {a}" for a in "XYZ"), *(f"Acceleration {a}" for a in "XYZ")]
    values = [t_s, *(gyro if written == "rad" else np.degrees(gyro)).T, *turn.inv().apply([0.0, 0.0, 9.8]).T]
    path = write_csv(tmp_path / "State.csv", names, values)
    if written == "deg":
        with pytest.raises(
            ConfigError, match="may be in rad/s, and gravity turns in the accelerometer as a gyro in deg/s says"
        ):
            read(path)
    else:
        np.testing.assert_allclose(read(path).imus["/imu0"].gyro, gyro, rtol=1e-9)


def test_a_name_that_only_ros_has_in_si_units_is_asked_where_gravity_has_another_unit(tmp_path):
    names = ["time", *(f"angular_velocity_{a}" for a in "xyz"), *(f"linear_acceleration_{a}" for a in "xyz")]
    path = write_csv(tmp_path / "ros.csv", names, [T_S, *(COUNTS * 0.011).T, *ACCEL_G.T])
    with pytest.raises(ConfigError, match=r"may be in m/s\^2, and the median acceleration is .*: gravity in g"):
        read(path)


@pytest.mark.parametrize(("unit", "doubted"), [("ms", True), ("s", False), ("us", True)])
def test_a_stated_unit_of_the_time_that_gives_no_rate_of_an_imu_is_doubted(tmp_path, unit, doubted):
    """The header names another unit than the times have, which are of 100 Hz."""
    size = {"ms": 1e6, "s": 1.0, "us": 1e-1}[unit]
    names = [f"time [{unit}]", *(f"gyro_{a} [deg/s]" for a in "xyz"), *(f"acc_{a} [g]" for a in "xyz")]
    path = write_csv(tmp_path / "imu.csv", names, [size * (T_S - T_S[0]), *COUNTS.T, *ACCEL_G.T])
    assert any("is the unit of the time right?" in note for note in read(path).remarks.notes) == doubted


@pytest.mark.parametrize("unit", [" [ft/s^2]", " (ft/s2)", " [feet/s²]", " [ft/s/s]", " (ft/sec/sec)", "_ft_s2"])
def test_feet_are_read_where_they_are_stated_alone(tmp_path, unit):
    names = ["time_s", *(f"w{a}_dps" for a in "xyz"), *(f"acc_{a}{unit}" for a in "xyz")]
    feet = 9.80665 / 0.3048 * ACCEL_G
    imu = read(write_csv(tmp_path / "imu.csv", names, [T_S, *COUNTS.T, *feet.T])).imus["/imu0"]
    np.testing.assert_allclose(imu.accel, 9.80665 * ACCEL_G)
    with pytest.raises(ConfigError, match="no unit of the accel"):
        read(write_csv(tmp_path / "imu.csv", [name.removesuffix(unit) for name in names], [T_S, *COUNTS.T, *feet.T]))


def test_forces_are_no_accelerations(tmp_path):
    names = ["time_s", *(f"w{a}_dps" for a in "xyz"), *(f"F{a}" for a in "xyz")]
    with pytest.raises(ConfigError, match="no unit of the accel"):
        read(write_csv(tmp_path / "force.csv", names, [T_S, *COUNTS.T, *(55.0 * ACCEL_G).T]))


@pytest.mark.parametrize(("counts", "full"), [(16384, 2), (8192, 4), (4096, 8), (2048, 16)])
def test_raw_counts_are_asked_with_the_range_that_they_fit(tmp_path, counts, full):
    raw = np.round(ACCEL_G * counts).astype(int)
    path = write_csv(tmp_path / "raw.csv", NAMES, [T_S, *raw.T, *COUNTS.astype(int).T])
    with pytest.raises(ConfigError, match="raw counts of a range of") as caught:
        read(path)
    line = (
        f'# accel_scale = {1 / counts!r}  # with accel_unit = "g", if these are raw counts of ±{full} g ({counts} counts a g)'
    )
    assert line in str(caught.value)
    assert "# gyro_scale = 0.0076335878" in str(caught.value)
    assert raw_counts(ACCEL_G * counts + 0.5) is None


@pytest.mark.parametrize(
    "row",
    [
        "{t}: |Acc X:{a[0]}, Acc Y:{a[1]}, Acc Z:{a[2]} |Gyr X:{g[0]} deg/s, Gyr Y:{g[1]} deg/s, Gyr Z:{g[2]} deg/s",
        "{{'acc': {{'x': {a[0]}, 'y': {a[1]}, 'z': {a[2]}}}, 'gyro': {{'x': {g[0]}, 'y': {g[1]}, 'z': {g[2]}}}, 't': {t}}}",
        '{{"time": {t}, "accel": [{a[0]}, {a[1]}, {a[2]}], "gyro": [{g[0]}, {g[1]}, {g[2]}], "temp_c": 25.5}}',
        "t={t} ax={a[0]} ay={a[1]} az={a[2]} gx={g[0]} gy={g[1]} gz={g[2]}",
        "[IMU] Time: {t} Accel: ({a[0]}, {a[1]}, {a[2]}), Gyroscope: ({g[0]}, {g[1]}, {g[2]})",
        "Time: {t}, Acceleration X: {a[0]}, Y: {a[1]}, Z: {a[2]} g, Gyro X: {g[0]}, Y: {g[1]}, Z: {g[2]} deg/s",
    ],
)
def test_rows_that_name_their_numbers(tmp_path, row):
    gyro = np.round(COUNTS * 0.07, 2)
    rows = [row.format(t=1000 + 10 * n, a=a, g=g) for n, (a, g) in enumerate(zip(ACCEL_G.tolist(), gyro.tolist(), strict=True))]
    (tmp_path / "serial.log").write_text("\n".join(["MPU6050 ready", *rows]) + "\n")
    log = read(tmp_path / "serial.log")
    imu = log.imus["/imu0"]
    np.testing.assert_allclose(imu.gyro, np.deg2rad(gyro), rtol=1e-9)
    np.testing.assert_allclose(imu.accel, 9.80665 * ACCEL_G, rtol=1e-9)
    assert np.array_equal(np.diff(imu.t_ns), np.full(COUNT - 1, 10_000_000))
    assert "1 lines of other words are left out" in log.remarks.notes
    assert not log.remarks.losses


def test_rows_that_name_padded_numbers_between_lines_of_the_state(tmp_path):
    gyro = np.round(COUNTS * 0.07, 2)
    form = "t={:6d} ax={:7.3f} ay={:7.3f} az={:7.3f} gx={:8.2f} gy={:8.2f} gz={:8.2f}\nstate: sys 3, gyro 3, accel 0, mag 3\n"
    rows = [form.format(1000 + 10 * n, *values) for n, values in enumerate(np.hstack([ACCEL_G, gyro]).tolist())]
    (tmp_path / "serial.log").write_text("ready\n" + "".join(rows))
    log = read(tmp_path / "serial.log")
    np.testing.assert_allclose(log.imus["/imu0"].gyro, np.deg2rad(gyro), rtol=1e-9)
    assert f"{COUNT + 1} lines of other words are left out" in log.remarks.notes
    assert not log.remarks.losses


def test_a_header_that_is_shorter_than_its_rows_is_named(tmp_path):
    path = write_csv(tmp_path / "imu.csv", ["time", "accel", "gyro"], [T_S, *ACCEL_G.T, *COUNTS.T])
    with pytest.raises(ConfigError, match=r"has 3 fields and the rows 7: it names no column \(time, accel, gyro\)"):
        read(path)


@pytest.mark.parametrize("row", ["a: 1 b: - 2 c: 3 d: 4 e: 5", "1.5,2.5,3.5,x: left,4.5", "level: 1, 2"])
def test_other_rows_name_no_numbers(row):
    assert as_table("\n".join([row] * 20)) == ("", 0, 0)


@pytest.mark.parametrize("name", ["mag_y", "temperature"])
def test_a_column_that_rises_is_no_time_unless_it_is_the_first(tmp_path, name):
    columns = [*ACCEL_G.T, *(COUNTS * 0.07).T, 20.0 + T_S]
    with pytest.raises(ConfigError, match="no column that rises looks like a time"):
        read(write_csv(tmp_path / "imu.csv", [*NAMES[1:], name], columns))
    imu = read(write_csv(tmp_path / "imu.csv", ["GPST", *NAMES[1:]], [columns[-1], *columns[:-1]])).imus["/imu0"]
    assert np.array_equal(np.diff(imu.t_ns), np.full(COUNT - 1, 10_000_000))


@pytest.mark.parametrize("order", [["accel", "gyro"], ["gyro", "accel"]])
def test_a_table_without_header_and_time_asks_its_rate_alone(tmp_path, order):
    parts = {"accel": ACCEL_G, "gyro": (COUNTS * 0.07).round(2)}
    six = np.hstack([parts[sensor] for sensor in order])
    (tmp_path / "imu.csv").write_text("\n".join(",".join(map(repr, row)) for row in six.tolist()) + "\n")
    with pytest.raises(ConfigError) as caught:
        read(tmp_path / "imu.csv")
    assert 'gyro = ["gyro_x", "gyro_y", "gyro_z"]\ngyro_unit = "deg/s"\n' in str(caught.value)
    assert 'accel_unit = "g"\n' in str(caught.value)


def test_a_wider_table_without_header_gets_a_guess_to_confirm(tmp_path):
    rows = np.hstack([T_S[:, None], ACCEL_G, COUNTS * 0.07, np.full((COUNT, 1), 25.5)])
    (tmp_path / "imu.csv").write_text("\n".join(",".join(map(repr, row)) for row in rows.tolist()) + "\n")
    with pytest.raises(ConfigError) as caught:
        read(tmp_path / "imu.csv")
    assert '# perhaps accel = ["column 2", "column 3", "column 4"]' in str(caught.value)
    assert '# perhaps gyro = ["column 5", "column 6", "column 7"]' in str(caught.value)


def test_the_motion_shows_which_columns_of_a_wide_table_are_the_imu(tmp_path):
    """Time, angles, quaternion, gyro, accelerometer, magnetometer, in an order of no known data set."""
    t_s = np.arange(3000) * 0.01
    turn = Rotation.from_euler("xyz", 0.8 * np.sin(t_s[:, None] * [0.9, 1.3, 0.7]))
    noise = np.random.default_rng(3).normal(0.0, 0.002, (4, 3000, 3))
    gyro = np.vstack([(turn[:-1].inv() * turn[1:]).as_rotvec() * 100.0, np.zeros(3)])
    sensors = [gyro + noise[0], turn.inv().apply([0.0, 0.0, 9.8]) + noise[1], turn.inv().apply([0.2, 0.0, -0.4]) + noise[2]]
    rows = np.column_stack([t_s, turn.as_euler("xyz"), turn.as_quat(), *sensors])
    (tmp_path / "imu.csv").write_text("\n".join(",".join(map(repr, row)) for row in rows.tolist()) + "\n")
    with pytest.raises(ConfigError) as caught:
        read(tmp_path / "imu.csv")
    assert '# perhaps accel = ["column 12", "column 13", "column 14"]' in str(caught.value)
    assert '# perhaps gyro = ["column 9", "column 10", "column 11"]' in str(caught.value)
    poses = np.insert(turn.as_matrix().reshape(-1, 9), [3, 6, 9], 331_000.0, axis=1).tolist()
    gps = [[3, 9, 0.738 + t, -1.461, 270.0, 0.0, 0.0] for t in t_s.tolist()]  # of NCLT: mode, satellites, latitude
    for others in (poses, gps):
        lines = (",".join(map(repr, [t, *row])) for t, row in zip(t_s.tolist(), others, strict=True))
        (tmp_path / "other.csv").write_text("\n".join(lines) + "\n")
        with pytest.raises(ConfigError) as caught:
            read(tmp_path / "other.csv")
        assert "perhaps" not in str(caught.value)


def test_axes_in_letters_come_before_numbered_columns_of_the_same_word(tmp_path):
    names = ["t_ms", *NAMES[1:], "a0", "a1", "a2"]
    columns = [1e3 * T_S, *ACCEL_G.T, *(COUNTS * 0.07).T, *RNG.normal(600, 9, (3, COUNT))]
    path = write_csv(tmp_path / "audio.csv", names, columns)
    np.testing.assert_allclose(read(path).imus["/imu0"].accel, 9.80665 * ACCEL_G, rtol=1e-12)


def test_the_axis_may_stand_in_front_as_in_messages_of_mavlink(tmp_path):
    """As mavlogdump.py of pymavlink writes them."""
    names = ["timestamp", *(f"HIGHRES_IMU.{a}{sensor}" for sensor in ("acc", "gyro", "mag") for a in "xyz")]
    imu = read(write_csv(tmp_path / "highres.csv", names, [T_S, *ACCEL_G.T, *(COUNTS * 0.07).T, *ACCEL_G.T])).imus["/imu0"]
    np.testing.assert_allclose(imu.accel, 9.80665 * ACCEL_G, rtol=1e-12)
    np.testing.assert_allclose(imu.gyro, np.deg2rad(COUNTS * 0.07), rtol=1e-12)


def test_the_poses_of_idol_are_those_of_its_table(tmp_path):
    sensors = [f"iphone{sensor}{a}" for sensor in ("Acc", "Gyro") for a in "XYZ"]
    names = ["timestamp", *sensors, *(f"orient{a}" for a in "WXYZ"), *(f"processedPos{a}" for a in "XYZ")]
    columns = [T_S, *ACCEL_G.T, *(COUNTS * 0.07).T, *np.full((4, COUNT), 0.5), *ACCEL_G.T]
    log = read(write_csv(tmp_path / "idol.csv", names, columns))
    ((topic, poses),) = log.poses.items()
    assert (log.kinds[topic], poses.q_wb_wxyz.tolist()) == ("estimate", [[0.5] * 4] * COUNT)
    np.testing.assert_array_equal(poses.p_wb, ACCEL_G)


def test_a_first_column_of_row_numbers_hides_no_time(tmp_path):
    names = ["", "Stop_watch", *NAMES[1:]]
    path = write_csv(tmp_path / "pandas.csv", names, [np.arange(COUNT), T_S, *ACCEL_G.T, *(COUNTS * 0.07).T])
    assert np.array_equal(np.diff(read(path).imus["/imu0"].t_ns), np.full(COUNT - 1, 10_000_000))


def test_imus_on_a_body_become_one_each_and_statistics_none(tmp_path):
    places = ["chest", "left_leg", "right_leg"]
    names = ["Millis", *(f"{sensor}{a}_{place}" for place in places for sensor in ("Accel", "Gyro") for a in "XYZ")]
    columns = [1e3 * T_S, *(part for _ in places for part in (*ACCEL_G.T, *(COUNTS * 0.07).T))]
    assert {*read(write_csv(tmp_path / "body.csv", names, columns)).imus} == {f"/{place}/imu" for place in places}
    names = [name.replace("chest", "mean").replace("leg", "std") for name in names]
    with pytest.raises(ConfigError, match="no columns look like the gyro"):
        read(write_csv(tmp_path / "features.csv", names, columns))


@pytest.mark.parametrize("names", [NAMES, ["time", *(f"linear_acceleration_{a}" for a in "xyz"), *NAMES[4:]]])
def test_a_motion_without_gravity_is_asked_though_it_is_as_long_as_gravity_in_g(tmp_path, names):
    motion = RNG.normal(0.0, 0.65, (COUNT, 3))
    assert abs(np.median(np.linalg.norm(motion, axis=1)) - 1.0) < 0.15
    with pytest.raises(ConfigError, match=r"gravity was taken out|no unit of the accel"):
        read(write_csv(tmp_path / "walk.csv", names, [T_S, *motion.T, *(COUNTS * 0.07).T]))
    turning = np.linalg.qr(np.random.default_rng(2).normal(size=(COUNT, 3, 3)))[0][:, 0] * RNG.normal(1.0, 0.2, (COUNT, 1))
    read(write_csv(tmp_path / "tumble.csv", NAMES, [T_S, *turning.T, *(COUNTS * 0.07).T]))


def test_a_unit_that_another_time_contradicts_is_asked(tmp_path):
    gyro = COUNTS * 0.07
    names = ["NodeTimestamp", "Date", *NAMES[1:]]
    rows = [
        ",".join([str(6 * n), f"2026-11-21 15:04:{n * 0.04:06.3f}", *map(repr, row)])
        for n, row in enumerate(np.hstack([ACCEL_G, gyro]).tolist())
    ]
    (tmp_path / "node.csv").write_text("\n".join([",".join(names), *rows]) + "\n")
    with pytest.raises(ConfigError, match=r"'NodeTimestamp' would count ms, but by 'Date' 11.96 s pass and not 1.794 s"):
        read(tmp_path / "node.csv")
    log = read(write_csv(tmp_path / "apple.csv", ["timeIntervalSince1970", *NAMES[1:]], [1.7e9 + T_S, *ACCEL_G.T, *gyro.T]))
    assert len(log.imus["/imu0"]) == COUNT


def test_tables_of_a_folder_may_name_their_sensor_in_each_row(tmp_path):
    parts = {"acce": ACCEL_G, "gyro": COUNTS * 0.07}
    for name, values in parts.items():
        rows = [f"{name.upper()};{t:.3f};{t:.3f};{x:.4f};{y:.4f};{z:.4f};0" for t, (x, y, z) in zip(T_S, values, strict=True)]
        (tmp_path / f"{name}.csv").write_text("\n".join(rows) + "\n")
    np.testing.assert_allclose(read(tmp_path).imus["/imu0"].gyro, np.deg2rad(parts["gyro"]), atol=1e-9)


@pytest.mark.parametrize(
    "text", ["1 " + "a" * 5_000_000 + " 2 3 4 5 6\n", 200 * ("1 " + "a:" * 900 + " 2 3 4 5 6 7\n"), "9" * 5_000_000 + "x\n"]
)
def test_long_lines_are_no_rows_that_name_their_numbers(text):
    """The search for labels costs the square of their length: it would take hours."""
    assert as_table(text) == ("", 0, 0)


def test_numbers_in_a_header_between_tabs_are_no_fields(tmp_path):
    """Blanks split `Distance 1` into a word and a number, and the header into a row of numbers."""
    names = [*NAMES, *(f"Distance {n}" for n in range(1, 9))]
    path = write_csv(tmp_path / "imu.csv", names, [T_S, *ACCEL_G.T, *(COUNTS * 0.07).round(2).T, *([T_S] * 8)], mark="\t")
    log = read(path)
    assert "/Distance_8" in log.scalars
    assert log.remarks.losses == []


@pytest.mark.parametrize(
    ("gyro", "accels"),
    [
        ("{}.Gyroscope {} [deg/s]", ["{}.Wide Range Accelerometer {} [m/s^2]"]),
        ("{}_gyr_{} [deg/s]", ["{}_lin_acc_{} [m/s^2]", "{}_acc_{} [m/s^2]"]),
        ("{}_AngVel_{} [deg/s]", ["{}_LinAcc_{} [m/s^2]"]),
    ],
)
def test_accelerations_with_further_words_are_of_the_imu_whose_name_theirs_begin_with(tmp_path, gyro, accels):
    owners, forms = ("leg", "leg_left"), (gyro, *accels)
    names = ["t [s]", *(form.format(owner, axis) for owner in owners for form in forms for axis in "xyz")]
    force = np.array([0.0, 0.0, 9.8]) + np.random.default_rng(3).normal(size=(400, 3))
    of = {
        owner: [factor * force, *([0.1 * force] * (len(accels) - 1)), force + factor] for factor, owner in enumerate(owners, 1)
    }
    path = write_csv(
        tmp_path / "gait.csv", names, [np.arange(400) / 100.0, *(v for o in owners for part in of[o] for v in part.T)]
    )
    log = table.read_sequence(table.sequences(path)[0])
    assert {*log.imus} == {"/leg/imu", "/leg_left/imu"}
    for owner in owners:
        np.testing.assert_allclose(log.imus[f"/{owner}/imu"].gyro, np.deg2rad(of[owner][0]))
        np.testing.assert_allclose(log.imus[f"/{owner}/imu"].accel, of[owner][-1])


def test_parameters_of_a_sensor_are_no_sensor_and_a_time_of_other_length_is_named(tmp_path):
    force = np.array([0.0, 0.0, 9.8]) + np.random.default_rng(3).normal(size=(400, 3))
    arrays = {"gyro": 0.1 * force, "accel": force, "C_gyro": np.eye(3), "C_accel": np.eye(3)}
    np.savez(tmp_path / "run.npz", t=np.arange(400) / 100.0, **arrays)
    (sequence,) = table.sequences(tmp_path / "run.npz")
    log = table.read_sequence(sequence, mapping={"gyro_unit": "rad/s"})
    np.testing.assert_allclose(log.imus["/imu0"].accel, force)
    assert "C_gyro[0]" in log.metadata["imutool/constants"]
    np.savez(tmp_path / "run.npz", t=np.arange(399) / 100.0, **arrays)
    with pytest.raises(ConfigError, match="'t' rises and has 399 rows, and the gyro 400"):
        table.read_sequence(sequence, mapping={"gyro_unit": "rad/s"})


def test_readings_in_several_states_are_asked_unless_one_has_none(tmp_path):
    """Raw and calibrated readings of one sensor, `acc_x_raw` and `acc_x_cal`, are two triples."""
    forces = {"": 9.8 * ACCEL_G, "_raw": 9.8 * ACCEL_G + 0.2, "_cal": 9.8 * ACCEL_G - 0.1}
    for states in (("", "_raw"), ("_raw", "_cal")):
        names = ["t", *(f"acc_{a}{state}" for state in states for a in "xyz"), *(f"g{a}" for a in "xyz")]
        columns = [T_S, *(axis for state in states for axis in forces[state].T), *(COUNTS * 0.07).round(2).T]
        path = write_csv(tmp_path / "imu.csv", names, columns)
        if "" in states:
            np.testing.assert_allclose(read(path).imus["/imu0"].accel, forces[""])
        else:
            with pytest.raises(ConfigError, match="2 triples of columns look like the accel: acc_x_raw/y/z, acc_x_cal/y/z"):
                read(path)


@pytest.mark.parametrize(
    ("gyro", "accel", "sizes"),
    [
        ("mrad/s", "mm/s^2", (1e-3, 1e-3)),
        ("deg/h", "µg", (np.pi / 180.0 / 3600.0, 9.80665e-6)),
        ("deg/min", "g", (np.pi / 180.0 / 60.0, 9.80665)),
        ("rpm", "g", (np.pi / 30.0, 9.80665)),
        ("rev/s", "g", (2.0 * np.pi, 9.80665)),
    ],
)
def test_other_units_in_a_header_are_multiplied(tmp_path, gyro, accel, sizes):
    names = ["time [s]", *(f"gyro_{a} [{gyro}]" for a in "xyz"), *(f"acc_{a} [{accel}]" for a in "xyz")]
    rates, forces = 0.01 * COUNTS, 9.80665 * ACCEL_G
    columns = [T_S, *(rates / sizes[0]).T, *(forces / sizes[1]).T, 100.0 + T_S]
    log = read(write_csv(tmp_path / "imu.csv", [*names, "motor [rpm]"], columns))
    np.testing.assert_allclose(log.imus["/imu0"].gyro, rates, rtol=1e-9)
    np.testing.assert_allclose(log.imus["/imu0"].accel, forces, rtol=1e-9)
    np.testing.assert_allclose(next(iter(log.scalars.values())).values[:, 0], 100.0 + T_S)


def test_multiples_of_a_unit_in_a_header_are_applied_and_ranges_are_not(tmp_path):
    names = ["time (ms)", *(f"gyroscope {a} (0.1 deg/s)" for a in "xyz"), *(f"accelerometer {a} (1e-3 g)" for a in "xyz")]
    path = write_csv(tmp_path / "imu.csv", names, [1e3 * T_S, *COUNTS.T, *(1e3 * ACCEL_G).T])
    log = read(path)
    np.testing.assert_allclose(log.imus["/imu0"].gyro, np.deg2rad(COUNTS * 0.1))
    np.testing.assert_allclose(log.imus["/imu0"].accel, 9.80665 * ACCEL_G)
    assert any("gyroscope x (0.1 deg/s) by 0.1 to deg/s" in note for note in log.remarks.notes)
    names = [name.replace("0.1 deg/s", "deg/s").replace("1e-3 g", "16 g") for name in names]
    path = write_csv(tmp_path / "imu.csv", names, [1e3 * T_S, *COUNTS.T, *ACCEL_G.T])
    np.testing.assert_allclose(read(path).imus["/imu0"].accel, 9.80665 * ACCEL_G)


def test_every_unit_at_the_end_of_a_name_has_a_meaning():
    rates = [
        f"{angle}{per}{second}"
        for angle in ("deg", "rad")
        for per in ("", "_", "_per_", "per")
        for second in ("s", "sec", "second")
    ]
    times = [f"{part}sec{end}" for part in ("", "nano", "micro", "milli") for end in ("", "s", "ond", "onds")]
    found = [split_name(f"x_{unit}") for unit in (*rates, *times)]
    assert [name for name, _ in found] == ["x"] * len(found)
    assert {unit for _, unit in found} == {"deg/s", "rad/s", "s", "ns", "us", "ms"}


@pytest.mark.parametrize("kind", ["lists", "arrays", "structures"])
def test_vectors_in_a_cell_of_parquet_are_columns(tmp_path, kind):
    import pyarrow as pa
    import pyarrow.parquet as pq

    gyro = COUNTS * 0.011

    def cells(values: np.ndarray) -> pa.Array:
        if kind == "structures":
            return pa.array([dict(zip("xyz", row, strict=True)) for row in values.tolist()])
        return pa.array(values.tolist(), pa.list_(pa.float64(), 3 if kind == "arrays" else -1))

    columns = {"time_s": T_S, "gyro": cells(gyro), "accel": cells(9.8 * ACCEL_G), "words": [[1.0], [1.0, 2.0]] * (COUNT // 2)}
    pq.write_table(pa.table(columns), tmp_path / "run.parquet")
    log = table.read_sequence(table.sequences(tmp_path / "run.parquet")[0], mapping={"gyro_unit": "rad/s"})
    np.testing.assert_array_equal(log.imus["/imu0"].gyro, gyro)
    np.testing.assert_array_equal(log.imus["/imu0"].accel, 9.8 * ACCEL_G)
    assert log.remarks.losses == ["words is left out: its lists differ in length, or are empty"]


@pytest.mark.parametrize("own", [True, False])
@pytest.mark.parametrize("mark", [",", "\t", " "])
def test_rows_of_arduinos_serial_monitor_begin_with_the_time_of_their_arrival(tmp_path, mark, own):
    """The board's own time counts before it."""
    late = [f"15:04:{5 + n // 100:02d}.{n % 100:02d}{n % 7} -> " for n in range(COUNT)]
    values = np.column_stack([*([1000 + np.arange(COUNT) * 10] if own else []), ACCEL_G, COUNTS * 0.07]).round(4)
    rows = [arrived + mark.join(f"{value:g}" for value in row) for arrived, row in zip(late, values.tolist(), strict=True)]
    header = "15:04:04.999 -> " + mark.join([*(["millis"] if own else []), *NAMES[1:]])
    (tmp_path / "monitor.txt").write_text("\n".join(["15:04:01.000 -> MPU ready", header, *rows]) + "\n")
    imu = read(tmp_path / "monitor.txt").imus["/imu0"]
    np.testing.assert_allclose(imu.gyro, np.deg2rad((COUNTS * 0.07).round(4)), rtol=1e-5)
    assert imu.t_ns[0] == (10**9 if own else (15 * 3600 + 4 * 60 + 5) * 10**9)
    assert (np.diff(imu.t_ns) == 10_000_000).all() == own


@pytest.mark.parametrize("blank", [",,,,,,,", "NaN" + ",NaN" * 7])
def test_a_blank_row_renames_no_further_column(tmp_path, blank):
    rows = [",".join(map(repr, row)) for row in np.column_stack([T_S, ACCEL_G, COUNTS * 0.07, 20.0 + T_S]).tolist()]
    (tmp_path / "imu.csv").write_text("\n".join([",".join([*NAMES, "temp"]), *rows[:100], blank, *rows[100:]]) + "\n")
    log = read(tmp_path / "imu.csv")
    assert [*log.scalars] == ["/temp"]
    assert len(log.imus["/imu0"]) == COUNT


def test_a_time_for_each_signal_that_is_the_same_is_one_time(tmp_path):
    names = [f"ACC.{a} 1[g]" for a in "XYZ"] + [f"GYRO.{a} 1[deg/s]" for a in "XYZ"]  # of Delsys' Trigno
    header = ",".join(f'X[s],"Avanti sensor 1: {name}"' for name in names)
    rows = [[each for value in row for each in (t, value)] for t, row in zip(T_S, np.hstack([ACCEL_G, COUNTS]), strict=True)]
    (tmp_path / "trial.csv").write_text(
        "\n".join([header, *(",".join(f"{value:.6f}" for value in row) for row in rows)]) + "\n"
    )
    imu = read(tmp_path / "trial.csv").imus["/imu0"]
    assert np.array_equal(np.diff(imu.t_ns), np.full(COUNT - 1, 10_000_000))
    np.testing.assert_allclose(imu.gyro, np.deg2rad(COUNTS), rtol=1e-6)


def test_rows_that_name_no_kind_are_of_one_of_their_own(tmp_path):
    """As the true poses in the JSON lines of Spectacular AI, between rows that name their sensor."""
    rows = []
    for n, t in enumerate(T_S.tolist()):
        rows += [{"time": t, "sensor": {"type": "gyroscope", "values": (COUNTS[n] * 0.011).tolist()}}]
        rows += [{"time": t, "sensor": {"type": "accelerometer", "values": (9.8 * ACCEL_G[n]).tolist()}}]
        pose = {"position": {"x": t, "y": 0, "z": 0}, "orientation": {"w": 1, "x": 0, "y": 0, "z": 0}}
        rows += [{"time": t, "groundTruth": pose}] * (n % 20 == 0)
    (tmp_path / "data.jsonl").write_text("\n".join(map(json.dumps, rows)))
    log = table.read_sequence(table.sequences(tmp_path / "data.jsonl")[0], mapping={"gyro_unit": "rad/s"})
    np.testing.assert_allclose(log.poses["/ground_truth/pose"].p_wb[:, 0], T_S[::20])
    assert log.remarks.losses == []


def test_objects_without_a_number_are_no_table(tmp_path):
    words = '{"first": [' + ",".join(['{"name": "left"}'] * 9) + '], "second": [' + ",".join(['{"name": "right"}'] * 9) + "]}"
    (tmp_path / "words.json").write_text(words)
    assert table.sequences(tmp_path) == []


def test_a_row_that_was_cut_is_a_loss_and_a_line_of_the_state_is_none(tmp_path):
    gyro = np.round(COUNTS * 0.07, 2).tolist()
    lines = [
        "t={} ax={} ay={} az={} gx={} gy={} gz={}".format(10 * n, *a, *g)
        for n, (a, g) in enumerate(zip(ACCEL_G.tolist(), gyro, strict=True))
    ]
    lines[50:50] = ["OK", "# battery 87", "t=505 ax=0.1"]
    (tmp_path / "serial.log").write_text("\n".join(lines) + "\n")
    log = read(tmp_path / "serial.log")
    assert len(log.imus["/imu0"]) == COUNT
    assert "2 lines of other words are left out" in log.remarks.notes
    assert log.remarks.losses == ["1 lines with a part of these names are left out"]


def test_lines_of_words_between_the_rows_of_a_table_are_no_loss(tmp_path):
    path = write_csv(tmp_path / "imu.csv", NAMES, [T_S, *ACCEL_G.T, *(COUNTS * 0.07).round(2).T])
    lines = path.read_text().splitlines()
    lines[60:60] = ["sensor ready", "# battery, 12"]
    path.write_text("\n".join(lines) + "\n")
    log = read(path)
    assert len(log.imus["/imu0"]) == COUNT
    assert not log.remarks.losses
    assert "2 lines of words between the rows are left out" in log.remarks.notes
    lines[60] = "0.595,0.1,"
    path.write_text("\n".join(lines) + "\n")
    assert read(path).remarks.losses == ["1 rows do not have 7 fields and are left out"]


@pytest.mark.parametrize("first", ["rows", "times"])
def test_a_header_without_a_name_for_the_first_column(tmp_path, first):
    """R's write.table gives none to the numbers of rows."""
    columns, names = [*ACCEL_G.T, *(COUNTS * 0.07).round(2).T, np.full(COUNT, 21.5)], [*NAMES[1:], "temperature"]
    if first == "rows":
        columns, names = [np.arange(1, COUNT + 1), T_S, *columns], ["t", *names]
    else:
        columns = [T_S, *columns]
    log = read(write_csv(tmp_path / "imu.csv", names, columns))
    np.testing.assert_allclose(log.imus["/imu0"].accel, 9.80665 * ACCEL_G)
    assert np.array_equal(log.imus["/imu0"].t_ns, np.rint(T_S * 1e9))
    assert "/temperature" in log.scalars


def test_rows_that_lack_numbers_hide_no_header(tmp_path):
    path = write_csv(tmp_path / "imu.csv", NAMES, [T_S, *ACCEL_G.T, *(COUNTS * 0.07).round(2).T])
    header, *lines = path.read_text().splitlines()
    path.write_text("\n".join([header, "-0.02,0.1,,,,,0.07", "-0.01,0.1,0.2,,,,", *lines]) + "\n")
    assert len(read(path).imus["/imu0"]) == COUNT


def test_gravity_in_feet_is_proposed_and_asked(tmp_path):
    path = write_csv(tmp_path / "imu.csv", NAMES, [T_S, *(32.17405 * ACCEL_G).T, *(COUNTS * 0.07).round(2).T])
    with pytest.raises(ConfigError, match=r"the median acceleration is 32.03: gravity in ft/s\^2\?"):
        read(path)
    log = table.read_sequence(table.sequences(path)[0], mapping={"accel_unit": "ft/s^2"})
    np.testing.assert_allclose(log.imus["/imu0"].accel, 9.80665 * ACCEL_G, rtol=1e-5)


@pytest.mark.parametrize("version", [1, 2])
def test_messages_that_ros_printed_are_rows(tmp_path, version):
    """`rostopic echo /imu > imu.txt`, and a last message that was cut."""
    sec, nanosec, space = ("secs", "nsecs", " ") if version == 1 else ("sec", "nanosec", "")
    covariance = "[0.1, 0.0, 0.1]" if version == 1 else "\n- 0.1\n- 0.0\n- 0.1"
    axes = f"{space}\n  x: {{}}\n  y: {{}}\n  z: {{}}\n"
    form = f"header:{space}\n  stamp:{space}\n    {sec}: 1700000000\n    {nanosec}: {{:9d}}\n  frame_id: imu\n"
    form += f"angular_velocity:{axes}angular_velocity_covariance: {covariance}\nlinear_acceleration:{axes}---\n"
    gyro, accel = COUNTS * 0.001, 9.80665 * ACCEL_G
    parts = [form.format(2_000_000 * n, *g, *a) for n, (g, a) in enumerate(zip(gyro.tolist(), accel.tolist(), strict=True))]
    (tmp_path / "imu.txt").write_text("".join(parts) + parts[0][:150])
    log = read(tmp_path / "imu.txt")
    imu = log.imus["/imu0"]
    np.testing.assert_allclose(np.hstack([imu.gyro, imu.accel]), np.hstack([gyro, accel]))
    assert np.array_equal(imu.t_ns, 1_700_000_000 * 10**9 + 2_000_000 * np.arange(COUNT))
    assert log.remarks.losses == ["1 messages without all fields of the first are left out"]


def test_commas_behind_a_header_and_its_rows_hide_no_name(tmp_path):
    """A spreadsheet writes them for columns that were emptied."""
    path = write_csv(tmp_path / "imu.csv", NAMES, [T_S, *ACCEL_G.T, *(COUNTS * 0.07).round(2).T])
    path.write_text("".join(f"{line},,,\n" for line in path.read_text().splitlines()))
    assert len(read(path).imus["/imu0"]) == COUNT


@pytest.mark.parametrize("is_packed", [False, True])
@pytest.mark.parametrize("is_in_folder", [False, True])
def test_a_table_of_hundreds_of_columns_is_one(tmp_path, is_packed, is_in_folder):
    """Its header and first row are longer than what shows most tables."""
    joints = [f"joint_{number}_angle (deg)" for number in range(400)]
    names = ["time (s)", *(f"gyro_{a} (rad/s)" for a in "xyz"), *(f"acc_{a} (g)" for a in "xyz"), *joints]
    values = [T_S, *(0.01 * COUNTS).T, *ACCEL_G.T, *np.round(RNG.normal(0.0, 30.0, (400, COUNT)), 4)]
    path = write_csv(tmp_path / "imu.csv", names, values)
    if is_packed:
        (tmp_path / "imu.csv.gz").write_bytes(gzip.compress(path.read_bytes()))
        path.unlink()
    log = read(tmp_path if is_in_folder else next(tmp_path.iterdir()))
    np.testing.assert_allclose(log.imus["/imu0"].gyro, 0.01 * COUNTS)


def test_units_and_states_behind_the_names_of_numbers_are_no_names(tmp_path):
    """`16555014.81m` is a number with its unit, and `GPS: NO_FIX` holds no number: both may change from row to row."""
    form = (
        "2025-10-04 16:35:{:06.3f},EULER(deg): R=1.70,P=9.24,GYRO: X={:.4f},Y={:.4f},Z={:.4f},"
        "ACCEL: X={:.4f},Y={:.4f},Z={:.4f},ALT: {:.2f}m,GPS: {},SAT=4,iTOW={}ms"
    )
    rows = [
        form.format(0.1 * n, *(0.01 * COUNTS[n]), *(9.8 * ACCEL_G[n]), 100.0 + n, ("NO_FIX", "3D_FIX")[n % 2], 200 * n)
        for n in range(COUNT)
    ]
    (tmp_path / "log.txt").write_text("\n".join(rows) + "\n")
    (found,) = table.sequences(tmp_path / "log.txt")
    log = table.read_sequence(found, mapping={"gyro_unit": "rad/s"})
    np.testing.assert_allclose(log.imus["/imu0"].gyro, 0.01 * COUNTS, atol=1e-9)
    assert not log.remarks.losses
    assert log.scalars["/ALT_m"].unit == "m"


def test_a_few_whole_numbers_are_no_gravity(tmp_path):
    """Counts of an acceleration without gravity may have a median of 10."""
    counts = np.round(RNG.normal([0.0, -10.0, -4.0], 1.0, (COUNT, 3)))
    with pytest.raises(ConfigError, match="state no unit of the accel that imutool knows, and its values show none"):
        read(write_csv(tmp_path / "imu.csv", NAMES, [T_S, *counts.T, *(COUNTS / 16).T]))


def test_further_columns_whose_names_have_the_same_latin_letters_are_topics_of_their_own(tmp_path):
    more = {name: np.full(COUNT, float(n)) for n, name in enumerate(("温度", "湿度", "Mag X", "Mag.X"))}
    names = ["time [s]", *(f"acc_{a} [g]" for a in "xyz"), *(f"gyro_{a} [deg/s]" for a in "xyz")]
    log = read(write_csv(tmp_path / "imu.csv", [*names, *more], [T_S, *ACCEL_G.T, *COUNTS.T, *more.values()]))
    found = {topic: scalars.values[0, 0] for topic, scalars in log.scalars.items()}
    assert found == {"/column": 0.0, "/column_1": 1.0, "/Mag_X": 2.0, "/Mag_X_3": 3.0}
    assert {"'湿度' is on /column_1", "'Mag.X' is on /Mag_X_3"} <= {*log.remarks.notes}


def test_many_samples_that_come_late_by_less_than_a_second_are_a_loss(tmp_path):
    names = ["Time (ms)", *(f"acc_{a} [g]" for a in "xyz"), *(f"gyro_{a} [deg/s]" for a in "xyz")]
    log = read(
        write_csv(tmp_path / "imu.csv", names, [np.round(1000 * T_S) - 400 * np.floor(T_S + 1e-9), *ACCEL_G.T, *COUNTS.T])
    )
    assert len(log.imus["/imu0"]) == 220
    assert log.remarks.losses == [
        "/imu0: 80 of 300 samples are left out, as their time goes back to that of samples before them"
    ]


def test_a_counter_of_32_bits_goes_on_where_it_begins_again(tmp_path):
    """`micros()` of a board does so after 71 minutes."""
    names = ["time_us", *(f"acc_{a} [g]" for a in "xyz"), *(f"gyro_{a} [deg/s]" for a in "xyz")]
    t_us = 2**32 - 1_000_000 + 10_000 * np.arange(COUNT)
    log = read(write_csv(tmp_path / "imu.csv", names, [t_us % 2**32, *ACCEL_G.T, *COUNTS.T]))
    assert log.imus["/imu0"].t_ns.tolist() == (1000 * t_us).tolist()
    assert log.remarks.losses == []
    assert log.remarks.notes.count("'time_us' begins again at 2^32 (1 times): its times go on there") == 1


@pytest.mark.parametrize(
    ("unit", "size", "first", "said"),
    [
        ("us", 2**24, 2**24 - 1_000_000, "2^24"),
        ("us", 2**32, 2**31 - 1_000_000, "2^32"),  # with a sign
        ("ms", 2**16, 2**16 - 1000, "2^16"),
        ("ms", 1000, 0, "1 s"),
        ("s", 86_400.0, 86_399.0, "86400 s"),
        ("s", 604_800.0, 604_799.0, "604800 s"),
        ("min", 60.0, 59.99, "3600 s"),
    ],
)
def test_a_time_goes_on_where_it_begins_again(tmp_path, unit, size, first, said):
    names = [f"time ({unit})", *(f"acc_{a} [g]" for a in "xyz"), *(f"gyro_{a} [deg/s]" for a in "xyz")]
    ns = {"us": 1000, "ms": 10**6, "s": 10**9, "min": 60 * 10**9}[unit]
    t = first + np.round(T_S * 1e9 / ns, 9).astype(type(size))
    low = -(2**31) if first == 2**31 - 1_000_000 else 0
    log = read(write_csv(tmp_path / "imu.csv", names, [(t - low) % size + low, *ACCEL_G.T, *COUNTS.T]))
    np.testing.assert_allclose(log.imus["/imu0"].t_ns, t.astype(float) * ns, rtol=0.0, atol=1000)
    assert any(f"begins again at {said} (" in note for note in log.remarks.notes)
    assert log.remarks.losses == []


@pytest.mark.parametrize("odd", ["mean", ""])
def test_a_row_without_a_time_is_left_out_and_named(tmp_path, odd):
    path = write_csv(
        tmp_path / "imu.csv", [*NAMES[:4], *(f"{each} (deg/s)" for each in NAMES[4:])], [T_S, *ACCEL_G.T, *COUNTS.T]
    )
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines, ",".join([odd, *lines[1].split(",")[1:]])]) + "\n")
    log = read(path)
    assert len(log.imus["/imu0"]) == COUNT
    assert log.remarks.losses == [f"1 rows without a number in {NAMES[0]!r} are left out (the first is row {COUNT + 1})"]


NAMED_AND_IN_UNITS = "time,gx,gy,gz,ax,ay,az\ns,rad/s,rad/s,rad/s,g,g,g"


@pytest.mark.parametrize(
    ("header", "other"),
    [
        (HEADER := "time [s],gx [rad/s],gy [rad/s],gz [rad/s],ax [g],ay [g],az [g]", HEADER.replace("rad", "deg")),
        (HEADER, "time [s],gz [rad/s],gy [rad/s],gx [rad/s],az [g],ay [g],ax [g]"),
        (NAMED_AND_IN_UNITS, NAMED_AND_IN_UNITS.replace("rad", "deg")),
    ],
)
def test_rows_below_another_header_are_refused(tmp_path, header, other):
    """They would be of other columns, or in other units."""
    rows = [",".join(map(str, row)) for row in np.column_stack([T_S, COUNTS, ACCEL_G])]
    half, path = COUNT // 2, tmp_path / "imu.csv"
    path.write_text("\n".join([header, *rows[:half], other, *rows[half:]]) + "\n")
    with pytest.raises(DataError, match=f"has another header below {half} rows: "):
        read(path)
    path.write_text("\n".join([header, *rows[:half], f"\ufeff{header} ", *rows[half:]]) + "\n")  # the same one
    log = read(path)
    np.testing.assert_array_equal(log.imus["/imu0"].gyro, COUNTS)
    assert any("repeat the header are left out" in note for note in log.remarks.notes)


def test_of_a_shimmers_two_accelerometers_the_low_noise_one_is_taken(tmp_path):
    sensors = "Accel_WR", "Accel_LN", "Gyro"
    names = ["Shimmer_67_Timestamp_Unix_CAL", *(f"Shimmer_67_{sensor}_{axis}_CAL" for sensor in sensors for axis in "XYZ")]
    path = write_csv(tmp_path / "imu.csv", names, [T_S * 1000, *(ACCEL_G + 0.1).T, *ACCEL_G.T, *COUNTS.T])
    header, rows = path.read_text().split("\n", 1)
    path.write_text("\n".join([header, ",".join(["ms", *["g"] * 6, *["deg/s"] * 3]), rows]))
    log = read(path)
    np.testing.assert_allclose(log.imus["/imu0"].accel, ACCEL_G * 9.80665)
    assert any("is the low-noise accelerometer of two" in note for note in log.remarks.notes)


@pytest.mark.parametrize("times", [("acc_time", "gyro_time"), ("Acc_ts", "Gyr_ts"), ("time", "time.1"), ("time_s", "time_s")])
def test_each_sensor_keeps_its_own_time(times, tmp_path):
    names = [times[0], "ax", "ay", "az", times[1], *(f"gyro_{axis} (rad/s)" for axis in "xyz")]
    ramp = np.stack([T_S, 0.0 * T_S, 0.0 * T_S + 9.81])  # at each time of the accelerometer
    imu = read(write_csv(tmp_path / "imu.csv", names, [T_S, *ramp, T_S + 0.504, *(0.01 * COUNTS).T])).imus["/imu0"]
    np.testing.assert_allclose(imu.accel[:, 0], imu.t_ns * 1e-9, atol=1e-6)
    assert imu.t_ns[0] == pytest.approx(504_000_000)


def test_lines_that_end_as_on_an_old_macintosh_are_lines(tmp_path):
    path = write_csv(tmp_path / "imu.csv", NAMES, [T_S, *(9.80665 * ACCEL_G).T, *(COUNTS / 131.0).T])
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r"))
    assert len(read(path).imus["/imu0"]) == COUNT


def test_a_structure_of_matlab_for_each_sample_is_a_table(tmp_path):
    columns = [T_S, *(9.80665 * ACCEL_G).T, *(COUNTS / 131.0).T]
    samples = np.array([*zip(*columns, strict=True)], [(name, object) for name in NAMES])
    scipy.io.savemat(tmp_path / "imu.mat", {"IMU_data": samples})
    np.testing.assert_allclose(read(tmp_path / "imu.mat").imus["/imu0"].accel, 9.80665 * ACCEL_G)


def kalibr(folder: Path, gyro: np.ndarray, alpha: np.ndarray) -> Path:
    names = ["timestamp", *(f"{of}_{axis}" for of in ("omega", "alpha") for axis in "xyz")]
    return write_csv(folder / "imu0.csv", names, [1.4e18 + 1e9 * T_S, *gyro.T, *alpha.T])


def test_a_table_for_kalibr_is_in_its_units_also_at_rest(tmp_path):
    """Its accelerations are named alpha, and nothing in a table at rest shows the unit of the gyro."""
    log = read(kalibr(tmp_path, 1e-4 * COUNTS + 1e-6, 9.81 * ACCEL_G))
    np.testing.assert_allclose(log.imus["/imu0"].gyro, 1e-4 * COUNTS + 1e-6)
    np.testing.assert_allclose(log.imus["/imu0"].accel, 9.81 * ACCEL_G)


def test_an_angular_acceleration_is_no_accelerometer(tmp_path):
    with pytest.raises(ConfigError, match="gravity was taken out"):
        read(kalibr(tmp_path, COUNTS, COUNTS - COUNTS.mean(axis=0)))


def test_a_folder_of_matlab_mobile_is_a_recording(tmp_path):
    times = [f"30-Nov-2025 10:53:{second:06.3f}" for second in T_S]
    for name, values in (("AngularVelocity", 0.01 * COUNTS), ("Acceleration", 9.81 * ACCEL_G)):
        rows = [f"{t},{x},{y},{z}" for t, (x, y, z) in zip(times, values, strict=True)]
        (tmp_path / f"{name}.csv").write_text("\n".join(["Timestamp,X,Y,Z", *rows]) + "\n")
    (sequence,) = table.sequences(tmp_path)
    imu = table.read_sequence(sequence, mapping={"gyro_unit": "rad/s"}).imus["/imu0"]
    np.testing.assert_allclose(imu.gyro, 0.01 * COUNTS)
    np.testing.assert_allclose(imu.accel, 9.81 * ACCEL_G)
    assert imu.t_ns[0] == 1_764_499_980_000_000_000  # UTC, as no zone is stated


def test_the_minus_of_typography_is_one(tmp_path):
    """Programs write it in the numbers of Sweden, Norway and Finland."""
    path = write_csv(
        tmp_path / "imu.csv", ["time [s]", *NAMES[1:4], *(f"g{a} [deg/s]" for a in "xyz")], [T_S, *ACCEL_G.T, *COUNTS.T]
    )
    path.write_text(path.read_text().replace("-", "\N{MINUS SIGN}"), encoding="utf-8")
    np.testing.assert_allclose(read(path).imus["/imu0"].gyro, np.deg2rad(COUNTS))


def test_a_temperature_that_rises_is_no_time_next_to_one(tmp_path):
    names = ["T", "Time", *NAMES[1:4], *(f"g{a} [deg/s]" for a in "xyz")]
    log = read(write_csv(tmp_path / "imu.csv", names, [20.0 + 0.005 * np.arange(COUNT), T_S, *ACCEL_G.T, *COUNTS.T]))
    assert np.array_equal(log.imus["/imu0"].t_ns, np.round(1e9 * T_S))


def test_imus_of_one_table_share_the_unit_that_one_shows(tmp_path):
    axes = [f"{side}_{sensor}_{axis}" for side in ("left", "Right") for sensor in ("gyr", "acc") for axis in "xyz"]
    shows, hides = COUNTS / 131, RNG.normal(0.0, 0.1, (COUNT, 3))
    path = write_csv(tmp_path / "two.csv", ["time [s]", *axes], [T_S, *shows.T, *ACCEL_G.T, *hides.T, *ACCEL_G.T])
    imus = read(path).imus
    np.testing.assert_allclose(imus["/right/imu"].gyro, np.deg2rad(hides))
    with pytest.raises(ConfigError, match="state no unit of the gyro"):
        read(write_csv(tmp_path / "one.csv", ["time [s]", *axes[6:]], [T_S, *hides.T, *ACCEL_G.T]))


def test_android_s_names_of_chips_say_whether_they_wake_the_phone(tmp_path):
    names = [f"icm4x6xx {sensor} Non-wakeup.{axis}" for sensor in ("Accelerometer", "Gyroscope") for axis in "xyz"]
    log = read(write_csv(tmp_path / "imu.csv", ["Timestamp", *names], [1.6e12 + 1e3 * T_S, *ACCEL_G.T, *(COUNTS / 131).T]))
    np.testing.assert_allclose(log.imus["/imu0"].gyro, np.deg2rad(COUNTS / 131), rtol=1e-5)


SAMPLES = {  # a line each, `{t}` the seconds
    "a serial monitor": (
        "15:04:{t:06.3f} -> Acceleration X: {a[0]}, Y: {a[1]}, Z: {a[2]} g",
        "15:04:{t:06.3f} -> Rotation X: {g[0]}, Y: {g[1]}, Z: {g[2]} rad/s",
        "15:04:{t:06.3f} -> Temperature: 28.50 degC",
        "15:04:{t:06.3f} -> ",
    ),
    "dashes": ("Time: {t:.3f} s", "Accel [g]: {a[0]} {a[1]} {a[2]}", "Gyro [rad/s]: {g[0]} {g[1]} {g[2]}", "-----"),
    "four numbers each": (
        "15:04:{t:06.3f} -> X-acceleration: {a[0]} g Y-acceleration: {a[1]} g Z-acceleration: {a[2]} g",
        "15:04:{t:06.3f} -> X-gyro: {g[0]} rad/s Y-gyro: {g[1]} rad/s Z-gyro: {g[2]} rad/s",
    ),
    "letters": (
        "15:04:{t:06.3f} -> G: {g[0]}, {g[1]}, {g[2]} rad/s",
        "15:04:{t:06.3f} -> A: {a[0]}, {a[1]}, {a[2]} g",
        "15:04:{t:06.3f} -> ",
    ),
    "brackets": (
        "15:04:{t:06.3f} -> Acc (g) [ {a[0]:08.4f}, {a[1]:08.4f}, {a[2]:08.4f} ], Gyr (rad/s) [ {g[0]}, {g[1]}, {g[2]} ]",
    ),
    "dates": (
        "2023-04-17 15:24:{t:06.3f}",
        "Acceleration (g): {a[0]}, {a[1]}, {a[2]}",
        "Rotation Rate (rad/s): {g[0]}, {g[1]}, {g[2]}",
    ),
}


@pytest.mark.parametrize("cut", [0, 1])
@pytest.mark.parametrize("name", SAMPLES)
def test_the_lines_of_a_sample_stand_below_one_another(tmp_path, name, cut):
    """A board printed them; the first sample may be cut where something shows where the next begins."""
    lines, cut = SAMPLES[name], 0 if name == "four numbers each" else cut
    gyro = 0.01 * COUNTS
    printed = [line.format(t=t, a=a, g=g) for t, a, g in zip(T_S, ACCEL_G, gyro, strict=True) for line in lines]
    (tmp_path / "log.txt").write_text("\n".join(printed[cut:]) + "\n")
    imu = read(tmp_path / "log.txt").imus["/imu0"]
    np.testing.assert_allclose(np.diff(imu.t_ns), 1e7)
    np.testing.assert_allclose(imu.gyro, gyro[cut:])
    np.testing.assert_allclose(imu.accel, 9.80665 * ACCEL_G[cut:])


def test_sensors_side_by_side_that_end_in_between_are_refused_without_a_warning(tmp_path):
    """An app joined sessions, in each of which the gyro ended first; NumPy warned of its missing times."""
    late = [f"{t:.0f}" if n % 100 < 90 else "" for n, t in enumerate(1e9 * T_S + 5e6)]
    rows = [
        ",".join(["15", f"{1e9 * t:.0f}", *map(str, a), end, *(map(str, 1e-3 * g) if end else [""] * 3)])
        for t, a, end, g in zip(T_S, 9.81 * ACCEL_G, late, COUNTS, strict=True)
    ]
    header = "Record Id,Acc Timestamp,AccX,AccY,AccZ,Gyro Timestamp,GyroX,GyroY,GyroZ"
    (tmp_path / "imu.csv").write_text("\n".join([header, *rows]) + "\n")
    with pytest.raises((ConfigError, DataError), match="Gyro Timestamp"):
        read(tmp_path / "imu.csv")
