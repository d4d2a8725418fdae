"""Whatever the layout, every record of a source stands byte for byte in its copy, however the bytes went there."""

from __future__ import annotations

import errno
import os
import resource
import signal
import stat
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer

from imutool.errors import ConfigError, DataError, LogError
from imutool.mcap_io import Verified
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.decode import ImuBatch
from imutool.mcap_io.codec.encode import encode_imu
from imutool.mcap_io.codec.messages import message_rows
from imutool.mcap_io.file_writer import Chunk, LogWriter, free_id
from imutool.mcap_io.log import Log
from imutool.mcap_io.passthrough.added_topics import DerivedBatch, NewTopic
from imutool.mcap_io.rewrite import rewrite
from imutool.mcap_io.storage import local
from imutool.mcap_io.storage.source import Digest, Source, sha256
from imutool.mcap_io.verify import verify
from imutool.mcap_io.write import write
from imutool.recording import Recording

Message = tuple[str, int, int, int, bytes]  # topic, log time, publish time, sequence, payload
Foreign = Callable[..., Path]
FLIPS = 250  # single bytes changed, of the few thousand that make up indexes and summary


class Half:
    """Every message again, at half the rate of turn."""

    def __init__(self, source_topic: str) -> None:
        self.source_topic = source_topic
        self.topics = [NewTopic(f"{source_topic}/half", schemas.IMU)]

    def __call__(self, batch: ImuBatch) -> DerivedBatch:
        return DerivedBatch(batch, [encode_imu(batch.stamp_ns, 0.5 * batch.gyro, batch.accel, batch.frame_id)])


def data_records(path: Path) -> list[tuple[int, bytes]]:
    """Opcode and bytes of every record of the data section, by nothing but the format's framing."""
    raw, at, found = path.read_bytes(), 8, []
    while raw[at] != Opcode.DATA_END:
        (length,) = struct.unpack_from("<Q", raw, at + 1)
        found.append((raw[at], raw[at : at + 9 + length]))
        at += 9 + length
    return found


def messages(path: Path, *, ordered: bool) -> list[Message]:
    """Every message: by the `mcap` package's indexes in order of log time, or by its walk in order of the file."""
    with path.open("rb") as file:
        if ordered:
            rows = [(c.topic, m) for _, c, m in make_reader(file, validate_crcs=True).iter_messages()]
        else:
            topics, rows = dict[int, str](), list[tuple[str, Any]]()
            for record in StreamReader(file, validate_crcs=True).records:
                if type(record).__name__ == "Channel":
                    topics[record.id] = record.topic
                elif type(record).__name__ == "Message":
                    rows.append((topics[record.channel_id], record))
    return [(topic, m.log_time, m.publish_time, m.sequence, m.data) for topic, m in rows]


# ── any layout ───────────────────────────────────────────────────────────────────────────────────────────────────────

LAYOUTS = st.fixed_dictionaries(
    {
        "compression": st.sampled_from(list(CompressionType)),
        "chunk_size": st.sampled_from([1, 400, 3_000, 100_000]),
        "use_chunking": st.sampled_from([True, True, False]),
        "index_types": st.sampled_from([IndexType.ALL, IndexType.NONE, IndexType.CHUNK, IndexType.MESSAGE]),
        "repeat_channels": st.booleans(),
        "repeat_schemas": st.booleans(),
        "use_statistics": st.booleans(),
        "use_summary_offsets": st.booleans(),
        "enable_crcs": st.booleans(),
        "enable_data_crcs": st.booleans(),
    }
)
TOPICS = ("/imu/a", "/imu/b", "/camera", "/empty")
MIXES = st.lists(st.tuples(st.sampled_from(TOPICS[:3]), st.integers(0, 3_000), st.integers(0, 900)), min_size=1, max_size=40)


def write_mix(path: Path, mix: list[tuple[str, int, int]], layout: dict[str, Any]) -> list[Message]:
    """A log of two IMUs and a camera as `mcap` writes it; log times jump as they like, so that chunks overlap."""
    rng, rows = np.random.default_rng(0), list[Message]()
    with path.open("wb") as file:
        writer = Writer(file, **layout)
        writer.start("ros2")
        imu = writer.register_schema(schemas.IMU, "ros2msg", schemas.definition(schemas.IMU).encode())
        image = writer.register_schema(schemas.IMAGE, "ros2msg", b"uint8[] data")
        ids = {topic: writer.register_channel(topic, "cdr", imu if "imu" in topic else image) for topic in TOPICS}
        for number, (topic, log_time, size) in enumerate(mix):
            stamps = np.array([1_000_000 * (number + 1)])
            frame = "x" * (size % 7)  # payloads of several lengths, and not all of one layout
            payload = encode_imu(stamps, rng.normal(size=(1, 3)), np.ones((1, 3)), frame)[0].tobytes()
            published = log_time + 1 if number % 3 else 2**64 - 1 - log_time  # a publisher may have no clock
            rows.append((topic, log_time, published, number, payload if "imu" in topic else rng.bytes(size)))
            writer.add_message(ids[topic], *(rows[-1][k] for k in (1, 4, 2, 3)))
            if number == 5:
                writer.add_attachment(1, 2, "a.bin", "x/y", rng.bytes(2_000))
                writer.add_metadata("m", {"k": "v"})
        writer.finish()
    return rows


@settings(max_examples=120, deadline=None)
@given(
    mix=MIXES,
    layout=LAYOUTS,
    check=st.sampled_from(["all", "imu", "none"]),
    topics=st.sampled_from([(), TOPICS[:1], TOPICS[:2]]),
)
def test_any_log_passes_through_and_gains_its_channels(
    tmp_path_factory: pytest.TempPathFactory,
    mix: list[tuple[str, int, int]],
    layout: dict[str, Any],
    check: str,
    topics: tuple[str, ...],
) -> None:
    folder = tmp_path_factory.mktemp("any")
    source, copy = folder / "in.mcap", folder / "out.mcap"
    rows = write_mix(source, mix, layout)
    with Log(source) as log:
        known = set(log.topics)  # without a summary, nothing tells of a topic that has no messages
    derived = [Half(topic) for topic in topics if topic in known]
    report = rewrite(source, copy, derived, metadata={"imutool": {"a": "b"}}, check=check)

    kept = [record for opcode, record in data_records(source) if opcode not in (Opcode.MESSAGE, Opcode.MESSAGE_INDEX)]
    there = iter(record for _, record in data_records(copy))
    assert all(record in there for record in kept), "every record, byte for byte, in the order of the source"
    old = [row for row in messages(copy, ordered=False) if not row[0].endswith("/half")]
    assert old == messages(source, ordered=False) == rows
    new = [(topic, *row[1:4]) for row in rows for topic in [f"{row[0]}/half"] if row[0] in topics]
    found = messages(copy, ordered=True)
    assert [row[1] for row in found] == sorted(row[1] for row in found)
    assert sorted(row[:4] for row in found) == sorted([row[:4] for row in rows] + new)
    assert report.copied == len(rows)
    assert report.added == {f"{d.source_topic}/half": sum(row[0] == d.source_topic for row in rows) for d in derived}
    with Log(copy) as log:
        verify(copy, log.index.counts())
        assert report.verified == Verified(check, report.verified.chunks_checked, len(log.index.blocks))
        assert log.index.definitions_known


# ── however the bytes go ─────────────────────────────────────────────────────────────────────────────────────────────


def unable(*_: Any, **__: Any) -> int:
    raise OSError(errno.EXDEV, os.strerror(errno.EXDEV))


def broken(*_: Any, **__: Any) -> int:
    raise OSError(errno.EIO, os.strerror(errno.EIO))


def stuck(*_: Any, **__: Any) -> int:
    return 0


def without_a_number(_: object) -> None:
    return None


def without_data_crc(path: Path) -> None:
    """Takes out the CRC of the data section, which most recorders leave out too."""
    with Log(path) as log:
        at = log.index.data_end + 9
    whole = bytearray(path.read_bytes())
    whole[at : at + 4] = bytes(4)
    path.write_bytes(whole)


@pytest.fixture
def source(recording: Recording, tmp_path: Path) -> Path:
    """Images and an IMU in chunks of their own."""
    path = tmp_path / "in.mcap"
    write(recording, path)
    without_data_crc(path)
    return path


CALLS = {
    "copy_file_range": [],
    "sendfile": [(os, "copy_file_range", unable)],
    "bytes": [(os, "copy_file_range", unable), (os, "sendfile", unable)],
    "a call that stops": [(os, "copy_file_range", stuck)],
    "files without numbers": [(local, "descriptor", without_a_number)],
}


@pytest.mark.parametrize("way", CALLS)
def test_every_way_to_copy_gives_the_same_file(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, way: str) -> None:
    rewrite(source, tmp_path / "expected.mcap", [], metadata={})
    for module, name, instead in CALLS[way]:
        monkeypatch.setattr(module, name, instead)
    rewrite(source, tmp_path / "out.mcap", [], metadata={})
    assert (tmp_path / "out.mcap").read_bytes() == (tmp_path / "expected.mcap").read_bytes()


def test_the_kernel_copies_what_stays_in_its_place_and_what_moves(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []
    real = os.copy_file_range
    monkeypatch.setattr(os, "copy_file_range", lambda *args, **options: asked.append(args[2]) or real(*args, **options))
    rewrite(source, tmp_path / "as_it_is.mcap", [], metadata={})
    assert sum(asked) > 0.9 * source.stat().st_size
    asked.clear()
    rewrite(source, tmp_path / "moved.mcap", [Half("/imu0")], metadata={})  # by the new Channel records, at the front
    with Log(source) as log:
        without_imu = [block for block in log.index.blocks if not block.may_hold(log.channel_ids("/imu0"))]
    assert sum(asked) >= sum(block.end - block.offset for block in without_imu) > 0


@pytest.mark.parametrize("name", ["copy_file_range", "sendfile"])
def test_a_kernel_that_copies_a_little_at_a_time_is_asked_again(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    rewrite(source, tmp_path / "expected.mcap", [], metadata={})
    real, moved = getattr(os, name), []

    def little(a: int, b: int, c: int, *rest: int, **options: int) -> int:
        count = real(a, b, min(c, 70_001), **options) if name == "copy_file_range" else real(a, b, c, min(rest[0], 70_001))
        moved.append(count)
        return int(count)

    if name == "sendfile":
        monkeypatch.setattr(os, "copy_file_range", unable)
    monkeypatch.setattr(os, name, little)
    rewrite(source, tmp_path / "out.mcap", [], metadata={})
    assert (tmp_path / "out.mcap").read_bytes() == (tmp_path / "expected.mcap").read_bytes()
    assert sum(moved) > 0.9 * source.stat().st_size  # and hardly a byte came this way


def test_a_file_the_system_refuses_to_grow_is_said_and_leaves_nothing(source: Path, tmp_path: Path) -> None:
    """The kernel copies by itself up to the limit, and its refusal is no traceback either."""
    limits, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, limits[1]))
    try:
        with pytest.raises(ConfigError, match=r"out.mcap: cannot be written \(File too large\)"):
            rewrite(source, tmp_path / "out.mcap", [], metadata={})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert [path.name for path in tmp_path.iterdir()] == ["in.mcap"]


def test_a_disk_that_cannot_be_read_is_not_called_a_disk_that_cannot_be_written(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel says the same of both; what follows tells them apart."""
    real = Source.at

    def at(self: Source, offset: int, length: int) -> bytes:
        if offset + length > 2_000_000 > offset and self.path == source:
            raise LogError(f"cannot be read at byte {offset} (Input/output error)")
        return real(self, offset, length)

    for name in ("copy_file_range", "sendfile"):
        monkeypatch.setattr(os, name, broken)
    monkeypatch.setattr(Source, "at", at)
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(LogError, match=r"in.mcap: cannot be read at byte"):
        rewrite(source, tmp_path / "out.mcap", [], metadata={})
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_the_data_crc_is_stated_where_the_source_states_one(recording: Recording, source: Path, tmp_path: Path) -> None:
    write(recording, tmp_path / "own.mcap")
    for path, states in ((source, False), (tmp_path / "own.mcap", True)):
        out = tmp_path / f"out_{path.name}"
        rewrite(path, out, [Half("/imu0")], metadata={})
        with out.open("rb") as file:
            stated = next(r.data_section_crc for r in StreamReader(file).records if type(r).__name__ == "DataEnd")
        assert bool(stated) == states
        with Log(out) as log:
            verify(out, log.index.counts())


# ── what is checked ──────────────────────────────────────────────────────────────────────────────────────────────────


def image_chunk(path: Path) -> int:
    """A byte inside the packed data of a chunk of images."""
    with Log(path) as log:
        ids = log.channel_ids("/cam0/image_raw/compressed")
        block = next(b for b in log.index.blocks if not ids.isdisjoint(b.indexes))
    return block.offset + block.length - 1000


def test_a_chunk_that_is_not_looked_into_is_not_called_checked(source: Path, tmp_path: Path) -> None:
    with Log(source) as log:
        chunks, imu = len(log.index.blocks), sum(b.may_hold(log.channel_ids("/imu0")) for b in log.index.blocks)
    reports = {
        check: rewrite(source, tmp_path / f"{check}.mcap", [Half("/imu0")], metadata={}, check=check).verified
        for check in ("all", "imu", "none")
    }
    new = reports["all"].chunks - chunks
    assert new > 0
    assert reports["none"] == Verified("none", imu, chunks + new)
    assert reports["imu"] == Verified("imu", imu + new, chunks + new)
    assert reports["all"] == Verified("all", chunks + new, chunks + new)


def test_all_finds_the_damage_that_the_others_pass_on(source: Path, tmp_path: Path) -> None:
    raw = bytearray(source.read_bytes())
    raw[image_chunk(source)] ^= 1
    source.write_bytes(raw)
    rewrite(source, tmp_path / "imu.mcap", [Half("/imu0")], metadata={})
    with pytest.raises(LogError, match="the chunk at byte"):
        rewrite(source, tmp_path / "all.mcap", [Half("/imu0")], metadata={}, check="all")
    assert not (tmp_path / "all.mcap").exists()
    with pytest.raises(ConfigError, match="check: unknown mode 'some'; expected all, imu, none"):
        rewrite(source, tmp_path / "some.mcap", [], metadata={}, check="some")


@pytest.mark.parametrize("check", ["all", "none"])
def test_no_byte_of_the_indexes_and_the_summary_can_change_unseen(source: Path, tmp_path: Path, check: str) -> None:
    """What a message index says of one message, only the unpacked chunk can contradict: that much `none` leaves out."""
    path = tmp_path / "out.mcap"
    rewrite(source, path, [Half("/imu0")], metadata={"imutool": {}})
    with Log(path) as log:
        counts, blocks, start = log.index.counts(), log.index.blocks, log.index.footer.summary_start
    whole = path.read_bytes()
    places = [at for b in blocks for at in range(b.offset, b.offset + 9)]
    if check == "all":
        places += [at for b in blocks for at in range(b.offset + b.length, b.end)]
    else:
        places += [at + byte for b in blocks for at in b.indexes.values() for byte in range(15)]
    places += range(start, len(whole))
    rng = np.random.default_rng(0)
    for at in rng.choice(places, FLIPS, replace=False).tolist():
        damaged = bytearray(whole)
        damaged[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            verify(path, counts, unpacked=None if check == "all" else ())
        except LogError:
            continue
        pytest.fail(f"byte {at} of {len(whole)} changed, and nobody saw it")


def test_metadata_is_asked_for_when_it_is_known_what_is_checked(source: Path, tmp_path: Path) -> None:
    asked: list[Verified] = []

    def metadata(verified: Verified) -> dict[str, dict[str, str]]:
        asked.append(verified)
        return {"imutool": {"chunks": str(verified.chunks)}}

    report = rewrite(source, tmp_path / "out.mcap", [Half("/imu0")], metadata=metadata)
    assert asked == [report.verified]
    with Log(tmp_path / "out.mcap") as log:
        assert log.metadata()["imutool"]["chunks"] == str(report.chunks)


def test_a_log_with_the_largest_id_gets_new_topics_under_free_ones(tmp_path: Path) -> None:
    path = tmp_path / "in.mcap"
    with LogWriter(path) as out:
        channel = out.channel("/imu0", schemas.IMU)
        out.contents.channels[65535] = out.contents.channels.pop(channel)
        out.contents.channels[65535].id = 65535
        payload = encode_imu(np.array([1]), np.zeros((1, 3)), np.zeros((1, 3)), "x")
        rows = message_rows(65535, np.array([1]), np.array([1]), np.zeros(1, np.uint32), payload)
        out.chunk(Chunk(rows.tobytes(), np.array([65535], np.uint16), np.array([1]), np.array([0])))
    rewrite(path, tmp_path / "out.mcap", [Half("/imu0")], metadata={})
    with Log(tmp_path / "out.mcap") as log:
        ids = {topic: log.channel_ids(topic) for topic in log.topics}
    assert ids.pop("/imu0") == {1, 65535}  # its first record stands in the log as well
    assert sorted(i for each in ids.values() for i in each) == list(range(2, len(ids) + 2))
    with pytest.raises(DataError, match="the log has 65535 channels"):
        free_id(dict.fromkeys(range(1, 65536)), "channel")


# ── in place ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_in_place_is_the_same_log_under_the_same_name_and_permissions(source: Path, tmp_path: Path) -> None:
    rewrite(source, tmp_path / "expected.mcap", [Half("/imu0")], metadata={})
    source.chmod(0o640)
    os.link(source, tmp_path / "other_name.mcap")
    before, names = sha256(source), sorted(p.name for p in tmp_path.iterdir())
    rewrite(source, None, [Half("/imu0")], metadata={})
    assert source.read_bytes() == (tmp_path / "expected.mcap").read_bytes()
    assert stat.S_IMODE(source.stat().st_mode) == 0o640
    assert sha256(tmp_path / "other_name.mcap") == before
    assert sorted(p.name for p in tmp_path.iterdir()) == names


def test_in_place_through_a_link_replaces_the_log_and_leaves_the_link(source: Path, tmp_path: Path) -> None:
    rewrite(source, tmp_path / "expected.mcap", [Half("/imu0")], metadata={})
    (tmp_path / "links").mkdir()
    link = tmp_path / "links" / "log.mcap"
    link.symlink_to(source)
    rewrite(link, None, [Half("/imu0")], metadata={})
    assert link.is_symlink()
    assert source.read_bytes() == (tmp_path / "expected.mcap").read_bytes()
    assert [p.name for p in link.parent.iterdir()] == ["log.mcap"]


def test_in_place_of_a_log_that_grows_is_refused(source: Path, tmp_path: Path) -> None:
    def metadata(_: Verified) -> dict[str, dict[str, str]]:
        with source.open("ab") as file:
            file.write(b"more")
        return {}

    names = sorted(p.name for p in tmp_path.iterdir())
    with pytest.raises(LogError, match=r"in.mcap: the log changed while it was copied\. Wait"):
        rewrite(source, None, [], metadata=metadata)
    assert source.read_bytes().endswith(b"more")
    assert sorted(p.name for p in tmp_path.iterdir()) == names


KILLED = """
import os, signal, sys
from pathlib import Path
from imutool.mcap_io.storage import local, target
from imutool.mcap_io.rewrite import rewrite
place, count = sys.argv[2], int(sys.argv[3])

def dies(owner, name):
    real = getattr(owner, name)
    def wrapped(*a, **k):
        global count
        count -= 1
        if count < 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return real(*a, **k)
    setattr(owner, name, wrapped)

if place != "never":
    owner, _, name = place.rpartition(".")
    dies({"Target": target.Target, "os": os, "Path": Path, "local": local}[owner], name)
rewrite(Path(sys.argv[1]), None, [], metadata={"imutool": {"new": "yes"}})
"""
POINTS = [
    ("Target.write", 0),
    ("Target.copy", 0),
    ("Target.write", 3),
    ("Target.flush", 0),
    ("os.fsync", 0),
    ("Path.replace", 0),
    ("local._settle", 0),
    ("never", 0),
]


def test_killed_at_any_moment_the_old_log_or_the_new_is_there_whole(source: Path, tmp_path: Path) -> None:
    old = source.read_bytes()
    rewrite(source, tmp_path / "expected.mcap", [], metadata={"imutool": {"new": "yes"}})
    new, seen = (tmp_path / "expected.mcap").read_bytes(), []
    for place, count in POINTS:
        source.write_bytes(old)
        line = [sys.executable, "-c", KILLED, str(source), place, str(count)]
        done = subprocess.run(line, check=False, capture_output=True, timeout=120)
        assert done.returncode == (0 if place == "never" else -9), done.stderr
        now = source.read_bytes()
        assert now in (old, new), f"killed in {place}"
        seen.append(now == new)
    assert seen == [False] * 6 + [True] * 2  # from the rename on


# ── the digest of the source ─────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture
def threads() -> Iterator[None]:
    """No thread is left running."""
    before = threading.active_count()
    yield
    assert threading.active_count() == before


@pytest.mark.parametrize("size", [0, 1, 3_000_000])
def test_the_digest_beside_other_work_is_the_digest(tmp_path: Path, threads: None, size: int) -> None:
    path = tmp_path / "x"
    path.write_bytes(os.urandom(size))
    with Digest(path) as digest:
        assert digest.result() == sha256(path)
    with Digest(path):
        pass  # an error elsewhere: nobody asks, and nothing waits for the rest


def test_a_file_that_shrinks_has_no_digest(tmp_path: Path, threads: None, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "x"
    path.write_bytes(bytes(1000))
    with Digest(path) as digest:
        assert digest.result()
    monkeypatch.setattr(
        "imutool.mcap_io.storage.source.Source.at", lambda self, at, n: (_ for _ in ()).throw(LogError("cut short"))
    )
    with Digest(path) as digest, pytest.raises(LogError, match="x: cut short"):
        digest.result()
