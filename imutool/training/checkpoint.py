"""Trainings with checkpoints: tensors in safetensors, the rest in its JSON header."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from imutool.bias import neural_ode
from imutool.bias.model_file import read_tensors, write_tensors
from imutool.config import plain
from imutool.errors import ConfigError, ModelError
from imutool.recording import Recording
from imutool.training.fit import Epoch, Stage, Training
from imutool.training.objectives.objective import RobustLoss
from imutool.training.objectives.paper_scheme import PaperTraining
from imutool.training.settings import TrainSettings
from imutool.units import SENSORS, Sensor

FORMAT = "imutool.training/3"


def checkpoint_path(out: Path) -> Path:
    """Where the checkpoint of a training that will write `out` lies."""
    return out.with_name(f"{out.name}.checkpoint")


@dataclass(frozen=True)
class Descent:
    """Trainings to their end, with a checkpoint on the way."""

    kept: Path
    resume: bool
    device: str
    say: Callable[[Epoch], None]

    def __call__(
        self,
        recordings: Sequence[Recording],
        method: str,
        settings: TrainSettings,
        constant: Collection[Sensor] = (),
        *,
        closed: Collection[Sensor] = (),
        checkpointed: bool = True,
        statistics: bool = True,
    ) -> Training:
        """Training of a method, whose `closed` sensors stay in closed form."""
        paper = method == neural_ode.Model.method and settings.model.get("scheme") == "paper"
        training = (PaperTraining if paper else Training)(recordings, method, settings, self.device, constant, closed)
        checkpointed = checkpointed and training.model.iterative
        if checkpointed:
            if self.resume:
                restore(training, self.kept)
            else:
                self.kept.unlink(missing_ok=True)
        try:
            for epoch in training.epochs(statistics=statistics):
                self.say(epoch)
                if checkpointed and epoch.step:
                    save(training, self.kept)
        except (KeyboardInterrupt, SystemExit) as end:  # perhaps in the middle of a step: what is kept is from before
            if self.kept.exists():
                end.add_note(f"{self.kept} holds what is done; the same command with `resume` goes on from there")
            raise
        return training


def save(training: Training, path: Path) -> None:
    """Everything the next step depends on, written next to it and renamed.

    Raises:
        ConfigError: the file cannot be written.
    """
    tensors = {f"model.{name}": value for name, value in training.model.state_dict().items()}
    tensors |= {"tracks": training.tracks.knots.detach(), "generator": training.generator.get_state()}
    about: dict[str, Any] = {"identity": _identity(training), "done": training.done, "before": training.before}
    if stage := training.stage:
        about["stage"] = {"sensor": stage.sensor, "step": stage.step, "before": stage.before}
        tensors |= {f"closed_form.{name}": value for name, value in stage.closed_form.items()}
        tensors |= {f"mean.{name}": value for name, value in stage.mean.state_dict().items()}
        tensors |= {f"usual.{n}": value for n, value in stage.objective.loss.medians.items()}
        for index, state in enumerate(stage.optimizer.state.values()):
            tensors |= {f"optimizer.{index}.{name}": value for name, value in state.items()}
    arrays = {name: value.detach().cpu().contiguous().numpy() for name, value in tensors.items()}
    write_tensors(arrays, {"format": FORMAT, "about": json.dumps(about)}, path, overwrite=True)


def restore(training: Training, path: Path) -> None:
    """Puts a training where a checkpoint left it.

    Raises:
        ConfigError: the checkpoint is of other logs, another method or other settings.
        ModelError: it is damaged.
    """
    arrays, header = read_tensors(path, FORMAT)
    tensors = {name: torch.from_numpy(value) for name, value in arrays.items()}
    try:
        about = json.loads(header["about"])
        if about["identity"] != _identity(training):
            raise ConfigError(
                "the checkpoint belongs to other logs, another method or other settings",
                where=path,
                fix="Give the same command again, or remove the file to start afresh",
            )
        training.model.load_state_dict(_part(tensors, "model."))
        with torch.no_grad():
            training.tracks.knots.copy_(tensors["tracks"])
        training.generator.set_state(tensors["generator"])
        done, before = ({s: float(about[key][s]) for s in SENSORS if s in about[key]} for key in ("done", "before"))
        training.done, training.before = done, before
        if "stage" in about:
            training.stage = _stage(training, about["stage"], tensors)
    except (KeyError, ValueError, TypeError, AttributeError, RuntimeError) as error:
        raise ModelError(f"is no whole checkpoint ({error})", where=path, fix="Remove it to start afresh") from error


def _stage(training: Training, about: dict[str, Any], tensors: dict[str, Tensor]) -> Stage:
    stage = training.begin(about["sensor"])
    stage.mean.load_state_dict(_part(tensors, "mean."))
    for index, state in enumerate(stage.optimizer.state.values()):
        for name, value in state.items():
            value.copy_(tensors[f"optimizer.{index}.{name}"])
    device = training.pool.t.device
    stage.objective.loss = RobustLoss({int(n): value.to(device) for n, value in _part(tensors, "usual.").items()})
    stage.step, stage.before, stage.closed_form = int(about["step"]), float(about["before"]), _part(tensors, "closed_form.")
    return stage


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def _identity(training: Training) -> dict[str, Any]:
    """Logs (by their samples), method and settings, which a checkpoint must match."""
    pool = training.pool
    return {
        "logs": [[name, int((pool.log == i).sum())] for i, name in enumerate(pool.names)],
        "gyro_sum": float(pool.gyro.sum()),
        "method": training.model.method,
        "settings": json.loads(json.dumps(plain(training.settings))),
    }
