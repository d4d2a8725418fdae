"""Effects of any scalar signal between a simulated number and its recording.

In the order in which they act: low_pass, delay, gain, dead_band, then what is added (offset, drift, friction, a driving
channel, an unnamed curve), saturation; quantization is seen in the values alone. Dead zone, Coulomb friction and first-order
lag are those of control textbooks (e.g. Slotine and Li, Applied Nonlinear Control, chapter 5).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from imutool.array_types import Float64
from imutool.diagnosis.estimation.jacobians import SplineCurve
from imutool.diagnosis.estimation.unnamed_effects import LAGS_S
from imutool.diagnosis.signals.aligned_signal import AlignedSignal
from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.effects.low_pass import Design, smoothed
from imutool.sensor.robot_effects.signal_samples import IdealSignal, Samples, SignalSamples
from imutool.sensor.robot_effects.signal_sizes import Scale, late
from imutool.units import AXES

CUTOFFS = (100.0, 30.0, 10.0, 3.0, 1.0, 0.3)  # to start from, over the signal's own mean frequency
WIDTHS = (0.05, 0.15, 0.4, 0.8)  # of a dead band, over the signal's standard deviation
REACHED = (0.001, 0.02, 0.1)  # of the samples beyond a limit to start from
STEEP = 0.002  # of the signal's size, over which a jump is smeared
MOVED = 0.005  # of the signal's size, by which derivatives move it: more than a jump's width, or they see none or all of it
LOG_MOVED = 0.02  # of the logarithm of a positive parameter, likewise
MIN_LAG_S = 0.02  # at first sight, which is two samples of the clock on which it is seen
VECTORS = {"magnetic"}  # kinds whose columns are a vector: what drives it has a field of its own
KNOTS, KNOTS_OF_TIME = 7, 15
BEND = 0.3  # of the signal's size: a second difference between a curve's knots


# ── the effects ──


def offset(signal: AlignedSignal, k: int) -> Effect:
    """A constant of one column: part of every fit."""
    numbers = (Parameter("offset", signal.units[k], 10.0 * float(np.ptp(signal.real[:, k]))),)
    starts, effect = [np.zeros(1)], signal.scale.effect
    return effect("offset", (k,), "y += offset", numbers, lambda s, theta: s.with_added(k, theta[0]), starts=starts)


def delay(signal: AlignedSignal, name: str, std_s: float, lag_s: float = 0.0) -> Effect:
    """A delay, positive where the recording comes late; at first sight it is `lag_s`."""
    starts = [np.zeros(1)] if abs(lag_s) < 1e-9 else [np.zeros(1), np.array([lag_s])]
    numbers = (Parameter("delay", "s", std_s, step=delay_step_s(signal)),)
    text, columns = "y(t) = x(t - delay)", signal.scale.columns
    return signal.scale.effect(name, columns, text, numbers, late, stage=Stage.CLOCK, starts=starts)


def delay_step_s(signal: AlignedSignal) -> float:
    """A delay that moves the signal by `MOVED` of its size."""
    return MOVED * float(np.min(signal.sampled.x.std(axis=0) / signal.sampled.dx.std(axis=0)))


def named(signal: AlignedSignal) -> Iterator[Effect]:
    """The catalogue of effects that any signal can have."""
    scale, unit, size, slope = signal.scale, signal.units[0], float(signal.sampled.x.std()), float(signal.sampled.dx.std())
    yield delay(signal, "delay", max(0.2, abs(signal.lag_s)), signal.lag_s)
    cutoff = (Parameter("f_c", "Hz", 10.0, positive=True, null_value=np.inf, step=LOG_MOVED),)
    rates = (*np.multiply(CUTOFFS, slope / size), *_of_lag(signal.lag_s))
    starts, text = [np.array([rate / (2.0 * np.pi)]) for rate in rates], "dy/dt = 2 pi f_c (x - y)"
    yield scale.effect("low_pass", (0,), text, cutoff, _low_pass, stage=Stage.BANDWIDTH, starts=starts, lagless=_lagless)
    gain = (Parameter("gain", "-", 0.5, null_value=1.0),)
    yield scale.effect("gain", (0,), "y = gain x", gain, lambda s, theta: s.but(theta[0] * s.y), starts=[np.ones(1)])
    yield from _dead_bands(scale, size)
    yield from _drifts(signal, size, unit)
    for variable, of, steep in (("x", "x", STEEP * size), ("dx", "dx/dt", STEEP * slope)):
        level, text = (Parameter("level", unit, size),), f"y += level sign({of})"
        yield scale.effect("friction", (0,), text, level, _Sign(variable, steep), variant=f"of {variable}")
    yield from _limits(scale, signal.real[:, 0], size)


def _of_lag(lag_s: float) -> list[float]:
    """Cut-off (rad/s) of a first-order lag that delays what is slow so much."""
    return [1.0 / lag_s] if lag_s > MIN_LAG_S else []


def _low_pass(ideal: IdealSignal, theta: Theta) -> IdealSignal:
    """First-order lag, exact for straight lines between fine samples; it starts settled."""
    a = 2.0 * np.pi * min(float(theta[0]), 1e3 * ideal.rate_hz) / ideal.rate_hz  # rad a sample
    e = np.exp(-a)
    b = [1.0 - (1.0 - e) / a, (1.0 - e) / a - e]
    first = ideal.fine[0]
    return replace(ideal, fine=np.asarray(lfilter(b, [1.0, -e], ideal.fine - first, axis=0) + first))


def _lagless(ideal: IdealSignal, theta: Theta) -> IdealSignal:
    return replace(ideal, fine=smoothed(ideal.fine, ideal.rate_hz, Design(float(theta[0]))))


def _dead_bands(scale: Scale, size: float) -> Iterator[Effect]:
    width = Parameter("width", scale.units[0], size, positive=True, step=LOG_MOVED)
    numbers = (width, Parameter("center", scale.units[0], 0.3 * size, step=MOVED * size))
    starts = [np.array([width * size, 0.0]) for width in WIDTHS]

    def zone(s: SignalSamples, theta: Theta) -> SignalSamples:
        from_center = s.y - theta[1]
        return s.but(np.sign(from_center) * np.maximum(np.abs(from_center) - theta[0], 0.0) + theta[1])

    def jump(s: SignalSamples, theta: Theta) -> SignalSamples:
        from_center = s.y - theta[1]
        past = np.clip((np.abs(from_center) - theta[0]) / (STEEP * size) + 0.5, 0.0, 1.0)  # a steep line across the edge
        return s.but(from_center * past + theta[1])

    text = "y = x - width sign(x) where |x| > width, else 0 (about center)"
    yield scale.effect("dead_band", (0,), text, numbers, zone, starts=starts, variant="zone")
    text = "y = x where |x| > width, else 0 (about center)"
    yield scale.effect("dead_band", (0,), text, numbers, jump, starts=starts, variant="jump", jumps=True)


def _limits(scale: Scale, real: Samples, size: float) -> Iterator[Effect]:
    """Limits above, below, or both: a side that is never reached is no limit."""
    upper = Parameter("upper", scale.units[0], size, null_value=np.inf, step=MOVED * size)
    lower = Parameter("lower", scale.units[0], size, null_value=-np.inf, step=MOVED * size)
    high, low = ([float(np.quantile(real, out)) for out in outs] for outs in ([1.0 - r for r in REACHED], REACHED))

    def effect(variant: str, text: str, numbers: tuple[Parameter, ...], starts: list[Theta]) -> Effect:
        def clip(s: SignalSamples, theta: Theta) -> SignalSamples:
            minimum, maximum = theta[-1] if lower in numbers else -np.inf, theta[0] if upper in numbers else np.inf
            return s.but(np.clip(s.y, minimum, maximum))

        return scale.effect("saturation", (0,), text, numbers, clip, stage=Stage.CONVERTER, starts=starts, variant=variant)

    yield effect("upper", "y = min(x, upper)", (upper,), [np.array([x]) for x in high])
    yield effect("lower", "y = max(x, lower)", (lower,), [np.array([x]) for x in low])
    both = [np.array(pair) for pair in zip(high, low, strict=True)]
    yield effect("both", "y = min(max(x, lower), upper)", (upper, lower), both)


class _Sign:
    """+ level, with the sign of the ideal signal or of its derivative."""

    def __init__(self, variable: str, steep: float) -> None:
        self.variable, self.steep = variable, steep

    def __call__(self, s: SignalSamples, theta: Theta) -> SignalSamples:
        of = s.dx if self.variable == "dx" else s.x
        return s.but(s.y + theta[0] * np.clip(of / self.steep, -1.0, 1.0))


def _drifts(signal: AlignedSignal, size: float, unit: str) -> Iterator[Effect]:
    first, last = float(signal.stamp_s[0]), float(signal.stamp_s[-1])
    middle, length = 0.5 * (first + last), last - first
    rate = (Parameter("rate", f"{unit}/s" if unit else "1/s", size / length),)
    effect = signal.scale.effect
    yield effect("drift", (0,), "y += rate t", rate, lambda s, theta: s.with_added(0, theta[0] * (s.stamp_s - middle)))
    curve = _curve(signal, 0, "t", "s", KNOTS)
    yield replace(curve, name="drift", kind="catalogue", linear=False, starts=lambda ideal, real: [np.zeros(KNOTS)])


# ── unnamed effects ──


class SignalCurve(SplineCurve):
    """Spline curve of one variable, by level, slope and bends about the middle.

    Bends are small, so that ends without data go straight on.
    """

    def __init__(self, variable: str, unit: str, inner: Float64[np.ndarray, " p"], column: int = 0) -> None:
        super().__init__(variable, unit, inner)
        self.column = column
        self.count = len(inner) + 2

    @property
    def plausible(self) -> tuple[float, ...]:
        """Plausible sizes of level, slope and bends, over the size of the signal."""
        return (1.0, 2.0 / self.count, *(BEND for _ in range(self.count - 2)))

    def _combined(self, splines: Float64[np.ndarray, "n q"]) -> Float64[np.ndarray, "n q"]:
        at = np.arange(self.count, dtype=np.float64) - 0.5 * (self.count - 1)
        bends = [np.maximum(at - at[j], 0.0) if at[j] >= 0 else np.maximum(at[j] - at, 0.0) for j in range(1, self.count - 1)]
        return np.asarray(splines @ np.stack([np.ones(self.count), at, *bends], axis=1))

    def __call__(self, samples: SignalSamples, theta: Theta) -> SignalSamples:
        """The signal with the curve on it."""
        of = variables_of(samples, self.column)[self.variable]
        return samples.with_added(self.column, self.basis(of) @ theta)


def variables_of(samples: SignalSamples, k: int) -> dict[str, Samples]:
    """What a column may be a function of: its ideal value and rate, time, and the state."""
    return {"x": samples.x[:, k], "dx/dt": samples.dx[:, k], "t": samples.stamp_s, **samples.state}


def _curve(signal: AlignedSignal, k: int, variable: str, unit: str, knots: int) -> Effect:
    values, size = variables_of(signal.sampled, k)[variable], float(signal.sampled.x[:, k].std())
    curve, text = SignalCurve(variable, unit, np.linspace(values.min(), values.max(), knots - 2), k), f"curve({variable})"
    numbers = tuple(Parameter(f"c{j}", signal.units[k], share * size) for j, share in enumerate(curve.plausible))
    effect = signal.scale.effect
    return effect("unknown", (k,), f"y += {text}", numbers, curve, kind="unknown", variable=variable, variant=text)


def unknown(signal: AlignedSignal, k: int) -> Iterator[Effect]:
    """Smooth curves of signal, derivative, time and state, in one column."""
    units = {"x": signal.units[k], "dx/dt": f"{signal.units[k]}/s", "t": "s"}
    for variable, values in variables_of(signal.sampled, k).items():
        if np.ptp(values) > 0 and not variable.startswith(("R", "v")):
            yield _curve(signal, k, variable, units.get(variable, ""), KNOTS_OF_TIME if variable == "t" else KNOTS)


class _Driven:
    """+ gain times a channel, some time earlier, in each of some columns."""

    def __init__(self, channel: str, mean: float, columns: range) -> None:
        self.channel, self.mean, self.columns = channel, mean, columns

    def __call__(self, s: SignalSamples, theta: Theta) -> SignalSamples:
        t_s, values = s.channels[self.channel]
        moved = np.interp(s.stamp_s - theta[-1], t_s, values) - self.mean
        for k, gain in zip(self.columns, theta[:-1].tolist(), strict=True):
            s = s.with_added(k, gain * moved)
        return s


def driven(signal: AlignedSignal) -> Iterator[Effect]:
    """Effects of each other channel that is no copy, on one column or on a vector as a whole."""
    parts = [range(signal.columns)] if signal.kind in VECTORS else [range(k, k + 1) for k in range(signal.columns)]
    for name, (t_s, values) in sorted(signal.ideal.channels.items()):
        channel = np.interp(signal.stamp_s, t_s, values)
        spread = float(channel.std())
        if name in signal.names or not spread > 1e-12 * max(1.0, float(np.abs(channel).max())):
            continue
        if any(abs(float(np.corrcoef(channel, own)[0, 1])) > signal.settings.signal.copy_correlation for own in signal.real.T):
            continue
        yield from (_driven(signal, part, name, float(channel.mean()), spread) for part in parts)


def _driven(signal: AlignedSignal, part: range, name: str, mean: float, spread: float) -> Effect:
    """Effect of one channel on some columns, which follow it at one time."""
    unit = signal.units[part[0]] or "1"
    gain = Parameter("gain", f"{unit} per unit of {name}", float(signal.sampled.x[:, part].std(axis=0).max()) / spread)
    gains = tuple(replace(gain, name=axis) for axis in AXES) if len(part) > 1 else (gain,)
    numbers, text = (*gains, Parameter("lag", "s", 0.2)), f"y += gain ({name}(t - lag) - mean)"
    starts = [np.array([*(0.0 for _ in gains), lag]) for lag in LAGS_S]
    forward = _Driven(name, mean, part)
    return signal.scale.effect(
        "driven", part, text, numbers, forward, starts=starts, kind="driven", variable=name, variant=name
    )
