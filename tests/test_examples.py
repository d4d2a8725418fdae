"""Every example runs as a reader would run it, on made-up data, and what it prints is true."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from support.in_process import run_script
from support.saved_rrd import entities

from imutool.cli.demo import write_asl
from imutool.debiasing import debias
from imutool.mcap_io.write import write
from imutool.sensor.made_up_flight import flight

EXAMPLES = Path(__file__).parents[1] / "examples"
SAMPLES = 4001  # 20 s at 200 Hz, both ends included

APART = {"read_debiased.py"}  # it is without imutool

Example = Callable[..., str]


@pytest.fixture
def example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Example:
    monkeypatch.setenv("PYTHONWARNINGS", "error")  # for the processes that an example starts

    def run(name: str, *words: str | Path) -> str:
        line = [str(EXAMPLES / name), *map(str, words)]
        if name in APART:
            apart = [sys.executable, "-W", "error", *line]
            done = subprocess.run(apart, cwd=tmp_path, capture_output=True, text=True, timeout=240, check=False)
        else:
            done = run_script(line, tmp_path)
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
    imu = flight(3, duration_s=10.0).imu
    header = "time [ns],gx [rad/s],gy [rad/s],gz [rad/s],ax [m/s^2],ay [m/s^2],az [m/s^2]"
    rows = np.column_stack([imu.t_ns - imu.t_ns[0], imu.gyro, imu.accel])
    np.savetxt(tmp_path / "blind.csv", rows, header=header, delimiter=",", comments="")
    printed = example("convert_and_debias.py", "blind.csv", "blind")
    assert "without true poses there are no errors to show" in printed
    assert sorted(p.name for p in (tmp_path / "blind").iterdir()) == ["blind.mcap", "blind_debiased.mcap"]


def test_a_model_is_trained_on_given_logs(tmp_path: Path, example: Example) -> None:
    for seed in (1, 2):
        write(flight(seed, duration_s=13.0, rate_hz=100.0), tmp_path / f"{seed}.mcap")
    words = ["steps=2", "samples=400", "gyro_window_s=[0.5]", "accel_window_s=[0.5]", "compare=false"]
    printed = example("train_on_your_logs.py", "m.safetensors", "1.mcap", "2.mcap", *words)
    assert "gyro    2/2" in printed
    assert "nan" not in printed
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


def begin(source: Path, target: Path, rows: int) -> None:
    """Copies the first rows of every table of a sequence."""
    for table in source.rglob("data.csv"):
        copy = target / table.relative_to(source)
        copy.parent.mkdir(parents=True)
        with table.open() as lines:
            copy.write_text("".join(islice(lines, rows)))


def test_the_papers_tables_are_made_in_one_command(tmp_path: Path, data: Path, example: Example) -> None:
    """On the smallest data set, by the quickest method, trained on the beginnings; the raw column is the published one."""
    for sequence in (data / "fetch").iterdir():
        begin(sequence, tmp_path / "data" / "fetch" / sequence.name, 10**6 if sequence.name == "05_random" else 3000)
    words = ("--set", "fetch", "--method", "linear", "--seeds", "1", "--workers", "1")
    printed = example("reproduce_tables.py", "data", "-o", "out", *words)
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
    assert example("reproduce_tables.py", "data", "-o", "out", *words) == printed  # nothing is made twice


def test_a_log_is_looked_at_and_a_page_is_left(
    tmp_path: Path, logs: Path, example: Example, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    printed = example("view_a_log.py", logs / "flight_1.mcap")
    raw, static = (
        float(re.findall(rf"^{name}: at the end ([\d.]+) deg", printed, re.MULTILINE)[0]) for name in ("raw", "static")
    )
    assert static < raw
    assert "worst: static: largest orientation error" in printed
    assert "<svg" in (tmp_path / "flight_1.html").read_text(encoding="utf-8")
    assert {"/world/debiased/path", "/error/orientation/raw"} <= entities(tmp_path / "flight_1.rrd")


def test_models_are_compared_on_one_log(tmp_path: Path, logs: Path, example: Example) -> None:
    printed = example("compare_models.py", logs / "flight_2.mcap", "both.rrd", "static", logs / "linear.safetensors")
    figures = next(line.split() for line in printed.splitlines() if line.startswith("aoe_deg"))
    raw, static, linear = map(float, figures[1:])
    assert max(static, linear) < raw
    assert "linear: over 5 s from the truth it drifts by" in printed
    held = entities(tmp_path / "both.rrd")
    assert {"/run/static/world/debiased/path", "/run/linear/world/debiased/path", "/world/raw/path"} <= held


def test_a_stream_is_shown_as_it_is_corrected(tmp_path: Path, example: Example) -> None:
    printed = example("live_stream.py", "live.rrd", "5")
    assert "1001 samples in batches of 100" in printed
    assert {"/world/debiased/path", "/imu/gyro/raw", "/bias/accel/estimated"} <= entities(tmp_path / "live.rrd")


CELLS = """
import json, sys
from IPython.core.interactiveshell import InteractiveShell
shell = InteractiveShell.instance()
for cell in json.load(open(sys.argv[1], encoding="utf-8"))["cells"]:
    if cell["cell_type"] == "code":
        done = shell.run_cell("".join(cell["source"]))
        done.raise_error()
        print("SHOWN", type(done.result).__name__)
"""


def run_cells(name: str, folder: Path) -> str:
    """What the cells of a notebook print, run one after the other as a server runs them; no browser sees it."""
    line = [sys.executable, "-c", CELLS, str(EXAMPLES / name)]
    env = {**os.environ, "IPYTHONDIR": str(folder / "ipython"), "MPLBACKEND": "agg"}
    done = subprocess.run(line, cwd=folder, env=env, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    notebook = json.loads((EXAMPLES / name).read_text(encoding="utf-8"))
    assert not any(cell.get("outputs") for cell in notebook["cells"])  # what was seen on one machine is no part of it
    return done.stdout


def test_a_notebook_shows_the_viewer_and_the_page(tmp_path: Path, logs: Path) -> None:
    shutil.copy(logs / "flight_1.mcap", tmp_path / "log.mcap")
    printed = run_cells("notebook.ipynb", tmp_path)
    assert re.findall(r"^SHOWN (\w+)", printed, re.MULTILINE) == ["NoneType", "NoneType", "Viewer", "Page"]
    assert re.search(r"aoe_deg +[\d.]+ +[\d.]+", printed)


def test_a_notebook_leads_from_a_wrong_simulation_of_a_real_recording_to_a_right_one(tmp_path: Path, data: Path) -> None:
    """The scales it finds are those that the authors of the data set published, and the simulation comes five times closer."""
    (tmp_path / "dataset-room1.tar.gz").symlink_to(data / "tumvi" / "dataset-room1.tar.gz")
    done = run_cells("simulation_to_recording.ipynb", tmp_path)
    scales = re.findall(r"^[xyz]: found +([-\d.]+) ± [\d.]+ %, published +([-\d.]+) %$", done, re.MULTILINE)
    assert len(scales) == 3
    assert all(float(own) == pytest.approx(float(published), abs=0.5) for own, published in scales)
    before, after = (float(angle) for angle in re.findall(r"([\d.]+)° in the median", done))
    assert after < before / 5.0
    assert re.search(r"^accel_scale +accel +removes +\d+%$", done, re.MULTILINE)


def test_every_example_is_run_here() -> None:
    here = Path(__file__).read_text()
    assert all(f'"{path.name}"' in here for path in [*EXAMPLES.glob("*.py"), *EXAMPLES.glob("*.ipynb")])
    assert len(list(EXAMPLES.glob("*.py"))) >= 4
