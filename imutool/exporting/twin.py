"""Diagnosed sensor of one unit, or of a fleet: means, and ranges for domain randomisation.

A range holds two deviations, of the fits and among the units.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from imutool.array_types import Float64
from imutool.errors import ConfigError, DataError
from imutool.noise import datasheet
from imutool.noise.datasheet import Noise
from imutool.recording import GRAVITY_M_S2
from imutool.sensor import catalogue, physics_file
from imutool.sensor.effects import gyro_scale
from imutool.sensor.physics_file import Bias, Entry, PhysicsFile, Value
from imutool.units import AXES, SENSORS, Sensor, three

PHYSICS, NOISE = "physics.toml", "noise.toml"
MAX_BIAS_M_S2 = 0.6 * GRAVITY_M_S2  # of an accelerometer; with a larger one it measures no gravity
RATE_HZ = 200.0  # of a sensor whose rate neither the diagnosed noise nor the given one says
DEVIATIONS = 2.0  # of a range
Vector = Float64[np.ndarray, "3"]


@dataclass(frozen=True, eq=False)
class Twin:
    """Sensor of a fleet: physics, spread of the bias, noise.

    `used` are the effects expressed, `of_some` those that the fleet as a whole has not. A rate that is not
    `rate_known` is assumed.
    """

    physics: PhysicsFile
    bias_std: Mapping[Sensor, Vector]
    noise: Noise
    units: int
    rate_hz: float = RATE_HZ
    rate_known: bool = True
    of_some: tuple[str, ...] = ()
    used: set[str] = field(default_factory=set)

    def vector(self, effect: str) -> Vector:
        """Three parameters of an effect, zero where it is not known."""
        entry = next((entry for entry in self.physics.effect if entry.name == effect and not sets_in(entry)), None)
        if entry is None:
            return np.zeros(3)
        self.used.add(effect)
        return np.array([next((v.value for k, v in entry.parameters.items() if k[-1] == axis), 0.0) for axis in AXES])

    def value(self, effect: str, parameter: str) -> float | None:
        """One parameter of an effect."""
        for entry in self.physics.effect:
            if entry.name == effect and parameter in entry.parameters:
                self.used.add(effect)
                return entry.parameters[parameter].value
        return None

    def rotation(self) -> Rotation:
        """Attitude of the sensor on its body."""
        return Rotation.from_rotvec(self.vector("mount_rotation"))

    def bias(self, sensor: Sensor) -> Vector:
        """Mean bias of a sensor."""
        return np.zeros(3) if self.physics.bias is None else np.array(getattr(self.physics.bias, sensor))

    def std(self, sensor: Sensor) -> Vector:
        """Standard deviation of a sample's noise."""
        return np.asarray(np.nan_to_num(self.noise.values(f"{sensor}_density")) * np.sqrt(self.rate_hz))

    def ranges(self) -> dict[str, tuple[float, float, float, str]]:
        """Value, low, high and unit of every parameter with a name."""
        out = {}
        for title, entry in _titled(self.physics.effect):
            for name, value in entry.parameters.items():
                half = DEVIATIONS * (value.std or 0.0)
                out[f"{title}.{name}"] = (value.value, value.value - half, value.value + half, value.unit)
        for sensor in SENSORS:
            low, high = (1.0, 1.0) if self.noise.colour is None else getattr(self.noise.colour, f"{sensor}_range")
            for axis, std in zip(AXES, self.std(sensor), strict=True):
                out[f"{sensor}_noise.{axis}"] = (float(std), float(std * low), float(std * high), "")
            for axis, mean, std in zip(AXES, self.bias(sensor), self.bias_std[sensor], strict=True):
                out[f"{sensor}_bias.{axis}"] = (float(mean), float(mean - DEVIATIONS * std), float(mean + DEVIATIONS * std), "")
        return out


def read(source: Path, noise: str | Path | None = None) -> Twin:
    """Twin of one diagnosis or of several.

    Raises:
        ConfigError: no physics.toml, or no noise.
        DataError: the physics of samples in another unit.
    """
    folders = [source] if (source / PHYSICS).is_file() else sorted(path.parent for path in source.glob(f"*/{PHYSICS}"))
    if not folders:
        raise ConfigError("holds no diagnosis", where=source, expected=f"the folder of imutool diagnose, with {PHYSICS}")
    files = [physics_file.read(folder / PHYSICS) for folder in folders]
    noises = [datasheet.read(folder / NOISE) for folder in folders if (folder / NOISE).is_file()]
    if noise is None and not noises:
        raise ConfigError(f"holds no {NOISE}", where=source, fix="Diagnose again, or give `noise`")
    sheet = datasheet.read(noise) if noise is not None else _middle(noises)
    biases = {s: np.array([getattr(file.bias, s) for file in files if file.bias is not None]).reshape(-1, 3) for s in SENSORS}
    known = {s: rows for s, rows in biases.items() if len(rows)}
    for folder, file in zip(folders, files, strict=True):
        if file.bias is not None and (size := float(np.linalg.norm(file.bias.accel))) > MAX_BIAS_M_S2:
            what = f"{PHYSICS} has an accelerometer's bias of {size:.3g} m/s²: its log does not measure gravity, or not in m/s²"
            raise DataError(what, where=folder, fix="Correct the log with imutool convert LOG OUT --fix, and diagnose it again")
    mean = Bias(**{s: three(rows.mean(axis=0)) for s, rows in known.items()}) if known else None
    std: dict[Sensor, Vector] = {s: rows.std(axis=0, ddof=1) if len(rows) > 1 else np.zeros(3) for s, rows in biases.items()}
    physics, of_some = (files[0], ()) if len(files) == 1 else _of_fleet(files)
    own = (sheet, *noises) if noise is None else (*noises, sheet)  # a given noise is often of another sensor
    rates = [each.colour.rate_hz for each in own if each.colour is not None]
    physics = msgspec.structs.replace(physics, bias=mean)
    return Twin(physics, std, sheet, len(files), next(iter(rates), RATE_HZ), bool(rates), of_some)


def _titled(entries: Iterable[Entry]) -> Iterator[tuple[str, Entry]]:
    """Effects by a name of their own: one that acts twice has its signal in it, and then a number."""
    names, seen = Counter(entry.name for entry in entries), Counter[str]()
    for entry in entries:
        title = entry.name if names[entry.name] == 1 else f"{entry.name}_{entry.column or entry.signal}"
        seen[title] += 1
        yield title if seen[title] == 1 else f"{title}_{seen[title]}", entry


def _of_fleet(files: list[PhysicsFile]) -> tuple[PhysicsFile, tuple[str, ...]]:
    """Effects that most units have, with mean and spread of each parameter, and texts of the other effects.

    Where an effect acts twice, as two lines of a vibration, the lower frequencies of all units are one effect. What sets in at
    a time belongs to one log. Curves and terms belong to one unit.
    """
    found: dict[tuple[str, str, str], list[list[Entry]]] = {}
    for file in files:
        own: dict[tuple[str, str, str], list[Entry]] = {}
        for entry in sorted(file.effect, key=_place):
            own.setdefault((entry.name, entry.signal or entry.column, entry.driver), []).append(entry)
        for key, entries in own.items():
            found.setdefault(key, []).append(entries)
    common, of_some = list[Entry](), list[str]()
    for (name, *_), units in found.items():
        if 2 * len(units) > len(files) and len({len(own) for own in units}) == 1 and not any(map(sets_in, units[0])):
            common += [_pooled(list(alike)) for alike in zip(*units, strict=True)]
        else:
            of_some.append(f"{name} of {len(units)} of {len(files)} units")
    curves = [curve for file in files for curve in file.unknown]
    of_some += [f"a curve of {curve.variable}" for curve in curves] + [term.term for file in files for term in file.term]
    return PhysicsFile(effect=tuple(common)), tuple(of_some)


def _place(entry: Entry) -> list[float]:
    """Frequency, time constant or another parameter that no axis has, by which two effects of a name are told apart."""
    return [value.value for name, value in entry.parameters.items() if name[-1] not in AXES]


def sets_in(entry: Entry) -> bool:
    """Whether an effect sets in at a time of its log."""
    own = (gyro_scale.of_form(effect, entry.parameters) for effect in catalogue.effects() if effect.name == entry.name)
    return any(of.begins for effect in own for of in effect.parameters)


def _pooled(entries: list[Entry]) -> Entry:
    values = {}
    for name, first in entries[0].parameters.items():
        own = [entry.parameters[name] for entry in entries if name in entry.parameters]
        x, std = np.array([v.value for v in own]), np.array([v.std or 0.0 for v in own])
        spread = float(x.std(ddof=1)) if len(x) > 1 else 0.0
        values[name] = Value(value=float(x.mean()), std=float(np.hypot(spread, np.sqrt((std**2).mean()))), unit=first.unit)
    return msgspec.structs.replace(entries[0], parameters=values)


def _middle(noises: list[Noise]) -> Noise:
    """The unit with the middle noise; a colour cannot be averaged."""
    sizes = [float(np.nansum(noise.values("accel_density"))) for noise in noises]
    return noises[int(np.argsort(sizes)[len(sizes) // 2])]
