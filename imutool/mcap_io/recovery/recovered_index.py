"""The chart of a log that may be damaged: everything in it that can still be proven, and what cannot is told.

Believed is what a CRC covers: a summary, the contents of a chunk. Message indexes are believed only as far as the summary
vouches for them. The data section is followed by `walk`; two logs in one file are two sections with definitions of their own
(`sections`), which `meaning` learns and goes by.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
from jaxtyping import UInt64
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, DataEnd, Footer, Header

from imutool.errors import LogError
from imutool.mcap_io.codec import records
from imutool.mcap_io.codec.crc import crc32
from imutool.mcap_io.codec.records import FOOTER_SIZE, HEAD, MAGIC
from imutool.mcap_io.index import RUN_BYTES, Block, LogIndex, Span
from imutool.mcap_io.losses import Loss, Losses
from imutool.mcap_io.recovery.chunk_repair import in_order, mended
from imutool.mcap_io.recovery.definitions import by_the_whole, counted, edited, learn, refuse_others, search
from imutool.mcap_io.recovery.resync import PRIVATE
from imutool.mcap_io.recovery.scan import LATEST_NS, Gap, Scan, reason
from imutool.mcap_io.sections import DEFINITIONS, Sections
from imutool.mcap_io.storage.source import Source


class RecoveredIndex(LogIndex):
    """As `LogIndex`, for a file that may be damaged; `losses` says what could not be used, and grows while chunks are read.

    Without a summary that a CRC vouches for, every chunk is unpacked at once, because only that proves it.

    Raises:
        LogError: there is nothing in the file that could be saved.
    """

    losses: Losses

    def __init__(self, source: Source) -> None:
        self.losses, self.sections = Losses(), Sections()
        self._known: dict[int, ChunkIndex] = {}  # chunks of a sound summary
        self._trusted = False  # there is one
        self._failed: list[tuple[Block, LogError]] = []
        self._lost_spans: set[int] = set()
        self._put_right: set[int] = set()
        self._agreed: set[bytes] = set()
        self._proven = False  # all of it, by the CRC of the data section
        super().__init__(source)

    # ── what callers use ─────────────────────────────────────────────────────────────────────────────────────────────

    @property
    def opening(self) -> bytes:
        """The bytes of the Header record, made anew where it is lost."""
        return records.build(self.header)

    def counts(self) -> dict[int, int]:
        """Messages per channel id, of what is not lost so far."""
        if self.statistics is not None and not self.losses:
            return dict(self.statistics.channel_message_counts)
        return self._total()

    def _total(self) -> dict[int, int]:
        total: Counter[int] = Counter()
        for block in self.blocks:
            if block.counts is None and block.vouched and block.indexes:
                block.counts = _indexed(block)
            if block.counts is None and (found := self.found(block)) is not None:
                block.counts = dict(Counter(found.heads["channel"].tolist()))
            total.update(block.counts or {})
        return dict(total)

    def read(self, block: Block) -> bytes:
        """The bytes of a block, the head of a chunk put right where that is what is damaged.

        Raises:
            LogError: the disk does not give them.
        """
        raw = super().read(block)
        if block.compression is None:
            return raw
        better = mended(raw, block.offset, self._known.get(block.offset))
        if better is None:
            return raw
        self._put_right.add(block.offset)
        return better

    def unpacked(self, block: Block, raw: bytes) -> records.Messages:
        """The messages of a block that mean something: those of channels that are defined, at times that can be."""
        return self._fitted(block, self._opened(block, raw))

    def index(self, block: Block, channel: int) -> UInt64[np.ndarray, "n 2"]:
        """The entries of a message index; none where it is damaged, since the chunk itself says the same."""
        try:
            return super().index(block, channel)
        except LogError as error:
            self.losses.mend(error.what)
            return np.zeros((0, 2), np.uint64)

    def lose(self, item: Block | Span, error: LogError) -> None:
        """Leaves a part of the log out from now on, and remembers why."""
        if isinstance(item, Span):
            if item.offset not in self._lost_spans:
                self._lost_spans.add(item.offset)
                self.losses.add(Loss(item.offset, item.length, reason(error), exact=True))
        elif not item.lost:
            item.lost = True
            self.losses.unchecked_in.pop(item.offset, None)
            counts, exact = self._known_of(item)
            times = (item.start_ns, item.end_ns) if item.start_ns <= item.end_ns < LATEST_NS else (None, None)
            self.losses.add(Loss(item.offset, item.length, reason(error), self._by_topic(counts), exact, *times))

    def check(self) -> None:
        """Reads every chunk and attachment, and compares its CRC and that of the data section."""
        super().check()
        self.prove()

    def prove(self) -> None:
        """Compares the CRC of the data section, where one is stated and nothing is known to be damaged yet.

        If it is right, it covers also what no other CRC does.
        """
        if self.losses or self._proven or self.data_end == self.source.size:
            return
        stated = records.parse(DataEnd, self.source.at(self.data_end + HEAD.size, 4), self.data_end).data_section_crc
        crc = 0
        for at in range(0, self.data_end if stated else 0, RUN_BYTES):
            crc = crc32(self.source.at(at, min(RUN_BYTES, self.data_end - at)), crc)
        if stated and crc == stated:
            self._proven = True
            self.losses.unchecked_in.clear()
            self.losses.unproven.clear()
        elif stated:
            self._explain(f"the data section has CRC {crc:08x}, expected {stated:08x}")

    def _explain(self, said: str) -> None:
        """What was changed: a chunk, or an index that can be held against one, or else what no other CRC covers."""
        super().check()
        if self.losses:
            return
        wrong = [block.offset for block in self.blocks if block.indexes and not self._indexes_match(block)]
        for offset in wrong:
            self.losses.mend(f"a message index of the chunk at byte {offset} is damaged; the chunk itself is sound")
        loose = {"messages outside chunks" for block in self.blocks if block.compression is None}
        loose |= {"metadata" for item in self.items if isinstance(item, Span) and item.opcode == Opcode.METADATA}
        loose |= {"private records" for item in self.items if isinstance(item, Span) and item.opcode >= PRIVATE}
        if loose and not wrong and not self.losses.mended:
            self.losses.add(Loss(0, 0, f"{said}: {' or '.join(sorted(loose))} may have changed, which no other CRC covers"))
        else:
            self.losses.mend(said)

    def _indexes_match(self, block: Block) -> bool:
        """Whether the message indexes of a chunk list what is in it."""
        found = self.found(block)
        if found is None or block.edited:
            return True
        for channel in block.indexes:
            mine = found.heads["channel"] == channel
            listed = self.index(block, channel)
            actual = np.column_stack([found.heads["log_time"][mine], found.offsets[mine].astype(np.uint64)])
            if listed.shape != actual.shape or not (listed[np.argsort(listed[:, 1])] == actual).all():
                return False
        return True

    def define(self, opcode: int, body: bytes, offset: int) -> None:
        """Takes in a Schema or Channel record that a CRC covers.

        Raises:
            LogError: damaged, or another definition of that id is vouched for as well.
        """
        if opcode in DEFINITIONS:
            said = self.sections.define(opcode, body, offset, vouched=True)
            if said:
                self.losses.mend(said)

    # ── how the chart comes about ────────────────────────────────────────────────────────────────────────────────────

    def _ends(self) -> Footer:
        source = self.source
        if source.size == 0:
            raise LogError("the file is empty", expected="an MCAP log")
        nothing = Footer(summary_start=0, summary_offset_start=0, summary_crc=0)
        at = source.size - len(MAGIC) - FOOTER_SIZE
        if at < len(MAGIC) or source.at(source.size - len(MAGIC), len(MAGIC)) != MAGIC:
            return nothing
        if source.head(at) != (Opcode.FOOTER, FOOTER_SIZE - HEAD.size):
            return nothing
        footer: Footer = records.parse(Footer, source.at(at + HEAD.size, FOOTER_SIZE - HEAD.size), at)
        return footer

    def _summary(self) -> dict[int, ChunkIndex]:
        if not self.footer.summary_crc:
            return {}  # nobody can say what it is worth; its records are met on the way, as others are
        try:
            self._known = super()._summary()
        except LogError as error:
            self.losses.mend(f"{reason(error)}; a new summary can be made")
            self.sections, self.statistics = Sections(), None
            return {}
        self._trusted = self.footer.summary_start > 0
        return self._known

    def _chart(self, index: dict[int, ChunkIndex]) -> int:
        limit = self.footer.summary_start if self._trusted else self.source.size
        self._walk = Scan(self.source, limit, index, self.sections, self.losses)
        self._walk.run()
        self.items = self._walk.items
        return self._walk.data_end

    def _complete(self) -> None:
        told, first = self.statistics, self.sections.each[0]
        lacking = told is None or (told.channel_count, told.schema_count) != (len(first.channels), len(first.schemas))
        if any(block.compression is not None for block in self.blocks):
            self._give_up_doubtful()
        for block in self.blocks:
            if lacking or not block.vouched:
                self._learn(block)
        damaged = [(block.offset, block.length) for block, _ in self._failed]
        damaged += [(gap.offset, gap.length) for gap in self._walk.gaps]
        search(self.sections, self.source, self.blocks, damaged)
        self.schemas, self.channels = self.sections.number()
        self.losses.unproven = self.sections.unproven()
        for old, new in ((old, new) for section in self.sections.each for old, new in section.renamed.items()):
            self.losses.mend(f"{old} carries messages of two types; those of the second are on {new}")
        for block in self.blocks:
            if block.counts is not None:
                block.counts = counted(self.sections.at(block.offset), block.counts)
        for block, error in self._failed:
            self.lose(block, error)
        for gap in self._walk.gaps:
            self._close(gap)
        self._settle_header()
        if told is not None and not self.losses and all(block.counts is not None for block in self.blocks):
            missing = Counter(told.channel_message_counts) - Counter(self._total())
            if missing:
                why = "the statistics of the log count messages that are not there"
                self.losses.add(Loss(0, 0, why, self._by_topic(missing), exact=True))
        del self._walk, self._failed

    def _give_up_doubtful(self) -> None:
        """In a log with chunks, messages found behind a gap are the insides of a damaged chunk, which nothing proves."""
        dropped = {id(block) for block, _ in self._walk.doubtful}
        for block, gap in self._walk.doubtful:
            gap.length = max(gap.length, block.offset + block.length - gap.offset)
            if not gap.counted:
                raw = self.source.at(block.offset, block.length)
                gap.counts.update(records.messages(raw, block.offset).heads["channel"].tolist())
        self.items = [item for item in self.items if id(item) not in dropped]

    def _learn(self, block: Block) -> None:
        """What a block holds, by unpacking it."""
        try:
            found = self._opened(block, self.read(block))
        except LogError as error:
            self._failed.append((block, error))
            return
        learn(self.sections, self.losses, found, block)
        good = found.heads[found.heads["log_time"] < LATEST_NS]
        block.counts = dict(Counter(found.heads["channel"].tolist()))
        if len(good):
            block.start_ns, block.end_ns = int(good["log_time"].min()), int(good["log_time"].max())

    def _settle_header(self) -> None:
        header = self._walk.header
        if not self.items and header is None and not self.sections.channels():
            raise LogError("this is not an MCAP log: no record of one is in it", expected="an MCAP log")
        if header is None:
            encodings = {channel.message_encoding for channel in self.channels.values()}
            profile = {"cdr": "ros2", "ros1": "ros1"}.get(next(iter(encodings)), "") if len(encodings) == 1 else ""
            header = Header(profile=profile, library="")
            self.losses.mend(f"the Header is lost; the profile is {profile!r} by the messages' encoding")
        self.header = header
        self.header_end = len(MAGIC) + len(self.opening)

    def _close(self, gap: Gap) -> None:
        ids = self.sections.at(gap.offset).ids
        counts = Counter({ids.get(local, -1 - local): count for local, count in gap.counts.items()})
        self.losses.add(Loss(gap.offset, gap.length, gap.reason, self._by_topic(counts), gap.counted, gap.start_ns, gap.end_ns))

    def _by_topic(self, counts: dict[int, int]) -> dict[str, int]:
        found: Counter[str] = Counter()
        for channel, count in counts.items():
            known = self.channels.get(channel)
            found[known.topic if known else f"(channel {-1 - channel if channel < 0 else channel}, not defined)"] += count
        return dict(found)

    def _known_of(self, block: Block) -> tuple[dict[int, int], bool]:
        """Messages of a block that cannot be read, and whether that is certain."""
        if block.counts is not None:
            return block.counts, True
        ids = self.sections.at(block.offset).ids
        counts = _indexed(block)
        return {ids.get(local, -1 - local): count for local, count in counts.items()}, bool(counts)

    def _opened(self, block: Block, raw: bytes) -> records.Messages:
        """Everything in a block, proven by its CRC where it has one."""
        if block.compression is None:
            found, crc = records.messages(raw, block.offset), 0
        else:
            found = records.messages(records.unpack(raw, block.offset), block.offset)
            crc = records.ChunkHead.of(raw[:128], len(raw), block.offset).crc
            if not crc and not in_order(raw, block.offset, self._known.get(block.offset)):
                raise LogError(f"the head of the chunk at byte {block.offset} is damaged, and it has no CRC to tell by")
        if not crc and len(found.heads) and not self._proven:
            self.losses.unchecked_in[block.offset] = len(found.heads)
        if block.offset in self._put_right:
            self.losses.mend(f"the head of the chunk at byte {block.offset} was damaged, and is put right")
        return found

    def _fitted(self, block: Block, found: records.Messages) -> records.Messages:
        """The same without what nobody defines and no clock shows, by the ids of the whole."""
        refuse_others(self.sections, found, block, self._agreed)
        placed = by_the_whole(self.sections.at(block.offset), found)
        if placed is None:
            return found
        channels, keep = placed
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
        return edited(found, keep, channels[keep])


def _indexed(block: Block) -> dict[int, int]:
    """Messages per channel by where the message indexes lie: each has 15 bytes and 16 for every message."""
    if not block.indexes:
        return {}
    starts = sorted(block.indexes.items(), key=lambda item: item[1])
    ends = [offset for _, offset in starts[1:]] + [block.end]
    sizes = {channel: end - offset - 15 for (channel, offset), end in zip(starts, ends, strict=True)}
    return (
        {channel: size // 16 for channel, size in sizes.items()} if all(s >= 0 and s % 16 == 0 for s in sizes.values()) else {}
    )
