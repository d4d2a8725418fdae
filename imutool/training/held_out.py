"""Errors of a model over the held-out parts of its training logs, and its drift in an hour."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from imutool.array_types import Float, Int
from imutool.bias.model import COLUMNS
from imutool.bias.networks.network import BiasNetwork, Segment
from imutool.bias.networks.threads import of_each
from imutool.errors import DataError
from imutool.training.bias_spread import TURN_ON_STD
from imutool.training.calibration import closed_form
from imutool.training.objectives.objective import BATCH_SAMPLES, error
from imutool.training.training_windows import Pool, corrected, sensors_up_to
from imutool.units import Sensor

LONGEST_S = {"gyro": 20.0, "accel": 5.0}
HOP_S = 1.0
HOUR_S = 3600.0


def held_out_errors(
    model: BiasNetwork, sensor: Sensor, pool: Pool, rest: Float[Tensor, "logs 6"], window_s: Sequence[float]
) -> tuple[Float[Tensor, " m"], Int[Tensor, " m"]]:
    """Errors over the longest windows of the held-out parts (rad or m/s), and the log of each.

    Each log's constant is solved for on that part first, over windows of `window_s`: it belongs to the run, and what is judged
    here is the sensor. `rest` are the constants to begin with.

    Raises:
        DataError: a log without truth in its held-out part.
    """
    first, n = _windows(pool, sensor)
    rest, columns = rest.clone(), COLUMNS[sensor]
    rest[:, columns] = model.rest_at_work(sensor, rest[:, columns])
    scored, pool = corrected(model, pool, "held_out", sensors_up_to(sensor))
    solved = closed_form.solve(scored, sensor, pool, rest, window_s, matrix=False, part="held_out", nuisances=False)
    rest[:, columns] = solved.rest
    with torch.no_grad():
        parts = torch.split(first, max(1, BATCH_SAMPLES // n))
        errors = of_each(lambda some: error(scored, sensor, pool.windows(some, n, rest[pool.log[some]])), parts)
    return torch.cat(errors), pool.log[first]


@torch.no_grad()
def runs_away(model: BiasNetwork, sensor: Sensor, pool: Pool, rest: Float[Tensor, "logs 6"]) -> bool:
    """Whether a drift carries the bias of a log further than a new turn-on does.

    In an hour at rest, or in an hour of the log's motion, again and again. The logs are minutes long, and a field that is
    right for minutes may be wrong without bound. `rest` are their biases.
    """
    columns = COLUMNS[sensor]
    for log, bias in enumerate(rest):
        rows = pool.log == log
        t, motion = pool.t[rows] - pool.t[rows][0], torch.cat([pool.gyro[rows], pool.accel[rows]], dim=1)
        at_rest = torch.cat([bias[:3], motion[:, 3:].mean(dim=0)]).expand_as(motion)
        u, state = torch.stack([at_rest, motion]), bias.repeat(2, 1)  # both in one pass: four fifths of the time of two
        for _ in range(math.ceil(HOUR_S / float(t[-1]))):
            path = model.rest_bias(sensor, Segment(t.expand(2, -1), u[..., :3], u[..., 3:], state))
            if (path - bias[columns]).abs().max() > TURN_ON_STD[sensor]:
                return True
            state[:, columns] = path[:, -1]
    return False


def _windows(pool: Pool, sensor: Sensor) -> tuple[Int[Tensor, " m"], int]:
    """First samples of the windows, and their steps."""
    window_s, of_log = LONGEST_S[sensor], [torch.empty(0)] * len(pool.names)
    while window_s > 0.1:
        n = pool.samples(window_s)
        first = pool.starts(n, "held_out", ends_only=True)
        of_log = [first[pool.log[first] == i][:: pool.samples(HOP_S)] for i in range(len(pool.names))]
        if all(len(part) for part in of_log):
            return torch.cat(of_log), n
        window_s *= 0.8
    raise DataError(
        "the last fifth of the log holds no stretch of truth",
        where=", ".join(name for name, part in zip(pool.names, of_log, strict=True) if not len(part)),
        expected="truth to the end of each log",
        fix="Leave that log out or cut it",
    )
