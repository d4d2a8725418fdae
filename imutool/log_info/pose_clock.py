"""Test of a stated delay of poses by a log's own motion, short as it may be."""

from __future__ import annotations

import numpy as np

from imutool.array_types import Float64
from imutool.cleaning.pose_delay import LONGEST_DELAY_S, StepIntegral, usable
from imutool.cleaning.samples import STEP_NS, STEP_S, Motion
from imutool.cleaning.truth import Truth, read_truth, turning
from imutool.cleaning.unit_evidence import POSES_APART_NS
from imutool.log_info.imu_samples import ImuSamples
from imutool.mcap_io.log import Log

FEWEST_TURNS, SEARCHED = 15, 1.0 / 6.0  # turns of a log, and share of it, in which another delay is searched
LAG_S, ALIKE_S = 0.02, 0.03  # steps of the search; between delays of one setup
APART = 1, 4  # poses of 0.1 s between which the body turns: over more, noise of the poses counts less
MIN_CORRELATION = 0.8  # under the best delay
CLEAR = 5.0  # logarithm of a likelihood ratio, with a sample each second


def contradicts_delay(log: Log, imu_topic: str, pose_topic: str, late_s: float) -> bool:
    """Whether poses that are not late by `late_s` fit the gyro clearly better.

    The correlation of the rates is that under the best rotation between the body of the poses and the gyro.
    """
    motion, truth = Motion(), read_truth(log, topics=[pose_topic])
    for samples in ImuSamples(log, imu_topic):
        motion.see(samples)
    if truth is None or len(motion.table()[0]) < FEWEST_TURNS:
        return False
    return any(_contradicts(motion, truth, late_s, spacing) for spacing in APART)


def _contradicts(motion: Motion, truth: Truth, late_s: float, spacing: int) -> bool:
    step, mean = motion.table()
    gyro = StepIntegral.of(step, mean[:, :3])
    longest_s = min(LONGEST_DELAY_S, SEARCHED * STEP_S * float(step[-1] - step[0]))
    lags, fits, spans_s = np.arange(-longest_s, longest_s + 1e-9, LAG_S), [], []
    for centre_s in (late_s, 0.0):
        first, last, rate = turning(truth._replace(t_ns=truth.t_ns - round(1e9 * centre_s)), spacing)
        use, first_s, last_s = usable(first, last, motion.middle_ns, step, POSES_APART_NS + (spacing - 1) * STEP_NS)
        inside = (first_s > longest_s + STEP_S * step[0]) & (last_s + longest_s < STEP_S * (step[-1] + 1))
        fits.append(np.zeros(len(lags)))
        if inside.sum() >= FEWEST_TURNS:
            means = (gyro.between(first_s[inside] - lag, last_s[inside] - lag) for lag in lags)
            fits[-1] = np.array([_aligned(rate[use[inside]], measured) for measured in means])
            spans_s.append(float(last_s[inside][-1] - first_s[inside][0]))
    fit_near_zero, best = float(fits[0][np.abs(lags) <= ALIKE_S].max()), float(np.max(fits))
    ratio = np.log((1.0 - min(fit_near_zero, best) ** 2) / max(1.0 - best**2, 1e-9))
    return best > MIN_CORRELATION and bool(0.5 * max(spans_s) * ratio > CLEAR)


def _aligned(a: Float64[np.ndarray, "n 3"], b: Float64[np.ndarray, "n 3"]) -> float:
    """Correlation of vectors under the best rotation."""
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    singular = np.linalg.svd(a.T @ b, compute_uv=False)
    return float(singular.sum() / np.sqrt(max(float((a**2).sum() * (b**2).sum()), 1e-300)))
