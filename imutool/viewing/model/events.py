"""Events in a log: gaps, rest, saturation, clock jumps, the worst error."""

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

KIND_OF_RULE: Mapping[str, Kind] = {
    "gaps": "gap",
    "time_back": "out_of_order",
    "clock_jumps": "clock_jump",
    "saturation": "saturation",
    "spikes": "spike",
    "stuck": "stuck",
    "duplicates": "duplicate",
    "not_finite": "not_finite",
}
MAX_EVENTS_PER_KIND = 100
EXPONENT_FROM = 1000.0  # a larger error is written with all digits instead of an exponent
MAX_TEXT_LENGTH = 300  # letters; some come from files of others


@dataclass(frozen=True)
class Event:
    """Event from `start_ns` to `end_ns` (equal for a moment) by header stamp, with a text."""

    kind: Kind
    start_ns: int
    end_ns: int
    text: str


def survey_events(survey: Survey) -> tuple[list[Event], list[str]]:
    """Events from a cleaning survey, and notes on findings without times or with too many.
    kept.
    """
    found, notes = [], []
    for finding in survey.findings:
        kind = KIND_OF_RULE.get(finding.rule)
        if kind is None or not finding.intervals_ns:
            notes.append(f"{finding.what}.")
            continue
        for start_ns, end_ns in finding.intervals_ns:
            length = f" for {(end_ns - start_ns) * 1e-9:.3g} s" if end_ns > start_ns else ""
            found.append(Event(kind, start_ns, end_ns, f"{finding.what}{length} ({finding.count} in the log)"))
        if finding.intervals_left_out:
            notes.append(f"{finding.what}: {finding.intervals_left_out} more intervals are not listed as events.")
    return found, notes


def stop_events(imu: Imu) -> list[Event]:
    """Intervals in which the IMU rests (`imutool.inertial.stationary`)."""
    ends = ((int(imu.t_ns[first]), int(imu.t_ns[end - 1])) for first, end in stationary.rest_stretches(imu))
    return [Event("stop", first, last, f"at rest for {(last - first) * 1e-9:.1f} s") for first, last in ends]


def worst_error_events(name: str, errors: Errors) -> Iterator[Event]:
    """Moments of a run's largest orientation and position error; none without errors."""
    of_kind = (("orientation", errors.orientation_total_deg, "deg"), ("position", errors.position_total_m, "m"))
    for kind, total, unit in of_kind:
        if np.isfinite(total).any():
            row = int(np.nanargmax(total))
            at_ns = int(errors.t_ns[row])
            size = f"{total[row]:.3g}" if total[row] < EXPONENT_FROM else f"{total[row]:.0f}"
            yield Event("worst", at_ns, at_ns, f"{name}: largest {kind} error, {size} {unit}")


def events_within(events: Iterable[Event], start_ns: int, end_ns: int) -> tuple[tuple[Event, ...], tuple[str, ...]]:
    """Events within a log by time, the longest of each kind, with notes that count the others.

    An event that is partly outside is cut to the log's time; a note counts those wholly outside (stamps of another century).
    """
    kept: list[Event] = []
    notes = []
    events = list(events)
    for kind in KINDS:
        of_kind = [event for event in events if event.kind == kind]
        inside = [event for event in of_kind if event.start_ns <= end_ns and event.end_ns >= start_ns]
        longest = sorted(inside, key=lambda event: event.start_ns - event.end_ns)[:MAX_EVENTS_PER_KIND]
        named = kind.replace("_", " ")
        if len(of_kind) > len(inside):
            notes.append(f"Events of kind {named}: {len(of_kind) - len(inside)} lie outside the log and are not shown.")
        if len(inside) > len(longest):
            notes.append(f"Events of kind {named}: the {len(longest)} longest are shown, {len(inside) - len(longest)} are not.")
        kept += (
            Event(kind, max(one.start_ns, start_ns), min(one.end_ns, end_ns), one.text[:MAX_TEXT_LENGTH]) for one in longest
        )
    return tuple(sorted(kept, key=lambda event: (event.start_ns, event.end_ns))), tuple(notes)
