"""Last layer of a network in closed form, once the descent has shaped the layers below.

A motion bias W u + V x is linear in W and V. A descent on batches ends about their minimum, where the batches' noise takes
combinations that the motion hardly shows to and fro: models of five seeds differed by degrees a minute on FETCH. Least squares
have one minimum. They are those of named effects (`imutool.training.calibration.normal_equations`): windows up to 40 s, each
log's own rest bias and nuisances beside the shared weights, errors as large as the logs scatter. V is zero where it does not
predict left-out logs clearly better than W alone.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from imutool.array_types import Float
from imutool.bias.model import COLUMNS
from imutool.bias.networks.network import BiasNetwork, Segment
from imutool.training.calibration.closed_form import W_PRIOR
from imutool.training.calibration.normal_equations import Seen, Terms, gain_of, linearise
from imutool.training.training_windows import Pool
from imutool.units import Sensor

LEAST_GAIN = 0.03  # of the judged loss, for the layer to be worth its weights
WEIGHT_PRIOR = 0.3  # of a weight, in the unit of the curve: chosen by left-out training logs of FETCH


@torch.no_grad()
def solve_last_layer(model: BiasNetwork, sensor: Sensor, pool: Pool, rest: Float[Tensor, "logs 6"]) -> bool:
    """Solve for the last layer of a sensor's motion bias; whether the model has one.

    The training parts of the logs count. `rest` are their rest biases; what a drift adds to them stays as it is.

    Raises:
        DataError: a log without a window that is free of gaps.
    """
    if (layer := model.last_layer(sensor)) is None:
        return False
    samples, gyro, inputs = pool.of_sensor(sensor).clone(), pool.gyro.clone(), []
    for log, bias in enumerate(rest):
        rows = pool.log == log
        t = pool.t[rows]
        whole = Segment((t - t[0])[None], pool.gyro[rows][None], pool.accel[rows][None], bias[None])
        inputs.append(layer.inputs(whole)[0])
        samples[rows] -= model.rest_bias(sensor, whole)[0] - bias[COLUMNS[sensor]]
        if sensor == "accel":
            gyro[rows] -= model.sensor_bias("gyro", whole)[0]
    values = torch.cat([pool.of_sensor(sensor), torch.cat(inputs)], dim=1)
    corrected = replace(pool, gyro=samples) if sensor == "gyro" else replace(pool, accel=samples)
    problem = linearise(Seen(corrected, sensor, gyro), _by_axis(values), "train")
    every, width = range(len(problem.theta)), values.shape[1]
    matrix = [k for k in every if k % width < 3]
    losses = (problem.predicted(columns, by_scatter=True) for columns in (every, matrix))
    columns = every if gain_of(*losses) >= LEAST_GAIN else matrix
    W, out = problem.solve_by_scatter(columns).theta.reshape(3, width).split((3, width - 3), dim=1)
    layer.W.copy_(W)
    layer.out.copy_(out)
    return True


def _by_axis(values: Float[Tensor, "n q"]) -> Terms:
    """Terms with a parameter for each axis and value, of which the first three are the samples."""
    q = values.shape[1]
    pattern = torch.eye(3 * q).to(values).reshape(3, q, 3 * q)
    std = torch.full((3, q), WEIGHT_PRIOR).to(values)
    std[:, :3] = W_PRIOR
    return Terms(values, pattern, std.flatten() ** -2.0)
