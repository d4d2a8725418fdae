"""Channels of a log: what may drive a sensor is read from any message, and the reference's own topics drive nothing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.writer import Writer

from imutool.diagnosis.diagnose import diagnose
from imutool.inertial.kinematics import Trajectory
from imutool.mcap_io.read import read
from imutool.mcap_io.write import write
from imutool.recording import Imu, Recording, Scalars
from imutool.sensor.channels import MAX_TRIED, with_channels
from imutool.sensor.made_up_flight import FlightSettings, trajectory

RATE_HZ, DURATION_S, SLOW_HZ = 100.0, 30.0, 10.0
GYRO_PER_K = 2e-3  # rad/s, of the planted effect
NOISE = np.array([1e-3] * 3 + [1e-2] * 3)
HEADER = """std_msgs/Header header
{fields}
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
Row = Callable[[float], dict[str, Any]]


@pytest.fixture(scope="module")
def path() -> Trajectory:
    return trajectory(4, FlightSettings(duration_s=DURATION_S, still_s=0.0))


def warm(t_s: np.ndarray | float) -> np.ndarray:
    """A housing that heats up and is cooled by a fan (K)."""
    return np.asarray(25.0 + 4.0 * (1.0 - np.exp(-np.asarray(t_s) / 8.0)) + 1.5 * np.sin(0.5 * np.asarray(t_s)))


def recording(motion: Trajectory, *, per_k: float = 0.0, noise: float = 1.0, **more: Any) -> Recording:
    t_ns = motion.start_ns + np.round(np.arange(DURATION_S * RATE_HZ) * 1e9 / RATE_HZ).astype(np.int64)
    ideal, rng = motion.imu(t_ns), np.random.default_rng(2)
    error = noise * NOISE * rng.normal(size=(len(t_ns), 6))
    error[:, 0] += per_k * warm((t_ns - motion.start_ns) * 1e-9)
    imu = Imu(t_ns, ideal.gyro + error[:, :3], ideal.accel + error[:, 3:])
    return Recording(name="flight", imu=imu, truths={"/ground_truth/pose": motion.poses(t_ns)}, **more)


def with_topics(base: Path, out: Path, start_ns: int, topics: dict[str, tuple[str, str, float, Row]]) -> Path:
    """The log with further topics: schema, its fields, rate (Hz) and a message as a function of time (s)."""
    with base.open("rb") as source, out.open("wb") as file:
        writer = Writer(file)
        for topic, (name, fields, rate_hz, row) in topics.items():
            schema = writer.register_msgdef(name, HEADER.format(fields=fields))
            for t_s in np.arange(0.0, DURATION_S, 1.0 / rate_hz):
                t_ns = start_ns + round(float(t_s) * 1e9)
                stamp = {"sec": t_ns // 10**9, "nanosec": t_ns % 10**9}
                message = {"header": {"stamp": stamp, "frame_id": ""}, **row(float(t_s))}
                writer.write_message(topic, schema, message, log_time=t_ns, publish_time=t_ns)
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            assert schema is not None
            if channel.id not in channels:
                at = writer._writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer._writer.register_channel(
                    channel.topic, channel.message_encoding, at, dict(channel.metadata)
                )
            writer._writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    return out


TEMPERATURE = ("sensor_msgs/msg/Temperature", "float64 temperature\nfloat64 variance", SLOW_HZ)


def test_a_bias_that_follows_a_slow_temperature_message_is_named(path: Trajectory, tmp_path: Path) -> None:
    write(recording(path, per_k=GYRO_PER_K), tmp_path / "base.mcap")
    write(recording(path, noise=0.3), tmp_path / "sim.mcap")
    topics = {"/housing": (*TEMPERATURE, lambda t_s: {"temperature": float(warm(t_s)), "variance": 0.1 + 0.01 * t_s})}
    real = with_topics(tmp_path / "base.mcap", tmp_path / "real.mcap", path.start_ns, topics)
    d = diagnose([real], tmp_path / "sim.mcap")
    assert [finding.effect for finding in d.findings] == ["temperature"]
    estimate = d.findings[0].parameters["gyro_x"]
    assert abs(estimate.value - GYRO_PER_K) < 4.0 * estimate.std
    assert any("Tried as causes" in remark and "/housing.temperature" in remark for remark in d.remarks)


def test_what_cannot_drive_is_no_channel(path: Trajectory, tmp_path: Path) -> None:
    t_ns = recording(path).imu.t_ns[::10]
    bias = Scalars(t_ns, np.sin(0.1 * np.arange(3.0 * len(t_ns)).reshape(-1, 3)), "rad/s")
    brought = {"/ground_truth/bias/gyro": bias, "/imu0/bias/gyro": bias, "/motor": bias}
    write(recording(path, scalars=brought), tmp_path / "base.mcap")
    rng = np.random.default_rng(0)

    def status(t_s: float) -> dict[str, Any]:
        volts = float(rng.normal())
        state = int(t_s) % 5
        return {
            "volts": volts,
            "copy": 2.0 * volts,
            "state": state,
            "count": int(10 * t_s),
            "stuck": 3.0,
            "volts_covariance": volts,
        }

    fields = "float64 volts\nfloat64 copy\nint32 state\nuint32 count\nfloat64 stuck\nfloat64 volts_covariance"
    log = with_topics(
        tmp_path / "base.mcap", tmp_path / "log.mcap", path.start_ns, {"/status": ("a/msg/Status", fields, 10.0, status)}
    )
    got = with_channels(read(log), log)
    assert got.added == ("/status.volts",)
    assert set(got.recording.scalars) == {"/motor", "/status.volts"}


def test_of_many_fields_the_first_are_tried_and_the_others_named(path: Trajectory, tmp_path: Path) -> None:
    write(recording(path), tmp_path / "base.mcap")
    rng = np.random.default_rng(1)
    fields = "\n".join(f"float64 x{k}" for k in range(MAX_TRIED + 20)) + "\nfloat64 temperature"

    def row(t_s: float) -> dict[str, Any]:
        return {f"x{k}": float(rng.normal()) for k in range(MAX_TRIED + 20)} | {"temperature": float(warm(t_s))}

    log = with_topics(tmp_path / "base.mcap", tmp_path / "log.mcap", path.start_ns, {"/many": ("a/msg/Many", fields, 5.0, row)})
    got = with_channels(read(log), log)
    assert got.added == ("/many.temperature", *(f"/many.x{k}" for k in range(MAX_TRIED - 1)))
    assert len(got.untried) == 21
    assert "not tried" in got.remark
    assert "and 9 more" in got.remark
