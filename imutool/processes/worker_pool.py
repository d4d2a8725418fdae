"""Apply a function to many items in worker processes; one that dies takes no other with it.

A worker is a Python process of its own with a socket to this one; nothing is forked, and the caller's `__main__` is not run
again. It has one item at a time, so that its death is known to be that item's, or to have come from outside. It ends when this
process ends, however that happens: its socket then ends too.

A worker that is killed from outside (by the system when memory runs out, or by a person) may be the victim of another item. As
long as others ran, such a death is charged to nobody, and the item is done again alone, after all others. Only a death alone or
a crash of its own, such as a segmentation fault, uses up one of an item's retries.
"""

from __future__ import annotations

import contextlib
import gc
import json
import math
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe, wait
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple, NoReturn

from imutool.errors import ConfigError
from imutool.processes.system import KILLED, inherited, opened, repeat_swallowed

POLL_S = 0.5
GRACE_S = 1.2  # for a worker to remove what it has half written
STARTS = 3  # deaths of workers one after the other before they are ready
TERMINATED = 143
READY = b"ready"
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
START = """
import sys, json
sys.path[:] = json.loads(sys.argv[2])
from imutool.processes.worker_pool import serve
serve(int(sys.argv[1]))
"""
Tick = Callable[[int], None]


class WorkerDiedError(Exception):
    """Error of an item whose worker died, also when tried again, or was ended as `overdue`."""

    def __init__(self, code: int, *, overdue: bool = False) -> None:
        super().__init__(signal.strsignal(-code) if code < 0 else f"exit code {code}")
        self.overdue = overdue


class WorkerBugError(Exception):
    """Exception that the function raised, as text: it need not pickle itself."""

    def __init__(self, text: str, trace: str) -> None:
        super().__init__(text, trace)  # with these it is pickled
        self.trace = trace

    def __str__(self) -> str:
        return str(self.args[0])


class Outcome(NamedTuple):
    """Item with what the function returned, or the error."""

    item: Any
    value: Any
    error: WorkerDiedError | WorkerBugError | None


@dataclass(eq=False)
class _Item:
    value: Any
    deaths: int = 0
    shared: bool = False  # whether other items ran at the same time
    overdue: bool = False


@dataclass(eq=False)
class _Worker:
    process: subprocess.Popen[bytes]
    connection: Connection
    ready: bool = False
    item: _Item | None = None
    until: float = math.inf


class WorkerPool:
    """Pool of processes that apply a function, as a context manager.

    `function` is pickled once for each worker, so it is a function of a module, or a partial one. Workers start when items wait
    for them, at most `workers`. An item is tried again up to `retries` times if its worker dies, and given up after `limit_s`.
    """

    def __init__(self, function: Callable[[Any], Any], workers: int, *, retries: int = 0, limit_s: float = math.inf) -> None:
        self._function, self._limit, self._retries, self._limit_s = pickle.dumps(function), workers, retries, limit_s
        self._workers: list[_Worker] = []
        self._again: deque[_Item] = deque()  # after a crash of their own
        self._alone: deque[_Item] = deque()  # after a kill while others ran
        self._failed_starts = 0

    def __enter__(self) -> WorkerPool:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def run(self, items: Iterable[Any], tick: Tick = lambda running: None) -> Generator[Outcome]:
        """Yield the outcome of each item as it comes; `tick` gets the number of busy workers.

        Raises:
            ConfigError: the workers do not start.
        """
        waiting = (_Item(item) for item in items)
        try:
            while True:
                self._assign(waiting)
                busy = [worker for worker in self._workers if worker.item is not None]
                tick(len(busy))
                if not busy:
                    return
                for connection in wait([worker.connection for worker in busy], POLL_S):
                    worker = next(worker for worker in busy if worker.connection is connection)
                    outcome = self._receive(worker)
                    if outcome is not None:
                        yield outcome
                self._stop_overdue()
        finally:
            self.close()

    def close(self) -> None:
        """End all workers; a busy one gets a moment to remove what it has half written."""
        ending, self._workers = self._workers, []
        for worker in ending:
            worker.connection.close()
            (worker.process.kill if worker.item is None else worker.process.terminate)()
        until = time.monotonic() + GRACE_S
        for worker in ending:
            try:
                worker.process.wait(max(0.0, until - time.monotonic()))
            except subprocess.TimeoutExpired:
                worker.process.kill()
                worker.process.wait()

    def _assign(self, waiting: Iterator[_Item]) -> None:
        """Give items to idle workers, and start more up to the limit."""
        self._workers = [worker for worker in self._workers if worker.item is not None or worker.process.poll() is None]
        given: list[tuple[_Worker, _Item]] = []
        while self._busy < self._limit and (item := self._next(waiting)) is not None:
            worker = next((worker for worker in self._workers if worker.item is None), None) or self._start()
            worker.item, worker.until = item, time.monotonic() + self._limit_s
            given.append((worker, item))
        shared = self._busy > 1
        for worker in self._workers:
            if worker.item is not None:
                worker.item.shared |= shared
        for worker, item in given:
            with contextlib.suppress(OSError):  # it has just died, which its connection says at the next look
                if not worker.ready:
                    worker.connection.send_bytes(self._function)
                worker.connection.send(item.value)

    @property
    def _busy(self) -> int:
        return sum(worker.item is not None for worker in self._workers)

    def _next(self, waiting: Iterator[_Item]) -> _Item | None:
        """Next item; one that is to run alone comes when no other is left."""
        if self._again:
            return self._again.popleft()
        item = next(waiting, None)
        return self._alone.popleft() if item is None and self._alone and not self._busy else item

    def _start(self) -> _Worker:
        """Start a process, out of reach of the terminal's Ctrl-C: this process ends it.

        With -P no module of the current folder, such as a json.py, takes the place of Python's own.
        """
        own_end, child_end = Pipe()
        try:
            process = subprocess.Popen(
                [sys.executable, "-P", "-c", START, str(child_end.fileno()), json.dumps(sys.path)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                env={**os.environ, **ONE_THREAD},
                **inherited(child_end.fileno()),
            )
        except OSError as error:
            raise ConfigError(f"a worker process cannot be started ({error.strerror})", where="workers") from error
        finally:
            child_end.close()
        worker = _Worker(process, own_end)
        self._workers.append(worker)
        return worker

    def _receive(self, worker: _Worker) -> Outcome | None:
        """Outcome of a worker's item; None where the item goes on or is tried again."""
        try:
            raw = worker.connection.recv_bytes()
        except (EOFError, OSError):
            return self._died(worker)
        if raw == READY:
            worker.ready, self._failed_starts, worker.until = True, 0, time.monotonic() + self._limit_s
            return None
        item, worker.item = worker.item, None
        assert item is not None, "only a busy worker answers"
        value = pickle.loads(raw)  # noqa: S301  from our own process
        error = value if isinstance(value, WorkerBugError) else None
        return Outcome(item.value, None if error else value, error)

    def _stop_overdue(self) -> None:
        """End workers whose item takes too long: at first they may remove what they have half written."""
        for worker in self._workers:
            if worker.item is not None and time.monotonic() > worker.until:
                (worker.process.kill if worker.item.overdue else worker.process.terminate)()
                worker.item.overdue, worker.until = True, time.monotonic() + GRACE_S

    def _died(self, worker: _Worker) -> Outcome | None:
        self._workers.remove(worker)
        worker.connection.close()
        try:
            code = worker.process.wait(GRACE_S)
        except subprocess.TimeoutExpired:
            worker.process.kill()
            code = worker.process.wait()
        item = worker.item
        assert item is not None, "only busy workers are waited for"
        if item.overdue:
            return Outcome(item.value, None, WorkerDiedError(code, overdue=True))
        if not worker.ready:
            self._failed_starts += 1
            if self._failed_starts >= STARTS:
                raise ConfigError(f"worker processes do not start ({WorkerDiedError(code)})", where="workers")
            self._again.append(item)
            return None
        killed = code in KILLED
        if not (killed and item.shared):
            item.deaths += 1
        if item.deaths > self._retries:
            return Outcome(item.value, None, WorkerDiedError(code))
        item.shared = False
        (self._alone if killed else self._again).append(item)
        return None


def serve(descriptor: int) -> None:
    """Apply the function that comes first to all items that follow, until this process is ended."""
    signal.signal(signal.SIGTERM, _end)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.set_threshold(100_000)  # as in every command: imports make objects that stay
    with contextlib.suppress(OSError):  # when memory runs out a worker ends, not the process that keeps the results
        Path("/proc/self/oom_score_adj").write_text("500")
    connection, items = opened(descriptor), queue.SimpleQueue[Any]()
    with contextlib.suppress(EOFError, OSError, SystemExit):  # the other end has gone, or wants this one to end
        function = pickle.loads(connection.recv_bytes())  # noqa: S301  from the process that started this one
        connection.send_bytes(READY)
        threading.Thread(target=_listen, args=(connection, items), daemon=True).start()
        while True:
            connection.send_bytes(_applied(function, items.get()))
    os._exit(TERMINATED)  # at once: a library's own clean-up at the interpreter's end can take seconds


def _applied(function: Callable[[Any], Any], item: Any) -> bytes:
    try:
        return pickle.dumps(function(item))
    except Exception as error:  # noqa: BLE001  the other process reports it
        return pickle.dumps(WorkerBugError(repr(error), "".join(traceback.format_exception(error))))


def _listen(connection: Connection, items: queue.SimpleQueue[Any]) -> None:
    """Take in items; at the end of the connection end this process too."""
    with contextlib.suppress(EOFError, OSError):
        while True:
            items.put(connection.recv())
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE_S)
    os._exit(TERMINATED)


def _end(number: int, frame: FrameType | None) -> NoReturn:
    """End this process once; what it has half written is removed on the way."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.unraisablehook = _end_again
    sys.exit(TERMINATED)


def _end_again(unraisable: sys.UnraisableHookArgs) -> None:
    if repeat_swallowed(unraisable):
        signal.signal(signal.SIGTERM, _end)
    else:
        sys.__unraisablehook__(unraisable)
