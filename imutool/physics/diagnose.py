"""From logs to an answer: paired with what was expected, weighed by the noise, searched, located, tested on unseen time.

logs ─ pair ─> Pair[] ─ whitening ─> Weighed[] ─ discover ─> Judged[] ─ locate ─> Diagnosis
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from imutool.errors import ConfigError, DataError
from imutool.mcap_io.fields import others, read_field
from imutool.mcap_io.read import read as read_log
from imutool.physics import stamps, unnamed
from imutool.physics.any_signal import diagnose_signal
from imutool.physics.apart import ANOTHER_MOTION, remarks, shared
from imutool.physics.diagnosis import UNITS, Curve, Diagnosis, Estimate, Finding, HeldOut, Traces, Unexplained
from imutool.physics.discover import Discovery, Judged, discover
from imutool.physics.effects import _catalogue
from imutool.physics.effects._forward import Physics
from imutool.physics.fit import Chosen, Fit, Weighed, derivatives, expected, fit
from imutool.physics.motion import smooth_motion
from imutool.physics.pair import LEAST_S, Pair, of_one_motion, with_simulation, with_truth
from imutool.physics.places import of_findings, of_what_is_left
from imutool.physics.reference import wrong_for_moments
from imutool.physics.unnamed import unit
from imutool.physics.whitening import Band, level, whitener
from imutool.place import Place
from imutool.recording import Recording

KNOWN_BAND = 0.45  # of where smoothing halves a motion: there it takes a per cent
ORDER_SIM, ORDER_TRUTH = 6, 12  # of the autoregression: a sensor's noise is nearly white, that of differentiated poses is not
RIDGE = 1e-8
JITTER = "timestamp_jitter"
SHOWN_BY_SAMPLES = {"saturation", "quantization"}  # without any fit: `stamps`
SHOWN_KNOTS = 41  # of a curve without a name, as it is told
EVERY_UNIT = (
    "mount_rotation",
    "gyro_scale",
    "accel_scale",
    "lever_arm",
    "clock_offset",
)  # in which every unit differs a little
WHITE = 1.15  # what is left over the noise, as a ratio, that still counts as noise
Tell = Callable[[int, int, str], None]


def diagnose(
    reals: Sequence[Place],
    sim: Place | None = None,
    *,
    imu: str | None = None,
    truth: str | None = None,
    signals: Sequence[str] = (),
    tell: Tell | None = None,
) -> Diagnosis:
    """What separates recordings from a simulation, or from what their own true poses say.

    Several recordings share the physics; each has a constant bias of its own. `signals` are other fields that one recording and
    its simulation both hold (`TOPIC.field`), compared in the same way. A simulation of another motion is compared by what its
    own true poses say of it (`imutool.physics.apart`).

    Raises:
        ConfigError, LogError: a log cannot be read, or has no such topic; signals without a simulation, or of several logs.
        DataError: no truth and no simulation, too little shared time, another motion.
    """
    say = tell or (lambda done, total, text: None)
    if signals and (sim is None or len(reals) != 1):
        raise ConfigError("--signal compares one recording with its simulation", where="--signal", fix="Give one log and --sim")
    say(0, 4, "reading")
    recordings = [read_log(real, imu=imu, truth=truth) for real in reals]
    simulated = None if sim is None else read_log(sim, imu=imu)
    known: tuple[Finding, ...] = ()
    if sim is not None and simulated is not None and simulated.truths and _moves_apart(recordings, simulated, signals):
        say(0, 4, "the simulation, of another motion")
        known, simulated = diagnose([sim], imu=imu).findings, None
    apart = sim is not None and simulated is None
    pairs = [_unclipped(pair) for recording in recordings for pair in _pairs(recording, simulated, truth)]
    say(1, 4, "noise")
    candidates = _candidates(pairs)
    logs = [_weighed(pair, candidates) for pair in pairs]
    say(2, 4, "searching")
    moments = wrong_for_moments(logs)
    found = discover(logs, () if moments[0] else candidates, () if moments[0] else later(pairs))
    say(3, 4, "locating")
    told = _told(logs, found, [str(real) for real in reals], None if sim is None else str(sim), known)
    if apart:
        told = replace(told, remarks=(ANOTHER_MOTION, *told.remarks))
    told = replace(told, findings=(*moments[0], *told.findings), located=tuple(moments[1]) or told.located)
    for signal in signals:
        assert sim is not None
        say(3, 4, signal)
        told = _with_signal(told, reals[0], sim, signal)
    say(4, 4, "")
    return told


def measured(
    real: Place,
    sim: Place | None = None,
    *,
    imu: str | None = None,
    truth: str | None = None,
    effects: Sequence[str] = EVERY_UNIT,
) -> Fit:
    """Some effects of the catalogue, fitted to a recording together whether they show or not: what units are compared by.

    Raises:
        ConfigError, LogError, DataError: as `diagnose`; or an effect that has nothing to be fitted to here.
    """
    simulated = None if sim is None else read_log(sim, imu=imu)
    pairs = [_unclipped(pair) for pair in _pairs(read_log(real, imu=imu, truth=truth), simulated, truth)]
    candidates = _candidates(pairs)
    begun = tuple((one, one.nothing.astype(float)) for one in _catalogue.physics(effects))
    return fit([_weighed(pair, candidates) for pair in pairs], begun, part="all")


def _moves_apart(reals: Sequence[Recording], sim: Recording, signals: Sequence[str]) -> bool:
    """Whether the simulation is of another motion than every recording, which all have true poses.

    Raises:
        DataError: it is of the motion of some only, or other signals are to be compared with it.
    """
    of_one = [of_one_motion(real.imu, sim.imu) for real in reals]
    if all(of_one) or not all(real.truths for real in reals):
        return False
    if any(of_one):
        raise DataError(
            "the simulation is of the same motion as some recordings only",
            where=sim.name,
            expected="one motion, or as many as logs",
            fix=f"Diagnose apart: {', '.join(real.name for real, same in zip(reals, of_one, strict=True) if same)}",
        )
    if signals:
        raise DataError(
            "--signal compares one motion, and the simulation is of another", where=sim.name, fix="Leave --signal out"
        )
    return True


def _with_signal(told: Diagnosis, real: Place, sim: Place, signal: str) -> Diagnosis:
    """The answer with what another field of both logs says."""
    one = diagnose_signal(read_field(real, signal), read_field(sim, signal), others(real, signal), signal)
    return replace(
        told,
        located=(*told.located, *one.located),
        findings=(*told.findings, *one.findings),
        not_identifiable=(*told.not_identifiable, *one.not_identifiable),
        unexplained={**told.unexplained, signal: one.unexplained},
        closer={**told.closer, signal: one.closer},
        remarks=(*told.remarks, *one.remarks),
        signals={**told.signals, signal: one.traces},
    )


def _pairs(real: Recording, sim: Recording | None, truth: str | None) -> Iterator[Pair]:
    """The recording beside the simulation, or each stretch of it beside its own poses."""
    if sim is not None:
        yield with_simulation(real, sim)
        return
    if not real.truths:
        raise DataError("no simulation and no true poses", where=real.name, expected="--sim SIM.mcap, or poses in the log")
    chosen = real if truth is not None else real.with_truth(next(iter(real.truths)))
    motion = smooth_motion(chosen.truth)
    parts = [felt for felt in motion.felt(1.0 / real.imu.period_s) if felt.t_s[-1] - felt.t_s[0] >= LEAST_S]
    if not parts:
        raise DataError(
            f"the true poses have no stretch of {LEAST_S:g} s that can be differentiated",
            where=real.name,
            expected="poses at 40 Hz or more, without holes",
            fix="Give a simulation with --sim",
        )
    for felt in parts:
        stretch = next(one for one in motion.stretches if one.start_s <= felt.t_s[0] <= one.end_s)
        started_ns = int(chosen.imu.t_ns[0])  # times are told from the log's start, also where its poses begin later
        since = replace(felt, t_s=felt.t_s + (motion.start_ns - started_ns) * 1e-9)
        yield with_truth(chosen, since, started_ns, KNOWN_BAND * min(stretch.cutoff_hz))


def _unclipped(pair: Pair) -> Pair:
    """Without rows in which a converter is at its end.

    Raises:
        DataError: hardly any other row is there.
    """
    clipped = stamps.clipped(pair.real)
    rest = replace(pair, fitted=pair.fitted & ~clipped, held_out=pair.held_out & ~clipped)
    if clipped.any() and (rest.fitted | rest.held_out).sum() * pair.period_s < LEAST_S:
        told = ", ".join(f"{signal} {most:.4g} {UNITS[signal]}" for signal, most in stamps.limits(pair.real).items())
        raise DataError(
            f"the sensor is at its limit in {100.0 * clipped.mean():.0f} % of the samples ({told})",
            where=pair.name,
            expected=f"{LEAST_S:g} s away from it",
            fix="Nobody knows what a sensor would have read beyond its range: record with a wider one",
        )
    return rest


def _candidates(pairs: Sequence[Pair]) -> tuple[Physics, ...]:
    """What of the catalogue can be thought of here, and stamps that may be wrong."""
    attitude = all(pair.felt.R_wb is not None for pair in pairs)
    channels = set.intersection(*(set(pair.channels) for pair in pairs))

    def thinkable(physics: Physics) -> bool:
        return all(attitude if need == "attitude" else any(need in name for name in channels) for need in physics.needs)

    found = [one for one in _catalogue.physics() if thinkable(one) and one.name not in SHOWN_BY_SAMPLES]
    biases = [np.median(pair.real - expected(pair, ()), axis=0) for pair in pairs]
    return (*found, *stamps.jitter(pairs), *stamps.soft_limits(pairs, biases))


def later(pairs: Sequence[Pair]) -> list[tuple[Physics, ...]]:
    """What is asked once the catalogue has nothing more to say: other channels, then curves and equations without a name."""
    like = unnamed.like(pairs)
    exact = all(pair.against == "simulation" for pair in pairs)  # a term is told from a curve by less than poses can tell
    return [tuple(unnamed.driven(pairs)), (*unnamed.curves(like), *(unnamed.terms(like) if exact else ()))]


def _weighed(pair: Pair, candidates: Sequence[Physics]) -> Weighed:
    """The pair with its noise: what is left when everything linear in the catalogue has had its way."""
    linear: Chosen = tuple((one, one.nothing.astype(float)) for one in candidates if one.linear)
    base = expected(pair, linear)
    J = derivatives(pair, linear, range(len(linear)), base)
    left, usable = pair.real - base, pair.fitted | pair.held_out
    for axis in range(6):
        A = np.concatenate([J[:, axis], np.ones((len(J), 1))], axis=1)
        size = np.linalg.norm(A[usable], axis=0)
        A = A[:, size > 0] / size[size > 0]
        N = A[usable].T @ A[usable] + RIDGE * np.eye(A.shape[1])
        left[:, axis] -= A @ np.linalg.solve(N, A[usable].T @ left[usable, axis])
    if pair.against == "simulation":
        return Weighed(pair, level(left, usable, 1.0 / pair.period_s, ORDER_SIM))
    assert pair.band_hz is not None
    return Weighed(pair, whitener(left, usable, ORDER_TRUTH, Band.below(pair.band_hz, 1.0 / pair.period_s)))


# ── what is told ──


def _told(
    logs: Sequence[Weighed], found: Discovery, reals: Sequence[str], sim: str | None, known: Sequence[Finding]
) -> Diagnosis:
    """Findings with what they bring, where the misfit lies, and what is left; what is `known` of a simulation is expected."""
    pairs = [log.pair for log in logs]
    floor = _floor(logs)
    after = [_with(pair, found.fitted.chosen) for pair in pairs]  # held-out time stays unseen
    told = [_finding(logs, found, one, floor) for one in found.judged]
    all_found = [one for one in told if one.share > 0.0]
    all_found += stamps.saturated(pairs, after, found.tried) + stamps.dropped(pairs) + stamps.rounded(pairs, floor)
    findings = [one for one in all_found if not shared(one, known)]
    expected_too = {judged.physics.name for judged, one in zip(found.judged, told, strict=True) if shared(one, known)}
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
                + [one.effect for one in told if one.share <= 0.0]
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
