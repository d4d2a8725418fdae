"""Forked processes for functions: they share this one's memory, results come by a pipe.

A fork takes some hundredths of a second and copies nothing, however large the arguments are. A command allows it
(`forking`), the library does not: the threads of another program may hold what a copy then waits for. Elsewhere, and on one
processor, a function runs in this process when its result is asked for, so that results depend on neither.
"""

from __future__ import annotations

import contextlib
import gc
import logging.handlers
import math
import os
import pickle
import queue
import select
import signal
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import chain, repeat
from typing import Any, ClassVar, Generic, NoReturn, TypeVar

from imutool.processes.system import can_fork, fork, kill, processors

T = TypeVar("T")
R = TypeVar("R")
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
WORTH_S = 0.2  # half of it goes for a fork and for memory that is copied when one of two writes to it
IDLE = 10  # by how much an idle process is nicer than this one


class _Processes:
    allowed = 0  # in addition to this one
    running: ClassVar[list[Forked[Any]]] = []


@contextlib.contextmanager
def forking() -> Iterator[None]:
    """Allow as many processes as processors; none is left at the end, however that comes."""
    _Processes.allowed = processors() - 1 if can_fork() else 0
    gc.freeze()  # what is imported stays: a collection that looks at it takes time, and in a fork a copy of its memory
    try:
        yield
    finally:
        gc.unfreeze()
        _Processes.allowed = 0
        for process in list(_Processes.running):
            process.end()


class Forked(Generic[T]):
    """Result of a function that runs in another process if a processor is free.

    What the function returns is pickled. Where it raises, it runs again in `result`, which raises the same. An `idle` one is
    for what is needed late: it runs on the time that the others leave, and takes no processor from them.
    """

    def __init__(self, function: Callable[[], T], *, idle: bool = False) -> None:
        self._function, self._idle, self._process, self._reading = function, idle, 0, -1
        self._got: tuple[T, list[logging.LogRecord]] | None = None
        if self.free() > 0:
            self._fork()

    @staticmethod
    def free() -> int:
        """Number of processors for one more; what has its result needs neither processor nor memory any more."""
        for process in select.select(_Processes.running, [], [], 0)[0]:
            process._read()
        return _Processes.allowed - sum(not process._idle for process in _Processes.running)

    def fileno(self) -> int:
        """The end of the pipe by which the result comes."""
        return self._reading

    @property
    def here(self) -> bool:
        """Whether no process has run it or runs it."""
        return not self._process and self._got is None

    def result(self) -> T:
        """Result of the function; it runs here if no process has run it to its end."""
        if self._process:
            self._read()
        if self._got is None:
            return self._function()
        value, records = self._got
        while records:
            record = records.pop(0)
            logging.getLogger(record.name).handle(record)
        return value

    def ready(self) -> T | None:
        """Result that a process has by now; else None, and the process ends. Its log lines are dropped."""
        if self._process and select.select([self], [], [], 0)[0]:
            self._read()
        self.end()
        return None if self._got is None else self._got[0]

    def end(self) -> None:
        """End the process whose result nobody wants."""
        if self._process:
            _Processes.running.remove(self)
            os.close(self._reading)
            kill(self._process)
            os.waitpid(self._process, 0)
            self._process = 0

    def _read(self) -> None:
        killed_or_raised = EOFError, pickle.UnpicklingError
        with contextlib.suppress(*killed_or_raised), open(self._reading, "rb", closefd=False) as pipe:
            self._got = pickle.load(pipe)  # noqa: S301  from our own process
        self.end()

    def _fork(self) -> None:
        """Start the process, if the system has one to give."""
        self._reading, writing = os.pipe()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)  # or a Ctrl-C would run this process' clean-up in the other
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # of the progress bar's thread, which the other never needs
                self._process = fork(IDLE if self._idle else 0)
            if not self._process:
                _serve(self._function, writing)
            _Processes.running.append(self)
        except OSError:  # no memory or no number is left for one more
            os.close(self._reading)
        finally:
            os.close(writing)
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def of_each(function: Callable[[T], R], items: Sequence[T], *, long: bool = False) -> Iterator[R]:
    """Function of each item, in order, until nobody asks for more.

    The first item is done here. Free processors take equal shares of the others if that saves time, as its time tells. Where
    every item is known to take `long`, they take equal shares of all.
    """
    began = time.perf_counter()
    first = [function(item) for item in items[: 0 if long else 1]]
    took = time.perf_counter() - began
    size = max(1, math.ceil((len(items) - len(first)) / (1 + max(0, Forked.free()))))
    shares = [items[k : k + size] for k in range(len(first), len(items), size)]
    worth = long or took * (len(items) - 1 - size) > WORTH_S
    beside = [Forked(partial(lambda share: [function(item) for item in share], share)) for share in shares[1:] if worth]
    try:
        yield from first
        for share, process in zip(shares, chain([None], beside, repeat(None)), strict=False):
            yield from map(function, share) if process is None or process.here else process.result()
    finally:
        for process in beside:
            process.end()


def _serve(function: Callable[[], object], writing: int) -> NoReturn:
    """Write what the function returns, and end without any clean-up."""
    code, _Processes.allowed, _Processes.running = 1, 0, []
    try:
        for number in SIGNALS:
            signal.signal(number, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        gc.freeze()
        log_records = queue.SimpleQueue[logging.LogRecord]()
        logging.getLogger().handlers = [logging.handlers.QueueHandler(log_records)]
        value = function()
        records = [log_records.get() for _ in range(log_records.qsize())]
        with open(writing, "wb", closefd=False) as pipe:
            pickle.dump((value, records), pipe, protocol=pickle.HIGHEST_PROTOCOL)
        code = 0
    finally:
        os._exit(code)
