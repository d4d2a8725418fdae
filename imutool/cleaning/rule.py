"""Base class of the cleaning rules, a pipeline stage, and the settings that choose rules."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta

from imutool import registry
from imutool.array_types import Float64, Int64
from imutool.cleaning.conventions import Conventions, judge
from imutool.cleaning.finding import Finding
from imutool.cleaning.samples import FrameCounts, Motion, Numbers, Samples
from imutool.cleaning.truth import Truth
from imutool.cleaning.unit_evidence import FORCES, accel_reading
from imutool.config import Settings
from imutool.errors import ConfigError

GROUP = "imutool.clean"  # of rules: one file each

Share = Annotated[float, Meta(ge=0.0, le=1.0)]


class CleaningSettings(Settings, frozen=True, kw_only=True):
    """Rules that run (by default all), and the limits of trust."""

    only: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    convert_units: bool = True  # where the unit is settled beyond doubt; else it is only said
    fix: bool = False  # also axes, where the motion shows them
    max_invalid_share: Share = 0.1  # of the messages dropped, from which on the log is not trusted
    max_missing_share: Share = 0.3  # of the samples its own rate would have brought
    force: bool = False  # clean what cannot be trusted all the same

    def names(self) -> list[str]:
        """Rules that run, sorted by name.

        Raises:
            ConfigError: a name that is no rule; the message names the nearest.
        """
        known = every()
        for parameter, given in (("rules", self.only), ("skip_rules", self.without)):
            for name in set(given) - set(known):
                registry.load(GROUP, name, parameter)  # says what was meant
        return [name for name in known if (not self.only or name in self.only) and name not in self.without]


@cache
def every() -> tuple[str, ...]:
    """Rules, sorted by name; the installed packages are listed once."""
    return tuple(registry.names(GROUP))


def chosen(only: Iterable[str], without: Iterable[str], force: bool, fix: bool) -> CleaningSettings:
    """Settings for the rules of a command line.

    Raises:
        ConfigError: a name that is no rule, or one both asked for and left out.
    """
    rules = CleaningSettings(only=tuple(only), without=tuple(without), force=force, fix=fix)
    rules.names()
    if both := set(rules.only) & set(rules.without):
        raise ConfigError(f"{min(both)} is in both lists", where="rules, skip_rules", fix="Leave it out of one of them")
    return rules


@dataclass
class TopicSummary:
    """Totals of a topic after the pass; rules read them in order and may add to them.

    Attributes:
        frames: messages by the frame that they name.
        scale: factors from the log's units to rad/s and m/s², gyro then accel.
        axes: signed permutations that lead from the log's axes to right ones, gyro then accel.
        mount: that which leads from the IMU's axes to the body of the poses; no defect, and only the poses may be turned.
        world: rotation of the poses' world after which z is up.
        position_unit: of the poses' positions.
        quaternions: what is wrong with those of the poses; empty where nothing is.
        pose_delay_ns: by which the stamps of the poses are late.
        late_ns: sorted stamps of late samples (from `time_back`): they are not missing.
        jumps: numbers of the samples before which the clock of the stamps stepped (from `clock_jumps`).
        other_rate_ns: stretches at another rate (from `changed_rate`).
    """

    settings: CleaningSettings
    messages: int
    motion: Motion
    truth: Truth | None
    frames: FrameCounts = field(default_factory=FrameCounts)
    scale: Float64[np.ndarray, "6"] = field(default_factory=lambda: np.ones(6))
    axes: Float64[np.ndarray, "2 3 3"] = field(default_factory=lambda: np.stack([np.eye(3)] * 2))
    mount: Float64[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    world: Float64[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    position_unit: str = "m"
    quaternions: str = ""
    pose_delay_ns: int = 0
    late_ns: Int64[np.ndarray, " n"] = field(default_factory=lambda: np.zeros(0, np.int64))
    jumps: frozenset[int] = frozenset()
    other_rate_ns: Sequence[tuple[int, int]] = ()

    @cached_property
    def conventions(self) -> Conventions:
        """Units, axes and frames that the motion shows."""
        return judge(self.motion, self.truth, FORCES.get(accel_reading(self.motion).unit, 1.0))


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
