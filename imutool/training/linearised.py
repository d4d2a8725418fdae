"""Residuals between true poses, linearised in effect parameters and per-log unknowns.

Unknowns of a log are its rest bias and, for the accelerometer, the tilt of its truth's world against gravity. The residual of a
window and how each sample moves it come from `imutool.inertial.windows`; an effect's error is linear in its parameters, so
the rest is
a product of matrices.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from imutool.errors import DataError
from imutool.inertial.strapdown import GRAVITY_W
from imutool.inertial.windows import HUBER_MEDIANS, attitudes, huber_weight, rotation_residual, velocity_residual
from imutool.sensor.linear_form import LinearForm, patterns
from imutool.sensor.signals import Signals
from imutool.training.closed_form import CORRELATED, REST_PRIOR, median_per_log
from imutool.training.normal_equations import Equations, Problem
from imutool.training.segments import Part, Pool, Windows
from imutool.units import Sensor

WINDOW_S: Mapping[Sensor, tuple[float, ...]] = {"gyro": (1.0, 4.0, 15.0, 40.0), "accel": (0.5, 2.0, 5.0)}
JUDGED_FROM_S: Mapping[Sensor, float] = {"gyro": 4.0, "accel": 2.0}  # drift over short windows does not rank calibrations
TILT_PRIOR = 0.1  # m/s² of gravity in the truth's horizontal plane: half a degree
MAX_SAMPLES = 150_000  # of one window length
CHUNK = 20_000  # samples at a time


# Standard deviations of the priors, in the parameters' units, where they are not the plausible sizes of the diagnosis: training
# calibrates a sensor that works, and what it did not see of a drift or a nonlinearity has to stay near zero; a diagnosis looks
# for faults. The shipped models were trained with these.
PRIOR_STD: Mapping[str, float] = {
    "accel_bias_drift": 0.1,
    "accel_scale": 0.1,
    "clock_offset": 0.01,
    "gyro_bias_drift": 2e-3,
    "gyro_g_sensitivity": 1e-3,
    "gyro_quadratic": 0.02,
}


def prior_std(effect: LinearForm) -> Float64[np.ndarray, " p"]:
    """Standard deviation of the prior of each parameter, which is about zero."""
    same = PRIOR_STD.get(effect.name)
    return effect.plausible if same is None else np.full(len(effect.parameters), same)


@dataclass(frozen=True)
class Seen:
    """Samples of one sensor in a pool: signals, and the gyro for an accelerometer's attitude."""

    pool: Pool
    sensor: Sensor
    signals: Signals
    gyro: Float[Tensor, "n 3"]

    @property
    def own_size(self) -> int:
        """Number of unknowns of each log."""
        return 3 if self.sensor == "gyro" else 5


@dataclass(frozen=True)
class WindowSet:
    """Windows of n steps, by first sample; `judged` if they rank calibrations."""

    first: Int[Tensor, " m"]
    n: int
    judged: bool


def linearise(seen: Seen, effects: Sequence[LinearForm], part: Part) -> Problem:
    """Gauss-Newton on all effects at once, from the shortest windows to all lengths.

    Raises:
        DataError: a log without a window that is free of gaps.
    """
    sets, logs = _window_sets(seen, part), len(seen.pool.names)
    std = np.concatenate([np.zeros(0), *(prior_std(effect) for effect in effects)])
    prior = torch.from_numpy(std**-2.0).to(seen.pool.t)
    tilt_prior = [TILT_PRIOR**-2] * (seen.own_size - 3)
    own_prior = torch.tensor([REST_PRIOR[seen.sensor] ** -2] * 3 + tilt_prior).to(seen.pool.t)
    theta, own = torch.zeros_like(prior), prior.new_zeros(logs, seen.own_size)
    for step in range(len(sets) + 2):
        fit = judged = Equations.none(prior, logs, len(prior) + seen.own_size)
        for windows in sets[: step + 1]:
            equations = _equations(seen, effects, theta, own, windows)
            fit = fit + equations
            judged = judged + equations if windows.judged else judged
        problem = Problem(theta, own, prior, own_prior, fit, judged)
        if step < len(sets) + 1:
            theta = problem.solve(range(len(prior))).theta
            own = problem.own_at(theta)
    return problem


def _window_sets(seen: Seen, part: Part) -> list[WindowSet]:
    """Windows of all lengths that fit, half overlapping, evenly chosen where there are many.

    Raises:
        DataError: a log has none of the shortest.
    """
    pool, sets = seen.pool, []
    for length_s in WINDOW_S[seen.sensor]:
        n = pool.samples(length_s)
        first = pool.starts(n, part, hop=max(1, n // 2))
        if len(first):
            evenly = first[:: max(1, -(-len(first) * n // MAX_SAMPLES))]
            sets.append(WindowSet(evenly, n, length_s >= JUDGED_FROM_S[seen.sensor]))
    covered = set(pool.log[sets[0].first].tolist()) if sets else set()
    missing = [name for i, name in enumerate(pool.names) if i not in covered]
    if missing:
        of = "" if part == "all" else f" in the {part.replace('_', '-')} part"
        raise DataError(
            f"no stretch of truth without a gap{of}",
            where=", ".join(missing),
            expected=f"{WINDOW_S[seen.sensor][0]:g} s of it in every log",
            fix="Leave the log out",
        )
    return sets


def _equations(
    seen: Seen, effects: Sequence[LinearForm], theta: Float[Tensor, " p"], own: Float[Tensor, "logs o"], windows: WindowSet
) -> Equations:
    """Normal equations of the windows of one length."""
    pool, n = seen.pool, windows.n
    error = _error(seen.signals, effects, theta.cpu().numpy()).to(pool.t)
    pattern = torch.from_numpy(patterns(effects)).to(pool.t)
    residuals, slopes = [], []
    for some in torch.split(windows.first, max(1, CHUNK // n)):
        index = some[:, None] + torch.arange(n + 1, device=some.device)
        cut = pool.windows(some, n, pool.t.new_zeros(len(some), 6))
        u = pool.gyro if seen.sensor == "gyro" else pool.accel
        true_u = u[index] - error[index] - own[cut.log, None, :3]
        e, A, by_tilt = _residual(seen.sensor, cut, true_u, seen.gyro[index], own)
        terms = torch.from_numpy(_terms(seen.signals, effects, index.cpu().numpy())).to(pool.t)
        terms = 0.5 * (terms[:, :-1] + terms[:, 1:]) if seen.sensor == "gyro" else terms  # rates hold between samples
        S = A.permute(0, 2, 3, 1).flatten(1, 2) @ terms
        by_theta = torch.einsum("mijq,jqp->mip", S.reshape(len(S), 3, 3, S.shape[2]), pattern)
        residuals.append(e)
        slopes.append(torch.cat([by_theta, A.sum(1), by_tilt], dim=2))
    return _summed(torch.cat(residuals), torch.cat(slopes), pool.log[windows.first], len(pool.names))


def _residual(
    sensor: Sensor,
    windows: Windows,
    true_u: Float[Tensor, "m n 3"],
    gyro: Float[Tensor, "m n 3"],
    own: Float[Tensor, "logs o"],
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m k 3 3"], Float[Tensor, "m 3 _"]]:
    """Residual, its Jacobian by minus each sample, and its Jacobian by the log's tilt."""
    if sensor == "gyro":
        e, A = rotation_residual(true_u, windows.dt, windows.R_start.mT @ windows.R_end)
        return e, A, e.new_zeros(len(e), 3, 0)
    R_wb = attitudes(windows.R_start, gyro, windows.dt)
    e, A = velocity_residual(true_u, windows.dt, R_wb, windows.v_end - windows.v_start, true_u.new_tensor(GRAVITY_W))
    tilt = torch.eye(3).to(e)[None, :, :2] * windows.dt.sum(1)[:, None, None]
    return e + (tilt @ own[windows.log, 3:, None])[..., 0], A, tilt


def _summed(e: Float[Tensor, "m 3"], J: Float[Tensor, "m 3 k"], log: Int[Tensor, " m"], logs: int) -> Equations:
    """Normal equations with Huber's weights, in units of the median of the log and the length."""
    size = e.norm(dim=1)
    delta = HUBER_MEDIANS * median_per_log(size, log, logs)[log]
    weight = huber_weight(size, delta) * 3 / delta**2 / CORRELATED
    parts = [log == i for i in range(logs)]
    H = torch.stack([torch.einsum("m,mij,mik->jk", weight[m], J[m], J[m]) for m in parts])
    g = torch.stack([torch.einsum("m,mij,mi->j", weight[m], J[m], e[m]) for m in parts])
    c = torch.stack([(weight[m] * e[m].square().sum(1)).sum() for m in parts])
    return Equations(H, g, c)


def _terms(
    signals: Signals, effects: Sequence[LinearForm], index: Int[np.ndarray, "*shape"]
) -> Float64[np.ndarray, "*shape q"]:
    """Terms of the effects at some samples."""
    rows = signals.rows(index.ravel())
    parts = [np.zeros((index.size, 0)), *(effect.terms(rows) for effect in effects)]
    return np.concatenate(parts, axis=1).reshape(*index.shape, -1)


def _error(signals: Signals, effects: Sequence[LinearForm], theta: Float64[np.ndarray, " p"]) -> Float[Tensor, "n 3"]:
    """Error of every sample, a chunk at a time."""
    matrix = np.einsum("iqp,p->qi", patterns(effects), theta)
    rows = np.arange(len(signals.t_s))
    starts = range(0, len(rows), CHUNK)
    return torch.from_numpy(np.concatenate([_terms(signals, effects, rows[k : k + CHUNK]) @ matrix for k in starts]))
