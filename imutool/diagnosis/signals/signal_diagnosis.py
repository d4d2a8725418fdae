"""Diagnosis of one signal of a log, of one or several columns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import msgspec
import numpy as np

from imutool.diagnosis.estimation.gauss_newton import fit
from imutool.diagnosis.estimation.jacobians import Chosen, expected
from imutool.diagnosis.estimation.model_selection import select_effects
from imutool.diagnosis.estimation.noise_estimate import noise_std
from imutool.diagnosis.estimation.observability import unobservable
from imutool.diagnosis.estimation.significance import bic, scatter
from imutool.diagnosis.estimation.trial.selection import Selection
from imutool.diagnosis.estimation.whitening import WhitenedLog
from imutool.diagnosis.held_out import held_out_rms, noise_floor, unexplained_residuals, with_effects
from imutool.diagnosis.localization import locate_findings
from imutool.diagnosis.result import Estimate, Finding, HeldOut, Located, SignalTraces, Unexplained
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.diagnosis.signals import scalar_effects as common
from imutool.diagnosis.signals.aligned_signal import AlignedSignal, aligned
from imutool.diagnosis.signals.ideal_signal import SignalPair
from imutool.diagnosis.signals.noise import (
    SMALL_GAIN,
    above_model_error,
    learnt_errors,
    lsb_of,
    rich_residual,
    whitened,
    with_learnt_error,
)
from imutool.diagnosis.signals.signal_constants import (
    GAIN,
    as_torques,
    constant_findings,
    current_remark,
    digits,
    gains_of,
    offsets_of,
    torque_constants,
    torque_findings,
)
from imutool.diagnosis.signals.sparsest_equation import python, terms
from imutool.diagnosis.summarize import finding_of
from imutool.mcap_io.fields import Fields
from imutool.sensor.effect import Effect
from imutool.sensor.robot_effects import joint_actuator_and_load, joint_friction, joint_transmission, wheel, world_sensors
from imutool.sensor.robot_effects.joint_actuator_and_load import with_extent
from imutool.sensor.robot_effects.joint_friction import holds, with_stiction

CONVERTED = 2  # times that currents are made torques: a limit or dead band in amperes shows once all else is known
MODEL_ERROR = 0.01  # of a misfit, that the error of learnt dynamics may be
CURVE_SHARE = 0.03  # of the misfit that a curve has to explain beyond an equation
NO_EPOCH = "{}: the two clocks share no epoch; aligned by the signals ({:+.3f} s), so that a delay between them cannot be seen"
DELAYS = frozenset({"delay", "latency"})
CATALOGUE = {
    "efforts": (
        joint_friction.friction_effects,
        joint_actuator_and_load.load_effects,
        joint_actuator_and_load.actuator_effects,
        joint_transmission.effects,
    ),
    "positions": (joint_transmission.position_effects,),
    "wheels": (wheel.effects,),
    "magnetic": (world_sensors.magnetometer_effects,),
    "pressure": (world_sensors.barometer_effects,),
    "gnss": (world_sensors.gnss_effects,),
}
"""Effects by the kind of a signal; a single column has those of any signal too."""


@dataclass(frozen=True, eq=False)
class SignalDiagnosis:
    """Diagnosis of a signal, in parts that a `Diagnosis` takes; strongest findings first."""

    located: tuple[Located, ...]
    findings: tuple[Finding, ...]
    offset: Mapping[str, Estimate]
    not_identifiable: tuple[str, ...]
    unexplained: Mapping[str, Unexplained]
    closer: Mapping[str, HeldOut]
    remarks: tuple[str, ...]
    traces: Mapping[str, SignalTraces]
    clock_s: float  # of the simulation, over the recording's


def diagnose_signal(
    pair: SignalPair, others: Mapping[str, Fields], settings: DiagnoseSettings | None = None
) -> SignalDiagnosis:
    """Diagnose the misfit of recorded columns to their simulation, but for constant and noise.

    `others` are further numbers of the recording, on its clock, which may drive the misfit; names of columns are TOPIC.field,
    as findings have them.

    Raises:
        DataError: constant, too short, or not of one motion; the message says what to do.
    """
    signal, selection = _with_own_search(aligned(pair, others, settings or DiagnoseSettings())), None
    prepared = _Prepared.of(signal, pair)
    constants = torque_constants(prepared.log, prepared.candidates, prepared.always)
    for _ in range(CONVERTED):
        if constants is None:
            break
        signal, pair = as_torques(signal, constants), replace(pair, real=constants * pair.real)
        prepared = _Prepared.of(signal, pair)
        selection = _selected(prepared)
        constants = gains_of(selection)
    selection = selection or _selected(prepared)
    if (settled := signal.settled(selection.whole.chosen)) is not signal:
        signal, prepared = settled, _Prepared.of(settled, pair)
        selection = _selected(prepared)
    rewhitened = whitened(signal, signal.real - expected(signal, selection.whole.chosen), prepared.lsb)
    if (noise_std(rewhitened.whiten) < signal.settings.signal.better_noise * noise_std(prepared.log.whiten)).any():
        prepared = prepared._replace(log=rewhitened)  # the effects' own high frequencies were taken for noise
        selection = _selected(prepared)
    return _summarized(prepared.log, prepared.candidates, selection, prepared.lsb, signal.settings)


class _Prepared(NamedTuple):
    """A signal to be searched: with the noise of nothing found, effects that may be, those that always are, and its digits."""

    log: WhitenedLog
    candidates: list[Effect]
    always: Chosen
    lsb: list[float]

    @classmethod
    def of(cls, signal: AlignedSignal, pair: SignalPair) -> _Prepared:
        """A signal that was aligned from columns."""
        columns, lsb, candidates = range(signal.columns), lsb_of(pair, signal.settings), catalogue(signal)
        always: Chosen = tuple((common.offset(signal, k), np.zeros(1)) for k in columns)
        if signal.constants:
            always = (*always, *((effect, np.ones(1)) for effect in candidates if effect.name == GAIN))
            candidates = [effect for effect in candidates if effect.name != GAIN]
        if not signal.shares_epoch:
            always = ((common.delay(signal, "delay", 0.2), np.zeros(1)), *always)
            candidates = [effect for effect in candidates if effect.name not in DELAYS]
        elif signal.clock_std_s and not pair.sim_state:
            always = ((common.delay(signal, "clock", signal.clock_std_s), np.zeros(1)), *always)
        log = whitened(signal, np.stack([rich_residual(signal, k) for k in columns], axis=1), lsb)
        return cls(log, candidates, always, lsb)


def _with_own_search(signal: AlignedSignal) -> AlignedSignal:
    """Signal whose search is for effects of each column, but for those that `above_model_error` would leave out."""
    search = signal.settings.search
    maximum = max(search.max_effects, search.effects_each_column * signal.columns)
    minimum = max(search.negligible_share, 0.0 if signal.band_hz is None else SMALL_GAIN)
    search = msgspec.structs.replace(search, max_effects=maximum, negligible_share=minimum)
    return replace(signal, settings=msgspec.structs.replace(signal.settings, search=search))


def _refined(log: WhitenedLog, selection: Selection, settings: DiagnoseSettings) -> Selection:
    """Selection with friction fitted where its joint slides, and a payload with its own inertia, if there are some."""
    finer = {effect.key: with_extent(with_stiction(effect)) for effect, _ in selection.whole.chosen}
    if all(finer[effect.key] is effect for effect, _ in selection.whole.chosen):
        return selection
    chosen = [
        tuple((of := finer[effect.key], np.append(theta, of.null_value[len(theta) :])) for effect, theta in s.chosen)
        for s in (selection.fitted, selection.whole)
    ]
    fitted, whole = fit([log], chosen[0]), fit([log], chosen[1], part="all")
    stds = scatter(whole).std
    effects = {effect.key: (effect, theta) for effect, theta in whole.chosen}
    selected = [
        replace(s, effect=effects[s.effect.key][0], theta=effects[s.effect.key][1], std=stds[s.effect.key])
        for s in selection.selected
    ]
    return replace(selection, selected=tuple(selected), fitted=fitted, whole=whole)


def _selected(prepared: _Prepared) -> Selection:
    """Effects of the catalogue, channels that drive and terms of equations; a curve where none of them stands out."""
    log, candidates, always = prepared.log, prepared.candidates, prepared.always
    signal: AlignedSignal = log.pair  # type: ignore[assignment]  # it was made of one
    columns = range(signal.columns)
    driven = [*common.driven(signal)]
    named = _refined(log, select_effects([log], candidates, [driven], always=always), signal.settings)
    if (resting := _beside_stiction(prepared, named, driven)) is not None:
        named, candidates = resting
    remaining, largest = named.whole.objective - named.whole.numbers, max((e.gain for e in named.selected), default=0.0)
    settings = signal.settings.search
    if named.whole.reduced_chi_square < settings.explained_chi_square or remaining < settings.negligible_share * largest:
        return named  # a term may fit as well as a name, and says less
    equations = [effect for k in columns for effect in terms(signal, k)]
    selection = _refined(log, select_effects([log], candidates, [driven, equations], always=always), signal.settings)
    if selection.whole.reduced_chi_square < settings.explained_chi_square:
        return selection
    curves = [effect for k in columns for effect in common.unknown(signal, k)]
    curved = _refined(log, select_effects([log], candidates, [driven, curves], always=always), signal.settings)
    before = fit([log], always, part="all").objective
    gain = selection.whole.objective - curved.whole.objective
    return curved if gain > CURVE_SHARE * (before - selection.whole.objective) else selection


def _beside_stiction(prepared: _Prepared, found: Selection, driven: Sequence[Effect]) -> tuple[Selection, list[Effect]] | None:
    """Selection with joints that friction holds at rest, and its candidates; None where it is no better.

    What a joint's rest leaves looks like a delay, for the joint turns when its effort does not.
    """
    settings = prepared.log.pair.settings
    begin = tuple(entry for entry in found.whole.chosen if holds(entry[0]))
    if not begin or found.whole.reduced_chi_square < settings.search.explained_chi_square:
        return None
    joints = {effect.sensors for effect, _ in begin}
    candidates = [with_stiction(effect) if effect.sensors in joints else effect for effect in prepared.candidates]
    trial = select_effects([prepared.log], candidates, [driven], always=prepared.always, begin=begin)
    trial = _refined(prepared.log, trial, settings)
    return (trial, candidates) if bic(trial.whole) < bic(found.whole) - settings.search.clearly_better else None


def catalogue(signal: AlignedSignal) -> list[Effect]:
    """Effects that a signal can have by name."""
    any_signal = common.named(signal) if signal.columns == 1 else ()
    return [*any_signal, *(effect for effects in CATALOGUE.get(signal.kind, ()) for effect in effects(signal.scale))]


# ── report ──


def _summarized(
    log: WhitenedLog, candidates: Sequence[Effect], selection: Selection, lsb: Sequence[float], settings: DiagnoseSettings
) -> SignalDiagnosis:
    pair: AlignedSignal = log.pair  # type: ignore[assignment]  # it was made of one
    level, logs, names = noise_floor([log]), [log], pair.names
    selection, small = above_model_error(log, selection)
    before, after = with_effects(pair, ()), with_effects(pair, selection.whole.chosen)
    similar = selection.similar()
    found = ((finding_of(logs, selection, selected, level, similar), selected.effect) for selected in selection.selected)
    findings = [msgspec.structs.replace(f, python=python(effect, f.signal.rpartition(".")[2])) for f, effect in found]
    if pair.band_hz is not None:  # dynamics that were learnt are known to a share
        errors = learnt_errors(log, selection.whole)
        each = zip(findings, selection.selected, strict=True)
        findings = [with_learnt_error(finding, selected.effect, errors) for finding, selected in each]
    p_values = {name: min((f.p_value for f in findings if f.signal in (name, pair.name)), default=1.0) for name in names}
    place = partial(locate_findings, [pair], [before], [after], level, (), p_values)
    floor = level.copy()
    for k in range(pair.columns):
        if lsb[k] > settings.timestamps.min_digits * float(level[k]):
            finding, rounded = digits(log, after, k, lsb[k])
            after = rounded if finding.held_out.rms_after < finding.held_out.rms_before else after
            findings.append(finding)
            floor[k] = np.hypot(level[k], lsb[k] / np.sqrt(12.0))
    offsets = dict(offsets_of(pair, selection))
    findings += [*constant_findings(pair, offsets, level), *torque_findings(log, selection, after, level)]
    if pair.band_hz is not None:
        floor = level = np.hypot(
            level, MODEL_ERROR * np.array([held_out_rms(logs, [before], [before], n).rms_before for n in names])
        )
    unexplained = unexplained_residuals(logs, [after], floor)
    maximum = settings.held_out.max_white_ratio
    beyond = any(not residual.white and residual.rms > maximum * residual.noise_floor for residual in unexplained.values())
    gains = {f.signal: f.parameters["gain"].value for f in findings if f.effect == "actuator_gain"}
    hidden = () if pair.shares_epoch else tuple(f"{name}.delay" for name in names)
    unseen = [*small, *(_unseen(log, candidates, selection, settings) if pair.columns > 1 else ())]
    return SignalDiagnosis(
        located=tuple(place() if findings or beyond else ()),  # what nothing explains has a place
        findings=tuple(findings),
        offset=offsets,
        not_identifiable=(*hidden, *unseen),
        unexplained={
            name: msgspec.structs.replace(unexplained[name], noise_floor=float(level[k])) for k, name in enumerate(names)
        },
        closer={name: held_out_rms(logs, [before], [after], name) for name in names},
        remarks=(*current_remark(gains), *(() if pair.shares_epoch else (NO_EPOCH.format(pair.name, pair.aligned_s),))),
        traces={
            name: SignalTraces(pair.stamp_s, pair.real[:, k], before[:, k], after[:, k], pair.held_out, pair.units[k])
            for k, name in enumerate(names)
        },
        clock_s=pair.aligned_s,
    )


def _unseen(log: WhitenedLog, candidates: Sequence[Effect], selection: Selection, settings: DiagnoseSettings) -> Iterator[str]:
    """Parameters that the motion cannot show, with their column."""
    for selected in selection.selected:
        yield from (f"{name}" for name in selected.unidentified)
    found = {selected.effect.key for selected in selection.selected}
    for effect in candidates:
        if effect.key not in found:
            columns = f" of {', '.join(effect.sensors)}" if 0 < len(effect.sensors) < log.pair.columns else ""
            yield from (f"{name}{columns}" for name in unobservable([log], [effect]))
