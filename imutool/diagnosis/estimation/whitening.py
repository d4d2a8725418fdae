"""Whitening of residuals: an autoregressive filter for each axis.

Poses that were differentiated leave noise of every colour; least squares on such residuals is sure of the wrong things. An
autoregressive filter makes it white (Box and Jenkins; here by Burg's recursion over stretches that count), and what is
correlated costs what it should.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.ndimage import median_filter, minimum_filter1d
from scipy.signal import firwin, lfilter, periodogram

from imutool.array_types import Bool, Float64, Int64
from imutool.diagnosis.estimation.aligned_log import DEFAULT, AlignedLog, Blocks, Pair
from imutool.diagnosis.settings import NoiseSettings
from imutool.inertial.wiener import NoiseLeft
from imutool.noise.bias_walk import without_walk

Rows = Sequence[Float64[np.ndarray, " n"]] | Float64[np.ndarray, "r n"]
MAD_TO_STD = 1.4826
MIN_STD = 1e-12
AT_ONCE = 8  # values of a band in one product of matrices
FORGOTTEN = 1e-12  # of the noise: its square would underflow


@dataclass(frozen=True, eq=False)
class Band:
    """Low-pass band of a signal, decimated: smoothed poses know nothing of what is faster."""

    taps: Float64[np.ndarray, " k"]
    every: int

    @staticmethod
    def below(band_hz: float, rate_hz: float, settings: NoiseSettings = DEFAULT.noise) -> Band:
        """Band up to `band_hz`, by a symmetric filter."""
        count = 2 * round(0.5 * settings.band_filter_s * rate_hz) + 1
        every = max(1, int(rate_hz / (settings.band_oversampling * band_hz)))
        return Band(firwin(count, min(band_hz, 0.45 * rate_hz), fs=rate_hz), every)

    def __call__(self, x: Float64[np.ndarray, "n k *p"]) -> Float64[np.ndarray, "m k *p"]:
        """The slow part of some columns."""
        slow = self.rows(np.moveaxis(x, 0, -1).reshape(math.prod(x.shape[1:]), len(x)))
        return np.moveaxis(slow.reshape(*x.shape[1:], slow.shape[1]), -1, 0)

    def rows(self, x: Rows) -> Float64[np.ndarray, "r m"]:
        """The slow part of some rows, each while a processor's cache holds it; `upfirdn` takes two to four times as long."""
        n = x.shape[1] if isinstance(x, np.ndarray) else len(x[0]) if x else 0
        count, hop = len(range(0, n, self.every)), AT_ONCE * self.every
        blocks, parts, before = -(-count // AT_ONCE), self._matrix.shape[1] // AT_ONCE, len(self.taps) // 2
        padded, out = np.zeros((blocks + parts - 1) * hop), np.empty((len(x), count))
        for slow, row in zip(out, x, strict=True):
            padded[before : before + n] = row[: len(padded) - before]
            each = (padded.reshape(-1, hop) @ self._matrix).reshape(-1, parts, AT_ONCE)
            added = each[:blocks, 0].copy()
            for k in range(1, parts):
                added += each[k : blocks + k, k]
            slow[:] = added.ravel()[:count]
        return out

    @cached_property
    def _matrix(self) -> Float64[np.ndarray, "hop _"]:
        """Matrix from a block of samples to its part in `AT_ONCE` values of each block of the output that it reaches."""
        hop = AT_ONCE * self.every
        parts = -(-(hop - self.every + len(self.taps)) // hop)
        whole = np.zeros((parts * hop, AT_ONCE))
        for k in range(AT_ONCE):
            whole[k * self.every : k * self.every + len(self.taps), k] = self.taps[::-1]
        return np.concatenate(np.split(whole, parts), axis=1)


@dataclass(frozen=True, eq=False)
class Whitener:
    """Whitening filter for each axis, with the standard deviation of its output."""

    filters: Float64[np.ndarray, "k order"]
    std: Float64[np.ndarray, " k"]
    band: Band | None = None
    counts: Bool[np.ndarray, "m k"] | None = None  # values that tell anything (None: all); the others come out as zero
    walk: Float64[np.ndarray, " k"] | None = None  # variances of a walking bias' steps, by row, in `std` (None: constant)

    def __call__(self, x: Float64[np.ndarray, "n k *p"]) -> Float64[np.ndarray, "m k *p"]:
        """White rows from coloured ones (fewer in a band); columns of zeros stay zeros."""
        columns = x.reshape(len(x), x.shape[1], math.prod(x.shape[2:]))
        axes, ks = np.nonzero(columns.any(axis=0))
        out = np.zeros((len(range(0, len(x), self.every)), *columns.shape[1:]))
        if len(axes):
            out[:, axes, ks] = self.rows(columns[:, axes, ks].T, axes).T
        return out.reshape(len(out), *x.shape[1:])

    def rows(self, x: Rows, axes: Int64[np.ndarray, " r"]) -> Float64[np.ndarray, "r m"]:
        """Some rows, one after another in time, each of an axis of its own, made white."""
        slow = x if self.band is None else self.band.rows(x)
        taps = (self.filters / self.std[:, None])[axes]
        out = np.empty((len(slow), len(slow[0]) if len(slow) else 0))
        for white, of, row in zip(out, taps, slow, strict=True):  # numpy's loop for few taps takes half the time of lfilter
            white[:] = np.convolve(row, of)[: len(row)]
        if self.walk is not None:
            for white, steps in zip(out, self.walk[axes].tolist(), strict=True):
                white[:] = without_walk(white, steps)
        if self.counts is not None and len(out):
            out[~self.counts.T[axes]] = 0.0
        return out

    def counting(self, known: Bool[np.ndarray, "n k"]) -> Whitener:
        """Whitener that drops values which depend on unknown samples."""
        if self.band is not None:
            known = np.asarray(minimum_filter1d(known, len(self.band.taps), axis=0, mode="nearest"))[:: self.every]
        return replace(self, counts=np.stack([settled(column, self.order) for column in known.T], axis=1))

    @property
    def every(self) -> int:
        """Decimation: samples for one row of the output."""
        return 1 if self.band is None else self.band.every

    @property
    def order(self) -> int:
        """Order of the filter."""
        return int(self.filters.shape[1] - 1)


@dataclass(frozen=True, eq=False)
class WhitenedLog:
    """Whitened log: aligned samples with the filter that makes their noise white."""

    pair: AlignedLog
    whiten: Whitener

    def count(self, part: str) -> int:
        """Number of white values of a part that depend on known samples."""
        rows, counts = self.rows(part), self.whiten.counts
        return int(self.pair.columns * rows.sum() if counts is None else counts[rows].sum())

    def rows(self, part: str) -> Bool[np.ndarray, " n"]:
        """Rows that are `fitted`, `held_out` or `all`, behind the filter's start."""
        fitted, held_out = self._rows
        return fitted | held_out if part == "all" else fitted if part == "fitted" else held_out

    @cached_property
    def _rows(self) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        every, order = self.whiten.every, self.whiten.order
        return settled(self.pair.fitted[::every], order), settled(self.pair.held_out[::every], order)

    @cached_property
    def constants(self) -> Float64[np.ndarray, "n k"]:
        """A constant on each axis, whitened; a bias that walks forgets it."""
        white = self.whiten(np.ones_like(self.pair.real))
        return np.where(np.abs(white) > FORGOTTEN, white, 0.0)

    def residual(
        self, blocks: Blocks, known: tuple[Blocks, Float64[np.ndarray, "m k"]] | None = None
    ) -> Float64[np.ndarray, "m k"]:
        """White residuals of expected readings, bias included; columns as of other readings are taken from theirs."""
        columns = [column for _, block in blocks for column in block.T]
        others, old = ([], None) if known is None else ([column for _, block in known[0] for column in block.T], known[1].T)
        new = [k for k, column in enumerate(columns) if old is None or not np.array_equal(column, others[k])]
        white = self.whiten.rows([self.pair.real[:, k] - columns[k] for k in new], np.array(new, np.int64))
        if old is None or len(new) == len(columns):
            return np.asarray(white.T)
        out = old.copy()
        if new:
            out[new] = white
        return np.asarray(out.T)


@dataclass(frozen=True, eq=False)
class WhitenedImu(WhitenedLog):
    """Whitened IMU log."""

    pair: Pair


def whitener(residual: Float64[np.ndarray, "n k"], usable: Bool[np.ndarray, "n ..."], order: int) -> Whitener:
    """Whitening filters from a residual and its usable rows or samples.

    The size is robust (a few spikes are not the noise), but no less than half of what the plain one is.
    """
    filters, std = np.zeros((residual.shape[1], order + 1)), np.ones(residual.shape[1])
    filters[:, 0] = 1.0
    for axis, counts in enumerate(_by_axis(usable, residual.shape[1])):
        rows = settled(counts, order)
        if not rows.any():
            continue
        filters[axis] = burg(residual[:, axis], counts, order)
        white = lfilter(filters[axis], [1.0], residual[:, axis])[rows]
        robust = MAD_TO_STD * float(np.median(np.abs(white)))
        std[axis] = max(robust, 0.5 * float(np.sqrt(np.mean(white**2))), MIN_STD)
    return Whitener(filters, std)


def level(
    residual: Float64[np.ndarray, "n k"],
    usable: Bool[np.ndarray, "n ..."],
    rate_hz: float,
    settings: NoiseSettings,
    noise_left: NoiseLeft | None = None,
    lsb: Float64[np.ndarray, " k"] | float = 0.0,
) -> Whitener:
    """Whitening filters of a sensor against an exact simulation, or above the band of its poses.

    As `whitener`, but below `motion_hz` the noise is taken to be that above, with `noise_left` of a simulation's own.
    What is left down there may be physics that nobody thought of. No noise is less than LSB² / 12 of a simulation's digits.
    """
    filters, std = np.eye(1, settings.order + 1).repeat(residual.shape[1], axis=0), np.ones(residual.shape[1])
    minimum = np.broadcast_to(np.square(lsb) / (6.0 * rate_hz), std.shape)
    for axis, counts in enumerate(_by_axis(usable, residual.shape[1])):
        if not counts.any():
            continue
        f_hz, power = spectrum(residual[:, axis], counts, rate_hz, settings)
        power = median_filter(power, settings.line_bins, mode="nearest")  # a line is no noise
        low, high = min(settings.motion_hz, 0.3 * rate_hz), min(settings.reference_hz, 0.45 * rate_hz)
        power[f_hz < low] = np.median(power[(f_hz >= low) & (f_hz <= high)])
        if noise_left is not None:
            power[f_hz < low] += np.interp(f_hz[f_hz < low], noise_left.f_hz, noise_left.density[:, axis])
        filters[axis], std[axis] = autoregression(np.maximum(power, minimum[axis]), rate_hz, settings.order)
    return Whitener(filters, std)


def autoregression(power: Float64[np.ndarray, " f"], rate_hz: float, order: int) -> tuple[Float64[np.ndarray, " _"], float]:
    """Autoregression (1, a_1, ..., a_order) and innovation std from a density (Yule-Walker)."""
    from scipy.linalg import solve_toeplitz

    covariance = np.fft.irfft(power * rate_hz / 2.0)[: order + 1] + np.concatenate([[MIN_STD**2], np.zeros(order)])
    a = -solve_toeplitz(covariance[:-1], covariance[1:]) if order else np.zeros(0)
    return np.concatenate([[1.0], a]), float(np.sqrt(max(float(covariance[0] + a @ covariance[1:]), MIN_STD**2)))


def _by_axis(usable: Bool[np.ndarray, "n ..."], columns: int) -> Bool[np.ndarray, "k n"]:
    return np.asarray(np.broadcast_to(usable.reshape(len(usable), -1).T, (columns, len(usable))))


def spectrum(
    x: Float64[np.ndarray, " n"], usable: Bool[np.ndarray, " n"], rate_hz: float, settings: NoiseSettings
) -> tuple[Float64[np.ndarray, " f"], Float64[np.ndarray, " f"]]:
    """Frequencies and a power density (Welch) of which the median over frequencies is right.

    A segment counts if all of it is usable, or most of it where none is. The median over few segments is skewed, so that a
    median over frequencies of unbiased values would be too small: by 31 % with one segment.
    """
    size = settings.segment_of(len(x))
    starts = range(0, len(x) - size + 1, max(1, size // 2))
    whole = np.array([float(usable[s : s + size].mean()) for s in starts])
    taken = [s for s, share in zip(starts, whole, strict=True) if share >= min(1.0, float(whole.max()))]
    f_hz, each = periodogram(np.stack([x[s : s + size] for s in taken]), rate_hz, "hann", detrend="constant")
    return f_hz, np.asarray(np.median(each, axis=0) / median_of_medians(len(taken)))


def median_of_medians(count: int) -> float:
    """Median of the median of exponential variables of mean one: ln 2 for an odd count.

    An even count takes the ratio of median and mean from the next odd count, which is right to 1 %.
    """
    return float(np.log(2.0)) * mean_of_median(count) / mean_of_median(count + 1 - count % 2)


def mean_of_median(count: int) -> float:
    """Mean of the median of exponential variables (Allen et al., FINDCHIRP, app. B)."""
    odd_count = count - (count + 1) % 2
    return float(sum((-1.0) ** (k + 1) / k for k in range(1, max(odd_count, 1) + 1)))


def settled(usable: Bool[np.ndarray, " n"], order: int) -> Bool[np.ndarray, " n"]:
    """Rows whose last `order` rows count as well."""
    if not order:
        return usable
    return np.asarray(lfilter(np.ones(order + 1), [1.0], usable.astype(float)) > order + 0.5)


def burg(x: Float64[np.ndarray, " n"], usable: Bool[np.ndarray, " n"], order: int) -> Float64[np.ndarray, " _"]:
    """Burg's autoregression (1, a_1, ..., a_order).

    Forward and backward errors count where all their samples do.
    """
    a = np.array([1.0])
    f, b, ok = np.where(usable, x, 0.0), np.where(usable, x, 0.0), usable.copy()
    for _ in range(order):
        f, b, ok = f[1:], b[:-1], ok[1:] & ok[:-1]
        energy = float((f[ok] ** 2).sum() + (b[ok] ** 2).sum())
        k = -2.0 * float(f[ok] @ b[ok]) / energy if energy > 0 else 0.0
        a = np.concatenate([a, [0.0]])
        a = a + k * a[::-1]
        f, b = f + k * b, b + k * f
    return a
