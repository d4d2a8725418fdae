"""Shapes in annotations are checked while the tests run; real recordings are found here, or their absence is said.

The installed command, made-up logs and a model trained on them are here too, for the tests of the whole way.
"""

from __future__ import annotations

import gc
import logging
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from filelock import FileLock
from hypothesis import settings

os.environ["COLUMNS"] = "80"  # the width of the commands' tables, which are made at import
os.environ.setdefault("OMP_NUM_THREADS", "1")  # small arrays side by side: a second thread of BLAS or torch only waits
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command does: idle threads must not spin while others test

# hundreds of processes start here: each would compile the whole package again
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# memory that a test gives back, the next one takes: to fetch it from the kernel anew took a twentieth of the time (glibc)
os.environ.setdefault("MALLOC_MMAP_THRESHOLD_", str(32 << 20))
os.environ.setdefault("MALLOC_TRIM_THRESHOLD_", str(512 << 20))

# a shell starts background jobs with SIGINT ignored, and they pass that on: the tests of Ctrl-C would test nothing
signal.signal(signal.SIGINT, signal.default_int_handler)

if not os.environ.get("CI"):  # there hypothesis has a profile of its own, which has no deadline and always draws the same
    settings.register_profile("side by side", deadline=None)  # a wall clock says little where tests share the cores
    settings.load_profile("side by side")

# every output is settled on the disk, which takes 4 ms each time: in memory, where there is room, no test waits for that
MEMORY, ROOM_BYTES = Path("/dev/shm"), 4 << 30
if MEMORY.is_dir() and shutil.disk_usage(MEMORY).free > ROOM_BYTES:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))

# thousands of tests and large packages lie in memory for good: going through them for garbage took a sixteenth of the time
gc.set_threshold(100_000, 20)

sys.path.insert(0, str(Path(__file__).parent))  # for tests/support

from support.made_once import made_once  # noqa: E402
from support.shapes import check_shapes  # noqa: E402  (before anything imports the package)

check_shapes("imutool")

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture
def on_disk() -> Iterator[Path]:
    """Folder in which a file takes its time to be written, so that a signal finds a command in the middle of one."""
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        yield Path(folder)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Lets one worker collect ahead of the others: what it compiles, they read."""
    run, compiled = os.environ.get("PYTEST_XDIST_TESTRUNUID", ""), Path(__file__).with_name("__pycache__") / "compiled_by"
    with FileLock(f"{compiled}.lock"):
        if not compiled.exists() or compiled.read_text() != run:
            collected = yield
            compiled.write_text(run)
            return collected
    return (yield)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Puts the tests of whole commands first: a long one that begins last is waited for alone."""
    items.sort(key=lambda item: item.path.parent.name not in ("tests", "cli"))


def pytest_collection_finish() -> None:
    """Leaves what is collected and imported out of every later collection of garbage."""
    from support.outlines import draw_outlines

    from imutool.processes import forked

    draw_outlines()
    if "PYTEST_XDIST_WORKER" in os.environ:  # the other processors are the other workers'
        pytest.MonkeyPatch().setattr(forked, "processors", lambda: 1)
    gc.freeze()


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real recordings."""
    if not DATA.is_dir():
        pytest.skip(f"real recordings are not at {DATA}")
    return DATA


@pytest.fixture(autouse=True)
def logging_as_before() -> Iterator[None]:
    """Restores the log levels that a command in this process sets: with --quiet later tests would see no warnings."""
    loggers = [logging.getLogger(name) for name in (None, "imutool")]
    levels = [logger.level for logger in loggers]
    yield
    for logger, level in zip(loggers, levels, strict=True):
        logger.setLevel(level)


@pytest.fixture(scope="session")
def command() -> str:
    """The installed `imutool` of the Python that runs the tests."""
    return str(Path(sys.executable).with_name("imutool"))


@pytest.fixture
def code(monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """Runs a command line in this process and returns its exit code."""
    monkeypatch.setenv("COLUMNS", "80")

    from imutool import cli

    def run(*words: str | Path) -> int:
        monkeypatch.setattr(sys, "argv", ["imutool", *map(str, words)])
        with pytest.raises(SystemExit) as leaving:
            cli.main()
        return int(leaving.value.code or 0)

    return run


@pytest.fixture(scope="session")
def imutool(command: str) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs the command line in a folder and returns what it printed and its exit code.

    In this process, but for what is about processes: `apart=True`, limits, and fleets, whose workers are processes too.
    """

    def run(*words: str | Path, cwd: Path, apart: bool = False, **options: object) -> subprocess.CompletedProcess[str]:
        from support.in_process import run_command

        env = {**os.environ, "COLUMNS": "80", **options.pop("env", {})}  # type: ignore[dict-item]
        line = [command, *map(str, words)]
        if not (apart or options or words[:1] == ("fleet",) or env["COLUMNS"] != "80"):
            return run_command(line[1:], cwd, env)
        return subprocess.run(
            line,
            cwd=cwd,
            env=env,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=240,
            check=False,
            **options,
        )  # type: ignore[call-overload]

    return run


@pytest.fixture(scope="session")
def torch_import_s(tmp_path_factory: pytest.TempPathFactory) -> float:
    """What a fresh Python takes to import torch, the shorter of two times."""

    def seconds() -> float:
        began = time.perf_counter()
        subprocess.run([sys.executable, "-c", "import torch"], check=True)
        return time.perf_counter() - began

    def make(folder: Path) -> None:
        (folder / "seconds").write_text(str(min(seconds(), seconds())))

    return float((made_once(tmp_path_factory, "torch_import", make) / "seconds").read_text())


@pytest.fixture(scope="session")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with flight_1.mcap and flight_2.mcap (20 s, 200 Hz, 3 s at rest), linear.safetensors of the first."""
    from imutool.mcap_io.write import write
    from imutool.sensor.made_up_flight import flight
    from imutool.training.run import train

    def make(folder: Path) -> None:
        for seed in (1, 2):
            write(flight(seed, duration_s=20.0), folder / f"flight_{seed}.mcap")
        train([folder / "flight_1.mcap"], folder / "linear.safetensors", method="linear")

    return made_once(tmp_path_factory, "logs", make)


@pytest.fixture(scope="session")
def demonstration(tmp_path_factory: pytest.TempPathFactory, imutool: Callable[..., subprocess.CompletedProcess[str]]) -> Path:
    """The folder in which `imutool demo -o demo-out` ran (once for all tests: it trains), its report in `report.json`."""

    def make(folder: Path) -> None:
        done = imutool("demo", "-o", "demo-out", "--json", "report.json", cwd=folder, apart=True)
        assert done.returncode == 0, done.stderr
        (folder / "stdout.txt").write_text(done.stdout)
        (folder / "stderr.txt").write_text(done.stderr)

    return made_once(tmp_path_factory, "demo", make)


@pytest.fixture(scope="session")
def store_server() -> Iterator[Any]:
    """One S3 server for all tests, since the clients of a process keep the address they first found."""
    from support.object_store import Store

    server = Store()
    yield server
    server.stop()


@pytest.fixture
def store(store_server: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The S3 store of tests/support/object_store.py with an empty bucket, found by the usual environment."""
    for name, value in store_server.environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr("s3fs.S3FileSystem.retries", 2)  # by itself it asks five times, for longer each time
    monkeypatch.setattr("s3fs.S3FileSystem.read_timeout", 4)  # s, of 15: what a silent store is given to answer
    store_server.empty()
    yield store_server
    store_server.fault = lambda _: None
