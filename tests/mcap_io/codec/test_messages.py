"""Messages are found in the bytes of a chunk in time that grows with the bytes, and topics with their number."""

from __future__ import annotations

import struct
import time
from pathlib import Path

import numpy as np
from mcap.writer import Writer

from imutool.mcap_io.codec.messages import parse
from imutool.mcap_io.log import Log


def message(size: int) -> bytes:
    return struct.pack("<BQHIQQ", 5, 22 + size, 1, 0, 1, 1) + bytes(size)


def test_a_chunk_of_many_short_runs_of_equal_messages_takes_no_time() -> None:
    """58 CPU seconds once: for each run all bytes behind it were looked at."""
    sizes = [8, 9] * 6_000
    data = b"".join(message(size) * 24 for size in sizes)
    began = time.process_time()
    found = parse(data, 0)
    assert time.process_time() - began < 3.0
    lengths = np.repeat([31 + size for size in sizes], 24)
    np.testing.assert_array_equal(found.offsets, np.cumsum(lengths) - lengths)


def test_a_long_run_ends_where_its_length_or_opcode_changes() -> None:
    for count in (1, 8, 9, 72, 73, 74, 328, 329, 330, 5000):
        data = message(8) * count + message(9) + message(8) * count
        assert len(parse(data, 0).offsets) == 2 * count + 1


def test_a_log_of_many_topics_is_opened_in_time_that_grows_with_their_number(tmp_path: Path) -> None:
    """Each topic looked at the ids of all others."""
    path, count = tmp_path / "log.mcap", 8000
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("x", "jsonschema", b"{}")
        for topic in range(count):
            channel = writer.register_channel(f"/t{topic}", "json", schema)
            writer.add_message(channel, topic, b"{}", topic)
        writer.finish()
    began = time.process_time()
    with Log(path) as log:
        assert len(log.topics) == count
    assert time.process_time() - began < 3.0
