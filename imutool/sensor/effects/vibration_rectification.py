"""What vibration leaves in the mean: + K v², v² the power of the specific force above 1.6 Hz, over half a second.

Known of accelerometers as vibration rectification error and of gyros as g²-sensitivity (IEEE 1293, 952): a sensor that reads
one bias on the ground and another with its motors running.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from imutool.sensor.effect import Effect, Stage, Theta, each_pair
from imutool.sensor.linear_effect import LinearEffect, full, per_pair
from imutool.sensor.readings import SensorSamples
from imutool.sensor.signals import POWER_S, SLOW_S, VIBRATION, low_pass
from imutool.units import Sensor

SENSORS: tuple[Sensor, ...] = ("gyro", "accel")
PLAUSIBLE = {"gyro": ("rad/s per (m/s²)²", 1e-3), "accel": ("s²/m", 2e-2)}


def effect(sensor: Sensor) -> LinearEffect:
    """K: seen where vibration comes and goes; collinear with the bias otherwise."""
    pairs = per_pair(*PLAUSIBLE[sensor])
    return LinearEffect("vibration_rectification", sensor, f"{sensor} += K v^2", pairs, VIBRATION, full())


def _power(read: SensorSamples) -> Float64[np.ndarray, "n 3"]:
    """As `SignalFilter` has it, over samples at their mean rate: (m/s²)² per axis."""
    period_s = (read.stamp_s[-1] - read.stamp_s[0]) / (len(read.stamp_s) - 1)
    slow, power = -np.expm1(-period_s / np.array([SLOW_S, POWER_S]))
    mean = low_pass(read.accel, slow, read.accel[0])
    before = np.concatenate([read.accel[:1], mean[:-1]])
    return low_pass((read.accel - before) ** 2, power, np.zeros(3))


def _forward(read: SensorSamples, k: Theta) -> SensorSamples:
    """K of the gyro, then of the accelerometer."""
    power = _power(read)
    return read.but(read.gyro + power @ k[:9].reshape(3, 3).T, read.accel + power @ k[9:].reshape(3, 3).T)


EFFECT = Effect(
    "vibration_rectification",
    Stage.SENSOR,
    SENSORS,
    "gyro += K v^2, accel += L v^2",
    each_pair(*PLAUSIBLE["gyro"], before="gyro_") + each_pair(*PLAUSIBLE["accel"], before="accel_"),
    "vibration comes and goes; collinear with the bias otherwise",
    _forward,
)
