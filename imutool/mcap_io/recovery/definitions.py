"""What the ids in a log that may be damaged mean: definitions are learnt from what is left, and messages then go by them.

The ids in a chunk are those of the log it lies in (`sections`); what callers see has the ids of the whole file.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Int64

from imutool.errors import LogError
from imutool.mcap_io.codec import records
from imutool.mcap_io.codec.records import HEAD
from imutool.mcap_io.index import Block
from imutool.mcap_io.losses import Losses
from imutool.mcap_io.recovery.chunk_repair import MOST_SEARCHED, definitions
from imutool.mcap_io.recovery.scan import LATEST_NS, reason
from imutool.mcap_io.sections import Section, Sections
from imutool.mcap_io.storage.source import Source

MOST_AGREED = 1000  # definitions that need no second look: some writers repeat all of theirs in every chunk


def learn(sections: Sections, losses: Losses, found: records.Messages, block: Block) -> None:
    """The definitions in a chunk; if they contradict what is vouched for, another log has begun."""
    each = [(opcode, found.data[first : first + length].tobytes()) for opcode, first, length in found.definitions]
    proven = block.offset not in losses.unchecked_in
    for again in (False, True):
        try:
            for opcode, body in each:
                said = sections.define(opcode, body, block.offset, vouched=proven)
                if said:
                    losses.mend(said)
            return
        except LogError as error:
            if again or not sections.begin(block.offset):
                losses.mend(reason(error))
                return
            losses.mend(f"another log begins at byte {block.offset}: the chunk there defines ids anew")


def search(sections: Sections, source: Source, blocks: Sequence[Block], damaged: Sequence[tuple[int, int]]) -> None:
    """Where sound messages lack a definition, it is looked for in the damaged stretches (first byte, bytes) of their log."""
    for section in sections.each:
        stop = sections.end(section) or source.size + 1
        for offset, length in sorted(stretch for stretch in damaged if section.start <= stretch[0] < stop):
            used = {c for block in blocks if section.start <= block.offset < stop for c in block.counts or block.indexes}
            if used <= section.readable():
                break
            for opcode, body in definitions(source.at(offset, min(length, MOST_SEARCHED))):
                sections.define(opcode, body, offset, vouched=False)


def counted(section: Section, counts: Mapping[int, int]) -> dict[int, int]:
    """Counts by the ids of the whole, without the messages that mean nothing."""
    ids, settled = section.ids, Counter[int]()
    for local, count in counts.items():
        if local in ids:
            settled[ids[local]] += count
    return dict(settled)


def refuse_others(sections: Sections, found: records.Messages, block: Block, agreed: set[bytes]) -> None:
    """A chunk that a CRC proves, and that defines ids otherwise than the log it lies in, is another log's.

    Bodies of definitions that need no second look are gathered in `agreed`.

    Raises:
        LogError: the chunk is another log's, or a definition in it is damaged.
    """
    for opcode, first, length in found.definitions:
        body = found.data[first : first + length].tobytes()
        if body in agreed:
            continue
        if sections.contradicts(opcode, body, block.offset):
            raise LogError(f"the chunk at byte {block.offset} defines another {records.name_of(opcode)} under an id in use")
        if len(agreed) < MOST_AGREED:
            agreed.add(body)


def by_the_whole(section: Section, found: records.Messages) -> tuple[Int64[np.ndarray, " n"], Bool[np.ndarray, " n"]] | None:
    """The channel of each message by the ids of the whole, -1 where nobody defines it, and which messages mean something.

    None where the messages can stay as they are.
    """
    ids, heads = section.ids, found.heads
    local = np.unique(heads["channel"]).tolist()
    late = heads["log_time"] >= LATEST_NS
    if (
        not late.any()
        and all(ids.get(channel) == channel for channel in local)
        and not ((section.start or section.renamed) and found.definitions)
    ):
        return None
    table = np.full(1 << 16, -1, np.int64)
    table[list(ids)] = list(ids.values())
    channels = table[heads["channel"]]
    return channels, ~late & (channels >= 0)


def edited(found: records.Messages, keep: Bool[np.ndarray, " n"], channels: Int64[np.ndarray, " k"]) -> records.Messages:
    """Some of the messages, one behind the other, with other channel ids."""
    offsets, heads = found.offsets[keep], found.heads[keep].copy()
    sizes = heads["length"].astype(np.int64) + HEAD.size
    data = b"".join(found.data[a : a + n].tobytes() for a, n in zip(offsets.tolist(), sizes.tolist(), strict=True))
    view = np.frombuffer(data, np.uint8).copy()
    places = np.cumsum(sizes) - sizes
    heads["channel"] = channels
    for byte in range(2):
        view[places + HEAD.size + byte] = channels >> (8 * byte) & 0xFF
    return records.Messages(view, places, heads, [])
