"""Hysteresis of the accelerometer: the play operator on the specific force."""

from __future__ import annotations

from imutool.sensor.effects.gyro_hysteresis import hysteresis

EFFECT = hysteresis("accel", "f", "m/s²", 0.2, "the force changes to and fro")
