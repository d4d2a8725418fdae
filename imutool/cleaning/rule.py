"""What every rule is: a station that samples pass, in one pass over the log, and what it says at the end."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from jaxtyping import Float64, Int64

from imutool.cleaning.finding import Finding
from imutool.cleaning.motion import Motion
from imutool.cleaning.samples import Numbers, Samples
from imutool.cleaning.settings import Rules
from imutool.cleaning.truth import Truth


@dataclass
class Whole:
    """What is known of a topic when all its samples have passed; the rules read it in their order and may add to it.

    Attributes:
        scale: what gyro and accel are to be multiplied by to be rad/s and m/s².
        late_ns: stamps of samples that came too late, in order (from `time_back`): they are not missing.
        jumps: numbers of the samples before which the clock of the stamps stepped (from `clock_jumps`).
        other_rate_ns: stretches at another rate (from `changed_rate`).
    """

    rules: Rules
    messages: int
    motion: Motion
    truth: Truth | None
    scale: Float64[np.ndarray, "6"] = field(default_factory=lambda: np.ones(6))
    late_ns: Int64[np.ndarray, " n"] = field(default_factory=lambda: np.zeros(0, np.int64))
    jumps: frozenset[int] = frozenset()
    other_rate_ns: Sequence[tuple[int, int]] = ()


class Rule(ABC):
    """One kind of defect. Made anew for each pass; what it remembers does not grow with the log, but for a row a second.

    Attributes:
        place: rules see the samples in this order, those that drop some before those that measure what is left.
        dropped: the numbers of the messages to be left out.
    """

    place: ClassVar[int]

    def __init__(self) -> None:
        self.dropped: list[Numbers] = []

    def __call__(self, stream: Iterable[Samples]) -> Iterator[Samples]:
        """The samples that are left; a rule that drops none only overrides `see`."""
        for samples in stream:
            self.see(samples)
            yield samples

    def see(self, samples: Samples) -> None:
        """The next samples, of which none is to be dropped."""
        return

    @abstractmethod
    def findings(self, whole: Whole) -> Iterator[Finding]:
        """What was found, once everything has passed."""
