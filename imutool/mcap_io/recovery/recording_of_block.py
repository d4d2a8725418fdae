"""Decide which recording each block of a damaged file belongs to.

One file may hold parts of several logs: each is a recording whose ids mean what its own records say. A block's recording
follows from the definitions in the block, from a summary that lists it, from the unbroken chain of records to its log's begin,
and last from what its messages decode as. What stays open is on no topic.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from hashlib import sha256

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from imutool.mcap_io.blocks import MessageBlock
from imutool.mcap_io.codec import messages
from imutool.mcap_io.recovery.definitions import NO_HABITS, Recording, key_pairs, parsed, topics_of
from imutool.mcap_io.recovery.losses import Losses
from imutool.mcap_io.recovery.scan_events import (
    Definition,
    Event,
    Gap,
    LogEnd,
    LogStart,
    ScannedBlock,
    definition_runs,
    note_habits,
)
from imutool.mcap_io.recovery.summary import Summary, recording_of


class Recordings:
    """Recordings of a file, and which of them each block is of (`MessageBlock.recording`)."""

    def __init__(
        self, summaries: Sequence[Summary], losses: Losses, found_in: Callable[[MessageBlock], messages.Messages]
    ) -> None:
        self.losses, self.found_in = losses, found_in
        self.each: list[Recording] = []
        self.unproven: dict[int, dict[int, str]] = {}  # by a block's offset: its channels of which several topics are possible
        self._current: Recording | None = None
        self._named: Recording | None = None  # the last one that is not anonymous
        self._early: list[ScannedBlock] = []  # blocks whose definitions, if any, come behind them
        self._certain = False  # an unbroken chain of records leads from the definitions of the current one to here
        self._follows = True  # the next block may go on with the one before: no data section ends between them
        self._behind_gap: list[ScannedBlock] | None = None  # blocks since the last gap, where one came since the log began
        self.each += [recording_of(summary, losses) for summary in summaries]

    def of(self, block: MessageBlock) -> Recording:
        """The recording of a block."""
        return self.each[block.recording]

    def assign(self, events: Sequence[Event]) -> None:
        """Finds the recording of every block, in file order."""
        blocks = [event for event in events if isinstance(event, ScannedBlock)]
        self._complete(blocks)
        note_habits(events)
        runs = definition_runs(events)
        for event in events:
            if isinstance(event, LogStart):
                self._begin(event.offset)
            elif isinstance(event, LogEnd):
                if self._current is not None:
                    self._current.ended |= event.closed
                self._certain = self._follows = False
            elif isinstance(event, Gap):
                event.recording = self.each.index(self._now)
                self._now.gapped = True
                self._current, self._certain, self._behind_gap = self._named, False, []
            elif isinstance(event, Definition):
                self._take_definitions(runs.get(id(event), []))
            else:
                self._assign(event)
        self._behind_gap = None
        for found in blocks:
            self._doubt(found)
        for recording in self.each:
            self._give_up_misfits(recording, [found for found in self._early if self.of(found.block) is recording])
        for found in self._early:
            self._verify(found, self.of(found.block))
        self._name_logs([found.block for found in blocks])
        alike = [f.block for f in blocks if not (f.evidence or self.of(f.block).anonymous or f.block.offset in self.unproven)]
        self.losses.assumed = sum(sum((block.counts or {}).values()) for block in alike)

    def _complete(self, blocks: Sequence[ScannedBlock]) -> None:
        """Completes what a summary says by what the chunks are that it lists."""
        keys = {found.key for found in blocks}
        for recording in self.each:
            if recording.lists and not recording.lists & keys:  # one field of every entry is wrong; do the others agree?
                pairs = {pair for key in recording.lists for pair in key_pairs(key)}
                recording.lists = {key for key in keys if not pairs.isdisjoint(key_pairs(key))} or recording.lists
        for found in blocks:  # a summary may leave definitions out; those of the chunks it lists are its own
            own = parsed(found.definitions, found.block.offset, self.losses)
            for recording in (r for r in self.each if own and found.key in (r.lists or ()) and r.agrees(own)):
                for record in own:
                    recording.define(record, proven=bool(found.crc))

    def _name_logs(self, blocks: Sequence[MessageBlock]) -> None:
        """Says where the blocks of another log begin."""
        met: list[Recording] = []
        for block in blocks:
            recording = self.of(block)
            if recording not in met:
                if any(recording.meaning(i) not in (None, other.meaning(i)) for other in met for i in other.readable()):
                    self.losses.add_harmless(f"another log begins at byte {block.offset}, or ahead of it")
                met.append(recording)

    def _assign(self, found: ScannedBlock) -> None:
        if self._behind_gap is not None:
            self._behind_gap.append(found)
        recording = self._choose(found)
        listed, own = found.key in (recording.lists or ()), parsed(found.definitions, 0, self.losses)
        kinds = {0} | {record.id for record in own if isinstance(record, Schema)}
        known = {record.id for record in own if isinstance(record, Channel) and record.schema_id in kinds}
        found.evidence = 3 if known >= set(found.block.counts or {}) else 2 if listed else int(self._certain)
        found.block.recording = self.each.index(recording)
        foreign = recording is not self._now and not listed  # of another log, although no record says that one begins
        self._current, self._named = recording, self._named if recording.anonymous else recording
        if not (found.block.counts or {}).keys() <= recording.readable():
            self._early.append(found)
        self._follows = True
        self._certain = not foreign and (self._certain or found.evidence > 1 or bool(known))
        recording.habits |= found.habits if found.evidence else NO_HABITS
        if found.evidence > 1:
            self._adopt(found, recording)
        else:
            self._verify(found, recording)

    def _adopt(self, found: ScannedBlock, recording: Recording) -> None:
        """Notes the sizes of a recording's messages, and a block to compare others with."""
        for channel in found.sizes.keys() & recording.readable():  # what is not defined yet may be another log's
            low, high = found.sizes[channel]
            minimum, maximum = recording.sizes.get(channel, (low, high))
            recording.sizes[channel] = min(low, minimum), max(high, maximum)
            recording.samples.setdefault(channel, found.block)

    def _verify(self, found: ScannedBlock, recording: Recording) -> None:
        """Give a block to no known log if it is written in another way, or if messages of unusual sizes do not decode."""
        foreign = not found.evidence and recording.habits.contradicts(found.habits)
        unusual = [
            channel
            for channel, (low, high) in found.sizes.items()
            if channel in recording.readable()
            and not (channel in recording.sizes and recording.sizes[channel][0] <= low <= high <= recording.sizes[channel][1])
        ]
        misfits = self._misfits(found, recording, unusual)
        compared = [self._fits(block, channel, recording) for channel, block in recording.samples.items()] if misfits else []
        never = bool(compared) and not any(compared)  # then the definitions never were those of the messages
        if not foreign and (not misfits or never):
            self._adopt(found, recording)
            return
        what = "are written in another way than those before them" if foreign else "do not fit the definitions before them"
        self.losses.add_harmless(f"messages from byte {found.block.offset} on {what}")
        recording.take_back(found.brought)
        self._current = self._new_behind_gap(found)
        self._current.anonymous = True
        self._give_up_misfits(self._current, [found])
        found.block.recording = len(self.each) - 1
        self.unproven.pop(found.block.offset, None)

    def _misfits(self, found: ScannedBlock, recording: Recording, unusual: Sequence[int]) -> bool:
        """Whether messages do not decode by definitions that others decode by: a writer may define a channel wrongly."""
        misfits = [channel for channel in unusual if not self._fits(found.block, channel, recording)]
        met = [channel for channel in misfits if channel in recording.samples]
        fitted = any(self._fits(recording.samples[channel], channel, recording) for channel in met)
        others = (recording.readable() & found.sizes.keys()) - set(misfits) if misfits else ()
        wrong = found.evidence and any(self._fits(found.block, channel, recording) for channel in others)
        return fitted or (len(met) < len(misfits) and not wrong)

    def _give_up_misfits(self, recording: Recording, blocks: Sequence[ScannedBlock]) -> None:
        """Takes definitions back that came behind messages of a log that nothing defines, where they fit some of them not."""
        readable = recording.readable() if recording.anonymous else set[int]()
        if any(not self._fits(found.block, i, recording) for found in blocks for i in readable & found.sizes.keys()):
            recording.schemas.clear()
            recording.channels.clear()

    @property
    def _now(self) -> Recording:
        return self._current or self.each[-1]

    def _begin(self, start: int) -> None:
        """Begins the log whose Header stands at a byte."""
        self._current = self._named = self._new(start)
        self._certain, self._behind_gap = True, None

    def _take_definitions(self, run: Sequence[Definition]) -> None:
        """Takes in definitions outside chunks that follow one another, unless they contradict earlier ones.

        Behind a log's end they are of another, as they are where most contradict proven ones: none of them then counts here.
        """
        found = [(d.offset, record) for d in run for record in parsed([(d.opcode, d.body)], d.offset, self.losses)]
        if found and self._now.ended:
            self._current = self._named = self._new(found[0][0])
        agree = [
            self._now.agrees([r]) for _, r in found if isinstance(r, Channel) and (Opcode.CHANNEL, r.id) in self._now.proven
        ]
        other = self._new(found[0][0], headless=True) if agree and 2 * sum(agree) <= len(agree) else None
        for offset, record in found:
            if not self._now.agrees([record]):
                what = f"{type(record).__name__.lower()} {record.id} has two definitions, the second at byte {offset}"
                key = int(Opcode.SCHEMA if isinstance(record, Schema) else Opcode.CHANNEL), record.id
                self.losses.add_harmless(
                    f"{what}; {'the one that a CRC covers' if key in self._now.proven else 'the first'} holds"
                )
            if other is not None or self._now.agrees([record]):
                (other or self._now).define(record, proven=False)

    def _choose(self, found: ScannedBlock) -> Recording:
        """The recording of a block, which may be a new one."""
        own = parsed(found.definitions, found.block.offset, self.losses) if found.definitions else []
        rest = set(found.block.counts or {}) - {record.id for record in own if isinstance(record, Channel)}
        every = (self._now, *self.each)
        agreeing = [r for r in every if r.agrees(own, proven=bool(found.crc))]
        agreeing = agreeing or [r for r in every if found.crc and r.outweighed(own, rest)]
        listed = [r for r in agreeing if r.lists and found.key in r.lists]
        if not agreeing:
            chosen = self._new_behind_gap(found)
        elif own and not rest:
            chosen = (listed or [r for r in agreeing if r.lists is None] or agreeing)[0]  # a summary lists all of its log
        else:
            chosen = self._among(found, rest, [r for r in listed if rest <= r.readable()] or agreeing)
        found.brought = [record for record in own if chosen.define(record, proven=bool(found.crc))]
        return chosen

    def _fits(self, block: MessageBlock, channel: int, recording: Recording) -> bool:
        """Whether messages of a channel decode by the recording's definition; True if unknown."""
        return recording.fits(channel, lambda: self.found_in(block))

    def drop_copies(self, blocks: Sequence[ScannedBlock]) -> None:
        """Keeps of equal chunks the one whose recording is best known; equally well known ones may be of any of theirs."""
        chunks = [found for found in blocks if found.block.compression is not None and found.block.counts]
        often = Counter((found.key, found.crc) for found in chunks)
        equal: dict[object, list[ScannedBlock]] = {}
        for found in (found for found in chunks if often[found.key, found.crc] > 1):
            equal.setdefault((found.crc, sha256(self.found_in(found.block).data.tobytes()).digest()), []).append(found)
        for copies in equal.values():
            best = max(map(self._evidence, copies))
            candidates = [found for found in copies if self._evidence(found) == best]
            kept, pool = candidates[0], [self.of(found.block) for found in candidates]
            kept.block.recording = self.each.index(self._by_content(kept, set(kept.block.counts or {}), pool))
            for other in (found.block for found in copies if found is not kept):
                other.lost = True
                self.losses.add_harmless(f"the chunk at byte {other.offset} repeats the one at byte {kept.block.offset}")

    def _evidence(self, found: ScannedBlock) -> tuple[bool, int]:
        """Evidence for the definitions of a block: whether each is readable, and how much speaks for them."""
        readable = self.of(found.block).readable() - self.unproven.get(found.block.offset, {}).keys()
        return (found.block.counts or {}).keys() <= readable, found.evidence

    def _new(self, start: int, *, headless: bool = False) -> Recording:
        self.each.append(Recording(start, headless=headless))
        return self.each[-1]

    def _new_behind_gap(self, found: ScannedBlock) -> Recording:
        """A recording of which a block is, with what others since the last gap define that do not contradict the block."""
        new = self._new(found.block.offset, headless=True)
        for block in (found, *(self._behind_gap or ())):
            own = parsed(block.definitions, block.block.offset, self.losses)
            for record in own if new.agrees(own) else ():
                new.define(record, proven=bool(block.crc))
        return new

    def _among(self, found: ScannedBlock, used: set[int], pool: Sequence[Recording]) -> Recording:
        """The recording of a block that does not define all of its ids itself."""
        given = pool = list({id(r): r for r in pool}.values())
        unlisted = [r for r in pool if r.lists is None or found.key in r.lists]
        if (self._certain or (self._now.anonymous and self._follows)) and self._now in unlisted:
            return self._now
        for narrower in (
            unlisted,
            [r for r in pool if not r.habits.contradicts(found.habits)],
            [r for r in pool if r.may_define(used)],
            [r for r in pool if not r.ended],
            [r for r in pool if r.start <= found.block.offset],
        ):
            pool = [r for r in pool if r in narrower] or pool
        alone = used <= self._now.readable() and not any(used <= r.readable() for r in pool)
        if self._certain and self._now in (given if alone else pool):
            return self._now
        return self._by_content(found, used, pool)

    def _doubt(self, found: ScannedBlock) -> None:
        """Weighs a block behind a gap against the logs behind it whose begin is lost: it may lie in one of them."""
        used, own = set(found.block.counts or {}), self.of(found.block)
        later = [r for r in self.each if r.headless and r.start > found.block.offset and r.may_define(used)]
        if later and not found.evidence and used <= own.readable():
            found.block.recording = self.each.index(self._by_content(found, used, [own, *later]))

    def _by_content(self, found: ScannedBlock, used: set[int], pool: Sequence[Recording]) -> Recording:
        """The first recording whose definitions fit a block's messages; notes channels of which several topics are possible."""
        open_ids = {i for i in used if len(topics_of(i, pool)) > 1}
        if not open_ids:  # of two definitions of one topic the proven holds
            return max(pool, key=lambda r: (len(used & r.readable()), sum((int(Opcode.CHANNEL), i) in r.proven for i in used)))
        pool = [r for r in pool if all(self._fits(found.block, i, r) for i in open_ids)] or pool
        if still := {i: " or ".join(sorted(topics)) for i in open_ids if len(topics := topics_of(i, pool)) > 1}:
            self.unproven[found.block.offset] = still
        return max(pool, key=lambda r: len(used & r.readable()))
