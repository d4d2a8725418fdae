"""Signals of any kind between effects: columns, and the state that they depend on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates, spline_filter

from imutool.array_types import Float64

Column = Float64[np.ndarray, "_"]
Columns = Float64[np.ndarray, "_ k"]
Samples = Float64[np.ndarray, " n"]
Values = Float64[np.ndarray, "n k"]
State = Mapping[str, Column]
NO_STATE: State = {}


@dataclass(frozen=True, eq=False)
class SignalSamples:
    """Signal samples between effects, with the ideal signal and its derivative."""

    stamp_s: Samples
    y: Values  # now
    x: Values  # ideal, as sampled
    dx: Values  # the same, per second
    state: State  # on which the signal depends when it is sampled (`q0`, `dq0`)
    channels: Mapping[str, tuple[Column, Column]]  # other numbers of the log, with their times

    def but(self, y: Values) -> SignalSamples:
        """The samples with other values."""
        return replace(self, y=np.asarray(y))

    def with_column(self, k: int, y: Samples) -> SignalSamples:
        """The samples with other values of one column."""
        out = self.y.copy()
        out[:, k] = y
        return replace(self, y=out)

    def with_added(self, k: int, added: Samples | float) -> SignalSamples:
        """The samples with something added to one column."""
        return self.with_column(k, self.y[:, k] + added)

    def channel(self, name: str) -> Samples:
        """Another channel at the stamps, whatever the delay of the signal."""
        return np.asarray(np.interp(self.stamp_s, *self.channels[name]))


@dataclass(frozen=True, eq=False)
class IdealSignal:
    """Ideal signal on a fine even clock, its state, and other channels by name."""

    start_s: float
    rate_hz: float
    fine: Columns
    channels: Mapping[str, tuple[Column, Column]]  # with times of their own (s)
    state: State = field(default_factory=lambda: NO_STATE)
    relation: Callable[[State], Any] | None = None  # of the signal to the state, if the simulation showed one

    @cached_property
    def _coefficients(self) -> list[tuple[Column, Column]]:
        slope = np.gradient(self.fine, axis=0) * self.rate_hz
        return [(spline_filter(a), spline_filter(b)) for a, b in zip(self.fine.T, slope.T, strict=True)]

    def sample(self, taken_s: Samples, stamp_s: Samples) -> SignalSamples:
        """The signal sampled at some times (cubic splines)."""
        at = ((taken_s - self.start_s) * self.rate_hz)[None]
        pairs = [
            [map_coordinates(c, at, order=3, mode="nearest", prefilter=False) for c in both] for both in self._coefficients
        ]
        x, dx = (np.stack([pair[which] for pair in pairs], axis=1) for which in (0, 1))
        k = np.arange(len(self.fine))
        state = {name: np.interp(at[0], k, values) for name, values in self.state.items()}
        return SignalSamples(stamp_s, x, x, dx, state, self.channels)

    def with_state(self, **changed: Column) -> IdealSignal:
        """The signal of another state."""
        assert self.relation is not None, "an effect on the state needs the relation"
        state = {**self.state, **changed}
        return replace(self, state=state, fine=self.relation(state))
