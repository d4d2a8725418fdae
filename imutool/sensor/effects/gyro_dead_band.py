"""Dead band of the gyro: it reads zero where it turns slowly.

Some drivers do so to hide the noise of a sensor at rest.
"""

from __future__ import annotations

import numpy as np

from imutool.sensor.effect import Effect, Parameter, Stage, Theta, residual
from imutool.sensor.samples import IdealMotion, SensorSamples

STEEP = 0.02  # of the width, in which a reading sets in: a derivative needs an edge that some samples lie on
WIDTHS = 20  # that differ: halves and doubles of one have other samples in the band
LEAST_RAD_S = 1e-6  # of a start: no digit of any gyro is finer
LOG_STEP = 0.02  # of the derivative by the width


def _forward(samples: SensorSamples, width: Theta) -> SensorSamples:
    if not width[0]:
        return samples
    past = np.clip((np.abs(samples.gyro) / width[0] - 1.0) / STEEP + 0.5, 0.0, 1.0)
    return samples.with_readings(samples.gyro * past)


def _starts(motion: IdealMotion, samples: SensorSamples) -> list[Theta]:
    """The width below which zero explains the samples better than the rate, by most squares."""
    error, _ = residual(motion, samples)
    ideal = motion.sample(samples.stamp_s, samples.stamp_s).gyro
    error = error - np.median(error, axis=0)
    rate, better = np.abs(ideal).ravel(), (error**2 - (error + ideal) ** 2).ravel()
    order = np.argsort(rate)
    return [np.array([max(float(rate[order][np.argmax(np.cumsum(better[order]))]), LEAST_RAD_S)])]


EFFECT = Effect(
    "gyro_dead_band",
    Stage.SENSOR,
    ("gyro",),
    "gyro = omega where |omega| > width, else 0, on every axis",
    (Parameter("width", "rad/s", 0.05, positive=True, step=LOG_STEP),),
    "it turns slowly and quickly",
    _forward,
    linear=False,
    starts=_starts,
    alternatives=lambda _: WIDTHS,
    jumps=True,
)
