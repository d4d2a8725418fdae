"""`gyro=TOPIC,accel=TOPIC` names one IMU of two topics, wherever a topic of an IMU is asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore

from imutool import info
from imutool.api.logs import convert
from imutool.debiasing import debias
from imutool.errors import ConfigError, LogError
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.encode import encode_imu, encode_vector3
from imutool.mcap_io.codec.joined_imu import pairs_by_name, parse_parts
from imutool.mcap_io.file_writer import LogWriter
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read
from imutool.mcap_io.write import Series, chunks

START_NS = 1_600_000_000_000_000_123
RNG = np.random.default_rng(8)
GYRO_NS = START_NS + np.arange(4000) * 2_500_000  # 400 Hz, 10 s
ACCEL_NS = START_NS + 1_300_000 + np.arange(2500) * 4_000_000  # 250 Hz, begins later and ends earlier
GYRO = RNG.normal(0.01, 0.003, (4000, 3))
ACCEL = np.array([0.0, 0.0, 9.81]) + RNG.normal(0.0, 0.02, (2500, 3))
PARTS = "gyro=/cam/motion_g,accel=/cam/motion_a"


def as_imu(sensor: str):
    """Encoder of an Imu whose other sensor reads nothing, as drivers publish single sensors."""

    def encode(t_ns, values):
        nothing = np.zeros_like(values)
        return encode_imu(t_ns, *((values, nothing) if sensor == "gyro" else (nothing, values)), "optical")

    return encode


def as_vector(t_ns, values):
    return encode_vector3(t_ns, values, "optical")


def write_log(path: Path, schema: str, topics: tuple[str, str] = ("/cam/motion_g", "/cam/motion_a")) -> Path:
    with LogWriter(path) as log:
        series = [
            Series(log.channel(topic, schema, {}), t, (t, v), as_imu(sensor) if schema == schemas.IMU else as_vector)
            for topic, sensor, t, v in zip(topics, ("gyro", "accel"), (GYRO_NS, ACCEL_NS), (GYRO, ACCEL), strict=True)
        ]
        for chunk in chunks(series):
            log.chunk(chunk)
    return path


@pytest.mark.parametrize("schema", [schemas.IMU, schemas.VECTOR3])
def test_two_topics_are_read_as_one_imu_on_the_gyros_stamps(tmp_path, schema, caplog):
    source = write_log(tmp_path / "two.mcap", schema)
    imu = read(source, imu=PARTS).imu
    inside = (ACCEL_NS[0] <= GYRO_NS) & (ACCEL_NS[-1] >= GYRO_NS)
    assert np.array_equal(imu.t_ns, GYRO_NS[inside])
    assert np.array_equal(imu.gyro, GYRO[inside])
    wanted = [np.interp(imu.t_ns - START_NS, ACCEL_NS - START_NS, column) for column in ACCEL.T]
    np.testing.assert_allclose(imu.accel, np.stack(wanted, axis=1), rtol=1e-12)
    assert "gyro at 400.0 Hz and accelerometer at 250.0 Hz became one IMU" in caplog.text
    assert "delay" in caplog.text
    assert "gyro samples without an accelerometer sample near them: 2" in caplog.text


def test_debias_writes_one_message_a_gyro_message(tmp_path):
    source = write_log(tmp_path / "two.mcap", schemas.IMU)
    done = debias(source, tmp_path / "out.mcap", imus=[PARTS])
    assert done.rewrite.added["/cam/imu/debiased"] == len(GYRO_NS) - 2
    debiased = read(tmp_path / "out.mcap", imu="/cam/imu/debiased").imu
    raw = read(tmp_path / "out.mcap", imu=PARTS).imu
    assert np.array_equal(debiased.t_ns, raw.t_ns)
    assert np.abs((raw.gyro - debiased.gyro).mean(axis=0) - 0.01).max() < 3e-4
    assert {topic.topic for topic in info(tmp_path / "out.mcap").imu} >= {"/cam/motion_g", "/cam/motion_a"}


def test_a_pair_by_name_is_offered_and_joined_on_conversion(tmp_path):
    source = write_log(tmp_path / "two.mcap", schemas.IMU, ("/cam/gyro/sample", "/cam/accel/sample"))
    with pytest.raises(LogError, match="or join two: gyro=/cam/gyro/sample,accel=/cam/accel/sample"):
        read(source)
    convert(source, tmp_path / "one.mcap")
    recording = read(tmp_path / "one.mcap")
    assert recording.imu_topic == "/cam/imu"
    assert np.array_equal(recording.imu.gyro, read(source, imu="gyro=/cam/gyro/sample,accel=/cam/accel/sample").imu.gyro)


def test_what_is_no_such_pair_is_refused(tmp_path):
    source = write_log(tmp_path / "two.mcap", schemas.IMU)
    assert parse_parts("/imu0") is None
    assert parse_parts("accel=/b, gyro=/a") == ("/a", "/b")
    with pytest.raises(ConfigError, match="gyro=TOPIC,accel=TOPIC"):
        parse_parts("gyro=/a")
    with Log(source) as log, pytest.raises(LogError, match="there is no topic /nowhere"):
        log.topic("gyro=/nowhere,accel=/cam/motion_a", (schemas.IMU,))


@pytest.mark.parametrize(
    ("topics", "pairs"),
    [
        (["/camera/gyro/sample", "/camera/accel/sample"], {"/camera/imu": ("/camera/gyro/sample", "/camera/accel/sample")}),
        (["/d/Gyro_0/imu/data", "/d/Accel_0/imu/data"], {"/d/imu": ("/d/Gyro_0/imu/data", "/d/Accel_0/imu/data")}),
        (["/phone/accelerometer", "/phone/gyroscope"], {"/phone/imu": ("/phone/gyroscope", "/phone/accelerometer")}),
        (["/a/gyro/sample", "/b/accel/sample"], {}),
        (["/gyro_0", "/accel_1"], {}),
        (["/imu0", "/imu1"], {}),
        (["/camera/gyro", "/camera/accel", "/camera/imu"], {}),
    ],
)
def test_topics_that_differ_by_the_sensor_alone_are_a_pair(topics: list[str], pairs: dict[str, tuple[str, str]]) -> None:
    assert pairs_by_name(topics) == pairs


@pytest.mark.parametrize("accel", schemas.ACCELS)
def test_a_twist_and_an_acceleration_are_joined(tmp_path, accel):
    """Drivers of ROS have rates in TwistStamped and accelerations in AccelStamped."""
    store, stamps = get_typestore(Stores.ROS2_HUMBLE), GYRO_NS[:200:2].tolist()
    vector, header = store.types["geometry_msgs/msg/Vector3"], store.types["std_msgs/msg/Header"]
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        for topic, kind, parts in (
            ("/rate", schemas.TWIST_STAMPED, ("Twist",)),
            ("/force", accel, ("Accel", "AccelWithCovariance")[: 1 + ("With" in accel)]),
        ):
            channel = writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", b""))
            for n, t_ns in enumerate(stamps):
                stamp = store.types["builtin_interfaces/msg/Time"](t_ns // 10**9, t_ns % 10**9)
                content = store.types[f"geometry_msgs/msg/{parts[0]}"](vector(*ACCEL[n]), vector(*GYRO[n]))
                if len(parts) > 1:
                    content = store.types[f"geometry_msgs/msg/{parts[1]}"](content, np.zeros(36))
                message = store.types[kind](header(stamp, "imu"), content)
                writer.add_message(channel, t_ns, bytes(store.serialize_cdr(message, kind)), t_ns)
        writer.finish()
    with pytest.raises(LogError, match="gyro=TOPIC,accel=TOPIC joins the vectors"):
        read(tmp_path / "log.mcap")
    imu = read(tmp_path / "log.mcap", imu="gyro=/rate,accel=/force").imu
    np.testing.assert_array_equal(imu.gyro, GYRO[:100])
    np.testing.assert_allclose(imu.accel, ACCEL[:100], rtol=1e-12)
