"""What happened in a log and when: gaps, stops, saturation, clock jumps, the worst error, what a diagnosis found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

Kind = Literal[
    "gap", "out_of_order", "clock_jump", "saturation", "spike", "stuck", "duplicate", "not_finite", "stop", "worst", "finding"
]
KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True)
class Event:
    """A stretch of time (or a moment: `start_ns == end_ns`) by header stamp, and what happened in words."""

    kind: Kind
    start_ns: int
    end_ns: int
    text: str
