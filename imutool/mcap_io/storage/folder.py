"""Write a folder that appears whole or not at all."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import shutil
import weakref
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

from imutool.errors import ConfigError

SIGNATURE = "# Exported by imutool"


class ExportFolder:
    """The folder being written; leaving the context without an error puts it in its place.

    Any error, Ctrl-C included, removes what was written. An older folder is replaced only if its file `signed` says that it
    was made here and its top holds nothing but what `holds` matches: a data set that merely looks alike is never removed.

    Raises:
        ConfigError: the target exists (without `overwrite`), is not an export, holds the log, or cannot be written.
    """

    def __init__(self, path: Path, log: Path, *, signed: str, holds: str, overwrite: bool) -> None:
        self.path, self.log, self.overwrite = path.absolute(), log, overwrite
        self.signed, self.holds = signed, holds
        self._refuse_existing()
        self.temporary = self._beside("partial")
        self._remove = weakref.finalize(self, shutil.rmtree, self.temporary, True)
        with writing(path):
            self.temporary.mkdir()

    def _beside(self, ending: str) -> Path:
        return self.path.with_name(f".{self.path.name}.{os.getpid()}.{secrets.token_hex(4)}.{ending}")

    def _refuse_existing(self) -> None:
        if not self.path.exists() and not self.path.is_symlink():
            return
        if not self.overwrite:
            raise ConfigError("the target exists", where=self.path, fix="Choose another name, or add `overwrite=True`")
        if self.path.is_symlink() or not self.path.is_dir():
            raise ConfigError("the target is not a folder", where=self.path, expected="the name of a new folder")
        if self.log.resolve().is_relative_to(self.path.resolve()):
            raise ConfigError("the target holds the log itself", where=self.path, expected="another folder")
        foreign = sorted(entry.name for entry in self.path.iterdir() if not re.fullmatch(self.holds, entry.name))
        if foreign or not self._was_made_here():
            what = f"the target holds {foreign[0]}, which no export makes" if foreign else "the target was not made by imutool"
            raise ConfigError(what, where=self.path, fix="Choose another folder, or remove this one yourself")

    def _was_made_here(self) -> bool:
        try:
            with (self.path / self.signed).open("rb") as file:
                return SIGNATURE.encode() in file.read(len(SIGNATURE) + 80)
        except OSError:
            return False

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
            before = self._beside("replaced")
            self.path.rename(before)
            try:
                self.temporary.rename(self.path)
            except BaseException:
                before.rename(self.path)
                raise
            shutil.rmtree(before)


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turns errors of the system into a ConfigError while a folder is written."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or type(error).__name__
        fix = "Choose a place that can be written and has room"
        raise ConfigError(f"cannot be written ({reason})", where=path, fix=fix) from error
