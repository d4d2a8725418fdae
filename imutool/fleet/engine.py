"""Workers of a fleet: processes of this machine, or a Ray cluster; one task for each log.

Only this file uses Ray, and only where a cluster's address is given.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import signal
import socket
import threading
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from types import FrameType
from typing import Any, Protocol

import msgspec

from imutool.errors import ConfigError, LogError, redact, required
from imutool.fleet.one_log import work
from imutool.fleet.task import Result, Task, failed
from imutool.processes import system
from imutool.processes.worker_pool import ONE_THREAD, Tick, WorkerBugError, WorkerPool

AHEAD = 2  # tasks in flight for each that can be worked on: the next one is there when one ends
POLL_S = 0.5
ANSWER_S = 5.0
BUG = 1
SETTINGS = bytes((0, 0, 0, 4, 0, 0, 0, 0, 0))  # an empty SETTINGS frame of HTTP/2, the first that either side sends
GREETING = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + SETTINGS  # RFC 9113, section 3.4; gRPC is HTTP/2
_decode = msgspec.json.Decoder(Task).decode
_decode_result = msgspec.json.Decoder(Result).decode


class Engine(Protocol):
    """Workers of a fleet, as a context manager."""

    def __enter__(self) -> Engine: ...

    def __exit__(self, *_: object) -> None: ...

    def run(self, tasks: Iterable[Task], tick: Tick, model: bytes | None) -> Generator[Result]:
        """Yield results as tasks end.

        The task of a worker that dies goes to another one.
        """


class ProcessEngine:
    """Processes of this machine: at most `workers`, and no more than memory allows.

    A log that takes longer than `limit_s` fails.

    Raises:
        ConfigError: the machine does not have that much memory.
    """

    def __init__(
        self, *, workers: int | None = None, memory_bytes: int = 1 << 30, retries: int = 3, limit_s: float = math.inf
    ) -> None:
        memory = system.memory_bytes()
        _refuse_too_much(memory_bytes, memory)
        self.workers = max(1, min(workers or system.processors(), memory // max(memory_bytes, 1)))
        self._retries, self._limit_s = retries, limit_s

    def __enter__(self) -> ProcessEngine:
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing: `run` has ended its processes."""

    def run(self, tasks: Iterable[Task], tick: Tick = lambda running: None, model: bytes | None = None) -> Generator[Result]:
        """Yield results as tasks end; a ConfigError says that processes do not start."""
        quietly = partial(_work_quietly, model=model)
        with WorkerPool(quietly, self.workers, retries=self._retries, limit_s=self._limit_s) as pool:
            for outcome in pool.run(tasks, tick):
                if outcome.error is None:
                    yield outcome.value
                elif isinstance(outcome.error, WorkerBugError):
                    yield _bug(outcome.item, outcome.error, outcome.error.trace)
                elif outcome.error.overdue:
                    why = f"it took longer than {self._limit_s:g} s. Set a longer time limit, or look at this log by itself."
                    yield failed(outcome.item.key, outcome.item.source, why, LogError.exit_code, outcome.item.target)
                else:
                    yield _died(outcome.item, str(outcome.error))


def _work_quietly(task: Task, model: bytes | None) -> Result:
    """Run `work`; what a library would print does not reach the terminal, where the progress is."""
    logging.lastResort = logging.NullHandler()  # None prints "No handlers could be found"
    warnings.simplefilter("ignore")
    return work(task, model)


def _refuse_too_much(wanted: int, maximum: int) -> None:
    if wanted > maximum:
        raise ConfigError(
            f"{wanted / 2**30:.2f} GiB are asked for each task",
            where="memory_bytes",
            expected=f"at most {maximum / 2**30:.2f} GiB, which the largest machine has",
        )


def _bug(task: Task, error: BaseException, trace: str) -> Result:
    logging.getLogger("imutool").info("%s: %s", task.source.place, trace)
    return failed(task.key, task.source, f"a bug, please report it: {error}", BUG, task.target)


def _died(task: Task, how: str) -> Result:
    why = f"its worker died, also where it ran alone ({how}). Look at this log by itself."
    return failed(task.key, task.source, why, LogError.exit_code, task.target)


def _work_as_json(raw: bytes, model: bytes | None) -> bytes:
    """Run `work` with task and result as JSON bytes, which any version of Python reads."""
    return msgspec.json.encode(work(_decode(raw), model))


class RayEngine:
    """Workers of the Ray cluster at an address.

    `workers` limits how many logs are worked on at once, `memory_bytes` is set aside for each. Where this process is connected
    to a cluster already, that one is used.

    Raises:
        ConfigError: Ray is not installed, or the cluster cannot be reached; no machine has that much memory.
    """

    def __init__(self, address: str, *, workers: int | None = None, memory_bytes: int = 1 << 30, retries: int = 3) -> None:
        self._workers, self._memory, self._connected = workers, memory_bytes, False
        self._ray = _ray()
        try:
            if not self._ray.is_initialized():
                self._connect(address)
            _refuse_too_much(memory_bytes, int(max((node.get("memory", 0.0) for node in self._nodes()), default=0.0)))
        except BaseException:
            self.close()
            raise
        options = {"num_cpus": 1, "memory": memory_bytes, "max_retries": retries, "name": "imutool fleet"}
        self._task = self._ray.remote(_work_as_json).options(**options)
        self._task_alone = self._ray.remote(_work_as_json).options(
            **options | {"num_cpus": max((node.get("CPU", 1.0) for node in self._nodes()), default=1.0)}
        )

    def __enter__(self) -> RayEngine:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the cluster; workers that still run are killed."""
        if self._connected:
            self._ray.shutdown()
            self._connected = False

    def _nodes(self) -> list[dict[str, float]]:
        """Resources of each machine of the cluster."""
        return [node["Resources"] for node in self._ray.nodes() if node["Alive"]]

    @property
    def slots(self) -> int:
        """Number of logs that can run at once now; a cluster may grow."""
        fits = sum(int(min(n.get("CPU", 0.0), n.get("memory", 0.0) // max(self._memory, 1))) for n in self._nodes())
        return max(1, fits if self._workers is None else min(fits, self._workers))

    def run(self, tasks: Iterable[Task], tick: Tick = lambda running: None, model: bytes | None = None) -> Generator[Result]:
        """Yield results as tasks end.

        The task of a worker that dies goes to another one, up to `retries` times, then once more to a machine of its own: what
        killed the worker may have been another log.

        Raises:
            ConfigError: Ray itself has died.
        """
        waiting, flying, alone = iter(tasks), dict[Any, Task](), set[str]()
        content = self._ray.put(model)
        try:
            with _interrupts_kept() as refuse_interrupted:
                while True:
                    refuse_interrupted()
                    room = AHEAD * self.slots if self._workers is None else self.slots
                    while len(flying) < room and (task := next(waiting, None)) is not None:
                        flying[self._task.remote(msgspec.json.encode(task), content)] = task
                    tick(len(flying))
                    if not flying:
                        return
                    for ref in self._ready(list(flying)):
                        result = self._result(ref, flying[ref], last=flying[ref].key in alone)
                        refuse_interrupted()  # Ctrl-C reaches workers on this machine too: what they say then is no result
                        task = flying.pop(ref)
                        if result is not None:
                            yield result
                            continue
                        alone.add(task.key)
                        flying[self._task_alone.remote(msgspec.json.encode(task), content)] = task
        finally:
            for ref in flying:
                with contextlib.suppress(self._ray.exceptions.RayError):
                    self._ray.cancel(ref, force=True)

    def _ready(self, refs: list[Any]) -> list[Any]:
        ready = self._ray.wait(refs, num_returns=1, timeout=POLL_S)[0]
        return list(self._ray.wait(refs, num_returns=len(refs), timeout=0)[0]) if ready else []

    def _result(self, ref: Any, task: Task, *, last: bool) -> Result | None:
        """Result of a task; None where its worker died and it was not the `last` try."""
        errors = self._ray.exceptions
        try:
            return _decode_result(self._ray.get(ref))
        except errors.RayTaskError as error:
            return _bug(task, error.cause, str(error))
        except errors.LocalRayletDiedError as error:
            raise ConfigError("Ray has died on this machine", fix="Go on with `resume`") from error
        except errors.RayError as error:
            return _died(task, type(error).__name__) if last else None

    def _connect(self, address: str) -> None:
        _refuse_silence(address)
        logging.getLogger("ray").setLevel(logging.ERROR)
        quiet = {"log_to_driver": False, "configure_logging": False}
        self._connected = True  # also where it ends half-way
        try:
            self._ray.init(address=address, runtime_env={"env_vars": ONE_THREAD}, **quiet)
        except Exception as error:  # of Ray, of its client, of gRPC
            why = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise ConfigError(
                f"Ray cannot be reached at {redact(address)} ({redact(why)})",
                expected="a cluster that answers",
                fix="Give the address of a cluster with `address`, or leave it out: then this machine does the work. "
                "If the cluster asks for a token, as Ray 2.60 does, set RAY_AUTH_MODE=token",
            ) from error


@contextmanager
def _interrupts_kept() -> Iterator[Callable[[], None]]:
    """Keep Ctrl-C: the function in the context raises KeyboardInterrupt once it has come.

    While Ray calls back, Python would lose the exception.
    """
    came: list[int] = []

    def refuse() -> None:
        if came:
            raise KeyboardInterrupt

    def handle(number: int, frame: FrameType | None) -> None:
        came.append(number)
        signal.default_int_handler(number, frame)

    if threading.current_thread() is not threading.main_thread():
        yield refuse
        return
    before = signal.signal(signal.SIGINT, handle)
    try:
        yield refuse
    finally:
        signal.signal(signal.SIGINT, before)


def _refuse_silence(address: str) -> None:
    """Check that a gRPC server answers at HOST:PORT; Ray itself would wait for minutes, or for ever.

    Raises:
        ConfigError: nobody does.
    """
    host, _, port = address.rpartition("://")[2].rpartition(":")
    if not host or not port.isdecimal():
        return  # a word such as auto, which Ray itself makes out
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=ANSWER_S) as connection:
            if "RAY_USE_TLS" not in os.environ:
                connection.sendall(GREETING)
                if connection.recv(4)[3:] != SETTINGS[3:4]:
                    raise OSError("what listens there does not speak gRPC")
    except (OSError, OverflowError) as error:
        raise ConfigError(f"nothing answers ({error})", where=f"address={redact(address)}", expected="a Ray cluster") from error


def _ray() -> Any:
    required("ray.exceptions", "fleet", user="a cluster")
    import ray

    return ray
