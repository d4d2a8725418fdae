"""Logs that contradict the others, by axes, unit or mount, and poses that are smoothed."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from imutool.array_types import Float64
from imutool.bias.log_binding import turned_axes
from imutool.bias_start.prior_width import MAX_CHANGE
from imutool.errors import DataError
from imutool.geometry import so3
from imutool.inertial.windows import HUBER_MEDIANS, huber_weight, rotation_residual
from imutool.recording import nanoseconds
from imutool.training.bias_spread import TURN_ON_STD
from imutool.training.calibration.effect_selection import Calibration, parameter_columns
from imutool.training.settings import LINEAR
from imutool.training.training_windows import Pool
from imutool.units import COLUMNS, Sensor

CONTRADICTS = 0.35  # of the error without a matrix, left by a log's own: 30 s without any matrix keep 0.43 at least
MAX_LEFT = (
    0.02  # share of chi-square that turned axes leave; of made-up sensors that turn on 10 to 20 mrad/s apart, 1 in 5000 has it
)
SMOOTHED_S, SLOPE_S, MAX_WINDOWS = 0.5, 0.04, 4000  # windows whose ends show smoothing, half the time of a slope, how many
SURE, TOO_SMALL = 5.0, 0.03  # deviations, and share of a turn; of EuRoC, TUM-VI, FETCH, BROAD, RepoIMU and a car 0.025 at most
ITERATIONS, RIDGE = 4, 1e-9  # of the weights; share of a square, for what the motion does not show
LONG_ENOUGH_S = 40.0  # for a calibration of a log alone: shorter logs fit their noise

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Contradiction:
    """Log that other logs' scale and misalignment make worse: its errors over that without."""

    log: str
    sensor: Sensor
    others: float
    own: float

    def __str__(self) -> str:
        """What a user should look at."""
        return (
            f"{self.log}: contradicts the other logs: their {self.sensor} scale and misalignment leave {self.others:.0%} of "
            f"its error, its own {self.own:.0%}. Another unit or mount, or turned poses? Train a model for each unit"
        )


def check_axes(pool: Pool, fits: Mapping[Sensor, Calibration]) -> None:
    """Refuse a log whose axes are turned against the others', and name one of another unit.

    Gravity and poses contradict no such log, and scales are the same in axes turned by half a turn: its bias shows it.

    Raises:
        DataError: such a log.
    """
    if len(pool.names) < 2:
        return
    bias, std = np.zeros((len(pool.names), 6)), np.full(6, np.inf)
    for sensor, fit in fits.items():
        bias[:, COLUMNS[sensor]] = fit.own[:, :3].cpu().numpy()
        std[COLUMNS[sensor]] = np.sqrt(2.0) * TURN_ON_STD[sensor]
    for log, name in enumerate(pool.names):
        others = np.delete(bias, log, axis=0)
        mean = np.median(others, axis=0)
        for what in turned_axes(bias[log] - mean, np.hypot(std, others.std(axis=0)), mean, MAX_LEFT):
            fix = "Turn its axes, or leave it out" if len(others) > 1 else "Turn the axes of one of the two"
            raise DataError(what, where=name, expected="the axes of the other logs", fix=fix)
    if len(pool.names) > 2:  # of two it could be either
        _name_other_units(pool.names, bias[:, :3])


def _name_other_units(names: Sequence[str], bias: Float64[np.ndarray, "logs 3"]) -> None:
    """Warn of logs whose gyro has a bias that no switching-on of the others' unit gives."""
    usual = np.median(bias, axis=0)
    for name, own in zip(names, bias, strict=True):
        axis = int(np.argmax(np.abs(own - usual)))
        if abs(own[axis] - usual[axis]) > MAX_CHANGE[axis]:
            what = "%s: the gyro's bias about %s is %+.2g rad/s, the median of all logs %+.2g: another unit? %s"
            fix = "Train a model for each unit"
            logger.warning(what, name, "xyz"[axis], own[axis], usual[axis], fix)


def warn_of_smoothed_poses(pool: Pool) -> None:
    """Warn of poses that are means over some time, whose turns teach a wrong scale."""
    for log, name in enumerate(pool.names):
        over_s, share = _smoothing(pool, log)
        if share > TOO_SMALL:
            what = "%s: the poses are smoothed over about %.2f s: turns of half a second are %.0f %% too small in them, and the"
            what = f"{what} model learns that as a scale. Train on poses as they were measured"
            logger.warning(what, name, over_s, 100.0 * share)


@torch.no_grad()
def _smoothing(pool: Pool, log: int) -> tuple[float, float]:
    """Time over which a log's poses are means, and the share of half a second's turn that this hides.

    The share is zero where it is not clear. Means over T miss the share T^2 / 24 of the second derivative of the attitude: the
    residual of a window is that share of w'_end - R^T w'_start, with scale, misalignment, bias, mount and a clock that is off
    by tau, whose square counts alike.
    """
    n, h = pool.samples(SMOOTHED_S), pool.samples(SLOPE_S)
    first = pool.starts(n, "all", hop=max(1, n // 2))
    first = first[pool.log[first] == log]
    first = first[:: -(-len(first) // MAX_WINDOWS) or 1]
    windows, eye = pool.windows(first, n, pool.t.new_zeros(len(first), 6)), torch.eye(3).to(pool.t)
    R = windows.R_start.mT @ windows.R_end
    e = rotation_residual(windows.segment.gyro, windows.dt, R)[0]
    turn = so3.log(R @ so3.exp(-e))  # the gyro's: noise of the poses is in the residual, and would look like a scale
    steps, ends = torch.arange(-h, h + 1).to(pool.t), [pool.gyro[pool.around(end, h, h)] for end in (first, first + n)]
    slopes = [torch.einsum("k,mki->mi", steps * pool.rate_hz / (steps @ steps), rates) for rates in ends]
    changes = [at[1] - (R.mT @ at[0][..., None])[..., 0] for at in ([rates.mean(1) for rates in ends], slopes)]
    by_matrix = torch.einsum("ij,mk->mijk", eye, turn).flatten(2)
    J = torch.cat([by_matrix, eye.expand_as(R), R.mT - eye, *(change[..., None] for change in changes)], dim=2)
    residual, x, H = e, J.new_zeros(J.shape[2]), J.new_zeros(J.shape[2], J.shape[2])
    for _ in range(ITERATIONS if len(first) > J.shape[2] else 0):
        size = residual.norm(dim=1)
        weight = huber_weight(size, HUBER_MEDIANS * size.median().expand_as(size))
        H = torch.einsum("m,mij,mik->jk", weight, J, J)
        x = torch.linalg.solve(H + torch.diag(RIDGE * H.diagonal() + RIDGE**2), torch.einsum("m,mij,mi->j", weight, J, e))
        residual = e - J @ x
    missed = float(x[-1] - 0.5 * x[-2] ** 2)
    std = float((torch.linalg.pinv(H)[-1, -1] * residual.square().mean()).sqrt())
    share = missed * float(changes[1].norm() / turn.norm()) if missed > SURE * std else 0.0
    return math.sqrt(24.0 * max(missed, 0.0)), share


def contradicting(pool: Pool, fits: Mapping[Sensor, Calibration]) -> tuple[Contradiction, ...]:
    """Logs of another unit or mount, or with turned poses; of two logs it could be either."""
    found = []
    for sensor, fit in fits.items():
        if len(fit.problem.own) == len(pool.names) > 2:  # logs, not folds of them
            other = [name for name in fit.effects if name not in LINEAR[sensor]]
            every, without = (parameter_columns(fit.forms, names) for names in ((*other, *LINEAR[sensor]), other))
            losses = [fit.problem.predicted(every, by_itself=alone) for alone in (False, True)]
            shares = (torch.stack(losses, dim=1) / fit.problem.predicted(without)[:, None]).clamp_min(0.0).sqrt()
            for name, (begin, end), (others, own) in zip(pool.names, pool.spans_ns, shares.tolist(), strict=True):
                if end - begin >= nanoseconds(LONG_ENOUGH_S) and others > 1.0 and own < CONTRADICTS:
                    found.append(Contradiction(name, sensor, others, own))
    return tuple(found)
