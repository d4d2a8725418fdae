"""The bytes of a log, wherever it lies: read only, by offset and length, never a byte fewer than asked for."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

from imutool.errors import ConfigError, LogError
from imutool.mcap_io.records import HEAD

CUT_SHORT = "Save what is there with `imutool repair`, or copy it again from where it was recorded"


class Source:
    """The bytes of a file that is only ever read, with a refusal in place of a short read."""

    def __init__(self, path: Path) -> None:
        try:
            self.file: BinaryIO = path.open("rb", buffering=0)
            self.size = path.stat().st_size
        except OSError as error:
            raise ConfigError(f"cannot be opened ({error.strerror})", where=path, expected="an MCAP log") from error
        self.path = path

    def at(self, offset: int, length: int) -> bytes:
        """Exactly these bytes.

        Raises:
            LogError: the file does not have them, or the disk does not give them.
        """
        try:
            self.file.seek(offset)
            parts = self.file.read(length)
            while len(parts) < length and (part := self.file.read(length - len(parts))):
                parts += part
        except OSError as error:
            raise LogError(f"cannot be read at byte {offset} ({error.strerror})") from error
        if len(parts) != length:
            raise LogError(f"the log is cut short at byte {offset + len(parts)}", fix=CUT_SHORT)
        return parts

    def head(self, offset: int) -> tuple[int, int]:
        """Opcode and length of the record at an offset."""
        opcode, length = HEAD.unpack(self.at(offset, HEAD.size))
        return opcode, length


def descriptor(file: object) -> int | None:
    """The number under which the system knows an open file; none for what only looks like one, as in an object store."""
    try:
        return int(file.fileno())  # type: ignore[attr-defined]  # asked for, not demanded
    except (AttributeError, OSError):
        return None
