"""What the training runs say beside the calibration: how rest biases differ from run to run, and how sure a start can be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from imutool.bias._base import COLUMNS, SENSORS, BiasModel, Sensor
from imutool.stationary import white_noise
from imutool.train import closed_form
from imutool.train.segments import Pool
from imutool.turn_on import TRUTH_S

MAD_TO_STD = 1.4826
ONE_RUN_STD = {"gyro": 5e-3, "accel": 0.1}  # run-to-run spread when there is one run to judge by, rad/s and m/s²
FLOOR_STD = {"gyro": 5e-5, "accel": 2e-3}


def store(model: BiasModel, pool: Pool, rest: Float[Tensor, "logs 6"], window_s: Mapping[Sensor, Sequence[float]]) -> None:
    """Fills the model's prior, the spread of starts from truth, and the noise of a sample, from the training part."""
    for sensor in SENSORS:
        columns = COLUMNS[sensor]
        solution = closed_form.solve(model, sensor, pool, rest, window_s[sensor], matrix=False)
        rest = rest.clone()
        rest[:, columns] = solution.rest
        model.prior_mean[columns] = solution.rest.mean(0)
        model.prior_std[columns] = _run_to_run(sensor, solution.rest)
        model.truth_std[columns] = _start_spread(model, sensor, pool, rest)
        u = pool.gyro if sensor == "gyro" else pool.accel
        model.noise_std[columns] = torch.from_numpy(white_noise(u.cpu().numpy())).to(rest)


def _run_to_run(sensor: Sensor, rest: Float[Tensor, "logs 3"]) -> Float[Tensor, "3"]:
    """Spread of the next run about the mean of those seen: s sqrt(1 + 1/L)."""
    logs = len(rest)
    if logs < 2:
        return torch.full_like(rest[0], ONE_RUN_STD[sensor])
    spread: Tensor = rest.std(0) * (1 + 1 / logs) ** 0.5
    return spread.clamp_min(FLOOR_STD[sensor])


@torch.no_grad()
def _start_spread(model: BiasModel, sensor: Sensor, pool: Pool, rest: Float[Tensor, "logs 6"]) -> Float[Tensor, "3"]:
    """How far a rest bias from `TRUTH_S` of truth lies from its log's, as a robust standard deviation."""
    n = pool.samples(TRUTH_S)
    first = pool.starts(n, "all", hop=max(1, n // 4), ends_only=True)
    if len(first) < 4:
        return torch.full_like(rest[0, :3], ONE_RUN_STD[sensor])
    e, A = closed_form.sensor_residual(model, sensor, pool.windows(first, n, rest[pool.log[first]]))
    off = torch.linalg.solve(A.sum(1), e)
    spread: Tensor = MAD_TO_STD * off.abs().median(0).values
    return spread.clamp_min(FLOOR_STD[sensor])
