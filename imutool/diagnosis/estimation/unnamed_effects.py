"""Misfits without a name in the catalogue: driven by another channel of the log, or unknown.

Each becomes a `Effect` of its own, made for the log at hand, so that it is fitted, tested, simulated and removed like any
other. `driven`: gain on every axis times a channel, some time later. `unknown`: a smooth curve of one variable (cubic
B-splines), or a short equation out of a library of products and powers; whichever explains more is kept, and no name is given
to it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import BSpline

from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.sensor import catalogue
from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.samples import SensorSamples, Vectors
from imutool.sensor.unnamed_effects import VARIABLES
from imutool.units import AXES, Sensor

LAGS_S = (-0.5, -0.2, -0.1, -0.05, 0.0, 0.05, 0.1, 0.2, 0.5)
KNOTS, FINE_KNOTS = 9, 33
SIGNALS: tuple[tuple[Sensor, str], ...] = (("gyro", "rad/s"), ("accel", "m/s²"))
PLAUSIBLE = {"gyro": 0.1, "accel": 1.0}
INSIDE = 0.005  # of the values of a variable lie beyond its first knot, and as many beyond its last
QUANTILES, BY_RANGE = 1001, 0.35  # places between which knots are found, and how many of them by the range alone
SPREAD = 1e-9  # relative: knots that lie closer are one

Variable = Callable[[SensorSamples], Float64[np.ndarray, " n"]]


def driven(pairs: Sequence[Pair]) -> Iterator[Effect]:
    """Effects driven by each other channel of the logs, on one of the sensors.

    + gain * channel, taken some time earlier.
    """
    named = {need for effect in catalogue.diagnosed() for need in effect.needs}
    for name in sorted(set.intersection(*(set(pair.channels) for pair in pairs))):
        if any(need in name for need in named):
            continue  # the catalogue has a name for that
        values = np.concatenate([pair.channels[name] for pair in pairs])
        center, size = float(np.mean(values)), float(np.std(values))
        if size <= 0:
            continue
        for k, (signal, measured_in) in enumerate(SIGNALS):
            numbers = (
                *(Parameter(axis, f"{measured_in} per unit of {name}", PLAUSIBLE[signal] / size) for axis in AXES),
                Parameter("lag", "s", 0.2),
            )
            yield Effect(
                "driven",
                Stage.SENSOR,
                (signal,),
                f"{signal} += gain ({name}(t - lag) - mean)",
                numbers,
                f"{name} varies",
                _Driven(name, center, k),
                linear=False,
                starts=lambda ideal, real: [np.array([0.0, 0.0, 0.0, lag]) for lag in LAGS_S],
                kind="driven",
                variable=name,
                variant=f"{name}:{signal}",
            )


class _Driven:
    def __init__(self, channel: str, center: float, sensor: int) -> None:
        self.channel, self.center, self.sensor = channel, center, sensor

    def __call__(self, read: SensorSamples, theta: Theta) -> SensorSamples:
        x = np.interp(read.stamp_s - theta[3], read.stamp_s, read.channels[self.channel]) - self.center
        added = x[:, None] * theta[:3]
        return read.with_readings(gyro=read.gyro + added) if self.sensor == 0 else read.with_readings(accel=read.accel + added)


UNIT_OF = {"omega": "rad/s", "f": "m/s²", "alpha": "rad/s²", "t": "s"}


def unit(variable: str) -> str:
    """Of what a misfit may be a function of."""
    return UNIT_OF[variable.strip("|").split("_")[0]]


def curves(like: SensorSamples) -> Iterator[Effect]:
    """A smooth curve of each variable, on each axis of each sensor."""
    for variable in VARIABLES:
        inner = _knots(like, variable, KNOTS)
        if inner is not None:
            yield from (_curve(variable, k, axis, inner) for k in range(len(SIGNALS)) for axis in range(3))


def finer(effect: Effect, like: SensorSamples) -> Effect | None:
    """Curve with more knots, for an edge; None where the variable has no room for them."""
    coarse = effect.forward
    if not isinstance(coarse, Curve):
        return None
    inner = _knots(like, coarse.variable, FINE_KNOTS)
    return None if inner is None else _curve(coarse.variable, coarse.sensor, coarse.axis, inner)


def _knots(like: SensorSamples, variable: str, count: int) -> Float64[np.ndarray, " p"] | None:
    """Most of them by samples, some by the range they go through; none for what hardly varies.

    By samples alone, a robot that stands most of the time has all its knots where it stands.
    """
    at = np.quantile(VARIABLES[variable](like), np.linspace(INSIDE, 1 - INSIDE, QUANTILES))
    along = (at - at[0]) / max(at[-1] - at[0], np.finfo(np.float64).tiny)
    reached = (1.0 - BY_RANGE) * np.linspace(0.0, 1.0, QUANTILES) + BY_RANGE * along
    inner = np.interp(np.linspace(0.0, 1.0, count - 2), reached, at)
    return inner if np.diff(inner).min() > SPREAD * max(1.0, np.abs(inner).max()) else None


def _curve(variable: str, sensor: int, axis: int, inner: Float64[np.ndarray, " p"]) -> Effect:
    signal, measured_in = SIGNALS[sensor]
    return Effect(
        "unknown",
        Stage.SENSOR,
        (signal,),
        f"{signal}.{AXES[axis]} += curve({variable})",
        tuple(Parameter(f"c{j}", measured_in, PLAUSIBLE[signal]) for j in range(len(inner) + 2)),
        f"{variable} varies",
        Curve(variable, sensor, axis, inner),
        kind="unknown",
        variable=variable,
        axis=axis,
        variant=f"{signal}.{AXES[axis]}({variable})",
    )


class SplineCurve:
    """Spline curve (cubic) of one variable, constant beyond its ends.

    Coefficients are those of B-splines, or of sums of them.

    Where samples are many, knots are close: at even distances, what the motion rarely does would bend all the rest.
    """

    def __init__(self, variable: str, inner: Float64[np.ndarray, " p"]) -> None:
        self.variable, self.inner = variable, inner
        self._last: tuple[np.ndarray, np.ndarray] | None = None
        self.knots = np.concatenate([[inner[0]] * 3, inner, [inner[-1]] * 3])

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


class Curve(SplineCurve):
    """+ a spline of one variable on one axis of an IMU."""

    def __init__(self, variable: str, sensor: int, axis: int, inner: Float64[np.ndarray, " p"]) -> None:
        super().__init__(variable, inner)
        self.sensor, self.axis = sensor, axis

    def __call__(self, read: SensorSamples, theta: Theta) -> SensorSamples:
        """The reading with the curve on it."""
        return _on_axis(read, self.sensor, self.axis, self.basis(VARIABLES[self.variable](read)) @ theta)


def library() -> Iterator[tuple[str, Variable]]:
    """Terms of equations, as physics.toml writes them."""
    names = [f"{kind}_{axis}" for kind in ("omega", "f", "alpha") for axis in AXES]
    for k, name in enumerate(names):
        x = VARIABLES[name]
        yield name, x
        yield f"|{name}|", partial(_of, x, np.abs)
        yield f"{name} |{name}|", partial(_of, x, lambda v: v * np.abs(v))
        yield f"{name}^3", partial(_of, x, lambda v: v * v * v)
        yield f"sign({name})", partial(_of, x, np.sign)
        for other in names[: k + 1]:
            yield f"{other} {name}", partial(_product, VARIABLES[other], x)


def _of(x: Variable, function: Callable[[np.ndarray], np.ndarray], read: SensorSamples) -> Float64[np.ndarray, " n"]:
    return np.asarray(function(x(read)))


def _product(x: Variable, y: Variable, read: SensorSamples) -> Float64[np.ndarray, " n"]:
    return x(read) * y(read)


def terms(like: SensorSamples) -> Iterator[Effect]:
    """Each term of the library on each axis of each sensor."""
    for text, term in library():
        size = float(np.std(term(like)))
        if not size > 0:
            continue
        for k, (signal, measured_in) in enumerate(SIGNALS):
            for axis in range(3):
                yield Effect(
                    "unknown",
                    Stage.SENSOR,
                    (signal,),
                    f"{signal}.{AXES[axis]} += c {text}",
                    (Parameter("c", f"{measured_in} per unit of {text}", PLAUSIBLE[signal] / size),),
                    f"{text} varies",
                    _Term(term, k, axis),
                    kind="unknown",
                    variable=text,
                    axis=axis,
                    variant=f"{signal}.{AXES[axis]}:{text}",
                )


class _Term:
    def __init__(self, term: Variable, sensor: int, axis: int) -> None:
        self.term, self.sensor, self.axis = term, sensor, axis

    def __call__(self, read: SensorSamples, theta: Theta) -> SensorSamples:
        return _on_axis(read, self.sensor, self.axis, theta[0] * self.term(read))


def _on_axis(read: SensorSamples, sensor: int, axis: int, added: Float64[np.ndarray, " n"]) -> SensorSamples:
    out: Vectors = (read.gyro if sensor == 0 else read.accel).copy()
    out[:, axis] += added
    return read.with_readings(gyro=out) if sensor == 0 else read.with_readings(accel=out)


def like(pairs: Sequence[Pair]) -> SensorSamples:
    """Ideal signals at the samples of the first log that are fitted: what ranges there are."""
    pair = pairs[0]
    stamp_s = pair.stamp_s[pair.fitted]
    return pair.ideal.sample(stamp_s, stamp_s)
