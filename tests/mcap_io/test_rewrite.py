"""A rewritten log holds every message of its source as it was, whatever the source's layout, and the new ones with them."""

from __future__ import annotations

import hashlib
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Attachment, Channel, Chunk, ChunkIndex, Metadata, Schema
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from imutool.cleaning.survey import raw_batches
from imutool.debiasing import debias
from imutool.errors import ConfigError, LogError
from imutool.mcap_io.codec import schemas as schema
from imutool.mcap_io.codec.decode import ImuBatch, StampCheck, check_finite, decode_imu
from imutool.mcap_io.codec.encode import encode_imu, encode_vector3
from imutool.mcap_io.log import Log
from imutool.mcap_io.passthrough.added_topics import DerivedBatch, NewTopic
from imutool.mcap_io.read import read
from imutool.mcap_io.rewrite import rewrite
from imutool.mcap_io.storage.source import sha256
from imutool.mcap_io.topics import DERIVED_KEY
from imutool.mcap_io.verify import verify
from imutool.mcap_io.write import write
from imutool.recording import Imu, Recording

RERUN = Path(sys.executable).with_name("rerun")
BIAS = np.array([0.125, -0.25, 0.5])  # exact in binary, so that subtracting it loses nothing in the comparison
PROVENANCE = {"imutool": {"model": "static", "source_sha256": "abc"}}
Messages = list[tuple[str, str, int, int, int, bytes]]
Foreign = Callable[..., Path]


class Debias:
    """What the debias command feeds through: the corrected IMU, and what was taken off."""

    def __init__(self, source_topic: str) -> None:
        self.source_topic = source_topic
        self.topics = [
            NewTopic(f"{source_topic}/debiased", schema.IMU),
            NewTopic(f"{source_topic}/bias/gyro", schema.VECTOR3),
        ]
        self.stamps: list[int] = []
        self.clock = StampCheck()

    def __call__(self, batch: ImuBatch) -> DerivedBatch:
        check_finite(batch, angular_velocity=batch.gyro, linear_acceleration=batch.accel)
        self.clock.check(batch.stamp_ns, batch.sequence)
        self.stamps += batch.stamp_ns.tolist()
        bias = np.tile(BIAS, (len(batch.stamp_ns), 1))
        imu = encode_imu(batch.stamp_ns, batch.gyro - bias, batch.accel, batch.frame_id)
        return DerivedBatch(batch, [imu, encode_vector3(batch.stamp_ns, bias, batch.frame_id)])


def digest(path: Path, topics: set[str] | None = None) -> dict[str, str]:
    """Per topic, a hash over channel id, times, sequence and data of every message, by the `mcap` package in file order."""
    found: dict[str, hashlib._Hash] = {}
    with path.open("rb") as file:
        for _, channel, m in NonSeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False):
            if topics is None or channel.topic in topics:
                each = found.setdefault(channel.topic, hashlib.sha256())
                each.update(repr((channel.id, m.log_time, m.publish_time, m.sequence)).encode() + m.data)
    return {topic: each.hexdigest() for topic, each in found.items()}


def everything_else(path: Path) -> tuple[list[Attachment], list[Metadata]]:
    with path.open("rb") as file:
        records = list(StreamReader(file, validate_crcs=True).records)
    attachments = [r for r in records if isinstance(r, Attachment)]
    return attachments, [r for r in records if isinstance(r, Metadata)]


def definitions(path: Path) -> tuple[dict[int, Schema], dict[int, Channel]]:
    with path.open("rb") as file:
        records = list(StreamReader(file).records)
    return {r.id: r for r in records if isinstance(r, Schema)}, {r.id: r for r in records if isinstance(r, Channel)}


@pytest.fixture
def source(foreign: Foreign, flight: Messages, layout: str) -> Path:
    return foreign(
        flight, layout, metadata={"vehicle": {"id": "7"}, "imutool": {"name": "x"}}, attachments=(b"a" * 3_000_000, b"")
    )


def test_every_message_attachment_and_definition_passes_through(source: Path, tmp_path: Path, layout: str) -> None:
    target, before = tmp_path / "out.mcap", sha256(source)
    make = Debias("/imu/data")
    report = rewrite(source, target, [make], metadata=PROVENANCE)
    assert sha256(source) == before == hashlib.sha256(source.read_bytes()).hexdigest()
    old = {"/imu/data", "/mocap", "/height"}
    assert digest(target, old) == digest(source)
    new = {"/imu/data/debiased": 900, "/imu/data/bias/gyro": 900}
    assert (report.copied, report.added) == (1180, new)
    assert (report.source_bytes, report.target_bytes) == (source.stat().st_size, target.stat().st_size)
    attachments, metadata = everything_else(source)
    assert len(attachments) == 2
    copied_attachments, copied_metadata = everything_else(target)
    assert copied_attachments == attachments
    assert copied_metadata == [*metadata, Metadata(name="imutool", metadata=PROVENANCE["imutool"])]
    schemas, channels = definitions(source)
    new_schemas, new_channels = definitions(target)
    assert {i: new_schemas[i] for i in schemas} == schemas
    assert {i: new_channels[i] for i in channels} == channels
    assert min(new_channels.keys() - channels.keys()) == max(channels) + 1
    with Log(target) as log:
        assert log.imu_topics == ["/imu/data"]
        assert log.metadata()["imutool"] == {"name": "x"} | PROVENANCE["imutool"]


def test_the_summary_indexes_everything(source: Path, tmp_path: Path) -> None:
    target = tmp_path / "out.mcap"
    report = rewrite(source, target, [Debias("/imu/data")], metadata=PROVENANCE)
    with target.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        names = {i: c.topic for i, c in summary.channels.items()}
        counts = {names[i]: n for i, n in summary.statistics.channel_message_counts.items()}
        assert counts == {"/imu/data": 900, "/mocap": 100, "/height": 180} | report.added
        assert summary.statistics.message_count == 2980
        assert summary.statistics.chunk_count == len(summary.chunk_indexes) == report.chunks
        assert (len(summary.attachment_indexes), len(summary.metadata_indexes)) == (2, 3)
        ordered = [(c.topic, m.log_time) for _, c, m in reader.iter_messages()]  # by the indexes alone
        assert len(ordered) == 2980
        assert [t for _, t in ordered] == sorted(t for _, t in ordered)
        assert [a.data for a in reader.iter_attachments()] == [b"a" * 3_000_000, b""]
        assert [m.name for m in reader.iter_metadata()] == ["vehicle", "imutool", "imutool"]
        times = [t for _, t in ordered]
        assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (times[0], times[-1])
        for index in summary.chunk_indexes:
            check_message_indexes(target, index)


def check_message_indexes(path: Path, index: ChunkIndex) -> None:
    """Each entry of each message index leads to a message of its channel and time, and none is missing."""
    with Log(path) as log:
        block = next(b for b in log.index.blocks if b.offset == index.chunk_start_offset)
        found = log.index.unpack(block)
        listed = {(c, int(t), int(o)) for c in block.indexes for t, o in log.index.entries(block, c)}
        actual = zip(found.heads["channel"].tolist(), found.heads["log_time"].tolist(), found.offsets.tolist(), strict=True)
        assert listed == set(actual)
        assert (index.message_start_time, index.message_end_time) == (found.times().min(), found.times().max())


def test_derived_messages_carry_times_and_sequence_of_their_source(source: Path, tmp_path: Path) -> None:
    target, make = tmp_path / "out.mcap", Debias("/imu/data")
    rewrite(source, target, [make], metadata={})
    with Log(target) as log:
        raw, clean = list(raw_batches(log, "/imu/data")), list(raw_batches(log, "/imu/data/debiased"))
        topic = log.topics["/imu/data/bias/gyro"]
        bias = [batch for _, rows in log.rows([topic.name]) for batch in topic.decode_scalars(rows)]
        assert log.topics["/imu/data/debiased"].metadata[DERIVED_KEY] == "/imu/data"
    for name in ("log_time", "publish_time", "sequence", "stamp_ns", "accel"):
        ours, theirs = (np.concatenate([getattr(b, name) for b in batches]) for batches in (clean, raw))
        assert ours.tobytes() == theirs.tobytes()
    assert np.array_equal(np.concatenate([b.gyro for b in clean]), np.concatenate([b.gyro for b in raw]) - BIAS)
    assert np.concatenate([b.log_time for b in bias]).tolist() == np.concatenate([b.log_time for b in raw]).tolist()
    assert make.stamps == np.concatenate([b.stamp_ns for b in raw]).tolist()
    assert np.array_equal(read(target, imu="/imu/data/debiased").imu.gyro, read(source).imu.gyro - BIAS)


@pytest.mark.parametrize("layout", ["zstd", "lz4", "plain", "data-crc", "no-message-index"], indirect=True)
def test_chunks_are_copied_as_bytes_and_new_messages_have_chunks_of_their_own(source: Path, tmp_path: Path) -> None:
    target = tmp_path / "out.mcap"
    rewrite(source, target, [Debias("/imu/data")], metadata={})

    def chunks(path: Path) -> list[Chunk]:
        with path.open("rb") as file:
            return [r for r in StreamReader(file, emit_chunks=True).records if isinstance(r, Chunk)]

    before, after = chunks(source), chunks(target)
    copied = [chunk for chunk in after if chunk in before]
    assert copied == before
    assert len(after) > len(before)
    assert {chunk.compression for chunk in after} == {before[0].compression}
    assert all(chunk.uncompressed_crc for chunk in after)


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_our_own_logs_pass_through_and_other_programs_take_the_result(
    recording: Recording, tmp_path: Path, compression: str
) -> None:
    source, target = tmp_path / "in.mcap", tmp_path / "out.mcap"
    write(recording, source, compression=compression)
    rewrite(source, target, [Debias("/imu0")], metadata=PROVENANCE)
    assert digest(target, set(digest(source))) == digest(source)
    back = read(target)
    assert (back.imu, back.truths, back.name, back.source) == (
        recording.imu,
        recording.truths,
        recording.name,
        recording.source,
    )
    assert back.metadata == {**recording.metadata, **PROVENANCE}
    schemas, channels = definitions(target)
    names = {c.topic: schemas[c.schema_id].id for c in channels.values()}
    assert names["/imu0/debiased"] == names["/imu0"]  # the Imu schema that is there already
    with AnyReader([target]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
        imu = [c for c in reader.connections if c.topic == "/imu0/debiased"]
        rates = [reader.deserialize(raw, c.msgtype).angular_velocity for c, _, raw in reader.messages(connections=imu)]
    assert counts["/imu0/debiased"] == counts["/imu0/bias/gyro"] == len(recording.imu)
    assert np.array_equal([[v.x, v.y, v.z] for v in rates], recording.imu.gyro - BIAS)
    done = subprocess.run([RERUN, "mcap", "check", "--full", target], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert "WARN" not in done.stderr
    assert "warn" not in done.stdout


def test_a_second_rewrite_of_another_imu_adds_to_the_first(foreign: Foreign, flight: Messages, tmp_path: Path) -> None:
    second = [("/imu/b", *m[1:]) for m in flight if m[0] == "/imu/data"]
    source = foreign(flight + second)
    once, twice = tmp_path / "once.mcap", tmp_path / "twice.mcap"
    rewrite(source, once, [Debias("/imu/data")], metadata=PROVENANCE)
    rewrite(once, twice, [Debias("/imu/b")], metadata={"imutool": {"model": "other"}})
    assert digest(twice, set(digest(once))) == digest(once)
    with Log(twice) as log:
        assert log.imu_topics == ["/imu/data", "/imu/b"]
        assert log.metadata()["imutool"] == {"model": "other", "source_sha256": "abc"}
    both = tmp_path / "both.mcap"
    report = rewrite(source, both, [Debias("/imu/data"), Debias("/imu/b")], metadata={})
    assert len(report.added) == 4
    assert set(report.added.values()) == {900}


def test_nothing_derived_copies_and_indexes_the_log(source: Path, tmp_path: Path) -> None:
    target = tmp_path / "out.mcap"
    report = rewrite(source, target, [], metadata={})
    assert digest(target) == digest(source)
    assert report.added == {}
    again = tmp_path / "again.mcap"
    rewrite(target, again, [], metadata={})
    assert again.read_bytes() == target.read_bytes()


def test_a_commented_imu_schema_is_reused(foreign: Foreign, flight: Messages, tmp_path: Path) -> None:
    source, target = foreign(flight, "plain"), tmp_path / "out.mcap"
    whole = source.read_bytes()
    text = schema.definition(schema.IMU).encode()
    commented = text.replace(b"orientation_covariance\n", b"orientation_covariance#\n", 1)
    assert len(commented) == len(text) + 1
    at = text.index(b"std_msgs/Header header")
    commented = commented[:at] + commented[at:].replace(
        b"float64[9] linear_acceleration_covariance\n=", b"float64[9] linear_acceleration_covariance\n", 1
    )
    assert len(commented) == len(text)
    del whole, commented
    rewrite(source, target, [Debias("/imu/data")], metadata={})
    schemas, channels = definitions(target)
    names = {c.topic: c.schema_id for c in channels.values()}
    assert names["/imu/data/debiased"] == names["/imu/data"]
    assert [s.name for s in schemas.values()].count(schema.IMU) == 1


def test_ros1_logs_get_cdr_channels_beside_their_own(foreign: Foreign, make: Callable[..., bytes], tmp_path: Path) -> None:
    stamps = [1_000_000_000 + i for i in range(50)]
    messages = [
        ("/imu", schema.IMU, t, t, 0, make(schema.IMU, t, np.ones(3) * i, np.zeros(3), ros1=True)) for i, t in enumerate(stamps)
    ]
    source, target = foreign(messages, ros1=True), tmp_path / "out.mcap"
    rewrite(source, target, [Debias("/imu")], metadata={})
    assert digest(target, {"/imu"}) == digest(source)
    with Log(target) as log:
        assert (log.index.header.profile, log.topics["/imu/debiased"].message_encoding) == ("ros1", "cdr")
    assert np.array_equal(read(target, imu="/imu/debiased").imu.gyro, read(source).imu.gyro - BIAS)


def test_progress_reaches_its_end_and_never_goes_back(source: Path, tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    rewrite(source, tmp_path / "out.mcap", [Debias("/imu/data")], metadata={}, progress=lambda *at: told.append(at))
    assert len(told) > 3
    assert [done for done, _ in told] == sorted(done for done, _ in told)
    assert {total for _, total in told} == {2 * source.stat().st_size}
    assert told[-1][0] == told[-1][1]


def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    peaks = []
    for count in (10_000, 80_000):
        t_ns = 1_000_000 * np.arange(count)
        recording = Recording("x", Imu(t_ns, rng.normal(size=(count, 3)), rng.normal(size=(count, 3))))
        source, target = tmp_path / f"{count}.mcap", tmp_path / f"{count}.out.mcap"
        write(recording, source, compression="lz4")
        make = Debias("/imu0")
        make.stamps = type("Nothing", (list,), {"__iadd__": lambda self, other: self})()
        tracemalloc.start()
        try:
            rewrite(source, target, [make], metadata={})
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0] + 200_000  # eight times the log; the chunk indexes are all that grows
    assert peaks[1] < 16 << 20


# ── refusals ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_new_topic_that_is_there_already_is_refused(foreign: Foreign, flight: Messages, tmp_path: Path) -> None:
    once = tmp_path / "once.mcap"
    rewrite(foreign(flight), once, [Debias("/imu/data")], metadata={})
    with pytest.raises(LogError, match=r"/imu/data/debiased is in this log already; .*`imu`.*original log"):
        rewrite(once, tmp_path / "twice.mcap", [Debias("/imu/data")], metadata={})
    assert not (tmp_path / "twice.mcap").exists()


@pytest.mark.parametrize(("which", "value", "said"), [(4, 1e9, "repeats"), (500, np.nan, "angular_velocity")])
def test_imu_messages_no_model_can_take_are_refused(
    foreign: Foreign, flight: Messages, make: Callable[..., bytes], tmp_path: Path, which: int, value: float, said: str
) -> None:
    imu = [i for i, message in enumerate(flight) if message[0] == "/imu/data"]
    before, (topic, kind, log_time, publish_time, sequence, _) = flight[imu[which - 1]], flight[imu[which]]
    stamp = decode_imu(np.frombuffer(before[5], np.uint8)[None]).stamp_ns[0]
    payload = make(kind, int(stamp) + (0 if said == "repeats" else 1), np.full(3, value), np.zeros(3))
    flight[imu[which]] = (topic, kind, log_time, publish_time, sequence, payload)
    with pytest.raises(LogError, match=f"/imu/data: message .*{said}"):
        rewrite(foreign(flight), tmp_path / "out.mcap", [Debias("/imu/data")], metadata={})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["foreign.mcap"]


def test_a_source_topic_that_is_not_there_is_refused(foreign: Foreign, flight: Messages, tmp_path: Path) -> None:
    with pytest.raises(LogError, match="there is no topic /imu9"):
        rewrite(foreign(flight), tmp_path / "out.mcap", [Debias("/imu9")], metadata={})


@pytest.mark.parametrize("layout", ["zstd", "lz4", "plain", "no-summary"], indirect=True)
def test_a_corrupt_chunk_is_found_even_of_another_topic_and_nothing_is_left(source: Path, tmp_path: Path) -> None:
    whole = source.read_bytes()
    with Log(source) as log:
        blocks = log.index.blocks
    folder = tmp_path / "out"
    folder.mkdir()
    for block in blocks:
        damaged = bytearray(whole)
        damaged[block.offset + block.length - 40] ^= 4
        source.write_bytes(damaged)
        with pytest.raises(LogError, match=f"the chunk at byte {block.offset} "):
            rewrite(source, folder / "out.mcap", [Debias("/imu/data")], metadata={})
        assert list(folder.iterdir()) == []


@pytest.mark.parametrize("layout", ["data-crc"], indirect=True)
def test_damage_between_chunks_is_found_by_the_data_crc(source: Path, tmp_path: Path) -> None:
    whole = bytearray(source.read_bytes())
    whole[whole.index(b"a" * 1000) + 500] = ord("b")  # inside the attachment
    source.write_bytes(whole)
    with pytest.raises(LogError, match="the data section has CRC"):
        rewrite(source, tmp_path / "out.mcap", [], metadata={})
    assert not (tmp_path / "out.mcap").exists()


def test_the_source_cannot_be_the_target(foreign: Foreign, flight: Messages, tmp_path: Path) -> None:
    source = foreign(flight)
    before = sha256(source)
    (tmp_path / "link.mcap").symlink_to(source)
    for target in (source, tmp_path / "link.mcap", tmp_path / "." / source.name):
        with pytest.raises(ConfigError, match="the target is the source"):
            rewrite(source, target, [], metadata={}, overwrite=True)
    assert sha256(source) == before


def test_verify_finds_a_changed_byte_and_a_missing_message(recording: Recording, tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write(recording, path)
    with Log(path) as log:
        counts, blocks = log.index.counts(), log.index.blocks
    verify(path, counts)
    with pytest.raises(LogError, match=rf"the copy has {sum(counts.values())} messages"):
        verify(path, counts | {1: counts[1] + 1})
    whole = bytearray(path.read_bytes())
    whole[blocks[0].end - 3] ^= 1  # in a message index, which no chunk CRC covers
    path.write_bytes(whole)
    with pytest.raises(LogError, match=f"the message indexes behind the chunk at byte {blocks[0].offset} are damaged"):
        verify(path, counts, unpacked=())


def test_debias_keeps_the_encoding_of_ros1(foreign: Foreign, make: Callable[..., bytes], tmp_path: Path) -> None:
    stamps = [10**18 + 10**7 * i for i in range(300)]
    at_rest = np.random.default_rng(1).normal([0.01, 0.0, 0.0, 0.0, 0.0, 9.81], 1e-3, (300, 6))
    messages = [
        ("/imu", schema.IMU, t, t, 0, make(schema.IMU, t, row[:3], row[3:], ros1=True))
        for t, row in zip(stamps, at_rest, strict=True)
    ]
    source = foreign(messages, ros1=True)
    for encoding, target in (("own", tmp_path / "own.mcap"), ("cdr", tmp_path / "cdr.mcap")):
        debias(source, target, encoding=encoding)
    own, cdr = tmp_path / "own.mcap", tmp_path / "cdr.mcap"
    store, schemas = get_typestore(Stores.ROS1_NOETIC), dict[str, bytes]()
    with own.open("rb") as file:
        for schema_, channel, message in make_reader(file).iter_messages():
            assert schema_ is not None
            kind = schema.canonical(schema_.name)
            if channel.topic == "/imu/bias/gyro":
                assert store.deserialize_ros1(message.data, kind).vector.x == pytest.approx(0.01, abs=1e-3)
            assert channel.message_encoding == "ros1"
            assert schemas.setdefault(kind, schema_.data) == schema_.data
    for kind, data in schemas.items():
        assert store.generate_msgdef(kind, ros_version=1)[1] == _md5(get_types_from_msg(data.decode(), kind), kind)
    a, b = read(own, imu="/imu/debiased").imu, read(cdr, imu="/imu/debiased").imu
    assert np.array_equal(a.gyro, b.gyro)
    assert np.array_equal(a.accel, b.accel)
    assert np.array_equal(a.t_ns, b.t_ns)


def _md5(parsed: Any, kind: str) -> str:
    """Hash by which ROS 1 compares definitions."""
    store = get_typestore(Stores.EMPTY)
    store.register(parsed)
    return str(store.generate_msgdef(kind, ros_version=1)[1])
