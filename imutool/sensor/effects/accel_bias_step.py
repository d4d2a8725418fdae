"""Step of the accelerometer's bias: + A from one moment on."""

from __future__ import annotations

from imutool.sensor.effects.gyro_bias_step import bias_step

EFFECT = bias_step("accel", "m/s²", 0.5)
