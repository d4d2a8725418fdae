"""physics.toml: which effects act on a sensor and how large they are, as `diagnose` finds them and `simulate` takes them.

::

    [[effect]]
    name = "lever_arm"                 # of the catalogue, or "driven"
    signal = "accel"                   # where it was seen; it acts wherever it acts
    [effect.parameters.x]
    value = 0.213
    std = 0.004                        # may be left out
    unit = "m"

    [bias]                             # rad/s and m/s², a constant
    gyro = [0.0, 0.0, 0.0]
    accel = [0.0, 0.0, 0.0]

    [[unknown]]                        # no name: a curve of one variable, straight between points, held beyond its ends
    signal = "accel"
    variable = "omega_x"               # omega_x .. f_x .. alpha_x .., |omega|, |f|, t (s), or a channel of the log
    unit = "rad/s"
    x = [-1.0, 0.0, 1.0]
    y = [[0.1, 0.0, 0.0], [0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]
    band = [[0.01, 0.01, 0.01], [0.01, 0.01, 0.01], [0.01, 0.01, 0.01]]

    [[term]]                           # no name: a term of an equation, by axis
    signal = "accel"
    term = "omega_x omega_y"
    value = [0.02, 0.0, 0.0]
    std = [0.001, 0.001, 0.001]

A parameter that is left out does nothing. `driven` has parameters x, y, z (the gain on each axis) and lag (s): the signal gains
gain (c(t - lag) - mean of c), c the channel named by `driver`.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from jaxtyping import Float64
from msgspec import Meta

from imutool.config import Settings, build, toml
from imutool.errors import ConfigError, DataError, ImutoolError
from imutool.mcap_io.storage.target import Target
from imutool.sensor import catalogue
from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.samples import SensorSamples
from imutool.sensor.variables import VARIABLES, factor, words
from imutool.units import AXES, UNITS, Sensor

SCHEMA = "imutool.physics/1"
DRIVEN = "driven"
# Within the stage SENSOR effects act by name. What has no name was learned from the ideal signals and comes first, upper case
# sorting before lower; a bias comes last, so that no scale acts on it.
UNKNOWN, BIAS = "Unknown", "~bias"

Three = tuple[float, float, float]
NotNegative = Annotated[float, Meta(ge=0.0)]
ThreeStd = tuple[NotNegative, NotNegative, NotNegative]
Known = Callable[[Sequence[str]], tuple[Effect, ...]]


class Value(Settings, frozen=True, kw_only=True):
    """A parameter, its standard deviation where that is known, and its unit."""

    value: float
    std: NotNegative | None = None
    unit: str


class Entry(Settings, frozen=True, kw_only=True):
    """An effect by name; `signal` says where it was seen, `driver` the channel that drives what is `driven`."""

    name: str
    signal: Literal["gyro", "accel", "both", ""] = ""
    driver: str = ""
    equation: str = ""
    parameters: dict[str, Value]


class Bias(Settings, frozen=True, kw_only=True):
    """A constant: rad/s, m/s²."""

    gyro: Three = (0.0, 0.0, 0.0)
    accel: Three = (0.0, 0.0, 0.0)


class Curve(Settings, frozen=True, kw_only=True):
    """What is added to the axes of a signal as a curve of one variable; `band` is one standard deviation."""

    signal: Sensor
    variable: str
    unit: str
    x: tuple[float, ...]
    y: tuple[Three, ...]
    band: tuple[ThreeStd, ...] = ()


class Term(Settings, frozen=True, kw_only=True):
    """What is added to the axes of a signal as so many times a product of signals."""

    signal: Sensor
    term: str
    value: Three
    std: ThreeStd | None = None


class PhysicsFile(Settings, frozen=True, kw_only=True):
    """Everything that a physics.toml says."""

    schema: Literal["imutool.physics/1"] = "imutool.physics/1"
    effect: tuple[Entry, ...] = ()
    bias: Bias | None = None
    unknown: tuple[Curve, ...] = ()
    term: tuple[Term, ...] = ()

    def acting(self, where: str | Path = "physics", known: Known = catalogue.effects) -> list[tuple[Effect, Theta]]:
        """The effects as they act, each with its parameters; `known` finds them by name.

        Raises:
            ConfigError: an unknown effect, parameter, unit, signal, variable or term (the nearest is named), or a wrong value.
        """
        found: list[tuple[Effect, Theta]] = []
        for k, entry in enumerate(self.effect):
            place = f"effect[{k}]"
            physics = _driven(entry, where, place) if entry.name == DRIVEN else _named(entry.name, known, where, place)
            found.append((physics, _theta(entry, physics, where, place)))
        for k, curve in enumerate(self.unknown):
            found.append((_curve(curve, k, where), np.zeros(0)))
        for k, term in enumerate(self.term):
            found.append((_term(term, k, where), np.zeros(0)))
        if self.bias is not None:
            found.append((_constant(self.bias), np.zeros(0)))
        return found


def read(path: Path) -> PhysicsFile:
    """What a physics.toml says, checked but for the names, which `acting` looks up.

    Raises:
        ConfigError: no such file, no TOML, an unknown or missing key, a wrong type, a number that is not finite.
    """
    values = toml(path, "physics")
    _refuse_infinite(values, path)
    file = build(PhysicsFile, values, where=path)
    for k, curve in enumerate(file.unknown):
        x = np.array(curve.x)
        if len(x) < 2 or not (np.diff(x) > 0.0).all():
            raise ConfigError(f"unknown[{k}].x does not rise", where=path, expected="two and more values, each above the last")
        for key, rows in (("y", curve.y), ("band", curve.band)):
            if len(rows) != len(x) and (rows or key == "y"):
                raise ConfigError(
                    f"unknown[{k}].{key} has {len(rows)} rows", where=path, expected=f"{len(x)}, one for each of x"
                )
    return file


def write(file: PhysicsFile, path: Path, *, overwrite: bool = False) -> None:
    """Writes a physics.toml, which `read` gives back bit for bit.

    Raises:
        ConfigError: the file exists (without `overwrite`), or cannot be written.
    """
    with Target(path, overwrite=overwrite) as target:
        target.write(to_toml(file).encode())


def to_toml(file: PhysicsFile) -> str:
    """The text of the file."""
    lines = ["# Physics of an IMU, as `imutool simulate --physics FILE` takes it", f"schema = {_text(file.schema)}"]
    for entry in file.effect:
        lines += ["", "[[effect]]", f"name = {_text(entry.name)}"]
        lines += [f"{key} = {_text(text)}" for key in ("signal", "driver", "equation") if (text := getattr(entry, key))]
        if not entry.parameters:
            lines.append("parameters = {}")
        for name, value in entry.parameters.items():
            lines += [f"[effect.parameters.{_key(name)}]", f"value = {value.value!r}"]
            lines += [] if value.std is None else [f"std = {value.std!r}"]
            lines.append(f"unit = {_text(value.unit)}")
    if file.bias is not None:
        lines += ["", "[bias]", f"gyro = {_row(file.bias.gyro)}", f"accel = {_row(file.bias.accel)}"]
    for curve in file.unknown:
        lines += ["", "[[unknown]]", *(f"{key} = {_text(getattr(curve, key))}" for key in ("signal", "variable", "unit"))]
        lines.append(f"x = {_row(curve.x)}")
        lines += [
            f"{key} = [{', '.join(map(_row, rows))}]" for key in ("y", "band") if (rows := getattr(curve, key)) or key == "y"
        ]
    for term in file.term:
        lines += ["", "[[term]]", f"signal = {_text(term.signal)}", f"term = {_text(term.term)}", f"value = {_row(term.value)}"]
        lines += [] if term.std is None else [f"std = {_row(term.std)}"]
    return "\n".join([*lines, ""])


def _text(text: str) -> str:
    """A string of TOML, which escapes as JSON does but for one control character."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _key(text: str) -> str:
    return text if re.fullmatch(r"[A-Za-z0-9_-]+", text) else _text(text)


def _row(values: Sequence[float]) -> str:
    return f"[{', '.join(repr(float(value)) for value in values)}]"


def _refuse_infinite(value: Any, where: Path, place: str = "") -> None:
    """As `config.build`, with the place in a list."""
    if isinstance(value, float) and not np.isfinite(value):
        raise ConfigError(f"{place} is {value}", where=where, expected="a finite number")
    if isinstance(value, dict):
        for key, inner in value.items():
            _refuse_infinite(inner, where, f"{place}.{key}" if place else key)
    elif isinstance(value, list):
        for k, inner in enumerate(value):
            _refuse_infinite(inner, where, f"{place}[{k}]")


# ── effects by name ──


def _named(name: str, known: Known, where: str | Path, place: str) -> Effect:
    try:
        (physics,) = known([name])
    except ImutoolError as error:
        raise ConfigError(f"{place}.name: {error.what}", where=where, expected=error.expected, fix=error.fix) from error
    return physics


def _theta(entry: Entry, physics: Effect, where: str | Path, place: str) -> Theta:
    """The parameters in the effect's own order."""
    if entry.signal not in ("", "both", *physics.sensors):
        listed = " or ".join(physics.sensors)
        raise ConfigError(f"{place}.signal is {entry.signal}: {entry.name} does not act there", where=where, expected=listed)
    numbers = {number.name: number for number in physics.parameters}
    theta = physics.null_value.astype(np.float64)
    for name, value in entry.parameters.items():
        key = f"{place}.parameters.{name}"
        if name not in numbers:
            raise _unknown(key, name, list(numbers), where)
        number = numbers[name]
        if value.unit != number.unit and entry.name != DRIVEN:
            raise ConfigError(f"{key}.unit is {value.unit!r}", where=where, expected=repr(number.unit))
        if number.positive and not value.value > 0.0:
            raise ConfigError(f"{key}.value is {value.value:g}", where=where, expected="more than 0")
        theta[list(numbers).index(name)] = value.value
    if not entry.parameters:
        raise ConfigError(f"{place}.parameters is empty", where=where, expected=f"some of {', '.join(numbers)}")
    return theta


def _unknown(key: str, name: str, names: Sequence[str], where: str | Path) -> ConfigError:
    near = difflib.get_close_matches(name, names, n=1)
    fix = f"Did you mean {near[0]}?" if near else ""
    return ConfigError(f"{key}: {name!r} is not known", where=where, expected=f"one of {', '.join(names)}", fix=fix)


# ── effects without one ──


def _constant(bias: Bias) -> Effect:
    gyro, accel = np.array(bias.gyro), np.array(bias.accel)

    def forward(read: SensorSamples, _: Theta) -> SensorSamples:
        return read.but(read.gyro + gyro, read.accel + accel)

    return Effect(BIAS, Stage.SENSOR, ("gyro", "accel"), "+ b", (), "always", forward)


def _driven(entry: Entry, where: str | Path, place: str) -> Effect:
    """+ gain (c(t - lag) - mean of c) on the axes of one signal."""
    if entry.signal not in UNITS:
        raise ConfigError(f"{place}.signal is {entry.signal!r}", where=where, expected="gyro or accel for what is driven")
    if not entry.driver:
        raise ConfigError(f"{place}.driver is missing", where=where, expected="the channel that drives it, as TOPIC or TOPIC.x")
    signal: Sensor = "gyro" if entry.signal == "gyro" else "accel"
    channel = entry.driver

    def forward(read: SensorSamples, theta: Theta) -> SensorSamples:
        c = _channel(read, channel)
        return _added(read, signal, np.outer(np.interp(read.stamp_s - theta[3], read.stamp_s, c) - c.mean(), theta[:3]))

    numbers = (*(Parameter(axis, f"{UNITS[signal]} per unit of {channel}", 1.0) for axis in AXES), Parameter("lag", "s", 0.2))
    return Effect(DRIVEN, Stage.SENSOR, (signal,), f"{signal} += gain (c(t - lag) - mean)", numbers, "c varies", forward)


def _curve(curve: Curve, k: int, where: str | Path) -> Effect:
    x, y, variable = np.array(curve.x), np.array(curve.y), curve.variable
    if not variable.startswith("/") and variable not in VARIABLES:
        raise _unknown(f"unknown[{k}].variable", variable, [*VARIABLES, "/TOPIC"], where)

    def forward(read: SensorSamples, _: Theta) -> SensorSamples:
        at = VARIABLES[variable](read) if variable in VARIABLES else _channel(read, variable)
        return _added(read, curve.signal, np.stack([np.interp(at, x, column) for column in y.T], axis=1))

    equation = f"{curve.signal} += curve({variable})"
    needs = () if variable in VARIABLES else (variable,)
    return Effect(f"{UNKNOWN}[{k}]", Stage.SENSOR, (curve.signal,), equation, (), "it varies", forward, needs=needs)


def _term(term: Term, k: int, where: str | Path) -> Effect:
    """Factors are variables, |variable|, variable^n or sign(variable), with a space or a bar between them."""
    factors = [factor(word) for word in words(term.term)]
    if not factors or None in factors:
        raise _unknown(f"term[{k}].term", term.term, [f"products of {', '.join(VARIABLES)}"], where)

    def forward(read: SensorSamples, _: Theta) -> SensorSamples:
        size = np.prod([one(read) for one in factors if one is not None], axis=0)
        return _added(read, term.signal, np.outer(size, term.value))

    return Effect(
        f"{UNKNOWN}[term {k}]", Stage.SENSOR, (term.signal,), f"{term.signal} += c {term.term}", (), "it varies", forward
    )


def _channel(read: SensorSamples, name: str) -> Float64[np.ndarray, " n"]:
    """A channel of the log.

    Raises:
        DataError: there is none of that name.
    """
    if name not in read.channels:
        listed = ", ".join(sorted(read.channels)) or "(none)"
        raise DataError(f"no channel {name}", where="physics", expected=f"one of the log's channels: {listed}")
    return read.channels[name]


def _added(read: SensorSamples, signal: str, more: Float64[np.ndarray, "n 3"]) -> SensorSamples:
    return read.but(gyro=read.gyro + more) if signal == "gyro" else read.but(accel=read.accel + more)


def plain(file: PhysicsFile) -> dict[str, Any]:
    """The file as plain JSON values."""
    values: dict[str, Any] = msgspec.to_builtins(file)
    return values
