"""Read the bytes of a log by offset, and its SHA-256; a short read is an error."""

from __future__ import annotations

import hashlib
import threading
from types import TracebackType

from imutool.errors import ConfigError, ImutoolError, LogError
from imutool.file_location import Location, compression, io_errors, open_location, reason
from imutool.mcap_io.codec.records import HEAD, crc32
from imutool.processes.system import read_at

BLOCK_BYTES = 1 << 20
SHORT_BYTES, AHEAD_BYTES = 512, 1 << 13  # a read of at most so many bytes of a local file takes as many at once
CUT_SHORT = "Save the rest with `imutool repair`, or copy it again from where it was recorded"
OF_A_FOLDER = "Name a log in it; `imutool fleet` takes a folder of logs, and `imutool convert` a recording that is a folder"


class Source:
    """Bytes of a file or object, read only; a short read is an error.

    Threads and forked processes may share it.
    """

    def __init__(self, path: Location, expected: str = "an MCAP log") -> None:
        try:
            self.file, self.size, self.identity = open_location(path)
        except IsADirectoryError as error:
            raise ConfigError("is a folder", where=path, expected=expected, fix=OF_A_FOLDER) from error
        except io_errors(path) as error:
            raise ConfigError(f"cannot be opened ({reason(error)})", where=path, expected=expected) from error
        self.path = path
        self._ahead = 0, b""  # where the bytes lie that were read ahead of short reads, and these
        self._is_local, self._moves = descriptor(self.file) is not None, threading.Lock()
        if self._is_local and (program := compression(self._read(0, 8))):
            self.file.close()
            what, fix = (
                f"is compressed with {program}",
                f"Unpack it first, for instance with {program} -d; `imutool convert` reads it as it is",
            )
            raise LogError(what, where=path, expected=expected, fix=fix)

    def at(self, offset: int, length: int) -> bytes:
        """Exactly these bytes.

        Raises:
            LogError: the file does not have them, or the disk or the store does not give them.
        """
        if length <= SHORT_BYTES and self._is_local:
            ahead_at, ahead = self._ahead
            start = offset - ahead_at
            if not 0 <= start <= len(ahead) - length:
                start, ahead = 0, self._read(offset, min(AHEAD_BYTES, max(length, self.size - offset)))
                self._ahead = offset, ahead
            if length <= len(ahead) - start:
                return ahead[start : start + length]
        parts = self._read(offset, length)
        if len(parts) != length:
            raise LogError(f"the log is cut short at byte {offset + len(parts)}", fix=CUT_SHORT)
        return parts

    def _read(self, offset: int, length: int) -> bytes:
        """These bytes, or those up to the end of the file."""
        try:
            parts = self._part(offset, length)
            while len(parts) < length and (part := self._part(offset + len(parts), length - len(parts))):
                parts += part
        except io_errors(self.path) as error:
            raise LogError(f"cannot be read at byte {offset} ({reason(error)})") from error
        return parts

    def _part(self, offset: int, length: int) -> bytes:
        """Some of these bytes at least."""
        if self._is_local and (part := read_at(self.file, offset, length)) is not None:
            return part
        with self._moves:
            self.file.seek(offset)
            return self.file.read(length)

    def head(self, offset: int) -> tuple[int, int]:
        """Opcode and length of the record at an offset."""
        opcode, length = HEAD.unpack(self.at(offset, HEAD.size))
        return opcode, length


def crc_of(source: Source, start: int, end: int, crc: int = 0) -> int:
    """CRC-32 of the bytes from `start` to `end`, continued from that of the bytes before them."""
    for at in range(start, end, BLOCK_BYTES):
        crc = crc32(source.at(at, min(BLOCK_BYTES, end - at)), crc)
    return crc


def descriptor(file: object) -> int | None:
    """The system's number of an open file; None in an object store."""
    try:
        return int(file.fileno())  # type: ignore[attr-defined]  # asked for, not demanded
    except (AttributeError, OSError):
        return None


def sha256(path: Location) -> str:
    """SHA-256 of a file, in hex, a block at a time.

    Raises:
        ConfigError: the file cannot be read.
    """
    try:
        with open_location(path).file as file:
            return hashlib.file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]  # readinto: all that `open_location` gives
    except io_errors(path) as error:
        raise ConfigError(f"cannot be read ({reason(error)})", where=path) from error


class Digest:
    """SHA-256 of a file in a thread, while the caller reads it: the disk reads a block once.

    A context manager: leaving it ends the thread, whether or not anybody asked for the result.
    """

    def __init__(self, path: Location) -> None:
        self._source, self._sum = Source(path), hashlib.sha256()
        self._error: ImutoolError | None = None
        self._left = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sha256", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        size = self._source.size
        try:
            for at in range(0, size, BLOCK_BYTES):
                if self._left.is_set():
                    return
                self._sum.update(self._source.at(at, min(BLOCK_BYTES, size - at)))
        except LogError as error:  # raised by `result`
            self._error = error.at(self._source.path)

    def result(self) -> str:
        """The digest, in hex, once the whole file has been read.

        Raises:
            LogError: the file has become shorter, or the disk does not give it.
        """
        self._thread.join()
        if self._error is not None:
            raise self._error
        return self._sum.hexdigest()

    def __enter__(self) -> Digest:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._left.set()
        self._thread.join()
        self._source.file.close()
