"""Noise file (noise.toml) of a diagnosis: what its findings leave, with its spectrum.

`simulate --noise` takes it. The samples of the recording less those expected with all findings: noise of the sensor, vibration,
and the motion that the reference does not know. A twin of the sensor has them all.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64

from imutool.diagnosis.estimation.whitening import burg
from imutool.diagnosis.result import Diagnosis
from imutool.noise.datasheet import Axes, Colour, Filters, Levels, Noise
from imutool.units import SENSORS

ORDER = 40  # of the autoregression: lines of a vibration need many
WINDOW_S = 1.0  # over which the size of the noise comes and goes
QUANTILES = 11


def to_noise_file(d: Diagnosis) -> Noise | None:
    """Noise with its colour, of all logs; None without samples of an IMU that vary."""
    if not d.traces:
        return None
    rate_hz = 1.0 / float(np.median([np.median(np.diff(trace.t_s)) for trace in d.traces]))
    gap = np.full((1, 6), np.nan)
    left = np.concatenate([part for trace in d.traces for part in (trace.real - trace.after, gap)])
    known = np.isfinite(left)
    left = np.where(known, left, 0.0) - np.nanmean(left, axis=0)
    std = np.sqrt((left**2 * known).sum(axis=0) / known.sum(axis=0))
    if not (std > 0.0).all():
        return None
    filters = [tuple(burg(left[:, k], known[:, k], ORDER)[1:].tolist()) for k in range(6)]
    levels = [_levels((left / std)[:, part], known[:, part], rate_hz) for part in (slice(0, 3), slice(3, 6))]
    names = ", ".join(trace.log for trace in d.traces)
    return Noise(
        gyro_density=_axes(std[:3] / np.sqrt(rate_hz)),
        accel_density=_axes(std[3:] / np.sqrt(rate_hz)),
        sources={f"{sensor}_density": f"what the findings leave of {names}" for sensor in SENSORS},
        colour=Colour(
            rate_hz=rate_hz,
            window_s=WINDOW_S,
            gyro=_filters(filters[:3]),
            accel=_filters(filters[3:]),
            gyro_levels=levels[0],
            accel_levels=levels[1],
        ),
    )


def _levels(x: Float64[np.ndarray, "n 3"], known: Bool[np.ndarray, "n 3"], rate_hz: float) -> Levels:
    """Quantiles of the local size, over the size of all."""
    count = max(2, round(WINDOW_S * rate_hz))
    windows = x[: len(x) // count * count].reshape(-1, count, 3)
    whole = known[: len(windows) * count].reshape(-1, count, 3).all(axis=(1, 2))
    if not whole.any():
        return (1.0, 1.0)
    size = np.sqrt((windows[whole] ** 2).mean(axis=(1, 2)))
    return tuple(np.quantile(size, np.linspace(0.0, 1.0, QUANTILES)).tolist())


def _axes(values: Float64[np.ndarray, "3"]) -> Axes:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _filters(rows: list[tuple[float, ...]]) -> Filters:
    x, y, z = rows
    return x, y, z
