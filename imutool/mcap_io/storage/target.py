"""Write a file or folder whole or not at all: under a temporary name, then renamed.

What another file holds is copied by the kernel: a file system that shares blocks between files copies nothing at all. Where
the bytes move by part of a block it takes 0.8 times as long as reading and writing in memory, and as long on ext4.
"""

from __future__ import annotations

import os
import re
import secrets
import shutil
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

from imutool.errors import ConfigError
from imutool.file_location import Location, first_bytes, io_errors, reason
from imutool.mcap_io.codec.records import crc32
from imutool.mcap_io.storage.local import LocalFile, Stream, is_stream, remove_abandoned, temporary_path
from imutool.mcap_io.storage.output_conflicts import refuse_existing
from imutool.mcap_io.storage.source import BLOCK_BYTES, Source, crc_of
from imutool.mcap_io.storage.upload import Upload

SIGNATURE = "# Exported by imutool"  # in the first lines of a file of every exported folder


class Target:
    """The file being written; leaving the context without an error puts it in its place.

    A device or a pipe gets the complete bytes and is never replaced. Any error, Ctrl-C included, removes what was written.
    `crc` is the CRC-32 of everything written while `summing`. In a store it is an object under another key, copied to its own
    by the store when it is complete; between the last look whether the target exists and that copy lies a moment in which
    another writer's object would be replaced, as with a file.

    Raises:
        ConfigError: the target exists (without `overwrite`), is a folder, or the system refuses to write.
    """

    def __init__(self, path: Location, *, overwrite: bool = False, summing: bool = True) -> None:
        self.path, self.overwrite = path, overwrite
        self.position, self.crc, self.summing = 0, 0, summing
        self._medium, self._errors = _medium(path), io_errors(path)
        self.temporary = self._medium.temporary
        # Ctrl-C may come between two lines, before `abandon` can be called: then the file goes with this object
        self._remove = weakref.finalize(self, self._medium.discard)
        with self._system_errors():
            refuse_existing(path, overwrite=overwrite)
            self._medium.open()

    @contextmanager
    def _system_errors(self) -> Iterator[None]:
        try:
            yield
        except ConfigError:
            raise
        except FileExistsError as error:
            raise ConfigError("the target exists", where=self.path, fix="Another program wrote it meanwhile") from error
        except self._errors as error:
            raise self._refusal(error) from error

    def _refusal(self, error: Exception) -> ConfigError:
        what = f"cannot be written ({reason(error)})"
        return ConfigError(what, where=self.path, fix="Choose a place that can be written and has room")

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Appends bytes.

        Raises:
            ConfigError: the system refuses; the message gives its reason.
        """
        try:  # a context manager would take as long as the rest
            self._medium.write(data)
        except self._errors as error:
            raise self._refusal(error) from error
        self.position += len(data)
        if self.summing:
            self.crc = crc32(data, self.crc)

    def copy(self, source: Source, start: int, end: int) -> None:
        """Appends bytes `start` to `end` of another file; the kernel copies if no CRC is needed.

        Raises:
            ConfigError: the system refuses to write.
            LogError: the source does not have the bytes, or the disk does not give them.
        """
        if not self.summing:
            with self._system_errors():
                stopped = self._medium.copy(source, start, end)
            self.position, start = self.position + stopped - start, stopped
        for at in range(start, end, BLOCK_BYTES):
            self.write(source.at(at, min(BLOCK_BYTES, end - at)))

    def flush(self) -> None:
        """Makes all bytes readable under the temporary name; nothing can be written after."""
        with self._system_errors():
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
            with self._system_errors():
                self._medium.complete()
                refuse_existing(self.path, overwrite=self.overwrite)
                self._medium.publish(replace=self.overwrite)
            self._remove.detach()
        except BaseException:
            self.abandon()
            raise

    def abandon(self) -> None:
        """Removes what was written."""
        self._remove()


def copy_file(source: Path, target: Location, *, overwrite: bool) -> None:
    """Copy a file.

    Raises:
        ConfigError: the target exists (without `overwrite`), or the system refuses to write.
    """
    opened = Source(source)
    with opened.file, Target(target, overwrite=overwrite, summing=False) as out:
        out.copy(opened, 0, opened.size)


def temporary(path: Location) -> Location:
    """Temporary name beside a place, which a later run on it knows as its own."""
    if isinstance(path, Path):
        return temporary_path(path)
    return path.with_name(f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}.partial")


def _medium(path: Location) -> LocalFile | Upload:
    if not isinstance(path, Path):
        return Upload(path, temporary(path).name)
    return Stream(path) if is_stream(path) else LocalFile(path)


class PassThrough:
    """Copies a source into a target in order, with new records between those of the source."""

    def __init__(self, source: Source, target: Target) -> None:
        self.source, self.target = source, target
        self.copied = self.crc = 0  # bytes of the source so far, and their CRC if it states one
        self.pending_end = 0  # the bytes from `copied` to here are to be copied, but not yet

    @property
    def pending(self) -> int:
        """Bytes to be copied later."""
        return self.pending_end - self.copied

    def defer(self, end: int) -> int:
        """Marks the source up to here to be copied now or later; returns by how much its bytes move."""
        self.pending_end = end
        return self.target.position - self.copied

    def flush(self) -> None:
        """Copies the pending bytes."""
        start, end, out = self.copied, self.pending_end, self.target
        self.copied = end
        if not out.summing:
            out.copy(self.source, start, end)
            return
        for at in range(start, end, BLOCK_BYTES):  # read once for the CRC of the source and that of the copy
            raw = self.source.at(at, min(BLOCK_BYTES, end - at))
            self.crc = crc32(raw, self.crc)
            out.write(raw)

    def skip(self, end: int) -> None:
        """Skips the source's bytes up to `end`: another form of them is written, or none."""
        if self.target.summing:
            self.crc = crc_of(self.source, self.copied, end, self.crc)
        self.copied = self.pending_end = end

    def write(self, raw: memoryview) -> int:
        """Copies bytes of the source that are in memory already; returns where they went."""
        self.flush()
        at = self.target.position
        if self.target.summing:
            self.crc = crc32(raw, self.crc)
        self.target.write(raw)
        self.copied = self.pending_end = self.copied + len(raw)
        return at


class FolderTarget:
    """The folder being written; leaving the context without an error puts it in its place.

    Any error, Ctrl-C included, removes what was written. An older folder is replaced only if its file `signed` says that it
    was made here, all paths in it match `holds`, and all its folders are written again: no other file is removed with it.

    Raises:
        ConfigError: the target exists (without `overwrite`), is not an export, holds the log, or cannot be written.
    """

    def __init__(self, path: Path, log: Path, *, signed: str, holds: str, overwrite: bool) -> None:
        self.path, self.log, self.overwrite = path.absolute(), log, overwrite
        self.signed, self.holds = signed, holds
        self.temporary = temporary_path(self.path)
        self._refuse_existing()
        remove_abandoned(self.path)
        self._remove = weakref.finalize(self, shutil.rmtree, self.temporary, True)
        with writing(path):
            self.temporary.mkdir()

    def _refuse_existing(self) -> None:
        if not self.path.exists() and not self.path.is_symlink():
            return
        if not self.overwrite:
            raise ConfigError("the target exists", where=self.path, fix="Choose another name, or add `overwrite=True`")
        if self.path.is_symlink() or not self.path.is_dir():
            raise ConfigError("the target is not a folder", where=self.path, expected="the name of a new folder")
        if self.log.resolve().is_relative_to(self.path.resolve()):
            raise ConfigError("the target holds the log itself", where=self.path, expected="another folder")
        within = sorted(entry.relative_to(self.path) for entry in self.path.rglob("*"))
        foreign = [str(entry) for entry in within if not (re.fullmatch(self.holds, entry.as_posix()) and self._makes(entry))]
        if foreign or SIGNATURE.encode() not in first_bytes(self.path / self.signed, len(SIGNATURE) + 80):
            what = (
                f"the target holds {foreign[0]}, which this export does not make"
                if foreign
                else "the target was not made by imutool"
            )
            raise ConfigError(what, where=self.path, fix="Choose another folder, or remove this one yourself")

    def _makes(self, entry: Path) -> bool:
        """Whether an entry is a file, or a folder that is written again, as far as that is known yet."""
        if not self.temporary.is_dir() or not (self.path / entry).is_dir():
            return True
        return (self.temporary / entry).is_dir() and not (self.path / entry).is_symlink()

    def __enter__(self) -> Path:
        return self.temporary

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            if kind is None:
                self._commit()
        finally:
            self._remove()

    def _commit(self) -> None:
        """Puts the folder in its place, and an older one out of it once nothing can fail."""
        self._refuse_existing()
        with writing(self.path):
            if not self.path.exists():
                self.temporary.rename(self.path)
                return
            before = temporary_path(self.path).with_suffix(".replaced")  # never removed by a later run
            self.path.rename(before)
            try:
                self.temporary.rename(self.path)
            except BaseException:
                before.rename(self.path)
                raise
            shutil.rmtree(before)


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turns errors of the system into a ConfigError while a folder is written."""
    try:
        yield
    except OSError as error:
        if isinstance(error, FileExistsError) and path.is_file():
            raise ConfigError("is a file", where=path, expected="a folder, which need not exist") from error
        reason = error.strerror or type(error).__name__
        fix = "Choose a place that can be written and has room"
        raise ConfigError(f"cannot be written ({reason})", where=path, fix=fix) from error
