"""Ray workers: the cores of this machine or a cluster, one task for each log.

Only this file uses Ray. Without an address Ray is started for this run alone: on the loopback interface, with a token that is
never written to a disk, without dashboard and usage statistics, in a temporary folder that is removed at the end.
"""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import shutil
import signal
import socket
import sys
import tempfile
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

import msgspec

from imutool.errors import ConfigError, LogError
from imutool.fleet.task import Result, Task
from imutool.fleet.work import work

AHEAD = 2  # tasks in flight for each that can be worked on: the next one is there when one ends
POLL_S = 0.5
ANSWER_S = 5.0
FOLDER = "imutool-fleet."  # the process that started Ray follows
OBJECT_STORE_BYTES = 80 << 20  # tasks and results are a few kilobytes; Ray takes no less
BUG = 1
QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_AUTH_MODE": "token",
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",  # Ray's word for: listen on 127.0.0.1 alone
}
IN_WORKERS = {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
_decode = msgspec.json.Decoder(Task).decode
_decode_result = msgspec.json.Decoder(Result).decode


def _work(raw: bytes, model: bytes | None) -> bytes:
    """Run `work` with task and result as JSON bytes, which any version of Python reads."""
    return msgspec.json.encode(work(_decode(raw), model))


class Engine:
    """Pool of Ray workers, as a context manager.

    `workers` limits how many logs are worked on at once, `memory_bytes` is set aside for each. Where Ray runs in this process
    already it is used, and left running.

    Raises:
        ConfigError: Ray is not installed, does not start or cannot be reached; no machine has that much memory.
    """

    def __init__(
        self,
        address: str | None = None,
        *,
        workers: int | None = None,
        memory_bytes: int = 1 << 30,
        retries: int = 3,
        dashboard: bool = False,
    ) -> None:
        self._workers, self._memory = workers, memory_bytes
        self._own, self._folder = False, ""
        self._ray = _ray(local=address is None)
        if not self._ray.is_initialized():
            try:
                self._start(address, dashboard)
                self.refuse_too_much()
            except BaseException:
                self.close()
                raise
        self._task = self._ray.remote(_work).options(num_cpus=1, memory=memory_bytes, max_retries=retries, name="imutool fleet")

    def __enter__(self) -> Engine:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Shut down; running workers are killed."""
        if self._own:
            self._ray.shutdown()
            self._own = False
        if self._folder:
            shutil.rmtree(self._folder, ignore_errors=True)

    @property
    def slots(self) -> int:
        """Number of logs that can run at once now; a cluster may grow."""
        fits = 0
        for node in self._ray.nodes():
            if node["Alive"]:
                has = node["Resources"]
                fits += int(min(has.get("CPU", 0.0), has.get("memory", 0.0) // max(self._memory, 1)))
        return max(1, fits if self._workers is None else min(fits, self._workers))

    def run(
        self, tasks: Iterable[Task], tick: Callable[[int], None] = lambda running: None, model: bytes | None = None
    ) -> Generator[Result]:
        """Yield results as tasks end; `tick` gets the number of running tasks.

        Every worker gets `model`.

        The task of a worker that dies goes to another one, up to `retries` times.

        Raises:
            ConfigError: Ray itself has died.
        """
        waiting, flying = iter(tasks), dict[Any, Task]()
        self._model = self._ray.put(model)
        with _interrupts_kept() as refuse_interrupted:
            yield from self._run(waiting, flying, tick, refuse_interrupted)

    def _run(
        self,
        waiting: Iterator[Task],
        flying: dict[Any, Task],
        tick: Callable[[int], None],
        refuse_interrupted: Callable[[], None],
    ) -> Iterator[Result]:
        try:
            while True:
                refuse_interrupted()
                room = AHEAD * self.slots if self._workers is None else self.slots
                while len(flying) < room and (task := next(waiting, None)) is not None:
                    flying[self._task.remote(msgspec.json.encode(task), self._model)] = task
                tick(len(flying))
                if not flying:
                    return
                refs = list(flying)
                if self._ray.wait(refs, num_returns=1, timeout=POLL_S)[0]:
                    ready, _ = self._ray.wait(refs, num_returns=len(refs), timeout=0)
                    for ref in ready:
                        result = self._result(ref, flying[ref])
                        refuse_interrupted()  # Ctrl-C reaches the workers as well: what they say then is no result
                        del flying[ref]
                        yield result
        finally:
            # A Ray of our own ends at once, tasks and all; to cancel one whose answer is on its way can end Ray's core first.
            for ref in () if self._folder else flying:
                with contextlib.suppress(self._ray.exceptions.RayError):
                    self._ray.cancel(ref, force=True)

    def _result(self, ref: Any, task: Task) -> Result:
        errors = self._ray.exceptions
        try:
            return _decode_result(self._ray.get(ref))
        except errors.RayTaskError as error:
            words, code = f"a bug, please report it: {error.cause!r}", BUG
            logging.getLogger("imutool").info("%s: %s", task.source.place, error)
        except errors.LocalRayletDiedError as error:
            raise ConfigError("Ray has died on this machine", fix="Go on with `resume`") from error
        except errors.OutOfMemoryError:
            words, code = "its worker ran out of memory. Set more aside with `memory_bytes`.", LogError.exit_code
        except errors.RayError as error:
            words = f"its worker died, and each one after it ({type(error).__name__}). Look at this log by itself."
            code = LogError.exit_code
        return Result(
            key=task.key,
            source=task.source.place,
            target=task.target,
            status="failed",
            source_bytes=task.source.size,
            error=words,
            exit_code=code,
        )

    def _start(self, address: str | None, dashboard: bool) -> None:
        wanted: dict[str, Any] = {
            "log_to_driver": False,
            "configure_logging": False,
            **({} if address is None else {"runtime_env": {"env_vars": IN_WORKERS}}),
        }
        if address is None:
            _sweep()
            self._folder = tempfile.mkdtemp(prefix=f"{FOLDER}{os.getpid()}.")
            wanted |= {
                "num_cpus": self._workers or os.cpu_count(),
                "include_dashboard": dashboard,
                "object_store_memory": OBJECT_STORE_BYTES,
                "_temp_dir": self._folder,
            }
        else:
            _refuse_silence(address)
        logging.getLogger("ray").setLevel(logging.ERROR)
        try:
            self._own = True  # also of what is half started
            self._ray.init(address=address or "local", **wanted)
        except (RuntimeError, OSError, ValueError, self._ray.exceptions.RayError) as error:
            where = f"at {address}" if address else "on this machine"
            raise ConfigError(
                f"Ray cannot be {'reached' if address else 'started'} {where} ({str(error).splitlines()[0]})",
                expected="a cluster that answers" if address else "a system that lets processes listen on 127.0.0.1",
                fix="Give the address of a cluster with `address`, or set TMPDIR to a short path that can be written",
            ) from error

    def refuse_too_much(self) -> None:
        """Refuse more memory for a task than any machine has.

        Raises:
            ConfigError: no machine has that much memory.
        """
        most = max((node["Resources"].get("memory", 0.0) for node in self._ray.nodes() if node["Alive"]), default=0.0)
        if self._memory > most:
            raise ConfigError(
                f"{self._memory / 2**30:.2f} GiB for each task",
                where="memory_bytes",
                expected=f"at most {most / 2**30:.2f} GiB, which the largest machine has to give",
            )


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


def _sweep() -> None:
    """Remove the temporary folders of killed runs on this machine."""
    for folder in Path(tempfile.gettempdir()).glob(f"{FOLDER}*"):
        pid = folder.name.removeprefix(FOLDER).partition(".")[0]
        if pid.isdecimal() and not _lives(int(pid)):
            shutil.rmtree(folder, ignore_errors=True)


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # somebody else's, and so is the folder
        return True
    return True


def _refuse_silence(address: str) -> None:
    """Check that HOST:PORT accepts connections; Ray itself would wait for minutes.

    Raises:
        ConfigError: nobody does.
    """
    host, _, port = address.rpartition("://")[2].rpartition(":")
    if not host or not port.isdecimal():
        return  # a word such as auto, which Ray itself makes out
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=ANSWER_S).close()
    except (OSError, OverflowError) as error:
        raise ConfigError(f"no answer ({error})", where=f"address={address}", expected="a Ray cluster") from error


def _ray(*, local: bool) -> Any:
    """Import Ray, with its settings in the environment before a first import."""
    if local and "ray" not in sys.modules:
        for name, value in QUIET.items():
            os.environ.setdefault(name, value)
        os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
        for name, value in IN_WORKERS.items():
            os.environ.setdefault(name, value)
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        raise ConfigError("a fleet needs ray, which is not installed", fix="pip install 'imutool[fleet]'") from error
    return ray
