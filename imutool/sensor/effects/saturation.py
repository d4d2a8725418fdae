"""Saturation: readings are clipped at a limit."""

from __future__ import annotations

import math

import numpy as np

from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.samples import IdealMotion, SensorSamples

NEVER = 100.0  # times the largest reading is not reached


def _forward(samples: SensorSamples, limit: Theta) -> SensorSamples:
    gyro, accel = (None if math.isinf(maximum) else maximum for maximum in limit.tolist())
    return samples.with_readings(
        None if gyro is None else np.clip(samples.gyro, -gyro, gyro),
        None if accel is None else np.clip(samples.accel, -accel, accel),
    )


def _starts(_motion: IdealMotion, samples: SensorSamples) -> list[Theta]:
    """Limits of one sensor, the other, both: the largest readings, for these are limits if reached."""
    gyro, accel = (float(np.abs(values).max()) or 1.0 for values in (samples.gyro, samples.accel))
    return [np.array(limit) for limit in ((gyro, NEVER * accel), (NEVER * gyro, accel), (gyro, accel))]


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
