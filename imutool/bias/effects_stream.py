"""Bias stream of effects: they are taken off the samples that a neural ODE sees."""

from __future__ import annotations

import math

import numpy as np

from imutool.array_types import Float64, Rows6, Vectors
from imutool.bias.model import DriftStream, Stream, Vector6
from imutool.sensor.linear_form import CompiledEffects
from imutool.sensor.signals import Load, SignalFilter
from imutool.units import COLUMNS


class EffectsStream:
    """Bias stream: effects, then the neural ODE on the corrected samples."""

    def __init__(
        self,
        rate_hz: float,
        gyro: CompiledEffects,
        accel: CompiledEffects,
        ode: DriftStream | None,
        rest: Vector6,
        start_s: float,
        load: Load | None = None,
    ) -> None:
        self._signals = SignalFilter(rate_hz, max(gyro.wanted, accel.wanted), load)
        self._matrix = np.concatenate([gyro.matrix, accel.matrix], axis=1)
        self._gyro, self._accel, self._only_product = gyro, accel, not (gyro.others or accel.others)
        self._ode, self._rest, self._start_s = ode, rest, start_s

    @property
    def rest(self) -> Vector6:
        """Latest rest bias."""
        return self._rest if self._ode is None else self._ode.rest

    def continue_from(self, before: Stream) -> None:
        """Go on with the load of the stretch before a gap."""
        if isinstance(before, EffectsStream):
            self._signals.continue_load(before._signals)

    def __call__(self, t_s: Float64[np.ndarray, " n"], gyro: Vectors, accel: Vectors) -> Rows6:
        """Bias at each sample."""
        if len(t_s) == 1:
            return self.one(float(t_s[0]), np.concatenate([gyro[0], accel[0]]))[None]
        if not len(t_s):
            return np.zeros((0, 6))
        if math.isnan(self._start_s):
            self._start_s = float(t_s[0])
        signals = self._signals(t_s - self._start_s, gyro, accel)
        error: Rows6 = np.dot(signals.columns, self._matrix)
        for columns, effects in ((COLUMNS["gyro"], self._gyro), (COLUMNS["accel"], self._accel)):
            for other in effects.others:
                error[:, columns] += other(signals)
        error += self._rest if self._ode is None else self._ode(t_s, gyro - error[:, :3], accel - error[:, 3:])
        return error

    def one(self, t_s: float, u: Vector6) -> Vector6:
        """Bias at one sample."""
        if math.isnan(self._start_s):
            self._start_s = t_s
        since_s = t_s - self._start_s
        row = self._signals.one(since_s, u)
        error: Vector6 = row.dot(self._matrix)
        if not self._only_product:
            floats = row.tolist()
            error += (*self._gyro.others_at(since_s, floats), *self._accel.others_at(since_s, floats))
        error += self._rest if self._ode is None else self._ode.one(t_s, u - error)
        return error
