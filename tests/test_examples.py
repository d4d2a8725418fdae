"""Every example runs as a reader would run it, on made-up data, and what it prints is true."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from imutool.debias import debias
from imutool.demo import write_asl
from imutool.physics.flight import flight

EXAMPLES = Path(__file__).parents[1] / "examples"
SAMPLES = 4001  # 20 s at 200 Hz, both ends included

Example = Callable[..., str]


@pytest.fixture
def example(tmp_path: Path) -> Example:
    def run(name: str, *words: str | Path) -> str:
        line = [sys.executable, "-W", "error", str(EXAMPLES / name), *map(str, words)]
        done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, timeout=240, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def test_a_data_set_becomes_debiased_logs_with_smaller_errors(tmp_path: Path, example: Example) -> None:
    for seed in (1, 2):
        write_asl(flight(seed, duration_s=10.0), tmp_path / "src" / f"flight_{seed}")
    printed = example("convert_and_debias.py", "src", "out")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "flight_1.mcap",
        "flight_1_debiased.mcap",
        "flight_2.mcap",
        "flight_2_debiased.mcap",
    ]
    errors = {kind: [float(v) for v in re.findall(rf"{kind}: orientation +([\d.]+)", printed)] for kind in ("raw", "static")}
    assert [len(values) for values in errors.values()] == [2, 2]
    assert max(errors["static"]) < min(errors["raw"])


def test_a_model_is_trained_on_given_logs(tmp_path: Path, logs: Path, example: Example) -> None:
    words = ["steps=2", "samples=400", "gyro_window_s=[0.5]", "accel_window_s=[0.5]"]
    printed = example("train_on_your_logs.py", "m.safetensors", logs / "flight_1.mcap", *words)
    assert "accel    2/2" in printed
    assert len(re.findall(r"held-out error", printed)) == 2
    assert (tmp_path / "m.safetensors").is_file()


@pytest.mark.parametrize("model", [[], ["linear.safetensors"]], ids=["static", "linear"])
def test_a_node_debiases_sample_by_sample_and_says_how_fast(logs: Path, example: Example, model: list[str]) -> None:
    printed = example("online_node.py", logs / "flight_2.mcap", *(logs / name for name in model))
    assert f"{SAMPLES} samples" in printed
    assert float(re.findall(r"([\d.]+) us each", printed)[0]) > 0.0


def test_a_debiased_log_is_read_without_imutool(tmp_path: Path, logs: Path, example: Example) -> None:
    assert "imutool." not in (EXAMPLES / "read_debiased.py").read_text().replace("imutool is needed", "")
    debias(logs / "flight_2.mcap", tmp_path / "out.mcap", model=logs / "linear.safetensors")
    printed = example("read_debiased.py", "out.mcap")
    assert "model linear" in printed
    assert f"{SAMPLES} messages on /imu0/debiased, 0 raw ones" in printed
    raw, corrected = map(float, re.findall(r"yaw rate (-?[\d.]+) rad/s, debiased (-?[\d.]+)", printed)[0])
    assert abs(corrected) < 0.01 < abs(raw)  # at rest; the bias of this sensor is some 0.04 rad/s


def test_the_papers_tables_are_made_in_one_command(tmp_path: Path, data: Path, example: Example) -> None:
    """On the smallest data set, by the quickest method; the raw column is the published one."""
    words = ("--set", "fetch", "--method", "linear", "--seeds", "1", "--workers", "1")
    printed = example("reproduce_tables.py", data, "-o", "out", *words)
    row = next(line for line in printed.splitlines() if line.startswith("| 05_random"))
    raw, linear = (re.search(r"\((\d+\.\d+) / \d+\) (\d+\.\d+) / ", cell) for cell in row.split("|")[2:4])
    assert raw is not None
    assert linear is not None
    assert abs(float(raw[2]) - float(raw[1])) < 0.11
    assert float(linear[2]) < 0.2 * float(raw[2])
    page = (tmp_path / "out" / "tables.html").read_text(encoding="utf-8")
    assert page.count("<table>") == 3
    assert page.count("data:image/png;base64,") == 1
    assert "http" not in page
    assert example("reproduce_tables.py", data, "-o", "out", *words) == printed  # nothing is made twice


def test_every_example_is_run_here() -> None:
    here = Path(__file__).read_text()
    assert all(f'"{path.name}"' in here for path in EXAMPLES.glob("*.py"))
    assert len(list(EXAMPLES.glob("*.py"))) >= 4
