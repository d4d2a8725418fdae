"""What can come between any simulated signal and its recording, whatever it measures: effects with a forward model each.

In the order in which they act: low_pass, delay, gain, dead_band, then what is added (offset, drift, friction, a driving
channel, a curve without a name), saturation, quantization. Dead zone, Coulomb friction and first-order lag are those of control
textbooks (e.g. Slotine and Li, Applied Nonlinear Control, chapter 5).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import BSpline
from scipy.ndimage import map_coordinates, spline_filter
from scipy.signal import lfilter

from imutool.sensor.effect import Parameter, Theta

Column = Float64[np.ndarray, "_"]
Samples = Float64[np.ndarray, " n"]
LAGS_S = (-0.5, -0.2, -0.1, -0.05, 0.0, 0.05, 0.1, 0.2, 0.5)
CUTOFFS = (100.0, 30.0, 10.0, 3.0, 1.0, 0.3)  # to start from, over the signal's own mean frequency
WIDTHS = (0.05, 0.15, 0.4, 0.8)  # of a dead band, over the signal's standard deviation
REACHED = (0.001, 0.02, 0.1)  # of the samples beyond a limit to start from
STEEP = 0.002  # of the signal's size, over which a jump is smeared
MOVED = (
    0.005  # of the signal's size, by which derivatives move it: more than a jump's width, or they would see none or all of it
)
KNOTS, KNOTS_OF_TIME = 7, 15
BEND = 0.3  # of the signal's size: a second difference between a curve's knots
SAME = 0.98  # correlation above which another channel says what the signal says
KEPT = 6  # intermediate signals


class Stage(IntEnum):
    """When an effect acts."""

    BANDWIDTH = 0
    CLOCK = 1
    GAIN = 2
    BREAK = 3
    ADDED = 4
    LIMIT = 5


@dataclass(frozen=True)
class Taken:
    """The simulated signal and its derivative (per second) as they are sampled, and when that is (s)."""

    x: Samples
    dx: Samples
    t_s: Samples
    channels: Mapping[str, tuple[Column, Column]]


@dataclass(frozen=True, eq=False)
class Effect:
    """An effect as it acts; variants of one name (`key` tells them apart) never act together.

    forward: (fine samples, their rate, theta) -> fine samples at BANDWIDTH; theta -> delay in seconds at CLOCK;
        (samples, Taken, theta) -> samples after.
    """

    name: str
    key: str
    stage: Stage
    equation: str
    numbers: tuple[Parameter, ...]
    forward: Callable[..., object]
    starts: tuple[Theta, ...]
    driver: str = ""
    jumps: bool = False  # where its parameters say: what comes out is no smooth function of them
    wanders: bool = False  # in time, so that a few blocks do not say what is between them

    @property
    def null_value(self) -> Theta:
        """The parameters at which it does nothing."""
        return np.array([number.null_value for number in self.numbers])


Chosen = tuple[tuple[Effect, Theta], ...]


@dataclass(eq=False)
class Ideal:
    """The simulated signal without noise, on a fine even clock, and the stamps (s) at which the recording took it."""

    start_s: float
    rate_hz: float
    fine: Column
    t_s: Samples
    channels: Mapping[str, tuple[Column, Column]]
    _kept: dict[bytes, Taken] = field(default_factory=dict)

    def taken(self, chosen: Chosen) -> Taken:
        """As the signal arrives after low_pass and delay; kept, because derivatives ask for the same again and again."""
        early = [one for one in chosen if one[0].stage <= Stage.CLOCK]
        key = b"".join(effect.key.encode() + theta.tobytes() for effect, theta in early)
        if key not in self._kept:
            if len(self._kept) >= KEPT:
                self._kept.pop(next(iter(self._kept)))
            fine, delay_s = self.fine, 0.0
            for effect, theta in early:
                if effect.stage == Stage.BANDWIDTH:
                    fine = np.asarray(effect.forward(fine, self.rate_hz, theta))
                else:
                    delay_s += float(theta[0])
            at = (self.t_s - delay_s - self.start_s) * self.rate_hz
            x, dx = (
                map_coordinates(spline_filter(column), at[None], order=3, mode="nearest", prefilter=False)
                for column in (fine, np.gradient(fine) * self.rate_hz)
            )
            self._kept[key] = Taken(x, dx, self.t_s, self.channels)
        return self._kept[key]

    def expected(self, chosen: Chosen) -> Samples:
        """What the recording would read with these effects."""
        taken = self.taken(chosen)
        y = taken.x
        for effect, theta in sorted(chosen, key=lambda one: one[0].stage):
            if effect.stage > Stage.CLOCK:
                y = np.asarray(effect.forward(y, taken, theta))
        return y


# ── the effects ──


def offset(size: float, unit: str) -> Effect:
    """A constant: part of every fit, and never news on its own."""
    return Effect(
        "offset",
        "offset",
        Stage.ADDED,
        "y += offset",
        (Parameter("offset", unit, 10.0 * size),),
        lambda y, taken, theta: y + theta[0],
        (np.zeros(1),),
    )


def delay(lag_s: float, step_s: float) -> Effect:
    """Positive where the recording comes late; `step_s` is what derivatives move it by."""
    starts = (np.zeros(1),) if abs(lag_s) < 1e-9 else (np.zeros(1), np.array([lag_s]))
    numbers = (Parameter("delay", "s", max(0.2, abs(lag_s)), step=step_s),)
    return Effect("delay", "delay", Stage.CLOCK, "y(t) = x(t - delay)", numbers, lambda theta: theta[0], starts)


def step_s(ideal: Ideal) -> float:
    """A delay that moves the signal by `MOVED` of its size."""
    taken = ideal.taken(())
    return MOVED * float(taken.x.std()) / float(taken.dx.std())


def named(ideal: Ideal, real: Samples, lag_s: float, unit: str) -> Iterator[Effect]:
    """The effects that any signal can have, for one whose simulated side is given; quantization is seen in the values alone."""
    taken = ideal.taken(())
    size, slope = float(taken.x.std()), float(taken.dx.std())
    yield delay(lag_s, step_s(ideal))
    yield Effect(
        "low_pass",
        "low_pass",
        Stage.BANDWIDTH,
        "dy/dt = 2 pi f_c (x - y)",
        (Parameter("f_c", "Hz", 10.0, positive=True, null_value=np.inf),),
        _low_pass,
        tuple(np.array([times * slope / size / (2.0 * np.pi)]) for times in CUTOFFS),
    )
    yield Effect(
        "gain",
        "gain",
        Stage.GAIN,
        "y = gain x",
        (Parameter("gain", "-", 0.5, null_value=1.0),),
        lambda y, taken, theta: theta[0] * y,
        (np.ones(1),),
    )
    yield from _dead_bands(size, unit)
    yield from _drifts(ideal, size, unit)
    level = (Parameter("level", unit, size),)
    yield Effect(
        "friction", "friction of x", Stage.ADDED, "y += level sign(x)", level, _Sign(False, STEEP * size), (np.zeros(1),)
    )
    yield Effect(
        "friction", "friction of dx", Stage.ADDED, "y += level sign(dx/dt)", level, _Sign(True, STEEP * slope), (np.zeros(1),)
    )
    yield from _limits(real, size, unit)


def _low_pass(fine: Column, rate_hz: float, theta: Theta) -> Column:
    """First-order lag, exact for straight lines between fine samples; as if what came first had always been."""
    a = 2.0 * np.pi * min(float(theta[0]), 1e3 * rate_hz) / rate_hz  # rad a sample
    e = np.exp(-a)
    b = [1.0 - (1.0 - e) / a, (1.0 - e) / a - e]
    return np.asarray(lfilter(b, [1.0, -e], fine - fine[0]) + fine[0])


def _dead_bands(size: float, unit: str) -> Iterator[Effect]:
    numbers = (Parameter("width", unit, size, positive=True), Parameter("center", unit, 0.3 * size))
    starts = tuple(np.array([width * size, 0.0]) for width in WIDTHS)

    def zone(y: Samples, _taken: Taken, theta: Theta) -> Samples:
        from_center = y - theta[1]
        return np.asarray(np.sign(from_center) * np.maximum(np.abs(from_center) - theta[0], 0.0) + theta[1])

    def jump(y: Samples, _taken: Taken, theta: Theta) -> Samples:
        from_center = y - theta[1]
        return np.asarray(from_center * _past(np.abs(from_center), theta[0], STEEP * size) + theta[1])

    yield Effect(
        "dead_band",
        "dead zone",
        Stage.BREAK,
        "y = x - width sign(x) where |x| > width, else 0 (about center)",
        numbers,
        zone,
        starts,
    )
    text = "y = x where |x| > width, else 0 (about center)"
    yield Effect("dead_band", "dead band", Stage.BREAK, text, numbers, jump, starts, jumps=True)


def _limits(real: Samples, size: float, unit: str) -> Iterator[Effect]:
    """Above, below, or both: a side that is never reached is no limit."""
    upper, lower = Parameter("upper", unit, size, null_value=np.inf), Parameter("lower", unit, size, null_value=-np.inf)
    high, low = ([np.quantile(real, out) for out in outs] for outs in ([1.0 - r for r in REACHED], REACHED))
    texts = "y = min(x, upper)", "y = max(x, lower)", "y = min(max(x, lower), upper)"

    def effect(key: str, text: str, numbers: tuple[Parameter, ...], starts: Iterable[Sequence[float]]) -> Effect:
        def clip(y: Samples, _taken: Taken, theta: Theta) -> Samples:
            least, most = (theta[-1] if key != "upper limit" else -np.inf), (theta[0] if key != "lower limit" else np.inf)
            return np.asarray(np.clip(y, least, most))

        return Effect("saturation", key, Stage.LIMIT, text, numbers, clip, tuple(np.array(start) for start in starts))

    yield effect("upper limit", texts[0], (upper,), ([x] for x in high))
    yield effect("lower limit", texts[1], (lower,), ([x] for x in low))
    yield effect("both limits", texts[2], (upper, lower), zip(high, low, strict=True))


def _past(x: Samples, edge: float, steep: float) -> Samples:
    """0 below an edge, 1 above it, a straight line across it."""
    return np.clip((x - edge) / steep + 0.5, 0.0, 1.0)


class _Sign:
    """+ level, with the sign of the signal or of its derivative."""

    def __init__(self, of_derivative: bool, steep: float) -> None:
        self.of_derivative, self.steep = of_derivative, steep

    def __call__(self, y: Samples, taken: Taken, theta: Theta) -> Samples:
        of = taken.dx if self.of_derivative else taken.x
        return np.asarray(y + theta[0] * np.clip(of / self.steep, -1.0, 1.0))


def _drifts(ideal: Ideal, size: float, unit: str) -> Iterator[Effect]:
    first, last = float(ideal.t_s[0]), float(ideal.t_s[-1])
    middle, length = 0.5 * (first + last), last - first
    yield Effect(
        "drift",
        "drift",
        Stage.ADDED,
        "y += rate t",
        (Parameter("rate", f"{unit}/s" if unit else "1/s", size / length),),
        lambda y, taken, theta: y + theta[0] * (taken.t_s - middle),
        (np.zeros(1),),
    )
    yield _curve("drift", "wandering drift", "t", "s", first, last, KNOTS, size, unit)


# ── what has no name ──


class Curve:
    """+ a cubic spline of one variable, held beyond its ends."""

    def __init__(self, variable: str, unit: str, first: float, last: float, knots: int) -> None:
        self.variable, self.unit, self.first, self.last, self.count = variable, unit, first, last, knots
        self.knots = np.concatenate([[first] * 3, np.linspace(first, last, knots - 2), [last] * 3])
        self._last: tuple[Column, Float64[np.ndarray, "_ q"]] | None = None

    def basis(self, at: Column) -> Float64[np.ndarray, "_ q"]:
        """What a curve is a sum of, at some values; those of the last values asked for are kept."""
        if self._last is None or not np.array_equal(self._last[0], at):
            inside = np.clip(at, self.first, self.last)
            splines = BSpline.design_matrix(inside, self.knots, 3).toarray()[:, : self.count]
            self._last = at, np.asarray(splines @ self.built)
        return self._last[1]

    @property
    def plausible(self) -> tuple[float, ...]:
        """Of level, slope and bends, over the size of the signal: bends are small, so that ends without data go straight on."""
        return (1.0, 2.0 / self.count, *(BEND for _ in range(self.count - 2)))

    @property
    def built(self) -> Float64[np.ndarray, "q q"]:
        """Coefficients of the splines from level, slope and bends (second differences), about the middle."""
        at = np.arange(self.count, dtype=np.float64) - 0.5 * (self.count - 1)
        bends = [np.maximum(at - at[j], 0.0) if at[j] >= 0 else np.maximum(at[j] - at, 0.0) for j in range(1, self.count - 1)]
        return np.stack([np.ones(self.count), at, *bends], axis=1)

    def of(self, taken: Taken) -> Samples:
        """The variable's values."""
        return {"x": taken.x, "dx/dt": taken.dx, "t": taken.t_s}[self.variable]

    def __call__(self, y: Samples, taken: Taken, theta: Theta) -> Samples:
        """The signal with the curve on it."""
        return np.asarray(y + self.basis(self.of(taken)) @ theta)


def _curve(
    name: str, key: str, variable: str, of: str, first: float, last: float, knots: int, size: float, unit: str
) -> Effect:
    curve = Curve(variable, of, first, last, knots)
    numbers = tuple(Parameter(f"c{j}", unit, share * size) for j, share in enumerate(curve.plausible))
    text = f"y += curve({variable})"
    return Effect(name, key, Stage.ADDED, text, numbers, curve, (np.zeros(knots),), wanders=variable == "t")


def unknown(ideal: Ideal, unit: str) -> Iterator[Effect]:
    """A smooth curve of the simulated signal, of its derivative, of time."""
    taken = ideal.taken(())
    size = float(taken.x.std())
    variables = (("x", unit, taken.x, KNOTS), ("dx/dt", f"{unit}/s", taken.dx, KNOTS), ("t", "s", taken.t_s, KNOTS_OF_TIME))
    for variable, of, values, knots in variables:
        first, last = float(values.min()), float(values.max())
        if last > first:
            yield _curve("unknown", f"curve of {variable}", variable, of, first, last, knots, size, unit)


class _Driven:
    """+ gain times a channel, some time earlier."""

    def __init__(self, channel: str, mean: float) -> None:
        self.channel, self.mean = channel, mean

    def __call__(self, y: Samples, taken: Taken, theta: Theta) -> Samples:
        t_s, values = taken.channels[self.channel]
        return np.asarray(y + theta[0] * (np.interp(taken.t_s - theta[1], t_s, values) - self.mean))


def driven(ideal: Ideal, real: Samples, unit: str) -> Iterator[Effect]:
    """By each other channel, but for those that say what the signal itself says."""
    size = float(ideal.taken(()).x.std())
    for name, (t_s, values) in sorted(ideal.channels.items()):
        there = np.interp(ideal.t_s, t_s, values)
        spread = float(there.std())
        if not spread > 1e-12 * max(1.0, float(np.abs(there).max())) or abs(float(np.corrcoef(there, real)[0, 1])) > SAME:
            continue
        numbers = (Parameter("gain", f"{unit or '1'} per unit of {name}", size / spread), Parameter("lag", "s", 0.2))
        yield Effect(
            "driven",
            f"driven by {name}",
            Stage.ADDED,
            f"y += gain ({name}(t - lag) - mean)",
            numbers,
            _Driven(name, float(there.mean())),
            tuple(np.array([0.0, lag]) for lag in LAGS_S),
            driver=name,
        )


def differ(one: Effect, others: Sequence[Effect]) -> bool:
    """Whether an effect may act beside others: none of its variants does, and no channel drives twice."""
    return all(one.key != other.key and (one.name != other.name or one.name in ("driven", "unknown")) for other in others)
