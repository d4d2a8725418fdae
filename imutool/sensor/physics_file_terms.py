"""Effects without a name: constant bias, driven gain, curve, product and noise."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from imutool.array_types import Float64, Vectors
from imutool.errors import DataError
from imutool.noise import datasheet
from imutool.recording import interpolate
from imutool.sensor.effect import Acting, Effect, Parameter, Stage, Theta
from imutool.sensor.effects.temperature import NO_CHANNEL
from imutool.sensor.samples import SensorSamples
from imutool.units import AXES, UNITS, Sensor

DRIVEN = "driven"
# Within the stage SENSOR effects act by name. What has no name was learned from the ideal signals and comes first, upper case
# sorting before lower; a bias, noise and what depends on time alone come last, so that no scale acts on them.
UNKNOWN, BIAS, NOISE = "Unknown", "~bias", "~noise"

Variable = Callable[[SensorSamples], Float64[np.ndarray, " n"]]


def _column(name: str, axis: int) -> Variable:
    def column(samples: SensorSamples) -> Float64[np.ndarray, " n"]:
        values: Vectors = getattr(samples, name)
        return values[:, axis]

    return column


# What an effect without a name can be a function of, as physics.toml and reports write it.
VARIABLES: dict[str, Variable] = {
    **{f"omega_{axis}": _column("gyro", k) for k, axis in enumerate(AXES)},
    **{f"f_{axis}": _column("accel", k) for k, axis in enumerate(AXES)},
    **{f"alpha_{axis}": _column("alpha", k) for k, axis in enumerate(AXES)},
    "|omega|": lambda samples: np.asarray(np.linalg.norm(samples.gyro, axis=1)),
    "|f|": lambda samples: np.asarray(np.linalg.norm(samples.accel, axis=1)),
    "t": lambda samples: samples.stamp_s,
}


def factors(text: str) -> list[str]:
    """Factors of a product: two in `omega_x|omega_x|`, and two in `omega_x omega_y`."""
    return re.findall(r"\|[^|]*\||sign\([^()]*\)|[^\s|]+", text)


def factor(word: str) -> Variable | None:
    """Factor as a function of the samples: a variable, its size, sign or power; else None."""
    for pattern, change in CHANGES:
        found = re.fullmatch(pattern, word)
        if found and found[1] in VARIABLES:
            return _Factor(VARIABLES[found[1]], change, float(found[2]) if found.lastindex == 2 else 1.0)
    return None


@dataclass(frozen=True)
class _Factor:
    """Sign, size or a power of a variable."""

    variable: Variable
    change: Callable[[Any], Any]
    power: float

    def __call__(self, samples: SensorSamples) -> Float64[np.ndarray, " n"]:
        return np.asarray(self.change(self.variable(samples)) ** self.power)


def _unchanged(x: Any) -> Any:
    return x


CHANGES: tuple[tuple[str, Callable[[Any], Any]], ...] = (
    (r"(.+)", _unchanged),
    (r"\|(.+)\|", np.abs),
    (r"sign\((.+)\)", np.sign),
    (r"(.+)\^([1-9])", _unchanged),
)


def product_of(text: str) -> Variable | None:
    """Product of factors as a function of the samples; None if a factor is not known."""
    parsed = [factor(word) for word in factors(text)]
    functions = [function for function in parsed if function is not None]
    if not parsed or len(functions) < len(parsed):
        return None
    return lambda samples: np.asarray(np.prod([function(samples) for function in functions], axis=0))


def constant_bias(gyro: Sequence[float], accel: Sequence[float]) -> Effect:
    """Effect of a constant bias (rad/s, m/s²)."""

    def forward(samples: SensorSamples, _: Theta) -> SensorSamples:
        return samples.with_readings(samples.gyro + np.array(gyro), samples.accel + np.array(accel))

    return Effect(BIAS, Stage.SENSOR, ("gyro", "accel"), "+ b", (), "always", forward)


def driven(signal: Sensor, channel: str) -> Effect:
    """Effect of a channel c of the log: + gain (c(t - lag) - mean of c), by axis of a signal."""

    def forward(samples: SensorSamples, theta: Theta) -> SensorSamples:
        c = _channel(samples, channel)
        delayed = np.interp(samples.stamp_s - theta[3], samples.stamp_s, c)
        return samples.with_added(signal, np.outer(theta[:3], delayed - c.mean()).T)

    gains = (Parameter(axis, f"{UNITS[signal]} per unit of {channel}", 1.0) for axis in AXES)
    parameters = (*gains, Parameter("lag", "s", 0.2))
    return Effect(DRIVEN, Stage.SENSOR, (signal,), f"{signal} += gain (c(t - lag) - mean)", parameters, "c varies", forward)


def curve(label: str, signal: Sensor, variable: str, x: Float64[np.ndarray, " k"], y: Float64[np.ndarray, "k 3"]) -> Effect:
    """Effect of a piecewise linear curve of a variable or channel, by axis of a signal."""
    of = VARIABLES.get(variable)

    def forward(samples: SensorSamples, _: Theta) -> SensorSamples:
        at = _channel(samples, variable) if of is None else of(samples)
        return samples.with_added(signal, interpolate(at, x, y))

    needs = () if of is not None else (variable,)
    equation = f"{signal} += curve({variable})"
    return Effect(f"{UNKNOWN}[{label}]", Stage.SENSOR, (signal,), equation, (), "it varies", forward, needs=needs)


def product(label: str, signal: Sensor, text: str, value: Sequence[float]) -> Effect | None:
    """Effect of a product of factors, so many times on each axis; None if a factor is not known."""
    function = product_of(text)
    if function is None:
        return None

    def forward(samples: SensorSamples, _: Theta) -> SensorSamples:
        return samples.with_added(signal, np.outer(value, function(samples)).T)

    return Effect(f"{UNKNOWN}[{label}]", Stage.SENSOR, (signal,), f"{signal} += c {text}", (), "it varies", forward)


def _channel(samples: SensorSamples, name: str) -> Float64[np.ndarray, " n"]:
    """A channel of the log."""
    if name not in samples.channels:
        listed = ", ".join(sorted(samples.channels)) or "(none)"
        expected = f"one of the log's channels: {listed}"
        raise DataError(f"no channel {name}", where="physics", expected=expected, fix=NO_CHANNEL)
    return samples.channels[name]


class SimulatedSensor(NamedTuple):
    """Sensor to simulate: effects, the stamp from which they count time, noise, rate and seed."""

    acting: Acting
    start_ns: int | None
    noise: datasheet.Noise
    rate_hz: float | None  # by default that of the log
    seed: int


def additive_noise(noise: datasheet.Noise, rate_hz: float, seed: int) -> Effect:
    """White noise and a walking bias, each from its own stream; unknown densities are zero."""
    densities = {name: np.nan_to_num(noise.values(name)) for name in datasheet.UNITS}
    colour = noise.colour if noise.colour is not None and noise.colour.holds_at(rate_hz) else None

    def forward(samples: SensorSamples, _: Theta) -> SensorSamples:
        dt = np.diff(samples.stamp_s, prepend=samples.stamp_s[0])[:, None]  # a walk goes on in a hole
        out, coloured = [], None
        if colour is not None:
            readings = np.concatenate([samples.gyro, samples.accel], axis=1)
            coloured = colour.drawn(samples.stamp_s, readings, np.random.default_rng([seed, 2]))
        for k, (name, values) in enumerate((("gyro", samples.gyro), ("accel", samples.accel))):
            white, walk = (np.random.default_rng([seed, k, kind]).normal(size=values.shape) for kind in (0, 1))
            bias = np.cumsum(densities[f"{name}_walk"] * np.sqrt(np.abs(dt)) * walk, axis=0)
            noise = white if coloured is None else coloured[:, 3 * k : 3 * k + 3]
            out.append(values + densities[f"{name}_density"] * np.sqrt(rate_hz) * noise + bias)
        return samples.with_readings(*out)

    return Effect(NOISE, Stage.SENSOR, ("gyro", "accel"), "+ n + b(t)", (), "always", forward)
