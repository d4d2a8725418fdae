"""Findings of the rules, their intervals, and the score and verdict that follow from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from imutool.array_types import Int64
from imutool.cleaning.samples import Numbers
from imutool.report import Section

Severity = Literal["note", "warning", "error"]
Action = Literal["dropped", "converted", "flagged"]
Verdict = Literal["good", "usable", "quarantine"]

JOIN = 64  # samples: defects nearer to one another than this are one interval
MAX_INTERVALS = 100  # listed of one finding; the rest is counted
MAX_SHOWN = 3  # of them in a table; all are in the JSON
CORRECTED, FLAGGED, ERROR = 0.02, 0.05, 0.3  # what a kind of finding costs the score


@dataclass(frozen=True)
class Finding:
    """One kind of defect in one topic.

    Attributes:
        count: of samples, steps or axes, as `what` says.
        intervals_ns: header stamps of the first and last affected sample; at most `MAX_INTERVALS`.
        confidence: that this is a defect and the action right, 0 to 1.
        distrust: the reason not to use the log, if there is one.
    """

    rule: str
    severity: Severity
    what: str
    count: int
    intervals_ns: tuple[tuple[int, int], ...] = ()
    intervals_left_out: int = 0
    values: dict[str, Any] = field(default_factory=dict)
    action: Action = "flagged"
    confidence: float = 1.0
    distrust: str = ""

    def when(self, start_ns: int) -> str:
        """Times of its first intervals (s), as `0.118, 5.437–6.318 and 2 more`."""
        ends = [tuple(f"{(ns - start_ns) * 1e-9:.3f}" for ns in interval) for interval in self.intervals_ns[:MAX_SHOWN]]
        more = len(self.intervals_ns) - len(ends) + self.intervals_left_out
        text = ", ".join(first if first == last else f"{first}–{last}" for first, last in ends)
        return text + (f" and {more} more" if more else "") if text else "whole log"

    def report(self, start_ns: int) -> FindingReport:
        """Report entry; seconds count from the topic's first good sample."""
        return FindingReport(
            rule=self.rule,
            severity=self.severity,
            what=self.what,
            count=self.count,
            intervals_ns=list(self.intervals_ns),
            intervals_s=[(round((a - start_ns) * 1e-9, 6), round((b - start_ns) * 1e-9, 6)) for a, b in self.intervals_ns],
            intervals_left_out=self.intervals_left_out,
            values=self.values,
            action=self.action,
            sure=self.confidence,
            distrust=self.distrust,
        )


class FindingReport(Section, frozen=True):
    """A finding in JSON."""

    rule: str
    severity: Severity
    what: str
    count: int
    intervals_ns: list[tuple[int, int]]
    intervals_s: list[tuple[float, float]]
    intervals_left_out: int
    values: dict[str, Any]
    action: Action
    sure: float
    distrust: str


class Intervals:
    """Intervals of affected samples; neighbours join, and the first `MAX_INTERVALS` are kept.

    Further intervals are only counted.
    """

    def __init__(self) -> None:
        self.count = 0
        self.left_out = 0
        self.intervals: list[tuple[int, int]] = []
        self._last: int | None = None

    def add(self, number: Numbers, stamp_ns: Int64[np.ndarray, " n"]) -> None:
        """Add the next samples, in order."""
        if not len(number):
            return
        far = np.diff(number, prepend=number[0] - JOIN - 1 if self._last is None else self._last) > JOIN
        if not far[0] and not self.left_out:  # goes on from the interval before
            part = stamp_ns[: int(np.argmax(far)) if far.any() else len(far)]
            first, last = self.intervals[-1]
            self.intervals[-1] = min(first, int(part.min())), max(last, int(part.max()))
        for start, end in pairwise([*np.flatnonzero(far), len(far)]):
            if len(self.intervals) == MAX_INTERVALS:
                self.left_out += 1
            else:
                self.intervals.append((int(stamp_ns[start:end].min()), int(stamp_ns[start:end].max())))
        self._last = int(number[-1])
        self.count += len(number)

    def add_run(self, numbers: tuple[int, int], stamps_ns: tuple[int, int], count: int) -> None:
        """Add a run of samples by its first and last one; a long run, too, is one interval."""
        self.add(np.array(numbers[:1]), np.array(stamps_ns[:1]))
        if not self.left_out:
            first, last = self.intervals[-1]
            self.intervals[-1] = first, max(last, stamps_ns[1])
        self._last = numbers[1]
        self.count += count - 1

    def where(self) -> dict[str, Any]:
        """Count and intervals, by the names of `Finding`."""
        return {"count": self.count, "intervals_ns": tuple(self.intervals), "intervals_left_out": self.left_out}


def score(messages: int, valid: int, missing: int, findings: Sequence[Finding]) -> float:
    """Quality of the IMU's samples, 0 (no valid sample) to 1 (nothing found).

        score = share * prod(1 - penalty)

    `share` is that of valid samples among those received and missing (a message sent twice counts once). Each kind of finding
    (a rule, and its cost) counts once: a note costs nothing, a warning that was corrected (dropped, converted) 0.02, one that
    was only flagged 0.05, an error 0.3.
    """
    whole = messages + missing
    value = valid / whole if whole else 0.0
    for _, cost in {(finding.rule, _cost(finding)) for finding in findings}:
        value *= 1.0 - cost
    return value


def _cost(finding: Finding) -> float:
    if finding.severity == "error":
        return ERROR
    if finding.severity == "note":
        return 0.0
    return FLAGGED if finding.action == "flagged" else CORRECTED


def verdict(findings: Sequence[Finding], reasons: Sequence[str]) -> Verdict:
    """Verdict on the log: `good`, `usable` or `quarantine`.

    `quarantine`: there is a reason not to trust the log. `good`: all findings are notes.
    """
    if reasons:
        return "quarantine"
    return "usable" if any(finding.severity != "note" for finding in findings) else "good"
