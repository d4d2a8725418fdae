"""Resampling of an even signal by the sampling theorem.

A cubic spline between samples loses motion that is nearly as fast as half of their rate.
"""

from __future__ import annotations

import numpy as np
from scipy.fft import dst, idst
from scipy.signal import periodogram

from imutool.array_types import Float64

AS_GOOD = 2.0  # root of the squares, in units of a recording's noise, that the spline may add to all of its samples
MAX_FACTOR = 8


def refined(x: Float64[np.ndarray, "n k"], noise: Float64[np.ndarray, " k"], count: int) -> Float64[np.ndarray, "m k"]:
    """Samples so dense that a cubic spline through them errs by less than noise hides.

    It errs by too little to show in `count` samples with that noise. Their rate is a multiple of the old one. Old samples
    stay, and nothing is added above half of the old rate. The line from the first sample to the last is taken off before: the
    rest is zero at both ends, and its odd mirror images join smoothly.
    """
    factor = refinement(x, noise, count)
    if factor == 1:
        return x
    line = np.linspace(x[0], x[-1], factor * (len(x) - 1) + 1)
    sines = np.zeros((len(line) - 2, x.shape[1]))
    sines[: len(x) - 2] = factor * dst((x - line[::factor])[1:-1], type=1, axis=0)
    line[1:-1] += idst(sines, type=1, axis=0)
    return np.asarray(line)


def refinement(x: Float64[np.ndarray, "n k"], noise: Float64[np.ndarray, " k"], count: int) -> int:
    """Factor of the rate from which on a cubic spline errs by less than noise hides.

    It errs by too little to show in `count` samples with that noise. It passes a frequency f of a rate r on as sinc(f/r)^4 /
    (2/3 + cos(2 pi f/r) / 3) (Unser, IEEE Signal Processing Magazine 16, 1999), and shows as much as it loses of it at other
    frequencies.
    """
    share, power = periodogram(x, 1.0, "hann", axis=0)
    factor, maximum = 1, AS_GOOD / np.sqrt(count) * noise
    while factor < MAX_FACTOR:
        f = share / factor
        lost = 1.0 - np.sinc(f) ** 4 / (2.0 / 3.0 + np.cos(2.0 * np.pi * f) / 3.0)
        if (np.sqrt(2.0 * (lost**2 @ power) * share[1]) <= maximum).all():
            break
        factor *= 2
    return factor
