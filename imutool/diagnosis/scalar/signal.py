"""Scalar signal for the estimator: ideal, sampled, and aligned with its recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import map_coordinates, spline_filter

from imutool.diagnosis.estimation.aligned_log import AlignedLog, Blocks
from imutool.sensor.effect import SignalState

Column = Float64[np.ndarray, "_"]
Samples = Float64[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class SignalSamples:
    """Signal samples between effects, with the ideal signal and its derivative.

    `y` is the value now; `x` and `dx` (per second) are the ideal ones as sampled.
    """

    stamp_s: Samples
    y: Samples
    x: Samples
    dx: Samples
    channels: Mapping[str, tuple[Column, Column]]

    def but(self, y: Samples) -> SignalSamples:
        """The samples with another value."""
        return replace(self, y=np.asarray(y))


@dataclass(frozen=True, eq=False)
class IdealSignal:
    """Ideal signal on a fine even clock, and other channels by name with their times (s)."""

    start_s: float
    rate_hz: float
    fine: Column
    channels: Mapping[str, tuple[Column, Column]]

    @cached_property
    def _coefficients(self) -> tuple[Column, ...]:
        return tuple(spline_filter(column) for column in (self.fine, np.gradient(self.fine) * self.rate_hz))

    def sample(self, taken_s: Samples, stamp_s: Samples) -> SignalSamples:
        """The signal sampled at some times (cubic splines)."""
        at = ((taken_s - self.start_s) * self.rate_hz)[None]
        x, dx = (map_coordinates(c, at, order=3, mode="nearest", prefilter=False) for c in self._coefficients)
        return SignalSamples(stamp_s, x, x, dx, self.channels)


@dataclass(frozen=True, eq=False, kw_only=True)
class AlignedSignal(AlignedLog):
    """One recorded column with the ideal signal.

    `lag_s` is how much later the recording follows at first sight, `sim_density` the density of the simulation's own noise.
    """

    ideal: IdealSignal
    unit: str
    lag_s: float
    sim_density: float
    shares_epoch: bool

    exact, denoised = True, False

    @property
    def bias_std(self) -> Float64[np.ndarray, " k"]:
        """The offset is an effect, which acts before saturation."""
        return np.full(1, 1e-9)

    def state(self) -> SignalState:
        """The ideal signal, to be sampled at the stamps."""
        return SignalState(self.ideal, self.stamp_s, self.stamp_s)

    def blocks(self, samples: SignalSamples) -> Blocks:
        """The one column."""
        return ((0, samples.y[:, None]),)

    def recorded(self) -> tuple[IdealSignal, Samples]:
        """The ideal signal and the recorded column."""
        return self.ideal, self.real[:, 0]

    @cached_property
    def sampled(self) -> SignalSamples:
        """The ideal signal at the stamps."""
        return self.ideal.sample(self.stamp_s, self.stamp_s)
