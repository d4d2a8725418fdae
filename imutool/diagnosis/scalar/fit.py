"""Effects of one signal fitted together: Gauss-Newton on white residuals with a weak prior, as for the IMU.

Noise is weighed by an autoregression. Where the simulated signal has its power, its density is taken from just above, so that
an effect that nobody has modelled is not taken for noise; what is left of the simulation's own noise comes on top.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.linalg import solve_toeplitz
from scipy.ndimage import median_filter
from scipy.signal import lfilter, welch

from imutool.diagnosis.estimation.whitening import settled
from imutool.diagnosis.scalar.effects import Chosen, Column, Effect, Ideal, Samples, Stage
from imutool.sensor.effect import Parameter, Theta

ORDER = 6
SEGMENT, LINES = 512, 9  # samples of a spectrum; frequencies of the median that takes lines out of it
IN_BAND, ABOVE = 0.999, 1.3  # of the signal's power lie below its edge, and noise is measured from a little above that
LOWEST, HIGHEST, TOP = 0.05, 0.3, 0.45  # of the sample rate: least and most for the edge, and the end of what is measured
LEAST_STD = 1e-12
PRIOR, LOG_PRIOR = 3.0, 1.5
STEP, LOG_STEP = 5e-3, 0.02  # of the plausible size, or of the logarithm: see `any_effects.MOVED`
ITERATIONS, BACKTRACKS, SETTLED, POLISHED = 12, 5, 1e-3, 8
BETWEEN_SAMPLES = 2.0  # an edge lies somewhere between two samples, which least squares are too sure of (20 cases: 1.7)


@dataclass(frozen=True, eq=False)
class Noise:
    """A filter that makes the residual white with unit variance, and the standard deviation of the noise of a sample."""

    filter: Column
    level: float

    def whiten(self, columns: Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
        """White columns; the first `ORDER` rows are not yet."""
        return np.asarray(lfilter(self.filter, [1.0], columns, axis=0))


def edge_hz(x: Samples, rate_hz: float) -> float:
    """Where a signal's power ends, within what a noise can be measured beside."""
    f_hz, power = welch(x, rate_hz, nperseg=min(SEGMENT, len(x)))
    share = np.cumsum(power) / max(float(power.sum()), 1e-300)
    return float(np.clip(ABOVE * f_hz[np.searchsorted(share, IN_BAND)], LOWEST * rate_hz, HIGHEST * rate_hz))


def density(x: Samples, usable: Bool[np.ndarray, " n"], rate_hz: float) -> tuple[Column, Column]:
    """Frequencies, and the one-sided density of what counts of a signal, its lines taken out."""
    f_hz, power = welch(np.where(usable, x, 0.0), rate_hz, nperseg=min(SEGMENT, len(x)), average="median")
    return f_hz, np.asarray(median_filter(power, LINES, mode="nearest")) / max(float(usable.mean()), 1e-3)


def noise(
    residual: Samples,
    usable: Bool[np.ndarray, " n"],
    rate_hz: float,
    edge: float,
    simulated: float = 0.0,
    rounding: Column | None = None,
) -> Noise:
    """From what a model leaves.

    `edge` (Hz) is where the signal's band ends, `simulated` the density of the simulation's own noise, which is within it, and
    `rounding` that of the error of rounding, on the frequencies of `density`: the noise is no less.
    """
    f_hz, power = density(residual, usable, rate_hz)
    near = (f_hz >= edge) & (f_hz <= min(2.0 * edge, TOP * rate_hz))
    far = (f_hz >= edge) & (f_hz <= TOP * rate_hz)
    inside = f_hz < edge
    power[inside] = max(float(np.median(power[near])), float(np.median(power[far]))) + simulated
    if rounding is not None:
        power = np.maximum(power, rounding)
    covariance = np.fft.irfft(power * rate_hz / 2.0)[: ORDER + 1]
    covariance[0] += LEAST_STD**2
    a = -solve_toeplitz(covariance[:-1], covariance[1:])
    std = np.sqrt(max(float(covariance[0] + a @ covariance[1:]), LEAST_STD**2))
    return Noise(np.concatenate([[1.0], a]) / std, float(np.sqrt(covariance[0])))


@dataclass(frozen=True, eq=False)
class WhitenedLog:
    """A recorded signal beside the simulated one, the rows that count, and the noise."""

    ideal: Ideal
    real: Samples
    fitted: Bool[np.ndarray, " n"]
    held_out: Bool[np.ndarray, " n"]
    noise: Noise

    def rows(self, part: str) -> Bool[np.ndarray, " n"]:
        """`fitted`, `held_out` or `all`, behind the filter's start."""
        if part == "all":
            return np.asarray(settled(self.fitted, ORDER) | settled(self.held_out, ORDER))
        return settled(self.fitted if part == "fitted" else self.held_out, ORDER)

    def white(self, chosen: Chosen) -> Samples:
        """White residual of every row."""
        return self.noise.whiten(self.real - self.ideal.expected(chosen))


@dataclass(frozen=True, eq=False)
class Fit:
    """Effects with their parameters and how well they fit.

    `objective`: squares of white residuals and of the prior; `covariance`: of the free parameters (logarithms of positive
    ones) in order.
    """

    chosen: Chosen
    objective: float
    covariance: Float64[np.ndarray, "p p"]

    def place(self, k: int) -> slice:
        """Where an effect's parameters are among all."""
        first = sum(len(theta) for _, theta in self.chosen[:k])
        return slice(first, first + len(self.chosen[k][1]))

    def std(self, k: int) -> Theta:
        """Standard deviations of an effect's parameters, in their units."""
        effect, theta = self.chosen[k]
        std = np.sqrt(np.diag(self.covariance)[self.place(k)]) * (BETWEEN_SAMPLES if effect.jumps else 1.0)
        return np.array([s * t if n.positive else s for s, t, n in zip(std, theta, effect.numbers, strict=True)])


def _numbers(chosen: Chosen) -> list[Parameter]:
    return [number for effect, _ in chosen for number in effect.numbers]


def _free(chosen: Chosen) -> Column:
    """All parameters, positive ones by their logarithm."""
    values = np.concatenate([theta for _, theta in chosen])
    positive = np.array([number.positive for number in _numbers(chosen)])
    return np.where(positive, np.log(np.where(positive, np.maximum(values, 1e-300), 1.0)), values)


def _bound(chosen: Chosen, free: Column) -> Chosen:
    """Back from there."""
    positive = np.array([number.positive for number in _numbers(chosen)])
    values = np.where(positive, np.exp(np.clip(free, -50.0, 50.0)), free)
    cuts = np.cumsum([len(theta) for _, theta in chosen])[:-1]
    return tuple((effect, theta) for (effect, _), theta in zip(chosen, np.split(values, cuts), strict=True))


def priors(begun: Chosen) -> tuple[Column, Column]:
    """Mean and standard deviation of the free parameters: about nothing, or where the fit began if nothing is infinite."""
    at = _free(begun)
    mean = [
        x if n.positive or not np.isfinite(n.null_value) else n.null_value for n, x in zip(_numbers(begun), at, strict=True)
    ]
    std = [LOG_PRIOR if n.positive else PRIOR * n.plausible for n in _numbers(begun)]
    return np.array(mean), np.array(std)


def step_of(number: Parameter) -> float:
    """For differences, of the logarithm of what is positive."""
    return number.step or (LOG_STEP if number.positive else STEP * number.plausible)


def derivatives(ideal: Ideal, chosen: Chosen, of: Sequence[int]) -> Float64[np.ndarray, "n p"]:
    """d expected / d (free parameters) of some of the effects, by central differences."""
    columns = []
    for k in of:
        one = (chosen[k],)
        free = _free(one)
        for j, number in enumerate(chosen[k][0].numbers):
            h = step_of(number)
            sides = []
            for sign in (1.0, -1.0):
                moved = free.copy()
                moved[j] += sign * h
                sides.append(ideal.expected((*chosen[:k], *_bound(one, moved), *chosen[k + 1 :])))
            columns.append((sides[0] - sides[1]) / (2.0 * h))
    return np.stack(columns, axis=1) if columns else np.zeros((len(ideal.t_s), 0))


def fit(signal: WhitenedLog, begun: Chosen, part: str = "fitted", iterations: int = ITERATIONS) -> Fit:
    """The effects fitted together to a part of the rows, from where they begin."""
    fitting = _Fitting(signal, signal.rows(part), begun)
    fitting.descend(iterations)
    if any(effect.jumps for effect, _ in begun):
        fitting.polish()
        fitting.descend(iterations)
    return Fit(fitting.chosen, fitting.objective, np.linalg.inv(fitting.normal()[0]))


class _Fitting:
    """Effects on their way to the least squares of some rows."""

    def __init__(self, signal: WhitenedLog, rows: Bool[np.ndarray, " n"], begun: Chosen) -> None:
        self.signal, self.rows, self.chosen = signal, rows, begun
        self.mean, self.std = priors(begun)
        self.objective, self.white = np.inf, np.zeros(0)
        self._better(begun)

    def _better(self, chosen: Chosen) -> float:
        """Takes parameters that lower the objective; returns by how much."""
        white = self.signal.white(chosen)[self.rows]
        there = float(white @ white + (((_free(chosen) - self.mean) / self.std) ** 2).sum())
        gained = self.objective - there
        if gained > 0.0:
            self.chosen, self.white, self.objective = chosen, white, there
        return gained

    def normal(self) -> tuple[Float64[np.ndarray, "p p"], Column]:
        """Normal equations of a step from here."""
        J = derivatives(self.signal.ideal, self.chosen, range(len(self.chosen)))
        J = self.signal.noise.whiten(J)[self.rows]
        weight = 1.0 / self.std**2
        return J.T @ J + np.diag(weight), J.T @ self.white - (_free(self.chosen) - self.mean) * weight

    def descend(self, iterations: int) -> None:
        """Gauss-Newton, shortened where a whole step goes too far."""
        most = np.array([1.0 if n.positive else 3.0 * PRIOR * n.plausible for n in _numbers(self.chosen)])
        for _ in range(iterations):
            x, delta = _free(self.chosen), np.clip(np.linalg.solve(*self.normal()), -most, most)
            gained = 0.0
            for back in range(BACKTRACKS):
                gained = self._better(_bound(self.chosen, x + delta * 0.4**back))
                if gained > 0.0:
                    break
            if gained < SETTLED:
                break

    def polish(self) -> None:
        """Parameters of what jumps, one by one by ever smaller steps: there, derivatives only tell the way from afar."""
        moving = [(effect.jumps, step_of(n)) for effect, _ in self.chosen for n in effect.numbers]
        for halved in range(POLISHED):
            for j, (jumps, h) in enumerate(moving):
                for sign in (1.0, -1.0) if jumps else ():
                    x = _free(self.chosen)
                    x[j] += sign * h * 2.0 ** (1 - halved)
                    self._better(_bound(self.chosen, x))


class Panel:
    """The normal equations of a fit, with a place left for one more effect."""

    def __init__(self, signal: WhitenedLog, now: Fit) -> None:
        self.signal, self.now, self.rows = signal, now, signal.rows("fitted")
        self.A = signal.noise.whiten(derivatives(signal.ideal, now.chosen, range(len(now.chosen))))[self.rows]
        _, std = priors(now.chosen)
        self.N = self.A.T @ self.A + np.diag(1.0 / std**2)
        self.left = self._left(signal.white(now.chosen)[self.rows])

    def _left(self, white: Column) -> float:
        g = self.A.T @ white
        return float(white @ white - g @ np.linalg.solve(self.N, g))

    def gain(self, effect: Effect, start: Theta) -> float:
        """Squares that one linear step of all parameters from a start takes off."""
        signal, chosen = self.signal, (*self.now.chosen, (effect, start))
        r = signal.white(chosen)[self.rows]
        B = signal.noise.whiten(derivatives(signal.ideal, chosen, [len(chosen) - 1]))[self.rows]
        A = self.A
        if effect.stage in (Stage.BREAK, Stage.LIMIT):  # what is clipped no longer follows the others
            A = signal.noise.whiten(derivatives(signal.ideal, chosen, range(len(chosen) - 1)))[self.rows]
        both = np.concatenate([A, B], axis=1)
        _, std = priors(chosen)
        g = both.T @ r
        return float(self.left - (r @ r - g @ np.linalg.solve(both.T @ both + np.diag(1.0 / std**2), g)))
