"""Prior of a run's biases, as wide as the log supports."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from imutool.array_types import Bool, Float64
from imutool.bias.model import Vector6
from imutool.inertial import inertial_filter
from imutool.inertial.inertial_filter import FilterSettings, State
from imutool.units import COLUMNS

MAX_CHANGE = np.array([0.05] * 3 + [0.7] * 3)  # rad/s and m/s²: no switching-on changes one sensor's bias by more
MAX_DEVIATIONS = 5.0  # between a log's bias and the prior; training logs up to 3.1, other sensors from 6.7 on
TELLING = np.array([0.02] * 3 + [0.2] * 3)  # rad/s and m/s²: bias by which sensors differ, to be seen in the log
USUAL_WALK = np.array([1e-4] * 3 + [2e-3] * 3)  # of a sensor whose training logs show no more
BIASES = slice(inertial_filter.BIAS.start, inertial_filter.GROUND.stop)  # both biases in the filter's error
BIAS_ROWS = np.eye(12)[:6]  # d(bias)/d(error of both biases)
MIN_SHOWN = 0.2  # precision from the log, of that of the prior, below which the log says nothing about the prior
SAME_WIDTH = 1e-6  # share of a variance by which a narrower prior differs at least
SHARES = np.linspace(0.0, 1.0, 25)[:, None]  # of the way from the least width of a prior to the most, in equal ratios
DEPENDENT = 2.0  # ratio of the shown bias's deviation to the filter's, which takes velocities for independent; a hand circles
MAX_UNKNOWN = 1e-3  # rad/s, deviation of a bias that may be left unknown: 3 degrees in a minute
HIDDEN = 3.0  # deviations, below which a bias may as well be none
TELLS = 20.0  # odds that tell a unit
CONTRADICTED = (np.inf, 10.8, 13.8, 16.3)  # chi-square of as many differences; a true prior exceeds it once in a thousand logs


Sixes = Float64[np.ndarray, "*batch 6"]  # one or several vectors of six


class LeastWidth(NamedTuple):
    """Least standard deviation that a prior may have, and the probability that it has just this."""

    std: Vector6
    probability: float = 0.0


@dataclass(frozen=True)
class BiasPrior:
    """Prior of a run's biases.

    Bias b in motion, offset at rest (mean zero), and random walk of b. `walk` is in rad/s and m/s² per second^1/2, `settings`
    are those of its filter. With `minimum` the standard deviation of b is only known to lie between that and `std`: the log
    decides (`supported_std`). Without `stops` rest is taken for motion.
    """

    mean: Vector6
    std: Vector6
    ground_std: Vector6
    walk: Vector6 = field(default_factory=USUAL_WALK.copy)
    minimum: LeastWidth | None = None
    settings: FilterSettings = field(default_factory=FilterSettings)
    stops: bool = True

    def supported(
        self, states: Sequence[State], elapsed_s: Float64[np.ndarray, " m"], resting: Bool[np.ndarray, " m"]
    ) -> tuple[Float64[np.ndarray, "m 6"], Float64[np.ndarray, "m 6 6"]]:
        """Rest biases and covariances of a filter that began with `std`.

        They are those for the width that the log supports until each time; the covariance counts that this width is not known.
        """
        bias, ground = (np.array([getattr(state, part) for state in states]) for part in ("bias", "ground"))
        P = np.array([state.P[BIASES, BIASES] for state in states])
        if self.minimum is not None:
            walked = self.walk**2 * elapsed_s[:, None]
            wide = self.std**2 + walked
            difference, variance = shown_bias(bias, P[:, range(6), range(6)], self.mean, wide)
            narrow = supported_std(self.std, self.minimum, difference, variance) ** 2 + walked
            narrow = np.minimum(narrow, wide * (1.0 - SAME_WIDTH))
            K, P = inertial_filter.gain(P, BIAS_ROWS, narrow * wide / (wide - narrow))
            moved = (K @ (bias - self.mean)[..., None])[..., 0]
            bias, ground = bias - moved[:, :6], ground - moved[:, 6:]
            wider = np.ones((len(P), P.shape[1]))
            wider[:, :6] = np.sqrt(self._share_of_width(difference, variance, narrow))
            P = P * wider[:, :, None] * wider[:, None, :]
        both = P[:, :6, :6] + P[:, :6, 6:] + P[:, 6:, :6] + P[:, 6:, 6:]
        at_rest = resting[:, None, None]
        return np.where(at_rest[..., 0], bias + ground, bias), np.where(at_rest, both, P[:, :6, :6])

    def _share_of_width(self, difference: Sixes, variance: Sixes, narrow: Sixes) -> Sixes:
        """Variance of the bias over all widths that the log allows, by that for the width of variance `narrow`; 1 or more.

        Each width w shows the mean d g and the variance w^2 (1 - g) with g = w^2 / (w^2 + v).
        """
        assert self.minimum is not None
        std, out = widened(self.std, difference, variance), np.ones_like(difference)
        for columns in COLUMNS.values():
            width, weight = _possible_widths(std, self.minimum, difference, variance, columns)
            square, d, v = width**2, difference[:, None, columns], variance[:, None, columns]
            usual = narrow[:, None, columns]
            gain, usual_gain = square / (square + v), usual / (usual + v)
            spread = square * (1.0 - gain) + (d * (gain - usual_gain)) ** 2
            out[:, columns] = np.maximum((weight * spread / (usual * (1.0 - usual_gain))).sum(axis=1), 1.0)
        return out


def shown_bias(
    bias: Sixes,
    after: Sixes,
    mean: Vector6,
    before: Sixes,
) -> tuple[Sixes, Sixes]:
    """Bias minus the prior's mean, as a log shows it without the prior, and its variance.

    Axis by axis from the variances after and before the log: the difference of the precisions. The variance is infinite where
    the log shows little.
    """
    precision = 1.0 / after - 1.0 / before
    measured = precision > MIN_SHOWN / before
    gain = np.where(measured, 1.0 - after / before, 1.0)
    return (bias - mean) / gain, np.where(measured, 1.0 / np.where(measured, precision, 1.0), np.inf)


def other_bias(difference: Vector6, deviations: Vector6, maximum: Vector6) -> Iterator[str]:
    """Sentences on biases that differ from a prior's by more deviations than a maximum."""
    for sensor, unit, columns in (("gyro", "rad/s", COLUMNS["gyro"]), ("accelerometer", "m/s²", COLUMNS["accel"])):
        axis = int(np.argmax(deviations[columns])) + columns.start
        if deviations[axis] > maximum[axis]:
            yield (
                f"the {sensor}'s bias about {'xyz'[axis % 3]} differs by {difference[axis]:+.2g} {unit} from the model's"
                f" prior, {deviations[axis]:.0f} standard deviations: another unit, or another turn-on"
            )


def contradicted_start(rest: Vector6, std: Vector6, shown: Vector6, shown_std: Vector6) -> tuple[list[str], bool]:
    """Sentences on a start that contradicts a log's bias, and whether no correction is nearer."""
    off, total = np.abs(rest - shown), np.sqrt(std**2 + shown_std**2)
    sentences = []
    for sensor, unit, columns in (("gyro", "rad/s", COLUMNS["gyro"]), ("accelerometer", "m/s²", COLUMNS["accel"])):
        axis = int(np.argmax(off[columns] / total[columns])) + columns.start
        if off[axis] > MAX_DEVIATIONS * total[axis]:
            seen = f"{shown[axis]:+.2g} ± {shown_std[axis]:.1g} {unit}"
            sentences.append(
                f"the start's bias of the {sensor} about {'xyz'[axis % 3]} is {rest[axis]:+.2g}, the log shows {seen}"
            )
    return sentences, bool((off - np.abs(shown) > TELLING + MAX_DEVIATIONS * total).any())


class ShownBias(NamedTuple):
    """Bias minus a prior's mean, in its deviations, along directions that a log shows."""

    directions: Float64[np.ndarray, "k 6"]
    difference: Float64[np.ndarray, " k"]
    variance: Float64[np.ndarray, " k"]

    @classmethod
    def of(cls, difference: Vector6, after: Float64[np.ndarray, "6 6"], before: Vector6, offset: Vector6) -> ShownBias:
        """What a filter has found about a prior of deviations `before`; `offset` is the deviation that no filter knows."""
        precision = np.linalg.inv(after / np.outer(before, before))
        value, columns = np.linalg.eigh(0.5 * (precision + precision.T) - np.eye(6))
        value, u = value[value > MIN_SHOWN], columns.T[value > MIN_SHOWN]
        return cls(u, u @ precision @ (difference / before) / value, DEPENDENT**2 / value + u**2 @ (offset / before) ** 2)

    def odds_of_unit(self, prior: BiasPrior) -> float:
        """Logarithm of the odds of the bias, of the prior's unit to others of its kind.

        Others have biases about zero, as large as this one's or smaller, for a sensor may be a good one. How much smaller is as
        unknown as the width of the unit's own prior (`supported_std`).
        """
        minimum = prior.std if prior.minimum is None else np.minimum(prior.minimum.std, prior.std)
        size = np.sqrt(np.repeat((prior.mean**2).reshape(2, 3).mean(axis=1), 3))
        own = self._likelihood(self.difference, minimum / prior.std, np.ones(6))
        whole = self.difference + self.directions @ (prior.mean / prior.std)
        return own - self._likelihood(whole, minimum / prior.std, np.maximum(size, minimum) / prior.std)

    def _likelihood(self, e: Float64[np.ndarray, " k"], minimum: Vector6, maximum: Vector6) -> float:
        """Log-likelihood of a difference, the mean over widths from the minimum to the maximum."""
        variance = (minimum ** (1.0 - SHARES) * maximum**SHARES) ** 2 @ (self.directions**2).T + self.variance
        each = -0.5 * (e**2 / variance + np.log(variance)).sum(axis=1)
        return float(each.max() + np.log(np.mean(np.exp(each - each.max()))))


def untold_unit(prior: BiasPrior, variance: Vector6, odds: float, std: Vector6) -> str:
    """Sentence on a log that may be another unit's, by what it does not show.

    It does not show a bias of the gyro, or agrees to within a large `std` alone. `variance` is that of the bias that the log
    shows. This bias tells the unit if it is `TELLS` times as probable for it as for others: of these, at most one in so many is
    taken for this one.
    """
    size = np.abs(prior.mean[:3])
    hidden = np.where((size > MAX_UNKNOWN) & (size < HIDDEN * DEPENDENT * np.sqrt(variance[:3])), size, 0.0)
    if hidden.any() and odds < math.log(TELLS):
        axis = int(np.argmax(hidden))
        bias = f"the gyro's bias about {'xyz'[axis]}, {prior.mean[axis]:+.2g} rad/s in the training logs"
        return f"the log neither shows {bias}, nor tells its unit: on another one, it does harm"
    nothing = "the log has neither a stop nor enough slow motion to judge the model by, and does not name its sensor"
    return "" if (std < TELLING / 2.0).any() else nothing


def of_log(prior: BiasPrior, difference: Vector6, variance: Vector6, offset: Vector6) -> BiasPrior:
    """Prior for a log, about zero if its gyro's bias is likelier another unit's.

    That bias is also nearer to none than to the training logs'. What the log does not show is about zero then, as wide as the
    bias that it shows. Else the prior itself.
    """
    gyro, mean, std, known = COLUMNS["gyro"], prior.mean.copy(), prior.std.copy(), np.isfinite(variance)
    bias, off = (each[gyro][known[gyro]] for each in (mean + difference, difference))
    of_axes = (DEPENDENT**2 * variance + offset**2)[known] / std[known] ** 2
    shown = ShownBias(np.eye(6)[known], (difference / std)[known], of_axes)
    if np.linalg.norm(bias) >= np.linalg.norm(off) or shown.odds_of_unit(prior) > 0.0:
        return prior
    mean[gyro], std[gyro] = 0.0, np.maximum(std[gyro], np.sqrt(np.mean(bias**2)))
    return replace(prior, mean=mean, std=std, minimum=None)


def supported_std(
    std: Vector6,
    minimum: LeastWidth | None,
    difference: Sixes,
    variance: Sixes,
) -> Sixes:
    """Standard deviation of a prior that a log supports.

    `difference` and `variance` are those of `widened`. Some sensors repeat their turn-on bias to 0.1 mrad/s, some to 20 mrad/s,
    and one session does not tell. So the logarithm of the width is uniform between the least and `std`. The three axes of a
    sensor are switched on together and have the same share of the way: where two axes repeat, weak evidence about the third is
    not believed. The result is the mean of that logarithm, given the log.
    """
    out = widened(std, difference, variance)
    if minimum is None:
        return out
    for columns in COLUMNS.values():
        _, weight = _possible_widths(out, minimum, difference, variance, columns)
        maximum, mean_share = out[..., columns], (weight * SHARES).sum(axis=-2)
        out[..., columns] = np.minimum(minimum.std[columns], maximum) ** (1.0 - mean_share) * maximum**mean_share
    return out


def std_before(std: Vector6, minimum: LeastWidth | None) -> Vector6:
    """Standard deviation of a bias of which a log shows nothing: over all widths of its prior.

    It is the most where nothing says how probable the least is.
    """
    if minimum is None or not minimum.probability:
        return std
    out, nothing = std.copy(), (np.zeros(6), np.full(6, np.inf))
    for columns in COLUMNS.values():
        width, weight = _possible_widths(std, minimum, *nothing, columns)
        out[columns] = np.sqrt((weight * width**2).sum(axis=-2))
    return out


def _possible_widths(
    std: Sixes, minimum: LeastWidth, difference: Sixes, variance: Sixes, columns: slice
) -> tuple[Float64[np.ndarray, "*batch widths 3"], Float64[np.ndarray, "*batch widths 1"]]:
    """Widths of a sensor's prior from the least to the most, and their probabilities given what the log shows."""
    maximum, square, noise = std[..., None, columns], difference[..., None, columns] ** 2, variance[..., None, columns]
    shown = np.isfinite(noise)
    width = np.minimum(minimum.std[columns], maximum) ** (1.0 - SHARES) * maximum**SHARES
    before = np.full(SHARES.shape, 1.0 - minimum.probability)
    before[0] += minimum.probability * len(SHARES)
    expected = width**2 + np.where(shown, noise, 1.0)
    log_likelihood = -0.5 * np.where(shown, square / expected + np.log(expected), 0.0).sum(axis=-1, keepdims=True)
    weight = before * np.exp(log_likelihood - log_likelihood.max(axis=-2, keepdims=True))
    return width, weight / weight.sum(axis=-2, keepdims=True)


def widened(std: Vector6, difference: Sixes, variance: Sixes) -> Sixes:
    """Standard deviation of a prior after comparison with what a log shows.

    `difference` is the bias that the log shows minus the prior's mean, `variance` that of the measurement (infinite where it
    shows nothing). A sensor whose chi-square exceeds `CONTRADICTED` gets the root mean square of its difference.
    """
    out = np.empty_like(difference)
    for columns in COLUMNS.values():
        shown = np.isfinite(variance[..., columns]) & (std[columns] > 0)  # a prior of zero variance stays
        square, count = np.where(shown, difference[..., columns] ** 2, 0.0), shown.sum(axis=-1)
        expected = std[columns] ** 2 + variance[..., columns]
        chi_square = np.divide(square, expected, out=np.zeros_like(square), where=shown).sum(axis=-1)
        contradicted = chi_square > np.take(CONTRADICTED, count)
        rms = np.sqrt(square.sum(axis=-1) / np.maximum(count, 1))
        out[..., columns] = np.maximum(std[columns], np.where(contradicted, rms, 0.0)[..., None])
    return out
