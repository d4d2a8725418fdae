"""Temperatures of a log by any writer: scalar topics and message fields, thinned, without NaN."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap_ros2.writer import Writer
from support.robot_cases.log import DEFINITIONS

from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read_recordings
from imutool.mcap_io.temperature import EVERY_NS, temperatures, thinned, with_temperatures
from imutool.mcap_io.write import write
from imutool.recording import Imu, Recording, Scalars

START_NS, RATE_HZ = 1_700_000_000_000_000_000, 10
TEMPERATURE = DEFINITIONS["sensor_msgs/msg/Temperature"]


def ros_log(path: Path, celsius: np.ndarray, late_ns: int = 40_000_000) -> None:
    """Log of `sensor_msgs/Temperature` and of a Float64, by the library of MCAP; the header's stamp is that of measurement."""
    with path.open("wb") as file, Writer(file) as writer:
        message = writer.register_msgdef("sensor_msgs/msg/Temperature", TEMPERATURE)
        number = writer.register_msgdef("std_msgs/msg/Float64", "float64 data")
        for k, value in enumerate(celsius.tolist()):
            t_ns = START_NS + k * 10**9 // RATE_HZ
            stamp = {"sec": t_ns // 10**9, "nanosec": t_ns % 10**9}
            known = {"header": {"stamp": stamp, "frame_id": "imu"}, "temperature": value, "variance": 0.1}
            writer.write_message("/imu/temperature", message, known, t_ns + late_ns, t_ns + late_ns)
            writer.write_message("/case_temp", number, {"data": value}, t_ns, t_ns)
            writer.write_message("/speed", number, {"data": value}, t_ns, t_ns)


def test_messages_and_numbers_of_any_writer_are_found_by_their_stamps(tmp_path: Path) -> None:
    celsius = 20.0 + np.arange(100.0)
    ros_log(tmp_path / "log.mcap", celsius)
    with Log(tmp_path / "log.mcap") as log:
        found = temperatures(log)
    assert set(found) == {"/imu/temperature.temperature", "/case_temp"}
    for channel in found.values():
        np.testing.assert_array_equal(channel.t_ns, START_NS + np.arange(20) * EVERY_NS)
        np.testing.assert_array_equal(channel.values[:, 0], celsius[::5])
    assert found["/imu/temperature.temperature"].unit == "degC"


def test_read_selects_them_by_log_time_too(tmp_path: Path) -> None:
    ros_log(tmp_path / "log.mcap", 20.0 + np.arange(100.0), late_ns=0)
    with Log(tmp_path / "log.mcap") as log:
        found = temperatures(log, start_ns=START_NS + 2 * EVERY_NS, end_ns=START_NS + 5 * EVERY_NS)
    assert [len(channel) for channel in found.values()] == [4, 4]


def test_nan_is_no_temperature_and_the_next_number_counts(tmp_path: Path) -> None:
    celsius = 20.0 + np.arange(100.0)
    celsius[5:8] = np.nan
    ros_log(tmp_path / "log.mcap", celsius)
    with Log(tmp_path / "log.mcap") as log:
        found = temperatures(log)
    for channel in found.values():
        assert channel.values[:3, 0].tolist() == [20.0, 28.0, 30.0]
        assert np.isfinite(channel.values).all()


def test_a_channel_of_nothing_but_nan_is_none(tmp_path: Path) -> None:
    ros_log(tmp_path / "log.mcap", np.full(20, np.nan))
    with Log(tmp_path / "log.mcap") as log:
        assert temperatures(log) == {}


def test_it_is_thinned_alike_in_whole_and_in_parts() -> None:
    rng = np.random.default_rng(1)
    t_ns = START_NS + np.cumsum(rng.integers(1, 300_000_000, 400))
    t_ns[200:210] -= 5_000_000_000  # set back: left out
    values = rng.normal(size=400)
    whole = thinned(t_ns, values, "degC")
    assert (np.diff(whole.t_ns) > 0).all()
    assert len(np.unique(whole.t_ns // EVERY_NS)) == len(whole)
    again = thinned(whole.t_ns, whole.values[:, 0], "degC")
    assert again == whole
    assert len(thinned(t_ns[:0], values[:0], "")) == 0


@pytest.mark.parametrize("own", [True, False])
def test_a_recording_gets_what_is_no_scalar_yet(tmp_path: Path, own: bool) -> None:
    t_ns = START_NS + 10_000_000 * np.arange(500, dtype=np.int64)
    imu = Imu(t_ns, np.zeros((500, 3)), np.tile([0.0, 0.0, 9.81], (500, 1)))
    channel = {"/imu0/temperature": Scalars(t_ns[::10], np.arange(50.0)[:, None], "degC")} if own else {}
    write(Recording("r", imu, scalars=channel), tmp_path / "log.mcap")
    with Log(tmp_path / "log.mcap") as log:
        recordings = read_recordings(log)
        assert with_temperatures(recordings, log) == recordings
        assert set(temperatures(log)) == set(channel)
