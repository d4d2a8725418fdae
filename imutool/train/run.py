"""Logs in, a model file out: reads the logs, trains, keeps a checkpoint on the way, and writes the model with its card."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from imutool import __version__
from imutool.bias import _file
from imutool.bias._base import SENSORS, BiasModel
from imutool.config import plain
from imutool.errors import ConfigError
from imutool.mcap_io.read import read
from imutool.mcap_io.rewrite import sha256
from imutool.recording import Recording
from imutool.train import checkpoint
from imutool.train.fit import Epoch, Training, TrainSettings

UNITS = {"gyro": "rad", "accel": "m/s"}


def checkpoint_path(out: Path) -> Path:
    """Where the checkpoint of a training that will write `out` lies."""
    return out.with_name(f"{out.name}.checkpoint")


def train(
    logs: Sequence[Path],
    out: Path,
    *,
    method: str = "neural_ode",
    settings: TrainSettings | None = None,
    device: str = "cpu",
    imu: str | None = None,
    truth: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Callable[[Epoch], None] | None = None,
) -> BiasModel:
    """Trains a model on logs of one sensor and writes it; interrupted, it leaves a checkpoint that `resume` takes up.

    Raises:
        ConfigError: the target exists, unknown method or settings, or a checkpoint of another training.
        LogError, DataError: a log without IMU or truth, different rates, too little to train on.
        NumericsError: the loss diverged.
    """
    if out.exists() and not overwrite:
        raise ConfigError("exists already", where=out, fix="Choose another name or give --overwrite")
    if not out.parent.is_dir():
        raise ConfigError("the folder does not exist", where=out.parent, fix="Create it first")
    kept = checkpoint_path(out)
    if resume and not kept.exists():
        raise ConfigError("there is no checkpoint", where=kept, fix="Train without --resume")
    if kept.exists() and not (resume or overwrite):
        said = "an interrupted training left its checkpoint"
        raise ConfigError(said, where=kept, fix="Give --resume to go on, or --overwrite to start afresh")
    recordings = [read(log, imu=imu, truth=truth) for log in logs]
    training = Training(recordings, method, settings, device)
    if resume:
        checkpoint.restore(training, kept)
    else:
        kept.unlink(missing_ok=True)
    try:
        for epoch in training.epochs():
            if progress is not None:
                progress(epoch)
            if training.model.iterative and epoch.step:
                checkpoint.save(training, kept)
    except KeyboardInterrupt as interrupt:  # it may have struck in the middle of a step: what is kept is from before
        if kept.exists():
            raise KeyboardInterrupt(
                f"{kept} holds what is done; the same command with --resume goes on from there"
            ) from interrupt
        raise
    model = training.model
    model.card = {**_card(training, logs), **{key: _shared(recordings, key) for key in ("sensor", "dataset")}}
    _file.save(model, out, overwrite=overwrite)
    kept.unlink(missing_ok=True)
    return _file.load(out)


def _shared(recordings: Sequence[Recording], key: str) -> str | None:
    """What all logs say of themselves under a key, if they agree."""
    said = {recording.metadata.get("imutool", {}).get(key) for recording in recordings}
    return said.pop() if len(said) == 1 else None


def _card(training: Training, logs: Sequence[Path]) -> dict[str, Any]:
    """Everything needed to repeat the training."""
    return {
        "imutool": __version__,
        "torch": torch.__version__,
        "method": training.model.method,
        "training": plain(training.settings),
        "logs": [{"name": n, "file": p.name, "sha256": sha256(p)} for n, p in zip(training.pool.names, logs, strict=True)],
        "held_out": {sensor: {"error": training.done[sensor], "unit": UNITS[sensor]} for sensor in SENSORS},
    }
