"""Prior of a run's biases, as wide as the log supports."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64

from imutool.bias.model import COLUMNS, Vector6
from imutool.inertial import inertial_filter
from imutool.inertial.inertial_filter import State

USUAL_WALK = np.array([1e-4] * 3 + [2e-3] * 3)  # of a sensor without a trained model
BIAS_ROWS = np.eye(inertial_filter.SIZE)[inertial_filter.BIAS]  # d(bias)/d(error)
LEAST_SHOWN = 0.2  # precision from the log, of that of the prior, below which the log says nothing about the prior
SAME_WIDTH = 1e-6  # share of a variance by which a narrower prior differs at least
WIDTHS = 25  # of a prior whose width is not known, from the least to the most in equal ratios
CONTRADICTED = (10.8, 13.8, 16.3)  # chi-square of one, two, three differences that a true prior exceeds once in a thousand logs


@dataclass(frozen=True)
class BiasPrior:
    """Prior of a run's biases.

    Bias b in motion, offset at rest (mean zero), and random walk of b.

    `walk` is in rad/s and m/s² per second^1/2. With `least_std` the standard deviation of b is only known to lie between that
    and `std`: the log decides (`supported_std`).
    """

    mean: Vector6
    std: Vector6
    ground_std: Vector6
    walk: Vector6 = field(default_factory=USUAL_WALK.copy)
    least_std: Vector6 | None = None

    def supported(self, state: State, elapsed_s: float) -> State:
        """State of a filter that began with `std`, for the width that the log supports until now.

        Its covariance counts that this width is not known.
        """
        if self.least_std is None:
            return state
        walked = self.walk**2 * elapsed_s
        wide = self.std**2 + walked
        difference, variance = shown_bias(state, self.mean, wide)
        narrow = np.minimum(
            supported_std(self.std, self.least_std, difference, variance) ** 2 + walked, wide * (1.0 - SAME_WIDTH)
        )
        known = inertial_filter.update(state, BIAS_ROWS, state.bias - self.mean, narrow * wide / (wide - narrow))
        unknown = np.ones(inertial_filter.SIZE)
        unknown[inertial_filter.BIAS] = np.sqrt(self._share_of_width(difference, variance, narrow))
        return replace(known, P=known.P * np.outer(unknown, unknown))

    def _share_of_width(self, difference: Vector6, variance: Vector6, narrow: Vector6) -> Vector6:
        """Variance of the bias over all widths that the log allows, by that for the width of variance `narrow`; 1 or more.

        Each width w shows the mean d g and the variance w^2 (1 - g) with g = w^2 / (w^2 + v).
        """
        assert self.least_std is not None
        std, out = widened(self.std, difference, variance), np.ones(6)
        for columns in COLUMNS.values():
            width, weight = _possible_widths(std, self.least_std, difference, variance, columns)
            square, d, v = width**2, difference[columns], variance[columns]
            gain, usual_gain = square / (square + v), narrow[columns] / (narrow[columns] + v)
            spread = square * (1.0 - gain) + (d * (gain - usual_gain)) ** 2
            out[columns] = np.maximum(weight @ spread / (narrow[columns] * (1.0 - usual_gain)), 1.0)
        return out


def shown_bias(state: State, mean: Vector6, variance: Vector6) -> tuple[Vector6, Vector6]:
    """Bias minus the prior's mean, as a log shows it without the prior, and its variance.

    Axis by axis: the precision of the state minus that of the prior. The variance is infinite where the log shows little.
    """
    after = np.diag(state.covariance(False))
    precision = 1.0 / after - 1.0 / variance
    measured = precision > LEAST_SHOWN / variance
    gain = np.where(measured, 1.0 - after / variance, 1.0)
    return (state.bias - mean) / gain, np.where(measured, 1.0 / np.where(measured, precision, 1.0), np.inf)


def supported_std(std: Vector6, least_std: Vector6 | None, difference: Vector6, variance: Vector6) -> Vector6:
    """Standard deviation of a prior that a log supports.

    `difference` and `variance` are those of `widened`. Some sensors repeat their turn-on bias to 0.1 mrad/s, some to 20 mrad/s,
    and one session does not tell. So the logarithm of the width is uniform between `least_std` and `std`. The three axes of a
    sensor are switched on together and have the same share of the way: where two axes repeat, weak evidence about the third is
    not believed. The result is the mean of that logarithm, given the log.
    """
    std = widened(std, difference, variance)
    if least_std is None:
        return std
    for columns in COLUMNS.values():
        width, weight = _possible_widths(std, least_std, difference, variance, columns)
        std[columns] = np.exp(weight @ np.log(width))
    return std


def _possible_widths(
    std: Vector6, least_std: Vector6, difference: Vector6, variance: Vector6, columns: slice
) -> tuple[Float64[np.ndarray, "widths 3"], Float64[np.ndarray, " widths"]]:
    """Widths of a sensor's prior from the least to the most, and their probabilities given what the log shows."""
    share = np.linspace(0.0, 1.0, WIDTHS)[:, None]
    most = std[columns]
    width = np.minimum(least_std[columns], most) ** (1.0 - share) * most**share
    d, v = difference[columns], variance[columns]
    shown = np.isfinite(v)
    expected = width[:, shown] ** 2 + v[shown]
    log_likelihood = -0.5 * (d[shown] ** 2 / expected + np.log(expected)).sum(axis=1)
    weight = np.exp(log_likelihood - log_likelihood.max())
    return width, weight / weight.sum()


def widened(std: Vector6, difference: Vector6, variance: Vector6) -> Vector6:
    """Standard deviation of a prior after comparison with what a log shows.

    `difference` is the bias that the log shows minus the prior's mean, `variance` that of the measurement (infinite where it
    shows nothing). A sensor whose chi-square exceeds `CONTRADICTED` gets the root mean square of its difference.
    """
    out = std.copy()
    for columns in COLUMNS.values():
        shown = np.isfinite(variance[columns]) & (std[columns] > 0)  # a prior of zero variance stays
        square = difference[columns][shown] ** 2
        chi_square = (square / (std[columns][shown] ** 2 + variance[columns][shown])).sum()
        if shown.any() and chi_square > CONTRADICTED[shown.sum() - 1]:
            out[columns] = np.maximum(std[columns], np.sqrt(square.mean()))
    return out
