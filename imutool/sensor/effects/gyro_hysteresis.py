"""Hysteresis of the gyro: its reading follows the rate a width behind.

It stays where it is until the rate has moved on by that width.
The play operator, y = clip(y before, omega - width, omega + width) (Krasnosel'skii and Pokrovskii, Systems with Hysteresis,
1989, ch. 1); hysteresis error: IEEE 528. It lags by a width, and a `gyro_delay` by a time. Of a material that gives, a share of
the reading does so alone, from a wide width on: one element of Prandtl's model, and nearly that of Bouc and Wen.
"""

from __future__ import annotations

import numpy as np

from imutool.array_types import Vectors
from imutool.sensor.effect import Effect, Parameter, Stage, Theta, residual
from imutool.sensor.samples import IdealMotion, SensorSamples
from imutool.units import Sensor

MIN = 1e-4  # of the plausible width, where a fit starts at least
LOG_STEP = 0.02  # of the derivative by the width
SHARE = Parameter("share", "-", 0.3, null_value=1.0)  # of the reading that lags


def hysteresis(sensor: Sensor, symbol: str, unit: str, plausible: float, observable_if: str) -> Effect:
    """Hysteresis of either sensor, of one width and share on all axes."""

    def forward(samples: SensorSamples, theta: Theta) -> SensorSamples:
        ideal, share = getattr(samples, sensor), float(theta[1]) if len(theta) > 1 else 1.0
        return samples.with_readings(**{sensor: ideal + share * (play(ideal, float(theta[0])) - ideal)})

    def starts(motion: IdealMotion, samples: SensorSamples) -> list[Theta]:
        """The width by which the samples lag on the way up and on the way down."""
        error, ideal = error_and_ideal(sensor, motion, samples)
        behind = -float(np.mean(error * np.sign(np.gradient(ideal, axis=0))))
        return [np.array([max(behind, MIN * plausible), SHARE.null_value])]

    return Effect(
        f"{sensor}_hysteresis",
        Stage.SENSOR,
        (sensor,),
        f"{sensor}(t) = {symbol} where it moves by less than width, else width behind it, on every axis",
        (Parameter("width", unit, plausible, positive=True, step=LOG_STEP), SHARE),
        observable_if,
        forward,
        linear=False,
        starts=starts,
    )


def error_and_ideal(sensor: Sensor, motion: IdealMotion, samples: SensorSamples) -> tuple[Vectors, Vectors]:
    """Error of the readings without its mean, and the ideal readings."""
    error = residual(motion, samples)[0 if sensor == "gyro" else 1]
    return error - error.mean(axis=0), getattr(motion.sample(samples.stamp_s, samples.stamp_s), sensor)


def play(x: Vectors, width: float) -> Vectors:
    """Play of columns: from turn to turn of a column, it is what the last turn left, clipped.

    Two clips in a row are one clip, so that those of all turns take as many steps as their number has binary digits.
    """
    out = np.empty_like(x)
    for column, reading in zip(x.T, out.T, strict=True):
        rises = np.diff(column) > 0.0
        turns = np.concatenate([[0], np.flatnonzero(rises[1:] != rises[:-1]) + 1])
        low, high = column[turns] - width, column[turns] + width
        low[0] = high[0] = column[0]
        step = 1
        while step < len(turns):
            low[step:], high[step:] = (np.clip(left[:-step], low[step:], high[step:]) for left in (low, high))
            step *= 2
        np.clip(np.repeat(low, np.diff(np.append(turns, len(column)))), column - width, column + width, out=reading)
    return out


EFFECT = hysteresis("gyro", "omega", "rad/s", 0.02, "it turns to and fro")
