"""Misalignment of the accelerometer's axes: off-diagonal 3x3 on f."""

from __future__ import annotations

from imutool.sensor.effect import Effect, Stage, Theta, each_pair, matrix
from imutool.sensor.samples import SensorSamples


def _forward(samples: SensorSamples, m: Theta) -> SensorSamples:
    return samples.with_readings(accel=samples.accel + samples.accel @ matrix(m).T)


EFFECT = Effect(
    "accel_misalignment",
    Stage.SENSOR,
    ("accel",),
    "accel += M f, diag M = 0",
    each_pair("-", 0.05, diagonal=False),
    "the attitude varies",
    _forward,
    trained=True,
)
