"""Where a log's index and its records contradict each other, the records that a CRC proves come back, once, on their topics."""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.opcode import Opcode
from support import log_damage

from imutool.errors import LogError
from imutool.mcap_io.codec.records import HEAD, MAGIC
from imutool.mcap_io.log import Log
from imutool.mcap_io.recovery.recovered_log import RecoveredLog
from imutool.mcap_io.repair import RepairReport, repair
from imutool.mcap_io.rewrite import rewrite

Messages = list[tuple[str, str, int, int, int, bytes]]
Foreign = Callable[..., Path]
by_mcap, stretches = log_damage.by_mcap, log_damage.stretches

# Messages that the CRCs of each file's chunks prove: an exhaustive search finds no more; and words of the report
PROVEN = {
    "new_log_over_older": (173, "a summary lists 5 chunks that are not in the file"),
    "index_lengths_wrong": (340, ""),
    "chunk_behind_damage": (313, "a summary lists 1 chunk that is not in the file"),
    "two_logs_overlapped": (139, "the chunk at byte 11691 is damaged"),  # 152, of which 13 are there twice
    "channel_65535": (324, ""),
}


@pytest.mark.parametrize("name", PROVEN)
def test_of_files_that_were_answered_wrongly_all_proven_messages_come_back(data: Path, tmp_path: Path, name: str) -> None:
    count, said = PROVEN[name]
    report = repair(data / "damaged" / f"{name}.mcap", tmp_path / "out.mcap")
    assert sum(report.messages.values()) == count == len(by_mcap(tmp_path / "out.mcap"))
    assert not report.whole
    reasons = [loss.reason for loss in report.losses.entries]
    assert any(said in reason for reason in reasons) if said else reasons == []
    times = [m[1] for m in by_mcap(tmp_path / "out.mcap")]
    assert times == sorted(times)


def test_messages_of_the_overlapping_log_stay_on_their_own_topics(data: Path, tmp_path: Path) -> None:
    report = repair(data / "damaged" / "two_logs_overlapped.mcap", tmp_path / "out.mcap")
    assert report.messages == {"/imu0": 80, "/pose": 40, "/talk": 16, "/imu1": 3}  # 53 of them were on the other's, once


@pytest.fixture
def log(foreign: Foreign, flight: Messages) -> Path:
    """A log of some ten chunks with an index."""
    return foreign(flight, chunk_size=20_000)


def saved(path: Path) -> tuple[Counter[object], RepairReport]:
    target = path.with_name("saved.mcap")
    report = repair(path, target, overwrite=True)
    return Counter(by_mcap(target)), report


def test_exchanged_chunks_cost_nothing_and_stand_in_order_again(log: Path) -> None:
    whole, raw = stretches(log), log.read_bytes()
    (a, b, _), (c, d, _) = whole[2], whole[5]
    log.write_bytes(raw[:a] + raw[c:d] + raw[b:c] + raw[a:b] + raw[d:])
    found, report = saved(log)
    assert found == Counter(m for _, _, each in whole for m in each)
    assert not report.losses
    assert any("put in order" in line for line in report.losses.harmless)
    with Log(log.with_name("saved.mcap")) as after:
        starts = [block.start_ns for block in after.index.blocks]
    assert starts == sorted(starts)


def test_an_old_index_never_wins_over_the_records(foreign: Foreign, log: Path, flight: Messages) -> None:
    others = [(f"/other{m[0]}", m[1], m[2] + 10**15, *m[3:]) for m in flight]
    other = foreign(others, chunk_size=15_000, name="other")
    raw, newer = log.read_bytes(), other.read_bytes()
    whole, mine = stretches(other), stretches(log)
    stop = whole[3][1]  # the new recording's last whole chunk
    log.write_bytes(newer[:stop] + raw[stop:])
    found, report = saved(log)
    theory = [m for _, end, each in whole if end <= stop for m in each] + [
        m for at, _, each in mine if at >= stop for m in each
    ]
    assert found == Counter(theory)
    assert report.losses


def test_a_chunk_that_is_gone_is_lost_though_its_message_indexes_remain(log: Path) -> None:
    whole, raw = stretches(log), log.read_bytes()
    start, end, gone = whole[3]
    log.write_bytes(raw[:start] + raw[end:])
    found, report = saved(log)
    assert found == Counter(m for at, _, each in whole if at != start for m in each)
    assert report.losses.topics == Counter(m[0] for m in gone)


@pytest.mark.parametrize(("at", "value"), [(0, b"\0"), (0, b"\x90"), (1, b"\xff")], ids=["opcode", "private opcode", "length"])
def test_a_damaged_end_of_the_data_costs_nothing(log: Path, at: int, value: bytes) -> None:
    """Its 13 bytes were lost with an unknown number of messages, and mended at the same time."""
    whole, raw = by_mcap(log), log.read_bytes()
    with Log(log) as before:
        end = before.index.data_end
    log.write_bytes(raw[: end + at] + value + raw[end + at + 1 :])
    found, report = saved(log)
    assert found == Counter(whole)
    assert not report.losses
    (line,) = report.losses.harmless
    assert line.startswith("the DataEnd record before byte")


def test_a_chunk_that_is_there_twice_is_kept_once(log: Path) -> None:
    whole, raw = stretches(log), log.read_bytes()
    start, end, _ = whole[3]
    log.write_bytes(raw[:end] + raw[start:end] + raw[end:])
    found, report = saved(log)
    assert found == Counter(m for _, _, each in whole for m in each)
    assert any("repeats the one" in line for line in report.losses.harmless)


def test_times_of_a_chunk_that_are_not_those_of_its_messages_are_set_right(log: Path, tmp_path: Path) -> None:
    raw = log.read_bytes()
    with Log(log) as before:
        summary, block = before.index.footer.summary_start, before.index.blocks[3]
    raw = raw.replace(struct.pack("<QQ", block.start_ns, block.end_ns), bytes(16))  # in the chunk and in the summary
    crc = zlib.crc32(raw[summary:-12])
    log.write_bytes(raw[:-12] + crc.to_bytes(4, "little") + MAGIC)
    with Log(log) as wrong:
        times = [rows.log_time for _, rows in wrong.rows(wrong.topics, block.start_ns, block.end_ns)]
        assert np.concatenate(times).size == sum(block.start_ns <= m[1] <= block.end_ns for m in by_mcap(log))
    found, report = saved(log)
    assert found == Counter(by_mcap(log))
    assert report.losses.harmless == [f"the times of the chunk at byte {block.offset} are not those of its messages"]
    with RecoveredLog(log.with_name("saved.mcap")) as after:
        after.check()
        assert after.losses.intact
    with pytest.raises(LogError, match="are not those of its messages"):
        rewrite(log, tmp_path / "out.mcap", [], metadata={})


@pytest.mark.parametrize("over", [45, 44, 43, 36])
def test_a_chunk_that_begins_inside_the_record_before_it_is_found(log: Path, over: int) -> None:
    """Of 44 bytes, the name "zstd" ends in an opcode, and the length of the packed data is that of a record."""
    whole, raw = stretches(log), log.read_bytes()
    (_, end, _), (start, _, _) = whole[3], whole[4]
    _, length = HEAD.unpack_from(raw, end)
    log.write_bytes(raw[: end + HEAD.size + length - over] + raw[start:])  # it goes over into the next chunk
    found, _ = saved(log)
    assert found == Counter(m for _, _, each in whole for m in each)


def test_messages_whose_topic_nothing_proves_are_on_none(foreign: Foreign, flight: Messages) -> None:
    imu = [m for m in flight if m[0] == "/imu/data"]
    first = foreign(imu[:300], "no-summary", chunk_size=20_000, name="first")
    second = foreign([("/other", *m[1:]) for m in imu[300:600]], "no-summary", chunk_size=20_000, name="second")
    a, b, raw = stretches(first), stretches(second), first.read_bytes()
    hole = b[0][1]
    cut = second.read_bytes()[:hole] + os.urandom(50)
    first.write_bytes(raw[: a[2][1]] + cut + raw[a[3][0] :])  # behind the hole: of which of the two?
    found, report = saved(first)
    assert found == Counter([m for _, _, each in a[:3] for m in each] + b[0][2])
    assert report.losses.unproven == sum(len(each) for _, _, each in a[3:])
    assert "(/imu/data or /other)" in report.losses.topics


def test_a_chunk_of_another_log_before_all_definitions_is_not_on_their_topics(foreign: Foreign, flight: Messages) -> None:
    first = foreign(flight[:300], "no-summary", chunk_size=20_000, name="first")
    poses = [m for m in flight if m[0] == "/mocap"]
    second = foreign(poses, "no-summary", chunk_size=3_000, name="second")  # its id 1 is the first one's IMU
    raw, (start, end, _) = first.read_bytes(), stretches(second)[2]
    whole = stretches(first)
    at = whole[0][0]
    first.write_bytes(raw[:at] + second.read_bytes()[start:end] + raw[at:])
    found, report = saved(first)
    assert found == Counter(m for _, _, each in whole for m in each)
    assert "(channel 1, not defined)" in report.losses.topics


def test_a_log_with_the_largest_channel_id_is_joined_to_another(foreign: Foreign, flight: Messages) -> None:
    first = foreign(flight[:60], "no-summary", name="first")
    second = foreign([(f"/b{m[0]}", *m[1:]) for m in flight[:60]], "no-summary", name="second")
    raw = bytearray(first.read_bytes())
    top = b"\x04" + struct.pack("<Q", 0)  # a Channel record outside chunks: id 65535, no schema
    body = struct.pack("<HH", 65535, 0) + struct.pack("<I", 4) + b"/top" + struct.pack("<I", 4) + b"json" + struct.pack("<I", 0)
    record = top[:1] + struct.pack("<Q", len(body)) + body
    header = len(MAGIC) + HEAD.size + HEAD.unpack_from(raw, len(MAGIC))[1]
    first.write_bytes(bytes(raw[:header]) + record + bytes(raw[header:]) + second.read_bytes())
    found, _ = saved(first)
    assert {m[0] for m in found} == {m[0] for m in flight[:60]} | {f"/b{m[0]}" for m in flight[:60]}


# ── bounds ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_chunks_above_the_bound_are_refused_and_said(log: Path, imutool: Callable[..., object]) -> None:
    report = repair(log, log.with_name("all.mcap"))
    assert report.whole
    done = imutool("repair", log.name, "few.mcap", "--max-chunk", "10000", cwd=log.parent)
    assert done.returncode == 3
    assert "at most 10000 (--max-chunk)" in done.stdout
    with pytest.raises(LogError, match="10000"), Log(log, max_chunk=10_000) as opened:
        opened.check()


def test_a_chunk_of_zeros_is_refused_before_it_is_followed(tmp_path: Path) -> None:
    path, size = tmp_path / "log.mcap", 64 << 20
    import zstandard

    packed = zstandard.ZstdCompressor().compress(bytes(size))
    body = struct.pack("<QQQII", 0, 1, size, zlib.crc32(bytes(size)), 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    path.write_bytes(MAGIC + HEAD.pack(1, 8) + bytes(8) + HEAD.pack(6, len(body)) + body)
    with RecoveredLog(path) as log:
        assert "opcode 0" in log.losses.entries[0].reason


@pytest.mark.parametrize("field", ["offset", "packed size"])
def test_a_summary_with_wrong_places_of_chunks_is_never_copied(
    foreign: Foreign, flight: Messages, tmp_path: Path, field: str
) -> None:
    """The log itself is intact, and everybody else goes by its summary."""
    path = foreign(flight[:200], chunk_size=3_000)
    raw = bytearray(path.read_bytes())
    start, position = struct.unpack_from("<Q", raw, len(raw) - 28)[0], 0
    position = start
    while raw[position] != Opcode.FOOTER:
        length = struct.unpack_from("<Q", raw, position + 1)[0]
        if raw[position] == Opcode.CHUNK_INDEX:
            at = position + 9 + (16 if field == "offset" else length - 16)
            raw[at : at + 8] = (int.from_bytes(raw[at : at + 8], "little") + 7).to_bytes(8, "little")
        position += 9 + length
    raw[-12:-8] = zlib.crc32(bytes(raw[start:-12])).to_bytes(4, "little")
    path.write_bytes(bytes(raw))
    repair(path, tmp_path / "out.mcap")
    assert Counter(by_mcap(tmp_path / "out.mcap")) == Counter((m[0], *m[2:]) for m in flight[:200])


def test_the_data_section_must_end_where_the_summary_begins(foreign: Foreign, flight: Messages) -> None:
    path = foreign(flight, "no-summary", chunk_size=20_000)
    raw, whole = path.read_bytes(), stretches(path)
    path.write_bytes(raw[: whole[3][0]] + HEAD.pack(2, 20) + bytes(20) + raw[whole[3][0] :])
    with pytest.raises(LogError, match="the data section ends at byte"):
        Log(path)
    found, _ = saved(path)
    assert found == Counter(m for _, _, each in whole for m in each)


def test_debias_says_what_no_crc_covers(log: Path, imutool: Callable[..., object]) -> None:
    raw = bytearray(log.read_bytes())
    for start, _, _ in stretches(log):
        raw[start + HEAD.size + 24 : start + HEAD.size + 28] = bytes(4)  # the CRC of the chunk
    log.write_bytes(raw)
    done = imutool("debias", log.name, "out.mcap", "--init", "0,0,0,0,0,0", "--force", cwd=log.parent)  # its samples are noise
    assert done.returncode == 0, done.stderr
    assert "unchecked: 1180 messages lie where no CRC covers them" in done.stdout
