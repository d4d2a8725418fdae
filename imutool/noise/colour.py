"""Colour of an IMU's noise: its spectrum, and how its size follows the motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from msgspec import Meta
from scipy.special import digamma, polygamma

from imutool.array_types import Float64, Int64
from imutool.config import Settings

SAME_RATE = 0.01  # by which two rates may differ and be one
WINDOW_S = 1.0  # in which the noise has one size
EDGES_HZ = (0.0, 1.5, 2.5, 4.5, 7.5, 10.5, 14.5, 20.5, 28.5, 40.5, 56.5, 75.5, 105.0, 150.0, 210.0, 300.0, 420.0)
FACTORS = 6  # by which bands and axes grow and shrink together
MIN_WINDOWS = 20  # of a spectrum that follows the motion
MIN_SHARE = 0.05  # of the power of what is left that is noise, where the expected signal has noise of its own
NOTICEABLE = 0.1  # of the expected power: less says nothing of the expected signal's own noise
CORRELATED = 1.5  # neighbouring lines of a Hann window's spectrum count as so many fewer
WHOLE = 1.02  # times its samples' periods that a window without a gap lasts at most
MIN_MOTION = 1e-9  # rms rate of change
RANGE = (0.025, 0.975)  # quantiles of the size of windows
DIGITS = 4  # of a number in a file

Columns = Float64[np.ndarray, "n 6"]
Level = tuple[float, ...]  # by band
Levels = tuple[Level, Level, Level, Level, Level, Level]  # of gyro x, y, z and accel x, y, z
Size = Annotated[float, Meta(ge=0.0)]
Sizes = tuple[Size, Size]


class Colour(Settings, frozen=True, kw_only=True):
    """Spectrum of the noise, and how its size follows the motion, as recorded at one rate.

    All is relative to white noise of the same power: 0 is the logarithm of its power in a line of the spectrum. In a window of
    `window_s` the logarithm of the noise's power in band k, lines from `edges_hz[k]` to `edges_hz[k + 1]`, is by column

        mean + follows_gyro (m_g - motion[0]) + follows_accel (m_a - motion[1]) + sum_j factors_j z_j + own z

    with the z standard normal numbers, and m the logarithm of the rms rate of change that the reading without noise has in
    the window (rad/s², m/s³), cut to `minimum` and `maximum`. Within a band `shape` has the power of one line after the other,
    1 / window_s apart. `gyro_range` and `accel_range` are the quantiles 2.5 and 97.5 % of the size in a window.
    """

    rate_hz: Annotated[float, Meta(gt=0.0)]
    window_s: Annotated[float, Meta(gt=0.0)]
    edges_hz: Level
    shape: Levels
    mean: Levels
    follows_gyro: Levels
    follows_accel: Levels
    factors: tuple[Levels, ...]
    own: Levels
    motion: tuple[float, float]
    minimum: tuple[float, float]
    maximum: tuple[float, float]
    gyro_range: Sizes
    accel_range: Sizes

    def holds_at(self, rate_hz: float) -> bool:
        """Whether samples of this rate can have it."""
        return abs(self.rate_hz / rate_hz - 1.0) < SAME_RATE

    def drawn(self, t_s: Float64[np.ndarray, " n"], readings: Columns, rng: np.random.Generator) -> Columns:
        """Noise along noise-free readings, relative to white noise of the same power.

        Windows with half a window of overlap, each weighed by a sine, so that the powers of two add up to one (Princen and
        Bradley, IEEE Trans. ASSP 34, 1986).
        """
        count = _count(self.window_s, self.rate_hz)
        half, n = count // 2, len(t_s)
        band = _bands(self.edges_hz, count, self.rate_hz)
        firsts = np.arange(-half, n, half)
        follows = np.array([self.follows_gyro, self.follows_accel])
        level = np.array(self.mean) + np.tensordot(self._motion(t_s, readings, firsts, count), follows, 1)
        if self.factors:
            level += np.tensordot(rng.normal(size=(len(firsts), len(self.factors))), np.array(self.factors), 1)
        level += np.array(self.own) * rng.normal(size=level.shape)
        out, weight, shape = (
            np.zeros((n + 2 * count, 6)),
            np.sin(np.pi * (np.arange(count) + 0.5) / count),
            np.array(self.shape),
        )
        for first, log_power in zip(firsts, level, strict=True):
            lines = np.sqrt(np.exp(shape + log_power[:, band])) * np.fft.rfft(rng.normal(size=(6, count)))
            out[first + half : first + half + count] += weight[:, None] * np.fft.irfft(lines, count).T
        return np.asarray(out[half : half + n])

    def _motion(
        self, t_s: Float64[np.ndarray, " n"], readings: Columns, firsts: Int64[np.ndarray, " w"], count: int
    ) -> Float64[np.ndarray, "w 2"]:
        """Logarithm of the rms rate of change in each window, over its mean."""
        step_s = np.maximum(np.diff(t_s), 0.5 / self.rate_hz)[:, None]
        squares = ((np.diff(readings, axis=0) / step_s) ** 2).reshape(-1, 2, 3).sum(axis=2)
        total = np.concatenate([np.zeros((1, 2)), np.cumsum(squares, axis=0)])
        begins, ends = (np.clip(rows, 0, len(squares)) for rows in (firsts, firsts + count - 1))
        size = np.sqrt(np.maximum(total[ends] - total[begins], 0.0) / np.maximum(ends - begins, 1)[:, None])
        return np.asarray(np.clip(np.log(np.maximum(size, MIN_MOTION)), self.minimum, self.maximum) - self.motion)


def measured(
    parts: Sequence[tuple[Float64[np.ndarray, " _"], Float64[np.ndarray, "_ 6"], Float64[np.ndarray, "_ 6"]]],
    std: Float64[np.ndarray, "6"],
    rate_hz: float,
) -> Colour | None:
    """Colour of recorded less expected samples; None where they are too short.

    `parts` are stretches of (time, recorded, expected). An expected signal with noise of its own, as smoothed poses have,
    leaves more than a simulation along it lacks. There the noise is the recorded less the expected power.
    """
    count = _count(WINDOW_S, rate_hz)
    windows = [window for part in parts for window in _windows(*part, count, rate_hz)]
    if len(windows) < MIN_WINDOWS:
        return None
    recorded, expected = (np.array(samples) for samples in zip(*windows, strict=True))
    real, ideal, rest = (_power(x / std) for x in (recorded, expected, recorded - expected))
    edges_hz = (*(edge for edge in EDGES_HZ if edge < 0.45 * rate_hz), 0.5 * rate_hz)
    band = _bands(edges_hz, count, rate_hz)
    lines = np.bincount(band)
    in_bands = [
        np.stack([power[..., band == k].mean(axis=-1) for k in range(len(lines))], axis=-1) for power in (real, ideal, rest)
    ]
    of_real, of_ideal, of_left = (power.sum(axis=0) for power in in_bands)
    share = np.clip((of_real - of_ideal) / of_left, MIN_SHARE, 1.0)
    log_power = np.log(in_bands[2] * np.where(of_left > NOTICEABLE * of_ideal, share, 1.0))
    freedom = np.maximum(lines / CORRELATED, 0.5 * CORRELATED)
    log_power += np.log(freedom) - digamma(freedom)  # a mean of few lines is drawn low (Bartlett and Kendall 1946)
    motion = np.log(np.maximum(_rate_of_change(expected, rate_hz), MIN_MOTION))
    columns = np.column_stack([np.ones(len(motion)), motion - motion.mean(axis=0)])
    rows = log_power.reshape(len(log_power), -1)
    coefficients = np.linalg.lstsq(columns, rows, rcond=None)[0]
    factors, own = _spread(rows - columns @ coefficients, np.tile(polygamma(1, freedom), 6))
    fine = np.log(rest.mean(axis=0))
    shape = fine - np.log(np.stack([rest.mean(axis=0)[:, band == k].mean(axis=1) for k in range(len(lines))], axis=1))[:, band]
    shares = ((recorded - expected) / std).reshape(len(recorded), -1, 2, 3).var(axis=1).mean(axis=2)
    low, high = np.quantile(np.sqrt(shares / shares.mean(axis=0)), RANGE, axis=0)
    return Colour(
        rate_hz=rate_hz,
        window_s=WINDOW_S,
        edges_hz=edges_hz,
        shape=_levels(shape),
        mean=_levels(coefficients[0]),
        follows_gyro=_levels(coefficients[1]),
        follows_accel=_levels(coefficients[2]),
        factors=tuple(_levels(row) for row in factors),
        own=_levels(own),
        motion=_two(motion.mean(axis=0)),
        minimum=_two(motion.min(axis=0)),
        maximum=_two(motion.max(axis=0)),
        gyro_range=(_rounded(low[0]), _rounded(high[0])),
        accel_range=(_rounded(low[1]), _rounded(high[1])),
    )


def _spread(
    rest: Float64[np.ndarray, "w k"], sampling: Float64[np.ndarray, " k"]
) -> tuple[Float64[np.ndarray, "f k"], Float64[np.ndarray, " k"]]:
    """Principal factors of the levels, and the spread that each has alone, without that of a finite window."""
    covariance = np.cov(rest.T)
    known = covariance - np.diag(np.minimum(sampling, np.diag(covariance)))
    values, vectors = np.linalg.eigh(known)
    factors = (vectors[:, -FACTORS:] * np.sqrt(np.maximum(values[-FACTORS:], 0.0))).T
    return factors, np.sqrt(np.maximum(np.diag(known) - (factors**2).sum(axis=0), 0.0))


def _windows(
    t_s: Float64[np.ndarray, " n"], real: Columns, expected: Columns, count: int, rate_hz: float
) -> list[tuple[Float64[np.ndarray, "_ 6"], Float64[np.ndarray, "_ 6"]]]:
    """Half overlapping windows without a gap."""
    known = np.isfinite(real).all(axis=1) & np.isfinite(expected).all(axis=1)
    out = []
    for first in range(0, len(t_s) - count + 1, count // 2):
        rows = slice(first, first + count)
        if known[rows].all() and t_s[rows][-1] - t_s[rows][0] < WHOLE * count / rate_hz:
            out.append((real[rows], expected[rows]))
    return out


def _power(x: Float64[np.ndarray, "w _ 6"]) -> Float64[np.ndarray, "w 6 _"]:
    """Power by line of the spectrum, 1 for white noise of variance 1."""
    weight = np.hanning(x.shape[1])[:, None]
    lines = np.fft.rfft((x - x.mean(axis=1, keepdims=True)) * weight, axis=1)
    return np.asarray(np.moveaxis(np.abs(lines) ** 2, 1, 2) / (weight**2).sum())


def _rate_of_change(x: Float64[np.ndarray, "w n 6"], rate_hz: float) -> Float64[np.ndarray, "w 2"]:
    squares = (np.diff(x, axis=1) * rate_hz) ** 2
    return np.asarray(np.sqrt(squares.mean(axis=1).reshape(len(x), 2, 3).sum(axis=2)))


def _count(window_s: float, rate_hz: float) -> int:
    """Even number of samples of a window."""
    return 2 * max(4, round(0.5 * window_s * rate_hz))


def _bands(edges_hz: Level, count: int, rate_hz: float) -> Int64[np.ndarray, " f"]:
    """Band of each line of a window's spectrum."""
    return np.asarray(np.clip(np.digitize(np.fft.rfftfreq(count, 1.0 / rate_hz), edges_hz) - 1, 0, len(edges_hz) - 2))


def _levels(values: Float64[np.ndarray, "*_"]) -> Levels:
    a, b, c, d, e, f = (tuple(_rounded(value) for value in row) for row in values.reshape(6, -1))
    return a, b, c, d, e, f


def _two(values: Float64[np.ndarray, "2"]) -> tuple[float, float]:
    return _rounded(values[0]), _rounded(values[1])


def _rounded(value: float) -> float:
    return round(float(value), DIGITS)
