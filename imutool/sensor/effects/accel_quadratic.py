"""Nonlinearity of the accelerometer: + k f², per axis; it rectifies vibration."""

from __future__ import annotations

from imutool.sensor.effect import Effect, Stage, Theta, each_axis
from imutool.sensor.samples import SensorSamples


def _forward(samples: SensorSamples, k: Theta) -> SensorSamples:
    return samples.with_readings(accel=samples.accel * (1.0 + k * samples.accel))


EFFECT = Effect(
    "accel_quadratic",
    Stage.SENSOR,
    ("accel",),
    "accel += k * f^2",
    each_axis("s²/m", 6e-3),
    "the attitude varies; it rectifies vibration",
    _forward,
    trained=True,
)
