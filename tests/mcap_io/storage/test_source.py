"""Bytes are those at their offset, whoever else reads the same file."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from imutool.file_location import location
from imutool.mcap_io.storage.source import Source

NUMBERS, READS, THREADS = 1 << 16, 300, 4


@pytest.mark.parametrize("store", [False, True], ids=["file", "store"])
def test_threads_share_a_source(store: bool, tmp_path: Path) -> None:
    place: Any = location("memory://shared/source.bin") if store else tmp_path / "source.bin"
    place.write_bytes(np.arange(NUMBERS, dtype="<u8").tobytes())
    source, together = Source(place), threading.Barrier(THREADS)

    def wrong(seed: int) -> int:
        rng = np.random.default_rng(seed)
        together.wait()
        asked = zip(rng.integers(0, NUMBERS - 4096, READS), rng.choice([1, 64, 4096], READS), strict=True)
        return sum(int(source.at(8 * int(at), 8 * int(count))[:8] != int(at).to_bytes(8, "little")) for at, count in asked)

    with ThreadPoolExecutor(THREADS) as pool:
        assert list(pool.map(wrong, range(THREADS))) == [0] * THREADS
    source.file.close()
