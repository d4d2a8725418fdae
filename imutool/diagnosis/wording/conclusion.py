"""Conclusion of a diagnosis in sentences, lines and a table: findings, gain, residual."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from textwrap import fill

from imutool.diagnosis.result import Diagnosis, HeldOut, Located, Unexplained
from imutool.diagnosis.wording.effect_sentences import has_gain, label, named_sentence, parameters_text, signals
from imutool.diagnosis.wording.quantity import grouped, percent, symbol
from imutool.units import UNITS

QUIET = "nothing else stands above the noise"
UNKNOWN = "What should have been read is not known, and by themselves the samples show nothing amiss."
NULL = "Nothing but a constant bias and noise separates the two."
SHOWN = 3  # intervals in a line
WITH_ALL = "With everything that was found"
AGAIN = "Simulated again with everything that was found"
ABOVE = 1.1  # times the noise from which a residual stands above it
FULL = 3  # findings with a sentence in the conclusion; the rest by name
LISTED = 4  # unobservable effects by name; the rest are counted
ENTRIES = 6  # of an effect that are listed one by one
WIDE = 40  # letters of a value in a table
AS_BEFORE = 2e-3  # relative change of a root mean square below which it is `as before`
CERTAIN = 1e-9  # p-value below which no number is given
COUNTS = ("No", "One thing was", "Two things were", "Three things were", "Four things were", "Five things were")


def conclusion(d: Diagnosis) -> str:
    """Conclusion in a few sentences: findings by signal, residual, unobservable effects."""
    return " ".join([*headline(d), *notes(d)])


def headline(d: Diagnosis) -> list[str]:
    """Most important sentences: the findings and the residual."""
    sentences = _findings(d) if d.mismatch else [NULL if d.unexplained else UNKNOWN]
    residuals = _residuals(d)
    if 0 < len(d.findings) <= FULL and len({finding.signal for finding in d.findings}) == 1 and len(residuals) == 1:
        sentences[-1] = f"{sentences[-1][:-1]}; {residuals[0][0].lower()}{residuals[0][1:]}"  # one thought, one sentence
    elif d.mismatch or not all(residual.white for residual in d.unexplained.values()):
        sentences += residuals
    return sentences


def notes(d: Diagnosis) -> list[str]:
    """Further sentences: gain of a second simulation, and unobservable effects."""
    sentences = []
    touched = {part for finding in d.findings for part in signals(finding.signal)}
    shares = {
        signal: closer.share for signal, closer in d.closer.items() if signal in touched and closer.by == "second simulation"
    }
    parts = [f"{percent(share)} of the misfit of {_the(signal)}" for signal, share in shares.items() if share is not None]
    if parts:
        seconds = max(closer.seconds for closer in d.closer.values())
        sentences.append(f"Simulated again with this, {' and '.join(parts)} is gone on {_seconds(seconds)} of unseen time.")
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
    out = [conclusion(d)]
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
        values = [q.labelled for q in grouped(finding.parameters)] if finding.curve is None else [parameters_text(finding)]
        if finding.false_discovery_rate >= CERTAIN:
            values.append(chance_text(finding.false_discovery_rate))
        rows.append([what, removes, "\n".join(fill(text, WIDE) for text in values or [finding.equation])])
    return rows


def below(d: Diagnosis) -> list[str]:
    """Lines below the findings: locations, gain, remarks."""
    out = [f"Where: {location_text(place)}; {percent(place.share)} of the misfit" for place in d.located]
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


def improvement(held_out: HeldOut) -> str:
    """`rms 0.52 to 0.19 m/s², 63 % closer`, or `as before` where nothing was found."""
    if not held_out.rms_before > 0.0 or abs(held_out.rms_after / held_out.rms_before - 1.0) < AS_BEFORE:
        return f"rms {held_out.rms_before:.3g} {symbol(held_out.unit)}, as before".replace(" ,", ",")
    gain = 1.0 - held_out.rms_after / held_out.rms_before
    return f"{rms_text(held_out)}, {percent(abs(gain))} {'closer' if gain > 0.0 else 'farther'}"


def location_text(place: Located) -> str:
    """Location as text: `accel x, y, angular rate above 0.4 rad/s, 12.0 to 48.5 s`."""
    spans = [f"{first:.1f} to {last:.1f} s" for first, last in place.intervals_s]
    shown = spans if len(spans) <= SHOWN else [*spans[: SHOWN - 1], f"{len(spans) - SHOWN + 1} more stretches"]
    parts = (Path(place.log).stem, f"{place.signal} {', '.join(place.axes)}", place.regime, *shown)
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
        return f"{what} is {rms} against {floor} of noise, and has no explanation yet"
    return QUIET if residual.white else f"{what} is as small as the noise, but not white"


def _findings(d: Diagnosis) -> list[str]:
    """A sentence per signal that differs; unexplained locations come last."""
    count = len(d.findings)
    sentences = []
    if count > 1:
        sentences.append(f"{COUNTS[count] if count < len(COUNTS) else f'{count} things were'} left out.")
    full = d.findings[:FULL]
    order = list(dict.fromkeys(finding.signal for finding in full))
    mentioned: set[float] = set()
    for signal, group in groupby(
        sorted(full, key=lambda finding: order.index(finding.signal)), key=lambda finding: finding.signal
    ):
        parts = []
        for finding in group:
            parts.append(named_sentence(d, finding))
            if has_gain(finding):
                seconds = finding.held_out.seconds
                held_out = f" on {_seconds(seconds)} of unseen data" if seconds > 0.0 and seconds not in mentioned else ""
                mentioned.add(seconds)
                parts[-1] += f"; modelling it removes {percent(finding.share)} of the misfit{held_out}"
        sentences.append(f"{_differs(signal)}{_regime(d.located, signal)}: {'; '.join(parts)}.")
    if count > FULL:
        sentences.append(f"Smaller: {', '.join(f'{label(finding)} ({finding.signal})' for finding in d.findings[FULL:])}.")
    named = {part for finding in d.findings for part in signals(finding.signal)}
    for place in d.located:
        if not place.reason and place.signal not in named and not set(signals(place.signal)) & named:
            text = f"{_differs(place.signal)}{_regime([place], place.signal)}"
            sentences.append(f"{text}, and what was left out could not be named.")
    return [*(_unusable(place) for place in d.located if place.reason), *sentences]


def _unusable(place: Located) -> str:
    return f"{_upper(_the(place.signal))}'s {', '.join(place.axes)} is no measurement: {place.reason}."


def _residuals(d: Diagnosis) -> list[str]:
    """Residual of each signal; one sentence where there is none."""
    units = {finding.signal: finding.held_out.unit for finding in d.findings} | UNITS
    texts = [residual_text(residual, units.get(signal, ""), _the(signal)) for signal, residual in d.unexplained.items()]
    if texts and set(texts) == {QUIET}:
        return [f"{_upper(QUIET)}."]
    return [f"{_upper(text)}." for text in texts if text != QUIET]


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
        return " off and on"
    word = regime.split()[0].lower()
    starts = {
        "when",
        "while",
        "where",
        "at",
        "in",
        "on",
        "above",
        "below",
        "during",
        "all",
        "throughout",
        "after",
        "before",
    }
    return f" {regime}" if word in starts else f" at {regime}"


def _seconds(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds >= 10.0 else f"{seconds:.1f} s"


def _upper(text: str) -> str:
    """As a sentence begins; a topic keeps its letters."""
    return text[0].upper() + text[1:]
