"""Which rows of a long curve or path to draw, so that nothing a person would see is lost."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64

MOST = 2_000_000  # rows of a curve: up to here it is drawn whole (two hours and three quarters at 200 Hz)
MOST_IN_3D = 20_000  # rows of a path: the screen has no more pixels along it

Rows = Int64[np.ndarray, " m"]


def curve_rows(values: Float64[np.ndarray, "n k"], most: int = MOST) -> Rows:
    """Rows of a curve to draw, at most `most`, in order: all, or of equal buckets the lowest and highest of every column.

    The first and the last row are always among them; of a bucket with rows that are not a number one such row, so that a hole
    stays a hole. `most` is at least 2 k + 3.
    """
    n, columns = values.shape
    if n <= most:
        return np.arange(n)
    buckets = max(1, (most - 2) // (2 * columns + 1))
    size = -(-n // buckets)
    starts = np.arange(0, n, size)
    chosen = [np.array([0, n - 1])]
    padded = np.full((len(starts) * size, columns), np.nan)
    padded[:n] = values
    cut = padded.reshape(len(starts), size, columns)
    hole = np.isnan(cut)
    for of, least in ((cut, np.inf), (-cut, np.inf)):
        of = np.where(hole, least, of)
        chosen.append((starts[:, None] + of.argmin(axis=1)).ravel())
    holes = hole.any(axis=2)
    chosen.append((starts + holes.argmax(axis=1))[holes.any(axis=1)])
    rows: Rows = np.unique(np.concatenate(chosen))
    return rows[rows < n]


def path_rows(p_wb: Float64[np.ndarray, "n 3"], most: int = MOST_IN_3D) -> Rows:
    """Rows of a path to draw, at most `most`, in order: all, or half of them even in time and half even along the path.

    So a row left out follows one that is drawn by less than 2 / (most - 2) of the path's length and of its rows: a fast stretch
    keeps its shape, and so does a small one beside a path that left for kilometres. The first and the last row are always among
    them.
    """
    n = len(p_wb)
    if n <= most:
        return np.arange(n)
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p_wb, axis=0), axis=1))])
    half = most // 2
    along = np.searchsorted(travelled, np.linspace(0.0, travelled[-1], half))
    rows: Rows = np.unique(np.concatenate([np.linspace(0, n - 1, most - half).round().astype(np.int64), along]))
    return rows
