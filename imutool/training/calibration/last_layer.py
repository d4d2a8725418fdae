"""Curve of the motion in closed form, W u + V x, behind layers that were drawn.

The curve is linear in W and V. A descent on batches ends about their minimum, where the noise of the batches takes
combinations that the motion hardly shows to and fro. Least squares have one minimum, and features that were drawn predict
left-out logs better than features that were descended to (docs/measurements/left-out-logs.md). They are the least squares of
named effects (`imutool.training.calibration.normal_equations`): windows up to 40 s, each log's own rest bias and nuisances
next to the shared weights, errors as large as the logs scatter. V is zero where it does not predict left-out logs surely better
than W alone.

Source of features that are drawn: Rahimi and Recht, "Random features for large-scale kernel machines", NIPS 2007.
"""

from __future__ import annotations

import torch
from scipy.special import ndtr, stdtrit
from torch import Tensor

from imutool.array_types import Float
from imutool.bias.networks.network import BiasNetwork, Segment
from imutool.training.calibration.closed_form import W_PRIOR
from imutool.training.calibration.log_scatter import MIN_GAIN, SURELY
from imutool.training.calibration.normal_equations import Seen, Terms, linearise
from imutool.training.calibration.shared_parameters import TINY
from imutool.training.training_windows import Pool
from imutool.units import Sensor

WEIGHT_PRIOR = 2.4  # factor of the prior's root of the weights, in the unit of the curve: chosen by left-out logs of FETCH


@torch.no_grad()
def solve_last_layer(model: BiasNetwork, sensor: Sensor, pool: Pool, rest: Float[Tensor, "logs 6"]) -> None:
    """Solve for the last layer of a sensor's motion bias, where left-out logs want it.

    Only the training parts of the logs count. `rest` are their rest biases.

    Raises:
        DataError: a log without a window that is free of gaps.
    """
    if (layer := model.last_layer(sensor)) is None:
        return
    gyro, inputs = pool.gyro.clone(), []
    for log, bias in enumerate(rest):
        rows = pool.log == log
        t = pool.t[rows]
        whole = Segment((t - t[0])[None], pool.gyro[rows][None], pool.accel[rows][None], bias[None])
        inputs.append(layer.inputs(whole)[0])
        if sensor == "accel":
            gyro[rows] -= model.sensor_bias("gyro", whole)[0]
    root = layer.prior_root.to(gyro)
    values = torch.cat([pool.of_sensor(sensor), torch.cat(inputs) @ root], dim=1)
    width = values.shape[1]
    std = torch.full((3, width), WEIGHT_PRIOR).to(values)
    std[:, :3] = W_PRIOR
    by_axis = torch.eye(3 * width).to(values).reshape(3, width, 3 * width)
    problem = linearise(Seen(pool, sensor, gyro), Terms(values, by_axis, std.flatten() ** -2.0), "train")
    every = range(len(problem.theta))
    matrix = [k for k in every if k % width < 3]
    if not _is_surely_less(*(problem.predicted(columns, by_scatter=True) for columns in (every, matrix))):
        return
    theta = problem.solve_by_scatter(every).theta.reshape(3, width)
    layer.W.copy_(theta[:, :3])
    layer.out.copy_(theta[:, 3:] @ root.mT)


def _is_surely_less(new: Float[Tensor, " logs"], loss: Float[Tensor, " logs"]) -> bool:
    """Whether losses of logs are less beyond their scatter; never of one log, which others do not predict.

    A scatter of few logs is uncertain itself, so the standard errors are Student's.
    """
    gain = (loss.clamp_min(TINY) / new.clamp_min(TINY)).log()
    if len(gain) < 2:
        return False
    surely = float(stdtrit(len(gain) - 1, ndtr(SURELY)))
    return bool(gain.mean() > max(MIN_GAIN, surely * float(gain.std()) / len(gain) ** 0.5))
