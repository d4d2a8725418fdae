"""Warm-up of the accelerometer: + A (1 - exp(-t/tau)), t from the log's start."""

from __future__ import annotations

from imutool.sensor.effects.gyro_bias_drift import warm_up

EFFECT = warm_up("accel", "m/s²", 0.5)
