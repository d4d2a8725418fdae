"""The training: a closed form to start from, then gradient descent, gyro first and the accelerometer on top of it.

Every step draws windows of several lengths from all logs at once. Beside the sensor's weights each log has a track of its
own rest bias, free but slow, so that what belongs to a run cannot be mistaken for what belongs to the sensor. The model
kept is the one that drifts least over the longest windows of the held-out part, the closed form it started from included.
What is judged and kept is a running mean over the last steps, which one step's draw of windows cannot throw off.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import msgspec
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from imutool import registry
from imutool.bias._base import COLUMNS, SENSORS, BiasModel, Sensor
from imutool.config import Settings, build
from imutool.errors import ConfigError, DataError, NumericsError
from imutool.recording import Recording
from imutool.train import closed_form, statistics
from imutool.train.closed_form import median_per_log
from imutool.train.loss import RobustLoss, error
from imutool.train.segments import Pool
from imutool.train.tracks import Tracks

Positive = Annotated[float, msgspec.Meta(gt=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]

LONGEST_HELD_OUT_S = {"gyro": 20.0, "accel": 5.0}
HELD_OUT_HOP_S = 1.0
USUAL_SAMPLES = 200_000  # enough for a median
WARM_UP_STEPS = 20
AVERAGE_STEPS = 30  # over which weights are averaged
TRIM = 0.9  # the worst tenth of the held-out windows is where the truth has outliers


class TrainSettings(Settings, frozen=True):
    """How to train; `model` holds the settings of the method (`imutool/bias/METHOD.py`, class Config)."""

    seed: int = 0
    gyro_window_s: tuple[Positive, ...] = (1.0, 4.0, 15.0)
    accel_window_s: tuple[Positive, ...] = (0.5, 2.0)
    samples: Count = 8_000
    steps: Count = 300
    gyro_rate: Positive = 1e-2  # learning rates
    accel_rate: Positive = 3e-3
    weight_decay: Annotated[float, msgspec.Meta(ge=0)] = 1e-4
    track_knot_s: Positive = 20.0
    validate_every: Count = 30
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


@dataclass
class Stage:
    """What one sensor's descent must remember to go on: also what a checkpoint holds."""

    sensor: Sensor
    optimizer: torch.optim.Optimizer
    mean: AveragedModel  # of the model
    loss: RobustLoss
    step: int = 0
    best: float = float("inf")
    best_state: dict[str, Tensor] = field(default_factory=dict)


class Training:
    """Trains one model on the recordings of one sensor; once `epochs` has ended, `model` is the best that was seen.

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
                self.stage = self.begin(sensor)
            yield from self._descend(self.stage)
            self.model.load_state_dict(self.stage.best_state)
            self.done[sensor], self.stage = self.stage.best, None
        lengths: dict[Sensor, tuple[float, ...]] = {sensor: self._window_s(sensor) for sensor in SENSORS}
        statistics.store(self.model, self.pool, self.tracks.per_log().detach(), lengths)
        self.model.requires_grad_(False).eval()

    def held_out(self, sensor: Sensor, model: BiasModel) -> float:
        """Error over the longest windows that fit the held-out parts: the mean without the worst tenth (rad or m/s).

        Each log's constant is solved for on that part first: it belongs to the run, and what is judged here is the sensor.
        """
        first, n = self._held_out_windows(sensor)
        rest, lengths = self.tracks.per_log().detach(), self._window_s(sensor)[:2]
        columns = COLUMNS[sensor]
        solved = closed_form.solve(model, sensor, self.pool, rest, lengths, matrix=False, part="held_out")
        rest[:, columns] = solved.rest
        with torch.no_grad():
            parts = torch.split(first, 64)
            errors = torch.cat([error(model, sensor, self.pool.windows(f, n, rest[self.pool.log[f]])) for f in parts])
        kept = errors.sort().values[: max(1, int(TRIM * len(errors)))]
        return float(kept.mean())

    def _held_out_windows(self, sensor: Sensor) -> tuple[Int[Tensor, " m"], int]:
        pool, window_s, of_log = self.pool, LONGEST_HELD_OUT_S[sensor], [torch.empty(0)] * len(self.pool.names)
        while window_s > 0.1:
            n = pool.samples(window_s)
            first = pool.starts(n, "held_out", ends_only=True)
            of_log = [first[pool.log[first] == i][:: pool.samples(HELD_OUT_HOP_S)] for i in range(len(pool.names))]
            if all(len(part) for part in of_log):
                return torch.cat(of_log), n
            window_s *= 0.8
        raise DataError(
            "the last fifth of the log holds no stretch of truth",
            where=", ".join(name for name, part in zip(pool.names, of_log, strict=True) if not len(part)),
            expected="truth to the end of each log",
            fix="Leave that log out or cut it",
        )

    def _errors(self, sensor: Sensor, first: Int[Tensor, " m"], n: int) -> Float[Tensor, " m"]:
        rest = self.tracks.at(self.pool.log[first], self.pool.t[first])
        return error(self.model, sensor, self.pool.windows(first, n, rest))

    def _closed_form(self, sensor: Sensor) -> None:
        """Calibration and rest biases, as far as windows and a matrix show them."""
        rest = self.tracks.per_log().detach()
        self._take(sensor, closed_form.solve(self.model, sensor, self.pool, rest, self._window_s(sensor), matrix=True))

    def _window_s(self, sensor: Sensor) -> tuple[float, ...]:
        return self.settings.gyro_window_s if sensor == "gyro" else self.settings.accel_window_s

    def _take(self, sensor: Sensor, solution: closed_form.Solution) -> None:
        self.model.begin_at(sensor, solution.W)
        self.tracks.set(sensor, solution.rest)

    def begin(self, sensor: Sensor) -> Stage:
        """A fresh stage, from where model and tracks stand: it moves the sensor's weights and the tracks."""
        rate, decay = self._rate(sensor), self.settings.weight_decay
        weights = [w for name, w in self.model.named_parameters() if f".{sensor}" in f".{name}"]
        groups = [
            {"params": weights, "weight_decay": decay},
            {"params": [self.tracks.knots], "weight_decay": 0.0},
        ]
        average = get_ema_multi_avg_fn(1 - 1 / AVERAGE_STEPS)  # type: ignore[no-untyped-call]  # torch gives it no type
        usual = RobustLoss({n: self._usual_errors(sensor, first, n) for n, first in self._pools(sensor)})
        return Stage(sensor, torch.optim.AdamW(groups, lr=rate), AveragedModel(self.model, multi_avg_fn=average), usual)

    def _pools(self, sensor: Sensor) -> list[tuple[int, Int[Tensor, " _"]]]:
        """Steps of each window length, and the first samples of its windows in the training part."""
        lengths = map(self.pool.samples, self._window_s(sensor))
        return [(n, first) for n in lengths if len(first := self.pool.starts(n, "train"))]

    @torch.no_grad()
    def _usual_errors(self, sensor: Sensor, first: Int[Tensor, " m"], n: int) -> Float[Tensor, " logs"]:
        """The median error of each log's windows; of a log that has none of this length, that of all."""
        some = first[:: max(1, -(-len(first) * n // USUAL_SAMPLES))]
        size = torch.cat([self._errors(sensor, part, n) for part in torch.split(some, 64)])
        return median_per_log(size, self.pool.log[some], len(self.pool.names))

    def _rate(self, sensor: Sensor) -> float:
        return self.settings.gyro_rate if sensor == "gyro" else self.settings.accel_rate

    def _descend(self, stage: Stage) -> Iterator[Epoch]:
        settings, sensor = self.settings, stage.sensor
        steps = settings.steps if self.model.iterative else 0
        pools = self._pools(sensor)
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

    def _one_step(self, stage: Stage, pools: Sequence[tuple[int, Int[Tensor, " _"]]], steps: int) -> float:
        warm, cool = min(1.0, (stage.step + 1) / WARM_UP_STEPS), 0.5 * (1 + math.cos(math.pi * stage.step / steps))
        rate = self._rate(stage.sensor) * warm * cool
        for group in stage.optimizer.param_groups:
            group["lr"] = rate
        # the losses are means over windows; a second of data counts once against the walk
        total = self.tracks.wandering(stage.sensor) / (len(self.pool.t) / self.pool.rate_hz)
        for n, first in pools:
            count = max(4, self.settings.samples // n)
            chosen = torch.randint(len(first), (count,), generator=self.generator).to(first.device)
            size = self._errors(stage.sensor, first[chosen], n)
            total = total + stage.loss(size, self.pool.log[first[chosen]], n)
        stage.optimizer.zero_grad()
        total.backward()  # type: ignore[no-untyped-call]
        if not bool(torch.isfinite(total)):
            raise NumericsError(
                f"the loss is {float(total.detach())} at step {stage.step} of the {stage.sensor} stage",
                expected="a finite loss",
                fix=f"Lower --set {stage.sensor}_rate",
            )
        stage.optimizer.step()
        stage.mean.update_parameters(self.model)
        stage.step += 1
        return float(total.detach())

    def _validate(self, stage: Stage) -> float:
        model = stage.mean.module
        assert isinstance(model, BiasModel)
        score = self.held_out(stage.sensor, model)
        if not (stage.best_state or math.isfinite(score)):
            raise NumericsError(
                f"the held-out error of the {stage.sensor} is {score} before the first step",
                expected="a finite error",
                fix="Look for absurd values in the logs with imutool info",
            )
        if score < stage.best:
            stage.best, stage.best_state = score, copy.deepcopy(model.state_dict())
        return score
