"""Any other signal of a log, aligned with its simulation: one clock, no simulation noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64
from scipy.interpolate import make_interp_spline
from scipy.signal import correlate, correlation_lags, welch

from imutool.diagnosis.estimation.aligned_log import AlignedLog, Blocks, Variables, split
from imutool.diagnosis.estimation.alignment import wiener_filter
from imutool.diagnosis.settings import DiagnoseSettings, SignalSettings
from imutool.errors import DataError
from imutool.mcap_io.fields import Fields
from imutool.recording import seconds
from imutool.sensor.effect import SignalState
from imutool.sensor.robot_effects.joint_dynamics import WELL_DETERMINED, Dynamics, identified
from imutool.sensor.robot_effects.signal_samples import IdealSignal, Scale, SignalSamples, moved
from imutool.sensor.robot_effects.wheel import WheelRelation

MOVES = 1e-9  # of its largest value, below which a signal is constant
MOST_FINE = 20_000_000  # samples
ENDS_S = 0.5  # of a motion, where its derivatives are not known
Column = Float64[np.ndarray, "_"]


@dataclass(frozen=True, eq=False)
class SignalPair:
    """Columns of a recording and of its simulation that are compared together, by the stamps of one topic each.

    `kind` chooses the effects. `state` is what the columns depend on in the recording (`q0`, `R00`, `speed`), and `sim_state` the
    same in the simulation, from which the relation between the two is learnt. Columns that follow from the state by such a
    relation are compared at the recorded motion, whatever the simulated one is.
    """

    name: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    real_ns: Int64[np.ndarray, " n"]
    real: Float64[np.ndarray, "n k"]
    sim_ns: Int64[np.ndarray, " m"]
    sim: Float64[np.ndarray, "m k"]
    kind: str = "number"
    state: Mapping[str, Fields] = field(default_factory=dict)
    sim_state: Mapping[str, Fields] = field(default_factory=dict)

    @classmethod
    def of_fields(cls, real: Fields, sim: Fields, name: str) -> SignalPair:
        """One plain number."""
        columns = (values.values[:, None] for values in (real, sim))
        return cls(name, (name,), (real.unit or sim.unit,), real.t_ns, next(columns), sim.t_ns, next(columns))


@dataclass(frozen=True, eq=False, kw_only=True)
class AlignedSignal(AlignedLog):
    """Recorded columns with the ideal signal.

    `lag_s` is how much later the recording follows at first sight, `sim_density` the density of the simulation's own noise, by
    column.
    """

    ideal: IdealSignal
    names: tuple[str, ...]
    units: tuple[str, ...]
    kind: str
    lag_s: float
    sim_density: Float64[np.ndarray, " k"]
    shares_epoch: bool

    exact, denoised = True, False

    @property
    def bias_std(self) -> Float64[np.ndarray, " k"]:
        """The offset is an effect, which acts before saturation."""
        return np.full(self.columns, 1e-9)

    def state(self) -> SignalState:
        """The ideal signal, to be sampled at the stamps."""
        return SignalState(self.ideal, self.stamp_s, self.stamp_s)

    def blocks(self, samples: SignalSamples) -> Blocks:
        """All columns."""
        return ((0, samples.y),)

    @property
    def signals(self) -> Mapping[str, slice]:
        """Each column by its name."""
        return {name: slice(k, k + 1) for k, name in enumerate(self.names)}

    def unit_of(self, signal: str) -> str:
        """Unit of a column."""
        return self.units[self.names.index(signal)]

    def variables(self) -> Variables:
        """Values, rates of change, the state, time and the channels of the log."""
        sampled, out = self.sampled, {}
        for k, (name, unit) in enumerate(zip(self.names, self.units, strict=True)):
            of = "its" if self.columns == 1 else f"{name.rpartition('.')[2]}'s"
            x = sampled.x[:, k]
            out[f"{of} value"] = unit, x
            out[f"{of} size"] = unit, np.abs(x - np.median(x))
            out[f"{of} rate of change"] = f"{unit}/s", np.abs(sampled.dx[:, k])
        out["time"] = "s", self.stamp_s
        out |= {
            STATE_WORDS.get(name.rstrip("0123456789"), "{}").format(name[-1]): ("", np.abs(values))
            for name, values in sampled.state.items()
            if name.rstrip("0123456789") in STATE_WORDS
        }
        channels = self.ideal.channels.items()
        return out | {name: ("", np.interp(self.stamp_s, at_s, values)) for name, (at_s, values) in channels}

    def recorded(self) -> tuple[IdealSignal, SignalSamples]:
        """The ideal signal, and its samples with the recorded columns as their value."""
        return self.ideal, self.sampled.but(self.real)

    @cached_property
    def sampled(self) -> SignalSamples:
        """The ideal signal at the stamps."""
        return self.ideal.sample(self.stamp_s, self.stamp_s)

    def scale(self) -> Scale:
        """Sizes from which effects take their plausible parameters."""
        sampled, relation = self.sampled, self.ideal.relation
        size, slope = (tuple(np.maximum(v.std(axis=0), 1e-12).tolist()) for v in (sampled.x, sampled.dx))
        state = {name: moved(values) for name, values in sampled.state.items()} | {
            name: moved(values) for name, (_, values) in self.ideal.channels.items()
        }
        dynamics = relation if isinstance(relation, Dynamics) else None
        duration_s = float(self.stamp_s[-1] - self.stamp_s[0])
        return Scale(self.names, self.units, size, slope, self.lag_s, duration_s, state, dynamics)


STATE_WORDS = {"dq": "speed of joint {}", "ddq": "acceleration of joint {}", "speed": "speed"}


def aligned(pair: SignalPair, others: Mapping[str, Fields], settings: DiagnoseSettings) -> AlignedSignal:
    """Align columns with their simulation, in seconds from the first sample.

    Raises:
        DataError: constant, too short or too few, or nothing alike in the two.
    """
    for k, name in enumerate(pair.names):
        for t_ns, values, what in ((pair.real_ns, pair.real, "recording"), (pair.sim_ns, pair.sim, "simulation")):
            _check(t_ns, values[:, k], what, name, settings.signal)
    start_ns = int(pair.real_ns[0])
    channels = {other: (seconds(fields.t_ns, start_ns), fields.values) for other, fields in others.items() if len(fields) > 1}
    channels |= {
        name: (seconds(pair.real_ns, start_ns), pair.real[:, k]) for k, name in enumerate(pair.names) if pair.sim_state
    }
    if pair.sim_state:
        return _at_recorded_motion(pair, channels, settings)
    t_real, t_sim = seconds(pair.real_ns, start_ns), seconds(pair.sim_ns, start_ns)
    lag_s, aligned_s = _lag(t_real, pair.real, t_sim, pair.sim, pair.names, settings)
    if aligned_s is not None:
        t_sim, lag_s = t_sim - aligned_s, 0.0
    period_real, period_sim = float(np.median(np.diff(t_real))), float(np.median(np.diff(t_sim)))
    early, late = min(0.0, lag_s), max(0.0, lag_s)
    rows = np.flatnonzero((t_real - late >= t_sim[0]) & (t_real - early <= t_sim[-1]))
    _refuse_little(t_real[rows], pair.name, settings.signal)
    part = slice(int(rows[0]), int(rows[-1]) + 1)
    ideal, sim_density = _ideal(t_sim, pair.sim, period_sim, period_real, settings)
    state = _state_on(ideal, pair.state, start_ns)
    held_out, usable = split(t_real[part], settings.split)
    step = np.diff(t_sim)
    for k in np.flatnonzero(step > max(settings.split.gap_periods * period_sim, 0.1)):  # what was never simulated
        usable &= (t_real[part] < t_sim[k] + early - settings.split.margin_s) | (
            t_real[part] > t_sim[k + 1] + late + settings.split.margin_s
        )
    return AlignedSignal(
        pair.name,
        t_real[part],
        pair.real[part],
        usable & ~held_out,
        usable & held_out,
        aligned_s=aligned_s or 0.0,
        start_ns=start_ns,
        ideal=replace(ideal, channels=channels, state=state),
        names=pair.names,
        units=pair.units,
        kind=pair.kind,
        lag_s=lag_s,
        sim_density=sim_density,
        shares_epoch=aligned_s is None,
        settings=settings,
    )


# ── columns that follow from a state ──


def _at_recorded_motion(
    pair: SignalPair, channels: Mapping[str, tuple[Column, Column]], settings: DiagnoseSettings
) -> AlignedSignal:
    """The simulation's relation between state and columns, at the state of the recording.

    Raises:
        DataError: the columns of the simulation do not follow from its state.
    """
    sim_s, _, sim_state = motion(pair.sim_state, settings)
    own_s = seconds(pair.sim_ns, int(next(iter(pair.sim_state.values())).t_ns[0]))
    inside = (own_s > sim_s[0] + ENDS_S) & (own_s < sim_s[-1] - ENDS_S)
    simulated = {name: np.interp(own_s[inside], sim_s, values) for name, values in sim_state.items()}
    relation = RELATIONS[pair.kind](simulated, pair.sim[inside])
    if relation is None:
        raise DataError(
            f"the {pair.name} of the simulation do not follow from its motion",
            where=pair.name,
            expected="efforts of an arm, or speeds of wheels, by the simulation's own motion",
            fix="Record positions and velocities of all joints",
        )
    left = pair.sim[inside] - relation(simulated)
    t_s, rate_hz, state = motion(pair.state, settings)
    start_ns = int(pair.real_ns[0])
    first_s = float(seconds(next(iter(pair.state.values())).t_ns[:1], start_ns)[0])
    ideal = IdealSignal(float(t_s[0]) + first_s, rate_hz, relation(state), channels, state, relation)
    t_real = seconds(pair.real_ns, start_ns)
    covered = np.flatnonzero((t_real > ideal.start_s + ENDS_S) & (t_real < first_s + t_s[-1] - ENDS_S))
    _refuse_little(t_real[covered], pair.name, settings.signal)
    part = slice(int(covered[0]), int(covered[-1]) + 1)
    held_out, usable = split(t_real[part], settings.split)
    period_sim = float(np.median(np.diff(own_s)))
    return AlignedSignal(
        pair.name,
        t_real[part],
        pair.real[part],
        usable & ~held_out,
        usable & held_out,
        start_ns=start_ns,
        ideal=ideal,
        names=pair.names,
        units=pair.units,
        kind=pair.kind,
        lag_s=0.0,
        sim_density=2.0 * period_sim * left.var(axis=0),
        shares_epoch=True,
        settings=settings,
    )


def motion(fields: Mapping[str, Fields], settings: DiagnoseSettings) -> tuple[Column, float, dict[str, Column]]:
    """State on a fine even clock (s from its first sample), without white noise, with accelerations.

    Raises:
        DataError: too few samples, or gaps.
    """
    first = next(iter(fields.values()))
    t_s = seconds(first.t_ns, int(first.t_ns[0]))
    period = float(np.median(np.diff(t_s)))
    values = np.stack([own.values for own in fields.values()], axis=1)
    ideal, _ = _ideal(t_s, values, period, period, settings)
    at_s = ideal.start_s + np.arange(len(ideal.fine)) / ideal.rate_hz
    state = dict(zip(fields, ideal.fine.T, strict=True))
    out = dict(state)
    for name, column in state.items():
        if name.startswith("q") and f"d{name}" not in state:
            out[f"d{name}"] = np.gradient(column) * ideal.rate_hz
    for name in [name for name in out if name.startswith("dq")]:
        out[f"d{name}"] = np.gradient(out[name]) * ideal.rate_hz
    return at_s, ideal.rate_hz, out


def _wheels(state: Mapping[str, Column], columns: Float64[np.ndarray, "_ k"]) -> WheelRelation | None:
    speeds = np.stack(list(state.values()), axis=1)
    weights, *_ = np.linalg.lstsq(speeds, columns, rcond=None)
    left = (columns - speeds @ weights).std(axis=0)
    return WheelRelation(weights) if (left < WELL_DETERMINED * columns.std(axis=0)).all() else None


RELATIONS: Mapping[str, Callable[[Any, Any], Dynamics | WheelRelation | None]] = {"efforts": identified, "wheels": _wheels}


def _state_on(ideal: IdealSignal, state: Mapping[str, Fields], start_ns: int) -> dict[str, Column]:
    """State of the recording on the clock of the ideal signal."""
    at_s = ideal.start_s + np.arange(len(ideal.fine)) / ideal.rate_hz
    return {name: np.interp(at_s, seconds(own.t_ns, start_ns), own.values) for name, own in state.items()}


def _refuse_little(t_s: Column, name: str, settings: SignalSettings) -> None:
    """Refuses a short time.

    Raises:
        DataError: less than the settings say.
    """
    shared_s = float(t_s[-1] - t_s[0]) if len(t_s) > 1 else 0.0
    if shared_s < settings.least_s or len(t_s) < settings.least_samples:
        raise DataError(
            f"{shared_s:.1f} s and {len(t_s)} samples of {name} are shared with the simulation",
            where=name,
            expected=f"at least {settings.least_s:g} s and {settings.least_samples} samples",
            fix="Give logs of the same time, or longer ones",
        )


def _check(t_ns: Int64[np.ndarray, " n"], values: Column, what: str, name: str, settings: SignalSettings) -> None:
    """Refuses what holds nothing to compare.

    Raises:
        DataError: too short, not finite, stamps that do not increase, constant.
    """
    length = float(t_ns[-1] - t_ns[0]) * 1e-9 if len(t_ns) else 0.0
    if length < settings.least_s or len(t_ns) < settings.least_samples:
        raise DataError(
            f"the {what} has {len(t_ns)} samples of {name} in {length:.1f} s",
            where=name,
            expected=f"at least {settings.least_s:g} s and {settings.least_samples} samples",
            fix="Give a longer log",
        )
    if not np.isfinite(values).all() or (np.diff(t_ns) <= 0).any():
        raise DataError(
            f"the {what} of {name} has values that are not finite, or stamps that do not increase",
            where=name,
            expected="finite values and increasing stamps",
            fix="Cut the log where it is sound",
        )
    if np.ptp(values) <= MOVES * float(np.abs(values).max()):
        why = "the sensor may be dead or not connected" if what == "recording" else "it may not be simulated at all"
        raise DataError(
            f"{name} is {values[0]:g} throughout the {what}",
            where=name,
            expected="a signal that varies",
            fix=f"Choose another field: {why}",
        )


def _ideal(
    t_sim: Column, values: Float64[np.ndarray, "_ k"], period_sim: float, period_real: float, settings: DiagnoseSettings
) -> tuple[IdealSignal, Float64[np.ndarray, " k"]]:
    """The simulation without white noise on a fine clock, and the density of that noise, by column."""
    t_even = t_sim[0] + period_sim * np.arange(int((t_sim[-1] - t_sim[0]) / period_sim) + 1)
    rate_hz = min(settings.signal.oversampling / min(period_sim, period_real), MOST_FINE / (t_even[-1] - t_even[0]))
    t_fine = t_even[0] + np.arange(int((t_even[-1] - t_even[0]) * rate_hz) + 1) / rate_hz
    fine, density = [], []
    for column in values.T:
        even, jumps = _resampled(t_sim, column, t_even), _jumps(column)
        f_hz, power = welch(even, 1.0 / period_sim, nperseg=min(settings.noise.segment_samples, len(even)), average="median")
        top = (f_hz >= settings.signal.noise_band / period_sim) & (f_hz <= settings.signal.noise_band_end / period_sim)
        clean = wiener_filter(even, settings.alignment)
        fine.append(np.interp(t_fine, t_even, clean) if jumps else np.asarray(make_interp_spline(t_even, clean, k=3)(t_fine)))
        density.append(float(np.median(power[top])))
    return IdealSignal(float(t_fine[0]), rate_hz, np.stack(fine, axis=1), {}), np.array(density)


def _resampled(t_s: Column, values: Column, at_s: Column) -> Column:
    """On other times: along splines, or straight lines where a signal jumps."""
    return np.interp(at_s, t_s, values) if _jumps(values) else np.asarray(make_interp_spline(t_s, values, k=3)(at_s))


def _jumps(values: Column) -> bool:
    """Whether a signal holds still for most samples, as a command does.

    A spline would ring about its steps.
    """
    return float((np.diff(values) == 0.0).mean()) > 0.5


def _lag(
    t_real: Column,
    real: Float64[np.ndarray, "_ k"],
    t_sim: Column,
    sim: Float64[np.ndarray, "_ k"],
    names: Sequence[str],
    settings: DiagnoseSettings,
) -> tuple[float, float | None]:
    """Lag (s) of the recording at first sight, and the clock shift (s) if no epoch is shared.

    Raises:
        DataError: nowhere are the two alike.
    """
    own = settings.signal
    a, b = (
        np.stack([_smooth(t_s, column, own.align_hz) for column in values.T]) for t_s, values in ((t_real, real), (t_sim, sim))
    )
    if len(names) > 1:  # columns of one size each, so that none decides for all
        size = np.maximum(b.std(axis=1, keepdims=True), 1e-300)
        a, b = a / size, b / size
    total = np.sum([correlate(x, y, mode="full") for x, y in zip(a, b, strict=True)], axis=0)
    correlation = total / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-300)
    lags = correlation_lags(a.shape[1], b.shape[1]) / own.align_hz + float(t_real[0] - t_sim[0])
    shared = min(t_real[-1], t_sim[-1]) - max(t_real[0], t_sim[0])
    length = min(t_real[-1] - t_real[0], t_sim[-1] - t_sim[0])
    near = np.abs(lags) <= settings.alignment.farthest_s
    if shared > max(own.least_s, 0.5 * length) and near.any() and np.abs(correlation[near]).max() > own.least_correlation:
        return float(lags[near][np.argmax(np.abs(correlation[near]))]), None
    best = int(np.argmax(correlation))
    if correlation[best] < own.least_correlation:
        raise DataError(
            f"recording and simulation of {names[0]} are not alike (correlation {correlation[best]:.2f} at best)",
            where=names[0],
            expected="one motion",
            fix="Simulate what was recorded, or choose another field",
        )
    return 0.0, -float(lags[best])


def _smooth(t_s: Column, values: Column, rate_hz: float) -> Float64[np.ndarray, " _"]:
    """On an even clock, without its mean."""
    at = np.arange(t_s[0], t_s[-1], 1.0 / rate_hz)
    even = np.interp(at, t_s, values)
    return np.asarray(even - even.mean())
