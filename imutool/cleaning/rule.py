"""Base class of the rules: a stage of the pipeline that samples pass once, with findings at the end."""

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
    """Totals of a topic after all its samples have passed; rules read them in their order and may add to them.

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
    """One kind of defect. Each pass has its own instance; its memory is bounded, but for a row a second.

    Attributes:
        place: position in the pipeline; rules that drop samples come before those that measure the rest.
        dropped: the numbers of the messages to be left out.
    """

    place: ClassVar[int]

    def __init__(self) -> None:
        self.dropped: list[Numbers] = []

    def __call__(self, stream: Iterable[Samples]) -> Iterator[Samples]:
        """Pass on the samples that are left; a rule that drops none overrides `see` alone."""
        for samples in stream:
            self.see(samples)
            yield samples

    def see(self, samples: Samples) -> None:
        """Take in the next samples; none is dropped."""
        return

    def second_pass(self, messages: int) -> Rule | None:
        """The instance for a second pass over the log, from the first one's totals; None where one pass is enough."""
        return None

    @abstractmethod
    def findings(self, whole: TopicSummary) -> Iterator[Finding]:
        """Findings, after the last sample."""
