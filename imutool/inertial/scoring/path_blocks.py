"""True poses and integrated paths along the samples of an IMU, a block at a time.

A path is integrated again wherever it is read: an hour at 200 Hz would take 115 MB with its true poses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from imutool.array_types import Bool, Int64
from imutool.errors import DataError
from imutool.inertial.kinematics import trapezoidal
from imutool.inertial.strapdown import StartPose, dead_reckon
from imutool.recording import GAP_FACTOR, MIN_GAP_S, Imu, Poses, Times

AT_ONCE = 1 << 13  # samples, whose arrays stay in the cache
Mask = Bool[np.ndarray, " n"]
Windows = Int64[np.ndarray, "m 2"]  # first and last rows


class PathBlock(NamedTuple):
    """Consecutive poses of an estimate and of the truth, and a mask of the rows with truth."""

    estimate: Poses
    truth: Poses
    valid: Mask

    def scored(self) -> tuple[Poses, Poses]:
        """Both at the rows with truth.

        Raises:
            DataError: their stamps differ.
        """
        estimate, truth, valid = self
        if not np.array_equal(estimate.t_ns, truth.t_ns) or len(valid) != len(truth):
            raise DataError(
                f"an estimate of {len(estimate)}, a truth of {len(truth)} poses and a mask of {len(valid)} do not match",
                expected="the same stamps (Poses.at)",
            )
        return (estimate, truth) if valid.all() else (estimate.rows(valid), truth.rows(valid))


PathBlocks = Callable[[], Iterator[PathBlock]]  # the blocks of a path, from its start at each call


class WindowPiece(NamedTuple):
    """Path and truth over some windows, whose first and last rows are those of the path."""

    path: Poses
    truth: Poses
    windows: Windows


class TrueSpan:
    """True poses at stamps, from the first stamp with truth to the last.

    `span` are the rows of the stamps, and `valid` marks those outside gaps of the truth, as in `Poses.at`.

    Raises:
        DataError: fewer than two stamps with truth.
    """

    def __init__(self, t_ns: Times, truth: Poses, where: str) -> None:
        self._truth, self._gap_s = truth, max(GAP_FACTOR * truth.period_s, MIN_GAP_S)
        valid = np.concatenate([np.zeros(0, bool), *(self._at(t_ns[rows])[1] for rows in _blocks(len(t_ns)))])
        if valid.sum() < 2:
            raise DataError("IMU and true poses share fewer than two samples", where=where, expected="an overlap")
        self.span = slice(int(np.argmax(valid)), len(valid) - int(np.argmax(valid[::-1])))
        self.t_ns, self.valid = t_ns[self.span], valid[self.span]

    def rows(self, rows: slice) -> Poses:
        """True poses of some rows of the span."""
        return self._at(self.t_ns[rows])[0]

    def _at(self, t_ns: Times) -> tuple[Poses, Mask]:
        known = self._truth.t_ns
        first, last = np.searchsorted(known, t_ns[[0, -1]])
        around = slice(max(0, min(int(first), len(known) - 1) - 2), max(2, int(last) + 2))  # rates of a curve need one more
        return self._truth.rows(around).at(t_ns, self._gap_s)


def integrated(imu: Imu, span: TrueSpan, *, means: bool = False) -> Iterator[PathBlock]:
    """Dead-reckoned path of the samples of a span, from its first true pose.

    With `means` by the trapezoidal rule.

    Raises:
        NumericsError: the numbers overflow.
    """
    start = StartPose.of(span.rows(slice(0, 1)))
    for rows in _blocks(len(imu)):
        samples = imu.rows(slice(rows.start, rows.stop + 1))  # the last starts the next block
        path = dead_reckon(trapezoidal(samples) if means else samples, start)
        start = StartPose.of(path, -1)
        yield PathBlock(path.rows(slice(0, AT_ONCE)), span.rows(rows), span.valid[rows])


def in_memory(path: Poses, span: TrueSpan) -> Iterator[PathBlock]:
    """A path of the samples of a span, in blocks."""
    for rows in _blocks(len(path)):
        yield PathBlock(path.rows(rows), span.rows(rows), span.valid[rows])


def pieces(imu: Imu, span: TrueSpan, windows: Windows, margin: int = 0) -> Iterator[WindowPiece]:
    """Path and truth over some windows at a time, with a margin of rows at both ends.

    The rule is the trapezoidal one. Each path begins at the truth: over a window it is that from any other start, but for a
    constant turn.
    """
    for rows, local in _groups(windows, margin):
        true = span.rows(rows)
        yield WindowPiece(dead_reckon(trapezoidal(imu.rows(rows)), StartPose.of(true)), true, local)


def pieces_in_memory(path: Poses, truth: Poses, windows: Windows) -> Iterator[WindowPiece]:
    """Path and truth over some windows at a time, of a path in memory."""
    for rows, local in _groups(windows, 0):
        yield WindowPiece(path.rows(rows), truth.rows(rows), local)


def _groups(windows: Windows, margin: int) -> Iterator[tuple[slice, Windows]]:
    """Rows of some windows at a time, and the windows in these rows."""
    first = 0
    for k in range(1, len(windows) + 1):
        if k == len(windows) or windows[k, 1] - windows[first, 0] > AT_ONCE:
            start = max(0, int(windows[first, 0]) - margin)
            yield slice(start, int(windows[k - 1, 1]) + 1 + margin), windows[first:k] - start
            first = k


def _blocks(count: int) -> Iterator[slice]:
    for first in range(0, count, AT_ONCE):
        yield slice(first, min(first + AT_ONCE, count))
