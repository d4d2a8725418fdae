"""Any other signal of a log, aligned with its simulation: one clock, no simulation noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.diagnosis.estimation.aligned_log import AlignedLog, Blocks, Variables, split
from imutool.diagnosis.estimation.jacobians import Chosen
from imutool.diagnosis.settings import DiagnoseSettings, SignalSettings
from imutool.diagnosis.signals.ideal_signal import (
    ENDS_S,
    SignalPair,
    at_recorded_motion,
    band_hz,
    from_simulation,
    state_on,
)
from imutool.diagnosis.signals.lag import lag_at_first_sight
from imutool.errors import DataError
from imutool.inertial.stationary import white_noise
from imutool.inertial.wiener import NoiseLeft
from imutool.mcap_io.fields import Fields
from imutool.recording import nanoseconds, seconds
from imutool.sensor.robot_effects.joint_dynamics import Dynamics
from imutool.sensor.robot_effects.signal_samples import IdealSignal, SignalSamples
from imutool.sensor.robot_effects.signal_sizes import Scale, moved

TIME_CONSTANTS, MAX_SETTLING = 8.0, 0.25  # to 0.03 % of a step; of the log's time
MOVES = 1e-9  # of its largest value, below which a signal is constant
Column = Float64[np.ndarray, "_"]
STATE_WORDS = {"dq": "speed of joint {}", "ddq": "acceleration of joint {}", "speed": "speed"}


@dataclass(frozen=True, eq=False, kw_only=True)
class AlignedSignal(AlignedLog):
    """Recorded columns with the ideal signal."""

    ideal: IdealSignal
    names: tuple[str, ...]
    units: tuple[str, ...]
    kind: str
    sim_density: Float64[np.ndarray, " k"]  # of the simulation's own noise, by column
    lag_s: float = 0.0  # by which the recording follows at first sight
    shares_epoch: bool = True
    clock_std_s: float = 0.0
    constants: tuple[float, ...] = ()  # factors by which recorded currents were made torques

    exact = True

    @property
    def denoised(self) -> bool:
        """Whether the simulation's samples were filtered."""
        return bool(self.sim_density.any())

    @property
    def bias_std(self) -> Float64[np.ndarray, " k"]:
        """The offset is an effect, which acts before saturation."""
        return np.full(self.columns, 1e-9)

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

    def settled(self, chosen: Chosen) -> AlignedSignal:
        """The signal without the time in which low-passes that were found forget their unknown start."""
        cutoffs = [float(theta[0]) for effect, theta in chosen if effect.name == "low_pass"]
        if not cutoffs:
            return self
        length_s = min(TIME_CONSTANTS / (2.0 * np.pi * min(cutoffs)), MAX_SETTLING * float(np.ptp(self.stamp_s)))
        known = self.stamp_s - self.ideal.start_s > length_s
        return replace(self, fitted=self.fitted & known, held_out=self.held_out & known)

    @cached_property
    def scale(self) -> Scale:
        """Sizes from which effects take their plausible parameters."""
        sampled, relation = self.sampled, self.ideal.relation
        size, slope = (tuple(np.maximum(v.std(axis=0), 1e-12).tolist()) for v in (sampled.x, sampled.dx))
        state = {name: moved(values) for name, values in sampled.state.items()} | {
            name: moved(values) for name, (_, values) in self.ideal.channels.items()
        }
        for k, name in enumerate(name for name in sampled.state if name.startswith("v")):
            state[f"noise{k}"] = float(white_noise(sampled.state[name][:, None])[0])
        dynamics = relation if isinstance(relation, Dynamics) else None
        if dynamics is not None:  # friction may be more than all that the simulation needs
            size = tuple(np.maximum(size, self.real.std(axis=0)).tolist())
        duration_s = float(self.stamp_s[-1] - self.stamp_s[0])
        return Scale(self.names, self.units, size, slope, self.lag_s, duration_s, state, dynamics)


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
        ideal, density = at_recorded_motion(pair, channels, settings)
        end_s = ideal.start_s + len(ideal.fine) / ideal.rate_hz
        t_real = seconds(pair.real_ns, start_ns)
        rows = np.flatnonzero((t_real > ideal.start_s + ENDS_S) & (t_real < end_s - ENDS_S))
        band = band_hz(pair.state, ideal.rate_hz, settings.signal) if isinstance(ideal.relation, Dynamics) else None
        return replace(_aligned(pair, ideal, rows, density, settings), band_hz=band)
    t_real, t_sim = seconds(pair.real_ns, start_ns), seconds(pair.sim_ns, start_ns)
    lag_s, aligned_s = 0.0, pair.clock_s or None
    if pair.clock_s is None:
        lag_s, aligned_s = lag_at_first_sight(pair, settings)
    if aligned_s is not None:
        t_sim, lag_s = seconds(pair.sim_ns, start_ns + nanoseconds(aligned_s)), 0.0
    period_real, period_sim = float(np.median(np.diff(t_real))), float(np.median(np.diff(t_sim)))
    early, late = min(0.0, lag_s), max(0.0, lag_s)
    rows = np.flatnonzero((t_real - late >= t_sim[0]) & (t_real - early <= t_sim[-1]))
    rate_hz = settings.signal.oversampling / min(period_sim, period_real)
    ideal, density = from_simulation(t_sim, pair.sim, period_sim, rate_hz, settings)
    ideal = replace(ideal, channels=channels, state=state_on(ideal, pair.state, start_ns))
    signal = replace(_aligned(pair, ideal, rows, density, settings), lag_s=lag_s)
    if aligned_s is not None:
        signal = replace(signal, aligned_s=aligned_s, shares_epoch=False)
    step, usable = np.diff(t_sim), np.ones(len(signal.stamp_s), bool)
    for gap in np.flatnonzero(step > max(settings.split.gap_periods * period_sim, 0.1)):  # what was never simulated
        usable &= (signal.stamp_s < t_sim[gap] + early - settings.split.margin_s) | (
            signal.stamp_s > t_sim[gap + 1] + late + settings.split.margin_s
        )
    return replace(signal, fitted=signal.fitted & usable, held_out=signal.held_out & usable)


def _aligned(
    pair: SignalPair,
    ideal: IdealSignal,
    rows: Int64[np.ndarray, " r"],
    density: Float64[np.ndarray, " k"],
    settings: DiagnoseSettings,
) -> AlignedSignal:
    """Recorded rows with their ideal signal, of one clock."""
    t_real = seconds(pair.real_ns, int(pair.real_ns[0]))
    _refuse_little(t_real[rows], pair.name, settings.signal)
    part = slice(int(rows[0]), int(rows[-1]) + 1)
    held_out, usable = split(t_real[part], settings.split)
    return AlignedSignal(
        pair.name,
        t_real[part],
        pair.real[part],
        usable & ~held_out,
        usable & held_out,
        start_ns=int(pair.real_ns[0]),
        ideal=ideal,
        names=pair.names,
        units=pair.units,
        kind=pair.kind,
        sim_density=density,
        noise_left=NoiseLeft(np.array([0.0, 0.5 / float(np.median(np.diff(t_real)))]), np.stack([density] * 2)),
        clock_std_s=pair.clock_std_s,
        settings=settings,
    )


def _refuse_little(t_s: Column, name: str, settings: SignalSettings) -> None:
    """Refuses a short time."""
    shared_s = float(t_s[-1] - t_s[0]) if len(t_s) > 1 else 0.0
    if shared_s < settings.min_s or len(t_s) < settings.min_samples:
        raise DataError(
            f"{shared_s:.1f} s and {len(t_s)} samples of {name} are shared with the simulation",
            where=name,
            expected=f"at least {settings.min_s:g} s and {settings.min_samples} samples",
            fix="Give logs of the same time, or longer ones",
        )


def _check(t_ns: Int64[np.ndarray, " n"], values: Column, what: str, name: str, settings: SignalSettings) -> None:
    """Refuses what holds nothing to compare."""
    length = float(t_ns[-1] - t_ns[0]) * 1e-9 if len(t_ns) else 0.0
    if length < settings.min_s or len(t_ns) < settings.min_samples:
        raise DataError(
            f"the {what} has {len(t_ns)} samples of {name} in {length:.1f} s",
            where=name,
            expected=f"at least {settings.min_s:g} s and {settings.min_samples} samples",
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
