"""Base class of the cleaning rules: a pipeline stage with findings at its end."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from jaxtyping import Float64, Int64

from imutool.cleaning.finding import Finding
from imutool.cleaning.samples import Motion, Numbers, Samples
from imutool.cleaning.settings import CleaningSettings
from imutool.cleaning.truth import Truth


@dataclass
class TopicSummary:
    """Totals of a topic after the pass; rules read them in order and may add to them.

    Attributes:
        scale: factors from the log's units to rad/s and m/s², gyro then accel.
        late_ns: sorted stamps of late samples (from `time_back`): they are not missing.
        jumps: numbers of the samples before which the clock of the stamps stepped (from `clock_jumps`).
        other_rate_ns: stretches at another rate (from `changed_rate`).
    """

    settings: CleaningSettings
    messages: int
    motion: Motion
    truth: Truth | None
    scale: Float64[np.ndarray, "6"] = field(default_factory=lambda: np.ones(6))
    late_ns: Int64[np.ndarray, " n"] = field(default_factory=lambda: np.zeros(0, np.int64))
    jumps: frozenset[int] = frozenset()
    other_rate_ns: Sequence[tuple[int, int]] = ()


class Rule(ABC):
    """Rule for one kind of defect; each pass over a log has its own instance.

    A rule may hold a row for each second of the log; all else has a fixed size.

    Attributes:
        place: position in the pipeline; rules that drop samples come before those that measure the rest.
        dropped: the numbers of the messages to be left out.
    """

    place: ClassVar[int]

    def __init__(self) -> None:
        self.dropped: list[Numbers] = []

    def __call__(self, stream: Iterable[Samples]) -> Iterator[Samples]:
        """Yield the samples that the rule keeps; a rule that drops none overrides `see` alone."""
        for samples in stream:
            self.see(samples)
            yield samples

    def see(self, samples: Samples) -> None:
        """Process the next samples; none is dropped."""
        return

    def second_pass(self, messages: int) -> Rule | None:
        """Rule for a second pass over the log, from the totals of the first; None if not needed."""
        return None

    @abstractmethod
    def findings(self, whole: TopicSummary) -> Iterator[Finding]:
        """Findings, after the last sample."""
