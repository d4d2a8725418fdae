"""Spread of rest biases from session to session, and uncertainty of a start from truth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from msgspec import to_builtins
from scipy.special import chdtri
from torch import Tensor

from imutool.array_types import Float, Float64
from imutool.bias.model import Session, Vector6
from imutool.bias.networks.network import BiasNetwork, Segment
from imutool.bias.networks.threads import of_each
from imutool.bias_start.bias_at_rest import rest_differences
from imutool.bias_start.bias_from_truth import MIN_TRUTH_STD, TRUTH_S, bias_from_truth
from imutool.bias_start.initial_bias import AT_REST_STD, SESSION_GAP_S
from imutool.bias_start.prior_width import USUAL_WALK
from imutool.geometry import so3
from imutool.inertial.stationary import CALM, white_noise
from imutool.recording import nanoseconds
from imutool.training.calibration import closed_form
from imutool.training.calibration.log_scatter import NUISANCE_STD
from imutool.training.training_windows import Pool, corrected
from imutool.units import COLUMNS, SENSORS, Sensor

MAD_TO_STD = 1.4826
TURN_ON_STD = {"gyro": 5e-3, "accel": 0.1}  # of a switching-on: ADIS16448 2e-3 over four months, BMI160 up to 5e-2 (data sheet)
MAX_TURN_ON = 11.0  # by the size of the biases themselves: three as small have a chance of one in a thousand
USUAL_STD = {"gyro": 5e-4, "accel": 2e-2}  # between logs of one switching-on
MAX_TAIL, MIN_FREEDOM = 3.0, 0.1  # variance of Student's t: three degrees of freedom, or fewer, count as three
SESSION_STEP = {"gyro": 3e-3, "accel": 0.3}  # another switching-on: a larger step of the bias from one log to the next
MIN_TRUSTED, FEWEST_STARTS = 0.5, 4
WALKS, WALK_FACTOR = np.geomspace(0.01, 30.0, 24), 3.0  # multiples of the usual walk; deviation of the prior, as a factor
WALK_WINDOW_S, MAX_WINDOWS, MIN_COMBINATIONS, MIN_SQUARE = 2.5, 24, 3, 1e-18
LONGEST_WALK_WINDOW_S = {"gyro": 30.0, "accel": 5.0}  # a bias of the gyro tilts the accelerometer's windows
AVERAGED_S, AVERAGED = 1.0, 8  # windows that begin within this time, whose mean has less of the poses' noise
POSE_ERROR_S = (0.3, 3.0, 30.0)  # how long errors of the poses last
POSE_SHARES = np.geomspace(1e-2, 1e4, 7)  # variance of the poses' errors, by that of a window's own noise
ERROR_SHARES = np.geomspace(1e-6, 2.0, 30)  # variance of a window's own noise, by the mean square of the residuals
BY_CHANCE = 0.01  # probability that logs seem to show a shift of the bias at rest where there is none


class TurnOn(NamedTuple):
    """Rest bias of the next session, and the sessions known."""

    mean: Vector6
    std: Vector6  # for a sensor of the usual kind
    min_std: Vector6  # as little as it may be
    sessions: list[Session]

    def card(self) -> dict[str, Any]:
        """Entries of a model card."""
        return {"sessions": to_builtins(self.sessions), "turn_on_least_std": self.min_std.tolist()}


def store_statistics(
    model: BiasNetwork, pool: Pool, rest: Float[Tensor, "logs 6"], window_s: Mapping[Sensor, Sequence[float]]
) -> TurnOn:
    """Store the prior, the spread of starts from truth and the noise; return the prior."""
    scored, residual = corrected(model, pool)
    rest, std = rest.clone(), torch.zeros_like(rest)
    shown = np.repeat([sensor in pool.sensors for sensor in SENSORS], 3)
    samples = torch.cat([pool.gyro, pool.accel], dim=1).cpu().numpy()
    model.noise_std.copy_(torch.from_numpy(CALM * white_noise(samples, 1.0 / pool.rate_hz)))
    for sensor in pool.sensors:
        columns = COLUMNS[sensor]
        solution = closed_form.solve(scored, sensor, residual, rest, window_s[sensor], matrix=False, part="all")
        rest[:, columns], std[:, columns] = solution.rest, solution.std
    biases = rest.cpu().double().numpy()
    turn_on = turn_on_prior(np.where(shown, biases, np.nan), pool.spans_ns)
    model.prior_mean.copy_(torch.from_numpy(turn_on.mean))
    model.prior_std.copy_(torch.from_numpy(turn_on.std))
    model.truth_std.copy_(_start_spread(scored, residual, rest))
    model.walk_std.copy_(_walk(scored, residual, rest))
    velocities = [residual.v_w[residual.log == log].cpu().double().numpy() for log in range(len(residual.names))]
    stops = [np.where(shown, rows, 0.0) for rows in rest_differences(scored.frozen(), _samples(residual), biases, velocities)]
    model.rest_std.copy_(torch.from_numpy(shift_at_rest(stops, std.cpu().double().numpy())))
    return turn_on


def turn_on_prior(rest: Float64[np.ndarray, "logs 6"], spans_ns: Sequence[tuple[int, int]]) -> TurnOn:
    """Prior of the next session's rest bias.

    Logs of one switching-on are one draw of the turn-on bias. From S sessions with means m_s the next one has the variance
    (sum (m_s - m)^2 + TURN_ON_STD^2) / S (1 + 1/S): the size that sensors usually have counts as one session more. Without it
    this is the least variance, of a sensor that repeats its bias as well as between the logs of one session.
    Within a session the variance comes from n logs, as many degrees of freedom too few to be known: the next log follows
    Student's t, whose variance is n / (n - 2) times larger, at most `MAX_TAIL`. Where most logs that follow each other closely
    differ all the same, the next log is of a session of its own, and no session is returned. A bias that no log shows is NaN:
    zero is expected of it, with `TURN_ON_STD`. No size exceeds that of the biases by more than `MAX_TURN_ON`: after another
    turn-on a fibre-optic gyro has 1e-5 rad/s again.
    """
    known, rest = np.isfinite(rest).all(axis=0), np.nan_to_num(rest)
    groups, broken = _sessions(rest, spans_ns)
    means = np.stack([rest[group].mean(axis=0) for group in groups])
    usual, turn_on = (np.repeat([size[sensor] for sensor in SENSORS], 3) for size in (USUAL_STD, TURN_ON_STD))
    maximum = MAX_TURN_ON * np.repeat(np.sqrt((means.reshape(-1, 2, 3) ** 2).mean(axis=(0, 2))), 3)
    usual, turn_on = (np.where(known, np.minimum(std, maximum), std) for std in (usual, turn_on))
    squares = sum(((rest[group] - mean) ** 2).sum(axis=0) for group, mean in zip(groups, means, strict=True))
    freedom = len(rest) - len(groups) + 1
    within = (squares + usual**2) / freedom * min(MAX_TAIL, freedom / max(freedom - 2.0, MIN_FREEDOM))
    mean, count = means.mean(axis=0), len(groups)
    scatter = ((means - mean) ** 2).sum(axis=0)
    maximum, minimum = ((scatter + one_more) / count * (1 + 1 / count) + within for one_more in (turn_on**2, 0.0))
    maximum, minimum, within = (np.where(known, variance, turn_on**2) for variance in (maximum, minimum, within))
    sessions = [
        Session(
            min(spans_ns[log][0] for log in group),
            max(spans_ns[log][1] for log in group),
            tuple(of_group.tolist()),
            tuple(np.sqrt(within * (1 + 1 / len(group))).tolist()),
        )
        for group, of_group in zip(groups, means, strict=True)
        if broken <= len(rest) - len(groups)
    ]
    return TurnOn(mean, np.sqrt(maximum), np.sqrt(minimum), sessions)


def _sessions(rest: Float64[np.ndarray, "logs 6"], spans_ns: Sequence[tuple[int, int]]) -> tuple[list[list[int]], int]:
    """Logs of each switching-on, hours apart at most and with biases alike; how many follow closely and are not alike."""
    step = np.repeat([SESSION_STEP[sensor] for sensor in SENSORS], 3)
    groups: list[list[int]] = []
    broken = 0
    for log in sorted(range(len(rest)), key=lambda log: spans_ns[log]):
        before = groups[-1][-1] if groups else None
        near = before is not None and spans_ns[log][0] - spans_ns[before][1] <= nanoseconds(SESSION_GAP_S)
        if near and bool((np.abs(rest[log] - rest[before]) < step).all()):
            groups[-1].append(log)
        else:
            broken += near
            groups.append([log])
    return groups, broken


def shift_at_rest(differences: Sequence[Float64[np.ndarray, "_ 6"]], std: Float64[np.ndarray, "logs 6"]) -> Vector6:
    """RMS of the bias at rest minus that in motion, where the logs together show a shift.

    `std` is that of each log's bias in motion. Stops whose differences are no larger than that and `AT_REST_STD` show none.
    """
    out, stops = AT_REST_STD.copy(), np.concatenate(differences)
    seen = np.repeat(std, [len(rows) for rows in differences], axis=0)
    for first, count in ((0, 3), (3, 1)):  # rest shows one direction of the accelerometer's bias
        columns, whole = slice(first, first + count), slice(first, first + 3)
        chi_square = float((stops[:, columns] ** 2 / (seen[:, columns] ** 2 + AT_REST_STD[columns] ** 2)).sum())
        if len(stops) and chi_square > chdtri(len(stops) * count, BY_CHANCE):
            out[whole] = np.maximum(MAD_TO_STD * np.median(np.abs(stops[:, whole]), axis=0), out[whole])
    return out


@torch.no_grad()
def _walk(model: BiasNetwork, pool: Pool, rest: Float[Tensor, "logs 6"]) -> Float[Tensor, "6"]:
    """Random walk of the rest biases: the mean of its logarithm, given all logs and a normal prior about `USUAL_WALK`."""
    walk = torch.from_numpy(USUAL_WALK).to(rest, copy=True)
    logarithm = torch.from_numpy(np.log(WALKS)).to(pool.t.device)
    for sensor in pool.sensors:
        shown = of_each(partial(_log_likelihood_of_walks, model, sensor, pool, rest), range(len(pool.names)))
        likely = torch.softmax(sum(shown) - 0.5 * (logarithm / math.log(WALK_FACTOR)).square(), dim=0)
        walk[COLUMNS[sensor]] *= float((likely * logarithm).sum().exp())
    return walk


def _log_likelihood_of_walks(
    model: BiasNetwork, sensor: Sensor, pool: Pool, rest: Float[Tensor, "logs 6"], log: int
) -> Float[Tensor, " walks"]:
    """Logarithm of the likelihood of each of `WALKS`, given the residuals of one log's windows.

    In world axes a residual is the bias, carried through the window, with the log's nuisances, the difference of the poses'
    errors at both ends and noise of the window's own. The bias is constant but for its walk. It is not known how large
    the errors are and how long those of the poses last: all sizes, shares and times of a grid count alike.
    """
    if (found := _walked_residuals(model, sensor, pool, rest, log)) is None:
        return torch.zeros(len(WALKS), dtype=torch.float64, device=pool.t.device)
    y, walked, poses = found
    errors = torch.from_numpy(POSE_SHARES).to(y)[:, None, None, None] * poses + torch.eye(len(y)).to(y)
    L = torch.linalg.cholesky(errors.flatten(0, 1))
    by_L = torch.linalg.solve_triangular(L, walked.expand_as(L), upper=False)
    eigenvalues, V = torch.linalg.eigh(torch.linalg.solve_triangular(L, by_L.mT, upper=False))
    square = (V.mT @ torch.linalg.solve_triangular(L, y.expand(len(L), -1, 1), upper=False))[..., 0].square()
    walks = (torch.from_numpy(WALKS).to(y) * USUAL_WALK[COLUMNS[sensor].start]) ** 2
    scale = torch.from_numpy(ERROR_SHARES).to(y) * y.square().mean().clamp_min(MIN_SQUARE)
    variance = scale[:, None, None] + walks[:, None, None, None] * eigenvalues.clamp_min(0.0)
    log_likelihood = -0.5 * (square / variance + variance.log()).sum(-1) - torch.diagonal(L, dim1=1, dim2=2).log().sum(1)
    return torch.logsumexp(log_likelihood.flatten(1), dim=1)


def _walked_residuals(
    model: BiasNetwork, sensor: Sensor, pool: Pool, rest: Float[Tensor, "logs 6"], log: int
) -> tuple[Float[Tensor, "r 1"], Float[Tensor, "r r"], Float[Tensor, "times r r"]] | None:
    """Combinations of a log's residuals that no constant changes; their covariances by walks and by pose errors of one."""
    begin, end = (int(torch.searchsorted(pool.log, log, right=right)) for right in (False, True))
    n = pool.samples(min(max((end - begin) / pool.rate_hz / MAX_WINDOWS, WALK_WINDOW_S), LONGEST_WALK_WINDOW_S[sensor]))
    later = torch.linspace(0, min(pool.samples(AVERAGED_S), n // 2), AVERAGED, device=pool.t.device).long()
    first = n * torch.arange(max(end - begin - 1 - int(later[-1]), 0) // n, device=pool.t.device)
    at, trusted = first[:, None] + later, pool.trusted[begin:end]
    broken = torch.cumsum(pool.late[begin:end] | ~trusted, dim=0)
    first = begin + first[((broken[at + n] == broken[at]) & trusted[at]).all(1)]
    first = first[:: max(1, -(-len(first) // MAX_WINDOWS))]
    if 3 * len(first) < 3 + len(NUISANCE_STD[sensor]) + MIN_COMBINATIONS:
        return None
    means = []
    for start in first + later[:, None]:
        windows = pool.windows(start, n, rest[pool.log[start]])
        e, by_sample = closed_form.sensor_residual(model, sensor, windows)
        gyro, accel = (u - bias[:, None] for u, bias in map(windows.segment.of, SENSORS))
        of_all = torch.cat([by_sample.sum(1), closed_form.nuisance_jacobian(sensor, windows, gyro, accel), e[..., None]], dim=2)
        means.append((windows.R_end @ of_all if sensor == "gyro" else of_all).double())  # in world axes
    mean = torch.stack(means).mean(0)
    constants, e = mean[..., :-1].flatten(0, 1), mean[..., -1:].flatten(0, 1)
    free = torch.linalg.qr(constants, mode="complete")[0][:, constants.shape[1] :].mT
    begins, ends = (pool.t[first + at].double() for at in (int(later[-1]) // 2, int(later[-1]) // 2 + n))
    since, J = (begins + ends - begins[0] - ends[0]) / 2, mean[..., :3]
    walked = torch.einsum("iac,ij,jbc->iajb", J, torch.minimum(since[:, None], since), J).flatten(2).flatten(0, 1)
    poses = [torch.kron(_of_differences(begins, ends, error_s), torch.eye(3).to(e)) for error_s in POSE_ERROR_S]
    return free @ e, free @ walked @ free.mT, free @ torch.stack(poses) @ free.mT


def _of_differences(begins: Float[Tensor, " m"], ends: Float[Tensor, " m"], error_s: float) -> Float[Tensor, "m m"]:
    """Covariance of end minus begin of an error of unit variance that decays by e in `error_s`."""
    t_s, eye = torch.cat([begins, ends]), torch.eye(len(begins)).to(begins)
    minus = torch.cat([-eye, eye], dim=1)
    return minus @ torch.exp(-(t_s[:, None] - t_s).abs() / error_s) @ minus.mT


@torch.no_grad()
def _start_spread(model: BiasNetwork, pool: Pool, rest: Float[Tensor, "logs 6"]) -> Float[Tensor, "6"]:
    """How far a rest bias from `TRUTH_S` of truth lies from its log's, as a robust standard deviation."""
    n = pool.samples(TRUTH_S)
    rows_of = [torch.nonzero(pool.log == log)[:, 0] for log in range(len(pool.names))]

    def missed(start: tuple[int, int]) -> Vector6 | None:
        log, first = start
        some = rows_of[log][(rows_of[log] >= first) & (rows_of[log] <= first + n)]
        trusted = pool.trusted[some]
        if len(some) <= n or not bool(trusted[0]) or float(trusted.double().mean()) < MIN_TRUSTED:
            return None
        u = torch.cat([pool.gyro[some], pool.accel[some]], dim=1)
        t = pool.t[some] - pool.t[some[0]]
        segment = Segment(t[None], u[None, :, :3], u[None, :, 3:], rest[log][None])
        residual = (u - model(segment)[0]).cpu().double().numpy()
        q_wb_wxyz = so3.quaternion_wxyz_from_matrix(pool.R_wb[some].double())
        seconds, q, v_w = (x.cpu().double().numpy() for x in (t, q_wb_wxyz, pool.v_w[some]))
        return bias_from_truth(seconds, residual, q, v_w, trusted.cpu().numpy())

    starts = [(log, first) for log, rows in enumerate(rows_of) for first in rows[:: max(1, n // 2)].tolist()]
    off = [bias for bias in of_each(missed, starts) if bias is not None]
    unknown = torch.tensor([TURN_ON_STD["gyro"]] * 3 + [TURN_ON_STD["accel"]] * 3).to(rest)
    if len(off) < FEWEST_STARTS:
        return unknown
    spread = np.maximum(MAD_TO_STD * np.median(np.abs(off), axis=0), MIN_TRUTH_STD)
    shown = torch.tensor([sensor in pool.sensors for sensor in SENSORS]).repeat_interleave(3).to(rest.device)
    return torch.where(shown, torch.from_numpy(spread).to(rest), unknown)


def _samples(pool: Pool) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Each log's seconds, gyro and accel."""
    parts = [pool.log == log for log in range(len(pool.names))]
    return [tuple(x[part].cpu().double().numpy() for x in (pool.t, pool.gyro, pool.accel)) for part in parts]  # type: ignore[misc]
