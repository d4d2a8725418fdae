"""Decimate curves and paths for drawing without losing a visible detail."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64

MAX_CURVE_ROWS = 300_000  # of a curve that is drawn whole (25 minutes at 200 Hz); an hour would take a viewer over 1 GB
MAX_PATH_ROWS = 20_000  # of a path: a screen has no more pixels along it

Rows = Int64[np.ndarray, " m"]


def curve_rows(values: Float64[np.ndarray, "n k"], most: int = MAX_CURVE_ROWS) -> Rows:
    """Decimate a curve to `most` rows: per bucket the lowest and highest of every column.

    The first and the last row are always drawn, and of a bucket with NaN rows one such row, so that a hole stays a hole.
    `most` is at least 2 k + 3.
    """
    n, columns = values.shape
    if n <= most:
        return np.arange(n)
    buckets = max(1, (most - 2) // (2 * columns + 1))
    size = -(-n // buckets)
    starts = np.arange(0, n, size)
    padded = np.full((columns, len(starts) * size), np.nan)  # by column: contiguous values are searched many times faster
    padded[:, :n] = values.T
    cut = padded.reshape(columns, len(starts), size)
    hole = np.isnan(cut)
    drawn = np.zeros(padded.shape[1], dtype=bool)
    drawn[[0, n - 1]] = True
    for least in (np.where(hole, np.inf, cut).argmin(axis=2), np.where(hole, -np.inf, cut).argmax(axis=2)):
        drawn[starts + least] = True
    holes = np.any(hole, axis=0)
    drawn[(starts + holes.argmax(axis=1))[np.any(holes, axis=1)]] = True
    rows: Rows = np.flatnonzero(drawn[:n])
    return rows


def path_rows(p_wb: Float64[np.ndarray, "n 3"], most: int = MAX_PATH_ROWS) -> Rows:
    """Decimate a path to at most `most` rows: half even in time, half even along the path.

    A row left out follows a drawn one by less than 2 / (most - 2) of the path's length and of its rows: a fast part keeps its
    shape, and so does a small part of a path that left for kilometres. The first and the last row are always drawn.
    """
    n = len(p_wb)
    if n <= most:
        return np.arange(n)
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p_wb, axis=0), axis=1))])
    half = most // 2
    along = np.searchsorted(travelled, np.linspace(0.0, travelled[-1], half))
    rows: Rows = np.unique(np.concatenate([np.linspace(0, n - 1, most - half).round().astype(np.int64), along]))
    return rows
