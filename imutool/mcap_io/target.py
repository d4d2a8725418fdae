"""A file that appears whole or not at all: written beside its place under another name, renamed when it is complete."""

from __future__ import annotations

import contextlib
import os
import secrets
import weakref
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from imutool.errors import ConfigError


class Target:
    """Context manager over the file being written; leaving it without an error puts the file in its place.

    Any error, Ctrl-C included, removes what was written. `crc` is the CRC-32 of everything written so far.

    Raises:
        ConfigError: the target exists (without `overwrite`), is a folder, or the system refuses to write.
    """

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        self.path, self.overwrite = path, overwrite
        self.position, self.crc = 0, 0
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

    def write(self, data: bytes | memoryview) -> None:
        """Appends bytes.

        Raises:
            ConfigError: the system refuses; the message gives its reason.
        """
        with self._told():
            self.file.write(data)
        self.position += len(data)
        self.crc = zlib.crc32(data, self.crc)

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
            self._remove.detach()
        except BaseException:
            self.abandon()
            raise

    def abandon(self) -> None:
        """Removes what was written."""
        with contextlib.suppress(OSError):  # a full disk refuses the last flush; the file goes all the same
            self.file.close()
        self._remove()


def _unlink(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)
