"""Continuous-time filters on an even clock: their own poles, and what a signal without high frequencies makes of their gain.

A filter H(s) of given poles answers samples as D(z) y = N x, D with the poles' exponentials as its roots. For a signal of
frequency w (rad a sample), N = H(jw) D(e^jw): since D cancels every pole of H it is smooth, and a few taps follow it. They are
the least relative squares over frequencies up to `BAND` of the sample rate, slow ones counting by far the most: a body moves
slowly, and a hundredth of a sample by which its motion came late would look like a clock. Gain and phase are right to 1e-4 up
to a tenth of the sample rate and to 1e-3 up to a quarter (the bilinear transform is off by 27 % in frequency there, a hold by
half a sample).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Complex128, Float64
from scipy.signal import lfilter

AHEAD, BEHIND = 5, 8  # samples that a tap looks ahead and back: this is no filter for samples as they arrive
BAND = 0.35  # of the sample rate
OMEGA = np.linspace(0.0, 2.0 * np.pi * BAND, 48)  # rad a sample
SLOW, FALL = 0.02, 3  # of half the sample rate, from where on, and by which power of the frequency, relative errors may grow
WEIGHT = 1.0 / (SLOW**FALL + (OMEGA / np.pi) ** FALL)
WAVES = np.exp(-1j * OMEGA[:, None] * np.arange(-AHEAD, BEHIND + 1))


def filtered(
    x: Float64[np.ndarray, "n k"], gain: Complex128[np.ndarray, " w"], denominator: Float64[np.ndarray, " d"]
) -> Float64[np.ndarray, "n k"]:
    """Columns through a filter of gain 1 at rest, as if they had always been what they are at first, and stayed so at last.

    gain: H at the frequencies `OMEGA`; denominator: D in powers of 1/z.
    """
    taps = _taps(gain * (WAVES[:, AHEAD : AHEAD + len(denominator)] @ denominator))
    from_first = np.concatenate([x, np.repeat(x[-1:], AHEAD, axis=0)]) - x[0]
    y: Float64[np.ndarray, "n k"] = lfilter(taps, denominator, from_first, axis=0)[AHEAD:] + x[0]
    return y


def _taps(numerator: Complex128[np.ndarray, " w"]) -> Float64[np.ndarray, " taps"]:
    """The first of `AHEAD` samples ahead."""
    relative = WAVES * (WEIGHT / numerator)[:, None]
    both = np.concatenate([relative.real, relative.imag])
    return np.asarray(np.linalg.lstsq(both, np.concatenate([WEIGHT, np.zeros(len(OMEGA))]), rcond=None)[0])
