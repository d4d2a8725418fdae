"""Logs we write, as the programs of others see them: `mcap`'s own reader, rosbags, and `rerun mcap check`."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from imutool.mcap_io.write import CHUNK_BYTES, write
from imutool.recording import Recording

RERUN = Path(sys.executable).with_name("rerun")
COMPRESSIONS = ["zstd", "lz4", "none"]
TOPICS = {
    "/imu0": "sensor_msgs/msg/Imu",
    "/ground_truth/pose": "geometry_msgs/msg/PoseStamped",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/ground_truth/velocity": "geometry_msgs/msg/Vector3Stamped",
    "/ground_truth_recomputed/pose": "geometry_msgs/msg/PoseStamped",
    "/imu0/temperature": "std_msgs/msg/Float64",
    "/magnetometer": "geometry_msgs/msg/Vector3Stamped",
    "/cam0/image_raw/compressed": "sensor_msgs/msg/CompressedImage",
}


@pytest.fixture(params=COMPRESSIONS)
def log(recording: Recording, tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    path = tmp_path / f"{request.param}.mcap"
    write(recording, path, compression=request.param)
    return path


def xyz(v: object) -> list[float]:
    return [v.x, v.y, v.z]


def wxyz(q: object) -> list[float]:
    return [q.w, q.x, q.y, q.z]


def check_values(recording: Recording, columns: dict[str, list[tuple[int, object]]]) -> None:
    """Every value of every message, against the arrays it was written from."""

    def check(topic: str, t_ns: np.ndarray, take: Callable[[object], list[float]], expected: np.ndarray) -> None:
        assert [t for t, _ in columns[topic]] == t_ns.tolist()
        assert np.array([take(m) for _, m in columns[topic]]).tobytes() == np.ascontiguousarray(expected).tobytes()

    imu, (first, second) = recording.imu, recording.truths.values()
    check("/imu0", imu.t_ns, lambda m: xyz(m.angular_velocity), imu.gyro)
    check("/imu0", imu.t_ns, lambda m: xyz(m.linear_acceleration), imu.accel)
    check("/ground_truth/pose", first.t_ns, lambda m: xyz(m.pose.position), first.p_wb)
    check("/ground_truth/pose", first.t_ns, lambda m: wxyz(m.pose.orientation), first.q_wb_wxyz)
    check("/ground_truth_recomputed/pose", second.t_ns, lambda m: wxyz(m.pose.orientation), second.q_wb_wxyz)
    check("/ground_truth/velocity", first.t_ns, lambda m: xyz(m.vector), first.v_w)
    check("/tf", first.t_ns, lambda m: xyz(m.transforms[0].transform.translation), first.p_wb)
    check("/tf", first.t_ns, lambda m: wxyz(m.transforms[0].transform.rotation), first.q_wb_wxyz)
    temperature, magnetometer = recording.scalars.values()
    check("/imu0/temperature", temperature.t_ns, lambda m: [m.data], temperature.values)
    check("/magnetometer", magnetometer.t_ns, lambda m: xyz(m.vector), magnetometer.values)
    images = list(recording.frames["/cam0/image_raw/compressed"].each())
    assert [(t, bytes(m.data)) for t, m in columns["/cam0/image_raw/compressed"]] == images
    for topic, messages in columns.items():
        for t_ns, message in messages:
            holder = message.transforms[0] if topic == "/tf" else message
            if topic != "/imu0/temperature":
                assert holder.header.stamp.sec * 10**9 + holder.header.stamp.nanosec == t_ns
    assert {m.transforms[0].header.frame_id for _, m in columns["/tf"]} == {"world"}
    assert {m.transforms[0].child_frame_id for _, m in columns["/tf"]} == {"body"}
    assert {m.orientation_covariance[0] for _, m in columns["/imu0"]} == {-1.0}


def test_mcap_and_its_ros2_support_decode_exactly_the_arrays(recording: Recording, log: Path) -> None:
    columns: dict[str, list[tuple[int, object]]] = {}
    with log.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            assert schema.name == TOPICS[channel.topic]
            assert message.publish_time == message.log_time
            assert message.sequence == len(columns.setdefault(channel.topic, []))
            columns[channel.topic].append((message.log_time, decoded))
        summary = reader.get_summary()
        counts = {summary.channels[i].topic: n for i, n in summary.statistics.channel_message_counts.items()}
        records = {record.name: record.metadata for record in reader.iter_metadata()}
    check_values(recording, columns)
    assert list(columns) != []
    assert set(columns) == set(TOPICS)
    assert counts == {topic: len(messages) for topic, messages in columns.items()}
    assert records["sensor"] == recording.metadata["sensor"]
    assert (records["imutool"]["name"], records["imutool"]["imu_topic"]) == ("MH_04", "/imu0")


def test_rosbags_decodes_exactly_the_arrays(recording: Recording, log: Path) -> None:
    columns: dict[str, list[tuple[int, object]]] = {}
    with AnyReader([log]) as reader:
        assert {c.topic: c.msgtype for c in reader.connections} == TOPICS
        for connection in reader.connections:
            (qos,) = connection.ext.offered_qos_profiles
            assert (qos.reliability.name, qos.depth) == ("RELIABLE", 10)
        for connection, t_ns, raw in reader.messages():
            columns.setdefault(connection.topic, []).append((t_ns, reader.deserialize(raw, connection.msgtype)))
    check_values(recording, columns)


def test_rerun_has_no_complaint(log: Path) -> None:
    done = subprocess.run([RERUN, "mcap", "check", "--full", log], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert "WARN" not in done.stderr
    assert "ERROR" not in done.stderr
    rows = [line.split() for line in done.stdout.splitlines() if line.startswith(("ok", "warn", "err"))]
    assert {row[3]: (row[0], row[4]) for row in rows} == dict.fromkeys(TOPICS, ("ok", "—"))


def test_definitions_stand_before_the_first_chunk_and_kinds_have_chunks_of_their_own(log: Path) -> None:
    kinds = [{"/imu0"}, {"/imu0/temperature", "/magnetometer"}, {"/cam0/image_raw/compressed"}]
    kinds.append(set(TOPICS) - set().union(*kinds))
    with log.open("rb") as file:
        records = list(StreamReader(file, emit_chunks=True, validate_crcs=True).records)
    first = next(i for i, record in enumerate(records) if isinstance(record, Chunk))
    assert {r.topic for r in records[:first] if isinstance(r, Channel)} == set(TOPICS)
    assert {r.name for r in records[:first] if isinstance(r, Schema)} == set(TOPICS.values())
    assert any(isinstance(r, Metadata) for r in records[:first])
    topics = {r.id: r.topic for r in records if isinstance(r, Channel)}
    chunks = [record for record in records if isinstance(record, Chunk)]
    starts = [chunk.message_start_time for chunk in chunks]
    assert starts == sorted(starts)
    assert all(chunk.uncompressed_crc for chunk in chunks)
    with log.open("rb") as file:
        inside = StreamReader(file, validate_crcs=True).records
        by_chunk: list[list[Message]] = [[] for _ in chunks]
        messages = (record for record in inside if isinstance(record, Message))
        for number, chunk in enumerate(chunks):
            size = 0
            while size < chunk.uncompressed_size:
                message = next(messages)
                size += 31 + len(message.data)
                by_chunk[number].append(message)
            assert size == chunk.uncompressed_size
    for chunk, found in zip(chunks, by_chunk, strict=True):
        present = {topics[message.channel_id] for message in found}
        assert sum(bool(present & kind) for kind in kinds) == 1
        times = [message.log_time for message in found]
        assert times == sorted(times)
        assert chunk.uncompressed_size <= CHUNK_BYTES + 400 or "/cam0/image_raw/compressed" in present


def test_an_image_that_is_packed_already_is_not_packed_again(recording: Recording, tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write(recording, path)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    (camera,) = [i for i, c in summary.channels.items() if c.topic == "/cam0/image_raw/compressed"]
    used = {camera in index.message_index_offsets: set() for index in summary.chunk_indexes}
    for index in summary.chunk_indexes:
        used[camera in index.message_index_offsets].add(index.compression)
    assert used == {True: {""}, False: {"zstd"}}
