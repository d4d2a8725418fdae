"""What a damaged log has lost: stretches of bytes with their reason, and the messages known to have lain in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

MOST_TOLD = 20  # lines to a person
MOST_LISTED = 1000  # stretches; a hostile file could have one every few bytes, and nobody reads that many


@dataclass(slots=True)
class Loss:
    """One stretch of a log that could not be saved; log times in ns."""

    offset: int
    length: int
    reason: str
    counts: Mapping[str, int] = field(default_factory=dict)  # messages known to be lost, by topic
    exact: bool = False  # whether that is all of them
    start_ns: int | None = None
    end_ns: int | None = None

    def plain(self) -> dict[str, Any]:
        """As JSON values; `messages` is null where their number is not known."""
        return {
            "offset": self.offset,
            "bytes": self.length,
            "reason": self.reason,
            "topics": dict(self.counts),
            "messages": sum(self.counts.values()) if self.exact else None,
            "first_ns": self.start_ns,
            "last_ns": self.end_ns,
        }


@dataclass
class Losses:
    """Everything known to be wrong with a log; true if something was lost.

    Damage that cost nothing (a summary, a message index, the head of a chunk that could be put right) is in `mended`. Of
    messages that no CRC covers, nobody can say whether they are as they were recorded: `unchecked` counts them.
    """

    entries: list[Loss] = field(default_factory=list)
    mended: list[str] = field(default_factory=list)
    left_out: int = 0  # stretches beyond those listed
    bytes: int = 0
    unproven: list[str] = field(default_factory=list)  # topics whose definition no CRC covers
    unchecked_in: dict[int, int] = field(default_factory=dict)  # messages without CRC, by the offset of their stretch

    def __bool__(self) -> bool:
        return bool(self.entries)

    @property
    def unchecked(self) -> int:
        """Messages read so far that no CRC covers."""
        return sum(self.unchecked_in.values())

    @property
    def topics(self) -> dict[str, int]:
        """Messages known to be lost, by topic."""
        found: dict[str, int] = {}
        for entry in self.entries:
            for topic, count in entry.counts.items():
                found[topic] = found.get(topic, 0) + count
        return dict(sorted(found.items()))

    @property
    def exact(self) -> bool:
        """Whether `topics` is all that was lost."""
        return not self.left_out and all(entry.exact for entry in self.entries)

    def add(self, loss: Loss) -> None:
        """Takes in a stretch."""
        self.bytes += loss.length
        if len(self.entries) < MOST_LISTED:
            self.entries.append(loss)
            self.entries.sort(key=lambda entry: entry.offset)
        else:
            self.left_out += 1

    def mend(self, what: str) -> None:
        """Takes in damage that cost nothing."""
        if len(self.mended) < MOST_LISTED and what not in self.mended:
            self.mended.append(what)

    def plain(self) -> dict[str, Any]:
        """As JSON values; `messages` is null where their number is not known."""
        return {
            "whole": not self.entries and not self.mended,
            "bytes": self.bytes,
            "messages": sum(self.topics.values()) if self.exact else None,
            "topics": self.topics,
            "stretches": [entry.plain() for entry in self.entries],
            "stretches_not_listed": self.left_out,
            "mended": list(self.mended),
            "unchecked_messages": self.unchecked,
            "unchecked_definitions": list(self.unproven),
        }


def told(losses: Mapping[str, Any]) -> list[str]:
    """What `Losses.plain` says, for a person: one line a stretch, the first `MOST_TOLD` of them."""
    stretches, mended = losses["stretches"], losses["mended"]
    lines = [f"lost: {_stretch(entry)}" for entry in stretches[:MOST_TOLD]]
    if (more := len(stretches) + losses["stretches_not_listed"] - len(lines)) > 0:
        lines.append(f"lost: {more} more stretches")
    lines += [f"mended: {what}" for what in mended[:MOST_TOLD]]
    if len(mended) > MOST_TOLD:
        lines.append(f"mended: {len(mended) - MOST_TOLD} more places")
    if losses["unchecked_messages"]:
        lines.append(f"unchecked: {losses['unchecked_messages']} messages lie where no CRC covers them")
    if losses["unchecked_definitions"]:
        lines.append(f"unchecked: no CRC covers the definition of {', '.join(losses['unchecked_definitions'])}")
    return lines


def _stretch(entry: Mapping[str, Any]) -> str:
    """Where, why, and which messages."""
    known = ", ".join(f"{count} on {topic}" for topic, count in entry["topics"].items())
    if entry["messages"] is None:
        which = f"{known} and more" if known else "an unknown number of messages"
    else:
        which = known or (f"{entry['messages']} messages" if entry["messages"] else "no message")
    first, last = entry["first_ns"], entry["last_ns"]
    when = "" if first is None or last is None else f", log time {first * 1e-9:.3f} to {last * 1e-9:.3f} s"
    return f"byte {entry['offset']}, {entry['bytes']} bytes: {entry['reason']} (lost: {which}{when})"
