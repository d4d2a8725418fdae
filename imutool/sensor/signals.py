"""Causal signals of an IMU: samples behind first-order filters, and their derivatives.

A filter of time constant tau follows dy/dt = (x - y) / tau, so that its input's slow derivative is (x - y) / tau itself (over
samples: over the lag behind a ramp, a little less than tau, so that a ramp's slope is exact).
A row depends on its sample and earlier ones alone, and not on the blocks in which samples arrive. The filters start settled at
the first sample. They count samples: over a gap they stand still. The derivatives divide by the difference of the stamps, and
by no less than a tenth of a period.

The *load* of a sensor is what may warm or strain it: that it is on, how fast it turns, how it shakes, how far the force is from
gravity. Slow filters of it are the states of a drift, dz/dt = (g(u) - z) / tau, zero (a cold sensor) at the first sample.
Ramps between knots make up g: a sum of them imitates any monotone dependence, and is constant beyond the last knot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from imutool.array_types import Float64, Vectors
from imutool.recording import GRAVITY_M_S2

SLOW_S = 0.1  # of the samples: what is faster counts as vibration
TURN_S = 0.02  # of the rate whose derivative is the angular acceleration
POWER_S = 0.5  # of the squared vibration
TAU_S = np.array([SLOW_S] * 6 + [TURN_S] * 3 + [POWER_S] * 3)
MIN_PERIODS = 0.1
BLOCK = 64  # samples of a matrix product in `low_pass`

# columns of the signals: the samples, the filters' whole state, and derivatives
GYRO, ACCEL, SAMPLES = slice(0, 3), slice(3, 6), slice(0, 6)
GYRO_SLOW, SLOW, TURN, VIBRATION = slice(6, 9), slice(6, 12), slice(12, 15), slice(15, 18)
FILTERED = slice(6, 18)
GYRO_DOT, ACCEL_DOT, DOTS, ALPHA = slice(18, 21), slice(21, 24), slice(18, 24), slice(24, 27)

LOAD_TAU_S = np.array([5.0, 20.0, 80.0])  # a response in between is a sum of two of them, right within 3 % of its size
TURNING_RAD_S = np.array([0.0, 0.3, 0.7, 1.5, 3.0])  # knots of the ramps
SHAKING_M_S2 = np.array([0.0, 0.5, 2.0, 6.0])
RAMPS = (len(TURNING_RAD_S) - 1, len(SHAKING_M_S2) - 1)
LOADS = 1 + RAMPS[0] + 2 * RAMPS[1]
ON = 0  # column of the load of being switched on
LOAD = slice(27, 27 + len(LOAD_TAU_S) * LOADS)  # the loads behind the first filter, then behind the next
COUNT = LOAD.stop
TEMPERATURE_TERMS = 3 * (1 + len(LOAD_TAU_S))  # polynomials of a temperature, at once and behind the filters

Load = Float64[np.ndarray, "3 11"]  # state of a slow drift, by time constant and load


@dataclass(frozen=True, slots=True)
class Signals:
    """Signals, one row a sample: rad/s, m/s², derivatives, vibration power in (m/s²)²."""

    t_s: Float64[np.ndarray, " n"]
    columns: Float64[np.ndarray, "n 60"]
    temperature: Float64[np.ndarray, "n 12"] | None = None  # its terms, in a training (`imutool.bias.temperature`)

    @property
    def gyro(self) -> Vectors:
        """Measured angular rate."""
        return self.columns[:, GYRO]

    @property
    def accel(self) -> Vectors:
        """Measured specific force."""
        return self.columns[:, ACCEL]

    @property
    def gyro_slow(self) -> Vectors:
        """Rate behind a filter of 0.1 s."""
        return self.columns[:, GYRO_SLOW]

    @property
    def gyro_dot(self) -> Vectors:
        """Derivative of the rate between two samples: its integral is exact, its noise large."""
        return self.columns[:, GYRO_DOT]

    @property
    def accel_dot(self) -> Vectors:
        """Derivative of the specific force from one sample to the next."""
        return self.columns[:, ACCEL_DOT]

    @property
    def alpha(self) -> Vectors:
        """Angular acceleration: the derivative of the rate through a filter of 0.02 s."""
        return self.columns[:, ALPHA]

    @property
    def vibration(self) -> Vectors:
        """Power of the force above 1.6 Hz over half a second."""
        return self.columns[:, VIBRATION]

    @property
    def load(self) -> Float64[np.ndarray, "n 3 11"]:
        """States of a slow drift, by time constant and load."""
        return self.columns[:, LOAD].reshape(-1, len(LOAD_TAU_S), LOADS)

    def rows(self, rows: slice | np.ndarray) -> Signals:
        """The signals of some rows."""
        return Signals(self.t_s[rows], self.columns[rows], None if self.temperature is None else self.temperature[rows])


class SignalFilter:
    """Causal filter from samples to signals, in blocks of any size; its state is the last row.

    It fills the first `wanted` columns of a row, and more where that is no extra work; the others are zero. `load` is the state
    of the load before the first sample, of a cold sensor by default.
    """

    def __init__(self, rate_hz: float, wanted: int = COUNT, load: Load | None = None) -> None:
        self._filters, self._derives, self._loads = (wanted > part.start for part in (FILTERED, DOTS, LOAD))
        self._gain = -np.expm1(-1.0 / (rate_hz * TAU_S))
        self._load_gain = -np.expm1(-1.0 / (rate_hz * LOAD_TAU_S))[:, None]
        self._period_s = 1.0 / rate_hz
        self._lag_s = self._period_s / math.expm1(self._period_s / TURN_S)
        self._lead = np.full(3, (1.0 / self._gain[6] - 1.0) / self._lag_s)  # from the filter's last step to what it lags by
        self._min_s = MIN_PERIODS * self._period_s
        self._t_s = math.nan
        self._row, self._step = np.zeros(COUNT), np.zeros(12)
        self._cut()
        if load is not None:
            self._load[:] = load

    def _cut(self) -> None:
        """Views of the state: numpy takes as long to cut a piece out as to add two."""
        row, step = self._row, self._step
        self._u, self._y, self._dots, self._alpha = row[SAMPLES], row[FILTERED], row[DOTS], row[ALPHA]
        self._gyro, self._slow, self._turn, self._power = row[GYRO], row[SLOW], row[TURN], row[VIBRATION]
        self._step_slow, self._step_turn, self._step_power = step[:6], step[6:9], step[9:]
        self._fast = step[3:6]  # the force without its mean, until it is a step
        self._load = row[LOAD].reshape(len(LOAD_TAU_S), LOADS)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Cut the views anew: a copy or a pickle has copied them, too."""
        self.__dict__.update(state)
        self._cut()

    def __call__(self, t_s: Float64[np.ndarray, " n"], gyro: Vectors, accel: Vectors) -> Signals:
        """The signals at each sample of a block."""
        if len(t_s) == 1:
            return Signals(t_s, self.one(float(t_s[0]), np.concatenate([gyro[0], accel[0]]))[None].copy())
        columns = np.zeros((len(t_s), COUNT))
        if len(t_s):
            columns[:, GYRO], columns[:, ACCEL] = gyro, accel
            self._many(t_s, columns)
        return Signals(t_s, columns)

    def one(self, t_s: float, u: Float64[np.ndarray, "6"]) -> Float64[np.ndarray, "60"]:
        """Columns at one sample, in a row that the next call overwrites; 10 times faster."""
        if math.isnan(self._t_s):
            self._begin(t_s, u)
        if self._derives:
            np.subtract(u, self._u, self._dots)
            self._dots *= 1.0 / max(t_s - self._t_s, self._min_s)
        self._u[:] = u
        if self._filters:
            step, power = self._step, self._step_power
            np.subtract(u, self._slow, self._step_slow)
            np.subtract(self._gyro, self._turn, self._step_turn)
            if self._loads:
                self._load += self._load_gain * (_loads(self._gyro[None], u[None, 3:], self._fast[None]) - self._load)
            np.multiply(self._fast, self._fast, power)
            power -= self._power
            step *= self._gain
            self._y += step
        if self._derives:
            np.multiply(self._step_turn, self._lead, self._alpha)
        self._t_s = t_s
        return self._row

    def _many(self, t_s: Float64[np.ndarray, " n"], columns: Float64[np.ndarray, "n 60"]) -> None:
        u, gyro, gain = columns[:, SAMPLES], columns[:, GYRO], self._gain
        if math.isnan(self._t_s):
            self._begin(float(t_s[0]), u[0])
        if self._filters:
            columns[:, SLOW] = slow = low_pass(u, gain[0], self._slow)
            columns[:, TURN] = low_pass(gyro, gain[6], self._turn)
            # the mean before the sample: one filter waits for none
            fast = columns[:, ACCEL] - np.concatenate([self._slow[None, 3:], slow[:-1, 3:]])
            columns[:, VIBRATION] = low_pass(fast**2, gain[9], self._power)
        if self._loads:
            load = _loads(gyro, columns[:, ACCEL], fast)
            states = [low_pass(load, gain, state) for gain, state in zip(self._load_gain.flat, self._load, strict=True)]
            columns[:, LOAD] = np.concatenate(states, axis=1)
        if self._derives:
            step_s = np.maximum(np.diff(t_s, prepend=self._t_s), self._min_s)[:, None]
            columns[:, DOTS] = np.diff(u, axis=0, prepend=self._u[None]) / step_s
            columns[:, ALPHA] = (gyro - columns[:, TURN]) / self._lag_s
        self._row[:], self._t_s = columns[-1], float(t_s[-1])

    def continue_load(self, before: SignalFilter) -> None:
        """Go on with the load of another filter, over a gap in which a sensor neither warms nor cools."""
        self._load[:] = before._load

    def _begin(self, t_s: float, u: Float64[np.ndarray, "6"]) -> None:
        """Start settled at the first sample."""
        self._t_s, self._u[:] = t_s - self._period_s, u
        if self._filters:
            self._slow[:], self._turn[:] = u, self._gyro


def _loads(gyro: Vectors, accel: Vectors, fast: Vectors) -> Float64[np.ndarray, "n 11"]:
    """Loads between zero and one: on, turning, shaking (force without its mean), and force other than gravity's."""
    turning, size, shaking = (np.sqrt(np.einsum("ij,ij->i", x, x)) for x in (gyro, accel, fast))
    on = np.ones((len(gyro), 1))
    ramps = (_ramps(turning, TURNING_RAD_S), _ramps(shaking, SHAKING_M_S2), _ramps(np.abs(size - GRAVITY_M_S2), SHAKING_M_S2))
    return np.concatenate([on, *ramps], axis=1)


def _ramps(x: Float64[np.ndarray, " n"], knots: Float64[np.ndarray, " k"]) -> Float64[np.ndarray, "n j"]:
    """How far each sample is from each knot to the next, between zero and one."""
    return np.asarray(np.clip((x[:, None] - knots[:-1]) / np.diff(knots), 0.0, 1.0))


def low_pass(x: Float64[np.ndarray, "n k"], gain: float, before: Float64[np.ndarray, " k"]) -> Float64[np.ndarray, "n k"]:
    """Low-pass y_k = y_{k-1} + gain (x_k - y_{k-1}) from a state; gain = 1 - exp(-period / tau).

    Blocks of samples times a triangular matrix, then a recursion over blocks: scipy.signal.lfilter is as fast, and its import
    takes a quarter of a second.
    """
    n, k = len(x), x[0].size if len(x) else 1
    blocks, keep, step = -(-n // BLOCK), 1.0 - gain, np.arange(BLOCK)
    padded = np.zeros((blocks, BLOCK, k))
    padded.reshape(-1, k)[:n] = x
    inside = gain * np.tril(keep ** np.maximum(step[:, None] - step, 0))
    y = (padded.swapaxes(1, 2).reshape(-1, BLOCK) @ inside.T).reshape(blocks, k, BLOCK)
    before_block, state, carry = np.empty((blocks, k)), before, keep**BLOCK
    for block, end in enumerate(y[:, :, -1]):
        before_block[block] = state
        state = end + carry * state
    y += before_block[..., None] * keep ** (step + 1.0)
    out: Float64[np.ndarray, "n k"] = y.swapaxes(1, 2).reshape(-1, k)[:n]
    return out


def vibration_power(rate_hz: float, accel: Vectors) -> Vectors:
    """The signals' `vibration` of a whole log at once, six times faster than all signals."""
    from scipy.signal import lfilter

    slow, power = -np.expm1(-1.0 / (rate_hz * np.array([SLOW_S, POWER_S])))
    mean = lfilter([slow], [1.0, slow - 1.0], accel, axis=0, zi=(1.0 - slow) * accel[:1])[0]
    fast = accel - np.concatenate([accel[:1], mean[:-1]])
    return np.asarray(lfilter([power], [1.0, power - 1.0], fast**2, axis=0))
