"""Saturation: readings are clipped at a limit, of a sensor or of one axis (`gyro_limit_x`)."""

from __future__ import annotations

import math
from collections.abc import Container
from dataclasses import replace

import numpy as np

from imutool.array_types import Float64
from imutool.sensor.effect import Effect, Parameter, Stage, Theta, each_axis
from imutool.sensor.samples import IdealMotion, SensorSamples
from imutool.units import AXES, SENSORS, Sensor

NEVER = 100.0  # times the largest reading is not reached


def _forward(samples: SensorSamples, limits: Theta) -> SensorSamples:
    """Readings between the limits of the sensors, and of single axes behind these."""
    by_axis = np.append(limits, np.full(6, np.inf))[2:8].reshape(2, 3)
    gyro, accel = np.minimum(limits[:2, None], by_axis)
    return samples.with_readings(
        None if np.isinf(gyro).all() else np.clip(samples.gyro, -gyro, gyro),
        None if np.isinf(accel).all() else np.clip(samples.accel, -accel, accel),
    )


def of_form(effect: Effect, names: Container[str]) -> Effect:
    """The saturation with limits of axes if one is named, any other effect itself."""
    of_axes = effect.name == EFFECT.name and any(p.name in names for p in OF_AXES)
    return replace(effect, parameters=(*effect.parameters, *OF_AXES)) if of_axes else effect


def _starts(_motion: IdealMotion, samples: SensorSamples) -> list[Theta]:
    """Limits of one sensor, the other, both: the largest readings, for these are limits if reached."""
    gyro, accel = (float(np.abs(values).max()) or 1.0 for values in (samples.gyro, samples.accel))
    return [np.array(limit) for limit in ((gyro, NEVER * accel), (NEVER * gyro, accel), (gyro, accel))]


def of_limit(key: str) -> tuple[str, Sensor, slice]:
    """Parameter, sensor and columns of the limit of a sensor or an axis (`gyro_x`)."""
    k = next(k for k, sensor in enumerate(SENSORS) if key.startswith(sensor))
    axis = key.removeprefix(SENSORS[k])
    first = 3 * k + (AXES.index(axis[1:]) if axis else 0)
    return f"{SENSORS[k]}_limit{axis}", SENSORS[k], slice(first, first + (1 if axis else 3))


class BiasedClip:
    """Readings between two limits, the bias being part of what is read."""

    def __init__(self, sensor: int, bias: Float64[np.ndarray, "3"]) -> None:
        self.sensor, self.bias = sensor, bias

    def __call__(self, read: SensorSamples, theta: Theta) -> SensorSamples:
        """Samples between plus and minus the limit."""
        x = read.gyro if self.sensor == 0 else read.accel
        out = np.clip(x + self.bias, -theta[0], theta[0]) - self.bias
        return read.with_readings(gyro=out) if self.sensor == 0 else read.with_readings(accel=out)


OF_AXES = tuple(
    replace(p, positive=True, null_value=math.inf)
    for p in (*each_axis("rad/s", 10.0, "gyro_limit_"), *each_axis("m/s²", 80.0, "accel_limit_"))
)
EFFECT = Effect(
    "saturation",
    Stage.CONVERTER,
    ("gyro", "accel"),
    "gyro = clip(gyro, -L, L), accel = clip(accel, -K, K)",
    (
        Parameter("gyro_limit", "rad/s", 10.0, positive=True, null_value=math.inf),
        Parameter("accel_limit", "m/s²", 80.0, positive=True, null_value=math.inf),
    ),
    "the limit is reached",
    _forward,
    linear=False,
    starts=_starts,
)
