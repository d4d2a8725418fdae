"""Differences between operating systems: locks, memory, processes, copies by the kernel.

Only this file uses what not every system has; elsewhere each function answers as well as the system allows.
"""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

CGROUP_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
END_WITH_PARENT = 1  # of Linux: PR_SET_PDEATHSIG
KILLED = (-signal.SIGKILL, -signal.SIGTERM) if sys.platform != "win32" else (1, 1)  # exit codes of a process that was killed
REPEAT_S = 0.01
LOCKED_AT = 1 << 62  # byte that Windows locks, behind all content: locked bytes could not be read


def lock(file: IO[bytes]) -> bool:
    """Lock a file for this process until it is closed; False if another process has it.

    A system or a file system without locks says True.
    """
    try:
        if sys.platform == "win32":
            import msvcrt

            at = file.tell()
            file.seek(LOCKED_AT)
            try:
                msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            finally:
                file.seek(at)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    except (ImportError, OSError):
        return True
    return True


def peak_bytes() -> int:
    """Peak memory of this process; 0 if unknown (`ru_maxrss` of Linux begins with the parent's)."""
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
        return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))
    try:
        import resource
    except ImportError:
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def release_memory() -> None:
    """Give freed memory back to the system, where the C library keeps it (glibc)."""
    with contextlib.suppress(AttributeError, OSError, TypeError):
        import ctypes

        ctypes.CDLL(None).malloc_trim(0)


def memory_bytes() -> int:
    """Memory of this machine or of this container; a large number if unknown."""
    limits = []
    with contextlib.suppress(AttributeError, OSError, ValueError):
        limits.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    for name in CGROUP_LIMITS:
        with contextlib.suppress(OSError, ValueError):  # no container, or one without a limit
            limits.append(int(Path(name).read_text(encoding="ascii")))
    return min(limits, default=sys.maxsize)


def processors() -> int:
    """Processors that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:
        return os.cpu_count() or 1


def can_fork() -> bool:
    """Whether a process may copy itself; elsewhere than on Linux that may harm libraries."""
    return sys.platform == "linux"


def fork(nicer: int) -> int:
    """Copy this process: 0 in the copy, its number here.

    The copy is `nicer` by so much, and ends with this one.
    """
    if sys.platform == "win32":
        raise NotImplementedError("a fork")
    import ctypes

    parent, prctl = os.getpid(), ctypes.CDLL(None).prctl
    process = os.fork()
    if not process:
        prctl(END_WITH_PARENT, signal.SIGKILL)
        if os.getppid() != parent:  # it has ended already
            os._exit(1)
        os.nice(nicer)
    return process


def kill(process: int) -> None:
    """End a process at once; one that has ended stays so."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(process, -KILLED[0] if sys.platform != "win32" else signal.SIGTERM)


def inherited(handle: int) -> dict[str, Any]:
    """Options of `Popen`: a process group of its own, and one end of a connection."""
    if sys.platform == "win32":
        os.set_handle_inheritable(handle, True)
        start = subprocess.STARTUPINFO(lpAttributeList={"handle_list": [handle]})
        return {"startupinfo": start, "creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    return {"pass_fds": [handle], "process_group": 0}


def opened(handle: int) -> Connection:
    """Connection whose end this process has inherited."""
    if sys.platform == "win32":
        from multiprocessing.connection import PipeConnection

        return PipeConnection(handle)
    from multiprocessing.connection import Connection

    return Connection(handle)


@contextlib.contextmanager
def collector_paused() -> Iterator[None]:
    """Pause Python's cycle collector, which would visit millions of objects that stay."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def user() -> str:
    """Number of the user, or the name where users have none."""
    try:
        return str(os.getuid())
    except AttributeError:
        return os.environ.get("USERNAME", "user")


def give(path: Path, status: os.stat_result) -> None:
    """Give a file the owner and the group of another, where the system allows it."""
    with contextlib.suppress(AttributeError, PermissionError):
        os.chown(path, status.st_uid, status.st_gid)


def read_at(file: IO[bytes], offset: int, length: int) -> bytes | None:
    """Bytes of a file at an offset, at most `length`; None where the system cannot.

    The place of the file stays: forked processes share it.
    """
    return os.pread(file.fileno(), length, offset) if hasattr(os, "pread") else None


def copy_by_kernel(source: int, target: int, start: int, end: int) -> int:
    """Append bytes of one open file to another; return where the kernel stopped."""
    calls: tuple[Callable[[int], int], ...] = (
        lambda at: os.copy_file_range(source, target, end - at, offset_src=at),
        lambda at: os.sendfile(target, source, at, end - at),
    )
    for call in calls:
        while start < end and (count := _tried(call, start)):
            start += count
    return start


def _tried(call: Callable[[int], int], at: int) -> int:
    """Bytes copied by the call; 0 if the call fails, then reading and writing show why."""
    try:
        return call(at)
    except (AttributeError, OSError):
        return 0


def repeat_swallowed(unraisable: sys.UnraisableHookArgs) -> bool:
    """Repeat a Ctrl-C or a SIGTERM that came while an object was removed; False of others.

    Python prints and forgets what is raised there. The main thread gets it, also where it waits.
    """
    number = {KeyboardInterrupt: signal.SIGINT, SystemExit: signal.SIGTERM}.get(unraisable.exc_type)
    if number is None:
        return False
    if sys.platform == "win32":
        timer = threading.Timer(REPEAT_S, signal.raise_signal, [number])
    else:
        timer = threading.Timer(REPEAT_S, signal.pthread_kill, [threading.main_thread().ident, number])
    timer.start()
    return True
