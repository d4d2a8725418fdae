"""Positions of satellites in metres, against the Earth's ellipsoid itself."""

from __future__ import annotations

import numpy as np
import pytest

from imutool.diagnosis.signals.ideal_signal import SignalPair
from imutool.diagnosis.signals.quantities import in_si, metres
from imutool.mcap_io.fields import Fields

A, B = 6_378_137.0, 6_356_752.314245  # m: half axes of WGS 84
WITHIN_M = 0.15  # of 500 m: the Earth's curvature takes 2 cm, a height of 400 m 3 cm, and the meridians close up


def from_centre(lat: np.ndarray, lon: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Points of the ellipsoid, by its half axes; angles in rad."""
    normal = A**2 / np.hypot(A * np.cos(lat), B * np.sin(lat))
    level = (normal + up) * np.cos(lat)
    return np.stack([level * np.cos(lon), level * np.sin(lon), ((B / A) ** 2 * normal + up) * np.sin(lat)], axis=1)


@pytest.mark.parametrize(("lat_deg", "lon_deg"), [(47.4, 8.5), (-33.9, 151.2), (0.0, -78.5), (-16.8, 180.0)])
def test_metres_are_east_north_and_up_of_the_simulations_first_position(lat_deg: float, lon_deg: float) -> None:
    rng, size = np.random.default_rng(0), 500.0 / 111_000.0  # degrees of some 500 m
    lat, lon = np.radians(lat_deg + size * rng.uniform(-1.0, 1.0, 50)), np.radians(lon_deg + size * rng.uniform(-1.0, 1.0, 50))
    up = 400.0 + rng.uniform(-50.0, 50.0, 50)
    values = {"latitude": np.degrees(lat), "longitude": (np.degrees(lon) + 180.0) % 360.0 - 180.0, "altitude": up}
    side = {name: Fields(np.arange(50), column) for name, column in values.items()}
    found = metres(side, side)
    s, c = np.sin([lat[0], lon[0]]), np.cos([lat[0], lon[0]])
    axes = np.array([[-s[1], c[1], 0.0], [-s[0] * c[1], -s[0] * s[1], c[0]], [c[0] * c[1], c[0] * s[1], s[0]]])
    p = from_centre(lat, lon, up)
    expected = (p - p[0]) @ axes.T
    for name, column in zip(("longitude", "latitude", "altitude"), expected.T, strict=True):
        np.testing.assert_allclose(found[name].values, column, rtol=0, atol=WITHIN_M)


@pytest.mark.parametrize(
    ("kind", "value", "unit"),
    [
        *(("magnetic", value, unit) for value, unit in ((0.48, "G"), (48.0, "µT"), (480.0, "mG"), (48_000.0, "nT"))),
        *(("pressure", value, unit) for value, unit in ((1013.25, "hPa"), (101.325, "kPa"), (1.01325, "bar"))),
    ],
)
def test_a_field_and_the_air_in_any_unit_are_tesla_and_pascal(kind: str, value: float, unit: str) -> None:
    t_ns, wave = np.arange(50) * 10**8, np.sin(np.arange(50.0))[:, None] / 100.0
    si, name = {"magnetic": (4.8e-5, "T"), "pressure": (101_325.0, "Pa")}[kind]
    pair = SignalPair("/a", ("/a.b",), ("",), t_ns, value * (1.0 + wave), t_ns, si * (1.0 + wave), kind=kind)
    found, remark = in_si(pair)
    np.testing.assert_allclose(found.real, found.sim, rtol=1e-12)
    assert found.units == (name,)
    assert f"it is in {unit} and {name}" in remark
