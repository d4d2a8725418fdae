"""Objectives of the descent and its steps: window errors, a robust loss, free rest biases.

The paper's losses are mean squares (eq. 16, 17). Here the error of a window is divided by the median error of windows of its
length and log, and goes through Huber's function: an outlier of the motion capture pulls no harder than an ordinary window, and
windows of every length and every log count alike. An objective draws its own batches from the training part. A model names the
objective it wants (`BiasNetwork.objective`).

The rest bias of each log belongs to the run, not to the sensor. It is fitted together with the weights, free but slow, so that
a turn-on bias or its drift is not attributed to the motion.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.adamw import adamw

from imutool.array_types import Float, Int
from imutool.bias.networks.network import BiasNetwork
from imutool.bias.networks.threads import of_each
from imutool.geometry import so3
from imutool.inertial.strapdown import GRAVITY_W
from imutool.inertial.windows import HUBER_MEDIANS, attitudes, huber, step_means
from imutool.training.calibration.closed_form import median_per_log
from imutool.training.settings import TrainSettings
from imutool.training.training_windows import Pool, Windows
from imutool.units import COLUMNS, SENSORS, Sensor

TRACK_UNIT = {"gyro": 1e-1, "accel": 1.0}  # one unit of a track's parameter, rad/s and m/s²
TRACK_WALK = {"gyro": 1e-4, "accel": 2e-3}  # how far a rest bias may walk in a second^1/2, rad/s and m/s²


class AdamW:
    """AdamW by the function of PyTorch.

    PyTorch's class would import the compiler of PyTorch, which takes a second of CPU time.

    Attributes:
        state: what the next step depends on, by weight, in the order of the groups.
    """

    def __init__(self, groups: Sequence[tuple[Sequence[Tensor], float]]) -> None:
        self.groups = groups  # weights, and how fast they decay
        self.state: dict[Tensor, dict[str, Tensor]] = {
            weight: {"exp_avg": torch.zeros_like(weight), "exp_avg_sq": torch.zeros_like(weight), "step": torch.tensor(0.0)}
            for weights, _ in groups
            for weight in weights
        }

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """Move the weights that have a gradient."""
        for weights, decay in self.groups:
            some = {weight: weight.grad for weight in weights if weight.grad is not None}
            means, squares, steps = ([self.state[w][name] for w in some] for name in ("exp_avg", "exp_avg_sq", "step"))
            usual: dict[str, Any] = {"beta1": 0.9, "beta2": 0.999, "eps": 1e-8, "amsgrad": False, "maximize": False}
            adamw([*some], [*some.values()], means, squares, [], steps, lr=rate, weight_decay=decay, **usual)


class RestBiases(nn.Module):
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


def orientation_error(model: BiasNetwork, windows: Windows) -> Float[Tensor, " batch"]:
    """|Log(R_hat^T R)| at the end of each window, in rad (paper, eq. 16, at the last sample)."""
    return length(so3.log(model.end_attitude(windows.R_start, windows.segment, windows.dt).mT @ windows.R_end))


def motion_error(model: BiasNetwork, windows: Windows) -> Float[Tensor, " batch"]:
    """|v_hat - v| and |p_hat - p| / window together, at the end of each window, in m/s.

    Paper, eq. 17, in one unit. The attitude follows the debiased gyro, whose weights this stage leaves alone.
    """
    segment, dt = windows.segment, windows.dt[..., None]
    with torch.no_grad():
        R_wb = attitudes(windows.R_start, segment.gyro - model.sensor_bias("gyro", segment), windows.dt)
    accel = segment.accel - model.sensor_bias("accel", segment)
    a_w = (R_wb @ accel[..., None])[..., 0] + accel.new_tensor(GRAVITY_W)
    rise = torch.cumsum(step_means(a_w) * dt, dim=1)
    velocity = windows.v_start + rise[:, -1] - windows.v_end
    risen = torch.cat([torch.zeros_like(rise[:, :1]), rise], dim=1)
    moved = (windows.v_start[:, None] + step_means(risen)) * dt
    position = (windows.p_start + moved.sum(1) - windows.p_end) / windows.dt.sum(1, keepdim=True)
    return length(torch.cat([velocity, position], dim=1))


def error(model: BiasNetwork, sensor: Sensor, windows: Windows) -> Float[Tensor, " batch"]:
    """Training error of a sensor: orientation for the gyro (rad), motion for the accel (m/s)."""
    return orientation_error(model, windows) if sensor == "gyro" else motion_error(model, windows)


class RobustLoss:
    """Huber's loss, its width 1.5 medians of the errors at the stage's start.

    Each length of windows of each log has its own median. Fixed during a stage, so that the loss can be followed; by log,
    because truths differ in quality by a factor of eight.
    """

    def __init__(self, medians: Mapping[int, Float[Tensor, " logs"]]) -> None:
        self.medians = medians

    def __call__(self, size: Float[Tensor, " batch"], log: Int[Tensor, " batch"], n: int) -> Float[Tensor, ""]:
        """Mean loss of windows of n steps."""
        return huber(size, HUBER_MEDIANS * self.medians[n][log]).mean()


def length(v: Float[Tensor, "*batch k"]) -> Float[Tensor, "*batch"]:
    """Euclidean length with a finite gradient at zero."""
    return (v.square().sum(dim=-1) + 1e-24).sqrt()


USUAL_SAMPLES = 200_000  # enough for a median
BATCH_SAMPLES = 40_000  # at a time where no gradient is kept


class Objective(ABC):
    """Errors of one sensor over batches of the training part, made comparable by a robust loss.

    Attributes:
        loss: its widths are fixed from the model as it stands when the objective is made; a checkpoint keeps them.
    """

    def __init__(self, model: BiasNetwork, sensor: Sensor, pool: Pool, tracks: RestBiases, settings: TrainSettings) -> None:
        self.model, self.sensor, self.pool, self.tracks, self.settings = model, sensor, pool, tracks, settings
        self._choose()
        with torch.no_grad():
            self.loss = RobustLoss(self._usual())

    @abstractmethod
    def _choose(self) -> None:
        """Chooses the lengths, and where in the training part they fit."""

    @abstractmethod
    def _usual(self) -> dict[int, Float[Tensor, " logs"]]:
        """The median error of each log, for each length in samples."""

    @abstractmethod
    def terms(self, generator: torch.Generator) -> Sequence[Callable[[], Float[Tensor, ""]]]:
        """Functions for the parts of one step's loss, on a batch drawn with the generator; the longest first."""

    @abstractmethod
    def settle(self) -> None:
        """Leaves the tracks as they should be now that the stage is over and the model is the one kept."""


class WindowEndObjective(Objective):
    """What integration misses at the end of windows of several lengths."""

    def _choose(self) -> None:
        lengths = dict.fromkeys(self.pool.samples(window_s) for window_s in self.settings.window_s[self.sensor])
        self.pools = [(n, first) for n in lengths if len(first := self.pool.starts(n, "train"))]

    def errors(self, first: Int[Tensor, " m"], n: int) -> Float[Tensor, " m"]:
        """The errors of the windows of n steps that start at some samples (rad or m/s)."""
        rest = self.tracks.at(self.pool.log[first], self.pool.t[first])
        return error(self.model, self.sensor, self.pool.windows(first, n, rest))

    def _usual(self) -> dict[int, Float[Tensor, " logs"]]:
        usual = {}
        for n, first in self.pools:
            some = first[:: max(1, -(-len(first) * n // USUAL_SAMPLES))]
            size = torch.cat(of_each(partial(self.errors, n=n), torch.split(some, max(1, BATCH_SAMPLES // n))))
            usual[n] = median_per_log(size, self.pool.log[some], self.pool.minimum(self.sensor))
        return usual

    def terms(self, generator: torch.Generator) -> Sequence[Callable[[], Float[Tensor, ""]]]:
        """One term a length, over windows drawn from all logs alike."""
        terms = []
        for n, first in self.pools:
            count = max(4, self.settings.samples // n)
            chosen = torch.randint(len(first), (count,), generator=generator).to(first.device)
            terms.append(partial(self._term, first[chosen], n))
        return terms[::-1]

    def _term(self, first: Int[Tensor, " m"], n: int) -> Float[Tensor, ""]:
        return self.loss(self.errors(first, n), self.pool.log[first], n)

    def settle(self) -> None:
        """Nothing: windows of many seconds have shown the rest biases as well as anything can."""
