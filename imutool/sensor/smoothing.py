"""Penalised spline through noisy samples, its smoothness chosen by restricted likelihood.

Quintic B-splines on even knots; the cost sum_k w_k |y_k - s(t_k)|² + lambda sum_j |D³ c_j|² (P-splines: Eilers and Marx,
Statistical Science 11, 1996, eq. 3) is that of white noise around a curve whose third derivative is white, and lambda is the
value under which the samples are likeliest (restricted likelihood: Wood, JRSS B 73, 2011, eq. 4). Matrices are banded, so that
time grows with the samples alone; the determinant, and the variance of what is fitted, are those of an endless even clock: they
follow from the matrices' symbols, b(theta) of the data and p(theta) = (2 - 2 cos theta)³ of the penalty.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.optimize import minimize_scalar

from imutool.array_types import Float64
from imutool.errors import NumericsError
from imutool.inertial.kinematics import DEGREE

ROUGHNESS = 3  # the derivative that is white: jerk, so that accelerations wander as a body's do
FREQUENCIES = 512  # at which symbols are summed
COARSE = 24  # cut-offs tried before the best is refined
LOWEST_HZ = 0.2
MIN_ANGLE = 1e-2  # of a knot at the lowest cut-off: its sixth power is the condition of the matrices
# Of the likeliest cut-off: real poses err more slowly than white noise. Against the IMU of TUM-VI room1 and room3 and of FETCH
# 03 and 06, 0.85 leaves 15, 19, 5 and 3 per cent less error of the specific force than 1; EuRoC's lose half a per cent.
CAUTION = 0.85
HIGHEST = 0.45  # cut-offs per knot; half would be what the knots can follow at all
END_COEFFICIENTS = 200  # at an end, whose variance is looked at in full
SMALLEST = 1e-12  # of the symbol's mean: where samples are rarer than knots it would fall to zero

Values = Float64[np.ndarray, "n d"]
Times = Float64[np.ndarray, " n"]
Band = Float64[np.ndarray, "6 c"]


@dataclass(frozen=True, eq=False)
class Penalised:
    """Penalised spline fitted to noisy samples."""

    spline: BSpline
    noise: float  # a sample's standard deviation at weight 1
    cutoff_hz: float  # a motion at it comes out at half its size
    penalty: float  # it was fitted with
    likeliest: float  # penalty that the samples ask for
    samples: Samples

    def residual(self) -> Values:
        """Residual: samples minus the curve."""
        residual_values: Values = self.samples.y - self.samples.fitted(np.asarray(self.spline.c))
        return residual_values

    def std(self, derivative: int) -> float:
        """Standard deviation of a derivative amid the data, by smoothing and noise, one coordinate.

        For curves as rough as the likeliest penalty l says: noise² times the mean over theta of |B|² (b + lambda² p / l) /
        (b + lambda p)², B the transform of the basis' derivative, at the knots and halfway between them. With lambda = l that
        is the posterior (Wahba, JRSS B 45, 1983). A motion that is smoother errs less.
        """
        b, p = self.samples.symbol, _penalty_symbol(_angles())
        spread = (b + self.penalty**2 / self.likeliest * p) / (b + self.penalty * p) ** 2
        basis = BSpline.basis_element(np.arange(DEGREE + 2) - (DEGREE + 1) / 2.0, extrapolate=False)
        both = []
        for phase in (0.0, 0.5):
            at = np.arange(-DEGREE, DEGREE + 1) + phase
            values = np.nan_to_num(np.asarray(basis(at, derivative))) / self.samples.knot_s**derivative
            response = np.abs(np.exp(1j * np.outer(_angles(), at)) @ values) ** 2
            both.append(np.mean(response * spread))
        return self.noise * float(np.sqrt(np.mean(both)))

    def end_s(self, derivative: int, worse: float, minimum: float) -> float:
        """Time (s) from an end within which a derivative is uncertain.

        There its deviation is above `minimum` and `worse` times the inner one. From the posterior of an even piece as dense as
        the data, in full; at most half of that piece.
        """
        own = self.samples
        count = min(own.count, END_COEFFICIENTS)
        length_s = (count - DEGREE) * own.knot_s
        density = len(own.y) / ((own.count - DEGREE) * own.knot_s)
        even = np.linspace(0.0, length_s, max(2, round(length_s * density)))
        piece = Samples(even, even[:, None], np.full(len(even), float(own.weights.mean())), own.knot_s * (1.0 + 1e-9))
        matrix = np.zeros((piece.count, piece.count))
        for offset, diagonal in enumerate((piece.normal + self.penalty * piece.roughness)[::-1]):
            row = np.arange(piece.count - offset)
            matrix[row, row + offset] = matrix[row + offset, row] = diagonal[offset:]
        t_s = np.arange(0.0, length_s / 2.0, own.knot_s / 2.0)
        values = np.asarray(BSpline(piece.knots, np.eye(piece.count), DEGREE)(t_s, derivative))
        std = self.noise * np.sqrt(np.einsum("nc,cn->n", values, np.linalg.solve(matrix, values.T)))
        poor = np.flatnonzero(std > max(minimum, worse * float(std[len(std) // 2 :].max())))
        return float(t_s[poor[-1]]) if len(poor) else 0.0


class Samples:
    """Weighted samples and their matrices, to be fitted with one penalty after another."""

    def __init__(self, t_s: Times, y: Values, weights: Times, knot_s: float) -> None:
        pieces = max(1, int(np.ceil((t_s[-1] - t_s[0]) / knot_s)))
        self.knot_s = float(t_s[-1] - t_s[0]) / pieces
        self.knots = t_s[0] + self.knot_s * np.arange(-DEGREE, pieces + DEGREE + 1)
        self.knots[DEGREE], self.knots[-DEGREE - 1] = t_s[0], t_s[-1]  # to the last bit, so that both ends are inside
        self.count, self.y, self.weights = pieces + DEGREE, y, weights
        design = BSpline.design_matrix(t_s, self.knots, DEGREE)
        self.design, self.values = design, design.data.reshape(len(t_s), DEGREE + 1)
        self.first = design.indices.reshape(len(t_s), DEGREE + 1)[:, 0]
        self.normal = self._normal()
        self.centre = np.average(y, axis=0, weights=weights)  # taken out: a world's far origin would cost digits
        self.right: Float64[np.ndarray, "c d"] = np.stack([self._right(column) for column in (y - self.centre).T], axis=1)
        self.roughness = _penalty(self.count)

    def _summed(self, x: Times, shift: int) -> Float64[np.ndarray, " c"]:
        return np.bincount(self.first + shift, weights=x, minlength=self.count)

    def _right(self, column: Times) -> Float64[np.ndarray, " c"]:
        """Right-hand side B^T W y."""
        parts = [self._summed(self.weights * self.values[:, k] * column, k) for k in range(DEGREE + 1)]
        return np.asarray(np.sum(parts, axis=0))

    def _normal(self) -> Band:
        """Normal matrix B^T W B, upper diagonals in scipy's order: the last row is the main one."""
        band = np.zeros((DEGREE + 1, self.count))
        for i in range(DEGREE + 1):
            for j in range(i, DEGREE + 1):
                band[DEGREE - (j - i)] += self._summed(self.weights * self.values[:, i] * self.values[:, j], j)
        return band

    @cached_property
    def symbol(self) -> Float64[np.ndarray, " f"]:
        """Symbol of the normal matrix, from the means of its diagonals."""
        diagonals = self.normal.sum(axis=1)[::-1] / (self.count - DEGREE)
        symbol = diagonals[0] + 2.0 * np.cos(np.outer(_angles(), np.arange(1, DEGREE + 1))) @ diagonals[1:]
        return np.asarray(np.maximum(symbol, SMALLEST * diagonals[0]))

    @property
    def highest_hz(self) -> float:
        """Highest cut-off that the knots can follow."""
        return HIGHEST / self.knot_s

    def penalty_for(self, cutoff_hz: float) -> float:
        """Penalty with which a motion of that frequency comes out at half its size."""
        theta = np.array([2.0 * np.pi * cutoff_hz * self.knot_s])
        return float((np.interp(theta, _angles(), self.symbol) / _penalty_symbol(theta))[0])

    def coefficients(self, penalty: float) -> Float64[np.ndarray, "c d"]:
        """Coefficients of the least cost.

        Raises:
            NumericsError: samples so uneven that they define no curve.
        """
        try:
            factor = cholesky_banded(self.normal + penalty * self.roughness)
        except np.linalg.LinAlgError as error:
            raise NumericsError(
                f"{len(self.y)} samples leave some of {self.count} splines undefined",
                expected="samples all along",
                fix="Give a stretch of poses with a more even clock",
            ) from error
        return np.asarray(cho_solve_banded((factor, False), self.right)) + self.centre  # the basis adds up to one

    def fitted(self, coefficients: Float64[np.ndarray, "c d"]) -> Values:
        """Values of the curve at the samples."""
        return np.asarray(self.design @ coefficients)

    def unlikelihood(self, cutoff_hz: float) -> tuple[float, float]:
        """Minus twice the log restricted likelihood, the noise profiled out; and that noise."""
        penalty = self.penalty_for(cutoff_hz)
        c = self.coefficients(penalty)
        misfit = float(np.sum(self.weights[:, None] * (self.y - self.fitted(c)) ** 2))
        cost = misfit + penalty * float(np.sum(np.diff(c, n=ROUGHNESS, axis=0) ** 2))
        free = (float(np.count_nonzero(self.weights)) - ROUGHNESS) * self.y.shape[1]
        variance = max(cost / free, np.finfo(np.float64).tiny)  # a body at rest, without noise, fits without any misfit
        ratio = (self.count - ROUGHNESS) * float(np.mean(np.log(self.symbol / penalty + _penalty_symbol(_angles()))))
        return free * np.log(variance) + self.y.shape[1] * ratio, float(np.sqrt(variance))

    def fit(self, cutoff_hz: float | None = None, near_hz: float | None = None) -> Penalised:
        """Likeliest curve, smoothed a little more than that; or the curve of a given cut-off.

        `near_hz` is the likeliest cut-off of other weights, from which it is looked for.
        """
        likeliest = self._likeliest(near_hz) if cutoff_hz is None else cutoff_hz
        chosen = CAUTION * likeliest if cutoff_hz is None else cutoff_hz
        penalty = self.penalty_for(chosen)
        spline: BSpline = BSpline(self.knots, self.coefficients(penalty), DEGREE, extrapolate=False)
        return Penalised(spline, self.unlikelihood(likeliest)[1], chosen, penalty, self.penalty_for(likeliest), self)

    def _likeliest(self, near_hz: float | None) -> float:
        def cost(log_hz: float) -> float:
            return self.unlikelihood(float(np.exp(log_hz)))[0]

        lowest_hz = max(min(LOWEST_HZ, self.highest_hz / 10.0), MIN_ANGLE / (2.0 * np.pi * self.knot_s))
        tried = np.log(np.geomspace(lowest_hz, self.highest_hz, COARSE)).tolist()
        known = cache(lambda k: cost(tried[k]))
        k = min(range(COARSE), key=known) if near_hz is None else int(np.abs(tried - np.log(near_hz)).argmin())
        while (better := min(range(max(k - 1, 0), min(k + 2, COARSE)), key=known)) != k:
            k = better
        bounds = tried[max(k - 1, 0)], tried[min(k + 1, COARSE - 1)]
        return float(np.exp(minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 0.02}).x))


def _angles() -> Float64[np.ndarray, " f"]:
    return (np.arange(FREQUENCIES) + 0.5) * np.pi / FREQUENCIES


def _penalty_symbol(theta: Float64[np.ndarray, " f"]) -> Float64[np.ndarray, " f"]:
    return np.asarray((2.0 - 2.0 * np.cos(theta)) ** ROUGHNESS)


def _penalty(count: int) -> Band:
    """Penalty D^T D of the third differences, upper diagonals as scipy keeps them."""
    band, difference = np.zeros((DEGREE + 1, count)), np.array([-1.0, 3.0, -3.0, 1.0])
    for i in range(ROUGHNESS + 1):
        for j in range(i, ROUGHNESS + 1):
            band[DEGREE - (j - i), j : j + count - ROUGHNESS] += difference[i] * difference[j]
    return band
