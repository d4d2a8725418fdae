"""Index of a log that may be damaged: what a CRC proves; `losses` lists the rest.

An intact log is read by its index. At the first thing that contradicts the index, it is read by its records instead (`Scan`):
the index then only helps to put damaged chunk heads right, and tells which chunks are gone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Header

from imutool.array_types import UInt64
from imutool.errors import LogError
from imutool.mcap_io.blocks import HEAD_BYTES, Attachment, MessageBlock, RecordSpan
from imutool.mcap_io.codec import messages, records
from imutool.mcap_io.codec.records import CHUNK_HEAD, HEAD, MAGIC
from imutool.mcap_io.index import CONVERT, LogIndex
from imutool.mcap_io.recovery.chunk_repair import find_definitions
from imutool.mcap_io.recovery.definitions import map_channels, parsed, remap, renumber, renumber_counts, unproven_topics
from imutool.mcap_io.recovery.losses import LATEST_NS, Loss, Losses, reason
from imutool.mcap_io.recovery.lost_messages import counts_by_size, really_lost
from imutool.mcap_io.recovery.recording_of_block import Recordings
from imutool.mcap_io.recovery.scan import Scan
from imutool.mcap_io.recovery.scan_events import Gap, ScannedBlock
from imutool.mcap_io.recovery.summary import proven_summary
from imutool.mcap_io.storage.source import Source
from imutool.processes.system import collector_paused

MAX_SEARCHED = 1 << 20  # bytes of a damaged stretch in which definitions are sought


class RecoveredIndex(LogIndex):
    """Index of a file that may be damaged; `losses` grows while chunks are read.

    With `by_records` the index is not believed from the start, and all damage is known at once.

    Raises:
        LogError: nothing in the file can be recovered.
    """

    def __init__(self, source: Source, max_chunk: int = records.MAX_CHUNK, *, by_records: bool = False) -> None:
        self.losses, self.by_records = Losses(), by_records
        self.proven = self._ready = False  # by the CRC of the data section; with an index that nothing contradicts so far
        self._repaired: dict[int, bytes] = {}  # heads of chunks as their contents prove them
        self._lost_spans: set[int] = set()
        self._stated: dict[int, int] = {}  # counts of an intact log
        self._listed: dict[int, ChunkIndex] = {}  # until the heads are compared
        with collector_paused():
            super().__init__(source, max_chunk)

    def _read(self) -> None:
        contradiction = ""
        if not self.by_records:
            try:
                super()._read()
                if self.footer.summary_crc and self.footer.summary_start:
                    self._compare_heads()
                    self._stated, self._ready, self._listed = super().counts(), True, {}
                    return
            except LogError as error:
                contradiction = reason(error)
        self.by_records, self.losses, self.statistics = True, Losses(), None
        self._read_records()
        if self.losses.intact and contradiction:
            self.losses.add_harmless(contradiction)
        self.sort()

    def _read_summary(self) -> dict[int, ChunkIndex]:
        self._listed = super()._read_summary()
        return self._listed

    def _compare_heads(self) -> None:
        """Compares every chunk's head with the summary.

        Not in a store, where that would fetch the whole log.

        Raises:
            LogError: they contradict each other.
        """
        if not isinstance(self.source.path, Path):
            return
        seen = set[int]()
        for block in self.blocks:
            if block.compression is not None:
                entry = self._listed.get(block.offset)
                head = block.head(self.source.at(block.offset, min(block.length, HEAD_BYTES)))
                size = entry.uncompressed_size if entry else head.size
                if head[:3] != (block.start_ns, block.end_ns, size) or head.compression != block.compression:
                    raise LogError(f"the summary lists the chunk at byte {block.offset} otherwise than it is")
                if head.crc and hash(head) in seen:
                    raise LogError(f"the chunk at byte {block.offset} may repeat another")
                seen.add(hash(head))

    @property
    def header_bytes(self) -> bytes:
        """The bytes of the Header record, rebuilt where it is lost."""
        return records.build(self.header)

    def counts(self) -> dict[int, int]:
        """Messages per channel id that are not lost so far."""
        if not self.losses and not self.by_records:
            return dict(self._stated)
        return self.summed_counts()

    def read(self, block: MessageBlock) -> bytes:
        """The bytes of a block, with a damaged chunk head repaired.

        Raises:
            LogError: too large, or the disk does not give them.
        """
        raw = super().read(block)
        better = self._repaired.get(block.offset, b"")
        return better + raw[len(better) :]

    def unpack_bytes(self, block: MessageBlock, raw: bytes) -> messages.Messages:
        """The messages of a block whose channel is defined and whose time is possible."""
        if not self.by_records:
            found = super().unpack_bytes(block, raw)
            times = found.times()
            if len(times) and (block.start_ns, block.end_ns) != (span := messages.span(times)):
                self.losses.add_harmless(f"the times of the chunk at byte {block.offset} are not those of its messages")
                block.start_ns, block.end_ns = span
        else:
            found = self._parse(block, raw)
        crc = 0 if block.compression is None else CHUNK_HEAD.unpack_from(raw, HEAD.size)[3]
        if not crc and len(found.heads) and not self.proven:
            self.losses.unchecked_in[block.offset] = len(found.heads)
        if self._ready and not crc and not set(found.heads["channel"].tolist()) <= self.channels.keys():
            raise LogError(f"the chunk at byte {block.offset} has messages of channels that no record defines")
        return self._readable(block, found) if self.by_records else found

    def entries(self, block: MessageBlock, channel: int) -> UInt64[np.ndarray, "n 2"]:
        """The entries of a message index; none where it is damaged, since the chunk says the same."""
        try:
            return super().entries(block, channel)
        except LogError as error:
            if not self._ready:
                raise
            self.losses.add_harmless(error.what)
            return np.zeros((0, 2), np.uint64)

    def check(self) -> None:
        """Compares the CRC of every attachment, and of every chunk that was not unpacked yet; then chunks are in order."""
        if not self.by_records:
            super().check()
            return
        for item in self.items:
            if isinstance(item, RecordSpan) and item.opcode == Opcode.ATTACHMENT:
                try:
                    Attachment.of(self.source, item.offset, item.length - HEAD.size).check_crc(self.source)
                except LogError as error:
                    self.lose(item, error)
        self.sort()

    def lose(self, item: MessageBlock | RecordSpan, error: LogError) -> None:
        """Leaves a part of the log out from now on, and lists it in `losses`."""
        if isinstance(item, RecordSpan):
            if item.offset not in self._lost_spans:
                self._lost_spans.add(item.offset)
                self.losses.add(Loss(item.offset, item.length, reason(error), exact=True))
        elif not item.lost:
            item.lost = True
            self.losses.unchecked_in.pop(item.offset, None)
            counts = item.counts or counts_by_size(item.indexes, item.end)
            times = (item.start_ns, item.end_ns) if item.start_ns <= item.end_ns < LATEST_NS else (None, None)
            self.losses.add(Loss(item.offset, item.length, reason(error), self._by_topic(counts), bool(counts), *times))

    # ── by records ───────────────────────────────────────────────────────────────────────────────────────────────────

    def _read_records(self) -> None:
        """Builds the index from the records alone."""
        self.footer, summary = proven_summary(self.source, self.losses)
        listed = {} if summary is None else {entry.chunk_start_offset: entry for entry in summary.chunks}
        limit = self.source.size if summary is None else self.footer.summary_start
        scan = Scan(self.source, limit, listed, self.losses, self.max_chunk)
        for opcode, body in [] if summary is None else summary.definitions:
            scan.used_channels |= {int.from_bytes(body[:2], "little")} if opcode == Opcode.CHANNEL else set()
        scan.run()
        self._repaired, self.items = scan.repaired, scan.items
        self.data_end = scan.data_ends[0] if len(scan.data_ends) == 1 else self.source.size
        self._drop_doubtful(scan)
        summaries = ([] if summary is None else [summary]) + scan.summaries
        self.recordings = Recordings(summaries, self.losses, lambda block: self._parse(block, self.read(block)))
        kept = {id(item) for item in self.items}
        self.recordings.assign([e for e in scan.events if not isinstance(e, ScannedBlock) or id(e.block) in kept])
        self.recordings.drop_copies([e for e in scan.events if isinstance(e, ScannedBlock)])
        self._search_definitions(scan)
        self.schemas, self.channels = renumber(self.recordings.each, self.blocks, self.losses)
        self.losses.unchecked_topics = unproven_topics(self.recordings.each)
        for gap in really_lost(scan, self.blocks, summaries, self.losses):
            self._add_gap(gap)
        unchecked = {e.block.offset for e in scan.events if isinstance(e, ScannedBlock) and not e.crc}
        spans = {id(e.block): e.times for e in scan.events if isinstance(e, ScannedBlock)}
        for block in self.blocks:
            self._edit(block, spans[id(block)])
            if block.offset in unchecked and block.counts:
                self.losses.unchecked_in[block.offset] = sum(block.counts.values())
        self._set_header(scan)

    def _drop_doubtful(self, scan: Scan) -> None:
        """Drops messages after a gap in a chunked log: unproven contents of a damaged chunk."""
        if not any(block.compression is not None for block in self.blocks):
            return
        dropped = {id(block) for block, _ in scan.doubtful}
        for block, gap in scan.doubtful:
            gap.length = max(gap.length, block.offset + block.length - gap.offset)
            if not gap.counted:
                gap.counts.update(block.counts or {})
        self.items = [item for item in self.items if id(item) not in dropped]

    def _parse(self, block: MessageBlock, raw: bytes) -> messages.Messages:
        contents = raw if block.compression is None else records.unpack(raw, block.offset, self.max_chunk)
        return messages.parse(contents, block.offset)

    def _search_definitions(self, scan: Scan) -> None:
        """Looks for missing definitions in the damaged stretches of the log."""
        used: dict[int, set[int]] = {}
        for block in self.blocks:
            used.setdefault(block.recording, set()).update(block.counts or {})
        for number, ids in used.items():
            recording = self.recordings.each[number]
            for gap in scan.gaps:
                if ids <= recording.readable():
                    break
                raw = self.source.at(gap.offset, min(gap.length, MAX_SEARCHED))
                for record in parsed(find_definitions(raw), gap.offset, self.losses):
                    if recording.agrees([record]):
                        recording.define(record, proven=False)

    def _add_gap(self, gap: Gap) -> None:
        topics = self._by_topic({self.recordings.each[gap.recording].ids.get(i, -1 - i): n for i, n in gap.counts.items()})
        self.losses.add(Loss(gap.offset, gap.length, gap.reason, topics, gap.counted, gap.start_ns, gap.end_ns))

    def _by_topic(self, counts: dict[int, int]) -> dict[str, int]:
        found: Counter[str] = Counter()
        for channel, count in counts.items():
            known = self.channels.get(channel)
            found[known.topic if known else f"(channel {-1 - channel if channel < 0 else channel}, not defined)"] += count
        return dict(found)

    def _edit(self, block: MessageBlock, spans: Mapping[int, tuple[int, int]]) -> None:
        """Counts by the channel ids of the whole file; lists messages without a topic as lost."""
        local, recording = block.counts or {}, self.recordings.of(block)
        unproven = self.recordings.unproven.get(block.offset, {})
        if lost := sum((Counter({f"({names})": local.get(i, 0)}) for i, names in unproven.items()), Counter[str]()):
            why = "messages here are of one of several recordings, and nothing proves of which"
            self.losses.add(Loss(block.offset, 0, why, dict(lost), True, block.start_ns, block.end_ns))
            self.losses.unproven += sum(lost.values())
        undefined = {-1 - i: n for i, n in local.items() if i not in recording.ids}
        if undefined:
            why = "messages in the chunk here have channels that no record defines"
            self.losses.add(Loss(block.offset, block.length, why, self._by_topic(undefined), True))
        block.counts = renumber_counts(recording, {i: n for i, n in local.items() if i not in unproven})
        kept = [span for i, span in spans.items() if i in recording.ids and i not in unproven]
        if kept:  # by these the chunks are put in order
            block.start_ns, block.end_ns = min(first for first, _ in kept), max(last for _, last in kept)

    def _readable(self, block: MessageBlock, found: messages.Messages) -> messages.Messages:
        """The messages of defined channels at possible times, by the channel ids of the whole file."""
        mapped = map_channels(self.recordings.of(block), self.recordings.unproven.get(block.offset, {}), found)
        if mapped is None:
            return found
        channels, keep = mapped
        late = found.heads["log_time"] >= LATEST_NS
        if late.any() and not block.edited:
            lost = Counter(channels[late].tolist())
            self.losses.add(Loss(block.offset, 0, "messages here have log times no clock shows", self._by_topic(lost), True))
            block.counts = dict(Counter(channels[keep].tolist()))
        block.edited = True
        return remap(found, keep, channels[keep])

    def sort(self) -> None:
        """Puts the chunks of a damaged log in order of log time, each with the records behind it."""
        keys, last = [], -1
        for item in self.items:
            last = item.start_ns if isinstance(item, MessageBlock) and item.counts != {} else last
            keys.append(last)
        if not self.losses.intact and any(a > b for a, b in pairwise(keys)):
            self.losses.add_harmless("the chunks are not in order of log time; they are put in order")
            self.items = [self.items[i] for i in sorted(range(len(keys)), key=keys.__getitem__)]

    def _set_header(self, scan: Scan) -> None:
        header = scan.header
        if not self.items and header is None and not self.channels:
            raise LogError("this is not an MCAP log: no record of one is in it", expected="an MCAP log", fix=CONVERT)
        if header is None:
            encodings = {channel.message_encoding for channel in self.channels.values()}
            profile = {"cdr": "ros2", "ros1": "ros1"}.get(next(iter(encodings)), "") if len(encodings) == 1 else ""
            header = Header(profile=profile, library="")
            self.losses.add_harmless(f"the Header is lost; the profile is {profile!r} by the messages' encoding")
        self.header = header
        self.header_end = len(MAGIC) + len(self.header_bytes)
