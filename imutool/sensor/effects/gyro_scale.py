"""Scale error of the gyro: omega (1 + s), per axis."""

from __future__ import annotations

from imutool.sensor.effect import Effect, Stage, Theta, each_axis
from imutool.sensor.samples import SensorSamples


def _forward(samples: SensorSamples, s: Theta) -> SensorSamples:
    return samples.with_readings(gyro=samples.gyro * (1.0 + s))


EFFECT = Effect(
    "gyro_scale",
    Stage.SENSOR,
    ("gyro",),
    "gyro += s * omega",
    each_axis("-", 0.1),
    "the axis turns",
    _forward,
    trained=True,
)
