"""The bytes of a log on their way into another: what is copied as it is, what is left out, and the CRC of all that went by."""

from __future__ import annotations

from imutool.mcap_io.codec.crc import crc32
from imutool.mcap_io.storage.source import Source
from imutool.mcap_io.storage.target import COPY_BYTES, Target
from imutool.mcap_io.verify import crc_of


class Passage:
    """A source passing into a target from its first byte to its last; what else is written there goes between its records."""

    def __init__(self, source: Source, target: Target) -> None:
        self.source, self.target = source, target
        self.copied = self.crc = 0  # bytes of the source so far, and their CRC if it states one
        self.upto = 0  # what lies between `copied` and here is to be copied, but not yet

    def verbatim(self, end: int) -> int:
        """Has the source copied up to here, now or later; returns by how much it moves."""
        self.upto = end
        return self.target.position - self.copied

    def settle(self) -> None:
        """Copies what was to be copied later."""
        start, end, out = self.copied, self.upto, self.target
        self.copied = end
        if not out.summing:
            out.copy(self.source, start, end)
            return
        for at in range(start, end, COPY_BYTES):  # read once for the CRC of the source and that of the copy
            raw = self.source.at(at, min(COPY_BYTES, end - at))
            self.crc = crc32(raw, self.crc)
            out.write(raw)

    def skip(self, end: int) -> None:
        """Leaves out the bytes of the source up to here, which are written in another form or not at all."""
        if self.target.summing:
            self.crc = crc_of(self.source, self.copied, end, self.crc)
        self.copied = self.upto = end

    def put(self, raw: memoryview) -> int:
        """Copies bytes that were read already; returns where they went."""
        self.settle()
        at = self.target.position
        if self.target.summing:
            self.crc = crc32(raw, self.crc)
        self.target.write(raw)
        self.copied = self.upto = self.copied + len(raw)
        return at
