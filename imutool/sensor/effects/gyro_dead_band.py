"""Dead band of the gyro: it reads zero where it turns slowly.

Some drivers do so to hide the noise of a sensor at rest. Faster readings are whole, or lose the width (a dead zone).
"""

from __future__ import annotations

import numpy as np

from imutool.sensor.effect import Effect, Parameter, Stage, Theta, residual
from imutool.sensor.samples import IdealMotion, SensorSamples

STEEP = 0.02  # of the width, in which a reading sets in: a derivative needs an edge that some samples lie on
WIDTHS = 20  # that differ: halves and doubles of one have other samples in the band
MIN_RAD_S = 1e-6  # of a start: no digit of any gyro is finer
LOG_STEP = 0.02  # of the derivative by the width
ZONE = "zone"  # variant in which faster readings lose the width
LOST = Parameter("lost", "-", 1.0, null_value=0.0)  # of the width, by faster readings


def _forward(samples: SensorSamples, theta: Theta) -> SensorSamples:
    width, lost = theta[0], theta[1] if len(theta) > 1 else LOST.null_value
    if not width:
        return samples
    size = np.abs(samples.gyro)
    past = np.clip((size / width - 1.0) / STEEP + 0.5, 0.0, 1.0)
    return samples.with_readings(np.sign(samples.gyro) * np.maximum(size - lost * width, 0.0) * past)


def _starts(motion: IdealMotion, samples: SensorSamples) -> list[Theta]:
    """The width below which zero explains the samples better than the rate, by most squares.

    With a dead zone that is twice its width.
    """
    error, _ = residual(motion, samples)
    ideal = motion.sample(samples.stamp_s, samples.stamp_s).gyro
    error = error - np.median(error, axis=0)
    rate, better = np.abs(ideal).ravel(), (error**2 - (error + ideal) ** 2).ravel()
    order = np.argsort(rate)
    width = max(float(rate[order][np.argmax(np.cumsum(better[order]))]), MIN_RAD_S)
    return [np.array([width, LOST.null_value]), np.array([0.5 * width, LOST.plausible])]


EFFECT = Effect(
    "gyro_dead_band",
    Stage.SENSOR,
    ("gyro",),
    "gyro = omega - lost width sign(omega) where |omega| > width, else 0, on every axis",
    (Parameter("width", "rad/s", 0.05, positive=True, step=LOG_STEP), LOST),
    "it turns slowly and quickly",
    _forward,
    linear=False,
    starts=_starts,
    alternatives=lambda _: WIDTHS,
    jumps=True,
)
