"""What a diagnosis says in plain words: what was left out, how large it is, what modelling it brings, and what is left."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from textwrap import fill

from imutool.diagnosis.quantity import Quantity, grouped, percent, symbol
from imutool.diagnosis.result import Diagnosis, Finding, HeldOut, Located, Unexplained

QUIET = "nothing else stands above the noise"
UNKNOWN = "What should have been read is not known, and by themselves the samples show nothing amiss."
NULL = "Nothing but a constant bias and noise separates the two."
SHOWN = 3  # stretches of time in a line
WITH_ALL = "With everything that was found"
AGAIN = "Simulated again with everything that was found"
ABOVE = 1.1  # what remains may be this many times the noise before it is said to stand above it
ITSELF = "always: "
FULL = 3  # findings that the conclusion tells in full; the rest by name
LISTED = 4  # effects that cannot be seen; the rest are counted
ENTRIES = 6  # of an effect that are listed one by one
WIDE = 40  # letters of a value in a table
AS_BEFORE = 2e-3  # by which a root mean square may change and still be called the same
CERTAIN = 1e-9  # a chance below which nobody asks how much
COUNTS = ("No", "One thing was", "Two things were", "Three things were", "Four things were", "Five things were")


@dataclass(frozen=True)
class Words:
    """What the sentences are made of.

    it: the pronoun of what differs; other: what it is compared with; main: the first quantity; rest: the others by label.
    """

    it: str
    other: str
    main: Quantity
    rest: tuple[Quantity, ...]
    finding: Finding

    def left_out(self, text: str) -> str:
        """What a sentence says nothing of, to go behind it; a curve's coefficients mean nothing to a reader."""
        quiet = () if self.finding.curve is not None else tuple(one for one in self.rest if str(one) not in text)
        return "".join(f", {one.labelled}" for one in quiet)


def _clock_offset(w: Words) -> str:
    """tau > 0: a sample shows what happens later, so the reading is ahead."""
    return f"{w.it} {'lags' if w.main.sign < 0 else 'is ahead of'} {w.other} by {w.main.size}"


def _delay(w: Words) -> str:
    return f"{w.it} {'comes before' if w.main.sign < 0 else 'lags'} {w.other} by {w.main.size}"


def _clock_skew(w: Words) -> str:
    """t (1 + eps): with eps > 0 the motion between two stamps is more than their difference says."""
    return f"the clock of the recording runs {'slow' if w.main.sign > 0 else 'fast'} by {w.main.size}"


def _clock_jump(w: Words) -> str:
    """When, and by how much."""
    how_far = f" by {w.rest[0]}" if w.rest else ""
    return f"the clock of the recording jumps{how_far} at {w.main}"


def _driven(w: Words) -> str:
    return f"{w.it} follows {w.finding.driver or 'another channel of the log'} with {w.main.labelled}"


def _unknown(w: Words) -> str:
    """An equation with its coefficients, or a curve that has none."""
    curve = w.finding.curve
    if curve is not None:
        return f"{w.it} follows a smooth curve of {curve.variable} that has no name among the known effects"
    return f"{w.finding.equation}, with {w.main.labelled}; this has no name among the known effects"


SENTENCES: Mapping[str, str | Callable[[Words], str]] = {
    "gyro_bias": "{w.it} reads a constant {w.main} too much",
    "accel_bias": "{w.it} reads a constant {w.main} too much",
    "gyro_scale": "its scale is off by {w.main}",
    "accel_scale": "its scale is off by {w.main}",
    "gyro_misalignment": "its axes are not square: one shows on another by {w.main}",
    "accel_misalignment": "its axes are not square: one shows on another by {w.main}",
    "gyro_g_sensitivity": "{w.it} feels the specific force, with {w.main}",
    "gyro_quadratic": "{w.it} bends with the square of the rate, by {w.main}",
    "accel_quadratic": "{w.it} bends with the square of the specific force, by {w.main}",
    "gyro_bias_drift": "its bias drifts by {w.main} in all",
    "accel_bias_drift": "its bias drifts by {w.main} in all",
    "rate_curve": "{w.it} errs by a curve of the rate, with {w.main}",
    "vibration_rectification": "{w.it} turns vibration into a constant, with {w.main}",
    "lever_arm": "{w.it} sits {w.main} from the tracked point",
    "size_effect": "its three axes sit apart, by {w.main}",
    "mount_rotation": "{w.it} is mounted turned by {w.main}",
    "clock_offset": _clock_offset,
    "clock_skew": _clock_skew,
    "clock_jump": _clock_jump,
    "low_pass": "{w.it} is too slow for what happens above {w.main} (first-order low-pass)",
    "saturation": "{w.it} stops at its limit of {w.main}",
    "quantization": "{w.it} comes in steps of {w.main}",
    "gravity": "gravity differs from what {w.other} takes it for, {w.main.labelled}",
    "earth_rotation": "{w.it} feels the Earth turn, {w.main.labelled}",
    "vibration": "{w.it} vibrates at {w.main}",
    "mount_resonance": "the mount swings at {w.main}",
    "temperature": "{w.it} follows the temperature, with {w.main}",
    "dropped_samples": "samples are missing, {w.main.labelled}",
    "timestamp_jitter": "samples are late by turns, {w.main.labelled}",
    "reference_error": "the reference is wrong, not the sensor, {w.main.labelled}",
    "gain": "its gain is off by {w.main}",
    "offset": "{w.it} reads a constant {w.main} too much",
    "delay": _delay,
    "dead_band": "{w.it} stays still within {w.main} of rest",
    "drift": "{w.it} drifts by {w.main}",
    "friction": "{w.it} is held back by friction of {w.main}, which turns with the sign of the motion",
    "driven": _driven,
    "unknown": _unknown,
}
"""By effect, what it does to a reading. What a sentence leaves out of its quantities is added behind it."""


def conclusion(d: Diagnosis) -> str:
    """The answer in a few sentences: findings by signal, strongest first, then what remains and what cannot be seen."""
    return " ".join([*answer(d), *besides(d)])


def answer(d: Diagnosis) -> list[str]:
    """The sentences that matter most: what was found, and what is left."""
    said = _found(d) if d.mismatch else [NULL if d.unexplained else UNKNOWN]
    left = _remains(d)
    if 0 < len(d.findings) <= FULL and len({one.signal for one in d.findings}) == 1 and len(left) == 1:
        said[-1] = f"{said[-1][:-1]}; {left[0][0].lower()}{left[0][1:]}"  # one thought, one sentence
    elif d.mismatch or not all(one.white for one in d.unexplained.values()):
        said += left
    return said


def besides(d: Diagnosis) -> list[str]:
    """What else there is to say: how much closer a second simulation came, and what cannot be seen."""
    said = []
    touched = {part for one in d.findings for part in signals(one.signal)}
    gone = {signal: one.share for signal, one in d.closer.items() if signal in touched and one.by == "second simulation"}
    again = [f"{percent(share)} of the misfit of {_the(signal)}" for signal, share in gone.items() if share is not None]
    if again:
        seconds = max(one.seconds for one in d.closer.values())
        said.append(f"Simulated again with this, {' and '.join(again)} is gone on {_seconds(seconds)} of unseen time.")
    if hidden := cannot_show(d):
        more = [f"{len(hidden) - LISTED} more effects in whole or part"] if len(hidden) > LISTED + 1 else hidden[LISTED:]
        said.append(f"These logs cannot show: {', '.join([*hidden[:LISTED], *more])}.")
    return said


def cannot_show(d: Diagnosis) -> list[str]:
    """What cannot be seen, by effect: `gyro_scale (x, y)`, or `lever_arm` for all of it; of many entries how many."""
    parts: dict[str, list[str]] = {}
    for name in d.not_identifiable:
        effect, _, part = (name, "", "") if name.startswith("/") else name.partition(".")
        parts.setdefault(effect, []).extend([part] if part else [])
    told = {
        effect: ", ".join(some) if len(some) <= ENTRIES else f"{len(some)} of its numbers" for effect, some in parts.items()
    }
    return [f"{effect} ({some})" if some else effect for effect, some in told.items()]


def lines(d: Diagnosis) -> list[str]:
    """A few lines: the conclusion, each finding with its numbers, places, what came closer, remarks."""
    out = [conclusion(d)]
    for rank, one in enumerate(d.findings, start=1):
        brought = f"; {before_after(one.held_out)}" if measured(one) else ""
        out.append(f"{rank}. {name(one)} ({one.signal}): {parameters(one)}{brought}; {by_chance(one.false_discovery_rate)}")
    return out + below(d)


def table(d: Diagnosis) -> list[list[str]]:
    """The findings in rows of a table, the first one the header; the chance of one that is not beyond all doubt."""
    rows = [["What", "Removes", "Value"]]
    for one in d.findings:
        what = name(one) if one.signal in name(one) else f"{name(one)} ({one.signal})"
        removes = percent(one.share).replace("less than", "<").replace("more than", ">") if measured(one) else "–"
        values = [q.labelled for q in grouped(one.parameters)] if one.curve is None else [parameters(one)]
        if one.false_discovery_rate >= CERTAIN:
            values.append(by_chance(one.false_discovery_rate))
        rows.append([what, removes, "\n".join(fill(text, WIDE) for text in values or [one.equation])])
    return rows


def below(d: Diagnosis) -> list[str]:
    """What goes below the findings: places, what came closer, remarks."""
    out = [f"Where: {where(one)}; {percent(one.share)} of the misfit" for one in d.located]
    if d.findings and d.closer:
        closer = "; ".join(f"{signal} {came_closer(one)}" for signal, one in d.closer.items())
        out.append(f"{with_all(d)}{unseen(d)}: {closer}")
    return out + list(d.remarks)


def with_all(d: Diagnosis) -> str:
    """How what came closer is known."""
    return AGAIN if any(one.by == "second simulation" for one in d.closer.values()) else WITH_ALL


def unseen(d: Diagnosis) -> str:
    """Over which time `closer` was measured, as it goes on after `WITH_ALL`."""
    seconds = max((one.seconds for one in d.closer.values()), default=0.0)
    return f", over {_seconds(seconds)} held out of the search" if seconds > 0.0 else ""


def came_closer(one: HeldOut) -> str:
    """`rms 0.52 to 0.19 m/s², 63 % closer`; what nothing was found for stays as it was."""
    if not one.rms_before > 0.0 or abs(one.rms_after / one.rms_before - 1.0) < AS_BEFORE:
        return f"rms {one.rms_before:.3g} {symbol(one.unit)}, as before".replace(" ,", ",")
    gain = 1.0 - one.rms_after / one.rms_before
    return f"{rms(one)}, {percent(abs(gain))} {'closer' if gain > 0.0 else 'farther'}"


def sentence(d: Diagnosis, one: Finding) -> str:
    """What one finding does, and its name: `it lags the simulation by 12.4 ± 0.3 ms (clock_offset)`."""
    could = f"; could as well be {' or '.join(one.similar)}" if one.similar else ""
    return f"{does(d, one)} ({one.effect}{could})"


def does(d: Diagnosis, one: Finding) -> str:
    """What one finding does to the reading, with its numbers."""
    quantities = grouped(one.parameters)
    main = quantities[0] if quantities else Quantity("", (), ())
    words = Words(_it(one.signal), _other(d), main, tuple(quantities[1:]), one)
    template = SENTENCES.get(one.effect)
    if template is None or not (quantities or one.curve):
        text = f"{words.it} shows {one.effect}, {one.equation}"
        text += f", {main.labelled}" if quantities else ""
    else:
        text = template(words) if callable(template) else template.format(w=words)
    return f"{text}{words.left_out(text)}"


def name(one: Finding) -> str:
    """The effect, with its driver where another channel drives it."""
    return f"{one.effect} by {one.driver}" if one.driver else one.effect


def rms(one: HeldOut) -> str:
    """With three digits, or as many more as it takes to tell the two apart."""
    for digits in range(3, 7):
        before, after = f"{one.rms_before:.{digits}g}", f"{one.rms_after:.{digits}g}"
        if before != after:
            break
    return f"rms {before} to {after} {symbol(one.unit)}".strip()


def measured(one: Finding) -> bool:
    """Whether modelling it is judged by what it removes: missing samples, or a converter's steps, are seen as such."""
    return one.held_out.rms_before > 0.0


def parameters(one: Finding) -> str:
    """All its quantities: `r (0.213, -0.051, 0.120) ± 0.004 m`; of a curve its variable."""
    if one.curve is not None:
        return f"a curve of {one.curve.variable}"
    return ", ".join(q.labelled for q in grouped(one.parameters)) or one.equation


def where(place: Located) -> str:
    """Signal, axes, regime and stretches of time: `accel x, y, angular rate above 0.4 rad/s, 12.0 to 48.5 s`."""
    spans = [f"{first:.1f} to {last:.1f} s" for first, last in place.intervals_s]
    shown = spans if len(spans) <= SHOWN else [*spans[: SHOWN - 1], f"{len(spans) - SHOWN + 1} more stretches"]
    parts = (Path(place.log).stem, f"{place.signal} {', '.join(place.axes)}", place.regime, *shown)
    return ", ".join(part for part in parts if part)


def signals(signal: str) -> tuple[str, ...]:
    """`gyro` and `accel` of what is on both, however that is written; any other signal alone."""
    if signal in {"both", "imu"}:
        return ("gyro", "accel")
    return tuple(part for part in re.split(r"\s*(?:\+|,|\band\b)\s*", signal) if part) or (signal,)


def before_after(one: HeldOut) -> str:
    """`rms 0.52 to 0.19 m/s² on 30 s of unseen data`."""
    return rms(one) + (f" on {_seconds(one.seconds)} of unseen data" if one.seconds > 0.0 else "")


def by_chance(p: float, *, short: bool = False) -> str:
    """How often noise alone would look like it, all that was tried counted: `1 in 2 000 by chance`."""
    if p < CERTAIN:
        said = "below 10⁻⁹" if short else "less than 1 in 10⁹"
    elif p < 0.1:
        said = f"1 in {float(f'{1.0 / p:.2g}'):,.0f}".replace(",", " ")
    else:
        said = "an unknown part" if math.isnan(p) else percent(p)
    return said if short else f"{said} by chance"


def remains(one: Unexplained, unit: str, of: str = "") -> str:
    """How what is left (of a signal, if it is named) compares with its noise."""
    left, floor = f"{one.rms:.3g}", f"{one.noise_floor:.3g} {symbol(unit)}".strip()
    what = f"what remains of {of}" if of else "what remains"
    if one.rms > ABOVE * one.noise_floor:
        return f"{what} is {left} against {floor} of noise, and has no explanation yet"
    return QUIET if one.white else f"{what} is as small as the noise, but not white"


def _found(d: Diagnosis) -> list[str]:
    """A sentence per signal that differs; places nobody could explain come after what has a name."""
    count = len(d.findings)
    said = []
    if count > 1:
        said.append(f"{COUNTS[count] if count < len(COUNTS) else f'{count} things were'} left out.")
    full = d.findings[:FULL]
    order = list(dict.fromkeys(one.signal for one in full))
    told: set[float] = set()
    for signal, group in groupby(sorted(full, key=lambda one: order.index(one.signal)), key=lambda one: one.signal):
        parts = []
        for one in group:
            parts.append(sentence(d, one))
            if measured(one):
                seconds = one.held_out.seconds
                unseen = f" on {_seconds(seconds)} of unseen data" if seconds > 0.0 and seconds not in told else ""
                told.add(seconds)
                parts[-1] += f"; modelling it removes {percent(one.share)} of the misfit{unseen}"
        said.append(f"{_differs(signal)}{_regime(d.located, signal)}: {'; '.join(parts)}.")
    if count > FULL:
        said.append(f"Smaller: {', '.join(f'{name(one)} ({one.signal})' for one in d.findings[FULL:])}.")
    named = {part for one in d.findings for part in signals(one.signal)}
    for place in d.located:
        if not _told_by_place(place) and place.signal not in named and not set(signals(place.signal)) & named:
            text = f"{_differs(place.signal)}{_regime([place], place.signal)}"
            said.append(f"{text}, and what was left out could not be named.")
    return [*(_known_place(one) for one in d.located if _told_by_place(one)), *said]


def _told_by_place(place: Located) -> bool:
    """Whether a place says itself what is the matter there: `always: it reads 0 in every sample`."""
    return place.regime.startswith(ITSELF)


def _known_place(place: Located) -> str:
    return f"{_upper(_the(place.signal))}'s {', '.join(place.axes)} is no measurement: {place.regime.removeprefix(ITSELF)}."


def _remains(d: Diagnosis) -> list[str]:
    """What is left of each signal; one sentence when it is nothing."""
    units = {one.signal: one.held_out.unit for one in d.findings} | {"gyro": "rad/s", "accel": "m/s²"}
    told = [remains(one, units.get(signal, ""), _the(signal)) for signal, one in d.unexplained.items()]
    if told and set(told) == {QUIET}:
        return [f"{_upper(QUIET)}."]
    return [f"{_upper(text)}." for text in told if text != QUIET]


def _the(signal: str) -> str:
    """`the gyro`, `gyro and accel`; any other signal by its name."""
    parts = signals(signal)
    if len(parts) > 1:
        return f"{', '.join(parts[:-1])} and {parts[-1]}"
    return f"the {signal}" if signal in {"gyro", "accel"} else signal


def _differs(signal: str) -> str:
    return f"{_upper(_the(signal))} differ{'' if len(signals(signal)) > 1 else 's'}"


def _it(signal: str) -> str:
    return "it" if len(signals(signal)) == 1 else "the sensor"


def _other(d: Diagnosis) -> str:
    return "the simulation" if d.sim is not None else "the true poses"


def _regime(located: Sequence[Located], signal: str) -> str:
    """Where the largest share of a signal's misfit lies, as it goes on after `differs`."""
    here = [
        place
        for place in located
        if place.regime and not _told_by_place(place) and set(signals(place.signal)) & set(signals(signal))
    ]
    if not here:
        return ""
    regime = max(here, key=lambda place: place.share).regime
    if regime.startswith("always"):
        return regime.replace("always", " throughout", 1)
    if regime.startswith("no regime"):
        return " off and on"
    word = regime.split()[0].lower()
    goes_on = {"when", "while", "where", "at", "in", "on", "above", "below", "during", "all", "throughout", "after", "before"}
    return f" {regime}" if word in goes_on else f" at {regime}"


def _seconds(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds >= 10.0 else f"{seconds:.1f} s"


def _upper(text: str) -> str:
    """As a sentence begins; a topic keeps its letters."""
    return text[0].upper() + text[1:]
