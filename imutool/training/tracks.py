"""What belongs to a run and not to its sensor: the rest bias of each training log, free to move, but slowly.

Fitted beside the weights, so that a turn-on bias or its drift is not mistaken for something the motion does.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from imutool.bias.model import COLUMNS
from imutool.training.segments import Pool
from imutool.units import SENSORS, Sensor

TRACK_UNIT = {"gyro": 1e-1, "accel": 1.0}  # one unit of a track's parameter, rad/s and m/s²
TRACK_WALK = {"gyro": 1e-4, "accel": 2e-3}  # how far a rest bias may walk in a second^1/2, rad/s and m/s²


class Tracks(nn.Module):
    """The rest bias of each log as a polyline in time, a knot every `knot_s`."""

    def __init__(self, pool: Pool, knot_s: float) -> None:
        super().__init__()
        ends = [float(pool.t[pool.log == i].max()) for i in range(len(pool.names))]
        self.counts = [max(2, round(end / knot_s) + 1) for end in ends]
        self.knot_s = knot_s
        device = pool.t.device
        self.offset = torch.tensor([sum(self.counts[:i]) for i in range(len(ends))], device=device)
        self.last = torch.tensor(self.counts, device=device) - 1
        self.knots = nn.Parameter(torch.zeros(sum(self.counts), 6, dtype=pool.t.dtype, device=device))
        unit = [TRACK_UNIT[sensor] for sensor in SENSORS for _ in range(3)]
        self.unit = torch.tensor(unit, dtype=pool.t.dtype, device=device)

    def at(self, log: Int[Tensor, " batch"], t: Float[Tensor, " batch"]) -> Float[Tensor, "batch 6"]:
        """The rest bias of some logs at some times (s from the log's start)."""
        place = (t / self.knot_s).clamp(min=0)
        j = torch.minimum(place.long(), self.last[log] - 1)
        weight = (place - j).clamp(max=1.0)[:, None]
        first = self.offset[log] + j
        return torch.lerp(self.knots[first], self.knots[first + 1], weight) * self.unit

    def per_log(self) -> Float[Tensor, "logs 6"]:
        """The mean rest bias of each log."""
        means: Tensor = torch.stack([part.mean(0) for part in self._parts()]) * self.unit
        return means

    def set(self, sensor: Sensor, rest: Float[Tensor, "logs 3"]) -> None:
        """Makes a sensor's tracks constant."""
        columns = COLUMNS[sensor]
        with torch.no_grad():
            for part, value in zip(self._parts(), rest, strict=True):
                part[:, columns] = value / self.unit[columns]

    def _parts(self) -> tuple[Tensor, ...]:
        """The knots of each log."""
        return torch.split(self.knots, self.counts)

    def wandering(self, sensor: Sensor) -> Float[Tensor, ""]:
        """Minus the log-likelihood of the tracks as random walks, summed over the logs."""
        columns = COLUMNS[sensor]
        step = torch.cat([torch.diff(part[:, columns], dim=0) for part in self._parts()])
        sigma = TRACK_WALK[sensor] * self.knot_s**0.5 / self.unit[columns]
        cost: Tensor = 0.5 * (step / sigma).square().sum()
        return cost
