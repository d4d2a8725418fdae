"""Events in a log: gaps, rest, saturation, clock jumps, the worst error."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

import msgspec
from msgspec import Meta

from imutool.cleaning import Survey
from imutool.diagnosis.result import SCHEMA
from imutool.errors import ConfigError, DataError
from imutool.inertial import stationary
from imutool.recording import Imu, nanoseconds
from imutool.viewing.model.trajectory_error import Errors, row_of_largest

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
EXPONENT_FROM = 1000.0  # a larger error or time is written with all digits instead of an exponent
MAX_TEXT_LENGTH = 300  # letters; some come from files of others


@dataclass(frozen=True)
class Event:
    """Event from `start_ns` to `end_ns` (equal for a moment) by header stamp, with a text."""

    kind: Kind
    start_ns: int
    end_ns: int
    text: str


def survey_events(survey: Survey) -> tuple[list[Event], list[str]]:
    """Events from a cleaning survey, and notes on findings without times or with too many."""
    events, notes = [], []
    for finding in survey.findings:
        kind = KIND_OF_RULE.get(finding.rule)
        if kind is None or not finding.intervals_ns:
            notes.append(f"{finding.what[0].upper()}{finding.what[1:]}.")
            continue
        for start_ns, end_ns in finding.intervals_ns:
            lasting = "for" if kind == "gap" else "within"  # a few samples near each other are one event
            length = f" {lasting} {_three_digits((end_ns - start_ns) * 1e-9)} s" if end_ns > start_ns else ""
            events.append(Event(kind, start_ns, end_ns, f"{finding.what}{length} ({finding.count} in the log)"))
        if finding.intervals_left_out:
            notes.append(f"{finding.intervals_left_out} later intervals of {finding.what} are not listed as events.")
    return events, notes


def _three_digits(value: float) -> str:
    return f"{value:.3g}" if value < EXPONENT_FROM else f"{value:.0f}"


def stop_events(imu: Imu) -> list[Event]:
    """Intervals in which the IMU rests (`imutool.inertial.stationary`)."""
    ends = ((int(imu.t_ns[first]), int(imu.t_ns[end - 1])) for first, end in stationary.rest_stretches(imu))
    return [Event("stop", first, last, f"at rest for {(last - first) * 1e-9:.1f} s") for first, last in ends]


def worst_error_events(name: str, errors: Errors) -> Iterator[Event]:
    """Moments of a run's largest orientation and position error; none without errors."""
    of_kind = (("orientation", errors.orientation_total_deg, "deg"), ("position", errors.position_total_m, "m"))
    for kind, total, unit in of_kind:
        if (row := row_of_largest(total)) is not None:
            at_ns = int(errors.t_ns[row])
            size = _three_digits(float(total[row]))
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
            notes.append(f"Events of kind {named}: {len(of_kind) - len(inside)} outside the log, not shown.")
        if len(inside) > len(longest):
            notes.append(f"Events of kind {named}: the {len(longest)} longest are shown, {len(inside) - len(longest)} are not.")
        kept += (
            Event(kind, max(event.start_ns, start_ns), min(event.end_ns, end_ns), event.text[:MAX_TEXT_LENGTH])
            for event in longest
        )
    return tuple(sorted(kept, key=lambda event: (event.start_ns, event.end_ns))), tuple(notes)


FINDINGS = "findings.json"
MAX_BYTES = 64 << 20  # a diagnosis of hours has some 100 kB
MAX_NAMED_EFFECTS = 3  # effects in an event's words
MAX_TIME_S = 1e9  # thirty years: beyond, a number is no time in a log

Time = Annotated[float, Meta(ge=-MAX_TIME_S, le=MAX_TIME_S)]


class _Located(msgspec.Struct):
    signal: str
    axes: list[str] = []
    intervals_s: list[tuple[Time, Time]] = []
    regime: str = ""
    share: float | None = None
    log: str = ""


class _Finding(msgspec.Struct):
    effect: str
    signal: str = ""
    driver: str = ""


class _Diagnosis(msgspec.Struct, tag_field="schema", tag=SCHEMA):
    real: list[str]
    located: list[_Located] = []
    findings: list[_Finding] = []


class _Unit(msgspec.Struct, tag_field="schema", tag="imutool.unit/1"):
    diagnosis: _Diagnosis | None = None


def finding_events(folder: Path, log: str, start_ns: int, end_ns: int) -> tuple[list[Event], list[str]]:
    """Events of the located findings of a log (by path or name), and notes on the others.

    `folder` is of a diagnosis, or the file that a fleet's diagnosis writes for one log. Times of a place count from the start
    of its log, or of the first where it names none. What is located without a time acts everywhere. Of a place with more
    stretches than are ever shown, the longest.

    Raises:
        ConfigError: the folder holds no diagnosis, or it cannot be read.
        DataError: its findings.json is not one.
    """
    diagnosis = _read(folder if folder.is_file() else folder / FINDINGS)
    first = diagnosis.real[0] if diagnosis.real else "no log"
    path, log = log, Path(log).name
    own = log, Path(log).stem  # of a recording of arrays a diagnosis holds the name
    places = [place for place in diagnosis.located if Path(place.log or first).name in own]
    if path in diagnosis.real:
        places = [place for place in places if (place.log or first) == path]
    if Path(first).name not in own and not places:
        return [], [f"The findings of {folder.name} are on the clock of {Path(first).name} and are not marked in {log}."]
    events, notes = [], []
    for place in places:
        text = _words(place, diagnosis.findings)
        longest = sorted(place.intervals_s, key=lambda interval: interval[0] - interval[1])
        if len(longest) > MAX_EVENTS_PER_KIND:
            notes.append(f"{text}: {len(longest) - MAX_EVENTS_PER_KIND} shorter stretches are not marked.")
        for first_s, last_s in longest[:MAX_EVENTS_PER_KIND] or [(0.0, (end_ns - start_ns) * 1e-9)]:
            low, high = sorted((start_ns + nanoseconds(first_s), start_ns + nanoseconds(last_s)))
            events.append(Event("finding", low, high, text))
    unplaced = diagnosis.findings if not diagnosis.located else []
    notes += [
        f"Diagnosis: {finding.effect} on {finding.signal}, at no time of its own." for finding in unplaced[:MAX_EVENTS_PER_KIND]
    ]
    return events, notes


def _words(place: _Located, findings: list[_Finding]) -> str:
    """Signal, axes, regime and share, and the strongest effects found on that signal."""
    what = f"{place.signal} {', '.join(place.axes)}".strip()
    share = "" if place.share is None else f", {100.0 * place.share:.0f} % of its misfit"
    of_signal = [finding for finding in findings if place.signal in finding.signal or finding.signal in ("both", "imu")]
    effects = [
        f"{finding.effect} ({finding.driver})" if finding.driver else finding.effect
        for finding in of_signal[:MAX_NAMED_EFFECTS]
    ]
    because = f": {', '.join(effects)}" if effects else ""
    return f"{what}{f', {place.regime}' if place.regime else ''}{share}{because}"


def _read(path: Path) -> _Diagnosis:
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise ConfigError(
            f"cannot be read ({error.strerror})", where=path, expected="the folder of a diagnosis (imutool diagnose -o DIR)"
        ) from error
    if len(raw) > MAX_BYTES:
        raise DataError(f"is longer than {MAX_BYTES} bytes", where=path, expected="the findings of one diagnosis")
    try:
        report = msgspec.json.decode(raw, type=_Diagnosis | _Unit)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise DataError(f"is no diagnosis ({error})", where=path, expected=f"JSON of {SCHEMA}") from error
    return report if isinstance(report, _Diagnosis) else report.diagnosis or _Diagnosis([])
