"""Journal of a fleet, OUT/fleet.journal: appended JSON lines, each flushed to the disk.

A line notes that a target was begun (a later run then knows it as the fleet's own), or the result of a log. One process writes,
and holds a lock. Every line ends with its CRC-32: a line that is incomplete or was hit by something else is skipped, the log of
its result is done again, and the lines around it count. Targets are noted a second time, some lines later.

In an object store, where nothing can be appended to, OUT/fleet.journal/ holds pieces of it: each is written over with one line
more until it is large enough for the next to begin, and what is read is a copy. Nobody there can hold a lock.
"""

from __future__ import annotations

import contextlib
import os
import platform
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import IO, Annotated
from zlib import crc32

import msgspec

from imutool import __version__
from imutool.errors import ConfigError
from imutool.file_location import Location, io_errors, reason
from imutool.fleet.task import Result, Settings
from imutool.processes.system import lock

NAME = "fleet.journal"
NOTED_AGAIN = 32  # targets in a second note
CRC = re.compile(rb',"crc":"([0-9a-f]{8})"\}\n?\Z')
CRC_WITHIN = re.compile(rb',"crc":"[0-9a-f]{8}"\}')
BEGIN = re.compile(rb'\{"line":"')
PIECE_BYTES = 256 << 10  # of a journal in a store


class Run(msgspec.Struct, frozen=True, tag_field="line", tag="run"):
    """Line of a run: its settings, the version of the tool, and whether all logs start anew."""

    settings: Settings
    digest: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
    anew: bool = False
    version: str = __version__
    process: str = ""  # that writes from here on


class TargetBegun(msgspec.Struct, frozen=True, tag_field="line", tag="began"):
    """Line of a target that is about to be written."""

    key: str
    target: str


class TargetsBegun(msgspec.Struct, frozen=True, tag_field="line", tag="targets"):
    """Second note of targets, with the settings under which they were begun."""

    targets: tuple[str, ...]
    digest: str


_Line = Run | TargetBegun | TargetsBegun | Result
_line = msgspec.json.Decoder(_Line)


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
        self._noted_once: list[str] = []
        self._done: dict[str, tuple[int, int]] = {}  # offset and length of a result's line
        self._digest = settings.digest
        self._pieces: _Pieces | None = None
        try:
            if isinstance(out, Path):
                out.mkdir(parents=True, exist_ok=True)
                self._file: IO[bytes] = (out / NAME).open("a+b", buffering=0)
            else:
                self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115  closed with the journal
                self._pieces = _Pieces(self.path, self._file)
        except io_errors(out) as error:
            where, expected = getattr(error, "filename", None) or out, "a folder as OUT that can be written"
            raise ConfigError(f"cannot be written ({reason(error)})", where=where, expected=expected) from error
        try:
            self._lock()
            known = self._read()
            if known is not None:
                self._refuse(known, settings, resume, overwrite)
            if not resume:
                self._done.clear()  # but what was begun stays the fleet's own
            process = f"process {os.getpid()} of {platform.node()}"
            self._append(Run(settings, settings.digest, anew=not resume, process=process))
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        with contextlib.suppress(ConfigError):  # a full disk: each target stands there once
            self._note_again(len(self._noted_once))
        self._file.close()

    def ours(self, target: str) -> bool:
        """Whether the fleet has begun this target in this run or an earlier one."""
        return target in self._begun

    def done(self, key: str) -> Result | None:
        """Result of a log, if the journal has one."""
        if (place := self._done.get(key)) is None:
            return None
        self._file.seek(place[0])
        result = _decoded(self._file.read(place[1]))
        assert isinstance(result, Result), "the offset is that of a result"
        return result

    def begin(self, key: str, target: str) -> None:
        """Note, before anything is written, that a target is the fleet's own."""
        if target not in self._begun:
            self._append(TargetBegun(key, target))
            self._begun.add(target)
            self._noted_once.append(target)
            if len(self._noted_once) >= 2 * NOTED_AGAIN:
                self._note_again(NOTED_AGAIN)

    def _note_again(self, count: int) -> None:
        """Note the oldest targets a second time, far from the first: what hits one line spares the other."""
        if count:
            targets, self._noted_once = self._noted_once[:count], self._noted_once[count:]
            self._append(TargetsBegun(tuple(targets), self._digest))

    def finish(self, result: Result) -> None:
        """Note the result of a log."""
        self._done[result.key] = self._append(result)

    def _append(self, line: _Line) -> tuple[int, int]:
        return self._append_bytes(_encoded(line))

    def _append_bytes(self, raw: bytes) -> tuple[int, int]:
        """Append without a buffer: on a full disk it would keep what it could not write, for whatever comes next."""
        if self._pieces is None and not self.path.exists():
            raise ConfigError("is gone: OUT was moved or removed", where=self.path, fix="Put it back, and go on with `resume`")
        at = self._file.seek(0, os.SEEK_END)
        try:
            _write_whole(self._file, raw)
            if self._pieces is None:
                os.fsync(self._file.fileno())
            else:
                self._pieces.append(raw)
        except io_errors(self.path) as error:
            with contextlib.suppress(OSError):
                self._file.truncate(at)
            what = f"cannot be written ({reason(error)})"
            fix = "Make room" if self._pieces is None else "Check the address and your access to the store"
            raise ConfigError(what, where=self.path, fix=f"{fix}, and go on with `resume`") from error
        return at, len(raw)

    def _lock(self) -> None:
        if not lock(self._file):
            runs = [line for _, _, line in self._lines() if isinstance(line, Run)]
            who = f" ({runs[-1].process})" if runs and runs[-1].process else ""
            raise ConfigError(f"another run is at work here{who}", where=self.path, fix="Wait for it, or choose another `out`")

    def _read(self) -> Run | None:
        """Read the journal, and return the last run's line."""
        run, digest = None, ""
        for at, length, line in self._lines():
            match line:
                case Run():
                    run = line
                    if line.anew:
                        self._done.clear()
                case TargetBegun():
                    self._begun.add(line.target)
                case TargetsBegun():
                    self._begun.update(line.targets)
                    digest = line.digest
                case Result():
                    self._begun.add(line.target)
                    self._done[line.key] = at, length
        end = self._file.seek(0, os.SEEK_END)
        self._file.seek(max(end - 1, 0))
        if end and self._file.read(1) != b"\n":
            self._append_bytes(b"\n")  # what comes now stands in a line of its own
        if run is None and end:  # hit: the keys of the results say whether the settings fit
            return Run(Settings(command="info"), digest or self._digest)
        return run

    def _lines(self) -> Iterator[tuple[int, int, _Line]]:
        """Offset, length and content of every sound line; two that have lost the end between them count both.

        Lines of earlier versions have no CRC. Behind one that has, a line without has lost it.
        """
        with os.fdopen(os.dup(self._file.fileno()), "rb") as lines:  # with a buffer
            lines.seek(0)
            at, checked = 0, False
            for raw in lines:
                has_crc = CRC.search(raw) is not None
                checked |= has_crc
                line = _decoded(raw) if has_crc or not checked else None
                if line is not None:
                    yield at, len(raw), line
                else:
                    for start, piece in _pieces(raw):
                        line = _decoded(piece)
                        if line is not None:
                            yield at + start, len(piece), line
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


def _write_whole(file: IO[bytes], raw: bytes) -> None:
    """Write all bytes to a file without a buffer, which may take fewer at once."""
    remaining = memoryview(raw)
    while remaining:
        remaining = remaining[file.write(remaining) :]


def _encoded(line: _Line) -> bytes:
    """Line as JSON whose last entry is the CRC-32 of the rest."""
    raw = msgspec.json.encode(line)
    return raw[:-1] + b',"crc":"%08x"}\n' % crc32(raw)


def _decoded(raw: bytes) -> _Line | None:
    """Content of a line; None for one that is not sound."""
    match = CRC.search(raw)
    if match is not None and crc32(raw[: match.start()] + b"}") != int(match[1], 16):
        return None
    with contextlib.suppress(msgspec.DecodeError, UnicodeDecodeError):
        line: _Line = _line.decode(raw)
        return line
    return None


def _pieces(raw: bytes) -> Iterator[tuple[int, bytes]]:
    """Everything in a line that may be a whole one: from where one begins to the next CRC."""
    for start in BEGIN.finditer(raw):
        end = CRC_WITHIN.search(raw, start.start())
        if end is not None:
            yield start.start(), raw[start.start() : end.end()]


class _Pieces:
    """Journal in an object store; `file` gets its content."""

    def __init__(self, folder: Location, file: IO[bytes]) -> None:
        self._folder, self._last = folder, bytearray()
        pieces: list[Location] = sorted(folder.glob("*.jsonl"), key=str)
        for piece in pieces:
            raw = piece.read_bytes()
            _write_whole(file, raw if raw.endswith(b"\n") or not raw else raw + b"\n")
        self._number = 1 + max((int(piece.stem[:8]) for piece in pieces if piece.stem[:8].isdecimal()), default=-1)
        self._own = os.urandom(4).hex()  # two runs that begin at once do not write over each other's pieces

    def append(self, raw: bytes) -> None:
        """Write the piece again with one more line."""
        if len(self._last) > PIECE_BYTES:
            self._last.clear()
            self._number += 1
        self._last += raw
        (self._folder / f"{self._number:08d}-{self._own}.jsonl").write_bytes(bytes(self._last))


def _difference(known: Run, settings: Settings) -> str:
    """Differences between settings, as old and new values."""
    old, new = msgspec.to_builtins(known.settings), msgspec.to_builtins(settings)
    changes = [f"{name} {old[name]!r}, now {new[name]!r}" for name in new if old[name] != new[name] and name != "model_sha256"]
    if old["model_sha256"] != new["model_sha256"] and not changes:
        changes.append("another content of the model")
    if known.version != __version__:
        changes.append(f"imutool {known.version}, now {__version__}")
    return "; ".join(changes) or "unknown"
