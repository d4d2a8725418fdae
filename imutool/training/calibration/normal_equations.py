"""Normal equations of windows between true poses, log by log, so that one can be left out.

Unknowns are theta, the effect parameters that all logs share, and a few of each log: its rest bias and its nuisances
(`imutool.training.calibration.log_scatter`: rotation, clock and lever arm between poses and sensor, tilt of the poses'
world). An effect of the same form as a nuisance is what logs have in common. Errors are linear in the
parameters: with a window's residual and Jacobian (sums of pieces, `imutool.inertial.windows`), the rest is a product of
matrices.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from imutool.array_types import Float, Int
from imutool.bias.networks.threads import of_each
from imutool.geometry import so3
from imutool.inertial.strapdown import GRAVITY_W
from imutool.inertial.windows import HUBER_MEDIANS, Pieces, Prefix, derivative_by_sample, huber_weight, turns_from_start
from imutool.sensor.linear_form import LinearForm, patterns, terms_of
from imutool.sensor.signals import Signals
from imutool.training.calibration.closed_form import end_samples, median_per_log, nuisance_jacobian, window_sets
from imutool.training.calibration.log_scatter import LogPieces, shown_by_logs, sums_by_log, widest
from imutool.training.calibration.shared_parameters import Equations, Problem
from imutool.training.settings import SensorPrior
from imutool.training.training_windows import Part, Pool
from imutool.units import Sensor

WINDOW_S: Mapping[Sensor, tuple[float, ...]] = {"gyro": (1.0, 4.0, 15.0, 40.0), "accel": (0.5, 2.0, 5.0)}
JUDGED_FROM_S: Mapping[Sensor, float] = {"gyro": 4.0, "accel": 2.0}  # drift over short windows does not rank calibrations
FREE: Mapping[Sensor, int] = {"gyro": 3, "accel": 5}  # a log's own unknowns that its prediction leaves free: rest bias, tilt
MAX_SAMPLES, CHUNK, PIECE = 150_000, 20_000, 128  # samples of one window length, at a time, and steps of a piece
REPEATED = 3.0  # windows that hold a sample's noise, from Wald's statistic of made-up logs without effects
SHARED = 0.5  # correlation of the errors that poses of one setup share from log to log: from logs left out, and from one alone
SETTLED, MAX_STEPS = 0.2, 40  # deviations by which a step moves a parameter at most; steps with windows of all lengths
WEAK = 0.01  # of a prior's precision, that of the prior at first
FOLDS = 3  # parts of a log where there are fewer logs than this


def folded(pool: Pool) -> Pool:
    """Pool with the training part of each log cut in folds where logs are few."""
    if len(pool.names) >= FOLDS:
        return pool
    counts = ~pool.held_out
    length = torch.bincount(pool.log, weights=counts.to(pool.t)).long()
    before = torch.cumsum(length, 0) - length
    index = (torch.cumsum(counts, 0) - 1 - before[pool.log]).clamp(min=0)  # within the part; the others are not used
    log = pool.log * FOLDS + (index * FOLDS // length.clamp(min=1)[pool.log]).clamp(max=FOLDS - 1)
    names = tuple(f"{n} {k + 1}/{FOLDS}" for n in pool.names for k in range(FOLDS))
    return replace(pool, names=names, log=log, floors=pool.floors.repeat_interleave(FOLDS, dim=0))


def design_effect(pool: Pool) -> float:
    """Kish's design effect 1 + (n - 1) rho of errors that n logs share."""
    return 1.0 + SHARED * (len(pool.spans_ns) - 1)


class Seen(NamedTuple):
    """Samples of a sensor in a pool; `gyro` carries the attitude under an accelerometer."""

    pool: Pool
    sensor: Sensor
    gyro: Float[Tensor, "n 3"]


class Terms(NamedTuple):
    """Errors that are linear in parameters theta, the product of `pattern` and the values."""

    values: Float[Tensor, "n q"]
    pattern: Float[Tensor, "3 q p"]
    prior: Float[Tensor, " p"]  # one over the variance of each parameter, about zero

    @classmethod
    def of(cls, effects: Sequence[LinearForm], signals: Signals, sensors: SensorPrior, pool: Pool) -> Terms:
        """Terms of some effects."""
        prior = np.concatenate([np.zeros(0), *map(sensors.std_of, effects)]) ** -2.0
        return cls(*(torch.from_numpy(x).to(pool.t) for x in (terms_of(effects, signals), patterns(effects), prior)))


class WindowSet(NamedTuple):
    """Windows of n steps, by first sample; `judged` if they rank calibrations."""

    first: Int[Tensor, " m"]
    n: int
    judged: bool


def linearise(seen: Seen, terms: Terms, part: Part, own_prior: Float[Tensor, " o"] | None = None) -> Problem:
    """Gauss-Newton on all parameters at once, from the shortest windows to all lengths.

    Without `own_prior` nuisances get a prior as wide as the logs scatter, once all lengths are in. Up to then the parameters
    have a weak prior: what it left of a large effect would count as noise, which would keep the prior strong.

    Raises:
        DataError: a log without a window that is free of gaps.
    """
    judged_s, lengths_s = JUDGED_FROM_S[seen.sensor], WINDOW_S[seen.sensor]
    found = window_sets(seen.pool, lengths_s, part, MAX_SAMPLES, ends_only=True)
    sets = [WindowSet(*windows, s >= judged_s) for s, windows in zip(lengths_s, found, strict=True) if len(windows[0])]
    logs, prior = len(seen.pool.names), terms.prior
    width = widest(seen.sensor, prior) if own_prior is None else own_prior
    theta, own, settled = torch.zeros_like(prior), prior.new_zeros(logs, len(width)), False
    pieces, turned = Pieces.between([windows[:2] for windows in sets], PIECE), dict[int, Tensor]()
    samples, split = seen.pool.of_sensor(seen.sensor), LogPieces.of(seen.pool.log, seen.pool.t, logs)
    rows, unknowns = [pieces.row(windows.first, windows.n) for windows in sets], len(prior) + len(width)
    nothing = Equations(*(prior.new_zeros(len(split.log), *shape) for shape in ((unknowns, unknowns), (unknowns,), ())))
    for step in range(len(sets) + MAX_STEPS):
        fit = judged = nothing
        size = seen.pool.minimum(seen.sensor)
        true_u = samples - terms.values @ torch.einsum("iqp,p->qi", terms.pattern, theta) - own[seen.pool.log, :3]
        prefix = _prefix(seen, pieces, terms, true_u, turned)
        for windows, row in list(zip(sets, rows, strict=True))[: step + 1]:
            equations, size = _equations(seen, windows, prefix.across(*row), true_u, own, size, split)
            fit = fit + equations
            judged = judged + equations if windows.judged else judged
        fit, judged = (Equations(*split.merged(some.H, some.g, some.c, seen.sensor, len(prior))) for some in (fit, judged))
        if own_prior is None and step >= len(sets) - 1:
            width = shown_by_logs(seen.sensor, fit.H, fit.g, theta, own, prior)
        penalty = prior * (1.0 if step >= len(sets) else WEAK)
        problem = Problem(theta, own, penalty, width, design_effect(seen.pool), FREE[seen.sensor], fit, judged)
        if step > len(sets) and settled:
            break
        to, covariance = problem.solve(range(len(prior)))
        settled = bool(((to - theta).abs() < SETTLED * covariance.diagonal().sqrt()).all())
        theta, own = to, problem.own_at(to)
    return problem


def _prefix(seen: Seen, pieces: Pieces, terms: Terms, true_u: Float[Tensor, "n 3"], turned: dict[int, Tensor]) -> Prefix:
    """Turn and sum of pieces: minus the derivative by theta and by the rest bias, and the samples under that derivative.

    `turned` keeps the turns under an accelerometer, which stay from step to step.
    """
    rates = true_u if seen.sensor == "gyro" else seen.gyro

    def added(numbered: tuple[int, Int[Tensor, "m s"]]) -> tuple[Float[Tensor, "m 3 3"], Float[Tensor, "m 3 k"]]:
        number, index = numbered
        dt = torch.diff(seen.pool.t[index], dim=1)
        turns = turned[number] if number in turned else turns_from_start(rates[index], dt)
        if seen.sensor == "accel":
            turned[number] = turns
        A = derivative_by_sample(seen.sensor, turns, dt)
        S = A.flatten(2).mT @ terms.values[index]
        by_theta = torch.einsum("mijq,jqp->mip", S.reshape(len(S), 3, 3, S.shape[2]), terms.pattern)
        by_all = torch.einsum("mkij,mkj->mi", A, true_u[index])
        return turns[:, -1], torch.cat([by_theta, A.sum(1), by_all[..., None]], dim=2)

    turns, adds = zip(*of_each(added, enumerate(torch.split(pieces.index(), max(1, CHUNK // PIECE)))), strict=True)
    return Prefix.of(torch.cat(turns), torch.cat(adds))


def _equations(
    seen: Seen,
    windows: WindowSet,
    crossed: tuple[Float[Tensor, "m 3 3"], Float[Tensor, "m 3 k"]],
    true_u: Float[Tensor, "n 3"],
    own: Float[Tensor, "logs o"],
    shorter: Float[Tensor, " logs"],
    split: LogPieces,
) -> tuple[Equations, Float[Tensor, " logs"]]:
    """Normal equations of windows of one length, by piece, and their usual residual; `shorter` is that of shorter windows."""
    pool, (turn, added) = seen.pool, crossed
    index = end_samples(windows.first, windows.n)
    ends = pool.at(index, own.new_zeros(len(index), 6))
    if seen.sensor == "gyro":
        e, by_shared = so3.log(turn.mT @ ends.R_start.mT @ ends.R_end), turn.mT @ added[..., :-1]
        by_nuisance = nuisance_jacobian("gyro", ends, true_u[index], true_u[index])
    else:
        by_shared, dv = (ends.R_start @ added).tensor_split((-1,), dim=2)
        e = ends.v_end - ends.v_start - true_u.new_tensor(GRAVITY_W) * ends.dt.sum(1, keepdim=True) - dv[..., 0]
        by_nuisance = nuisance_jacobian("accel", ends, seen.gyro[index], true_u[index])
    e = e + (by_nuisance @ own[ends.log, 3:, None])[..., 0]
    slopes = torch.cat([by_shared, by_nuisance], dim=2)
    # errors add up: a median below that of shorter windows comes from so few that a log's own unknowns fit their noise
    size = e.norm(dim=1)
    usual = median_per_log(size, ends.log, shorter)
    delta = HUBER_MEDIANS * usual[ends.log]
    weight = huber_weight(size, delta) * 3 / delta**2 / REPEATED
    sums = sums_by_log(slopes, e, weight, split.of_sample[windows.first], len(split.log))
    return Equations(*sums).times(1.0 / design_effect(pool)), usual
