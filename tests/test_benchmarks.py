"""Benchmarks load and print their help: nothing else runs most of them."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from support.benchmarks import FOLDER, benchmark


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_a_benchmark_loads_and_prints_its_help(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module = benchmark(path.stem)
    if "ArgumentParser(" not in path.read_text(encoding="utf-8"):
        return
    monkeypatch.setattr(sys, "argv", [str(path), "--help"])
    with pytest.raises(SystemExit) as ended:
        module.main()
    assert ended.value.code == 0
    assert f"usage: {path.name}" in capsys.readouterr().out


def test_the_codec_benchmark_decodes_what_it_encodes() -> None:
    codec = benchmark("codec")
    count = 2 * codec.CHUNK + 1
    gyro, accel = np.random.default_rng(0).normal(size=(2, count, 3))
    columns = codec.decode(codec.encode(5_000_000 * np.arange(count), gyro, accel))
    assert np.concatenate([part.gyro for part in columns]).tobytes() == gyro.tobytes()
    assert np.concatenate([part.accel for part in columns]).tobytes() == accel.tobytes()
