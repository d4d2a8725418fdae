"""Noise model from the residuals of the full-catalogue fit, and the band of the poses.

Beside poses the noise is unknown: that of the poses, differentiated, has every colour, and that of the sensor lies under it.
It is estimated from what a rich model leaves: every effect of the catalogue, the nonlinear ones by their derivatives where a
fit of them would start. An effect left out here would be taken for noise, and never be seen again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.signal import csd, welch

from imutool.array_types import Bool, Float64
from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.jacobians import Chosen, ForwardPass, expected
from imutool.diagnosis.estimation.whitening import Band, WhitenedImu, Whitener, level, settled, whitener
from imutool.diagnosis.settings import BandSettings
from imutool.processes.forked import of_each
from imutool.sensor.effect import Effect

RIDGE = 1e-8
INDEPENDENT = 1e-3  # of the largest singular value, below which a column is a combination of others
EDGES_HZ = (0.5, 0.8, 1.25, 2.0, 3.0, 4.5, 6.5, 9.0, 13.0, 18.0, 25.0)  # of the bands in which the poses are checked


def whitened(pair: Pair, candidates: Sequence[Effect], settings: BandSettings) -> WhitenedImu:
    """Whitened log with its noise model; beside poses also with the band that they know."""
    if pair.exact:
        return _counting(pair, level(_left(pair, candidates), pair.usable, 1.0 / pair.period_s, pair.settings.noise))
    assert pair.band_hz is not None
    columns, misfit = _rich(pair, candidates), pair.real - expected(pair, ())
    whiten, residual = _in_band(pair, columns, misfit, pair.band_hz)
    assert whiten.band is not None
    rate_hz = 1.0 / (pair.period_s * whiten.every)
    band_hz = known_band_hz(whiten.band(pair.real), residual, rate_hz, pair.band_hz, settings)
    if band_hz < pair.band_hz:
        pair = replace(pair, band_hz=band_hz)
        whiten, _ = _in_band(pair, columns, misfit, band_hz)
    return _counting(pair, limited_to_quiet_axes(whiten, settings.noisy_axis))


def _counting(pair: Pair, white: Whitener) -> WhitenedImu:
    """The whitened log, without values that depend on unknown samples."""
    return WhitenedImu(pair, white if pair.known is None else white.counting(pair.known))


def _in_band(
    pair: Pair, wide: Sequence[Float64[np.ndarray, "_ _"]], wide_misfit: Float64[np.ndarray, "n 6"], band_hz: float
) -> tuple[Whitener, Float64[np.ndarray, "m 6"]]:
    """The noise of rows up to a frequency, and the residual of a rich model there."""
    band = Band.below(band_hz, 1.0 / pair.period_s, pair.settings.noise)
    columns, misfit = [band.rows(rows) for rows in wide], band(wide_misfit)
    usable = pair.usable[:: band.every]
    whiten = Whitener(np.ones((6, 1)), np.ones(6))
    for _ in range(pair.settings.noise.rounds):
        residual, fitted = misfit.copy(), np.zeros(6)
        for axis in np.flatnonzero(usable.any(axis=0)).tolist():
            rows = settled(usable[:, axis], whiten.order)
            both = np.concatenate([columns[axis], misfit[:, axis][None]])
            white = whiten.rows(both, np.full(len(both), axis))[:, rows]
            x, fitted[axis] = _solved(white[:-1], white[-1])
            residual[:, axis] -= x @ columns[axis]
        whiten = whitener(residual, usable, pair.settings.noise.order)
        count = np.maximum(usable.sum(axis=0), 1.0)  # the noise before so many parameters were fitted to it
        whiten = Whitener(whiten.filters, whiten.std * np.sqrt(count / np.maximum(count - fitted, 0.5 * count)))
    return Whitener(whiten.filters, whiten.std, band), residual


def limited_to_quiet_axes(whiten: Whitener, most: float) -> Whitener:
    """Whitener with no axis more than `most` times as noisy as the middle axis of its sensor.

    Poses err alike in all directions, and a sensor's axes are equally noisy; an axis with a much larger residual holds what
    the catalogue has no name for.
    """
    filters, std = whiten.filters.copy(), whiten.std.copy()
    total = noise_std(whiten)
    for part in (slice(0, 3), slice(3, 6)):
        middle = int(np.argsort(total[part])[1]) + part.start
        for axis in range(part.start, part.stop):
            if total[axis] > most * total[middle]:
                filters[axis], std[axis] = whiten.filters[middle], most * whiten.std[middle]
    return Whitener(filters, std, whiten.band)


def noise_std(whiten: Whitener) -> Float64[np.ndarray, " k"]:
    """Standard deviation of the noise of a row by axis, before whitening."""
    response = np.array([np.abs(np.fft.rfft(a, 512)) ** 2 for a in whiten.filters])
    return np.asarray(whiten.std * np.sqrt((1.0 / response).mean(axis=1)))


def _left(pair: Pair, candidates: Sequence[Effect]) -> Float64[np.ndarray, "n 6"]:
    """Residual of a simulation's misfit after a fit of every linear effect."""
    linear: Chosen = tuple((effect, effect.null_value.astype(float)) for effect in candidates if effect.linear)
    forward = ForwardPass(pair, linear)
    residual: Float64[np.ndarray, "n 6"] = pair.real - forward.expected
    columns: list[list[np.ndarray]] = [[np.ones(len(residual))] for _ in range(6)]
    for effect, _ in linear:
        for axis, _, row in forward.derivatives(effect):
            columns[axis].append(row)
    for axis, rows in enumerate(pair.usable.T):
        residual[:, axis] -= ridge_fit(np.stack(columns[axis], axis=1), residual[:, axis], rows)
    return residual


def ridge_fit(
    A: Float64[np.ndarray, "n q"], y: Float64[np.ndarray, " n"], rows: Bool[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """Ridge fit of y by columns on some rows, evaluated on all rows."""
    size = np.linalg.norm(A[rows], axis=0)
    A = A[:, size > 0] / size[size > 0]
    N = A[rows].T @ A[rows] + RIDGE * np.eye(A.shape[1])
    return np.asarray(A @ np.linalg.solve(N, A[rows].T @ y[rows]))


def _rich(pair: Pair, candidates: Sequence[Effect]) -> list[Float64[np.ndarray, "_ n"]]:
    """Design columns by axis: a constant, and derivatives where fits begin."""
    columns = [[np.ones(len(pair.real))] for _ in range(6)]
    ideal = ForwardPass(pair, ())

    def rows(effect: Effect) -> list[tuple[int, int, Float64[np.ndarray, " n"]]]:
        passes = [ideal]
        if effect.starts is not None and not effect.linear:
            passes = [ForwardPass(pair, ((effect, start),), ideal) for start in pair.starts(effect)] or passes
        return [row for forward in passes for row in forward.derivatives(effect, onsets=False)]

    for found in of_each(rows, candidates):
        for axis, _, row in found:
            columns[axis].append(row)
    return [np.stack(rows) for rows in columns]


def _solved(A: Float64[np.ndarray, "q m"], y: Float64[np.ndarray, " m"]) -> tuple[Float64[np.ndarray, " q"], float]:
    """Least squares by the independent columns, and their number."""
    size = np.linalg.norm(A, axis=1)
    size = np.where(size > 0, size, 1.0)
    left, singular, right = np.linalg.svd((A / size[:, None]).T, full_matrices=False)
    kept = singular > INDEPENDENT * singular[0]
    return right[kept].T @ ((left[:, kept].T @ y) / singular[kept]) / size, float(kept.sum())


def known_band_hz(
    real: Float64[np.ndarray, "m 6"],
    residual: Float64[np.ndarray, "m 6"],
    rate_hz: float,
    most_hz: float,
    settings: BandSettings,
) -> float:
    """Band edge (Hz, up to `most_hz`) below which poses have hardly any error.

    An error of the expectation does two things together: the recording shares less of it (coherence), and follows it with a
    gain that is too small by as much (regression dilution; Fuller, Measurement Error Models, 1987, eq. 1.1.7: gain = true gain
    x reliability), which passes for a scale. Noise of the sensor lowers the coherence alone, a slow sensor the gain alone.
    The standard deviation of the gain is Bendat and Piersol's (Random Data, 4th ed., eq. 9.89).

    `residual` is that of a rich model of the sensor; the rest of the recording `real` is the expectation.
    """
    expectation, size = real - residual, min(int(settings.segment_s * rate_hz), len(residual))
    f_hz, power = welch(expectation, rate_hz, nperseg=size, axis=0)
    _, recorded = welch(real, rate_hz, nperseg=size, axis=0)
    _, cross = csd(expectation, real, rate_hz, nperseg=size, axis=0)
    duration_s = len(residual) / rate_hz
    for low, high in pairwise(EDGES_HZ):
        if low >= most_hz:
            break
        band = (f_hz >= low) & (f_hz < high)
        for axis in range(real.shape[1]):  # a lively axis must not hide a quiet one, which follows poorly
            e, r, x = (float(abs(density[band, axis].sum())) for density in (power, recorded, cross))
            if not e * r:  # an axis that never moves
                continue
            gain, coherence = x / e, min(1.0, x * x / (e * r))
            std = np.sqrt((1.0 - coherence) / (2.0 * duration_s * (high - low))) * np.sqrt(r / e)
            diluted = min(1.0 - gain - settings.sigma * std, 1.0 - coherence) > settings.diluted_share
            if low >= settings.least_hz and diluted:
                return low
    return most_hz
