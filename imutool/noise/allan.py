"""Allan deviation at rest and its slopes.

Density at -1/2, instability at 0, bias walk at +1/2.

A stretch of T seconds shows averaging times up to T/4. Over these the variance is a sum of powers (IEEE 952, annex C)::

    sigma²(tau) = 3 Q²/tau² + N²/tau + (2 ln 2/pi) B² + K² tau/3 + R² tau²/2

(quantisation or vibration, white density, instability, bias walk, ramp; none negative), fitted to the relative deviations with
Huber's weights. The fit drops a power that it does not need. A power counts as unseen if a neighbour could replace it, or if it
is nowhere half of the variance. If the shortest times do not follow a sum of powers (a sensor's filter, a motor's vibration),
they are dropped one by one until the rest does.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from types import ModuleType
from typing import NamedTuple

import numpy as np

from imutool.array_types import Bool, Float64
from imutool.errors import required
from imutool.inertial.stationary import GAP_PERIODS
from imutool.recording.columns import Columns
from imutool.units import Sensor

LONGEST = 4  # averaging times up to the stretch over this: beyond, a single disagreement decides
MODEL_ERROR = 0.1  # of the variance: no sensor is a sum of powers to better than this
MISFIT = 3.5  # standard deviations at one averaging time that the sum may miss it by
NEEDED = 12.0  # rise of chi² when a power is taken out, below which it was not needed
TOLD_APART = 4.0  # rise of chi² when a power makes way for its neighbour, below which it could be either
CORRELATED = 1.7  # standard deviations of slopes beyond the white one: neighbouring averaging times share their samples
MIN_FREEDOM = 10.0  # degrees of freedom that an averaging time needs to bound a density from above
BOUND_RISK = 0.002  # probability that one averaging time puts the bound too low
HUBER = 2.0
COARSE = 0.55  # steps of the readings: as much as two neighbouring readings scatter, whatever the noise below them
HALF = 0.5
MIN_TIMES = 3  # averaging times, an octave apart, that anything is fitted to
MIN_TIMES_OF = {"quantisation": 1, "density": 3, "instability": 3, "walk": 2, "ramp": 2}  # over which it must be the half
ITERATIONS = 8
FLICKER = 2.0 * np.log(2.0) / np.pi

POWERS = {
    "quantisation": (3.0, -2),
    "density": (1.0, -1),
    "instability": (FLICKER, 0),
    "walk": (1.0 / 3.0, 1),
    "ramp": (0.5, 2),
}

Samples = Float64[np.ndarray, "_ 3"]


@dataclass(frozen=True)
class Curve:
    """Allan deviation by averaging time (s) and axis, with its degrees of freedom."""

    tau_s: Float64[np.ndarray, " m"]
    deviation: Float64[np.ndarray, "m 3"]
    freedom: Float64[np.ndarray, " m"]


@dataclass(frozen=True)
class Slopes:
    """Slopes of one axis: values, standard deviations, and the range of the fit.

    `powers` holds all fitted values, seen or not, for drawing. The fit holds from `from_s` on. `excess` is the worst ratio of
    variance to fit below `from_s` (less than 1: smaller, as with filters), 1 if no time was dropped.
    """

    seen: dict[str, float] = field(default_factory=dict)
    std: dict[str, float] = field(default_factory=dict)
    powers: dict[str, float] = field(default_factory=dict)
    from_s: float = 0.0
    excess: float = 1.0


def library() -> ModuleType:
    """Library that computes Allan deviations.

    Raises:
        ConfigError: it is not installed.
    """
    module: ModuleType = required("allantools", "noise", where="noise", user="an Allan deviation")
    return module


def sample_period_s(rows: Columns) -> float:
    """Mean step between rows, without gaps.

    The median errs by up to a third where stamps are whole milliseconds.

    Raises:
        DataError: fewer than two rows.
    """
    longest_s, steps_s = GAP_PERIODS * rows.period_s, 1e-9 * np.diff(rows.t_ns)
    return float(steps_s[steps_s <= longest_s].mean())


def coarse_axes(stretches: Sequence[Samples]) -> list[bool]:
    """Axes that hardly leave two neighbouring readings: they show digits, and no noise."""
    variance = np.mean([part.var(axis=0) for part in stretches], axis=0)
    steps = [np.diff(np.unique(column)).min(initial=np.inf) for column in np.concatenate(stretches).T]
    return [bool(np.sqrt(v) < COARSE * step) for v, step in zip(variance, steps, strict=True)]


def curve(stretches: Iterable[Samples], period_s: float) -> Curve:
    """Overlapping Allan deviation over stretches of one sensor.

    At averaging times an octave apart.

    Squared differences of all stretches are averaged together; none reaches across from one stretch to the next. Empty
    where no stretch has 8 samples.

    Raises:
        ConfigError: allantools is not installed.
    """
    tools = library()
    parts = [part - part.mean(axis=0) for part in stretches if len(part) >= 2 * LONGEST]
    longest = max((len(part) for part in parts), default=0)
    octaves = 2 ** np.arange(max(0, int(np.log2(longest // LONGEST)) + 1)) if longest else np.zeros(0, int)
    squares, counts, worth = np.zeros((len(octaves), 3)), np.zeros(len(octaves)), np.zeros(len(octaves))
    for part in parts:
        own = octaves[octaves * LONGEST <= len(part)]
        for axis in range(3):
            _, deviation, _, number = tools.oadev(part[:, axis], rate=1.0 / period_s, data_type="freq", taus=own * period_s)
            squares[: len(own), axis] += number * deviation**2
        counts[: len(own)] += number
        worth[: len(own)] += [freedom(tools, len(part), int(m)) for m in own]
    return Curve(octaves * period_s, np.sqrt(squares / np.maximum(counts, 1.0)[:, None]), worth)


def freedom(tools: ModuleType, count: int, m: int) -> float:
    """Equivalent degrees of freedom (NIST SP 1065, table 5).

    The smaller of those for white noise and for a random walk.
    """
    return max(1.0, min(float(tools.edf_simple(count + 1, m, alpha)) for alpha in (0, -2)))


def density_bound(curve: Curve) -> list[float | None]:
    """Upper bound of the white density by axis.

    It is the least of deviation * sqrt(tau) with its confidence.
    """
    from scipy.special import gammaincinv

    enough = curve.freedom >= MIN_FREEDOM
    if not enough.any():
        return [None] * 3
    freedom = curve.freedom[enough]
    stretch = np.sqrt(freedom / (2.0 * gammaincinv(freedom / 2.0, BOUND_RISK)))  # the quantile of chi²
    bounds = curve.deviation[enough] * (np.sqrt(curve.tau_s[enough]) * stretch)[:, None]
    return [float(value) for value in bounds.min(axis=0)]


def slopes(curve: Curve) -> list[Slopes]:
    """Slopes of each axis of a curve."""
    return [_slopes(curve.tau_s, curve.deviation[:, axis] ** 2, curve.freedom) for axis in range(3)]


def _slopes(
    tau_s: Float64[np.ndarray, " m"], variance: Float64[np.ndarray, " m"], freedom: Float64[np.ndarray, " m"]
) -> Slopes:
    if not (variance > 0).all():
        return Slopes()  # a constant: no sensor, or one that is stuck
    error = np.sqrt(2.0 / freedom + MODEL_ERROR**2)
    for first in range(len(tau_s) - MIN_TIMES + 1):
        part = slice(first, None)
        fit = _fit(tau_s[part], variance[part], error[part])
        if fit.misfit <= MISFIT:
            below = variance[:first] / _sum(fit.powers, tau_s[:first])
            excess = float(below[np.argmax(np.abs(np.log(below)))]) if first else 1.0
            seen = {k: v for k, v in fit.powers.items() if k not in fit.doubtful and _is_seen(k, fit.powers, tau_s[part])}
            return Slopes(seen, {name: fit.std[name] for name in seen}, fit.powers, float(tau_s[first]), excess)
    return Slopes()


class _Fit(NamedTuple):
    """Fitted powers, their standard deviations, the ambiguous ones, and the largest misfit."""

    powers: dict[str, float]
    std: dict[str, float]
    doubtful: set[str]
    misfit: float


def _fit(tau_s: Float64[np.ndarray, " m"], variance: Float64[np.ndarray, " m"], error: Float64[np.ndarray, " m"]) -> _Fit:
    """Backward elimination from all powers, or from as many as there are averaging times to tell them apart."""
    names = list(POWERS)
    if len(tau_s) < len(names) + 1:
        names = names[: max(1, len(tau_s) - 1)]  # the longer a power needs, the less a short stretch can show it
    best = _non_negative(names, tau_s, variance, error)
    while len(names) > 1:
        without = {name: _non_negative([n for n in names if n != name], tau_s, variance, error) for name in names}
        minimum = min(without, key=lambda name: without[name][1])
        if without[minimum][1] - best[1] >= NEEDED:
            break
        names.remove(minimum)
        best = without[minimum]
    coefficients, chi2, residual, std = best
    powers, spread, doubtful = {}, {}, set()
    order = list(POWERS)
    for name, c, s in zip(names, coefficients, std, strict=True):
        if c > 0:
            powers[name] = float(np.sqrt(c))
            spread[name] = float(s / (2.0 * np.sqrt(c))) * (CORRELATED if name != "density" else 1.0)
            others = {n for n in order if abs(order.index(n) - order.index(name)) == 1} - set(names)
            swapped = [[*(n for n in names if n != name), other] for other in others]
            if any(_non_negative(s, tau_s, variance, error)[1] < chi2 + TOLD_APART for s in swapped):
                doubtful.add(name)
    return _Fit(powers, spread, doubtful, float(np.abs(residual).max()))


def _non_negative(
    names: Sequence[str],
    tau_s: Float64[np.ndarray, " m"],
    variance: Float64[np.ndarray, " m"],
    error: Float64[np.ndarray, " m"],
) -> tuple[Float64[np.ndarray, " k"], float, Float64[np.ndarray, " m"], Float64[np.ndarray, " k"]]:
    """Squared strengths, robust chi², residuals and standard deviations of the strengths; relative to what is fitted."""
    from scipy.optimize import nnls

    columns = np.stack([POWERS[name][0] * tau_s ** float(POWERS[name][1]) for name in names], axis=1)
    fitted, weight = variance, np.ones_like(variance)
    x = np.zeros(len(names))
    for _ in range(ITERATIONS):
        scale = np.sqrt(weight) / (error * fitted)
        design = columns * scale[:, None]
        norm = np.linalg.norm(design, axis=0)
        x = nnls(design / norm, variance * scale)[0] / norm
        fitted = np.maximum(columns @ x, 1e-3 * variance)
        residual = np.log(variance / fitted) / error  # of the logarithm: as strict below the fit as above it
        weight = np.minimum(1.0, HUBER / np.maximum(np.abs(residual), 1e-12))
    size = np.abs(residual)
    chi2 = float(np.where(size <= HUBER, size**2, 2.0 * HUBER * size - HUBER**2).sum())
    design = columns / (error * fitted)[:, None]
    norm = np.linalg.norm(design, axis=0)
    covariance = np.linalg.pinv((design / norm).T @ (design / norm)) / np.outer(norm, norm)
    return x, chi2, residual, np.sqrt(np.diag(covariance))


def _sum(powers: dict[str, float], tau_s: Float64[np.ndarray, " m"]) -> Float64[np.ndarray, " m"]:
    parts = [part(name, value, tau_s) ** 2 for name, value in powers.items()]
    return np.sum(parts, axis=0) if parts else np.zeros_like(tau_s)


def part(name: str, value: float, tau_s: Float64[np.ndarray, " m"]) -> Float64[np.ndarray, " m"]:
    """Allan deviation of a single power."""
    factor, exponent = POWERS[name]
    return np.asarray(value * np.sqrt(factor * tau_s ** float(exponent)))


def _is_seen(name: str, powers: dict[str, float], tau_s: Float64[np.ndarray, " m"]) -> bool:
    """Whether a power makes up half of the variance over as many averaging times as its slope needs to show."""
    rules: Bool[np.ndarray, " m"] = part(name, powers[name], tau_s) ** 2 >= HALF * _sum(powers, tau_s)
    return int(rules.sum()) >= MIN_TIMES_OF[name]


VIBRATES = 2.0  # times the white variance at shorter averaging times: more than any filter or misfit


def rest_remarks(sensor: Sensor, slopes: Sequence[Slopes], coarse: Sequence[bool]) -> list[str]:
    """Remarks on axes at rest that show a vibration, or nothing but their digits."""
    vibrating = ["xyz"[axis] for axis, of_axis in enumerate(slopes) if _vibrates(of_axis) and not coarse[axis]]
    digits = ["xyz"[axis] for axis, wrong in enumerate(coarse) if wrong]
    shake = (
        f"the {sensor}'s deviation on {', '.join(vibrating)} does not fall as tau^-1/2 from the shortest on: "
        "something vibrates (idling motors?), so its noise is above the data sheet's"
    )
    round_off = f"the {sensor} on {', '.join(digits)} hardly leaves one reading: its digits are too coarse to show its noise"
    return [shake] * bool(vibrating) + [round_off] * bool(digits)


def _vibrates(slopes: Slopes) -> bool:
    return slopes.excess > VIBRATES or "quantisation" in slopes.seen or not slopes.powers
