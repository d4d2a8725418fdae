"""Diagnosis of one signal of a log, of one or several columns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np
from jaxtyping import Bool, Float64
from scipy.ndimage import median_filter
from scipy.signal import welch

from imutool.diagnosis.estimation.candidate_score import Selection
from imutool.diagnosis.estimation.jacobians import Chosen, expected
from imutool.diagnosis.estimation.model_selection import select_effects
from imutool.diagnosis.estimation.noise_estimate import noise_std, ridge_fit
from imutool.diagnosis.estimation.observability import unobservable
from imutool.diagnosis.estimation.timestamps import grid
from imutool.diagnosis.estimation.unnamed_effects import SplineBasis
from imutool.diagnosis.estimation.whitening import Band, WhitenedLog, Whitener, autoregression
from imutool.diagnosis.held_out import held_out_rms, noise_floor, unexplained_residuals, with_effects
from imutool.diagnosis.localization import locate_findings
from imutool.diagnosis.result import Estimate, Finding, HeldOut, Located, SignalTraces, Unexplained
from imutool.diagnosis.settings import DiagnoseSettings, NoiseSettings
from imutool.diagnosis.signals import common_effects as common
from imutool.diagnosis.signals.alignment import AlignedSignal, Column, aligned
from imutool.diagnosis.signals.ideal_signal import SignalPair
from imutool.diagnosis.summarize import finding_of
from imutool.mcap_io.fields import Fields
from imutool.sensor.effect import Effect
from imutool.sensor.robot_effects import (
    barometer,
    gnss,
    joint_actuator,
    joint_friction,
    joint_load,
    joint_transmission,
    magnetometer,
    wheel,
)

EXACT = 1e-3
RICH_KNOTS = 12
CERTAIN = 6.0  # deviations from which a constant is a finding
NO_EPOCH = "{}: the two clocks share no epoch; aligned by the signal ({:+.3f} s), so that a delay between them cannot be seen"
DELAYS = frozenset({"delay", "latency"})
CATALOGUE = {
    "efforts": (joint_friction.effects, joint_load.effects, joint_actuator.effects, joint_transmission.effects),
    "positions": (joint_transmission.position_effects,),
    "wheels": (wheel.effects,),
    "magnetic": (magnetometer.effects,),
    "pressure": (barometer.effects,),
    "gnss": (gnss.effects,),
}
"""Effects by the kind of a signal; a single column has those of any signal too."""
CONSTANTS = {
    "magnetic": ("hard_iron", "field += hard iron"),
    "range": ("offset", "y += offset"),
    "positions": ("encoder_offset", "the angle read = angle + offset"),
}
"""Name and equation of a constant, where it is physics and no news of a sensor's zero."""


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


def diagnose_signal(
    pair: SignalPair, others: Mapping[str, Fields], settings: DiagnoseSettings | None = None
) -> SignalDiagnosis:
    """Diagnose the misfit of recorded columns to their simulation, but for constant and noise.

    `others` are further numbers of the recording, on its clock, which may drive the misfit; names of columns are TOPIC.field,
    as findings have them.

    Raises:
        DataError: constant, too short, or not of one motion; the message says what to do.
    """
    settings = settings or DiagnoseSettings()
    signal = aligned(pair, others, settings)
    lsb = _lsb(pair, settings)
    always: Chosen = tuple((common.offset(signal, k), np.zeros(1)) for k in range(signal.columns))
    candidates = catalogue(signal)
    if not signal.shares_epoch:
        always = ((common.delay(0.0, common.delay_step_s(signal)), np.zeros(1)), *always)
        candidates = [effect for effect in candidates if effect.name not in DELAYS]
    columns = range(signal.columns)
    later = [[e for k in columns for e in common.driven(signal, k)], [e for k in columns for e in common.unknown(signal, k)]]
    log = _whitened(signal, np.stack([_rich_residual(signal, k) for k in columns], axis=1), lsb)
    selection = select_effects([log], candidates, later, always=always)
    rewhitened = _whitened(signal, signal.real - expected(signal, selection.whole.chosen), lsb)
    if (noise_std(rewhitened.whiten) < settings.signal.better_noise * noise_std(log.whiten)).any():
        log = rewhitened  # the effects' own high frequencies were taken for noise
        selection = select_effects([log], candidates, later, always=always)
    return _summarized(log, candidates, selection, lsb, settings)


def catalogue(signal: AlignedSignal) -> list[Effect]:
    """Effects that a signal can have by name."""
    scale = signal.scale()
    any_signal = common.named(signal) if signal.columns == 1 else ()
    return [*any_signal, *(effect for effects in CATALOGUE.get(signal.kind, ()) for effect in effects(scale))]


# ── noise ──


def _whitened(pair: AlignedSignal, residual: Float64[np.ndarray, "n k"], lsb: Sequence[float]) -> WhitenedLog:
    """The signal with its noise model.

    Where the simulated signal has its power, the noise density is taken from just above, so that an effect that nobody has
    modelled is not taken for noise; the simulation's own noise, which is in its band, comes on top. An error of rounding is no
    white noise where the signal is slow: the density is no less than that.
    """
    settings, band = pair.settings, None
    if pair.band_hz is not None:
        band = Band.below(pair.band_hz, 1.0 / pair.period_s, settings.noise)
    every = 1 if band is None else band.every
    usable, rate_hz, filters, stds = pair.usable[::every, 0], 1.0 / (pair.period_s * every), [], []
    slow, expected_slow = (values if band is None else band(values) for values in (residual, pair.sampled.x))
    top_hz = settings.signal.noise_band_end * rate_hz if pair.band_hz is None else 0.9 * pair.band_hz
    for k in range(pair.columns):
        edge = _edge_hz(expected_slow[:, k], rate_hz, settings)
        f_hz, power = _density(slow[:, k], usable, rate_hz, settings.noise, "median" if band is None else "mean")
        near = (f_hz >= edge) & (f_hz <= min(2.0 * edge, top_hz))
        far = (f_hz >= edge) & (f_hz <= top_hz)
        level = float(np.median(power[near]))
        if band is None:  # the error of a motion grows with frequency
            level = max(level, float(np.median(power[far])))
        power[f_hz < edge] = level + pair.sim_density[k]
        if lsb[k]:
            model = (pair.real - residual)[:, k]
            rounding = np.rint(model / lsb[k]) * lsb[k] - model
            power = np.maximum(power, _density(rounding[::every], usable, rate_hz, settings.noise)[1])
        filter_, std = autoregression(power, rate_hz, settings.noise.order)
        filters.append(filter_)
        stds.append(std)
    return WhitenedLog(pair, Whitener(np.stack(filters), np.array(stds), band))


def _edge_hz(x: Column, rate_hz: float, settings: DiagnoseSettings) -> float:
    """Frequency where a signal's power ends, within what a noise can be measured above."""
    own = settings.signal
    f_hz, power = welch(x, rate_hz, nperseg=min(settings.noise.segment_samples, len(x)))
    share = np.cumsum(power) / max(float(power.sum()), 1e-300)
    edge_hz = own.edge_factor * f_hz[np.searchsorted(share, own.power_share)]
    return float(np.clip(edge_hz, own.least_edge * rate_hz, own.most_edge * rate_hz))


def _density(
    x: Float64[np.ndarray, " n"],
    usable: Bool[np.ndarray, " n"],
    rate_hz: float,
    settings: NoiseSettings,
    average: Literal["median", "mean"] = "median",
) -> tuple[Column, Column]:
    """Frequencies, and the one-sided density of the usable part of a signal, without lines.

    The mean counts what comes off and on, as a joint turns round, for noise.
    """
    f_hz, power = welch(np.where(usable, x, 0.0), rate_hz, nperseg=min(settings.segment_samples, len(x)), average=average)
    return f_hz, np.asarray(median_filter(power, settings.line_bins, mode="nearest")) / max(float(usable.mean()), 1e-3)


def _rich_residual(pair: AlignedSignal, column: int) -> Float64[np.ndarray, " n"]:
    """Residual of a smooth function of signals, derivatives, state and time: noise, or what is sharp."""
    ideal, k = pair.ideal, np.arange(len(pair.ideal.fine))
    at = (pair.stamp_s - pair.lag_s - ideal.start_s) * ideal.rate_hz
    derivatives = [ideal.fine]
    for _ in range(3):
        derivatives.append(np.gradient(derivatives[-1], axis=0) * ideal.rate_hz)
    columns = [np.interp(at, k, values) for each in derivatives for values in each.T]
    x, dx = columns[column], columns[column + pair.columns]
    states = [np.interp(at, k, values) for values in ideal.state.values()]
    columns += [np.sign(x), np.sign(dx), *states, *(np.sign(values) for values in states)]
    for values in (x, dx, pair.stamp_s, *states):
        if np.ptp(values) > 0:
            columns += [*SplineBasis(np.linspace(values.min(), values.max(), RICH_KNOTS - 2)).basis(values).T]
    return np.asarray(pair.real[:, column] - ridge_fit(np.stack(columns, axis=1), pair.real[:, column], pair.usable[:, 0]))


def _lsb(pair: SignalPair, settings: DiagnoseSettings) -> list[float]:
    """Quantization step of recorded values, by column.

    0 where they lie on no grid, or the simulation's lie on the same.
    """
    steps = []
    for real, sim in zip(pair.real.T, pair.sim.T, strict=True):
        step, simulated = (grid(values, settings.timestamps) for values in (real, sim))
        steps.append(0.0 if simulated and abs(step / simulated - 1.0) < settings.signal.same_grid else step)
    return steps


# ── report ──


def _summarized(
    log: WhitenedLog, candidates: Sequence[Effect], selection: Selection, lsb: Sequence[float], settings: DiagnoseSettings
) -> SignalDiagnosis:
    pair: AlignedSignal = log.pair  # type: ignore[assignment]  # it was made of one
    level, logs, names = noise_floor([log]), [log], pair.names
    before, after = with_effects(pair, ()), with_effects(pair, selection.whole.chosen)
    findings = [finding_of(logs, selection, selected, level) for selected in selection.selected]
    p_values = {name: min((f.p_value for f in findings if f.signal in (name, pair.name)), default=1.0) for name in names}
    located = locate_findings([pair], [before], [after], level, (), p_values, settings.localization) if findings else []
    floor = level.copy()
    for k in range(pair.columns):
        if lsb[k] > settings.timestamps.least_digits * float(level[k]):
            finding, rounded = _quantization(log, after, k, lsb[k])
            after = rounded if finding.held_out.rms_after < finding.held_out.rms_before else after
            findings.append(finding)
            floor[k] = np.hypot(level[k], lsb[k] / np.sqrt(12.0))
    offsets = dict(_offsets(pair, selection))
    findings += _constants(pair, offsets, level)
    unexplained = unexplained_residuals(logs, [after], floor, settings.held_out)
    hidden = () if pair.shares_epoch else tuple(f"{name}.delay" for name in names)
    unseen = [] if pair.columns == 1 else _unseen(log, candidates, selection, settings)
    return SignalDiagnosis(
        located=tuple(located),
        findings=tuple(findings),
        offset=offsets,
        not_identifiable=(*hidden, *unseen),
        unexplained={
            name: msgspec.structs.replace(unexplained[name], noise_floor=float(level[k])) for k, name in enumerate(names)
        },
        closer={name: held_out_rms(logs, [before], [after], name) for name in names},
        remarks=() if pair.shares_epoch else (NO_EPOCH.format(pair.name, pair.aligned_s),),
        traces={
            name: SignalTraces(pair.stamp_s, pair.real[:, k], before[:, k], after[:, k], pair.held_out, pair.units[k])
            for k, name in enumerate(names)
        },
    )


def _unseen(log: WhitenedLog, candidates: Sequence[Effect], selection: Selection, settings: DiagnoseSettings) -> Iterator[str]:
    """Parameters that the motion cannot show, with their column."""
    for selected in selection.selected:
        yield from (f"{name}" for name in selected.unidentified)
    found = {selected.effect.key for selected in selection.selected}
    for effect in candidates:
        if effect.key not in found:
            columns = f" of {', '.join(effect.sensors)}" if 0 < len(effect.sensors) < log.pair.columns else ""
            yield from (f"{name}{columns}" for name in unobservable([log], [effect], settings.search))


def _offsets(pair: AlignedSignal, selection: Selection) -> Iterator[tuple[str, Estimate]]:
    stds = selection.whole.stds()
    for effect, theta in selection.whole.chosen:
        if effect.name == "offset":
            k = pair.names.index(effect.sensors[0]) if effect.sensors else 0
            yield pair.names[k], Estimate(float(theta[0]), float(stds[effect.key][0]), pair.units[k])


def _constants(pair: AlignedSignal, offsets: Mapping[str, Estimate], level: Float64[np.ndarray, " k"]) -> Iterator[Finding]:
    """Finding of a constant where it is physics: hard iron, an encoder's zero, a range's offset."""
    name, equation = CONSTANTS.get(pair.kind, ("", ""))
    values, stds = (np.array([getattr(estimate, part) for estimate in offsets.values()]) for part in ("value", "std"))
    if not name or not (np.abs(values) > CERTAIN * stds).any():
        return
    labels = [column.rpartition(".")[2] for column in pair.names] if pair.columns > 1 else [name.rpartition("_")[2]]
    parameters = dict(zip(labels, offsets.values(), strict=True))
    noise, size = float(np.sqrt((level**2).sum())), float(np.linalg.norm(values))
    gain = HeldOut(float(np.hypot(size, noise)), noise, pair.units[0], 0.0)
    yield Finding(name, pair.name, 1.0, 0.0, 0.0, parameters, equation, gain)


def _quantization(
    log: WhitenedLog, after: Float64[np.ndarray, "n k"], k: int, lsb: float
) -> tuple[Finding, Float64[np.ndarray, "n k"]]:
    """Finding of the digits, which no noise makes by chance, and the rounded expectation."""
    name, real = list(log.pair.signals)[k], log.pair.real[:, k]
    phase = float(np.median(np.mod(real + 0.5 * lsb, lsb))) - 0.5 * lsb
    rounded = after.copy()
    rounded[:, k] = np.rint((after[:, k] - phase) / lsb) * lsb + phase
    gain = held_out_rms([log], [after], [rounded], name)
    share = float(np.clip(1.0 - (gain.rms_after / max(gain.rms_before, 1e-300)) ** 2, 0.0, 1.0))
    parameters = {"lsb": Estimate(lsb, EXACT * lsb, log.pair.unit_of(name))}
    return Finding("quantization", name, share, 0.0, 0.0, parameters, "y = lsb round(x / lsb)", gain), rounded
