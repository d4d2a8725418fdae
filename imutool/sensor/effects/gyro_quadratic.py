"""Nonlinearity of the gyro in the rate: + k omega², per axis."""

from __future__ import annotations

from imutool.sensor.effect import Effect, Stage, Theta, each_axis
from imutool.sensor.samples import SensorSamples


def _forward(samples: SensorSamples, k: Theta) -> SensorSamples:
    return samples.with_readings(gyro=samples.gyro * (1.0 + k * samples.gyro))


EFFECT = Effect(
    "gyro_quadratic",
    Stage.SENSOR,
    ("gyro",),
    "gyro += k * omega^2",
    each_axis("s/rad", 0.1),
    "it turns fast",
    _forward,
    trained=True,
)
