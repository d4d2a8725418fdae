"""Conclusion of a diagnosis in sentences, lines and a table: findings, gain, residual."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from textwrap import fill

from imutool.diagnosis.result import CONVENTIONS, Closer, Diagnosis, HeldOut, Located, Unexplained
from imutool.diagnosis.wording.effect_sentences import has_gain, label, named_sentence, parameters_text, reference, signals
from imutool.diagnosis.wording.quantity import percent, symbol
from imutool.units import UNITS

NO_EXPLANATION = "has no explanation yet"
MAY_BE_NOISE = "may exceed it by chance"
QUIET = "nothing else stands above the noise"
UNKNOWN = "This log has no usable reference, and its samples alone show no defect."
NULL = "Nothing but a constant bias and noise separates the two."
SHOWN = 3  # intervals in a line
NOT_COMPARED = "Nothing could be compared with the simulation."
WITH_ALL = "With everything that was found"
AGAIN = "Simulated again with everything that was found"
ABOVE = 1.1  # times the noise from which a residual stands above it
FULL = 3  # findings with a sentence in the conclusion; the rest by name
LISTED = 4  # unobservable effects by name; the rest are counted
ENTRIES = 6  # of an effect that are listed one by one
WIDE = 40  # letters of a value in a table
PREPOSITIONS = ("after", "in", "when")  # with which a regime may begin
AS_BEFORE = 2e-3  # relative change of a root mean square below which it is `as before`
CERTAIN = 1e-9  # p-value below which no number is given
COUNTS = ("No effect", "One effect", "Two effects", "Three effects", "Four effects", "Five effects")
TIMES = {2: " twice", 3: " three times"}  # that an effect acts, as the step of a bias
MEASURE = "Removes: share of the squared misfit above the noise, on time that no fit has seen."


def conclusion(d: Diagnosis) -> str:
    """Headline and notes as one text."""
    return " ".join([headline(d), *notes(d)])


def headline(d: Diagnosis) -> str:
    """Answer in one sentence: what differs, how much the findings remove, what is left."""
    if not d.mismatch:
        return NULL if d.unexplained else NOT_COMPARED if d.sim is not None else UNKNOWN
    unnamed = _unnamed_place(d)
    parts = [_only_finding(d) if len(d.findings) == 1 else _all_findings(d)] if d.findings else []
    if unnamed:
        parts.append(unnamed)
    elif not d.unexplained:
        parts.append("nothing else could be compared")
    elif all(_residual(d, signal) == QUIET for signal in d.unexplained):
        parts.append(QUIET)
    elif signals := [signal for signal, residual in d.unexplained.items() if not residual.white and not _rings(d, signal)]:
        parts.append(f"{_the(' and '.join(signals))} {'keep' if len(signals) > 1 else 'keeps'} a misfit that has no name")
    elif not any(_rings(d, signal) for signal in d.unexplained):
        parts.append("what is left may be noise")
    if d.caveat:
        parts.append(d.caveat)
    return f"{_upper('; '.join(parts))}." if parts else NULL


def notes(d: Diagnosis) -> list[str]:
    """Further sentences: unusable axes, residuals that remain, unobservable effects."""
    unusable = [(f"{_upper(_the(at.signal))}'s {', '.join(at.axes)}", at.reason) for at in d.located if at.reason]
    sentences = [f"{axes} is no measurement: {reason}." for axes, reason in unusable]
    residuals = (_residual(d, signal) for signal in d.unexplained)
    sentences += [f"{_upper(text)}." for text in residuals if text != QUIET]
    if hidden := unobservable(d):
        more = [f"{len(hidden) - LISTED} more effects in whole or part"] if len(hidden) > LISTED + 1 else hidden[LISTED:]
        sentences.append(f"These logs cannot show: {', '.join([*hidden[:LISTED], *more])}.")
    return sentences


def unobservable(d: Diagnosis) -> list[str]:
    """Unobservable parameters by effect: `gyro_scale (x, y)`; `lever_arm` for all; or a count."""
    parts: dict[str, list[str]] = {}
    for entry in d.not_identifiable:
        effect, _, part = (entry, "", "") if entry.startswith("/") else entry.partition(".")
        parts.setdefault(effect, []).extend([part] if part else [])
    listed = {
        effect: ", ".join(names) if len(names) <= ENTRIES else f"{len(names)} of its numbers" for effect, names in parts.items()
    }
    return [f"{effect} ({names})" if names else effect for effect, names in listed.items()]


def lines(d: Diagnosis) -> list[str]:
    """Lines of a text report: conclusion, findings with their numbers, locations, gain, remarks."""
    out = [headline(d), *notes(d)]
    for rank, finding in enumerate(d.findings, start=1):
        gain = f"; {gain_text(finding.held_out)}" if has_gain(finding) else ""
        chance = chance_text(finding.false_discovery_rate)
        out.append(f"{rank}. {label(finding)} ({finding.signal}): {parameters_text(finding)}{gain}; {chance}")
    return out + below(d)


def table(d: Diagnosis) -> list[list[str]]:
    """Rows of the findings table with its header, and the p-value of an uncertain finding."""
    rows = [["What", "Removes", "Value"]]
    for finding in d.findings:
        what = label(finding) if finding.signal in label(finding) else f"{label(finding)} ({finding.signal})"
        removes = percent(finding.share).replace("less than", "<").replace("more than", ">") if has_gain(finding) else "–"
        values = parameters_text(finding).split("; ") if finding.curve is None else [parameters_text(finding)]
        if finding.false_discovery_rate >= CERTAIN:
            values.append(chance_text(finding.false_discovery_rate))
        rows.append([what, removes, "\n".join(fill(text, WIDE) for text in values or [finding.equation])])
    return rows


def below(d: Diagnosis) -> list[str]:
    """Lines below the findings: locations, gain, remarks."""
    out = [MEASURE] if any(has_gain(finding) for finding in d.findings) else []
    out += [f"Where: {location_text(place, d)}; {percent(place.share)} of the misfit" for place in d.located]
    if d.findings and d.closer:
        closer = "; ".join(f"{signal} {improvement(gain)}" for signal, gain in d.closer.items())
        out.append(f"{gain_source(d)}{held_out_time(d)}: {closer}")
    return out + list(d.remarks)


def gain_source(d: Diagnosis) -> str:
    """Source of the gain: a second simulation, or the estimator."""
    return AGAIN if any(gain.by == "second simulation" for gain in d.closer.values()) else WITH_ALL


def held_out_time(d: Diagnosis) -> str:
    """Held-out time over which the gain was measured, as it follows `gain_source`."""
    seconds = max((gain.seconds for gain in d.closer.values()), default=0.0)
    return f", over {_seconds(seconds)} held out of the search" if seconds > 0.0 else ""


def rms_text(held_out: HeldOut) -> str:
    """`rms 0.52 to 0.19 m/s²`, with three digits, or as many as make the two differ."""
    for digits in range(3, 7):
        before, after = f"{held_out.rms_before:.{digits}g}", f"{held_out.rms_after:.{digits}g}"
        if before != after:
            break
    return f"rms {before} to {after} {symbol(held_out.unit)}".strip()


def improvement(closer: Closer) -> str:
    """`rms 0.52 to 0.19 m/s², 87 % of the misfit removed`, or `as before` without a change."""
    if not closer.rms_before > 0.0 or abs(closer.rms_after / closer.rms_before - 1.0) < AS_BEFORE:
        return f"rms {closer.rms_before:.3g} {symbol(closer.unit)}, as before".replace(" ,", ",")
    if closer.share is None or closer.share <= 0.0:
        return f"{rms_text(closer)}{', farther than before' if closer.rms_after > closer.rms_before else ''}"
    return f"{rms_text(closer)}, {percent(closer.share)} of the misfit removed"


def location_text(place: Located, d: Diagnosis | None = None) -> str:
    """Location as text: `accel x, y, angular rate above 0.4 rad/s, 12.0 to 48.5 s`."""
    names = {trace.path: trace.log for trace in d.traces if trace.path} if d is not None else {}
    spans = [f"{first:.1f} to {last:.1f} s" for first, last in place.intervals_s]
    shown = spans if len(spans) <= SHOWN else [*spans[: SHOWN - 1], f"{len(spans) - SHOWN + 1} more stretches"]
    parts = (
        names.get(place.log, Path(place.log).stem),
        f"{place.signal} {', '.join(place.axes)}".rstrip(),
        place.regime,
        *shown,
    )
    return ", ".join(part for part in parts if part)


def gain_text(held_out: HeldOut) -> str:
    """`rms 0.52 to 0.19 m/s² on 30 s of unseen data`."""
    return rms_text(held_out) + (f" on {_seconds(held_out.seconds)} of unseen data" if held_out.seconds > 0.0 else "")


def chance_text(p: float, *, short: bool = False) -> str:
    """p-value as text, corrected for the number of trials: `1 in 2 000 by chance`."""
    if p < CERTAIN:
        text = "below 10⁻⁹" if short else "less than 1 in 10⁹"
    elif p < 0.1:
        text = f"1 in {float(f'{1.0 / p:.2g}'):,.0f}".replace(",", " ")
    else:
        text = "an unknown part" if math.isnan(p) else percent(p)
    return text if short else f"{text} by chance"


def residual_text(residual: Unexplained, unit: str, of: str = "") -> str:
    """Residual (of a signal, if it is named) compared with its noise."""
    rms, floor = f"{residual.rms:.3g}", f"{residual.noise_floor:.3g} {symbol(unit)}".strip()
    what = f"what remains of {of}" if of else "what remains"
    if residual.rms > ABOVE * residual.noise_floor:
        return f"{what} is {rms} against {floor} of noise, and {MAY_BE_NOISE if residual.white else NO_EXPLANATION}"
    return QUIET if residual.white else f"{what} is as small as the noise, but not white"


def _only_finding(d: Diagnosis) -> str:
    (finding,) = d.findings
    text = f"{_differs(finding.signal)}{_regime(d.located, finding.signal)}: {named_sentence(d, finding)}"
    if has_gain(finding):
        text += f"; modelling it removes {percent(finding.share)} of the misfit"
        text += f" on {_seconds(finding.held_out.seconds)} of unseen data" if finding.held_out.seconds > 0.0 else ""
    return text


def _all_findings(d: Diagnosis) -> str:
    """Names of several findings, strongest first, and the gain of all of them."""
    count, labels = len(d.findings), Counter(f"{label(finding)} ({finding.signal})" for finding in d.findings)
    shown = [f"{text}{TIMES.get(times, '')}" for text, times in labels.items()]
    if len(shown) > FULL + 1:
        shown = [*shown[:FULL], f"{count - sum([*labels.values()][:FULL])} smaller ones"]
    number = COUNTS[count] if count < len(COUNTS) else f"{count} effects"
    other = reference(d) if d.sim is not None or len(d.real) == 1 else "their true poses"
    text = f"{number} separate the recording{'s' if len(d.real) > 1 else ''} from {other}: "
    text += f"{', '.join(shown[:-1])}{' and ' if len(shown) > 1 else ''}{shown[-1]}"
    touched = {part for finding in d.findings for part in signals(finding.signal) if has_gain(finding)}
    gains = [
        f"{percent(closer.share)} of the misfit of {_the(signal)}"
        for signal, closer in d.closer.items()
        if signal in touched and closer.share is not None and closer.share > 0.0
    ]
    of_convention = any(finding.effect in CONVENTIONS for finding in d.findings)
    who = f"in the units and axes of {other} the others remove" if of_convention else "together they remove"
    return f"{text}; {who} {' and '.join(gains)}" if gains else text


def _unnamed_place(d: Diagnosis) -> str:
    """Clause on signals that differ without a finding, empty where there is none."""
    named = {part for finding in d.findings for part in signals(finding.signal)}
    columns = tuple(f"{name}." for name in named)  # of a message that has a finding as a whole
    places = [
        place
        for place in d.located
        if not place.reason and not set(signals(place.signal)) & named and not place.signal.startswith(columns)
    ]
    if not places:
        return ""
    differing = list(dict.fromkeys(place.signal for place in places))
    return f"{_differs(' and '.join(differing))}{_regime(places, differing[0])}, and no known effect explains it"


def _rings(d: Diagnosis, signal: str) -> bool:
    """Whether a mount rings, which is a name for a residual that no sample predicts."""
    return any(f.effect == "mount_resonance" and f.signal == signal and not has_gain(f) for f in d.findings)


def _residual(d: Diagnosis, signal: str) -> str:
    """Residual of a signal as text."""
    units = {finding.signal: finding.held_out.unit for finding in d.findings} | UNITS
    text = residual_text(d.unexplained[signal], units.get(signal, ""), _the(signal))
    return text.replace(NO_EXPLANATION, "rings") if _rings(d, signal) else text


def _the(signal: str) -> str:
    """`the gyro`, `gyro and accel`; any other signal by its name."""
    parts = signals(signal)
    if len(parts) > 1:
        return f"{', '.join(parts[:-1])} and {parts[-1]}"
    return f"the {signal}" if signal in {"gyro", "accel"} else signal


def _differs(signal: str) -> str:
    return f"{_upper(_the(signal))} differ{'' if len(signals(signal)) > 1 else 's'}"


def _regime(located: Sequence[Located], signal: str) -> str:
    """Where the largest share of a signal's misfit lies, as it goes on after `differs`."""
    places = [
        place for place in located if place.regime and not place.reason and set(signals(place.signal)) & set(signals(signal))
    ]
    if not places:
        return ""
    place = max(places, key=lambda place: place.share)
    regime = place.regime
    if place.extent == "everywhere":
        return f" throughout{regime.removeprefix('always')}"
    if place.extent == "intermittent":
        return " from time to time"
    return f" {regime}" if regime.split()[0] in PREPOSITIONS else f" at {regime}"


def _seconds(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds >= 10.0 else f"{seconds:.1f} s"


def _upper(text: str) -> str:
    """As a sentence begins; a topic keeps its letters."""
    return text[0].upper() + text[1:]
