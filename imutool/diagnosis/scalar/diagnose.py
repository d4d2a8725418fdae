"""Diagnosis of one scalar signal of a log: aligned, whitened, searched, reported."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool
from scipy.ndimage import median_filter
from scipy.signal import welch

from imutool.diagnosis.estimation.jacobians import Chosen, expected
from imutool.diagnosis.estimation.model_selection import SelectedEffect, Selection, select_effects
from imutool.diagnosis.estimation.noise_estimate import ORDER, noise_std, ridge_fit
from imutool.diagnosis.estimation.timestamps import LEAST_DIGITS, grid
from imutool.diagnosis.estimation.unnamed_effects import SplineCurve
from imutool.diagnosis.estimation.whitening import LINES, SEGMENT, WhitenedLog, Whitener, autoregression
from imutool.diagnosis.localization import intervals, regime
from imutool.diagnosis.result import Curve, Estimate, Finding, HeldOut, Located, SignalTraces, Unexplained
from imutool.diagnosis.scalar import effects
from imutool.diagnosis.scalar.alignment import TOP, aligned
from imutool.diagnosis.scalar.effects import SignalCurve
from imutool.diagnosis.scalar.signal import AlignedSignal, Column, Samples
from imutool.diagnosis.settings import DiagnoseSettings, LocalizationSettings
from imutool.mcap_io.fields import Fields

BETTER_NOISE = 0.95  # of what the noise was first taken for, below which effects are searched once more
IN_BAND, ABOVE = 0.999, 1.3  # of the signal's power lie below its edge, and noise is measured from a little above that
LOWEST, HIGHEST = 0.05, 0.3  # of the sample rate: least and most for the edge
SHOWN_KNOTS = 41
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
    return _summarized(pair, log, selection, len(always), lsb, settings)


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
        columns += [*SplineCurve("", np.linspace(values.min(), values.max(), RICH_KNOTS - 2)).basis(values).T]
    return np.asarray(pair.real[:, 0] - ridge_fit(np.stack(columns, axis=1), pair.real[:, 0], pair.usable[:, 0]))


def _lsb(real: Fields, sim: Fields) -> float:
    """Quantization step of recorded values.

    0 where they lie on no grid, or the simulation's lie on the same.
    """
    step, simulated = grid(real.values), grid(sim.values)
    return 0.0 if simulated and abs(step / simulated - 1.0) < SAME_GRID else step


# ── report ──


def _summarized(
    pair: AlignedSignal, log: WhitenedLog, selection: Selection, always: int, lsb: float, settings: DiagnoseSettings
) -> SignalDiagnosis:
    level, name, unit = _level(log), pair.name, pair.unit
    real, chosen, held_out = pair.real[:, 0], selection.whole.chosen, pair.held_out
    before, after = _column(pair, ()), _column(pair, chosen)
    before = before + (real - before)[pair.usable[:, 0]].mean()
    findings = [_finding(pair, selection, selected, always, level) for selected in selection.selected]
    rounded = lsb > LEAST_DIGITS * level
    if rounded:
        phase = float(np.median(np.mod(real + 0.5 * lsb, lsb))) - 0.5 * lsb
        digits = np.rint((after - phase) / lsb) * lsb + phase
        held_out_gain = _held_out(pair, after, digits)
        share = float(np.clip(1.0 - (held_out_gain.rms_after / max(held_out_gain.rms_before, 1e-300)) ** 2, 0.0, 1.0))
        parameters = {"lsb": Estimate(lsb, EXACT * lsb, unit)}  # no noise puts every value on a grid by chance
        findings.append(Finding("quantization", name, share, 0.0, 0.0, parameters, "y = lsb round(x / lsb)", held_out_gain))
        after = digits if held_out_gain.rms_after < held_out_gain.rms_before else after
    p_value = min((selected.p_value for selected in selection.selected), default=1.0)
    offset = selection.whole.stds()["offset"]
    rms = float(np.sqrt(np.mean((real - after)[held_out] ** 2)))
    floor = float(np.hypot(level, lsb / np.sqrt(12.0))) if rounded else level
    return SignalDiagnosis(
        signal=name,
        unit=unit,
        located=_located(pair, after - before, level, p_value, settings.localization) if selection.selected else (),
        findings=tuple(findings),
        offset=Estimate(float({e.key: theta for e, theta in chosen}["offset"][0]), float(offset[0]), unit),
        not_identifiable=() if pair.shares_epoch else (f"{name}.delay",),
        unexplained=Unexplained(rms, level, rms < settings.held_out.white_ratio * floor),
        closer=_held_out(pair, before, after),
        remarks=() if pair.shares_epoch else (NO_EPOCH.format(name, pair.aligned_s),),
        traces=SignalTraces(pair.stamp_s, real, before, after, held_out, unit),
    )


def _column(pair: AlignedSignal, chosen: Chosen) -> Samples:
    return np.asarray(expected(pair, chosen)[:, 0])


def _held_out(pair: AlignedSignal, before: Samples, after: Samples) -> HeldOut:
    rms = [float(np.sqrt(np.mean((pair.real[:, 0] - model)[pair.held_out] ** 2))) for model in (before, after)]
    return HeldOut(rms[0], rms[1], pair.unit, round(float(pair.held_out.sum()) * pair.period_s, 1))


def _finding(pair: AlignedSignal, selection: Selection, selected: SelectedEffect, always: int, level: float) -> Finding:
    """A finding, with what leaving it out costs on time that its parameters were not fitted to."""
    effect, chosen = selected.effect, selection.fitted.chosen
    without = tuple(pair for pair in chosen if pair[0].key != effect.key)
    complete, left_out, no_effects = (_column(pair, these) for these in (chosen, without, chosen[:always]))
    left_out, no_effects = (model + (pair.real[:, 0] - model)[pair.fitted].mean() for model in (left_out, no_effects))
    held_out, held_out_of_all = _held_out(pair, left_out, complete), _held_out(pair, no_effects, complete)
    misfit = max(held_out_of_all.rms_before**2 - level**2, 1e-300)
    numbers = zip(effect.parameters, selected.theta, selected.std, strict=True)
    curve = isinstance(effect.forward, SignalCurve)
    return Finding(
        effect=effect.name,
        signal=pair.name,
        share=float(np.clip((held_out.rms_before**2 - held_out.rms_after**2) / misfit, 0.0, 1.0)),
        p_value=selected.p_value,
        false_discovery_rate=selected.false_discovery_rate,
        parameters={} if curve else {n.name: Estimate(float(value), float(std), n.unit) for n, value, std in numbers},
        equation=effect.equation,
        held_out=held_out,
        driver=effect.variable if effect.kind == "driven" else "",
        similar=selected.similar,
        curve=_curve(selection, selected),
        kind=effect.kind,
        variable=effect.variable,
    )


def _curve(selection: Selection, selected: SelectedEffect) -> Curve | None:
    """A curve by its values, with their standard deviations; its mean belongs to the offset."""
    forward = selected.effect.forward
    if not isinstance(forward, SignalCurve):
        return None
    x = forward.points(SHOWN_KNOTS)
    basis = forward.basis(x)
    centred = basis - basis.mean(axis=0)
    place = selection.whole.place(selected.effect.key)
    band = np.sqrt(np.einsum("nq,qp,np->n", centred, selection.whole.covariance[place, place], centred))
    return Curve.of_arrays(forward.variable, forward.unit, x, (centred @ selected.theta)[:, None], band[:, None])


def _located(
    pair: AlignedSignal, misfit: Samples, level: float, p_value: float, settings: LocalizationSettings
) -> tuple[Located, ...]:
    """Location of the findings' misfit: seconds that stand out of the noise, and regime."""
    t_s, sampled = pair.stamp_s, pair.sampled
    window = np.floor((t_s - t_s[0]) / settings.window_s).astype(int)
    power = np.bincount(window, weights=((misfit - np.median(misfit)) / level) ** 2)
    inside = power > settings.clear_squares
    if not inside.any():
        return ()
    variables: dict[str, tuple[str, Column]] = {
        "its value": (pair.unit, sampled.x),
        "its size": (pair.unit, np.abs(sampled.x - np.median(sampled.x))),
        "its rate of change": (f"{pair.unit}/s", np.abs(sampled.dx)),
        "time": ("s", t_s),
    }
    variables |= {other: ("", np.interp(t_s, at, values)) for other, (at, values) in pair.ideal.channels.items()}
    spans = intervals(float(t_s[0]) + settings.window_s * np.flatnonzero(inside), settings)
    where = regime(inside, power, window, variables, settings)
    return (Located(pair.name, (), tuple(spans), where, float(power[inside].sum() / power.sum()), p_value),)
