"""Temperature: biases that follow a temperature channel of the log."""

from __future__ import annotations

import numpy as np

from imutool.array_types import Float64
from imutool.errors import DataError
from imutool.sensor.effect import Effect, Stage, Theta, each_axis
from imutool.sensor.samples import SensorSamples

NO_CHANNEL = "Give a log that has it; a diagnosis with `close` takes the channel of the recording"
OF_IMU = ("imu", "gyro", "accel")  # in the name of a channel: a battery or a motor has a temperature, too


def from_mean(samples: SensorSamples) -> Float64[np.ndarray, " n"]:
    """Temperature less its mean over the samples.

    Of several temperatures that of an IMU counts, by its name, else the first by name.

    Raises:
        DataError: no channel with a temperature in its name.
    """
    names = [name for name in samples.channels if "temperature" in name.lower()]
    if not names:
        expected = "a channel with temperature in its name"
        raise DataError("no temperature channel", where="temperature", expected=expected, fix=NO_CHANNEL)
    T = samples.channels[min(names, key=lambda name: (not any(word in name.lower() for word in OF_IMU), name))]
    return np.asarray(T - T.mean())


def _forward(samples: SensorSamples, k: Theta) -> SensorSamples:
    """k of the gyro, then of the accelerometer; T0 is the mean of the channel."""
    gyro, accel = (np.outer(own, from_mean(samples)).T for own in (k[:3], k[3:]))
    return samples.with_readings(samples.gyro + gyro, samples.accel + accel)


EFFECT = Effect(
    "temperature",
    Stage.SENSOR,
    ("gyro", "accel"),
    "gyro += k (T - T0), accel += l (T - T0)",
    each_axis("rad/s per K", 1e-3, "gyro_") + each_axis("m/s² per K", 1e-2, "accel_"),
    "the temperature varies",
    _forward,
    needs=("temperature",),
)
