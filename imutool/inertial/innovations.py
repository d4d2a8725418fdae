"""Innovations of velocity or position: the share of a correction, and stops they refute."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from imutool.array_types import Float64
from imutool.inertial.inertial_filter import SIZE, STILL, Step
from imutool.inertial.stationary import MAX_SHAKING

STUDENT = 7.0  # degrees of freedom of the likelihood, so that one jolt does not decide
SURPRISING = 7.81  # chi-square of three that one innovation in twenty exceeds: above, it gets less weight
LAGS = 6  # blocks over which innovations depend on each other: the bounded velocity is no white noise
MIN_DRIVEN_M_S, DRIVEN = 0.5, 11.3  # speed, and its chi-square, which a body at rest exceeds once in a hundred times
DRIVEN_M_S = 2.0  # speed that is no error of the filter
TURNS = 25.0  # chi-square of a rate against the bias so far, which no vibration makes


class Innovations(NamedTuple):
    """Innovations by block in body axes, and their covariances.

    They are of the velocity, or of the position where the filter has a bound for it (`room_m`).
    """

    e: Float64[np.ndarray, "m 3"]
    S: Float64[np.ndarray, "m 3 3"]

    @property
    def chi_square(self) -> Float64[np.ndarray, " m"]:
        """Chi-square e^T S^-1 e of each block."""
        return np.asarray((self.e * np.linalg.solve(self.S, self.e[..., None])[..., 0]).sum(axis=1))

    @property
    def log_likelihood(self) -> Float64[np.ndarray, " m"]:
        """Student's log-likelihood of each block."""
        fit = -0.5 * (STUDENT + 3.0) * np.log1p(self.chi_square / STUDENT)
        return np.asarray(fit - 0.5 * np.linalg.slogdet(self.S)[1])


def innovations(steps: Iterable[Step]) -> Innovations:
    """Innovations of each step, in body axes; none of a step over a gap."""
    measured = [(step.expected.R_wb.T, *step.innovation) for step in steps if step.innovation is not None]
    R_bw, v, S = (np.array([row[k] for row in measured]).reshape(-1, *shape) for k, shape in enumerate(((3, 3), (3,), (3, 3))))
    return Innovations((R_bw @ v[..., None])[..., 0], R_bw @ S @ R_bw.transpose(0, 2, 1))


class DriveDetector:
    """Detector of steady drives among blocks that look like rest.

    A body that drives shakes more than at a stop before, and by the filter has speed, or a rate other than the bias so far. An
    engine hides that this rate is not constant.
    """

    def __init__(self) -> None:
        self._calmest = np.full(2, np.inf)

    def __call__(self, samples: Float64[np.ndarray, "n 6"], step: Step) -> bool:
        """Whether a body drives, from the samples of a block and the filter's step of it at rest."""
        noise = np.sqrt(samples.var(axis=0).reshape(2, 3).sum(axis=1))
        shakes, self._calmest = bool((noise > MAX_SHAKING * self._calmest).any()), np.minimum(noise, self._calmest)
        if not shakes or step.innovation is None:
            return False
        rate = samples[:, :3].mean(axis=0) - step.expected.rest_bias(True)[:3]
        of_rate = STILL @ step.expected.P[:SIZE, :SIZE] @ STILL.T + np.diag(samples[:, :3].var(axis=0) / len(samples))
        if rate @ np.linalg.solve(of_rate, rate) > TURNS:
            return True
        v_w, S = step.innovation
        speed = float(np.linalg.norm(v_w))
        return speed > DRIVEN_M_S or bool(speed > MIN_DRIVEN_M_S and v_w @ np.linalg.solve(S, v_w) > DRIVEN)


class Share(NamedTuple):
    """Share of a correction that innovations ask for, with its deviation; infinite if unknown."""

    value: float
    std: float
    filter_std: float = 0.0  # deviation by the filter's covariances alone


def share_of_correction(without: Innovations, corrected: Innovations) -> Share:
    """Share of a correction that best explains the innovations, by weighted least squares.

    A correction changes the innovations e of the raw samples by d to those of the corrected. The share a minimises
    sum (e - a d)^T S^-1 (e - a d): the sensor's own correction has 1, one of an unrelated sensor 0, and above one half a
    correction does more good than harm. The deviation allows for dependent innovations (Newey and West, "A simple, positive
    semi-definite, heteroskedasticity and autocorrelation consistent covariance matrix", Econometrica 1987).
    """
    S = 0.5 * (without.S + corrected.S)
    d = without.e - corrected.e
    weight = 1.0 / np.maximum(1.0, np.minimum(without.chi_square, corrected.chi_square) / SURPRISING)
    Sd = weight[:, None] * np.linalg.solve(S, d[..., None])[..., 0]
    size = float((d * Sd).sum())
    if size <= 0.0:
        return Share(0.0, math.inf, math.inf)
    value = float((without.e * Sd).sum()) / size
    score = ((without.e - value * d) * Sd).sum(axis=1)
    variance = score @ score
    for lag in range(1, min(LAGS, len(score) - 1) + 1):
        variance += 2.0 * (1.0 - lag / (LAGS + 1.0)) * (score[lag:] @ score[:-lag])
    return Share(value, math.sqrt(max(float(variance), 0.0)) / size, 1.0 / math.sqrt(size))
