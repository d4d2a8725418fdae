"""Scale error of the gyro that grows with the time t from the start: omega (1 + s t)."""

from __future__ import annotations

from imutool.sensor.effect import Effect, Stage, Theta, each_axis
from imutool.sensor.samples import SensorSamples


def _forward(samples: SensorSamples, s: Theta) -> SensorSamples:
    return samples.with_gain("gyro", samples.stamp_s[:, None] * s)


EFFECT = Effect(
    "gyro_scale_drift",
    Stage.SENSOR,
    ("gyro",),
    "gyro += s t omega",
    each_axis("1/s", 1e-3),
    "the axis turns early and late",
    _forward,
)
