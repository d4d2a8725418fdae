"""What every effect is: an error that is linear in its parameters, made of terms that the sensor's own signals give.

The reading errs by `sum_p theta_p sum_q pattern[:, q, p] term_q`: forward (`simulate`) the terms are of the true motion,
backward (`debias`) of the measured one, which differs by the error times the error. Linear in theta means that any set of
effects is fitted together by one linear solve a Gauss-Newton step, with the covariance of the answer for nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from imutool.sensor.signals import COUNT, Signals
from imutool.units import AXES, Sensor

Three = tuple[float, float, float]


@dataclass(frozen=True)
class LinearParameter:
    """A number of an effect: its name within the effect, its unit, and the size it plausibly has (one standard deviation)."""

    name: str
    unit: str
    plausible: float


@dataclass(frozen=True, slots=True)
class AtWork:
    """An effect for given parameters: the error at each sample of a block, and at one, from its time and columns.

    One sample is plain floats: numpy's calls would cost several times the arithmetic.
    """

    block: Callable[[Signals], Float64[np.ndarray, "n 3"]]
    one: Callable[[float, list[float]], Three]

    def __call__(self, signals: Signals) -> Float64[np.ndarray, "n 3"]:
        """The error at each sample of a block."""
        return self.block(signals)


@dataclass(frozen=True)
class LinearEffect:
    """One effect on one sensor. It sees columns of the signals, or what a function makes of them."""

    name: str
    sensor: Sensor
    equation: str
    parameters: tuple[LinearParameter, ...]
    sees: slice | Callable[[Signals], Float64[np.ndarray, "n q"]]
    pattern: Float64[np.ndarray, "3 q p"]
    at_work: Callable[[Float64[np.ndarray, " p"]], AtWork] | None = None  # a quicker way than through many terms

    @property
    def plausible(self) -> Float64[np.ndarray, " p"]:
        """The plausible size of each parameter."""
        return np.array([parameter.plausible for parameter in self.parameters])

    def terms(self, signals: Signals) -> Float64[np.ndarray, "n q"]:
        """What the error is made of."""
        return signals.columns[:, self.sees] if isinstance(self.sees, slice) else self.sees(signals)

    def matrix(self, theta: Float64[np.ndarray, " p"]) -> Float64[np.ndarray, "q 3"]:
        """What takes terms to errors: error = terms matrix."""
        out: Float64[np.ndarray, "q 3"] = np.einsum("iqp,p->qi", self.pattern, theta)
        return out

    def compiled(self, theta: Float64[np.ndarray, " p"]) -> AtWork:
        """The error, for given parameters."""
        if self.at_work is not None:
            return self.at_work(theta)
        matrix = self.matrix(theta)

        def block(signals: Signals) -> Float64[np.ndarray, "n 3"]:
            return np.asarray(self.terms(signals) @ matrix)

        def one(t_s: float, row: list[float]) -> Three:
            x, y, z = block(Signals(np.array([t_s]), np.array([row])))[0].tolist()
            return x, y, z

        return AtWork(block, one)


@dataclass(frozen=True)
class Together:
    """Several effects for given parameters: one product with all columns, and what cannot be had that way."""

    matrix: Float64[np.ndarray, "27 3"]
    others: tuple[AtWork, ...]

    @property
    def wanted(self) -> int:
        """How many of the signals' columns must be there."""
        if self.others:
            return COUNT
        return int(np.flatnonzero(self.matrix.any(axis=1)).max(initial=-1)) + 1

    def __call__(self, signals: Signals) -> Float64[np.ndarray, "n 3"]:
        """The error at each sample of a block."""
        out: Float64[np.ndarray, "n 3"] = np.dot(signals.columns, self.matrix)
        for other in self.others:
            out += other(signals)
        return out

    def others_at(self, t_s: float, row: list[float]) -> Three:
        """The error at one sample but for the product's."""
        x, y, z = 0.0, 0.0, 0.0
        for other in self.others:
            dx, dy, dz = other.one(t_s, row)
            x, y, z = x + dx, y + dy, z + dz
        return x, y, z


def patterns(effects: Sequence[LinearEffect]) -> Float64[np.ndarray, "3 q p"]:
    """The effects' patterns side by side: [axis, term, parameter]."""
    terms, parameters = (sum(effect.pattern.shape[k] for effect in effects) for k in (1, 2))
    out, q, p = np.zeros((3, terms, parameters)), 0, 0
    for effect in effects:
        _, dq, dp = effect.pattern.shape
        out[:, q : q + dq, p : p + dp] = effect.pattern
        q, p = q + dq, p + dp
    return out


def compiled(effects: Sequence[LinearEffect], theta: Float64[np.ndarray, " p"]) -> Together:
    """Some effects at work together, for given parameters in their order."""
    matrix, others = np.zeros((COUNT, 3)), []
    for effect in effects:
        size = len(effect.parameters)
        own, theta = theta[:size], theta[size:]
        if isinstance(effect.sees, slice) and effect.at_work is None:
            matrix[effect.sees] += effect.matrix(own)
        else:
            others.append(effect.compiled(own))
    return Together(matrix, tuple(others))


def per_axis(unit: str, plausible: float) -> tuple[LinearParameter, ...]:
    """One parameter for each axis."""
    return tuple(LinearParameter(axis, unit, plausible) for axis in AXES)


def per_pair(unit: str, plausible: float, *, diagonal: bool = True) -> tuple[LinearParameter, ...]:
    """One parameter for each entry of a 3x3 matrix, row by row: `xy` is what y adds to x."""
    return tuple(LinearParameter(a + b, unit, plausible) for a in AXES for b in AXES if diagonal or a != b)


def diagonal() -> Float64[np.ndarray, "3 3 3"]:
    """Pattern of an effect of each axis on itself."""
    return np.eye(3)[:, :, None] * np.eye(3)[None]


def full(terms: int = 3) -> Float64[np.ndarray, "3 q p"]:
    """Pattern of every term on every axis, parameters row by row."""
    pattern: Float64[np.ndarray, "3 q p"] = np.einsum("ia,qb->iqab", np.eye(3), np.eye(terms)).reshape(3, terms, 3 * terms)
    return pattern


def off_diagonal() -> Float64[np.ndarray, "3 3 6"]:
    """Pattern of every axis on the others."""
    pattern: Float64[np.ndarray, "3 3 6"] = full()[:, :, ~np.eye(3, dtype=bool).ravel()]
    return pattern
