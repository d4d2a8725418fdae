"""What a sensor feels and then reads, on its way from an ideal simulation to the samples of a log.

Three clocks meet here. `t_s` is even and belongs to the motion; effects of the motion, the mount and the bandwidth act on it.
`taken_s` says when, on that clock, each sample was taken; effects of the clock act on it. `stamp_s` is what the log says.
`taken` goes from the first to the second; effects of the sensor and its converter act on what it gives, one row a sample.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import make_interp_spline

Vectors = Float64[np.ndarray, "n 3"]
Times = Float64[np.ndarray, " n"]
NOTHING: Mapping[str, Float64[np.ndarray, " n"]] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class Felt:
    """What the tracked point of a body feels, on an even clock of seconds.

    gyro: angular rate, body frame (rad/s); accel: specific force R_wb^T (a_w - g_w) (m/s²); alpha: angular acceleration
    (rad/s²); R_wb: attitude, where it is known. `channels` are other numbers of the log on the same clock (temperature in °C, a
    motor current), by `topic.field`.
    """

    t_s: Times
    gyro: Vectors
    accel: Vectors
    alpha: Vectors
    R_wb: Float64[np.ndarray, "n 3 3"] | None = None
    channels: Mapping[str, Float64[np.ndarray, " n"]] = field(default_factory=lambda: NOTHING)

    @property
    def rate_hz(self) -> float:
        """Of the even clock."""
        return float((len(self.t_s) - 1) / (self.t_s[-1] - self.t_s[0]))

    def taken(self, taken_s: Float64[np.ndarray, " m"], stamp_s: Float64[np.ndarray, " m"]) -> Read:
        """What is felt at other times (cubic splines; held beyond the ends), one row a sample."""
        at = np.clip(taken_s, self.t_s[0], self.t_s[-1])
        columns = [self.gyro, self.accel, self.alpha, *(values[:, None] for values in self.channels.values())]
        if self.R_wb is not None:
            columns.append(self.R_wb.reshape(-1, 9))
        both = make_interp_spline(self.t_s, np.concatenate(columns, axis=1), k=3)(at)
        names = {name: both[:, 9 + k] for k, name in enumerate(self.channels)}
        R_wb = None if self.R_wb is None else both[:, -9:].reshape(-1, 3, 3)
        return Read(stamp_s, both[:, :3], both[:, 3:6], both[:, 6:9], R_wb, names)


@dataclass(frozen=True, eq=False)
class Read:
    """One row a sample, by the log's own stamps (s): the same signals, on their way through the sensor."""

    stamp_s: Times
    gyro: Vectors
    accel: Vectors
    alpha: Vectors
    R_wb: Float64[np.ndarray, "n 3 3"] | None = None
    channels: Mapping[str, Float64[np.ndarray, " n"]] = field(default_factory=lambda: NOTHING)

    def but(self, gyro: Vectors | None = None, accel: Vectors | None = None) -> Read:
        """With one of the sensors, or both, reading something else."""
        return replace(self, gyro=self.gyro if gyro is None else gyro, accel=self.accel if accel is None else accel)
