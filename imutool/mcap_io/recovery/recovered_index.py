"""Index of a damaged log; keeps CRC-verified records, lists the rest in `losses`.

A CRC covers the summary and the contents of a chunk. Message indexes are used only as far as the summary lists them. `Scan`
follows the data section; two logs in one file are two sections with definitions of their own (`definitions`).
"""

from __future__ import annotations

from collections import Counter

import numpy as np
from jaxtyping import UInt64
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Footer, Header

from imutool.errors import LogError
from imutool.mcap_io.blocks import HEAD_BYTES, MessageBlock, RecordSpan
from imutool.mcap_io.codec import messages, records
from imutool.mcap_io.codec.records import FOOTER_SIZE, HEAD, MAGIC
from imutool.mcap_io.index import LogIndex
from imutool.mcap_io.recovery import definitions
from imutool.mcap_io.recovery.chunk_repair import is_consistent, repair_head
from imutool.mcap_io.recovery.definitions import DEFINITIONS, Sections
from imutool.mcap_io.recovery.losses import LATEST_NS, Loss, Losses, reason
from imutool.mcap_io.recovery.resync import Gap
from imutool.mcap_io.recovery.scan import Scan
from imutool.mcap_io.storage.source import Source


class RecoveredIndex(LogIndex):
    """As `LogIndex`, for a file that may be damaged; `losses` grows while chunks are read.

    Without a summary that a CRC covers, every chunk is unpacked at once, because only that proves it.

    Raises:
        LogError: nothing in the file can be recovered.
    """

    def __init__(self, source: Source) -> None:
        self.losses, self.sections = Losses(), Sections()
        self._summary: dict[int, ChunkIndex] = {}  # chunk indexes of an intact summary
        self._summary_intact = False
        self._failed: list[tuple[MessageBlock, LogError]] = []
        self._lost_spans: set[int] = set()
        self._repaired_heads: set[int] = set()
        self._agreed: set[bytes] = set()  # definitions that contradict nothing
        self.proven = False  # all of it, by the CRC of the data section
        super().__init__(source)

    @property
    def header_bytes(self) -> bytes:
        """The bytes of the Header record, rebuilt where it is lost."""
        return records.build(self.header)

    def counts(self) -> dict[int, int]:
        """Messages per channel id that are not lost so far."""
        if self.statistics is not None and not self.losses:
            return dict(self.statistics.channel_message_counts)
        return self._total()

    def _total(self) -> dict[int, int]:
        total: Counter[int] = Counter()
        for block in self.blocks:
            if block.counts is None and block.trusted and block.indexes:
                block.counts = _counts_by_size(block)
            if block.counts is None and (found := self.unpack_or_lose(block)) is not None:
                block.counts = dict(Counter(found.heads["channel"].tolist()))
            total.update(block.counts or {})
        return dict(total)

    def read(self, block: MessageBlock) -> bytes:
        """The bytes of a block, with a damaged chunk head repaired.

        Raises:
            LogError: the disk does not give them.
        """
        raw = super().read(block)
        if block.compression is None:
            return raw
        better = repair_head(raw, block.offset, self._summary.get(block.offset))
        if better is None:
            return raw
        self._repaired_heads.add(block.offset)
        return better

    def unpack_bytes(self, block: MessageBlock, raw: bytes) -> messages.Messages:
        """The messages of a block whose channel is defined and whose time is possible."""
        return self._readable(block, self._unpack_bytes(block, raw))

    def entries(self, block: MessageBlock, channel: int) -> UInt64[np.ndarray, "n 2"]:
        """The entries of a message index; none where it is damaged, since the chunk says the same."""
        try:
            return super().entries(block, channel)
        except LogError as error:
            self.losses.add_harmless(error.what)
            return np.zeros((0, 2), np.uint64)

    def lose(self, item: MessageBlock | RecordSpan, error: LogError) -> None:
        """Leaves a part of the log out from now on, and lists it in `losses`."""
        if isinstance(item, RecordSpan):
            if item.offset not in self._lost_spans:
                self._lost_spans.add(item.offset)
                self.losses.add(Loss(item.offset, item.length, reason(error), exact=True))
        elif not item.lost:
            item.lost = True
            self.losses.unchecked_in.pop(item.offset, None)
            counts, exact = self._counts_of_lost(item)
            times = (item.start_ns, item.end_ns) if item.start_ns <= item.end_ns < LATEST_NS else (None, None)
            self.losses.add(Loss(item.offset, item.length, reason(error), self._by_topic(counts), exact, *times))

    def define(self, opcode: int, body: bytes, offset: int) -> None:
        """Takes in a Schema or Channel record that a CRC covers.

        Raises:
            LogError: damaged, or a CRC covers another definition of that id as well.
        """
        if opcode in DEFINITIONS:
            conflict = self.sections.define(opcode, body, offset, proven=True)
            if conflict:
                self.losses.add_harmless(conflict)

    # ── building the index ───────────────────────────────────────────────────────────────────────────────────────────

    def _read_footer(self) -> Footer:
        source = self.source
        if source.size == 0:
            raise LogError("the file is empty", expected="an MCAP log")
        missing = Footer(summary_start=0, summary_offset_start=0, summary_crc=0)
        at = source.size - len(MAGIC) - FOOTER_SIZE
        if at < len(MAGIC) or source.at(source.size - len(MAGIC), len(MAGIC)) != MAGIC:
            return missing
        if source.head(at) != (Opcode.FOOTER, FOOTER_SIZE - HEAD.size):
            return missing
        footer: Footer = records.parse(Footer, source.at(at + HEAD.size, FOOTER_SIZE - HEAD.size), at)
        return footer

    def _read_summary(self) -> dict[int, ChunkIndex]:
        if not self.footer.summary_crc:
            return {}  # nothing proves it; the scan meets its records as it meets others
        try:
            self._summary = super()._read_summary()
        except LogError as error:
            self.losses.add_harmless(f"{reason(error)}; a new summary can be made")
            self.sections, self.statistics = Sections(), None
            return {}
        self._summary_intact = self.footer.summary_start > 0
        return self._summary

    def _scan_data_section(self, chunks: dict[int, ChunkIndex]) -> int:
        limit = self.footer.summary_start if self._summary_intact else self.source.size
        self._scan = Scan(self.source, limit, chunks, self.sections, self.losses)
        self._scan.run()
        self.items = self._scan.items
        return self._scan.data_end

    def _find_definitions(self) -> None:
        stated, first = self.statistics, self.sections.each[0]
        lacking = stated is None or (stated.channel_count, stated.schema_count) != (len(first.channels), len(first.schemas))
        if any(block.compression is not None for block in self.blocks):
            self._drop_doubtful()
        for block in self.blocks:
            if lacking or not block.trusted:
                self._read_definitions(block)
        damaged = [(block.offset, block.length) for block, _ in self._failed]
        damaged += [(gap.offset, gap.length) for gap in self._scan.gaps]
        definitions.search_damaged(self.sections, self.source, self.blocks, damaged)
        self.schemas, self.channels = self.sections.renumber()
        self.losses.unchecked_topics = self.sections.unproven_topics()
        for old, new in ((old, new) for section in self.sections.each for old, new in section.renamed.items()):
            self.losses.add_harmless(f"{old} carries messages of two types; those of the second are on {new}")
        for block in self.blocks:
            if block.counts is not None:
                block.counts = definitions.renumber_counts(self.sections.at(block.offset), block.counts)
        for block, error in self._failed:
            self.lose(block, error)
        for gap in self._scan.gaps:
            self._add_gap(gap)
        self._set_header()
        if stated is not None and not self.losses and all(block.counts is not None for block in self.blocks):
            missing = Counter(stated.channel_message_counts) - Counter(self._total())
            if missing:
                why = "the statistics of the log count messages that are not there"
                self.losses.add(Loss(0, 0, why, self._by_topic(missing), exact=True))
        del self._scan, self._failed

    def _drop_doubtful(self) -> None:
        """Drops messages after a gap in a chunked log: unproven contents of a damaged chunk."""
        dropped = {id(block) for block, _ in self._scan.doubtful}
        for block, gap in self._scan.doubtful:
            gap.length = max(gap.length, block.offset + block.length - gap.offset)
            if not gap.counted:
                raw = self.source.at(block.offset, block.length)
                gap.counts.update(messages.parse(raw, block.offset).heads["channel"].tolist())
        self.items = [item for item in self.items if id(item) not in dropped]

    def _read_definitions(self, block: MessageBlock) -> None:
        """Definitions, counts and times of a block, by unpacking it."""
        try:
            found = self._unpack_bytes(block, self.read(block))
        except LogError as error:
            self._failed.append((block, error))
            return
        definitions.read_definitions(self.sections, self.losses, found, block)
        good = found.heads[found.heads["log_time"] < LATEST_NS]
        block.counts = dict(Counter(found.heads["channel"].tolist()))
        if len(good):
            block.start_ns, block.end_ns = int(good["log_time"].min()), int(good["log_time"].max())

    def _set_header(self) -> None:
        header = self._scan.header
        if not self.items and header is None and not self.sections.channels():
            raise LogError("this is not an MCAP log: no record of one is in it", expected="an MCAP log")
        if header is None:
            encodings = {channel.message_encoding for channel in self.channels.values()}
            profile = {"cdr": "ros2", "ros1": "ros1"}.get(next(iter(encodings)), "") if len(encodings) == 1 else ""
            header = Header(profile=profile, library="")
            self.losses.add_harmless(f"the Header is lost; the profile is {profile!r} by the messages' encoding")
        self.header = header
        self.header_end = len(MAGIC) + len(self.header_bytes)

    def _add_gap(self, gap: Gap) -> None:
        ids = self.sections.at(gap.offset).ids
        counts = Counter({ids.get(local, -1 - local): count for local, count in gap.counts.items()})
        self.losses.add(Loss(gap.offset, gap.length, gap.reason, self._by_topic(counts), gap.counted, gap.start_ns, gap.end_ns))

    def _by_topic(self, counts: dict[int, int]) -> dict[str, int]:
        found: Counter[str] = Counter()
        for channel, count in counts.items():
            known = self.channels.get(channel)
            found[known.topic if known else f"(channel {-1 - channel if channel < 0 else channel}, not defined)"] += count
        return dict(found)

    def _counts_of_lost(self, block: MessageBlock) -> tuple[dict[int, int], bool]:
        """Messages of a lost block, and whether their number is certain."""
        if block.counts is not None:
            return block.counts, True
        ids = self.sections.at(block.offset).ids
        counts = _counts_by_size(block)
        return {ids.get(local, -1 - local): count for local, count in counts.items()}, bool(counts)

    def _unpack_bytes(self, block: MessageBlock, raw: bytes) -> messages.Messages:
        """All messages of a block, proven by its CRC where it has one."""
        if block.compression is None:
            found, crc = messages.parse(raw, block.offset), 0
        else:
            found = messages.parse(records.unpack(raw, block.offset), block.offset)
            crc = records.ChunkHead.of(raw[:HEAD_BYTES], len(raw), block.offset).crc
            if not crc and not is_consistent(raw, block.offset, self._summary.get(block.offset)):
                raise LogError(f"the head of the chunk at byte {block.offset} is damaged, and it has no CRC to tell by")
        if not crc and len(found.heads) and not self.proven:
            self.losses.unchecked_in[block.offset] = len(found.heads)
        if block.offset in self._repaired_heads:
            self.losses.add_harmless(f"the head of the chunk at byte {block.offset} was damaged, and is repaired")
        return found

    def _readable(self, block: MessageBlock, found: messages.Messages) -> messages.Messages:
        """The messages of defined channels at possible times, by the channel ids of the whole file."""
        definitions.check_definitions(self.sections, found, block, self._agreed)
        mapped = definitions.map_channels(self.sections.at(block.offset), found)
        if mapped is None:
            return found
        channels, keep = mapped
        if not block.edited:
            block.edited = True
            dropped = Counter(
                int(new) if new >= 0 else -1 - int(old)
                for new, old in zip(channels[~keep], found.heads["channel"][~keep], strict=True)
            )
            if dropped:
                why = "channels that no record defines" if (channels < 0).any() else "log times no clock shows"
                self.losses.add(
                    Loss(block.offset, block.length, f"messages in the chunk here have {why}", self._by_topic(dropped), True)
                )
        return definitions.remap(found, keep, channels[keep])


def _counts_by_size(block: MessageBlock) -> dict[int, int]:
    """Messages per channel by index size: 15 bytes a message index, 16 a message."""
    if not block.indexes:
        return {}
    starts = sorted(block.indexes.items(), key=lambda item: item[1])
    ends = [offset for _, offset in starts[1:]] + [block.end]
    sizes = {channel: end - offset - 15 for (channel, offset), end in zip(starts, ends, strict=True)}
    return (
        {channel: size // 16 for channel, size in sizes.items()} if all(s >= 0 and s % 16 == 0 for s in sizes.values()) else {}
    )
