"""How an IMU moved, in steps of a tenth of a second: what is left in memory of its samples, whatever their rate."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64

from imutool.cleaning.samples import Samples
from imutool.recording import nanoseconds

STEP_NS = nanoseconds(0.1)
STEP_S = 0.1


class Motion:
    """Means of the samples of each step: 64 bytes per 0.1 s, 23 MB for ten hours."""

    def __init__(self) -> None:
        self.start_ns: int | None = None
        self.end_ns = 0
        self.samples = 0
        self._steps: list[Int64[np.ndarray, " m"]] = []
        self._sums: list[Float64[np.ndarray, "m 7"]] = []
        self._open: tuple[int, Float64[np.ndarray, "7"]] | None = None
        self._mean: tuple[Int64[np.ndarray, " m"], Float64[np.ndarray, "m 6"]] | None = None

    def see(self, samples: Samples) -> None:
        """The next samples, their stamps in order."""
        if not len(samples.number):
            return
        if self.start_ns is None:
            self.start_ns = int(samples.stamp_ns[0])
        self.end_ns = int(samples.stamp_ns[-1])
        self.samples += len(samples.number)
        step = (samples.stamp_ns - self.start_ns) // STEP_NS
        rows = np.column_stack([np.ones(len(step)), samples.values])
        first = np.flatnonzero(np.diff(step, prepend=step[0] - 1))
        sums, steps = np.add.reduceat(rows, first, axis=0), step[first]
        if self._open is not None:
            if self._open[0] == steps[0]:
                sums[0] += self._open[1]
            else:
                self._steps.append(np.array([self._open[0]]))
                self._sums.append(self._open[1][None])
        self._open = int(steps[-1]), sums[-1].copy()
        self._steps.append(steps[:-1])
        self._sums.append(sums[:-1])

    def table(self) -> tuple[Int64[np.ndarray, " m"], Float64[np.ndarray, "m 6"]]:
        """Steps (tenths of a second since the first sample), and the mean of gyro and accel in each that has samples.

        Once everything has been seen; the arrays are the same ones each time.
        """
        if self._open is not None:
            self._steps.append(np.array([self._open[0]]))
            self._sums.append(self._open[1][None])
            self._open = None
        if self._mean is None:
            step = np.concatenate([np.zeros(0, np.int64), *self._steps])
            total = np.concatenate([np.zeros((0, 7)), *self._sums])
            self._steps, self._sums = [], []
            self._mean = step, total[:, 1:] / total[:, :1]
        return self._mean
