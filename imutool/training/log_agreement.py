"""Logs that contradict the others: turned axes, another unit or another mount."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from imutool.array_types import Float64
from imutool.bias.model import COLUMNS
from imutool.bias_start.prior_width import MOST_CHANGE, turned_axes
from imutool.errors import DataError
from imutool.recording import nanoseconds
from imutool.training.bias_spread import TURN_ON_STD
from imutool.training.calibration.effect_selection import LINEAR, Calibration, parameter_columns
from imutool.training.training_windows import Pool
from imutool.units import Sensor

CONTRADICTS = 0.35  # of the error without a matrix, left by a log's own: 30 s without any matrix keep 0.43 at least
MOST_LEFT = (
    0.02  # share of chi-square that turned axes leave; of made-up sensors that turn on 10 to 20 mrad/s apart, 1 in 5000 has it
)
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
        for what in turned_axes(bias[log] - mean, np.hypot(std, others.std(axis=0)), mean, MOST_LEFT):
            fix = "Turn its axes, or leave it out" if len(others) > 1 else "Turn the axes of one of the two"
            raise DataError(what, where=name, expected="the axes of the other logs", fix=fix)
    if len(pool.names) > 2:  # of two it could be either
        _name_other_units(pool.names, bias[:, :3])


def _name_other_units(names: Sequence[str], bias: Float64[np.ndarray, "logs 3"]) -> None:
    """Warn of logs whose gyro has a bias that no switching-on of the others' unit gives."""
    usual = np.median(bias, axis=0)
    for name, own in zip(names, bias, strict=True):
        axis = int(np.argmax(np.abs(own - usual)))
        if abs(own[axis] - usual[axis]) > MOST_CHANGE[axis]:
            what = "%s: the gyro's bias about %s is %+.2g rad/s, the median of all logs %+.2g: another unit? %s"
            fix = "Train a model for each unit"
            logger.warning(what, name, "xyz"[axis], own[axis], usual[axis], fix)


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
