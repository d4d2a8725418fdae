"""Events of a diagnosis in a log, from the folder that `imutool diagnose -o` writes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from imutool.diagnosis.result import SCHEMA
from imutool.errors import ConfigError, DataError
from imutool.recording import nanoseconds
from imutool.viewing.model.events import MAX_EVENTS_PER_KIND, Event

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


class _Diagnosis(msgspec.Struct):
    schema: Literal["imutool.diagnosis/1"]
    real: list[str]
    located: list[_Located] = []
    findings: list[_Finding] = []


def finding_events(folder: Path, log: str, start_ns: int, end_ns: int) -> tuple[list[Event], list[str]]:
    """Events of the located findings of a log (by file name), and notes on the others.

    Times of a place count from the start of its log, or of the first where it names none. What is located without a time acts
    everywhere. Of a place with more stretches than are ever shown, the longest.

    Raises:
        ConfigError: the folder holds no diagnosis, or it cannot be read.
        DataError: its findings.json is not one.
    """
    found = _read(folder / FINDINGS)
    first = found.real[0] if found.real else "no log"
    here = [place for place in found.located if Path(place.log or first).name == log]
    if Path(first).name != log and not here:
        return [], [f"The findings of {folder.name} are on the clock of {Path(first).name} and are not marked in {log}."]
    events, notes = [], []
    for place in here:
        text = _words(place, found.findings)
        longest = sorted(place.intervals_s, key=lambda one: one[0] - one[1])
        if len(longest) > MAX_EVENTS_PER_KIND:
            notes.append(f"{text}: {len(longest) - MAX_EVENTS_PER_KIND} shorter stretches are not marked.")
        for first_s, last_s in longest[:MAX_EVENTS_PER_KIND] or [(0.0, (end_ns - start_ns) * 1e-9)]:
            low, high = sorted((start_ns + nanoseconds(first_s), start_ns + nanoseconds(last_s)))
            events.append(Event("finding", low, high, text))
    unplaced = found.findings if not found.located else []
    notes += [f"Diagnosis: {one.effect} on {one.signal}, at no time of its own." for one in unplaced[:MAX_EVENTS_PER_KIND]]
    return events, notes


def _words(place: _Located, findings: list[_Finding]) -> str:
    """Signal, axes, regime and share, and the strongest effects found on that signal."""
    what = f"{place.signal} {', '.join(place.axes)}".strip()
    share = "" if place.share is None else f", {100.0 * place.share:.0f} % of its misfit"
    of_signal = [one for one in findings if place.signal in one.signal or one.signal in ("both", "imu")]
    effects = [f"{one.effect} ({one.driver})" if one.driver else one.effect for one in of_signal[:MAX_NAMED_EFFECTS]]
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
        return msgspec.json.decode(raw, type=_Diagnosis)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise DataError(f"is no diagnosis ({error})", where=path, expected=f"JSON of {SCHEMA}") from error
