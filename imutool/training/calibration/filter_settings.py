"""Bias filter settings from training logs: speed of the body, error of a turn."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from imutool.bias.model import BiasModel
from imutool.bias_start.initial_bias import UNKNOWN_BODY
from imutool.inertial.inertial_filter import FilterSettings
from imutool.training.training_windows import Pool

VEHICLE_M2_S = 1.0  # density of velocity above which the filter's usual bound is not believed
SPEED_WINDOWS_S = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0)
MIN_TURN_ERROR = 1e-3  # left-out logs of TUM-VI are worse with less, others hardly better
MAX_TURN_ERROR = FilterSettings().gyro_scale  # and worse with more, for the errors of blocks are not independent
AT_ONCE = 1 << 14  # samples: roots take some hundred bytes each


def filter_settings(model: BiasModel, pool: Pool) -> dict[str, Any]:
    """Entries of a model card."""
    return _speed(pool) | _turn_error(model, pool)


def _speed(pool: Pool) -> dict[str, Any]:
    """Speed of the training logs, if they move as vehicles do.

    The filter takes velocity for noise of the density 2 v^2 tau, with its correlation time tau, so its mean over a longer time
    T has the variance 2 v^2 tau / T. The largest density over all T counts. Poses without positions show no speed.
    """
    if "accel" not in pool.sensors:
        return {"speed": UNKNOWN_BODY}
    densities = []
    for window_s in SPEED_WINDOWS_S:
        n = pool.samples(window_s)
        first = pool.starts(n, "all", hop=n)
        moved = (pool.p_wb[first + n] - pool.p_wb[first]).square().mean(1) / window_s
        of_log = [float(moved[pool.log[first] == log].mean()) for log in set(pool.log[first].tolist())]
        densities.append(float(np.mean(of_log or [0.0])))
    square, density = float(pool.v_w[pool.trusted].square().mean()), max(densities)
    if density <= VEHICLE_M2_S:
        return {}
    return {"speed": {"speed_m_s": math.sqrt(square), "speed_correlation_s": density / (2.0 * square)}}


def _turn_error(model: BiasModel, pool: Pool) -> dict[str, float]:
    """Error of a turn as a share of it, by the calibration's covariance in the motion of the training logs.

    A constant part of it is a bias, which the filter estimates. The filter takes the errors of its half seconds for
    independent. They are not, so the error of all axes together counts for each axis.
    """
    error = turned = 0.0
    for log in range(len(pool.names)):
        if (root_at := model.calibration_covariance()) is None:
            return {}
        rows, total = np.flatnonzero((pool.log == log).cpu().numpy()), np.zeros(())
        for first in range(0, len(rows), AT_ONCE):
            some = rows[first : first + AT_ONCE]
            t_s, gyro, accel = (x[some].cpu().double().numpy() for x in (pool.t, pool.gyro, pool.accel))
            if (S := root_at(t_s, gyro, accel).get("gyro")) is None:
                return {}
            total, error = total + S.sum(axis=0), error + float((S**2).sum())
        error -= float(np.sum(np.square(total)) / len(rows))
        turned += len(rows) * float(pool.gyro[rows].var(dim=0, correction=0).sum())
    share = math.sqrt(max(error, 0.0) / turned) if turned > 0.0 else math.inf
    return {"turn_error": min(max(share, MIN_TURN_ERROR), MAX_TURN_ERROR)}
