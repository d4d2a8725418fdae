"""PX4 ULogs, made up byte by byte and the public samples: frames, kinds, instances, every topic."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from scipy.spatial.transform import Rotation
from support.flight_logs import ATTITUDE, COMBINED, SENSOR, START_US, Ulog, ulog_flight

from imutool.converters import ulog
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read


@pytest.fixture
def log(convert, tmp_path):
    done = convert(ulog_flight().write(tmp_path / "flight.ulg"), tmp_path / "out.mcap")
    assert done.returncode == 0, done.stderr
    return tmp_path / "out.mcap"


def test_imu_and_truth_are_written_in_flu_and_enu(log):
    recording = read(log, imu="/imu")
    assert recording.imu.t_ns[0] == START_US * 1000
    np.testing.assert_allclose(recording.imu.gyro[7], [0.1, -0.2, -0.3], rtol=1e-6)
    np.testing.assert_allclose(recording.imu.accel[7], [1.0, -2.0, 9.75], rtol=1e-6)
    assert list(recording.truths) == ["/ground_truth/pose"]
    assert recording.other_poses == {"/ekf/pose": "estimate"}
    np.testing.assert_allclose(recording.truth.p_wb[3], [2.0, 1.0, 3.0])
    np.testing.assert_allclose(recording.truth.v_w[3], [0.25, 0.5, 0.125])
    half = np.pi / 8  # the nose, to the north-east, is 45 degrees from east
    np.testing.assert_allclose(np.abs(recording.truth.q_wb_wxyz[3]), [np.cos(half), 0, 0, np.sin(half)], atol=1e-7)


def test_truth_whose_sample_time_is_not_set_keeps_the_times_of_its_messages(convert, tmp_path):
    writer, fields = Ulog(), "uint64_t timestamp;uint64_t timestamp_sample;"
    times = [START_US + 4000 * n for n in range(250)]
    writer.topic("sensor_combined", COMBINED, [(t, 0.1, 0.2, 0.3, 4000, 0, 1.0, 2.0, -9.75, 4000) for t in times])
    attitude, position = fields + "float[4] q", fields + "float x;float y;float z"
    writer.topic("vehicle_attitude_groundtruth", attitude, [(t, 0, 1.0, 0.0, 0.0, 0.0) for t in times[::2]])
    writer.topic("vehicle_local_position_groundtruth", position, [(t, 0, 1.0, 2.0, -3.0) for t in times[::5]])
    done = convert(writer.write(tmp_path / "sim.ulg"), tmp_path / "out.mcap")
    assert done.returncode == 0, done.stderr
    assert "left out" not in done.stderr
    truth = read(tmp_path / "out.mcap").truth
    assert truth.t_ns[[0, 1]].tolist() == [1000 * times[0], 1000 * times[2]]
    np.testing.assert_allclose(truth.p_wb[0], [2.0, 1.0, 3.0])


def test_every_instance_is_an_imu_on_the_gyros_stamps(log):
    with Log(log) as opened:
        assert opened.imu_topics == ["/imu", "/imu/sensor0", "/imu/sensor1"]
    second = read(log, imu="/imu/sensor1").imu
    np.testing.assert_allclose(second.gyro[5], [1.0, -1.0, -2.0])
    assert second.t_ns[0] == (START_US + 4000) * 1000  # the first gyro sample has no accelerometer sample ahead of it


def test_a_gyro_of_several_pairs_with_the_only_accelerometer(tmp_path):
    writer = Ulog()
    for sensor, instances in (("sensor_gyro", (0, 1)), ("sensor_accel", (0,))):
        for instance in instances:
            rows = [(t, t, 1.0 + instance, 0.0, -9.75, 25.0) for t in range(5_000_000, 6_000_000, 4000)]
            writer.topic(sensor, SENSOR, rows, instance)
    (sequence,) = ulog.sequences(writer.write(tmp_path / "log.ulg"))
    (imu,) = ulog.read_sequence(sequence).imus.values()
    assert np.array_equal(imu.gyro[:, 0], np.ones(250))


def test_an_attitude_of_zeros_costs_its_own_pose_alone(tmp_path):
    """As PX4 has it before the estimator or the simulator set one."""
    writer, times = Ulog(), range(5_000_000, 6_000_000, 4000)
    writer.topic("vehicle_attitude", ATTITUDE, [(t, float(t > 5_000_000), 0.0, 0.0, 0.0) for t in times])
    (sequence,) = ulog.sequences(writer.write(tmp_path / "log.ulg"))
    log = ulog.read_sequence(sequence)
    assert len(log.poses["/ekf/pose"].t_ns) == 249
    assert any("1 samples that are not finite are left out" in note for note in log.remarks.notes)


def test_every_topic_parameter_and_text_arrives(log):
    with log.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        found: dict[str, list[Any]] = {}
        for _, channel, message, content in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append(content)
            assert message.log_time >= START_US * 1000  # PX4 gave one message the stamp 0
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    assert found["/sensor_combined"][9].accelerometer_m_s2 == [1.0, 2.0, -9.75]  # PX4's own frame
    assert [len(found[f"/sensor_gyro/{n}"]) for n in (0, 1)] == [250, 250]
    assert found["/sensor_accel/1"][0].temperature == 26.0
    assert [(m.timestamp, m.changes) for m in found["/parameter_update"]] == [(0, 7)]
    (line,) = found["/logged_messages"]
    assert (line.msg, line.level, line.stamp.sec) == ("Takeoff detected", 30, 5)
    assert metadata["px4/parameters"] == {"IMU_GYRO_CUTOFF": "40.0"}
    assert list(metadata["px4/dropouts"].values()) == ["12 ms"]
    assert "sensor" not in metadata["imutool"]


def test_the_samples_of_a_fifo_are_spread_over_its_time(convert, tmp_path):
    fifo = "uint64_t timestamp;uint64_t timestamp_sample;float dt;float scale;uint8_t samples;float[4] x;float[4] y;float[4] z"
    writer = Ulog()
    for sensor in ("sensor_gyro_fifo", "sensor_accel_fifo"):
        rows = [
            (t, t, 1000.0, 0.5, 3, *(4.0 * n + i for i in range(4)), *[1.0] * 8)
            for n in range(100)
            for t in (5_000_000 + 3000 * n,)
        ]
        writer.topic(sensor, fifo, rows)
    assert convert(writer.write(tmp_path / "a.ulg"), tmp_path / "a.mcap").returncode == 0
    imu = read(tmp_path / "a.mcap").imu
    assert len(imu) == 300
    assert set(np.diff(imu.t_ns).tolist()) == {1_000_000}
    assert imu.gyro[:4, 0].tolist() == [0.0, 0.5, 1.0, 2.0]


@pytest.mark.parametrize(
    ("raw", "said"), [(b"ULogEnc" + bytes(90), "is encrypted"), (b"ULog\x01\x12\x35\x01", "cannot be read")]
)
def test_what_cannot_be_read_is_refused_in_one_sentence(convert, tmp_path, raw, said):
    (tmp_path / "a.ulg").write_bytes(raw)
    done = convert(tmp_path / "a.ulg", tmp_path / "a.mcap")
    assert done.returncode == 4
    assert said in done.stderr
    assert "Traceback" not in done.stderr


def test_a_log_that_pyulog_would_read_for_ever_is_refused(convert, tmp_path):
    (tmp_path / "a.ulg").write_bytes(ulog_flight().write(tmp_path / "b.ulg").read_bytes().replace(b"float vz;", b"floavz;", 1))
    done = convert(tmp_path / "a.ulg", tmp_path / "a.mcap")
    assert done.returncode == 4
    assert "cannot be read as a ULog (it begins again and again)" in done.stderr
    assert done.stdout == ""


def test_fields_and_times_that_cannot_be_are_told_and_the_rest_is_converted(convert, tmp_path):
    log = ulog_flight()
    log.log("from the end of time", 2**31 * 1_000_000)
    log.topic("damaged", "uint64_t timestamp;float **;float Load;float load", [(7_000_000, 1.0, 2.0, 3.0)])
    (tmp_path / "a.ulg").write_bytes(
        log.write(tmp_path / "b.ulg").read_bytes().replace(b"float[3] gyro_rad", b"float[3] gyro_bad")
    )
    done = convert(tmp_path / "a.ulg", tmp_path / "a.mcap")
    assert done.returncode == 3
    assert "/imu is left out: its topic has no field gyro_rad[0]" in done.stderr
    assert "texts with an impossible time: 1" in done.stderr
    assert len(read(tmp_path / "a.mcap", imu="/imu/sensor0").imu) > 200


def test_a_file_that_ends_within_a_message_is_told(convert, tmp_path):
    whole = ulog_flight().write(tmp_path / "a.ulg").read_bytes()
    (tmp_path / "a.ulg").write_bytes(whole[:-300])
    done = convert(tmp_path / "a.ulg", tmp_path / "a.mcap")
    assert done.returncode == 3
    assert "ends within a message" in done.stderr
    assert len(read(tmp_path / "a.mcap", imu="/imu").imu.t_ns) == 250  # what is there comes in


@pytest.mark.parametrize("fields", ["x y z vx vy vz", "x y z", "x y z vx vz", "x y"])
def test_two_instances_and_simulated_truth_hold_what_pyulog_reads(convert, tmp_path, fields):
    """Each IMU in FLU, the truth in ENU, whatever columns the position has."""
    from pyulog import ULog

    rng = np.random.default_rng(3)
    times = [START_US + 4000 * n for n in range(500)]
    writer, position = Ulog(), "vehicle_local_position_groundtruth"
    for instance in (0, 1):
        for sensor in ("sensor_gyro", "sensor_accel"):
            writer.topic(sensor, SENSOR, [(t, t, *rng.normal(size=3), 25.0) for t in times], instance)
    q = rng.normal(size=(len(times), 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    writer.topic("vehicle_attitude_groundtruth", ATTITUDE, [(t, *row) for t, row in zip(times, q, strict=True)])
    names = fields.split()
    moves = [(t, *rng.normal(size=len(names))) for t in times]
    writer.topic(position, "uint64_t timestamp;" + ";".join(f"float {name}" for name in names), moves)
    path = writer.write(tmp_path / "sitl.ulg")
    done = convert(path, tmp_path / "a.mcap")
    assert done.returncode == 0, done.stderr
    theirs = ULog(str(path))
    for instance in (0, 1):
        imu = read(tmp_path / "a.mcap", imu=f"/imu/sensor{instance}").imu
        for values, sensor in ((imu.gyro, "sensor_gyro"), (imu.accel, "sensor_accel")):
            sample = theirs.get_dataset(sensor, instance).data
            assert np.array_equal(imu.t_ns, 1000 * sample["timestamp_sample"].astype(np.int64))
            assert np.array_equal(values, np.stack([sample["x"], -sample["y"], -sample["z"]], axis=1).astype(float))
    truth = read(tmp_path / "a.mcap", imu="/imu/sensor0").truth
    sample, moved = (theirs.get_dataset(name).data for name in ("vehicle_attitude_groundtruth", position))
    assert np.array_equal(truth.t_ns, 1000 * sample["timestamp"].astype(np.int64))
    R_ned_frd = Rotation.from_quat(np.stack([sample[f"q[{n}]"] for n in (1, 2, 3, 0)], axis=1))
    R_enu_ned, R_frd_flu = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.diag([1, -1, -1])
    R_wb = Rotation.from_quat(truth.q_wb_wxyz[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(R_wb, R_enu_ned @ R_ned_frd.as_matrix() @ R_frd_flu, atol=1e-6)
    position_known, velocity_known = {*"xyz"} <= {*names}, {"vx", "vy", "vz"} <= {*names}
    p_wb = np.stack([moved["y"], moved["x"], -moved["z"]], axis=1) if position_known else np.zeros((len(times), 3))
    assert np.array_equal(truth.p_wb, p_wb)
    assert ("has no positions" in done.stderr) != position_known
    if velocity_known:
        assert np.array_equal(truth.v_w, np.stack([moved["vy"], moved["vx"], -moved["vz"]], axis=1))
    else:
        assert truth.v_w is None


@pytest.mark.parametrize("sample", ["sample_log_small", "sample_px4_events"])
def test_the_public_samples_hold_the_values_that_pyulog_reads(tmp_path, data, sample, convert):
    from pyulog import ULog

    path = data / "outside" / "ulog" / f"{sample}.ulg"
    done = convert(path, tmp_path / "a.mcap")
    assert done.returncode == 0, done.stderr
    theirs = ULog(str(path))
    combined = theirs.get_dataset("sensor_combined").data
    imu = read(tmp_path / "a.mcap").imu
    assert np.array_equal(imu.t_ns, combined["timestamp"].astype(np.int64) * 1000)
    for axis, sign in enumerate((1, -1, -1)):
        assert np.array_equal(imu.gyro[:, axis], sign * combined[f"gyro_rad[{axis}]"].astype(float))
    with Log(tmp_path / "a.mcap") as log:
        counts = {topic.name.split("/")[1]: 0 for topic in log.topics.values()}
        for topic in log.topics.values():
            counts[topic.name.split("/")[1]] += topic.count
    for dataset in theirs.data_list:
        same = sum(len(d.data["timestamp"]) for d in theirs.data_list if d.name == dataset.name)
        assert counts[dataset.name] == same, dataset.name


def test_a_ulog_is_known_by_its_content(tmp_path):
    (sequence,) = ulog.sequences(ulog_flight().write(tmp_path / "download"))
    assert ulog.read_sequence(sequence).name == "download"


def test_fields_whose_names_differ_by_capitals_have_names_that_ros_reads(convert, tmp_path):
    writer = Ulog()
    writer.topic("sensor_combined", COMBINED, [(START_US, 0.1, 0.2, 0.3, 4000, 0, 1.0, 2.0, -9.75, 4000)])
    writer.topic("script", "uint64_t timestamp;float Roll;float roll", [(START_US, 1.0, 2.0)])
    assert convert(writer.write(tmp_path / "flight.ulg"), tmp_path / "out.mcap").returncode in (0, 3)
    with (tmp_path / "out.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        (message,) = [found for _, channel, _, found in reader.iter_decoded_messages(["/script"])]
    assert (message.roll, message.roll_2) == (1.0, 2.0)


def test_a_damaged_start_of_the_log_costs_no_message(convert, tmp_path):
    """A start beyond 64 bits of nanoseconds ended in a traceback, where a message has no stamp."""
    writer = Ulog()
    writer.topic("script", "uint64_t timestamp;float roll", [(0, 1.0), (START_US, 2.0)])
    path = writer.write(tmp_path / "a.ulg")
    path.write_bytes(path.read_bytes().replace(struct.pack("<Q", START_US), bytes(7) + b"\xff", 1))
    assert convert(path, tmp_path / "a.mcap").returncode == 3  # no IMU
    with Log(tmp_path / "a.mcap") as log:
        assert log.topics["/script"].count == 2
