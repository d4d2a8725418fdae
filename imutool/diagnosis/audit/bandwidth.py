"""Bandwidth of a sensor by its noise: where a filter makes it fall, and how late it is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.signal import spectrogram

from imutool.array_types import Float64, Vectors
from imutool.diagnosis.audit.faults import FaultFound, clear, found
from imutool.diagnosis.audit.motion import KinematicFit, kinematic_fit, kinematics
from imutool.diagnosis.result import Estimate
from imutool.recording import Recording
from imutool.units import COLUMNS, Sensor

BANDS = ((0.2, 0.35), (0.5, 0.65), (0.85, 0.97))  # of Nyquist
FALLS, STEP, WHITE = 0.35, 0.75, 0.75  # of the noise that is left near Nyquist, and from band to band; of white noise
SEGMENT, SHORT = 1024, 32  # samples; a body that never rests is calm between two impacts
MEAN_BAND = 0.3  # by which a curvature may differ from that of a mean; of a filter of first order it is three times as large
WINDOW_BINS = 0.5  # by which a Hann window moves a cut-off up
FOURTH_ORDER = 0.42  # of the period of its cut-off, by which a Butterworth filter of fourth order is late; of first order 0.16


def max_filter_delays(sim: Recording, fit: KinematicFit) -> tuple[float, float]:
    """Most delays (sample periods) of the sensors' filters, by their noise; 0 for white noise.

    A residual counts where the poses come as late as the sensor does: what a delay of all frequencies leaves is no noise, nor
    is what a mean leaves, as a difference of attitudes is one.
    """
    out = []
    for name, samples, part in (("tau_g", sim.imu.gyro, COLUMNS["gyro"]), ("tau_f", sim.imu.accel, COLUMNS["accel"])):
        late, residual = fit.estimates[name], fit.residual[:, part]
        if clear(late):
            k = kinematics(replace(sim, imu=replace(sim.imu, t_ns=sim.imu.t_ns - round(late.value * 1e9))))
            then = kinematic_fit(k)
            residual, rate = then.residual[:, part], k.rates()[then.frames[0]]
            if name == "tau_g" and _is_mean(residual, rate, k.t_s, late.value):
                out.append(0.0)
                continue
        out.append(max_filter_delay(residual, samples))
    return out[0], out[1]


def _is_mean(residual: Vectors, rate: Vectors, t_s: Float64[np.ndarray, " n"], late_s: float) -> bool:
    """Whether a residual is what a mean of the rate over twice its delay leaves: tau^2 / 6 of the rate's curvature."""
    rate = rate - rate.mean(axis=0)
    bent = np.gradient(np.gradient(rate, t_s, axis=0), t_s, axis=0)
    residual, bent = (x - x.mean(axis=0) - rate * (x * rate).sum() / (rate**2).sum() for x in (residual, bent))
    size = float((residual * bent).sum() / (bent**2).sum())
    explained = size * float((residual * bent).sum()) / max(float((residual**2).sum()), 1e-300)
    return explained > 0.5 and abs(6.0 * size / late_s**2 - 1.0) < MEAN_BAND


def max_filter_delay(residual: Vectors, samples: Float64[np.ndarray, "m 3"]) -> float:
    """Most delay (sample periods) of a filter that the noise shows; 0 for white noise."""
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
    bins = half[-1] + 1 + above / (above - min(below, 0.0))
    return FOURTH_ORDER / float(f[1] * (bins - WINDOW_BINS))


def bandwidth_faults(
    sensor: Sensor,
    sims: tuple[Vectors, Float64[np.ndarray, "m 3"]],
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


def _left(x: Vectors, rate_hz: float, nyquist_hz: float) -> tuple[float, float]:
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
