"""What a misfit without a name can be a function of, as physics.toml and reports write it."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from imutool.sensor.samples import SensorSamples
from imutool.units import AXES

Variable = Callable[[SensorSamples], Float64[np.ndarray, " n"]]


def _column(name: str, axis: int) -> Variable:
    def column(read: SensorSamples) -> Float64[np.ndarray, " n"]:
        values: Float64[np.ndarray, "n 3"] = getattr(read, name)
        return values[:, axis]

    return column


VARIABLES: dict[str, Variable] = {
    **{f"omega_{axis}": _column("gyro", k) for k, axis in enumerate(AXES)},
    **{f"f_{axis}": _column("accel", k) for k, axis in enumerate(AXES)},
    **{f"alpha_{axis}": _column("alpha", k) for k, axis in enumerate(AXES)},
    "|omega|": lambda read: np.asarray(np.linalg.norm(read.gyro, axis=1)),
    "|f|": lambda read: np.asarray(np.linalg.norm(read.accel, axis=1)),
    "t": lambda read: read.stamp_s,
}


def words(text: str) -> list[str]:
    """`omega_x|omega_x|` is two factors, `omega_x omega_y` as well."""
    return re.findall(r"\|[^|]*\||sign\([^()]*\)|[^\s|]+", text)


def factor(word: str) -> Variable | None:
    """A variable, its size, its sign, or a power of it; None where it is none of these."""
    for pattern, change in CHANGES:
        found = re.fullmatch(pattern, word)
        if found and found[1] in VARIABLES:
            power = float(found[2]) if found.lastindex == 2 else 1.0
            return _Factor(VARIABLES[found[1]], change, power)
    return None


@dataclass(frozen=True)
class _Factor:
    """sign, size or a power of a variable."""

    variable: Variable
    change: Callable[[Any], Any]
    power: float

    def __call__(self, read: SensorSamples) -> Float64[np.ndarray, " n"]:
        return np.asarray(self.change(self.variable(read)) ** self.power)


def _same(x: Any) -> Any:
    return x


CHANGES: tuple[tuple[str, Callable[[Any], Any]], ...] = (
    (r"(.+)", _same),
    (r"\|(.+)\|", np.abs),
    (r"sign\((.+)\)", np.sign),
    (r"(.+)\^([1-9])", _same),
)
