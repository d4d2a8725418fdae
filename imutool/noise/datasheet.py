"""Noise of an IMU: densities, walks and instabilities by axis, with their sources.

Data sheets by name.

The model is that of IEEE 952 and 1293, as Kalibr and the ASL `sensor.yaml` write it: a sample reads truth + b(t) + n(t), n
white with a density, b a random walk with a walk density, plus a flicker floor (instability) that no averaging gets below.
An unknown value is None, in a file `"unknown"`; zero means no noise.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from imutool.array_types import Float64
from imutool.config import Settings, build, toml
from imutool.errors import ConfigError, did_you_mean
from imutool.mcap_io.storage.target import Target
from imutool.noise.colour import Colour

UNITS = {
    "gyro_density": "rad/s/sqrt(Hz)",
    "accel_density": "m/s^2/sqrt(Hz)",
    "gyro_walk": "rad/s^2/sqrt(Hz)",
    "accel_walk": "m/s^3/sqrt(Hz)",
    "gyro_instability": "rad/s",
    "accel_instability": "m/s^2",
}
UNKNOWN = "unknown"  # TOML has no null

Value = Annotated[float, Meta(ge=0.0)]
Axes = tuple[Value | None, Value | None, Value | None]
_NONE: Axes = (None, None, None)


class Noise(Settings, frozen=True, kw_only=True):
    """Noise by axis x, y, z in the units of `UNITS`, None where it is not known.

    `*_density`: white noise; the standard deviation of a sample is density * sqrt(rate). `*_walk`: how far the bias walks,
    walk * sqrt(t) after t seconds. `*_instability`: the B of IEEE 952, whose Allan deviation is flat at 0.664 B.
    `sources` says in a few words where each comes from. With a `colour` the density is that of the same power, were it white.
    """

    gyro_density: Axes = _NONE
    accel_density: Axes = _NONE
    gyro_walk: Axes = _NONE
    accel_walk: Axes = _NONE
    gyro_instability: Axes = _NONE
    accel_instability: Axes = _NONE
    sources: dict[str, str] = msgspec.field(default_factory=dict)
    colour: Colour | None = None

    def values(self, quantity: str) -> Float64[np.ndarray, "3"]:
        """Values of a quantity by axis, NaN if unknown."""
        return np.array([np.nan if value is None else value for value in getattr(self, quantity)])

    def known(self) -> bool:
        """Whether any value is known."""
        return any(value is not None for quantity in UNITS for value in getattr(self, quantity))


def _each(value: float) -> Axes:
    return value, value, value


_DEGREE, _HOUR, _G = np.pi / 180.0, 3600.0, 9.80665  # data sheets write deg, h and standard gravity

SHEETS: Mapping[str, Noise] = MappingProxyType(
    {
        "none": build(Noise, {**{name: _each(0.0) for name in UNITS}, "sources": dict.fromkeys(UNITS, "none")}),
        "adis16448": Noise(
            gyro_density=_each(0.66 * _DEGREE / np.sqrt(_HOUR)),
            accel_density=_each(0.11 / np.sqrt(_HOUR)),
            gyro_walk=_each(1.9393e-5),
            accel_walk=_each(3.0e-3),
            gyro_instability=_each(14.5 * _DEGREE / _HOUR),
            accel_instability=_each(0.25e-3 * _G),
            sources={
                "gyro_density": "data sheet: angular random walk 0.66 deg/sqrt(h)",
                "accel_density": "data sheet: velocity random walk 0.11 m/s/sqrt(h)",
                "gyro_walk": "EuRoC sensor.yaml (the data sheet has none)",
                "accel_walk": "EuRoC sensor.yaml (the data sheet has none)",
                "gyro_instability": "data sheet: in-run bias stability 14.5 deg/h",
                "accel_instability": "data sheet: in-run bias stability 0.25 mg",
            },
        ),
        "bmi160": Noise(
            gyro_density=_each(0.007 * _DEGREE),
            accel_density=_each(180e-6 * _G),
            gyro_walk=_each(2.2e-6),
            accel_walk=_each(8.6e-5),
            sources={
                "gyro_density": "data sheet: 0.007 deg/s/sqrt(Hz)",
                "accel_density": "data sheet: 180 ug/sqrt(Hz)",
                "gyro_walk": "Allan deviation in the TUM-VI paper (the data sheet has none)",
                "accel_walk": "Allan deviation in the TUM-VI paper (the data sheet has none)",
            },
        ),
    }
)
"""Typical figures of sensors by name.

adis16448: Analog Devices, ADIS16448 data sheet, table 1. Its rate noise density at 25 Hz, 0.0135 deg/s/sqrt(Hz) or 2.4e-4
rad/s/sqrt(Hz), and 0.23 mg/sqrt(Hz) are a fifth above what its random walks say; the walks are what integrates.
bmi160: Bosch Sensortec, BST-BMI160-DS000, table 3. Walks: Schubert et al., The TUM VI Benchmark, IROS 2018, section IV-B.
"""


def read(name: str | Path) -> Noise:
    """Noise of a sensor in `SHEETS`, or from a TOML file of `write`.

    A single number holds for all three axes.

    Raises:
        ConfigError: no such name or file (the nearest name is given), no TOML, unknown key, negative or infinite value.
    """
    if isinstance(name, str) and name in SHEETS:
        return SHEETS[name]
    path = Path(name)
    if not path.exists():
        raise ConfigError(
            "there is no such noise",
            where=path,
            expected=f"{', '.join(SHEETS)} or a TOML file",
            fix=did_you_mean(str(name), SHEETS),
        )
    values = toml(path, "noise")
    return build(Noise, {key: _axes(value) if key in UNITS else value for key, value in values.items()}, where=path)


def _axes(value: Any) -> Any:
    """Turns a quantity of TOML into a list of three; any other value stays, to be refused with its place."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return [float(value)] * 3
    if value == UNKNOWN:
        return list(_NONE)
    return [None if axis == UNKNOWN else axis for axis in value] if isinstance(value, list) else value


def to_toml(noise: Noise) -> str:
    """TOML text of the noise; `read` returns the same numbers, bit for bit."""
    lines = ["# Noise of an IMU by axis x, y, z, as `imutool simulate --noise FILE` takes it"]
    for name, unit in UNITS.items():
        axes = ", ".join(f'"{UNKNOWN}"' if value is None else repr(float(value)) for value in getattr(noise, name))
        lines.append(f"{name} = [{axes}]  # {unit}")
    if noise.sources:
        lines += ["", "[sources]", *(f"{_text(key, bare=True)} = {_text(text)}" for key, text in noise.sources.items())]
    if noise.colour is not None:
        lines += ["", "[colour]", *(f"{key} = {json.dumps(value)}" for key, value in msgspec.to_builtins(noise.colour).items())]
    return "\n".join([*lines, ""])


def _text(text: str, *, bare: bool = False) -> str:
    """A string of TOML, which escapes as JSON does but for one control character."""
    if bare and re.fullmatch(r"[A-Za-z0-9_-]+", text):
        return text
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def write(noise: Noise, path: Path, *, overwrite: bool = False) -> None:
    """Write the noise as TOML.

    Raises:
        ConfigError: the file exists (without `overwrite`), or cannot be written.
    """
    with Target(path, overwrite=overwrite) as target:
        target.write(to_toml(noise).encode())


def plain(noise: Noise) -> dict[str, Any]:
    """Noise as plain JSON values, with its units."""
    values = {**{name: list(getattr(noise, name)) for name in UNITS}, "units": dict(UNITS), "sources": dict(noise.sources)}
    return values if noise.colour is None else {**values, "colour": msgspec.to_builtins(noise.colour)}


assert set(UNITS) == {field.name for field in msgspec.structs.fields(Noise)} - {"sources", "colour"}


def unknown(noise: Noise) -> list[str]:
    """Names of what a noise does not state: `gyro_walk`, or `gyro_walk (x, y)` of some axes."""
    missing = {name: [axis for axis, value in zip("xyz", noise.values(name), strict=True) if np.isnan(value)] for name in UNITS}
    return [name if len(axes) == len("xyz") else f"{name} ({', '.join(axes)})" for name, axes in missing.items() if axes]
