"""Lines and spectra with as many points as a drawing shows."""

from __future__ import annotations

import numpy as np

from imutool.array_types import Bool, Float64
from imutool.recording import GAP_FACTOR
from imutool.recording.columns import median, true_ranges

PER_DECADE = 40  # points of a spectrum
LARGEST = 1e300  # of a drawn value: beyond, the limits of an axis overflow
BUCKETS = 400  # of a line at half width; each draws its lowest and its highest sample

Line = Float64[np.ndarray, " n"]
DecimatedLine = Float64[np.ndarray, " m"]  # shorter than the line it comes from


def decimate_extremes(t: Line, y: Line, buckets: int = BUCKETS) -> tuple[DecimatedLine, DecimatedLine]:
    """Decimate a line to the lowest and highest sample of each bucket; gaps stay gaps.

    Where samples are missing for longer than half a bucket, a NaN breaks the line: a straight one would pass for samples.
    """
    y = np.clip(y, -LARGEST, LARGEST)
    step = np.diff(t)
    longer = max(GAP_FACTOR * median(step), np.sum(step) / (2 * buckets)) if len(step) else 0.0
    gaps = np.flatnonzero(step > longer)
    keep = np.arange(len(t))
    if len(t) > 2 * buckets:
        edges = np.linspace(0, len(t), buckets + 1).astype(int)
        values = y[np.minimum(edges[:-1, None] + np.arange(np.diff(edges).max()), edges[1:, None] - 1)]
        known = ~np.isnan(values)
        lowest, highest = np.where(known, values, np.inf).argmin(axis=1), np.where(known, values, -np.inf).argmax(axis=1)
        keep = np.union1d(np.where(known.any(axis=1), [lowest, highest], 0) + edges[:-1], [*gaps, *(gaps + 1)]).astype(int)
    at = np.searchsorted(keep, gaps) + 1
    return np.insert(t[keep], at, (t[gaps] + t[gaps + 1]) / 2.0), np.insert(y[keep], at, np.nan)


def decimate_angle(t: Line, angle_deg: Line) -> tuple[DecimatedLine, DecimatedLine]:
    """Decimate an angle (deg), with a break where it goes on from 180° at -180°.

    A line from top to bottom would pass for a turn back.
    """
    wraps = np.flatnonzero(np.abs(np.diff(angle_deg)) > 180.0) + 1
    buckets = max(1, BUCKETS // (len(wraps) + 1))
    parts = [decimate_extremes(*part, buckets) for part in zip(np.split(t, wraps), np.split(angle_deg, wraps), strict=True)]
    ends = [(part[0][-1:], np.array([np.nan])) for part in parts]
    times, angles = zip(*(piece for pair in zip(parts, ends, strict=True) for piece in pair), strict=True)
    return np.concatenate(times), np.concatenate(angles)


def true_intervals(t: Line, mask: Bool[np.ndarray, " n"]) -> list[tuple[float, float]]:
    """Intervals of time in which a mask is true."""
    return [(float(t[first]), float(t[end - 1])) for first, end in true_ranges(mask)]


def average_log_bins(
    frequency_hz: Line, power: Float64[np.ndarray, " n *k"], lowest_hz: float
) -> tuple[DecimatedLine, Float64[np.ndarray, " m *k"]]:
    """Average a spectrum in forty bins a decade above `lowest_hz`.

    Without it, noise at high frequencies would draw a band instead of a line.
    """
    decade = np.round(PER_DECADE * np.log10(frequency_hz / lowest_hz)).astype(int)
    starts = np.flatnonzero(np.diff(decade, prepend=decade[0] - 1))
    count = np.diff(np.append(starts, len(decade)))
    sums = np.add.reduceat(power, starts, axis=0)
    return np.add.reduceat(frequency_hz, starts) / count, sums / count.reshape(-1, *[1] * (power.ndim - 1))
