"""Bags that are cut, spoiled or without an index: what can be read of them is there again, byte for byte, and no more."""

from __future__ import annotations

import bz2
import os
import struct
import time
import tracemalloc
from pathlib import Path
from typing import Any, NamedTuple

import lz4.frame
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.rosbag1 import Reader, Writer
from rosbags.typesys import Stores, get_typestore

from imutool.bag import records
from imutool.bag.records import Op
from imutool.bag.repair import repair_bag
from imutool.bag.scan import Bag
from imutool.errors import ConfigError, LogError
from imutool.file_location import to_location

STORE = get_typestore(Stores.ROS1_NOETIC)
TEXT = STORE.types["std_msgs/msg/String"]
MESSAGES, TOPICS = 8, ("/imu", "/pose")
CHUNK_BYTES = 200  # small chunks: four in a bag of a few kilobytes
HEAD_BYTES = 70  # of the record behind a message, by which it is trusted
Told = list[tuple[str, int, bytes]]


def write_bag(path: Path, compression: str = "none", messages: int = MESSAGES, chunk_bytes: int = CHUNK_BYTES) -> Path:
    writer = Writer(path)
    writer.chunk_threshold = chunk_bytes
    if compression != "none":
        writer.set_compression(Writer.CompressionFormat[compression.upper()])
    with writer as bag:
        numbers = [bag.add_connection(topic, TEXT.__msgtype__, typestore=STORE) for topic in TOPICS]
        for n in range(messages):
            text = f"message {n} " + "x" * (n % 37)
            bag.write(numbers[n % 2], 10**18 + n * 10**6, bytes(STORE.serialize_ros1(TEXT(text), TEXT.__msgtype__)))
    return path


def told(path: Path) -> Told:
    """What another reader finds."""
    with Reader(path) as bag:
        return [(connection.topic, t_ns, bytes(data)) for connection, t_ns, data in bag.messages()]


def walked(path: Path) -> tuple[Told, Bag]:
    with Bag(path, recover=True) as bag:
        found = [
            (bag.connections[m.connection].topic, m.time_ns, chunk.data[m.data_at : m.end])
            for chunk in bag.chunks()
            for m in chunk.messages
        ]
        return found, bag


class Made(NamedTuple):
    """A bag, its messages, and for each the stretches of the file without which it cannot be read."""

    compression: str
    raw: bytes
    messages: Told
    spans: list[tuple[int, int]]
    needed: list[list[tuple[int, int]]]


@pytest.fixture(scope="module", params=["none", "bz2", "lz4"])
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Made:
    path = write_bag(tmp_path_factory.mktemp("made") / "one.bag", request.param)
    spans, chunks, definitions = [], [], []
    with Bag(path) as bag:
        for chunk in bag.chunks():
            head = bag._head(chunk.offset)
            assert head is not None
            chunks += [(chunk.offset, head.data_at)] * len(chunk.messages)
            whole = (chunk.offset, chunk.offset + chunk.length)
            for m in chunk.messages:
                inside = (head.data_at + m.at, head.data_at + m.end)
                spans.append(inside if request.param == "none" else whole)
            for text in TOPICS:
                if (at := chunk.data.find(b"topic=" + text.encode())) >= 0:
                    here = (head.data_at + at - 50, head.data_at + at + 250)
                    definitions.append(here if request.param == "none" else whole)
        assert bag.header is not None
        definitions.append((bag.header.number(b"index_pos"), bag.header.number(b"index_pos") + 500))
    needed = [[(a, b + HEAD_BYTES), chunk, *definitions] for (a, b), chunk in zip(spans, chunks, strict=True)]
    assert (len(spans), len(definitions)) == (MESSAGES, 3)
    return Made(request.param, path.read_bytes(), told(path), spans, needed)


def test_a_whole_bag_comes_out_as_it_was(made: Made, tmp_path: Path) -> None:
    (tmp_path / "in.bag").write_bytes(made.raw)
    report = repair_bag(tmp_path / "in.bag", tmp_path / "out.bag")
    assert (report.whole, report.was_indexed, report.rebuilt, report.losses) == (True, True, 0, ())
    assert report.messages == {"/imu": 4, "/pose": 4}
    assert told(tmp_path / "out.bag") == made.messages
    assert (tmp_path / "in.bag").read_bytes() == made.raw


def test_a_bag_without_its_index_gets_one(made: Made, tmp_path: Path) -> None:
    position = struct.unpack("<Q", made.raw[(at := made.raw.index(b"index_pos=") + 10) : at + 8])[0]
    crashed = made.raw[:at] + bytes(8) + made.raw[at + 8 : position]
    (tmp_path / "in.bag").write_bytes(crashed)
    with pytest.raises(Exception, match="not indexed"):
        told(tmp_path / "in.bag")
    report = repair_bag(tmp_path / "in.bag", tmp_path / "out.bag")
    assert (report.whole, report.was_indexed, report.rebuilt) == (True, False, 0)
    assert told(tmp_path / "out.bag") == made.messages


def test_of_a_bag_cut_anywhere_every_message_that_is_there_is_found(made: Made, tmp_path: Path) -> None:
    path = tmp_path / "cut.bag"
    path.write_bytes(made.raw)
    ends = {end + off for _, end in made.spans for off in (-1, 0, 1)}
    first, last = made.spans[0][0], len(made.raw) - 1
    for size in sorted({*range(first, last, 5), *(ends & set(range(first, last))), last}, reverse=True):
        os.truncate(path, size)
        found, bag = walked(path)
        there = [message for message, (_, end) in zip(made.messages, made.spans, strict=True) if end <= size]
        assert found[: len(there)] == there, size
        assert found == made.messages[: len(found)], size  # of a packed chunk that is cut, its first messages may be more
        assert bag.lost or size >= made.spans[-1][1], size


@pytest.mark.parametrize("size", [0, 1, 12, 13, 14, 100, 4096, 4108, 4109, 4120])
def test_a_bag_cut_ahead_of_its_first_message_is_refused(made: Made, tmp_path: Path, size: int) -> None:
    (tmp_path / "cut.bag").write_bytes(made.raw[:size])
    with pytest.raises(LogError, match=r"cut\.bag: (the file is empty|this is not a ROS 1 bag|not one message can be read)"):
        repair_bag(tmp_path / "cut.bag", tmp_path / "out.bag")
    assert [path.name for path in tmp_path.iterdir()] == ["cut.bag"]


@pytest.mark.parametrize("part", [0.6, 0.8, 0.9])
def test_what_is_left_of_a_cut_bag_is_a_bag_for_others(made: Made, tmp_path: Path, part: float) -> None:
    size = int(made.spans[0][0] + part * (made.spans[-1][1] - made.spans[0][0]))
    (tmp_path / "cut.bag").write_bytes(made.raw[:size])
    report = repair_bag(tmp_path / "cut.bag", tmp_path / "out.bag")
    found = told(tmp_path / "out.bag")
    assert found == walked(tmp_path / "cut.bag")[0]
    assert (sum(report.messages.values()), report.whole) == (len(found), False)


# always the same examples: of 12 500 where bytes are taken out or doubled, about five leave heads that run into one another
# and then cost a neighbour
@settings(deadline=None, max_examples=120, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_only_what_damage_touches_is_lost(made: Made, tmp_path: Path, data: st.DataObject) -> None:
    first, last = made.spans[0][0], made.spans[-1][1]
    at = data.draw(st.integers(first, last), label="at")
    length = data.draw(st.integers(1, 300), label="length")
    how = data.draw(st.sampled_from(["zeros", "ones", "noise", "gone", "doubled"]), label="how")
    noise = np.random.default_rng(at).bytes(length)
    new = {
        "zeros": bytes(length),
        "ones": b"\xff" * length,
        "noise": noise,
        "gone": b"",
        "doubled": made.raw[at : at + length] * 2,
    }[how]
    path = tmp_path / "spoiled.bag"
    path.write_bytes(made.raw[:at] + new + made.raw[at + length :])
    found, bag = walked(path)
    hit = [any(a < at + length and at < b for a, b in needed) for needed in made.needed]
    if how in ("gone", "doubled"):  # heads may run into one another, which costs the neighbours
        chunks = [needed[1] for needed in made.needed]
        spoiled_chunks = {chunk for chunk, spoiled in zip(chunks, hit, strict=True) if spoiled}
        hit = [spoiled or chunk in spoiled_chunks for chunk, spoiled in zip(chunks, hit, strict=True)]
    untouched = {message for message, spoiled in zip(made.messages, hit, strict=True) if not spoiled}
    assert untouched <= set(found)
    strange = {(t_ns, data) for _, t_ns, data in found} - {(t_ns, data) for _, t_ns, data in made.messages}
    assert len(strange) <= (0 if made.compression == "bz2" else sum(hit))
    if len(found) < MESSAGES:
        assert bag.lost


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(flips=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=6))
def test_whatever_was_spoiled_what_is_repaired_is_a_bag_for_others(
    made: Made, tmp_path: Path, flips: list[tuple[float, int]]
) -> None:
    raw, first = bytearray(made.raw), 4100  # what lies before is padding
    for share, value in flips:
        raw[first + int(share * (len(raw) - 1 - first))] = value
    (tmp_path / "in.bag").write_bytes(raw)
    try:
        report = repair_bag(tmp_path / "in.bag", tmp_path / "out.bag", overwrite=True)
    except LogError:
        return
    found = told(tmp_path / "out.bag")
    assert len(found) == sum(report.messages.values())
    if made.compression == "bz2":  # its own check is the only one; of a topic's name the index has none
        assert {(t_ns, data) for _, t_ns, data in found} <= {(t_ns, data) for _, t_ns, data in made.messages}
    if len(found) < MESSAGES:
        assert not report.whole


def test_every_loss_says_where_and_how_much(made: Made, tmp_path: Path) -> None:
    (a, b), path = made.spans[5], tmp_path / "in.bag"
    at = a + 4 if made.compression == "none" else (a + b) // 2
    path.write_bytes(made.raw[:at] + bytes(20) + made.raw[at + 20 :])
    report = repair_bag(path, tmp_path / "out.bag")
    assert a <= report.losses[0].offset + report.losses[0].length
    assert report.losses[0].offset < b
    if made.compression == "none":
        assert report.rebuilt == 1
    else:
        assert report.losses[0].messages == sum(span == made.spans[5] for span in made.spans)
    assert set(told(tmp_path / "out.bag")) < set(made.messages)


def test_two_bags_joined_are_read_to_the_end_and_numbers_that_changed_their_meaning_are_not_believed(tmp_path: Path) -> None:
    one, other = write_bag(tmp_path / "one.bag"), write_bag(tmp_path / "other.bag")
    (tmp_path / "same.bag").write_bytes(one.read_bytes() + other.read_bytes())
    assert walked(tmp_path / "same.bag")[0] == told(one) + told(other)
    renamed = other.read_bytes().replace(b"topic=/imu", b"topic=/gps")
    (tmp_path / "renamed.bag").write_bytes(one.read_bytes() + renamed)
    found, bag = walked(tmp_path / "renamed.bag")
    assert found == told(one) + [message for message in told(other) if message[0] == "/pose"]
    assert any("connection 0 is both /imu and /gps" in loss.reason for loss in bag.losses)


# ── bags that mean harm ──


def hostile(*raw: bytes) -> bytes:
    return records.MAGIC + records.bag_header(0, 0, 0) + b"".join(raw)


def chunk(compression: bytes, size: int, data: bytes) -> bytes:
    return records.record(Op.CHUNK, {b"compression": compression, b"size": struct.pack("<I", size)}, data)


@pytest.mark.parametrize(
    ("compression", "size"),
    [(b"bz2", 100), (b"lz4", 100), (b"bz2", 2**32 - 1), (b"lz4", 2**32 - 1), (b"zstd", 100), (b"none", 7)],
)
def test_a_chunk_that_unpacks_to_more_than_it_says_takes_no_memory(tmp_path: Path, compression: bytes, size: int) -> None:
    packed = {b"bz2": bz2.compress, b"lz4": lz4.frame.compress}.get(compression, bytes)(bytes(1 << 26))
    path = tmp_path / "bomb.bag"
    path.write_bytes(hostile(chunk(compression, size, packed if len(packed) < 1 << 20 else packed[:1000])))
    tracemalloc.start()
    try:
        found, bag = walked(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert (found, bag.lost) == ([], 1)
    assert peak < 8 << 20


@pytest.mark.parametrize("kind", ["chunk", "connection"])
def test_a_record_beyond_all_sense_is_never_held_in_memory(tmp_path: Path, kind: str) -> None:
    size = records.CHUNK_LIMIT + 1
    head = chunk(b"none", size, b"") if kind == "chunk" else records.record(Op.CONNECTION, {b"conn": bytes(4)}, b"")
    path = tmp_path / "large.bag"
    path.write_bytes(hostile(head[:-4] + struct.pack("<I", size)))
    os.truncate(path, path.stat().st_size + size)  # a hole: it takes no room on the disk
    tracemalloc.start()
    try:
        found, bag = walked(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert (found, bag.lost) == ([], 1)
    assert peak < 8 << 20


def test_heads_without_end_and_lengths_beyond_the_file_are_gone_through_quickly(tmp_path: Path) -> None:
    head = chunk(b"none", 10, b"")[:-4] + struct.pack("<I", 2**32 - 1)
    path = tmp_path / "many.bag"
    path.write_bytes(hostile(head * 4000, struct.pack("<I", 2**31) * 4000, b"\4\0\0\0op=\5" * 20_000))
    began = time.perf_counter()
    found, bag = walked(path)
    assert (found, bag.lost > 0) == ([], True)
    assert len(bag.losses) <= 10_000
    assert time.perf_counter() - began < 20.0  # about 1 s; what is quadratic takes hours


@given(raw=st.binary(max_size=3000))
@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_whatever_stands_in_a_bag_is_read_or_refused_with_an_error_of_ours(tmp_path: Path, raw: bytes) -> None:
    path = tmp_path / "any.bag"
    path.write_bytes(hostile(raw))
    try:
        repair_bag(path, tmp_path / "out.bag", overwrite=True)
    except LogError:
        assert path.read_bytes() == hostile(raw)


def test_an_encrypted_bag_is_refused(tmp_path: Path) -> None:
    header = records.record(
        Op.BAG, {b"index_pos": bytes(8), b"conn_count": bytes(4), b"chunk_count": bytes(4), b"encryptor": b"rosbag/Aes"}, b""
    )
    (tmp_path / "secret.bag").write_bytes(records.MAGIC + header)
    with pytest.raises(LogError, match=r"secret.bag: the bag is encrypted with b'rosbag/Aes'"):
        repair_bag(tmp_path / "secret.bag", tmp_path / "out.bag")


def test_the_target_is_not_the_source_and_not_there_already(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "one.bag")
    before = path.read_bytes()
    with pytest.raises(ConfigError, match="the target is the source"):
        repair_bag(path, path, overwrite=True)
    (tmp_path / "out.bag").write_text("precious")
    with pytest.raises(ConfigError, match="the target exists"):
        repair_bag(path, tmp_path / "out.bag")
    assert (path.read_bytes(), (tmp_path / "out.bag").read_text()) == (before, "precious")
    with pytest.raises(ConfigError, match=r"none.bag: cannot be opened \(No such file or directory\); expected a ROS 1 bag"):
        repair_bag(tmp_path / "none.bag", tmp_path / "out2.bag")


def test_a_bag_in_a_store_is_repaired_there(store: Any, tmp_path: Path) -> None:
    raw = write_bag(tmp_path / "one.bag").read_bytes()
    report = repair_bag(to_location(store.put("in.bag", raw[:6000])), to_location("s3://fleet/out.bag"))
    (tmp_path / "out.bag").write_bytes(store.get("out.bag"))
    assert len(told(tmp_path / "out.bag")) == sum(report.messages.values()) > 0
    assert store.keys() == ["in.bag", "out.bag"]
