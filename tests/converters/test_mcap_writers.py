"""MCAP logs of other writers: what their summaries leave out, and what stands next to the messages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Chunk, Message, Metadata
from mcap.writer import IndexType, Writer

from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.encode import encode_imu
from imutool.mcap_io.codec.records import build
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read

COUNT = 200
T_NS = 1_700_000_000 * 10**9 + np.arange(COUNT, dtype=np.int64) * 5_000_000
GYRO = np.random.default_rng(5).normal(0, 0.1, (COUNT, 3))
ACCEL = np.random.default_rng(6).normal(0, 0.1, (COUNT, 3)) + np.array([0.0, 0.0, 9.81])
NO_INDEX: dict[str, Any] = {
    "repeat_channels": False,
    "repeat_schemas": False,
    "use_statistics": False,
    "use_summary_offsets": False,
    "index_types": IndexType.NONE,
}


def write_log(path: Path, topics: tuple[str, ...] = ("/imu",), *, beside: bool = False, **options: Any) -> Path:
    """Log of the same samples on each topic, with two metadata records of one name and an attachment on request."""
    rows = encode_imu(T_NS, GYRO, ACCEL, "imu")
    path.parent.mkdir(exist_ok=True)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=10_000, **options)
        writer.start("ros2")
        schema = writer.register_schema(schemas.IMU, "ros2msg", schemas.definition(schemas.IMU).encode())
        channels = [writer.register_channel(topic, "cdr", schema) for topic in topics]
        for t_ns, row in zip(T_NS.tolist(), rows, strict=True):
            for channel in channels:
                writer.add_message(channel, t_ns, row.tobytes(), t_ns)
        if beside:
            writer.add_metadata("rig", {"camera": "left"})
            writer.add_metadata("rig", {"mount": "roof"})
            writer.add_attachment(T_NS[0], T_NS[0], "calibration.yaml", "text/yaml", b"gain: 1")
        writer.finish()
    return path


@pytest.mark.parametrize(
    "options",
    [{"repeat_channels": False}, {"repeat_schemas": False}, {"repeat_channels": False, "use_statistics": False}, NO_INDEX],
)
def test_a_summary_without_definitions_costs_no_message(convert, tmp_path, options):
    done = convert(write_log(tmp_path / "in.mcap", **options), tmp_path / "out.mcap")
    assert done.returncode == 0, done.stderr
    imu = read(tmp_path / "out.mcap").imu
    assert np.array_equal(imu.t_ns, T_NS)
    assert np.array_equal(imu.gyro, GYRO)


@pytest.mark.parametrize("options", [{"use_statistics": False}, NO_INDEX])
def test_two_sensors_are_joined_without_statistics(convert, tmp_path, options):
    source = write_log(tmp_path / "in.mcap", ("/camera/gyro/sample", "/camera/accel/sample"), **options)
    assert convert(source, tmp_path / "out.mcap").returncode == 0
    with Log(tmp_path / "out.mcap") as log:
        assert log.imu_topics == ["/camera/imu"]
        assert log.topics["/camera/imu"].count == COUNT


@pytest.mark.parametrize("options", [{}, {"index_types": IndexType.CHUNK}, NO_INDEX])
def test_metadata_of_one_name_and_attachments_are_kept(convert, tmp_path, options):
    """Attachments were left out, and the exit code was 3."""
    done = convert(write_log(tmp_path / "in.mcap", beside=True, **options), tmp_path / "out.mcap")
    assert done.returncode == 0, done.stderr
    with (tmp_path / "out.mcap").open("rb") as file:
        found = {record.name: record.metadata for record in make_reader(file).iter_metadata()}
        file.seek(0)
        (attached,) = make_reader(file).iter_attachments()
    assert found["rig"] == {"camera": "left", "mount": "roof"}
    assert (attached.name, attached.media_type, attached.data) == ("calibration.yaml", "text/yaml", b"gain: 1")
    assert attached.log_time == attached.create_time == T_NS[0]
    with Log(tmp_path / "out.mcap") as log:
        log.check()


def test_a_damaged_attachment_is_a_loss(convert, tmp_path):
    source = write_log(tmp_path / "in.mcap", beside=True)
    source.write_bytes(source.read_bytes().replace(b"gain: 1", b"gain: 2"))
    done = convert(source, tmp_path / "out.mcap")
    assert done.returncode == 3
    assert "the attachment at byte" in done.stderr
    assert "it is left out" in done.stderr
    with (tmp_path / "out.mcap").open("rb") as file:
        assert list(make_reader(file).iter_attachments()) == []
    with Log(tmp_path / "out.mcap") as log:
        log.check()


def _append(path: Path, records: bytes) -> None:
    """Put records behind the last chunk of a log without summary offsets and CRCs."""
    raw = path.read_bytes()
    start = int.from_bytes(raw[-28:-20], "little")
    data_end, footer = start - 13, raw[start:-28] + (start + len(records)).to_bytes(8, "little") + raw[-20:]
    path.write_bytes(raw[:data_end] + records + raw[data_end:start] + footer)


@pytest.mark.parametrize("statistics", [True, False])
def test_what_no_index_lists_is_converted_or_said(convert, tmp_path, statistics):
    options = {"use_statistics": statistics, "use_summary_offsets": False, "enable_crcs": False}
    source = write_log(tmp_path / "in.mcap", **options)
    t_ns = T_NS + (T_NS[-1] - T_NS[0] + 5_000_000)
    rows, later = encode_imu(t_ns, GYRO, ACCEL, "imu"), t_ns.tolist()
    more = [build(Message(1, t, row.tobytes(), t, 0)) for t, row in zip(later, rows, strict=True)]
    unlisted = b"".join([*more[100:], b"\x90" + bytes(8)])
    chunk = Chunk("", unlisted, later[-1], later[100], 0, len(unlisted))
    rig = [build(Metadata("rig", {f"mount{n}": place for n in range(12)})) for place in ("roof", "floor", "hall")]
    _append(source, b"".join([*more[:100], build(chunk), *rig, b"\x80" + bytes(8)]))
    done = convert(source, tmp_path / "out.mcap")
    assert done.returncode == 3, done.stderr
    assert "not carried over: 1 of 0x80" in done.stderr
    assert "records in chunks that are none of MCAP's own are not carried over: 1 of 0x90" in done.stderr
    assert "later values replace others: mount0 of rig (2 times), mount1 of rig" in done.stderr
    assert "mount9 of rig (2 times) and 2 more" in done.stderr
    assert "100 messages lie outside chunks" in done.stderr
    assert read(tmp_path / "out.mcap").imu.t_ns.tolist() == [*T_NS.tolist(), *later]


@pytest.mark.parametrize("options", [{}, {"use_statistics": False}])
def test_an_imu_that_never_sent_a_message_is_no_choice(tmp_path, options):
    """A recorder enters every topic that is offered."""
    with (tmp_path / "in.mcap").open("wb") as file:
        writer = Writer(file, **options)
        writer.start("ros2")
        schema = writer.register_schema(schemas.IMU, "ros2msg", schemas.definition(schemas.IMU).encode())
        writer.register_channel("/spare/imu", "cdr", schema)
        channel = writer.register_channel("/imu", "cdr", schema)
        for t_ns, row in zip(T_NS.tolist(), encode_imu(T_NS, GYRO, ACCEL, "imu"), strict=True):
            writer.add_message(channel, t_ns, row.tobytes(), t_ns)
        writer.finish()
    assert read(tmp_path / "in.mcap").imu_topic == "/imu"
    assert len(read(tmp_path / "in.mcap", imu="/spare/imu").imu) == 0


def test_topics_without_messages_are_kept_or_named(convert, tmp_path):
    """They were dropped without a word; those that are not CDR may become another topic by their first message."""
    with (tmp_path / "in.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data")
        writer.register_channel("/never", "cdr", schema)
        writer.register_channel("/sent", "cdr", writer.register_schema("std_msgs/msg/Float32", "ros2msg", b"float32 data"))
        writer.register_channel("/silent", "json", writer.register_schema("Text", "jsonschema", b"{}"))
        writer.add_message(writer.register_channel("/sent", "cdr", schema), 1, b"\0\1\0\0" + bytes(8), 1)
        writer.finish()
    done = convert(tmp_path / "in.mcap", tmp_path / "out.mcap")
    assert "topics without messages are left out: /silent" in done.stderr
    with Log(tmp_path / "out.mcap") as log:
        assert {name: topic.count for name, topic in log.topics.items()} == {"/never": 0, "/sent": 1}


def test_metadata_of_each_part_of_a_bag_are_kept(convert, tmp_path):
    for number in range(2):
        write_log(tmp_path / "bag" / f"run_{number}.mcap", beside=number == 0)
    assert convert(tmp_path / "bag", tmp_path / "out.mcap").returncode == 0
    with (tmp_path / "out.mcap").open("rb") as file:
        found = {record.name: record.metadata for record in make_reader(file).iter_metadata()}
        file.seek(0)
        assert [record.name for record in make_reader(file).iter_attachments()] == ["calibration.yaml"]
    assert found["rig"] == {"camera": "left", "mount": "roof"}


def test_attachments_of_a_part_whose_recorder_died_are_kept(convert, tmp_path):
    part = write_log(tmp_path / "bag" / "run_0.mcap", beside=True)
    raw = part.read_bytes()
    part.write_bytes(raw[: int.from_bytes(raw[-28:-20], "little") - 13])
    assert convert(tmp_path / "bag", tmp_path / "out.mcap").returncode == 3  # the part was not finished
    with (tmp_path / "out.mcap").open("rb") as file:
        assert [record.data for record in make_reader(file).iter_attachments()] == [b"gain: 1"]
