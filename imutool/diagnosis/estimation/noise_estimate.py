"""Recordings with the noise they are weighed by: what is left when everything in the catalogue has had its way.

Beside poses nobody states the noise: that of the poses, differentiated, has every colour, and that of the sensor lies under it.
It is taken from what a rich model leaves: every effect of the catalogue, those that are not linear by their derivatives where
a fit of them would start. An effect left out here would be taken for noise, and never be seen again.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from imutool.diagnosis.estimation.alignment import Pair
from imutool.diagnosis.estimation.forward_cache import Chosen, ForwardPass
from imutool.diagnosis.estimation.gauss_newton import WhitenedLog, expected
from imutool.diagnosis.estimation.known_band import known_band_hz
from imutool.diagnosis.estimation.whitening import Band, Whitener, level, settled, whitener
from imutool.sensor.effect import Effect, Theta
from imutool.sensor.samples import SensorSamples

ORDER_SIM, ORDER_TRUTH = 6, 6  # of the autoregression: the noise of a sensor; of poses, on rows that just hold their band
RIDGE = 1e-8
TURNS = 2  # of noise and model beside poses, each asked of the other
MUCH = 3.0  # times the noise of another axis
SAME = 1e-3  # of a column, left when those before it are taken out: it says nothing of its own


def whitened(pair: Pair, candidates: Sequence[Effect]) -> WhitenedLog:
    """The pair with its noise; beside poses also with the band up to which they are seen to know the motion."""
    if pair.against == "simulation":
        return _counting(pair, level(_left(pair, candidates), pair.usable, 1.0 / pair.period_s, ORDER_SIM))
    assert pair.band_hz is not None
    found, left = _in_band(pair, candidates, pair.band_hz)
    assert found.band is not None
    rate_hz = 1.0 / (pair.period_s * found.every)
    band_hz = known_band_hz(found.band(pair.real), left, rate_hz, pair.band_hz)
    if band_hz < pair.band_hz:
        pair = pair.within(band_hz)
        found, _ = _in_band(pair, candidates, band_hz)
    return _counting(pair, limited_to_quiet_axes(found))


def _counting(pair: Pair, white: Whitener) -> WhitenedLog:
    """Without the values into which samples that tell nothing have gone."""
    return WhitenedLog(pair, white if pair.known is None else white.counting(pair.known))


def _in_band(pair: Pair, candidates: Sequence[Effect], band_hz: float) -> tuple[Whitener, Float64[np.ndarray, "m 6"]]:
    """The noise of rows up to a frequency, and what a rich model leaves there."""
    band = Band.below(band_hz, 1.0 / pair.period_s)
    columns, misfit = _rich(pair, candidates, band), band(pair.real - expected(pair, ()))
    usable = pair.usable[:: band.every]
    found = Whitener(np.ones((6, 1)), np.ones(6))
    for _ in range(TURNS):
        left, spent = misfit.copy(), np.zeros(6)
        for axis in np.flatnonzero(usable.any(axis=0)).tolist():
            rows = settled(usable[:, axis], found.order)
            both = np.concatenate([columns[axis], misfit[:, axis][None]])
            white = found.rows(both, np.full(len(both), axis))[:, rows]
            x, spent[axis] = _solved(white[:-1], white[-1])
            left[:, axis] -= x @ columns[axis]
        found = whitener(left, usable, ORDER_TRUTH)
        count = np.maximum(usable.sum(axis=0), 1.0)  # the noise before so many numbers were fitted to it
        found = Whitener(found.filters, found.std * np.sqrt(count / np.maximum(count - spent, 0.5 * count)))
    return Whitener(found.filters, found.std, band), left


def limited_to_quiet_axes(found: Whitener) -> Whitener:
    """With no axis much noisier than the quiet ones of its sensor.

    Poses err alike in all directions, and a sensor's axes are noisy alike; an axis in which much more is left holds what
    the catalogue has no name for.
    """
    filters, std = found.filters.copy(), found.std.copy()
    total = noise_std(found)
    for part in (slice(0, 3), slice(3, 6)):
        middle = int(np.argsort(total[part])[1]) + part.start
        for axis in range(part.start, part.stop):
            if total[axis] > MUCH * total[middle]:
                filters[axis], std[axis] = found.filters[middle], MUCH * found.std[middle]
    return Whitener(filters, std, found.band)


def noise_std(found: Whitener) -> Float64[np.ndarray, "6"]:
    """The noise of a row by axis, before it is made white."""
    response = np.array([np.abs(np.fft.rfft(a, 512)) ** 2 for a in found.filters])
    return np.asarray(found.std * np.sqrt((1.0 / response).mean(axis=1)))


def _left(pair: Pair, candidates: Sequence[Effect]) -> Float64[np.ndarray, "n 6"]:
    """What is left of a simulation's misfit when everything linear has had its way."""
    linear: Chosen = tuple((one, one.null_value.astype(float)) for one in candidates if one.linear)
    course = ForwardPass(pair, linear)
    left: Float64[np.ndarray, "n 6"] = pair.real - course.expected
    columns: list[list[np.ndarray]] = [[np.ones(len(left))] for _ in range(6)]
    for one, _ in linear:
        for axis, _, row in course.slope(one):
            columns[axis].append(row)
    for axis, rows in enumerate(pair.usable.T):
        A = np.stack(columns[axis], axis=1)
        size = np.linalg.norm(A[rows], axis=0)
        A = A[:, size > 0] / size[size > 0]
        N = A[rows].T @ A[rows] + RIDGE * np.eye(A.shape[1])
        left[:, axis] -= A @ np.linalg.solve(N, A[rows].T @ left[rows, axis])
    return left


def _rich(pair: Pair, candidates: Sequence[Effect], band: Band) -> list[Float64[np.ndarray, "_ m"]]:
    """For each axis a constant, and derivatives of everything in the catalogue at the places where fits begin, in a band."""
    samples = SensorSamples(pair.stamp_s, pair.real[:, :3], pair.real[:, 3:], np.zeros((len(pair.real), 3)))
    columns = [[np.ones(len(pair.real))] for _ in range(6)]
    nothing = ForwardPass(pair, ())
    for physics in candidates:
        starts: Sequence[Theta] = ()
        if physics.starts is not None and not physics.linear:
            starts = physics.starts(pair.felt, samples)
        courses = [ForwardPass(pair, ((physics, np.asarray(start, dtype=float)),), nothing) for start in starts] or [nothing]
        for course in courses:
            for axis, j, row in course.slope(physics):
                if not physics.parameters[j].begins:
                    columns[axis].append(row)
    return [band.rows(np.stack(rows)) for rows in columns]


def _solved(A: Float64[np.ndarray, "q m"], y: Float64[np.ndarray, " m"]) -> tuple[Float64[np.ndarray, " q"], float]:
    """Least squares by the columns that say something of their own, and how many that are."""
    size = np.linalg.norm(A, axis=1)
    size = np.where(size > 0, size, 1.0)
    left, singular, right = np.linalg.svd((A / size[:, None]).T, full_matrices=False)
    told = singular > SAME * singular[0]
    return right[told].T @ ((left[:, told].T @ y) / singular[told]) / size, float(told.sum())
