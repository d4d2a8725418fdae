"""Text whose rows name their sensor, in the layouts of phones' loggers: made-up values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from imutool.converters import table
from imutool.errors import ConfigError
from imutool.recording.message_log import MessageLog

COUNT = 60
START_MS, LATE_NS = 1_600_000_000_000, 2_000_000
GYRO = np.random.default_rng(13).normal(0.0, 0.1, (COUNT, 3))
ACCEL = np.tile([0.1, 0.2, 9.8], (COUNT, 1))
ANDROID = ["#\tstartTime:1600000000000", f"{START_MS}\tTYPE_WIFI\thome\t-50"]
GETSENSORDATA = [
    "% LogFile Data format:",
    "% Accelerometer data: \t'ACCE;AppTimestamp(s);SensorTimestamp(s);Acc_X(m/s^2);Acc_Y(m/s^2);Acc_Z(m/s^2)'",
    "% Gyroscope data: \t'GYRO;AppTimestamp(s);SensorTimestamp(s);Gyr_X(rad/s);Gyr_Y(rad/s);Gyr_Z(rad/s)'",
]
GNSSLOGGER = [
    "# UncalAccel,utcTimeMillis,elapsedRealtimeNanos,UncalAccelXMps2,UncalAccelYMps2,UncalAccelZMps2,BiasX,BiasY,BiasZ",
    "# UncalGyro,utcTimeMillis,elapsedRealtimeNanos,"
    "UncalGyroXRadPerSec,UncalGyroYRadPerSec,UncalGyroZRadPerSec,DriftXRadPerSec,DriftYRadPerSec,DriftZRadPerSec",
]
NAMED = ["ms,sensor,x,y,z"]


def row(mark: str, *fields: object) -> str:
    return mark.join(map(str, fields))


for number, (gyro, accel) in enumerate(zip(GYRO.tolist(), ACCEL.tolist(), strict=True)):
    ms, late = START_MS + 10 * number, 0.001 * (number % 3)
    ANDROID += [row("\t", ms, "TYPE_GYROSCOPE", *gyro, 3), row("\t", ms + 2, "TYPE_ACCELEROMETER", *accel, 3)]
    ANDROID += [
        row("\t", ms, "TYPE_GYROSCOPE_UNCALIBRATED", *accel, 0, 0, 0, 3),
        row("\t", ms, "TYPE_LINEAR_ACCELERATION", *gyro, 3),
    ]
    GETSENSORDATA += [f"GYRO;{number / 100 + late:.3f};{number / 100 + 5e4:.6f};{row(';', *gyro)}"]
    GETSENSORDATA += [f"ACCE;{number / 100 + late:.3f};{number / 100 + 5e4 + 0.002:.6f};{row(';', *accel)}"]
    GNSSLOGGER += [row(",", "UncalGyro", ms, 10**13 + number * 10**7, *gyro, 0.0, 0.0, 0.0)]
    GNSSLOGGER += [row(",", "UncalAccel", ms, 10**13 + number * 10**7 + LATE_NS, *accel, 0.0, 0.0, 0.0), "Raw,1,2,3,4"]
    NAMED += [row(",", ms, "gyro [rad/s]", *gyro), row(",", ms + 2, "accel [m/s^2]", *accel)]


def read(path: Path, lines: list[str]) -> MessageLog:
    path.write_text("\n".join(lines) + "\n")
    return table.read_sequence(table.sequences(path)[0])


@pytest.mark.parametrize(
    "lines",
    [ANDROID, [line.replace("\t", " ") for line in ANDROID], GETSENSORDATA, GNSSLOGGER, NAMED],
    ids=["android", "spaces", "getsensordata", "gnsslogger", "named"],
)
def test_rows_that_name_their_sensor_become_one_imu(tmp_path, lines):
    log = read(tmp_path / "walk.txt", lines)
    imu = log.imus["/imu0"]
    assert np.array_equal(np.diff(imu.t_ns), np.full(COUNT - 2, 10_000_000))  # the first has no accelerometer sample before it
    assert np.array_equal(imu.gyro, GYRO[1:])
    np.testing.assert_allclose(imu.accel, ACCEL[1:], rtol=1e-12)
    assert any("became one IMU" in note for note in log.remarks.notes)


def test_a_table_with_words_in_it_is_read_as_one(tmp_path):
    lines = ["t,gyro_x [rad/s],gyro_y [rad/s],gyro_z [rad/s],ax [m/s^2],ay [m/s^2],az [m/s^2],state"]
    lines += [
        row(",", n / 100, *gyro, *accel, "gyro" if n % 2 else "accel")
        for n, (gyro, accel) in enumerate(zip(GYRO, ACCEL, strict=True))
    ]
    assert np.array_equal(read(tmp_path / "log.csv", lines).imus["/imu0"].gyro, GYRO)


def test_rows_of_several_devices_are_several_imus(tmp_path):
    """As one IMU, samples of two bodies would take turns."""
    lines = ["time [ms],device,gx [deg/s],gy [deg/s],gz [deg/s],ax [g],ay [g],az [g]"]
    for number, (gyro, accel) in enumerate(zip(GYRO.tolist(), ACCEL.tolist(), strict=True)):
        lines += [row(",", 10 * number + late, device, *gyro, *accel) for device, late in (("left_foot", 0), ("right_foot", 3))]
    imus = read(tmp_path / "two.csv", lines).imus
    assert {topic: len(imu) for topic, imu in imus.items()} == {"/left_foot/imu": COUNT, "/right_foot/imu": COUNT}
    assert imus["/right_foot/imu"].t_ns[0] == 3_000_000
    last = [",".join([first, *rest, device]) for first, device, *rest in (line.split(",") for line in lines)]
    assert read(tmp_path / "last.csv", last).imus.keys() == imus.keys()
    numbered = [line.replace("left_foot", "1").replace("right_foot", "2") for line in lines]
    assert [len(imu) for imu in read(tmp_path / "two.csv", numbered).imus.values()] == [COUNT, COUNT]


def test_rows_of_several_kinds_do_not_hide_one_another(tmp_path):
    """Those of the IMU have fewer fields than those of what the robot sees."""
    lines = []
    for number, (gyro, accel) in enumerate(zip(GYRO.tolist(), ACCEL.tolist(), strict=True)):
        lines += [row(" ", "IMU", f"{0.01 * number:.6f}", *gyro, *accel), row(" ", "LANDMARK", 0.01 * number, *range(12))]
    (tmp_path / "log.txt").write_text("\n".join(lines) + "\n")
    with pytest.raises(ConfigError, match="no unit of the gyro") as refused:
        table.read_sequence(table.sequences(tmp_path / "log.txt")[0])
    (tmp_path / "map.toml").write_text(refused.value.fix.split("\n\n", 1)[1].replace('gyro_unit = "?"', 'gyro_unit = "rad/s"'))
    (sequence,) = table.sequences(tmp_path / "log.txt")
    imu = table.read_sequence(sequence, mapping=tmp_path / "map.toml").imus["/imu0"]
    np.testing.assert_allclose(np.hstack([imu.gyro, imu.accel]), np.hstack([GYRO, ACCEL]))


def test_rows_of_several_kinds_that_a_spreadsheet_made_equally_long_are_told_apart(tmp_path):
    """Quaternions of a sensor next to its readings, with the commas that a spreadsheet adds."""
    lines = []
    for number, (gyro, accel) in enumerate(zip(GYRO.tolist(), ACCEL.tolist(), strict=True)):
        lines += [row(",", 10 * number, 2, *accel, *gyro), row(",", 10 * number, 3, 1.0, 0.0, 0.0, 0.0, "", "")]
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    mapping = {"gyro_unit": "rad/s", "time_unit": "ms"}
    imu = table.read_sequence(table.sequences(tmp_path / "log.csv")[0], mapping=mapping).imus["/imu0"]
    np.testing.assert_allclose(np.hstack([imu.gyro, imu.accel]), np.hstack([GYRO, ACCEL]))
    assert np.array_equal(imu.t_ns, 10_000_000 * np.arange(COUNT))


@pytest.mark.parametrize("flags", ["VX", ("true", "false"), ("walk", "run")])
def test_states_and_labels_of_one_device_make_no_kinds_of_rows(tmp_path, flags):
    lines = ["time [ms],state,gx [deg/s],gy [deg/s],gz [deg/s],ax [g],ay [g],az [g]"]
    for number, (gyro, accel) in enumerate(zip(GYRO.tolist(), ACCEL.tolist(), strict=True)):
        state = flags[number // 20 % 2 if "run" in flags else number % 2]
        lines.append(row(",", 10 * number, state, *gyro, *accel))
    assert [len(imu) for imu in read(tmp_path / "one.csv", lines).imus.values()] == [COUNT]


@pytest.mark.parametrize(
    "further",
    [{}, {"time_unit": "ms"}, {"rate_hz": 100.0}, {"gyro_scale": 0.5}],
    ids=["units", "time_unit", "rate_hz", "scale"],
)
def test_stated_units_hold_for_each_of_several_imus(tmp_path, further):
    """Both units without that of the time ended in KeyError: ''."""
    axes = [f"{side}_{sensor}_{axis}" for side in ("left", "right") for sensor in ("gyro", "acc") for axis in "xyz"]
    rows = [row(",", 10 * n, *gyro, *accel, *gyro, *accel) for n, (gyro, accel) in enumerate(zip(GYRO, ACCEL, strict=True))]
    (tmp_path / "two.csv").write_text("\n".join([row(",", "time_ms", *axes), *rows]) + "\n")
    mapping = {"gyro_unit": "deg/s", "accel_unit": "g", **further}
    imus = table.read_sequence(table.sequences(tmp_path / "two.csv")[0], mapping=mapping).imus
    assert [*imus] == ["/left/imu", "/right/imu"]
    for imu in imus.values():
        np.testing.assert_allclose(imu.gyro, np.deg2rad(GYRO) * further.get("gyro_scale", 1.0))
        np.testing.assert_allclose(imu.accel, 9.80665 * ACCEL)
        assert np.array_equal(imu.t_ns, 10_000_000 * np.arange(COUNT))
