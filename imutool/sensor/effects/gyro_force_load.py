"""Gyro drift with vibration and force: + K z, dz/dt = (g(f) - z) / tau."""

from __future__ import annotations

from imutool.sensor.effects.gyro_rate_load import LOADS
from imutool.sensor.effects.gyro_warm_up import load_drift
from imutool.sensor.signals import SHAKING_M_S2

EFFECT = load_drift(
    "gyro_force_load",
    slice(LOADS.stop, None),
    tuple(f"{of}{knot:g}_" for of in ("shake", "force") for knot in SHAKING_M_S2[1:]),
    "gyro += K z, dz/dt = (g(f) - z) / tau",
    "vibration or force vary over minutes",
)
