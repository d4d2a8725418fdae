"""Cached forward passes through effects, and finite-difference Jacobians.

A forward pass keeps the signals before each effect, so that a change of one effect evaluates only the effects behind it.
Derivatives are differences of the effects' own forward models: an effect is one function. They cost an evaluation for each
parameter and log, so a fit keeps them by effect and evaluates only the missing ones.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from bisect import bisect
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import BSpline

from imutool.array_types import Bool, Float64, Int64
from imutool.diagnosis.estimation.aligned_log import AlignedLog
from imutool.diagnosis.estimation.whitening import Whitener
from imutool.diagnosis.settings import FitSettings
from imutool.sensor.effect import Effect, Parameter, SignalState, Stage, Theta, in_stage_order, stage_order
from imutool.sensor.samples import SensorSamples

STEP, LOG_STEP = 1e-3, 1e-3  # of the plausible size, or of the logarithm

Chosen = tuple[tuple[Effect, Theta], ...]


class AddedColumns(ABC):
    """Forward model of columns on one axis, times the parameters: they are its derivatives."""

    sensor: int
    axis: int

    @abstractmethod
    def columns_at(self, samples: SensorSamples) -> Float64[np.ndarray, "n q"]:
        """Columns at some samples, one for each parameter."""

    def added_at(self, samples: SensorSamples, theta: Theta) -> Float64[np.ndarray, " n"]:
        """What the columns add."""
        return np.asarray(self.columns_at(samples) @ theta)

    def __call__(self, samples: SensorSamples, theta: Theta) -> SensorSamples:
        """The samples with the columns on them."""
        out = (samples.gyro if self.sensor == 0 else samples.accel).copy(order="K")
        out[:, self.axis] += self.added_at(samples, theta)
        return samples.with_readings(gyro=out) if self.sensor == 0 else samples.with_readings(accel=out)


class SplineBasis:
    """Cubic B-splines, or sums of them, of one variable, constant beyond their ends.

    Where samples are many, knots are close: at even distances, what the motion rarely does would bend all the rest.
    """

    def __init__(self, inner: Float64[np.ndarray, " p"]) -> None:
        self.inner, self.knots = inner, np.concatenate([[inner[0]] * 3, inner, [inner[-1]] * 3])
        self._last: tuple[np.ndarray, np.ndarray] | None = None

    def points(self, count: int) -> Float64[np.ndarray, " k"]:
        """Values to show the curve at: more where it can bend more."""
        return np.asarray(np.interp(np.linspace(0.0, 1.0, count), np.linspace(0.0, 1.0, len(self.inner)), self.inner))

    def basis(self, x: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "n q"]:
        """The curve's basis functions at some values."""
        if self._last is None or not np.array_equal(self._last[0], x):  # derivatives ask for the same again and again
            inside = np.clip(x, self.inner[0], self.inner[-1])
            splines = BSpline.design_matrix(inside, self.knots, 3).toarray()[:, : len(self.inner) + 2]
            self._last = x.copy(), self._combined(np.asarray(splines))
        return self._last[1]

    def _combined(self, splines: Float64[np.ndarray, "n q"]) -> Float64[np.ndarray, "n q"]:
        return splines


class SplineCurve(SplineBasis, ABC):
    """Forward model of a spline curve of one variable, on one of the columns of a signal."""

    def __init__(self, variable: str, unit: str, inner: Float64[np.ndarray, " p"], columns: int = 1, axis: int = 0) -> None:
        super().__init__(inner)
        self.variable, self.unit, self.columns, self.axis = variable, unit, columns, axis

    @abstractmethod
    def __call__(self, samples: Any, theta: Theta) -> Any:
        """The samples with the curve on them."""


class ForwardPass:
    """Forward pass of a log's ideal signals through effects; shares states with another pass."""

    def __init__(self, pair: AlignedLog, chosen: Chosen, like: ForwardPass | None = None) -> None:
        self.pair, self.acting = pair, in_stage_order(chosen)
        same = 0 if like is None else _shared(self.acting, like.acting)
        self._states: list[SignalState] = [pair.state()] if like is None else like._states[: same + 1]
        for effect, theta in self.acting[same:]:
            if effect.stage > Stage.CLOCK:
                self._states[-1] = self._states[-1].sampled()
            self._states.append(self._states[-1].through(effect, theta))
        self.blocks = pair.blocks(self._states[-1].samples())

    @property
    def expected(self) -> Float64[np.ndarray, "n k"]:
        """Readings without bias."""
        return np.concatenate([block for _, block in self.blocks], axis=1)

    def added(self, to: ForwardPass) -> dict[int, Float64[np.ndarray, " n"]]:
        """Readings less those of another pass, by the axes on which they differ."""
        pairs = ((first, own, other) for (first, own), (_, other) in zip(self.blocks, to.blocks, strict=True))
        rows = {first + k: row for first, own, other in pairs if own is not other for k, row in enumerate((own - other).T)}
        return {axis: row for axis, row in rows.items() if row.any()}

    def derivatives(self, effect: Effect, *, onsets: bool = True) -> Iterator[tuple[int, int, Float64[np.ndarray, " n"]]]:
        """Forward differences d expected / d (free parameters): axis, parameter, nonzero row; `onsets` or without them.

        An effect outside this pass is inserted at its null value, for which it has to be linear.
        """
        place = next((k for k, (other, _) in enumerate(self.acting) if other is effect), None)
        if place is None:
            place = bisect([stage_order(other) for other, _ in self.acting], stage_order(effect))
            theta, behind = effect.null_value.astype(float), self.acting[place:]
        else:
            theta, behind = self.acting[place][1], self.acting[place + 1 :]
        if effect.stage > Stage.CLOCK:
            self._states[place] = self._states[place].sampled()
        x, before = free(effect, theta), self._states[place]
        if isinstance(effect.forward, AddedColumns) and not behind:
            rows = np.ascontiguousarray(effect.forward.columns_at(before.samples()).T)
            yield from ((3 * effect.forward.sensor + effect.forward.axis, j, row) for j, row in enumerate(rows) if row.any())
            return
        for j, parameter in enumerate(effect.parameters):
            if parameter.begins and not onsets:
                continue
            h = step_of(parameter)
            only_j = np.arange(len(x)) == j
            moves = only_j | (effect.reached is not None and parameter.positive)  # of which the amplitudes depend on it
            # the others stay to the last bit: their rounding would look like a derivative
            state = before.through(effect, np.where(moves, bound(effect, x + h * only_j), theta))
            for other, values in behind:
                state = state.through(other, values)
            for (first, then), (_, block) in zip(self.pair.blocks(state.samples()), self.blocks, strict=True):
                if then is not block:
                    rows = np.subtract(then.T, block.T, order="C")
                    rows /= h
                    yield from ((first + k, j, row) for k, row in enumerate(rows) if row.any())


def _shared(a: list[tuple[Effect, Theta]], b: list[tuple[Effect, Theta]]) -> int:
    """Number of effects that two passes share from the start."""
    count = 0
    for (effect, theta), (other, same) in zip(a, b, strict=False):
        if effect is not other or not np.array_equal(theta, same):
            break
        count += 1
    return count


def expected(pair: AlignedLog, chosen: Chosen) -> Float64[np.ndarray, "n k"]:
    """Expected readings of a sensor with some effects, without bias."""
    return ForwardPass(pair, chosen).expected


def with_value(chosen: Chosen, k: int, j: int, value: float) -> Chosen:
    """The effects with another value of one parameter."""
    theta = chosen[k][1].copy()
    theta[j] = value
    return (*chosen[:k], (chosen[k][0], theta), *chosen[k + 1 :])


def free(effect: Effect, theta: Theta) -> Theta:
    """Free parameters of a fit: logarithms of positive ones, what a log reaches of amplitudes."""
    x = np.array([np.log(t) if n.positive else t for t, n in zip(theta, effect.parameters, strict=True)])
    if effect.reached is not None:
        x[:-1] *= effect.reached(float(theta[-1]))
    return x


def bound(effect: Effect, x: Theta) -> Theta:
    """Parameters from the free ones: the inverse of `free`."""
    each = zip(x, effect.parameters, strict=True)
    theta = np.array([np.exp(np.clip(v, -50, 50)) if n.positive else v for v, n in each])
    if effect.reached is not None:
        theta[:-1] /= effect.reached(float(theta[-1]))
    return theta


def bound_slopes(effect: Effect, theta: Theta) -> Float64[np.ndarray, "p p"]:
    """Derivatives of the parameters by the free ones."""
    slopes = np.diag([t if n.positive else 1.0 for t, n in zip(theta, effect.parameters, strict=True)])
    if effect.reached is not None:
        share, more = (effect.reached(float(theta[-1]) * at) for at in (1.0, np.exp(LOG_STEP)))
        slopes[:-1, :-1] /= share
        slopes[:-1, -1] = -theta[:-1] * np.log(more / share) / LOG_STEP
    return slopes


def step_of(parameter: Parameter) -> float:
    """Step of the finite difference."""
    if parameter.step is not None:
        return parameter.step
    return LOG_STEP if parameter.positive else STEP * parameter.plausible


def sets_in(effect: Effect) -> Bool[np.ndarray, " p"]:
    """Which parameters of an effect are onsets."""
    return np.array([parameter.begins for parameter in effect.parameters], dtype=bool)


def parameters_of(chosen: Chosen) -> list[Parameter]:
    """All parameters in order."""
    return [parameter for effect, _ in chosen for parameter in effect.parameters]


def free_of(chosen: Chosen) -> Theta:
    """All free parameters in order."""
    return np.concatenate([np.zeros(0), *(free(effect, theta) for effect, theta in chosen)])


def priors(begun: Chosen, settings: FitSettings) -> tuple[Float64[np.ndarray, " p"], Float64[np.ndarray, " p"]]:
    """Prior mean and standard deviation of the free parameters.

    The mean is the null value, or the start where the null value is infinite or the parameter positive.
    """
    mean, std = [], []
    for parameter, x in zip(parameters_of(begun), free_of(begun), strict=True):
        at_start = parameter.positive or not np.isfinite(parameter.null_value)
        mean.append(x if at_start else parameter.null_value)
        free_std = settings.prior_std * parameter.plausible
        std.append(settings.log_prior_std if parameter.positive else free_std)
    return np.array(mean), np.array(std)


class EffectJacobian(NamedTuple):
    """Nonzero white rows of an effect's Jacobian on one log, each with its axis and parameter."""

    rows: Float64[np.ndarray, "r n"]
    axes: Int64[np.ndarray, " r"]
    parameters: Int64[np.ndarray, " r"]
    width: int  # the number of the effect's parameters

    def on(self, axis: int) -> Int64[np.ndarray, " q"]:
        """Rows of an axis, in the order of the parameters."""
        return np.asarray((self.axes == axis).nonzero()[0])


def effect_jacobian(whiten: Whitener, forward: ForwardPass, effect: Effect, *, onsets: bool = True) -> EffectJacobian:
    """Jacobian of an effect in a forward pass, or of a linear one outside it."""
    entries = list(forward.derivatives(effect, onsets=onsets))
    axes, js = (np.array([entry[k] for entry in entries], np.int64) for k in (0, 1))
    return EffectJacobian(whiten.rows([row for _, _, row in entries], axes), axes, js, len(effect.parameters))


class Jacobians:
    """Jacobians of effects that act together; those of equal effects in `known` are reused."""

    def __init__(
        self, whiteners: Sequence[Whitener], passes: Sequence[ForwardPass], chosen: Chosen, known: Jacobians | None = None
    ) -> None:
        known_jacobians: dict[int, tuple[EffectJacobian, ...]] = {} if known is None else known._by_effect
        self.fresh = not any(id(effect) in known_jacobians for effect, _ in chosen)
        self.chosen = chosen
        self._by_effect: dict[int, tuple[EffectJacobian, ...]] = {}
        for effect, _ in chosen:
            known_jacobian = known_jacobians.get(id(effect))
            own = (effect_jacobian(whiten, forward, effect) for whiten, forward in zip(whiteners, passes, strict=True))
            self._by_effect[id(effect)] = tuple(own) if known_jacobian is None else known_jacobian

    def linear(self) -> Jacobians:
        """Those of the linear effects alone, which change least from step to step."""
        out = Jacobians((), (), ())
        out.chosen = tuple(pair for pair in self.chosen if pair[0].linear)
        out._by_effect = {id(effect): self._by_effect[id(effect)] for effect, _ in out.chosen}
        return out

    def on_axis(
        self, log: int, axis: int, mask: Bool[np.ndarray, " n"]
    ) -> tuple[Int64[np.ndarray, " q"], Float64[np.ndarray, "q m"]]:
        """Indices of the parameters that act on an axis of a log, and their derivatives."""
        where, rows, first = [np.zeros(0, np.int64)], [], 0
        for jacobians in self._by_effect.values():
            jacobian = jacobians[log]
            on = jacobian.on(axis)
            if len(on):
                where.append(first + jacobian.parameters[on])
                rows.append(jacobian.rows[on].compress(mask, axis=1))
            first += jacobian.width
        return np.concatenate(where), np.concatenate(rows) if rows else np.zeros((0, int(mask.sum())))

    def along(self, log: int, axis: int, step: Theta, mask: Bool[np.ndarray, " n"]) -> Float64[np.ndarray, " m"]:
        """Predicted change of an axis' white samples in a step of all parameters."""
        where, rows = self.on_axis(log, axis, mask)
        return np.asarray(step[where] @ rows)
