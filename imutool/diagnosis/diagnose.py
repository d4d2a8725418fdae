"""Diagnosis of recordings: alignment, whitening, effects, localization, held-out gain.

logs ─ align_all ─> Pair[] ─ whitened ─> WhitenedImu[] ─ select_effects ─> Selection ─ summarize ─> Diagnosis
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from imutool.array_types import Float64
from imutool.bias_start.stretches import longest_stretch, measured_recording
from imutool.diagnosis import summarize
from imutool.diagnosis.audit import simulator_remarks
from imutool.diagnosis.audit.simulation import imu_in, read_simulation
from imutool.diagnosis.compare_findings import ANOTHER_MOTION
from imutool.diagnosis.compared_logs import ComparedLogs, imu_topics
from imutool.diagnosis.estimation import timestamps
from imutool.diagnosis.estimation import unnamed_effects as unnamed
from imutool.diagnosis.estimation.aligned_log import DEFAULT, Pair
from imutool.diagnosis.estimation.gauss_newton import fit
from imutool.diagnosis.estimation.jacobians import Chosen, expected
from imutool.diagnosis.estimation.model_selection import select_effects
from imutool.diagnosis.estimation.noise_estimate import whitened_stretches
from imutool.diagnosis.estimation.observability import for_noise, unobservable, with_free
from imutool.diagnosis.estimation.significance import scatter
from imutool.diagnosis.estimation.trial.effect_forms import in_forms
from imutool.diagnosis.estimation.trial.selection import Selection
from imutool.diagnosis.estimation.whitening import WhitenedImu
from imutool.diagnosis.held_out import resimulate
from imutool.diagnosis.imu_relation import imu_relation, imu_sentence
from imutool.diagnosis.reference.another_motion import compared
from imutool.diagnosis.reference.conventions import with_common_conventions
from imutool.diagnosis.reference.coverage import (
    align,
    align_all,
    check_without_reference,
    clock_difference,
    is_another_motion,
    own_poses_sentence,
    with_unique_names,
    without_unseen_offset,
    without_unusable,
)
from imutool.diagnosis.reference.errors import SMOOTHED, reference_caveat, reference_errors, turned_reference
from imutool.diagnosis.result import Diagnosis, Estimate, Finding
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.diagnosis.signals import check_signals, with_signals
from imutool.diagnosis.to_sensor_files import NO_EFFECT, start_values
from imutool.errors import ImutoolError
from imutool.file_location import Location
from imutool.log_info.convention_report import check_one_sensor, check_units, convention_warnings, warn_of_recordings
from imutool.mcap_io.read import read
from imutool.processes.forked import Forked
from imutool.recording import Recording
from imutool.report import NamedProgress, silent
from imutool.sensor import catalogue
from imutool.sensor.channels import with_channels
from imutool.sensor.effect import Effect
from imutool.sensor.effects import clock_wander, gyro_bias_drift, gyro_bias_step, gyro_scale

SHOWN_BY_SAMPLES = {"saturation", "quantization"}  # without any fit: `stamps`
NEEDS_POSES = clock_wander.EFFECT.name  # one clock cannot wander against itself
NEEDS_SIMULATION = "gyro_dead_band"  # a zero crossing takes milliseconds, beyond what poses know


def diagnose(
    reals: Sequence[Location],
    sim: Location | None = None,
    *,
    imu: str | None = None,
    truth: str | None = None,
    signals: Sequence[str] = (),
    tell: NamedProgress = silent,
    settings: DiagnoseSettings = DEFAULT,
    begin: Sequence[Finding] = (),
) -> Diagnosis:
    """Effects that separate recordings from a simulation, or from their own true poses.

    Several recordings share the physics; each has a constant bias of its own. `signals` are other fields that one recording and
    its simulation both hold (`TOPIC.field`), compared in the same way. A simulation of another motion is compared by what its
    own true poses say of it (`imutool.diagnosis.compare_findings`). The search begins with the findings of `begin`.

    Raises:
        ConfigError, LogError: a log cannot be read, or has no such topic; signals without a simulation, or of several logs.
        DataError: no truth and no simulation, too little shared time, another motion, no usable axis, different sensors.
    """
    asked = ComparedLogs(reals, sim, imu, truth, signals, settings)
    tell(0, 4, "reading")
    check_signals(asked)
    topics = imu_topics(reals[0])
    if sim is not None and not (topics and imu_topics(sim)):
        return with_signals(Diagnosis.without_imu(reals, sim), asked, tell)
    first = asked.compared_imu()
    logs_read = [with_channels(read_log(real, imu=first, truth=truth), real) for real in reals]
    recordings = with_unique_names([log.recording for log in logs_read])
    check_one_sensor(recordings)
    wrong = [text for whole in warn_of_recordings(recordings) for text in convention_warnings(whole)]
    others = [topic for topic in topics if topic != first] if len(reals) == 1 and first in topics else []
    if others and sim is None and not recordings[0].truths:
        diagnosis = check_without_reference(recordings[0], str(reals[0]), "no simulation and no true poses", settings)
    else:
        remarks_read = [*(log.remark for log in logs_read if log.remark), *(wrong if sim is None else ())]
        diagnosis, _ = _beside_reference(asked, recordings, remarks_read, tell, begin)
    if others and first is not None:
        diagnosis = _with_other_imus(diagnosis, recordings[0], reals[0], first, others, settings)
    tell(4, 4, "")
    return diagnosis


def _beside_reference(
    asked: ComparedLogs,
    recordings: Sequence[Recording],
    remarks_read: Sequence[str] = (),
    report: NamedProgress = silent,
    begin: Sequence[Finding] = (),
) -> tuple[Diagnosis, Selection | None]:
    """Diagnosis beside a simulation or own poses, and the effects selected (None without a reference)."""
    reals, sim, imu, truth, signals, settings = asked
    simulated = None if sim is None else read_simulation(sim, imu=imu_in(sim, imu))[0]
    warn_of_recordings([] if simulated is None else [simulated])
    of_sim, sim_selection, another = tuple[Finding, ...](), None, list[str]()
    if sim is not None and simulated is not None and is_another_motion(recordings, simulated, signals, settings.alignment):
        report(0, 4, "the simulation, of another motion")
        another = [ANOTHER_MOTION, *simulator_remarks(simulated)]
        own = ComparedLogs([sim], None, imu_in(sim, imu), next(iter(simulated.truths)), (), settings)
        of_itself = with_channels(read_log(sim, imu=own.imu, truth=own.truth), sim).recording
        alone, sim_selection = _beside_reference(own, [of_itself])
        of_sim = alone.findings
        simulated = None
    pairs, left_out = align_all(recordings, simulated, truth, settings)
    if not pairs:
        return check_without_reference(recordings[0], str(reals[0]), left_out[0], settings), None
    pairs, conventions = with_common_conventions(pairs, "poses" if simulated is None else "simulation")
    report(1, 4, "noise")
    candidates = candidates_for(pairs)
    logs = whitened_stretches(pairs, lambda pair: (*for_noise(candidates), *unnamed.driven([pair])))
    pairs = [log.pair for log in logs]
    report(2, 4, "searching")
    wrong, places = reference_errors(logs)
    named, unnamed_groups = ((), ()) if wrong else (candidates, unnamed_candidates(pairs))
    named, always = without_unseen_offset(named, pairs)
    first, trying = start_values(begin, named), lambda word: report(2, 4, f"trying {word}")
    selection = select_effects(logs, named, unnamed_groups, trying, always=always, begin=first)
    wrong += turned_reference(logs, selection.whole.chosen)
    if sim_selection is not None:
        selection, of_sim, small = compared(selection, sim_selection, of_sim)
        another += [small] if small else []
    report(3, 4, "locating")
    paths = {recording.name: str(real) for recording, real in zip(recordings, reals, strict=True)}
    similar, hidden = Forked(selection.similar), unobservable(logs, candidates)
    diagnosis = summarize.summarize(logs, selection, paths, None if sim is None else str(sim), of_sim, hidden)
    if simulated is not None and any(finding.effect not in NO_EFFECT for finding in diagnosis.findings):
        report(3, 4, "simulating again")
        diagnosis = _resimulated(diagnosis, logs, selection, simulated)
    diagnosis = replace(diagnosis, findings=summarize.with_similar(diagnosis.findings, selection, similar.result()))
    caveat = reference_caveat(recordings) if (poses := any(not pair.exact for pair in pairs)) else ""
    follows = [own_poses_sentence(pairs)] if poses and simulated is not None else []
    remarks = (*another, *left_out, *follows, *diagnosis.remarks, *dict.fromkeys(remarks_read))
    findings, located = (*conventions, *wrong, *diagnosis.findings), places if wrong else diagnosis.located or places
    diagnosis = replace(diagnosis, findings=findings, located=located, remarks=remarks, caveat=caveat)
    if sim is not None and len(reals) == 1 and (simulated is not None or signals):
        diagnosis = with_signals(diagnosis, asked, report, clock_difference(pairs, selection.whole))
    return diagnosis, selection


def _with_other_imus(
    diagnosis: Diagnosis, recording: Recording, real: Location, first: str, others: Sequence[str], settings: DiagnoseSettings
) -> Diagnosis:
    """Adds the relation of each other IMU to the first, or the reason why there is none."""
    imus, remarks = dict[str, Mapping[str, Estimate]](), [f"{1 + len(others)} IMUs; the findings are those of {first}"]
    for topic in others:
        try:
            imus[topic] = imu_relation(recording, read_log(real, imu=topic), EVERY_UNIT, settings)
            remarks.append(imu_sentence(topic, first, imus[topic]))
        except ImutoolError as error:
            remarks.append(f"{topic} is not compared with {first}: {error}")
    return replace(diagnosis, imus=imus, remarks=(*diagnosis.remarks, *remarks))


def read_log(log: Location, *, imu: str | None, truth: str | None = None) -> Recording:
    """A recording, which may fall freely, without samples that no sensor gives."""
    return measured_recording(longest_stretch(read(log, imu=imu, truth=truth)), free_fall=True)


def _resimulated(diagnosis: Diagnosis, logs: Sequence[WhitenedImu], selection: Selection, sim: Recording) -> Diagnosis:
    """Adds the gain of a second simulation, or the reason why there is none."""
    if any(finding.effect == timestamps.JITTER for finding in diagnosis.findings):  # jitter of stamps is not simulated
        return diagnosis
    try:
        clock = selection.fitted.chosen[: selection.always]
        closer = resimulate(logs, sim, summarize.physics_of_fitted_time(logs, selection, diagnosis), clock)
    except ImutoolError as error:
        why = f"The gain is computed, not measured with a second simulation. Reason: {error}"
        return replace(diagnosis, remarks=(*diagnosis.remarks, why, *simulator_remarks(sim)))
    return replace(diagnosis, closer=closer)


def candidates_for(pairs: Sequence[Pair]) -> tuple[Effect, ...]:
    """Effects of the catalogue that the logs can have, and jittering stamps."""
    attitude = all(pair.ideal.R_wb is not None for pair in pairs)
    channels = set.intersection(*(set(pair.channels) for pair in pairs))

    def thinkable(effect: Effect) -> bool:
        return all(attitude if need == "attitude" else any(need in name for name in channels) for need in effect.needs)

    exact = all(pair.exact for pair in pairs)  # poses know nothing of a millisecond: `late_stamps`
    left_out = {*SHOWN_BY_SAMPLES, NEEDS_POSES if exact else NEEDS_SIMULATION}
    effects = [effect for effect in catalogue.diagnosed() if thinkable(effect) and effect.name not in left_out]
    effects = in_forms(effects, exact=exact)
    end_s = max(float(pair.stamp_s[-1]) for pair in pairs)
    effects = [*gyro_bias_step.repeated([*gyro_bias_drift.within(clock_wander.with_knots(effects, end_s), end_s)])]
    if len({pair.name for pair in pairs}) == 1:  # else one of another sensor looks like it: `compare_findings`
        effects = [*gyro_scale.in_both_forms(effects)]
    biases = [np.median(pair.real - expected(pair, ()), axis=0) for pair in pairs]
    of_reference = timestamps.jitter(pairs) if exact else (SMOOTHED,)
    return (*effects, *of_reference, *timestamps.soft_limits(pairs, biases))


def unnamed_candidates(pairs: Sequence[Pair]) -> list[tuple[Effect, ...]]:
    """Candidates after the catalogue: driven by other channels, then curves and terms."""
    like = unnamed.like(pairs)
    return [tuple(unnamed.driven(pairs)), (*unnamed.curves(like), *unnamed.terms(like))]


EVERY_UNIT = (
    "mount_rotation",
    "gyro_scale",
    "accel_scale",
    "lever_arm",
    "clock_offset",
)  # of these every unit has a little


class EffectSizes(NamedTuple):
    """Sizes of effects fitted together, with robust standard deviations and biases."""

    chosen: Chosen
    std: dict[str, Float64[np.ndarray, " p"]]
    information: Float64[np.ndarray, "q q"]  # Fisher information of the noise alone, over all parameters in order
    bias: Float64[np.ndarray, "stretches 6"]
    remarks: tuple[str, ...]  # on units and axes of the recording


def effect_sizes(
    real: Location,
    sim: Location | None = None,
    *,
    imu: str | None = None,
    truth: str | None = None,
    effects: Sequence[str] = EVERY_UNIT,
) -> EffectSizes:
    """Fit effects of the catalogue to a recording, significant or not.

    Unobservable parameters are left out, for example the scale of a gyro axis that never turns. `reference_smoothing` among the
    effects keeps the smoothing of poses, which looks like a scale, out of the others; a short log says less of them then.

    Raises:
        ConfigError, LogError, DataError: as `diagnose`; an effect that has nothing to be fitted to here; another unit.
    """
    simulated, settings = None if sim is None else read_simulation(sim, imu=imu_in(sim, imu))[0], DiagnoseSettings()
    recording = with_channels(read_log(real, imu=imu, truth=truth), real).recording
    (whole,) = warn_of_recordings([recording])
    check_units(whole, f"{recording.name} {recording.imu_topic}")
    aligned = align(recording, simulated, truth, settings)
    pairs = [*map(without_unusable, aligned)]
    of_poses = {clock_wander.EFFECT.name, SMOOTHED.name} - set(effects)
    candidates = [effect for effect in candidates_for(pairs) if effect.name not in of_poses]
    logs = whitened_stretches(pairs, lambda _: for_noise(candidates))
    named = catalogue.diagnosed([name for name in effects if name != SMOOTHED.name])
    last_s = max(float(pair.stamp_s[-1]) for pair in pairs)
    wanted = [*clock_wander.with_knots(named, last_s), *((SMOOTHED,) if SMOOTHED.name in effects else ())]
    hidden = set(unobservable(logs, wanted))
    observable = []
    for effect in wanted:
        free = [k for k, p in enumerate(effect.parameters) if not {effect.name, f"{effect.name}.{p.name}"} & hidden]
        observable += [with_free(effect, free)] if free else []
    fitted = fit(logs, tuple((effect, effect.null_value.astype(float)) for effect in observable), part="all")
    std = scatter(fitted).std if observable else {}
    scatters = {key: np.asarray(s) for key, s in std.items()}
    return EffectSizes(fitted.chosen, scatters, fitted.information, fitted.bias, tuple(convention_warnings(whole)))
