"""Read a damaged log: what is intact of it, and a list of what is lost."""

from __future__ import annotations

import numpy as np
from mcap.opcode import Opcode

from imutool.mcap_io.blocks import MessageBlock, RecordSpan
from imutool.mcap_io.log import Log
from imutool.mcap_io.recovery.losses import Loss, Losses
from imutool.mcap_io.recovery.recovered_index import RecoveredIndex
from imutool.mcap_io.recovery.summary import PRIVATE
from imutool.mcap_io.storage.source import Source, crc_of
from imutool.mcap_io.verify import stated_crc


class RecoveredLog(Log):
    """A log that may be damaged: reads what a CRC proves, and lists the rest in `losses`.

    `losses` is complete once everything was read (`check`), because damage inside a chunk shows when the chunk is unpacked.

    Raises:
        ConfigError: the file cannot be opened.
        LogError: nothing in the file can be recovered.
    """

    index: RecoveredIndex

    def _read_index(self, source: Source) -> RecoveredIndex:
        return RecoveredIndex(source, self.max_chunk)

    def __enter__(self) -> RecoveredLog:
        return self

    @property
    def losses(self) -> Losses:
        """Losses so far; none of an intact log."""
        return self.index.losses

    def strict(self) -> Log:
        """The same log over the same open file, where damage is an error; it closes the file.

        Raises:
            LogError: the log is damaged.
        """
        log = Log(self._source, max_chunk=self.max_chunk)
        self._owns_source = False
        return log

    def check(self) -> None:
        """Compares the CRC of every chunk, attachment and of the data section; completes `losses`."""
        with self.named():
            self.index.check()
            if self.losses and not self.index.by_records:
                self.read_by_records()
            self.check_data_crc()

    def read_by_records(self) -> None:
        """Reads the log again by its records, because its index contradicts them."""
        with self.named():
            self.index = RecoveredIndex(self._source, self.max_chunk, by_records=True)
            self.index.check()
            self._read_topics()

    def check_data_crc(self) -> None:
        """Compares the CRC of the data section, where one is stated and no damage is known yet.

        A right CRC also covers what no other CRC does.
        """
        index, losses = self.index, self.losses
        if losses or index.proven or index.data_end == index.source.size:
            return
        stated = stated_crc(index)
        crc = crc_of(index.source, 0, index.data_end if stated else 0)
        if stated and crc == stated:
            index.proven = True
            losses.unchecked_in.clear()
            losses.unchecked_topics.clear()
        elif stated:
            self._explain(f"the data section has CRC {crc:08x}, expected {stated:08x}")

    def _explain(self, mismatch: str) -> None:
        """Finds the damage: a chunk, an index against its chunk, or bytes that no other CRC covers."""
        index, losses = self.index, self.losses
        index.check()
        if losses:
            return
        wrong = [block.offset for block in index.blocks if block.indexes and not self._indexes_match(block)]
        for offset in wrong:
            losses.add_harmless(f"a message index of the chunk at byte {offset} is damaged; the chunk itself is sound")
        spans = [item for item in index.items if isinstance(item, RecordSpan)]
        uncovered = {"messages outside chunks" for block in index.blocks if block.compression is None}
        uncovered |= {"metadata" for span in spans if span.opcode == Opcode.METADATA}
        uncovered |= {"private records" for span in spans if span.opcode >= PRIVATE}
        if uncovered and not wrong and not losses.harmless:
            what = " or ".join(sorted(uncovered))
            losses.add(Loss(0, 0, f"{mismatch}: {what} may have changed, which no other CRC covers"))
        else:
            losses.add_harmless(mismatch)
        index.sort()

    def _indexes_match(self, block: MessageBlock) -> bool:
        """Whether the message indexes of a chunk list its messages."""
        found = self.index.unpack_or_lose(block)
        if found is None or block.edited:
            return True
        for channel in block.indexes:
            of_channel = found.heads["channel"] == channel
            listed = self.index.entries(block, channel)
            actual = np.column_stack([found.heads["log_time"][of_channel], found.offsets[of_channel].astype(np.uint64)])
            if listed.shape != actual.shape or not (listed[np.argsort(listed[:, 1])] == actual).all():
                return False
        return True
