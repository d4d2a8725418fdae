"""Summaries that their CRC proves, wherever in a file they lie."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Footer

from imutool.errors import LogError
from imutool.mcap_io.codec import records
from imutool.mcap_io.codec.records import FOOTER_SIZE, HEAD, MAGIC, crc32
from imutool.mcap_io.index import MAX_SUMMARY
from imutool.mcap_io.recovery.definitions import Recording, different, parsed
from imutool.mcap_io.recovery.losses import Losses, reason
from imutool.mcap_io.storage.source import Source

DEFINITIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
PRIVATE = 0x80  # opcodes from here on belong to whoever writes them
OFFSET_SIZE = HEAD.size + 17  # bytes of a SummaryOffset record
SUMMARY = {
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.STATISTICS,
    Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET,
}


class Summary(NamedTuple):
    """A summary that its CRC proves; `base` is the byte from which it counts."""

    base: int
    definitions: list[tuple[int, bytes]]
    chunks: list[ChunkIndex]


def recording_of(summary: Summary, losses: Losses) -> Recording:
    """Recording whose definitions a summary states."""
    lists = {(e.message_start_time, e.message_end_time, e.uncompressed_size) for e in summary.chunks or ()}
    recording = Recording(summary.base, lists=lists or None)
    definitions = parsed(summary.definitions, summary.base, losses)
    twice = {key for key, number in Counter((type(d), d.id) for d in different(definitions)).items() if number > 1}
    for record in (d for d in definitions if (type(d), d.id) not in twice):
        recording.define(record, proven=True)
    for kind, number in sorted(twice, key=str):
        losses.add_harmless(f"a summary defines {kind.__name__.lower()} {number} twice; neither is used")
    return recording


def proven_summary(source: Source, losses: Losses) -> tuple[Footer, Summary | None]:
    """The footer, and the summary if its CRC proves it where the footer says it is.

    Raises:
        LogError: the file is empty.
    """
    missing = Footer(summary_start=0, summary_offset_start=0, summary_crc=0)
    if source.size == 0:
        raise LogError("the file is empty", expected="an MCAP log")
    at = source.size - len(MAGIC) - FOOTER_SIZE
    if at < len(MAGIC) or source.at(source.size - len(MAGIC), len(MAGIC)) != MAGIC:
        return missing, None
    if source.head(at) != (Opcode.FOOTER, FOOTER_SIZE - HEAD.size):
        return missing, None
    footer: Footer = records.parse(Footer, source.at(at + HEAD.size, FOOTER_SIZE - HEAD.size), at)
    start = footer.summary_start
    if not footer.summary_crc or not start:
        return footer, None  # nothing proves it; the scan meets its records as it meets others
    try:
        if not len(MAGIC) <= start <= at:
            raise LogError(f"the footer says the summary begins at byte {start}", expected=f"at most {at}")
        if at - start > MAX_SUMMARY:
            raise LogError(f"the summary at byte {start} has {at - start} bytes", expected=f"at most {MAX_SUMMARY}")
        raw = source.at(start, at - start + FOOTER_SIZE - 4)
        if crc32(raw) != footer.summary_crc:
            raise LogError(f"the summary at byte {start} is damaged: its CRC is {crc32(raw):08x}")
        if (summary := parse_summary(raw[: at - start], 0)) is None:
            raise LogError(f"other records than those of a summary follow byte {start}")
        return footer, summary
    except LogError as error:
        losses.add_harmless(f"{reason(error)}; a new summary can be made")
        return footer, None


def moved_summary(source: Source, starts: Sequence[int], position: int) -> tuple[int, Summary | None]:
    """Moved summary that the CRC in the Footer proves, and its start; `starts` may be it."""
    footer = records.parse(Footer, source.at(position + HEAD.size, FOOTER_SIZE - HEAD.size), position)
    stop = position + FOOTER_SIZE - 4
    stated = [at for at in _stated_starts(source, footer, position) if at >= 0]
    for start in (*stated, *starts) if footer.summary_crc and footer.summary_start else ():
        raw = source.at(start, stop - start) if stop - start <= MAX_SUMMARY else b""
        if raw and crc32(raw) == footer.summary_crc:
            return start, parse_summary(raw[: position - start], start - footer.summary_start)
    return position, None


def _stated_starts(source: Source, footer: Footer, position: int) -> Iterator[int]:
    """Starts by the length that the Footer states and the SummaryOffset records in front of the Footer."""
    size = footer.summary_offset_start - footer.summary_start
    while footer.summary_offset_start and 0 < size <= position:
        yield position - size
        position -= OFFSET_SIZE
        if position < 0 or source.head(position) != (Opcode.SUMMARY_OFFSET, OFFSET_SIZE - HEAD.size):
            return


def parse_summary(raw: bytes, base: int) -> Summary | None:
    """Definitions and chunk indexes of a summary; None where other records are in it."""
    found = Summary(base, [], [])
    at = 0
    while len(raw) - at >= HEAD.size:
        opcode, length = HEAD.unpack_from(raw, at)
        body = raw[at + HEAD.size : at + HEAD.size + length]
        if opcode in DEFINITIONS:
            found.definitions.append((opcode, body))
        elif opcode == Opcode.CHUNK_INDEX:
            with suppress(LogError):
                found.chunks.append(records.parse_chunk_index(body, at))
        elif opcode not in SUMMARY and opcode < PRIVATE:
            return None
        at += HEAD.size + length
    return found if at == len(raw) else None
