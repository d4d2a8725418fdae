"""Scale error of the accelerometer: f (1 + s), per axis."""

from __future__ import annotations

from imutool.sensor.effects.gyro_scale import scale

EFFECT = scale("accel", "f", 0.05, "the attitude varies; collinear with the bias otherwise")
