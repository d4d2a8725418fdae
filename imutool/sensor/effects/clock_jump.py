"""A clock that jumps: from one time on its offset is another."""

from __future__ import annotations

import numpy as np

from imutool.sensor.effect import Effect, Parameter, Stage, Theta, residual
from imutool.sensor.samples import IdealMotion, SensorSamples, Times

PARTS, STARTS = 12, 4  # of the log, and the best times of how many of them


def _forward(taken_s: Times, theta: Theta) -> Times:
    """t_jump (s from the log's start), then the step (s): a sample at that very time is already beyond it."""
    return np.asarray(taken_s + theta[1] * (taken_s >= theta[0]))


def _starts(motion: IdealMotion, samples: SensorSamples) -> list[Theta]:
    """Times at which two offsets explain most of the gyro's residual, to first order, by part.

    An offset tau adds tau d omega/dt, so that sums up to each sample and from it on tell what any jump would bring.
    """
    error, _ = residual(motion, samples)
    slope = np.gradient(motion.sample(samples.stamp_s, samples.stamp_s).gyro, samples.stamp_s, axis=0)
    common = np.cumsum(np.sum(slope * (error - np.median(error, axis=0)), axis=1))
    power = np.cumsum(np.sum(slope**2, axis=1)) + np.finfo(np.float64).tiny
    before = common[:-1] / power[:-1]
    after = (common[-1] - common[:-1]) / (power[-1] - power[:-1] + np.finfo(np.float64).tiny)
    gain = before**2 * power[:-1] + after**2 * (power[-1] - power[:-1])
    best = [int(part[np.argmax(gain[part])]) for part in np.array_split(np.arange(len(gain)), PARTS) if len(part)]
    best = sorted(best, key=lambda row: -gain[row])[:STARTS]
    t_s = samples.stamp_s
    return [np.array([(t_s[row] + t_s[row + 1]) / 2.0, after[row] - before[row]]) for row in best]


EFFECT = Effect(
    "clock_jump",
    Stage.CLOCK,
    ("gyro", "accel"),
    "samples are taken at t + step from t_jump on",
    (Parameter("t_jump", "s", 30.0, begins=True), Parameter("step", "s", 0.05)),
    "it moves before and after",
    _forward,
    linear=False,
    starts=_starts,
)
