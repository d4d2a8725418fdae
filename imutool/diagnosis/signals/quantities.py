"""Signals as quantities: angles that wrap, units that differ, positions in metres."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from imutool.array_types import Float64
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.diagnosis.signals.ideal_signal import SignalPair, simulated_motion, stacked
from imutool.diagnosis.signals.lag import lag_at_first_sight
from imutool.errors import DataError
from imutool.mcap_io.fields import Fields
from imutool.sensor.channels import is_quantity
from imutool.sensor.robot_effects.joint_dynamics import identified

FACTOR_ERROR = 0.25  # of the logarithm: a sensor's own gain departs less, and no two factors are as near
OTHER_MOTION_ERROR = 1.5  # likewise, of the efforts of two motions
TURNED = 4.0 * np.pi  # rad; a hinge of an arm turns less
TURNS = (2.0 * np.pi, 360.0)
EARTH_M, FLATTENING = 6_378_137.0, 1.0 / 298.257223563  # WGS 84
FACTORS = {180.0 / np.pi: "degrees", 100.0: "hundreds", 1e3: "thousands", 1e4: "gauss", 1e6: "millions"}
"""Factors between units of one quantity, either way round."""
MAGNETIC = re.compile(r"magnet|(?<![a-z])mag(?![a-z])|compass")  # in the name of a field, or of its topic
FIRST = re.compile(r"\[0\]$|(?<![A-Za-z])[xX](?![A-Za-z])")  # of three numbers
AXES_OF = ("[0]", "[1]", "[2]", "[3]"), tuple("xyzw"), tuple("XYZW")  # with a fourth, four numbers are no field
PRESSURE = re.compile(r"press[^.]*(\.(data|value))?$")  # in its own, or in that of a topic with one number
UNITS = {
    "magnetic": {"T": 1.0, "G": 1e-4, "µT": 1e-6, "mG": 1e-7, "nT": 1e-9},
    "pressure": {"Pa": 1.0, "hPa": 1e2, "kPa": 1e3, "bar": 1e5},
}
SIZES = {"magnetic": (1.5e-5, 1.3e-4), "pressure": (3e4, 1.15e5)}
"""Of the Earth's field with some hard iron (T), of its air up to 9 km (Pa)."""


def field_vectors(topic: str, real: Mapping[str, Fields], sim: Mapping[str, Fields]) -> Iterator[tuple[str, ...]]:
    """Paths of magnetic fields in messages of any type.

    Each is an array of three, or x, y and z, is named a field or compass, and is as large as the Earth's field.
    """
    for path in real:
        for first in FIRST.finditer(path):
            axes = next(axes for axes in AXES_OF if axes[0] == first[0])
            triple = tuple(f"{path[: first.start()]}{axis}{path[first.end() :]}" for axis in axes[:3])
            named = MAGNETIC.search(f"{topic}.{path}".lower()) is not None
            named &= f"{path[: first.start()]}{axes[3]}{path[first.end() :]}" not in real
            if named and all(field in side and is_quantity(side[field]) for field in triple for side in (real, sim)):
                columns = (stacked([side[field] for field in triple])[1] for side in (real, sim))
                if None not in [_unit("magnetic", values) for values in columns]:
                    yield triple


def is_air(name: str, values: Fields) -> bool:
    """Whether a number is named a pressure, and is of the size of the air's."""
    return PRESSURE.search(name.lower()) is not None and _unit("pressure", values.values[:, None]) is not None


def _unit(kind: str, values: Float64[np.ndarray, "n k"]) -> str | None:
    """Unit in which values have the size that there is on the Earth; None where they have it in no unit."""
    size, (minimum, maximum) = float(np.median(np.linalg.norm(values, axis=1))), SIZES[kind]
    within = {unit: size * factor for unit, factor in UNITS[kind].items() if minimum < size * factor < maximum}
    return min(within, key=lambda unit: _departure(kind, within[unit]), default=None)


def _departure(kind: str, size: float) -> float:
    """Departure (logarithm) of a size in T or Pa from the middle of those on Earth."""
    minimum, maximum = SIZES[kind]
    return abs(float(np.log(size / np.sqrt(minimum * maximum))))


def in_si(pair: SignalPair) -> tuple[SignalPair, str]:
    """Field or pressure of unknown unit in tesla or pascal, by the size that it has on Earth."""
    if any(pair.units) or pair.kind not in UNITS:
        return pair, ""
    units = [_unit(pair.kind, values) for values in (pair.real, pair.sim)]
    if None in units:
        return pair, ""
    (si, *_), (real, sim) = UNITS[pair.kind], (UNITS[pair.kind][str(unit)] for unit in units)
    changed = replace(pair, real=real * pair.real, sim=sim * pair.sim, units=(si,) * len(pair.units))
    names = " and ".join(dict.fromkeys(str(unit) for unit in units))
    return changed, "" if names == si else f"{pair.name} was converted to {si}: its size shows that it is in {names}"


def unwrapped(pair: SignalPair) -> SignalPair:
    """Angles that wrap, as continuous ones."""
    return replace(pair, real=continuous(pair.real), sim=continuous(pair.sim))


def continuous(values: Float64[np.ndarray, "..."]) -> Float64[np.ndarray, "..."]:
    """Angles of one column without the jumps of a turn; other numbers as they are."""
    steps = np.abs(np.diff(values.ravel()))
    for turn in TURNS:
        jumps = steps[steps > 0.5 * turn]
        if np.ptp(values) <= 1.001 * turn and len(jumps) and (np.abs(jumps - turn) < 0.2 * turn).all():
            return np.asarray(np.unwrap(values, period=turn, axis=0))
    return values


def in_radians(pair: SignalPair) -> tuple[SignalPair, str]:
    """Efforts of an arm with its angles in radians, where a log has degrees.

    A hinge of an arm turns less than twice round. Simulated degrees are known by the efforts, which follow from the angles in
    radians alone; recorded ones by their size relative to the simulated.
    """
    states, changed, settings = [pair.state, pair.sim_state], list[str](), DiagnoseSettings()
    far = [pair.kind == "efforts" and max(map(_size, _angles(state)), default=0.0) > TURNED for state in states]
    if far[1] and _is_chain(trial := replace(pair, sim_state=_radians(states[1])), settings):
        pair, changed = trial, ["simulation"]
    sizes = [np.median([np.std(own.values) for own in _angles(state)] or [1.0]) for state in (pair.state, pair.sim_state)]
    if far[0] and abs(np.log(sizes[0] / sizes[1]) - np.log(180.0 / np.pi)) < OTHER_MOTION_ERROR:
        pair, changed = replace(pair, state=_radians(states[0])), ["recording", *changed]
    return pair, f"Angles of {pair.name} are degrees in the {' and the '.join(changed)}, and were converted" if changed else ""


def _size(values: Fields) -> float:
    return float(np.abs(values.values).max())


def _angles(state: Mapping[str, Fields]) -> list[Fields]:
    return [values for name, values in state.items() if name.startswith("q")]


def _radians(state: Mapping[str, Fields]) -> dict[str, Fields]:
    return {name: replace(values, values=np.radians(values.values)) for name, values in state.items()}


def _is_chain(pair: SignalPair, settings: DiagnoseSettings) -> bool:
    """Whether simulated efforts are those of links on hinges: sums of sines would fit angles of any unit."""
    try:
        dynamics = identified(*simulated_motion(pair, settings))
    except DataError:
        return False
    return dynamics is not None and (bool(dynamics.signs) or dynamics.spatial is not None)


def in_one_unit(pair: SignalPair) -> tuple[SignalPair, str]:
    """Both logs in one unit, where they differ by a known factor.

    It is the message's unit where the size of the values shows it, else the simulation's. Two noises differ by any factor.
    """
    sizes = [float(np.linalg.norm(np.std(values, axis=0))) for values in (pair.real, pair.sim)]
    ratio = np.log(max(sizes[0], 1e-300) / max(sizes[1], 1e-300))
    factors, error = ({1e3: "thousands"}, OTHER_MOTION_ERROR) if pair.sim_state else (FACTORS, FACTOR_ERROR)
    for factor, word in factors.items():
        if abs(abs(ratio) - np.log(factor)) < error and (pair.sim_state or _is_one_motion(pair)):
            larger, changed = bool(ratio > 0.0), "sim" if _is_usual(pair) else "real"
            by = factor if larger != (changed == "real") else 1.0 / factor
            text = (
                f"{pair.name} is {factor:.4g} times {'larger' if larger else 'smaller'} than in the simulation,"
                f" as in another unit ({word}); the {'simulation' if changed == 'sim' else 'recording'} was"
                f" {'divided' if by < 1.0 else 'multiplied'} by that"
            )
            return replace(pair, **{changed: getattr(pair, changed) * by}), text
    return pair, ""


def _is_one_motion(pair: SignalPair) -> bool:
    """Whether both logs move alike."""
    try:
        lag_at_first_sight(pair, DiagnoseSettings())
    except DataError:
        return False
    return True


def _is_usual(pair: SignalPair) -> bool:
    """Whether the recording, and not the simulation, has the size that its message's unit gives."""
    if pair.kind not in SIZES:
        return False
    sizes = (float(np.sqrt((values**2).sum(axis=1).mean())) for values in (pair.real, pair.sim))
    real, sim = (_departure(pair.kind, max(size, 1e-300)) for size in sizes)
    return real < sim


def metres(side: Mapping[str, Fields], origin: Mapping[str, Fields]) -> dict[str, Fields]:
    """East, north and up (m) about the simulation's first position, by the angles' names."""
    lat0, lon0, up0 = (float(origin[name].values[0]) for name in ("latitude", "longitude", "altitude"))
    e2, sin = FLATTENING * (2.0 - FLATTENING), float(np.sin(np.radians(lat0)))
    along = EARTH_M * (1.0 - e2) / (1.0 - e2 * sin**2) ** 1.5
    across = EARTH_M / np.sqrt(1.0 - e2 * sin**2) * np.cos(np.radians(lat0))
    latitude, longitude, altitude = (side[name] for name in ("latitude", "longitude", "altitude"))
    return {
        "longitude": Fields(longitude.t_ns, np.radians(np.mod(longitude.values - lon0 + 180.0, 360.0) - 180.0) * across),
        "latitude": Fields(latitude.t_ns, np.radians(latitude.values - lat0) * along),
        "altitude": Fields(altitude.t_ns, altitude.values - up0),
    }
