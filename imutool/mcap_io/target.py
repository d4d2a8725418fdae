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
from typing import BinaryIO, Protocol

from imutool.errors import ConfigError
from imutool.mcap_io.upload import Upload
from imutool.place import Place, failures, reason


class _Medium(Protocol):
    """What is being written under its temporary name."""

    @property
    def temporary(self) -> Place: ...

    def open(self) -> None: ...

    def write(self, data: bytes | memoryview) -> None: ...

    def complete(self) -> None:
        """Makes all of it readable under the temporary name."""

    def publish(self) -> None:
        """Puts it in its place."""

    def discard(self) -> None:
        """Removes it; what cannot be removed is left without a word."""


class Target:
    """Context manager over the file being written; leaving it without an error puts the file in its place.

    Any error, Ctrl-C included, removes what was written. `crc` is the CRC-32 of everything written so far. In a store it is
    an object under another key, copied to its own by the store when it is complete; between the last look whether the target
    exists and that copy lies a moment in which another writer's object would be replaced, as with a file.

    Raises:
        ConfigError: the target exists (without `overwrite`), is a folder, or the system refuses to write.
    """

    def __init__(self, path: Place, *, overwrite: bool = False) -> None:
        self.path, self.overwrite = path, overwrite
        self.position, self.crc = 0, 0
        name = f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}.partial"
        self._medium: _Medium = _File(path, name) if isinstance(path, Path) else Upload(path, name)
        self.temporary = self._medium.temporary
        # Ctrl-C may come between two lines, before anybody is there to call `abandon`: then the file goes with this object
        self._remove = weakref.finalize(self, self._medium.discard)
        with self._told():
            self._refuse_existing()
            self._medium.open()

    def _refuse_existing(self) -> None:
        if self.path.is_dir():
            raise ConfigError("the target is a folder", where=self.path, expected="the name of a file")
        if self.path.exists() and not self.overwrite:
            raise ConfigError("the target exists", where=self.path, fix="Choose another name, or add --overwrite")

    @contextmanager
    def _told(self) -> Iterator[None]:
        try:
            yield
        except ConfigError:
            raise
        except failures(self.path) as error:
            raise ConfigError(
                f"cannot be written ({reason(error)})", where=self.path, fix="Choose a place that can be written and has room"
            ) from error

    def write(self, data: bytes | memoryview) -> None:
        """Appends bytes.

        Raises:
            ConfigError: the system refuses; the message gives its reason.
        """
        with self._told():
            self._medium.write(data)
        self.position += len(data)
        self.crc = zlib.crc32(data, self.crc)

    def flush(self) -> None:
        """Hands everything over, so that it can be read back under its temporary name; nothing can be written after."""
        with self._told():
            self._medium.complete()

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
                self._medium.complete()
                self._refuse_existing()
                self._medium.publish()
            self._remove.detach()
        except BaseException:
            self.abandon()
            raise

    def abandon(self) -> None:
        """Removes what was written."""
        self._remove()


class _File:
    """A file beside its place."""

    file: BinaryIO

    def __init__(self, path: Path, name: str) -> None:
        self.path, self.temporary = path, path.with_name(name)

    def open(self) -> None:
        self.file = self.temporary.open("xb")

    def write(self, data: bytes | memoryview) -> None:
        self.file.write(data)

    def complete(self) -> None:
        self.file.flush()

    def publish(self) -> None:
        os.fsync(self.file.fileno())
        self.file.close()
        self.temporary.replace(self.path)

    def discard(self) -> None:
        with contextlib.suppress(OSError, AttributeError):  # a full disk refuses the last flush; or it was never opened
            self.file.close()
        with contextlib.suppress(OSError):
            self.temporary.unlink(missing_ok=True)
