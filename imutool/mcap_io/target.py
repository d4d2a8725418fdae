"""A file that appears whole or not at all: written beside its place under another name, renamed when it is complete.

What another file holds is copied by the kernel where it can: the bytes never come here, and a file system that shares
blocks between files copies nothing at all.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from imutool.errors import ConfigError
from imutool.mcap_io.crc import crc32
from imutool.mcap_io.source import Source, descriptor

COPY_BYTES = 1 << 20  # what passes through memory stays in the processor's cache


class Target:
    """Context manager over the file being written; leaving it without an error puts the file in its place.

    Any error, Ctrl-C included, removes what was written. `crc` is the CRC-32 of everything written while `summing`.

    Raises:
        ConfigError: the target exists (without `overwrite`), is a folder, or the system refuses to write.
    """

    def __init__(self, path: Path, *, overwrite: bool = False, summing: bool = True) -> None:
        self.path, self.overwrite = path, overwrite
        self.position, self.crc, self.summing = 0, 0, summing
        self._refuse_existing()
        self.temporary = path.with_name(f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}.partial")
        # Ctrl-C may come between two lines, before anybody is there to call `abandon`: then the file goes with this object
        self._remove = weakref.finalize(self, _unlink, self.temporary)
        with self._told():
            self.file: BinaryIO = self.temporary.open("xb")

    def _refuse_existing(self) -> None:
        if self.path.is_dir():
            raise ConfigError("the target is a folder", where=self.path, expected="the name of a file")
        if self.path.exists() and not self.overwrite:
            raise ConfigError("the target exists", where=self.path, fix="Choose another name, or add --overwrite")

    @contextmanager
    def _told(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            reason = error.strerror or type(error).__name__
            raise ConfigError(
                f"cannot be written ({reason})", where=self.path, fix="Choose a place that can be written and has room"
            ) from error

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Appends bytes.

        Raises:
            ConfigError: the system refuses; the message gives its reason.
        """
        with self._told():
            self.file.write(data)
        self.position += len(data)
        if self.summing:
            self.crc = crc32(data, self.crc)

    def copy(self, source: Source, start: int, end: int) -> None:
        """Appends the bytes of another file from `start` to `end`, by the kernel unless their CRC is wanted.

        Raises:
            ConfigError: the system refuses to write.
            LogError: the source does not have the bytes, or the disk does not give them.
        """
        if not self.summing:
            start = self._by_the_kernel(source, start, end)
        for at in range(start, end, COPY_BYTES):
            self.write(source.at(at, min(COPY_BYTES, end - at)))

    def _by_the_kernel(self, source: Source, start: int, end: int) -> int:
        """As much as the kernel copies; returns where it stopped, which is where it began if it cannot do it."""
        theirs, ours = descriptor(source.file), descriptor(self.file)
        if theirs is None or ours is None:
            return start
        calls: tuple[Callable[[int], int], ...] = (
            lambda at: os.copy_file_range(theirs, ours, end - at, offset_src=at),
            lambda at: os.sendfile(ours, theirs, at, end - at),
        )
        with self._told():
            self.file.flush()
            for call in calls:
                while start < end and (count := _tried(call, start)):
                    start, self.position = start + count, self.position + count
            self.file.seek(self.position)
        return start

    def flush(self) -> None:
        """Hands everything to the system, so that the file can be read back under its temporary name."""
        with self._told():
            self.file.flush()

    def __enter__(self) -> Target:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if kind is None:
            self.commit()
        else:
            self.abandon()

    def commit(self) -> None:
        """Puts the complete file in its place.

        Raises:
            ConfigError: the system refuses, or somebody else wrote the target meanwhile; nothing is left behind.
        """
        try:
            with self._told():
                self.file.flush()
                os.fsync(self.file.fileno())
                self.file.close()
                self._refuse_existing()
                self.temporary.replace(self.path)
                _settle(self.path.parent)
            self._remove.detach()
        except BaseException:
            self.abandon()
            raise

    def abandon(self) -> None:
        """Removes what was written."""
        with contextlib.suppress(OSError):  # a full disk refuses the last flush; the file goes all the same
            self.file.close()
        self._remove()


def _settle(folder: Path) -> None:
    """Has the new name written to the disk, so that a power cut does not bring back the old file; Windows has no way."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _tried(call: Callable[[int], int], at: int) -> int:
    """Bytes that were copied; 0 if this call cannot do it, whatever the reason: reading and writing then say which."""
    try:
        return call(at)
    except OSError:
        return 0


def _unlink(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)
