"""Up to which frequency the poses know the motion: where their own errors stand out, what is expected is wrong, not the sensor.

Poses come smoothed by whoever made them, and with errors that a second derivative makes large. An error of what is expected
does two things together: the recording shares less of it (coherence), and follows it with a gain that is too small by as much
(regression dilution; Fuller, Measurement Error Models, 1987, eq. 1.1.7: gain = true gain x reliability), which passes for a
scale. Noise of the sensor lowers the coherence alone, a sensor too slow the gain alone.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from jaxtyping import Float64
from scipy.signal import csd, welch

SEGMENT_S = 4.0
EDGES_HZ = (0.5, 0.8, 1.25, 2.0, 3.0, 4.5, 6.5, 9.0, 13.0, 18.0, 25.0)  # bands that are looked at, slow to fast
DILUTED = 0.04  # share of what is expected that is its own error, from which on it is not known
SURE = 3.0  # standard deviations of a gain (Bendat and Piersol, Random Data, 4th ed., eq. 9.89) beyond that
LEAST_HZ = 1.25  # below, nothing would be left to look at


def known_band_hz(real: Float64[np.ndarray, "m 6"], left: Float64[np.ndarray, "m 6"], rate_hz: float, most_hz: float) -> float:
    """The frequency (Hz, up to `most_hz`) below which hardly any of what is expected is an error of the poses.

    `left` is what a rich model of the sensor leaves of what is read; what is expected is the rest.
    """
    there, size = real - left, min(int(SEGMENT_S * rate_hz), len(left))
    f_hz, power = welch(there, rate_hz, nperseg=size, axis=0)
    _, read = welch(real, rate_hz, nperseg=size, axis=0)
    _, both = csd(there, real, rate_hz, nperseg=size, axis=0)
    duration_s = len(left) / rate_hz
    for low, high in pairwise(EDGES_HZ):
        if low >= most_hz:
            break
        band = (f_hz >= low) & (f_hz < high)
        for part in (slice(0, 3), slice(3, 6)):
            e, r, x = (float(abs(one[band, part].sum())) for one in (power, read, both))
            gain, coherence = x / e, x * x / (e * r)
            unsure = np.sqrt((1.0 - coherence) / (2.0 * 3.0 * duration_s * (high - low))) * np.sqrt(r / e)
            if low >= LEAST_HZ and min(1.0 - gain - SURE * unsure, 1.0 - coherence) > DILUTED:
                return low
    return most_hz
