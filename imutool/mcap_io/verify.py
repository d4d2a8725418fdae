"""A log read back: what its summary says is held against what lies in it, as closely as is asked for.

Always checked: every index of the summary leads to a record of its kind and size, every message index to entries inside
its chunk, and the statistics are the sums of these. The contents of a chunk are checked only where it is unpacked.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, DataEnd, MetadataIndex, SummaryOffset

from imutool.errors import ConfigError, LogError
from imutool.location import Location
from imutool.mcap_io.codec import records
from imutool.mcap_io.codec.crc import crc32
from imutool.mcap_io.codec.records import FOOTER_SIZE, HEAD, MAGIC
from imutool.mcap_io.index import Block, LogIndex, Span
from imutool.mcap_io.listing import described
from imutool.mcap_io.log import Log
from imutool.mcap_io.storage.source import Source
from imutool.mcap_io.storage.target import COPY_BYTES

MODES = ("all", "imu", "none")


class Verified(NamedTuple):
    """What of a log was checked: its structure always, and the contents of some or all of its chunks."""

    mode: str
    chunks_checked: int
    chunks: int


def refuse_unknown(mode: str) -> None:
    """Says what can be asked for.

    Raises:
        ConfigError: something else was.
    """
    if mode not in MODES:
        raise ConfigError(f"{mode!r}", where="--verify", expected=", ".join(MODES))


def verify(
    path: Location,
    counts: Mapping[int, int],
    *,
    unpacked: Collection[int] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Checks a log that should hold so many messages per channel id, and returns how many chunks were unpacked for it.

    These are the chunks that begin at the bytes `unpacked`, or else every chunk, and then the CRC of every attachment and
    of the data section too.

    Raises:
        LogError: something is not as the log's own indexes, statistics or CRCs say.
    """
    with Log(path) as log, log.named():
        structure, done = log.structure, 0
        sums = _Sums()
        for block in structure.blocks:
            whole = unpacked is None or block.offset in unpacked
            sums.take(structure, block, whole=whole)
            done += whole
            if progress:
                progress(block.end, structure.source.size)
        sums.compare(structure, counts)
        _summary(structure)
        if unpacked is None:
            _attachments(structure)
            check_data_crc(structure, crc_of(structure.source, 0, structure.data_end))
        return done


class _Sums:
    """What the statistics must say."""

    def __init__(self) -> None:
        self.counts: Counter[int] = Counter()
        self.start_ns, self.end_ns = 2**64, 0

    def take(self, structure: LogIndex, block: Block, *, whole: bool) -> None:
        """Checks a block, and its messages if it is to be taken `whole`."""
        if block.compression is None:
            raise LogError(f"messages lie outside chunks at byte {block.offset}", expected="chunks alone")
        _, listed = described(structure.source, block)
        if listed is None:
            if structure.unpack(block).offsets.size:
                raise LogError(f"the message indexes behind the chunk at byte {block.offset} are damaged")
            return
        raw = structure.source.at(block.offset, block.length) if whole else b""
        if whole and not listed.messages(records.unpack(raw, block.offset), block.offset)[1]:
            raise LogError(f"the message indexes behind the chunk at byte {block.offset} list other messages than are in it")
        if (block.start_ns, block.end_ns) != (listed.start_ns, listed.end_ns):
            raise LogError(
                f"the summary says the chunk at byte {block.offset} ends at {block.end_ns} ns", expected=str(listed.end_ns)
            )
        for channel, count in listed.counts.items():
            self.counts[channel] += count
        self.start_ns, self.end_ns = min(self.start_ns, listed.start_ns), max(self.end_ns, listed.end_ns)

    def compare(self, structure: LogIndex, counts: Mapping[int, int]) -> None:
        """Holds the sums against the log's statistics, and against what should be there."""
        told = structure.statistics
        if self.counts != Counter(counts):
            raise LogError(f"the copy has {self.counts.total()} messages", expected=str(sum(counts.values())))
        if told is None:
            raise LogError("the copy has no statistics", expected="a Statistics record")
        found = (len(structure.blocks), len(structure.channels), len(structure.schemas), self.counts.total())
        says = (told.chunk_count, told.channel_count, told.schema_count, told.message_count)
        if found != says or Counter(told.channel_message_counts) != self.counts:
            raise LogError(f"the statistics say {says} chunks, channels, schemas and messages", expected=str(found))
        if self.counts and (told.message_start_time, told.message_end_time) != (self.start_ns, self.end_ns):
            raise LogError(f"the statistics say the messages end at {told.message_end_time} ns", expected=str(self.end_ns))


def _summary(structure: LogIndex) -> None:
    """Follows the summary: its groups are where its offsets say, its indexes lead to records of their kind."""
    source, footer = structure.source, structure.footer
    start, end = footer.summary_start, source.size - len(MAGIC) - FOOTER_SIZE
    raw, at, groups = source.at(start, end - start), 0, dict[int, tuple[int, int]]()
    found: Counter[int] = Counter()
    while at < len(raw):
        opcode, length = HEAD.unpack_from(raw, at)
        body, whole = raw[at + HEAD.size : at + HEAD.size + length], HEAD.size + length
        if opcode == Opcode.SUMMARY_OFFSET:
            group = records.parse(SummaryOffset, body, start + at)
            if groups.pop(group.group_opcode, None) != (group.group_start, group.group_length):
                raise LogError(f"the summary offset at byte {start + at} leads nowhere")
        else:
            first, size = groups.get(opcode, (start + at, 0))
            groups[opcode] = first, size + whole
            if first + size != start + at:
                raise LogError(f"the {records.name_of(opcode)} records of the summary lie apart")
        if opcode in (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
            attached = opcode == Opcode.ATTACHMENT_INDEX
            entry = records.parse(AttachmentIndex if attached else MetadataIndex, body, start + at)
            kind = Opcode.ATTACHMENT if attached else Opcode.METADATA
            if entry.length < HEAD.size or source.head(entry.offset) != (kind, entry.length - HEAD.size):
                raise LogError(f"the summary says {records.name_of(kind)} lies at byte {entry.offset}, which it does not")
        found[opcode] += 1
        at += whole
    if groups:
        raise LogError(f"no summary offset leads to {', '.join(map(records.name_of, groups))}")
    told = structure.statistics
    assert told is not None, "compared before"
    kinds = (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX, Opcode.CHUNK_INDEX)
    if tuple(found[k] for k in kinds) != (told.attachment_count, told.metadata_count, told.chunk_count):
        raise LogError("the statistics count other attachments, metadata or chunks than the summary lists")


def _attachments(structure: LogIndex) -> None:
    """The CRC of every attachment that states one."""
    for item in structure.items:
        if isinstance(item, Span) and item.opcode == Opcode.ATTACHMENT:
            end = item.offset + item.length
            (stated,) = struct.unpack("<I", structure.source.at(end - 4, 4))
            found = crc_of(structure.source, item.offset + HEAD.size, end - 4)
            if stated not in (0, found):
                raise LogError(
                    f"the attachment at byte {item.offset} is damaged: its CRC is {found:08x}", expected=f"{stated:08x}"
                )


# ── the CRC of the data section ──────────────────────────────────────────────────────────────────────────────────────


def crc_of(source: Source, start: int, end: int, crc: int = 0) -> int:
    """The CRC of some bytes, continued from that of what lies before them."""
    for at in range(start, end, COPY_BYTES):
        crc = crc32(source.at(at, min(COPY_BYTES, end - at)), crc)
    return crc


def stated_crc(structure: LogIndex) -> int:
    """The CRC of the data section that the log states; 0 where it states none."""
    opcode, length = structure.source.head(structure.data_end)
    if opcode != Opcode.DATA_END:
        return 0
    body = structure.source.at(structure.data_end + HEAD.size, length)
    return int(records.parse(DataEnd, body, structure.data_end).data_section_crc)


def check_data_crc(structure: LogIndex, crc: int) -> None:
    """Refuses a log whose data section has another CRC than it states.

    Raises:
        LogError: it has.
    """
    stated = stated_crc(structure)
    if stated and stated != crc:
        raise LogError(f"the data section has CRC {crc:08x}", expected=f"{stated:08x}")
