"""Misalignment of the gyro's axes: off-diagonal 3x3 on omega.

A rotation common to both sensors is a mount rotation.
"""

from __future__ import annotations

from imutool.sensor.effect import Effect, Stage, Theta, each_pair, matrix
from imutool.sensor.samples import SensorSamples
from imutool.units import Sensor


def misalignment(sensor: Sensor, symbol: str, observable_if: str) -> Effect:
    """Misalignment of either sensor."""

    def forward(samples: SensorSamples, m: Theta) -> SensorSamples:
        return samples.with_added(sensor, (matrix(m) @ getattr(samples, sensor).T).T)

    parameters = each_pair("-", 0.05, diagonal=False)
    equation = f"{sensor} += M {symbol}, diag M = 0"
    return Effect(f"{sensor}_misalignment", Stage.SENSOR, (sensor,), equation, parameters, observable_if, forward, trained=True)


EFFECT = misalignment("gyro", "omega", "two axes turn")
