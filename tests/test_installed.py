"""What a user installs: the command starts light and imports no more than its job needs, and the wheel holds what it must."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
import venv
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from imutool import __version__
from imutool.cli.demo import write_asl
from imutool.mcap_io.write import write
from imutool.sensor.made_up_flight import flight

ROOT = Path(__file__).parents[1]
HEAVY = {"scipy", "torch", "torchdiffeq", "rerun", "ray", "matplotlib", "rosbags", "fsspec", "upath"}
HELP_SHARE = 0.4  # of the time `import torch` takes; the command itself takes about a tenth of it
ROUNDS = 4


# ── what a command imports ──

SPY = """
import atexit, json, sys
sys.argv = ["imutool", *sys.argv[1:]]
from imutool.cli import main
atexit.register(lambda: print("SEEN", json.dumps(sorted({m.partition(".")[0] for m in sys.modules})), file=sys.stderr))
main()
"""


@pytest.fixture
def imported(tmp_path: Path) -> Callable[..., set[str]]:
    """The heavy packages that a command, run to its end, has imported."""

    def run(*words: str | Path) -> set[str]:
        line = [sys.executable, "-c", SPY, *map(str, words)]
        done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, done.stderr
        return HEAVY & set(json.loads(re.findall(r"^SEEN (.*)$", done.stderr, re.MULTILINE)[0]))

    return run


@pytest.mark.parametrize("words", [["--help"], ["train", "--help"], ["convert", "--help"], ["--version"]], ids=" ".join)
def test_help_imports_nothing_heavy(imported: Callable[..., set[str]], words: list[str]) -> None:
    assert imported(*words) == set()


HYBRID = "debias LOG o.mcap --model euroc-adis16448-hybrid --force --init truth"


@pytest.mark.parametrize(
    "line", ["info LOG", "clean LOG", "evaluate LOG --model MODEL", "debias LOG o.mcap --model MODEL", HYBRID]
)
def test_commands_that_look_or_infer_import_nothing_heavy(imported: Callable[..., set[str]], logs: Path, line: str) -> None:
    given = {"LOG": logs / "flight_1.mcap", "MODEL": logs / "linear.safetensors"}
    assert imported(*(given.get(word, word) for word in line.split())) == set()


def test_convert_imports_nothing_heavy(imported: Callable[..., set[str]], tmp_path: Path) -> None:
    write_asl(flight(1, duration_s=1.0), tmp_path / "flight_1")
    assert imported("convert", "flight_1", "out.mcap") == set()
    assert (tmp_path / "out.mcap").is_file()


def test_view_without_a_model_imports_the_viewer_and_scipy(
    imported: Callable[..., set[str]], tmp_path: Path, logs: Path
) -> None:
    assert imported("view", logs / "flight_1.mcap", "--save", "out.rrd") == {"rerun", "scipy"}
    assert (tmp_path / "out.rrd").is_file()


def test_noise_in_motion_shows_that_the_spy_sees(imported: Callable[..., set[str]], logs: Path) -> None:
    assert "torch" in imported("info", logs / "flight_1.mcap", "--noise")


INFERENCE = """
import sys
from typer.testing import CliRunner
from imutool.cli import load
for line in sys.argv[1:]:
    done = CliRunner().invoke(load(), line.split())
    assert done.exit_code == 0, (line, done.output, done.exception)
    assert "torch" not in sys.modules, line
"""


def test_commands_that_infer_need_no_torch(tmp_path: Path, logs: Path) -> None:
    """Every command but those that train, one after another in one process, with every method that ships a network."""
    log, cut = tmp_path / "log.mcap", tmp_path / "cut.mcap"
    write(flight(2, duration_s=8.0), log)
    cut.write_bytes(log.read_bytes()[:-1000])
    lines = [
        f"debias {log} linear.mcap --model {logs / 'linear.safetensors'}",
        f"debias {log} smooth.mcap --smooth",
        f"debias {log} hybrid.mcap --model euroc-adis16448-hybrid --init truth --force",
        f"debias {log} ode.mcap --model euroc-adis16448-neural_ode --force",
        f"debias {log} conv.mcap --model euroc-adis16448-conv --force",
        f"evaluate {log} --model {logs / 'linear.safetensors'} --zupt",
        f"view {log} --model static --html view.html",
        f"repair {cut} repaired.mcap",
        f"info {log} linear.mcap",
        f"clean {log} cleaned.mcap",
        "models",
    ]
    line = [sys.executable, "-c", INFERENCE, *lines]
    done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, timeout=180, check=False)
    assert done.returncode == 0, done.stderr


WITHOUT_TORCH = """
import importlib.machinery
import sys

class Finder(importlib.machinery.PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name in {"torch", "torchdiffeq"} else super().find_spec(name, path, target)

sys.meta_path = [Finder if each is importlib.machinery.PathFinder else each for each in sys.meta_path]
sys.argv[0] = "imutool"
"""


def test_without_torch_training_says_what_to_install_and_debias_works(tmp_path: Path, logs: Path) -> None:
    def run(*words: str | Path) -> subprocess.CompletedProcess[str]:
        line = [sys.executable, "-c", f"{WITHOUT_TORCH}from imutool.cli import main; main()", *map(str, words)]
        return subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)

    refused = run("train", logs / "flight_1.mcap", "-o", "m.safetensors")
    assert refused.returncode == 3
    assert refused.stderr.endswith("Install it with: pip install 'imutool[train]'.\n")
    assert run("debias", logs / "flight_2.mcap", "o.mcap", "--model", logs / "linear.safetensors").returncode == 0


def test_help_is_quick(command: str, torch_import_s: float) -> None:
    def seconds() -> float:
        began = time.perf_counter()
        subprocess.run([command, "--help"], check=True, stdout=subprocess.DEVNULL)
        return time.perf_counter() - began

    limit_s = HELP_SHARE * torch_import_s
    assert any(seconds() < limit_s for _ in range(ROUNDS)), f"imutool --help took over {limit_s:.2f} s each time"


# ── the wheel ──


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built by hatchling in an environment of its own as pip does for anybody."""
    out = tmp_path_factory.mktemp("wheel")
    line = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(out), str(ROOT)]
    done = subprocess.run(line, capture_output=True, text=True, timeout=300, check=False)
    if "No matching distribution found for hatchling" in done.stderr:
        pytest.skip("no package index can be reached from here, and hatchling comes from one")
    assert done.returncode == 0, done.stderr
    (built,) = out.glob("*.whl")
    return built


def test_the_wheel_holds_one_package_its_types_and_the_models(wheel: Path) -> None:
    held = set(zipfile.ZipFile(wheel).namelist())
    for folder, package in (("imutool", "imutool"), ("converters", "imutool/converters")):
        root = ROOT / folder
        assert {f"{package}/{path.relative_to(root).as_posix()}" for path in root.rglob("*.py")} <= held
        assert f"{package}/py.typed" in held
    models = {f"imutool/_models/{path.name}" for path in (ROOT / "models").iterdir()}
    assert models <= held
    assert "imutool/_models/README.md" in models
    tops = {name.partition("/")[0] for name in held}
    assert tops == {"imutool", f"imutool-{__version__}.dist-info"}
    assert {f"imutool/viewing/rerun/site/{name}" for name in ("index.html", "start.js")} <= held


def test_the_wheel_runs_in_a_fresh_environment(wheel: Path, tmp_path: Path, logs: Path) -> None:
    """What it depends on is lent from here by PYTHONPATH, which takes no notice of our own editable install."""
    venv.create(tmp_path / "venv", with_pip=False)
    python = tmp_path / "venv" / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps", "--no-index", str(wheel)]
    subprocess.run(pip, check=True, timeout=120)
    lent = next(path for path in sys.path if path.endswith("site-packages"))

    def run(*line: str | Path) -> Any:
        env = {**os.environ, "PYTHONPATH": lent}
        return subprocess.run(list(map(str, line)), cwd=tmp_path, env=env, check=True, capture_output=True, text=True).stdout

    for package in ("imutool", "imutool.converters"):
        assert Path(run(python, "-c", f"import {package}; print({package}.__file__)").strip()).is_relative_to(tmp_path)
    assert run(tmp_path / "venv" / "bin" / "imutool", "--version").strip() == f"imutool {__version__}"
    report = json.loads(run(tmp_path / "venv" / "bin" / "imutool", "info", logs / "flight_1.mcap", "--json", "-"))
    assert report["log"] == "flight_1"
