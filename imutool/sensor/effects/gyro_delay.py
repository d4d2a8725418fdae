"""Delay of the gyro against the accelerometer, from the filters of one chip.

What delays both is a `clock_offset`. Only a motion that both sensors see tells the two apart. The delay turns the phases of
a spectrum: a spline between samples would take a twelfth from a vibration at a third of the sample rate.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from imutool.array_types import Complex128, Float64
from imutool.sensor.effect import Effect, Parameter, Stage, Theta, starts_at
from imutool.sensor.samples import IdealMotion

MAX_S = 0.3  # of a delay that sets in: slower than any filter of a chip
NEARLY_WHOLE = 1e-30  # of a sample, where 0 / 0 would be the kernel's own 1


def _forward(motion: IdealMotion, tau_s: Theta) -> IdealMotion:
    samples = float(tau_s[0]) * motion.rate_hz
    if samples == 0.0:
        return motion
    by = _Delay.of(len(motion.t_s), samples)
    return replace(motion, gyro=motion.sampler.behind.changed(motion.gyro, by, by.delayed))


class _Delay(NamedTuple):
    """Delay of a column of some length, mirrored at its ends without the ramp between them.

    The mirrored column has period L = 2 n - 2. Its delay by s samples is a convolution with the periodic sinc of even L,
    h(k) = -(-1)^k sin(pi s) / (L tan(pi (k - s) / L)), and as the column is odd, y_i = sum over j of x_j (h(i - j) - h(i + j)).
    Both sums are convolutions of any length from 2 n - 1 on: a transform of length L takes ten times as long where L has a
    large prime factor.
    """

    samples: float
    length: int
    direct: Complex128[np.ndarray, " f"]  # spectrum of h(i - j)
    mirrored: Complex128[np.ndarray, " f"]  # and of h(i + j)

    @staticmethod
    @lru_cache(maxsize=4)
    def of(n: int, samples: float) -> _Delay:
        """Delay of n rows by some samples; the same object again, by which a motion knows its columns behind it."""
        from scipy.fft import next_fast_len, rfft

        length, whole = next_fast_len(2 * n - 1, real=True), round(samples)
        fraction = (samples - whole) or NEARLY_WHOLE
        period = 2 * n - 2
        k = (np.arange(1 - n, n) - whole + period // 2) % period - period // 2
        h = (2.0 * (k % 2) - 1.0) * np.sin(np.pi * fraction) / (period * np.tan(np.pi * (k - fraction) / period))
        near, far = np.zeros(length), np.zeros(length)
        near[:n], near[1 - n :] = h[n - 1 :], h[: n - 1]
        far[:n], far[n : 2 * n - 1] = h[n - 1 :], h[1:n]  # h(k) = h(k - L)
        return _Delay(samples, length, rfft(near), rfft(far))

    def delayed(self, x: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        """The column some samples later."""
        from scipy.fft import irfft, rfft

        ramp = np.linspace(x[0], x[-1], n := len(x))
        slope = (x[-1] - x[0]) / max(n - 1, 1)
        spectrum = rfft(x - ramp, self.length)
        later = irfft(spectrum * self.direct - spectrum.conj() * self.mirrored, self.length)[:n]
        return np.asarray(ramp - slope * self.samples + later)


EFFECT = Effect(
    "gyro_delay",
    Stage.BANDWIDTH,
    ("gyro",),
    "gyro(t) = omega(t - tau)",
    (Parameter("tau", "s", 0.005, maximum=MAX_S),),
    "it turns, and the accelerometer shows the clock",
    _forward,
    linear=False,
    starts=starts_at([0.0]),
)
