"""Errors of a model over the held-out parts of its training logs, and its drift in an hour."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from imutool.array_types import Float, Int
from imutool.bias.networks.network import BiasNetwork, Segment
from imutool.bias.networks.threads import of_each
from imutool.errors import DataError
from imutool.training.bias_spread import TURN_ON_STD
from imutool.training.calibration import closed_form
from imutool.training.objectives.objective import BATCH_SAMPLES, error
from imutool.training.training_windows import Pool, corrected, sensors_up_to
from imutool.units import COLUMNS, Sensor

LONGEST_S = {"gyro": 20.0, "accel": 5.0}
HOP_S = 1.0
HOUR_S = 3600.0
AT_ONCE = 1_000_000  # samples of several logs in one pass


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
    columns, counts = COLUMNS[sensor], [int((pool.log == log).sum()) for log in range(len(rest))]
    for logs in _alike(counts):  # in one pass: a step of many takes hardly longer than of one
        bias, n = rest[logs], counts[logs[0]]
        t, u, passes = [], [], []
        for log, start in zip(logs, bias, strict=True):
            rows = pool.log == log
            t_s, motion = pool.t[rows] - pool.t[rows][0], torch.cat([pool.gyro[rows], pool.accel[rows]], dim=1)
            passes.append(math.ceil(HOUR_S / float(t_s[-1])))
            at_rest = torch.cat([start[:3], motion[:, 3:].mean(dim=0)]).expand_as(motion)
            beyond = torch.arange(n - len(motion), device=motion.device)  # up to the longest: nobody looks at it
            last_s = t_s[-1] + (beyond + 1) * (t_s[-1] - t_s[0]) / (len(t_s) - 1)
            t += [torch.cat([t_s, last_s])] * 2
            u += [torch.cat([x, x[-1:].expand(len(beyond), -1)]) for x in (at_rest, motion)]
        shared_t, shared_u, state = torch.stack(t), torch.stack(u), bias.repeat_interleave(2, dim=0)
        for k in range(max(passes)):
            path = model.rest_bias(sensor, Segment(shared_t, shared_u[..., :3], shared_u[..., 3:], state))
            for j, log in enumerate(logs):
                own = path[2 * j : 2 * j + 2, : counts[log]]
                if k < passes[j] and (own - bias[j, columns]).abs().max() > TURN_ON_STD[sensor]:
                    return True
                state[2 * j : 2 * j + 2, columns] = own[:, -1]
    return False


def _alike(counts: Sequence[int]) -> Iterator[list[int]]:
    """Logs in groups, the longest first: each has at least half of the samples of its group's longest."""
    waiting = sorted(range(len(counts)), key=lambda log: -counts[log])
    while waiting:
        longest = counts[waiting[0]]
        alike = [log for log in waiting if 2 * counts[log] >= longest][: max(1, AT_ONCE // (2 * longest))]
        waiting = waiting[len(alike) :]
        yield alike


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
