"""The bytes of a log, wherever it lies: read only, by offset and length, never a byte fewer than asked for."""

from __future__ import annotations

from imutool.errors import ConfigError, LogError
from imutool.location import Location, failures, opened, reason
from imutool.mcap_io.codec.records import HEAD

CUT_SHORT = "Save what is there with `imutool repair`, or copy it again from where it was recorded"


class Source:
    """The bytes of a file or an object in a store that is only ever read, with a refusal in place of a short read."""

    def __init__(self, path: Location, expected: str = "an MCAP log") -> None:
        try:
            self.file, self.size = opened(path)
        except failures(path) as error:
            raise ConfigError(f"cannot be opened ({reason(error)})", where=path, expected=expected) from error
        self.path = path

    def at(self, offset: int, length: int) -> bytes:
        """Exactly these bytes.

        Raises:
            LogError: the file does not have them, or the disk or the store does not give them.
        """
        try:
            self.file.seek(offset)
            parts = self.file.read(length)
            while len(parts) < length and (part := self.file.read(length - len(parts))):
                parts += part
        except failures(self.path) as error:
            raise LogError(f"cannot be read at byte {offset} ({reason(error)})") from error
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
