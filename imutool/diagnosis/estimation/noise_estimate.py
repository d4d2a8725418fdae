"""Noise model from the residuals of the full-catalogue fit, and the band of the poses.

Against poses the noise is unknown: that of the poses, differentiated, has every colour, and that of the sensor lies under it.
It is estimated from what a rich model leaves: every effect of the catalogue, the nonlinear ones by their derivatives where a
fit of them would start. An effect left out here would be taken for noise, and never be seen again.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.signal import butter, csd, sosfiltfilt, welch

from imutool.array_types import Bool, Float64, Rows6
from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.gauss_newton import Fit
from imutool.diagnosis.estimation.jacobians import Chosen, ForwardPass, expected
from imutool.diagnosis.estimation.whitening import Band, WhitenedImu, WhitenedLog, Whitener, level, settled, whitener
from imutool.diagnosis.settings import BandSettings
from imutool.errors import DataError
from imutool.noise.bias_walk import INDEPENDENT
from imutool.processes.forked import of_each
from imutool.sensor.effect import Effect, Theta
from imutool.sensor.effects import vibration
from imutool.units import COLUMNS

logger = logging.getLogger(__name__)

RIDGE = 1e-8
MIN_ROWS = 2  # times the order of the noise model: rows that follow others without a gap
ALL_SLOW, SLOW_ORDER = 0.9, 4  # of the frequencies, from which on nothing is fast; order of the filter
Axes = Float64[np.ndarray, " _"]
EDGES_HZ = (0.5, 0.8, 1.25, 2.0, 3.0, 4.5, 6.5, 9.0, 13.0, 18.0, 25.0)  # of the bands in which the poses are checked


def whitened(pair: Pair, candidates: Sequence[Effect]) -> WhitenedImu:
    """Whitened log with its noise model; against poses also with the band that they know."""
    if pair.exact:
        residual, rate_hz = _left(pair, candidates), 1.0 / pair.period_s
        return _counting(pair, level(residual, pair.usable, rate_hz, pair.settings.noise, pair.noise_left, pair.sim_lsb))
    assert pair.band_hz is not None
    ideal, works, settings = expected(pair, ()), pair.axes, pair.settings.band
    band_hz = known_band_hz(pair.real[:, works], ideal[:, works], 1.0 / pair.period_s, pair.band_hz, settings)
    pair = replace(pair, band_hz=band_hz)
    band = Band.below(band_hz, 1.0 / pair.period_s, pair.settings.noise)
    _check_rows(pair, band)
    whiten = _in_band(pair, _rich(pair, candidates, band), pair.real - ideal, band)
    return _counting(pair, limited_to_quiet_axes(whiten, settings.noisy_axis))


def whitened_stretches(pairs: Sequence[Pair], candidates: Callable[[Pair], Sequence[Effect]]) -> list[WhitenedImu]:
    """Whitened stretches of logs; a short one among longer ones is left out with a warning.

    Raises:
        DataError: all are too short for a noise model.
    """
    logs, refused = list[WhitenedImu](), list[str]()
    for number, pair in enumerate(pairs):
        try:
            logs.append(whitened(pair, candidates(pair)))
        except DataError as error:
            if not logs and number + 1 == len(pairs):
                raise
            refused.append(f"{pair.stamp_s[0]:.1f} to {pair.stamp_s[-1]:.1f} s are left out: {error}")
    for reason in refused:
        logger.warning("%s", reason)
    return logs


def _check_rows(pair: Pair, band: Band) -> None:
    """Refuse a log with too few rows in the band for a noise model."""
    order = pair.settings.noise.order
    usable = pair.usable[:: band.every]
    counts = [int(settled(rows, order).sum()) for rows in usable.T if rows.any()]
    if not counts or min(counts) < MIN_ROWS * order:
        step_s, rows, minimum = pair.period_s * band.every, min(counts, default=0), MIN_ROWS * order
        raise DataError(
            f"its poses show motion below {pair.band_hz:.3g} Hz; {rows} values every {step_s:.2g} s are there without a gap",
            where=pair.name,
            expected=f"{minimum} or more",
            fix="Record longer, with fewer gaps, or with poses at a higher rate",
        )


def _counting(pair: Pair, white: Whitener) -> WhitenedImu:
    """The whitened log, without values that depend on unknown samples."""
    return WhitenedImu(pair, white if pair.known is None else white.counting(pair.known))


def _in_band(pair: Pair, columns: Sequence[Float64[np.ndarray, "_ m"]], wide_misfit: Rows6, band: Band) -> Whitener:
    """The noise of rows in a band, from the residual of a rich model there, whose columns are in it by axis."""
    misfit = band(wide_misfit)
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
    return Whitener(whiten.filters, whiten.std, band)


def limited_to_quiet_axes(whiten: Whitener, maximum: float) -> Whitener:
    """Whitener with no axis more than `maximum` times as noisy as the middle axis of its sensor.

    Poses err alike in all directions, and a sensor's axes are equally noisy; an axis with a much larger residual holds what
    the catalogue has no name for.
    """
    filters, std = whiten.filters.copy(), whiten.std.copy()
    total = noise_std(whiten)
    for part in COLUMNS.values():
        middle = int(np.argsort(total[part])[1]) + part.start
        for axis in range(part.start, part.stop):
            if total[axis] > maximum * total[middle]:
                filters[axis], std[axis] = whiten.filters[middle], maximum * whiten.std[middle]
    return Whitener(filters, std, whiten.band)


def noise_std(whiten: Whitener) -> Float64[np.ndarray, " k"]:
    """Standard deviation of the noise of a row by axis, before whitening."""
    response = np.array([np.abs(np.fft.rfft(a, 512)) ** 2 for a in whiten.filters])
    return np.asarray(whiten.std * np.sqrt((1.0 / response).mean(axis=1)))


def _left(pair: Pair, candidates: Sequence[Effect]) -> Rows6:
    """Residual of a simulation's misfit after a fit of every linear effect."""
    linear: Chosen = tuple((effect, effect.null_value.astype(float)) for effect in candidates if effect.linear)
    forward = ForwardPass(pair, linear)
    residual: Rows6 = pair.real - forward.expected
    columns: list[list[np.ndarray]] = [[np.ones(len(residual))] for _ in range(6)]
    for effect, _ in linear:
        for axis, _, row in forward.derivatives(effect):
            columns[axis].append(row)
    for axis, rows in enumerate(pair.usable.T):
        residual[:, axis] -= ridge_fit(np.stack(columns[axis], axis=1), residual[:, axis], rows)
    return residual


def is_coloured_noise(effect: Effect, theta: Theta, found: Fit) -> bool:
    """Whether a line against a simulation is noise that an autoregression smooths, or wanders."""
    exact, chance = [log.pair for log in found.logs if log.pair.exact], found.logs[0].pair.settings.search.false_discovery_rate
    if effect.name != vibration.EFFECT.name or len(exact) < len(found.logs):
        return False
    others = tuple(entry for entry in found.chosen if entry[0] is not effect)
    without = [expected(pair, others) for pair in exact]
    p_values = (
        vibration.line_p_value(pair.real - model, 1.0 / pair.period_s, theta[0])
        for pair, model in zip(exact, without, strict=True)
    )
    if all(p_value > chance for p_value in p_values):
        return True
    waves = ((*others, (effect, turned)) for turned in (theta, vibration.quarter_turn(theta)))
    lines = [[expected(pair, acting) - model for pair, model in zip(exact, without, strict=True)] for acting in waves]
    readings = [pair.real - model for pair, model in zip(exact, without, strict=True)]
    return all(vibration.wanders(*each) for each in zip(readings, *lines, strict=True))


def white_rows(found: Fit) -> list[Float64[np.ndarray, "_ k"]]:
    """White residuals of the fitted rows without the bias, by log."""
    each = zip(found.logs, found.residuals, found.bias, strict=True)
    return [(r - log.constants * b)[log.rows(found.part)] for log, r, b in each]


def axis_squares(found: Fit, only: Collection[WhitenedLog] = ()) -> Axes:
    """Squares of white residuals by axis, of all logs or of some."""
    each = zip(found.logs, white_rows(found), strict=True)
    return np.asarray(sum((rows**2).sum(axis=0) for log, rows in each if not only or log in only))


def leaves_slow_motion(found: Fit, sensor: str, squares: float) -> bool:
    """Whether a fit leaves more than some squares on a sensor, where a body moves."""
    return float(_slow_squares(found)[found.logs[0].pair.signals[sensor]].sum()) > squares


def _slow_squares(found: Fit) -> Axes:
    """Squares of white residuals above noise by axis, below the frequency `motion_hz` up to which a body moves."""
    total = np.zeros(found.logs[0].pair.columns)
    for log, r, b in zip(found.logs, found.residuals, found.bias, strict=True):
        settings, residual = log.pair.settings, r - log.constants * b
        slow = 2.0 * settings.noise.motion_hz * log.pair.period_s * log.whiten.every  # share of the frequencies
        if slow < ALL_SLOW:
            residual = sosfiltfilt(butter(SLOW_ORDER, slow, output="sos"), residual, axis=0)
        rows = residual[log.rows(found.part)]
        total += np.maximum((rows**2).sum(axis=0) - settings.search.white_chi_square * min(slow, 1.0) * len(rows), 0.0)
    return total


def kurtosis(found: Fit) -> Axes:
    """Kurtosis of white residuals by axis: 3 of normal noise, more where few samples err."""
    rows = np.concatenate(white_rows(found))
    return np.asarray((rows**4).mean(axis=0) / np.maximum((rows**2).mean(axis=0) ** 2, 1e-300))


def ridge_fit(
    A: Float64[np.ndarray, "n q"], y: Float64[np.ndarray, " n"], rows: Bool[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """Ridge fit of y by columns on some rows, evaluated on all rows."""
    size = np.linalg.norm(A[rows], axis=0)
    A = A[:, size > 0] / size[size > 0]
    return np.asarray(A @ np.linalg.solve(A[rows].T @ A[rows] + RIDGE * np.eye(A.shape[1]), A[rows].T @ y[rows]))


def _rich(pair: Pair, candidates: Sequence[Effect], band: Band) -> list[Float64[np.ndarray, "_ m"]]:
    """Design columns in a band by axis: a constant, and derivatives where fits begin."""
    columns = [[band.rows([np.ones(len(pair.real))])[0]] for _ in range(6)]
    ideal = ForwardPass(pair, ())

    def rows(effect: Effect) -> list[tuple[int, Float64[np.ndarray, " m"]]]:
        passes = [ideal]
        if effect.starts is not None and not effect.linear:
            passes = [ForwardPass(pair, ((effect, start),), ideal) for start in pair.starts(effect)] or passes
        found = [row for forward in passes for row in forward.derivatives(effect, onsets=False)]
        slow = band.rows([row for _, _, row in found])  # of which a process passes on far less
        return [(axis, row) for (axis, _, _), row in zip(found, slow, strict=True)]

    for found in of_each(rows, candidates):
        for axis, row in found:
            columns[axis].append(row)
    return [np.stack(rows) for rows in columns]


def _solved(A: Float64[np.ndarray, "q m"], y: Float64[np.ndarray, " m"]) -> tuple[Float64[np.ndarray, " q"], float]:
    """Least squares by the independent columns, and their number."""
    size = np.linalg.norm(A, axis=1)
    size = np.where(size > 0, size, 1.0)
    both = np.concatenate([A / size[:, None], y[None]])
    R = np.asarray(np.linalg.qr(both.T, mode="r"))  # takes, with its singular values, half the time of A's own
    left, singular, right = np.linalg.svd(R[: len(A), :-1], full_matrices=False)
    kept = singular > INDEPENDENT * singular[0]
    return right[kept].T @ ((left[:, kept].T @ R[: len(A), -1]) / singular[kept]) / size, float(kept.sum())


def known_band_hz(
    real: Float64[np.ndarray, "n k"],
    expectation: Float64[np.ndarray, "n k"],
    rate_hz: float,
    max_hz: float,
    settings: BandSettings,
) -> float:
    """Band edge (Hz, up to `max_hz`) below which poses have hardly any error.

    An error of the expectation does two things together: the recording shares less of it (coherence), and follows it with a
    gain that is too small by as much (regression dilution; Fuller, Measurement Error Models, 1987, eq. 1.1.7: gain = true gain
    x reliability). Noise of the sensor lowers the coherence alone, a slow sensor the gain alone. A scale is the same at every
    frequency, so the gain is compared with that of slower motion. No model of the sensor is fitted first, for it would fit
    these errors: a scale takes the dilution, and a lever arm the motion that the poses lack.

    The standard deviation of the gain is Bendat and Piersol's (Random Data, 4th ed., eq. 9.89).
    """
    size = min(int(settings.segment_s * rate_hz), len(real))
    f_hz, power = welch(expectation, rate_hz, nperseg=size, axis=0)
    _, recorded = welch(real, rate_hz, nperseg=size, axis=0)
    _, cross = csd(expectation, real, rate_hz, nperseg=size, axis=0)
    moves = power.any(axis=0) & recorded.any(axis=0)
    duration_s = len(real) / rate_hz

    def follows(low: float, high: float) -> Float64[np.ndarray, "3 _"]:
        """Gain, its relative standard deviation, and coherence, by axis."""
        band = (f_hz >= low) & (f_hz < high)
        e, r, x = (np.abs(density[band][:, moves].sum(axis=0)) for density in (power, recorded, cross))
        coherence = np.minimum(1.0, x**2 / (e * r))
        return np.stack([x / e, np.sqrt((1.0 / coherence - 1.0) / (2.0 * duration_s * (high - low))), coherence])

    def is_diluted(gain: Axes, std: Axes, coherence: Axes) -> Bool[np.ndarray, " _"]:
        lost = 1.0 - gain * (1.0 + settings.sigma * std)
        return np.asarray(np.minimum(lost, 1.0 - coherence) > settings.diluted_share)

    known = ~is_diluted(*follows(EDGES_HZ[0], settings.min_hz))  # no band helps an axis whose slow motion is not known
    for low, high in pairwise([*(hz for hz in EDGES_HZ if hz + 1.0 / settings.segment_s <= max_hz), max_hz]):
        if low >= settings.min_hz:
            (slow, slow_std, _), (fast, fast_std, coherence) = follows(EDGES_HZ[0], low), follows(low, high)
            if (known & is_diluted(fast / slow, np.hypot(slow_std, fast_std), coherence)).any():
                return low  # a lively axis must not hide a quiet one
    return max_hz
