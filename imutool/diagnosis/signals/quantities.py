"""Signals as quantities: angles that wrap, units that differ, positions in metres."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from imutool.array_types import Float64
from imutool.diagnosis.signals.ideal_signal import SignalPair
from imutool.mcap_io.fields import Fields

FACTOR_ERROR = 0.05
TURNS = (2.0 * np.pi, 360.0)
EARTH_M, FLATTENING = 6_378_137.0, 1.0 / 298.257223563  # WGS 84
FACTORS = {
    180.0 / np.pi: "degrees",
    1000.0: "thousandths",
    1e4: "gauss",
    1e6: "millionths",
    0.01: "hundreds",
    1e-3: "thousands",
}


def unwrapped(pair: SignalPair) -> SignalPair:
    """Angles that wrap, as continuous ones."""

    def whole(values: Float64[np.ndarray, "_ 1"]) -> Float64[np.ndarray, "_ 1"]:
        steps = np.abs(np.diff(values[:, 0]))
        for turn in TURNS:
            if (
                np.ptp(values) <= 1.001 * turn
                and (np.abs(steps[steps > 0.5 * turn] - turn) < 0.2 * turn).all()
                and (steps > 0.5 * turn).any()
            ):
                return np.asarray(np.unwrap(values, period=turn, axis=0))
        return values

    return replace(pair, real=whole(pair.real), sim=whole(pair.sim))


def in_one_unit(pair: SignalPair) -> tuple[SignalPair, str]:
    """The recording in the simulation's unit, where the two differ by a known factor."""
    if pair.sim_state:
        return pair, ""
    ratio = float(np.linalg.norm(np.std(pair.real, axis=0))) / max(float(np.linalg.norm(np.std(pair.sim, axis=0))), 1e-300)
    for factor, word in FACTORS.items():
        if abs(ratio / factor - 1.0) < FACTOR_ERROR:
            text = f"{pair.name} is {factor:.4g} times larger than in the simulation, as {word} are; it was divided by that"
            return replace(pair, real=pair.real / factor), text
    return pair, ""


def metres(side: Mapping[str, Fields], origin: Mapping[str, Fields]) -> dict[str, Fields]:
    """East, north and up (m) about the simulation's first position, by the angles' names."""
    lat0, lon0, up0 = (float(origin[name].values[0]) for name in ("latitude", "longitude", "altitude"))
    e2, sin = FLATTENING * (2.0 - FLATTENING), float(np.sin(np.radians(lat0)))
    along = EARTH_M * (1.0 - e2) / (1.0 - e2 * sin**2) ** 1.5
    across = EARTH_M / np.sqrt(1.0 - e2 * sin**2) * np.cos(np.radians(lat0))
    latitude, longitude, altitude = (side[name] for name in ("latitude", "longitude", "altitude"))
    return {
        "longitude": Fields(longitude.t_ns, np.radians(longitude.values - lon0) * across),
        "latitude": Fields(latitude.t_ns, np.radians(latitude.values - lat0) * along),
        "altitude": Fields(altitude.t_ns, altitude.values - up0),
    }
