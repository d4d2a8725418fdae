"""Quantization: readings are whole multiples of a least significant bit."""

from __future__ import annotations

import numpy as np

from imutool.array_types import Vectors
from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.samples import IdealMotion, SensorSamples

SAME = 1e-6  # of the largest reading: values no further apart are one value, told apart by rounding
FINE = 1e-3  # of the smallest step is none


def _forward(samples: SensorSamples, lsb: Theta) -> SensorSamples:
    gyro, accel = lsb.tolist()
    return samples.with_readings(
        np.rint(samples.gyro / gyro) * gyro if gyro else None,
        np.rint(samples.accel / accel) * accel if accel else None,
    )


def _smallest_step(values: Vectors) -> float:
    """Smallest step between distinct values of an axis; negligible where every axis is constant."""
    minimum = max(SAME * float(np.abs(values).max()), np.finfo(np.float64).tiny)
    steps = np.diff(np.sort(values, axis=0), axis=0)
    return float(steps[steps > minimum].min(initial=np.inf)) if (steps > minimum).any() else minimum


def _starts(_motion: IdealMotion, samples: SensorSamples) -> list[Theta]:
    """One sensor in steps, the other, both."""
    gyro, accel = _smallest_step(samples.gyro), _smallest_step(samples.accel)
    return [np.array(lsb) for lsb in ((gyro, FINE * accel), (FINE * gyro, accel), (gyro, accel))]


EFFECT = Effect(
    "quantization",
    Stage.CONVERTER,
    ("gyro", "accel"),
    "gyro = LSB round(gyro / LSB), and likewise accel",
    (Parameter("gyro_lsb", "rad/s", 1e-2, positive=True), Parameter("accel_lsb", "m/s²", 5e-2, positive=True)),
    "the least significant bit exceeds the noise",
    _forward,
    linear=False,
    starts=_starts,
)
