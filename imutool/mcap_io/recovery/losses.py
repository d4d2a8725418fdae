"""Losses of a damaged log: byte ranges with reasons, and the messages lost in them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from imutool.errors import LogError

LATEST_NS = 2**63  # no clock shows log times from here on (the year 2262)
MAX_LINES = 20  # of stretches in a description
MAX_LISTED = 1000  # stretches; a hostile file could have one every few bytes


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
        """Returns JSON values; `messages` is null where their number is not known."""
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
    """Damage found in a log so far; true if something was lost.

    `harmless` lists damage without loss: a summary, a message index, a chunk's head that could be rebuilt. `unchecked` counts
    messages that no CRC covers, which may differ from what was recorded.
    """

    entries: list[Loss] = field(default_factory=list)
    harmless: list[str] = field(default_factory=list)
    unlisted: int = 0  # stretches beyond those listed
    bytes: int = 0
    unchecked_topics: list[str] = field(default_factory=list)  # topics whose definition no CRC covers
    unproven: int = 0  # messages of which two definitions are possible
    assumed: int = 0  # messages behind damage that nothing but their channel ids gives to their topics
    unchecked_in: dict[int, int] = field(default_factory=dict)  # messages without CRC, by the offset of their stretch

    def __bool__(self) -> bool:
        return bool(self.entries)

    @property
    def intact(self) -> bool:
        """Whether nothing was lost and nothing had to be rebuilt."""
        return not (self.entries or self.harmless or self.assumed)

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
        return not self.unlisted and all(entry.exact for entry in self.entries)

    def add(self, loss: Loss) -> None:
        """Takes in a stretch."""
        self.bytes += loss.length
        if len(self.entries) < MAX_LISTED:
            self.entries.append(loss)
            self.entries.sort(key=lambda entry: entry.offset)
        else:
            self.unlisted += 1

    def add_harmless(self, what: str) -> None:
        """Takes in damage without loss."""
        if len(self.harmless) < MAX_LISTED and what not in self.harmless:
            self.harmless.append(what)

    def plain(self) -> dict[str, Any]:
        """Returns JSON values; `messages` is null where their number is not known."""
        return {
            "whole": self.intact,
            "bytes": self.bytes,
            "messages": sum(self.topics.values()) if self.exact else None,
            "topics": self.topics,
            "stretches": [entry.plain() for entry in self.entries],
            "stretches_not_listed": self.unlisted,
            "mended": list(self.harmless),
            "unproven_messages": self.unproven,
            "assumed_messages": self.assumed,
            "unchecked_messages": self.unchecked,
            "unchecked_definitions": list(self.unchecked_topics),
        }


def describe(losses: Mapping[str, Any]) -> list[str]:
    """Lines for a person from `Losses.plain`: one for each stretch, at most `MAX_LINES`."""
    stretches, mended = losses["stretches"], losses["mended"]
    lines = [f"lost: {_stretch(entry)}" for entry in stretches[:MAX_LINES]]
    if (more := len(stretches) + losses["stretches_not_listed"] - len(lines)) > 0:
        lines.append(f"lost: {more} more stretches")
    lines += [f"mended: {what}" for what in mended[:MAX_LINES]]
    if len(mended) > MAX_LINES:
        lines.append(f"mended: {len(mended) - MAX_LINES} more places")
    if losses.get("unproven_messages"):
        lines.append(
            f"unproven: {losses['unproven_messages']} messages may be of either of two recordings, and are on no topic"
        )
    return lines + [f"unchecked: {what}" for what in unchecked(losses)]


def unchecked(losses: Mapping[str, Any]) -> Iterator[str]:
    """Yields what nothing proves, in words."""
    if losses.get("assumed_messages"):
        yield f"{losses['assumed_messages']} messages behind damage are on their topics by nothing but their channel ids"
    if losses["unchecked_messages"]:
        yield f"{losses['unchecked_messages']} messages lie where no CRC covers them"
    if losses["unchecked_definitions"]:
        yield f"no CRC covers the definition of {', '.join(losses['unchecked_definitions'])}"


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


def reason(error: LogError) -> str:
    """Text of an error, as part of a line."""
    return error.what + (f", expected {error.expected}" if error.expected else "")
