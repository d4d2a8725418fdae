"""The SHA-256 of a file, also beside other work on it: hashing gives other threads their turn."""

from __future__ import annotations

import hashlib
import threading
from types import TracebackType

from imutool.errors import ConfigError, ImutoolError, LogError
from imutool.location import Location, failures, opened, reason
from imutool.mcap_io.storage.source import Source

BLOCK_BYTES = 1 << 20


def sha256(path: Location) -> str:
    """The SHA-256 of a file, in hex, a block at a time.

    Raises:
        ConfigError: the file cannot be read.
    """
    try:
        with opened(path).file as file:
            return hashlib.file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]  # readinto: all that `opened` gives
    except failures(path) as error:
        raise ConfigError(f"cannot be read ({reason(error)})", where=path) from error


class Digest:
    """The SHA-256 of a file while something else reads it, so that a disk is asked for each block once.

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
        except LogError as error:  # told where the result is asked for
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
