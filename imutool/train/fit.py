"""The training: a closed form to start from, then gradient descent, gyro first and the accelerometer on top of it.

Every step draws windows of several lengths from all logs at once. Beside the sensor's weights each log has a track of its
own rest bias, free but slow, so that what belongs to a run cannot be mistaken for what belongs to the sensor. The model kept is
the one that drifts least over the longest windows of the held-out part, the closed form it started from included.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import msgspec
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from imutool import registry
from imutool.bias._base import COLUMNS, SENSORS, BiasModel, Sensor
from imutool.config import Settings, build
from imutool.errors import ConfigError, DataError, NumericsError
from imutool.recording import Recording
from imutool.train import closed_form, statistics
from imutool.train.loss import RobustLoss, error
from imutool.train.segments import Pool

Positive = Annotated[float, msgspec.Meta(gt=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]

TRACK_UNIT = {"gyro": 1e-1, "accel": 1.0}  # one unit of a track's parameter, rad/s and m/s²
TRACK_WALK = {"gyro": 1e-4, "accel": 2e-3}  # how far a rest bias may walk in a second^1/2, rad/s and m/s²
LONGEST_HELD_OUT_S = {"gyro": 20.0, "accel": 5.0}
TRIM = 0.9  # the worst tenth of the held-out windows is where the truth has outliers


class TrainSettings(Settings, frozen=True):
    """How to train; `model` holds the settings of the method (`imutool/bias/METHOD.py`, class Config)."""

    seed: int = 0
    gyro_window_s: tuple[Positive, ...] = (1.0, 4.0, 15.0)
    accel_window_s: tuple[Positive, ...] = (0.5, 2.0)
    samples: Count = 10_000
    steps: Count = 300
    learning_rate: Positive = 3e-3
    weight_decay: Annotated[float, msgspec.Meta(ge=0)] = 1e-4
    track_knot_s: Positive = 20.0
    validate_every: Count = 20
    model: dict[str, Any] = msgspec.field(default_factory=dict)


@dataclass(frozen=True)
class Epoch:
    """One line of progress: errors are rad for the gyro's stage and m/s for the accelerometer's."""

    sensor: Sensor
    step: int
    steps: int
    loss: float
    held_out: float
    best: float
    left_s: float


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


@dataclass
class Stage:
    """What one sensor's descent must remember to go on: also what a checkpoint holds."""

    sensor: Sensor
    optimizer: torch.optim.Optimizer
    loss: RobustLoss = field(default_factory=RobustLoss)
    step: int = 0
    best: float = float("inf")
    best_state: dict[str, Tensor] = field(default_factory=dict)


class Training:
    """Trains one model on the recordings of one sensor; `model` is the result, at any time the best so far.

    Raises:
        DataError: recordings without truth, of different rates, too short, or standing still.
        ConfigError: a method that is not trained, or settings it does not know.
    """

    def __init__(
        self, recordings: Sequence[Recording], method: str, settings: TrainSettings | None = None, device: str = "cpu"
    ) -> None:
        self.settings = settings or TrainSettings()
        if device.startswith("cuda") and not torch.cuda.is_available():
            raise ConfigError("no CUDA device here", where="--device", fix="Use --device cpu")
        module = registry.load("imutool.bias", method)
        self.pool = Pool.of(recordings, device=device)
        torch.manual_seed(self.settings.seed)
        config = build(module.Config, self.settings.model, where=f"model settings of {method}")
        self.model: BiasModel = module.Model(config, self.pool.rate_hz).double().to(device)
        self.tracks = Tracks(self.pool, self.settings.track_knot_s)
        self.generator = torch.Generator().manual_seed(self.settings.seed)
        self.done: dict[Sensor, float] = {}  # held-out error of each finished stage
        self.stage: Stage | None = None

    def epochs(self) -> Iterator[Epoch]:
        """Trains, yielding a line of progress now and then; may be left and entered again between two lines."""
        for sensor in SENSORS:
            if sensor in self.done:
                continue
            if self.stage is None:
                self._closed_form(sensor)
                self.stage = Stage(sensor, self.optimizer(sensor))
            yield from self._descend(self.stage)
            self.model.load_state_dict(self.stage.best_state)
            self.done[sensor], self.stage = self.stage.best, None
        lengths: dict[Sensor, tuple[float, ...]] = {sensor: self._window_s(sensor) for sensor in SENSORS}
        statistics.store(self.model, self.pool, self.tracks.per_log().detach(), lengths)
        self.model.requires_grad_(False).eval()

    def held_out(self, sensor: Sensor) -> float:
        """Error over the longest windows that fit the held-out parts: the mean without the worst tenth (rad or m/s)."""
        first, n = self._held_out_windows(sensor)
        with torch.no_grad():
            errors = torch.cat([self._errors(sensor, part, n) for part in torch.split(first, 256)])
        kept = errors.sort().values[: max(1, int(TRIM * len(errors)))]
        return float(kept.mean())

    def _held_out_windows(self, sensor: Sensor) -> tuple[Int[Tensor, " m"], int]:
        pool, window_s = self.pool, LONGEST_HELD_OUT_S[sensor]
        while window_s > 0.1:
            n = pool.samples(window_s)
            first = pool.starts(n, "held_out", hop=max(1, pool.samples(0.25)), ends_only=True)
            if len(torch.unique(pool.log[first])) == len(pool.names):
                return first, n
            window_s *= 0.8
        raise DataError(
            "the last fifth of a training log holds no stretch of truth",
            where=", ".join(pool.names),
            expected="truth to the end of each log",
            fix="Leave that log out or cut it",
        )

    def _errors(self, sensor: Sensor, first: Int[Tensor, " m"], n: int) -> Float[Tensor, " m"]:
        windows = self.pool.windows(first, n, self.tracks.at(self.pool.log[first], self.pool.t[first]))
        return error(self.model, sensor, windows)

    def _closed_form(self, sensor: Sensor) -> None:
        """Calibration and rest biases, as far as windows and a matrix show them."""
        rest = self.tracks.per_log().detach()
        self._take(sensor, closed_form.solve(self.model, sensor, self.pool, rest, self._window_s(sensor), matrix=True))

    def _window_s(self, sensor: Sensor) -> tuple[float, ...]:
        return self.settings.gyro_window_s if sensor == "gyro" else self.settings.accel_window_s

    def _take(self, sensor: Sensor, solution: closed_form.Solution) -> None:
        self.model.begin_at(sensor, solution.W)
        self.tracks.set(sensor, solution.rest)

    def optimizer(self, sensor: Sensor) -> torch.optim.Optimizer:
        """A fresh optimiser for one stage: the sensor's weights and the tracks."""
        rate, decay = self.settings.learning_rate, self.settings.weight_decay
        weights = [w for name, w in self.model.named_parameters() if f".{sensor}" in f".{name}"]
        groups = [
            {"params": weights, "weight_decay": decay},
            {"params": [self.tracks.knots], "weight_decay": 0.0},
        ]
        return torch.optim.AdamW(groups, lr=rate)

    def _descend(self, stage: Stage) -> Iterator[Epoch]:
        settings, sensor = self.settings, stage.sensor
        steps = settings.steps if self.model.iterative else 0
        lengths = map(self.pool.samples, self._window_s(sensor))
        pools = [(n, first) for n in lengths if len(first := self.pool.starts(n, "train"))]
        began, begun_at = time.monotonic(), stage.step
        loss = float("nan")
        while True:
            if stage.step % settings.validate_every == 0 or stage.step == steps:
                score = self._validate(stage)
                per_step = (time.monotonic() - began) / max(stage.step - begun_at, 1)
                yield Epoch(sensor, stage.step, steps, loss, score, stage.best, per_step * (steps - stage.step))
            if stage.step >= steps:
                return
            loss = self._one_step(stage, pools, steps)

    def _one_step(self, stage: Stage, pools: Sequence[tuple[int, Int[Tensor, " m"]]], steps: int) -> float:
        rate = self.settings.learning_rate * 0.5 * (1 + torch.cos(torch.tensor(torch.pi * stage.step / steps)).item())
        for group in stage.optimizer.param_groups:
            group["lr"] = rate
        # the losses are means over windows; a second of data counts once against the walk
        total = self.tracks.wandering(stage.sensor) / (len(self.pool.t) / self.pool.rate_hz)
        for n, first in pools:
            count = max(4, self.settings.samples // n)
            chosen = torch.randint(len(first), (count,), generator=self.generator).to(first.device)
            total = total + stage.loss(self._errors(stage.sensor, first[chosen], n), n)
        stage.optimizer.zero_grad()
        total.backward()  # type: ignore[no-untyped-call]
        if not bool(torch.isfinite(total)):
            raise NumericsError(
                f"the loss is {float(total)} at step {stage.step} of the {stage.sensor} stage",
                expected="a finite loss",
                fix="Lower --set learning_rate",
            )
        stage.optimizer.step()
        stage.step += 1
        return float(total.detach())

    def _validate(self, stage: Stage) -> float:
        score = self.held_out(stage.sensor)
        if score < stage.best:
            stage.best, stage.best_state = score, copy.deepcopy(self.model.state_dict())
        return score
