"""Workers die alone: what killed one is charged to nobody as long as another item may be the cause, and none outlives us."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path

import pytest
from support import pool_functions
from support.pool_functions import follow
from support.processes import below, lives, soon

from imutool.errors import ConfigError
from imutool.processes.worker_pool import Outcome, WorkerBugError, WorkerDiedError, WorkerPool

LEFT_S = 2.0


def outcomes(
    folder: Path, actions: Iterable[str], *, workers: int = 2, retries: int = 0, limit_s: float = math.inf
) -> dict[str, Outcome]:
    """By the name of each item: its number and what it does."""
    items = [(action, str(folder / f"{number} {action}")) for number, action in enumerate(actions)]
    with WorkerPool(follow, workers, retries=retries, limit_s=limit_s) as pool:
        return {Path(outcome.item[1]).name: outcome for outcome in pool.run(items)}


def tries(folder: Path, name: str) -> list[int]:
    """The processes in which an item was tried."""
    return [int(line) for line in (folder / name).read_text().splitlines()]


def test_every_item_has_one_outcome_and_a_bug_stops_no_other(tmp_path: Path) -> None:
    done = outcomes(tmp_path, ["well", "bug", "well", "well"])
    assert {name: outcome.value for name, outcome in done.items() if outcome.error is None} == {
        name: str(tmp_path / name) for name in ("0 well", "2 well", "3 well")
    }
    error = done["1 bug"].error
    assert isinstance(error, WorkerBugError)
    assert str(error) == "ValueError('two and two is five')"
    assert "in follow" in error.trace
    assert len({pid for name in done for pid in tries(tmp_path, name)}) <= 2


@pytest.mark.parametrize("action", ["last 60", "last 60 against SIGTERM"])
def test_an_item_that_takes_too_long_is_given_up_and_no_other(tmp_path: Path, action: str) -> None:
    begin = time.monotonic()
    done = outcomes(tmp_path, [action, "well", "well"], retries=3, limit_s=1.0)
    error = done[f"0 {action}"].error
    assert isinstance(error, WorkerDiedError)
    assert error.overdue
    assert [name for name, outcome in done.items() if outcome.error] == [f"0 {action}"]
    assert len(tries(tmp_path, f"0 {action}")) == 1
    assert time.monotonic() - begin < 30.0


def test_a_killed_worker_costs_a_sound_item_no_retry(tmp_path: Path) -> None:
    """Without a single retry: another item may have taken the memory. It is done again alone, after all others."""
    done = outcomes(tmp_path, ["killed once", "last 1", "well", "well"])
    assert [name for name, outcome in done.items() if outcome.error] == []
    assert len(tries(tmp_path, "0 killed once")) == 2
    assert list(done)[-1] == "0 killed once"


def test_an_item_whose_worker_is_killed_alone_too_is_given_up(tmp_path: Path) -> None:
    done = outcomes(tmp_path, ["killed", "last 1", "well"], retries=1)
    assert isinstance(done["0 killed"].error, WorkerDiedError)
    assert str(done["0 killed"].error) == "Killed"
    assert len(tries(tmp_path, "0 killed")) == 3  # once with another, and twice alone
    assert [name for name, outcome in done.items() if outcome.error is None] == ["2 well", "1 last 1"]


def test_a_crash_is_charged_to_its_own_item(tmp_path: Path) -> None:
    done = outcomes(tmp_path, ["crash", "crash once", "well"], retries=1)
    assert {name: str(outcome.error) for name, outcome in done.items() if outcome.error} == {"0 crash": "Segmentation fault"}
    assert [len(tries(tmp_path, name)) for name in ("0 crash", "1 crash once", "2 well")] == [2, 2, 1]


def test_an_end_that_a_destructor_swallows_comes_again(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """What is raised in a destructor is printed and forgotten, and the worker would go on for ever."""
    done = outcomes(tmp_path, ["ended in a destructor", "well"])
    assert str(done["0 ended in a destructor"].error) == "exit code 143"
    assert done["1 well"].error is None
    assert capfd.readouterr().err == ""


def test_a_file_that_is_called_as_a_module_is_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "json.py").write_text("raise SystemExit")
    monkeypatch.chdir(tmp_path)
    assert outcomes(tmp_path, ["well"])["0 well"].error is None


def test_workers_that_do_not_start_are_an_error_not_a_loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool_functions.no_worker, "__qualname__", "nowhere")
    monkeypatch.setattr(pool_functions, "nowhere", pool_functions.no_worker, raising=False)
    with (
        WorkerPool(pool_functions.no_worker, 2) as pool,
        pytest.raises(ConfigError, match=r"workers: worker processes do not start \(exit code 1\)"),
    ):
        list(pool.run([1, 2]))


DRIVER = """
import sys
from pathlib import Path
from imutool.processes.worker_pool import WorkerPool
from support.pool_functions import follow
with WorkerPool(follow, 2) as pool:
    list(pool.run([("last 60", sys.argv[1] + name) for name in "ab"]))
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT], ids=["KILL", "TERM", "INT"])
def test_no_worker_is_left_two_seconds_after_its_parent(tmp_path: Path, number: signal.Signals) -> None:
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, sys.path))}
    line = [sys.executable, "-c", DRIVER, f"{tmp_path}/"]
    with subprocess.Popen(line, env=env, stderr=subprocess.DEVNULL) as driver:
        soon(lambda: len(list(tmp_path.iterdir())) == 2)
        workers = [pid for pid in below(driver.pid) if pid != driver.pid]
        assert len(workers) == 2
        began = time.monotonic()
        driver.send_signal(number)
        driver.wait(timeout=LEFT_S)
        soon(lambda: not any(lives(pid) for pid in workers))
        assert time.monotonic() - began < LEFT_S
