"""Spread of rest biases from run to run, and uncertainty of a start from truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from imutool.bias.model import COLUMNS
from imutool.bias.networks.network import BiasNetwork, Segment
from imutool.bias_start.bias_at_rest import rest_spread
from imutool.bias_start.bias_from_truth import TRUTH_S, bias_from_truth
from imutool.geometry import so3
from imutool.inertial.stationary import white_noise
from imutool.training import closed_form
from imutool.training.segments import Pool, corrected
from imutool.units import SENSORS, Sensor

MAD_TO_STD = 1.4826
ONE_RUN_STD = {"gyro": 5e-3, "accel": 0.1}  # run-to-run spread when there is one run to judge by, rad/s and m/s²
USUAL_STD = {"gyro": 5e-4, "accel": 2e-2}
LEAST_TRUSTED, FEWEST_STARTS = 0.5, 4
FLOOR_STD = {"gyro": 5e-5, "accel": 2e-3}


def store_statistics(
    model: BiasNetwork, pool: Pool, rest: Float[Tensor, "logs 6"], window_s: Mapping[Sensor, Sequence[float]]
) -> None:
    """Fills the model's prior, the spread of starts from truth, and the noise of a sample.

    From the training part.
    """
    scored, left = corrected(model, pool)
    for sensor in SENSORS:
        columns = COLUMNS[sensor]
        solution = closed_form.solve(scored, sensor, left, rest, window_s[sensor], matrix=False, part="all")
        rest = rest.clone()
        rest[:, columns] = solution.rest
        model.prior_mean[columns] = solution.rest.mean(0)
        model.prior_std[columns] = _run_to_run(sensor, solution.rest)
        u = pool.gyro if sensor == "gyro" else pool.accel
        model.noise_std[columns] = torch.from_numpy(white_noise(u.cpu().numpy())).to(rest)
    model.truth_std.copy_(_start_spread(scored, left, rest))
    model.walk_std.copy_(_walk(scored, left, rest, window_s))
    model.rest_std.copy_(torch.from_numpy(rest_spread(scored.frozen(), _samples(left), rest.cpu().double().numpy())))


def _run_to_run(sensor: Sensor, rest: Float[Tensor, "logs 3"]) -> Float[Tensor, "3"]:
    """Spread of the next run about the mean of those seen: s sqrt(1 + 1/L), s from the runs and one more of a usual spread.

    The spread of two or three runs is itself unsure, and mostly too small.
    """
    logs = len(rest)
    if logs < 2:
        return torch.full_like(rest[0], ONE_RUN_STD[sensor])
    squares = (rest - rest.mean(0)).square().sum(0) + USUAL_STD[sensor] ** 2
    return (squares / logs * (1 + 1 / logs)).sqrt()


def _walk(
    model: BiasNetwork, pool: Pool, rest: Float[Tensor, "logs 6"], window_s: Mapping[Sensor, Sequence[float]]
) -> Float[Tensor, "6"]:
    """How far rest biases walk in a second^1/2: the means over a log's two halves differ by walk sqrt(T / 3)."""
    begins = torch.searchsorted(pool.log, torch.arange(len(pool.names), device=pool.log.device))
    length = torch.bincount(pool.log)
    later = torch.arange(len(pool.t), device=pool.log.device) - begins[pool.log] >= length[pool.log] // 2
    names = tuple(f"{name} {half}" for name in pool.names for half in ("early", "late"))
    halves = replace(pool, log=2 * pool.log + later, names=names)
    both, out = rest.repeat_interleave(2, dim=0), []
    for sensor in SENSORS:
        columns = COLUMNS[sensor]
        both[:, columns] = closed_form.solve(model, sensor, halves, both, window_s[sensor], matrix=False, part="all").rest
        change = both[1::2, columns] - both[::2, columns]
        out.append((change.square() * (3.0 * pool.rate_hz / length)[:, None]).mean(0).sqrt())
    return torch.cat(out)


@torch.no_grad()
def _start_spread(model: BiasNetwork, pool: Pool, rest: Float[Tensor, "logs 6"]) -> Float[Tensor, "6"]:
    """How far a rest bias from `TRUTH_S` of truth lies from its log's, as a robust standard deviation."""
    n, off = pool.samples(TRUTH_S), []
    for log in range(len(pool.names)):
        rows = torch.nonzero(pool.log == log)[:, 0]
        for first in rows[:: max(1, n // 2)].tolist():
            some = rows[(rows >= first) & (rows <= first + n)]
            trusted = pool.trusted[some]
            if len(some) <= n or not bool(trusted[0]) or float(trusted.double().mean()) < LEAST_TRUSTED:
                continue
            u = torch.cat([pool.gyro[some], pool.accel[some]], dim=1)
            t = pool.t[some] - pool.t[some[0]]
            segment = Segment(t[None], u[None, :, :3], u[None, :, 3:], rest[log][None])
            left = (u - model(segment)[0]).cpu().double().numpy()
            q_wb_wxyz = so3.quaternion_wxyz_from_matrix(pool.R_wb[some].double())
            seconds, q, v_w = (x.cpu().double().numpy() for x in (t, q_wb_wxyz, pool.v_w[some]))
            off.append(bias_from_truth(seconds, left, q, v_w, trusted.cpu().numpy()))
    if len(off) < FEWEST_STARTS:
        return torch.tensor([ONE_RUN_STD["gyro"]] * 3 + [ONE_RUN_STD["accel"]] * 3).to(rest)
    floor = torch.tensor([FLOOR_STD["gyro"]] * 3 + [FLOOR_STD["accel"]] * 3)
    spread = MAD_TO_STD * np.median(np.abs(off), axis=0)
    return torch.maximum(torch.from_numpy(spread), floor).to(rest)


def _samples(pool: Pool) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Each log's seconds, gyro and accel."""
    parts = [pool.log == log for log in range(len(pool.names))]
    return [tuple(x[part].cpu().double().numpy() for x in (pool.t, pool.gyro, pool.accel)) for part in parts]  # type: ignore[misc]
