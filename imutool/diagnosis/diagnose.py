"""From logs to an answer: paired with what was expected, weighed by the noise, searched, located, tested on unseen time.

logs ─ pair ─> Pair[] ─ whitening ─> Weighed[] ─ discover ─> Judged[] ─ locate ─> Diagnosis
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from imutool.diagnosis import summarize
from imutool.diagnosis.compare_findings import ANOTHER_MOTION
from imutool.diagnosis.estimation import timestamps
from imutool.diagnosis.estimation import unnamed_effects as unnamed
from imutool.diagnosis.estimation.alignment import LEAST_S, Pair, same_motion, with_simulation, with_truth
from imutool.diagnosis.estimation.block_scatter import scatter
from imutool.diagnosis.estimation.fixed_parameters import with_free
from imutool.diagnosis.estimation.forward_cache import Chosen
from imutool.diagnosis.estimation.gauss_newton import WhitenedLog, expected, fit
from imutool.diagnosis.estimation.model_selection import Selection, select_effects
from imutool.diagnosis.estimation.noise_estimate import whitened
from imutool.diagnosis.estimation.observability import unobservable
from imutool.diagnosis.reference_errors import wrong_for_moments
from imutool.diagnosis.reference_free_checks import by_samples
from imutool.diagnosis.resimulation import simulated_again
from imutool.diagnosis.result import Closer, Diagnosis, Finding
from imutool.diagnosis.scalar.diagnose import SignalDiagnosis, diagnose_signal
from imutool.diagnosis.to_physics_file import NO_EFFECT
from imutool.errors import ConfigError, DataError, ImutoolError, NumericsError
from imutool.location import Location
from imutool.mcap_io.fields import others, read_field
from imutool.mcap_io.read import read as read_log
from imutool.recording import Recording
from imutool.sensor import catalogue
from imutool.sensor.effect import Effect
from imutool.sensor.trajectory import smooth_motion

LEAST_BAND_HZ = 1.0  # and no less: what rests, smoothing makes straight, and it is known all the same
KNOWN_BAND = 0.45  # of where smoothing halves a motion: there it takes a per cent
MOST_OF_IT = 0.9  # of a recording: what is covered less is told
LEAST_KNOWN_S = 2.0  # of an axis, to fit it and again to test it, away from where its converter ends
SHOWN_BY_SAMPLES = {"saturation", "quantization"}  # without any fit: `stamps`
EVERY_UNIT = (
    "mount_rotation",
    "gyro_scale",
    "accel_scale",
    "lever_arm",
    "clock_offset",
)  # in which every unit differs a little
Tell = Callable[[int, int, str], None]


def diagnose(
    reals: Sequence[Location],
    sim: Location | None = None,
    *,
    imu: str | None = None,
    truth: str | None = None,
    signals: Sequence[str] = (),
    tell: Tell | None = None,
) -> Diagnosis:
    """What separates recordings from a simulation, or from what their own true poses say.

    Several recordings share the physics; each has a constant bias of its own. `signals` are other fields that one recording and
    its simulation both hold (`TOPIC.field`), compared in the same way. A simulation of another motion is compared by what its
    own true poses say of it (`imutool.diagnosis.compare_findings`).

    Raises:
        ConfigError, LogError: a log cannot be read, or has no such topic; signals without a simulation, or of several logs.
        DataError: no truth and no simulation, too little shared time, another motion, no axis that tells anything.
    """
    say = tell or (lambda done, total, text: None)
    if signals and (sim is None or len(reals) != 1):
        raise ConfigError("--signal compares one recording with its simulation", where="--signal", fix="Give one log and --sim")
    say(0, 4, "reading")
    beside = [] if sim is None else [(one, read_field(reals[0], one), read_field(sim, one)) for one in signals]
    recordings = _by_names([read_log(real, imu=imu, truth=truth) for real in reals])
    simulated = None if sim is None else read_log(sim, imu=imu)
    known: tuple[Finding, ...] = ()
    if sim is not None and simulated is not None and simulated.truths and _moves_apart(recordings, simulated, signals):
        say(0, 4, "the simulation, of another motion")
        known, simulated = diagnose([sim], imu=imu).findings, None
    apart = sim is not None and simulated is None
    pairs, left_out = _paired(recordings, simulated, truth)
    if not pairs:
        return by_samples(recordings[0], str(reals[0]), left_out[0])
    say(1, 4, "noise")
    candidates = _candidates(pairs)
    logs = [whitened(pair, (*candidates, *unnamed.driven([pair]))) for pair in pairs]
    pairs = [log.pair for log in logs]
    say(2, 4, "searching")
    moments = wrong_for_moments(logs)
    asked, unnamed_too = ((), ()) if moments[0] else (candidates, later(pairs))
    found = select_effects(logs, asked, unnamed_too, lambda word: say(2, 4, f"trying {word}"))
    say(3, 4, "locating")
    paths = {recording.name: str(real) for recording, real in zip(recordings, reals, strict=True)}
    told = summarize.told(logs, found, paths, None if sim is None else str(sim), known, unobservable(logs, candidates))
    if simulated is not None and any(one.effect not in NO_EFFECT for one in told.findings):
        say(3, 4, "simulating again")
        told = _again(told, logs, found, simulated)
    told = replace(told, remarks=(*([ANOTHER_MOTION] if apart else []), *left_out, *told.remarks))
    told = replace(told, findings=(*moments[0], *told.findings), located=tuple(moments[1]) or told.located)
    for signal, real, there in beside:
        say(3, 4, signal)
        told = _with_signal(told, diagnose_signal(real, there, others(reals[0], signal), signal))
    say(4, 4, "")
    return told


def _again(told: Diagnosis, logs: Sequence[WhitenedLog], found: Selection, sim: Recording) -> Diagnosis:
    """With what a second simulation says of the findings; where there can be none, with the reason."""
    if any(one.effect == summarize.JITTER for one in told.findings):  # stamps that jitter are no physics to simulate
        return told
    try:
        closer = simulated_again(logs, sim, summarize.without_held_out(logs, found, told))
    except ImutoolError as error:
        why = f"How much closer it comes is computed, not simulated again: {error}"
        return replace(told, remarks=(*told.remarks, why))
    return replace(told, closer=closer)


def _paired(recordings: Sequence[Recording], sim: Recording | None, truth: str | None) -> tuple[list[Pair], list[str]]:
    """Each recording beside what it should have read; and remarks on what is left out, for poses that do not say that.

    Raises:
        DataError: as `_pairs` and `_telling`; of poses that are too poor only where none of several logs has better ones.
    """
    pairs: list[Pair] = []
    refused: list[ImutoolError] = []
    said: list[str] = []
    for recording in recordings:
        try:
            here = list(_pairs(recording, sim, truth))
        except (DataError, NumericsError) as error:
            if sim is not None or not recording.truths:
                raise
            refused.append(error.at(recording.name))
            continue
        pairs += [_telling(pair) for pair in here]
        covered = sum(float(pair.stamp_s[-1] - pair.stamp_s[0]) for pair in here)
        if covered < MOST_OF_IT * recording.imu.duration_s:
            what = "its true poses cover" if sim is None else "the simulation covers"
            said.append(
                f"{recording.name}: {what} {covered:.0f} of {recording.imu.duration_s:.0f} s; the rest was not looked at"
            )
    if refused and not pairs and len(recordings) > 1:
        raise refused[0]
    return pairs, said + [f"left out, {error}" if pairs else str(error) for error in refused]


def _by_names(recordings: Sequence[Recording]) -> list[Recording]:
    """With a name each: logs of several folders may be called alike."""
    out: list[Recording] = []
    for one in recordings:
        name, number, taken = one.name, 2, {other.name for other in out}
        while name in taken:
            name, number = f"{one.name} ({number})", number + 1
        out.append(one if name == one.name else replace(one, name=name))
    return out


class Measured(NamedTuple):
    """Effects with their parameters, by effect how sure those are (as blocks of time scatter), and the stretches' biases.

    `information` is the noise's alone, of all parameters in order.
    """

    chosen: Chosen
    std: dict[str, Float64[np.ndarray, " p"]]
    information: Float64[np.ndarray, "q q"]
    bias: Float64[np.ndarray, "stretches 6"]


def measured(
    real: Location,
    sim: Location | None = None,
    *,
    imu: str | None = None,
    truth: str | None = None,
    effects: Sequence[str] = EVERY_UNIT,
) -> Measured:
    """Some effects of the catalogue, fitted to a recording together whether they are there or not: what units are compared by.

    Left out is what could not be seen even if it were there: the scale of a gyro's axis that never turns.

    Raises:
        ConfigError, LogError, DataError: as `diagnose`; or an effect that has nothing to be fitted to here.
    """
    simulated = None if sim is None else read_log(sim, imu=imu)
    pairs = [_telling(pair) for pair in _pairs(read_log(real, imu=imu, truth=truth), simulated, truth)]
    candidates = _candidates(pairs)
    logs = [whitened(pair, candidates) for pair in pairs]
    asked = catalogue.diagnosed(effects)
    hidden = set(unobservable(logs, asked))
    shown = []
    for one in asked:
        free = [k for k, number in enumerate(one.parameters) if not {one.name, f"{one.name}.{number.name}"} & hidden]
        shown += [with_free(one, free)] if free else []
    found = fit(logs, tuple((one, one.null_value.astype(float)) for one in shown), part="all")
    std = scatter(logs, found, "all").std if shown else {}
    return Measured(found.chosen, {name: np.asarray(one) for name, one in std.items()}, found.information, found.bias)


def remaining(real: Location, chosen: Chosen = (), *, imu: str | None = None, truth: str | None = None) -> dict[str, Closer]:
    """How far a recording is from what its own true poses say, all of it: without and with some physics, by signal.

    The best constant of its own is in both; compared is as far up in frequency as the poses are known.

    Raises:
        ConfigError, LogError, DataError: as `diagnose`.
    """
    pairs = [_telling(pair) for pair in _pairs(read_log(real, imu=imu, truth=truth), None, truth)]
    candidates = _candidates(pairs)
    logs = []
    for log in (whitened(pair, candidates) for pair in pairs):
        unobservable = replace(log.pair, fitted=np.zeros_like(log.pair.fitted), held_out=log.pair.fitted | log.pair.held_out)
        logs.append(replace(log, pair=unobservable))
    before, after = ([summarize.with_constant(log.pair, expected(log.pair, one)) for log in logs] for one in ((), chosen))
    return summarize.closer(logs, before, after)


def _moves_apart(reals: Sequence[Recording], sim: Recording, signals: Sequence[str]) -> bool:
    """Whether the simulation is of another motion than every recording, which all have true poses.

    Raises:
        DataError: it is of the motion of some only, or other signals are to be compared with it.
    """
    of_one = [same_motion(real.imu, sim.imu) for real in reals]
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


def _with_signal(told: Diagnosis, one: SignalDiagnosis) -> Diagnosis:
    """The answer with what another field of both logs says."""
    signal = one.signal
    return replace(
        told,
        located=(*told.located, *one.located),
        findings=(*told.findings, *one.findings),
        not_identifiable=(*told.not_identifiable, *one.not_identifiable),
        unexplained={**told.unexplained, signal: one.unexplained},
        closer={**told.closer, signal: Closer.of(one.closer, one.unexplained.noise_floor)},
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
        yield with_truth(chosen, since, started_ns, max(KNOWN_BAND * min(stretch.cutoff_hz), LEAST_BAND_HZ))


def _telling(pair: Pair) -> Pair:
    """With what is known: no sample of a converter at its end, no axis that hardly has others, or that is stuck.

    Raises:
        DataError: no axis is left.
    """
    known = ~(timestamps.clipped(pair.real) | timestamps.stuck(pair.real))
    if known.all():
        return pair
    rest = replace(pair, known=known)
    for part in (pair.fitted, pair.held_out):
        known &= (known[part].sum(axis=0) * pair.period_s >= LEAST_KNOWN_S) | (known[part].all(axis=0))
    if not known.any():
        raise DataError(
            "; ".join(summarize.silent(rest)),
            where=pair.name,
            expected=f"{LEAST_KNOWN_S:g} s or more of an axis that moves within its range",
            fix="Record with a sensor that works, of a wider range or of finer digits",
        )
    return rest


def _candidates(pairs: Sequence[Pair]) -> tuple[Effect, ...]:
    """What of the catalogue can be thought of here, and stamps that may be wrong."""
    attitude = all(pair.felt.R_wb is not None for pair in pairs)
    channels = set.intersection(*(set(pair.channels) for pair in pairs))

    def thinkable(physics: Effect) -> bool:
        return all(attitude if need == "attitude" else any(need in name for name in channels) for need in physics.needs)

    found = [one for one in catalogue.diagnosed() if thinkable(one) and one.name not in SHOWN_BY_SAMPLES]
    biases = [np.median(pair.real - expected(pair, ()), axis=0) for pair in pairs]
    exact = all(pair.against == "simulation" for pair in pairs)  # poses know nothing of a millisecond: `late_stamps`
    return (*found, *(timestamps.jitter(pairs) if exact else ()), *timestamps.soft_limits(pairs, biases))


def later(pairs: Sequence[Pair]) -> list[tuple[Effect, ...]]:
    """What is asked once the catalogue has nothing more to say: other channels, then curves and equations without a name."""
    like = unnamed.like(pairs)
    return [tuple(unnamed.driven(pairs)), (*unnamed.curves(like), *unnamed.terms(like))]
