"""Calibration: effects that the training logs support, fitted by linear least squares.

Effects (`imutool.sensor.effects`) are shared by all logs; rest bias and tilt are each log's own.
Forward selection: an effect is chosen by how well the other logs predict each log's long windows
(`imutool.training.normal_equations`), and refused where most logs do not agree or chance explains it. A parameter that the
motion does not show stays at its prior, and is named.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.stats import chi2
from torch import Tensor

from imutool.sensor import catalogue
from imutool.sensor.linear_form import LinearForm
from imutool.sensor.signals import SignalFilter, Signals
from imutool.training.closed_form import CORRELATED
from imutool.training.normal_equations import Problem, Seen, linearise
from imutool.training.segments import Part, Pool
from imutool.units import Sensor

BY_CHANCE = 0.01  # probability of finding any effect where there is none
LEAST_GAIN = 0.03  # of the judged loss, for an effect to be worth its parameters
FOLDS = 3  # parts of a log where there are fewer logs than this
UNSEEN = 0.9  # of its prior's width: a parameter no narrower was not seen


@dataclass(frozen=True)
class Calibration:
    """Chosen effects, their parameters in order, and the covariance of these.

    `gains`: share of the loss that each effect took off logs that had no part in its fit, in the order of choice.
    """

    effects: tuple[str, ...]
    theta: Float[Tensor, " p"]
    covariance: Float[Tensor, "p p"]
    rest: Float[Tensor, "logs 3"]
    gains: Mapping[str, float]
    unseen: tuple[str, ...]


def signals_of(pool: Pool) -> Signals:
    """Signals of all logs, end to end; filters start at each log's first sample in the pool."""
    parts = []
    for log in range(len(pool.names)):
        rows = pool.log == log
        t, gyro, accel = (x[rows].cpu().double().numpy() for x in (pool.t, pool.gyro, pool.accel))
        parts.append(SignalFilter(pool.rate_hz)(t, gyro, accel))
    return Signals(np.concatenate([part.t_s for part in parts]), np.concatenate([part.columns for part in parts]))


def calibrate(
    pool: Pool,
    sensor: Sensor,
    gyro: Float[Tensor, "n 3"],
    names: Sequence[str] | None = None,
    part: Part = "train",
    signals: Signals | None = None,
) -> Calibration:
    """Fit the effects that the logs support, or those named.

    `gyro` is the debiased rate that carries the attitude under the accelerometer, and the gyro's own samples for the gyro.
    `signals` are those of every sample where the logs begin before the pool does.

    Raises:
        DataError: a log without a stretch of truth that is free of gaps.
        ConfigError: a name that no effect on the sensor has.
    """
    effects = catalogue.trained(sensor, names)
    seen = Seen(folded(pool, part), sensor, signals_of(pool) if signals is None else signals, gyro)
    problem, gains = linearise(seen, effects, part), {}
    if names is None:
        gains = _choose(problem, effects)
        if len(gains) < len(effects):
            effects = tuple(effect for effect in effects if effect.name in gains)
            problem = linearise(seen, effects, part)
    theta, covariance = problem.solve(range(len(problem.theta)))
    rest = problem.own_at(theta)[:, :3]
    return Calibration(
        tuple(effect.name for effect in effects),
        theta,
        covariance,
        rest.reshape(len(pool.names), -1, 3).mean(1),
        gains,
        _unseen(effects, problem, covariance),
    )


def folded(pool: Pool, part: Part) -> Pool:
    """Pool with each log cut in equal folds where there are too few logs."""
    if len(pool.names) >= FOLDS:
        return pool
    counts = torch.ones_like(pool.held_out) if part == "all" else pool.held_out == (part == "held_out")
    length = torch.bincount(pool.log, weights=counts.to(pool.t)).long()
    before = torch.cumsum(length, 0) - length
    index = (torch.cumsum(counts, 0) - 1 - before[pool.log]).clamp(min=0)  # within the part; the others are not used
    log = pool.log * FOLDS + (index * FOLDS // length.clamp(min=1)[pool.log]).clamp(max=FOLDS - 1)
    return replace(pool, names=tuple(f"{n} {k + 1}/{FOLDS}" for n in pool.names for k in range(FOLDS)), log=log)


def _columns(effects: Sequence[LinearForm], names: Sequence[str]) -> list[int]:
    """Columns of the parameters of some effects."""
    of = [effect.name for effect in effects for _ in effect.parameters]
    return [k for k, name in enumerate(of) if name in names]


def _choose(problem: Problem, effects: Sequence[LinearForm]) -> dict[str, float]:
    """Forward selection, by the gain on other logs; stops where the best gain is small."""
    gains: dict[str, float] = {}
    loss = problem.predicted([])
    while True:
        left = [effect.name for effect in effects if effect.name not in gains]
        tried = {name: problem.predicted(_columns(effects, [*gains, name])) for name in left}
        helped = {name: new for name, new in tried.items() if bool((new < loss).sum() > 0.5 * len(loss))}
        agreed = {name: new for name, new in helped.items() if _beyond_chance(problem, effects, [*gains, name])}
        if not agreed:
            return gains
        best = min(agreed, key=lambda name: float(agreed[name].sum()))
        gain = 1 - float(agreed[best].sum() / loss.sum())
        if gain < LEAST_GAIN:
            return gains
        gains[best], loss = gain, agreed[best]


def _beyond_chance(problem: Problem, effects: Sequence[LinearForm], names: Sequence[str]) -> bool:
    """Wald's test of the last effect's parameters, corrected for the number of candidates.

    Windows count as independent here, though the covariance takes them as correlated: the test only keeps out effects without
    evidence; the held-out loss decides which come in.
    """
    columns = _columns(effects, names)
    theta, covariance = problem.solve(columns)
    own = [k for k, column in enumerate(columns) if column in _columns(effects, names[-1:])]
    found = theta[columns][own]
    wald = CORRELATED * float(found @ torch.linalg.solve(covariance[own][:, own], found))
    return wald > float(chi2.isf(BY_CHANCE / len(effects), len(own)))


def _unseen(effects: Sequence[LinearForm], problem: Problem, covariance: Float[Tensor, "p p"]) -> tuple[str, ...]:
    """Parameters whose standard deviation is that of their prior: the motion does not show them."""
    names = [f"{effect.name}.{parameter.name}" for effect in effects for parameter in effect.parameters]
    share = (covariance.diagonal() * problem.prior).sqrt()
    return tuple(name for name, s in zip(names, share, strict=True) if float(s) > UNSEEN)
