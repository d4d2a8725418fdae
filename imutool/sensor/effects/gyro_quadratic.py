"""Nonlinearity of the gyro in the rate: + k omega², per axis."""

from __future__ import annotations

from imutool.sensor.effect import Effect, Stage, Theta, each_axis
from imutool.sensor.samples import SensorSamples
from imutool.units import Sensor


def quadratic(sensor: Sensor, symbol: str, unit: str, plausible: float, observable_if: str) -> Effect:
    """Quadratic error of either sensor."""

    def forward(samples: SensorSamples, k: Theta) -> SensorSamples:
        return samples.with_gain(sensor, k * getattr(samples, sensor))

    name, equation = f"{sensor}_quadratic", f"{sensor} += k * {symbol}^2"
    return Effect(name, Stage.SENSOR, (sensor,), equation, each_axis(unit, plausible), observable_if, forward, trained=True)


EFFECT = quadratic("gyro", "omega", "s/rad", 0.1, "it turns fast")
