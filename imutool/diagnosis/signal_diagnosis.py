"""Diagnosis of one scalar signal of a log: aligned, whitened, searched, reported."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import msgspec
import numpy as np
from jaxtyping import Bool, Float64
from scipy.ndimage import median_filter
from scipy.signal import welch

from imutool.diagnosis import signal_effects as effects
from imutool.diagnosis.estimation.candidate_score import Selection
from imutool.diagnosis.estimation.jacobians import Chosen, expected
from imutool.diagnosis.estimation.model_selection import select_effects
from imutool.diagnosis.estimation.noise_estimate import noise_std, ridge_fit
from imutool.diagnosis.estimation.timestamps import grid
from imutool.diagnosis.estimation.unnamed_effects import SplineBasis
from imutool.diagnosis.estimation.whitening import WhitenedLog, Whitener, autoregression
from imutool.diagnosis.held_out import held_out_rms, noise_floor, unexplained_residuals, with_effects
from imutool.diagnosis.localization import locate_findings
from imutool.diagnosis.result import Estimate, Finding, HeldOut, Located, SignalTraces, Unexplained
from imutool.diagnosis.settings import DiagnoseSettings, NoiseSettings
from imutool.diagnosis.signal_alignment import AlignedSignal, Column, Samples, aligned
from imutool.diagnosis.summarize import finding_of
from imutool.mcap_io.fields import Fields

EXACT = 1e-3
RICH_KNOTS = 12
NO_EPOCH = "{}: the two clocks share no epoch; aligned by the signal ({:+.3f} s), so that a delay between them cannot be seen"


@dataclass(frozen=True, eq=False)
class SignalDiagnosis:
    """Diagnosis of one signal, in parts that a `Diagnosis` takes; findings come strongest first."""

    signal: str
    unit: str
    located: tuple[Located, ...]
    findings: tuple[Finding, ...]
    offset: Estimate
    not_identifiable: tuple[str, ...]
    unexplained: Unexplained
    closer: HeldOut
    remarks: tuple[str, ...]
    traces: SignalTraces


def diagnose_signal(
    real: Fields, sim: Fields, others: Mapping[str, Fields], name: str, settings: DiagnoseSettings | None = None
) -> SignalDiagnosis:
    """Diagnose the misfit of a recorded signal to its simulation, but for constant and noise.

    `others` are further numbers of the recording, on its clock, which may drive the misfit; `name` is TOPIC.field, as findings
    have it.

    Raises:
        DataError: constant, too short, or not of one motion; the message says what to do.
    """
    settings = settings or DiagnoseSettings()
    pair = aligned(real, sim, others, name, settings)
    lsb = _lsb(real, sim, settings)
    always: Chosen = ((effects.offset(float(np.ptp(pair.real)), pair.unit), np.zeros(1)),)
    if not pair.shares_epoch:
        always = ((effects.delay(0.0, effects.delay_step_s(pair)), np.zeros(1)), *always)
    candidates = [effect for effect in effects.named(pair) if effect.name != "delay" or pair.shares_epoch]
    later = [list(effects.driven(pair)), list(effects.unknown(pair))]
    log = _whitened(pair, _rich_residual(pair), lsb)
    selection = select_effects([log], candidates, later, always=always)
    rewhitened = _whitened(pair, (pair.real - expected(pair, selection.whole.chosen))[:, 0], lsb)
    if _level(rewhitened) < settings.signal.better_noise * _level(
        log
    ):  # the effects' own high frequencies were taken for noise
        log = rewhitened
        selection = select_effects([log], candidates, later, always=always)
    return _summarized(pair, log, selection, lsb, settings)


# ── noise ──


def _whitened(pair: AlignedSignal, residual: Samples, lsb: float) -> WhitenedLog:
    """The signal with its noise model.

    Where the simulated signal has its power, the noise density is taken from just above, so that an effect that nobody has
    modelled is not taken for noise; the simulation's own noise, which is in its band, comes on top. An error of rounding is no
    white noise where the signal is slow: the density is no less than that.
    """
    usable, rate_hz, settings = pair.usable[:, 0], 1.0 / pair.period_s, pair.settings
    edge, top_hz = _edge_hz(pair.sampled.x, rate_hz, settings), settings.signal.noise_band_end * rate_hz
    f_hz, power = _density(residual, usable, rate_hz, settings.noise)
    near = (f_hz >= edge) & (f_hz <= min(2.0 * edge, top_hz))
    far = (f_hz >= edge) & (f_hz <= top_hz)
    power[f_hz < edge] = max(float(np.median(power[near])), float(np.median(power[far]))) + pair.sim_density
    if lsb:
        model = pair.real[:, 0] - residual
        power = np.maximum(power, _density(np.rint(model / lsb) * lsb - model, usable, rate_hz, settings.noise)[1])
    filter_, std = autoregression(power, rate_hz, settings.noise.order)
    return WhitenedLog(pair, Whitener(filter_[None], np.array([std])))


def _edge_hz(x: Samples, rate_hz: float, settings: DiagnoseSettings) -> float:
    """Frequency where a signal's power ends, within what a noise can be measured above."""
    own = settings.signal
    f_hz, power = welch(x, rate_hz, nperseg=min(settings.noise.segment_samples, len(x)))
    share = np.cumsum(power) / max(float(power.sum()), 1e-300)
    edge_hz = own.edge_factor * f_hz[np.searchsorted(share, own.power_share)]
    return float(np.clip(edge_hz, own.least_edge * rate_hz, own.most_edge * rate_hz))


def _density(x: Samples, usable: Bool[np.ndarray, " n"], rate_hz: float, settings: NoiseSettings) -> tuple[Column, Column]:
    """Frequencies, and the one-sided density of the usable part of a signal, without lines."""
    f_hz, power = welch(np.where(usable, x, 0.0), rate_hz, nperseg=min(settings.segment_samples, len(x)), average="median")
    return f_hz, np.asarray(median_filter(power, settings.line_bins, mode="nearest")) / max(float(usable.mean()), 1e-3)


def _level(log: WhitenedLog) -> float:
    """Standard deviation of the noise of a sample."""
    return float(noise_std(log.whiten)[0])


def _rich_residual(pair: AlignedSignal) -> Samples:
    """Residual of a smooth function of signal, derivatives and time: noise, or what is sharp."""
    ideal, k = pair.ideal, np.arange(len(pair.ideal.fine))
    at = (pair.stamp_s - pair.lag_s - ideal.start_s) * ideal.rate_hz
    derivatives = [ideal.fine]
    for _ in range(3):
        derivatives.append(np.gradient(derivatives[-1]) * ideal.rate_hz)
    columns = [np.interp(at, k, column) for column in derivatives]
    x, dx = columns[0], columns[1]
    columns += [np.sign(x), np.sign(dx)]
    for values in (x, dx, pair.stamp_s):
        columns += [*SplineBasis(np.linspace(values.min(), values.max(), RICH_KNOTS - 2)).basis(values).T]
    return np.asarray(pair.real[:, 0] - ridge_fit(np.stack(columns, axis=1), pair.real[:, 0], pair.usable[:, 0]))


def _lsb(real: Fields, sim: Fields, settings: DiagnoseSettings) -> float:
    """Quantization step of recorded values.

    0 where they lie on no grid, or the simulation's lie on the same.
    """
    step, simulated = (grid(fields.values, settings.timestamps) for fields in (real, sim))
    return 0.0 if simulated and abs(step / simulated - 1.0) < settings.signal.same_grid else step


# ── report ──


def _summarized(
    pair: AlignedSignal, log: WhitenedLog, selection: Selection, lsb: float, settings: DiagnoseSettings
) -> SignalDiagnosis:
    level, name, unit, logs = noise_floor([log]), pair.name, pair.unit, [log]
    before, after = with_effects(pair, ()), with_effects(pair, selection.whole.chosen)
    findings = [finding_of(logs, selection, selected, level) for selected in selection.selected]
    p_values = {name: min((finding.p_value for finding in findings), default=1.0)}
    located = locate_findings([pair], [before], [after], level, (), p_values, settings.localization) if findings else []
    floor = level
    if lsb > settings.timestamps.least_digits * float(level[0]):
        finding, rounded = _quantization(log, after, lsb)
        after = rounded if finding.held_out.rms_after < finding.held_out.rms_before else after
        findings, floor = [*findings, finding], np.hypot(level, lsb / np.sqrt(12.0))
    (offset,) = (theta for effect, theta in selection.whole.chosen if effect.key == "offset")
    unexplained = unexplained_residuals(logs, [after], floor, settings.held_out)[name]
    return SignalDiagnosis(
        signal=name,
        unit=unit,
        located=tuple(located),
        findings=tuple(findings),
        offset=Estimate(float(offset[0]), float(selection.whole.stds()["offset"][0]), unit),
        not_identifiable=() if pair.shares_epoch else (f"{name}.delay",),
        unexplained=msgspec.structs.replace(unexplained, noise_floor=float(level[0])),
        closer=held_out_rms(logs, [before], [after], name),
        remarks=() if pair.shares_epoch else (NO_EPOCH.format(name, pair.aligned_s),),
        traces=SignalTraces(pair.stamp_s, pair.real[:, 0], before[:, 0], after[:, 0], pair.held_out, unit),
    )


def _quantization(
    log: WhitenedLog, after: Float64[np.ndarray, "n 1"], lsb: float
) -> tuple[Finding, Float64[np.ndarray, "n 1"]]:
    """Finding of the digits, which no noise makes by chance, and the rounded expectation."""
    name, real = log.pair.name, log.pair.real
    phase = float(np.median(np.mod(real + 0.5 * lsb, lsb))) - 0.5 * lsb
    rounded = np.rint((after - phase) / lsb) * lsb + phase
    gain = held_out_rms([log], [after], [rounded], name)
    share = float(np.clip(1.0 - (gain.rms_after / max(gain.rms_before, 1e-300)) ** 2, 0.0, 1.0))
    parameters = {"lsb": Estimate(lsb, EXACT * lsb, log.pair.unit_of(name))}
    return Finding("quantization", name, share, 0.0, 0.0, parameters, "y = lsb round(x / lsb)", gain), rounded
