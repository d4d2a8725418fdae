"""What a rule has found: which defect, how often, when, what was done about it, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Int64

from imutool.cleaning.samples import Numbers

Severity = Literal["note", "warning", "error"]
Action = Literal["dropped", "converted", "flagged"]

JOIN = 64  # samples: defects nearer to one another than this are one interval
MAX_INTERVALS = 100  # listed of one finding; the rest is counted


@dataclass(frozen=True)
class Finding:
    """One kind of defect in one topic.

    Attributes:
        count: of what `what` says: samples, steps, axes.
        intervals_ns: where, by header stamp, first and last affected sample; at most `MAX_INTERVALS`.
        sure: how sure it is that this is a defect and the action right, 0 to 1, as a person would say it.
        distrust: why the log should not be used, where that follows.
    """

    rule: str
    severity: Severity
    what: str
    count: int
    intervals_ns: tuple[tuple[int, int], ...] = ()
    intervals_left_out: int = 0
    values: dict[str, Any] = field(default_factory=dict)
    action: Action = "flagged"
    sure: float = 1.0
    distrust: str = ""

    def plain(self, start_ns: int) -> dict[str, Any]:
        """As JSON values; seconds count from the topic's first good sample."""
        seconds = [[round((a - start_ns) * 1e-9, 6), round((b - start_ns) * 1e-9, 6)] for a, b in self.intervals_ns]
        return {
            "rule": self.rule,
            "severity": self.severity,
            "what": self.what,
            "count": self.count,
            "intervals_ns": [list(pair) for pair in self.intervals_ns],
            "intervals_s": seconds,
            "intervals_left_out": self.intervals_left_out,
            "values": self.values,
            "action": self.action,
            "sure": self.sure,
            "distrust": self.distrust,
        }


class Places:
    """Samples as a bounded number of intervals: numbers near one another are one, and beyond the bound are only counted."""

    def __init__(self) -> None:
        self.count = 0
        self.left_out = 0
        self.intervals: list[tuple[int, int]] = []
        self._last: int | None = None

    def add(self, number: Numbers, stamp_ns: Int64[np.ndarray, " n"]) -> None:
        """Takes in the next samples, in order."""
        if not len(number):
            return
        before = number[0] - JOIN - 1 if self._last is None else self._last
        far = np.diff(number, prepend=before) > JOIN
        if not far[0] and not self.left_out:  # goes on from the interval before
            part = stamp_ns[: int(np.argmax(far)) if far.any() else len(far)]
            first, last = self.intervals[-1]
            self.intervals[-1] = min(first, int(part.min())), max(last, int(part.max()))
        starts = np.flatnonzero(far)
        for start, end in pairwise([*starts, len(far)]):
            if len(self.intervals) == MAX_INTERVALS:
                self.left_out += 1
            else:
                self.intervals.append((int(stamp_ns[start:end].min()), int(stamp_ns[start:end].max())))
        self._last = int(number[-1])
        self.count += len(number)

    def add_run(self, numbers: tuple[int, int], stamps_ns: tuple[int, int], count: int) -> None:
        """Takes in a stretch of samples by its first and last."""
        self.add(np.array(numbers), np.array(stamps_ns))
        self.count += count - 2

    def where(self) -> dict[str, Any]:
        """Count and intervals, by the names of `Finding`."""
        return {"count": self.count, "intervals_ns": tuple(self.intervals), "intervals_left_out": self.left_out}


def runs(mask: Bool[np.ndarray, " n"]) -> list[tuple[int, int]]:
    """Index ranges `[first, end)` in which a mask holds."""
    edges = np.flatnonzero(np.diff(mask.astype(np.int8), prepend=0, append=0))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
