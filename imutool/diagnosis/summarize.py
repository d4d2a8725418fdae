"""What is told of a discovery: findings with what they bring, where the misfit lies, what is left, what was not asked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import msgspec
import numpy as np
from jaxtyping import Bool, Float64
from scipy.stats import f as fisher
from scipy.stats import ttest_1samp

from imutool.diagnosis.compare_findings import remarks, shared
from imutool.diagnosis.estimation import timestamps
from imutool.diagnosis.estimation import unnamed_effects as unnamed
from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.alignment import LEAST_NOISE
from imutool.diagnosis.estimation.gauss_newton import Fit, fit
from imutool.diagnosis.estimation.jacobians import Chosen, expected
from imutool.diagnosis.estimation.model_selection import SelectedEffect, Selection
from imutool.diagnosis.estimation.noise_estimate import noise_std
from imutool.diagnosis.estimation.timestamps import late_stamps
from imutool.diagnosis.estimation.unnamed_effects import unit
from imutool.diagnosis.estimation.whitening import WhitenedImu
from imutool.diagnosis.localization import locate_findings, locate_residual
from imutool.diagnosis.result import Closer, Curve, Diagnosis, Estimate, Finding, HeldOut, Located, Traces, Unexplained
from imutool.diagnosis.to_physics_file import to_physics_file
from imutool.diagnosis.wording.quantity import percent
from imutool.inertial.stationary import white_noise
from imutool.sensor.physics_file import PhysicsFile
from imutool.units import ASCII_UNITS, AXES, SENSORS, UNITS

JITTER, QUANTIZATION = "timestamp_jitter", "quantization"
SHOWN_KNOTS = 41  # of a curve without a name, as it is told
SOME = 0.05  # of the samples of an axis at its limit, from which on that is told
MOVES = 5.0  # times its noise by which an axis should have moved before it is called stuck
WHITE = 1.15  # what is left over the noise, as a ratio, that still counts as noise
BLOCK_S, DOUBTED = 3.0, 0.01  # of held-out time; a chance below which more than noise is left beside poses
BY_CHANCE = 1e-3  # or more, where so few values are left that noise alone exceeds that


def told(
    logs: Sequence[WhitenedImu],
    found: Selection,
    reals: Mapping[str, str],
    sim: str | None,
    known: Sequence[Finding],
    hidden: Sequence[str],
) -> Diagnosis:
    """Findings with what they bring, where the misfit lies, and what is left; what is `known` of a simulation is expected.

    `reals` are paths by the name of a log, `hidden` what of the catalogue no motion shows.
    """
    pairs = [log.pair for log in logs]
    noise = floor(logs)
    found, named, idle = _worthwhile(logs, found, noise)
    after = [_with(pair, found.fitted.chosen) for pair in pairs]  # held-out time stays unseen
    all_found = list(named)
    exact = all(pair.against == "simulation" for pair in pairs)
    # digits are a sample's, and a row beside poses is the mean of many
    sample = noise if exact else np.asarray(np.median([white_noise(pair.real) for pair in pairs], axis=0))
    all_found += timestamps.saturated(pairs, after, found.tried) + timestamps.dropped(pairs) + timestamps.rounded(pairs, sample)
    if not exact:
        all_found += late_stamps(pairs)
    findings = [one for one in all_found if not shared(one, known)]
    expected_too = {judged.physics.key for judged, one in zip(found.selected, named, strict=True) if shared(one, known)}
    before = [_with(pair, tuple(one for one in found.fitted.chosen if one[0].key in expected_too)) for pair in pairs]
    p_values = {
        signal: min((one.p_value for one in findings if one.effect != JITTER and one.signal in (signal, "both")), default=1.0)
        for signal in ("gyro", "accel")
    }
    quiet = expected_too | {JITTER}  # where stamps are wrong, signals are not
    still = [_with(pair, tuple(one for one in found.fitted.chosen if one[0].key in quiet)) for pair in pairs]
    unexplained = _unexplained(logs, after, noise)
    if findings:
        places = locate_findings(pairs, still, after, noise, findings, p_values)
    else:  # where something is left all the same, it is said where
        odd = {name for name, one in unexplained.items() if not one.white}
        places = [place for place in locate_residual(pairs, after, noise) if place.signal in odd]
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
        closer=closer(logs, before, after),
        traces=tuple(_traces(pair, b, a, reals[pair.name]) for pair, b, a in zip(pairs, before, after, strict=True)),
    )


def _traces(pair: Pair, before: Float64[np.ndarray, "n 6"], after: Float64[np.ndarray, "n 6"], path: str) -> Traces:
    ideal = expected(pair, ())
    return Traces(
        pair.name, pair.stamp_s, pair.real, before, after, pair.held_out, pair.truth, ideal, band_hz=pair.band_hz, path=path
    )


def without_held_out(logs: Sequence[WhitenedImu], found: Selection, d: Diagnosis) -> PhysicsFile:
    """What was found as physics.toml has it, with the numbers that the fitted time alone says; digits are no motion's."""
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
    """A discovery without effects that bring nothing on unseen time beside the others, its findings, and those effects."""
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
    """Of what was found, the numbers that nothing shows; of the rest of the catalogue what could not be seen."""
    told = [name for one in found.selected for name in one.unidentified if one.physics.name != JITTER]
    told += idle
    there = {one.physics.name for one in found.selected}
    return tuple(dict.fromkeys([*told, *(name for name in hidden if name.partition(".")[0] not in there)]))


def _stuck(pair: Pair, floor: Float64[np.ndarray, "6"], *, several: bool) -> Iterator[Located]:
    """Axes that read the same in every sample though more was expected than that."""
    stuck, there = timestamps.stuck(pair.real), expected(pair, ())
    for a in np.flatnonzero(stuck & ~_ended(pair) & (there.std(axis=0) > MOVES * floor)):
        signal = SENSORS[a // 3]
        reason = f"it reads {pair.real[0, a]:.4g} {UNITS[signal]} in every sample"
        span = ((float(pair.stamp_s[0]), float(pair.stamp_s[-1])),)
        yield Located(signal, (AXES[a % 3],), span, f"always: {reason}", 1.0, 0.0, pair.name if several else "", reason)


def _ended(pair: Pair) -> Bool[np.ndarray, "6"]:
    """Axes that are at their converter's end so often that it is worth telling."""
    return np.asarray(timestamps.clipped(pair.real).mean(axis=0) > SOME)


def _with(pair: Pair, chosen: Chosen) -> Float64[np.ndarray, "n 6"]:
    """What is expected with some effects and the constant that suits them best."""
    return with_constant(pair, expected(pair, chosen))


def with_constant(pair: Pair, there: Float64[np.ndarray, "n 6"]) -> Float64[np.ndarray, "n 6"]:
    """What is expected with the constant that suits it best; none for an axis of which nothing is known."""
    counts = pair.usable
    constant = np.where(counts, pair.real - there, 0.0).sum(axis=0) / np.maximum(counts.sum(axis=0), 1)
    return np.asarray(there + constant)


def floor(logs: Sequence[WhitenedImu]) -> Float64[np.ndarray, "6"]:
    """The noise of a sample by axis, before it was made white; of an axis nobody knows, that of those beside it."""
    total, count = np.zeros(6), np.zeros(6)
    for log in logs:
        total += log.pair.axes * noise_std(log.whiten) ** 2
        count += log.pair.axes
    variance = total / np.maximum(count, 1.0)
    for part in (slice(0, 3), slice(3, 6)):
        there = count[part] > 0
        variance[part][~there] = variance[part][there].mean() if there.any() else LEAST_NOISE[part][0] ** 2
    return np.asarray(np.sqrt(variance))


def _unseen(log: WhitenedImu, there: Float64[np.ndarray, "n 6"], part: slice) -> Float64[np.ndarray, " m"]:
    """What is left on held-out samples that tell anything, up to where what is expected is known."""
    pair, counts = log.pair, log.whiten.counts
    left, rows = pair.real - there, pair.held_out[:: log.whiten.every]
    if log.whiten.band is not None:
        left = log.whiten.band(left)
    return np.asarray(left[rows, part].ravel() if counts is None else left[rows, part][counts[rows, part]])


def closer(logs: Sequence[WhitenedImu], before: Sequence[np.ndarray], after: Sequence[np.ndarray]) -> dict[str, Closer]:
    """What all findings together bring to each sensor, on held-out time."""
    noise, out = floor(logs), {}
    for signal, k in _known([log.pair for log in logs]).items():
        out[signal] = Closer.computed(_held_out(logs, before, after, k, ASCII_UNITS[signal]), _noise(logs, noise, k))
    return out


def _noise(logs: Sequence[WhitenedImu], floor: Float64[np.ndarray, "6"], k: int) -> float:
    """Of a sensor, over the axes of which anything is known."""
    part, axes = slice(3 * k, 3 * k + 3), np.any([log.pair.axes for log in logs], axis=0)
    return float(np.sqrt(np.mean(floor[part][axes[part]] ** 2)))


def _held_out(
    logs: Sequence[WhitenedImu], before: Sequence[np.ndarray], after: Sequence[np.ndarray], k: int, unit_: str
) -> HeldOut:
    """Root mean squares over held-out samples and axes of a signal, and how long that was; no numbers where none are known."""
    part = slice(3 * k, 3 * k + 3)
    rms = []
    for those in (before, after):
        left = np.concatenate([_unseen(log, there, part) for log, there in zip(logs, those, strict=True)])
        rms.append(float(np.sqrt((left**2).mean())) if len(left) else float("nan"))
    length = sum(float(log.pair.held_out.sum()) * log.pair.period_s for log in logs)
    return HeldOut(rms[0], rms[1], unit_, round(length, 1))


def _finding(logs: Sequence[WhitenedImu], found: Selection, one: SelectedEffect, floor: Float64[np.ndarray, "6"]) -> Finding:
    """One effect: what leaving it out costs on time that its parameters were not fitted to."""
    pairs = [log.pair for log in logs]
    fitted = found.fitted
    names = [physics.key for physics, _ in fitted.chosen]
    k = names.index(one.physics.key)
    without: Chosen = (*fitted.chosen[:k], *fitted.chosen[k + 1 :])
    with_ = [_with(pair, fitted.chosen) for pair in pairs]
    alone = [_with(pair, without) for pair in pairs]
    nothing = [_with(pair, ()) for pair in pairs]
    shares, known = [], _known(pairs)
    for j, signal in enumerate(("gyro", "accel")):
        if signal in one.physics.sensors and signal in known:
            held = _held_out(logs, alone, with_, j, ASCII_UNITS[signal])
            all_ = _held_out(logs, nothing, with_, j, ASCII_UNITS[signal])
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
    """As they were fitted, but for what stamps and samples show exactly; a curve is told by its values."""
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
    """A curve without a name by its values, with what they are sure to."""
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


def _unexplained(
    logs: Sequence[WhitenedImu], after: Sequence[Float64[np.ndarray, "n 6"]], noises: Float64[np.ndarray, "6"]
) -> dict[str, Unexplained]:
    """Of the sensors of which anything is known; beside poses, whose errors come and go, by blocks that are of one mind."""
    out, beside_poses = {}, any(log.whiten.band is not None for log in logs)
    for signal, k in _known([log.pair for log in logs]).items():
        held, noise = _held_out(logs, after, after, k, ASCII_UNITS[signal]), _noise(logs, noises, k)
        part = slice(3 * k, 3 * k + 3)
        unseen = sum(len(_unseen(log, there, part)) for log, there in zip(logs, after, strict=True))
        seen = sum(log.count("fitted") for log in logs) / 2.0  # of both sensors
        most = max(WHITE, float(np.sqrt(fisher.isf(BY_CHANCE, unseen, max(seen, 1.0))))) if unseen else WHITE
        white = held.rms_after < most * noise
        if not white and beside_poses:
            white = _by_chance(logs, after, k, noise) > DOUBTED
        out[signal] = Unexplained(held.rms_after, noise, white)
    return out


def _by_chance(logs: Sequence[WhitenedImu], after: Sequence[Float64[np.ndarray, "n 6"]], k: int, noise: float) -> float:
    """The chance of blocks of held-out time having so much more power than noise, as far as they differ among themselves."""
    powers: list[float] = []
    for log, there in zip(logs, after, strict=True):
        if not log.pair.axes[3 * k : 3 * k + 3].any():
            continue
        rows = log.pair.held_out[:: log.whiten.every]
        left = log.pair.real - there if log.whiten.band is None else log.whiten.band(log.pair.real - there)
        power = (left[rows, 3 * k : 3 * k + 3][:, log.pair.axes[3 * k : 3 * k + 3]] ** 2).mean(axis=1)
        block = np.floor(log.pair.stamp_s[:: log.whiten.every][rows] / BLOCK_S).astype(int)
        powers += [float(power[block == one].mean()) for one in np.unique(block)]
    if len(powers) < 2:
        return 1.0
    return float(ttest_1samp(powers, (WHITE * noise) ** 2, alternative="greater").pvalue)


def _known(pairs: Sequence[Pair]) -> dict[str, int]:
    """Sensors of which an axis at least tells anything, with their places."""
    axes = np.any([pair.axes for pair in pairs], axis=0)
    return {signal: k for k, signal in enumerate(SENSORS) if axes[3 * k : 3 * k + 3].any()}


def silent(pair: Pair) -> list[str]:
    """What of a log tells nothing, and why."""
    stuck, clipped, ended, out = timestamps.stuck(pair.real), timestamps.clipped(pair.real).mean(axis=0), _ended(pair), []
    for a in np.flatnonzero(stuck & ~ended):
        signal = SENSORS[a // 3]
        out.append(f"{signal} {AXES[a % 3]} reads {pair.real[0, a]:.4g} {UNITS[signal]} in every sample")
    for signal, most in timestamps.limits(pair.real).items():
        k = 3 * SENSORS.index(signal)
        share = ", ".join(f"{AXES[a - k]} in {percent(float(clipped[a]))}" for a in range(k, k + 3) if ended[a])
        if share:
            out.append(f"{signal} is at its limit of {most:.4g} {UNITS[signal]}: {share} of the samples")
    return out


def _resting(pairs: Sequence[Pair], hidden: Sequence[str]) -> Iterator[str]:
    """That nothing moves, where not even a late clock would show."""
    if "clock_offset" in hidden:
        names = ", ".join(dict.fromkeys(pair.name for pair in pairs))
        yield f"{names}: too little motion for anything but a bias, its drift, noise, digits and vibration"


def _remarks(pairs: Sequence[Pair]) -> Iterator[str]:
    for pair in pairs:
        if lost := silent(pair):
            yield f"{pair.name}: {'; '.join(lost)}. What was felt there nobody knows, so the answer rests on all other samples"
        if pair.aligned_s:
            yield (
                f"{pair.name}: the two clocks share no epoch; aligned by the motion ({pair.aligned_s:+.3f} s), "
                "so that a constant offset between them cannot be seen"
            )
        if pair.felt.R_wb is None:
            yield f"{pair.name}: no attitude is known, so that gravity and the earth's rotation were not asked"
