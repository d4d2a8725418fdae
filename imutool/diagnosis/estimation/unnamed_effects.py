"""Misfits without a name in the catalogue: driven by another channel of the log, or unknown.

Each becomes a `Effect` of its own, made for the log at hand. `driven`: gain on every axis times a channel, some time later.
`unknown`: a smooth curve of one variable (cubic B-splines) or a short equation of products and powers; which explains more.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.integrate import trapezoid
from scipy.interpolate import PPoly, make_interp_spline

from imutool.array_types import Float64
from imutool.diagnosis.estimation.aligned_log import AlignedLog, Pair
from imutool.diagnosis.estimation.gauss_newton import Fit, fit
from imutool.diagnosis.estimation.jacobians import AddedColumns, Chosen, SplineBasis, SplineCurve, expected
from imutool.diagnosis.estimation.observability import values_of, without_implausible
from imutool.diagnosis.estimation.significance import bic
from imutool.diagnosis.estimation.trial.filter_forms import is_late
from imutool.diagnosis.estimation.whitening import WhitenedLog
from imutool.sensor import catalogue
from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.effects.low_pass import Design, smoothed
from imutool.sensor.physics_file_terms import VARIABLES, Variable, product_of
from imutool.sensor.physics_file_terms import driven as channel_effect
from imutool.sensor.samples import Recent, SensorSamples
from imutool.units import AXES, SENSORS, UNITS

LAGS_S = (-0.5, -0.2, -0.1, -0.05, 0.0, 0.05, 0.1, 0.2, 0.5)
KNOTS, FINE_KNOTS = 9, 33
PLAUSIBLE, PLAUSIBLE_LAG_S = {"gyro": 0.1, "accel": 1.0}, 0.2
INSIDE = 0.005  # of the values of a variable lie beyond its first knot, and as many beyond its last
QUANTILES, BY_RANGE = 1001, 0.35  # places between which knots are found, and how many of them by the range alone
REPEATED = 0.01  # of a channel's variance, left by the IMU's samples: below it the channel is these samples
LAG_SHARE = 0.8  # of what a low-pass removes, that its lag has to explain
SMOOTHED_SHARE = 0.15  # of the noise that a filter left: it errs by up to 0.13 of it
SPREAD = 1e-9  # relative: knots that lie closer are one


def driven(pairs: Sequence[Pair]) -> Iterator[Effect]:
    """Effects of each other channel of the logs, some time earlier, on one of the sensors."""
    named = {need for effect in catalogue.diagnosed() for need in effect.needs}
    for name in sorted(set.intersection(*(set(pair.channels) for pair in pairs))):
        size = float(np.std(np.concatenate([pair.channels[name] for pair in pairs])))
        if size <= 0 or any(need in name for need in named):
            continue  # constant, or the catalogue has a name for that
        if all(_repeats(pair, name) for pair in pairs):
            continue  # the IMU itself is no cause of its error
        for signal in SENSORS:
            effect = channel_effect(signal, name)
            plausible = (PLAUSIBLE[signal] / size,) * 3 + (PLAUSIBLE_LAG_S,)
            yield replace(
                effect,
                parameters=tuple(replace(n, plausible=p) for n, p in zip(effect.parameters, plausible, strict=True)),
                equation=f"{signal} += gain ({name}(t - lag) - mean)",
                observable_if=f"{name} varies",
                linear=False,
                starts=lambda ideal, real: [np.array([0.0, 0.0, 0.0, lag]) for lag in LAGS_S],
                kind="driven",
                variable=name,
                variant=f"{name}:{signal}",
            )


def _repeats(pair: Pair, name: str) -> bool:
    """Whether a channel is the IMU's own samples again, calibrated or not."""
    rows = pair.fitted | pair.held_out
    samples, channel = (x[rows] - x[rows].mean(axis=0) for x in (pair.real, pair.channels[name]))
    gain = np.linalg.lstsq(samples, channel)[0]
    return float(np.var(channel - samples @ gain)) < REPEATED * float(np.var(channel))


UNIT_OF = {"omega": "rad/s", "f": "m/s²", "alpha": "rad/s²", "t": "s"}


def unit(variable: str) -> str:
    """Of what a misfit may be a function of."""
    return UNIT_OF[variable.strip("|").split("_")[0]]


def curves(like: SensorSamples) -> Iterator[Effect]:
    """A smooth curve of each variable, on each axis of each sensor."""
    for variable in VARIABLES:
        inner = _knots(like, variable, KNOTS)
        if inner is not None:
            splines = SplineBasis(inner)
            yield from (_curve(variable, k, axis, splines) for k in range(len(SENSORS)) for axis in range(3))


def finer(effect: Effect, like: SensorSamples) -> Effect | None:
    """Curve with more knots, for an edge; None where the variable has no room for them."""
    coarse = effect.forward
    if not isinstance(coarse, Curve):
        return None
    inner = _knots(like, coarse.variable, FINE_KNOTS)
    return None if inner is None else _curve(coarse.variable, coarse.sensor, coarse.axis, SplineBasis(inner))


def _knots(like: SensorSamples, variable: str, count: int) -> Float64[np.ndarray, " p"] | None:
    """Most of them by samples, some by the range they go through; none for what hardly varies.

    By samples alone, a robot that stands most of the time has all its knots where it stands.
    """
    at = np.quantile(VARIABLES[variable](like), np.linspace(INSIDE, 1 - INSIDE, QUANTILES))
    along = (at - at[0]) / max(at[-1] - at[0], np.finfo(np.float64).tiny)
    reached = (1.0 - BY_RANGE) * np.linspace(0.0, 1.0, QUANTILES) + BY_RANGE * along
    inner = np.interp(np.linspace(0.0, 1.0, count - 2), reached, at)
    return inner if np.diff(inner).min() > SPREAD * max(1.0, np.abs(inner).max()) else None


def _curve(variable: str, sensor: int, axis: int, splines: SplineBasis) -> Effect:
    signal = SENSORS[sensor]
    return Effect(
        "unknown",
        Stage.SENSOR,
        (signal,),
        f"{signal}.{AXES[axis]} += curve({variable})",
        tuple(Parameter(f"c{j}", UNITS[signal], PLAUSIBLE[signal]) for j in range(len(splines.inner) + 2)),
        f"{variable} varies",
        Curve(variable, sensor, axis, splines),
        kind="unknown",
        variable=variable,
        axis=axis,
        variant=f"{signal}.{AXES[axis]}({variable})",
        of_time=variable == "t",
    )


class Curve(AddedColumns, SplineCurve):
    """+ a spline of one variable on one axis of an IMU; curves of a variable share splines."""

    def __init__(self, variable: str, sensor: int, axis: int, splines: SplineBasis) -> None:
        super().__init__(variable, unit(variable), splines.inner, columns=len(AXES), axis=axis)
        self.sensor, self._splines = sensor, splines

    def columns_at(self, samples: SensorSamples) -> Float64[np.ndarray, "n q"]:
        """The splines."""
        return self._splines.basis(VARIABLES[self.variable](samples))

    def added_at(self, samples: SensorSamples, theta: Theta) -> Float64[np.ndarray, " n"]:
        """Their sum by its polynomial between two knots: 25 times as fast as the splines themselves."""
        x = np.clip(VARIABLES[self.variable](samples), self.inner[0], self.inner[-1])
        return np.asarray(PPoly.from_spline((self.knots, theta, 3))(x))


def library() -> Iterator[str]:
    """Terms of equations, as physics.toml writes them."""
    names = [f"{kind}_{axis}" for kind in ("omega", "f", "alpha") for axis in AXES]
    for k, name in enumerate(names):
        yield from (name, f"|{name}|", f"{name} |{name}|", f"{name}^3", f"sign({name})")
        yield from (f"{other} {name}" for other in names[: k + 1])


def terms(like: SensorSamples) -> Iterator[Effect]:
    """Each term of the library on each axis of each sensor."""
    known = Recent()  # all axes of both sensors ask for the same values
    for text in library():
        term = product_of(text)
        assert term is not None, f"{text} is a product of known factors"
        size = float(np.std(term(like)))
        for sensor, signal in enumerate(SENSORS) if size > 0 else ():
            for axis, letter in enumerate(AXES):
                yield Effect(
                    "unknown",
                    Stage.SENSOR,
                    (signal,),
                    f"{signal}.{letter} += c {text}",
                    (Parameter("c", f"{UNITS[signal]} per unit of {text}", PLAUSIBLE[signal] / size),),
                    f"{text} varies",
                    _Term(term, known, sensor, axis),
                    kind="unknown",
                    variable=text,
                    axis=axis,
                    variant=f"{signal}.{letter}:{text}",
                )


class _Term(AddedColumns):
    def __init__(self, term: Variable, known: Recent, sensor: int, axis: int) -> None:
        self.term, self.known, self.sensor, self.axis = term, known, sensor, axis

    def columns_at(self, samples: SensorSamples) -> Float64[np.ndarray, "n 1"]:
        return self.known.made(samples, self.term, lambda: self.term(samples)[:, None])


def like(pairs: Sequence[Pair]) -> SensorSamples:
    """Ideal signals at the samples of the first log that are fitted: what ranges there are."""
    pair = pairs[0]
    stamp_s = pair.stamp_s[pair.fitted]
    return pair.ideal.sample(stamp_s, stamp_s)


def with_finer_curve(base: Fit) -> Fit:
    """Fit with more knots in the curve that has just come in, where an edge pays for them (BIC)."""
    others, (effect, _) = base.chosen[:-1], base.chosen[-1]
    fine = finer_curve(base.logs, effect) if isinstance(effect.forward, Curve) else None
    if fine is None:
        return base
    trial = fit(base.logs, (*others, (fine, fine.null_value.astype(float))), near=base)
    return trial if bic(trial) < bic(base) - base.logs[0].pair.settings.search.clearly_better else base


def finer_curve(logs: Sequence[WhitenedLog], curve: Effect) -> Effect | None:
    """Curve with more knots; none where the variable has no room for them."""
    return finer(curve, like([log.pair for log in logs if isinstance(log.pair, Pair)]))


def takes_noise(effect: Effect, theta: Theta, logs: Sequence[WhitenedLog]) -> bool:
    """Whether a term, a curve or a limit takes the noise of poses or of a simulation.

    On an axis that hardly moves, what poses say is their own noise, and whatever shrinks it removes a misfit (regression
    dilution; Fuller, Measurement Error Models, 1987, eq. 1.1.7). So a limit, a term or a curve takes it, if it takes most of
    the axis' motion: no sensor loses so much. Of a simulation a term or a curve takes it, if it is no larger than this noise.
    """
    if effect.kind == "unknown" and any(_within_noise(effect, theta, log.pair) for log in logs):
        return True
    if effect.kind == "catalogue" and effect.name != "saturation":
        return False

    def taken(log: WhitenedLog) -> Float64[np.ndarray, " k"]:
        """Share of the motion that the effect takes, by axis."""
        ideal, rows, constant = expected(log.pair, ()), log.rows("all"), log.constants[log.rows("all")]
        added = log.whiten(expected(log.pair, ((effect, theta),)) - ideal)[rows]
        motion = log.whiten(ideal)[rows]
        motion = motion - constant * (constant * motion).sum(axis=0) / np.maximum((constant**2).sum(axis=0), 1e-300)
        return np.asarray(-(motion * added).sum(axis=0) / np.maximum((motion**2).sum(axis=0), 1e-300))

    return any(bool((taken(log) > log.pair.settings.search.max_taken).any()) for log in logs if log.pair.band_hz is not None)


def _within_noise(effect: Effect, theta: Theta, pair: AlignedLog) -> bool:
    """Whether an effect adds no more to any axis than a simulation's own noise does."""
    if not isinstance(pair, Pair) or pair.noise_left is None:
        return False
    added = (expected(pair, ((effect, theta),)) - expected(pair, ()))[pair.fitted | pair.held_out]
    return bool((added.var(axis=0) < trapezoid(pair.noise_left.density, pair.noise_left.f_hz, axis=0)).all())


def plausible_part(chosen: Chosen, factor: float) -> Chosen | None:
    """Effects without implausible parameters; None if all are plausible."""
    reduced = [without_implausible(effect, theta, factor) for effect, theta in chosen]
    if all(new is effect for new, (effect, _) in zip(reduced, chosen, strict=True)):
        return None
    kept = [(new, values_of(effect, new, theta)) for new, (effect, theta) in zip(reduced, chosen, strict=True)]
    return tuple(pair for pair in kept if len(pair[1]))


def has_no_size(effect: Effect, theta: Theta, std: Theta, *, curve: bool) -> bool:
    """Whether a fitted frequency is no larger than its deviation, or no amplitude than its own.

    A curve's coefficients move together by a constant, which the bias takes: each is as unsure as its prior, however sure
    the curve. So do the amplitudes of a drift with a time constant that its log does not show.
    """
    if curve or effect.reached is not None:
        return False
    vague = any(
        parameter.unit == "Hz" and s >= value for parameter, value, s in zip(effect.parameters, theta, std, strict=True)
    )
    # what has another null value than zero, a time constant or a frequency, has no size by itself
    amounts = [k for k, n in enumerate(effect.parameters) if n.null_value == 0.0 and not n.begins]
    return vague or (bool(amounts) and bool((np.abs(theta[amounts]) < std[amounts]).all()))


def smoothing(found: Fit, first: int) -> Chosen:
    """Low-passes that only smooth what is left of a simulation's noise, without their lag."""
    filters = [entry for entry in found.chosen[first:] if entry[0].lagless and any(log.pair.denoised for log in found.logs)]
    early = ((effect, theta) for effect, theta in filters if not is_late(found, effect))
    return tuple((effect.without_lag(theta), theta) for effect, theta in early if _only_smooths(effect, theta, found))


def _only_smooths(effect: Effect, theta: Theta, found: Fit) -> bool:
    """Whether no lag is explained, nor more than a filter errs by (clocks without a common epoch hide a lag)."""
    others, lagless = tuple(entry for entry in found.chosen if entry[0] is not effect), (effect.without_lag(theta), theta)
    without, alike = (fit(found.logs, chosen, part=found.part) for chosen in (others, (*others, lagless)))
    gain, of_lag = without.objective - found.objective, alike.objective - found.objective
    if of_lag >= LAG_SHARE * gain:
        return False
    return gain < sum(_smoothed_squares(log, Design.of(effect, theta), found.part) for log in found.logs)


def _smoothed_squares(log: WhitenedLog, design: Design, part: str) -> float:
    """White squares that a low-pass takes from the noise that is left of a simulation; infinite if that is unknown."""
    rest, share = log.pair.noise_left, SMOOTHED_SHARE if isinstance(log.pair, Pair) else 1.0  # of a signal it is all noise
    if rest is None:
        return np.inf
    n, rate_hz = len(log.pair.real), 1.0 / log.pair.period_s
    density = make_interp_spline(rest.f_hz, rest.density, k=1)(np.fft.rfftfreq(n, 1.0 / rate_hz).clip(max=rest.f_hz[-1]))
    white = np.fft.rfft(np.random.default_rng(0).normal(scale=np.sqrt(rate_hz / 2.0), size=(n, log.pair.columns)), axis=0)
    noise = np.fft.irfft(np.sqrt(density) * white, n, axis=0)
    before, after = (log.whiten(x)[log.rows(part)] for x in (noise, smoothed(noise, rate_hz, design)))
    return share * float((before**2).sum() - (after**2).sum())
