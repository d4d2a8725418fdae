"""ArduPilot DataFlash logs, made up message by message."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from support.flight_logs import DataFlash, write_dataflash

from imutool.converters import dataflash
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read


def test_a_log_in_text_gives_the_same_messages(tmp_path):
    paths = write_dataflash(tmp_path / "1.BIN"), write_dataflash(tmp_path / "1.log", text=True)
    binary, text = (dataflash.read_sequence(dataflash.sequences(path)[0]) for path in paths)
    assert text.imus.keys() == binary.imus.keys()
    for topic, imu in binary.imus.items():
        assert np.array_equal(text.imus[topic].t_ns, imu.t_ns)
        np.testing.assert_allclose(text.imus[topic].gyro, imu.gyro, rtol=0, atol=0)
        np.testing.assert_allclose(text.imus[topic].accel, imu.accel, rtol=0, atol=0)
    assert np.array_equal(text.poses["/ekf/pose"].q_wb_wxyz, binary.poses["/ekf/pose"].q_wb_wxyz)
    assert {t: c.columns.tolist() for t, c in text.tables.items()} == {t: c.columns.tolist() for t, c in binary.tables.items()}
    assert (text.metadata["ardupilot/parameters"], text.remarks) == (binary.metadata["ardupilot/parameters"], binary.remarks)


def test_lines_of_a_text_log_that_are_no_message_are_counted(tmp_path):
    path = write_dataflash(tmp_path / "1.log", text=True)
    path.write_text(path.read_text() + "IMU, 12, 0, 0.1\nnoise\nGPS, 9000000, three, 47.3\n")
    log = dataflash.read_sequence(dataflash.sequences(path)[0])
    assert log.remarks.losses[0] == "2 lines of the log are no message that it describes"
    assert log.remarks.losses[1].startswith("1 messages GPS are left out: invalid literal")
    assert len(log.imus["/imu0"]) == 500


def test_a_text_log_that_contradicts_itself_loses_that_message_alone(tmp_path):
    path = write_dataflash(tmp_path / "1.log", text=True)
    whole = dataflash.read_sequence(dataflash.sequences(path)[0])
    path.write_text(
        path.read_text() + "FMT, 1a, none, ODD, Qc, TimeUS,V\nODD, 5, 1e30\nFMT, 9, 3, NAN, QC, TimeUS,V\nNAN, 5, nan\n"
    )
    damaged = dataflash.read_sequence(dataflash.sequences(path)[0])
    assert damaged.imus.keys() == whole.imus.keys()
    assert [loss for loss in damaged.remarks.losses if "ODD" in loss or "NAN" in loss] == [
        f"1 messages {name} are left out: a V is beyond what the binary log holds" for name in ("ODD", "NAN")
    ]


def test_a_number_that_cannot_be_read_costs_its_own_message_alone(tmp_path):
    path = write_dataflash(tmp_path / "1.log", text=True)
    lines = path.read_text().splitlines()
    at = [n for n, line in enumerate(lines) if line.startswith("IMU,")][500]
    lines[at] = lines[at].replace("0.2", "`0.2")
    path.write_text("\n".join(lines))
    log = dataflash.read_sequence(dataflash.sequences(path)[0])
    assert log.remarks.losses == ["1 messages IMU are left out: could not convert string to float: '`0.2'"]
    assert [len(imu) for imu in log.imus.values()] == [499, 500]


def test_a_loss_does_not_quote_a_damaged_line_in_full(tmp_path):
    path = write_dataflash(tmp_path / "1.log", text=True)
    path.write_text(path.read_text().replace(", 0.2", ", 0." + "x" * 10**5, 1))
    (loss,) = dataflash.read_sequence(dataflash.sequences(path)[0]).remarks.losses
    assert "left out: could not convert string to float: '0.xxx" in loss
    assert len(loss) == 200


def test_names_that_differ_by_capitals_and_formats_of_one_name_are_kept_apart(convert, tmp_path):
    """As scripts log them; `g` is a float of two bytes."""
    formats = {201: (b"LUA", b"Qgg", b"TimeUS,Roll,roll"), 202: (b"LUA", b"QB", b"TimeUS,State")}
    raw = b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", 128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
    for number, (name, letters, labels) in formats.items():
        size = 3 + struct.calcsize("<" + letters.decode().replace("g", "e"))
        raw += b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", number, size, name, letters, labels)
    for n in range(5):
        raw += b"\xa3\x95\xc9" + struct.pack("<Qee", 1000 * n, 0.5, n) + b"\xa3\x95\xca" + struct.pack("<QB", 1000 * n, n)
    (tmp_path / "1.bin").write_bytes(raw)
    done = convert(tmp_path / "1.bin", tmp_path / "out.mcap")
    assert "Traceback" not in done.stderr
    found = dict[str, list[Any]]()
    with (tmp_path / "out.mcap").open("rb") as file:
        for _, channel, _, message in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            values = (message.roll, message.roll_2) if channel.topic == "/LUA" else message.state
            found.setdefault(channel.topic, []).append(values)
    assert found == {"/LUA": [(0.5, n) for n in range(5)], "/LUA_202": [*range(5)]}


def test_an_imu_of_other_fields_is_named_as_lost(tmp_path):
    path = tmp_path / "1.log"
    path.write_text("FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\nFMT, 9, 12, IMU, QB, TimeUS,I\nIMU, 100, 1\n")
    log = dataflash.read_sequence(dataflash.sequences(path)[0])
    assert log.imus == {}
    assert any("/imu1 lacks numbers of GyrX" in loss for loss in log.remarks.losses)


@pytest.mark.parametrize("older", [False, True])
def test_raw_samples_become_an_imu_at_the_times_when_they_were_taken(tmp_path, older):
    """GYR and ACC are what a log holds of each sample on request; of logs before 2020 each sensor has its own message."""
    lines = ["FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns"]
    for kind, sensor in ((9, "GYR"), (10, "ACC")):
        name, axes = sensor + ("2" if older else ""), ",".join(f"{sensor.capitalize()}{axis}" for axis in "XYZ")
        form, which, instance = ("QQfff", "", "") if older else ("QBQfff", "I,", "1, ")
        lines.append(f"FMT, {kind}, 40, {name}, {form}, TimeUS,{which}SampleUS,{axes}")
        lines += [f"{name}, {5000 + 1000 * n}, {instance}{4000 + 1000 * n}, {0.1 * n}, 0.2, -9.5" for n in range(50)]
    (tmp_path / "1.log").write_text("\n".join(lines) + "\n")
    log = dataflash.read_sequence(dataflash.sequences(tmp_path / "1.log")[0])
    imu = log.imus["/imu1/raw"]
    assert (list(log.imus), log.remarks.losses) == (["/imu1/raw"], [])
    assert imu.t_ns.tolist() == [(4000 + 1000 * n) * 1000 for n in range(50)]
    for values in (imu.gyro, imu.accel):  # FRD becomes FLU
        np.testing.assert_allclose(values, np.array([[0.1 * n, -0.2, 9.5] for n in range(50)]), rtol=1e-6)


def test_imus_poses_and_every_message_arrive(convert, imutool, tmp_path):
    done = convert(write_dataflash(tmp_path / "00000042.BIN"), tmp_path / "out.mcap")
    assert done.returncode == 0, done.stderr
    with Log(tmp_path / "out.mcap") as log:
        assert log.imu_topics == ["/imu0", "/imu1"]
        assert {t.name: t.count for t in log.topics.values()} | {"/IMU": 1000, "/GPS": 1, "/XKF1": 500} == {
            t.name: t.count for t in log.topics.values()
        }
    recording = read(tmp_path / "out.mcap", imu="/imu1", truth="/ekf/pose")
    np.testing.assert_allclose(recording.imu.gyro[3], [0.1, -0.2, -0.3], rtol=1e-6)
    np.testing.assert_allclose(recording.imu.accel[3], [1.0, -2.0, 9.75], rtol=1e-6)
    assert recording.imu.t_ns[0] == 7_000_001_000
    np.testing.assert_allclose(recording.truth.p_wb[0], [2.0, 1.0, 3.0])
    np.testing.assert_allclose(np.abs(recording.truth.q_wb_wxyz[0]), [np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)], atol=1e-6)
    assert read(tmp_path / "out.mcap", imu="/imu0").other_poses == {"/ekf/pose": "estimate"}
    with (tmp_path / "out.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        (gps,) = [content for _, c, _, content in reader.iter_decoded_messages() if c.topic == "/GPS"]
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    assert (gps.status, gps.lat) == (3, 473_977_418)
    assert metadata["ardupilot/parameters"] == {"INS_GYRO_RATE": "2.0"}
    assert metadata["ardupilot/messages"] == {"2 us": "ArduCopter V4.5"}
    assert imutool("info", "out.mcap", cwd=tmp_path).returncode == 0


def test_damage_is_passed_over_and_counted(convert, tmp_path):
    log = write_dataflash(tmp_path / "a.bin")
    raw = log.read_bytes()
    log.write_bytes(raw[:20_000] + bytes(33) + raw[20_000:-5])
    done = convert(log, tmp_path / "out.mcap")
    assert done.returncode == 3
    assert "are no message that it describes" in done.stderr
    assert len(read(tmp_path / "out.mcap", imu="/imu0").imu) >= 498


def write_older_log(path: Path, text: bool = False) -> Path:
    """Log as ArduPilot wrote it before 2015: times in ms, several messages without one, and a GPS with a time of the week."""
    log = DataFlash()
    log.form(1, "IMU", "Iffffff", "TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ")
    log.form(2, "IMU2", "Iffffff", "TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ")
    log.form(3, "EKF1", "IccCffffff", "TimeMS,Roll,Pitch,Yaw,VN,VE,VD,PN,PE,PD")
    log.form(4, "GPS", "BIHLI", "Status,TimeMS,Week,Lat,T")
    log.form(5, "PARM", "Nf", "Name,Value")
    log.form(6, "MSG", "Z", "Message")
    log.form(7, "STRT", "", "")
    log.add("STRT")
    log.add("PARM", b"INS_MPU6K_FILTER", 20.0)
    for n in range(500):
        t_ms = 7_000 + 20 * n
        log.add("IMU", t_ms, 0.1, 0.2, 0.3, 1.0, 2.0, -9.75)
        log.add("IMU2", t_ms, 0.1, 0.2, 0.3, 1.0, 2.0, -9.5)
        log.add("EKF1", t_ms, 0, 0, 4500, 0.5, 0.25, -0.125, 1.0, 2.0, -3.0)
        if n == 250:
            log.add("GPS", 3, 500_000_000, 1813, 473_977_418, t_ms)
            log.add("MSG", b"Takeoff")
            log.add("MSG", b"Mode Auto")
    path.write_text("\n".join([*log.lines, ""])) if text else path.write_bytes(log.raw)
    return path


@pytest.mark.parametrize("text", [False, True])
def test_a_log_of_before_2015_is_read_with_its_times_in_milliseconds(convert, tmp_path, text):
    path = write_older_log(tmp_path / "old.log", text)
    done = convert(path, tmp_path / "out.mcap")
    assert done.returncode == 0, done.stderr
    assert "messages without a time have that of the message before them: MSG, PARM, STRT" in done.stderr
    recording = read(tmp_path / "out.mcap", imu="/imu1", truth="/ekf/pose")
    assert recording.imu.t_ns[[0, 1]].tolist() == [7_000_000_000, 7_020_000_000]
    np.testing.assert_allclose(recording.imu.accel[0], [1.0, -2.0, 9.5])
    np.testing.assert_allclose(recording.truth.p_wb[0], [2.0, 1.0, 3.0])
    log = dataflash.read_sequence(dataflash.sequences(path)[0])
    assert log.tables["/GPS"].t_ns.tolist() == [12_000_000_000]
    assert log.tables["/PARM"].t_ns.tolist() == [7_000_000_000]
    assert log.metadata["ardupilot/messages"] == {"12000000 us": "Takeoff", "12000000 us, 2": "Mode Auto"}
    assert log.metadata["ardupilot/parameters"] == {"INS_MPU6K_FILTER": "20.0"}


def test_a_log_that_ends_within_a_message_says_so(tmp_path):
    path = write_older_log(tmp_path / "cut.bin")
    path.write_bytes(path.read_bytes()[:-10])
    log = dataflash.read_sequence(dataflash.sequences(path)[0])
    assert log.remarks.losses == ["the log ends within a message EKF1: what came after is lost"]
    assert len(log.poses["/ekf/pose"]) == 499


def test_what_a_log_with_texts_alone_on_a_topic_loses_to_a_cut_is_its_end(convert, imutool, tmp_path):
    convert(write_older_log(tmp_path / "old.bin"), tmp_path / "out.mcap")
    raw = (tmp_path / "out.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(raw[: raw.rindex(b"/MSG")])  # in the summary
    done = imutool("repair", "cut.mcap", "saved.mcap", cwd=tmp_path)
    assert "500 on /imu0" in done.stdout, done.stderr
    with (tmp_path / "out.mcap").open("rb") as file:
        assert {m.data for _, c, m in make_reader(file).iter_messages() if c.topic in ("/MSG", "/STRT")} == {b"\0\1\0\0\0"}


@pytest.mark.parametrize(("name", "older"), [("T", False), ("Temp", True)])
def test_the_temperature_of_each_imu_is_a_topic(convert, tmp_path, name, older):
    log = DataFlash()
    names = ("IMU", "IMU2") if older else ("IMU", "IMU")
    for kind, each in enumerate(dict.fromkeys(names)):
        which = ("Q", "TimeUS,") if older else ("QB", "TimeUS,I,")
        log.form(1 + kind, each, f"{which[0]}fffffff", f"{which[1]}GyrX,GyrY,GyrZ,AccX,AccY,AccZ,{name}")
    for n in range(500):
        for instance, each in enumerate(names):
            own = () if older else (instance,)
            log.add(each, 7_000_000 + 5000 * n, *own, 0.1, 0.2, 0.3, 1.0, 2.0, -9.75, (41.0 + 0.01 * n) * (1 - instance))
    (tmp_path / "1.BIN").write_bytes(log.raw)
    assert convert(tmp_path / "1.BIN", tmp_path / "out.mcap").returncode == 0
    with Log(tmp_path / "out.mcap") as opened:
        assert opened.imu_topics == ["/imu0", "/imu1"]
        assert "/imu1/temperature" not in opened.topics  # it writes zeros
    found = read(tmp_path / "out.mcap", imu="/imu0").scalars["/imu0/temperature"]
    assert (found.unit, len(found.t_ns), found.t_ns[0]) == ("degC", 500, 7_000_000_000)
    np.testing.assert_allclose(found.values[:, 0], 41.0 + 0.01 * np.arange(500), rtol=1e-6)


@pytest.mark.parametrize("text", [True, False])
def test_the_truth_of_a_simulated_flight_becomes_true_poses(tmp_path, text):
    """Message SIM of ArduPilot's simulator: a copter that looks to the east, and goes a hundredth of a minute north and up."""
    log = DataFlash()
    log.form(9, "SIM", "QccCfLLffff", "TimeUS,Roll,Pitch,Yaw,Alt,Lat,Lng,Q1,Q2,Q3,Q4")
    for n in range(3):
        log.add(
            "SIM",
            1000 * n,
            0,
            0,
            9000,
            584.0 + n,
            -353_632_621 + 1667 * n,
            1_491_652_374 - 1000 * n,
            0.5**0.5,
            0.0,
            0.0,
            0.5**0.5,
        )
    path = tmp_path / ("1.log" if text else "1.bin")
    path.write_text("\n".join([*log.lines, ""])) if text else path.write_bytes(log.raw)
    flight = dataflash.read_sequence(dataflash.sequences(path)[0])
    assert flight.kinds == {"/ground_truth/pose": "truth"}
    poses = flight.poses["/ground_truth/pose"]
    assert poses.t_ns.tolist() == [0, 1_000_000, 2_000_000]
    np.testing.assert_allclose(np.abs(poses.q_wb_wxyz), [[1.0, 0.0, 0.0, 0.0]] * 3, atol=1e-7)  # -q is q
    np.testing.assert_allclose(poses.p_wb[2], [-18.18, 37.0, 2.0], atol=0.02)  # a degree: 90.9 km to the east, 110.96 km north
