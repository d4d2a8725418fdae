"""Score of findings (imutool.diagnosis/1) against the concealed truth of a blind case."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from imutool.blind_cases.catalogue import AXES, CATALOGUE
from imutool.blind_cases.envelope import ConcealedEffect, ConcealedTruth, Location
from imutool.blind_cases.gain import (
    BOTH,
    SIGNALS,
    Findings,
    ReportedFinding,
    ReportedLocation,
    ReportedValue,
    explained_gain,
    reported_gain,
)
from imutool.errors import DataError
from imutool.recording import Recording
from imutool.report import Report, Section

SCHEMA, FINDINGS_SCHEMA = "imutool.score/1", "imutool.diagnosis/1"
IN_EVERY_LOG = {"gyro_bias", "accel_bias"}  # right, but never concealed
ALIASES: Mapping[str, tuple[str, ...]] = {
    **{axis: (f"phi_{axis}",) for axis in AXES},
    "t_j": ("t_jump",),
    "g": ("magnitude",),
    "gyro": ("gyro_limit", "gyro_lsb"),
    "accel": ("accel_limit", "accel_lsb"),
}
"""Names of a parameter in findings, where a case names it otherwise."""


class LocationScore(Section, frozen=True):
    """F1 of the seconds (of a signal whose misfit comes and goes), of the axes, and their mean."""

    seconds_f1: float | None
    axes_f1: float | None
    f1: float | None


class ParameterScore(Section, frozen=True):
    """Reported value of an identifiable parameter against the true one."""

    effect: str
    parameter: str
    true: float
    value: float
    std: float
    sigmas: float | None  # error over the reported deviation
    percent: float  # error over the parameter's scale
    over_bound: float | None  # reported deviation over the Cramér-Rao bound


class Score(Report, frozen=True, kw_only=True, tag=SCHEMA):
    """Score of findings: names, location, parameters and gain.

    Attributes:
        right: the names are those concealed, no more and no less; `wrong` are names that were not concealed.
        place: doubtful seconds and axes are left out.
        untold: identifiable parameters of a named effect that the findings do not report.
        gain: share of the misfit explained, by the forward models of this room if they can, else as `gain_said`.
        gain_said: reduction of the residual on held-out time that the findings report, over the achievable one.
    """

    kind: str
    size: str
    concealed: tuple[str, ...]
    found: tuple[str, ...]
    detected: bool
    right: bool
    hits: tuple[str, ...]
    missing: tuple[str, ...]
    wrong: tuple[str, ...]
    precision: float | None
    recall: float | None
    place: LocationScore
    parameters: tuple[ParameterScore, ...]
    untold: tuple[str, ...]
    gain: float | None
    gain_said: float | None


def score(truth: ConcealedTruth, report: Mapping[str, Any], where: Path, sim: Recording | None = None) -> Score:
    """Score of a report of `diagnose`.

    The simulation `sim` lets the gain be computed, not only read.

    Raises:
        DataError: findings of another schema, or with fields of another type.
    """
    if report.get("schema") != FINDINGS_SCHEMA:
        raise DataError(f"schema {report.get('schema')!r}", where=where, expected=FINDINGS_SCHEMA)
    try:
        found = msgspec.convert(report, Findings)
    except msgspec.ValidationError as error:
        raise DataError(f"the findings cannot be read ({error})", where=where, expected=FINDINGS_SCHEMA) from error
    return _score(truth, found, sim)


def _score(truth: ConcealedTruth, found: Findings, sim: Recording | None) -> Score:
    findings = [finding for finding in found.findings if finding.effect not in IN_EVERY_LOG]
    hits, missing, wrong = _matched(truth.effects, findings)
    reported = reported_gain(truth, found, findings)
    explained = None
    if sim is not None:
        explained = explained_gain(truth, [(finding, _catalogue_values(finding)) for finding in findings], sim)
    return Score(
        kind=truth.kind,
        size=truth.size,
        concealed=tuple(effect.effect for effect in truth.effects),
        found=tuple(finding.effect for finding in findings),
        detected=bool(findings or found.mismatch),
        right=not missing and not wrong,
        hits=tuple(effect.effect for effect, _ in hits),
        missing=tuple(effect.effect for effect in missing),
        wrong=tuple(finding.effect for finding in wrong),
        precision=len(hits) / len(findings) if findings else None,
        recall=len(hits) / len(truth.effects) if truth.effects else None,
        place=_location_score(truth.place, found.located),
        parameters=tuple(row for effect, finding in hits for row in _parameters(effect, finding)),
        untold=tuple(f"{effect.effect}.{name}" for effect, finding in hits for name in _unreported(effect, finding)),
        gain=reported if explained is None else explained,
        gain_said=reported,
    )


def _matched(
    effects: Sequence[ConcealedEffect], findings: Sequence[ReportedFinding]
) -> tuple[list[tuple[ConcealedEffect, ReportedFinding]], list[ConcealedEffect], list[ReportedFinding]]:
    """Effects with their findings, effects without one, findings without an effect."""
    hits, missing, wrong = [], [], list(findings)
    for effect in effects:
        match = next((finding for finding in wrong if _same(effect, finding)), None)
        if match is None:
            missing.append(effect)
        else:
            wrong.remove(match)
            hits.append((effect, match))
    return hits, missing, wrong


def _same(effect: ConcealedEffect, finding: ReportedFinding) -> bool:
    """The same name; a driven effect by the same topic, an unknown one in the same signal."""
    if effect.effect != finding.effect:
        return False
    if effect.effect == "driven":
        return finding.driver == effect.driver or finding.driver.startswith((f"{effect.driver}.", f"{effect.driver}/"))
    return effect.effect != "unknown" or finding.signal in (effect.signal, *BOTH)


# ── parameters ──


def _reported(name: str, finding: ReportedFinding) -> tuple[float, float] | None:
    """Value and standard deviation of a parameter under any of its names; of a sine and a cosine the amplitude."""
    for candidate in (name, *ALIASES.get(name, ())):
        if candidate in finding.parameters:
            return _finite(finding.parameters[candidate])
    sensor, _, axis = name.rpartition("_")
    waves = [(f"sin_{axis}", f"cos_{axis}"), (f"{sensor}_sin_{axis}", f"{sensor}_cos_{axis}")]
    for names in waves if sensor in SIGNALS else []:
        pair = [_finite(finding.parameters[wave]) for wave in names if wave in finding.parameters]
        sine, cosine = pair if len(pair) == 2 else (None, None)
        if sine is not None and cosine is not None and (names[0].startswith(sensor) or sensor == "accel"):
            value = float(np.hypot(sine[0], cosine[0]))
            std = float(np.hypot(sine[0] * sine[1], cosine[0] * cosine[1])) / value if value > 0.0 else sine[1]
            return value, std
    return None


def _finite(reported: ReportedValue) -> tuple[float, float] | None:
    if reported.value is None or reported.std is None:
        return None
    return reported.value, reported.std


def _catalogue_values(finding: ReportedFinding) -> dict[str, float]:
    """Parameters of a finding by the catalogue's names."""
    model = CATALOGUE.get(finding.effect)
    names = ("gain", "lag") if model is None else tuple(parameter.name for parameter in model.parameters)
    reported = {name: _reported(name, finding) for name in names}
    return {name: value[0] for name, value in reported.items() if value is not None}


def _parameters(effect: ConcealedEffect, finding: ReportedFinding) -> list[ParameterScore]:
    rows = []
    for name, true in effect.parameters.items():
        reported = _reported(name, finding)
        if reported is None or not true.identifiable:
            continue
        value, std = reported
        rows.append(
            ParameterScore(
                effect=effect.effect,
                parameter=name,
                true=true.value,
                value=value,
                std=std,
                sigmas=(value - true.value) / std if std > 0.0 else None,
                percent=100.0 * abs(value - true.value) / true.scale,
                over_bound=None if not true.smallest_std else std / true.smallest_std,
            )
        )
    return rows


def _unreported(effect: ConcealedEffect, finding: ReportedFinding) -> list[str]:
    """Identifiable parameters that the finding does not report; those of an unknown have no names."""
    if effect.effect == "unknown":
        return []
    return [name for name, true in effect.parameters.items() if true.identifiable and _reported(name, finding) is None]


# ── location ──


def _location_score(true: Location, located: Sequence[ReportedLocation]) -> LocationScore:
    seconds, axes = [], []
    for signal, marks in zip(SIGNALS, (true.gyro, true.accel), strict=True):
        own = [place for place in located if place.signal in (signal, *BOTH)]
        if marks.localised:
            seconds += list(zip(marks.seconds, _covered(len(marks.seconds), true.window_s, own), strict=True))
        named = {axis for place in own for axis in place.axes}
        axes += [(marks.axes[axis], axis in named) for axis in AXES]
    both = (_f1(seconds), _f1(axes))
    known = [value for value in both if value is not None]
    return LocationScore(both[0], both[1], float(np.mean(known)) if known else None)


def _covered(count: int, window_s: float, located: Sequence[ReportedLocation]) -> list[bool]:
    """Windows that are at least half inside an interval; no intervals at all mean everywhere."""
    inside = np.zeros(count)
    starts = window_s * np.arange(count)
    for place in located:
        if not place.intervals_s:
            return [True] * count
        for start, end in place.intervals_s:
            inside = np.maximum(inside, np.clip(np.minimum(end, starts + window_s) - np.maximum(start, starts), 0.0, None))
    return [bool(value >= 0.5 * window_s) for value in inside]


def _f1(pairs: Sequence[tuple[str, bool]]) -> float | None:
    """F1 of reported against clear marks; None where nothing is clear."""
    right = sum(mark == "#" and reported for mark, reported in pairs)
    missed = sum(mark == "#" and not reported for mark, reported in pairs)
    false = sum(mark == "." and reported for mark, reported in pairs)
    return 2.0 * right / (2.0 * right + missed + false) if right + missed else None
