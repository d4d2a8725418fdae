"""An attachment's fields and CRC, without holding its data."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

from imutool.errors import LogError
from imutool.mcap_io.codec.records import HEAD
from imutool.mcap_io.storage.source import Source

BLOCK = 1 << 20
MOST_TEXT = 1 << 16  # bytes of a name or media type


@dataclass(frozen=True, slots=True)
class Attached:
    """What stands around the data of one Attachment record."""

    offset: int
    length: int  # of the whole record
    log_time: int
    create_time: int
    name: str
    media_type: str
    size: int

    @staticmethod
    def of(source: Source, offset: int, length: int) -> Attached:
        """The fields of the record that begins at `offset` and has `length` bytes behind its head.

        Raises:
            LogError: its lengths contradict one another.
        """
        at, end = offset + HEAD.size, offset + HEAD.size + length

        def part(size: int) -> bytes:
            nonlocal at
            if size > min(end - at, MOST_TEXT):
                raise LogError(f"the attachment at byte {offset} is damaged: its lengths contradict one another")
            at += size
            return source.at(at - size, size)

        def text() -> str:
            return part(struct.unpack("<I", part(4))[0]).decode(errors="replace")

        log_time, create_time = struct.unpack("<QQ", part(16))
        name, media_type = text(), text()
        (size,) = struct.unpack("<Q", part(8))
        if size + 4 != end - at:
            raise LogError(f"the attachment at byte {offset} is damaged: its data have {size} bytes")
        return Attached(offset, HEAD.size + length, log_time, create_time, name, media_type, size)

    def check(self, source: Source) -> bool:
        """Reads it all and compares its CRC; false if it states none.

        Raises:
            LogError: another CRC.
        """
        start, end = self.offset + HEAD.size, self.offset + self.length - 4
        stated, crc = struct.unpack("<I", source.at(end, 4))[0], 0
        if not stated:
            return False
        for at in range(start, end, BLOCK):
            crc = zlib.crc32(source.at(at, min(BLOCK, end - at)), crc)
        if crc != stated:
            raise LogError(f"the attachment at byte {self.offset} is damaged: its CRC is {crc:08x}", expected=f"{stated:08x}")
        return True
