"""Which log a definition is of, where a damaged file holds parts of several; and the order of chunks that lost messages."""

from __future__ import annotations

import struct
import time
import tracemalloc
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.records import Channel, Schema
from mcap.writer import Writer
from support.log_damage import by_mcap, stretches

from imutool.conversion.message_writer import write_log
from imutool.mcap_io.blocks import MessageBlock
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.encode import encode_imu
from imutool.mcap_io.log import Log
from imutool.mcap_io.recovery import definitions
from imutool.mcap_io.recovery.chunk_repair import find_definitions
from imutool.mcap_io.recovery.definitions import Recording, renumber
from imutool.mcap_io.recovery.losses import Losses, describe
from imutool.mcap_io.recovery.recovered_log import RecoveredLog
from imutool.mcap_io.repair import repair
from imutool.recording.message_log import Message as Encoded
from imutool.recording.message_log import MessageLog, MessageTopic

Message = tuple[str, str, int, int, int, bytes]
Foreign = Callable[..., Path]
LONG, SHORT = 5000, 10  # bytes of a message that fills a chunk, and of one that does not
CHUNK_SIZE = 3000


def text(topic: str, t_ns: int, size: int = LONG) -> Message:
    return topic, "std_msgs/msg/String", t_ns, t_ns, 0, b"\xff" * size


def summary_of(path: Path) -> bytes:
    raw = path.read_bytes()
    return raw[struct.unpack_from("<Q", raw, len(raw) - 28)[0] :]


def test_the_definitions_of_a_damaged_chunk_that_unpacks_to_zeros_take_no_time() -> None:
    """Two CPU seconds once: each piece of 256 bytes was a copy of all before it."""
    packed = zstandard.ZstdCompressor(level=1).compress(bytes(50 << 20))
    began = time.process_time()
    assert list(find_definitions(b"damaged head" + packed)) == []
    assert time.process_time() - began < 1.0


@pytest.mark.parametrize("proven", [True, False])
def test_the_memory_for_chunks_that_unpack_to_zeros_is_that_of_one(foreign: Foreign, tmp_path: Path, proven: bool) -> None:
    """Each stayed in memory once: 1.6 GB for six of 250 MiB, which are 48 kB of a file."""
    log = foreign([text("/mine", 100 + i) for i in range(3)], chunk_size=CHUNK_SIZE, name="log")
    whole, raw, zeros = stretches(log), log.read_bytes(), bytes(8 << 20)
    packed = zstandard.ZstdCompressor(level=1).compress(zeros)
    head = struct.pack("<QQQII", 100, 101, len(zeros), zlib.crc32(zeros) * proven, 4) + b"zstd" + struct.pack("<Q", len(packed))
    chunk = struct.pack("<BQ", 6, len(head + packed)) + head + packed
    log.write_bytes(raw[: whole[0][1]] + 12 * chunk + raw[whole[1][0] :])
    tracemalloc.start()
    try:
        report = repair(log, tmp_path / "out.mcap")
        _, maximum = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert report.messages == {"/mine": 3}
    assert maximum < 3 * len(zeros)


def test_a_summary_that_follows_a_part_of_itself_says_whose_the_chunks_are(foreign: Foreign, tmp_path: Path) -> None:
    first = foreign([text("/mine", 100 + i) for i in range(5)], chunk_size=CHUNK_SIZE, name="first")
    second = foreign([text("/other", 1000 + i) for i in range(9)], chunk_size=CHUNK_SIZE, name="second")
    a, b, raw, summary = stretches(first), stretches(second), second.read_bytes(), summary_of(second)
    part = summary[: 9 + struct.unpack_from("<Q", summary, 1)[0]]  # its first record, a schema
    data = raw[b[3][0] : -len(summary)]  # chunks without definitions
    first.write_bytes(first.read_bytes()[: a[3][1]] + data + part + b"\0" * 5 + summary)
    repair(first, tmp_path / "out.mcap")
    assert by_mcap(tmp_path / "out.mcap") == [m for _, _, each in a[:4] + b[3:] for m in each]


@pytest.mark.parametrize("ended", [True, False])
def test_a_log_takes_no_definition_from_another_ones_summary(foreign: Foreign, tmp_path: Path, ended: bool) -> None:
    mine = [text(("/gone", "/kept")[i % 2], 100 + i) for i in range(8)]
    first = foreign(mine, "no-summary", chunk_size=CHUNK_SIZE, name="first")
    second = foreign([text("/x", 1), text("/y", 2), text("/z", 3)], chunk_size=CHUNK_SIZE, name="second")
    whole, raw, summary = stretches(first), first.read_bytes(), summary_of(second)
    stop = len(raw) if ended else whole[-1][1]
    first.write_bytes(raw[: whole[0][0]] + raw[whole[0][1] : stop] + b"\0" * 5 + summary[:-30])  # /gone is not defined
    report = repair(first, tmp_path / "out.mcap")
    assert report.messages == {"/kept": 4}
    assert report.losses.topics == {"(channel 1, not defined)": 3}


def test_chunks_of_which_messages_are_left_out_stand_in_order_of_the_others(foreign: Foreign, tmp_path: Path) -> None:
    first_of_two = [text("/gone", 100, SHORT), text("/kept", 300)]  # in one chunk
    log = foreign([text("/gone", 1), text("/kept", 2), *first_of_two, text("/kept", 200)], "no-summary", chunk_size=CHUNK_SIZE)
    whole, raw = stretches(log), log.read_bytes()
    log.write_bytes(raw[: whole[0][0]] + raw[whole[0][1] :])
    repair(log, tmp_path / "out.mcap")
    with Log(tmp_path / "out.mcap") as after:
        assert [block.start_ns for block in after.index.blocks] == [2, 200, 300]


def test_chunks_that_no_summary_lists_keep_the_definitions_of_their_own_log(foreign: Foreign, tmp_path: Path) -> None:
    first = foreign([text("/same", 100 + i) for i in range(5)], chunk_size=CHUNK_SIZE, name="first")
    second = foreign([text("/same", 1000 + i) for i in range(4)], "no-summary", chunk_size=CHUNK_SIZE, name="second")
    a, b, raw, other = stretches(first), stretches(second), first.read_bytes(), second.read_bytes()
    inside = other[b[0][0] : b[0][1]] + b"\0" * 5 + other[b[1][0] : b[3][1]]
    first.write_bytes(raw[: a[4][1]] + inside + raw[a[4][1] :])
    repair(first, tmp_path / "out.mcap")
    assert by_mcap(tmp_path / "out.mcap") == [m for _, _, each in a + b for m in each]


def test_chunks_between_two_gaps_may_be_of_the_log_that_follows_without_its_begin(foreign: Foreign, tmp_path: Path) -> None:
    first = foreign([text("/mine", 100 + i) for i in range(3)], chunk_size=CHUNK_SIZE, name="first")
    second = foreign([text("/other", 1000 + i) for i in range(5)], chunk_size=CHUNK_SIZE, name="second")
    a, b, raw, other = stretches(first), stretches(second), first.read_bytes(), second.read_bytes()
    tail, begin = other[b[2][0] : b[3][1]], other[b[0][0] : b[0][1]]  # chunks that define nothing, and the one that does
    first.write_bytes(raw[: a[0][1]] + b"\0" * 5 + tail + b"\0" * 5 + begin)
    report = repair(first, tmp_path / "out.mcap")
    assert by_mcap(tmp_path / "out.mcap") == [*a[0][2], *b[0][2]]
    assert report.losses.unproven == 2
    assert report.losses.topics == {"(/mine or /other)": 2}


@pytest.mark.parametrize(
    ("first", "second", "told"),
    [
        ("no-message-index", "zstd", True),
        ("zstd", "no-message-index", True),
        ("zstd", "lz4", True),
        ("zstd", "plain", False),  # a writer leaves small chunks as they are
    ],
)
def test_chunks_written_in_another_way_are_not_on_the_topics_of_the_log_before_them(
    foreign: Foreign, tmp_path: Path, first: str, second: str, told: bool
) -> None:
    mine = foreign([text("/mine", 100 + i) for i in range(3)], first, chunk_size=CHUNK_SIZE, name="first")
    other = foreign([text("/other", 1000 + i) for i in range(5)], second, chunk_size=CHUNK_SIZE, name="second")
    a, b = stretches(mine), stretches(other)
    mine.write_bytes(mine.read_bytes()[: a[1][1]] + b"\0" * 5 + other.read_bytes()[b[2][0] : b[4][1]])
    report = repair(mine, tmp_path / "out.mcap")
    assert report.messages == {"/mine": 2 if told else 5}
    assert report.losses.assumed == (0 if told else 3)
    assert report.losses.topics == ({"(channel 1, not defined)": 3} if told else {})


def test_a_log_that_may_have_lost_a_definition_stays_among_those_a_chunk_may_be_of(foreign: Foreign, tmp_path: Path) -> None:
    """Its messages came back on the other log's topic, because only that one still defines all of the chunk's channels."""
    mine = [text("/mine", 100, SHORT), text("/two", 101)]
    other = [text("/other", 1000), text("/two", 1001), text("/other", 1002, SHORT), text("/two", 1003)]
    first = foreign(mine, chunk_size=CHUNK_SIZE, name="first")
    second = foreign(other, chunk_size=CHUNK_SIZE, name="second")
    a, b, raw = stretches(first), stretches(second), bytearray(second.read_bytes())
    assert [len(each) for _, _, each in b] == [1, 1, 2]
    raw[b[1][0] : b[1][1]] = bytes(b[1][1] - b[1][0])  # the chunk that defines /two
    first.write_bytes(first.read_bytes()[: a[0][1]] + bytes(raw[: b[2][1]]))
    report = repair(first, tmp_path / "out.mcap")
    assert report.messages == {"/mine": 1, "/other": 1, "/two": 2}
    assert report.losses.topics == {"(/mine or /other)": 1, "(channel 2, not defined)": 1}
    assert report.losses.unproven == 1


def test_definitions_of_another_log_behind_its_chunks_leave_open_whose_these_are(foreign: Foreign, tmp_path: Path) -> None:
    """A log over the end of another that was written the same way: its messages were on the topics of the first one."""
    first = foreign([text("/mine", 100 + i) for i in range(3)], chunk_size=CHUNK_SIZE, name="first")
    second = foreign([text("/other", 1000 + i) for i in range(5)], chunk_size=CHUNK_SIZE, name="second")
    a, b, other = stretches(first), stretches(second), second.read_bytes()
    tail = other[b[2][0] : b[4][1]] + summary_of(second)[:-60]  # without a footer, no CRC proves the summary
    first.write_bytes(first.read_bytes()[: a[1][1]] + b"\0" * 5 + tail)
    report = repair(first, tmp_path / "out.mcap")
    assert report.messages == {"/mine": 2}
    assert report.losses.unproven == 3
    assert report.losses.topics == {"(/mine or /other)": 3}


def test_a_chunk_in_two_logs_whose_definitions_differ_is_unproven(foreign: Foreign, tmp_path: Path) -> None:
    """It came back on the topic of the log that stood first in the file."""
    first = foreign([text("/mine", 100 + i) for i in range(3)], chunk_size=CHUNK_SIZE, name="first")
    second = foreign([text("/other", 1000 + i) for i in range(3)], chunk_size=CHUNK_SIZE, name="second")
    a, b, raw, other = stretches(first), stretches(second), first.read_bytes(), second.read_bytes()
    chunk = other[b[1][0] : b[1][1]]
    own = raw[a[1][0] : a[1][1]]
    data = chunk * 2 + own  # twice in the first log, once in its own
    first.write_bytes(raw[: a[0][1]] + data + raw[a[2][0] : a[2][1]] + other[: b[2][1]])
    report = repair(first, tmp_path / "out.mcap")
    assert by_mcap(tmp_path / "out.mcap") == [m for each in (*a, b[0], b[2]) for m in each[2]]
    assert report.losses.unproven == 1
    assert report.losses.topics == {"(/mine or /other)": 1}


def test_every_message_of_which_two_topics_are_possible_is_counted(foreign: Foreign, tmp_path: Path) -> None:
    """Seed n8-b, logs 722: of two channels with the same two possible topics, one was counted."""
    first = foreign([text("/mine", 100), text("/other", 101)], chunk_size=CHUNK_SIZE, name="first")
    messages = [
        text("/other", 1000),
        text("/mine", 1001),
        *(text(("/other", "/mine")[i % 2], 1002 + i, 1200) for i in range(3)),
    ]
    second = foreign(messages, chunk_size=CHUNK_SIZE, name="second")
    a, b, raw, other = stretches(first), stretches(second), first.read_bytes(), second.read_bytes()
    assert [len(each) for _, _, each in b] == [1, 1, 3]
    chunk, begin = other[b[2][0] : b[2][1]], other[b[0][0] : b[1][1]]
    first.write_bytes(raw[: a[1][1]] + b"\0" * 5 + chunk + b"\0" * 5 + begin)
    report = repair(first, tmp_path / "out.mcap")
    assert (report.losses.unproven, report.losses.topics) == (3, {"(/mine or /other)": 3})


def test_a_chunk_behind_the_data_of_a_log_may_be_of_another(foreign: Foreign, tmp_path: Path) -> None:
    """Seed n8-b, logs 4158: a chunk among the last records of a log whose begin is lost was on that log's topic."""
    first = foreign([text("/mine", 100 + i) for i in range(4)], "no-message-index", chunk_size=CHUNK_SIZE, name="first")
    second = foreign([text("/other", 1000 + i) for i in range(4)], chunk_size=CHUNK_SIZE, name="second")
    a, b, raw, other = stretches(first), stretches(second), first.read_bytes(), second.read_bytes()
    tail = other[b[2][0] : -60]  # with its summary, of which without a footer nothing is proven
    tail = tail[: tail.rindex(b"\x0e")]  # ends with a record
    first.write_bytes(raw[: a[1][1]] + b"\0" * 5 + tail + raw[a[3][0] : a[3][1]])
    report = repair(first, tmp_path / "out.mcap")
    assert (report.messages, report.losses.topics) == ({"/mine": 2, "/other": 2}, {"(/mine or /other)": 1})


@pytest.mark.parametrize(("layout", "open_"), [("zstd", 0), ("no-summary", 3)])  # of /two or /other, if nothing lists the chunk
def test_a_foreign_chunk_takes_its_definitions_with_it(foreign: Foreign, tmp_path: Path, layout: str, open_: int) -> None:
    """Seed n8-d, logs 1434: one sound chunk of another log defined a channel, and all of this log behind it was lost.

    In a log with a summary, the chunk replaced the channel that the summary proves.
    """

    def said(topic: str, t_ns: int) -> Message:
        return topic, "std_msgs/msg/String", t_ns, t_ns, 0, b"\0\1\0\0" + struct.pack("<I", 1201) + b"a" * 1200 + b"\0"

    def turned(topic: str, t_ns: int) -> Message:
        payload = encode_imu(np.array([t_ns]), np.zeros((1, 3)), np.zeros((1, 3)), "imu").tobytes()
        return topic, schemas.IMU, t_ns, t_ns, 0, payload

    mine = [said("/mine", i) for i in range(3)] + [said("/two", 10 + i) for i in range(6)]
    other = [turned("/imu", 1000 + i) for i in range(10)] + [said("/other", 1010 + i) for i in range(3)]
    first = foreign(mine, layout, chunk_size=CHUNK_SIZE, name="first")
    second = foreign(other, layout, chunk_size=CHUNK_SIZE, name="second")
    a, b, raw = stretches(first), stretches(second), first.read_bytes()
    assert {m[0] for m in a[0][2]} == {"/mine"}
    assert {m[0] for m in b[1][2]} == {"/imu", "/other"}
    first.write_bytes(raw[: a[0][1]] + second.read_bytes()[b[1][0] : b[1][1]] + raw[a[0][1] :])
    assert repair(first, tmp_path / "out.mcap").losses.unproven == open_
    back = [m for m in by_mcap(tmp_path / "out.mcap") if m not in b[1][2]]
    assert back == [m for _, _, each in a for m in each][: 9 - open_]


def test_a_definition_that_no_crc_covers_gives_way_to_a_proven_one(foreign: Foreign, tmp_path: Path) -> None:
    """Seed n9-l, logs 15095: a channel of another log's summary stood in a gap, and the chunk that defines it was foreign."""
    mine = [text("/mine", 100), *(text(f"/{('two', 'mine')[i % 2]}", 101 + i, 1200) for i in range(5))]
    first = foreign(mine, "no-summary", chunk_size=CHUNK_SIZE, name="first")
    a, raw = stretches(first), first.read_bytes()
    assert [sorted({m[0] for m in each}) for _, _, each in a] == [["/mine"], ["/mine", "/two"], ["/mine", "/two"]]
    body = struct.pack("<HHI", 2, 1, 6) + b"/other" + struct.pack("<I", 3) + b"cdr" + struct.pack("<I", 0)
    channel = struct.pack("<BQ", 4, len(body)) + body
    first.write_bytes(raw[: a[0][1]] + b"\0" * 5 + channel + raw[a[0][1] :])
    repair(first, tmp_path / "out.mcap")
    assert by_mcap(tmp_path / "out.mcap") == [m for _, _, each in a for m in each]


def test_a_topic_stays_with_the_messages_that_are_on_it() -> None:
    """Seed n8-a, logs 1280: poses went to /pose_2, since a channel without messages said that /pose has another type."""
    imu, pose = Schema(3, b"", "ros2msg", schemas.IMU), Schema(4, b"", "ros2msg", schemas.POSE)
    empty = Recording(0, {3: imu}, {3: Channel(3, "/pose", "cdr", {}, 3)})
    full = Recording(9, {4: pose}, {4: Channel(4, "/pose", "cdr", {}, 4)})
    block = MessageBlock(0, 0, 0, 0, 0, None, counts={4: 1}, recording=1)
    kinds, channels = renumber([empty, full], [block], losses := Losses())
    assert {(c.topic, kinds[c.schema_id].name) for c in channels.values()} == {("/pose", pose.name), ("/pose_2", imu.name)}
    assert [empty.renamed, full.renamed, empty.moved] == [{3: "/pose_2"}, {}, True]
    assert any("/pose has two types" in line for line in describe(losses.plain()))


def test_a_topic_that_its_writer_defined_wrongly_costs_no_other_its_messages(tmp_path: Path) -> None:
    """Nothing of a cut log was saved once: a message without fields lacked the one byte that ROS 2 gives it."""
    kinds = {"/right": b"float64[40] numbers\n", "/go": b"", "/load": b"float64[100] load\n"}
    right, *wrong = [MessageTopic(name, f"own/msg/Kind{name[1]}", "ros2msg", text, "cdr") for name, text in kinds.items()]

    def every() -> Iterator[Encoded]:
        for number in range(9000):
            yield Encoded(right, number, number, b"\0\1\0\0" + bytes(320))
            if number % 1000 == 999:  # one byte and 800 are to come, but none and a few do
                yield from (Encoded(topic, number, number, b"\0\1\0\0" + bytes(number // 1000)) for topic in wrong)

    write_log(MessageLog("log", "log", topics=(right, *wrong), messages=every), tmp_path / "log.mcap", compression="none")
    raw = (tmp_path / "log.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(raw[: len(raw) * 2 // 3])
    report = repair(tmp_path / "cut.mcap", tmp_path / "out.mcap")
    assert report.messages["/right"] > 3000
    assert report.messages["/load"] > 2


def test_chunks_of_usual_messages_are_judged_without_decoding_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every message was decoded where the summary has no CRC: half the time of a log of small chunks."""
    with (path := tmp_path / "small.mcap").open("wb") as file:
        writer = Writer(file, chunk_size=1, enable_crcs=False)
        writer.start("ros2")
        kind = writer.register_schema(schemas.IMU, "ros2msg", schemas.definition(schemas.IMU).encode())
        channel = writer.register_channel("/imu", "cdr", kind)
        for n in range(20):
            payload = encode_imu(np.array([n]), np.zeros((1, 3)), np.ones((1, 3)), "imu")[0].tobytes()
            writer.add_message(channel, n, payload, n)
        writer.finish()
    decoded = list[bytes]()
    monkeypatch.setattr(definitions, "decodes", lambda payload, *_: decoded.append(payload) or True)
    with RecoveredLog(path) as log:
        assert len(log.index.blocks) == 20
    assert len(decoded) < 5
