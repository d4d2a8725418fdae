"""A clock that jumps: from one time on its offset is another."""

from __future__ import annotations

import numpy as np

from imutool.array_types import Float64
from imutool.sensor.effect import Effect, Parameter, Stage, Theta, residual
from imutool.sensor.samples import IdealMotion, SensorSamples, Times

Column = Float64[np.ndarray, " n"]
Steps = Float64[np.ndarray, " n-1"]
NOTHING = 1e-9  # of the squared slopes: what rounding leaves where nothing has moved yet, or nothing moves any more
PARTS, STARTS, ON_TREND = 12, 4, 1  # of the log; the best times of how many of them, with two offsets and on a trend


def _forward(taken_s: Times, theta: Theta) -> Times:
    """t_jump (s from the log's start), then the step (s): a sample at that very time is already beyond it."""
    return np.asarray(taken_s + theta[1] * (taken_s >= theta[0]))


def _starts(motion: IdealMotion, samples: SensorSamples) -> list[Theta]:
    """Times at which a step of the offset explains most of the gyro's residual, to first order, by part.

    An offset tau adds tau d omega/dt, so that sums up to each sample and from it on tell what any jump would bring. The last of
    them are steps on a trend: with a clock that also runs fast, two offsets do not show when it jumps.
    """
    error, _ = residual(motion, samples)
    slope = np.gradient(motion.sample(samples.stamp_s, samples.stamp_s).gyro, samples.stamp_s, axis=0)
    common = np.sum(slope * (error - np.median(error, axis=0)), axis=1)
    power = np.sum(slope**2, axis=1) + np.finfo(np.float64).tiny
    t_s, starts = samples.stamp_s, list[Theta]()
    for degree, count in ((0, STARTS), (1, ON_TREND)):
        step, gain = _steps(np.vander((t_s - t_s[0]) / np.ptp(t_s), degree + 1), common, power)
        best = [int(part[np.argmax(gain[part])]) for part in np.array_split(np.arange(len(gain)), PARTS) if len(part)]
        best = sorted(best, key=lambda row: -gain[row])[:count]
        size = 0.0 if degree else 1.0  # a trend that is in the fit by now has changed the step
        starts += [np.array([(t_s[row] + t_s[row + 1]) / 2.0, size * step[row]]) for row in best]
    return starts


def _steps(trend: Float64[np.ndarray, "n p"], common: Column, power: Column) -> tuple[Steps, Steps]:
    """Size of the step after each sample but the last, on a trend of the offset, and the squares that it explains."""
    whole = np.linalg.pinv(trend.T @ (power[:, None] * trend))
    after = np.cumsum((power[:, None] * trend)[::-1], axis=0)[::-1][1:]
    residual = np.cumsum(common[::-1])[::-1][1:] - after @ whole @ (trend.T @ common)
    own = np.cumsum(power[::-1])[::-1][1:] - np.einsum("np,pq,nq->n", after, whole, after)
    step = np.where(own > NOTHING * power.sum(), residual, 0.0) / np.maximum(own, NOTHING * power.sum())
    return step, step * residual


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
