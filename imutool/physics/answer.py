"""What is told of a discovery: findings with what they bring, where the misfit lies, what is left, what was not asked."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float64

from imutool.physics import stamps, unnamed
from imutool.physics.apart import remarks, shared
from imutool.physics.diagnosis import UNITS, Curve, Diagnosis, Estimate, Finding, HeldOut, Traces, Unexplained
from imutool.physics.discover import Discovery, Judged
from imutool.physics.fit import Chosen, Fit, Weighed, expected
from imutool.physics.pair import Pair
from imutool.physics.places import of_findings, of_what_is_left
from imutool.physics.unnamed import unit
from imutool.physics.whitening import Band

JITTER = "timestamp_jitter"
INEXACT = 1e-5  # of a misfit's power: 0.3 % of its size, as which the inexactness of a much larger effect's model may pass
SHOWN_KNOTS = 41  # of a curve without a name, as it is told
WHITE = 1.15  # what is left over the noise, as a ratio, that still counts as noise


def told(
    logs: Sequence[Weighed], found: Discovery, reals: Sequence[str], sim: str | None, known: Sequence[Finding]
) -> Diagnosis:
    """Findings with what they bring, where the misfit lies, and what is left; what is `known` of a simulation is expected."""
    pairs = [log.pair for log in logs]
    floor = _floor(logs)
    after = [_with(pair, found.fitted.chosen) for pair in pairs]  # held-out time stays unseen
    named = [_finding(logs, found, one, floor) for one in found.judged]
    all_found = [one for one in named if one.share > INEXACT]
    all_found += stamps.saturated(pairs, after, found.tried) + stamps.dropped(pairs) + stamps.rounded(pairs, floor)
    findings = [one for one in all_found if not shared(one, known)]
    expected_too = {judged.physics.name for judged, one in zip(found.judged, named, strict=True) if shared(one, known)}
    before = [_with(pair, tuple(one for one in found.fitted.chosen if one[0].name in expected_too)) for pair in pairs]
    p_values = {
        signal: min((one.p_value for one in findings if one.effect != JITTER and one.signal in (signal, "both")), default=1.0)
        for signal in ("gyro", "accel")
    }
    quiet = expected_too | {JITTER}  # where stamps are wrong, signals are not
    still = [_with(pair, tuple(one for one in found.fitted.chosen if one[0].name in quiet)) for pair in pairs]
    unexplained = _unexplained(pairs, after, floor)
    if findings:
        places = of_findings(pairs, still, after, floor, findings, p_values)
    else:  # where something is left all the same, it is said where
        odd = {name for name, one in unexplained.items() if not one.white}
        places = [place for place in of_what_is_left(pairs, after, floor) if place.signal in odd]
    return Diagnosis(
        real=tuple(reals),
        sim=sim,
        located=tuple(places),
        findings=tuple(findings),
        bias=found.whole.bias,
        not_identifiable=tuple(
            dict.fromkeys(
                [name for one in found.judged for name in one.unidentified if one.physics.name != JITTER]
                + [one.effect for one in named if one.share <= INEXACT]
            )
        ),
        unexplained=unexplained,
        remarks=(*_remarks(pairs), *remarks(all_found, known)),
        closer={signal: _held_out(pairs, before, after, k, UNITS[signal]) for k, signal in enumerate(("gyro", "accel"))},
        traces=tuple(
            Traces(pair.name, pair.stamp_s, pair.real, b, a, pair.held_out, pair.truth, expected(pair, ()))
            for pair, b, a in zip(pairs, before, after, strict=True)
        ),
    )


def _with(pair: Pair, chosen: Chosen) -> Float64[np.ndarray, "n 6"]:
    """What is expected, with the constant that suits it best."""
    there = expected(pair, chosen)
    usable = pair.fitted | pair.held_out
    return np.asarray(there + (pair.real - there)[usable].mean(axis=0))


def _floor(logs: Sequence[Weighed]) -> Float64[np.ndarray, "6"]:
    """The noise of a sample by axis, before it was made white."""
    variances = []
    for log in logs:
        response = np.array([np.abs(np.fft.rfft(a, 512)) ** 2 for a in log.whiten.filters])
        variances.append(log.whiten.std**2 * (1.0 / response).mean(axis=1))
    return np.asarray(np.sqrt(np.mean(variances, axis=0)))


def _unseen(pair: Pair, there: Float64[np.ndarray, "n 6"]) -> Float64[np.ndarray, "m 6"]:
    """What is left on held-out samples, up to where what is expected is known."""
    left = pair.real - there
    if pair.band_hz is None:
        return np.asarray(left[pair.held_out])
    band = Band.below(pair.band_hz, 1.0 / pair.period_s)
    return np.asarray(band(left)[pair.held_out[:: band.every]])


def _held_out(pairs: Sequence[Pair], before: Sequence[np.ndarray], after: Sequence[np.ndarray], k: int, unit_: str) -> HeldOut:
    """Root mean squares over held-out samples and axes of a signal, and how long that was."""
    part = slice(3 * k, 3 * k + 3)
    power = [
        np.concatenate([(_unseen(pair, there)[:, part] ** 2).ravel() for pair, there in zip(pairs, those, strict=True)])
        for those in (before, after)
    ]
    length = sum(float(pair.held_out.sum()) * pair.period_s for pair in pairs)
    return HeldOut(float(np.sqrt(power[0].mean())), float(np.sqrt(power[1].mean())), unit_, round(length, 1))


def _finding(logs: Sequence[Weighed], found: Discovery, one: Judged, floor: Float64[np.ndarray, "6"]) -> Finding:
    """One effect: what leaving it out costs on time that its parameters were not fitted to."""
    pairs = [log.pair for log in logs]
    fitted = found.fitted
    names = [physics.name for physics, _ in fitted.chosen]
    k = names.index(one.physics.name)
    without: Chosen = (*fitted.chosen[:k], *fitted.chosen[k + 1 :])
    with_ = [_with(pair, fitted.chosen) for pair in pairs]
    alone = [_with(pair, without) for pair in pairs]
    nothing = [_with(pair, ()) for pair in pairs]
    shares = []
    for j, signal in enumerate(("gyro", "accel")):
        if signal in one.physics.sensors:
            held = _held_out(pairs, alone, with_, j, UNITS[signal])
            all_ = _held_out(pairs, nothing, with_, j, UNITS[signal])
            noise = float(np.mean(floor[3 * j : 3 * j + 3] ** 2))
            misfit = max(all_.rms_before**2 - noise, 1e-300)
            excess = held.rms_before**2 - held.rms_after**2
            shares.append((excess / noise, float(np.clip(excess / misfit, 0.0, 1.0)), signal, held))
    _, share, signal, held = max(shares, key=lambda entry: entry[0])
    told_signal = signal if len(one.physics.sensors) == 1 else "both"
    name, _, rest = one.physics.name.replace(" accel", "").partition(":")
    return Finding(
        effect=name,
        signal=told_signal,
        share=share,
        p_value=one.p_value,
        false_discovery_rate=one.false_discovery_rate,
        parameters=_parameters(pairs, one),
        equation=one.physics.equation,
        held_out=held,
        driver=rest.rpartition(":")[0] if name == "driven" else "",
        curve=_curve(logs[0].pair, one, found.whole),
        similar=one.similar,
    )


def _parameters(pairs: Sequence[Pair], one: Judged) -> dict[str, Estimate]:
    """As they were fitted, but for what stamps and samples show exactly; a curve is told by its values."""
    if isinstance(one.physics.forward, unnamed.Curve):
        return {}
    if one.physics.name == JITTER:
        off = np.concatenate([pair.stamp_s - stamps.even(pair.stamp_s)[0] for pair in pairs])
        std = float(off.std())
        return {"std": Estimate(std, std / np.sqrt(2.0 * len(off)), "s")}
    return {
        number.name: Estimate(float(value), float(std), number.unit)
        for number, value, std in zip(one.physics.parameters, one.theta, one.std, strict=True)
    }


def _curve(pair: Pair, one: Judged, whole: Fit) -> Curve | None:
    """A curve without a name by its values, with what they are sure to."""
    forward = one.physics.forward
    if not isinstance(forward, unnamed.Curve):
        return None
    x = forward.points(SHOWN_KNOTS)
    basis = forward.basis(x)
    first = 0
    for physics, theta in whole.chosen:
        if physics.name == one.physics.name:
            break
        first += len(theta)
    covariance = whole.covariance[first : first + len(one.theta), first : first + len(one.theta)]
    middle = float((basis @ one.theta).mean())  # a constant belongs to the bias
    y, band = np.zeros((len(x), 3)), np.zeros((len(x), 3))
    y[:, forward.axis] = basis @ one.theta - middle
    centred = basis - basis.mean(axis=0)
    band[:, forward.axis] = np.sqrt(np.einsum("nq,qp,np->n", centred, covariance, centred))
    return Curve(forward.variable, unit(forward.variable), x, y, band, middle)


def _unexplained(
    pairs: Sequence[Pair], after: Sequence[Float64[np.ndarray, "n 6"]], floor: Float64[np.ndarray, "6"]
) -> dict[str, Unexplained]:
    out = {}
    for k, signal in enumerate(("gyro", "accel")):
        held = _held_out(pairs, after, after, k, UNITS[signal])
        noise = float(np.sqrt(np.mean(floor[3 * k : 3 * k + 3] ** 2)))
        out[signal] = Unexplained(held.rms_after, noise, held.rms_after < WHITE * noise)
    return out


def _remarks(pairs: Sequence[Pair]) -> Iterator[str]:
    for pair in pairs:
        if pair.aligned_s:
            yield (
                f"{pair.name}: the two clocks share no epoch; aligned by the motion ({pair.aligned_s:+.3f} s), "
                "so that a constant offset between them cannot be seen"
            )
        if pair.felt.R_wb is None:
            yield f"{pair.name}: no attitude is known, so that gravity and the earth's rotation were not asked"
