"""Comparison of findings: between recordings, and with a simulation of another motion.

Several recordings share their findings. One that asks for other numbers is named: it is of another unit, or mounted otherwise.

A recording and a simulation are each diagnosed against their own truth, then the findings are compared. An effect that both
have, alike to within what the two are sure of, is no difference. One that both have in different sizes is told with the
recording's numbers; one that only the simulation has is told as a remark, since no recording shows it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.gauss_newton import Fit, fit
from imutool.diagnosis.estimation.jacobians import Chosen, free
from imutool.diagnosis.estimation.noise_estimate import axis_squares
from imutool.diagnosis.estimation.observability import exclude_each_other, values_of
from imutool.diagnosis.estimation.trial.selection import Selection
from imutool.diagnosis.estimation.unnamed_effects import plausible_part
from imutool.diagnosis.estimation.whitening import WhitenedLog
from imutool.diagnosis.result import Curve, Estimate, Finding
from imutool.diagnosis.wording.quantity import grouped, stated_parameters
from imutool.sensor import catalogue
from imutool.sensor.effects.gyro_scale import SCALES
from imutool.units import AXES, COLUMNS

ALIKE_STD = 4.5  # joint deviations: chance exceeds them in 0.5 % (Student's t of ten blocks, the largest of nine numbers)
ALIKE_SHARE = (
    0.03  # of the largest number: smoothed poses lack a per cent of either motion. Alike is what is within one of both
)
CONTRADICTS = 0.15  # of what own numbers leave of an axis and of what they explain; logs of one real unit miss up to 0.07
READING = {"gyro": "omega", "accel": "f"}  # what a sensor reads, as equations write it
OF_READING = (  # or of its rest, where rounding errs by a constant
    *("gyro_scale_asymmetry", "accel_scale_asymmetry", "gyro_hysteresis", "accel_hysteresis", "gyro_dead_band"),
    *("gyro_bias_drift", "accel_bias_drift", "gyro_bias_step", "accel_bias_step"),
)
NAMED_SHARE = 0.05  # of the squares that rounding adds, which an effect with a name has to remove
OF_UNIT = ("gyro_scale", "gyro_misalignment", "accel_scale", "accel_misalignment", "mount_rotation")  # its own, or its mount's
OF_LOG = ("clock_offset", "clock_skew")  # its clock, which may be another than that of the others
ANOTHER_MOTION = "the simulation is of another motion; each was compared with its own true poses"


def shared(finding: Finding, sim_findings: Sequence[Finding]) -> bool:
    """Whether the simulation has the same effect with the same numbers."""
    twin = _twin(finding, sim_findings)
    return twin is not None and _alike(finding, twin)


def _reversed_axes(findings: Sequence[Finding]) -> Iterator[str]:
    """Remark on axes that read the opposite of the motion: no sensor has an error of scale below -1."""
    for finding in findings:
        scales = finding.parameters if finding.effect in SCALES else {}
        if axes := ", ".join(axis for axis, s in scales.items() if axis in AXES and s.value + s.std < -1.0):
            yield f"{finding.signal} {axes}: it reads the opposite of the motion, as an axis that is reversed does"


def is_of_digits(finding: Finding, digits: Finding) -> bool:
    """Whether a term, a curve or an effect of an axis' own reading is no more than its rounding.

    It removes less than rounding adds, LSB / sqrt(12); an effect with a name less than `NAMED_SHARE` of these squares.
    """
    own, lsb = f"{READING.get(finding.signal, '')}_{finding.axis}", digits.parameters.get(f"{finding.signal}_lsb")
    is_term = finding.kind == "unknown" and own in finding.equation
    if lsb is None or not (is_term or finding.effect in OF_READING):
        return False
    removed = finding.held_out.rms_before**2 - finding.held_out.rms_after**2
    return removed < (1.0 if is_term else NAMED_SHARE) * lsb.value**2 / 12.0


def is_of_simulation(digits: Finding, pairs: Sequence[Pair]) -> bool:
    """Whether the simulation has the digits of the recording, too: they set neither apart."""
    lsb = {f"{name}_lsb": float(np.median([pair.sim_lsb[part] for pair in pairs])) for name, part in COLUMNS.items()}
    return all(abs(lsb[name] - own.value) <= ALIKE_SHARE * own.value for name, own in digits.parameters.items())


def remarks(findings: Sequence[Finding], sim_findings: Sequence[Finding]) -> Iterator[str]:
    """Effects that the simulation shares or has alone, and axes that are reversed."""
    matched = []
    for finding in findings:
        twin = _twin(finding, sim_findings)
        if twin is None:
            continue
        matched.append(twin)
        if _alike(finding, twin):
            yield f"{_words(finding)}: the simulation has it alike, so it is not among the findings"
        else:
            yield f"{_words(finding)}: the simulation has it too, as {_numbers(twin)}"
    for twin in sim_findings:
        if twin not in matched:
            yield f"{_words(twin)}: the simulation has it ({_numbers(twin)}), the recording does not show it"
    yield from _reversed_axes(findings)


def contradictions(logs: Sequence[WhitenedLog], selection: Selection) -> Iterator[str]:
    """Remarks on recordings whose own numbers of the findings are not those of the others.

    Numbers in which units and mounts differ are fitted with the findings: what only some recordings have is not among these.
    """
    found, always = selection.whole, selection.always
    beside = [
        effect
        for effect in catalogue.diagnosed((*OF_UNIT, *OF_LOG))
        if not any(exclude_each_other(effect, rival) for rival, _ in found.chosen)
    ]
    chosen = (*found.chosen, *((effect, effect.null_value.astype(float)) for effect in beside))
    whole = fit(logs, chosen, found.part)
    while len({log.pair.name for log in whole.logs}) > 1:
        missed = {own: _missed(own, whole, always) for own in _by_log(whole)}
        if max(missed.values()) <= CONTRADICTS:
            return
        own, whole = _odd_one(missed, whole.logs, chosen, always)
        yield f"{own.logs[0].pair.name} contradicts the other logs: {_differing(own, whole, found)}. Diagnose it separately"


def _odd_one(missed: Mapping[Fit, float], logs: Sequence[WhitenedLog], chosen: Chosen, always: int) -> tuple[Fit, Fit]:
    """The recording without which the others agree best, of two the one that misses more, and the fit of the others."""
    entries = [(own, fit([log for log in logs if log not in own.logs], chosen, own.part)) for own in missed]
    if len(entries) == 2:
        return max(entries, key=lambda entry: missed[entry[0]])
    return min(entries, key=lambda entry: max(_missed(e, entry[1], always) for e in missed if e is not entry[0]))


def _by_log(whole: Fit) -> Iterator[Fit]:
    """The effects fitted to each recording by itself, less numbers that are implausible: its motion does not show them."""
    factor = whole.logs[0].pair.settings.search.implausible_factor
    for name in dict.fromkeys(log.pair.name for log in whole.logs):
        own = fit([log for log in whole.logs if log.pair.name == name], whole.chosen, whole.part)
        while (reduced := plausible_part(own.chosen, factor)) is not None:
            own = fit(own.logs, reduced, own.part)
        yield own


def _missed(own: Fit, whole: Fit, always: int) -> float:
    """Squares that an axis of a recording loses by the numbers of all, over those that its own leave, or explain there."""
    without, rest = fit(own.logs, own.chosen[:always], own.part), axis_squares(own)
    return float(
        ((axis_squares(whole, own.logs) - rest) / np.maximum(np.maximum(rest, axis_squares(without) - rest), 1.0)).max()
    )


def _differing(own: Fit, others: Fit, found: Fit) -> str:
    """The effect whose own numbers differ most from those of the others, and both, fitted with the findings."""
    theta, pull = dict(zip(others.keys, others.chosen, strict=True)), np.zeros(len(own.information))
    for effect, own_theta in own.chosen:
        other_values = values_of(theta[effect.key][0], effect, theta[effect.key][1])
        off = np.nan_to_num(free(effect, own_theta) - free(effect, other_values))
        pull += own.information[:, own.place(effect.key)] @ off
    parts = {key: own.place(key) for key in own.keys}
    gain = {key: float(pull[at] @ np.linalg.pinv(own.information[at, at]) @ pull[at]) for key, at in parts.items()}
    key = max(gain, key=lambda name: gain[name])
    own, others = (
        fit(side.logs, tuple(entry for entry in side.chosen if entry[0].key in (key, *found.keys)), side.part)
        for side in (own, others)
    )
    return f"its {key.replace('_', ' ')} is {_numbers_of(own, key)}, theirs {_numbers_of(others, key)}"


def _numbers_of(found: Fit, key: str) -> str:
    effect, theta = found.chosen[found.keys.index(key)]
    each = zip(effect.parameters, theta, found.stds()[key], strict=True)
    return _listed({p.name: Estimate(float(value), float(std), p.unit) for p, value, std in each})


def _twin(finding: Finding, sim_findings: Sequence[Finding]) -> Finding | None:
    """The simulation's finding of the same effect on the same signal, by the same driver."""
    return next((other for other in sim_findings if _key(other) == _key(finding)), None)


def _key(finding: Finding) -> tuple[str, ...]:
    variable = "" if finding.curve is None else finding.curve.variable
    return (
        finding.effect,
        "" if finding.effect == "quantization" else finding.signal,  # digits of either sensor, as far as its noise shows them
        finding.driver,
        variable,
        finding.equation if finding.effect == "unknown" and not variable else "",
    )


def _alike(real: Finding, sim: Finding) -> bool:
    if real.curve is not None and sim.curve is not None:
        return _same_curve(real.curve, sim.curve)
    return _same_numbers(*(_inverted(f.effect, _without_phase(f.parameters)) for f in (real, sim)))


def _inverted(name: str, parameters: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """Parameters with the inverse of each that is infinite without the effect: no filter is one of a period of zero."""
    of_effect = (each for effect in catalogue.diagnosed() if effect.name == name for each in effect.parameters)
    endless = {each.name for each in of_effect if np.isinf(each.null_value) and not each.begins}
    return {
        key: Estimate(1.0 / e.value, e.std / e.value**2, f"1/({e.unit})") if key in endless else e
        for key, e in parameters.items()
    }


def _without_phase(parameters: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """Parameters with amplitudes for sines and cosines: two logs of one vibration begin at other phases."""
    out = {name: e for name, e in parameters.items() if "_sin_" not in name and "_cos_" not in name}
    for name, s in parameters.items():
        if "_sin_" in name:
            c = parameters[name.replace("_sin_", "_cos_")]
            out[name.replace("_sin_", "_")] = Estimate(float(np.hypot(s.value, c.value)), max(s.std, c.std), s.unit)
    return out


def _same_numbers(real: Mapping[str, Estimate], sim: Mapping[str, Estimate]) -> bool:
    """Whether all parameters that both findings have agree within their uncertainty."""
    both = [(real[name], sim[name]) for name in real.keys() & sim.keys()]
    largest = {
        a.unit: max(abs(estimate.value) for pair in both for estimate in pair if estimate.unit == a.unit) for a, _ in both
    }
    return bool(both) and all(
        abs(a.value - b.value) <= max(ALIKE_STD * np.hypot(a.std, b.std), ALIKE_SHARE * largest[a.unit]) for a, b in both
    )


def _same_curve(real: Curve, sim: Curve) -> bool:
    """Where the variable reaches on both sides, about the mean there."""
    x = np.array(real.x)
    inside = (x >= sim.x[0]) & (x <= sim.x[-1])
    if not inside.any():
        return False
    y, band = (
        np.stack([np.interp(x[inside], sim.x, column) for column in np.array(part).T], axis=1) for part in (sim.y, sim.band)
    )
    off = np.array(real.y)[inside] - y
    return bool((np.abs(off - off.mean(axis=0)) <= ALIKE_STD * np.hypot(np.array(real.band)[inside], band)).all())


def _words(finding: Finding) -> str:
    return finding.effect.replace("_", " ") + (f" by {finding.driver}" if finding.driver else "")


def _numbers(finding: Finding) -> str:
    return _listed(stated_parameters(finding))


def _listed(parameters: Mapping[str, Estimate]) -> str:
    texts = [quantity.labelled for quantity in grouped(parameters)]
    return ", ".join(texts) if texts else "a curve of its own"
