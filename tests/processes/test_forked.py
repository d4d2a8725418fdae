"""Forked processes: results and log lines come back, nothing is left, one processor gives the same."""

from __future__ import annotations

import logging
import math
import os
import select
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from imutool.errors import DataError
from imutool.processes import forked
from imutool.processes.forked import Forked, forking, of_each

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="commands fork on Linux alone")


def children() -> set[str]:
    """Processes that this one has started, those included that ended and are not waited for."""
    return {pid for task in Path("/proc/self/task").iterdir() for pid in (task / "children").read_text().split()}


@pytest.fixture
def two(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Two processors, however many there are; nothing is left at the end."""
    monkeypatch.setattr(forked, "processors", lambda: 2)
    before = children()
    yield
    assert children() <= before


@pytest.mark.usefixtures("two")
def test_a_function_runs_beside_this_process_and_its_result_comes_back() -> None:
    large, (waiting, release) = b"x" * 10_000_000, os.pipe()
    with forking():
        first, second = Forked(lambda: (os.getpid(), os.read(waiting, 1) * len(large))), Forked(os.getpid)
        assert second.result() == os.getpid()  # the other processor is taken
        os.write(release, b"x")
        process, content = first.result()
        assert process != os.getpid()
        assert content == large
        assert first.result() == (process, large)
        assert Forked(os.getpid).result() != os.getpid()
    os.close(waiting)
    os.close(release)


@pytest.mark.usefixtures("two")
def test_outside_a_command_nothing_is_forked() -> None:
    assert Forked(os.getpid).result() == os.getpid()


def test_on_one_processor_nothing_is_forked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forked, "processors", lambda: 1)
    with forking():
        assert Forked(os.getpid).result() == os.getpid()


@pytest.mark.usefixtures("two")
def test_where_the_system_has_no_process_to_give_the_function_runs_here(monkeypatch: pytest.MonkeyPatch) -> None:
    def none_left(nicer: int) -> int:
        raise BlockingIOError

    monkeypatch.setattr(forked, "fork", none_left)
    with forking():
        before = list(Path("/proc/self/fd").iterdir())
        assert Forked(os.getpid).result() == os.getpid()
        assert len(list(Path("/proc/self/fd").iterdir())) == len(before)


@pytest.mark.usefixtures("two")
def test_its_log_lines_come_with_the_result(caplog: pytest.LogCaptureFixture) -> None:
    def warn() -> int:
        logging.getLogger("imutool.test").warning("%s of it", "half")
        return 1

    with forking():
        beside = Forked(warn)
        assert caplog.messages == []
        assert beside.result() == 1
    assert caplog.messages == ["half of it"]


@pytest.mark.usefixtures("two")
def test_a_function_that_raises_raises_here_and_one_whose_process_dies_runs_here() -> None:
    def refuse() -> int:
        raise DataError("too little")

    here = os.getpid()

    def die_elsewhere() -> str:
        if os.getpid() != here:
            os._exit(9)
        return "done"

    with forking():
        beside = Forked(refuse)
        with pytest.raises(DataError, match="too little"):
            beside.result()
        assert Forked(die_elsewhere).result() == "done"


@pytest.mark.usefixtures("two")
def test_an_idle_process_takes_no_processor_and_nobody_waits_for_it(caplog: pytest.LogCaptureFixture) -> None:
    def warned() -> int:
        logging.getLogger("imutool.test").warning("said again later")
        return os.getpid()

    with forking():
        done, slow = Forked(warned, idle=True), Forked(lambda: time.sleep(60.0), idle=True)
        assert Forked(os.getpid).result() != os.getpid()
        if done in forked._Processes.running:  # else its result came before the next process was forked
            select.select([done], [], [], 30.0)
        assert done.ready() not in (None, os.getpid())
        began = time.monotonic()
        assert slow.ready() is None
        assert time.monotonic() - began < 30.0
        assert not forked._Processes.running
    assert Forked(warned, idle=True).ready() is None
    assert caplog.messages == []


@pytest.mark.usefixtures("two")
def test_a_process_with_its_result_takes_no_processor_and_no_memory() -> None:
    before = children()
    with forking():
        done = Forked(lambda: b"x" * 10_000_000)
        select.select([done], [], [], 30.0)
        assert Forked(os.getpid).result() != os.getpid()
        assert children() <= before
        assert len(done.result()) == 10_000_000


@pytest.mark.usefixtures("two")
@pytest.mark.parametrize("count", range(8))
@pytest.mark.parametrize("processors", [1, 2, 4])
@pytest.mark.parametrize("worth_s", [0.0, 60.0])
def test_each_item_has_its_result_in_order_and_free_processors_share_what_is_worth_it(
    monkeypatch: pytest.MonkeyPatch, worth_s: float, processors: int, count: int
) -> None:
    monkeypatch.setattr(forked, "WORTH_S", worth_s)
    monkeypatch.setattr(forked, "processors", lambda: processors)
    here, before = os.getpid(), children()
    with forking():
        made = list(of_each(lambda k: (10 * k, os.getpid()), range(3, 3 + count)))
        assert [tens for tens, _ in made] == [10 * k for k in range(3, 3 + count)]
        share = max(1, math.ceil((count - 1) / processors)) if worth_s == 0.0 else count
        assert [process == here for _, process in made] == [k < 1 + share for k in range(count)]
        assert len({process for _, process in made}) == min(count, max(1, math.ceil((count - 1) / share) if share else 0))
        assert next(of_each(lambda k: k, range(count)), 0) == 0  # who wants no more leaves no process behind
        assert children() <= before
    assert list(of_each(str, range(3))) == ["0", "1", "2"]


@pytest.mark.usefixtures("two")
@pytest.mark.parametrize("count", range(5))
def test_items_that_take_long_are_shared_from_the_first_on(count: int) -> None:
    here = os.getpid()
    with forking():
        made = list(of_each(lambda k: (10 * k, os.getpid()), range(count), long=True))
    assert [tens for tens, _ in made] == [10 * k for k in range(count)]
    assert [process == here for _, process in made] == [k < math.ceil(count / 2) for k in range(count)]


@pytest.mark.usefixtures("two")
def test_whatever_ends_a_command_ends_its_processes() -> None:
    def interrupted() -> None:
        with forking():
            Forked(lambda: time.sleep(60.0))
            raise KeyboardInterrupt

    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    before = children()
    with forking():
        slow = Forked(lambda: time.sleep(60.0))
        slow.end()
        assert children() <= before
    assert time.monotonic() - began < 30.0
