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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--left-out", "a.mcap", "--known", "rest"], "of made-up sensors"),
        (["--model", "static", "a.mcap", "--rest", "8"], "of made-up sensors"),
        (["--made-up", "2", "--rest", "0"], "no log to judge"),  # both have a stop
        (["--left-out"], "no log to judge"),
    ],
)
def test_consistency_says_what_it_cannot_judge(
    arguments: list[str], message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It took no notice of such options, or printed nothing."""
    monkeypatch.setattr(sys, "argv", ["consistency.py", *arguments])
    with pytest.raises(SystemExit) as ended:
        benchmark("consistency").main()
    assert ended.value.code == 2
    assert message in capsys.readouterr().err


def test_the_codec_benchmark_decodes_what_it_encodes() -> None:
    codec = benchmark("codec")
    count = 2 * codec.CHUNK + 1
    gyro, accel = np.random.default_rng(0).normal(size=(2, count, 3))
    columns = codec.decode(codec.encode(5_000_000 * np.arange(count), gyro, accel))
    assert np.concatenate([part.gyro for part in columns]).tobytes() == gyro.tobytes()
    assert np.concatenate([part.accel for part in columns]).tobytes() == accel.tobytes()
