"""Asymmetry of the gyro's scale factor: + a/2 |omega|, per axis.

a is the gain of positive readings less that of negative ones, as a share of their mean.
IEEE 528 and 952 (scale factor asymmetry); of an accelerometer the term K1'/2 |f| of IEEE 1293. A reading that never changes
its sign has a scale instead.
"""

from __future__ import annotations

import numpy as np

from imutool.sensor.effect import Effect, Stage, Theta, each_axis
from imutool.sensor.samples import SensorSamples
from imutool.units import Sensor


def scale_asymmetry(sensor: Sensor, symbol: str, plausible: float, observable_if: str) -> Effect:
    """Asymmetry of either sensor's scale factor."""

    def forward(samples: SensorSamples, a: Theta) -> SensorSamples:
        return samples.with_added(sensor, 0.5 * a * np.abs(getattr(samples, sensor)))

    name, equation = f"{sensor}_scale_asymmetry", f"{sensor} += a / 2 |{symbol}|"
    return Effect(name, Stage.SENSOR, (sensor,), equation, each_axis("-", plausible), observable_if, forward)


EFFECT = scale_asymmetry("gyro", "omega", 0.1, "the axis turns both ways")
