"""Diagnosis from the selected effects: findings with their gain, locations, residuals, remarks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import msgspec
import numpy as np
from jaxtyping import Float64

from imutool.diagnosis.compare_findings import remarks, shared
from imutool.diagnosis.estimation import timestamps
from imutool.diagnosis.estimation import unnamed_effects as unnamed
from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.gauss_newton import Fit, fit
from imutool.diagnosis.estimation.jacobians import Chosen, expected
from imutool.diagnosis.estimation.model_selection import SelectedEffect, Selection
from imutool.diagnosis.estimation.timestamps import late_stamps
from imutool.diagnosis.estimation.unnamed_effects import unit
from imutool.diagnosis.estimation.whitening import WhitenedImu
from imutool.diagnosis.held_out import gains, held_out_rms, known_sensors, noise_floor, unexplained_residuals, with_effects
from imutool.diagnosis.localization import locate_findings, locate_residual
from imutool.diagnosis.reference_free_checks import at_limit, unusable_axes
from imutool.diagnosis.result import ALWAYS, Curve, Diagnosis, Estimate, Finding, Located, Traces
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.diagnosis.to_physics_file import to_physics_file
from imutool.inertial.stationary import white_noise
from imutool.sensor.physics_file import PhysicsFile
from imutool.units import ASCII_UNITS, AXES, SENSORS, UNITS

JITTER, QUANTIZATION = "timestamp_jitter", "quantization"
SHOWN_KNOTS = 41  # of a curve without a name in the report
MOVES = 5.0  # times its noise: an axis should have moved so much to be called stuck


def summarize(
    logs: Sequence[WhitenedImu],
    found: Selection,
    reals: Mapping[str, str],
    sim: str | None,
    known: Sequence[Finding],
    hidden: Sequence[str],
    settings: DiagnoseSettings,
) -> Diagnosis:
    """Diagnosis from a selection of effects; findings that the simulation shares (`known`) are no difference.

    `reals` are paths by the name of a log, `hidden` the unobservable parameters of the catalogue.
    """
    pairs = [log.pair for log in logs]
    noise = noise_floor(logs)
    found, named, idle = _worthwhile(logs, found, noise)
    after = [with_effects(pair, found.fitted.chosen) for pair in pairs]  # held-out time stays unseen
    all_found = list(named)
    exact = all(pair.against == "simulation" for pair in pairs)
    # digits are a sample's, and a row beside poses is the mean of many
    sample = noise if exact else np.asarray(np.median([white_noise(pair.real) for pair in pairs], axis=0))
    all_found += timestamps.saturated(pairs, after, found.tried) + timestamps.dropped(pairs) + timestamps.rounded(pairs, sample)
    if not exact:
        all_found += late_stamps(pairs)
    findings = [one for one in all_found if not shared(one, known)]
    expected_too = {judged.physics.key for judged, one in zip(found.selected, named, strict=True) if shared(one, known)}
    before = [with_effects(pair, tuple(one for one in found.fitted.chosen if one[0].key in expected_too)) for pair in pairs]
    p_values = {
        signal: min((one.p_value for one in findings if one.effect != JITTER and one.signal in (signal, "both")), default=1.0)
        for signal in ("gyro", "accel")
    }
    quiet = expected_too | {JITTER}  # where stamps are wrong, signals are not
    still = [with_effects(pair, tuple(one for one in found.fitted.chosen if one[0].key in quiet)) for pair in pairs]
    unexplained = unexplained_residuals(logs, after, noise, settings.held_out)
    if findings:
        places = locate_findings(pairs, still, after, noise, findings, p_values, settings.localization)
    else:  # where something is left all the same, it is said where
        odd = {name for name, one in unexplained.items() if not one.white}
        places = [at for at in locate_residual(pairs, after, noise, settings.localization) if at.signal in odd]
    places += [place for pair in pairs for place in _stuck(pair, noise, several=len(reals) > 1)]
    return Diagnosis(
        real=tuple(reals.values()),
        sim=sim,
        located=tuple(msgspec.structs.replace(one, log=reals[one.log]) if one.log else one for one in places),
        findings=tuple(findings),
        bias=found.whole.bias,
        not_identifiable=_not_identifiable(found, idle, hidden),
        unexplained=unexplained,
        remarks=(*_remarks(pairs), *_resting(pairs, hidden), *remarks(all_found, known)),
        closer=gains(logs, before, after),
        traces=tuple(_traces(pair, b, a, reals[pair.name]) for pair, b, a in zip(pairs, before, after, strict=True)),
    )


def _traces(pair: Pair, before: Float64[np.ndarray, "n 6"], after: Float64[np.ndarray, "n 6"], path: str) -> Traces:
    ideal = expected(pair, ())
    return Traces(
        pair.name, pair.stamp_s, pair.real, before, after, pair.held_out, pair.truth, ideal, band_hz=pair.band_hz, path=path
    )


def physics_of_fitted_time(logs: Sequence[WhitenedImu], found: Selection, d: Diagnosis) -> PhysicsFile:
    """Physics file of the findings with parameters from the fitted time alone, without quantization."""
    theta = {physics.key: value for physics, value in found.fitted.chosen}
    judged = {(one.physics.name, one.physics.equation): replace(one, theta=theta[one.physics.key]) for one in found.selected}
    pairs = [log.pair for log in logs]

    def fitted(one: Finding) -> Finding:
        there = judged.get((one.effect, one.equation))
        if there is None:
            return one
        curve = _curve(pairs[0], there, found.fitted)
        return msgspec.structs.replace(one, parameters=_parameters(pairs, there), curve=curve)

    return to_physics_file(replace(d, findings=tuple(fitted(one) for one in d.findings if one.effect != QUANTIZATION)))


def _worthwhile(
    logs: Sequence[WhitenedImu], found: Selection, noise: Float64[np.ndarray, "6"]
) -> tuple[Selection, list[Finding], list[str]]:
    """Selection without effects that gain nothing on held-out time, its findings, and those effects."""
    named, idle = [_finding(logs, found, one, noise) for one in found.selected], []
    while any(one.share <= 0.0 for one in named):
        least = min(range(len(named)), key=lambda k: named[k].share)
        idle.append(named[least].effect)
        name = found.selected[least].physics.key
        fitted, whole = (
            fit(logs, tuple(one for one in those.chosen if one[0].key != name), part=those.part, near=those)
            for those in (found.fitted, found.whole)
        )
        theta = {physics.key: value for physics, value in whole.chosen}
        rest = (one for one in found.selected if one.physics.key != name)
        selected = tuple(replace(one, theta=theta[one.physics.key]) for one in rest)
        found = replace(found, selected=selected, fitted=fitted, whole=whole)
        named = [_finding(logs, found, one, noise) for one in found.selected]
    return found, named, idle


def _not_identifiable(found: Selection, idle: Sequence[str], hidden: Sequence[str]) -> tuple[str, ...]:
    """Unidentified parameters of the findings, and unobservable ones of the other effects."""
    told = [name for one in found.selected for name in one.unidentified if one.physics.name != JITTER]
    told += idle
    there = {one.physics.name for one in found.selected}
    return tuple(dict.fromkeys([*told, *(name for name in hidden if name.partition(".")[0] not in there)]))


def _stuck(pair: Pair, floor: Float64[np.ndarray, "6"], *, several: bool) -> Iterator[Located]:
    """Axes with one value in every sample, although a motion was expected."""
    stuck, there = timestamps.stuck(pair.real), expected(pair, ())
    for a in np.flatnonzero(stuck & ~at_limit(pair) & (there.std(axis=0) > MOVES * floor)):
        signal = SENSORS[a // 3]
        reason = f"it reads {pair.real[0, a]:.4g} {UNITS[signal]} in every sample"
        span = ((float(pair.stamp_s[0]), float(pair.stamp_s[-1])),)
        yield Located(signal, (AXES[a % 3],), span, f"{ALWAYS}: {reason}", 1.0, 0.0, pair.name if several else "", reason)


def _finding(logs: Sequence[WhitenedImu], found: Selection, one: SelectedEffect, floor: Float64[np.ndarray, "6"]) -> Finding:
    """Finding of an effect, with its gain on held-out time over the fit without it."""
    pairs = [log.pair for log in logs]
    fitted = found.fitted
    names = [physics.key for physics, _ in fitted.chosen]
    k = names.index(one.physics.key)
    without: Chosen = (*fitted.chosen[:k], *fitted.chosen[k + 1 :])
    with_ = [with_effects(pair, fitted.chosen) for pair in pairs]
    alone = [with_effects(pair, without) for pair in pairs]
    nothing = [with_effects(pair, ()) for pair in pairs]
    shares, known = [], known_sensors(pairs)
    for j, signal in enumerate(("gyro", "accel")):
        if signal in one.physics.sensors and signal in known:
            held = held_out_rms(logs, alone, with_, j, ASCII_UNITS[signal])
            all_ = held_out_rms(logs, nothing, with_, j, ASCII_UNITS[signal])
            noise = float(np.mean(floor[3 * j : 3 * j + 3] ** 2))
            most = max(all_.rms_before, held.rms_before)  # effects may make up for one another
            misfit = max(most**2 - noise, 1e-300)
            excess = held.rms_before**2 - held.rms_after**2
            shares.append((excess / noise, float(np.clip(excess / misfit, 0.0, 1.0)), signal, held))
    _, share, signal, held = max(shares, key=lambda entry: entry[0])
    if sum(brought for brought, *_ in shares) <= 0.0:  # what it takes from one sensor it adds to the other
        share = 0.0
    told_signal = signal if len(one.physics.sensors) == 1 else "both"
    return Finding(
        effect=one.physics.name,
        signal=told_signal,
        share=share,
        p_value=one.p_value,
        false_discovery_rate=one.false_discovery_rate,
        parameters=_parameters(pairs, one),
        equation=one.physics.equation,
        held_out=held,
        driver=one.physics.variable if one.physics.kind == "driven" else "",
        curve=_curve(logs[0].pair, one, found.whole),
        similar=one.similar,
        kind=one.physics.kind,
        axis=None if one.physics.axis is None else AXES[one.physics.axis],
        variable=one.physics.variable,
        onset_s=_onset_s(one),
    )


def _onset_s(one: SelectedEffect) -> float | None:
    times = [float(t_s) for number, t_s in zip(one.physics.parameters, one.theta, strict=True) if number.begins]
    return times[0] if times and np.isfinite(times[0]) else None


def _parameters(pairs: Sequence[Pair], one: SelectedEffect) -> dict[str, Estimate]:
    """Fitted parameters; jitter from the stamps themselves, none for a curve."""
    if isinstance(one.physics.forward, unnamed.Curve):
        return {}
    if one.physics.name == JITTER:
        off = np.concatenate([pair.stamp_s - timestamps.even(pair.stamp_s)[0] for pair in pairs])
        std = float(off.std())
        return {"std": Estimate(std, std / np.sqrt(2.0 * len(off)), "s")}
    return {
        number.name: Estimate(float(value), float(std), number.unit)
        for number, value, std in zip(one.physics.parameters, one.theta, one.std, strict=True)
    }


def _curve(pair: Pair, one: SelectedEffect, whole: Fit) -> Curve | None:
    """Curve of an unknown effect with one standard deviation."""
    forward = one.physics.forward
    if not isinstance(forward, unnamed.Curve):
        return None
    x = forward.points(SHOWN_KNOTS)
    basis = forward.basis(x)
    first = 0
    for physics, theta in whole.chosen:
        if physics.key == one.physics.key:
            break
        first += len(theta)
    covariance = whole.covariance[first : first + len(one.theta), first : first + len(one.theta)]
    middle = float((basis @ one.theta).mean())  # a constant belongs to the bias
    y, band = np.zeros((len(x), 3)), np.zeros((len(x), 3))
    y[:, forward.axis] = basis @ one.theta - middle
    centred = basis - basis.mean(axis=0)
    band[:, forward.axis] = np.sqrt(np.einsum("nq,qp,np->n", centred, covariance, centred))
    return Curve.of_arrays(forward.variable, unit(forward.variable), x, y, band, middle)


def _resting(pairs: Sequence[Pair], hidden: Sequence[str]) -> Iterator[str]:
    """Remark that nothing moves, where not even a clock offset could be seen."""
    if "clock_offset" in hidden:
        names = ", ".join(dict.fromkeys(pair.name for pair in pairs))
        yield f"{names}: too little motion for anything but a bias, its drift, noise, digits and vibration"


def _remarks(pairs: Sequence[Pair]) -> Iterator[str]:
    for pair in pairs:
        if lost := unusable_axes(pair):
            yield f"{pair.name}: {'; '.join(lost)}. What was felt there nobody knows, so the answer rests on all other samples"
        if pair.aligned_s:
            yield (
                f"{pair.name}: the two clocks share no epoch; aligned by the motion ({pair.aligned_s:+.3f} s), "
                "so that a constant offset between them cannot be seen"
            )
        if pair.felt.R_wb is None:
            yield f"{pair.name}: no attitude is known, so that gravity and the earth's rotation were not asked"
