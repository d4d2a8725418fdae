"""Bandwidth of the sensor: a first-order low-pass on both, H(s) = w_c / (s + w_c).

`filtered` is any continuous-time filter on an even clock. A filter H(s) of given poles answers samples as D(z) y = N x, D with
the poles' exponentials as its roots. For a signal of frequency w (rad a sample), N = H(jw) D(e^jw): D cancels every pole of H,
so that N is smooth, and a few taps follow it. They minimise relative squares over frequencies up to `BAND` of the sample rate.
Slow frequencies count most: a body moves slowly, and a delay of a hundredth of a sample would look like a clock's offset. Gain
and phase are right to 1e-4 up to a tenth of the sample rate and to 1e-3 up to a quarter (the bilinear transform is off by 27 %
in frequency there, a hold by half a sample).

A digital filter, made by that bilinear transform at its own `rate` and with the cut-off frequency kept (as by
`scipy.signal.butter`), answers a frequency f as the analog one does f_c tan(pi f / rate) / tan(pi f_c / rate): H is 0 at half
of its rate. Samples of another rate see it by its frequencies. An `order` n is that of a Butterworth filter. Order 0
is the mean of the last T seconds, f_c = 0.443 / T, and at a rate that of the last T rate samples.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

from imutool.array_types import Complex128, Float64, Vectors
from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.samples import IdealMotion, SensorSamples
from imutool.units import SENSORS, Sensor

MAX = 0.4999  # cycles a sample of a digital filter: its gain is 0 at a half
START_HZ = (2.0, 5.0, 10.0, 20.0, 40.0, 80.0)
FORGOTTEN = 4.0  # periods of the cut-off frequency, after which less than 1e-10 of a sample is left
AHEAD, BEHIND = 5, 8  # samples that a tap looks ahead and back: this is no filter for samples as they arrive
BAND = 0.35  # of the sample rate
OMEGA = np.linspace(0.0, 2.0 * np.pi * BAND, 48)  # rad a sample
SLOW, FALL = 0.02, 3  # of half the sample rate, from where on, and by which power of the frequency, relative errors may grow
WEIGHT = 1.0 / (SLOW**FALL + (OMEGA / np.pi) ** FALL)
RATE = Parameter("rate", "Hz", 200.0, positive=True, null_value=math.inf)  # of a digital filter
ORDER = Parameter("order", "-", 1.0, null_value=1.0)  # of a Butterworth filter; 0: a moving average
SMOOTHING = Parameter("smoothing_rate", "Hz", 200.0, positive=True, null_value=math.inf)  # of y += k (x - y) at each sample
CHIP_HZ = 1000.0  # at which a sensor filters at least (MPU-6050 and ICM-20948: 1 kHz to 1.1 kHz; BMI160: 1.6 kHz)
AVERAGE = 0.4429  # f_c T of a moving average: there it has lost half of the power
WAVES = np.exp(-1j * OMEGA[:, None] * np.arange(-AHEAD, BEHIND + 1))


def _forward(motion: IdealMotion, theta: Theta) -> IdealMotion:
    """f_c (Hz), the rate of a digital filter, the order, and the rate of exponential smoothing; it starts settled."""
    if math.isinf(theta[0]):
        return motion
    design = _design(theta)
    if math.isfinite(min(design.rate_hz, design.smoothing_hz)) or design.order != 1.0:
        return behind_gain(motion, design, lag=True)
    a = 2.0 * math.pi * float(theta[0]) / motion.rate_hz  # rad a sample
    gyro, accel, alpha = (slowed(motion, x, _first_order(a)) for x in (motion.gyro, motion.accel, motion.alpha))
    return replace(motion, gyro=gyro, accel=accel, alpha=alpha)


class Design(NamedTuple):
    """Design of a low-pass: of second order if it has a damping, digital if it has a rate.

    Exponential smoothing, y += k (x - y) with k = 1 - exp(-2 pi f_c / rate), lags by half a sample less than the analog filter.
    Of second order it is two in a row, whose poles are the exponentials of the analog ones.
    """

    cutoff_hz: float
    zeta: float | None = None
    rate_hz: float = math.inf
    order: float = 1.0
    smoothing_hz: float = math.inf

    @classmethod
    def of(cls, effect: Effect, theta: Theta) -> Design:
        """Design of an effect of this or of second order."""
        values = dict(zip((parameter.name for parameter in effect.parameters), theta.tolist(), strict=True))
        values |= {parameter.name: value for parameter, value in effect.constants}
        rates = (values.get(rate.name, math.inf) for rate in (RATE, SMOOTHING))
        return cls(float(theta[0]), values.get("zeta"), next(rates), values.get(ORDER.name, 1.0), next(rates))

    @property
    def kept(self) -> Complex128[np.ndarray, " order"]:
        """What exponential smoothing keeps of the sample before, by pole."""
        faster = 1.0 if self.zeta is None else self.zeta + cmath.sqrt(self.zeta**2 - 1.0)
        poles = np.array([-faster, -1.0 / faster][: 1 if self.zeta is None else 2], complex)
        return np.asarray(np.exp(2.0 * np.pi * self.cutoff_hz / self.smoothing_hz * poles))

    @property
    def lag_s(self) -> float:
        """Lag far below the cut-off."""
        if not self.order:
            return 0.5 * (AVERAGE / self.cutoff_hz - (1.0 / self.rate_hz if math.isfinite(self.rate_hz) else 0.0))
        if math.isfinite(self.smoothing_hz):
            return float((self.kept / (1.0 - self.kept)).real.sum()) / self.smoothing_hz
        twice_zeta = float(-self.poles.real.sum()) if self.zeta is None else 2.0 * self.zeta
        cutoff = math.pi * self.cutoff_hz
        if math.isfinite(self.rate_hz):
            cutoff = self.rate_hz * math.tan(min(cutoff / self.rate_hz, math.pi * MAX))
        return 0.5 * twice_zeta / cutoff

    @property
    def digital_share(self) -> float:
        """Relative error of the cut-off if the filter is digital, of a chip's rate: slow motion shows its lag alone."""
        if math.isfinite(min(self.rate_hz, self.smoothing_hz)):
            return 0.0
        cycles = min(self.cutoff_hz / CHIP_HZ, 0.25)  # a sample
        return cycles / AVERAGE if not self.order else (math.pi * cycles) ** 2 / 3.0

    @property
    def poles(self) -> Complex128[np.ndarray, " order"]:
        """Poles of a Butterworth filter with a cut-off of one rad/s."""
        n = round(self.order)
        return np.asarray(np.exp(0.5j * np.pi * (2.0 * np.arange(1, n + 1) + n - 1.0) / n))

    def answer(self, f_hz: Float64[np.ndarray, " f"]) -> Complex128[np.ndarray, " f"]:
        """What it makes of a wave of one, by frequency."""
        if not self.order:
            window_s = AVERAGE / self.cutoff_hz
            own = np.sinc(np.clip(f_hz / self.rate_hz, 0.0, 0.5))  # of a mean of samples, up to half of their rate
            return np.asarray(np.sinc(f_hz * window_s) / own * np.exp(-2j * np.pi * f_hz * self.lag_s))
        if math.isfinite(self.smoothing_hz):
            one_later = np.exp(-2j * np.pi * f_hz / self.smoothing_hz)[:, None]
            return np.asarray(np.prod((1.0 - self.kept) / (1.0 - self.kept * one_later), axis=1))
        x = f_hz / self.cutoff_hz
        if math.isfinite(self.rate_hz):
            x = _folded_tan(f_hz / self.rate_hz) / math.tan(math.pi * min(self.cutoff_hz / self.rate_hz, MAX))
        if self.zeta is not None:
            return np.asarray(1.0 / (1.0 - x**2 + 2j * self.zeta * x))
        return np.asarray(1.0 / np.prod(1.0 - 1j * x[:, None] / self.poles, axis=1))


def smoothed(x: Float64[np.ndarray, "n k"], rate_hz: float, design: Design) -> Float64[np.ndarray, "n k"]:
    """Columns with the gain of a low-pass, and without its lag."""
    gain = _Gain.of(len(x), rate_hz, design)
    return np.stack([gain.on(column) for column in x.T], axis=1)


def behind_gain(motion: IdealMotion, design: Design, *, lag: bool) -> IdealMotion:
    """Motion behind a low-pass by its frequencies, with its lag or without."""
    gain = _Gain.of(len(motion.gyro), motion.rate_hz, design, lag=lag)
    columns = (motion.sampler.behind.changed(x, gain, gain.on) for x in (motion.gyro, motion.accel, motion.alpha))
    gyro, accel, alpha = columns
    return replace(motion, gyro=gyro, accel=accel, alpha=alpha)


def _without_lag(motion: IdealMotion, theta: Theta) -> IdealMotion:
    return behind_gain(motion, _design(theta), lag=False)


def _design(theta: Theta) -> Design:
    return Design(float(theta[0]), None, *theta[1:].tolist())


def _folded_tan(f: Float64[np.ndarray, "..."]) -> Float64[np.ndarray, "..."]:
    """tan(pi f), f in cycles a sample of a filter, to which whole numbers are alike."""
    return np.asarray(np.tan(np.pi * np.clip(f - np.round(f), -MAX, MAX)))


class _Gain(NamedTuple):
    """Gain of a low-pass at the frequencies of a column that is mirrored about its ends."""

    margin: int
    length: int
    gain: Float64[np.ndarray, " f"] | Complex128[np.ndarray, " f"]

    @staticmethod
    @lru_cache(maxsize=8)
    def of(n: int, rate_hz: float, design: Design, *, lag: bool = False) -> _Gain:
        """Gain for n samples; the same object again, by which a motion knows its columns."""
        damping = design.zeta or float(np.min(-design.poles.real, initial=1.0))
        margin = min(n - 1, math.ceil(FORGOTTEN * rate_hz / (design.cutoff_hz * min(1.0, damping))))
        length = next_fast_len(n + 2 * margin, real=True)
        answer = design.answer(rfftfreq(length) * rate_hz)
        return _Gain(margin, length, answer if lag else np.abs(answer))

    def on(self, x: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        """The column behind the gain."""
        before, after = (
            2.0 * x[end] - x[part] for end, part in ((0, slice(self.margin, 0, -1)), (-1, slice(-2, -self.margin - 2, -1)))
        )
        mean = x.mean()
        y = np.concatenate([before, x, after]) - mean
        return np.asarray(irfft(rfft(y, self.length) * self.gain, self.length)[self.margin : self.margin + len(x)] + mean)


class Filter(NamedTuple):
    """Filter of samples N / D in powers of 1/z."""

    taps: Float64[np.ndarray, " _"]  # the first is for the sample `AHEAD` samples later
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
    from scipy.signal import lfilter  # half a second, in a simulation without this effect too

    return np.asarray(lfilter([1.0], by.denominator, driven)[AHEAD:] + x[0])


def _taps(numerator: Complex128[np.ndarray, " w"]) -> Float64[np.ndarray, " taps"]:
    """Taps of N, the first for the sample `AHEAD` samples later."""
    relative = WAVES * (WEIGHT / numerator)[:, None]
    both = np.concatenate([relative.real, relative.imag])
    return np.asarray(np.linalg.lstsq(both, np.concatenate([WEIGHT, np.zeros(len(OMEGA))]), rcond=None)[0])


def digital_starts(
    *analog: Sequence[float], order: Sequence[float] = ()
) -> Callable[[IdealMotion, SensorSamples], Sequence[Theta]]:
    """Starts of a digital filter that runs at the rate of the samples."""

    def starts(_motion: IdealMotion, samples: SensorSamples) -> Sequence[Theta]:
        rate_hz = 1.0 / float(np.median(np.diff(samples.stamp_s)))
        return [np.array([*theta, rate_hz, *order]) for theta in analog]

    return starts


def of_one(effect: Effect, sensor: Sensor) -> Effect:
    """A low-pass of one sensor alone: many chips have a filter for each."""

    def alone(change: Callable[[IdealMotion, Theta], IdealMotion]) -> Callable[[IdealMotion, Theta], IdealMotion]:
        def changed(motion: IdealMotion, theta: Theta) -> IdealMotion:
            x = motion.gyro if sensor == "gyro" else motion.accel
            y = change(replace(motion, gyro=x, accel=x, alpha=x), theta).gyro  # the same array, so that it is filtered once
            return replace(motion, gyro=y) if sensor == "gyro" else replace(motion, accel=y)

        return changed

    assert effect.lagless is not None, "a low-pass has a lag"
    alone_lagless = alone(effect.lagless)
    return replace(effect, variant=sensor, sensors=(sensor,), forward=alone(effect.forward), lagless=alone_lagless)


def of_signal(effect: Effect, signal: str) -> Effect:
    """A low-pass of the one sensor that a signal names; any other effect itself."""
    sensor = next((name for name in SENSORS if name == signal), None)
    return effect if effect.lagless is None or sensor is None else of_one(effect, sensor)


EFFECT = Effect(
    "low_pass",
    Stage.BANDWIDTH,
    ("gyro", "accel"),
    "d gyro/dt = 2 pi f_c (omega - gyro), and likewise accel (at a rate: bilinear)",
    (Parameter("f_c", "Hz", 20.0, positive=True, null_value=math.inf), RATE, ORDER, SMOOTHING),
    "it moves at frequencies near f_c; a delay alone is a clock_offset",
    _forward,
    linear=False,
    starts=digital_starts(*([hz] for hz in START_HZ), order=[1.0, SMOOTHING.plausible]),
    lagless=_without_lag,
)
