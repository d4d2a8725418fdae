"""Diagnosis from the selected effects: findings, locations, residuals, remarks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType

import msgspec
import numpy as np

from imutool.array_types import Float64
from imutool.diagnosis.compare_findings import contradictions, is_of_digits, is_of_simulation, remarks, shared
from imutool.diagnosis.estimation import timestamps
from imutool.diagnosis.estimation.aligned_log import AlignedLog, Pair
from imutool.diagnosis.estimation.gauss_newton import Fit, without_effects
from imutool.diagnosis.estimation.jacobians import Chosen, SplineCurve, expected
from imutool.diagnosis.estimation.model_selection import select_effects
from imutool.diagnosis.estimation.timestamps import JITTER, late_stamps
from imutool.diagnosis.estimation.trial.selection import SelectedEffect, Selection, without
from imutool.diagnosis.estimation.whitening import WhitenedImu, WhitenedLog, level
from imutool.diagnosis.held_out import (
    gains,
    held_out_rms,
    known_signals,
    noise_floor,
    ringing,
    unexplained_residuals,
    with_effects,
)
from imutool.diagnosis.localization import locate_findings, locate_residual
from imutool.diagnosis.reference.coverage import locate_stuck, unusable_axes
from imutool.diagnosis.reference.own_poses import is_in_raw_poses
from imutool.diagnosis.reference.taken_samples import batched
from imutool.diagnosis.result import Curve, Diagnosis, Estimate, Finding, Traces
from imutool.diagnosis.to_sensor_files import to_physics_file
from imutool.inertial.stationary import white_noise
from imutool.sensor import catalogue
from imutool.sensor.effects.vibration import IN_POSES, line_p_value, line_power, steady_p_value
from imutool.sensor.physics_file import PhysicsFile
from imutool.units import AXES, SENSORS

RESONANT = {"mount_resonance", "vibration", JITTER}
QUANTIZATION = "quantization"
SHOWN_KNOTS = 41  # of a curve without a name in the report


def summarize(
    logs: Sequence[WhitenedImu],
    selection: Selection,
    reals: Mapping[str, str],
    sim: str | None,
    sim_findings: Sequence[Finding],
    hidden: Sequence[str],
) -> Diagnosis:
    """Diagnosis from selected effects; findings shared with a simulation are left out."""
    pairs, noise = [log.pair for log in logs], noise_floor(logs)
    exact = all(pair.exact for pair in pairs)
    sample = noise if exact else np.asarray(np.median([white_noise(pair.real) for pair in pairs], axis=0))
    digits = timestamps.rounded(pairs, sample)  # are a sample's, and a row against poses is the mean of many
    selection, named, idle = _worthwhile(logs, selection, noise, digits)
    after = [with_effects(pair, selection.fitted.chosen) for pair in pairs]  # held-out time stays unseen
    all_findings = [*named, *timestamps.saturated(pairs, after, selection.tried), *timestamps.dropped(pairs)]
    all_findings += [f for f in digits if not is_of_simulation(f, pairs)]
    if not exact:
        all_findings += late_stamps(pairs) + vibration_above_band(logs, selection.whole.chosen)
    elif not any(finding.effect in RESONANT for finding in all_findings):
        all_findings += ringing(logs, after)
    all_findings += batched(pairs, all_findings)
    findings, both_have = [f for f in all_findings if not shared(f, sim_findings)], remarks(all_findings, sim_findings)
    both, chosen = zip(selection.selected, named, strict=True), selection.fitted.chosen
    clock = chosen[: selection.always]  # where logs share no epoch
    expected_too = {f.effect.key for f, finding in both if shared(finding, sim_findings)} | {of.key for of, _ in clock}
    before = [with_effects(pair, tuple(entry for entry in chosen if entry[0].key in expected_too)) for pair in pairs]
    p_values = {str(signal): _p_value(findings, signal) for signal in SENSORS}
    baseline = [with_effects(pair, tuple(of for of in chosen if of[0].key in {JITTER, *expected_too})) for pair in pairs]
    unexplained = unexplained_residuals(logs, after, noise)
    located = locate_findings(pairs, baseline, after, noise, findings, p_values) if findings else []
    if not located:  # where something is left all the same, it is said where
        coloured = {signal: residual.p_value for signal, residual in unexplained.items() if not residual.white}
        located = locate_residual(pairs, after, noise, coloured)
    located += [place for pair in pairs for place in locate_stuck(pair, noise, several=len(reals) > 1)]
    return Diagnosis(
        real=tuple(reals.values()),
        sim=sim,
        located=tuple(msgspec.structs.replace(at, log=reals[at.log]) if at.log else at for at in located),
        findings=tuple(findings),
        bias=_biases(selection.whole),
        not_identifiable=_not_identifiable(selection, idle, hidden),
        unexplained=unexplained,
        remarks=(
            *contradictions(logs, selection),
            *dict.fromkeys(_remarks(pairs, selection)),
            *_resting(pairs, hidden),
            *both_have,
        ),
        closer=gains(logs, before, after),
        traces=tuple(
            Traces(p.name, p.stamp_s, p.real, b, a, p.held_out, p.truth, expected(p, clock), p.band_hz, reals[p.name])
            for p, b, a in zip(pairs, before, after, strict=True)
        ),
        start_ns=pairs[0].log_start_ns + round(1e9 * pairs[0].aligned_s),
    )


def vibration_above_band(logs: Sequence[WhitenedImu], chosen: Chosen) -> list[Finding]:
    """Vibration faster than the band of the poses, from the longest stretch of one log.

    A line that stands out from the colour of what the body does needs no reference. One that the poses have, too, smoothed
    or not, is the body's motion, or their own, as at a camera's rate.
    """
    (vibration,) = catalogue.diagnosed(["vibration"])
    pair = max((log.pair for log in logs), key=lambda aligned: len(aligned.stamp_s))
    several = len({log.pair.name for log in logs}) > 1
    if several or pair.band_hz is None or any(effect.key == vibration.key for effect, _ in chosen):
        return []
    by_poses, residual, rate_hz = expected(pair, ()), pair.real - expected(pair, chosen), 1.0 / pair.period_s
    white = level(residual, pair.usable, rate_hz, msgspec.structs.replace(pair.settings.noise, motion_hz=pair.band_hz))
    log = WhitenedImu(replace(pair, real=residual + by_poses, band_hz=None), white)
    found = select_effects([log], [vibration])
    chance, power = pair.settings.search.false_discovery_rate, partial(line_power, pair.stamp_s, noise=white_noise(pair.real))
    faster = [line for line in found.selected if line.theta[0] > pair.band_hz]
    own = [line for line in faster if IN_POSES * power(pair.real, line.theta[0]) > power(by_poses, line.theta[0])]
    tests = partial(line_p_value, residual, rate_hz), partial(steady_p_value, pair.stamp_s, residual)
    clear = [line for line in own if all(p_value(line.theta[0]) < chance for p_value in tests)]
    alone = [line for line in clear if not is_in_raw_poses(pair, residual, line.theta[0])]
    return [finding_of([log], found, line, noise_floor([log])) for line in alone]


def physics_of_fitted_time(logs: Sequence[WhitenedImu], selection: Selection, d: Diagnosis) -> PhysicsFile:
    """Physics file of the findings, fitted without held-out time and without quantization."""
    theta = {effect.key: value for effect, value in selection.fitted.chosen}
    refitted = [replace(effect, theta=theta[effect.effect.key]) for effect in selection.selected]
    pairs = [log.pair for log in logs]

    def fitted(finding: Finding) -> Finding:
        alike = [e for e in refitted if (e.effect.name, e.effect.equation) == (finding.effect, finding.equation)]
        if not alike:
            return finding
        selected = next((e for e in alike if e.effect.sensors == (finding.signal,)), alike[-1])
        curve = _curve(selected, selection.fitted)
        return msgspec.structs.replace(finding, parameters=_parameters(pairs, selected), curve=curve)

    return to_physics_file(
        replace(d, findings=tuple(fitted(finding) for finding in d.findings if finding.effect != QUANTIZATION))
    )


def _biases(whole: Fit) -> Float64[np.ndarray, "logs 6"]:
    """Constant bias of each log: the mean of one that walks, whose fit knows where it began."""
    if all(log.whiten.walk is None for log in whole.logs):
        return whole.bias
    pairs = [log.pair for log in whole.logs]
    return np.array([with_effects(pair, whole.chosen)[0] - expected(pair, whole.chosen)[0] for pair in pairs])


def _worthwhile(
    logs: Sequence[WhitenedImu], selection: Selection, noise: Float64[np.ndarray, "6"], digits: Sequence[Finding]
) -> tuple[Selection, list[Finding], list[str]]:
    """Selection without effects of no held-out gain or of `digits`, its findings, and the former."""
    named, idle = [finding_of(logs, selection, selected, noise) for selected in selection.selected], []
    while weak := [k for k, f in enumerate(named) if f.share <= 0.0 or any(is_of_digits(f, other) for other in digits)]:
        minimum = min(weak, key=lambda k: named[k].share)
        idle += [named[minimum].effect] if named[minimum].share <= 0.0 else []
        selection = without(selection, {selection.selected[minimum].effect.key})
        named = [finding_of(logs, selection, selected, noise) for selected in selection.selected]
    return selection, named, idle


def _not_identifiable(selection: Selection, idle: Sequence[str], hidden: Sequence[str]) -> tuple[str, ...]:
    """Unidentified parameters of the findings, and unobservable ones of the other effects."""
    names = [name for selected in selection.selected for name in selected.unidentified if selected.effect.name != JITTER]
    names += idle
    reported = {selected.effect.name for selected in selection.selected}
    return tuple(dict.fromkeys([*names, *(name for name in hidden if name.partition(".")[0] not in reported)]))


def finding_of(
    logs: Sequence[WhitenedLog],
    selection: Selection,
    selected: SelectedEffect,
    floor: Float64[np.ndarray, " k"],
    similar: Mapping[str, tuple[str, ...]] = MappingProxyType({}),
) -> Finding:
    """Finding of an effect, with its gain on held-out time over the fit without it."""
    pairs, effect, chosen = [log.pair for log in logs], selected.effect, selection.fitted.chosen
    place, always = selection.fitted.keys.index(effect.key), selection.always
    without, nothing = (without_effects(selection.fitted, out, always) for out in ([place], range(always, len(chosen))))
    complete, left_out, no_effects = ([with_effects(pair, these) for pair in pairs] for these in (chosen, without, nothing))
    shares, named = [], list[str](effect.sensors) or list(pairs[0].signals)
    for signal in known_signals(logs):
        if signal in named:
            held_out = held_out_rms(logs, left_out, complete, signal)
            held_out_of_all = held_out_rms(logs, no_effects, complete, signal)
            noise = float(np.mean(floor[pairs[0].signals[signal]] ** 2))
            maximum = max(held_out_of_all.rms_before, held_out.rms_before)  # effects may make up for one another
            misfit = max(maximum**2 - noise, 1e-300)
            excess = held_out.rms_before**2 - held_out.rms_after**2
            shares.append((excess / noise, float(np.clip(excess / misfit, 0.0, 1.0)), signal, held_out))
    _, share, signal, held_out = max(shares, key=lambda entry: entry[0])
    if sum(brought for brought, *_ in shares) <= 0.0:  # what it takes from one sensor it adds to the other
        share = 0.0
    return Finding(
        effect=effect.name,
        signal=signal if len(named) == 1 else "both" if named == list(SENSORS) else pairs[0].name,
        share=share,
        p_value=selected.p_value,
        false_discovery_rate=selected.false_discovery_rate,
        parameters=_parameters(pairs, selected),
        equation=effect.equation,
        held_out=held_out,
        driver=effect.variable if effect.kind == "driven" else "",
        curve=_curve(selected, selection.whole),
        similar=similar.get(effect.key, ()),
        kind=effect.kind,
        axis=None if effect.axis is None else AXES[effect.axis],
        variable=effect.variable,
        onset_s=_onset_s(selected),
    )


def with_similar(
    findings: Sequence[Finding], selection: Selection, similar: Mapping[str, tuple[str, ...]]
) -> tuple[Finding, ...]:
    """Findings with the other effects that would do as well, by the key of the selected effect."""
    found = {(e.effect.name, e.effect.equation): similar.get(e.effect.key, ()) for e in selection.selected}
    return tuple(msgspec.structs.replace(e, similar=found.get((e.effect, e.equation), ())) for e in findings)


def _onset_s(selected: SelectedEffect) -> float | None:
    times = [float(t_s) for parameter, t_s in zip(selected.effect.parameters, selected.theta, strict=True) if parameter.begins]
    return times[0] if times and np.isfinite(times[0]) else None


def _parameters(pairs: Sequence[AlignedLog], selected: SelectedEffect) -> dict[str, Estimate]:
    """Fitted parameters; jitter from the stamps themselves, none for a curve."""
    if isinstance(selected.effect.forward, SplineCurve):
        return {}
    if selected.effect.name == JITTER:
        jitter_s = np.concatenate([pair.stamp_s - timestamps.even(pair.stamp_s)[0] for pair in pairs])
        std = float(np.hypot(jitter_s.std(), max(pair.batched_s for pair in pairs if isinstance(pair, Pair))))
        return {"std": Estimate(std, float(std / np.sqrt(2.0 * len(jitter_s))), "s")}
    fitted = {
        parameter.name: Estimate(float(value), float(std), parameter.unit)
        for parameter, value, std in zip(selected.effect.parameters, selected.theta, selected.std, strict=True)
    }
    return fitted | {parameter.name: Estimate(value, 0.0, parameter.unit) for parameter, value in selected.effect.constants}


def _curve(selected: SelectedEffect, fitted: Fit) -> Curve | None:
    """Curve of an effect with one standard deviation; its mean belongs to the bias."""
    forward = selected.effect.forward
    if not isinstance(forward, SplineCurve):
        return None
    x = forward.points(SHOWN_KNOTS)
    basis = forward.basis(x)
    centred, place = basis - basis.mean(axis=0), fitted.place(selected.effect.key)
    y, band = np.zeros((len(x), forward.columns)), np.zeros((len(x), forward.columns))
    y[:, forward.axis] = centred @ selected.theta
    band[:, forward.axis] = np.sqrt(np.einsum("nq,qp,np->n", centred, fitted.covariance[place, place], centred))
    return Curve.of_arrays(forward.variable, forward.unit, x, y, band, float((basis @ selected.theta).mean()))


def _resting(pairs: Sequence[Pair], hidden: Sequence[str]) -> Iterator[str]:
    """Remark that nothing moves, where not even a clock offset could be seen."""
    if "clock_offset" in hidden:
        names = ", ".join(dict.fromkeys(pair.name for pair in pairs))
        yield f"{names}: too little motion for anything but a bias, its drift, noise, digits and vibration"


def _p_value(findings: Sequence[Finding], signal: str) -> float:
    """Least p-value of the findings of a signal."""
    return min((f.p_value for f in findings if f.effect != JITTER and f.signal in (signal, "both")), default=1.0)


def _remarks(pairs: Sequence[Pair], selection: Selection) -> Iterator[str]:
    yield from selection.remarks
    for pair in pairs:
        if axes := unusable_axes(pair):
            yield f"{pair.name}: {'; '.join(axes)}. These samples are no measurement; the diagnosis uses all others"
        if not pair.exact and pair.truth is not None and not pair.truth.has_positions:
            yield f"{pair.name}: the true poses have no positions, so the accelerometer was not compared with them"
        if pair.aligned_s:
            unseen = "so that a constant delay of the sensor cannot be told from it"
            yield f"{pair.name}: the two clocks differ by {pair.aligned_s:+.3f} s; aligned by the motion, {unseen}"
        if pair.ideal.R_wb is None:
            yield f"{pair.name}: no attitude is known, so gravity and the earth's rotation were not tried"
