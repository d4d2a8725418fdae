"""Whole logs corrected once, so that windows of them can be scored again and again without the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from imutool.bias import static
from imutool.bias.model import BiasModel, Segment
from imutool.training.segments import Part, Pool
from imutool.units import SENSORS, Sensor

CHUNK = 8192  # samples at a time: what is in memory does not depend on how long a log is


@torch.no_grad()
def corrected(model: BiasModel, pool: Pool, part: Part = "all", sensors: Sequence[Sensor] = SENSORS) -> tuple[BiasModel, Pool]:
    """A model and a pool that are scored over windows as the given ones at work over whole logs.

    A model that looks back (`BiasModel.context`) would be shown a window without the samples before it, and would be computed
    anew for every window that overlaps another. What it adds to the rest bias depends on the samples alone: here it is taken
    off them, with their real history, and a constant remains. Only the samples of `part` and the columns of `sensors` are
    corrected. Models that do not look back, and their pool, come back as they are.
    """
    if not model.context:
        return model, pool
    columns = {"gyro": pool.gyro.clone(), "accel": pool.accel.clone()}
    nothing = pool.t.new_zeros(1, 6)
    wanted = torch.ones_like(pool.held_out) if part == "all" else pool.held_out == (part == "held_out")
    for log in range(len(pool.names)):
        rows = torch.nonzero(wanted & (pool.log == log))[:, 0]
        for some in torch.split(rows, CHUNK):
            index = pool.around(some[:1], model.context, len(some) - 1)[0]
            t = pool.t[index]
            segment = Segment((t - t[0])[None], pool.gyro[index][None], pool.accel[index][None], nothing)
            for sensor in sensors:
                columns[sensor][some] -= model.sensor_bias(sensor, segment)[0, model.context :]
    return static.Model().to(pool.t), replace(pool, gyro=columns["gyro"], accel=columns["accel"])


def up_to(sensor: Sensor) -> Sequence[Sensor]:
    """A sensor and those trained before it: the accelerometer's errors depend on the gyro, not the other way round."""
    return SENSORS[: SENSORS.index(sensor) + 1]
