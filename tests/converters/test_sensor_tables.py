"""Folders and zips with a table for each sensor: made-up ones in the layouts that the apps and data sets document."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read

RNG = np.random.default_rng(8)
COUNT = 400
T_NS = 1_600_000_000_000_000_000 + np.arange(COUNT) * 10_000_000
GYRO = RNG.normal(0, 0.003, (COUNT, 3))
MOTION = RNG.normal(0, 0.02, (COUNT, 3))
GRAVITY = np.tile([0.0, 0.0, 9.80665], (COUNT, 1))


def sensor_logger(values: np.ndarray) -> str:
    """Table of Sensor Logger: z before y before x."""
    rows = [
        f"{t},{(t - T_NS[0]) * 1e-9:.9f},{z!r},{y!r},{x!r}" for t, (x, y, z) in zip(T_NS.tolist(), values.tolist(), strict=True)
    ]
    return "\n".join(["time,seconds_elapsed,z,y,x", *rows]) + "\n"


def phyphox(values: np.ndarray, unit: str) -> str:
    """Table of phyphox: seconds since the start."""
    t = (T_NS - T_NS[0]) * 1e-9
    rows = [f"{s:.9E},{x!r},{y!r},{z!r}" for s, (x, y, z) in zip(t.tolist(), values.tolist(), strict=True)]
    return "\n".join([f'"Time (s)","X ({unit})","Y ({unit})","Z ({unit})"', *rows]) + "\n"


def pack(path: Path, files: dict[str, str]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    return path


METADATA = (
    "version,device name,recording epoch time,recording time,recording timezone,platform,standardisation\n3,x,1,a,b,{},false\n"
)
STATED = """"event","experiment time","system time","system time text"
"START",0.0,1600000000.000,"2020"
"PAUSE",4.0,1600000004.0,""
"""
PHONES = {
    "sensor logger, android": {
        "Gyroscope.csv": sensor_logger(GYRO),
        "Accelerometer.csv": sensor_logger(MOTION),
        "TotalAcceleration.csv": sensor_logger(GRAVITY + MOTION),
        "Magnetometer.csv": sensor_logger(np.full((COUNT, 3), 30.0)),
        "Metadata.csv": METADATA.format("android"),
    },
    "sensor logger, ios": {
        "Gyroscope.csv": sensor_logger(GYRO),
        "Accelerometer.csv": sensor_logger(-MOTION),
        "Gravity.csv": sensor_logger(-GRAVITY),
        "Metadata.csv": METADATA.format("ios"),
    },
    "sensor logger, ios, uncalibrated": {
        "GyroscopeUncalibrated.csv": sensor_logger(GYRO),
        "AccelerometerUncalibrated.csv": sensor_logger(-(GRAVITY + MOTION) / 9.80665),
        "Metadata.csv": METADATA.format("ios"),
    },
    "sensor logger, ios, without its metadata": {
        "Gyroscope.csv": sensor_logger(GYRO),
        "AccelerometerUncalibrated.csv": sensor_logger(-(GRAVITY + MOTION) / 9.80665),
    },
    "phyphox": {
        "Gyroscope.csv": phyphox(GYRO, "rad/s"),
        "Accelerometer.csv": phyphox(GRAVITY + MOTION, "m/s^2"),
        "meta/time.csv": STATED,
        "meta/device.csv": '"property","value"\n"deviceModel","Pixel"\n',
    },
}


@pytest.mark.parametrize("phone", PHONES)
def test_a_phones_zip_becomes_an_imu_in_si_units(convert, tmp_path, phone):
    done = convert(pack(tmp_path / "walk.zip", PHONES[phone]), tmp_path / "out.mcap")
    assert done.returncode == 0, done.stderr
    recording = read(tmp_path / "out.mcap")
    assert np.abs(recording.imu.t_ns - T_NS).max() <= 1
    np.testing.assert_allclose(recording.imu.gyro, GYRO, rtol=1e-12)
    np.testing.assert_allclose(recording.imu.accel, GRAVITY + MOTION, rtol=1e-9, atol=1e-12)
    assert ("sign was turned" in done.stderr) == ("ios" in phone)
    assert ("/Magnetometer/x" in recording.scalars) == ("android" in phone)


def test_a_phone_of_sensor_logger_that_nothing_names_is_asked_about(convert, tmp_path):
    phone = {name: text for name, text in PHONES["sensor logger, ios"].items() if name != "Metadata.csv"}
    done = convert(pack(tmp_path / "walk.zip", phone), tmp_path / "out.mcap")
    assert done.returncode == 0, done.stderr
    assert "counts as Android's, which reads +g upwards" in done.stderr
    stated = phone | {"Metadata.csv": "platform\nios\n"}
    done = convert(pack(tmp_path / "stated.zip", stated), tmp_path / "stated.mcap")
    assert "counts as Android's" not in done.stderr
    turned, asked = read(tmp_path / "stated.mcap").imu.accel, read(tmp_path / "out.mcap").imu.accel
    assert np.array_equal(turned, -asked)
    np.testing.assert_allclose(turned, GRAVITY + MOTION, rtol=1e-9, atol=1e-12)
    of_android = {name: text for name, text in PHONES["sensor logger, android"].items() if name != "Metadata.csv"}
    done = convert(pack(tmp_path / "android.zip", of_android), tmp_path / "android.mcap")
    assert "counts as Android's" not in done.stderr


def test_narrow_tables_are_kept_empty_ones_are_no_loss_and_texts_are_named(convert, tmp_path):
    more = {
        "Light.csv": "time,seconds_elapsed,lux\n1600000000100000000,0.1,120\n1600000000200000000,0.2,121\n",
        "Annotation.csv": "time,seconds_elapsed,text,millisecond_press_duration\n",
    }
    path = pack(tmp_path / "walk.zip", PHONES["sensor logger, android"] | more)
    done = convert(path, tmp_path / "out.mcap")
    assert done.returncode == 0, done.stderr
    assert read(tmp_path / "out.mcap").scalars["/Light/lux"].values[:, 0].tolist() == [120.0, 121.0]
    more["Annotation.csv"] += "1600000000100000000,0.1,start,20\n1600000000300000000,0.3,end,20\n"
    done = convert(pack(path, PHONES["sensor logger, android"] | more), tmp_path / "text.mcap")
    assert done.returncode == 3
    assert "Annotation.csv: text is left out: its fields, as 'start', are no numbers" in done.stderr


def test_an_unpacked_folder_reads_as_its_zip_and_other_zips_are_none(convert, tmp_path):
    folder = tmp_path / "walk"
    for name, text in PHONES["phyphox"].items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    assert convert(folder, tmp_path / "out.mcap").returncode == 0
    assert np.array_equal(read(tmp_path / "out.mcap").imu.gyro, GYRO)
    done = convert(pack(tmp_path / "other.zip", {"a.csv": "x,y\n1,2\n"}), tmp_path / "none.mcap")
    assert done.returncode == 4
    assert "no sequence found" in done.stderr


@pytest.mark.parametrize("strength", [1.0, 50.0, 150.0])
def test_motion_without_gravity_is_refused_and_says_what_to_record(convert, tmp_path, strength):
    files = {"Gyroscope.csv": sensor_logger(GYRO), "Accelerometer.csv": sensor_logger(strength * MOTION)}
    done = convert(pack(tmp_path / "walk.zip", files), tmp_path / "out.mcap")
    assert done.returncode == 4
    assert "gravity was taken out" in done.stderr
    assert "Record the acceleration with gravity" in done.stderr


@pytest.mark.parametrize("with_gravity", [True, False])
def test_the_linear_acceleration_of_phyphox_counts_with_gravity_alone(convert, tmp_path, with_gravity):
    files = {"Gyroscope.csv": phyphox(GYRO, "rad/s"), "Linear Accelerometer.csv": phyphox(MOTION, "m/s^2")}
    if with_gravity:
        files["Gravity.csv"] = phyphox(GRAVITY, "m/s^2")
    done = convert(pack(tmp_path / "walk.zip", files), tmp_path / "out.mcap")
    assert done.returncode == (0 if with_gravity else 4)
    assert ("Linear Accelerometer.csv has no gravity in it" in done.stderr) != with_gravity


def test_oxts_of_kitti_gives_the_imu_and_an_estimate(convert, imutool, tmp_path):
    drive = {}
    for n in range(50):
        row = [49.0 + n * 1e-6, 8.0, 110.0, 0.0, 0.0, np.pi / 2, *[0.0] * 24]
        row[11:14], row[17:20] = [0.1, 0.2, 9.81], [0.01, 0.02, 0.03]
        drive[f"2011_09_26/drive/oxts/data/{n:010d}.txt"] = " ".join(map(repr, map(float, row)))
    drive["2011_09_26/drive/oxts/timestamps.txt"] = "".join(f"2011-09-26 13:02:{n / 10:012.9f}\n" for n in range(50))
    done = convert(pack(tmp_path / "drive.zip", drive), tmp_path / "out.mcap")
    assert done.returncode == 0, done.stderr
    recording = read(tmp_path / "out.mcap", truth="/oxts/pose")
    assert recording.imu.t_ns[1] - recording.imu.t_ns[0] == 100_000_000
    assert recording.imu.gyro[3].tolist() == [0.01, 0.02, 0.03]
    assert recording.imu.accel[3].tolist() == [0.1, 0.2, 9.81]
    poses = recording.truths["/oxts/pose"]
    np.testing.assert_allclose(poses.p_wb[-1], [0.0, 49e-6 * np.pi / 180 * 6_378_137.0, 0.0], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(poses.q_wb_wxyz[0], [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], atol=1e-12)
    with Log(tmp_path / "out.mcap") as log:
        assert log.topics["/oxts/pose"].pose_kind == "estimate"
        assert not log.truth_topics
    report = json.loads(imutool("info", "out.mcap", "--json", "-", cwd=tmp_path).stdout)
    assert report["truth"][0]["kind"] == "estimate"


def test_a_second_recording_beside_the_first_does_not_take_its_place(convert, tmp_path):
    files = PHONES["phyphox"] | {"Gyroscope_2.csv": phyphox(2.0 * GYRO, "rad/s")}
    done = convert(pack(tmp_path / "two.zip", files), tmp_path / "out.mcap")
    assert done.returncode == 0
    assert "Gyroscope_2.csv of further gyroscopes or recordings become numbers and no IMU" in done.stderr
    assert np.array_equal(read(tmp_path / "out.mcap").imu.gyro, GYRO)


def test_each_folder_of_a_zip_is_a_recording(convert, tmp_path):
    files = {f"all/{place}/{name}": text for place in ("a/walk", "b/walk") for name, text in PHONES["phyphox"].items()}
    done = convert(pack(tmp_path / "all.zip", files | {"__MACOSX/all/a/walk/Gyroscope.csv": ""}), tmp_path / "out/")
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["all_a_walk.mcap", "all_b_walk.mcap"]
    assert np.array_equal(read(tmp_path / "out" / "all_b_walk.mcap").imu.gyro, GYRO)


def test_zips_and_folders_below_a_folder_of_a_recording_are_recordings_too(convert, tmp_path):
    source = tmp_path / "source"
    for place in (source, source / "still"):
        place.mkdir()
        for name, text in PHONES["sensor logger, android"].items():
            (place / name).write_text(text)
    pack(source / "run.zip", PHONES["phyphox"])
    (source / "broken.zip").write_bytes((source / "run.zip").read_bytes()[:200])
    done = convert(source, tmp_path / "out/")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["run.mcap", "source.mcap", "still.mcap"], done.stderr


def test_steps_as_strong_as_gravity_are_not_gravity(convert, tmp_path):
    steps = np.column_stack([np.zeros((COUNT, 2)), 10.0 * np.sign(np.sin(2 * np.pi * 2.5 * 0.01 * (np.arange(COUNT) + 0.5)))])
    jog = {"Gyroscope.csv": sensor_logger(GYRO), "Accelerometer.csv": sensor_logger(steps + MOTION)}
    done = convert(pack(tmp_path / "jog.zip", jog), tmp_path / "out.mcap")
    assert done.returncode == 4
    assert "in a second: gravity was taken out" in done.stderr
    upright = jog | {"Accelerometer.csv": sensor_logger(steps + GRAVITY + MOTION)}
    assert convert(pack(tmp_path / "up.zip", upright), tmp_path / "up.mcap").returncode == 0


def test_an_accelerometer_that_runs_much_longer_than_the_gyro_is_doubted(convert, tmp_path):
    first = phyphox(GYRO, "rad/s").splitlines(keepends=True)[: COUNT // 2]
    files = PHONES["phyphox"] | {"Gyroscope.csv": "".join(first)}
    done = convert(pack(tmp_path / "two.zip", files), tmp_path / "out.mcap")
    assert done.returncode == 0, done.stderr
    assert "before or after all of the gyro's are left out: are both of one recording?" in done.stderr
