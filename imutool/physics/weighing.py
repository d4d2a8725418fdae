"""Recordings with the noise they are weighed by: what is left when everything in the catalogue has had its way.

Beside poses nobody states the noise: that of the poses, differentiated, has every colour, and that of the sensor lies under it.
It is taken from what a rich model leaves: every effect of the catalogue, those that are not linear by their derivatives where
a fit of them would start. An effect left out here would be taken for noise, and never be seen again.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64

from imutool.physics.course import Chosen, Course
from imutool.physics.effects._forward import Physics, Theta
from imutool.physics.fit import Weighed, expected
from imutool.physics.known_band import known_below
from imutool.physics.pair import Pair
from imutool.physics.readings import Read
from imutool.physics.whitening import Band, Whitener, level, settled, whitener

ORDER_SIM, ORDER_TRUTH = 6, 6  # of the autoregression: the noise of a sensor; of poses, on rows that just hold their band
RIDGE = 1e-8
TURNS = 2  # of noise and model beside poses, each asked of the other
MUCH = 3.0  # times the noise of another axis
SAME = 1e-3  # of a column, left when those before it are taken out: it says nothing of its own

Columns = Float64[np.ndarray, "m 6 p"]


def weighed(pair: Pair, candidates: Sequence[Physics]) -> Weighed:
    """The pair with its noise; beside poses also with the band up to which they are seen to know the motion."""
    if pair.against == "simulation":
        return _counting(pair, level(_left(pair, candidates), pair.usable, 1.0 / pair.period_s, ORDER_SIM))
    assert pair.band_hz is not None
    columns, misfit, usable = _rich(pair, candidates), pair.real - expected(pair, ()), pair.usable
    band_hz = known_below(pair, misfit - _explained(columns, misfit, usable)[0], pair.band_hz)
    if band_hz < pair.band_hz:
        pair = pair.within(band_hz)
    band = Band.below(band_hz, 1.0 / pair.period_s)
    slow, rows = band(columns), usable[:: band.every]
    left, spent = _explained(slow, band(misfit), rows)
    found = _scaled(whitener(band(misfit) - left, rows, ORDER_TRUTH), rows, spent)
    for _ in range(TURNS - 1):
        settled_rows = np.stack([settled(column, ORDER_TRUTH) for column in rows.T], axis=1)
        white = found(band(misfit))
        fitted, spent = _explained(found(slow), white, settled_rows, slow)
        found = _scaled(whitener(band(misfit) - fitted, rows, ORDER_TRUTH), rows, spent)
    return _counting(pair, alike(Whitener(found.filters, found.std, band)))


def _counting(pair: Pair, white: Whitener) -> Weighed:
    """Without the values into which samples that tell nothing have gone."""
    return Weighed(pair, white if pair.known is None else white.counting(pair.known))


def alike(found: Whitener) -> Whitener:
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


def _scaled(found: Whitener, rows: Bool[np.ndarray, "m 6"], spent: Float64[np.ndarray, "6"]) -> Whitener:
    """With the size that the rows' noise had before so many numbers were fitted to it."""
    count = np.maximum(rows.sum(axis=0), 1.0)
    return Whitener(found.filters, found.std * np.sqrt(count / np.maximum(count - spent, 0.5 * count)), found.band)


def _left(pair: Pair, candidates: Sequence[Physics]) -> Float64[np.ndarray, "n 6"]:
    """What is left of a simulation's misfit when everything linear has had its way."""
    linear: Chosen = tuple((one, one.nothing.astype(float)) for one in candidates if one.linear)
    course = Course(pair, linear)
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


def _rich(pair: Pair, candidates: Sequence[Physics]) -> Columns:
    """Derivatives of everything in the catalogue at the places where fits begin, and a constant."""
    columns = [np.ones((*pair.real.shape, 1))]
    samples = Read(pair.stamp_s, pair.real[:, :3], pair.real[:, 3:], np.zeros((len(pair.real), 3)))
    nothing = Course(pair, ())
    for physics in candidates:
        starts: Sequence[Theta] = [physics.nothing.astype(float)]
        if physics.starts is not None and not physics.linear:
            starts = physics.starts(pair.felt, samples)
        moves = np.array([not number.begins for number in physics.parameters])
        for start in starts:
            course = nothing if physics.linear else Course(pair, ((physics, np.asarray(start, dtype=float)),), nothing)
            slopes = np.zeros((*pair.real.shape, len(moves)))
            for axis, j, row in course.slope(physics):
                slopes[:, axis, j] = row
            columns.append(slopes[:, :, moves])
    return np.concatenate(columns, axis=2)


def _explained(
    columns: Columns, misfit: Float64[np.ndarray, "m 6"], usable: Bool[np.ndarray, "m 6"], shown: Columns | None = None
) -> tuple[Float64[np.ndarray, "m 6"], Float64[np.ndarray, "6"]]:
    """What columns explain of each axis by least squares (as it is `shown`, if otherwise), and by how many numbers."""
    out, spent = np.zeros_like(misfit), np.zeros(6)
    for axis, rows in enumerate(usable.T):
        if not rows.any():
            continue
        A = columns[rows, axis]
        size = np.linalg.norm(A, axis=0)
        some = size > 0
        left, singular, right = np.linalg.svd(A[:, some] / size[some], full_matrices=False)
        told = singular > SAME * singular[0]
        x = right[told].T @ ((left[:, told].T @ misfit[rows, axis]) / singular[told])
        out[:, axis] = (columns if shown is None else shown)[:, axis][:, some] @ (x / size[some])
        spent[axis] = told.sum()
    return out, spent
