"""An object being written to a store: in parts, under a temporary key, then copied to its own by the store."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

from imutool.errors import ConfigError

if TYPE_CHECKING:
    from upath import UPath

PART_BYTES = 16 << 20  # S3 takes 10 000 parts: up to 156 GiB, with one part and its copy in memory


class Upload:
    """One object under its temporary key; nothing of it can be seen before `complete`."""

    def __init__(self, path: UPath, name: str) -> None:
        self.path, self.temporary = path, path.with_name(name)
        self.size, self.seal = 0, ""
        self.file: Any = None

    def open(self) -> None:
        """Begins; most stores notice at the first part."""
        self.file = self.temporary.fs.open(self.temporary.path, "wb", block_size=PART_BYTES)

    def write(self, data: bytes | memoryview) -> None:
        """Takes in bytes, and sends a part whenever there is one."""
        self.file.write(data)
        self.size += len(data)

    def complete(self) -> None:
        """Sends the last part: the object is then there under its temporary key. Does nothing when it is there already."""
        if not self.file.closed:
            self.file.close()
            self.seal = self._seal(self.temporary)

    def publish(self) -> None:
        """Copies the object to its own key, within the store, and removes the temporary one.

        Raises:
            ConfigError: the store holds something else than what was written.
        """
        if self._seal(self.temporary) != self.seal:
            raise ConfigError("was changed by somebody while it was written", where=self.temporary)
        self.path.fs.cp_file(self.temporary.path, self.path.path)
        self._seal(self.path)
        self.path.fs.rm_file(self.temporary.path)

    def _seal(self, place: UPath) -> str:
        """What identifies the contents of an object that must be as long as what was written."""
        info: dict[str, Any] = place.fs.info(place.path)
        if info["size"] != self.size:
            raise ConfigError(f"the store holds {info['size']} bytes", where=place, expected=str(self.size))
        return str(info.get("ETag", ""))

    def discard(self) -> None:
        """Aborts the upload and removes the temporary object, as far as the store can be reached."""
        if self.file is None:
            return
        self.file.closed = True  # else the file would complete the upload when it is collected
        with contextlib.suppress(Exception):
            self.file.discard()
        with contextlib.suppress(Exception):  # it is there if the upload was complete, or an answer was lost on its way
            self.temporary.fs.rm_file(self.temporary.path)
