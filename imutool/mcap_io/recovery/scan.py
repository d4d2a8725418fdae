"""The data section of a file that may be damaged, followed from its first byte to its last.

Records are followed as in a whole log. Where framing breaks, the search goes on until a record convinces again (`resync`), or
to the next chunk that the summary knows; what lies between is a gap. Nothing is unpacked here but what is needed to tell a
whole chunk from one that was cut off.
"""

from __future__ import annotations

import struct
import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Int64
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Footer, Header

from imutool.errors import LogError
from imutool.mcap_io.codec import records
from imutool.mcap_io.codec.attachment import Attached
from imutool.mcap_io.codec.records import FIXED, FOOTER_SIZE, HEAD, MAGIC
from imutool.mcap_io.index import MOST_SUMMARY, RUN_BYTES, Block, Span, known_block
from imutool.mcap_io.losses import Losses
from imutool.mcap_io.recovery.resync import LEAST, MOST_TRIED, PRIVATE, SUMMARY, Frames
from imutool.mcap_io.sections import DEFINITIONS, Sections
from imutool.mcap_io.storage.source import Source

MOST_ITEMS = 5_000_000  # a 100 GB log has some 100 000 chunks; a file of nothing but empty ones is made to fill the memory
LATEST_NS = 2**63  # log times from here on (the year 2262) are of no clock
ANOTHER = MAGIC + bytes([Opcode.HEADER])  # how a log begins


@dataclass
class Gap:
    """A stretch in which no record could be made out."""

    offset: int
    length: int
    reason: str
    counts: Counter[int] = field(default_factory=Counter)  # by the channel ids of its section
    counted: bool = False  # from message indexes that survived behind it
    start_ns: int | None = None
    end_ns: int | None = None


class Scan:
    """One pass over the records of a file; `index` has the chunks of a summary that is sound, if there is one.

    Raises:
        LogError: more records than any recorder writes.
    """

    def __init__(self, source: Source, limit: int, index: Mapping[int, ChunkIndex], sections: Sections, losses: Losses) -> None:
        self.source, self.limit, self.index, self.sections, self.losses = source, limit, index, sections, losses
        self.trusted = limit < source.size  # a sound summary begins at the limit
        self.frames = Frames(source, limit)
        self.items: list[Block | Span] = []
        self.gaps: list[Gap] = []
        self.doubtful: list[tuple[Block, Gap]] = []  # messages that may be the contents of a damaged chunk
        self.header: Header | None = None
        self._data_ends: list[int] = []
        self._seen: set[int] = set()  # channels of messages, whose definition may be lost
        self._closed = False  # past a footer
        self._ended = False  # past the data section of a log
        self._last: Block | Gap | None = None  # what message indexes would belong to
        self._unframed: Gap | None = None  # behind this gap nothing shows yet whether we are inside a chunk

    def run(self) -> None:
        """Goes from the first byte to the limit."""
        limit, chunks = self.limit, sorted(self.index)
        position = self._open()
        while position < limit:
            if len(self.items) + len(self.gaps) > MOST_ITEMS:
                raise LogError(
                    f"the log has more than {MOST_ITEMS} chunks and other records", expected="one that a recorder made"
                )
            if (block := self._vouched(position, limit)) is not None:
                self._take(block)
                position = block.end
                continue
            after = self._step(position)
            if after is None:
                following = bisect_right(chunks, position)
                after = self._gap(position, min(limit, chunks[following]) if following < len(chunks) else limit)
            position = after
        if self.trusted and not self._ended:
            self.losses.mend(f"the DataEnd record before byte {limit} is damaged; a new one can be made")
        elif self._ended and not self._closed and not self.trusted:
            self.losses.mend("the log ends inside its summary; a new one can be made")
        elif not self._ended and not (self.gaps and self.gaps[-1].offset + self.gaps[-1].length == limit):
            self.gaps.append(
                Gap(limit, 0, "the log stops here without an end: the recorder did not finish it, or it was cut off")
            )

    @property
    def data_end(self) -> int:
        """Where the DataEnd record begins; the end of the file, where there is none or more than one."""
        return self._data_ends[0] if len(self._data_ends) == 1 and len(self.sections.each) == 1 else self.source.size

    def _vouched(self, position: int, limit: int) -> Block | None:
        entry = self.index.get(position)
        if entry is None:
            return None
        try:
            return known_block(entry, limit)
        except LogError as error:
            self.losses.mend(reason(error))
            return None

    def _open(self) -> int:
        """The magic and the Header; returns where records begin."""
        at = len(MAGIC)
        found = self.frames.head(at)
        sound = found is not None and found[0] == Opcode.HEADER and self.frames.agrees(at, *found)
        if not self.frames.magic(0):
            self.losses.mend("the file does not begin as an MCAP log does")
            if not sound:
                return 0
        return at

    def _take(self, chunk: Block) -> None:
        self.items.append(chunk)
        self._last, self._unframed = chunk, None

    def _step(self, position: int) -> int | None:
        """Takes in what begins at a position; returns where the next record begins, or None where none can be made out."""
        frames = self.frames
        if frames.magic(position):
            self._border(position)
            return position + len(MAGIC)
        head = frames.head(position)
        if head is not None and head[0] == Opcode.MESSAGE:
            return self._messages(position, head[1])
        if head is None or not frames.agrees(position, *head):
            return self._damaged(position)
        return None if self._swallows(position, *head) else self._record(position, *head)

    def _swallows(self, position: int, opcode: int, length: int) -> bool:
        """Whether a record was cut off, and what was written next lies where the rest of it should.

        Then another log begins inside it, or the end of a chunk leads nowhere; and its CRC does not prove it whole.
        """
        end = position + HEAD.size + length
        astray = opcode == Opcode.CHUNK and not self.frames.leads_on(end)
        if self.trusted or not (astray or self.frames.find(position, end, ANOTHER) >= 0):
            return False
        try:
            if opcode == Opcode.CHUNK:
                records.unpack(self.source.at(position, end - position), position)
            elif opcode == Opcode.ATTACHMENT:
                return not Attached.of(self.source, position, length).check(self.source)
        except LogError:
            return True
        return opcode != Opcode.CHUNK

    def _border(self, position: int) -> None:
        """The magic inside the file: another log begins here, if a Header follows; else one has ended."""
        head = self.frames.head(position + len(MAGIC))
        if position and head is not None and head[0] == Opcode.HEADER:
            if not self._ended:
                self.gaps.append(Gap(position, 0, "a log stops here without an end, and another begins"))
            self.losses.mend(f"another log begins at byte {position}")
            self.sections.begin(position)
            self._ended, self._closed, self._last, self._unframed = False, False, None, None

    def _record(self, position: int, opcode: int, length: int) -> int:
        """Takes in a record that agrees with itself; returns where it ends."""
        end = position + HEAD.size + length
        if opcode == Opcode.CHUNK:
            head = self.frames.chunk(position, length)
            assert head is not None, "a chunk that agrees has a head"
            self._take(Block(position, end - position, end, head.start_ns, head.end_ns, head.compression, vouched=False))
        elif opcode == Opcode.MESSAGE_INDEX:
            self._message_index(position, length)
        elif opcode == Opcode.HEADER:
            if self.header is None:
                self.header = records.parse(Header, self.source.at(position + HEAD.size, length), position)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._define(opcode, self.source.at(position + HEAD.size, length), position, vouched=False)
            if not self._ended:
                self.items.append(Span(opcode, position, end - position))
        elif opcode == Opcode.FOOTER:
            self._moved_summary(position)
            self._closed = self.frames.magic(end)
        elif opcode == Opcode.DATA_END:
            self._data_ends.append(position)
            self._ended, self._last, self._unframed = True, None, None
        elif opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
            self.items.append(Span(opcode, position, end - position))
        return end

    def _moved_summary(self, position: int) -> None:
        """A summary that is not where it says it is tells by how far, and so where its log began in the file."""
        if not self._ended or not self._data_ends:
            return
        footer = records.parse(Footer, self.source.at(position + HEAD.size, FOOTER_SIZE - HEAD.size), position)
        start, stop = self._data_ends[-1] + HEAD.size + 4, position + FOOTER_SIZE - 4
        base = start - footer.summary_start
        if self.trusted or not footer.summary_crc or not footer.summary_start or base < 0:
            return
        if stop - start > MOST_SUMMARY:
            return
        raw = self.source.at(start, stop - start)
        if zlib.crc32(raw) != footer.summary_crc:
            return
        if self.sections.begin(base):
            self.losses.mend(f"another log begins at byte {base}, as its summary says")
        at = 0
        while len(raw) - at >= HEAD.size:
            opcode, length = HEAD.unpack_from(raw, at)
            self._define(opcode, raw[at + HEAD.size : at + HEAD.size + length], base, vouched=True)
            at += HEAD.size + length

    def _define(self, opcode: int, body: bytes, offset: int, *, vouched: bool) -> None:
        """Takes in a definition; one that contradicts what is vouched for is left out."""
        if opcode not in DEFINITIONS:
            return
        try:
            said = self.sections.define(opcode, body, offset, vouched=vouched)
        except LogError as error:
            said = reason(error)
        if said:
            self.losses.mend(said)

    def _message_index(self, position: int, length: int) -> None:
        """A message index belongs to the chunk right before it, or tells what was in one that is lost."""
        last, self._unframed = self._last, None
        if isinstance(last, Gap):
            self._count(last, position, length)
        elif last is not None and last.end == position:
            channel, size = struct.unpack("<HI", self.source.at(position + HEAD.size, 6))
            last.end = position + HEAD.size + length
            if size:
                last.indexes[channel] = position

    def _count(self, gap: Gap, position: int, length: int) -> None:
        """A message index whose chunk is lost still tells what was in it."""
        body = self.source.at(position + HEAD.size, length)
        (channel,) = struct.unpack_from("<H", body)
        entries = np.frombuffer(body, "<u8", offset=6).reshape(-1, 2)
        if not gap.counted:
            gap.counts, gap.counted = Counter(), True
        gap.counts[channel] += len(entries)
        if len(entries) and entries[:, 0].max() < LATEST_NS:
            first, final = int(entries[:, 0].min()), int(entries[:, 0].max())
            gap.start_ns = first if gap.start_ns is None else min(first, gap.start_ns)
            gap.end_ns = final if gap.end_ns is None else max(final, gap.end_ns)

    def _damaged(self, position: int) -> int | None:
        """A record that does not agree with itself, or that nobody knows; None where not even its end is known."""
        frames = self.frames
        if frames.limit - position < HEAD.size:
            return None
        opcode, length = self.source.head(position)
        fits = length <= frames.limit - position - HEAD.size and frames.leads_on(position + HEAD.size + length)
        for own in (length if fits else None, frames.own_length(position)):  # a chunk whose opcode or length is what is damaged
            if own is not None and (opcode == Opcode.CHUNK or frames.chunk(position, own) is not None):
                end = position + HEAD.size + own
                if frames.leads_on(end):
                    start_ns, end_ns = struct.unpack("<QQ", self.source.at(position + HEAD.size, 16))
                    self._take(Block(position, end - position, end, start_ns, end_ns, "", vouched=False))
                    return end
        if not fits:
            return None
        whole = HEAD.size + length
        if opcode >= PRIVATE:
            self.items.append(Span(opcode, position, whole))
        elif (opcode in SUMMARY and self._ended) or (opcode == Opcode.MESSAGE_INDEX and self._last is not None):
            self.losses.mend(f"the {records.name_of(opcode)} record at byte {position} is damaged; a new one can be made")
            if isinstance(self._last, Block) and self._last.end == position:
                self._last.end += whole
        else:
            self.gaps.append(Gap(position, whole, f"the {records.name_of(opcode)} record here is damaged"))
        return position + whole

    def _messages(self, position: int, length: int) -> int | None:
        """A run of messages outside chunks, as one block; its last one counts only if what follows shows where it ends."""
        limit = self.frames.limit
        raw = self.source.at(position, min(max(RUN_BYTES, HEAD.size + length), limit - position))
        offsets, _, end = records.scan(raw, bare=True)
        if not self._bounded(position + end, raw, offsets):
            end = int(offsets[-1])
        another = -1 if self.trusted else self.frames.find(position, position + end, ANOTHER)
        if another >= 0:
            end = int(offsets[offsets <= another - position][-1])
        if not end:
            return None
        found = records.messages(raw[:end], position)
        times = found.heads["log_time"]
        self._seen.update(np.unique(found.heads["channel"]).tolist())
        block = Block(position, end, position + end, int(times.min()), int(times.max()), None, vouched=False)
        self.items.append(block)
        self._last = self._unframed
        if self._unframed is not None:
            self.doubtful.append((block, self._unframed))
        return position + end

    def _bounded(self, end: int, raw: bytes, offsets: Int64[np.ndarray, " n"]) -> bool:
        """Whether the last message of a run ends at `end` indeed: a record follows, if perhaps a damaged one."""
        frames = self.frames
        if frames.leads_on(end):
            return True
        room = frames.limit - end
        if room >= HEAD.size:
            opcode, length = self.source.head(end)
            if opcode in LEAST and opcode != Opcode.MESSAGE and length < 1 << 48:
                return True  # a record of another kind, which goes on beyond the end of the file or is damaged
        if room < HEAD.size + 2:
            return self.source.at(end, 1)[0] in LEAST
        heads = [raw[at : at + HEAD.size + 2] for at in offsets[-256:].tolist()]
        if heads[-1] in heads[:-1]:
            return True  # as long as one before it on its channel
        following = self.source.at(end, HEAD.size + 2)
        opcode, length = HEAD.unpack_from(following)
        known = self.sections.channels() | self._seen | {int.from_bytes(head[HEAD.size :], "little") for head in heads}
        if opcode == Opcode.MESSAGE and int.from_bytes(following[HEAD.size :], "little") in known:
            return True
        return bool(length <= room - HEAD.size and length >= FIXED and frames.leads_on(end + HEAD.size + length))

    def _gap(self, position: int, limit: int) -> int:
        """Goes on to the next record that convinces; what lies between is lost."""
        frames = self.frames
        after = frames.next(position + 1, limit, self.sections.channels() | self._seen)
        gap = Gap(position, after - position, self._what_broke(position))
        if frames.tried > MOST_TRIED:
            gap.reason += "; the search for what follows was given up after too many false starts"
        first = self.source.at(position, min(64, frames.limit - position))
        if len(first) >= HEAD.size + 16 and first[0] == Opcode.CHUNK:
            start_ns, end_ns = struct.unpack_from("<QQ", first, HEAD.size)
            if start_ns <= end_ns < LATEST_NS:
                gap.start_ns, gap.end_ns = start_ns, end_ns
        following = frames.head(after)
        if self._ended and not self._closed and (following is None or following[0] in SUMMARY | {Opcode.FOOTER, *DEFINITIONS}):
            self.losses.mend(f"{after - position} bytes of the summary at byte {position} are damaged; a new one can be made")
            return after
        if self._ended and frames.empty(position, after):
            self.losses.mend(f"{after - position} zero bytes follow the end of the log, at byte {position}")
            return after
        self.gaps.append(gap)
        self._last = self._unframed = gap
        return after

    def _what_broke(self, position: int) -> str:
        room = self.frames.limit - position - HEAD.size
        if room < 0:
            return "the log is cut short here, inside the head of a record"
        opcode, length = self.source.head(position)
        if opcode not in set(Opcode):
            return "no record begins here"
        name = records.name_of(opcode)
        if length > room:
            return f"the {name} record here says it has {length} bytes, and {room} are there"
        return f"the {name} record here is damaged"


def reason(error: LogError) -> str:
    """What an error says, as part of a line."""
    return error.what + (f", expected {error.expected}" if error.expected else "")
