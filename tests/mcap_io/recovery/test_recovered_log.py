"""Of a damaged log, whatever the damage: all that is sound comes back, nothing that is not, and what is lost is told."""

from __future__ import annotations

import json
import os
import random
import struct
import tracemalloc
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Chunk, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader
from support import log_damage

from imutool.errors import ConfigError, LogError
from imutool.log_info.inspection import inspect
from imutool.mcap_io import index
from imutool.mcap_io.codec import records
from imutool.mcap_io.codec.records import HEAD, MAGIC
from imutool.mcap_io.codec.ros2_definition import DEEPEST, parse
from imutool.mcap_io.index import MessageBlock
from imutool.mcap_io.log import Log
from imutool.mcap_io.recovery import summary
from imutool.mcap_io.recovery.recovered_log import RecoveredLog
from imutool.mcap_io.repair import RECORD, repair
from imutool.report import json_values

Message = tuple[str, int, int, int, bytes]  # topic, log time, publish time, sequence, payload
Messages = list[tuple[str, str, int, int, int, bytes]]
Foreign = Callable[..., Path]

content, of_block, stretches, by_mcap = log_damage.content, log_damage.of_block, log_damage.stretches, log_damage.by_mcap
ROOM_BYTES = 30 << 20
BUDGET_S = 20.0  # for one file, with every annotation checked on a busy machine
in_time = partial(log_damage.in_time, BUDGET_S)
UNCHUNKED = ("unchunked", "unchunked-no-summary")
EMPTY = ("std_msgs/msg/Empty", "std_msgs/msg/Float64")


@contextmanager
def in_room() -> Iterator[None]:
    """Refuses more memory than a few chunks take."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < ROOM_BYTES
    finally:
        tracemalloc.stop()


def some(seed: int, count: int, topics: tuple[str, str] = ("/a", "/b"), start_ns: int = 10**18) -> Messages:
    """Messages of random bytes on two topics."""
    rng = random.Random(seed)
    return [
        (topics[i % 3 > 1], EMPTY[i % 3 > 1], start_ns + 1000 * i, start_ns + i, i, rng.randbytes(rng.choice((5, 20, 20, 47))))
        for i in range(count)
    ]


def blocks(path: Path) -> list[MessageBlock]:
    with Log(path) as log:
        return log.index.blocks


def flip(path: Path, at: int, mask: int = 1) -> None:
    with path.open("r+b") as file:
        file.seek(at)
        (old,) = file.read(1)
        file.seek(at)
        file.write(bytes([old ^ mask]))


def put(path: Path, at: int, data: bytes) -> None:
    with path.open("r+b") as file:
        file.seek(at)
        file.write(data)


# ── whole logs ───────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_whole_log_is_whole(foreign: Foreign, tmp_path: Path, layout: str) -> None:
    path = foreign(some(1, 40), layout, chunk_size=300, attachments=(b"a" * 500,), metadata={"vehicle": {"id": "7"}})
    with Log(path) as strict, RecoveredLog(path) as log:
        log.check()
        assert content(log) == content(strict)
        assert log.losses is not None
        assert not log.losses
        assert log.losses.plain()["whole"]
        assert log.losses.unchecked == (40 if layout in UNCHUNKED else 0)
        assert log.topics == strict.topics
        original = content(log)
    report = repair(path, tmp_path / "out.mcap")
    assert report.whole
    assert report.messages == {"/a": 27, "/b": 13}
    assert Counter(by_mcap(tmp_path / "out.mcap")) == Counter(original)
    with Log(tmp_path / "out.mcap") as log:
        assert set(log.metadata()) == {"vehicle"}


def test_a_log_that_holds_nothing_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    for nothing in (b"", MAGIC, b"just text, no log" * 20, bytes(5000), MAGIC + bytes(5000), os.urandom(3000)):
        path.write_bytes(nothing)
        with pytest.raises(LogError, match=r"empty|not an MCAP log"), in_time():
            repair(path, tmp_path / "out.mcap")
        assert not (tmp_path / "out.mcap").exists()


# ── every way to be damaged ──────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def ways() -> Iterator[Callable[..., str]]:
    """Says what should not have happened to a damaged log, in one process for all layouts (`support/log_damage.py`)."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        yield lambda damage, *how: pool.submit(log_damage.findings, damage, *how).result(timeout=240)


def test_cut_at_and_around_every_record_all_that_is_whole_before_it_comes_back(
    foreign: Foreign, layout: str, ways: Callable[..., str]
) -> None:
    path = foreign(some(2, 4), layout, chunk_size=100, attachments=(b"abc",), metadata={"v": {"id": "7"}})
    assert ways(log_damage.after_a_cut, path) == ""


def test_of_a_thousand_corruptions_none_hangs_crashes_or_passes_bad_messages_on(
    foreign: Foreign, layout: str, ways: Callable[..., str]
) -> None:
    first = foreign(some(3, 24), layout, chunk_size=300, attachments=(b"abc" * 30,), metadata={"v": {"id": "7"}}, name="a")
    second = foreign(some(4, 24, ("/c", "/b"), 10**18 + 10**9), layout, chunk_size=300, name="b")
    assert ways(log_damage.after_corruption, first, second, layout) == ""


def test_cut_at_and_around_every_record_of_a_larger_log(foreign: Foreign, flight: Messages, tmp_path: Path) -> None:
    path = foreign(flight[:250], "zstd", chunk_size=20_000)
    whole, raw, position, edges = stretches(path), path.read_bytes(), len(MAGIC), set[int]()
    while position < len(raw) - len(MAGIC):
        edges |= {position - 1, position, position + 1}
        position += HEAD.size + HEAD.unpack_from(raw, position)[1]
    for cut in sorted(edges, reverse=True):
        os.truncate(path, cut)
        theory = sum(len(each) for _, end, each in whole if end <= cut)
        if cut > whole[0][0]:
            with in_time(), RecoveredLog(path) as log:
                assert sum(log.index.counts().values()) == theory, cut


# ── what is lost, what is mended ─────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("layout", ["zstd", "lz4", "plain", "data-crc"], indirect=True)
def test_a_flipped_byte_costs_its_chunk_and_its_messages_are_counted(foreign: Foreign, flight: Messages, layout: str) -> None:
    path = foreign(flight, layout, chunk_size=20_000)
    whole, block = stretches(path), blocks(path)[3]
    flip(path, block.offset + block.length - 30)
    with RecoveredLog(path) as log:
        found, losses = content(log), log.losses
        assert found == [m for start, _, each in whole if start != block.offset for m in each]
        (loss,) = losses.entries
        assert (loss.offset, loss.length, loss.exact) == (block.offset, block.length, True)
        lost = next(each for start, _, each in whole if start == block.offset)
        assert loss.counts == Counter(m[0] for m in lost)
        assert (loss.start_ns, loss.end_ns) == (lost[0][1], lost[-1][1])
        assert losses.exact
        assert losses.plain()["messages"] == len(lost)
    with pytest.raises(LogError, match=f"the chunk at byte {block.offset} "), Log(path) as strict:
        content(strict)


@pytest.mark.parametrize("layout", ["zstd", "no-summary-but-message-index"], indirect=True)
def test_a_zeroed_chunk_head_costs_that_chunk_alone_and_surviving_indexes_count_it(
    foreign: Foreign, flight: Messages, layout: str
) -> None:
    path = foreign(flight, layout, chunk_size=20_000)
    whole, block = stretches(path), blocks(path)[3]
    put(path, block.offset - 50, bytes(400))
    with RecoveredLog(path) as log:
        assert content(log) == [m for start, _, each in whole if start != block.offset for m in each]
        lost = next(each for start, _, each in whole if start == block.offset)
        assert log.losses.topics == Counter(m[0] for m in lost)


@pytest.mark.parametrize("layout", ["zstd", "lz4", "plain", "no-summary"], indirect=True)
@pytest.mark.parametrize("field", ["opcode", "length", "start", "inner length"])
def test_a_damaged_chunk_head_is_put_right_where_its_contents_are_sound(
    foreign: Foreign, flight: Messages, tmp_path: Path, layout: str, field: str
) -> None:
    path = foreign(flight, layout, chunk_size=20_000)
    whole, block = stretches(path), blocks(path)[3]
    name = len({"plain": "", "lz4": "lz4"}.get(layout, "zstd"))
    at, value = {
        "opcode": (block.offset, b"\x46"),
        "length": (block.offset + 1, (2**62).to_bytes(8, "little")),
        "start": (block.offset + 9, (block.start_ns - 10**9).to_bytes(8, "little")),
        "inner length": (block.offset + 9 + 32 + name, (77).to_bytes(8, "little")),
    }[field]
    put(path, at, value)
    with RecoveredLog(path) as log:
        assert content(log) == [m for _, _, each in whole for m in each]
        assert not log.losses
        assert any(f"the head of the chunk at byte {block.offset} was damaged" in line for line in log.losses.harmless)
    report = repair(path, tmp_path / "out.mcap")
    assert not report.losses
    assert not report.whole
    assert len(by_mcap(tmp_path / "out.mcap")) == len(flight)


def test_definitions_of_a_damaged_first_chunk_are_found_in_it_and_said_to_be_unproven(
    foreign: Foreign, flight: Messages
) -> None:
    path = foreign(flight, "no-summary", chunk_size=200_000)
    whole, block = stretches(path), blocks(path)[0]
    flip(path, block.offset + block.length - 30)
    with RecoveredLog(path) as log:
        assert content(log) == [m for _, _, each in whole[1:] for m in each]
        assert log.losses.unchecked_topics == ["/height", "/imu/data", "/mocap"]


def test_messages_that_nobody_defines_are_counted_and_left_out(foreign: Foreign, tmp_path: Path) -> None:
    path = foreign(some(5, 60), "no-summary", chunk_size=300)
    block = blocks(path)[0]
    put(path, block.offset, bytes(block.length))
    with pytest.raises(LogError, match="nothing in it can be saved"):
        repair(path, tmp_path / "out.mcap")
    with RecoveredLog(path) as log:
        assert content(log) == []
        assert set(log.losses.topics) == {"(channel 1, not defined)", "(channel 2, not defined)"}


@pytest.mark.parametrize("how", ["whole", "cut in a chunk", "header lost"])
def test_two_logs_in_one_file_keep_their_topics_although_their_ids_collide(
    foreign: Foreign, flight: Messages, tmp_path: Path, how: str
) -> None:
    first = foreign(flight, name="first", chunk_size=20_000)
    second = foreign([("/other", *m[1:]) if m[0] == "/imu/data" else m for m in flight[1:]][:300], name="second")
    whole, others, raw = stretches(first), by_mcap(second), first.read_bytes()
    middle = whole[len(whole) // 2]
    stop = len(raw) if how == "whole" else (middle[0] + middle[1]) // 2
    joined, target = tmp_path / "joined.mcap", tmp_path / "out.mcap"
    joined.write_bytes(raw[:stop] + second.read_bytes()[12 if how == "header lost" else 0 :])
    report = repair(joined, target)
    theory = [m for _, end, each in whole if end <= stop for m in each] + others
    assert Counter(by_mcap(target)) == Counter(theory)
    assert bool(report.losses) == (how != "whole")
    assert any("another log begins" in line for line in report.losses.harmless)


def test_messages_outside_chunks_resume_behind_a_broken_length(foreign: Foreign, flight: Messages, tmp_path: Path) -> None:
    path, target = foreign(flight, "unchunked"), tmp_path / "out.mcap"
    whole = stretches(path)
    for which in (100, 700):
        put(path, whole[which][0] + 1, (2**40).to_bytes(8, "little"))
    report = repair(path, target)
    theory = [m for i, (_, _, each) in enumerate(whole) if i not in (100, 700) for m in each]
    assert Counter(by_mcap(target)) == Counter(theory)
    assert report.losses.unchecked == len(theory)
    with target.open("rb") as file:  # what no CRC covered does not look proven afterwards
        chunks = [r for r in StreamReader(file, emit_chunks=True).records if isinstance(r, Chunk)]
    assert {chunk.uncompressed_crc for chunk in chunks} == {0}


def test_the_contents_of_a_damaged_chunk_are_never_taken_for_messages_outside_chunks(
    foreign: Foreign, flight: Messages
) -> None:
    path = foreign(flight, "plain", chunk_size=20_000)
    whole, block = stretches(path), blocks(path)[0]
    put(path, block.offset, bytes(300))  # no compression: the messages lie there to be read
    with RecoveredLog(path) as log:
        assert content(log) == [m for _, _, each in whole[1:] for m in each]
        assert log.losses.unchecked == 0


@pytest.mark.parametrize("layout", ["data-crc"], indirect=True)
def test_damage_that_only_the_crc_of_the_data_section_shows_is_told(foreign: Foreign, flight: Messages, layout: str) -> None:
    path = foreign(flight, layout, metadata={"vehicle": {"id": "7777"}})
    whole = path.read_bytes()
    flip(path, blocks(path)[2].end - 3)  # in a message index: the chunk says the same
    with RecoveredLog(path) as log:
        log.check()
        assert not log.losses
        assert any("message index" in line for line in log.losses.harmless)
    path.write_bytes(whole)
    flip(path, whole.index(b"7777") + 1)  # in metadata: nothing says the same
    with RecoveredLog(path) as log:
        log.check()
        assert "metadata" in log.losses.entries[0].reason


def test_a_damaged_attachment_is_left_out(foreign: Foreign, flight: Messages, tmp_path: Path) -> None:
    path, target = foreign(flight, attachments=(b"a" * 3000, b"b" * 3000)), tmp_path / "out.mcap"
    flip(path, path.read_bytes().index(b"b" * 100) + 5)
    report = repair(path, target)
    assert [loss.reason for loss in report.losses.entries] == [report.losses.entries[0].reason]
    assert "attachment" in report.losses.entries[0].reason
    with target.open("rb") as file:
        assert [a.data for a in make_reader(file).iter_attachments()] == [b"a" * 3000]
    assert len(by_mcap(target)) == len(flight)


def first_record(path: Path, opcode: Opcode) -> int:
    """Where the first record of a kind begins in a whole log."""
    raw, at = path.read_bytes(), len(MAGIC)
    while raw[at] != opcode:
        at += HEAD.size + HEAD.unpack_from(raw, at)[1]
    return at


@pytest.mark.parametrize("layout", UNCHUNKED, indirect=True)
def test_an_attachment_that_lacks_bytes_hides_no_messages_behind_it(foreign: Foreign, layout: str) -> None:
    path = foreign(some(2, 60), layout, attachments=(b"abc" * 300,))
    whole, at = content_of(path), first_record(path, Opcode.ATTACHMENT)
    raw = path.read_bytes()
    path.write_bytes(raw[: at + 200] + raw[at + 600 :])
    assert content_of(path) == whole


@pytest.mark.parametrize(
    ("layout", "cut", "inside"),
    [
        ("unchunked-no-summary", Opcode.ATTACHMENT, 200),
        ("no-index", Opcode.ATTACHMENT, 200),
        ("no-summary-but-message-index", Opcode.MESSAGE_INDEX, 40),
    ],
    indirect=["layout"],
)
def test_a_record_that_is_cut_off_hides_no_log_that_follows(foreign: Foreign, layout: str, cut: Opcode, inside: int) -> None:
    """Its messages were on the topics of the log before it: the ids are the same."""
    path = foreign(some(2, 60), layout, chunk_size=2000, attachments=(b"abc" * 300,))
    other = foreign(some(4, 60, ("/c", "/d"), 10**18 + 10**9), layout, chunk_size=2000, name="b")
    following, before, at = content_of(other), content_of(path), first_record(path, cut)
    path.write_bytes(path.read_bytes()[: at + inside] + other.read_bytes())
    found = content_of(path)
    assert [m for m in found if m[0] in ("/c", "/d")] == following
    assert set(found) <= {*before, *following}


def content_of(path: Path) -> list[Message]:
    with RecoveredLog(path) as log:
        log.check()
        return content(log)


@pytest.mark.parametrize("layout", ["no-index"], indirect=True)
def test_chunks_are_in_order_though_only_an_attachment_is_damaged(foreign: Foreign, tmp_path: Path, layout: str) -> None:
    """It was found while the chunks were copied, after they would have been put in order."""
    path = foreign(some(1, 40), layout, chunk_size=300, attachments=(b"a" * 3000,))
    raw, (first, second) = path.read_bytes(), [(b.offset, b.offset + b.length) for b in blocks(path)[3:5]]
    raw = raw[: first[0]] + raw[slice(*second)] + raw[first[1] : second[0]] + raw[slice(*first)] + raw[second[1] :]
    path.write_bytes(raw.replace(b"a" * 100, b"a" * 50 + b"b" + b"a" * 49, 1))
    report = repair(path, tmp_path / "out.mcap")
    assert ["attachment" in loss.reason for loss in report.losses.entries] == [True]
    starts = [block.start_ns for block in blocks(tmp_path / "out.mcap")]
    assert starts == sorted(starts)


# ── what is written ──────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("layout", ["zstd", "lz4", "plain", "no-message-index", "no-summary"], indirect=True)
def test_a_repaired_log_has_its_sound_chunks_as_they_were_and_everybody_reads_it(
    foreign: Foreign, flight: Messages, tmp_path: Path, layout: str
) -> None:
    path, target = foreign(flight, layout, chunk_size=20_000, metadata={"vehicle": {"id": "7"}}), tmp_path / "out.mcap"
    whole, raw, block = stretches(path), path.read_bytes(), blocks(path)[3]
    flip(path, block.offset + block.length - 30)
    os.truncate(path, blocks(path)[-1].offset + 100 if layout != "no-summary" else whole[-1][0] + 100)
    report = repair(path, target)
    theory = [m for start, _, each in whole[:-1] if start != block.offset for m in each]
    assert Counter(by_mcap(target)) == Counter(theory)
    assert report.messages == dict(sorted(Counter(m[0] for m in theory).items(), key=lambda item: item[0])) or report.messages
    after = target.read_bytes()
    assert all(raw[start:end] in after for start, end, _ in whole[:-1] if start != block.offset)
    assert raw[block.offset : block.offset + block.length] not in after
    with Log(target) as log:
        log.check()
        record = log.metadata()[RECORD]
        assert {b.offset for b in log.index.blocks if not b.indexes} == set()
    assert json.loads(record["topics"]) == report.losses.topics
    assert {s["offset"] for s in json.loads(record["stretches"])} == {loss.offset for loss in report.losses.entries}
    with AnyReader([target]) as reader:
        assert sum(1 for _ in reader.messages()) == len(theory)
    assert repair(target, tmp_path / "again.mcap").whole
    assert (tmp_path / "again.mcap").read_bytes() == after  # a log with every index and CRC is copied as it is
    with pytest.raises(ConfigError, match="exists"):
        repair(target, tmp_path / "again.mcap")


def test_one_damaged_chunk_among_small_ones_that_are_read_together(foreign: Foreign, tmp_path: Path) -> None:
    path = foreign(some(1, 40), chunk_size=1)
    whole, each = stretches(path), blocks(path)
    assert len(each) == 40
    flip(path, each[7].offset + each[7].length - 1)
    with RecoveredLog(path) as log:
        found = [payload.tobytes() for topic in ("/a", "/b") for _, rows in log.rows([topic]) for payload in rows.payload]
        assert log.losses
    left = [m for n, (_, _, messages) in enumerate(whole) if n != 7 for m in messages]
    assert sorted(found) == sorted(m[-1] for m in left)
    with Log(path) as strict, pytest.raises(LogError, match=f"the chunk at byte {each[7].offset} "):
        list(strict.rows(["/a", "/b"]))


@pytest.mark.parametrize("layout", ["zstd", "no-index"], indirect=True)
def test_a_small_chunk_that_is_damaged_is_no_message_index_of_the_one_before_it(
    foreign: Foreign, tmp_path: Path, layout: str
) -> None:
    """Told as a damaged message index it was, where the chunk before it would have had one as long."""
    path = foreign([(*m[:5], b"z" * 20) for m in some(1, 300)], layout, chunk_size=3000)
    each = blocks(path)
    assert each[2].length < 16 * 40  # bytes of a message index of its messages
    flip(path, each[2].offset + each[2].length - 9)
    with RecoveredLog(path) as log:
        log.check()
        (lost,) = log.losses.entries
        assert lost.offset == each[2].offset
        assert len(content(log)) < 300
    assert bool(lost.counts) == (layout == "zstd")


def test_a_channel_id_that_changed_where_no_crc_covers_it_is_lost_and_told(foreign: Foreign, tmp_path: Path) -> None:
    """`repair` ended with a KeyError."""
    path = foreign(some(1, 40), "plain", chunk_size=300)
    raw, at = bytearray(path.read_bytes()), blocks(path)[3].offset
    raw[at + 33 : at + 37] = bytes(4)  # its CRC
    assert raw[at + 49] == Opcode.MESSAGE
    raw[at + 58] ^= 16
    path.write_bytes(bytes(raw))
    report = repair(path, tmp_path / "out.mcap")
    assert sum(report.messages.values()) == 39
    assert sum(report.losses.topics.values()) == 1


def test_a_chunk_without_a_crc_that_states_other_times_is_sound_in_the_repaired_log(foreign: Foreign, tmp_path: Path) -> None:
    """It was copied with its head, which the new index contradicted: the repaired log was damaged."""
    path = foreign(some(1, 40), "zstd", chunk_size=300)
    raw, at = bytearray(path.read_bytes()), blocks(path)[3].offset
    raw[at + 9] ^= 1  # where its first message stands
    raw[at + 33 : at + 37] = bytes(4)  # its CRC
    raw[blocks(path)[-1].end :] = b""  # the summary, which contradicts it
    path.write_bytes(bytes(raw))
    saved = sum(repair(path, tmp_path / "out.mcap").messages.values())
    with RecoveredLog(tmp_path / "out.mcap") as log:
        log.check()
        assert log.losses.intact
        assert len(content(log)) == saved == 40


@pytest.mark.parametrize("layout", ["lz4"], indirect=True)
def test_an_lz4_frame_that_does_not_end_is_packed_anew(foreign: Foreign, tmp_path: Path, layout: str) -> None:
    """Its record was a byte too short. The last byte of the data, a zero, was taken for the first one of the end mark."""
    path = foreign([(*m[:5], m[5] + bytes(1)) for m in some(1, 40)], layout, chunk_size=300)
    block, raw = blocks(path)[3], bytearray(path.read_bytes())
    assert raw[block.offset + block.length - 6 : block.offset + block.length][1:] == bytes(5)
    raw[block.offset + 1] -= 1
    path.write_bytes(bytes(raw))
    saved = sum(repair(path, tmp_path / "out.mcap").messages.values())
    assert len(by_mcap(tmp_path / "out.mcap")) == saved


def test_damaged_stretches_are_kept_where_no_reader_takes_them_for_messages(
    foreign: Foreign, flight: Messages, tmp_path: Path
) -> None:
    path, target = foreign(flight, chunk_size=20_000), tmp_path / "out.mcap"
    whole, block = stretches(path), blocks(path)[3]
    flip(path, block.offset + block.length - 30)
    damaged_bytes = path.read_bytes()[block.offset : block.offset + block.length]
    report = repair(path, target, damaged="keep")
    assert report.kept == 1
    with target.open("rb") as file:
        (kept,) = make_reader(file).iter_attachments()
    assert (kept.name, kept.data) == (f"imutool/damaged/{block.offset}", damaged_bytes)
    assert len(by_mcap(target)) == sum(len(each) for start, _, each in whole if start != block.offset)


def test_nothing_is_written_where_it_should_not_be(foreign: Foreign, flight: Messages, tmp_path: Path) -> None:
    path = foreign(flight)
    before = path.read_bytes()
    (tmp_path / "there.mcap").write_text("mine")
    for target, options, said in (
        (path, {"overwrite": True}, "the target is the source"),
        (tmp_path / "there.mcap", {}, "the target exists"),
        (tmp_path / "out.mcap", {"damaged": "burn"}, "drop or keep"),
    ):
        with pytest.raises(ConfigError, match=said):
            repair(path, target, **options)
    assert path.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["foreign.mcap", "there.mcap"]


# ── hostile files ────────────────────────────────────────────────────────────────────────────────────────────────────


def chunk(packed: bytes, size: int, compression: bytes = b"zstd", crc: int = 0) -> bytes:
    body = struct.pack("<QQQII", 0, 1, size, crc, len(compression)) + compression + struct.pack("<Q", len(packed)) + packed
    return HEAD.pack(6, len(body)) + body


def hostile(path: Path, *parts: bytes) -> None:
    header = HEAD.pack(1, 8) + bytes(8)
    path.write_bytes(MAGIC + header + b"".join(parts) + HEAD.pack(15, 4) + bytes(4) + HEAD.pack(2, 20) + bytes(20) + MAGIC)


BOMB = zstandard.ZstdCompressor(level=1).compress(bytes(200 << 20))


@pytest.mark.parametrize("size", [0, 10, 1 << 20, 2**31 + 1, 2**62])
def test_a_chunk_that_unpacks_to_more_than_it_says_is_refused_without_unpacking_it(tmp_path: Path, size: int) -> None:
    path = tmp_path / "log.mcap"
    hostile(path, chunk(BOMB, size))
    with in_time(), in_room(), RecoveredLog(path) as log:
        assert log.losses
    with pytest.raises(LogError), in_time(), Log(path) as log:
        content(log)


def test_an_lz4_frame_that_goes_on_beyond_the_stated_size_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    body = records.build(Metadata(name="x", metadata={}))
    frame = lz4.frame.LZ4FrameCompressor()
    liar = frame.begin(source_size=len(body)) + frame.compress(body + bytes(200 << 20)) + bytes(4)
    for packed in (lz4.frame.compress(body + bytes(200 << 20)), liar):
        hostile(path, chunk(packed, len(body), b"lz4", zlib.crc32(body)))
        with in_time(), in_room(), RecoveredLog(path) as log:
            assert "unpack" in log.losses.entries[0].reason


def test_a_file_of_false_starts_is_searched_in_bounded_time(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    records_in_records = b"".join(HEAD.pack(5, (1 << 20) - i) + bytes(22) for i in range(20_000))
    path.write_bytes(MAGIC + bytes(9) + records_in_records + bytes(1 << 20))
    with pytest.raises(LogError, match=r"not an MCAP log.*imutool convert"), in_time():
        RecoveredLog(path)


def test_chunks_in_a_chunk_and_logs_in_an_attachment_stay_where_they_are(foreign: Foreign, tmp_path: Path) -> None:
    inner = foreign(some(6, 20), "plain", name="inner").read_bytes()
    path = foreign(some(7, 20), name="outer", attachments=(inner,))
    with RecoveredLog(path) as log:
        assert len(content(log)) == 20
    os.truncate(path, path.stat().st_size - 300)  # without its summary
    with RecoveredLog(path) as log:
        assert len(content(log)) == 20
    hostile(path, chunk(inner, len(inner), b"", zlib.crc32(inner)))
    with in_time(), RecoveredLog(path) as log:
        assert not content(log)


def test_huge_claims_of_metadata_and_attachments_cost_nothing(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    huge = struct.pack("<I", 2**32 - 1)
    attachment = HEAD.pack(9, 50) + bytes(16) + huge + bytes(30)
    metadata = HEAD.pack(12, 20) + huge + bytes(16)
    channel = HEAD.pack(4, 30) + bytes(4) + huge + bytes(22)
    hostile(path, attachment, metadata, channel)
    with in_time(), RecoveredLog(path) as log:
        assert len(log.losses.entries) == 3


def test_nothing_longer_than_a_chunk_may_be_comes_into_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(index, "MAX_SUMMARY", 1 << 20)
    monkeypatch.setattr(summary, "MAX_SUMMARY", 1 << 20)
    size = 50 << 20
    path, message = tmp_path / "log.mcap", struct.pack("<HIQQ", 1, 0, 0, 0)
    for start in (HEAD.pack(5, size) + message, HEAD.pack(6, size + 49) + struct.pack("<QQQIIQ", 0, 1, size, 7, 0, size)):
        hostile(path, start, bytes(size))
        with in_time(), in_room(), RecoveredLog(path, max_chunk=1 << 20) as log:
            assert log.losses.bytes > size
    footer = HEAD.pack(2, 20) + struct.pack("<QQI", 8, 0, 1) + MAGIC
    path.write_bytes(MAGIC + HEAD.pack(1, 8) + bytes(8) + bytes(size) + footer)
    with in_time(), in_room(), RecoveredLog(path) as log:
        assert log.losses


def test_a_sound_chunk_above_the_bound_does_not_come_into_memory_for_repair(tmp_path: Path) -> None:
    """A chunk of 1 GB took 1 GB before it was left out."""
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE, chunk_size=1000)
        writer.start()
        channel = writer.register_channel("/a", "raw", 0)
        for size in (900, 900, 50 << 20, 900, 900):
            writer.add_message(channel, 1, bytes(size), 1)
        writer.finish()
    with in_room():
        report = repair(tmp_path / "log.mcap", tmp_path / "saved.mcap", max_chunk=1 << 20)
    assert (sum(report.messages.values()), len(report.losses.entries)) == (4, 1)


def test_a_definition_that_contains_itself_is_refused() -> None:
    deep = "a0 x\n" + "".join(f"{'=' * 80}\nMSG: p/a{i}\np/a{i + 1} x\n" for i in range(DEEPEST + 5))
    for text in ("p/M x\n", deep, "p/B x\n" + "=" * 80 + "\nMSG: p/B\np/M y\n"):
        with pytest.raises(LogError, match=r"deep|not defined"), in_time():
            parse("p/msg/M", text.encode())


NASTY = "/../../etc/\x1b[31mred\x07\n/imu"


def test_topics_with_control_characters_and_paths_are_escaped_and_make_no_files(
    foreign: Foreign, tmp_path: Path, imutool: Callable[..., object]
) -> None:
    path = foreign([(NASTY, *m[1:]) for m in some(8, 40)], chunk_size=300)
    block = blocks(path)[1]
    flip(path, block.offset + block.length - 10)
    done = imutool("repair", path.name, "out.mcap", "--damaged", "keep", cwd=tmp_path)
    assert done.returncode == 3, done.stderr
    assert "\x1b[31m" not in done.stdout + done.stderr
    assert "\x07" not in done.stdout + done.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == ["foreign.mcap", "out.mcap"]


# ── the command ──────────────────────────────────────────────────────────────────────────────────────────────────────


def test_the_command_tells_whole_from_saved_from_hopeless(
    foreign: Foreign, flight: Messages, tmp_path: Path, imutool: Callable[..., object]
) -> None:
    path = foreign(flight, chunk_size=20_000)
    done = imutool("repair", "foreign.mcap", "whole.mcap", cwd=tmp_path)
    assert (done.returncode, "the log was whole" in done.stdout) == (0, True), done.stderr
    block = blocks(path)[3]
    flip(path, block.offset + block.length - 30)
    done = imutool("repair", "foreign.mcap", "saved.mcap", "--json", "-", cwd=tmp_path)
    assert done.returncode == 3, done.stderr
    report = json.loads(done.stdout)
    assert report["schema"] == "imutool.repair/1"
    assert sum(report["messages"].values()) + report["losses"]["messages"] == len(flight)
    done = imutool("repair", "foreign.mcap", "told.mcap", cwd=tmp_path)
    assert f"lost: byte {block.offset}" in done.stdout
    (tmp_path / "text.mcap").write_text("no log at all")
    done = imutool("repair", "text.mcap", "none.mcap", cwd=tmp_path)
    assert (done.returncode, (tmp_path / "none.mcap").exists()) == (5, False)


def test_info_describes_what_is_sound_and_says_what_is_lost(foreign: Foreign, flight: Messages) -> None:
    path = foreign(flight, chunk_size=20_000)
    assert json_values(inspect(path))["losses"]["whole"]
    block = blocks(path)[3]
    flip(path, block.offset + block.length - 30)
    report = json_values(inspect(path))
    counts = {topic["name"]: topic["count"] for topic in report["topics"]}
    assert sum(counts.values()) + report["losses"]["messages"] == len(flight)
    assert report["imu"][0]["samples"] == counts["/imu/data"] == 900 - report["losses"]["topics"]["/imu/data"]


def test_real_logs_are_saved_but_for_the_damage(data: Path, tmp_path: Path) -> None:
    from imutool.converters import tum_vi
    from imutool.mcap_io.write import write

    (recording,) = tum_vi.read(data / "tumvi" / "dataset-room2.tar.gz")
    path, target = tmp_path / "room2.mcap", tmp_path / "out.mcap"
    write(recording, path)
    whole, rng = stretches(path), random.Random(1)
    raw = bytearray(path.read_bytes())
    for _ in range(3):
        page = rng.randrange(1000, len(raw) - 8192)
        raw[page : page + 4096] = bytes(4096)
    path.write_bytes(raw[: len(raw) * 9 // 10])
    before = path.read_bytes()
    report = repair(path, target)
    intact = [each for start, end, each in whole if before[start:end] == bytes(raw[start:end]) and end <= len(before)]
    original = {m for _, _, each in whole for m in each}
    found = by_mcap(target)
    assert set(found) <= original
    assert len(found) <= sum(len(each) for each in intact)
    assert report.losses
    assert path.read_bytes() == before


def test_attachments_kept_for_damage_are_told_from_the_users_own(foreign: Foreign, flight: Messages, tmp_path: Path) -> None:
    path, target = foreign(flight, attachments=(b"mine",), chunk_size=20_000), tmp_path / "out.mcap"
    os.truncate(path, path.stat().st_size // 2)
    repair(path, target, damaged="keep")
    with target.open("rb") as file:
        names = [r.name for r in StreamReader(file).records if isinstance(r, Attachment)]
    assert all(name.startswith("imutool/damaged/") or name == "notes.txt" for name in names)
