"""MCAP logs of other encodings: every command reads their IMUs, and conversion makes them CDR."""

from __future__ import annotations

import functools
import json
import struct
import tracemalloc
from base64 import b64decode
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from imutool.api.logs import convert as convert_logs
from imutool.converters import mcap_log
from imutool.errors import DataError
from imutool.mcap_io.codec import records
from imutool.mcap_io.codec.formats.flatbuffer import FlatBuffer
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read
from imutool.mcap_io.write import write
from imutool.recording import Imu, Recording

BFBS = b64decode(json.loads((Path(__file__).parents[1] / "fixtures" / "flatbuffer.json").read_text())["bfbs"])
START_NS = 1_600_000_000_000_000_123
COUNT = 500
GYRO = np.random.default_rng(3).normal(0, 0.003, (COUNT, 3))
ACCEL = np.random.default_rng(4).normal(0, 0.02, (COUNT, 3)) + np.array([0.0, 0.0, 9.81])


def as_json(n: int, t_ns: int, size: float = 1.0) -> bytes:
    xyz = [dict(zip("xyz", row.tolist(), strict=True)) for row in (GYRO[n], ACCEL[n] * size)]
    stamp = {"sec": t_ns // 10**9, "nsec": t_ns % 10**9}
    return json.dumps({"timestamp": stamp, "frame_id": "imu", "angularVelocity": xyz[0], "linearAcceleration": xyz[1]}).encode()


@functools.cache
def protobuf_type() -> tuple[bytes, Any]:
    """A made-up robot's own IMU message, as a descriptor set and a class."""
    file = descriptor_pb2.FileDescriptorProto(name="robot.proto", package="robot", syntax="proto3")
    fields = descriptor_pb2.FieldDescriptorProto
    vector = file.message_type.add(name="Xyz")
    for number, axis in enumerate("xyz", start=1):
        vector.field.add(name=axis, number=number, type=fields.TYPE_DOUBLE, label=fields.LABEL_OPTIONAL)
    stamp = file.message_type.add(name="Clock")
    for number, part in enumerate(("seconds", "nanos"), start=1):
        stamp.field.add(name=part, number=number, type=fields.TYPE_INT64, label=fields.LABEL_OPTIONAL)
    imu = file.message_type.add(name="Inertial")
    for number, (name, kind) in enumerate((("stamp", "Clock"), ("gyro", "Xyz"), ("accel", "Xyz")), start=1):
        imu.field.add(
            name=name, number=number, type=fields.TYPE_MESSAGE, type_name=f".robot.{kind}", label=fields.LABEL_OPTIONAL
        )
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName("robot.Inertial"))
    return descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString(), kind


def as_protobuf(n: int, t_ns: int) -> bytes:
    message = protobuf_type()[1]()
    message.stamp.seconds, message.stamp.nanos = t_ns // 10**9, t_ns % 10**9
    for vector, row in ((message.gyro, GYRO[n]), (message.accel, ACCEL[n])):
        vector.x, vector.y, vector.z = row.tolist()
    return message.SerializeToString()


@functools.cache
def flatbuffer() -> FlatBuffer:
    return FlatBuffer.of("acme.ImuSample", BFBS)


def as_flatbuffer(n: int, t_ns: int) -> bytes:
    stamp = zip((("header", "stamp", "sec"), ("header", "stamp", "nsec")), divmod(t_ns, 10**9), strict=True)
    vectors = (("angular_velocity", GYRO), ("linear_acceleration", ACCEL))
    values = [((name, axis), row[n, k]) for name, row in vectors for k, axis in enumerate("xyz")]
    return flatbuffer().new([*stamp, *values])


def write_log(path: Path, encoding: str, *, lacking: int | None = None, size: float = 1.0) -> Path:
    """Log of an IMU with a topic next to it; the message `lacking` has no acceleration, JSON's are `size` times as large."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        if encoding == "json":
            schema = writer.register_schema("Imu", "jsonschema", b'{"type": "object"}')
        elif encoding == "flatbuffer":
            schema = writer.register_schema("acme.ImuSample", "flatbuffer", BFBS)
        else:
            schema = writer.register_schema("robot.Inertial", "protobuf", protobuf_type()[0])
        imu = writer.register_channel("/robot/imu", encoding, schema)
        note = writer.register_channel("/notes", "text", 0)
        make = {"json": functools.partial(as_json, size=size), "protobuf": as_protobuf, "flatbuffer": as_flatbuffer}[encoding]
        for n in range(COUNT):
            t_ns = START_NS + n * 5_000_000
            payload = make(n, t_ns) if n != lacking else b"{}" if encoding == "json" else b""
            writer.add_message(imu, t_ns + 700, payload, t_ns + 300)
            if n % 100 == 0:
                writer.add_message(note, t_ns, b"hello", t_ns)
        writer.finish()
    return path


@pytest.mark.parametrize("encoding", ["json", "protobuf", "flatbuffer"])
def test_an_imu_in_another_encoding_becomes_one_that_every_command_reads(convert, imutool, tmp_path, encoding):
    done = convert(write_log(tmp_path / "in.mcap", encoding), tmp_path / "out.mcap")
    assert done.returncode == 0, done.stderr
    assert f"/robot/imu: {encoding} became sensor_msgs/msg/Imu" in done.stderr
    recording = read(tmp_path / "out.mcap")
    assert recording.imu_topic == "/robot/imu"
    assert recording.imu.t_ns.tolist() == [START_NS + n * 5_000_000 for n in range(COUNT)]
    assert np.array_equal(recording.imu.gyro, GYRO)
    assert np.array_equal(recording.imu.accel, ACCEL)
    assert imutool("debias", "out.mcap", "d.mcap", cwd=tmp_path).returncode == 0
    with (tmp_path / "in.mcap").open("rb") as a, (tmp_path / "out.mcap").open("rb") as b:
        theirs = [(c.topic, m.log_time, m.publish_time, m.data) for _, c, m in make_reader(a).iter_messages()]
        kept = {"/robot/imu/as_recorded": "/robot/imu", "/notes": "/notes"}
        every = list(make_reader(b, validate_crcs=True).iter_messages())
        ours = [(kept[c.topic], m.log_time, m.publish_time, m.data) for _, c, m in every if c.topic in kept]
    assert sorted(ours) == sorted(theirs)


def test_an_original_is_not_translated_again(convert, imutool, tmp_path):
    """`--fix` converts in rounds: its log has one IMU, and the recorded messages under one name."""
    convert(write_log(tmp_path / "in.mcap", "json", size=1 / 9.80665), tmp_path / "once.mcap")
    for source, options in (("once.mcap", ()), ("in.mcap", ("--fix",)), ("once.mcap", ("--fix",))):
        done = imutool("convert", source, "again.mcap", *options, "--overwrite", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        with Log(tmp_path / "again.mcap") as log:
            assert sorted(log.topics) == ["/notes", "/robot/imu", "/robot/imu/as_recorded"]
            assert log.imu_topics == ["/robot/imu"]
            assert log.topics["/robot/imu/as_recorded"].message_encoding == "json"
        assert np.allclose(read(tmp_path / "again.mcap").imu.accel, ACCEL / (1.0 if options else 9.80665), rtol=1e-12)


def test_a_message_without_a_sample_is_a_loss(convert, tmp_path):
    done = convert(write_log(tmp_path / "in.mcap", "protobuf", lacking=7), tmp_path / "out.mcap")
    assert done.returncode == 3
    assert "messages of /robot/imu without a sample: 1; see /robot/imu/as_recorded" in done.stderr
    assert len(read(tmp_path / "out.mcap").imu) == COUNT - 1


@pytest.mark.parametrize("encoding", ["json", "protobuf", "flatbuffer"])
def test_a_log_in_another_encoding_is_read_and_debiased_without_conversion(imutool, tmp_path, encoding):
    source = write_log(tmp_path / "in.mcap", encoding)
    recording = read(source)
    assert recording.imu_topic == "/robot/imu"
    assert recording.imu.t_ns.tolist() == [START_NS + n * 5_000_000 for n in range(COUNT)]
    assert np.array_equal(recording.imu.gyro, GYRO)
    assert np.array_equal(recording.imu.accel, ACCEL)
    done = imutool("info", "in.mcap", "--json", "-", cwd=tmp_path)
    report = json.loads(done.stdout)
    assert [(t["name"], t["encoding"]) for t in report["topics"]] == [("/robot/imu", encoding), ("/notes", "text")]
    assert report["imu"][0]["samples"] == COUNT
    assert "is not read" not in done.stdout

    assert imutool("debias", "in.mcap", "own.mcap", cwd=tmp_path).returncode == 0
    assert imutool("debias", "in.mcap", "ros.mcap", "--encoding", "cdr", cwd=tmp_path).returncode == 0
    own, ros = (read(tmp_path / f"{name}.mcap", imu="/robot/imu/debiased").imu for name in ("own", "ros"))
    assert np.array_equal(own.t_ns, recording.imu.t_ns)
    assert np.array_equal(own.gyro, ros.gyro)
    assert np.array_equal(own.accel, ros.accel)
    assert not np.array_equal(own.gyro, recording.imu.gyro)
    with Log(tmp_path / "own.mcap") as log:
        made, recorded = log.topics["/robot/imu/debiased"], log.topics["/robot/imu"]
        assert (made.message_encoding, made.own_schema) == (encoding, recorded.own_schema)
        assert log.imu_topics == ["/robot/imu"]
    with Log(tmp_path / "ros.mcap") as log:
        assert log.topics["/robot/imu/debiased"].message_encoding == "cdr"


def test_debias_leaves_out_what_holds_no_sample_and_counts_it(imutool, tmp_path):
    write_log(tmp_path / "in.mcap", "json", lacking=7)
    done = imutool("debias", "in.mcap", "d.mcap", cwd=tmp_path)
    assert done.returncode == 3
    assert "1 not finite" in done.stderr
    assert len(read(tmp_path / "d.mcap", imu="/robot/imu/debiased").imu) == COUNT - 1


def test_a_ros2_type_with_rates_and_accelerations_is_an_imu_where_the_log_has_no_other(imutool, tmp_path):
    store = get_typestore(Stores.ROS2_JAZZY)
    text = "uint64 timestamp\nstring note\nfloat32[3] gyro_rad\nuint32 gyro_integral_dt\nfloat32[3] accelerometer_m_s2\n"
    store.register(get_types_from_msg(text, "px4_msgs/msg/SensorCombined"))
    kind = store.types["px4_msgs/msg/SensorCombined"]
    with (tmp_path / "in.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        schema = writer.register_schema("px4_msgs/msg/SensorCombined", "ros2msg", text.encode())
        channel = writer.register_channel("/fmu/out/sensor_combined", "cdr", schema)
        for n in range(COUNT):
            message = kind(n, "x" * (n // 100), GYRO[n].astype(np.float32), 5000, ACCEL[n].astype(np.float32))
            t_ns = START_NS + n * 5_000_000
            writer.add_message(channel, t_ns, store.serialize_cdr(message, message.__msgtype__), t_ns)
        writer.finish()
    imu = read(tmp_path / "in.mcap").imu
    assert imu.t_ns.tolist() == [START_NS + n * 5_000_000 for n in range(COUNT)]  # the log times: its stamp has no unit
    assert np.array_equal(imu.gyro, GYRO.astype(np.float32))
    assert np.array_equal(imu.accel, ACCEL.astype(np.float32))
    assert imutool("debias", "in.mcap", "d.mcap", cwd=tmp_path).returncode == 0
    with Log(tmp_path / "d.mcap") as log:
        assert log.topics["/fmu/out/sensor_combined/debiased"].schema_name == "sensor_msgs/msg/Imu"
        assert log.topics["/fmu/out/sensor_combined/debiased"].reflected is None


def test_poses_in_another_encoding_have_a_kind_and_serve_as_truth(convert, imutool, tmp_path):
    """foxglove.PoseInFrame in JSON on a topic of motion capture, and an odometry next to it."""
    with (tmp_path / "in.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("foxglove.PoseInFrame", "jsonschema", b'{"type": "object"}')
        imu, *poses = (writer.register_channel(t, "json", schema) for t in ("/imu", "/mocap/body", "/wheels/odom"))
        for n in range(COUNT):
            t_ns = START_NS + n * 5_000_000
            writer.add_message(imu, t_ns, as_json(n, t_ns), t_ns)
            place = {"position": {"x": n / 100, "y": 0, "z": 1}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
            stamp = {"sec": t_ns // 10**9, "nsec": t_ns % 10**9}
            for channel in poses:
                message = json.dumps({"timestamp": stamp, "frame_id": "world", "pose": place}).encode()
                writer.add_message(channel, t_ns, message, t_ns)
        writer.finish()
    recording = read(tmp_path / "in.mcap")
    assert recording.truths["/mocap/body"].p_wb[7].tolist() == [0.07, 0.0, 1.0]
    assert recording.other_poses == {"/wheels/odom": "odometry"}
    assert convert(tmp_path / "in.mcap", tmp_path / "out.mcap").returncode == 0
    converted = read(tmp_path / "out.mcap")
    assert converted.truths["/mocap/body"] == recording.truths["/mocap/body"]
    assert converted.other_poses == recording.other_poses
    done = imutool("evaluate", "in.mcap", "--init", "truth", "--json", "-", cwd=tmp_path)
    assert done.returncode == 0, done.stderr


def test_a_log_cut_in_its_summary_is_debiased_in_its_encoding(imutool, tmp_path):
    log = write_log(tmp_path / "in.mcap", "protobuf")
    log.write_bytes(log.read_bytes()[:-60])
    done = imutool("debias", "in.mcap", "d.mcap", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "mended: the log ends inside its summary" in done.stdout
    with Log(tmp_path / "d.mcap") as made:
        assert made.topics["/robot/imu/debiased"].message_encoding == "protobuf"
    assert len(read(tmp_path / "d.mcap", imu="/robot/imu/debiased").imu) == COUNT


@pytest.mark.parametrize("damage", ["cut", "flipped"])
def test_a_damaged_log_is_refused_and_repair_is_named(convert, tmp_path, damage):
    """A bit flipped in a chunk that its CRC covers ended in a traceback."""
    log = write_log(tmp_path / "in.mcap", "protobuf")
    raw = bytearray(log.read_bytes())
    raw[raw.index(b"zstd") + 3000] ^= 4
    log.write_bytes(raw[:20_000] if damage == "cut" else raw)
    done = convert(log, tmp_path / "out.mcap")
    assert done.returncode == 4
    assert "imutool repair" in done.stderr
    assert not (tmp_path / "out.mcap").exists()


def test_a_time_beyond_64_bits_with_a_sign_is_refused(convert, tmp_path):
    source = tmp_path / "far.mcap"
    with source.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("robot.Text", "jsonschema", b"{}")
        channel = writer.register_channel("/text", "json", schema)
        for log_time in (START_NS, 2**63):
            writer.add_message(channel, log_time, b"{}", log_time)
        writer.finish()
    done = convert(source, tmp_path / "out.mcap")
    assert done.returncode == 4, done.stderr
    assert "expected a time from 1970 to 2262" in done.stderr
    assert not (tmp_path / "out.mcap").exists()


def test_a_log_without_an_imu_is_converted_with_a_note(convert, tmp_path):
    with (tmp_path / "in.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_message(writer.register_channel("/notes", "text", 0), START_NS, b"hello", START_NS)
        writer.finish()
    done = convert(tmp_path / "in.mcap", tmp_path / "out.mcap")
    assert done.returncode == 0, done.stderr
    assert "note: out.mcap: no topic is an IMU" in done.stderr
    assert "no topic is an IMU" not in convert(write_log(tmp_path / "imu.mcap", "json"), tmp_path / "with.mcap").stderr


def test_chunks_that_overlap_come_in_the_order_of_their_log_times(tmp_path):
    """As the library's own reader has them, also where times are equal."""
    path, times = tmp_path / "in.mcap", np.random.default_rng(1).integers(0, 40, 300)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=500)
        writer.start("", "test")
        schema = writer.register_schema("robot/Number", "jsonschema", b'{"type": "object"}')
        channels = [writer.register_channel(topic, "json", schema) for topic in ("/a", "/b")]
        for n, time in enumerate(times.tolist()):
            writer.add_message(channels[n % 2], START_NS + time, json.dumps({"n": n}).encode(), START_NS + n)
        writer.finish()
    with path.open("rb") as file:
        reader = make_reader(file)
        assert len(reader.get_summary().chunk_indexes) > 10
        expected = [(channel.topic, message.data) for _, channel, message in reader.iter_messages()]
    assert [(message.topic.name, message.payload) for message in mcap_log._messages(path, images=True)] == expected


@pytest.mark.parametrize("length", [5, 4000, 2**63])
def test_a_record_that_does_not_fit_its_chunk_is_refused(convert, tmp_path, length):
    """Without a CRC nothing else shows it."""
    path = tmp_path / "in.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE, enable_crcs=False)
        writer.start("", "test")
        channel = writer.register_channel("/notes", "text", 0)
        for n in range(3):
            writer.add_message(channel, START_NS + n, b"hello", START_NS)
        writer.finish()
    content, head = path.read_bytes(), struct.pack("<BQ", 5, 22 + len(b"hello"))
    path.write_bytes(content.replace(head, struct.pack("<BQ", 5, length)))
    done = convert(path, tmp_path / "out.mcap")
    assert done.returncode == 4, done.stderr
    assert f"a record of {length} bytes in a chunk" in done.stderr
    assert "imutool repair" in done.stderr


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_chunk_of_several_frames_is_read_and_converted(tmp_path, monkeypatch, compression):
    """Both formats allow frames in a row, as parallel compressors write them; such a log counted as damaged."""
    whole = records.pack(compression)

    def frames(data: bytes) -> bytes:
        return b"".join(whole(data[at : at + 5000]) for at in range(0, len(data), 5000))

    t_ns = START_NS + 10_000_000 * np.arange(COUNT)
    with monkeypatch.context() as patch:
        patch.setattr(records, "pack", lambda _: frames)
        write(Recording("x", Imu(t_ns, GYRO, ACCEL)), tmp_path / "in.mcap", compression=compression)
    convert_logs(tmp_path / "in.mcap", tmp_path / "out.mcap")
    for log in ("in.mcap", "out.mcap"):
        np.testing.assert_array_equal(read(tmp_path / log).imu.gyro, GYRO)


@pytest.mark.parametrize("what", ["expands", "states", "attachment"])
def test_what_a_log_without_a_summary_would_unpack_to_or_attach_takes_no_memory(tmp_path, what):
    """The chunk unpacked as a whole, and the attachment was read for the definitions behind it."""
    size = 1000 if what == "expands" else 2**40
    packed = lz4.frame.compress(bytes(100 << 20)) if what == "expands" else b""
    chunk = struct.pack("<QQQII3sQ", 1, 1, size, 0, 3, b"lz4", len(packed)) + packed
    attachment = struct.pack("<QQIIQ", 1, 1, 0, 0, 100 << 20) + bytes((100 << 20) + 4)
    opcode, content = (9, attachment) if what == "attachment" else (6, chunk)
    end = struct.pack("<BQI", 15, 4, 0) + struct.pack("<BQQQI", 2, 20, 0, 0, 0)
    log = mcap_log.MAGIC + struct.pack("<BQII", 1, 8, 0, 0) + struct.pack("<BQ", opcode, len(content)) + content + end
    (tmp_path / "in.mcap").write_bytes(log + mcap_log.MAGIC)
    tracemalloc.start()
    with nullcontext() if what == "attachment" else pytest.raises(DataError, match=f"{size} bytes"):
        mcap_log.read_sequence(*mcap_log.sequences(tmp_path / "in.mcap"), images=True)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10 << 20
