"""Ideal signals: simulated columns without noise, or a relation at the recorded motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import Any

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import make_interp_spline
from scipy.signal import firwin, welch

from imutool.array_types import Float64, Int64
from imutool.diagnosis.estimation.whitening import Band
from imutool.diagnosis.settings import DiagnoseSettings, SignalSettings
from imutool.errors import DataError
from imutool.inertial.correlation import time_ahead_s
from imutool.inertial.wiener import wiener_filter
from imutool.mcap_io.fields import Fields
from imutool.recording import seconds
from imutool.sensor.robot_effects.joint_dynamics import WELL_DETERMINED, Dynamics, following, identified
from imutool.sensor.robot_effects.signal_samples import IdealSignal
from imutool.sensor.robot_effects.wheel import WheelRelation

MAX_FINE, STEP_ROUNDS = 20_000_000, 3  # samples; until the half step of a simulator is known
WIDER, FILTER_PERIODS = 2.0, 2.0  # of a motion's filter: it changes nothing within the band
SEGMENT = 512  # samples of a velocity's spectrum
WAY_S, CONTRADICTS, WHOLE = 1.0, 0.5, 0.8  # of a way, the share by which two may differ, and of its samples without a gap
ENDS_S = 0.5  # of a motion, where its derivatives are not known
Column = Float64[np.ndarray, "_"]


@dataclass(frozen=True, eq=False)
class SignalPair:
    """Columns of a recording and of its simulation that are compared together.

    `kind` chooses the effects. `state` is what the columns depend on in the recording (`q0`, `R00`, `speed`), and `sim_state`
    the same in the simulation, from which the relation between the two is learnt. Columns that follow from the state by such
    a relation are compared at the recorded motion, whatever the simulated one is.
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
    clock_s: float | None = None  # of the simulation, which other signals of the two logs know
    clock_std_s: float = 0.0  # of the simulation's stamps against the recording's

    @classmethod
    def of_fields(cls, real: Fields, sim: Fields, name: str) -> SignalPair:
        """One plain number."""
        columns = (values.values[:, None] for values in (real, sim))
        return cls(name, (name,), (real.unit or sim.unit,), real.t_ns, next(columns), sim.t_ns, next(columns))

    @classmethod
    def of_columns(
        cls,
        topic: str,
        paths: tuple[str, ...],
        kind: str,
        units: tuple[str, ...],
        real: Mapping[str, Fields],
        sim: Mapping[str, Fields],
        state: Mapping[str, Fields],
        sim_state: Mapping[str, Fields] | None = None,
    ) -> SignalPair:
        """Fields of one message, at the stamps that all of them have."""
        names = tuple(f"{topic}.{path}" for path in paths)
        (real_ns, real_values), (sim_ns, sim_values) = (stacked([side[path] for path in paths]) for side in (real, sim))
        return cls(topic, names, units, real_ns, real_values, sim_ns, sim_values, kind, state, sim_state or {})


def stacked(columns: Sequence[Fields]) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, "n k"]]:
    """Stamps that all columns have, and their values there."""
    t_ns = reduce(np.intersect1d, [column.t_ns for column in columns])
    return t_ns, np.stack([column.values[np.isin(column.t_ns, t_ns)] for column in columns], axis=1)


def at_recorded_motion(
    pair: SignalPair, channels: Mapping[str, tuple[Column, Column]], settings: DiagnoseSettings
) -> tuple[IdealSignal, Float64[np.ndarray, " k"]]:
    """The simulated relation at the recorded state, and the density of its error.

    Raises:
        DataError: the columns of the simulation do not follow from its state.
    """
    for side, log in ((pair.state, "recording"), (pair.sim_state, "simulation")):
        _refuse_contradictory(side, pair, log)
    if pair.kind == "efforts":
        _refuse_fast(pair, settings.signal)
    sim_s, _, sim_state = motion(pair.sim_state, settings)
    own_s = seconds(pair.sim_ns, int(next(iter(pair.sim_state.values())).t_ns[0]))
    inside = (own_s > sim_s[0] + ENDS_S) & (own_s < sim_s[-1] - ENDS_S)
    ahead_s, simulated = 0.0, dict[str, Column]()
    relation: Dynamics | WheelRelation | None = None
    for _ in range(STEP_ROUNDS):  # a simulator holds its efforts for a step, so they come half a step before their motion
        simulated = {name: np.interp(own_s[inside] + ahead_s, sim_s, values) for name, values in sim_state.items()}
        relation = RELATIONS[pair.kind](simulated, pair.sim[inside], relation)
        if relation is None:
            raise DataError(
                f"the {pair.kind} of {pair.name} do not follow from the motion in the simulation",
                where=pair.name,
                expected="efforts of an arm, or speeds of wheels, by the simulation's own motion",
                fix="Record positions and velocities of all joints",
            )
        ahead_s += time_ahead_s(relation(simulated), pair.sim[inside], own_s[inside])
    assert relation is not None
    residual = pair.sim[inside] - relation(simulated)
    t_s, rate_hz, state = motion(pair.state, settings)
    first_s = float(seconds(next(iter(pair.state.values())).t_ns[:1], int(pair.real_ns[0]))[0])
    ideal = IdealSignal(float(t_s[0]) + first_s - ahead_s, rate_hz, relation(state), channels, state, relation)
    return ideal, 2.0 * float(np.median(np.diff(own_s))) * residual.var(axis=0)


def simulated_motion(pair: SignalPair, settings: DiagnoseSettings) -> tuple[dict[str, Column], Float64[np.ndarray, "n k"]]:
    """Simulated state at the stamps of the simulated efforts, and those efforts.

    Raises:
        DataError: too few samples, or gaps.
    """
    sim_s, _, state = motion(pair.sim_state, settings)
    own_s = seconds(pair.sim_ns, int(next(iter(pair.sim_state.values())).t_ns[0]))
    inside = (own_s > sim_s[0] + ENDS_S) & (own_s < sim_s[-1] - ENDS_S)
    return {name: np.interp(own_s[inside], sim_s, values) for name, values in state.items()}, pair.sim[inside]


def without_others(pair: SignalPair, settings: DiagnoseSettings) -> SignalPair | None:
    """Efforts of the joints that follow from the motion, without those of a gripper."""
    kept = following(*simulated_motion(pair, settings)) if pair.kind == "efforts" else []
    if not 0 < len(kept) < len(pair.names):
        return None
    states = [
        {f"{kind}{n}": side[f"{kind}{k}"] for n, k in enumerate(kept) for kind in ("q", "dq") if f"{kind}{k}" in side}
        for side in (pair.state, pair.sim_state)
    ]
    names, units = (tuple(of[k] for k in kept) for of in (pair.names, pair.units))
    real, sim = pair.real[:, kept], pair.sim[:, kept]
    return replace(pair, names=names, units=units, real=real, sim=sim, state=states[0], sim_state=states[1])


def _refuse_contradictory(state: Mapping[str, Fields], pair: SignalPair, log: str) -> None:
    """Refuses velocities that are no rates of the positions next to them.

    They are compared by the way of each second: a velocity that is filtered, or late, goes the same way but for a small part.
    """
    contradictions = list[tuple[float, float, float, str]]()
    for label in (label for label in state if label.startswith("q") and f"d{label}" in state):
        position, velocity = state[label], state[f"d{label}"]
        t_s, own_s = (seconds(side.t_ns, int(position.t_ns[0])) for side in (position, velocity))
        at_s = np.arange(max(0.0, own_s[0]), min(t_s[-1], own_s[-1]), WAY_S)
        gone = np.interp(at_s, own_s, cumulative_trapezoid(velocity.values, own_s, initial=0))
        counts = np.array([np.diff(np.searchsorted(stamps, at_s)) for stamps in (t_s, own_s)])
        whole = (counts > WHOLE * counts.max(axis=1, initial=0, keepdims=True)).all(axis=0)
        paths = np.diff([np.interp(at_s, t_s, position.values), gone], axis=1)[:, whole]
        if paths.size:
            by_position, by_velocity, difference = np.sqrt((np.stack([*paths, paths[1] - paths[0]]) ** 2).mean(axis=1))
            share = float(difference / max(by_position, by_velocity, position.values.std(), 1e-300))
            contradictions.append((share, by_velocity, by_position, pair.names[int(label.removeprefix("q"))]))
    share, by_velocity, by_position, name = max(contradictions, default=(0.0, 0.0, 0.0, ""))
    if share > CONTRADICTS:
        raise DataError(
            f"the velocity next to {name} is not the rate of the position in the {log}:"
            f" {by_velocity:.3g} rad a second by the velocity, {by_position:.3g} by the position",
            where=name,
            expected="velocities that are the rates of the positions",
            fix="Record both of the same joint and in one unit, or the positions alone",
        )


def motion(fields: Mapping[str, Fields], settings: DiagnoseSettings) -> tuple[Column, float, dict[str, Column]]:
    """State on an even clock (s from its first sample), slow enough to be differentiated.

    Raises:
        DataError: too few samples, or gaps.
    """
    first = next(iter(fields.values()))
    t_s = seconds(first.t_ns, int(first.t_ns[0]))
    rate_hz = 1.0 / float(np.median(np.diff(t_s)))
    at_s = np.arange(int((t_s[-1] - t_s[0]) * rate_hz) + 1) / rate_hz
    even = np.stack([np.interp(at_s, t_s, own.values) for own in fields.values()], axis=1)
    cutoff_hz = WIDER * band_hz(fields, rate_hz, settings.signal)
    slow = Band(firwin(2 * round(FILTER_PERIODS * rate_hz / cutoff_hz) + 1, cutoff_hz, fs=rate_hz), 1)
    line = even[0] + np.outer(at_s / at_s[-1], even[-1] - even[0])  # beyond its ends a filter sees zeros
    out = dict(zip(fields, (line + slow(even - line)).T, strict=True))
    unfiltered = {f"v{name[2:]}": column for name, column in zip(fields, even.T, strict=True) if name.startswith("dq")}
    for name in [name for name in out if name.startswith("q")]:
        rate, inner = _slope(at_s, out[name]), (at_s > ENDS_S) & (at_s < at_s[-1] - ENDS_S)
        if f"d{name}" in out:  # of a semi-implicit integrator half a step late, of a filter as late as it is
            late_s = -time_ahead_s(rate[inner], out[f"d{name}"][inner], at_s[inner])
            for side, velocity in ((out, f"d{name}"), (unfiltered, f"v{name[1:]}")):
                side[velocity] = np.interp(at_s + late_s, at_s, side[velocity])
        out.setdefault(f"d{name}", rate)
    for name in [name for name in out if name.startswith("dq")]:
        out[f"d{name}"] = _slope(at_s, out[name])
        out[f"v{name[2:]}"] = unfiltered.get(f"v{name[2:]}", out[name])  # a filter moves the time at which friction turns
    return at_s, rate_hz, out


def band_hz(fields: Mapping[str, Fields], rate_hz: float, settings: SignalSettings) -> float:
    """Frequency up to which a motion is compared: above, its accelerations are noise.

    A motion that is faster, as where a controller oscillates, is compared as far as its samples can be differentiated.
    """
    max_hz = settings.motion_band_share * rate_hz
    slow_hz = min(settings.motion_band_hz, max_hz)
    return max_hz if _faster(fields, rate_hz, slow_hz) > settings.motion_beyond_band else slow_hz


def _faster(fields: Mapping[str, Fields], rate_hz: float, above_hz: float) -> float:
    """Share of the squared velocities of all joints above a frequency."""
    total, fast = 0.0, 0.0
    for name, own in fields.items():
        rates = own.values if name.startswith("dq") else np.gradient(own.values) * rate_hz
        if name.startswith("dq") or (name.startswith("q") and f"d{name}" not in fields):
            f_hz, power = welch(rates, rate_hz, nperseg=min(SEGMENT, len(rates)))
            total, fast = total + float(power.sum()), fast + float(power[f_hz > above_hz].sum())
    return fast / max(total, 1e-300)


def _refuse_fast(pair: SignalPair, settings: SignalSettings) -> None:
    """Refuses an arm whose motion is too fast for its samples to be differentiated."""
    for state, log in ((pair.state, "recording"), (pair.sim_state, "simulation")):
        rate_hz = 1e9 / float(np.median(np.diff(next(iter(state.values())).t_ns)))
        max_hz = settings.motion_band_share * rate_hz
        if (share := _faster(state, rate_hz, max_hz)) > settings.motion_beyond_band:
            raise DataError(
                f"{share:.0%} of the squared velocities of {pair.name} in the {log} are faster than {max_hz:.3g} Hz, as where"
                " a controller oscillates",
                where=pair.name,
                expected=f"a motion that {rate_hz:.4g} samples a second can be differentiated for",
                fix="Record faster, or with a calmer controller",
            )


def _slope(t_s: Column, values: Column) -> Column:
    """Derivative along a spline of fifth degree."""
    return np.asarray(make_interp_spline(t_s, values, k=5)(t_s, 1))


def _wheels(state: Mapping[str, Column], columns: Float64[np.ndarray, "_ k"], _: WheelRelation | None) -> WheelRelation | None:
    speeds = np.stack(list(state.values()), axis=1)
    weights = np.linalg.lstsq(speeds, columns, rcond=None)[0]
    residual_std = (columns - speeds @ weights).std(axis=0)
    return WheelRelation(weights) if (residual_std < WELL_DETERMINED * columns.std(axis=0)).all() else None


RELATIONS: Mapping[str, Callable[[Any, Any, Any], Dynamics | WheelRelation | None]] = {"efforts": identified, "wheels": _wheels}


def state_on(ideal: IdealSignal, state: Mapping[str, Fields], start_ns: int) -> dict[str, Column]:
    """State of the recording on the clock of the ideal signal."""
    at_s = ideal.start_s + np.arange(len(ideal.fine)) / ideal.rate_hz
    return {name: np.interp(at_s, seconds(own.t_ns, start_ns), own.values) for name, own in state.items()}


def from_simulation(
    t_sim: Column, values: Float64[np.ndarray, "_ k"], period_sim: float, rate_hz: float, settings: DiagnoseSettings
) -> tuple[IdealSignal, Float64[np.ndarray, " k"]]:
    """The simulation without white noise on a fine clock, and the density of that noise."""
    t_even = t_sim[0] + period_sim * np.arange(int((t_sim[-1] - t_sim[0]) / period_sim) + 1)
    rate_hz = min(rate_hz, MAX_FINE / (t_even[-1] - t_even[0]))
    t_fine = t_even[0] + np.arange(int((t_even[-1] - t_even[0]) * rate_hz) + 1) / rate_hz
    fine, density = [], []
    for column in values.T:
        even, jumps = _resampled(t_sim, column, t_even), _jumps(column)
        f_hz, power = welch(even, 1.0 / period_sim, nperseg=settings.noise.segment_of(len(even)), average="median")
        top = (f_hz >= settings.signal.noise_band / period_sim) & (f_hz <= settings.signal.noise_band_end / period_sim)
        clean = wiener_filter(even[:, None], 1.0 / period_sim, settings.alignment)[:, 0]
        fine.append(np.interp(t_fine, t_even, clean) if jumps else np.asarray(make_interp_spline(t_even, clean, k=3)(t_fine)))
        density.append(float(np.median(power[top])))
    return IdealSignal(float(t_fine[0]), rate_hz, np.stack(fine, axis=1), {}), np.array(density)


def _resampled(t_s: Column, values: Column, at_s: Column) -> Column:
    """On other times: along splines, or straight lines where a signal jumps."""
    return np.interp(at_s, t_s, values) if _jumps(values) else np.asarray(make_interp_spline(t_s, values, k=3)(at_s))


def _jumps(values: Column) -> bool:
    """Whether a signal holds still for most samples, as a command does: a spline would ring."""
    return float((np.diff(values) == 0.0).mean()) > 0.5
