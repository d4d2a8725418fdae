"""Write an object to a store: in parts, under a temporary key, then copied by the store."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from imutool.errors import ConfigError
from imutool.file_location import reason
from imutool.mcap_io.storage.source import Source

if TYPE_CHECKING:
    from upath import UPath

logger = logging.getLogger(__name__)

DELETE_PAUSES_S = (0.1, 1.0)
PART_BYTES = 8 << 20  # one part and its copies are what is in memory
LARGE_AFTER, LARGE_PART_BYTES = 32 << 30, 64 << 20  # S3 takes 10 000 parts: so they are enough for 400 GiB


class Upload:
    """One object under its temporary key, invisible before `complete`."""

    def __init__(self, path: UPath, name: str) -> None:
        self.path, self.temporary = path, path.with_name(name)
        self.size, self.etag = 0, ""
        self.file: Any = None

    def open(self) -> None:
        """Begins; most stores notice at the first part."""
        self.file = self.temporary.fs.open(self.temporary.path, "wb", block_size=PART_BYTES)

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Takes in bytes, and sends a part whenever there is one."""
        if self.size >= LARGE_AFTER:
            self.file.blocksize = LARGE_PART_BYTES
        self.file.write(data)
        self.size += len(data)

    def copy(self, source: Source, start: int, end: int) -> int:
        """Copies nothing: parts of objects are not copied within the store."""
        return start

    def complete(self) -> None:
        """Sends the last part, unless that is done: the temporary object then exists."""
        if not self.file.closed:
            self.file.close()
            self.etag = self._check_size(self.temporary)

    def publish(self, *, replace: bool) -> None:
        """Copies the object to its own key, within the store, and removes the temporary one.

        Raises:
            ConfigError: the store holds something else than what was written.
        """
        if self._check_size(self.temporary) != self.etag:
            raise ConfigError("was changed while it was written", where=self.temporary)
        with self._no_parts_left():
            self.path.fs.cp_file(self.temporary.path, self.path.path)
        self._check_size(self.path)
        self._remove_temporary()

    def _remove_temporary(self) -> None:
        """Remove the temporary object; a store that fails is asked again."""
        for pause_s in (*DELETE_PAUSES_S, None):
            try:
                return self.temporary.fs.rm_file(self.temporary.path)  # type: ignore[no-any-return]  # None
            except FileNotFoundError:
                return None
            except Exception as error:  # the object is in its place, and whole: that is what was asked for  # noqa: BLE001
                if pause_s is None:
                    logger.warning("%s could not be removed: %s", self.temporary, reason(error))
                else:
                    time.sleep(pause_s)
        return None

    @contextmanager
    def _no_parts_left(self) -> Iterator[None]:
        """Aborts the parts of a large copy in S3 that failed: s3fs leaves them there."""
        before = self._uploads()
        try:
            yield
        except BaseException:
            with suppress(Exception):  # the first error is raised
                for upload in self._uploads() - before:  # the others are somebody else's
                    self.path.fs.abort_mpu(*upload)
            raise

    def _uploads(self) -> set[tuple[str, str, str]]:
        """Bucket, key and id of every unfinished upload to the target's key."""
        bucket, _, key = self.path.path.partition("/")
        with suppress(Exception):  # no such call, or not allowed
            found = self.path.fs.list_multipart_uploads(bucket)
            return {(bucket, key, entry["UploadId"]) for entry in found if entry["Key"] == key}
        return set()

    def _check_size(self, place: UPath) -> str:
        """ETag of an object, whose size must be that of the bytes written."""
        info: dict[str, Any] = place.fs.info(place.path)
        if info["size"] != self.size:
            raise ConfigError(f"the store holds {info['size']} bytes", where=place, expected=str(self.size))
        return str(info.get("ETag", ""))

    def discard(self) -> None:
        """Aborts the upload and removes the temporary object, as far as the store can be reached."""
        if self.file is None:
            return
        with suppress(AttributeError):  # else the file would complete the upload when it is collected; some have no such way
            self.file.closed = True
        with suppress(Exception):
            self.file.discard()
        with suppress(Exception):  # it is there if the upload was complete, or an answer was lost on its way
            self._remove_temporary()
