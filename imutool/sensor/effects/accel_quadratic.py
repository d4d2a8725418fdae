"""Nonlinearity of the accelerometer: + k f², per axis; it rectifies vibration."""

from __future__ import annotations

from imutool.sensor.effects.gyro_quadratic import quadratic

EFFECT = quadratic("accel", "f", "s²/m", 6e-3, "the attitude varies; it rectifies vibration")
