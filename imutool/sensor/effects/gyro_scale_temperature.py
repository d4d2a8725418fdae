"""Scale error of the gyro that follows a temperature of the log: omega (1 + s (T - T0))."""

from __future__ import annotations

from imutool.sensor.effect import Effect, Stage, Theta, each_axis
from imutool.sensor.effects.temperature import from_mean
from imutool.sensor.samples import SensorSamples


def _forward(samples: SensorSamples, s: Theta) -> SensorSamples:
    return samples.with_gain("gyro", from_mean(samples)[:, None] * s)


EFFECT = Effect(
    "gyro_scale_temperature",
    Stage.SENSOR,
    ("gyro",),
    "gyro += s (T - T0) omega",
    each_axis("1/K", 1e-3),
    "the temperature varies while the axis turns",
    _forward,
    needs=("temperature",),
)
