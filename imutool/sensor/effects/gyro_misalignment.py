"""Misalignment of the gyro's axes: off-diagonal 3x3 on omega.

A rotation common to both sensors is a mount rotation.
"""

from __future__ import annotations

from imutool.sensor.effect import Effect, Stage, Theta, each_pair, matrix
from imutool.sensor.samples import SensorSamples


def _forward(samples: SensorSamples, m: Theta) -> SensorSamples:
    return samples.with_readings(gyro=samples.gyro + samples.gyro @ matrix(m).T)


EFFECT = Effect(
    "gyro_misalignment",
    Stage.SENSOR,
    ("gyro",),
    "gyro += M omega, diag M = 0",
    each_pair("-", 0.05, diagonal=False),
    "two axes turn",
    _forward,
    trained=True,
)
