"""Sensitivity of the gyro to specific force, as it is and not as it is read: + G f."""

from __future__ import annotations

from imutool.sensor.effect import Effect, Stage, Theta, each_pair
from imutool.sensor.samples import SensorSamples


def _forward(samples: SensorSamples, g: Theta) -> SensorSamples:
    return samples.with_readings(gyro=samples.gyro + (g.reshape(3, 3) @ samples.at.accel.T).T)


EFFECT = Effect(
    "gyro_g_sensitivity",
    Stage.SENSOR,
    ("gyro",),
    "gyro += G f",
    each_pair("rad/s per m/s²", 3e-3),
    "attitude or acceleration varies; collinear with the bias at rest",
    _forward,
    trained=True,
)
