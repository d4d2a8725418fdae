"""Scale error of the accelerometer: f (1 + s), per axis."""

from __future__ import annotations

from imutool.sensor.effect import Effect, Stage, Theta, each_axis
from imutool.sensor.samples import SensorSamples


def _forward(samples: SensorSamples, s: Theta) -> SensorSamples:
    return samples.with_readings(accel=samples.accel * (1.0 + s))


EFFECT = Effect(
    "accel_scale",
    Stage.SENSOR,
    ("accel",),
    "accel += s * f",
    each_axis("-", 0.05),
    "the attitude varies; collinear with the bias otherwise",
    _forward,
    trained=True,
)
