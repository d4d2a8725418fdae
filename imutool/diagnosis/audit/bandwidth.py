"""Bandwidth of a sensor by its noise: where a filter makes it fall, and how late it is."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.signal import spectrogram

from imutool.array_types import Float64
from imutool.diagnosis.audit.faults import FaultFound, found
from imutool.diagnosis.result import Estimate
from imutool.units import Sensor

BANDS = ((0.2, 0.35), (0.5, 0.65), (0.85, 0.97))  # of Nyquist
FALLS, STEP, WHITE = 0.35, 0.75, 0.75  # of the noise that is left near Nyquist, and from band to band; of white noise
SEGMENT, SHORT = 1024, 32  # samples; a body that never rests is calm between two impacts
FOURTH_ORDER = 0.42  # of the period of its cut-off, by which a Butterworth filter of fourth order is late; of first order 0.16


def most_filter_delay(residual: Float64[np.ndarray, "n 3"], samples: Float64[np.ndarray, "m 3"]) -> float:
    """Most delay (sample periods) of a filter that the noise shows; 0 for white noise.

    Quartiles of short segments are those between two impacts.
    """
    both = []
    for x in (residual, samples):
        f, _, parts = spectrogram(x, 1.0, window="hann", nperseg=min(SHORT, len(x)), axis=0)
        both.append(np.quantile(parts, 0.25, axis=-1))
    sides = [_falls(f, power, 0.5) for power in both]
    if not all(middle * near < FALLS and max(middle, near) < STEP for middle, near in sides):
        return 0.0
    level = both[0][1:].sum(axis=1)
    half = np.flatnonzero(level[:-1] > level.max() / 2.0)
    if not len(half):  # no noise
        return 0.0
    above, below = np.log(2.0 * np.maximum(level[half[-1] : half[-1] + 2] / level.max(), 1e-300))
    return FOURTH_ORDER / float(f[half[-1] + 1] + f[1] * above / (above - min(below, 0.0)))


def bandwidth_faults(
    sensor: Sensor,
    sims: tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "m 3"]],
    sim_hz: float,
    real: Float64[np.ndarray, "k 3"],
    real_hz: float,
) -> Iterator[FaultFound]:
    """White noise near the recording's Nyquist frequency, where the recording's has fallen.

    `sims` are what the motion leaves of the simulation, and all of it: where a body moves in these bands, a fall is that of
    its motion.
    """
    nyquist_hz = min(sim_hz, real_hz) / 2.0
    white = all(middle * near > WHITE for middle, near in (_left(x, sim_hz, nyquist_hz) for x in sims))
    middle, near = _left(real, real_hz, nyquist_hz)
    if white and middle * near < FALLS and max(middle, near) < STEP:
        yield found("bandwidth_absent", sensor, left=Estimate(middle * near, 0.1 * middle * near, "-"))


def _left(x: Float64[np.ndarray, "n 3"], rate_hz: float, nyquist_hz: float) -> tuple[float, float]:
    """Power that is left from band to band, towards a Nyquist frequency, in the calm quarter of a log."""
    f_hz, _, parts = spectrogram(x, rate_hz, window="hann", nperseg=min(SEGMENT, len(x)), axis=0)
    loud = parts[f_hz > BANDS[0][0] * nyquist_hz].sum(axis=0)
    power = np.stack(
        [p[:, q <= np.quantile(q, 0.25)].mean(axis=1) for p, q in zip(parts.swapaxes(0, 1), loud, strict=True)], axis=1
    )
    return _falls(f_hz, power, nyquist_hz)


def _falls(f_hz: Float64[np.ndarray, " f"], power: Float64[np.ndarray, "f 3"], nyquist_hz: float) -> tuple[float, float]:
    """Power that is left from the first to the second of `BANDS`, and from there to the third."""
    low, middle, near = (float(np.median(power[(f_hz > a * nyquist_hz) & (f_hz < b * nyquist_hz)])) for a, b in BANDS)
    return middle / max(low, 1e-300), near / max(middle, 1e-300)
