"""Verify a written log: compare its summary, indexes, statistics and CRCs with its contents.

Always checked: every index of the summary leads to a record of its kind and size, every message index to entries inside
its chunk, and the statistics are the sums of these. The contents of a chunk are checked only where it is unpacked.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, DataEnd, MetadataIndex, SummaryOffset

from imutool.errors import ConfigError, LogError
from imutool.file_location import Location
from imutool.mcap_io.blocks import Attachment, MessageBlock, RecordSpan, read_message_indexes, too_large
from imutool.mcap_io.codec import records
from imutool.mcap_io.codec.records import CHUNK_HEAD, FOOTER_SIZE, HEAD, MAGIC
from imutool.mcap_io.index import LogIndex
from imutool.mcap_io.log import Log
from imutool.mcap_io.passthrough.chunk_check import check_chunk
from imutool.mcap_io.storage.source import crc_of
from imutool.report import Progress, silent

MODES = ("all", "imu", "none")


def check_mode(mode: str) -> None:
    """Refuses an unknown mode of verification.

    Raises:
        ConfigError: not one of `MODES`.
    """
    if mode not in MODES:
        raise ConfigError(f"unknown mode {mode!r}", where="check", expected=", ".join(MODES))


def verify(
    path: Location,
    counts: Mapping[int, int],
    *,
    unpacked: Collection[int] | None = None,
    max_chunk: int | None = None,
    progress: Progress = silent,
) -> int:
    """Checks a log that should hold `counts` messages per channel id.

    Returns how many chunks were unpacked.

    These are the chunks that begin at the bytes `unpacked`, or else every chunk, and then the CRC of every attachment and
    of the data section too.

    Raises:
        LogError: the log contradicts its own indexes, statistics or CRCs.
    """
    with Log(path, max_chunk=max_chunk, reads_topics=False) as log, log.named():
        return verify_index(log.index, counts, unpacked=unpacked, progress=progress)


def verify_index(
    index: LogIndex,
    counts: Mapping[int, int],
    *,
    unpacked: Collection[int] | None = None,
    proven: bool = False,
    progress: Progress = silent,
) -> int:
    """Checks an open log as `verify` does; returns how many chunks were unpacked.

    With `proven` a chunk without CRC is an error, as is a definition that the summary lacks.

    Raises:
        LogError: as `verify`.
    """
    sums, done = _Sums(proven=proven), 0
    for block in index.blocks:
        whole = unpacked is None or block.offset in unpacked
        sums.add(index, block, whole=whole)
        done += whole
        progress(block.end, index.source.size)
    sums.compare(index, counts)
    _check_summary(index, complete=proven)
    if unpacked is None:
        for item in index.items:
            if isinstance(item, RecordSpan) and item.opcode == Opcode.ATTACHMENT:
                Attachment.of(index.source, item.offset, item.length - HEAD.size).check_crc(index.source)
        check_data_crc(index, crc_of(index.source, 0, index.data_end))
    return done


class _Sums:
    """Sums over the chunks, to compare with the statistics."""

    def __init__(self, *, proven: bool) -> None:
        self.counts: Counter[int] = Counter()
        self.proven = proven
        self.start_ns, self.end_ns = 2**64, 0

    def add(self, index: LogIndex, block: MessageBlock, *, whole: bool) -> None:
        """Checks a block, with `whole` its messages too."""
        if block.compression is None:
            raise LogError(f"messages lie outside chunks at byte {block.offset}", expected="chunks alone")
        if whole and block.length > index.max_chunk:
            raise too_large("chunk", block.offset, block.length, index.max_chunk)
        if whole:
            everything = memoryview(index.source.at(block.offset, block.end - block.offset))
            head, listed, right, _ = check_chunk(everything, block, index.max_chunk)
            if self.proven and not head.crc:
                raise LogError(f"the chunk at byte {block.offset} states no CRC", expected="one in every chunk")
        else:
            (_, listed), right = read_message_indexes(index.source, block), True
        if listed is None:
            if index.unpack(block).offsets.size:
                raise LogError(f"the message indexes behind the chunk at byte {block.offset} are damaged")
            return
        if not right:
            raise LogError(f"the message indexes behind the chunk at byte {block.offset} list other messages than are in it")
        if (block.start_ns, block.end_ns) != (listed.start_ns, listed.end_ns):
            raise LogError(
                f"the summary says the chunk at byte {block.offset} ends at {block.end_ns} ns", expected=str(listed.end_ns)
            )
        for channel, count in listed.counts.items():
            self.counts[channel] += count
        self.start_ns, self.end_ns = min(self.start_ns, listed.start_ns), max(self.end_ns, listed.end_ns)

    def compare(self, index: LogIndex, counts: Mapping[int, int]) -> None:
        """Compares the sums with the log's statistics and with the expected counts."""
        stated = index.statistics
        if self.counts != Counter(counts):
            raise LogError(f"the copy has {self.counts.total()} messages", expected=str(sum(counts.values())))
        if stated is None:
            raise LogError("the copy has no statistics", expected="a Statistics record")
        found = (len(index.blocks), len(index.channels), len(index.schemas), self.counts.total())
        says = (stated.chunk_count, stated.channel_count, stated.schema_count, stated.message_count)
        if found != says or Counter(stated.channel_message_counts) != self.counts:
            raise LogError(f"the statistics say {says} chunks, channels, schemas and messages", expected=str(found))
        if self.counts and (stated.message_start_time, stated.message_end_time) != (self.start_ns, self.end_ns):
            raise LogError(f"the statistics say the messages end at {stated.message_end_time} ns", expected=str(self.end_ns))


def _check_summary(index: LogIndex, *, complete: bool) -> None:
    """Checks that the groups of the summary are where its offsets say, and its indexes lead, and `complete` definitions."""
    source, footer = index.source, index.footer
    start, end = footer.summary_start, source.size - len(MAGIC) - FOOTER_SIZE
    raw, at, groups = source.at(start, end - start), 0, dict[int, tuple[int, int]]()
    found: Counter[int] = Counter()
    lengths = {block.offset: block.length for block in index.blocks}
    while at < len(raw):
        opcode, length = HEAD.unpack_from(raw, at)
        body, whole = raw[at + HEAD.size : at + HEAD.size + length], HEAD.size + length
        if opcode == Opcode.SUMMARY_OFFSET:
            group = records.parse(SummaryOffset, body, start + at)
            if group.group_length and groups.pop(group.group_opcode, None) != (group.group_start, group.group_length):
                raise LogError(f"the summary offset at byte {start + at} leads nowhere")
        else:
            first, size = groups.get(opcode, (start + at, 0))
            groups[opcode] = first, size + whole
            if first + size != start + at:
                raise LogError(f"the {records.name_of(opcode)} records of the summary lie apart")
        if opcode == Opcode.CHUNK_INDEX:
            chunk = records.parse_chunk_index(body, start + at)
            ahead = HEAD.size + CHUNK_HEAD.size + len(chunk.compression) + 8  # bytes of the record before the packed data
            actual = lengths.get(chunk.chunk_start_offset)
            if actual != chunk.chunk_length or actual != ahead + chunk.compressed_size:
                raise LogError(f"the summary lists a chunk at byte {chunk.chunk_start_offset} otherwise than it is")
        elif opcode in (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
            attached = opcode == Opcode.ATTACHMENT_INDEX
            entry = records.parse(AttachmentIndex if attached else MetadataIndex, body, start + at)
            kind = Opcode.ATTACHMENT if attached else Opcode.METADATA
            if entry.length < HEAD.size or source.head(entry.offset) != (kind, entry.length - HEAD.size):
                name = records.name_of(kind)
                raise LogError(f"the summary lists {name} at byte {entry.offset}, and none begins there")
        found[opcode] += 1
        at += whole
    if groups:
        raise LogError(f"no summary offset leads to {', '.join(map(records.name_of, groups))}")
    stated = index.statistics
    assert stated is not None, "compared before"
    if complete and (found[Opcode.SCHEMA], found[Opcode.CHANNEL]) != (stated.schema_count, stated.channel_count):
        raise LogError("the summary lacks definitions", expected="those of all schemas and channels")
    kinds = (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX, Opcode.CHUNK_INDEX)
    if tuple(found[k] for k in kinds) != (stated.attachment_count, stated.metadata_count, stated.chunk_count):
        raise LogError("the statistics count other attachments, metadata or chunks than the summary lists")


def stated_crc(index: LogIndex) -> int:
    """The CRC of the data section that the log states; 0 where it states none."""
    opcode, length = index.source.head(index.data_end)
    if opcode != Opcode.DATA_END:
        return 0
    body = index.source.at(index.data_end + HEAD.size, length)
    return int(records.parse(DataEnd, body, index.data_end).data_section_crc)


def check_data_crc(index: LogIndex, crc: int) -> None:
    """Refuses a log whose data section has another CRC than it states.

    Raises:
        LogError: it has.
    """
    stated = stated_crc(index)
    if stated and stated != crc:
        raise LogError(f"the data section has CRC {crc:08x}", expected=f"{stated:08x}")
