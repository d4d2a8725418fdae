"""Ideal motion and sensor samples: signals between a simulation and the samples of a log.

Three clocks meet here. `t_s` is even and belongs to the motion; effects of the motion, the mount and the bandwidth act there.
`taken_s` says when, on that clock, each sample was taken; effects of the clock act on it. `stamp_s` is what the log says.
`IdealMotion.sample` goes from the first to the second; effects of the sensor and its converter act on its rows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np

from imutool.array_types import Float64, Vectors
from imutool.errors import DataError
from imutool.sensor.signals import FILTERED, SignalFilter, Signals, vibration_power
from imutool.units import Sensor

Column = Float64[np.ndarray, "_"]
Columns = Float64[np.ndarray, "_ _"]
Times = Float64[np.ndarray, " n"]
PAD = 12  # samples beyond the ends, over which the spline forgets its start: 0.27^12 = 1e-7
UNEVEN = 1e-2  # of a period: how far the even clock may be from even
SAME_S = 1e-7  # a stamp's rounding; the fastest motion goes nowhere in it
INSTANTS, RECENT = 3, 16  # entries that a sampler keeps: sets of instants, and columns
JOINED = "stamp_s", "gyro", "accel", "alpha"
NOTHING: Mapping[str, Float64[np.ndarray, " n"]] = MappingProxyType({})
Instants = tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " m"], Any]  # the last a csr_array or a slice


class Sampler:
    """Cache of cubic splines over one even clock, evaluated at some instants.

    Every `replace` of an `IdealMotion` shares one, so that a column which an effect leaves alone is evaluated once. The arrays
    are read-only; each memory is replaced as a whole, so that threads may share it.
    """

    def __init__(self) -> None:
        self._instants: tuple[Instants, ...] = ()
        self._coefficients, self._values, self._others = Recent(), Recent(), Recent()
        self.behind, self.vibration = Recent(), Recent()  # columns behind an effect, and the power of the force

    def at(self, x: Vectors, motion: IdealMotion, taken_s: Float64[np.ndarray, " m"]) -> Float64[np.ndarray, "m 3"]:
        """Columns of a motion at some instants."""
        return self._at_instants(x, self._at(motion.t_s, taken_s))

    def others(self, motion: IdealMotion, taken_s: Float64[np.ndarray, " m"]) -> Float64[np.ndarray, "m k"]:
        """R_wb row by row, where it is known, then the channels."""
        instants = self._at(motion.t_s, taken_s)

        def columns() -> Float64[np.ndarray, "n k"]:
            first = [np.zeros((len(motion.t_s), 0))] if motion.R_wb is None else [motion.R_wb.reshape(-1, 9)]
            return np.concatenate([*first, *(values[:, None] for values in motion.channels.values())], axis=1)

        return self._at_instants(self._others.made(motion.R_wb, motion.channels, columns), instants)

    def _at_instants(self, x: Float64[np.ndarray, "n k"], instants: Instants) -> Float64[np.ndarray, "m k"]:
        weights = instants[2]
        if isinstance(weights, slice):
            return self._values.made(x, instants, lambda: x[weights])
        return self._values.changed(self._coefficients.changed(x, None, _coefficients), instants, weights.__matmul__)

    def _at(self, t_s: Times, taken_s: Float64[np.ndarray, " m"]) -> Instants:
        """Clock, instants, and matrix from coefficients to values, or the rows of the clock's own instants."""
        for last in self._instants:
            if all(a is b or np.array_equal(a, b) for a, b in zip(last[:2], (t_s, taken_s), strict=True)):
                return last
        first = int(np.abs(t_s - taken_s[0]).argmin())
        rows = slice(first, first + len(taken_s))
        own = len(t_s[rows]) == len(taken_s) and bool(np.abs(t_s[rows] - taken_s).max() <= SAME_S)
        found: Instants = (t_s, taken_s, rows if own else _weights(t_s, taken_s))
        self._instants = (found, *self._instants[: INSTANTS - 1])
        return found


class Recent:
    """The last few arrays made from others, read-only, by the objects they were made from."""

    def __init__(self) -> None:
        self._known: tuple[tuple[Any, object, Columns], ...] = ()

    def made(self, of: object, at: object, make: Callable[[], Float64[np.ndarray, "n k"]]) -> Float64[np.ndarray, "n k"]:
        """Array made from two objects; the same array for the same objects."""
        value = self._of(of, at)
        return self._kept(of, at, make()) if value is None else value

    def changed(self, x: Columns, by: object, change: Callable[[Column], Column]) -> Columns:
        """Columns behind a change of each by itself, which `by` stands for; each lies in one piece of memory.

        Columns that were changed before, in this array or in another, are taken from there.
        """
        value = self._of(x, by)
        if value is not None:
            return value
        alike = [entry for entry in self._known if entry[1] is by and entry[0].shape == x.shape]
        if not alike:
            return self._kept(x, by, np.stack([change(column) for column in x.T]).T)
        few = slice(None, None, len(x) // 16 + 1)
        unlike = (np.stack([entry[0][few] for entry in alike]) != x[few]).any(axis=1)
        nearest = int(unlike.sum(axis=1).argmin())
        like, _, before = alike[nearest]
        differs = [k for k in range(x.shape[1]) if unlike[nearest, k] or not np.array_equal(like[:, k], x[:, k])]
        if not differs:
            return self._kept(x, by, before)
        out = np.empty(before.T.shape)
        for k, column in enumerate(out):
            column[:] = change(x[:, k]) if k in differs else before[:, k]
        return self._kept(x, by, out.T)

    def _of(self, of: object, at: object) -> Columns | None:
        for k, entry in enumerate(entries := self._known):
            if entry[0] is of and entry[1] is at:
                if k:  # an entry in use moves to the front
                    self._known = (entry, *entries[:k], *entries[k + 1 :])
                return entry[2]
        return None

    def _kept(self, of: object, at: object, value: Columns) -> Columns:
        value.flags.writeable = False
        self._known = ((of, at, value), *self._known[: RECENT - 1])
        return value


def _weights(t_s: Float64[np.ndarray, " n"], taken_s: Float64[np.ndarray, " m"]) -> Any:
    """The four cubic B-splines that reach each instant."""
    n, period_s = len(t_s), (t_s[-1] - t_s[0]) / (len(t_s) - 1)
    off = np.abs(t_s - (t_s[0] + period_s * np.arange(n)))
    if not off.max() <= UNEVEN * period_s:
        row = int(off.argmax())
        raise DataError(f"the clock of the motion is {off[row]:.3g} s off in row {row}", expected="an even clock")
    at = np.clip((taken_s - t_s[0]) / period_s, 0.0, n - 1.0)
    first = np.minimum(at.astype(np.int32), n - 2)
    values, u = np.empty((len(at), 4)), at - first
    for x, end, inner in ((u, 3, 1), (1.0 - u, 0, 2)):  # products: a cube by `**` takes five times as long
        values[:, end] = x * x * x / 6.0
        values[:, inner] = 2.0 / 3.0 - x * x * (1.0 - 0.5 * x)
    columns = np.empty((len(at), 4), np.int32)
    for k in range(4):  # by columns: four times as fast as an outer sum
        np.add(first, PAD - 1 + k, out=columns[:, k])
    ends = np.arange(0, 4 * len(at) + 1, 4, dtype=np.int32)
    from scipy.sparse import csr_array

    return csr_array((values.ravel(), columns.ravel(), ends), shape=(len(at), n + 2 * PAD))


def _coefficients(x: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " m"]:
    """Spline coefficients of a column, which is reflected through its last points beyond the ends."""
    beyond = np.minimum(np.arange(1, PAD + 1), (n := len(x)) - 1)
    padded = np.empty(n + 2 * PAD)
    padded[PAD : n + PAD] = x
    padded[:PAD] = 2.0 * x[0] - x[beyond[::-1]]
    padded[n + PAD :] = 2.0 * x[-1] - x[n - 1 - beyond]
    from scipy.ndimage import spline_filter1d

    return np.asarray(spline_filter1d(padded, 3, output=padded))


@dataclass(frozen=True, eq=False)
class IdealMotion:
    """Ideal signals of the tracked point of a body, on an even clock of seconds."""

    t_s: Times
    gyro: Vectors  # angular rate, body frame (rad/s)
    accel: Vectors  # specific force R_wb^T (a_w - g_w) (m/s²)
    alpha: Vectors  # angular acceleration (rad/s²)
    R_wb: Float64[np.ndarray, "n 3 3"] | None = None  # attitude, where it is known
    channels: Mapping[str, Float64[np.ndarray, " n"]] = field(default_factory=lambda: NOTHING)  # by `TOPIC.field`
    sampler: Sampler = field(default_factory=Sampler, repr=False)

    @property
    def rate_hz(self) -> float:
        """Rate of the even clock."""
        return float((len(self.t_s) - 1) / (self.t_s[-1] - self.t_s[0]))

    def sample(self, taken_s: Float64[np.ndarray, " m"], stamp_s: Float64[np.ndarray, " m"]) -> SensorSamples:
        """Samples at other times (cubic splines; held beyond the ends), one row each.

        Raises:
            DataError: `t_s` is not even.
        """
        gyro, accel = (self.sampler.at(x, self, taken_s) for x in (self.gyro, self.accel))
        return SensorSamples(stamp_s, gyro, accel, MotionAt(self, taken_s), powers=self.sampler.vibration)


@dataclass(frozen=True, eq=False)
class MotionAt:
    """Motion at the times of samples, evaluated where an effect asks for it."""

    motion: IdealMotion
    taken_s: Times

    @cached_property
    def accel(self) -> Vectors:
        """Specific force."""
        return self.motion.sampler.at(self.motion.accel, self.motion, self.taken_s)

    @cached_property
    def alpha(self) -> Vectors:
        """Angular acceleration."""
        return self.motion.sampler.at(self.motion.alpha, self.motion, self.taken_s)

    @cached_property
    def R_wb(self) -> Float64[np.ndarray, "n 3 3"] | None:  # noqa: N802  # as the motion's own
        """Attitude, where it is known."""
        return None if self.motion.R_wb is None else self._others[:, :9].reshape(-1, 3, 3)

    @cached_property
    def channels(self) -> Mapping[str, Float64[np.ndarray, " n"]]:
        """The log's other numbers."""
        count = len(self.motion.channels)
        return {name: self._others[:, k - count] for k, name in enumerate(self.motion.channels)}

    @cached_property
    def _others(self) -> Columns:
        return self.motion.sampler.others(self.motion, self.taken_s)


@dataclass(frozen=True, eq=False)
class SensorSamples:
    """Samples of a sensor, one row each, by the log's own stamps (s)."""

    stamp_s: Times
    gyro: Vectors
    accel: Vectors
    at: MotionAt | IdealMotion
    online: Signals | None = field(default=None, repr=False)
    powers: Recent = field(default_factory=Recent, repr=False)

    @property
    def alpha(self) -> Vectors:
        """Angular acceleration (rad/s²)."""
        return self.at.alpha

    @property
    def channels(self) -> Mapping[str, Float64[np.ndarray, " n"]]:
        """The log's other numbers, by `topic.field`."""
        return self.at.channels

    @cached_property
    def signals(self) -> Signals:
        """Filtered signals: of a running filter (`online`), else of these samples at mean rate."""
        if self.online is not None:
            return self.online
        return SignalFilter(self._mean_rate_hz, FILTERED.stop)(self.stamp_s, self.gyro, self.accel)

    @property
    def vibration(self) -> Vectors:
        """The signals' vibration power, which only the force changes."""
        if self.online is not None:
            return self.online.vibration
        return self.powers.made(self.accel, self.stamp_s, lambda: vibration_power(self._mean_rate_hz, self.accel))

    @property
    def _mean_rate_hz(self) -> float:
        return float((len(self.stamp_s) - 1) / (self.stamp_s[-1] - self.stamp_s[0]))

    @cached_property
    def load(self) -> Float64[np.ndarray, "n 3 11"]:
        """States of a slow drift (`Signals.load`), which only it needs."""
        if self.online is not None:
            return self.online.load
        return SignalFilter(self._mean_rate_hz)(self.stamp_s, self.gyro, self.accel).load

    @classmethod
    def joined(cls, parts: Sequence[SensorSamples]) -> SensorSamples:
        """Several stretches end to end; the attitude only where all of them have one."""
        attitudes = [part.at.R_wb for part in parts if part.at.R_wb is not None]
        t_s, gyro, accel, alpha = (np.concatenate([getattr(part, name) for part in parts]) for name in JOINED)
        R_wb = np.concatenate(attitudes) if len(attitudes) == len(parts) else None
        channels = {name: np.concatenate([part.channels[name] for part in parts]) for name in parts[0].channels}
        return cls(t_s, gyro, accel, IdealMotion(t_s, gyro, accel, alpha, R_wb, channels))

    def with_readings(self, gyro: Vectors | None = None, accel: Vectors | None = None) -> SensorSamples:
        """The samples with other readings of one sensor, or of both."""
        kept = self.gyro if gyro is None else gyro, self.accel if accel is None else accel
        return SensorSamples(self.stamp_s, *kept, self.at, powers=self.powers)

    def with_added(self, sensor: Sensor, added: Vectors) -> SensorSamples:
        """The samples with something added to one sensor."""
        return self.with_readings(**{sensor: getattr(self, sensor) + added})

    def with_gain(self, sensor: Sensor, error: Vectors | Float64[np.ndarray, "3"]) -> SensorSamples:
        """The samples of one sensor times one plus a gain's error."""
        return self.with_readings(**{sensor: getattr(self, sensor) * (1.0 + error)})
