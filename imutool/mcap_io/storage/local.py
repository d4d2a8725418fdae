"""Write local files, devices and pipes; remove temporary files of killed processes.

A file is written as `.NAME.PID.HEX.partial` next to its place. HEX says the machine (and container), its boot, the start of
the process, and a random number, so that a later run can tell whose file it is. It removes one if and only if

- this machine and container wrote it, and
- in this boot: no process has the number PID, or the process that has it started at another time;
- in an earlier boot: it was last changed before this boot.

Files of other machines on a shared folder stay, and those of a living process.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import platform
import re
import secrets
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import BinaryIO

from imutool.mcap_io.storage.source import Source, descriptor
from imutool.processes.system import copy_by_kernel

PARTIAL = re.compile(r"\.(?P<name>.+)\.(?P<pid>\d+)\.(?P<mark>[0-9a-f]{24})\.partial", re.DOTALL)
MARK_PART = 6  # hexadecimal digits of each part of a mark
LONGEST_NAME = 180  # bytes of a name in the temporary one; a file system takes 255
MAX_ENTRIES = 20_000  # of a folder that is searched for temporary files: some 20 ms
OPEN_FILE = re.compile(r"/(?:dev|proc/self)/fd/(\d+)")
STANDARD = {"/dev/stdout": 1, "/dev/stderr": 2}


@contextlib.contextmanager
def removed_if_empty(folder: Path) -> Iterator[None]:
    """Remove a folder that was not there before, if nothing is in it afterwards."""
    existed = folder.exists()
    try:
        yield
    finally:
        if not existed:
            with contextlib.suppress(OSError):  # a file, or a folder with something in it
                folder.rmdir()


class LocalFile:
    """File under its temporary name, next to its place."""

    file: BinaryIO

    def __init__(self, path: Path) -> None:
        self.path, self.temporary = path, temporary_path(path)

    def open(self) -> None:
        """Open the temporary file; remove those of processes that were killed."""
        remove_abandoned(self.path)
        self.file = self.temporary.open("xb")

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Append bytes."""
        self.file.write(data)

    def copy(self, source: Source, start: int, end: int) -> int:
        """Copies by the kernel; returns `start` if the kernel cannot."""
        source_descriptor, own_descriptor = descriptor(source.file), descriptor(self.file)
        if source_descriptor is None or own_descriptor is None:
            return start
        self.file.flush()
        start = copy_by_kernel(source_descriptor, own_descriptor, start, end)
        self.file.seek(0, os.SEEK_END)
        return start

    def complete(self) -> None:
        """Make all bytes readable under the temporary name."""
        self.file.flush()

    def publish(self, *, replace: bool) -> None:
        """Rename the file to its place, and settle both on the disk; without `replace`, a file that came meanwhile stays.

        Raises:
            FileExistsError: such a file came.
        """
        os.fsync(self.file.fileno())
        self.file.close()
        if replace or not self._link():
            self.temporary.replace(self.path)
        _settle(self.path.parent)

    def _link(self) -> bool:
        """Link the file to its place, which no other can do at the same time; False if the file system has no links."""
        try:
            os.link(self.temporary, self.path)
        except FileExistsError:
            raise
        except OSError:
            return False
        self.temporary.unlink(missing_ok=True)
        return True

    def discard(self) -> None:
        """Remove the temporary file, silently if that fails."""
        with contextlib.suppress(OSError, AttributeError):  # a full disk refuses the last flush; or it was never opened
            self.file.close()
        with contextlib.suppress(OSError):
            self.temporary.unlink(missing_ok=True)


class Stream(LocalFile):
    """Device or pipe; it is written to from a temporary file, and never replaced."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.temporary = temporary_path(Path(tempfile.gettempdir()) / path.name)

    def open(self) -> None:
        """Open the temporary file."""
        self.file = self.temporary.open("xb")

    def publish(self, *, replace: bool) -> None:
        """Write everything to the device or pipe; a pipe waits for its reader."""
        sys.stdout.flush()
        number = STANDARD.get(str(self.path)) or _open_number(self.path)
        opened = os.open(self.path, os.O_WRONLY) if number is None else os.dup(number)
        with self.temporary.open("rb") as source, os.fdopen(opened, "wb") as out:
            shutil.copyfileobj(source, out)
        self.discard()


def is_stream(path: Path) -> bool:
    """Whether a path is a character device, a pipe, or a file that is open already."""
    if str(path) in STANDARD or _open_number(path) is not None:
        return True
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        return False
    return stat.S_ISCHR(mode) or stat.S_ISFIFO(mode)


def _open_number(path: Path) -> int | None:
    match = OPEN_FILE.fullmatch(str(path))
    return None if match is None else int(match[1])


def temporary_path(path: Path) -> Path:
    """Path of a temporary file or folder next to a place, marked with machine, boot and process."""
    place = path.absolute() if not path.name else path  # "." has no name of its own
    own = PARTIAL.fullmatch(place.name)  # a temporary file of a temporary file belongs to the same place
    mark = f"{_machine()}{_boot()}{_start(os.getpid()) or '0' * MARK_PART}{secrets.token_hex(MARK_PART // 2)}"
    return place.with_name(f".{own['name'] if own else _short(place.name)}.{os.getpid()}.{mark}.partial")


def _short(name: str) -> str:
    """Name that leaves room for the mark; a digest where it is too long."""
    return name if len(os.fsencode(name)) <= LONGEST_NAME else hashlib.sha256(os.fsencode(name)).hexdigest()


def remove_abandoned(path: Path) -> None:
    """Remove temporary files and folders of a place whose process was killed, by the rule above.

    In a folder of more than `MAX_ENTRIES` entries only so many are looked at.
    """
    place = path.absolute()
    with contextlib.suppress(OSError):
        for entry in list(_entries(place.parent)):
            match = PARTIAL.fullmatch(entry.name)
            if (
                match is not None
                and match["name"] == _short(place.name)
                and _is_abandoned(entry, int(match["pid"]), match["mark"])
            ):
                shutil.rmtree(entry) if entry.is_dir() else entry.unlink()


def _entries(folder: Path) -> Iterator[Path]:
    with os.scandir(folder) as entries:
        yield from (Path(entry.path) for entry in islice(entries, MAX_ENTRIES) if entry.name.endswith(".partial"))


def _is_abandoned(path: Path, pid: int, mark: str) -> bool:
    machine, boot, start = (mark[i : i + MARK_PART] for i in range(0, 3 * MARK_PART, MARK_PART))
    if machine != _machine() or sys.platform == "win32":
        return False
    if boot != _boot():
        return path.stat().st_mtime < _booted_at()
    if pid == os.getpid():
        return start != _start(pid)
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except OSError:  # it lives, under another user
        return False
    current = _start(pid)
    return current is not None and current != start


@functools.cache
def _machine() -> str:
    """Digest of this machine and container: host name, machine id, namespace of process numbers."""
    parts = [platform.node(), _read("/etc/machine-id")]
    with contextlib.suppress(OSError):
        parts.append(str(Path("/proc/self/ns/pid").stat().st_ino))
    return _digest(*parts)


@functools.cache
def _boot() -> str:
    """Digest of the machine's boot."""
    return _digest(_read("/proc/sys/kernel/random/boot_id"))


def _booted_at() -> float:
    """Time of the machine's boot in seconds; 0 if unknown."""
    match = re.search(r"^btime (\d+)$", _read("/proc/stat"), re.MULTILINE)
    return 0.0 if match is None else float(match[1])


def _start(pid: int) -> str | None:
    """Digest of a process's start; None if it cannot be read. A zombie has none that fits."""
    status = _read(f"/proc/{pid}/stat").rpartition(")")[2].split()  # the name before may hold anything
    if len(status) < 20:
        return None
    return _digest("ended") if status[0] in "ZX" else _digest(status[19])


def _digest(*parts: str) -> str:
    return hashlib.sha256("\0".join(parts).encode("utf-8", "surrogateescape")).hexdigest()[:MARK_PART]


def _read(path: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


def _settle(folder: Path) -> None:
    """Writes the new name to disk, so that a power cut does not restore the old file."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
