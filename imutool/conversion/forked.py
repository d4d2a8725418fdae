"""Forked processes for functions: they share this one's memory, results come by a pipe.

A fork takes some hundredths of a second and copies nothing, however large the arguments are. A command allows it
(`forking`), the library does not: the threads of another program may hold what a copy then waits for. Elsewhere, and on one
processor, a function runs in this process when its result is asked for, so that results depend on neither.
"""

from __future__ import annotations

import contextlib
import gc
import logging.handlers
import os
import pickle
import queue
import signal
import warnings
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import ClassVar, Generic, NoReturn, TypeVar

from imutool.mcap_io.storage.system import can_fork, fork, kill, processors

T = TypeVar("T")
R = TypeVar("R")
SIGNALS = signal.SIGINT, signal.SIGTERM


class _Processes:
    allowed = 0  # beside this one
    running: ClassVar[dict[int, int]] = {}  # the reading end of its pipe by process


@contextlib.contextmanager
def forking() -> Iterator[None]:
    """Allow as many processes as processors; none is left at the end, however that comes."""
    _Processes.allowed = processors() - 1 if can_fork() else 0
    try:
        yield
    finally:
        _Processes.allowed = 0
        for process in list(_Processes.running):
            _end(process)


class Forked(Generic[T]):
    """Result of a function that runs beside this process if a processor is free.

    What the function returns is pickled. Where it raises, it runs again in `result`, which raises the same.
    """

    def __init__(self, function: Callable[[], T]) -> None:
        self._function, self._process = function, 0
        if len(_Processes.running) < _Processes.allowed:
            self._process = _fork(function)

    def result(self) -> T:
        """What the function returns; run here if no process has run it to its end."""
        if self._process:
            with contextlib.suppress(EOFError, pickle.UnpicklingError):  # it was killed, or the function raised
                with open(_Processes.running[self._process], "rb", closefd=False) as pipe:
                    value, records = pickle.load(pipe)  # noqa: S301  from our own process
                _end(self._process)
                for record in records:
                    logging.getLogger(record.name).handle(record)
                self._process, self._function = 0, lambda: value
            self.end()
        return self._function()

    def end(self) -> None:
        """End the process whose result nobody wants."""
        if self._process:
            _end(self._process)
            self._process = 0


def of_each(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """Function of each item, in order; side by side as far as processors are free."""
    left, out = list(items), list[R]()
    while left:
        first, *others = left[: 1 + _Processes.allowed - len(_Processes.running)]
        del left[: 1 + len(others)]
        beside = [Forked(partial(function, item)) for item in others]
        out += [function(first), *(one.result() for one in beside)]
    return out


def _fork(function: Callable[[], object]) -> int:
    """Number of the process that runs the function; 0 if the system has none to give."""
    reading, writing = os.pipe()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)  # or a Ctrl-C would run this process' clean-up in the other
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of the progress bar's thread, which the other never needs
            process = fork()
        if not process:
            _serve(function, writing)
    except OSError:  # no memory or no number is left for one more
        os.close(reading)
        os.close(writing)
        return 0
    else:
        os.close(writing)
        _Processes.running[process] = reading
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return process


def _serve(function: Callable[[], object], writing: int) -> NoReturn:
    """Write what the function returns, and end without any clean-up."""
    code, _Processes.allowed = 1, 0
    try:
        for number in SIGNALS:
            signal.signal(number, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        gc.freeze()
        said = queue.SimpleQueue[logging.LogRecord]()
        logging.getLogger().handlers = [logging.handlers.QueueHandler(said)]
        value = function()
        records = [said.get() for _ in range(said.qsize())]
        with open(writing, "wb", closefd=False) as pipe:
            pickle.dump((value, records), pipe, protocol=pickle.HIGHEST_PROTOCOL)
        code = 0
    finally:
        os._exit(code)


def _end(process: int) -> None:
    os.close(_Processes.running.pop(process))
    kill(process)
    os.waitpid(process, 0)
