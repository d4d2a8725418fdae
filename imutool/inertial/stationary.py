"""Rest detection: the stretches in which an IMU rests, from its samples only.

At rest, the angular rate is a constant plus noise (with idling motors: vibration). Noise averages out: the means of blocks of
k samples scatter by the standard deviation within the blocks over sqrt(k). Motion does not average out. A window rests if its
block means scatter no more than that (or no more than the calmest windows of the log, for sensors whose filter correlates
neighbouring samples), within absolute caps for every log.

Chosen on the 23 recordings of EuRoC, TUM-VI and FETCH against their true poses: the scatter of 0.1 s means over 1 s is
at most 0.007 rad/s on the ground with motors running, and at least 0.008 in hovering flight, 0.03 in the hand. Nor does the
rate of a stop have a trend: a log that never rests has calmest windows, too.
A steady turn about the vertical looks like a bias; only its size, or its difference from the other rest of the log, shows it.
"""

from __future__ import annotations

import math
from bisect import insort
from collections import deque
from collections.abc import Iterable
from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta

from imutool.array_types import Bool, Float64, Int64
from imutool.config import Settings
from imutool.recording import Imu, nanoseconds
from imutool.recording.columns import quantile, true_ranges

WHITE_MARGIN = 1.3  # ratio of block means to white noise; with 10 blocks of 3 axes, equally noisy, it scatters by 0.14
MIN_VARIANCE = 1e-300  # of a window that is stuck
TREND_DEVIATIONS = 4.0  # of the difference of two means; real stops reach 2.1, a slow turn that changes 11
FLOOR_MARGIN = 2.5  # ratio to the calmest windows of the log
FLOOR_RANK = 10  # rank of the window that sets the floor: a single stuck window must not
NOISE_BLOCK, CALMEST = 20, 0.25
SLOW_S = 0.015  # at 50 Hz second differences of a drone or a hand show 1.4 to 4.5 times the noise, at 25 Hz 4 to 20 times
CALM = 1.2  # times `white_noise`, that pure white noise is
MEANS, MIN_MEANS = (20, 200), 8  # samples of a mean of noise, and how many means there are at least
TOLERATED_MEAN = 1.8  # by which they may scatter more than noise is measured, which finds five sixths of it
MAX_DRIFT = np.array([0.1] * 3 + [0.5] * 3)  # rad/s, m/s²: plausible sizes of a bias and of its drift
KEPT_MEANS, COMPARED_MEANS = 1000, 100  # of windows at rest: kept by a live detector, and compared with each other
MAX_SHAKING = 1.5  # noise at rest, by that of the calmest stop: white noise scatters to 1.3, idling cars drive with 1.9
REPEATED_RAD_S, OFTEN = 4e-3, 0.05  # means that are alike; share of the commonest's windows that a bias has at least
GAP_PERIODS = 3.0  # a longer step between samples breaks a window

AT_ONCE = 1 << 14  # windows

Batch = tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]  # stamps in ns, gyro, accel
Means = Float64[np.ndarray, "*w 3"]
Positive = Annotated[float, Meta(gt=0)]


class StationarySettings(Settings, frozen=True, kw_only=True):
    """Settings of rest detection: lengths, and caps of a resting sensor."""

    block_s: Positive = 0.1
    window_s: Positive = 1.0
    min_s: Positive = 1.5
    gyro_scatter_rad_s: Positive = 0.0075  # block means over a window, norm of three axes
    accel_scatter_m_s2: Positive = 0.12
    gyro_noise_rad_s: Positive = 0.1  # within blocks; EuRoC's idling motors reach 0.085
    accel_noise_m_s2: Positive = 1.5
    gyro_mean_rad_s: Positive = 0.2  # about gravity; a larger mean is a turn, not a bias (11 degrees a second)
    gyro_bias_rad_s: Positive = 0.7  # about any axis; ITG-3200 40 degrees a second
    gyro_agreement_rad_s: Positive = 0.02  # between a window's mean and the rate at rest
    gyro_trend_rad_s: Positive = 2e-3  # between the means of a window's halves, in addition to four deviations of their noise


USUAL = StationarySettings()


class Blocks(NamedTuple):
    """Block statistics of samples in blocks of `k`: 4 MB per hour at any rate."""

    k: int
    period_s: float
    first_ns: Int64[np.ndarray, " m"]  # stamps of the first and last sample of each block
    last_ns: Int64[np.ndarray, " m"]
    mean: Float64[np.ndarray, "m 6"]  # gyro, then accel
    var: Float64[np.ndarray, "m 6"]  # within the block
    late: Bool[np.ndarray, " m"]  # samples are missing inside or before it


def block_statistics(batches: Iterable[Batch], period_s: float, settings: StationarySettings = USUAL) -> Blocks:
    """Block statistics of batches of samples; an incomplete last block is ignored."""
    k = max(2, round(settings.block_s / period_s))
    parts = [_blocks_of(np.zeros(0, np.int64), np.zeros((0, 6)), k, 0, period_s)]
    t_left, u_left = np.zeros(0, np.int64), np.zeros((0, 6))
    before: int | None = None
    for t_ns, gyro, accel in batches:
        t, u = np.concatenate([t_left, t_ns]), np.concatenate([u_left, np.concatenate([gyro, accel], axis=1)])
        if len(t) >= k:
            whole = len(t) // k * k
            parts.append(_blocks_of(t[:whole], u[:whole], k, int(t[0]) if before is None else before, period_s))
            before = int(t[whole - 1])
            t, u = t[whole:], u[whole:]
        t_left, u_left = t, u
    return Blocks(k, period_s, *(np.concatenate(column) for column in list(zip(*parts, strict=True))[2:]))


def _blocks_of(t_ns: Int64[np.ndarray, " n"], u: Float64[np.ndarray, "n 6"], k: int, before_ns: int, period_s: float) -> Blocks:
    """Block statistics of samples that fill their blocks exactly."""
    t, cut = t_ns.reshape(-1, k), u.reshape(-1, k, 6)
    late = np.diff(t_ns, prepend=np.int64(before_ns)) > nanoseconds(GAP_PERIODS * period_s)
    inside: Bool[np.ndarray, " m"] = np.asarray(late.reshape(-1, k).any(axis=1))
    return Blocks(k, period_s, t[:, 0].copy(), t[:, -1].copy(), np.asarray(cut.mean(axis=1)), cut.var(axis=1, ddof=1), inside)


def rest_stretches(imu: Imu, settings: StationarySettings = USUAL) -> list[tuple[int, int]]:
    """Rest stretches as ordered, disjoint index ranges `[start, end)`; none of too few samples."""
    if len(imu) < 2:
        return []
    parts = (slice(first, first + AT_ONCE) for first in range(0, len(imu), AT_ONCE))
    blocks = block_statistics(((imu.t_ns[s], imu.gyro[s], imu.accel[s]) for s in parts), imu.period_s, settings)
    return [(first * blocks.k, last * blocks.k) for first, last in resting_blocks(blocks, settings)]


def resting_blocks(blocks: Blocks, settings: StationarySettings = USUAL) -> list[tuple[int, int]]:
    """Rest stretches of at least `min_s` as ordered, disjoint ranges `[first, end)` of blocks.

    Window statistics: block means m_j and variances s_j^2 over k samples each; rest when
    std(m) <= max(1.3 sqrt(mean(s^2) / k), 2.5 floor) for the gyro, and all figures are within their caps. The margin of
    1.3 is that of equally noisy axes (`_white_margin`).
    """
    k, period_s, count = blocks.k, blocks.period_s, len(blocks.late)
    width = max(4, round(settings.window_s / (k * period_s)))
    if count < width:
        return []
    gyro_scatter, gyro_variances, gyro_mean = _window_statistics(blocks.mean[:, :3], blocks.var[:, :3], width)
    accel_scatter, accel_variances, accel_mean = _window_statistics(blocks.mean[:, 3:], blocks.var[:, 3:], width)
    gyro_noise, accel_noise = noise = np.sqrt([variances.sum(axis=1) for variances in (gyro_variances, accel_variances)])
    half = width // 2
    halves = np.lib.stride_tricks.sliding_window_view(blocks.mean[:, :3], half, axis=0).mean(axis=-1)
    trend = np.linalg.norm(halves[width - half :] - halves[: len(gyro_scatter)], axis=1)
    calmest = np.sort(gyro_scatter)
    floor = calmest[min(FLOOR_RANK, len(calmest) // 10)]
    allowed = np.maximum(_white_margin(gyro_variances) * gyro_noise / np.sqrt(k), FLOOR_MARGIN * floor)
    rests = (
        (gyro_scatter <= np.minimum(allowed, settings.gyro_scatter_rad_s))
        & (trend <= settings.gyro_trend_rad_s + TREND_DEVIATIONS * gyro_noise * np.sqrt(2.0 / (half * k)))
        & (accel_scatter <= settings.accel_scatter_m_s2)
        & (gyro_noise <= settings.gyro_noise_rad_s)
        & (accel_noise <= settings.accel_noise_m_s2)
        & _may_be_bias(gyro_mean, accel_mean, settings)
        & ~np.lib.stride_tricks.sliding_window_view(blocks.late, width).any(axis=-1)
    )
    if rests.any():  # a turn-on bias does not jump: an outlier among the resting windows is a steady turn
        distance = np.linalg.norm(gyro_mean - _rate_at_rest(gyro_mean[rests], noise[:, rests]), axis=1)
        rests &= distance <= settings.gyro_agreement_rad_s
    resting_blocks = np.zeros(count, bool)
    for shift in range(width):
        resting_blocks[shift : shift + len(rests)] |= rests
    min_ns = nanoseconds(settings.min_s - 2 * period_s)
    return [(a, b) for a, b in true_ranges(resting_blocks) if blocks.last_ns[b - 1] - blocks.first_ns[a] >= min_ns]


class OnlineRestDetector:
    """Online rest detector: the same rule, causally, from block to block.

    The calmest windows and the rate at rest come from the samples so far, not from the whole log. A block holds half
    a window; a longer or shorter block changes the lengths in proportion.
    """

    def __init__(self) -> None:
        self.parts = max(2, round(0.5 * USUAL.window_s / USUAL.block_s))
        self.needed = max(1, round((USUAL.min_s - USUAL.window_s) / (0.5 * USUAL.window_s)) + 1)
        self.blocks_needed = self.needed + 1
        self._last: tuple[Float64[np.ndarray, "parts 6"], Float64[np.ndarray, "parts 6"], int] | None = None
        self._calmest: list[float] = []
        self._means: deque[Float64[np.ndarray, "5"]] = deque(maxlen=KEPT_MEANS)  # and their noise
        self._windows, self._resting = 0, 0

    def __call__(self, gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"], *, whole: bool = True) -> bool:
        """Whether the sensor rests for `min_s` up to the last sample; `whole` if no sample is missing."""
        parts = min(self.parts, len(gyro) // 2)  # fewer below 20 Hz
        if parts < 2 or not whole:
            self._last, self._resting = None, 0
            return False
        k = len(gyro) // parts
        cut = np.concatenate([gyro, accel], axis=1)[: k * parts].reshape(parts, k, 6)
        mean = cut.sum(axis=1) / k
        away = cut - mean[:, None]
        var = np.einsum("pki,pki->pi", away, away) / (k - 1)  # `np.var` takes the mean again
        before, self._last = self._last, (mean, var, k)
        if before is None:
            return False
        rests = self._window(np.concatenate([before[0], mean]), np.concatenate([before[1], var]), min(before[2], k))
        self._resting = self._resting + 1 if rests else 0
        return self._resting >= self.needed

    def _window(self, mean: Float64[np.ndarray, "w 6"], var: Float64[np.ndarray, "w 6"], k: int) -> bool:
        s = USUAL
        whole = mean.sum(axis=0) / len(mean)
        away, centre = mean - whole, whole[:3]
        squares, noises = np.einsum("wi,wi->i", away, away).tolist(), var.sum(axis=0).tolist()
        scatter = [math.sqrt(sum(squares[j : j + 3]) / (len(mean) - 1)) for j in (0, 3)]
        noise = [math.sqrt(sum(noises[j : j + 3]) / len(mean)) for j in (0, 3)]
        insort(self._calmest, scatter[0])
        del self._calmest[FLOOR_RANK + 1 :]
        self._windows += 1
        if scatter[0] > s.gyro_scatter_rad_s or scatter[1] > s.accel_scatter_m_s2:  # nearly always in motion
            return False
        if noise[0] > s.gyro_noise_rad_s or noise[1] > s.accel_noise_m_s2 or not _may_be_bias(centre, whole[3:], s):
            return False
        floor = self._calmest[min(FLOOR_RANK, self._windows // 10)]
        white = float(_white_margin(var[:, :3].sum(axis=0))) * noise[0] / math.sqrt(k)
        half = len(mean) // 2
        trend = float(np.linalg.norm(mean[-half:, :3].sum(axis=0) - mean[:half, :3].sum(axis=0))) / half
        steady = trend <= s.gyro_trend_rad_s + TREND_DEVIATIONS * noise[0] * math.sqrt(2.0 / (half * k))
        if not (scatter[0] <= max(white, FLOOR_MARGIN * floor) and steady):
            return False
        self._means.append(np.array([*centre, *noise]))
        kept = np.array(self._means)
        return bool(np.linalg.norm(centre - _rate_at_rest(kept[:, :3], kept[:, 3:].T)) <= s.gyro_agreement_rad_s)


def _may_be_bias(rate: Means, force: Means, s: StationarySettings) -> Bool[np.ndarray, "*w"]:
    """Whether a constant rate may be a bias: a turn about gravity leaves the force as it is, one aside moves it."""
    aside = np.abs((rate * force).sum(axis=-1)) <= s.gyro_mean_rad_s * np.linalg.norm(force, axis=-1)
    return np.asarray(aside & (np.linalg.norm(rate, axis=-1) <= s.gyro_bias_rad_s))


def _rate_at_rest(means: Float64[np.ndarray, "n 3"], noise: Float64[np.ndarray, "2 n"]) -> Float64[np.ndarray, "3"]:
    """Rate that is the bias among those of windows that look like rest; the others are steady turns.

    A bias repeats from window to window. A turn at a constant rate does so, too, but mostly shakes more, or is faster than a
    bias is large.
    """
    calmest = np.sort(noise, axis=1)[:, min(FLOOR_RANK, len(means) // 10), None]
    calm = means[(noise <= MAX_SHAKING * calmest).all(axis=0)]
    calm = calm if len(calm) else means
    some = calm[:: -(-len(calm) // COMPARED_MEANS)]
    alike = (np.linalg.norm(some[:, None] - some, axis=2) <= REPEATED_RAD_S).sum(axis=1)
    often = some[alike >= OFTEN * alike.max()]
    return np.asarray(often[np.argmin(np.linalg.norm(often, axis=1))])


def white_noise(values: Float64[np.ndarray, "n k"], period_s: float = 0.0) -> Float64[np.ndarray, " k"]:
    """White noise of a sample (standard deviation) from calm second differences.

    The variance of differences of order m is C(2m, m) sigma², with little motion in it. In samples more than `SLOW_S` apart,
    second differences hold the motion of a hand, and sixth ones are taken. The figure is the lower quartile over blocks of
    `NOISE_BLOCK` samples: five sixths of pure white noise. Zero for fewer samples than a block.
    """
    order = 6 if period_s > SLOW_S else 2
    squares = np.diff(values, n=order, axis=0) ** 2 if len(values) > order else values[:0]
    if len(squares) < NOISE_BLOCK:
        return np.zeros(values.shape[1])
    blocks = squares[: len(squares) // NOISE_BLOCK * NOISE_BLOCK].reshape(-1, NOISE_BLOCK, values.shape[1]).mean(axis=1)
    return np.asarray(np.sqrt(quantile(blocks, CALMEST) / math.comb(2 * order, order)))


def nothing_but_noise(x: Float64[np.ndarray, " n"], minimum: float = 0.0) -> bool:
    """Whether means of a signal scatter no more than means of white noise."""
    noise = max(float(white_noise(x[:, None])[0]), minimum)
    sizes = [size for size in (*MEANS, len(x) // MIN_MEANS) if 0 < size <= len(x) // MIN_MEANS]
    means = (x[: len(x) // size * size].reshape(-1, size).mean(axis=1) for size in sizes)
    return all(float(mean.std()) <= TOLERATED_MEAN * noise / np.sqrt(size) for mean, size in zip(means, sizes, strict=True))


def may_rest(imu: Imu) -> bool:
    """Whether a sensor may rest with biases that drift: means of half a second hardly change."""
    samples, count = np.concatenate([imu.gyro, imu.accel], axis=1), min(len(imu), round(0.5 / imu.period_s) + 1)
    means = samples[: len(samples) // count * count].reshape(-1, count, 6).mean(axis=1)
    return bool((np.abs(means - np.median(means, axis=0)) < MAX_DRIFT).all())


def _white_margin(variances: Float64[np.ndarray, "*w 3"]) -> Float64[np.ndarray, "*w"]:
    """Margin of the ratio of block means to white noise.

    It scatters as fewer axes do where one is much noisier than the others: by sqrt(3 sum(s^4)) / sum(s^2) times as much.
    """
    total = np.maximum(variances.sum(axis=-1), MIN_VARIANCE)
    return np.asarray(1.0 + (WHITE_MARGIN - 1.0) * np.sqrt(3.0 * (variances**2).sum(axis=-1)) / total)


def _window_statistics(
    mean: Float64[np.ndarray, "m 3"], var: Float64[np.ndarray, "m 3"], width: int
) -> tuple[Float64[np.ndarray, " w"], Float64[np.ndarray, "w 3"], Float64[np.ndarray, "w 3"]]:
    """Scatter of the block means, variances within blocks, and mean of each window of consecutive blocks."""
    scatter, variances, means = [], [], []
    for first in range(0, len(mean) - width + 1, AT_ONCE):  # numpy needs ten times the memory of its windows
        part = slice(first, first + AT_ONCE + width - 1)
        m = np.lib.stride_tricks.sliding_window_view(mean[part], width, axis=0)
        v = np.lib.stride_tricks.sliding_window_view(var[part], width, axis=0)
        scatter.append(np.sqrt(m.var(axis=-1, ddof=1).sum(axis=1)))
        variances.append(v.mean(axis=-1))
        means.append(m.mean(axis=-1))
    return np.concatenate(scatter), np.concatenate(variances), np.concatenate(means)
