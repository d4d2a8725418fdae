"""Misalignment of the accelerometer's axes: off-diagonal 3x3 on f."""

from __future__ import annotations

from imutool.sensor.effects.gyro_misalignment import misalignment

EFFECT = misalignment("accel", "f", "the attitude varies")
