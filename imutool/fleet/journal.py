"""Journal of a fleet, OUT/fleet.journal: appended JSON lines, each flushed to the disk.

A line notes that a target was begun (a later run then knows it as the fleet's own), or the result of a log. One process writes,
and holds a lock. A line that a dying process left incomplete is cut off; an unreadable line is skipped, and its log done again.

In an object store, where nothing can be appended to, OUT/fleet.journal/ holds pieces of it: each is written over with one line
more until it is large enough for the next to begin, and what is read is a copy. Nobody there can hold a lock.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import IO

import msgspec

from imutool import __version__
from imutool.errors import ConfigError
from imutool.fleet.task import Result, Settings
from imutool.location import Location, io_errors, reason

NAME = "fleet.journal"
PIECE_BYTES = 256 << 10  # of a journal in a store


class Run(msgspec.Struct, frozen=True, tag_field="line", tag="run"):
    """Line of a run: its settings, the version of the tool, and whether all logs start anew."""

    settings: Settings
    digest: str
    anew: bool = False
    version: str = __version__


class TargetBegun(msgspec.Struct, frozen=True, tag_field="line", tag="began"):
    """Line of a target that is about to be written."""

    key: str
    target: str


_line = msgspec.json.Decoder(Run | TargetBegun | Result)


class Journal:
    """Journal of OUT, open for reading and appending; memory holds only keys and offsets.

    With `resume` it goes on where it ended. With `overwrite` it begins anew or, with both, goes on under other settings.

    Raises:
        ConfigError: there is one already (without `resume` or `overwrite`); it was made with other settings (without
            `overwrite`); another process writes to it; or it cannot be written.
    """

    def __init__(self, out: Location, settings: Settings, *, resume: bool = False, overwrite: bool = False) -> None:
        self.path = out / NAME
        self._begun: set[str] = set()
        self._done: dict[str, int] = {}
        self._pieces: _Pieces | None = None
        try:
            if isinstance(out, Path):
                out.mkdir(parents=True, exist_ok=True)
                self._file: IO[bytes] = (out / NAME).open("a+b")
            else:
                self._file = tempfile.TemporaryFile()  # noqa: SIM115  closed with the journal
                self._pieces = _Pieces(self.path, self._file)
        except io_errors(out) as error:
            raise ConfigError(f"cannot be written ({reason(error)})", where=self.path, fix="Choose another OUT") from error
        try:
            self._lock()
            known = self._read()
            if known is not None:
                self._refuse(known, settings, resume, overwrite)
            if not resume:
                self._done.clear()  # but what was begun stays the fleet's own
            self._append(Run(settings, settings.digest, anew=not resume))
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._file.close()

    def ours(self, target: str) -> bool:
        """Whether the fleet has begun this target in this run or an earlier one."""
        return target in self._begun

    def done(self, key: str) -> Result | None:
        """Result of a log, if the journal has one."""
        at = self._done.get(key)
        if at is None:
            return None
        self._file.seek(at)
        found = _line.decode(self._file.readline())
        assert isinstance(found, Result), "the offset is that of a result"
        return found

    def begin(self, key: str, target: str) -> None:
        """Note, before anything is written, that a target is the fleet's own."""
        if target not in self._begun:
            self._append(TargetBegun(key, target))
            self._begun.add(target)

    def finish(self, result: Result) -> None:
        """Note the result of a log."""
        self._done[result.key] = self._append(result)

    def _append(self, line: Run | TargetBegun | Result) -> int:
        raw = msgspec.json.encode(line) + b"\n"
        at = self._file.seek(0, os.SEEK_END)
        try:
            self._file.write(raw)
            self._file.flush()
            if self._pieces is None:
                os.fsync(self._file.fileno())
            else:
                self._pieces.append(raw)
        except io_errors(self.path) as error:
            with contextlib.suppress(OSError):
                self._file.truncate(at)
            raise ConfigError(
                f"cannot be written ({reason(error)})", where=self.path, fix="Make room, and go on with `resume`"
            ) from error
        return at

    def _lock(self) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ConfigError(
                "another run is at work here", where=self.path, fix="Wait for it, or choose another OUT"
            ) from error

    def _read(self) -> Run | None:
        """Read the journal, cut off an incomplete last line, and return the last run's line."""
        run, end = None, 0
        for at, raw in self._lines():
            if not raw.endswith(b"\n"):
                self._file.truncate(at)
                break
            end = at + len(raw)
            with contextlib.suppress(msgspec.DecodeError, UnicodeDecodeError):
                line = _line.decode(raw)
                match line:
                    case Run():
                        run = line
                        if line.anew:
                            self._done.clear()
                    case TargetBegun():
                        self._begun.add(line.target)
                    case Result():
                        self._begun.add(line.target)
                        self._done[line.key] = at
        return run if run is not None or end == 0 else Run(Settings(command="info"), "")

    def _lines(self) -> Iterator[tuple[int, bytes]]:
        self._file.seek(0)
        at = 0
        for raw in self._file:
            yield at, raw
            at += len(raw)

    def _refuse(self, known: Run, settings: Settings, resume: bool, overwrite: bool) -> None:
        if overwrite:
            return
        if not resume:
            raise ConfigError(
                "holds a fleet's results already",
                where=self.path.parent,
                fix="Go on with `resume`, choose another `out`, or begin anew with `overwrite`",
            )
        if known.digest != settings.digest:
            raise ConfigError(
                f"was begun with other settings ({_difference(known, settings)})",
                where=self.path.parent,
                fix="Give the same ones, choose another `out`, or add `overwrite` to do all logs again",
            )


class _Pieces:
    """Journal in an object store; `file` gets its content."""

    def __init__(self, folder: Location, file: IO[bytes]) -> None:
        self._folder, self._last = folder, bytearray()
        pieces: list[Location] = sorted(folder.glob("*.jsonl"), key=str)
        for piece in pieces:
            raw = piece.read_bytes()
            file.write(raw if raw.endswith(b"\n") or not raw else raw + b"\n")
        self._number = 1 + max((int(piece.stem) for piece in pieces if piece.stem.isdecimal()), default=-1)

    def append(self, raw: bytes) -> None:
        """Write the piece again with one more line."""
        if len(self._last) > PIECE_BYTES:
            self._last.clear()
            self._number += 1
        self._last += raw
        (self._folder / f"{self._number:08d}.jsonl").write_bytes(bytes(self._last))


def _difference(known: Run, settings: Settings) -> str:
    """Differences between settings, as old and new values."""
    then, now = msgspec.to_builtins(known.settings), msgspec.to_builtins(settings)
    changes = [
        f"{name} {then[name]!r}, now {now[name]!r}" for name in now if then[name] != now[name] and name != "model_sha256"
    ]
    if then["model_sha256"] != now["model_sha256"] and not changes:
        changes.append("another content of the model")
    if known.version != __version__:
        changes.append(f"imutool {known.version}, now {__version__}")
    return "; ".join(changes) or "unknown"
