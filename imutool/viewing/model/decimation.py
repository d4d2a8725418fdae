"""Lines, paths and spectra with as many points as a drawing shows."""

from __future__ import annotations

import numpy as np

from imutool.array_types import Bool, Float64, Int64
from imutool.geometry import quaternion
from imutool.recording import GAP_FACTOR
from imutool.recording.columns import median, true_ranges

PER_DECADE = 40  # points of a spectrum
LARGEST = 1e300  # of a drawn value: beyond, the limits of an axis overflow
BUCKETS = 400  # of a line at half width; each draws its lowest and its highest sample
MAX_CURVE_ROWS = 300_000  # of a curve that is drawn whole (25 minutes at 200 Hz); an hour would take a viewer over 1 GB
MAX_PATH_ROWS = 20_000  # of a path: a screen has no more pixels along it

Line = Float64[np.ndarray, " n"]
Rows = Int64[np.ndarray, " m"]
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


def curve_rows(values: Float64[np.ndarray, "n k"], maximum: int = MAX_CURVE_ROWS) -> Rows:
    """Decimate a curve to `maximum` rows: per bucket the lowest and highest of every column.

    The first and the last row are always drawn, and of a bucket with NaN rows one such row, so that a hole stays a hole.
    `maximum` is at least 2 k + 3.
    """
    n, columns = values.shape
    if n <= maximum:
        return np.arange(n)
    buckets = max(1, (maximum - 2) // (2 * columns + 1))
    size = -(-n // buckets)
    starts = np.arange(0, n, size)
    drawn, holes = np.zeros(len(starts) * size, dtype=bool), np.zeros((len(starts), size), dtype=bool)
    drawn[[0, n - 1]] = True
    for column in values.T:  # one after the other: contiguous values are searched many times faster
        cut = np.full(len(starts) * size, np.nan)
        cut[:n] = column
        cut = cut.reshape(-1, size)
        hole = np.isnan(cut)
        for extreme, minimum in ((np.inf, np.argmin), (-np.inf, np.argmax)):
            cut[hole] = extreme
            drawn[starts + minimum(cut, axis=1)] = True
        holes |= hole
    drawn[(starts + holes.argmax(axis=1))[np.any(holes, axis=1)]] = True
    rows: Rows = np.flatnonzero(drawn[:n])
    return rows


def path_rows(p_wb: Float64[np.ndarray, "n 3"], maximum: int = MAX_PATH_ROWS) -> Rows:
    """Decimate a path to at most `maximum` rows: half even in time, half even along the path.

    A row left out follows a drawn one by less than 2 / (most - 2) of the path's length and of its rows: a fast part keeps its
    shape, and so does a small part of a path that left for kilometres. The first and the last row are always drawn.
    """
    n = len(p_wb)
    if n <= maximum:
        return np.arange(n)
    edges = range(0, n - 1, quaternion.ROWS_AT_ONCE)
    steps = [quaternion.length(np.diff(p_wb[first : first + quaternion.ROWS_AT_ONCE + 1], axis=0)) for first in edges]
    travelled = np.cumsum(np.concatenate([[0.0], *steps]))
    half = maximum // 2
    finite = np.isfinite(travelled[-1])  # squares of absurd positions overflow: then all rows are even in time
    along = np.searchsorted(travelled, np.linspace(0.0, travelled[-1], half)) if finite else np.zeros(0, np.int64)
    rows: Rows = np.unique(np.concatenate([np.linspace(0, n - 1, maximum - half).round().astype(np.int64), along]))
    return rows
