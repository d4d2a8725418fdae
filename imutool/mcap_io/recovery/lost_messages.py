"""Messages lost in the gaps of a damaged log, from message indexes and summaries."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex

from imutool.mcap_io.blocks import MessageBlock
from imutool.mcap_io.recovery.losses import LATEST_NS, Losses
from imutool.mcap_io.recovery.scan import Scan
from imutool.mcap_io.recovery.scan_events import Gap, ScannedBlock
from imutool.mcap_io.recovery.summary import Summary


def counts_by_size(indexes: dict[int, int], end: int) -> dict[int, int]:
    """Messages per channel by index size: 15 bytes a message index, 16 a message."""
    if not indexes:
        return {}
    starts = sorted(indexes.items(), key=lambda item: item[1])
    ends = [offset for _, offset in starts[1:]] + [end]
    sizes = {channel: stop - offset - 15 for (channel, offset), stop in zip(starts, ends, strict=True)}
    good = all(size >= 0 and size % 16 == 0 for size in sizes.values())
    return {channel: size // 16 for channel, size in sizes.items()} if good else {}


def really_lost(scan: Scan, blocks: list[MessageBlock], summaries: list[Summary], losses: Losses) -> Iterator[Gap]:
    """The gaps in which something was lost, with what message indexes and summaries say of it."""
    places = {block.offset + block.length: block for block in blocks if block.compression is not None}
    sizes = {end: end + sum(15 + 16 * n for n in (block.counts or {}).values()) for end, block in places.items()}
    starts = np.array(sorted(sizes), np.int64)
    where = {(channel, n) for block in blocks for channel, n in (block.counts or {}).items()}
    missing = [(n, entry) for n, summary in enumerate(summaries) for entry in _missing(summary, scan)]
    for gap in scan.gaps:
        before = int(np.searchsorted(starts, gap.offset, "right")) - 1
        inside_log = gap.end < scan.limit or scan.data_ends
        behind = int(starts[before]) if before >= 0 else -1
        if gap.length and inside_log and gap.end <= sizes.get(behind, 0) and _may_be_index(gap, places[behind], blocks, scan):
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
        named = "1 chunk that is" if len(entries) == 1 else f"{len(entries)} chunks that are"
        why = f"a summary lists {named} not in the file"
        gap = Gap(min(max(0, start), scan.source.size), 0, why, recording=number)
        _count(gap, entries)
        yield gap


def _may_be_index(gap: Gap, block: MessageBlock, blocks: list[MessageBlock], scan: Scan) -> bool:
    """Whether message indexes of the block may have stood in a gap behind it, rather than a small chunk."""
    opcode = scan.source.at(gap.offset, 1)[0]
    lacks = not (block.counts or {}).keys() <= block.indexes.keys()
    return lacks and (opcode == Opcode.MESSAGE_INDEX or (opcode != Opcode.CHUNK and any(each.indexes for each in blocks)))


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
