"""What vibration leaves in the mean: + K v², v² the power of the specific force above 1.6 Hz, over half a second.

Known of accelerometers as vibration rectification error and of gyros as g²-sensitivity (IEEE 1293, 952): a sensor that reads
one bias on the ground and another with its motors running.
"""

from __future__ import annotations

from imutool.physics.effects._base import Effect, Sensor, full, per_pair
from imutool.physics.signals import VIBRATION

SENSORS: tuple[Sensor, ...] = ("gyro", "accel")
PLAUSIBLE = {"gyro": ("rad/s per (m/s²)²", 1e-3), "accel": ("s²/m", 2e-2)}


def effect(sensor: Sensor) -> Effect:
    """K: seen where vibration comes and goes; collinear with the bias otherwise."""
    pairs = per_pair(*PLAUSIBLE[sensor])
    return Effect("vibration_rectification", sensor, f"{sensor} += K v^2", pairs, VIBRATION, full())
