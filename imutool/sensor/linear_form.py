"""Linear form of an effect: error = terms @ matrix(theta), derived from its `forward`.

A bias model needs an error that is linear in its parameters: any set of effects is then fitted together by one linear solve a
Gauss-Newton step, with the covariance of the answer. The error is `sum_p theta_p sum_q pattern[:, q, p] term_q`. Simulation
takes the terms of the true motion, debiasing of the measured one, which differs by the error times the error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from random import Random
from typing import Any

import numpy as np

from imutool.array_types import Float64, Int64, Vectors
from imutool.sensor.effect import CompiledEffect, Effect, Parameter, Stage, Theta
from imutool.sensor.samples import IdealMotion, SensorSamples
from imutool.sensor.signals import COUNT, LOAD, Signals
from imutool.units import Sensor, Three

# Size of the parameters with which `forward` is asked for an error: next to that error the reading is lost in rounding, and to
# divide by a power of two is exact. So the error has all its digits, and not only those that a reading leaves to it.
SCALE = 2.0**100
PROBE_ROWS, TERM_ROWS = 128, 20_000
SAME = 1e-9  # an effect's own basis may differ by rounding from what `forward` says


@dataclass(frozen=True, eq=False)
class Probe:
    """Parameters of a call of `forward`, and the terms that its error is: (axis, term)."""

    theta: Theta
    terms: tuple[tuple[int, int], ...]


@dataclass(frozen=True, eq=False)
class LinearForm:
    """Linear form of an effect on a sensor: its parameters and pattern [axis, term, parameter].

    columns: the signals' columns that are its terms; none where terms follow from `probes` (or the effect's own `basis`).
    base: values of the effect's parameters, zero but for those that training fixes; free: where the others stand.
    recipe: a function of a module and its arguments that make the form again, for a copy or a pickle: an effect has functions
        that do not pickle.
    """

    effect: Effect
    sensor: Sensor
    parameters: tuple[Parameter, ...]
    base: Theta
    free: Int64[np.ndarray, " p"]
    columns: Int64[np.ndarray, " q"] | None
    probes: tuple[Probe, ...]
    pattern: Float64[np.ndarray, "3 q p"]
    recipe: tuple[Callable[..., LinearForm], tuple[Any, ...]] | None = None

    def __reduce_ex__(self, protocol: Any) -> str | tuple[Any, ...]:
        return self.recipe or super().__reduce_ex__(protocol)

    @property
    def name(self) -> str:
        """The effect's name."""
        return self.effect.name

    @property
    def plausible(self) -> Float64[np.ndarray, " p"]:
        """The plausible size of each parameter."""
        return np.array([parameter.plausible for parameter in self.parameters])

    def terms(self, signals: Signals) -> Float64[np.ndarray, "n q"]:
        """The terms of the error at each sample."""
        if self.columns is not None:
            return signals.columns[:, self.columns]
        if self.effect.basis is not None:
            return self.effect.basis(signals)
        out = np.empty((len(signals.t_s), self.pattern.shape[1]))
        for probe in self.probes:
            error = _error(self.effect, self.sensor, signals, probe.theta)
            for axis, term in probe.terms:
                out[:, term] = error[:, axis]
        return out / SCALE

    def matrix(self, theta: Float64[np.ndarray, " p"]) -> Float64[np.ndarray, "q 3"]:
        """The matrix of error = terms @ matrix."""
        out: Float64[np.ndarray, "q 3"] = np.einsum("iqp,p->qi", self.pattern, theta)
        return out

    def compiled(self, theta: Float64[np.ndarray, " p"]) -> CompiledEffect:
        """The error for given parameters."""
        if self.effect.fast is not None:
            return self.effect.fast(self._scaled(theta, 1.0))
        at = self._scaled(theta, SCALE)

        def block(signals: Signals) -> Vectors:
            return _error(self.effect, self.sensor, signals, at) / SCALE

        def one(t_s: float, row: list[float]) -> Three:
            x, y, z = block(Signals(np.array([t_s]), np.array([row])))[0].tolist()
            return x, y, z

        return CompiledEffect(block, one)

    def _scaled(self, theta: Float64[np.ndarray, " p"], scale: float) -> Theta:
        out = self.base.copy()
        out[self.free] = scale * theta
        return out


@dataclass(frozen=True, eq=False)
class CompiledEffects:
    """Several effects for given parameters: one matrix on all columns, and effects without one."""

    matrix: Float64[np.ndarray, "60 3"]
    others: tuple[CompiledEffect, ...]
    forms: tuple[LinearForm, ...]
    theta: Float64[np.ndarray, " p"]

    def __reduce__(self) -> tuple[Any, ...]:
        return compiled, (self.forms, self.theta)

    @property
    def wanted(self) -> int:
        """How many of the signals' columns they need: effects without a matrix all but the load."""
        own = int(np.flatnonzero(self.matrix.any(axis=1)).max(initial=-1)) + 1
        return max(own, LOAD.start) if self.others else own

    def __call__(self, signals: Signals) -> Vectors:
        """The error at each sample of a block."""
        out: Vectors = np.dot(signals.columns, self.matrix)
        for other in self.others:
            out += other(signals)
        return out

    def others_at(self, t_s: float, row: list[float]) -> Three:
        """The error of `others` at one sample."""
        x, y, z = 0.0, 0.0, 0.0
        for other in self.others:
            dx, dy, dz = other.one(t_s, row)
            x, y, z = x + dx, y + dy, z + dz
        return x, y, z


def patterns(forms: Sequence[LinearForm]) -> Float64[np.ndarray, "3 q p"]:
    """Patterns of several effects side by side: [axis, term, parameter]."""
    terms, parameters = (sum(form.pattern.shape[k] for form in forms) for k in (1, 2))
    out, q, p = np.zeros((3, terms, parameters)), 0, 0
    for form in forms:
        _, dq, dp = form.pattern.shape
        out[:, q : q + dq, p : p + dp] = form.pattern
        q, p = q + dq, p + dp
    return out


def terms_of(forms: Sequence[LinearForm], signals: Signals) -> Float64[np.ndarray, "n q"]:
    """Terms of several effects side by side, some samples at a time."""
    out = np.empty((len(signals.t_s), sum(form.pattern.shape[1] for form in forms)))
    for rows in (slice(k, k + TERM_ROWS) for k in range(0, len(out), TERM_ROWS)):
        some = signals.rows(rows)
        np.concatenate([np.zeros((len(some.t_s), 0)), *(form.terms(some) for form in forms)], axis=1, out=out[rows])
    return out


def compiled(forms: Sequence[LinearForm], theta: Float64[np.ndarray, " p"]) -> CompiledEffects:
    """Several effects together, for given parameters in their order."""
    matrix, others, rest = np.zeros((COUNT, 3)), [], theta
    for form in forms:
        size = len(form.parameters)
        own, rest = rest[:size], rest[size:]
        if form.columns is not None:
            matrix[form.columns] += form.matrix(own)
        else:
            others.append(form.compiled(own))
    return CompiledEffects(matrix, tuple(others), tuple(forms), theta)


@lru_cache(maxsize=256)
def linear_form(effect: Effect, sensor: Sensor) -> LinearForm:
    """Linear form of an effect on a sensor, from errors of `forward` for single parameters."""
    base = np.array([parameter.fixed_in_training or 0.0 for parameter in effect.parameters])
    free = np.flatnonzero([parameter.fixed_in_training is None for parameter in effect.parameters])
    signals = _probe_signals()
    probed = base + SCALE * np.eye(len(base))[free]
    errors = np.stack([_error(effect, sensor, signals, theta) for theta in probed], axis=2) / SCALE  # [row, axis, parameter]
    reached = errors.any(axis=(0, 1))
    free, probed, errors = free[reached], probed[reached], errors[:, :, reached]
    probes: tuple[Probe, ...] = ()
    columns, term = None, _found_among(signals.columns, errors, 0.0) if effect.trained else None
    if term is not None:
        columns = np.flatnonzero(np.bincount(term[term >= 0]))  # `np.unique` would import numpy.ma
        term = np.searchsorted(columns, term, side="right") - 1
    elif effect.basis is not None:
        term = _found_among(effect.basis(signals), errors, SAME)
        assert term is not None, f"the basis of {effect.name} lacks an error that its forward makes"
    else:
        probes, term = _distinct(probed, errors)
    pattern = np.zeros((3, int(term.max(initial=-1)) + 1, len(free)))
    for axis, k in np.argwhere(term >= 0):
        pattern[axis, term[axis, k], k] = 1.0
    named = [replace(of, name=of.name.removeprefix(f"{sensor}_")) for of in (effect.parameters[k] for k in free)]
    return LinearForm(effect, sensor, tuple(named), base, free, columns, probes, pattern)


def _error(effect: Effect, sensor: Sensor, signals: Signals, theta: Theta) -> Vectors:
    """Error of a sensor's samples; of a clock to first order, the shift times the derivative."""
    if effect.stage == Stage.CLOCK:
        shift_s = effect.forward(signals.t_s, theta) - signals.t_s
        return np.asarray(shift_s[:, None] * (signals.gyro_dot if sensor == "gyro" else signals.accel_dot))
    motion = IdealMotion(signals.t_s, signals.gyro, signals.accel, signals.alpha)
    samples = SensorSamples(signals.t_s, signals.gyro, signals.accel, motion, online=signals)
    before: IdealMotion | SensorSamples = motion if effect.stage < Stage.CLOCK else samples
    after = effect.forward(before, theta)
    return np.asarray(after.gyro - before.gyro if sensor == "gyro" else after.accel - before.accel)


@cache
def _probe_signals() -> Signals:
    """Signals without any relation to one another, of sizes between a hundredth and five."""
    rng = Random(0)  # numpy.random takes 15 ms to import
    sizes = [rng.choice((-1.0, 1.0)) * 10.0 ** rng.uniform(-2.0, 0.7) for _ in range(PROBE_ROWS * COUNT)]
    return Signals(np.array([rng.uniform(1.0, 100.0) for _ in range(PROBE_ROWS)]), np.array(sizes).reshape(PROBE_ROWS, COUNT))


def _found_among(
    columns: Float64[np.ndarray, "n c"], errors: Float64[np.ndarray, "n 3 p"], tolerance: float
) -> Int64[np.ndarray, "3 p"] | None:
    """Which column each error is, -1 where it is zero; none if an error is no column."""
    found = np.full(errors.shape[1:], -1)
    for axis, k in np.argwhere(errors.any(axis=0)):
        off = np.abs(columns - errors[:, axis, k, None]).max(axis=0)
        found[axis, k] = off.argmin()
        if off.min() > tolerance:
            return None
    return found


def _distinct(
    probed: Float64[np.ndarray, "p all"], errors: Float64[np.ndarray, "n 3 p"]
) -> tuple[tuple[Probe, ...], Int64[np.ndarray, "3 p"]]:
    """Probes whose errors are the distinct terms, and the term of each error."""
    known: dict[bytes, int] = {}
    probes, found = [], np.full(errors.shape[1:], -1)
    for k, theta in enumerate(probed):
        own = []
        for axis in np.flatnonzero(errors[:, :, k].any(axis=0)):
            key = errors[:, axis, k].tobytes()
            if key not in known:
                known[key] = len(known)
                own.append((int(axis), known[key]))
            found[axis, k] = known[key]
        if own:
            probes.append(Probe(theta, tuple(own)))
    return tuple(probes), found
