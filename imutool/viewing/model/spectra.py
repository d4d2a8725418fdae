"""Power spectral densities of what an IMU measured, by Welch's method (scipy)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Float64
from scipy.signal import welch

from imutool.recording import Imu

WINDOW_S = 8.0  # the longest: an eighth of a hertz can be told apart
FEWEST = 64  # samples in a window, below which there is no spectrum


@dataclass(frozen=True, eq=False)
class Spectrum:
    """One-sided density of each axis, in the signal's unit squared per Hz."""

    frequency_hz: Float64[np.ndarray, " k"]
    density: Float64[np.ndarray, "k 3"]


def spectra(imu: Imu) -> Mapping[str, Spectrum]:
    """`gyro` ((rad/s)²/Hz) and `accel` ((m/s²)²/Hz); empty for a log too short to have one.

    Samples are taken as evenly spaced by their median period, so that jitter and gaps blur lines a little.
    """
    if len(imu) < FEWEST:
        return MappingProxyType({})
    rate_hz = 1.0 / imu.period_s
    length = min(len(imu), max(FEWEST, round(WINDOW_S * rate_hz)))
    found = {}
    for kind, values in (("gyro", imu.gyro), ("accel", imu.accel)):
        along = np.ascontiguousarray(values.T)  # twice as fast
        frequency_hz, density = welch(along, rate_hz, nperseg=length, detrend="constant")
        found[kind] = Spectrum(frequency_hz[1:], density.T[1:])  # what does not change is no part of a spectrum
    return MappingProxyType(found)
