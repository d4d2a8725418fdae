"""Index of a log that may be damaged; keeps what a CRC proves, and lists the rest in `losses`.

An intact log is read by its index. At the first thing that contradicts the index, it is read by its records instead (`Scan`): the
index then only helps to put damaged chunk heads right, and tells which chunks are gone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt64
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Footer, Header

from imutool.errors import LogError
from imutool.mcap_io.blocks import HEAD_BYTES, Attachment, MessageBlock, RecordSpan
from imutool.mcap_io.codec import messages, records
from imutool.mcap_io.codec.records import CHUNK_HEAD, FOOTER_SIZE, HEAD, MAGIC, crc32
from imutool.mcap_io.codec.ros2_definition import decodes
from imutool.mcap_io.index import MAX_SUMMARY, LogIndex
from imutool.mcap_io.recovery.chunk_repair import find_definitions
from imutool.mcap_io.recovery.definitions import Recording, Recordings, map_channels, parsed, remap, renumber_counts
from imutool.mcap_io.recovery.losses import LATEST_NS, Loss, Losses, reason
from imutool.mcap_io.recovery.resync import Gap
from imutool.mcap_io.recovery.scan import Scan, ScannedBlock, Summary, parse_summary
from imutool.mcap_io.storage.source import Source

MAX_SEARCHED = 1 << 20  # bytes of a damaged stretch in which definitions are sought
SAMPLES = 4  # messages of a channel that must decode by a definition


class RecoveredIndex(LogIndex):
    """As `LogIndex`, for a file that may be damaged; `losses` grows while chunks are read.

    With `by_records` the index is not believed from the start, and all damage is known at once.

    Raises:
        LogError: nothing in the file can be recovered.
    """

    def __init__(self, source: Source, max_chunk: int = records.MAX_CHUNK, *, by_records: bool = False) -> None:
        self.losses, self.by_records = Losses(), by_records
        self.proven = False  # all of it, by the CRC of the data section
        self._repaired: dict[int, bytes] = {}  # heads of chunks as their contents prove them
        self._lost_spans: set[int] = set()
        self._stated: dict[int, int] = {}  # counts of an intact log
        self._ready = False
        super().__init__(source, max_chunk)

    def _read(self) -> None:
        if not self.by_records:
            try:
                super()._read()
                self._compare_heads()
                self._stated = super().counts()
                self._ready = True
                return
            except LogError as error:
                self.by_records, contradiction = True, reason(error)
        else:
            contradiction = ""
        self.losses, self.statistics = Losses(), None
        self._read_records()
        if self.losses.intact and contradiction:
            self.losses.add_harmless(contradiction)

    def _compare_heads(self) -> None:
        """Compares every chunk's head with the summary; not in a store, where that would fetch the whole log.

        Raises:
            LogError: they contradict each other.
        """
        if not isinstance(self.source.path, Path):
            return
        size, seen = HEAD.size + CHUNK_HEAD.size, set[int]()
        for block in self.blocks:
            if block.compression is not None:
                raw = self.source.at(block.offset, size)
                start_ns, end_ns, _, crc, _ = CHUNK_HEAD.unpack_from(raw, HEAD.size)
                stated = (*HEAD.unpack_from(raw), start_ns, end_ns)
                if stated != (Opcode.CHUNK, block.length - HEAD.size, block.start_ns, block.end_ns):
                    raise LogError(f"the summary lists the chunk at byte {block.offset} otherwise than it is")
                if crc and hash(raw) in seen:
                    raise LogError(f"the chunk at byte {block.offset} may repeat another")
                seen.add(hash(raw))

    @property
    def header_bytes(self) -> bytes:
        """The bytes of the Header record, rebuilt where it is lost."""
        return records.build(self.header)

    def counts(self) -> dict[int, int]:
        """Messages per channel id that are not lost so far."""
        if not self.losses and not self.by_records:
            return dict(self._stated)
        total: Counter[int] = Counter()
        for block in self.blocks:
            total.update(self._counts_of(block))
        return dict(total)

    def read(self, block: MessageBlock) -> bytes:
        """The bytes of a block, with a damaged chunk head repaired.

        Raises:
            LogError: too large, or the disk does not give them.
        """
        raw = super().read(block)
        better = self._repaired.get(block.offset)
        return raw if better is None else better + raw[len(better) :]

    def unpack_bytes(self, block: MessageBlock, raw: bytes) -> messages.Messages:
        """The messages of a block whose channel is defined and whose time is possible."""
        if not self.by_records:
            found = super().unpack_bytes(block, raw)
            found.times()
        elif block.compression is None:
            found = messages.parse(raw, block.offset)
        else:
            found = messages.parse(records.unpack(raw, block.offset, self.max_chunk), block.offset)
        crc = 0 if block.compression is None else records.ChunkHead.of(raw[:HEAD_BYTES], len(raw), block.offset).crc
        if not crc and len(found.heads) and not self.proven:
            self.losses.unchecked_in[block.offset] = len(found.heads)
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
        """Compares the CRC of every attachment, and of every chunk that was not unpacked yet."""
        if not self.by_records:
            super().check()
            return
        for item in self.items:
            if isinstance(item, RecordSpan) and item.opcode == Opcode.ATTACHMENT:
                try:
                    Attachment.of(self.source, item.offset, item.length - HEAD.size).check_crc(self.source)
                except LogError as error:
                    self.lose(item, error)

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
        self.footer, summary = self._proven_summary()
        listed = {} if summary is None else {entry.chunk_start_offset: entry for entry in summary.chunks}
        limit = self.source.size if summary is None else self.footer.summary_start
        scan = Scan(self.source, limit, listed, self.losses, self.max_chunk)
        scan.run()
        self._repaired, self.items = scan.repaired, scan.items
        self.data_end = scan.data_ends[0] if len(scan.data_ends) == 1 else self.source.size
        self._drop_doubtful(scan)
        summaries = ([] if summary is None else [summary]) + scan.summaries
        self.recordings = Recordings(summaries, self.losses, self._fits)
        kept = {id(item) for item in self.items}
        self.recordings.assign([e for e in scan.events if not isinstance(e, ScannedBlock) or id(e.block) in kept])
        self._drop_copies(scan)
        self._search_definitions(scan)
        self.schemas, self.channels = self.recordings.renumber()
        self.losses.unchecked_topics = self.recordings.unproven_topics()
        for gap in _really_lost(scan, self.blocks, summaries, self.losses):
            self._add_gap(gap)
        unchecked = {e.block.offset for e in scan.events if isinstance(e, ScannedBlock) and not e.crc}
        for block in self.blocks:
            self._edit(block)
            if block.offset in unchecked and block.counts:
                self.losses.unchecked_in[block.offset] = sum(block.counts.values())
        self._sort()
        self._set_header(scan)

    def _proven_summary(self) -> tuple[Footer, Summary | None]:
        """The footer, and the summary if its CRC proves it where the footer says it is."""
        source, missing = self.source, Footer(summary_start=0, summary_offset_start=0, summary_crc=0)
        if source.size == 0:
            raise LogError("the file is empty", expected="an MCAP log")
        at = source.size - len(MAGIC) - FOOTER_SIZE
        if at < len(MAGIC) or source.at(source.size - len(MAGIC), len(MAGIC)) != MAGIC:
            return missing, None
        if source.head(at) != (Opcode.FOOTER, FOOTER_SIZE - HEAD.size):
            return missing, None
        footer: Footer = records.parse(Footer, source.at(at + HEAD.size, FOOTER_SIZE - HEAD.size), at)
        start = footer.summary_start
        if not footer.summary_crc or not len(MAGIC) <= start <= at:
            if start:
                self.losses.add_harmless(f"nothing proves the summary at byte {start}; a new one can be made")
            return footer, None
        try:
            if at - start > MAX_SUMMARY:
                raise LogError(f"the summary at byte {start} has {at - start} bytes", expected=f"at most {MAX_SUMMARY}")
            raw = source.at(start, at - start + FOOTER_SIZE - 4)
            if crc32(raw) != footer.summary_crc:
                raise LogError(f"the summary at byte {start} is damaged: its CRC is {crc32(raw):08x}")
            if (summary := parse_summary(raw[: at - start], 0)) is None:
                raise LogError(f"other records than those of a summary follow byte {start}")
            return footer, summary
        except LogError as error:
            self.losses.add_harmless(f"{reason(error)}; a new summary can be made")
            return footer, None

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

    def _fits(self, block: MessageBlock, channel: int, recording: Recording) -> bool:
        """Whether the messages of a channel decode by the recording's definition; True where nothing tells."""
        known = recording.channels[channel]
        schema = recording.schemas.get(known.schema_id)
        if schema is None or (schema.encoding, known.message_encoding) != ("ros2msg", "cdr"):
            return True
        found = messages.parse(_contents(self.read(block), block, self.max_chunk), block.offset)
        chosen = np.flatnonzero(found.heads["channel"] == channel)[:SAMPLES].tolist()
        sizes = found.heads["length"].astype(np.int64) + HEAD.size
        payloads = [found.data[found.offsets[i] + messages.MESSAGE.itemsize : found.offsets[i] + sizes[i]] for i in chosen]
        return all(decodes(payload.tobytes(), schema.name, schema.data) for payload in payloads)

    def _drop_copies(self, scan: Scan) -> None:
        """Keeps of equal chunks the one whose recording is best known."""
        kept: dict[object, ScannedBlock] = {}
        for event in scan.events:
            if not isinstance(event, ScannedBlock) or event.block.compression is None or not event.block.counts:
                continue
            before = kept.setdefault((event.key, event.crc), event)
            if before is not event and self._same_contents(before.block, event.block):
                better, worse = (event, before) if event.evidence > before.evidence else (before, event)
                kept[event.key, event.crc], worse.block.lost = better, True
                self.losses.add_harmless(f"the chunk at byte {worse.block.offset} repeats the one at byte {better.block.offset}")

    def _same_contents(self, a: MessageBlock, b: MessageBlock) -> bool:
        return bytes(_contents(self.read(a), a, self.max_chunk)) == bytes(_contents(self.read(b), b, self.max_chunk))

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
        ids = self.recordings.each[gap.recording].ids
        counts = Counter({ids.get(local, -1 - local): count for local, count in gap.counts.items()})
        self.losses.add(Loss(gap.offset, gap.length, gap.reason, self._by_topic(counts), gap.counted, gap.start_ns, gap.end_ns))

    def _by_topic(self, counts: dict[int, int]) -> dict[str, int]:
        found: Counter[str] = Counter()
        for channel, count in counts.items():
            known = self.channels.get(channel)
            found[known.topic if known else f"(channel {-1 - channel if channel < 0 else channel}, not defined)"] += count
        return dict(found)

    def _edit(self, block: MessageBlock) -> None:
        """Counts by the channel ids of the whole file; messages that are on no topic are listed as lost."""
        local, recording = block.counts or {}, self.recordings.of(block)
        unproven = self.recordings.unproven.get(block.offset, {})
        if unproven and (lost := {f"({names})": local[i] for i, names in unproven.items() if i in local}):
            why = "messages here are of one of several recordings, and nothing proves of which"
            self.losses.add(Loss(block.offset, 0, why, lost, True, block.start_ns, block.end_ns))
            self.losses.unproven += sum(lost.values())
        undefined = {-1 - i: n for i, n in local.items() if i not in recording.ids}
        if undefined:
            why = "messages in the chunk here have channels that no record defines"
            self.losses.add(Loss(block.offset, block.length, why, self._by_topic(undefined), True))
        block.counts = renumber_counts(recording, {i: n for i, n in local.items() if i not in unproven})

    def _readable(self, block: MessageBlock, found: messages.Messages) -> messages.Messages:
        """The messages of defined channels at possible times, by the channel ids of the whole file."""
        recording = self.recordings.of(block)
        mapped = map_channels(recording, self.recordings.unproven.get(block.offset, {}), found)
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

    def _sort(self) -> None:
        """Puts the chunks in order of log time; other records stay behind the chunk that they follow."""
        keys, last = [], -1
        for item in self.items:
            last = item.start_ns if isinstance(item, MessageBlock) and item.counts else last
            keys.append(last)
        if any(a > b for a, b in zip(keys, keys[1:], strict=False)):
            self.losses.add_harmless("the chunks are not in order of log time; they are put in order")
            order = sorted(range(len(keys)), key=keys.__getitem__)
            self.items = [self.items[i] for i in order]

    def _set_header(self, scan: Scan) -> None:
        header = scan.header
        if not self.items and header is None and not self.channels:
            raise LogError("this is not an MCAP log: no record of one is in it", expected="an MCAP log")
        if header is None:
            encodings = {channel.message_encoding for channel in self.channels.values()}
            profile = {"cdr": "ros2", "ros1": "ros1"}.get(next(iter(encodings)), "") if len(encodings) == 1 else ""
            header = Header(profile=profile, library="")
            self.losses.add_harmless(f"the Header is lost; the profile is {profile!r} by the messages' encoding")
        self.header = header
        self.header_end = len(MAGIC) + len(self.header_bytes)


def _contents(raw: bytes, block: MessageBlock, max_chunk: int) -> bytes | memoryview:
    return raw if block.compression is None else records.unpack(raw, block.offset, max_chunk)


def counts_by_size(indexes: dict[int, int], end: int) -> dict[int, int]:
    """Messages per channel by index size: 15 bytes a message index, 16 a message; none where they do not fit."""
    if not indexes:
        return {}
    starts = sorted(indexes.items(), key=lambda item: item[1])
    ends = [offset for _, offset in starts[1:]] + [end]
    sizes = {channel: stop - offset - 15 for (channel, offset), stop in zip(starts, ends, strict=True)}
    good = all(size >= 0 and size % 16 == 0 for size in sizes.values())
    return {channel: size // 16 for channel, size in sizes.items()} if good else {}


def _really_lost(scan: Scan, blocks: list[MessageBlock], summaries: list[Summary], losses: Losses) -> Iterator[Gap]:
    """The gaps in which something was lost, with what message indexes and summaries say of it."""
    places = {block.offset + block.length: block for block in blocks if block.compression is not None}
    sizes = {end: end + sum(15 + 16 * n for n in (block.counts or {}).values()) for end, block in places.items()}
    starts = np.array(sorted(sizes), np.int64)
    where = {(channel, n) for block in blocks for channel, n in (block.counts or {}).items()}
    missing = [(n, entry) for n, summary in enumerate(summaries) for entry in _missing(summary, scan)]
    for gap in scan.gaps:
        before = int(np.searchsorted(starts, gap.offset, "right")) - 1
        if gap.length and before >= 0 and gap.end <= sizes[int(starts[before])]:
            losses.add_harmless(f"a message index at byte {gap.offset} is damaged; a new one can be made")
            continue
        if not gap.length and gap.indexes and all((channel, n) in where for channel, n, _, _ in gap.indexes):
            losses.add_harmless(f"message indexes at byte {gap.offset} are not behind their chunk; new ones can be made")
            continue
        inside = [pair for pair in missing if gap.offset - 15 <= pair[1].chunk_start_offset < max(gap.end, gap.offset + 1)]
        missing = [pair for pair in missing if pair not in inside]
        gap.recording = inside[0][0] if inside else gap.recording
        if inside and not gap.counted:
            _count(gap, [entry for _, entry in inside])
        yield gap
    for number in sorted({number for number, _ in missing}):
        entries = [entry for n, entry in missing if n == number]
        start = min(entry.chunk_start_offset for entry in entries)
        gap = Gap(start, 0, f"a summary lists {len(entries)} chunks that are not in the file", recording=number)
        _count(gap, entries)
        yield gap


def _missing(summary: Summary, scan: Scan) -> Iterator[ChunkIndex]:
    """Entries of a summary whose chunk was not met, by the bytes of the file."""
    keys = {event.key for event in scan.events if isinstance(event, ScannedBlock)}
    places = {event.block.offset for event in scan.events if isinstance(event, ScannedBlock)}
    entries = [e for e in summary.chunks if (e.message_start_time, e.message_end_time, e.uncompressed_size) not in keys]
    if len(entries) == len(summary.chunks):  # the times or sizes are wrong
        entries = [e for e in entries if summary.base + e.chunk_start_offset not in places]
    for entry in entries:
        offsets = {channel: at + summary.base for channel, at in entry.message_index_offsets.items()}
        start = entry.chunk_start_offset + summary.base
        yield replace(entry, chunk_start_offset=start, message_index_offsets=offsets)


def _count(gap: Gap, entries: Iterable[ChunkIndex]) -> None:
    """Adds the messages and times of lost chunks to a gap, as their summary states them."""
    complete = True
    for entry in entries:
        end = entry.chunk_start_offset + entry.chunk_length + entry.message_index_length
        found = counts_by_size(entry.message_index_offsets, end)
        complete = complete and bool(found)
        gap.counts.update(found)
        if entry.message_start_time <= entry.message_end_time < LATEST_NS:
            starts, ends = [gap.start_ns, entry.message_start_time], [gap.end_ns, entry.message_end_time]
            gap.start_ns, gap.end_ns = min(t for t in starts if t is not None), max(t for t in ends if t is not None)
    gap.counted = complete
