"""Any other signal of a log, aligned with its simulation: one clock, no simulation noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import make_interp_spline
from scipy.ndimage import map_coordinates, spline_filter
from scipy.signal import correlate, correlation_lags, welch

from imutool.diagnosis.estimation.aligned_log import AlignedLog, Blocks, Variables, split
from imutool.diagnosis.estimation.alignment import wiener_filter
from imutool.diagnosis.settings import DiagnoseSettings, SignalSettings
from imutool.errors import DataError
from imutool.mcap_io.fields import Fields
from imutool.recording import seconds
from imutool.sensor.effect import SignalState

MOVES = 1e-9  # of its largest value, below which a signal is constant
MOST_FINE = 20_000_000  # samples
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

    @property
    def signals(self) -> Mapping[str, slice]:
        """The one signal."""
        return {self.name: slice(0, 1)}

    def unit_of(self, signal: str) -> str:
        """Unit of the signal."""
        return self.unit

    def variables(self) -> Variables:
        """Value, rate of change, time and the channels of the log."""
        sampled = self.sampled
        out = {
            "its value": (self.unit, sampled.x),
            "its size": (self.unit, np.abs(sampled.x - np.median(sampled.x))),
            "its rate of change": (f"{self.unit}/s", np.abs(sampled.dx)),
            "time": ("s", self.stamp_s),
        }
        channels = self.ideal.channels.items()
        return out | {name: ("", np.interp(self.stamp_s, at_s, values)) for name, (at_s, values) in channels}

    def recorded(self) -> tuple[IdealSignal, Samples]:
        """The ideal signal and the recorded column."""
        return self.ideal, self.real[:, 0]

    @cached_property
    def sampled(self) -> SignalSamples:
        """The ideal signal at the stamps."""
        return self.ideal.sample(self.stamp_s, self.stamp_s)


def aligned(real: Fields, sim: Fields, others: Mapping[str, Fields], name: str, settings: DiagnoseSettings) -> AlignedSignal:
    """Align a signal with its simulation, in seconds from the first shared sample.

    Raises:
        DataError: constant, too short or too few, or nothing alike in the two.
    """
    for fields, what in ((real, "recording"), (sim, "simulation")):
        _check(fields, what, name, settings.signal)
    start_ns = int(real.t_ns[0])
    t_real, t_sim = seconds(real.t_ns, start_ns), seconds(sim.t_ns, start_ns)
    lag_s, aligned_s = _lag(t_real, real.values, t_sim, sim.values, name, settings)
    if aligned_s is not None:
        t_sim, lag_s = t_sim - aligned_s, 0.0
    period_real, period_sim = float(np.median(np.diff(t_real))), float(np.median(np.diff(t_sim)))
    early, late = min(0.0, lag_s), max(0.0, lag_s)
    rows = np.flatnonzero((t_real - late >= t_sim[0]) & (t_real - early <= t_sim[-1]))
    shared_s = float(t_real[rows[-1]] - t_real[rows[0]]) if len(rows) > 1 else 0.0
    if shared_s < settings.signal.least_s or len(rows) < settings.signal.least_samples:
        raise DataError(
            f"{shared_s:.1f} s and {len(rows)} samples of {name} are shared with the simulation",
            where=name,
            expected=f"at least {settings.signal.least_s:g} s and {settings.signal.least_samples} samples",
            fix="Give logs of the same time, or longer ones",
        )
    part = slice(int(rows[0]), int(rows[-1]) + 1)
    channels = {other: (seconds(fields.t_ns, start_ns), fields.values) for other, fields in others.items() if len(fields) > 1}
    ideal, sim_density = _ideal(t_sim, sim.values, period_sim, period_real, channels, settings)
    held_out, usable = split(t_real[part], settings.split)
    step = np.diff(t_sim)
    for k in np.flatnonzero(step > max(settings.split.gap_periods * period_sim, 0.1)):  # what was never simulated
        usable &= (t_real[part] < t_sim[k] + early - settings.split.margin_s) | (
            t_real[part] > t_sim[k + 1] + late + settings.split.margin_s
        )
    return AlignedSignal(
        name,
        t_real[part],
        real.values[part, None],
        usable & ~held_out,
        usable & held_out,
        aligned_s=aligned_s or 0.0,
        start_ns=start_ns,
        ideal=ideal,
        unit=real.unit or sim.unit,
        lag_s=lag_s,
        sim_density=sim_density,
        shares_epoch=aligned_s is None,
        settings=settings,
    )


def _check(fields: Fields, what: str, name: str, settings: SignalSettings) -> None:
    """Refuses what holds nothing to compare.

    Raises:
        DataError: too short, not finite, stamps that do not increase, constant.
    """
    length = float(fields.t_ns[-1] - fields.t_ns[0]) * 1e-9 if len(fields) else 0.0
    if length < settings.least_s or len(fields) < settings.least_samples:
        raise DataError(
            f"the {what} has {len(fields)} samples of {name} in {length:.1f} s",
            where=name,
            expected=f"at least {settings.least_s:g} s and {settings.least_samples} samples",
            fix="Give a longer log",
        )
    if not np.isfinite(fields.values).all() or (np.diff(fields.t_ns) <= 0).any():
        raise DataError(
            f"the {what} of {name} has values that are not finite, or stamps that do not increase",
            where=name,
            expected="finite values and increasing stamps",
            fix="Cut the log where it is sound",
        )
    if np.ptp(fields.values) <= MOVES * float(np.abs(fields.values).max()):
        why = "the sensor may be dead or not connected" if what == "recording" else "it may not be simulated at all"
        raise DataError(
            f"{name} is {fields.values[0]:g} throughout the {what}",
            where=name,
            expected="a signal that varies",
            fix=f"Choose another field: {why}",
        )


def _ideal(
    t_sim: Column,
    values: Column,
    period_sim: float,
    period_real: float,
    channels: Mapping[str, tuple[Column, Column]],
    settings: DiagnoseSettings,
) -> tuple[IdealSignal, float]:
    """The simulation without white noise on a fine clock, and the density of that noise."""
    t_even = t_sim[0] + period_sim * np.arange(int((t_sim[-1] - t_sim[0]) / period_sim) + 1)
    even = np.interp(t_even, t_sim, values) if _jumps(values) else np.asarray(make_interp_spline(t_sim, values, k=3)(t_even))
    f_hz, power = welch(even, 1.0 / period_sim, nperseg=min(settings.noise.segment_samples, len(even)), average="median")
    top = (f_hz >= settings.signal.noise_band / period_sim) & (f_hz <= settings.signal.noise_band_end / period_sim)
    rate_hz = min(settings.signal.oversampling / min(period_sim, period_real), MOST_FINE / (t_even[-1] - t_even[0]))
    t_fine = t_even[0] + np.arange(int((t_even[-1] - t_even[0]) * rate_hz) + 1) / rate_hz
    clean = wiener_filter(even, settings.alignment)
    fine = np.interp(t_fine, t_even, clean) if _jumps(values) else np.asarray(make_interp_spline(t_even, clean, k=3)(t_fine))
    return IdealSignal(float(t_fine[0]), rate_hz, fine, channels), float(np.median(power[top]))


def _jumps(values: Column) -> bool:
    """Whether a signal holds still for most samples, as a command does.

    A spline would ring about its steps.
    """
    return float((np.diff(values) == 0.0).mean()) > 0.5


def _lag(
    t_real: Column, real: Column, t_sim: Column, sim: Column, name: str, settings: DiagnoseSettings
) -> tuple[float, float | None]:
    """Lag (s) of the recording at first sight, and the clock shift (s) if no epoch is shared.

    Raises:
        DataError: nowhere are the two alike.
    """
    own = settings.signal
    a, b = _smooth(t_real, real, own.align_hz), _smooth(t_sim, sim, own.align_hz)
    correlation = correlate(a, b, mode="full") / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-300)
    lags = correlation_lags(len(a), len(b)) / own.align_hz + float(t_real[0] - t_sim[0])
    shared = min(t_real[-1], t_sim[-1]) - max(t_real[0], t_sim[0])
    length = min(t_real[-1] - t_real[0], t_sim[-1] - t_sim[0])
    near = np.abs(lags) <= settings.alignment.farthest_s
    if shared > max(own.least_s, 0.5 * length) and near.any() and np.abs(correlation[near]).max() > own.least_correlation:
        return float(lags[near][np.argmax(np.abs(correlation[near]))]), None
    best = int(np.argmax(correlation))
    if correlation[best] < own.least_correlation:
        raise DataError(
            f"recording and simulation of {name} are not alike (correlation {correlation[best]:.2f} at best)",
            where=name,
            expected="one motion",
            fix="Simulate what was recorded, or choose another field",
        )
    return 0.0, -float(lags[best])


def _smooth(t_s: Column, values: Column, rate_hz: float) -> Float64[np.ndarray, " _"]:
    """On an even clock, without its mean."""
    at = np.arange(t_s[0], t_s[-1], 1.0 / rate_hz)
    even = np.interp(at, t_s, values)
    return np.asarray(even - even.mean())
