"""Logs of other writers, in every layout and encoding; and logs that must be refused, with a reason."""

from __future__ import annotations

import logging
import random
import re
import shutil
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.records import Chunk, ChunkIndex
from mcap.writer import Writer

from imutool.cleaning import look, raw_batches
from imutool.errors import ConfigError, LogError
from imutool.log_info.inspection import inspect
from imutool.mcap_io.codec import messages, schemas
from imutool.mcap_io.codec.decode import decode_imu
from imutool.mcap_io.codec.encode import encode_imu, encode_pose, encode_vector3
from imutool.mcap_io.file_writer import LogWriter
from imutool.mcap_io.index import LogIndex
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read, read_recordings
from imutool.mcap_io.recovery.recovered_log import RecoveredLog
from imutool.mcap_io.topics import DERIVED_KEY, VELOCITY_KEY
from imutool.mcap_io.write import Series, chunks, write
from imutool.recording import Imu, Recording
from imutool.sensor.made_up_flight import flight

START_NS = 1_403_638_128_245_096_960
Message = tuple[str, str, int, int, int, bytes]
Foreign = Callable[..., Path]
Make = Callable[..., bytes]


def imu_messages(make: Make, topic: str = "/imu", count: int = 20, **options: Any) -> list[Message]:
    values = np.arange(3.0 * count).reshape(count, 3)
    stamps = [START_NS + 10_000_000 * i for i in range(count)]
    return [(topic, schemas.IMU, t, t, i, make(schemas.IMU, t, values[i], -values[i], **options)) for i, t in enumerate(stamps)]


def poses(make: Make, topic: str, kind: str = schemas.POSE, count: int = 5, **options: Any) -> list[Message]:
    q = np.array([0.5, -0.5, 0.5, 0.5])
    each = [(START_NS + 10_000_000 * i + 3, np.array([i, 2.0, 3.0])) for i in range(count)]
    return [(topic, kind, t, t, i, make(kind, t, p, q, **options)) for i, (t, p) in enumerate(each)]


def test_messages_of_many_small_chunks_are_decoded_together(foreign: Foreign, flight: list[Message], layout: str) -> None:
    with Log(foreign(flight, layout)) as log:
        one_by_one = [rows for _, rows in log.rows(["/imu/data"])]
        cut_up = [rows.where(slice(n, n + 1)) for rows in one_by_one for n in range(len(rows.sequence))]
        together = [rows for _, rows in messages.joined(("/imu/data", rows) for rows in cut_up)]
    assert len(together) < len(cut_up) == 900
    assert all(rows.payload.size <= 2 * messages.BATCH_BYTES for rows in together)
    for column in range(len(messages.Rows._fields) - 1):
        expected = np.concatenate([rows[column] for rows in one_by_one])
        assert np.concatenate([rows[column] for rows in together]).tolist() == expected.tolist()
    payloads = [bytes(payload) for rows in together for payload in rows.payload]
    assert payloads == [bytes(payload) for rows in one_by_one for payload in rows.payload]


def test_every_layout_reads_the_same(foreign: Foreign, flight: list[Message], layout: str) -> None:
    path = foreign(flight, layout, metadata={"vehicle": {"id": "7"}}, attachments=(b"a" * 70_000, b""))
    with Log(path) as log:
        assert {t.name: t.count for t in log.topics.values()} == {"/imu/data": 900, "/mocap": 100, "/height": 180}
        assert (log.index.header.profile, log.imu_topics, log.pose_topics) == ("ros2", ["/imu/data"], ["/mocap"])
        assert log.topics["/imu/data"].schema_encoding == "ros2msg"
        assert log.topics["/imu/data"].metadata == {"frame": "x"}
        assert log.metadata() == {"vehicle": {"id": "7"}}
        batches = list(raw_batches(log, "/imu/data"))
        mine = [message for message in flight if message[0] == "/imu/data"]
        assert np.concatenate(list(log.stamps("/imu/data"))).tolist() == [m[2] for m in mine]
        assert np.concatenate([b.log_time for b in batches]).tolist() == [m[2] for m in mine]
        assert np.concatenate([b.publish_time for b in batches]).tolist() == [m[3] for m in mine]
        assert np.concatenate([b.sequence for b in batches]).tolist() == [m[4] for m in mine]
        assert {b.frame_id for b in batches} == {"imu"}
        expected = np.concatenate([decode_imu(np.frombuffer(m[5], np.uint8)[None]).gyro for m in mine])
        assert np.concatenate([b.gyro for b in batches]).tobytes() == expected.tobytes()
        assert sum(len(b.stamp_ns) for b in log.pose_batches("/mocap")) == 100
    recording = read(path)
    assert (recording.name, recording.imu_topic, recording.source) == ("foreign", "/imu/data", "")
    assert recording.imu.gyro.tobytes() == expected.tobytes()
    assert list(recording.truths) == ["/mocap"]
    assert len(recording.scalars["/height"]) == 180
    assert recording.metadata == {"vehicle": {"id": "7"}}


def test_time_of_a_recording_is_the_stamp_and_selection_is_by_log_time(foreign: Foreign, flight: list[Message]) -> None:
    path = foreign(flight)
    imu = [message for message in flight if message[0] == "/imu/data"]
    recording = read(path, start_ns=imu[100][2], end_ns=imu[199][2])
    assert recording.imu.t_ns.tolist() == [START_NS + 5_000_000 * i for i in range(100, 200)]


@pytest.mark.parametrize("kind", [schemas.POSE, schemas.POSE_COVARIANCE, schemas.ODOMETRY, schemas.TRANSFORM])
def test_truth_comes_from_any_pose_message(foreign: Foreign, make: Make, kind: str) -> None:
    log = foreign(imu_messages(make) + poses(make, "/odom", kind))
    assert read(log).truths == {}
    assert read(log).other_poses == {"/odom": "odometry"}
    recording = read(log, truth="/odom")
    assert recording.truth_caveat == "/odom (odometry) is no truth: poses made with this IMU hide errors of it"
    truth = recording.truths["/odom"]
    assert truth.p_wb[:, 0].tolist() == [0, 1, 2, 3, 4]
    assert truth.q_wb_wxyz[0].tolist() == [0.5, -0.5, 0.5, 0.5]
    assert truth.v_w is None


def test_goals_are_poses_of_no_body(foreign: Foreign, make: Make) -> None:
    recording = read(foreign(imu_messages(make) + poses(make, "/odom", schemas.ODOMETRY) + poses(make, "/goal_pose")))
    assert (dict(recording.truths), dict(recording.other_poses)) == ({}, {"/odom": "odometry"})


def tree(make: Make, children: list[str], count: int = 4) -> list[Message]:
    q = np.array([1.0, 0, 0, 0])
    return [
        ("/tf", schemas.TF, t, t, 0, make(schemas.TF, t, *[(np.array([k, 0.0, 0]), q, c) for k, c in enumerate(children)]))
        for t in (START_NS + 1 + i for i in range(count))
    ]


def test_transforms_that_are_the_truth_count_beside_odometry(foreign: Foreign, make: Make) -> None:
    moved = [("/vicon/tf", *message[1:]) for message in tree(make, ["drone"])]
    recording = read(foreign(imu_messages(make) + poses(make, "/odom", schemas.ODOMETRY) + moved + tree(make, ["base"])))
    assert (list(recording.truths), dict(recording.other_poses)) == (["/vicon/tf/drone"], {"/odom": "odometry"})


def test_transforms_are_an_estimate_that_is_named_by_its_child_frame(foreign: Foreign, make: Make) -> None:
    several = foreign(imu_messages(make) + tree(make, ["base", "/arm"]), name="several")
    unnamed = read(several)
    assert (dict(unnamed.truths), dict(unnamed.other_poses)) == ({}, {"/tf": "estimate"})
    recording = read(several, truth="/tf/arm")
    assert list(recording.truths) == ["/tf/arm"]
    assert recording.truths["/tf/arm"].p_wb[:, 0].tolist() == [1, 1, 1, 1]
    assert "/tf/arm (estimate) is no truth" in recording.truth_caveat
    with pytest.raises(LogError, match=r"/tf has 2 child frames.*/tf/base, /tf/arm"):
        read(several, truth="/tf")
    with pytest.raises(LogError, match=r"no poses on /tf/leg.*/tf/base, /tf/arm"):
        read(several, truth="/tf/leg")
    both = foreign(imu_messages(make) + poses(make, "/mocap") + tree(make, ["base"]), name="both")
    assert list(read(both).truths) == ["/mocap"]
    assert list(read(both, truth="/tf").truths) == ["/tf/base"]


def test_ros1_messages_in_mcap_read_as_ros2_ones_do(foreign: Foreign, make: Make) -> None:
    messages = imu_messages(make, ros1=True) + poses(make, "/vicon", schemas.TRANSFORM, ros1=True)
    path = foreign(messages, ros1=True)
    twin = foreign(imu_messages(make) + poses(make, "/vicon", schemas.TRANSFORM), name="twin")
    with Log(path) as log:
        assert (log.index.header.profile, log.imu_topics) == ("ros1", ["/imu"])
        topic = log.topics["/imu"]
        assert (topic.schema_name, topic.schema_encoding, topic.message_encoding) == (schemas.IMU, "ros1msg", "ros1")
    assert read(path).imu == read(twin).imu
    assert read(path).truths == read(twin).truths


def test_quaternions_off_by_more_than_a_recording_takes_are_made_unit(foreign: Foreign, make: Make) -> None:
    q = [np.array([0.5, 0.5, 0.5, 0.5]) * (1 + e) for e in (0, 9e-7, 1e-4)]
    messages = [
        ("/p", schemas.POSE, START_NS + i, START_NS + i, i, make(schemas.POSE, START_NS + i, np.zeros(3), q[i]))
        for i in range(3)
    ]
    truth = read(foreign(imu_messages(make) + messages)).truths["/p"]
    assert truth.q_wb_wxyz[:2].tobytes() == np.array(q[:2]).tobytes()
    assert np.linalg.norm(truth.q_wb_wxyz[2]) == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize("lost", [np.zeros(4), np.full(4, np.nan)])
def test_poses_that_tracking_lost_are_left_out(
    foreign: Foreign, make: Make, lost: np.ndarray, caplog: pytest.LogCaptureFixture
) -> None:
    q = [np.array([0.5, 0.5, 0.5, 0.5])] * 3 + [lost] * 2
    messages = [
        ("/p", schemas.POSE, START_NS + i, START_NS + i, i, make(schemas.POSE, START_NS + i, np.zeros(3), q[i]))
        for i in range(5)
    ]
    truth = read(foreign(imu_messages(make) + messages)).truths["/p"]
    assert truth.t_ns.tolist() == [START_NS + i for i in range(3)]
    assert "/p: 2 of 5 poses are lost (NaN, or a quaternion of zero) and left out" in caplog.text
    with pytest.raises(LogError, match=r"/p: 2 of 2 poses are lost .*; expected poses of a tracked body"):
        read(foreign(imu_messages(make) + messages[3:], name="none"))


def test_our_own_derived_channels_are_no_imus_but_can_be_named(recording: Recording, tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    imu = recording.imu
    with LogWriter(path) as log:
        for topic, metadata, gyro in (("/imu0", {}, imu.gyro), ("/imu0/debiased", {DERIVED_KEY: "/imu0"}, imu.gyro + 1)):
            channel = log.channel(topic, schemas.IMU, metadata)
            series = Series(channel, imu.t_ns, (imu.t_ns, gyro, imu.accel), lambda t, g, a: encode_imu(t, g, a, "b"))
            for chunk in chunks([series]):
                log.chunk(chunk)
    assert read(path).imu == imu
    assert np.array_equal(read(path, imu="/imu0/debiased").imu.gyro, imu.gyro + 1)


def test_frames_that_change_within_a_topic_come_as_batches_of_their_own(foreign: Foreign, make: Make) -> None:
    messages = imu_messages(make)
    other = imu_messages(make, frames=("c", ""))
    messages[5], messages[6] = other[5], other[6]
    with Log(foreign(messages)) as log:
        batches = list(raw_batches(log, "/imu"))
    assert [(b.frame_id, len(b.stamp_ns)) for b in batches] == [("a", 5), ("c", 2), ("a", 13)]


def test_a_chunk_that_states_times_beyond_any_is_not_left_out(
    foreign: Foreign, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The IMU had no messages, and nothing was said."""
    for record in (Chunk, ChunkIndex):
        whole, late = record.write, partial(replace, message_start_time=2**64 - 1)
        monkeypatch.setattr(record, "write", lambda self, to, whole=whole, late=late: whole(late(self), to))
    path = foreign(imu_messages(make))
    with RecoveredLog(path) as log:
        assert sum(len(rows.payload) for _, rows in log.rows(["/imu"])) == 20
    assert len(read(path).imu) == 20


def test_a_payload_that_is_no_message_is_refused_by_its_number(foreign: Foreign, make: Make) -> None:
    messages = imu_messages(make)
    *head, payload = messages[7]
    messages[7] = (*head, payload[:12] + b"\xff" * 4 + payload[16:])  # the length of a text
    with pytest.raises(LogError, match=r"message 7 \(log .*\) is no sensor_msgs/msg/Imu: .*\. Cut the log before or after it"):
        read(path := foreign(messages))
    imu = inspect(path).imu[0]
    assert (imu.samples, imu.not_finite) == (20, 1)
    assert [w for w in imu.warnings if w.startswith("message 7 (log ")]  # the report on all others was refused, too
    with Log(path) as log:
        assert np.flatnonzero(look(log, "/imu").dropped).tolist() == [7]


def test_images_that_are_none_are_left_out_and_named(foreign: Foreign, make: Make, caplog: pytest.LogCaptureFixture) -> None:
    bad = [("/cam", schemas.IMAGE, START_NS + i, START_NS + i, i, bytes(range(40, 80))) for i in range(3)]
    with caplog.at_level(logging.WARNING):
        recording = read(foreign(imu_messages(make) + bad))
    assert len(recording.imu) == 20
    assert recording.frames == {}
    assert "/cam is left out: payload starts with 28 29 2a 2b" in caplog.text


def test_scalars_a_recording_cannot_hold_are_left_out_and_named(
    foreign: Foreign, make: Make, caplog: pytest.LogCaptureFixture
) -> None:
    values = [1.0, float("nan"), 2.0]
    bad = [("/battery", schemas.FLOAT, START_NS + i, START_NS + i, i, make(schemas.FLOAT, 0, v)) for i, v in enumerate(values)]
    good = [("/height", schemas.FLOAT, START_NS + i, START_NS + i, i, make(schemas.FLOAT, 0, 1.0)) for i in range(3)]
    with caplog.at_level(logging.WARNING):
        recording = read(foreign(imu_messages(make) + bad + good))
    assert list(recording.scalars) == ["/height"]
    assert "/battery is left out: message 1 (log time 1403638128.245 s) has values [nan]" in caplog.text


# ── memory and what is not done ──────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def long_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Forty chunks of IMU messages, 14 MB unpacked."""
    rng = np.random.default_rng(0)
    count = 120_000
    imu = Imu(START_NS + 1_000_000 * np.arange(count), rng.normal(size=(count, 3)), rng.normal(size=(count, 3)))
    path = tmp_path_factory.mktemp("long") / "log.mcap"
    write(Recording("long", imu), path)
    return path


def test_reading_holds_one_chunk_and_batches_keep_no_chunk_alive(long_log: Path) -> None:
    chunk = 1 << 20
    with Log(long_log) as log:
        tracemalloc.start()
        try:
            for _ in raw_batches(log, "/imu0"):
                pass
            assert tracemalloc.get_traced_memory()[1] < 8 * chunk  # 43 MB unpacked in all
            kept = list(raw_batches(log, "/imu0"))
            own = sum(column.nbytes for batch in kept for column in batch[:-1])
            assert tracemalloc.get_traced_memory()[0] < 1.1 * own + chunk
        finally:
            tracemalloc.stop()


def test_a_recording_is_read_with_one_column_in_memory_twice(long_log: Path) -> None:
    tracemalloc.start()
    try:
        imu = read(long_log).imu
        own = imu.t_ns.nbytes + imu.gyro.nbytes + imu.accel.nbytes
        assert tracemalloc.get_traced_memory()[1] < 1.9 * own  # 2.5 where the parts of all columns stay to the end
    finally:
        tracemalloc.stop()


def test_scalars_of_three_columns_are_read_on_request(tmp_path: Path) -> None:
    recording = flight(3, duration_s=5.0)
    path = tmp_path / "log.mcap"
    write(recording, path)
    with Log(path) as log:
        (every,), (numbers,) = read_recordings(log), read_recordings(log, vectors=False)
    assert {name: scalars for name, scalars in every.scalars.items() if scalars.values.shape[1] == 1} == numbers.scalars
    assert len(numbers.scalars) < len(every.scalars)
    assert numbers.imu == every.imu
    assert numbers.truth == every.truth


def test_stamps_come_from_the_indexes_and_unpack_nothing(long_log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: LogIndex, *_: object) -> None:
        raise AssertionError("a chunk was unpacked")

    monkeypatch.setattr(LogIndex, "unpack", refuse)
    with Log(long_log) as log:
        stamps = np.concatenate(list(log.stamps("/imu0")))
    assert np.array_equal(stamps, START_NS + 1_000_000 * np.arange(120_000))


def test_message_indexes_spare_following_the_records_one_by_one(long_log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("the records of a chunk were followed one by one")

    monkeypatch.setattr("imutool.mcap_io.codec.messages.parse", refuse)
    with Log(long_log) as log:
        assert sum(len(batch.stamp_ns) for batch in raw_batches(log, "/imu0")) == 120_000


def test_chunks_of_other_topics_are_not_unpacked(recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "log.mcap"
    write(recording, path)
    unpack, seen = LogIndex.unpack, []
    monkeypatch.setattr(LogIndex, "unpack", lambda self, block: (seen.append(block), unpack(self, block))[1])
    with Log(path) as log:
        blocks = log.index.blocks
        (imu,) = log.channel_ids("/imu0")
        for _ in raw_batches(log, "/imu0"):
            pass
    assert seen == [block for block in blocks if imu in block.indexes]
    assert 1 < len(seen) < len(blocks)


# ── refusals ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_missing_file_and_a_folder_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nothing.mcap: cannot be opened \(No such file"):
        read(tmp_path / "nothing.mcap")
    with pytest.raises(ConfigError, match=r"is a folder; expected an MCAP log.*imutool fleet.*imutool convert"):
        read(tmp_path)


def test_an_empty_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    path.touch()
    with pytest.raises(LogError, match=r"empty.mcap: the file is empty; expected an MCAP log"):
        read(path)


@pytest.mark.parametrize("content", [b"t", b"time,gyro\n0,1\n" * 50])
def test_a_text_file_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "text.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match="this is not an MCAP log: it starts with b't"):
        read(path)


@pytest.mark.parametrize("layout", ["zstd", "no-summary", "unchunked"])
def test_a_log_cut_anywhere_is_refused_with_the_byte(foreign: Foreign, flight: list[Message], layout: str) -> None:
    path = foreign(flight, layout)
    whole = path.read_bytes()
    for cut in (*range(1, 60, 3), *range(60, len(whole), len(whole) // 20), *range(len(whole) - 40, len(whole))):
        path.write_bytes(whole[:cut])
        with pytest.raises(LogError, match=rf"cut short at byte {cut}\b"):
            read(path)


def test_a_cut_log_says_inside_which_record(foreign: Foreign, flight: list[Message]) -> None:
    path = foreign(flight)
    with Log(path) as log:
        chunk = log.index.blocks[1]
    path.write_bytes(path.read_bytes()[: chunk.offset + 5000])
    expected = rf"byte {chunk.offset + 5000}, inside the Chunk record at byte {chunk.offset}; .*imutool repair"
    with pytest.raises(LogError, match=expected):
        read(path)


@pytest.mark.parametrize("layout", ["zstd", "lz4", "plain", "no-summary"])
def test_a_flipped_bit_in_any_chunk_is_found(foreign: Foreign, flight: list[Message], layout: str) -> None:
    path = foreign(flight, layout)
    whole = bytearray(path.read_bytes())
    with Log(path) as log:
        blocks = log.index.blocks
    assert len(blocks) > 2
    for block in blocks:
        damaged = whole.copy()
        damaged[block.offset + block.length - 40] ^= 1
        path.write_bytes(damaged)
        with pytest.raises(LogError, match=rf"the chunk at byte {block.offset} "):
            read(path)


@pytest.mark.parametrize("layout", ["zstd", "no-summary", "no-message-index", "unchunked", "lz4"])
def test_random_damage_is_refused_or_harmless_but_never_a_traceback(
    foreign: Foreign, flight: list[Message], layout: str
) -> None:
    path = foreign(flight[:150], layout, chunk_size=8000, metadata={"a": {"b": "c"}}, attachments=(b"data",))
    whole, rng, refusals = path.read_bytes(), random.Random(5), []
    for at in (*range(1, 60), *range(0, len(whole), len(whole) // 60), *range(len(whole) - 400, len(whole), 2)):
        damaged = bytearray(whole)
        if rng.random() < 0.5:
            damaged[at] ^= rng.randrange(1, 256)
        else:
            damaged[at : at + 8] = (2 ** rng.randrange(8, 63)).to_bytes(8, "little")
        path.write_bytes(damaged[: len(whole)])
        try:
            read(path)
        except LogError as error:
            refusals.append(str(error))
    assert len(refusals) > 100
    assert all(str(path) in refusal for refusal in refusals)


def test_a_chunk_that_claims_to_unpack_to_an_enormous_size_is_refused(foreign: Foreign, flight: list[Message]) -> None:
    path = foreign(flight, "no-summary")
    with Log(path) as log:
        block = log.index.blocks[0]
    whole = bytearray(path.read_bytes())
    whole[block.offset + 25 : block.offset + 33] = (2**62).to_bytes(8, "little")
    path.write_bytes(whole)
    with pytest.raises(LogError, match=str(2**62)):
        read(path)


def test_a_log_without_imu_lists_its_topics(foreign: Foreign, make: Make) -> None:
    with pytest.raises(LogError, match=r"no IMU topic; expected .* /mocap \(geometry_msgs/msg/PoseStamped\)"):
        read(foreign(poses(make, "/mocap")))
    with pytest.raises(LogError, match=r"no IMU topic; expected .* among topics \(the log has none\)\.$"):
        read(foreign([], name="nothing"))
    vectors = [
        (f"/{name}", schemas.VECTOR3, START_NS, START_NS, 0, make(schemas.VECTOR3, START_NS, np.ones(3))) for name in "ab"
    ]
    with pytest.raises(
        LogError, match=r"no IMU topic; expected .* `imu` gyro=TOPIC,accel=TOPIC joins the vectors of a gyroscope"
    ):
        read(foreign(vectors, name="vectors"))


@pytest.mark.parametrize("ros1", [False, True])
def test_an_imu_whose_definition_has_another_order_is_read_in_its_own(tmp_path: Path, make: Make, ros1: bool) -> None:
    text = schemas.ros1_definition(schemas.IMU) if ros1 else schemas.definition(schemas.IMU)
    other = {"angular_velocity": "linear_acceleration", "linear_acceleration": "angular_velocity"}
    text = re.sub("|".join(other), lambda found: other[found[0]], text)
    path = tmp_path / "odd.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        language, encoding = ("ros1msg", "ros1") if ros1 else ("ros2msg", "cdr")
        channel = writer.register_channel("/imu", encoding, writer.register_schema(schemas.IMU, language, text.encode()))
        for n in range(5):
            payload = make(schemas.IMU, 1000 + n, np.array([0.0, 0.0, 9.8]), np.array([0.1, 0.2, 0.3]), ros1=ros1)
            writer.add_message(channel, 1000 + n, payload, 1000 + n)
        writer.finish()
    imu = read(path).imu
    assert (imu.gyro[0].tolist(), imu.accel[0].tolist()) == ([0.1, 0.2, 0.3], [0.0, 0.0, 9.8])


@pytest.mark.parametrize(
    ("encoding", "hint"),
    [
        ("cbor", "Messages in cbor are not searched for an IMU: record them as"),
        ("msgpack", "A message in msgpack is an IMU if its fields are named as"),
        ("protobuf", "A message in protobuf is an IMU if its fields are named as"),  # which is installed
        (
            "json",
            "A message in json is an IMU .*; messages of several samples each are read from a file, one JSON",
        ),
    ],
)
def test_a_log_without_an_imu_says_how_messages_are_searched(tmp_path: Path, encoding: str, hint: str) -> None:
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_message(writer.register_channel("/imu", encoding, 0), 1, b"\xa0", 1)
        writer.finish()
    with pytest.raises(LogError, match=f"no IMU topic.* {hint}"):
        read(tmp_path / "log.mcap")


def test_several_imus_are_listed(foreign: Foreign, make: Make) -> None:
    path = foreign(imu_messages(make, "/left") + imu_messages(make, "/right"))
    with pytest.raises(LogError, match=r"2 IMU topics: /left, /right. Choose one with `imu`"):
        read(path)
    assert read(path, imu="/right").imu_topic == "/right"


def test_a_topic_that_is_not_there_or_is_something_else_is_refused(foreign: Foreign, make: Make) -> None:
    path = foreign(imu_messages(make) + poses(make, "/mocap"))
    with pytest.raises(LogError, match=r"no topic /imu9; expected /imu\.?$"):
        read(path, imu="/imu9")
    with pytest.raises(LogError, match=r"/mocap carries geometry_msgs/msg/PoseStamped; expected /imu\.?$"):
        read(path, imu="/mocap")
    with pytest.raises(LogError, match="no poses on /truth; expected /mocap"):
        read(path, truth="/truth")
    with pytest.raises(LogError, match=r"/imu carries sensor_msgs/msg/Imu; expected /mocap\.?$"):
        read(path, truth="/imu")
    with Log(path) as log, pytest.raises(LogError, match="no topic /x"):
        next(log.stamps("/x"))


def test_another_topic_of_two_types_leaves_the_imu_readable(tmp_path: Path, make: Make) -> None:
    with (path := tmp_path / "two.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        kind = {k: writer.register_schema(k, "ros2msg", schemas.definition(k).encode()) for k in (schemas.IMU, schemas.POSE)}
        imu = writer.register_channel("/imu", "cdr", kind[schemas.IMU])
        writer.register_channel("/both", "cdr", kind[schemas.POSE])
        writer.register_channel("/both", "json", 0)
        for _, _, *times, sequence, payload in imu_messages(make):
            writer.add_message(imu, times[0], payload, times[1], sequence)
        writer.finish()
    assert len(read(path).imu) == 20
    with pytest.raises(LogError, match="/both carries geometry_msgs/msg/PoseStamped and no type in json; expected"):
        read(path, truth="/both")


def test_an_unknown_encoding_is_named(foreign: Foreign, make: Make) -> None:
    with pytest.raises(LogError, match="/imu is encoded as 'json'; expected cdr or ros1"):
        read(foreign(imu_messages(make), encoding="json"))


@pytest.mark.parametrize(("step", "word"), [(0, "repeats"), (-5, "goes back")])
def test_a_stamp_that_does_not_increase_names_message_and_stamps(foreign: Foreign, make: Make, step: int, word: str) -> None:
    messages = imu_messages(make, count=400)
    for i in (350, 351):  # the second one is not to be named
        topic, kind, log_time, publish_time, sequence, _ = messages[i]
        stamp = START_NS + 10_000_000 * 349 + step
        payload = make(kind, stamp, np.zeros(3), np.zeros(3))
        messages[i] = (topic, kind, log_time, publish_time, sequence, payload)
    path = foreign(messages, chunk_size=20_000)  # the pair lies in two batches or in one: it must not matter
    before = START_NS + 10_000_000 * 349
    expected = (
        rf"/imu: message 350 \(sequence 350\) has the stamp {before + step} ns, which {word}: .* has {before} ns.*--clean"
    )
    with pytest.raises(LogError, match=expected):
        read(path)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_nan_and_infinity_in_imu_or_truth_are_refused(foreign: Foreign, make: Make, bad: float) -> None:
    messages = imu_messages(make)
    t = messages[7][2]
    messages[7] = ("/imu", schemas.IMU, t, t, 7, make(schemas.IMU, t, np.zeros(3), np.array([0, bad, 0])))
    with pytest.raises(LogError, match=r"/imu: message 7 \(log .*\) has linear_acceleration \[0.0, (nan|inf), 0.0\].*--clean"):
        read(foreign(messages))
    pose = ("/mocap", schemas.POSE, t, t, 0, make(schemas.POSE, t, np.array([bad, 0, 0]), np.ones(4) / 2))
    with pytest.raises(LogError, match=r"/mocap: 1 of 1 poses are lost"):
        read(foreign([*imu_messages(make), pose], name="pose"))


def with_velocities(path: Path, times: list[int]) -> Path:
    """A log with poses at 1, 2 and 3 ns, and velocities at these times: so many metres a second along x."""
    t_ns, zeros, q_wxyz = np.array([1, 2, 3]), np.zeros((3, 3)), np.tile([1.0, 0, 0, 0], (3, 1))
    v_ns = np.array(times, np.int64)
    v_w = v_ns[:, None] * np.array([1.0, 0.0, 0.0])
    with LogWriter(path) as log:
        velocity = log.channel("/v", schemas.VECTOR3, {VELOCITY_KEY: "/p"})
        group = [
            Series(log.channel("/imu", schemas.IMU), t_ns, (t_ns, zeros, zeros), partial(encode_imu, frame_id="b")),
            Series(log.channel("/p", schemas.POSE), t_ns, (t_ns, zeros, q_wxyz), partial(encode_pose, frame_id="w")),
            Series(velocity, v_ns, (v_ns, v_w), partial(encode_vector3, frame_id="w")),
        ]
        for chunk in chunks(group):
            log.chunk(chunk)
    return path


def test_velocities_that_do_not_belong_to_their_poses_are_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="/p: the velocities on /v have other stamps than the poses"):
        read(with_velocities(tmp_path / "log.mcap", [4, 5, 6]))


@pytest.mark.parametrize("times", [[1, 2], [2, 3], [1, 3, 4]])
def test_poses_and_velocities_that_damage_parted_are_used_where_both_are_left(
    tmp_path: Path, times: list[int], caplog: pytest.LogCaptureFixture
) -> None:
    (poses,) = read(with_velocities(tmp_path / "log.mcap", times)).truths.values()
    both = [t for t in times if t <= 3]
    assert poses.v_w is not None
    assert poses.t_ns.tolist() == poses.v_w[:, 0].tolist() == both
    assert "/p: poses without a velocity are left out: 1" in caplog.text


def test_poses_whose_velocities_are_all_lost_are_read_without(tmp_path: Path) -> None:
    (poses,) = read(with_velocities(tmp_path / "log.mcap", [])).truths.values()
    assert poses.t_ns.tolist() == [1, 2, 3]
    assert poses.v_w is None


def test_reading_leaves_the_file_as_it_is(foreign: Foreign, flight: list[Message], tmp_path: Path) -> None:
    path = foreign(flight)
    copy = Path(shutil.copy2(path, tmp_path / "copy"))
    read(path)
    assert path.read_bytes() == copy.read_bytes()
    assert path.stat().st_mtime_ns == copy.stat().st_mtime_ns
