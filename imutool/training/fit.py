"""Gradient descent from a closed form: first the gyro, then the accelerometer.

What a step descends on is the objective's to say (`imutool.training.objectives`), and it mixes all logs. Next to the sensor's
weights each log has a slow track of its own rest bias, so that what belongs to a run cannot be mistaken for the sensor's. What
is kept is the running mean over the last steps; or the closed form, if that drifts less over the longest windows of the
held-out part, or if the bias of a log runs away within an hour. A choice among many steps would be made by the noise of that
part, which may be seconds long.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from imutool import registry
from imutool.array_types import Float, Int
from imutool.bias.networks.network import BiasNetwork
from imutool.bias.networks.threads import of_each
from imutool.config import build
from imutool.errors import ConfigError, NumericsError
from imutool.recording import Recording
from imutool.training import bias_spread
from imutool.training.calibration import closed_form
from imutool.training.calibration.last_layer import solve_last_layer
from imutool.training.held_out import held_out_errors, runs_away
from imutool.training.log_signals import begin_at
from imutool.training.objectives.increments import IncrementObjective
from imutool.training.objectives.objective import AdamW, Objective, RestBiases, WindowEndObjective
from imutool.training.settings import TrainSettings, settings_for
from imutool.training.training_windows import Pool, corrected, sensors_up_to
from imutool.units import Sensor

__all__ = ["Epoch", "Stage", "TrainSettings", "Training"]

OBJECTIVES: dict[str, type[Objective]] = {"window_ends": WindowEndObjective, "increments": IncrementObjective}
WARM_UP_STEPS = 20
AVERAGE_STEPS = 30  # over which weights are averaged
SEED_STRIDE = 1_000_003  # between the seeds of two steps
ERROR_UNITS = {"gyro": "rad", "accel": "m/s"}  # of the held-out errors
TRIM = 0.9  # the worst tenth of the held-out windows is where the truth has outliers


@dataclass(frozen=True)
class Epoch:
    """One line of progress: errors are rad for the gyro's stage and m/s for the accelerometer's."""

    sensor: Sensor
    step: int
    steps: int
    loss: float
    held_out: float
    before: float  # held-out error of the closed form the stage started from
    left_s: float
    note: str = ""  # what is being done instead, where there are no steps to count


def note(text: str) -> Epoch:
    """Line of progress where there are no steps to count."""
    return Epoch("gyro", 0, 0, math.nan, math.nan, math.nan, 0.0, text)


@dataclass
class Stage:
    """What one sensor's descent must remember to go on: also what a checkpoint holds."""

    sensor: Sensor
    optimizer: AdamW
    mean: AveragedModel  # of the model
    objective: Objective
    step: int = 0
    before: float = math.nan  # held-out error of the closed form
    closed_form: dict[str, Tensor] = field(default_factory=dict)  # the model it left, once it is judged


def check_device(device: str) -> None:
    """Refuses a device that is not there.

    Raises:
        ConfigError: neither cpu nor cuda, or cuda where there is none.
    """
    if device.partition(":")[0] not in ("cpu", "cuda"):
        raise ConfigError(f"{device!r} is no device", where="device", expected="cpu or cuda")
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise ConfigError("no CUDA device here", where="device", fix="Use `device=cpu`")


class Training:
    """Training of one model on one sensor; `model` is final once `epochs` has ended.

    The `constant` sensors get no matrix in closed form, and the `closed` ones no descent after it.

    Raises:
        DataError: recordings without truth, of different rates, too short, or standing still.
        ConfigError: a method that is not trained, settings it does not know, or settings with another method's defaults.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        method: str,
        settings: TrainSettings | None = None,
        device: str = "cpu",
        constant: Collection[Sensor] = (),
        closed: Collection[Sensor] = (),
    ) -> None:
        self.settings, self._constant, self._closed = settings_for(method, settings), constant, closed
        check_device(device)
        self.pool = Pool.of(recordings, device=device, floors=self.settings.pose_floors)
        torch.manual_seed(self.settings.seed)
        config = build(registry.load("imutool.bias", method).Config, self.settings.model, where=f"model settings of {method}")
        self.model: BiasNetwork = (
            registry.load("imutool.networks", method).Network(config, self.pool.rate_hz).double().to(device)
        )
        learnt = ~self.pool.held_out
        self.model.see(self.pool.gyro[learnt], self.pool.accel[learnt])
        self.tracks = RestBiases(self.pool, self.settings.track_knot_s)
        self.generator = torch.Generator().manual_seed(self.settings.seed)
        self.done: dict[Sensor, float] = {}  # held-out error of each finished stage
        self.before: dict[Sensor, float] = {}  # that of its closed form
        self.stage: Stage | None = None
        self.turn_on: bias_spread.TurnOn | None = None

    def epochs(self, *, statistics: bool = True) -> Iterator[Epoch]:
        """Train and yield progress; a caller may stop and resume between two yields.

        Without `statistics` they are left to `store_statistics`, for a model that may not be kept.
        """
        for sensor in self.pool.sensors:
            if sensor in self.done:
                continue
            if self.stage is None:
                self._closed_form(sensor)
                self.stage = self.begin(sensor)
            last = yield from self._descend(self.stage)
            if kept := last <= self.stage.before and not self._runs_away(self.stage):
                self.model.load_state_dict(self.stage.mean.module.state_dict())
            else:
                self.model.load_state_dict(self.stage.closed_form)
            self.stage.objective.settle()
            self.before[sensor] = self.stage.before
            self.done[sensor], self.stage = last if kept else self.stage.before, None
        if statistics:
            self.store_statistics()

    def store_statistics(self, pool: Pool | None = None) -> None:
        """Store priors, spreads and noise of a pool with the same logs in the model, which is final then."""
        self.model.eval()
        self.turn_on = bias_spread.store_statistics(
            self.model, pool or self.pool, self.tracks.per_log().detach(), self.settings.window_s
        )
        self.model.requires_grad_(False)

    def errors(self) -> dict[str, Any]:
        """Error of each sensor on held-out time; of a descent also that of the closed form from which it began."""
        before = {s: {"closed_form": error} for s, error in self.before.items() if self.model.iterative}
        return {s: {"error": error, "unit": ERROR_UNITS[s], **before.get(s, {})} for s, error in self.done.items()}

    def held_out(self, sensor: Sensor, model: BiasNetwork) -> float:
        """Error over the longest windows that fit the held-out parts: the mean without the worst tenth (rad or m/s)."""
        errors, _ = self.held_out_errors(sensor, model)
        return float(errors.sort().values[: max(1, int(TRIM * len(errors)))].mean())

    def held_out_errors(self, sensor: Sensor, model: BiasNetwork) -> tuple[Float[Tensor, " m"], Int[Tensor, " m"]]:
        """Errors over the longest windows that fit the held-out parts (rad or m/s), and the log of each."""
        return held_out_errors(model, sensor, self.pool, self.tracks.per_log().detach(), self.settings.window_s[sensor][:2])

    def _closed_form(self, sensor: Sensor) -> None:
        """Calibration, curve and rest biases, as far as windows show them."""
        rest = self.tracks.per_log().detach()
        scored, pool = corrected(self.model.eval(), self.pool, "train", sensors_up_to(sensor))
        lengths = self.settings.window_s[sensor]
        if sensor not in self._constant:
            solution = closed_form.solve(scored, sensor, pool, rest, lengths, matrix=True)
            begin_at(self.model, sensor, solution, self.pool.sensors)
            solve_last_layer(self.model, sensor, self.pool, rest)
        # constants that take the nuisances of their logs: the descent knows none
        scored, pool = corrected(self.model.eval(), self.pool, "train", sensors_up_to(sensor))
        constants = closed_form.solve(scored, sensor, pool, rest, lengths, matrix=False, nuisances=False)
        self.tracks.set(sensor, constants.rest)

    def begin(self, sensor: Sensor) -> Stage:
        """Fresh stage from the current model and tracks: it moves the sensor's weights and the tracks."""
        weights = self._moved(sensor)
        free = [w for name, w in weights.items() if name.startswith(self.model.undecayed)]
        groups = [
            ([w for name, w in weights.items() if not name.startswith(self.model.undecayed)], self.settings.weight_decay),
            ([*free, self.tracks.knots], 0.0),
        ]
        average = get_ema_multi_avg_fn(1 - 1 / AVERAGE_STEPS)  # type: ignore[no-untyped-call]  # torch gives it no type
        # with its buffers: the running statistics of a batch norm belong to the weights they were seen with
        mean = AveragedModel(self.model.eval(), multi_avg_fn=average, use_buffers=True)
        objective = OBJECTIVES[self.model.objective](self.model, sensor, self.pool, self.tracks, self.settings)
        return Stage(sensor, AdamW(groups), mean, objective)

    def _moved(self, sensor: Sensor) -> dict[str, Tensor]:
        """Weights of a sensor that a descent moves: those that no closed form gives."""
        named = {name: w for name, w in self.model.named_parameters() if f".{sensor}" in f".{name}"}
        return {name: w for name, w in named.items() if w.requires_grad}

    def _rate(self, sensor: Sensor) -> float:
        return self.settings.gyro_rate if sensor == "gyro" else self.settings.accel_rate

    def _descend(self, stage: Stage) -> Generator[Epoch, None, float]:
        """To the last step; the held-out error there."""
        sensor, steps = stage.sensor, self._steps(stage.sensor)
        began, begun_at = time.monotonic(), stage.step
        loss = float("nan")
        while True:
            if stage.step % self.settings.validate_every == 0 or stage.step == steps:
                score = self._validate(stage)
                per_step = (time.monotonic() - began) / max(stage.step - begun_at, 1)
                yield Epoch(sensor, stage.step, steps, loss, score, stage.before, per_step * (steps - stage.step))
            if stage.step >= steps:
                return score
            loss = self._one_step(stage)

    def _steps(self, sensor: Sensor) -> int:
        descends = self.model.iterative and sensor not in self._closed
        return self.settings.steps if descends and self._moved(sensor) else 0

    def _rate_at(self, stage: Stage) -> float:
        sensor, warm = stage.sensor, min(1.0, (stage.step + 1) / WARM_UP_STEPS)
        return self._rate(sensor) * warm * 0.5 * (1 + math.cos(math.pi * stage.step / self._steps(sensor)))

    def _one_step(self, stage: Stage) -> float:
        self._set_training(stage)
        total = self._descent_direction(stage)
        if not math.isfinite(total):
            raise NumericsError(
                f"the loss is {total} at step {stage.step} of the {stage.sensor} stage",
                expected="a finite loss",
                fix=f"Lower the setting {stage.sensor}_rate",
            )
        stage.optimizer.step(self._rate_at(stage))
        stage.mean.update_parameters(self.model)
        stage.step += 1
        return total

    def _descent_direction(self, stage: Stage) -> float:
        """Put the gradient of a step's loss at the weights; the loss."""
        free = list(stage.optimizer.state)

        def derived(term: Callable[[], Tensor]) -> tuple[float, tuple[Tensor | None, ...]]:
            loss = term()
            return float(loss.detach()), torch.autograd.grad(loss, free, allow_unused=True)

        def wandering() -> Tensor:  # the losses are means over windows; a second of data counts once against the walk
            return self.tracks.wandering(stage.sensor) / (len(self.pool.t) / self.pool.rate_hz)

        losses, gradients = zip(*of_each(derived, [*stage.objective.terms(self.generator), wandering]), strict=True)
        for tensor, *parts in zip(free, *gradients, strict=True):
            known = [part for part in parts if part is not None]
            tensor.grad = torch.stack(known).sum(0) if known else None
        return math.fsum(losses)

    def _set_training(self, stage: Stage) -> None:
        """Puts the parts of the stage's sensor, and no others, where batch norm and dropout do what they do in training.

        What they draw follows from seed and step, so that a training taken up again goes on as if it had not been left.
        """
        self.model.eval()
        for name, module in self.model.named_modules():
            module.training = f".{stage.sensor}" in f".{name}"
        # for a GPU that is not there torch.manual_seed would note down each time where it was called from
        drawing = torch.default_generator if self.pool.t.device.type == "cpu" else torch
        drawing.manual_seed((self.settings.seed + SEED_STRIDE * (stage.step + 1)) % 2**63)

    def _runs_away(self, stage: Stage) -> bool:
        model = stage.mean.module
        assert isinstance(model, BiasNetwork)
        return not model.forgets and runs_away(model, stage.sensor, self.pool, self.tracks.per_log().detach())

    def _validate(self, stage: Stage) -> float:
        model = stage.mean.module
        assert isinstance(model, BiasNetwork)
        model.eval()
        score = self.held_out(stage.sensor, model)
        if stage.closed_form:
            return score if math.isfinite(score) else math.inf
        if not math.isfinite(score):
            raise NumericsError(
                f"the held-out error of the {stage.sensor} is {score} before the first step",
                expected="a finite error",
                fix="Look for absurd values in the logs with imutool info",
            )
        stage.before, stage.closed_form = score, copy.deepcopy(model.state_dict())
        return score
