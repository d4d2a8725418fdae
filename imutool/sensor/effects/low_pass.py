"""Bandwidth of the sensor: a first-order low-pass on both, H(s) = w_c / (s + w_c).

`filtered` is any continuous-time filter on an even clock. A filter H(s) of given poles answers samples as D(z) y = N x, D with
the poles' exponentials as its roots. For a signal of frequency w (rad a sample), N = H(jw) D(e^jw): D cancels every pole of H,
so that N is smooth, and a few taps follow it. They minimise relative squares over frequencies up to `BAND` of the sample rate.
Slow frequencies count most: a body moves slowly, and a delay of a hundredth of a sample would look like a clock's offset. Gain
and phase are right to 1e-4 up to a tenth of the sample rate and to 1e-3 up to a quarter (the bilinear transform is off by 27 %
in frequency there, a hold by half a sample).
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq
from scipy.signal import lfilter

from imutool.array_types import Complex128, Float64
from imutool.sensor.effect import Effect, Parameter, Stage, Theta, starts_at
from imutool.sensor.samples import IdealMotion, Vectors

START_HZ = (2.0, 5.0, 10.0, 20.0, 40.0, 80.0)
FORGOTTEN = 4.0  # periods of the cut-off frequency, after which less than 1e-10 of a sample is left
AHEAD, BEHIND = 5, 8  # samples that a tap looks ahead and back: this is no filter for samples as they arrive
BAND = 0.35  # of the sample rate
OMEGA = np.linspace(0.0, 2.0 * np.pi * BAND, 48)  # rad a sample
SLOW, FALL = 0.02, 3  # of half the sample rate, from where on, and by which power of the frequency, relative errors may grow
WEIGHT = 1.0 / (SLOW**FALL + (OMEGA / np.pi) ** FALL)
WAVES = np.exp(-1j * OMEGA[:, None] * np.arange(-AHEAD, BEHIND + 1))


def _forward(motion: IdealMotion, cutoff_hz: Theta) -> IdealMotion:
    """The filter starts settled; an infinite cut-off frequency lets everything pass."""
    if math.isinf(cutoff_hz[0]):
        return motion
    a = 2.0 * math.pi * float(cutoff_hz[0]) / motion.rate_hz  # rad a sample
    gyro, accel, alpha = (slowed(motion, x, _first_order(a)) for x in (motion.gyro, motion.accel, motion.alpha))
    return replace(motion, gyro=gyro, accel=accel, alpha=alpha)


def lag_s(theta: Theta) -> float:
    """Lag (s) far below the cut-off (Hz), of a first order, or of a second by its damping."""
    twice_zeta = 2.0 * float(theta[1]) if len(theta) > 1 else 1.0
    return twice_zeta / (2.0 * math.pi * float(theta[0]))


def smoothed(x: Float64[np.ndarray, "n k"], rate_hz: float, theta: Theta) -> Float64[np.ndarray, "n k"]:
    """Columns with the gain of a low-pass, of first or second order, and without its lag."""
    gain = _Gain.of(len(x), float(theta[0]) / rate_hz, *theta[1:].tolist())
    return np.stack([gain.on(column) for column in x.T], axis=1)


def without_lag(motion: IdealMotion, theta: Theta) -> IdealMotion:
    """Motion with the gain of a low-pass, and without its lag."""
    gain = _Gain.of(len(motion.gyro), float(theta[0]) / motion.rate_hz, *theta[1:].tolist())
    columns = (motion.sampler.behind.changed(x, gain, gain.on) for x in (motion.gyro, motion.accel, motion.alpha))
    gyro, accel, alpha = columns
    return replace(motion, gyro=gyro, accel=accel, alpha=alpha)


class _Gain(NamedTuple):
    """Gain of a low-pass at the frequencies of a column that is mirrored about its ends."""

    margin: int
    length: int
    gain: Float64[np.ndarray, " f"]

    @staticmethod
    @lru_cache(maxsize=8)
    def of(n: int, cutoff: float, zeta: float | None = None) -> _Gain:
        """Gain for n samples, cutoff in cycles a sample; the same object again, by which a motion knows its columns."""
        margin = min(n - 1, math.ceil(FORGOTTEN / (cutoff * min(1.0, zeta or 1.0))))
        length = next_fast_len(n + 2 * margin, real=True)
        x = rfftfreq(length) / cutoff
        return _Gain(margin, length, 1.0 / (np.hypot(1.0, x) if zeta is None else np.hypot(1.0 - x**2, 2.0 * zeta * x)))

    def on(self, x: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        """The column behind the gain."""
        before, after = (
            2.0 * x[end] - x[part] for end, part in ((0, slice(self.margin, 0, -1)), (-1, slice(-2, -self.margin - 2, -1)))
        )
        mean = x.mean()
        y = np.concatenate([before, x, after]) - mean
        return np.asarray(irfft(rfft(y, self.length) * self.gain, self.length)[self.margin : self.margin + len(x)] + mean)


class Filter(NamedTuple):
    """Filter of samples N / D in powers of 1/z.

    The first tap of N is for the sample `AHEAD` samples later.
    """

    taps: Float64[np.ndarray, " _"]
    denominator: Float64[np.ndarray, " d"]

    @classmethod
    def of(cls, gain: Complex128[np.ndarray, " w"], denominator: Float64[np.ndarray, " d"]) -> Filter:
        """Filter of gain H at the frequencies `OMEGA`, with these poles.

        To be kept: two designs differ in the last bits, and a derivative would take that for an effect.
        """
        return cls(_taps(gain * (WAVES[:, AHEAD : AHEAD + len(denominator)] @ denominator)), denominator)


@lru_cache(maxsize=64)
def _first_order(a: float) -> Filter:
    return Filter.of(a / (1j * OMEGA + a), np.array([1.0, -math.exp(-a)]))


def slowed(motion: IdealMotion, x: Vectors, by: Filter) -> Vectors:
    """Columns of a motion behind a filter."""
    return motion.sampler.behind.changed(x, by, lambda column: filtered(column, by))


def filtered(x: Float64[np.ndarray, " n"], by: Filter) -> Float64[np.ndarray, " n"]:
    """Column behind a filter of gain 1 at rest, held constant beyond the ends."""
    n, half = len(x), len(by.taps) // 2
    from_first = np.empty(n + AHEAD)
    np.subtract(x, x[0], out=from_first[:n])
    from_first[n:] = from_first[n - 1]
    driven = np.convolve(from_first, by.taps[:half])[: len(from_first)]  # numpy is quick for up to 11 taps
    driven[half:] += np.convolve(from_first, by.taps[half:])[: len(from_first) - half]
    return np.asarray(lfilter([1.0], by.denominator, driven)[AHEAD:] + x[0])


def _taps(numerator: Complex128[np.ndarray, " w"]) -> Float64[np.ndarray, " taps"]:
    """Taps of N, the first for the sample `AHEAD` samples later."""
    relative = WAVES * (WEIGHT / numerator)[:, None]
    both = np.concatenate([relative.real, relative.imag])
    return np.asarray(np.linalg.lstsq(both, np.concatenate([WEIGHT, np.zeros(len(OMEGA))]), rcond=None)[0])


EFFECT = Effect(
    "low_pass",
    Stage.BANDWIDTH,
    ("gyro", "accel"),
    "d gyro/dt = 2 pi f_c (omega - gyro), and likewise accel",
    (Parameter("f_c", "Hz", 20.0, positive=True, null_value=math.inf),),
    "it moves at frequencies near f_c; a delay alone is a clock_offset",
    _forward,
    linear=False,
    starts=starts_at(*([hz] for hz in START_HZ)),
    lagless=without_lag,
)
