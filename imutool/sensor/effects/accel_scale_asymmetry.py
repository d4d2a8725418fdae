"""Asymmetry of the accelerometer's scale factor: + a/2 |f|, per axis (IEEE 1293, K1')."""

from __future__ import annotations

from imutool.sensor.effects.gyro_scale_asymmetry import scale_asymmetry

EFFECT = scale_asymmetry("accel", "f", 0.05, "the force on the axis changes its sign")
