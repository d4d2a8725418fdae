"""Train on logs with checkpoints, and write the model file with its card."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from torch import Tensor

from imutool import __version__, registry
from imutool.array_types import Float64
from imutool.bias import hybrid, linear, model_file, neural_ode, static
from imutool.bias.model import BiasModel
from imutool.bias.networks import neural_ode as neural_ode_network
from imutool.bias.networks.network import BiasNetwork
from imutool.bias.networks.threads import settings_of_a_new_process, side_by_side
from imutool.bias_start.stretches import within_range
from imutool.config import plain
from imutool.errors import ConfigError
from imutool.log_info.convention_report import check_conventions
from imutool.mcap_io.storage.local import is_stream
from imutool.mcap_io.storage.source import sha256
from imutool.recording import Recording
from imutool.training.calibration.effect_selection import DRIFTS, Calibration, PhysicsFirst, config_of
from imutool.training.calibration.filter_settings import filter_settings
from imutool.training.calibration.log_scatter import MIN_GAIN, SURELY
from imutool.training.calibration.normal_equations import FOLDS
from imutool.training.candidates import left_out_covariance, simpler_effects
from imutool.training.checkpoint import Descent, checkpoint_path
from imutool.training.fit import Epoch, Training, check_device, note
from imutool.training.left_out import MIN_ERROR, Comparison, beaten, compare, network_scores
from imutool.training.log_agreement import warn_of_smoothed_poses
from imutool.training.log_signals import matrix_covariance, read_parts, with_poses_of_sensor
from imutool.training.settings import LINEAR, TrainSettings, settings_for
from imutool.training.training_windows import Pool, check_trainable
from imutool.units import SENSORS, Sensor

logger = logging.getLogger(__name__)

LogErrors = Mapping[Sensor, Float64[np.ndarray, " logs"]]


@settings_of_a_new_process()
def train(
    logs: Sequence[Path],
    out: Path,
    *,
    method: str = "hybrid",
    settings: TrainSettings | None = None,
    device: str = "cpu",
    imu: str | None = None,
    truth: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Callable[[Epoch], None] | None = None,
) -> BiasModel:
    """Train a model on logs of one sensor and write it; `resume` continues from a checkpoint.

    Raises:
        ConfigError: the target exists or is a pipe, unknown method or settings, or a checkpoint of another training.
        ConfigError, LogError, DataError: a log without IMU, measurements or truth, different rates, too little to train on.
        NumericsError: the loss diverged.
    """
    if is_stream(out):
        raise ConfigError("is a pipe or a device", where=out, expected="a file, next to which the checkpoint lies")
    if out.exists() and not overwrite:
        raise ConfigError("exists already", where=out, fix="Choose another name or give `overwrite`")
    if not out.parent.is_dir():
        raise ConfigError("the folder does not exist", where=out.parent, fix="Create it first")
    kept = checkpoint_path(out)
    if resume and not kept.exists():
        raise ConfigError("there is no checkpoint", where=kept, fix="Train without `resume`")
    if kept.exists() and not (resume or overwrite):
        raise ConfigError("interrupted training left its checkpoint", where=kept, fix="Give `resume` to go on, or `overwrite`")
    if method == static.Model.method:
        raise ConfigError("static is not trained", where="method", fix="Choose hybrid, neural_ode, conv or linear")
    check_device(device)
    chosen = settings_for(method, settings)
    if resume and not registry.load("imutool.networks", method).Network.iterative:
        raise ConfigError(f"{method} has no steps to go on with", where="resume", fix="Train it without `resume`")
    if method == hybrid.Model.method:
        config_of(chosen)  # a misspelt setting is an error before any log is read
    parts = read_parts(logs, chosen.max_samples, imu=imu, truth=truth)
    check_conventions(part for _, part in parts)
    recordings = [within_range(part) for _, part in parts]
    for recording in (recording for recording in recordings if recording.truth_caveat):
        logger.warning("%s: %s, and the model learns them", recording.name, recording.truth_caveat)
    pool = Pool.of(recordings)
    check_trainable(recordings, pool)
    warn_of_smoothed_poses(pool)
    if "accel" not in pool.sensors:
        names = ", ".join(recording.name for recording in recordings if not recording.truth.has_positions)
        what = "the true poses of %s have no positions: the gyro alone is trained, and the accelerometer turned with it"
        logger.warning(what, names)
    descent = Descent(kept, resume, device, progress or (lambda epoch: None))
    trainer: Trainer = TRAINERS[method] if method in TRAINERS else partial(_network_alone, method)
    with side_by_side():
        model, about = trainer(recordings, chosen, descent)
    about |= filter_settings(model.frozen(), pool)
    model.card = _card(method, chosen, parts) | about | {key: _shared(recordings, key) for key in ("sensor", "dataset")}
    model_file.save(model.frozen(), out, overwrite=overwrite)
    kept.unlink(missing_ok=True)
    return model_file.load(out)


def _physics_first(
    recordings: Sequence[Recording], settings: TrainSettings, descent: Descent
) -> tuple[BiasNetwork, dict[str, Any]]:
    """Effects as far as they help left-out logs, then the neural ODE where it helps; the card's entries for both."""
    physics = PhysicsFirst.of(recordings, settings, descent.device, descent.say)
    alone = msgspec.structs.replace(settings, model={})
    without = descent(physics.recordings, static.Model.method, alone)
    compared, constant, fits = dict[str, Any](), set[Sensor](), physics.fits
    if settings.compare:
        descent.say(note("scoring left-out logs"))
        pool = Pool.of(recordings, floors=settings.pose_floors)
        comparison = compare(recordings, pool, physics.fits, without.model, settings, physics.scale)
        compared, constant = {"left_out": comparison.card()}, comparison.constant
        if simpler := simpler_effects(physics.fits, comparison.kept):
            named = msgspec.structs.replace(settings, model=settings.model | simpler)
            physics = PhysicsFirst.of(recordings, named, descent.device, descent.say)
            without = descent(physics.recordings, static.Model.method, alone, statistics=False)
    held_out: dict[str, Any] = {"effects": without.errors()}
    kept = without
    if physics.model.config.remainder and len(recordings) > 1:  # a single log shows what fits its own motion
        shared = with_poses_of_sensor(physics.recordings, [fit.own for fit in physics.fits.values()])
        before = descent(shared, static.Model.method, alone, statistics=False)
        ode = descent(shared, neural_ode.Model.method, physics.ode_settings(settings), constant, statistics=False)
        held_out = {"effects": before.errors(), "effects and neural_ode": ode.errors()}
        kept = ode if helps(*(_log_errors(training) for training in (before, ode))) else before
    if kept.turn_on is None:
        kept.store_statistics(without.pool)
    model = physics.finish(kept.model)
    for sensor in (sensor for sensor in constant if not fits[sensor].named):
        covariance = left_out_covariance(fits[sensor], sensor)
        model.take(sensor, LINEAR[sensor], torch.zeros(len(covariance)), covariance)
    return model, _about(kept) | {"compared": held_out, "physics": _described(physics.fits)} | compared


def _drift_first(
    recordings: Sequence[Recording], settings: TrainSettings, descent: Descent
) -> tuple[BiasNetwork, dict[str, Any]]:
    """Drift behind the load as far as it helps left-out logs, then the neural ODE; the card's entries."""

    def physics_of(**effects: Sequence[str]) -> PhysicsFirst:
        alone = msgspec.structs.replace(settings, model={"accel_effects": (), **effects, **channel})
        return PhysicsFirst.of(recordings, alone, descent.device, lambda epoch: None)

    channel = {name: value for name, value in settings.model.items() if name == "temperature"}
    settings = msgspec.structs.replace(settings, model={k: v for k, v in settings.model.items() if k not in channel})
    loads = settings.model.get("loads")
    if loads is None:
        paper = settings.model.get("scheme") == "paper"
        loads = [] if paper else [name for name in physics_of().fits["gyro"].effects if name in DRIFTS]
    if not loads:
        training = descent(recordings, neural_ode.Model.method, settings)
    else:
        physics = physics_of(gyro_effects=(*LINEAR["gyro"], *loads)).with_gyro_effects(recordings, loads)
        training = descent(physics.recordings, neural_ode.Model.method, settings)
        assert isinstance(training.model, neural_ode_network.Network)
        training.model.take_loads(loads, physics.fits["gyro"].theta)
        if "gyro_temperature" in loads:
            training.model.take_temperature(
                str(physics.model.config.temperature), dict(physics.model.temperature.named_buffers())
            )
    return training.model, _about(training)


def helps(before: LogErrors, after: LogErrors) -> bool:
    """Whether a descent lowers a sensor's errors beyond the scatter of logs, and harms none."""
    harm = max(float(np.mean(after[sensor] - before[sensor])) for sensor in before)
    return harm < MIN_GAIN and any(beaten(before[sensor], after[sensor], SURELY) for sensor in before)


def _log_errors(training: Training) -> LogErrors:
    """Logarithms of each log's mean held-out error."""

    def of_logs(errors: Tensor, log: Tensor) -> Float64[np.ndarray, " logs"]:
        means = [float(errors[log == index].mean()) for index in range(len(training.pool.names))]
        return np.log(np.maximum(means, MIN_ERROR))

    return {sensor: of_logs(*training.held_out_errors(sensor, training.model)) for sensor in training.done}


def _described(fits: Mapping[Sensor, Calibration]) -> dict[str, Any]:
    """Entries of a model card: effects, gains on logs left out of the fit, unseen parameters."""
    return {s: {"effects": list(f.effects), "gains": dict(f.gains), "unseen": list(f.unseen)} for s, f in fits.items()}


def _closed_forms(
    recordings: Sequence[Recording], settings: TrainSettings, descent: Descent
) -> tuple[Mapping[Sensor, Calibration], Comparison]:
    """Constant bias, scale and misalignment on left-out logs."""
    descent.say(note("scoring left-out logs"))
    names = {f"{sensor}_effects": LINEAR[sensor] for sensor in SENSORS}
    shared = {name: getattr(settings, name) for name in TrainSettings.__struct_fields__}
    physics = PhysicsFirst.of(recordings, TrainSettings(**shared | {"model": names}), descent.device, lambda epoch: None)
    without = descent(physics.recordings, static.Model.method, TrainSettings(**shared | {"model": {}}))
    pool = Pool.of(recordings, floors=settings.pose_floors)
    return physics.fits, compare(recordings, pool, physics.fits, without.model, settings)


def _linear(recordings: Sequence[Recording], settings: TrainSettings, descent: Descent) -> tuple[BiasNetwork, dict[str, Any]]:
    """A matrix for each sensor whose matrix helps left-out logs; the card's entries."""
    compared, constant = dict[str, Any](), set[Sensor]()
    if settings.compare:
        fits, comparison = _closed_forms(recordings, settings, descent)
        compared, constant = {"left_out": comparison.card()}, comparison.constant
    training = descent(recordings, linear.Model.method, settings, constant)
    for sensor in constant:
        training.model.take_covariance(sensor, matrix_covariance(left_out_covariance(fits[sensor], sensor)))
    return training.model, _about(training) | compared


def _network_alone(
    method: str, recordings: Sequence[Recording], settings: TrainSettings, descent: Descent
) -> tuple[BiasNetwork, dict[str, Any]]:
    """Network, as far as left-out logs do not refute it; the card's entries.

    The last fifths of logs that each show one motion confirm a network that harms other motions.
    """
    if not settings.compare or len(recordings) < FOLDS:
        training = descent(recordings, method, settings)
        return training.model, _about(training)
    fits, comparison = _closed_forms(recordings, settings, descent)

    def trained_on(logs: Sequence[int]) -> BiasModel:
        descent.say(note("training on half of the logs"))
        half = descent([recordings[index] for index in logs], method, settings, checkpointed=False)
        model = half.model.frozen()
        model.card = {"logs": [{}] * len(logs), **_about(half), **filter_settings(model, half.pool)}
        return model

    pool = Pool.of(recordings, floors=settings.pose_floors)
    comparison = comparison.with_scores(network_scores(method, trained_on, recordings, pool, fits))
    refuted = {sensor for sensor, kept in comparison.kept.items() if kept != method}
    training = descent(recordings, method, settings, comparison.constant, closed=refuted)
    return training.model, _about(training) | {"left_out": comparison.card()}


Trainer = Callable[[Sequence[Recording], TrainSettings, Descent], tuple[BiasNetwork, dict[str, Any]]]
TRAINERS: dict[str, Trainer] = {"hybrid": _physics_first, "linear": _linear, "neural_ode": _drift_first}


def _shared(recordings: Sequence[Recording], key: str) -> str | None:
    """What all logs say of themselves under a key, if they agree."""
    values = {recording.metadata.get("imutool", {}).get(key) for recording in recordings}
    return values.pop() if len(values) == 1 else None


def _about(training: Training) -> dict[str, Any]:
    """Entries of a model card: errors on held-out time, and what the logs tell of the turn-on bias."""
    assert training.turn_on is not None, "the training has not ended"
    return {"held_out": training.errors(), **training.turn_on.card()}


def _card(method: str, settings: TrainSettings, parts: Sequence[tuple[Path, Recording]]) -> dict[str, Any]:
    """Everything needed to repeat the training."""
    return {
        "imutool": __version__,
        "torch": torch.__version__,
        "method": method,
        "training": plain(settings),
        "logs": [
            {"name": r.name, "file": p.name, "sha256": sha256(p), "poses": r.kind_of(next(iter(r.truths), ""))}
            for p, r in parts
        ],
    }
