"""Noise of a signal: whitening filters, the step of its values, errors of what is ideal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Literal

import msgspec
import numpy as np
from scipy.ndimage import median_filter
from scipy.signal import welch

from imutool.array_types import Bool, Float64
from imutool.diagnosis.estimation.gauss_newton import Fit
from imutool.diagnosis.estimation.jacobians import SplineBasis
from imutool.diagnosis.estimation.noise_estimate import ridge_fit
from imutool.diagnosis.estimation.timestamps import grid
from imutool.diagnosis.estimation.trial.selection import SelectedEffect, Selection
from imutool.diagnosis.estimation.whitening import Band, WhitenedLog, Whitener, autoregression
from imutool.diagnosis.held_out import held_out_rms, with_effects
from imutool.diagnosis.result import Finding
from imutool.diagnosis.settings import DiagnoseSettings, NoiseSettings
from imutool.diagnosis.signals.aligned_signal import AlignedSignal, Column
from imutool.diagnosis.signals.ideal_signal import SignalPair
from imutool.sensor.effect import Effect

RICH_KNOTS, RICH_SAMPLES = 12, 6  # of a curve; for each number of a fit
INTERPOLATION_ERROR = 1e-5  # of a signal's size, between the stamps of two logs; the digits of a sensor are coarser
LEARNT_ERROR = 0.003  # of the efforts themselves
SMALL_GAIN = 3e-3  # of the largest effect's squares, which such an error may take (5 % of its size)


def whitened(pair: AlignedSignal, residual: Float64[np.ndarray, "n k"], lsb: Sequence[float]) -> WhitenedLog:
    """The signal with its noise model.

    Where the simulated signal has its power, the noise density is taken from just above, so that an effect that nobody has
    modelled is not taken for noise; the simulation's own noise, which is in its band, comes on top. An error of rounding is no
    white noise where the signal is slow: the density is no less than that, nor than the error of interpolation.
    """
    settings, band = pair.settings, None
    if pair.band_hz is not None:
        band = Band.below(pair.band_hz, 1.0 / pair.period_s, settings.noise)
    every = 1 if band is None else band.every
    usable, rate_hz, filters, stds = pair.usable[::every, 0], 1.0 / (pair.period_s * every), [], []
    slow, expected_slow = (values if band is None else band(values) for values in (residual, pair.sampled.x))
    top_hz = settings.signal.noise_band_end * rate_hz if pair.band_hz is None else 0.9 * pair.band_hz
    for k in range(pair.columns):
        edge = min(_edge_hz(expected_slow[:, k], rate_hz, settings), settings.signal.max_top * top_hz)
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
        power = np.maximum(power, 2.0 * (INTERPOLATION_ERROR * float(expected_slow[:, k].std())) ** 2 / rate_hz)
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
    return float(np.clip(edge_hz, own.min_edge * rate_hz, own.max_edge * rate_hz))


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
    f_hz, power = welch(np.where(usable, x, 0.0), rate_hz, nperseg=settings.segment_of(len(x)), average=average)
    return f_hz, np.asarray(median_filter(power, settings.line_bins, mode="nearest")) / max(float(usable.mean()), 1e-3)


def rich_residual(pair: AlignedSignal, column: int) -> Float64[np.ndarray, " n"]:
    """Residual of a smooth function of signal, state and time: noise, or what is sharp."""
    ideal, k = pair.ideal, np.arange(len(pair.ideal.fine))
    at = (pair.stamp_s - pair.lag_s - ideal.start_s) * ideal.rate_hz
    derivatives = [ideal.fine]
    for _ in range(3):
        derivatives.append(np.gradient(derivatives[-1], axis=0) * ideal.rate_hz)
    columns = [np.interp(at, k, values) for each in derivatives for values in each.T]
    x, dx = columns[column], columns[column + pair.columns]
    states = [np.interp(at, k, values) for values in ideal.state.values()]
    columns += [np.sign(x), np.sign(dx)]
    for values in (x, dx, pair.stamp_s, *states):
        if np.ptp(values) > 0:
            columns += [*SplineBasis(np.linspace(values.min(), values.max(), RICH_KNOTS - 2)).basis(values).T]
    columns += [*states, *(np.sign(values) for values in states)]
    usable = pair.usable[:, 0]
    columns = columns[: int(usable.sum()) // RICH_SAMPLES]  # of few samples a rich fit would leave nothing
    taken = len(columns) / max(int(usable.sum()), 1)  # of the noise, by the fit
    residual = pair.real[:, column] - ridge_fit(np.stack(columns, axis=1), pair.real[:, column], usable)
    return np.asarray(residual / np.sqrt(1.0 - taken))


def lsb_of(pair: SignalPair, settings: DiagnoseSettings) -> list[float]:
    """Quantization step of recorded values, by column; 0 without a grid of their own."""
    steps = []
    for real, sim in zip(pair.real.T, pair.sim.T, strict=True):
        step, simulated = (grid(values, settings.timestamps) for values in (real, sim))
        steps.append(0.0 if simulated and abs(step / simulated - 1.0) < settings.signal.same_grid else step)
    return steps


def above_model_error(log: WhitenedLog, selection: Selection) -> tuple[Selection, list[str]]:
    """Selection without effects as small as errors of dynamics or interpolation, and those."""
    pair: AlignedSignal = log.pair  # type: ignore[assignment]  # it was made of one
    if not selection.selected:
        return selection, []
    size, of = np.array(pair.scale.size), _changes if pair.band_hz is None else _sizes
    sizes = np.stack([of(log, selection, selected) for selected in selection.selected])
    of_size, of_largest = INTERPOLATION_ERROR, pair.settings.search.model_error
    if pair.band_hz is not None:
        of_size, of_largest = LEARNT_ERROR, SMALL_GAIN
    enough = np.maximum(of_size * size, np.sqrt(of_largest) * sizes.max(axis=0))
    kept, small = list[SelectedEffect](), list[SelectedEffect]()
    for selected, own in zip(selection.selected, sizes, strict=True):
        (kept if (own >= enough).any() else small).append(selected)
    names = [f"{selected.effect.name} of {', '.join(selected.effect.sensors or pair.names)}" for selected in small]
    return replace(selection, selected=tuple(kept)), names


def _changes(log: WhitenedLog, selection: Selection, selected: SelectedEffect) -> Float64[np.ndarray, " k"]:
    """Deviation of what an effect adds to each column."""
    without, complete = _models(log, selection, selected)
    return np.asarray((complete - without).std(axis=0))


def _sizes(log: WhitenedLog, selection: Selection, selected: SelectedEffect) -> Float64[np.ndarray, " k"]:
    """What an effect removes of each column, on held-out time."""
    without, complete = _models(log, selection, selected)
    gains = [held_out_rms([log], [without], [complete], name) for name in log.pair.signals]
    return np.array([np.sqrt(max(gain.rms_before**2 - gain.rms_after**2, 0.0)) for gain in gains])


def _models(log: WhitenedLog, selection: Selection, selected: SelectedEffect) -> Iterator[Float64[np.ndarray, "n k"]]:
    """Expected samples without an effect, and with it."""
    chosen = selection.fitted.chosen
    without = tuple(entry for entry in chosen if entry[0].key != selected.effect.key)
    return (with_effects(log.pair, these) for these in (without, chosen))


def learnt_errors(log: WhitenedLog, found: Fit) -> dict[str, Float64[np.ndarray, " _"]]:
    """Deviations of parameters, by effect, where the learnt dynamics are wrong by a share.

    Each joint has a share of its own, for what it carries at rest and for what moves it. A small difference from an arm's own
    efforts is less sure than that share.
    """
    pair: AlignedSignal = log.pair  # type: ignore[assignment]  # it was made of one
    assert pair.ideal.relation is not None
    state, rows, squares = pair.sampled.state, log.rows("all"), np.zeros(len(found.prior))
    at_rest = pair.ideal.relation({name: values * name.startswith("q") for name, values in state.items()})
    for k in range(pair.columns):
        where, A = found.jacobians.on_axis(0, k, rows)
        for part in (at_rest[:, k], pair.sampled.x[:, k] - at_rest[:, k]):
            white = log.whiten.rows([LEARNT_ERROR * part], np.array([k]))[0][rows]
            squares += (found.covariance[:, where] @ (A @ white)) ** 2
    out = dict[str, Float64[np.ndarray, " _"]]()
    for effect, theta in found.chosen:
        positive = np.array([parameter.positive for parameter in effect.parameters])  # fitted by their logarithm
        out[effect.key] = np.sqrt(squares[found.place(effect.key)]) * np.where(positive, theta, 1.0)
    return out


def with_learnt_error(finding: Finding, effect: Effect, errors: Mapping[str, Float64[np.ndarray, " _"]]) -> Finding:
    """Finding with no parameter surer than the dynamics that were learnt; a curve has none."""
    by_name = {parameter.name: error for parameter, error in zip(effect.parameters, errors[effect.key].tolist(), strict=True)}
    parameters = {
        name: msgspec.structs.replace(e, std=float(np.linalg.norm([e.std, by_name[name], LEARNT_ERROR * e.value])))
        for name, e in finding.parameters.items()
    }
    return msgspec.structs.replace(finding, parameters=parameters)
