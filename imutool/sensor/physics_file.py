"""physics.toml: effects on a sensor and their sizes, from `diagnose` to `simulate`.

::

    start_ns = 1403715524907143168     # may be left out: stamp of the recording's first sample

    [[effect]]
    name = "lever_arm"                 # of the catalogue, or "driven"
    signal = "accel"                   # where it was seen
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

Times count from `start_ns` along the log that was diagnosed, else from the first simulated sample. A parameter that is left
out does nothing. `driven` has parameters x, y, z (the gain on each axis) and lag (s): the signal gains
gain (c(t - lag) - mean of c), c the channel named by `driver`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from imutool.config import Settings, build, toml
from imutool.errors import ConfigError, ImutoolError, did_you_mean
from imutool.mcap_io.storage.target import Target
from imutool.sensor import catalogue, physics_file_terms
from imutool.sensor.effect import Effect, Theta
from imutool.sensor.effects import gyro_scale, low_pass, saturation
from imutool.sensor.physics_file_terms import DRIVEN, VARIABLES
from imutool.units import SENSORS, Sensor, Three

OTHER = "# Of another signal than the IMU's: simulate and debias do not apply it."
NotNegative = Annotated[float, Meta(ge=0.0)]
ThreeStd = tuple[NotNegative, NotNegative, NotNegative]
Known = Callable[[Sequence[str]], tuple[Effect, ...]]


class Value(Settings, frozen=True, kw_only=True):
    """Value of a parameter, its standard deviation where that is known, and its unit."""

    value: float
    std: NotNegative | None = None
    unit: str


class Entry(Settings, frozen=True, kw_only=True):
    """Effect by name; `signal` is where it was seen, `driver` the channel behind a `driven` one.

    `column` is the TOPIC.field of another signal than an IMU's: the file tells of it, and no simulation of an IMU applies it.
    """

    name: str
    signal: Literal["gyro", "accel", "both", ""] = ""
    driver: str = ""
    column: str = ""
    equation: str = ""
    parameters: dict[str, Value]


class Bias(Settings, frozen=True, kw_only=True):
    """Constant bias (rad/s, m/s²)."""

    gyro: Three = (0.0, 0.0, 0.0)
    accel: Three = (0.0, 0.0, 0.0)


class Curve(Settings, frozen=True, kw_only=True):
    """Curve of one variable, added to the axes of a signal; `band` is one standard deviation."""

    signal: Sensor
    variable: str
    unit: str
    x: tuple[float, ...]
    y: tuple[Three, ...]
    band: tuple[ThreeStd, ...] = ()


class Term(Settings, frozen=True, kw_only=True):
    """Product of variables, added to the axes of a signal so many times."""

    signal: Sensor
    term: str
    value: Three
    std: ThreeStd | None = None


class PhysicsFile(Settings, frozen=True, kw_only=True):
    """Contents of a physics.toml.

    `start_ns` is the stamp from which its times count, on the clock of the log to simulate along. `conventions` names what the
    recording had otherwise than the simulation: the physics is in the units and axes of the simulation.
    """

    schema: Literal["imutool.physics/1"] = "imutool.physics/1"
    start_ns: int | None = None
    conventions: tuple[str, ...] = ()
    effect: tuple[Entry, ...] = ()
    bias: Bias | None = None
    unknown: tuple[Curve, ...] = ()
    term: tuple[Term, ...] = ()

    def acting(self, where: str | Path = "physics", known: Known = catalogue.effects) -> list[tuple[Effect, Theta]]:
        """Effects of the IMU with their parameters; `known` finds them by name.

        Raises:
            ConfigError: an unknown effect, parameter, unit, signal, variable or term (the nearest is named), or a wrong value.
        """
        found: list[tuple[Effect, Theta]] = []
        for k, entry in enumerate(self.effect):
            if entry.column:
                continue
            place = f"effect[{k}]"
            effect = _driven(entry, where, place) if entry.name == DRIVEN else _named(entry.name, known, where, place)
            effect = low_pass.of_signal(saturation.of_form(effect, entry.parameters), entry.signal)
            effect = gyro_scale.of_form(effect, entry.parameters)
            found.append((effect, _theta(entry, effect, where, place)))
        found += [(_curve(curve, k, where), np.zeros(0)) for k, curve in enumerate(self.unknown)]
        for k, term in enumerate(self.term):
            found.append((_term(term, k, where), np.zeros(0)))
        if self.bias is not None:
            found.append((physics_file_terms.constant_bias(self.bias.gyro, self.bias.accel), np.zeros(0)))
        return found


def read(path: Path) -> PhysicsFile:
    """Read and check a physics.toml; `acting` looks up its names.

    Raises:
        ConfigError: no such file, no TOML, an unknown or missing key, a wrong type, a number that is not finite.
    """
    values = toml(path, "physics")
    file = build(PhysicsFile, values, where=path)
    for k, curve in enumerate(file.unknown):
        x = np.array(curve.x)
        if len(x) < 2 or not (np.diff(x) > 0.0).all():
            raise ConfigError(f"unknown[{k}].x does not rise", where=path, expected="two and more values, each above the last")
        for key, rows in (("y", curve.y), ("band", curve.band)):
            if len(rows) != len(x) and (rows or key == "y"):
                what = f"unknown[{k}].{key} has {len(rows)} rows"
                raise ConfigError(what, where=path, expected=f"{len(x)}, one for each of x")
    return file


def write(file: PhysicsFile, path: Path) -> None:
    """Write a physics.toml, which `read` gives back bit for bit.

    Raises:
        ConfigError: the file exists, or cannot be written.
    """
    with Target(path) as target:
        target.write(to_toml(file).encode())


def to_toml(file: PhysicsFile) -> str:
    """Text of the file."""
    lines = ["# Physics of an IMU, as `imutool simulate --physics FILE` takes it", f"schema = {_text(file.schema)}"]
    lines += [] if file.start_ns is None else [f"start_ns = {file.start_ns}"]
    lines += [f"conventions = [{', '.join(map(_text, file.conventions))}]"] if file.conventions else []
    for entry in file.effect:
        lines += ["", *([OTHER] if entry.column else []), "[[effect]]", f"name = {_text(entry.name)}"]
        keys = ("signal", "driver", "column", "equation")
        lines += [f"{key} = {_text(text)}" for key in keys if (text := getattr(entry, key))]
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
        columns = {"y": curve.y, **({"band": curve.band} if curve.band else {})}
        lines += [f"x = {_row(curve.x)}", *(f"{key} = [{', '.join(map(_row, rows))}]" for key, rows in columns.items())]
    for term in file.term:
        lines += ["", "[[term]]", f"signal = {_text(term.signal)}", f"term = {_text(term.term)}", f"value = {_row(term.value)}"]
        lines += [] if term.std is None else [f"std = {_row(term.std)}"]
    return "\n".join([*lines, ""])


def _text(text: str) -> str:
    """String of TOML, which escapes as JSON does but for one control character."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _key(text: str) -> str:
    return text if re.fullmatch(r"[A-Za-z0-9_-]+", text) else _text(text)


def _row(values: Sequence[float]) -> str:
    return f"[{', '.join(repr(float(value)) for value in values)}]"


# ── effects by name ──


def _named(name: str, known: Known, where: str | Path, place: str) -> Effect:
    try:
        (effect,) = known([name])
    except ImutoolError as error:
        raise ConfigError(f"{place}.name: {error.what}", where=where, expected=error.expected, fix=error.fix) from error
    return effect


def _theta(entry: Entry, effect: Effect, where: str | Path, place: str) -> Theta:
    """Parameters in the effect's own order."""
    if entry.signal not in ("", "both", *effect.sensors):
        listed = " or ".join(effect.sensors)
        raise ConfigError(f"{place}.signal is {entry.signal}: {entry.name} does not act there", where=where, expected=listed)
    parameters = {parameter.name: parameter for parameter in effect.parameters}
    theta = effect.null_value.astype(np.float64)
    for name, value in entry.parameters.items():
        key = f"{place}.parameters.{name}"
        if name not in parameters:
            raise _unknown(key, name, list(parameters), where)
        parameter = parameters[name]
        if value.unit != parameter.unit and entry.name != DRIVEN:
            raise ConfigError(f"{key}.unit is {value.unit!r}", where=where, expected=repr(parameter.unit))
        if parameter.positive and not value.value > 0.0:
            raise ConfigError(f"{key}.value is {value.value:g}", where=where, expected="more than 0")
        theta[list(parameters).index(name)] = value.value
    if not entry.parameters:
        raise ConfigError(f"{place}.parameters is empty", where=where, expected=f"some of {', '.join(parameters)}")
    return theta


def _unknown(key: str, name: str, names: Sequence[str], where: str | Path) -> ConfigError:
    expected, fix = f"one of {', '.join(names)}", did_you_mean(name, names)
    return ConfigError(f"{key}: {name!r} is not known", where=where, expected=expected, fix=fix)


# ── effects without a name ──


def _driven(entry: Entry, where: str | Path, place: str) -> Effect:
    if entry.signal not in SENSORS:
        raise ConfigError(f"{place}.signal is {entry.signal!r}", where=where, expected="gyro or accel for what is driven")
    if not entry.driver:
        raise ConfigError(f"{place}.driver is missing", where=where, expected="the channel that drives it, as TOPIC or TOPIC.x")
    return physics_file_terms.driven("gyro" if entry.signal == "gyro" else "accel", entry.driver)


def _curve(curve: Curve, k: int, where: str | Path) -> Effect:
    if not curve.variable.startswith("/") and curve.variable not in VARIABLES:
        raise _unknown(f"unknown[{k}].variable", curve.variable, [*VARIABLES, "/TOPIC"], where)
    return physics_file_terms.curve(str(k), curve.signal, curve.variable, np.array(curve.x), np.array(curve.y))


def _term(term: Term, k: int, where: str | Path) -> Effect:
    """Effect of a product of variables, |variable|, variable^n or sign(variable)."""
    effect = physics_file_terms.product(f"term {k}", term.signal, term.term, term.value)
    if effect is None:
        raise _unknown(f"term[{k}].term", term.term, [f"products of {', '.join(VARIABLES)}"], where)
    return effect
