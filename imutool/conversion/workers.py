"""Worker processes of a conversion: one log a job, with clean interrupts."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import islice
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import FrameType
from typing import Any

from imutool import registry
from imutool.conversion.labels import Labels
from imutool.conversion.message_writer import write_log
from imutool.errors import DataError, ImutoolError
from imutool.mcap_io.storage.local import remove_abandoned
from imutool.mcap_io.write import write
from imutool.recording import Recording
from imutool.recording.message_log import MessageLog

GROUP = "imutool.converters"
INTERRUPT_EVERY_S = 0.1
GRACE_S = 1.0  # for a process to remove its partial file


@dataclass(frozen=True)
class Job:
    """Job of a worker process: one log."""

    converter: str
    sequence: Any  # the converter's own handle: has a `name`, and pickles
    target: Path = Path()
    compression: str = "zstd"
    images: bool = True
    overwrite: bool = False
    labels: Labels = field(default_factory=Labels)


@dataclass(frozen=True)
class Outcome:
    """Outcome of a job: its error, or remarks on what was written."""

    error: ImutoolError | None = None
    notes: tuple[str, ...] = ()
    losses: tuple[str, ...] = ()


def run_jobs(jobs: Sequence[Job], workers: int) -> Iterator[tuple[int, Outcome]]:
    """Yield each job's number and outcome, as the jobs end."""
    if workers <= 1:
        for number, job in enumerate(jobs):
            yield number, _convert_one(job)
    else:
        yield from _run_in_processes(jobs, workers)


def _convert_one(job: Job) -> Outcome:
    try:
        module = registry.load(GROUP, job.converter)
        content = module.read_sequence(job.sequence, images=job.images)
        return write_content(content, job.target, job.labels, compression=job.compression, overwrite=job.overwrite)
    except ImutoolError as error:
        return Outcome(error)


def write_content(
    content: Recording | MessageLog, target: Path, labels: Labels, *, compression: str, overwrite: bool
) -> Outcome:
    """Write what a converter has read, with the user's labels.

    Raises:
        ImutoolError: it cannot be written.
    """
    labelled = labels.put_on(content)
    if isinstance(labelled, Recording):
        write(labelled, target, compression=compression, overwrite=overwrite)
        return Outcome()
    write_log(labelled, target, compression=compression, overwrite=overwrite)
    return Outcome(None, tuple(labelled.remarks.notes), tuple(labelled.remarks.losses))


def _run_in_processes(jobs: Sequence[Job], workers: int) -> Iterator[tuple[int, Outcome]]:
    """Run jobs in processes; on an interrupt, wait until all have removed their partial files."""
    others = set(multiprocessing.active_children())
    waiting = iter(enumerate(jobs))
    running: dict[Future[Outcome], int] = {}
    pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))
    try:
        with _interrupts_held():  # inherited by the processes, which heed interrupts only inside a job
            running.update({pool.submit(_convert_in_process, job): n for n, job in islice(waiting, workers)})
        while running:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                number = running.pop(future)
                yield number, _outcome(future, jobs[number])
                for following, job in waiting:
                    try:
                        running[pool.submit(_convert_in_process, job)] = following
                    except BrokenProcessPool:  # a process died and took the pool with it: none of the rest can run
                        yield following, _died(job)
                        continue
                    break
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        _interrupt(set(multiprocessing.active_children()) - others)
        for job in jobs:
            remove_abandoned(job.target)
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _interrupt(processes: Collection[BaseProcess]) -> None:
    """Interrupt processes until all have ended; after a second, kill those that are stuck."""
    patience = time.monotonic() + GRACE_S
    while alive := [process for process in processes if process.is_alive()]:
        for process in alive:
            if process.pid is not None:
                with suppress(ProcessLookupError):  # it has just ended by itself
                    os.kill(process.pid, signal.SIGINT if time.monotonic() < patience else signal.SIGKILL)
        alive[0].join(INTERRUPT_EVERY_S)


def _outcome(future: Future[Outcome], job: Job) -> Outcome:
    try:
        return future.result()
    except BrokenProcessPool:
        return _died(job)


def _died(job: Job) -> Outcome:
    return Outcome(
        DataError("its process died, perhaps for want of memory", where=str(job.sequence), fix="Use fewer `workers`")
    )


def _convert_in_process(job: Job) -> Outcome:
    signal.signal(signal.SIGINT, _interrupt_once)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    try:
        return _convert_one(job)
    finally:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


def _interrupt_once(_number: int, _frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt once; ignore further interrupts during the clean-up."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    raise KeyboardInterrupt


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Block interrupts, which processes started within inherit, and put SIGTERM off.

    A process whose parent leaves while it starts would end with a traceback.
    """
    put_off: list[int] = []
    here = threading.current_thread() is threading.main_thread()
    terminate = signal.signal(signal.SIGTERM, lambda number, _: put_off.append(number)) if here else None
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if here:
            signal.signal(signal.SIGTERM, terminate)
        if put_off:
            signal.raise_signal(signal.SIGTERM)
