"""Chunks are unpacked by many threads at once, and their buffers are not faulted in anew for every chunk."""

from __future__ import annotations

import subprocess
import sys
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from imutool.errors import LogError
from imutool.mcap_io.codec import records
from imutool.mcap_io.codec.records import chunk_head, keep_buffers, pack, unpack
from imutool.mcap_io.write import write
from imutool.recording import Frames, Imu, Recording

PAGE = 4096
COUNT_FAULTS = """
import resource, sys
from pathlib import Path
from imutool.mcap_io.log import Log
with Log(Path(sys.argv[1])) as log:
    topic, = log.topics.keys() - log.imu_topics
    def run():
        for block in log.index.blocks:
            log.index.unpack(block)
    run()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    run()
    print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def test_buffers_are_used_again_from_chunk_to_chunk(tmp_path: Path) -> None:
    if not keep_buffers():
        pytest.skip("the allocator of this system is not glibc's, which alone is told here")
    images = [(1000 + i, np.random.default_rng(i).bytes(1 << 20)) for i in range(30)]
    nothing = Imu(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
    frames = {"/cam0/image_raw": Frames("raw", len(images), lambda: iter(images))}
    path = tmp_path / "log.mcap"
    write(Recording("x", nothing, frames=frames), path, compression="lz4")
    done = subprocess.run([sys.executable, "-c", COUNT_FAULTS, path], capture_output=True, text=True, check=True)
    unpacked_pages = len(images) * (1 << 20) // PAGE
    assert int(done.stdout) < unpacked_pages / 4  # unhelped it is twice the pages, one for the packed and one for the unpacked


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_threads_unpack_their_own_chunks_at_once(compression: str) -> None:
    contents = [np.random.default_rng(k).integers(0, 4, 200_000, np.uint8).tobytes() for k in range(8)]
    chunks = [chunk_head(data, pack(compression)(data), compression, 0, 1) + pack(compression)(data) for data in contents]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda chunk: bytes(unpack(chunk, 0)), 8 * chunks))
    assert found == 8 * contents


def unpacked(data: bytes, packed: bytes) -> bytes | str:
    try:
        return bytes(unpack(chunk_head(data, packed, "lz4", 0, 1) + packed, 0))
    except LogError as error:
        return str(error)


def test_a_large_lz4_chunk_comes_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    data = np.random.default_rng(1).integers(0, 4, 1 << 20, np.uint8).tobytes()
    frame, half = pack("lz4")(data), len(data) // 2
    frames = {
        "one": frame,
        "two": pack("lz4")(data[:half]) + pack("lz4")(data[half:]),
        "cut": frame[: len(frame) // 2],
        "too long": pack("lz4")(data + b"more"),
    }
    at_once = {name: unpacked(data, packed) for name, packed in frames.items()}
    assert at_once["one"] == at_once["two"] == data
    monkeypatch.setattr(records, "PIECE", 100_000)
    assert {name: unpacked(data, packed) for name, packed in frames.items()} == at_once
    tracemalloc.start()
    unpack(chunk_head(data, frame, "lz4", 0, 1) + frame, 0)
    peak = tracemalloc.get_traced_memory()[1] - len(frame)
    tracemalloc.stop()
    assert peak < 1.5 * len(data)  # it was twice its size
