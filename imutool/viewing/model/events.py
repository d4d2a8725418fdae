"""What happened in a log and when: gaps, stops, saturation, clock jumps, the worst error, what a diagnosis found."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from imutool.cleaning import Survey
from imutool.inertial import stationary
from imutool.recording import Imu
from imutool.viewing.model.trajectory_error import Errors

Kind = Literal[
    "gap", "out_of_order", "clock_jump", "saturation", "spike", "stuck", "duplicate", "not_finite", "stop", "worst", "finding"
]
KINDS: tuple[Kind, ...] = get_args(Kind)

OF_RULE: Mapping[str, Kind] = {
    "gaps": "gap",
    "time_back": "out_of_order",
    "clock_jumps": "clock_jump",
    "saturation": "saturation",
    "spikes": "spike",
    "stuck": "stuck",
    "duplicates": "duplicate",
    "not_finite": "not_finite",
}
MOST_PER_KIND = 100
DIGITS = 1000.0  # from here on all digits before the point, rather than an exponent
LONGEST_TEXT = 300  # letters; some come from files of others


@dataclass(frozen=True)
class Event:
    """A stretch of time (or a moment: `start_ns == end_ns`) by header stamp, and what happened in words."""

    kind: Kind
    start_ns: int
    end_ns: int
    text: str


def of_survey(survey: Survey) -> tuple[list[Event], list[str]]:
    """What `imutool.cleaning` found at some time, and sentences for what it found without one, or at more times than it
    kept.
    """
    found, notes = [], []
    for finding in survey.findings:
        kind = OF_RULE.get(finding.rule)
        if kind is None or not finding.intervals_ns:
            notes.append(f"{finding.what}.")
            continue
        for start_ns, end_ns in finding.intervals_ns:
            length = f" for {(end_ns - start_ns) * 1e-9:.3g} s" if end_ns > start_ns else ""
            found.append(Event(kind, start_ns, end_ns, f"{finding.what}{length} ({finding.count} in the log)"))
        if finding.intervals_left_out:
            notes.append(f"{finding.what}: {finding.intervals_left_out} more places than the events name.")
    return found, notes


def of_stops(imu: Imu) -> list[Event]:
    """The stretches in which the IMU rests (`imutool.inertial.stationary`)."""
    ends = ((int(imu.t_ns[first]), int(imu.t_ns[end - 1])) for first, end in stationary.rest_stretches(imu))
    return [Event("stop", first, last, f"at rest for {(last - first) * 1e-9:.1f} s") for first, last in ends]


def of_worst(name: str, errors: Errors) -> Iterator[Event]:
    """The moments of a run's largest orientation and position error; none where no error is known."""
    of_kind = (("orientation", errors.orientation_total_deg, "deg"), ("position", errors.position_total_m, "m"))
    for kind, total, unit in of_kind:
        if np.isfinite(total).any():
            row = int(np.nanargmax(total))
            at_ns = int(errors.t_ns[row])
            size = f"{total[row]:.3g}" if total[row] < DIGITS else f"{total[row]:.0f}"
            yield Event("worst", at_ns, at_ns, f"{name}: largest {kind} error, {size} {unit}")


def gathered(events: Iterable[Event], start_ns: int, end_ns: int) -> tuple[tuple[Event, ...], tuple[str, ...]]:
    """The events within the log, by time; of a kind with more than `MOST_PER_KIND` the longest, the others counted in a note.

    Events partly outside are cut to the log's time, those wholly outside (stamps of another century) counted in a note.
    """
    kept: list[Event] = []
    notes = []
    events = list(events)
    for kind in KINDS:
        every = [event for event in events if event.kind == kind]
        inside = [event for event in every if event.start_ns <= end_ns and event.end_ns >= start_ns]
        longest = sorted(inside, key=lambda event: event.start_ns - event.end_ns)[:MOST_PER_KIND]
        named = kind.replace("_", " ")
        if len(every) > len(inside):
            notes.append(
                f"Events of kind {named}: {len(every) - len(inside)} lie outside the log's own time and are not shown."
            )
        if len(inside) > len(longest):
            notes.append(f"Events of kind {named}: the {len(longest)} longest are shown, {len(inside) - len(longest)} are not.")
        kept += (Event(kind, max(one.start_ns, start_ns), min(one.end_ns, end_ns), one.text[:LONGEST_TEXT]) for one in longest)
    return tuple(sorted(kept, key=lambda event: (event.start_ns, event.end_ns))), tuple(notes)
