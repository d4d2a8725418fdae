"""Rectified vibration: + K v², v² the force's power above 1.6 Hz over half a second.

Known of accelerometers as vibration rectification error and of gyros as g²-sensitivity (IEEE 1293, 952): a sensor that reads
one bias on the ground and another with its motors running.
"""

from __future__ import annotations

from imutool.sensor.effect import Effect, Stage, Theta, each_pair
from imutool.sensor.samples import SensorSamples


def _forward(samples: SensorSamples, k: Theta) -> SensorSamples:
    """K of the gyro, then of the accelerometer."""
    gyro, accel = ((own.reshape(3, 3) @ samples.vibration.T).T for own in (k[:9], k[9:]))
    return samples.with_readings(samples.gyro + gyro, samples.accel + accel)


EFFECT = Effect(
    "vibration_rectification",
    Stage.SENSOR,
    ("gyro", "accel"),
    "gyro += K v^2, accel += L v^2",
    each_pair("rad/s per (m/s²)²", 1e-3, before="gyro_") + each_pair("s²/m", 2e-2, before="accel_"),
    "vibration comes and goes; collinear with the bias otherwise",
    _forward,
    trained=True,
)
