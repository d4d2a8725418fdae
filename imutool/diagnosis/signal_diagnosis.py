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
from imutool.diagnosis.estimation.jacobians import Chosen, expected
from imutool.diagnosis.estimation.model_selection import Selection, select_effects
from imutool.diagnosis.estimation.noise_estimate import ORDER, noise_std, ridge_fit
from imutool.diagnosis.estimation.timestamps import LEAST_DIGITS, grid
from imutool.diagnosis.estimation.unnamed_effects import SplineBasis
from imutool.diagnosis.estimation.whitening import LINES, SEGMENT, WhitenedLog, Whitener, autoregression
from imutool.diagnosis.held_out import held_out_rms, noise_floor, unexplained_residuals, with_effects
from imutool.diagnosis.localization import locate_findings
from imutool.diagnosis.result import Estimate, Finding, HeldOut, Located, SignalTraces, Unexplained
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.diagnosis.signal_alignment import TOP, AlignedSignal, Column, Samples, aligned
from imutool.diagnosis.summarize import finding_of
from imutool.mcap_io.fields import Fields

BETTER_NOISE = 0.95  # of what the noise was first taken for, below which effects are searched once more
IN_BAND, ABOVE = 0.999, 1.3  # of the signal's power lie below its edge, and noise is measured from a little above that
LOWEST, HIGHEST = 0.05, 0.3  # of the sample rate: least and most for the edge
EXACT = 1e-3
SAME_GRID = 0.01
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
    pair = aligned(real, sim, others, name)
    lsb = _lsb(real, sim)
    always: Chosen = ((effects.offset(float(np.ptp(pair.real)), pair.unit), np.zeros(1)),)
    if not pair.shares_epoch:
        always = ((effects.delay(0.0, effects.delay_step_s(pair)), np.zeros(1)), *always)
    candidates = [effect for effect in effects.named(pair) if effect.name != "delay" or pair.shares_epoch]
    later = [list(effects.driven(pair)), list(effects.unknown(pair))]
    log = _whitened(pair, _rich_residual(pair), lsb)
    selection = select_effects([log], candidates, later, always=always, settings=settings.search)
    rewhitened = _whitened(pair, (pair.real - expected(pair, selection.whole.chosen))[:, 0], lsb)
    if _level(rewhitened) < BETTER_NOISE * _level(log):  # the effects' own high frequencies were taken for noise
        log = rewhitened
        selection = select_effects([log], candidates, later, always=always, settings=settings.search)
    return _summarized(pair, log, selection, lsb, settings)


# ── noise ──


def _whitened(pair: AlignedSignal, residual: Samples, lsb: float) -> WhitenedLog:
    """The signal with its noise model.

    Where the simulated signal has its power, the noise density is taken from just above, so that an effect that nobody has
    modelled is not taken for noise; the simulation's own noise, which is in its band, comes on top. An error of rounding is no
    white noise where the signal is slow: the density is no less than that.
    """
    usable, rate_hz = pair.usable[:, 0], 1.0 / pair.period_s
    edge = _edge_hz(pair.sampled.x, rate_hz)
    f_hz, power = _density(residual, usable, rate_hz)
    near = (f_hz >= edge) & (f_hz <= min(2.0 * edge, TOP * rate_hz))
    far = (f_hz >= edge) & (f_hz <= TOP * rate_hz)
    power[f_hz < edge] = max(float(np.median(power[near])), float(np.median(power[far]))) + pair.sim_density
    if lsb:
        model = pair.real[:, 0] - residual
        power = np.maximum(power, _density(np.rint(model / lsb) * lsb - model, usable, rate_hz)[1])
    filter_, std = autoregression(power, rate_hz, ORDER)
    return WhitenedLog(pair, Whitener(filter_[None], np.array([std])))


def _edge_hz(x: Samples, rate_hz: float) -> float:
    """Frequency where a signal's power ends, within what a noise can be measured above."""
    f_hz, power = welch(x, rate_hz, nperseg=min(SEGMENT, len(x)))
    share = np.cumsum(power) / max(float(power.sum()), 1e-300)
    return float(np.clip(ABOVE * f_hz[np.searchsorted(share, IN_BAND)], LOWEST * rate_hz, HIGHEST * rate_hz))


def _density(x: Samples, usable: Bool[np.ndarray, " n"], rate_hz: float) -> tuple[Column, Column]:
    """Frequencies, and the one-sided density of the usable part of a signal, without lines."""
    f_hz, power = welch(np.where(usable, x, 0.0), rate_hz, nperseg=min(SEGMENT, len(x)), average="median")
    return f_hz, np.asarray(median_filter(power, LINES, mode="nearest")) / max(float(usable.mean()), 1e-3)


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


def _lsb(real: Fields, sim: Fields) -> float:
    """Quantization step of recorded values.

    0 where they lie on no grid, or the simulation's lie on the same.
    """
    step, simulated = grid(real.values), grid(sim.values)
    return 0.0 if simulated and abs(step / simulated - 1.0) < SAME_GRID else step


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
    if lsb > LEAST_DIGITS * float(level[0]):
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
