"""What effects look at: the samples of an IMU and what a few causal first-order filters make of them.

A filter of time constant tau follows dy/dt = (x - y) / tau, so that its input's slow derivative is (x - y) / tau itself (over
samples: over the lag behind a ramp, a little less than tau, so that a ramp's slope is exact).
Everything at a sample comes from it and earlier ones, and the blocks in which samples arrive change nothing. The filters start
at the first sample, as if the sensor had always read it. They count samples: over a gap they stand still. The derivatives
divide by the stamps' own difference, and by no less than a tenth of a period.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.signal import lfilter

SLOW_S = 0.1  # of the samples: what is faster counts as vibration
TURN_S = 0.02  # of the rate whose derivative is the angular acceleration
POWER_S = 0.5  # of the squared vibration
TAU_S = np.array([SLOW_S] * 6 + [TURN_S] * 3 + [POWER_S] * 3)
LEAST_PERIODS = 0.1

# columns of the signals
GYRO, ACCEL, SAMPLES = slice(0, 3), slice(3, 6), slice(0, 6)
GYRO_SLOW, GYRO_DOT, ACCEL_DOT, DOTS = slice(6, 9), slice(9, 12), slice(12, 15), slice(9, 15)
ALPHA, VIBRATION, COUNT = slice(15, 18), slice(18, 21), 21

Vectors = Float64[np.ndarray, "n 3"]


@dataclass(frozen=True, slots=True)
class Signals:
    """One row a sample: rad/s, m/s², their derivatives per second, and the vibration's power in (m/s²)² per axis."""

    t_s: Float64[np.ndarray, " n"]
    columns: Float64[np.ndarray, "n 21"]

    @property
    def gyro(self) -> Vectors:
        """The angular rate as measured."""
        return self.columns[:, GYRO]

    @property
    def accel(self) -> Vectors:
        """The specific force as measured."""
        return self.columns[:, ACCEL]

    @property
    def gyro_slow(self) -> Vectors:
        """The rate through a filter of 0.1 s."""
        return self.columns[:, GYRO_SLOW]

    @property
    def gyro_dot(self) -> Vectors:
        """The rate's derivative from one sample to the next: its integral is exact, its noise large."""
        return self.columns[:, GYRO_DOT]

    @property
    def accel_dot(self) -> Vectors:
        """The force's derivative likewise."""
        return self.columns[:, ACCEL_DOT]

    @property
    def alpha(self) -> Vectors:
        """Angular acceleration: the derivative of the rate through a filter of 0.02 s."""
        return self.columns[:, ALPHA]

    @property
    def vibration(self) -> Vectors:
        """Power of the force above 1.6 Hz over half a second."""
        return self.columns[:, VIBRATION]

    def rows(self, rows: slice | np.ndarray) -> Signals:
        """Some samples."""
        return Signals(self.t_s[rows], self.columns[rows])


class SignalFilter:
    """Signals from samples as they arrive, in blocks of any size."""

    def __init__(self, rate_hz: float) -> None:
        self._gain = -np.expm1(-1.0 / (rate_hz * TAU_S))
        self._period_s = 1.0 / rate_hz
        self._lag_s = self._period_s / math.expm1(self._period_s / TURN_S)
        self._t_s = 0.0
        self._last: Float64[np.ndarray, "6"] | None = None
        self._state = np.zeros(12)  # gyro and accel slow, gyro for its derivative, power
        self._seen = np.zeros(12)  # what the next sample shows the filters

    def __call__(self, t_s: Float64[np.ndarray, " n"], gyro: Vectors, accel: Vectors) -> Signals:
        """The signals at each sample of a block."""
        columns = np.empty((len(t_s), COUNT))
        if not len(t_s):
            return Signals(t_s, columns)
        columns[:, GYRO], columns[:, ACCEL] = gyro, accel
        if self._last is None:
            self._last, self._t_s = columns[0, SAMPLES].copy(), float(t_s[0]) - self._period_s
            self._state = np.concatenate([self._last, self._last[:3], np.zeros(3)])
        if len(t_s) == 1:
            self._one(float(t_s[0]), columns[0], self._last)
        else:
            self._many(t_s, columns, self._last)
        self._last, self._t_s = columns[-1, SAMPLES].copy(), float(t_s[-1])
        return Signals(t_s, columns)

    def _one(self, t_s: float, row: Float64[np.ndarray, "21"], last: Float64[np.ndarray, "6"]) -> None:
        """One sample: what the calls of `_many` cost would be ten times the arithmetic."""
        seen, y, u = self._seen, self._state, row[SAMPLES]
        seen[:6], seen[6:9] = u, row[GYRO]
        np.subtract(row[ACCEL], y[3:6], out=seen[9:])
        np.square(seen[9:], out=seen[9:])
        seen -= y
        seen *= self._gain
        y += seen
        row[GYRO_SLOW], row[VIBRATION] = y[:3], y[9:]
        np.subtract(u, last, out=row[DOTS])
        row[DOTS] *= 1.0 / max(t_s - self._t_s, LEAST_PERIODS * self._period_s)
        np.subtract(row[GYRO], y[6:9], out=row[ALPHA])
        row[ALPHA] *= 1.0 / self._lag_s

    def _many(
        self, t_s: Float64[np.ndarray, " n"], columns: Float64[np.ndarray, "n 21"], last: Float64[np.ndarray, "6"]
    ) -> None:
        u, gyro, before = columns[:, SAMPLES], columns[:, GYRO], self._state
        step_s = np.maximum(np.diff(t_s, prepend=self._t_s), LEAST_PERIODS * self._period_s)[:, None]
        slow = low_pass(u, self._gain[0], before[:6])
        around = np.concatenate([before[None, 3:6], slow[:-1, 3:]])  # the mean before the sample: one filter waits for none
        turn = low_pass(gyro, self._gain[6], before[6:9])
        power = low_pass((columns[:, ACCEL] - around) ** 2, self._gain[9], before[9:])
        columns[:, GYRO_SLOW], columns[:, VIBRATION] = slow[:, :3], power
        columns[:, DOTS] = np.diff(u, axis=0, prepend=last[None]) / step_s
        columns[:, ALPHA] = (gyro - turn) / self._lag_s
        self._state = np.concatenate([slow[-1], turn[-1], power[-1]])


def low_pass(x: Float64[np.ndarray, "n k"], gain: float, before: Float64[np.ndarray, " k"]) -> Float64[np.ndarray, "n k"]:
    """y_k = y_{k-1} + gain (x_k - y_{k-1}), from a state on; gain = 1 - exp(-period / tau) is the ODE's own solution."""
    y, _ = lfilter([gain], [1.0, gain - 1.0], x, axis=0, zi=(1.0 - gain) * before[None])
    return np.asarray(y)
