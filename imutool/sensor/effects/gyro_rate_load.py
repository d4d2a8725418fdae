"""Gyro drift with the rate: + K z, dz/dt = (g(|omega|) - z) / tau."""

from __future__ import annotations

from imutool.sensor.effects.gyro_warm_up import load_drift
from imutool.sensor.signals import RAMPS, TURNING_RAD_S

LOADS = slice(1, 1 + RAMPS[0])

EFFECT = load_drift(
    "gyro_rate_load",
    LOADS,
    tuple(f"rate{knot:g}_" for knot in TURNING_RAD_S[1:]),
    "gyro += K z, dz/dt = (g(|omega|) - z) / tau",
    "the rate's size varies over minutes",
)
